//! First pass over an image: which readings are valid, which voxels they occupy, and what has
//! appeared.

use crate::block::{Evidence, State};
use crate::blocks::Blocks;
use crate::capsules::RobotMask;
use crate::config::MapConfig;
use crate::footprint::{Footprint, Pyramid};
use crate::grid::VoxelIx;
use crate::view::View;
use nalgebra::Vector3;

/// Readings of neighboring pixels on the same surface differ by less than this fraction of the
/// depth, or by a voxel: at a distance of 1 m and with a focal length of 600 pixels, the surface is
/// then inclined by up to 87 degrees.
const MAX_STEP_FRAC: f32 = 0.03;

/// A surface in a voxel that was free before.
#[derive(Clone, Copy, Debug)]
struct Appeared {
    point: Vector3<f32>,
    ray: Vector3<f32>,
}

/// Parts of the map that the pass reads.
#[derive(Debug)]
pub(crate) struct Scene<'a> {
    pub(crate) config: &'a MapConfig,
    pub(crate) view: &'a View,
    pub(crate) robot: &'a RobotMask,
    pub(crate) evidence: Evidence,
}

/// Readings with at least one neighbor of a similar depth, up to the maximum depth; 0 for all
/// others. Pixels at the border of the image have too few neighbors.
pub(crate) fn without_outliers(depth_m: &[f32], width: usize, config: &MapConfig) -> Vec<f32> {
    #[expect(clippy::cast_possible_truncation, reason = "depth is in f32")]
    let [voxel_m, min_m, max_m] =
        [config.voxel_m, config.min_depth_m, config.max_depth_m].map(|m| m as f32);
    let mut kept = vec![0.0; depth_m.len()];
    let height = depth_m.len() / width;
    if width < 3 || height < 3 {
        return kept;
    }
    for row in 1..height - 1 {
        let line = |row: usize| &depth_m[row * width..(row + 1) * width];
        let (above, own, below) = (line(row - 1), line(row), line(row + 1));
        let kept = &mut kept[row * width + 1..(row + 1) * width - 1];
        for (ix, kept) in kept.iter_mut().enumerate() {
            let z = own[ix + 1];
            let max_step = voxel_m.max(MAX_STEP_FRAC * z);
            // Comparisons with NaN are false. Readings of 0 differ from all valid ones by more.
            let is_close = |other: f32| (other - z).abs() <= max_step;
            let is_kept = is_close(above[ix])
                | is_close(above[ix + 1])
                | is_close(above[ix + 2])
                | is_close(own[ix])
                | is_close(own[ix + 2])
                | is_close(below[ix])
                | is_close(below[ix + 1])
                | is_close(below[ix + 2]);
            let is_valid = z >= min_m && z < f32::INFINITY;
            *kept = if is_kept & is_valid {
                z.min(max_m)
            } else {
                0.0
            };
        }
    }
    kept
}

/// Marks voxels with readings as occupied, forgets what is behind a surface that has appeared, and
/// fills the pyramid.
pub(crate) fn mark(
    blocks: &mut Blocks,
    scene: &Scene<'_>,
    readings_m: &[f32],
    pyramid: &mut Pyramid,
) {
    let [width, _] = scene.view.size_px;
    pyramid.start(scene.view.size_px);
    let stride_px = pyramid.stride_px();
    let mut appeared = Vec::new();
    for (row, readings) in readings_m.chunks_exact(width).enumerate() {
        let mut pixels = RowPixels {
            first_ray: scene.view.ray(0, row),
            last: None,
            blocks,
            scene,
            appeared: &mut appeared,
        };
        let texels = pyramid.texels_of_row(row);
        for (texel_ix, (texel, readings)) in texels
            .iter_mut()
            .zip(readings.chunks(stride_px))
            .enumerate()
        {
            pixels.add(texel, readings, texel_ix * stride_px);
        }
    }
    pyramid.finish(scene.view.size_px);
    for surface in &appeared {
        forget_behind(blocks, scene, surface);
    }
}

