//! Data of topics that `client/server_message.rs` converts to messages. Viewers receive only the
//! latest values.
//!
//! The data of a topic are usually defined in its file, as in `base_path.rs`. The types here cannot
//! be there: `server_message.rs` uses them, and the files of their topics use `server_message.rs`,
//! so the files would import each other in a cycle.

use kinematics::{Stamp, Transform};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum number of points of the accuracy curve on the page. Longer curves are thinned evenly.
/// The curve is a part of every status message, several times per second, while the chart is only
/// some hundred pixels wide.
const MAX_HISTORY: usize = 512;

/// Status of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Status {
    /// One or two words for the operator, such as `waiting for images` or `training`.
    pub state: String,
    /// Wall time since the first image, seconds.
    pub seconds: f64,
    /// Number of stored keyframes.
    pub keyframes: u64,
    /// Number of images rejected as keyframes, by reason.
    pub rejected: BTreeMap<String, u64>,
    /// The model rendered for clients that do not choose one.
    #[serde(flatten)]
    pub model: ModelStatus,
    /// The models trained in parallel with it; empty if there is only one.
    pub others: Vec<ModelStatus>,
    /// Changes whenever the edits of a model change, even if their number does not.
    pub edit_revision: u64,
    /// Messages that the operator should read, for example that a camera disconnected.
    pub notes: Vec<String>,
    /// The result, once the run has ended and its model is saved.
    pub result: Option<RunResult>,
    /// What the operator should do, for commands that take images without training.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub guidance: Option<Guidance>,
}

/// What the operator should do next. While there is guidance, the page shows the camera images
/// instead of a model.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Guidance {
    /// What was done so far, and what to do next.
    pub text: String,
    /// Whether nothing is left to do, so that the server may stop.
    pub is_finished: bool,
}

/// Result of a run that has ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RunResult {
    /// Folder of the saved model; `None` if nothing was saved.
    pub folder: Option<String>,
    /// Final scores in one line, such as `PSNR 26.76 dB`; empty if there are none.
    pub scores: String,
    /// Wall time of the whole run, seconds.
    pub seconds: f64,
}

/// Status of a model.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ModelStatus {
    /// Name of the method.
    pub method: String,
    /// Number of optimizer steps so far.
    pub step: u64,
    /// GPU time of a step, milliseconds, smoothed; `None` before the first step.
    pub step_millis: Option<f64>,
    /// Number of splats, voxel blocks or table entries.
    pub primitives: u64,
    /// Label of that number, such as `Voxel blocks`.
    pub primitives_label: String,
    /// GPU memory used by the model, bytes.
    pub bytes: u64,
    /// Whether the model can be sent in chunks, so that clients can draw it themselves.
    pub has_chunks: bool,
    /// Number of edits that can be undone.
    pub edits: usize,
    /// Mean PSNR over the test keyframes, dB; `None` before the first evaluation.
    pub psnr: Option<f64>,
    /// `(seconds, psnr)` of every evaluation so far, in order.
    pub psnr_history: Vec<(f64, f64)>,
}

impl Status {
    /// Returns the same status with curves that are short enough to send several times per second.
    /// The first and last points are kept.
    pub(crate) fn thinned(mut self) -> Self {
        for model in std::iter::once(&mut self.model).chain(&mut self.others) {
            let n = model.psnr_history.len();
            if n > MAX_HISTORY {
                let last = n - 1;
                // From index 0 to index `last`, both included. The page shows the newest score.
                let kept = |ix: usize| model.psnr_history[ix * last / (MAX_HISTORY - 1)];
                model.psnr_history = (0..MAX_HISTORY).map(kept).collect();
            }
        }
        self
    }
}

/// Scene extent and initial view.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneHint {
    /// Center of the orbit, in world, meters.
    pub center_m: [f64; 3],
    /// Radius around the center that contains the relevant scene, meters.
    pub radius_m: f64,
    /// Initial view.
    pub world_from_camera: Transform,
}

/// A box along the axes of the world that contains the relevant parts of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SceneBounds {
    /// Corner with the smallest coordinates, meters.
    pub min_m: [f64; 3],
    /// Corner with the largest coordinates, meters.
    pub max_m: [f64; 3],
}

/// What is known about a scene.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PublishedScene {
    pub(crate) hint: SceneHint,
    /// `None` if only the hint is known: clients then begin with its view.
    pub(crate) bounds: Option<SceneBounds>,
}

/// Pose and lens of an accepted keyframe, drawn as a frustum.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyframePose {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// Stamp of the keyframe; with the camera, it identifies the keyframe.
    pub stamp: Stamp,
    /// Pose at the keyframe's stamp.
    pub world_from_camera: Transform,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

#[cfg(test)]
mod tests {
    use super::{MAX_HISTORY, ModelStatus, Status};

    #[test]
    fn long_curves_are_thinned_keeping_ends() {
        let with = |psnr_history: Vec<(f64, f64)>| ModelStatus {
            psnr_history,
            ..ModelStatus::default()
        };
        let long = with(
            (0..5000)
                .map(|ix| (f64::from(ix), f64::from(ix) * 0.5))
                .collect(),
        );
        let short = with(vec![(1.0, 2.0)]);
        let status = Status {
            model: long.clone(),
            others: vec![short.clone(), long],
            ..Status::default()
        }
        .thinned();
        assert_eq!(status.others[0], short);
        for model in [&status.model, &status.others[1]] {
            assert_eq!(model.psnr_history.len(), MAX_HISTORY);
            assert_eq!(model.psnr_history.first(), Some(&(0.0, 0.0)));
            assert_eq!(model.psnr_history.last(), Some(&(4999.0, 2499.5)));
            assert!(
                model
                    .psnr_history
                    .windows(2)
                    .all(|pair| pair[0].0 < pair[1].0)
            );
        }
    }
}
