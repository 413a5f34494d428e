//! Registry entry of a method: its names, files and options, and functions that create, resume and
//! load its models.

use crate::model_options::ModelOptions;
use crate::{Error, Method, ResumedModel};
use calibration::ParamSet;
use gpu::Gpu;
use keyframe::Keyframe;
use model_files::checkpoint::Checkpoint;
use std::path::Path;
use std::sync::Arc;

/// Creates an untrained model.
pub type StartModel = fn(Arc<Gpu>, &ModelOptions) -> Result<Box<dyn Method>, Error>;
/// Restores a model from a checkpoint. The keyframes must include the keyframes that the model was
/// trained on.
pub type ResumeModel = fn(Arc<Gpu>, &Checkpoint, &[Arc<Keyframe>]) -> Result<ResumedModel, Error>;
/// Loads a saved model from a folder or a single file.
pub type LoadModel = fn(Arc<Gpu>, &Path) -> Result<Box<dyn Method>, Error>;

/// A training method.
pub struct MethodEntry {
    /// Name in files and on the command line.
    pub name: &'static str,
    /// Short description of the method's models, for help texts.
    pub description: &'static str,
    /// Noun phrase with an article for one model of the method, such as `a distance field`.
    pub model: &'static str,
    /// The items that [`crate::Progress::primitives`] counts, in the singular.
    pub primitive: &'static str,
    /// Label of the primitive count, in the plural and capitalized.
    pub primitives_label: &'static str,
    /// Files of a saved model besides `model.json`, in the order in which they are moved into
    /// place. A folder that contains the last file contains the complete model.
    pub files: &'static [&'static str],
    /// Type of the files that each hold a complete model. `None` if a saved model is always a
    /// folder.
    pub single_file: Option<SingleFile>,
    /// Whether the method trains only on keyframes with depth.
    pub needs_depth: bool,
    /// Whether a keyframe that the model was trained on can be replaced by the same keyframe with a
    /// more accurate pose.
    pub can_revise: bool,
    /// Whether models can be sent to clients that draw them themselves, see
    /// [`Method::queue_chunks`].
    pub has_chunks: bool,
    /// Camera parameters that can be optimized with the scene.
    pub learnable: ParamSet,
    /// Export formats, the preferred one first.
    pub exports: &'static [Export],
    /// Default options of a model.
    pub default_options: fn() -> ModelOptions,
    /// Fails if options are invalid.
    pub check_options: fn(&ModelOptions) -> Result<(), Error>,
    /// Creates an untrained model.
    pub start: StartModel,
    /// Restores a model from a checkpoint. The `state.options` of the checkpoint are
    /// [`ModelOptions`]. The keyframes must include all training keyframes that were not removed. A
    /// keyframe may lack pixels if the caller removes it right afterwards.
    pub resume: ResumeModel,
    /// Loads a saved model from its folder, or from a single file.
    pub load: LoadModel,
}

/// Converts a resumed model of one method to a model of any method.
pub(crate) fn boxed<M: Method + 'static>((model, untrained): ResumedModel<M>) -> ResumedModel {
    (Box::new(model), untrained)
}

/// A type of file that holds a complete model.
#[derive(Clone, Copy, Debug)]
pub struct SingleFile {
    /// Noun phrase with an article for such a file, such as `a file of splats`.
    pub description: &'static str,
    /// Supported extensions.
    pub extensions: &'static [&'static str],
    /// Extensions of formats that cannot be read. The error names the format.
    pub unsupported_extensions: &'static [&'static str],
}

/// A format of other programs to which saved models can be exported.
pub struct Export {
    /// Name of the format, which is also the extension of its files.
    pub format: &'static str,
    /// Contents of an exported file, such as `splats`.
    pub contents: &'static str,
    /// Whether [`ExportRequest::cell_m`] applies.
    pub has_cells: bool,
    /// Exports a model.
    pub write: ExportWriter,
}

/// Function that exports a saved model.
pub enum ExportWriter {
    /// A function that does not need a GPU.
    Cpu(fn(&ExportRequest<'_>) -> Result<Exported, Error>),
    /// A function that needs a GPU.
    Gpu(fn(Arc<Gpu>, &ExportRequest<'_>) -> Result<Exported, Error>),
}

/// A model to export.
#[derive(Clone, Copy, Debug)]
pub struct ExportRequest<'a> {
    /// Folder of a saved model, or a single file.
    pub model: &'a Path,
    /// File to write.
    pub out: &'a Path,
    /// If given, the mesh is simplified to one vertex per cell of this width, meters.
    pub cell_m: Option<f64>,
}

/// Summary of an export.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Number of exported items.
    pub n_items: u64,
    /// Name of an item, in the singular.
    pub item: &'static str,
    /// Additional properties to print after the items, such as `of SH degree 3`. The text may be
    /// empty.
    pub detail: String,
}
