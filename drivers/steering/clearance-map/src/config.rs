//! Settings of the map, and the reach of an arm, from which its size follows.

use crate::error::Error;
use kinematics::Chain;
use nalgebra::Vector3;
use steering::Body;

/// Voxels per side of a block, the unit of allocation. One row of a block is one byte.
pub(crate) const BLOCK_VOXELS: usize = 8;

/// Largest distance that the map reports, voxels. A row of voxels within this distance on both
/// sides is then read as one word of 64 bits, at any offset within a byte.
const MAX_DISTANCE_VOXELS: f64 = 24.0;

/// Maximum number of blocks per side. The rows of a map of this size take 7 MB, and they are
/// copied after each image.
const MAX_BLOCKS: usize = 48;

/// Values per joint that the search for the reach tries.
const REACH_STEPS: u32 = 16;

/// Half of the range that the search for the reach tries for a joint without limits, rad or m.
const UNLIMITED: f64 = std::f64::consts::PI;

/// Settings of the map.
#[derive(Clone, Debug, PartialEq)]
pub struct MapConfig {
    /// Side of a voxel, meters.
    pub voxel_m: f64,
    /// Radius of the mapped region around the arm's base, meters. Points outside are never seen.
    pub radius_m: f64,
    /// Largest distance that the map reports, meters. Larger distances are reported as this one.
    pub max_distance_m: f64,
    /// Readings closer than this are no readings: most cameras see nothing there, or noise.
    pub min_depth_m: f64,
    /// Readings farther than this only show that the space up to here is free.
    pub max_depth_m: f64,
    /// Surfaces this close to the robot's capsules at the time of an image are the robot: cables,
    /// errors of its model, of joint angles and of the camera's pose.
    pub robot_margin_m: f64,
    /// Depth of the space behind a surface that has just appeared whose earlier state is forgotten,
    /// meters. What has appeared is solid, up to this thickness.
    pub hidden_depth_m: f64,
    /// Whether distances from surfaces alone are asked for, beside those from all that is not known
    /// to be free.
    pub has_surfaces: bool,
}

impl MapConfig {
    /// Settings for an arm whose parts stay within `reach_m` of its base.
    #[must_use]
    pub fn for_reach(reach_m: f64) -> Self {
        let max_distance_m = 0.25;
        Self {
            voxel_m: 0.02,
            radius_m: reach_m + max_distance_m,
            max_distance_m,
            min_depth_m: 0.1,
            max_depth_m: 4.0,
            robot_margin_m: 0.03,
            hidden_depth_m: 0.15,
            has_surfaces: false,
        }
    }

    /// The largest reach of these settings, meters.
    #[must_use]
    pub fn max_reach_m() -> f64 {
        let config = Self::for_reach(0.0);
        let n_blocks = (MAX_BLOCKS - 1) / 2 - config.border_blocks();
        n_blocks as f64 * BLOCK_VOXELS as f64 * config.voxel_m - config.max_distance_m
    }

    /// Blocks per side, with a border on each side that is never seen, so that searches near the
    /// border of the region need no bounds.
    pub(crate) fn n_blocks(&self) -> usize {
        2 * (self.region_blocks() + self.border_blocks()) + 1
    }

    pub(crate) fn border_blocks(&self) -> usize {
        self.in_blocks(self.max_distance_m) + 1
    }

    fn region_blocks(&self) -> usize {
        self.in_blocks(self.radius_m)
    }

    fn in_blocks(&self, length_m: f64) -> usize {
        let n = (length_m / (BLOCK_VOXELS as f64 * self.voxel_m)).ceil();
        // The range was checked; a float to integer cast saturates.
        #[expect(clippy::cast_possible_truncation, reason = "checked")]
        let n = n as usize;
        n
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        let in_range = |what, value: f64, is_valid, expected| {
            if is_valid && value.is_finite() {
                Ok(())
            } else {
                Err(Error::Value {
                    what,
                    value,
                    expected,
                })
            }
        };
        let voxel_m = self.voxel_m;
        let is_valid = (1e-3..=0.2).contains(&voxel_m);
        in_range("voxel_m", voxel_m, is_valid, "from 0.001 to 0.2")?;
        let distance_m = self.max_distance_m;
        let is_valid = distance_m >= voxel_m && distance_m <= MAX_DISTANCE_VOXELS * voxel_m;
        in_range(
            "max_distance_m",
            distance_m,
            is_valid,
            "from 1 to 24 voxels",
        )?;
        let radius_m = self.radius_m;
        let is_valid = radius_m >= voxel_m && radius_m <= 100.0;
        in_range("radius_m", radius_m, is_valid, "from voxel_m to 100")?;
        let is_valid = self.n_blocks() <= MAX_BLOCKS;
        let expected =
            "smaller, or voxel_m larger: the map would have more than 48 blocks per side";
        in_range("radius_m", radius_m, is_valid, expected)?;
        let min_m = self.min_depth_m;
        let is_valid = min_m >= 2.0 * voxel_m;
        in_range("min_depth_m", min_m, is_valid, "at least two voxels")?;
        let max_m = self.max_depth_m;
        let is_valid = max_m > min_m && max_m <= 20.0;
        in_range(
            "max_depth_m",
            max_m,
            is_valid,
            "more than min_depth_m and at most 20",
        )?;
        for (what, value) in [
            ("robot_margin_m", self.robot_margin_m),
            ("hidden_depth_m", self.hidden_depth_m),
        ] {
            in_range(what, value, (0.0..=1.0).contains(&value), "from 0 to 1")?;
        }
        Ok(())
    }
}

/// Largest distance of a part of the body from the base of a chain, meters: a lower bound of it,
/// which a search over the joints from the middle of their ranges finds. The part of a region
/// beyond it counts as never seen, so a reach that is too small is safe.
#[must_use]
pub fn reach_m(body: &Body, chain: &Chain) -> f64 {
    let ranges: Vec<[f64; 2]> = chain
        .limits()
        .iter()
        .map(|joint| [joint.lower.max(-UNLIMITED), joint.upper.min(UNLIMITED)])
        .collect();
    let mut q: Vec<f64> = ranges
        .iter()
        .map(|[low, high]| 0.5 * (low + high))
        .collect();
    let mut best_m = farthest_m(body, &q);
    // Each round changes one joint after the other. The distance never becomes smaller.
    for _ in 0..4 {
        for (joint_ix, [low, high]) in ranges.iter().enumerate() {
            for step in 0..=REACH_STEPS {
                let frac = f64::from(step) / f64::from(REACH_STEPS);
                let before = std::mem::replace(&mut q[joint_ix], low + (high - low) * frac);
                let distance_m = farthest_m(body, &q);
                if distance_m > best_m {
                    best_m = distance_m;
                } else {
                    q[joint_ix] = before;
                }
            }
        }
    }
    best_m
}

fn farthest_m(body: &Body, q: &[f64]) -> f64 {
    let far = |end: &Vector3<f64>, radius_m: f64| end.norm() + radius_m;
    body.capsules(q)
        .iter()
        .flat_map(|capsule| capsule.ends.map(|end| far(&end, capsule.radius_m)))
        .fold(0.0, f64::max)
}
