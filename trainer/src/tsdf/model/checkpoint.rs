//! The state of a field on the way: all that decides how it goes on, bit for bit.

use super::super::block::{Block, Blocks, N_VOXELS, Place};
use super::super::buffers::{Capacity, FieldBuffers};
use super::super::chosen::Lattice;
use super::super::options::TsdfOptions;
use super::{FIRST_CAPACITY, TsdfModel};
use crate::checkpoint::{Array, Checkpoint, PendingCheckpoint};
use crate::gpu::Gpu;
use crate::seen::{self, Seen};
use crate::{Error, Keyframe};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

pub(super) const METHOD: &str = "tsdf";
const PLACES: &str = "places";
const GEOMETRY: &str = "geometry";
const COLORS: &str = "colors";

/// All but the blocks.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct State {
    pub(super) options: TsdfOptions,
    pub(super) lattice: Option<Lattice>,
    pub(super) step: u64,
    pub(super) n_refused: u64,
    pub(super) n_blocks: u64,
    pub(super) fused: Vec<Seen>,
    /// Pushed and not fused, in order.
    pub(super) pending: Vec<Seen>,
}

impl TsdfModel {
    pub(super) fn take_checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        let (state, arrays) = self.state()?;
        Ok(PendingCheckpoint::new(move || Ok(Checkpoint::new(METHOD, state, arrays))))
    }

    /// The state and the blocks, in order of their places.
    pub(super) fn state(&mut self) -> Result<(serde_json::Value, Vec<Array>), Error> {
        let blocks = self.blocks()?;
        let state = State {
            options: self.options.clone(),
            lattice: self.lattice.clone(),
            step: self.step,
            n_refused: self.n_refused,
            n_blocks: blocks.len() as u64,
            fused: self.fused.clone(),
            pending: self.pending.iter().map(|keyframe| Seen::of(keyframe)).collect(),
        };
        let state = serde_json::to_value(state).map_err(|error| bad_state(error.to_string()))?;
        Ok((state, arrays_of(&blocks)))
    }

    /// Goes on from a checkpoint as if nothing had stopped. What it had seen must be among `keyframes`; the others come
    /// back, to be pushed or kept for testing.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        let mut model = Self::of_state(gpu, checkpoint)?;
        let seen: Vec<Seen> = model.fused.iter().chain(&model.to_match).cloned().collect();
        let (mut found, rest) = seen::matched(&seen, keyframes, Arc::clone)?;
        model.pending = found.split_off(model.fused.len()).into();
        model.to_match.clear();
        Ok((model, rest))
    }

    /// The model a checkpoint holds, without the keyframes it waits for.
    pub(super) fn of_state(gpu: Arc<Gpu>, checkpoint: &Checkpoint) -> Result<Self, Error> {
        if checkpoint.method != METHOD {
            return Err(bad_state(format!("it is of the method {:?}", checkpoint.method)));
        }
        let state: State =
            serde_json::from_value(checkpoint.state.clone()).map_err(|error| bad_state(error.to_string()))?;
        let blocks = blocks_of(checkpoint, state.n_blocks)?;
        let mut model = Self::within_any_budget(gpu, state.options)?;
        let most = model.most_blocks() as usize;
        model.due = blocks.keys().copied().collect();
        let mut resident = blocks;
        if let Some(last) = resident.keys().nth(most).copied() {
            model.waiting = resident.split_off(&last);
        }
        if let Some(lattice) = &state.lattice {
            check_lattice(lattice)?;
            let n_blocks = FIRST_CAPACITY.n_blocks.min(model.most_blocks());
            let capacity = Capacity { n_blocks, ..FIRST_CAPACITY };
            let field = FieldBuffers::with_blocks(&model.gpu, &model.pipelines, lattice, &resident, capacity)?;
            model.n_resident = field.n_blocks(&model.gpu)?;
            model.field = Some(field);
        }
        model.lattice = state.lattice;
        (model.step, model.n_refused) = (state.step, state.n_refused);
        (model.fused, model.to_match) = (state.fused, state.pending);
        Ok(model)
    }
}

fn check_lattice(lattice: &Lattice) -> Result<(), Error> {
    let positive = [lattice.voxel_m, lattice.truncation_m, lattice.scale_m, lattice.max_depth_m];
    let is_usable = positive.iter().all(|value| value.is_finite() && *value > 0.0)
        && lattice.anchor_m.iter().all(|along| along.is_finite())
        && lattice.noise_per_m2 >= 0.0
        && lattice.truncation_m > lattice.voxel_m
        && lattice.max_weight <= 65_535;
    if is_usable { Ok(()) } else { Err(bad_state(format!("no field has such voxels: {lattice:?}"))) }
}

fn arrays_of(blocks: &Blocks) -> Vec<Array> {
    let places: Vec<u8> = blocks.keys().flatten().flat_map(|along| along.to_le_bytes()).collect();
    let geometry: Vec<u8> =
        blocks.values().flat_map(|block| &block.geometry).flat_map(|word| word.to_le_bytes()).collect();
    let colors: Vec<u8> =
        blocks.values().flat_map(|block| &block.colors).flatten().flat_map(|word| word.to_le_bytes()).collect();
    [(PLACES, places), (GEOMETRY, geometry), (COLORS, colors)]
        .map(|(name, bytes)| Array { name: name.to_owned(), bytes })
        .into()
}

fn blocks_of(checkpoint: &Checkpoint, n_blocks: u64) -> Result<Blocks, Error> {
    let n_bytes = |each: u64| n_blocks.checked_mul(each).ok_or_else(|| bad_state(format!("{n_blocks} blocks")));
    let places = checkpoint.array(PLACES, n_bytes(12)?)?;
    let geometry = checkpoint.array(GEOMETRY, n_bytes(4 * 512)?)?;
    let colors = checkpoint.array(COLORS, n_bytes(8 * 512)?)?;
    let word = |bytes: &[u8]| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    let places = places
        .chunks_exact(12)
        .map(|bytes| -> Place { std::array::from_fn(|axis| word(&bytes[4 * axis..4 * axis + 4]).cast_signed()) });
    let blocks =
        geometry.chunks_exact(4 * N_VOXELS).zip(colors.chunks_exact(8 * N_VOXELS)).map(|(geometry, colors)| Block {
            geometry: geometry.chunks_exact(4).map(word).collect(),
            colors: colors.chunks_exact(8).map(|both| [word(&both[..4]), word(&both[4..])]).collect(),
        });
    let blocks: Blocks = places.zip(blocks).collect();
    if blocks.len() as u64 == n_blocks { Ok(blocks) } else { Err(bad_state("a block is there twice".to_owned())) }
}

pub(super) fn bad_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}
