//! Checkpoints of a field, from which training continues bit for bit.

use super::super::block::{Block, Blocks, GridCoord, N_VOXELS};
use super::super::chosen_grid::VoxelGrid;
use super::super::options::TsdfOptions;
use super::TsdfModel;
use super::field_store::FieldStore;
use super::keyframe_queue::KeyframeQueue;
use crate::Error;
use crate::keyframe_signature::{self, KeyframeSignature};
use crate::model_options::{MethodOptions, ModelOptions};
use crate::pending::PendingCheckpoint;
use gpu::Gpu;
use keyframe::Keyframe;
use model_files::checkpoint::{Array, Checkpoint};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

pub(super) const METHOD: &str = TsdfOptions::METHOD;
const BLOCK_COORDS: &str = "block_coords";
const GEOMETRY: &str = "geometry";
const COLORS: &str = "colors";

/// The state without the blocks.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TsdfState {
    pub(super) options: ModelOptions<TsdfOptions>,
    pub(super) voxel_grid: Option<VoxelGrid>,
    pub(super) step: u64,
    pub(super) n_skipped: u64,
    pub(super) n_blocks: u64,
    pub(super) fused: Vec<KeyframeSignature>,
    pub(super) n_removed: u64,
    /// Keyframes that were pushed but not fused yet, in order.
    pub(super) pending: Vec<KeyframeSignature>,
}

impl TsdfModel {
    pub(super) fn take_checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        let (state, arrays) = self.state()?;
        Ok(PendingCheckpoint::new(move || {
            Ok(Checkpoint::new(METHOD, state, arrays))
        }))
    }

    /// The state, and the blocks ordered by their coordinates.
    pub(super) fn state(&mut self) -> Result<(serde_json::Value, Vec<Array>), Error> {
        let blocks = self.blocks()?;
        let state = TsdfState {
            options: self.options.clone(),
            voxel_grid: self.voxel_grid().cloned(),
            step: self.queue.step(),
            n_skipped: self.queue.n_skipped,
            n_blocks: blocks.len() as u64,
            fused: self.queue.fused.clone(),
            n_removed: self.queue.n_removed,
            pending: self
                .queue
                .pending
                .iter()
                .map(|keyframe| KeyframeSignature::of(keyframe))
                .collect(),
        };
        let state =
            serde_json::to_value(state).map_err(|error| invalid_state(error.to_string()))?;
        Ok((state, arrays_of(&blocks)))
    }

    /// Resumes training exactly where the checkpoint was taken. `keyframes` must include all
    /// keyframes that the model had received. Also returns the other keyframes, to be pushed or
    /// kept for testing.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        let mut model = Self::of_state(gpu, checkpoint)?;
        let KeyframeQueue {
            pending,
            fused,
            unmatched,
            ..
        } = &mut model.queue;
        let known: Vec<KeyframeSignature> = fused.iter().chain(&*unmatched).cloned().collect();
        // Fused keyframes are only verified, because the blocks contain their contribution. Pending
        // keyframes are needed with their pixels.
        let (mut found, rest) = keyframe_signature::match_keyframes(&known, keyframes)?;
        *pending = found.split_off(fused.len()).into();
        unmatched.clear();
        Ok((model, rest))
    }

    /// Restores a model from a checkpoint, without its pending keyframes.
    pub(super) fn of_state(gpu: Arc<Gpu>, checkpoint: &Checkpoint) -> Result<Self, Error> {
        if checkpoint.method != METHOD {
            return Err(invalid_state(format!(
                "it was written by method {:?}",
                checkpoint.method
            )));
        }
        let state: TsdfState = serde_json::from_value(checkpoint.state.clone())
            .map_err(|error| invalid_state(error.to_string()))?;
        let blocks = blocks_of(checkpoint, state.n_blocks)?;
        let mut model = Self::without_budget_check(gpu, state.options)?;
        if let Some(voxel_grid) = state.voxel_grid {
            check_lattice(&voxel_grid)?;
            let max_bytes = model.options.common.max_bytes;
            model.store = Some(FieldStore::with_blocks(
                &model.gpu,
                &model.pipelines,
                voxel_grid,
                max_bytes,
                blocks,
            )?);
        }
        model.queue = KeyframeQueue {
            fused: state.fused,
            unmatched: state.pending,
            n_skipped: state.n_skipped,
            n_removed: state.n_removed,
            ..KeyframeQueue::default()
        };
        Ok(model)
    }
}

