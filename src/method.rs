//! Which scene model: by its name on the command line, new or out of a folder.

mod failed_model;
mod kind;

pub(crate) use failed_model::FailedModel;
pub(crate) use kind::ModelKind;

use crate::config::Train;
use crate::exit::BadArgument;
use crate::model_bounds::Bounds;
use crate::run_folder::{expect_model, expect_one_model};
use crate::splat_file;
use anyhow::Context;
use std::path::Path;
use std::sync::Arc;
use trainer::checkpoint::Checkpoint;
use trainer::gpu::Gpu;
use trainer::nerf::{NerfModel, NerfOptions};
use trainer::splat::{CameraRefinement, SplatOptions, SplatTrainer};
use trainer::tsdf::{TsdfModel, TsdfOptions};
use trainer::{Aligned, Keyframe, Method, Restartable};

/// Names of kinds for people: `splat`, `tsdf and splat`, `tsdf, nerf and splat`.
pub(crate) fn describe(kinds: &[ModelKind]) -> String {
    let names: Vec<&str> = kinds.iter().map(|kind| kind.name()).collect();
    match names.split_last() {
        Some((last, others)) if !others.is_empty() => format!("{} and {last}", others.join(", ")),
        _ => names.concat(),
    }
}

/// A scene model to be made.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ModelSpec {
    pub(crate) kind: ModelKind,
    pub(crate) options: SplatOptions,
}

impl ModelSpec {
    /// A model that has seen nothing yet. Of the options a distance field has the memory it may take, a neural field also
    /// seed, planned steps and whether poses of images are learned, and both alignment; what else they want to know they find in the keyframes.
    pub(crate) fn start(self, gpu: Arc<Gpu>) -> anyhow::Result<Box<dyn Method>> {
        let Self { kind, options } = self;
        Ok(match kind {
            ModelKind::Splat => Box::new(SplatTrainer::new(gpu, options)?),
            ModelKind::Tsdf => aligned(TsdfModel::new(gpu.clone(), tsdf_options(&options))?, &gpu, options),
            ModelKind::Nerf => aligned(NerfModel::new(gpu.clone(), nerf_options(&options))?, &gpu, options),
        })
    }
}

/// The model, with its cameras aligned where that is asked for.
fn aligned(model: impl Restartable + 'static, gpu: &Gpu, options: SplatOptions) -> Box<dyn Method> {
    if options.align == CameraRefinement::default() {
        return Box::new(model);
    }
    Box::new(Aligned::new(model, options.align, gpu.is_software(), options.n_planned_steps))
}

fn tsdf_options(options: &SplatOptions) -> TsdfOptions {
    TsdfOptions { max_bytes: options.max_bytes, ..TsdfOptions::default() }
}

fn nerf_options(options: &SplatOptions) -> NerfOptions {
    let SplatOptions { seed, max_bytes, n_planned_steps, .. } = *options;
    NerfOptions { seed, max_bytes, n_planned_steps, cameras: options.cameras.clone(), ..NerfOptions::default() }
}

/// A model that goes on from a checkpoint.
pub(crate) struct Resumed {
    /// Seed and planned steps are those that training began with.
    pub(crate) model_spec: ModelSpec,
    pub(crate) method: Box<dyn Method>,
    /// What it had not learned from: test keyframes, and new ones.
    pub(crate) untrained: Vec<Arc<Keyframe>>,
}

/// Goes on from a checkpoint; what was learned from must be among the keyframes.
pub(crate) fn resume(gpu: Arc<Gpu>, checkpoint: &Checkpoint, keyframes: &[Arc<Keyframe>]) -> anyhow::Result<Resumed> {
    if checkpoint.method == ModelKind::Tsdf.name() {
        let TsdfOptions { max_bytes, .. } = saved_options(checkpoint)?;
        let options = SplatOptions { max_bytes, ..SplatOptions::default() };
        let resume = |own: &Checkpoint, keyframes: &[_]| TsdfModel::resume(gpu, own, keyframes);
        let (method, untrained) = Aligned::resume(checkpoint, keyframes, resume)?;
        return Ok(Resumed { model_spec: ModelSpec { kind: ModelKind::Tsdf, options }, method, untrained });
    }
    if checkpoint.method == ModelKind::Nerf.name() {
        let NerfOptions { seed, max_bytes, n_planned_steps, cameras, .. } = saved_options(checkpoint)?;
        let options = SplatOptions { seed, max_bytes, n_planned_steps, cameras, ..SplatOptions::default() };
        let resume = |own: &Checkpoint, keyframes: &[_]| NerfModel::resume(gpu, own, keyframes);
        let (method, untrained) = Aligned::resume(checkpoint, keyframes, resume)?;
        return Ok(Resumed { model_spec: ModelSpec { kind: ModelKind::Nerf, options }, method, untrained });
    }
    let (model, untrained) = SplatTrainer::resume(gpu, checkpoint, keyframes)?;
    let model_spec = ModelSpec { kind: ModelKind::Splat, options: model.options().clone() };
    Ok(Resumed { model_spec, method: Box::new(model), untrained })
}

