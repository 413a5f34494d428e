//! Registers neural fields as a method.

use super::files::FIELD_FILE;
use super::{NerfModel, NerfOptions};
use crate::method_entry::{MethodEntry, boxed};
use crate::model_options::{MethodOptions, default_options};
use calibration::ParamSet;

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
    can_revise: true,
    has_chunks: false,
    learnable: ParamSet::IMAGE_POSES.union(ParamSet::IMAGE_GAINS),
    exports: &[], // No other program can read the format.
    default_options: default_options::<NerfOptions>,
    check_options: |options| options.typed::<NerfOptions>().map(drop),
    start: |gpu, options| Ok(Box::new(NerfModel::new(gpu, options.typed()?)?)),
    resume: |gpu, checkpoint, keyframes| NerfModel::resume(gpu, checkpoint, keyframes).map(boxed),
    load: |gpu, folder| Ok(Box::new(NerfModel::load(gpu, folder)?)),
};