/// Checks the values with which kernels divide or allocate, because files come from users.
fn check_lattice(voxel_grid: &VoxelGrid) -> Result<(), Error> {
    let positive = [
        voxel_grid.voxel_m,
        voxel_grid.truncation_m,
        voxel_grid.scale_m,
        voxel_grid.max_depth_m,
    ];
    let is_usable = positive
        .iter()
        .all(|value| value.is_finite() && *value > 0.0)
        && voxel_grid.anchor_m.iter().all(|along| along.is_finite())
        && voxel_grid.noise_per_m2 >= 0.0
        && voxel_grid.truncation_m > voxel_grid.voxel_m
        && voxel_grid.max_weight <= 65_535;
    if is_usable {
        Ok(())
    } else {
        Err(invalid_state(format!("invalid voxel grid: {voxel_grid:?}")))
    }
}

fn arrays_of(blocks: &Blocks) -> Vec<Array> {
    let block_coords: Vec<u8> = blocks
        .keys()
        .flatten()
        .flat_map(|along| along.to_le_bytes())
        .collect();
    let geometry: Vec<u8> = blocks
        .values()
        .flat_map(|block| &block.geometry)
        .flat_map(|word| word.to_le_bytes())
        .collect();
    let colors: Vec<u8> = blocks
        .values()
        .flat_map(|block| &block.colors)
        .flatten()
        .flat_map(|word| word.to_le_bytes())
        .collect();
    [
        (BLOCK_COORDS, block_coords),
        (GEOMETRY, geometry),
        (COLORS, colors),
    ]
    .map(|(name, bytes)| Array {
        name: name.to_owned(),
        bytes,
    })
    .into()
}

/// Size of an array with `each` bytes per block. The number of blocks comes from a file, so it may
/// be implausibly large.
fn n_bytes(n_blocks: u64, each: u64) -> Result<u64, Error> {
    n_blocks
        .checked_mul(each)
        .ok_or_else(|| invalid_state(format!("too many blocks: {n_blocks}")))
}

fn blocks_of(checkpoint: &Checkpoint, n_blocks: u64) -> Result<Blocks, Error> {
    let block_coords = checkpoint.array(BLOCK_COORDS, n_bytes(n_blocks, 12)?)?;
    let geometry = checkpoint.array(GEOMETRY, n_bytes(n_blocks, 4 * 512)?)?;
    let colors = checkpoint.array(COLORS, n_bytes(n_blocks, 8 * 512)?)?;
    let word = |bytes: &[u8]| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    // All arrays have the order of the blocks' coordinates, not of their slots.
    let block_coords = block_coords.chunks_exact(12).map(|bytes| -> GridCoord {
        std::array::from_fn(|axis| word(&bytes[4 * axis..4 * axis + 4]).cast_signed())
    });
    let blocks = geometry
        .chunks_exact(4 * N_VOXELS)
        .zip(colors.chunks_exact(8 * N_VOXELS))
        .map(|(geometry, colors)| Block {
            geometry: geometry.chunks_exact(4).map(word).collect(),
            colors: colors
                .chunks_exact(8)
                .map(|both| [word(&both[..4]), word(&both[4..])])
                .collect(),
        });
    // The map keeps only one of several blocks with the same coordinates, so a wrong number reveals
    // duplicates.
    let blocks: Blocks = block_coords.zip(blocks).collect();
    if blocks.len() as u64 == n_blocks {
        Ok(blocks)
    } else {
        Err(invalid_state("duplicate block coordinates".to_owned()))
    }
}

pub(super) fn invalid_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}
