//! Options of a model: common options of all methods, and options specific to its method.

use crate::Error;
use calibration::CameraRefinement;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Options of one method.
pub trait MethodOptions: Serialize + DeserializeOwned + Default {
    /// Name of the method in files and on the command line.
    const METHOD: &'static str;
}

/// When the cameras of keyframes are aligned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlignTiming {
    /// Cameras are aligned once, with the keyframes that are known at the first step. If a keyframe
    /// has depth, the result is applied a fixed number of steps later. Otherwise, it is applied
    /// before the first step.
    #[default]
    Once,
    /// Cameras are aligned repeatedly as keyframes arrive. Results are applied a fixed number of
    /// steps later.
    Lockstep,
    /// Cameras are aligned repeatedly as keyframes arrive. Results are applied by
    /// [`poll_alignment`](crate::AlignedModel::poll_alignment), so that training never waits for
    /// them.
    RealTime,
}

/// Options that all methods share. A method ignores the options that do not apply to it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommonOptions {
    /// Seeds every random choice.
    pub seed: u64,
    /// Maximum GPU memory of the model, bytes.
    pub max_bytes: Option<u64>,
    /// Steps over which learning rates decay and the model grows.
    pub n_planned_steps: u64,
    /// Camera parameters that are optimized with the scene.
    pub cameras: CameraRefinement,
    /// Camera parameters that alignment estimates. It registers keyframes that have depth. Without
    /// depth, it matches features of the keyframes.
    pub align: CameraRefinement,
    /// When alignment estimates these parameters.
    pub align_timing: AlignTiming,
    /// Whether movements of cameras relative to their mounts are detected. Detection needs cameras
    /// that are aligned repeatedly, and poses that do not drift.
    #[serde(default)]
    pub detects_movements: bool,
}

/// Options of a model. `S` is the type of the method-specific options. Its default is JSON, which
/// holds the options of any method.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelOptions<S = Value> {
    /// Options that all methods share.
    pub common: CommonOptions,
    /// Options of the method.
    pub specific: S,
}

impl Default for CommonOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            max_bytes: None,
            n_planned_steps: 7000,
            cameras: CameraRefinement::default(),
            align: CameraRefinement::default(),
            align_timing: AlignTiming::Once,
            detects_movements: false,
        }
    }
}

impl<S> ModelOptions<S> {
    /// Applies a change and returns the changed options.
    #[must_use]
    pub fn with(mut self, change: impl FnOnce(&mut Self)) -> Self {
        change(&mut self);
        self
    }
}

impl<S> From<S> for ModelOptions<S> {
    /// Combines method-specific options with the default common options.
    fn from(specific: S) -> Self {
        Self {
            common: CommonOptions::default(),
            specific,
        }
    }
}

impl ModelOptions {
    /// Converts the method-specific options from JSON to their own type.
    ///
    /// # Errors
    ///
    /// Fails if an option of the method is missing, unknown or has an invalid value.
    pub fn typed<S: MethodOptions>(&self) -> Result<ModelOptions<S>, Error> {
        let specific = S::deserialize(&self.specific).map_err(|error| Error::InvalidOptions {
            method: S::METHOD,
            reason: error.to_string(),
        })?;
        Ok(ModelOptions {
            common: self.common.clone(),
            specific,
        })
    }
}

impl<S: MethodOptions> ModelOptions<S> {
    /// Converts the method-specific options to JSON.
    pub fn to_json(&self) -> ModelOptions {
        ModelOptions {
            common: self.common.clone(),
            specific: serde_json::to_value(&self.specific).expect("options are plain data"),
        }
    }
}

/// Default options of a model of the method with the options `S`, as JSON.
pub(crate) fn default_options<S: MethodOptions>() -> ModelOptions {
    ModelOptions::<S>::default().to_json()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mean_color::MeanColorOptions;

    #[test]
    fn options_survive_json_bit_by_bit() {
        let options = ModelOptions::<MeanColorOptions>::default().with(|options| {
            options.common.seed = u64::MAX;
            options.specific.rate = 0.1 + 0.2;
        });
        let text = serde_json::to_string(&options.to_json()).unwrap();
        let read: ModelOptions = serde_json::from_str(&text).unwrap();
        assert_eq!(read.typed::<MeanColorOptions>().unwrap(), options);
    }

    #[test]
    fn invalid_options_are_rejected_with_the_method() {
        let mut options = ModelOptions::<MeanColorOptions>::default().to_json();
        options.specific["rate"] = "fast".into();
        let message = options.typed::<MeanColorOptions>().unwrap_err().to_string();
        assert!(
            message.contains("mean-color") && message.contains("fast"),
            "{message}"
        );
        options.specific = serde_json::json!({ "rate": 0.5, "seed": 1 });
        assert!(
            options.typed::<MeanColorOptions>().is_err(),
            "common options must be rejected"
        );
        options.specific = serde_json::json!({});
        assert!(
            options.typed::<MeanColorOptions>().is_err(),
            "missing options must be rejected"
        );
    }
}
