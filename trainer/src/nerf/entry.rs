//! Registers neural fields as a method.

use super::files::FIELD_FILE;
use super::{NerfModel, NerfOptions};
use crate::method_entry::MethodEntry;
use crate::model_options::{MethodOptions, ModelOptions, default_options};
use crate::{Aligned, Error, Method, ResumedModel};
use calibration::ParamSet;
use gpu::Gpu;
use keyframe::Keyframe;
use model_files::checkpoint::Checkpoint;
use std::path::Path;
use std::sync::Arc;

/// Registry entry of neural fields.
pub(crate) static ENTRY: MethodEntry = MethodEntry {
    name: NerfOptions::METHOD,
    description: "neural radiance field",
    model: "a neural field",
    primitive: "entry",
    primitives_label: "Table entries",
    files: &[FIELD_FILE],
    single_file: None,
    needs_depth: false,
    has_chunks: false,
    learnable: ParamSet::IMAGE_POSES.union(ParamSet::IMAGE_GAINS),
    exports: &[], // No other program can read the format.
    default_options: default_options::<NerfOptions>,
    check_options: |options| options.typed::<NerfOptions>().map(drop),
    start,
    resume,
    load,
};

fn start(gpu: Arc<Gpu>, options: &ModelOptions) -> Result<Box<dyn Method>, Error> {
    let model = NerfModel::new(gpu.clone(), options.typed()?)?;
    Ok(Aligned::if_requested(model, &options.common, &gpu))
}

fn resume(
    gpu: Arc<Gpu>,
    checkpoint: &Checkpoint,
    keyframes: &[Arc<Keyframe>],
    placeholders: &[Arc<Keyframe>],
) -> Result<ResumedModel, Error> {
    Aligned::resume(
        checkpoint,
        keyframes,
        placeholders,
        |own_checkpoint, keyframes| NerfModel::resume(gpu, own_checkpoint, keyframes),
    )
}

fn load(gpu: Arc<Gpu>, folder: &Path) -> Result<Box<dyn Method>, Error> {
    Ok(Box::new(Aligned::load(
        NerfModel::load(gpu, folder)?,
        folder,
    )?))
}
