//! What a method registers: its names, files and options, and the functions that create, resume and load its models.

use crate::checkpoint::Checkpoint;
use crate::gpu::Gpu;
use crate::model_options::ModelOptions;
use crate::{Error, Method, ResumedModel};
use calibration::ParamSet;
use keyframe::Keyframe;
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;

/// Creates an untrained model.
pub type StartModel = fn(Arc<Gpu>, &ModelOptions) -> Result<Box<dyn Method>, Error>;
/// Restores a model from a checkpoint; the keyframes must contain those it was trained on.
pub type ResumeModel = fn(Arc<Gpu>, &Checkpoint, &[Arc<Keyframe>]) -> Result<ResumedModel, Error>;
/// Loads a saved model from a folder or a single file.
pub type LoadModel = fn(Arc<Gpu>, &Path) -> Result<Box<dyn Method>, Error>;

/// A method that models can be trained with.
pub struct MethodEntry {
    /// Name in files and on the command line.
    pub name: &'static str,
    /// A model of the method in a few words, for help texts.
    pub description: &'static str,
    /// A model of the method in a sentence, such as `a distance field`.
    pub model: &'static str,
    /// The items that [`crate::Progress::primitives`] counts, in the singular.
    pub primitive: &'static str,
    /// Label of their number, in the plural and capitalized.
    pub primitives_label: &'static str,
    /// Files of a saved model besides `model.json`, in the order in which they are put in place. A folder that contains
    /// the last one contains the complete model.
    pub files: &'static [&'static str],
    /// Files that are models by themselves; `None` if a model is always a folder.
    pub single_file: Option<SingleFile>,
    /// Whether only keyframes with depth are trained on.
    pub needs_depth: bool,
    /// Camera parameters that can be optimized with the scene.
    pub learnable: ParamSet,
    /// Formats of other programs, the preferred one first.
    pub exports: &'static [Export],
    /// Default options of the method, as JSON.
    pub default_options: fn() -> Value,
    /// Fails if options are invalid.
    pub check_options: fn(&ModelOptions) -> Result<(), Error>,
    /// Creates an untrained model.
    pub start: StartModel,
    /// Restores a model from a checkpoint, whose `state.options` are [`ModelOptions`]. The keyframes must contain all
    /// that the model was trained on and that were not removed. Some may lack their pixels, because they are removed
    /// right afterwards.
    pub resume: ResumeModel,
    /// Loads a saved model from its folder, or from a single file.
    pub load: LoadModel,
}

/// Files that are models by themselves.
#[derive(Clone, Copy, Debug)]
pub struct SingleFile {
    /// Such a file in a sentence, such as `a file of splats`.
    pub description: &'static str,
    /// Its possible extensions.
    pub extensions: &'static [&'static str],
}

/// A format of other programs into which saved models can be converted.
pub struct Export {
    /// Name of the format, which is also the extension of its files.
    pub format: &'static str,
    /// What a file contains, such as `splats`.
    pub contents: &'static str,
    /// Whether [`ExportRequest::cell_m`] applies.
    pub has_cells: bool,
    /// Converts a model.
    pub write: ExportWriter,
}

/// Converts a saved model.
pub enum ExportWriter {
    /// Without a GPU.
    Cpu(fn(&ExportRequest<'_>) -> Result<Exported, Error>),
    /// With a GPU.
    Gpu(fn(Arc<Gpu>, &ExportRequest<'_>) -> Result<Exported, Error>),
}

/// A model to convert.
#[derive(Clone, Copy, Debug)]
pub struct ExportRequest<'a> {
    /// Folder of a saved model, or a single file.
    pub model: &'a Path,
    /// File to write.
    pub out: &'a Path,
    /// If given, the mesh is simplified to one vertex per cell of this width, meters.
    pub cell_m: Option<f64>,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Number of items.
    pub n_items: u64,
    /// An item, in the singular.
    pub item: &'static str,
    /// Additional properties, to be read after the items, such as `of color degree 3`; may be empty.
    pub detail: String,
}
