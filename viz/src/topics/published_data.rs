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
    /// The saved model or file that is viewed; `None` in a run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<ModelSource>,
    /// Files that clients can download; set by [`publish_files`](crate::publish_files).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<FileLink>,
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
    /// How good the result is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verdict: Option<Verdict>,
    /// Errors that ended the run, and descriptions of lost data, one sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub problems: Vec<String>,
}

/// How good a result is.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// The grade, for colors.
    pub grade: Grade,
    /// One sentence without a period, such as `Good: 31.2 dB on 12 test images`.
    pub text: String,
}

/// Grade of a result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// Pictures of the model can hardly be distinguished from photos.
    Good,
    /// Shapes are right, details are not.
    Fair,
    /// The model differs visibly from the scene.
    Poor,
    /// The model was not scored.
    #[default]
    Unknown,
}

/// What `view` shows: a saved model of a run, or a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ModelSource {
    /// Whether it is a model folder or a file.
    pub kind: SourceKind,
    /// Name of the file or folder, without its parents.
    pub name: String,
    /// The path, as given.
    pub path: String,
    /// Format of a file, such as `PLY`; `None` for a folder.
    pub format: Option<String>,
    /// Size of the model's files, bytes; of several models, the sum.
    pub bytes: u64,
    /// When the model was saved, seconds since 1970 in UTC; `None` if it is not known.
    pub modified_unix_secs: Option<u64>,
    /// Dataset or recording that the model was trained on; `None` for live runs and if it is not
    /// known.
    pub data: Option<String>,
    /// GPU on which it was trained; `None` if it is not known.
    pub adapter: Option<String>,
    /// How good the model is; `None` without a report.
    pub verdict: Option<Verdict>,
    /// Axis of the model that points up on the page: `x`, `y`, `z`, `-x`, `-y` or `-z`.
    pub up_axis: &'static str,
}

/// Kind of a [`ModelSource`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceKind {
    /// Folder of a saved model, or of several.
    Saved,
    /// A single file, which may come from another program.
    File,
}

/// A file that the server offers to its clients.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FileLink {
    /// Path of the URL, without a slash at its beginning.
    pub path: String,
    /// What the file contains, for display.
    pub label: String,
    /// Whether browsers show the file instead of saving it.
    pub is_page: bool,
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
