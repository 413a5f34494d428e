//! Follows the drift of the base with the depth images of its keyframes.

use super::is_usable;
use calibration::{DriftTracker, RangeSensor};
use keyframe::{DepthMap, Keyframe};
use kinematics::Transform;
use nalgebra::{Matrix6, Point3};

/// Number of points of each depth image. More points would lie on the same surfaces.
const N_POINTS: u32 = 2500;
/// Maximum standard deviations of a correction in any direction, meters and radians. With larger
/// errors, an image would blur the model.
const MAX_SIGMA_M: f64 = 0.004;
const MAX_SIGMA_RAD: f64 = 0.004;
/// Maximum standard deviations of a correction that is more accurate than a share of the correction
/// of the next station, meters and radians.
const ACCURATE_M: f64 = 0.0015;
const ACCURATE_RAD: f64 = 0.0015;

/// A correction by depth tracking.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tracked {
    pub(super) from_odom: Transform,
    /// Whether it is more accurate than a share of the correction of the next station.
    pub(super) is_accurate: bool,
}

/// The correction of the reported base poses according to depth images alone. It is known at once,
/// but is less accurate than the registration of a station.
///
/// It does not use the results of registration, because their timing varies.
pub(super) struct DepthTracking {
    tracker: DriftTracker,
    tracked_from_odom: Transform,
}

impl DepthTracking {
    pub(super) fn new() -> Self {
        Self {
            tracker: DriftTracker::new(RangeSensor::DepthCamera),
            tracked_from_odom: Transform::identity(),
        }
    }

    /// The newest correction; `None` if depth images do not determine it.
    pub(super) fn newest(&self) -> Option<Tracked> {
        tracked(self.tracked_from_odom, &self.tracker.covariance())
    }

    /// Adds a keyframe with its reported pose. Returns the correction for it.
    pub(super) fn add(&mut self, keyframe: &Keyframe) -> Option<Tracked> {
        let base_state = keyframe.base.as_ref()?;
        let world_from_base = self.tracked_from_odom * base_state.world_from_base;
        let depth = keyframe.depth.as_ref();
        let points = depth.map_or(Vec::new(), |depth| points(depth, &self.tracked_from_odom));
        if !is_usable(keyframe) {
            // Test keyframes must not influence the poses of other keyframes. Keyframes without depth
            // follow the newest one with depth, with the drift since then.
            return match self.tracker.locate(&points, &world_from_base) {
                Some(found) => tracked(found.motion * self.tracked_from_odom, &found.covariance),
                None if self.tracker.is_empty() => None,
                None => {
                    let covariance = self.tracker.covariance_at(&world_from_base);
                    tracked(self.tracked_from_odom, &covariance)
                }
            };
        }
        if let Some(found) = self.tracker.add(&points, &world_from_base) {
            self.tracked_from_odom = found.motion * self.tracked_from_odom;
        }
        self.newest()
    }
}

/// A correction, if its standard deviations are small enough in all directions.
fn tracked(from_odom: Transform, covariance: &Matrix6<f64>) -> Option<Tracked> {
    let is_below = |begin: usize, max_sigma: f64| {
        let block = covariance.fixed_view::<3, 3>(begin, begin).into_owned();
        block.symmetric_eigenvalues().max() <= max_sigma * max_sigma
    };
    let is_known = is_below(0, MAX_SIGMA_M) && is_below(3, MAX_SIGMA_RAD);
    is_known.then(|| Tracked {
        from_odom,
        is_accurate: is_below(0, ACCURATE_M) && is_below(3, ACCURATE_RAD),
    })
}

/// Points of a depth image, spread evenly, with corrected poses.
fn points(depth: &DepthMap, tracked_from_odom: &Transform) -> Vec<Point3<f64>> {
    let [width, height] = depth.size_px;
    let n_pixels_per_point = f64::from(width) * f64::from(height) / f64::from(N_POINTS);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a number of pixels that is at least 1"
    )]
    let stride = n_pixels_per_point.sqrt().ceil().max(1.0) as usize;
    let world_from_depth = tracked_from_odom * depth.world_from_camera;
    let pixels = (0..height)
        .step_by(stride)
        .flat_map(|y| (0..width).step_by(stride).map(move |x| [x, y]));
    pixels
        .filter_map(|[x, y]| {
            let z_m = f64::from(*depth.depth_m.get((y * width + x) as usize)?);
            let is_measured = z_m > 0.0 && z_m.is_finite();
            is_measured.then(|| world_from_depth * Point3::from(depth.point(x, y, z_m)))
        })
        .collect()
}
