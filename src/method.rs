//! Creates, resumes and loads scene models of any kind.

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
use calibration::CameraRefinement;
use keyframe::Keyframe;
use std::path::Path;
use std::sync::Arc;
use trainer::checkpoint::Checkpoint;
use trainer::gpu::Gpu;
use trainer::nerf::{NerfModel, NerfOptions};
use trainer::splat::{SplatOptions, SplatTrainer};
use trainer::tsdf::{TsdfModel, TsdfOptions};
use trainer::{Aligned, Method, Restartable};

/// Names of kinds as prose: `splat`, `tsdf and splat`, `tsdf, nerf and splat`.
pub(crate) fn describe(kinds: &[ModelKind]) -> String {
    let names: Vec<&str> = kinds.iter().map(|kind| kind.name()).collect();
    match names.split_last() {
        Some((last, others)) if !others.is_empty() => format!("{} and {last}", others.join(", ")),
        _ => names.concat(),
    }
}

/// Kind and options of a model to create.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ModelSpec {
    pub(crate) kind: ModelKind,
    pub(crate) options: SplatOptions,
}

impl ModelSpec {
    /// Creates an untrained model. A distance field uses only the memory limit of the options and the alignment; a
    /// neural field also uses the seed, the planned steps and the camera refinement. Everything else comes from the
    /// keyframes.
    pub(crate) fn start(self, gpu: Arc<Gpu>) -> anyhow::Result<Box<dyn Method>> {
        let Self { kind, options } = self;
        Ok(match kind {
            ModelKind::Splat => aligned(SplatTrainer::new(gpu.clone(), options.clone())?, &gpu, options),
            ModelKind::Tsdf => aligned(TsdfModel::new(gpu.clone(), tsdf_options(&options))?, &gpu, options),
            ModelKind::Nerf => aligned(NerfModel::new(gpu.clone(), nerf_options(&options))?, &gpu, options),
        })
    }
}

/// The model, with camera alignment if the options request it.
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

/// A model restored from a checkpoint.
pub(crate) struct Resumed {
    /// Seed and planned steps are those of the original training.
    pub(crate) model_spec: ModelSpec,
    pub(crate) method: Box<dyn Method>,
    /// Keyframes it was not trained on: test keyframes and new ones.
    pub(crate) untrained: Vec<Arc<Keyframe>>,
}

/// Restores a model from a checkpoint. `keyframes` must contain those it was trained on.
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
    let model_spec = ModelSpec { kind: ModelKind::Splat, options: saved_options(checkpoint)? };
    let resume = |own: &Checkpoint, keyframes: &[_]| SplatTrainer::resume(gpu, own, keyframes);
    let (method, untrained) = Aligned::resume(checkpoint, keyframes, resume)?;
    Ok(Resumed { model_spec, method, untrained })
}

/// The options of the model in a checkpoint.
fn saved_options<T: serde::de::DeserializeOwned>(checkpoint: &Checkpoint) -> anyhow::Result<T> {
    let options = checkpoint.state.get("options").cloned().unwrap_or_default();
    serde_json::from_value(options).context("the checkpoint has no valid model options")
}

/// The kind of model in a folder, from the method in `model.json` or else from the files; `None` if neither identifies
/// one.
///
/// # Errors If the folder contains several models, or `model.json` is invalid.
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

/// Loads a saved model of any kind from its folder, or splats from a file.
pub(crate) fn load(gpu: Arc<Gpu>, model: &Path) -> anyhow::Result<Box<dyn Method>> {
    Ok(load_with_bounds(gpu, model, false)?.method)
}

/// A saved model in GPU memory.
pub(crate) struct LoadedModel {
    pub(crate) kind: ModelKind,
    pub(crate) method: Box<dyn Method>,
    /// Region that contains most of the model; `None` if the model is empty or the bounds were not requested.
    pub(crate) bounds: Option<Bounds>,
}

/// Loads a saved model as [`load`] does, with its bounds if `needs_bounds`.
pub(crate) fn load_with_bounds(gpu: Arc<Gpu>, model: &Path, needs_bounds: bool) -> anyhow::Result<LoadedModel> {
    expect_model(model)?;
    match kind_in(model)? {
        Some(ModelKind::Tsdf) => {
            let mut tsdf = TsdfModel::load(gpu, model)?;
            let voxel_grid = tsdf.voxel_grid().filter(|_| needs_bounds).cloned();
            let bounds = match voxel_grid {
                Some(voxel_grid) => Bounds::of_blocks(tsdf.blocks()?.keys(), &voxel_grid),
                None => None,
            };
            return Ok(LoadedModel { kind: ModelKind::Tsdf, method: Box::new(Aligned::load(tsdf, model)?), bounds });
        }
        Some(ModelKind::Nerf) => {
            let nerf = NerfModel::load(gpu, model)?;
            let extent = nerf.extent().filter(|_| needs_bounds);
            let bounds = extent.map(|extent| Bounds { center_m: extent.center_m, radius_m: extent.radius_m });
            return Ok(LoadedModel { kind: ModelKind::Nerf, method: Box::new(Aligned::load(nerf, model)?), bounds });
        }
        Some(ModelKind::Splat) | None => {}
    }
    let splats = splat_file::read(model)?;
    let bounds = if needs_bounds { Bounds::of_splats(&splats) } else { None };
    let trainer = SplatTrainer::from_arrays(gpu, SplatOptions::default(), &splats)?;
    let method: Box<dyn Method> = match model.is_dir() {
        true => Box::new(Aligned::load(trainer.with_saved_corrections(model)?, model)?),
        false => Box::new(trainer),
    };
    Ok(LoadedModel { kind: ModelKind::Splat, method, bounds })
}

/// Trainer options from the settings in a rig file. `steps` is the number of steps if it is fixed in advance.
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
