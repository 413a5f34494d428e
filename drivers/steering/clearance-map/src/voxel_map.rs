//! The map: integrates images one after the other. It has no thread and no clock.

use crate::block::{Evidence, State};
use crate::blocks::Blocks;
use crate::capsules::{GridCapsule, RobotMask, in_grid};
use crate::carve::{Carving, carve};
use crate::clock::MapClock;
use crate::config::{BLOCK_VOXELS, MapConfig};
use crate::error::Error;
use crate::footprint::Pyramid;
use crate::grid::Grid;
use crate::image::{DepthImage, DepthOrigin, Posture};
use crate::samples::{Samples, without_outliers};
use crate::snapshot::Snapshot;
use crate::surfaces::{Scene, mark};
use crate::view::View;
use kinematics::Transform;
use nalgebra::Vector3;
use steering::Capsule;

/// The region follows a moving base once the base is this many blocks away from its middle.
const MAX_OFF_CENTER_BLOCKS: f64 = 1.0;

/// Voxels around the arm.
#[derive(Debug)]
pub(crate) struct VoxelMap {
    config: MapConfig,
    blocks: Blocks,
    clock: MapClock,
    /// The newest version for answers.
    snapshot: Snapshot,
    // Kept to reuse their memory.
    robot: RobotMask,
    pyramid: Pyramid,
}

impl VoxelMap {
    /// A map in which nothing was ever seen.
    ///
    /// # Errors
    /// If a setting is out of its range.
    pub(crate) fn new(config: &MapConfig) -> Result<Self, Error> {
        config.check()?;
        let blocks = Blocks::new(config);
        Ok(Self {
            config: config.clone(),
            clock: MapClock::default(),
            snapshot: Snapshot::unknown(blocks.grid, config.has_surfaces),
            blocks,
            robot: RobotMask::default(),
            pyramid: Pyramid::default(),
        })
    }

    /// Integrates an image. Returns whether it shows a part of the region.
    ///
    /// * `capsules_in_base`: the robot at the time of the image.
    pub(crate) fn integrate(&mut self, image: &DepthImage, capsules_in_base: &[Capsule]) -> bool {
        let world_from_base = &image.posture.world_from_base;
        self.clock.start(image.stamp);
        let Some(millis) = self.clock.millis(image.stamp) else {
            return false;
        };
        self.follow_base(world_from_base);
        let grid = self.blocks.grid;
        let in_grid = |margin_m| in_grid(capsules_in_base, world_from_base, &grid, margin_m);
        let evidence = Evidence {
            millis,
            is_measured: image.origin == DepthOrigin::Measured,
        };
        let view = View::new(&grid, image);
        self.robot.set(&grid, in_grid(self.config.robot_margin_m));

        // Surfaces come first: what is behind a surface that appeared is forgotten, unless the same
        // image shows it, for example beside a wire.
        let readings_m = without_outliers(&image.depth_m, view.size_px[0], &self.config);
        let samples = Samples::new(&readings_m, view.size_px[0]);
        let scene = Scene {
            config: &self.config,
            view: &view,
            robot: &self.robot,
            evidence,
        };
        mark(&mut self.blocks, &scene, &samples, &mut self.pyramid);
        let carving = Carving {
            view: &view,
            pyramid: &self.pyramid,
            noise: image.origin.noise(),
            evidence,
        };
        let is_visible = carve(&mut self.blocks, &carving);
        // No camera sees inside the robot. Nothing else was there, so it does not age.
        self.set_free_inside(&in_grid(0.0), State::Free, evidence);
        self.publish();
        is_visible
    }

    /// Marks space in and near capsules of the robot as free where nothing was ever seen.
    pub(crate) fn sweep(&mut self, capsules_in_base: &[Capsule], posture: &Posture, margin_m: f64) {
        self.clock.start(posture.stamp);
        let Some(millis) = self.clock.millis(posture.stamp) else {
            return;
        };
        self.follow_base(&posture.world_from_base);
        let grid = self.blocks.grid;
        let evidence = Evidence {
            millis,
            is_measured: false,
        };
        let near = in_grid(capsules_in_base, &posture.world_from_base, &grid, margin_m);
        self.set_free_inside(&near, State::Unknown, evidence);
        let inside = in_grid(capsules_in_base, &posture.world_from_base, &grid, 0.0);
        self.set_free_inside(&inside, State::Free, evidence);
        self.publish();
    }

    /// Forgets everything.
    pub(crate) fn clear(&mut self) {
        self.blocks.clear();
        self.snapshot = Snapshot::unknown(self.blocks.grid, self.config.has_surfaces);
    }

    /// The newest version for answers.
    pub(crate) fn snapshot(&self) -> Snapshot {
        self.snapshot.clone()
    }

    /// Memory of the voxels, bytes.
    pub(crate) fn bytes(&self) -> usize {
        self.blocks.bytes() + self.snapshot.blocked.len() + 4 * self.snapshot.oldest.len()
    }

    /// Sets voxels free whose centers are inside of capsules, if they have a given state.
    fn set_free_inside(&mut self, capsules: &[GridCapsule], before: State, evidence: Evidence) {
        let grid = self.blocks.grid;
        let blocks = &mut self.blocks;
        for capsule in capsules {
            capsule.rows(grid.side(), |span| {
                let [block_y, block_z] = [span.y, span.z].map(|voxel| voxel / BLOCK_VOXELS);
                let row = [span.y, span.z].map(|voxel| voxel % BLOCK_VOXELS);
                for (block_x, bits) in span.bytes() {
                    let block_ix = grid.block_ix([block_x, block_y, block_z]);
                    // A block that does not exist has only unknown voxels.
                    let block = match before {
                        State::Unknown => blocks.get_or_make(block_ix),
                        State::Free | State::Occupied => blocks.existing(block_ix),
                    };
                    if let Some(block) = block {
                        block.set_row_free(row, bits, before, evidence);
                    }
                }
            });
        }
    }

    /// Moves the region if the base has left its middle.
    fn follow_base(&mut self, world_from_base: &Transform) {
        let base = world_from_base.translation.vector;
        let grid = self.blocks.grid;
        let middle = Vector3::repeat(0.5 * grid.side() as f64);
        let off_center = (grid.in_voxels(&base) - middle) / BLOCK_VOXELS as f64;
        if off_center.amax() <= MAX_OFF_CENTER_BLOCKS {
            return;
        }
        let moved = Grid::around(&self.config, &base);
        self.blocks.move_to(moved);
        self.snapshot = Snapshot::unknown(moved, self.config.has_surfaces);
    }

    fn publish(&mut self) {
        self.snapshot.update(&mut self.blocks);
        self.snapshot.clock = self.clock;
    }
}
