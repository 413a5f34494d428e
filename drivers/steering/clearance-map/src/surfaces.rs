//! First pass over an image: which voxels its readings occupy, and what has appeared.

use crate::block::{Evidence, State};
use crate::blocks::Blocks;
use crate::capsules::RobotMask;
use crate::config::MapConfig;
use crate::footprint::{Footprint, Pyramid};
use crate::grid::VoxelIx;
use crate::samples::{Sample, Samples, sample_px};
use crate::view::View;
use nalgebra::Vector3;

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

/// Marks voxels with readings as occupied, forgets what is behind a surface that has appeared, and
/// fills the pyramid.
pub(crate) fn mark(
    blocks: &mut Blocks,
    scene: &Scene<'_>,
    samples: &Samples,
    pyramid: &mut Pyramid,
) {
    pyramid.start(scene.view.size_px);
    let sample_px = sample_px(scene.view.size_px[0]);
    let samples_per_texel = pyramid.stride_px() / sample_px;
    let mut appeared = Vec::new();
    let mut marking = Marking {
        last: None,
        blocks: &mut *blocks,
        scene,
        appeared: &mut appeared,
    };
    for (row, samples) in samples.rows().enumerate() {
        let texels = pyramid.texels_of_row(row / samples_per_texel);
        // The ray through the center of a sample.
        let center = |ix: usize| (ix as f32 + 0.5) * sample_px as f32;
        let mut ray = scene.view.ray(center(0), center(row));
        let per_sample = scene.view.per_column() * sample_px as f32;
        for (column, sample) in samples.iter().enumerate() {
            marking.add(&mut texels[column / samples_per_texel], sample, &ray);
            ray += per_sample;
        }
    }
    pyramid.finish(scene.view.size_px);
    for surface in &appeared {
        forget_behind(blocks, scene, surface);
    }
}

/// Readings on their way into the map and the pyramid.
struct Marking<'a> {
    /// The voxel of the last reading, if it is not the robot. Neighbors often share a voxel.
    last: Option<VoxelIx>,
    blocks: &'a mut Blocks,
    scene: &'a Scene<'a>,
    appeared: &'a mut Vec<Appeared>,
}

impl Marking<'_> {
    /// Adds a sample to its texel and to the map.
    fn add(&mut self, texel: &mut Footprint, sample: &Sample, ray: &Vector3<f32>) {
        if sample.n_valid == 0.0 {
            return;
        }
        let is_robot = self.is_robot(ray, sample.near_m);
        texel.add(sample, is_robot);
    }

    /// Whether a reading is the robot. If not, it occupies its voxel.
    fn is_robot(&mut self, ray: &Vector3<f32>, z_m: f32) -> bool {
        let point = self.scene.view.center() + ray * z_m;
        let Some(at) = self.blocks.grid.voxel_of(&point) else {
            return false;
        };
        if self.last == Some(at) {
            return false;
        }
        if self.scene.robot.contains(&point, at.block) {
            return true;
        }
        self.last = Some(at);
        if f64::from(z_m) < self.scene.config.max_depth_m {
            self.occupy(at, Appeared { point, ray: *ray });
        }
        false
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
