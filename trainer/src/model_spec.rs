//! Creates, resumes and loads models of any method.

use crate::model_options::{CommonOptions, MethodOptions, ModelOptions};
use crate::registry::ModelKind;
use crate::{AlignedModel, Error};
use gpu::Gpu;
use keyframe::Keyframe;
use kinematics::Stamp;
use model_files::Edits;
use model_files::checkpoint::Checkpoint;
use serde::Deserialize;
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;

/// Method and options of a model to create.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelSpec {
    /// The method.
    pub kind: ModelKind,
    /// Options of the model.
    pub options: ModelOptions,
}

/// A model restored from a checkpoint.
pub struct Resumed {
    /// Method and options of the original training.
    pub model_spec: ModelSpec,
    /// The model.
    pub method: AlignedModel,
    /// Keyframes that the model was not trained on. These are test keyframes and new keyframes.
    pub untrained: Vec<Arc<Keyframe>>,
    /// Erased space.
    pub edits: Edits,
}

/// Camera and stamp of a keyframe.
pub type KeyframeId = (Arc<str>, Stamp);

/// A saved model in GPU memory.
pub struct LoadedModel {
    /// The method.
    pub kind: ModelKind,
    /// The model.
    pub method: AlignedModel,
    /// Erased space.
    pub edits: Edits,
}

impl ModelSpec {
    /// The default options of the method, overridden by `settings`, which contains names and values
    /// of options. Settings that the method does not have are ignored, so that several methods can
    /// share one list of settings.
    ///
    /// # Errors
    ///
    /// Fails if a value is invalid.
    pub fn new(
        kind: ModelKind,
        common: CommonOptions,
        settings: &[(&str, Value)],
    ) -> Result<Self, Error> {
        let mut options = (kind.entry().default_options)();
        options.common = common;
        for (name, value) in settings {
            // `get_mut` does not insert, so an option that this method lacks stays absent.
            if let Some(option) = options.specific.get_mut(name) {
                *option = value.clone();
            }
        }
        let model_spec = Self { kind, options };
        model_spec.check()?;
        Ok(model_spec)
    }

    /// The spec of a model with these options. Their type determines the method.
    ///
    /// # Errors
    ///
    /// Fails if the method is not registered.
    pub fn of<S: MethodOptions>(options: &ModelOptions<S>) -> Result<Self, Error> {
        Ok(Self {
            kind: registered(S::METHOD)?,
            options: options.to_json(),
        })
    }

    /// The options as the method-specific type `S`. `None` if the model uses another method.
    ///
    /// # Errors
    ///
    /// Fails if the options are invalid.
    pub fn options_of<S: MethodOptions>(&self) -> Result<Option<ModelOptions<S>>, Error> {
        (self.kind.name() == S::METHOD)
            .then(|| self.options.typed())
            .transpose()
    }

    /// Fails if the options do not belong to the method or are invalid.
    pub fn check(&self) -> Result<(), Error> {
        (self.kind.entry().check_options)(&self.options)
    }

    /// Creates an untrained model.
    ///
    /// # Errors
    ///
    /// Fails if the options are invalid, or on an error of the GPU.
    pub fn start(&self, gpu: Arc<Gpu>) -> Result<AlignedModel, Error> {
        let is_software = gpu.is_software();
        let model = (self.kind.entry().start)(gpu, &self.options)?;
        Ok(AlignedModel::new(model, &self.options.common, is_software))
    }
}

/// Restores a model from a checkpoint. `keyframes` must include the keyframes that the model was
/// trained on.
///
/// # Errors
///
/// Fails if the checkpoint is invalid, if keyframes are missing or differ, or on an error of the
/// GPU.
pub fn resume(
    gpu: Arc<Gpu>,
    checkpoint: &Checkpoint,
    keyframes: &[Arc<Keyframe>],
) -> Result<Resumed, Error> {
    resume_with(gpu, checkpoint, keyframes, &[])
}

/// Like [`resume`], but keyframes may be missing. Missing keyframes are removed from the training
/// set, but their effect on the parameters remains. Also returns the cameras and stamps of the
/// missing keyframes.
///
/// # Errors
///
/// Fails if the checkpoint is invalid, if keyframes differ, or on an error of the GPU.
pub fn resume_without_missing(
    gpu: Arc<Gpu>,
    checkpoint: &Checkpoint,
    keyframes: &[Arc<Keyframe>],
) -> Result<(Resumed, Vec<KeyframeId>), Error> {
    // A first attempt shows which keyframes the model needs. The second attempt uses placeholders
    // for the missing keyframes, because a model may store parameters in the order of the
    // keyframes.
    let placeholders = match resume_with(gpu.clone(), checkpoint, keyframes, &[]) {
        Ok(resumed) => return Ok((resumed, Vec::new())),
        Err(Error::MissingKeyframes { placeholders }) => placeholders,
        Err(error) => return Err(error),
    };
    let mut resumed = resume_with(gpu, checkpoint, keyframes, &placeholders)?;
    // Placeholders have no pixels, so they must be gone before the first step.
    for missing in &placeholders {
        resumed.method.remove(&missing.camera, missing.stamp)?;
    }
    Ok((
        resumed,
        placeholders
            .iter()
            .map(|missing| (Arc::clone(&missing.camera), missing.stamp))
            .collect(),
    ))
}

fn resume_with(
    gpu: Arc<Gpu>,
    checkpoint: &Checkpoint,
    keyframes: &[Arc<Keyframe>],
    placeholders: &[Arc<Keyframe>],
) -> Result<Resumed, Error> {
    let kind = registered(&checkpoint.method)?;
    let options = checkpoint.state.get("options").unwrap_or(&Value::Null);
    let options = ModelOptions::deserialize(options).map_err(|error| Error::CheckpointState {
        reason: format!("options: {error}"),
    })?;
    let (method, untrained) =
        AlignedModel::resume(checkpoint, keyframes, placeholders, |own, keyframes| {
            (kind.entry().resume)(gpu, own, keyframes)
        })?;
    Ok(Resumed {
        model_spec: ModelSpec { kind, options },
        method,
        untrained,
        edits: checkpoint.edits.clone(),
    })
}

/// Loads a saved model from its folder, or from a single file.
///
/// # Errors
///
/// Fails if the method of the model is unknown, if a file is invalid, or on an error of the GPU.
pub fn load(gpu: Arc<Gpu>, model: &Path) -> Result<LoadedModel, Error> {
    let kind = ModelKind::of_saved(model)?.ok_or_else(|| Error::UnknownModel {
        path: model.to_owned(),
    })?;
    let edits = Edits::read(model)?;
    let method = (kind.entry().load)(gpu, model)?;
    Ok(LoadedModel {
        kind,
        edits,
        // Only the folder of a saved model has an alignment.
        method: if model.is_dir() {
            AlignedModel::load(method, model)?
        } else {
            AlignedModel::unaligned(method)
        },
    })
}

fn registered(name: &str) -> Result<ModelKind, Error> {
    ModelKind::from_name(name).ok_or_else(|| Error::UnknownMethod {
        name: name.to_owned(),
    })
}