/// The options of the model that a checkpoint is of.
fn saved_options<T: serde::de::DeserializeOwned>(checkpoint: &Checkpoint) -> anyhow::Result<T> {
    let options = checkpoint.state.get("options").cloned().unwrap_or_default();
    serde_json::from_value(options).context("the checkpoint does not say how its model was made")
}

/// The kind of model that a folder holds: what its `model.json` names, else what its files are; `None` where there is neither.
/// A folder that holds several models is refused.
pub(crate) fn kind_in(folder: &Path) -> anyhow::Result<Option<ModelKind>> {
    expect_one_model(folder)?;
    #[derive(serde::Deserialize)]
    struct ModelFile {
        method: Option<String>,
    }
    let kind_by_files =
        [(TsdfModel::is_saved_in(folder), ModelKind::Tsdf), (NerfModel::is_saved_in(folder), ModelKind::Nerf)];
    let detected_kind = || kind_by_files.into_iter().find_map(|(is_here, kind)| is_here.then_some(kind));
    let path = folder.join("model.json");
    let Ok(bytes) = std::fs::read(&path) else { return Ok(detected_kind()) };
    let metadata: ModelFile =
        serde_json::from_slice(&bytes).with_context(|| format!("{} is damaged", path.display()))?;
    Ok(metadata.method.as_deref().and_then(ModelKind::from_name).or_else(detected_kind))
}

/// A saved model: its folder, of any kind, or a file of splats.
pub(crate) fn load(gpu: Arc<Gpu>, model: &Path) -> anyhow::Result<Box<dyn Method>> {
    Ok(load_with_bounds(gpu, model, false)?.method)
}

/// A saved model in GPU memory.
pub(crate) struct LoadedModel {
    pub(crate) kind: ModelKind,
    pub(crate) method: Box<dyn Method>,
    /// Where most of it is; `None` if the model is empty or the bounds were not requested.
    pub(crate) bounds: Option<Bounds>,
}

/// Loads a saved model as [`load`] does; with bounds if `wants_bounds`.
pub(crate) fn load_with_bounds(gpu: Arc<Gpu>, model: &Path, wants_bounds: bool) -> anyhow::Result<LoadedModel> {
    expect_model(model)?;
    match kind_in(model)? {
        Some(ModelKind::Tsdf) => {
            let mut tsdf = TsdfModel::load(gpu, model)?;
            let voxel_grid = tsdf.voxel_grid().filter(|_| wants_bounds).cloned();
            let bounds = match voxel_grid {
                Some(voxel_grid) => Bounds::of_blocks(tsdf.blocks()?.keys(), &voxel_grid),
                None => None,
            };
            return Ok(LoadedModel { kind: ModelKind::Tsdf, method: Box::new(Aligned::load(tsdf, model)?), bounds });
        }
        Some(ModelKind::Nerf) => {
            let nerf = NerfModel::load(gpu, model)?;
            let extent = nerf.extent().filter(|_| wants_bounds);
            let bounds = extent.map(|extent| Bounds { center_m: extent.center_m, radius_m: extent.radius_m });
            return Ok(LoadedModel { kind: ModelKind::Nerf, method: Box::new(Aligned::load(nerf, model)?), bounds });
        }
        Some(ModelKind::Splat) | None => {}
    }
    let splats = splat_file::read(model)?;
    let bounds = if wants_bounds { Bounds::of_splats(&splats) } else { None };
    let trainer = SplatTrainer::from_arrays(gpu, SplatOptions::default(), &splats)?;
    let method: Box<dyn Method> =
        Box::new(if model.is_dir() { trainer.with_saved_corrections(model)? } else { trainer });
    Ok(LoadedModel { kind: ModelKind::Splat, method, bounds })
}

/// The options of a rig file as the trainer wants them; `steps` when their number is settled beforehand.
pub(crate) fn options(train: &Train, steps: Option<u64>) -> Result<SplatOptions, BadArgument> {
    let defaults = SplatOptions::default();
    let max_splats = train.max_splats.unwrap_or(defaults.max_splats.into());
    Ok(SplatOptions {
        seed: train.seed,
        max_splats: u32::try_from(max_splats)
            .map_err(|_| BadArgument(format!("max_splats = {max_splats}: must be at most {}", u32::MAX)))?,
        max_bytes: train.max_bytes,
        sh_degree: train.sh_degree,
        n_planned_steps: steps.unwrap_or(defaults.n_planned_steps),
        ..defaults
    })
}
