//! A method for tests. Its model is one color, which moves toward the mean color of the keyframes.
//!
//! It is registered like any other method but needs no kernels, so it also serves as a minimal
//! example of a method.

use crate::keyframe_signature::{self, KeyframeSignature};
use crate::method_entry::{MethodEntry, boxed};
use crate::model_metadata::METADATA_FILE;
use crate::model_options::{MethodOptions, ModelOptions, default_options};
use crate::pending::PendingCheckpoint;
use crate::{CorrectedKeyframe, Error, Method, Picture, Progress, RenderRequest};
use calibration::{Alignment, ParamSet};
use gpu::PassTiming;
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use model_files::checkpoint::Checkpoint;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// Registry entry of the method.
pub(crate) static ENTRY: MethodEntry = MethodEntry {
    name: MeanColorOptions::METHOD,
    description: "one color",
    model: "a color",
    primitive: "color",
    primitives_label: "Colors",
    files: &[COLOR_FILE],
    single_file: None,
    needs_depth: false,
    can_revise: true,
    has_chunks: false,
    learnable: ParamSet::empty(),
    exports: &[],
    default_options: default_options::<MeanColorOptions>,
    check_options: |options| options.typed::<MeanColorOptions>().map(drop),
    start: |_, options| Ok(Box::new(MeanColor::new(options.typed()?))),
    resume: |_, checkpoint, keyframes| MeanColor::resume(checkpoint, keyframes).map(boxed),
    load: |_, folder| Ok(Box::new(MeanColor::load(folder)?)),
};

/// File of the saved color, in the format of a checkpoint.
const COLOR_FILE: &str = "mean.color";

/// Options of a [`MeanColor`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MeanColorOptions {
    /// Fraction of the difference from a keyframe's color that one step removes.
    pub(crate) rate: f64,
}

impl Default for MeanColorOptions {
    fn default() -> Self {
        Self { rate: 0.5 }
    }
}

impl MethodOptions for MeanColorOptions {
    const METHOD: &'static str = "mean-color";
}

/// One color, trained on the mean colors of the keyframes in turn.
#[derive(Debug)]
pub(crate) struct MeanColor {
    options: ModelOptions<MeanColorOptions>,
    keyframes: Vec<Arc<Keyframe>>,
    color_srgb: [f64; 3],
    step: u64,
}

/// The state in a checkpoint.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    options: ModelOptions<MeanColorOptions>,
    keyframes: Vec<KeyframeSignature>,
    color_srgb: [f64; 3],
    step: u64,
}

impl MeanColor {
    pub(crate) fn new(options: ModelOptions<MeanColorOptions>) -> Self {
        Self {
            options,
            keyframes: Vec::new(),
            color_srgb: [0.0; 3],
            step: 0,
        }
    }

    /// Resumes from a checkpoint. Also returns the keyframes that the model was not trained on.
    pub(crate) fn resume(
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        let (mut model, signatures) = Self::of_state(checkpoint)?;
        let (matched, others) = keyframe_signature::match_keyframes(&signatures, keyframes)?;
        model.keyframes = matched;
        Ok((model, others))
    }

    pub(crate) fn load(folder: &Path) -> Result<Self, Error> {
        Ok(Self::of_state(&Checkpoint::read(&folder.join(COLOR_FILE))?)?.0)
    }

    fn of_state(checkpoint: &Checkpoint) -> Result<(Self, Vec<KeyframeSignature>), Error> {
        let State {
            options,
            keyframes,
            color_srgb,
            step,
        } = State::deserialize(&checkpoint.state).map_err(|error| Error::CheckpointState {
            reason: error.to_string(),
        })?;
        Ok((
            Self {
                color_srgb,
                step,
                ..Self::new(options)
            },
            keyframes,
        ))
    }

    fn state(&self) -> Result<Checkpoint, Error> {
        let state = State {
            options: self.options.clone(),
            keyframes: self
                .keyframes
                .iter()
                .map(|keyframe| KeyframeSignature::of(keyframe))
                .collect(),
            color_srgb: self.color_srgb,
            step: self.step,
        };
        let state = serde_json::to_value(state).map_err(|error| Error::CheckpointState {
            reason: error.to_string(),
        })?;
        Ok(Checkpoint::new(MeanColorOptions::METHOD, state, Vec::new()))
    }
}

/// Mean color of an image, 0 to 255.
fn mean_srgb(keyframe: &Keyframe) -> [f64; 3] {
    let pixels = keyframe.rgba_srgb.as_chunks::<4>().0;
    [0, 1, 2].map(|channel| channel_sum(pixels, channel) / pixels.len().max(1) as f64)
}

fn channel_sum(pixels: &[[u8; 4]], channel: usize) -> f64 {
    pixels.iter().map(|pixel| f64::from(pixel[channel])).sum()
}

impl Method for MeanColor {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        if keyframe.split != Split::Test {
            self.keyframes.push(keyframe);
        }
        Ok(())
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.keyframes
            .retain(|keyframe| keyframe.camera.as_ref() != camera || keyframe.stamp != stamp);
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        if self.keyframes.is_empty() {
            return Ok(0);
        }
        for _ in 0..n {
            let ix = usize::try_from(self.step % self.keyframes.len() as u64).expect("an index");
            for (color, mean) in self
                .color_srgb
                .iter_mut()
                .zip(mean_srgb(&self.keyframes[ix]))
            {
                *color += self.options.specific.rate * (mean - *color);
            }
            self.step += 1;
        }
        Ok(n)
    }

    fn is_idle(&self) -> bool {
        self.keyframes.is_empty()
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        Ok(self.step)
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        let n_pixels = request.size_px.iter().map(|side| *side as usize).product();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "colors are 0 to 255"
        )]
        let [red, green, blue] = self.color_srgb.map(|channel| channel.round() as u8);
        Ok(Picture {
            size_px: request.size_px,
            rgba_srgb: [red, green, blue, 255].repeat(n_pixels),
            depth_m: if request.depth {
                vec![0.0; n_pixels]
            } else {
                Vec::new()
            },
        })
    }

    fn recalibrate(&mut self, keyframes: &[CorrectedKeyframe], _: &Alignment) -> Result<(), Error> {
        // The mean does not depend on poses. It restarts anyway, as an example for models that
        // depend on them.
        *self = Self::new(self.options.clone());
        keyframes
            .iter()
            .try_for_each(|keyframe| self.push(keyframe.after.clone()))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.step(1)?;
        Ok(Vec::new())
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.step,
            primitives: 1,
            ..Progress::default()
        }
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        std::fs::create_dir_all(folder).map_err(|source| Error::Write {
            path: folder.to_owned(),
            source,
        })?;
        self.state()?.write(&folder.join(COLOR_FILE))?;
        let description =
            serde_json::json!({ "method": MeanColorOptions::METHOD, "steps": self.step });
        let path = folder.join(METADATA_FILE);
        files::write(&path, description.to_string()).map_err(|source| Error::Write { path, source })
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        let checkpoint = self.state()?;
        Ok(PendingCheckpoint::new(move || Ok(checkpoint)))
    }
}

#[cfg(test)]
mod tests;
