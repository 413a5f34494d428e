//! Second pass over an image: which voxels it shows to be free.
//!
//! Cubes of voxels are compared with the readings over all of their points, from whole blocks to
//! single voxels. Marching along rays would miss voxels between the rays, and visit those near the
//! camera many times.

use crate::block::{Evidence, State};
use crate::blocks::Blocks;
use crate::config::BLOCK_VOXELS;
use crate::footprint::{Footprint, Pyramid};
use crate::image::Noise;
use crate::view::{Projected, View, Visible};
use nalgebra::Vector3;

/// Fraction of the pixels of a voxel that must have a reading. Stereo cameras have none at a few
/// percent of all pixels, and beside objects that are closer.
const MIN_VALID_FRAC: f32 = 0.75;

/// Cubes of this side that are not in the image as a whole are not judged. Single voxels at the
/// edges of the image would take more time than all others.
const MIN_PARTLY: usize = 2;

/// An image that shows free space.
#[derive(Debug)]
pub(crate) struct Carving<'a> {
    pub(crate) view: &'a View,
    pub(crate) pyramid: &'a Pyramid,
    pub(crate) noise: Noise,
    pub(crate) evidence: Evidence,
}

/// A cube of voxels in a block.
#[derive(Clone, Copy, Debug)]
struct Cube {
    block_ix: usize,
    /// Lowest voxel of the block.
    block_low: [usize; 3],
    /// Lowest voxel of the cube, in the block.
    low: [usize; 3],
    side: usize,
}

/// Marks all voxels that an image shows to be free. Returns whether the image shows any part of the
/// region.
pub(crate) fn carve(blocks: &mut Blocks, carving: &Carving<'_>) -> bool {
    let mut is_any_visible = false;
    for block_ix in 0..blocks.len() {
        if !blocks.is_in_region(block_ix) {
            continue;
        }
        let block = Cube {
            block_ix,
            block_low: blocks
                .grid
                .block_at(block_ix)
                .map(|block| block * BLOCK_VOXELS),
            low: [0; 3],
            side: BLOCK_VOXELS,
        };
        is_any_visible |= carve_cube(blocks, carving, block);
    }
    is_any_visible
}

/// Judges a cube, and its parts if it cannot be judged as a whole. Returns whether it is visible.
fn carve_cube(blocks: &mut Blocks, carving: &Carving<'_>, cube: Cube) -> bool {
    let projected = match carving.view.project(&cube.center(), cube.side) {
        Visible::No => return false,
        Visible::Partly => return cube.side > MIN_PARTLY && carve_parts(blocks, carving, cube),
        Visible::Whole(projected) => projected,
    };
    let readings = carving.pyramid.over(&projected);
    let block = blocks.get(cube.block_ix);
    let has_free = block.is_some_and(|block| block.has_free(cube.low, cube.side));
    if !carving.may_show_free(&projected, &readings, has_free) {
        return true;
    }
    if carving.is_in_front(&projected, &readings) && readings.min_valid_frac() >= MIN_VALID_FRAC {
        if let Some(block) = blocks.get_or_make(cube.block_ix) {
            block.set_free(cube.low, cube.side, carving.evidence);
        }
    } else if cube.side > 1 {
        carve_parts(blocks, carving, cube);
    } else if readings.valid_frac() >= MIN_VALID_FRAC {
        carve_voxel(blocks, carving, &cube, &projected, &readings);
    }
    true
}

fn carve_parts(blocks: &mut Blocks, carving: &Carving<'_>, cube: Cube) -> bool {
    let mut is_visible = false;
    for part in cube.parts() {
        is_visible |= carve_cube(blocks, carving, part);
    }
    is_visible
}

fn carve_voxel(
    blocks: &mut Blocks,
    carving: &Carving<'_>,
    cube: &Cube,
    projected: &Projected,
    readings: &Footprint,
) {
    let [x, y, z] = cube.low;
    let voxel = (z * BLOCK_VOXELS + y) * BLOCK_VOXELS + x;
    let state = blocks
        .get(cube.block_ix)
        .map_or(State::Unknown, |block| block.state(voxel));
    let is_free = match state {
        State::Occupied => carving.is_in_front(projected, readings),
        State::Unknown => carving.is_before_robot(projected, readings),
        // What was free before needs no margin to stay free. Otherwise, voxels in the margin of a
        // surface would be seen only once, from close by. A surface inside would have occupied it.
        State::Free => projected.center_m <= readings.near_scene_m().min(readings.near_robot_m()),
    };
    if is_free && let Some(block) = blocks.get_or_make(cube.block_ix) {
        block.set(voxel, State::Free, carving.evidence);
    }
}

impl Carving<'_> {
    /// Whether any voxel of a cube may become or stay free, because it is in front of the largest
    /// reading. Cubes behind surfaces and in their margin end here.
    fn may_show_free(&self, cube: &Projected, readings: &Footprint, has_free: bool) -> bool {
        let is_margin_needed = !has_free && readings.near_robot_m() == f32::INFINITY;
        let voxel_m = self.view.voxel_depth_m();
        if is_margin_needed {
            cube.near_m + voxel_m <= self.noise.free_up_to_m(readings.far_m())
        } else {
            cube.near_m + 0.5 * voxel_m <= readings.far_m()
        }
    }

    /// Whether the whole cube is in front of all surfaces.
    fn is_in_front(&self, cube: &Projected, readings: &Footprint) -> bool {
        cube.far_m <= readings.near_robot_m() && self.is_before_scene(cube, readings)
    }

    /// Whether the whole cube is in front of the scene, and its center in front of the robot. What
    /// is between the camera and the robot is known to be free without a margin, because the
    /// surface is that of the robot.
    fn is_before_robot(&self, cube: &Projected, readings: &Footprint) -> bool {
        cube.center_m <= readings.near_robot_m() && self.is_before_scene(cube, readings)
    }

    fn is_before_scene(&self, cube: &Projected, readings: &Footprint) -> bool {
        // Infinite minus infinite would be NaN: no reading of the scene is no limit.
        readings.near_scene_m() == f32::INFINITY
            || cube.far_m <= self.noise.free_up_to_m(readings.near_scene_m())
    }
}

impl Cube {
    /// Center in the grid, voxels.
    fn center(&self) -> Vector3<f32> {
        let half = 0.5 * self.side as f32;
        Vector3::from_fn(|axis, _| (self.block_low[axis] + self.low[axis]) as f32 + half)
    }

    /// Its eight parts.
    fn parts(self) -> impl Iterator<Item = Self> {
        let side = self.side / 2;
        (0..8_usize).map(move |ix| {
            let low = [0, 1, 2].map(|axis| self.low[axis] + side * (ix >> axis & 1));
            Self { low, side, ..self }
        })
    }
}