/// The pixels of one row.
struct RowPixels<'a> {
    first_ray: Vector3<f32>,
    /// The voxel of the pixel before, and whether it is the robot. Neighbors often share a voxel.
    last: Option<(VoxelIx, bool)>,
    blocks: &'a mut Blocks,
    scene: &'a Scene<'a>,
    appeared: &'a mut Vec<Appeared>,
}

impl RowPixels<'_> {
    /// Adds the readings of some pixels to their texel and to the map.
    fn add(&mut self, texel: &mut Footprint, readings_m: &[f32], first_column: usize) {
        let per_column = self.scene.view.per_column();
        for (ix, z_m) in readings_m.iter().enumerate() {
            if *z_m <= 0.0 {
                continue;
            }
            texel.valid_frac += 1.0;
            texel.far_m = texel.far_m.max(*z_m);
            let ray = self.first_ray + per_column * (first_column + ix) as f32;
            if self.is_robot(ray, *z_m) {
                texel.near_robot_m = texel.near_robot_m.min(*z_m);
            } else {
                texel.near_scene_m = texel.near_scene_m.min(*z_m);
            }
        }
    }

    /// Whether a reading is the robot. If not, it occupies its voxel.
    fn is_robot(&mut self, ray: Vector3<f32>, z_m: f32) -> bool {
        let point = self.scene.view.center() + ray * z_m;
        let Some(at) = self.blocks.grid.voxel_of(&point) else {
            return false;
        };
        if let Some((_, false)) = self.last.filter(|(last, _)| *last == at) {
            return false;
        }
        let is_robot = self.scene.robot.contains(&point, at.block);
        self.last = Some((at, is_robot));
        if !is_robot && f64::from(z_m) < self.scene.config.max_depth_m {
            self.occupy(at, Appeared { point, ray });
        }
        is_robot
    }

    fn occupy(&mut self, at: VoxelIx, surface: Appeared) {
        let Some((block, voxel)) = self.blocks.of_voxel(at) else {
            return;
        };
        let was_free = block.state(voxel) == State::Free;
        block.set(voxel, State::Occupied, self.scene.evidence);
        if was_free && block.state(voxel) == State::Occupied {
            self.appeared.push(surface);
        }
    }
}

/// Forgets that space behind a surface was free. Errors of depth also move surfaces into space that
/// was free, so nothing changes if a surface was close behind before.
fn forget_behind(blocks: &mut Blocks, scene: &Scene<'_>, surface: &Appeared) {
    /// Voxels per step. No voxel on the ray is missed by more than its corners.
    const STEP: f32 = 0.5;
    /// Steps in which a surface that was there before is the same one.
    const SAME_SURFACE_STEPS: u32 = 5;
    let direction = surface.ray.normalize();
    #[expect(clippy::cast_possible_truncation, reason = "inner loops use f32")]
    let depth = (scene.config.hidden_depth_m / scene.config.voxel_m) as f32;
    let n_steps = u32::try_from(crate::grid::floor(depth / STEP)).unwrap_or(0);
    let point = |step: u32| surface.point + direction * (STEP * step as f32);
    let is_old_surface = |step: u32| {
        let at = blocks.grid.voxel_of(&point(step));
        let block = at.and_then(|at| Some((blocks.get(at.block)?, at.voxel)));
        block.is_some_and(|(block, voxel)| {
            block.state(voxel) == State::Occupied && block.millis(voxel) < scene.evidence.millis
        })
    };
    if (1..=SAME_SURFACE_STEPS).any(is_old_surface) {
        return;
    }
    for step in 1..=n_steps {
        let Some(at) = blocks.grid.voxel_of(&point(step)) else {
            return;
        };
        let Some(block) = blocks.existing(at.block) else {
            continue;
        };
        if block.state(at.voxel) == State::Free {
            block.set(at.voxel, State::Unknown, scene.evidence);
        }
    }
}
