//! Data of topics that `client/server_message.rs` converts to messages. Viewers receive only the
//! latest values.
//!
//! The data of a topic are usually defined in its file, as in `base_path.rs`. The types here cannot
//! be there: `server_message.rs` uses them, and the files of their topics use `server_message.rs`,
//! so the files would import each other in a cycle.

use crate::topics::edit_status::{ErasedBox, LastEdit, SavedEdits};
use crate::topics::operator_status::OperatorStatus;
use crate::topics::photograph_coverage::PhotographCoverage;
use crate::topics::preview_status::PreviewStatus;
use kinematics::{Stamp, Transform};
use model_files::Edits;
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
    /// Progress of the work that `state` names; `None` if it is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub progress: Option<StateProgress>,
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
    /// The last edit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_edit: Option<LastEdit>,
    /// The result of the last request to save the edits of saved models.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saved_edits: Option<SavedEdits>,
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
    /// The devices, for a preview, which trains nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preview: Option<PreviewStatus>,
    /// What the operator's header shows.
    #[serde(flatten)]
    pub operator: OperatorStatus,
}

/// Progress of the work that the state of a [`Status`] names.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StateProgress {
    /// A few words for the operator, such as `3 of 5 keyframes`.
    pub text: String,
    /// Completed part of the work, 0 to 1; `None` if it is not known.
    pub done_frac: Option<f64>,
    /// Whether the model has not been started yet, so that pictures may be empty or missing.
    pub is_startup: bool,
}

impl StateProgress {
    /// Progress of work that consists of `n_all` equal parts.
    pub fn of_parts(text: String, n_done: usize, n_all: usize) -> Self {
        Self {
            text,
            done_frac: (n_all > 0).then(|| n_done.min(n_all) as f64 / n_all as f64),
            is_startup: false,
        }
    }

    /// The same progress, before the model is started.
    #[must_use]
    pub fn at_startup(self) -> Self {
        Self {
            is_startup: true,
            ..self
        }
    }
}

/// What the operator should do next. While there is guidance, the page shows the camera images
/// instead of a model.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Guidance {
    /// What was done so far, and what to do next.
    pub text: String,
    /// Whether nothing is left to do, so that the server may stop.
    pub is_finished: bool,
    /// What the photographs of a target cover so far, for the calibration of a lens.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coverage: Option<PhotographCoverage>,
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
    /// Size of the model's files, bytes. If there are several models, this is the sum.
    pub bytes: u64,
    /// When the model was saved, seconds since 1970 in UTC; `None` if it is not known.
    pub modified_unix_secs: Option<u64>,
    /// Dataset or recording that the model was trained on. `None` if the run was live, or if the
    /// data are not known.
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
    /// GPU memory used by the model, bytes; for a saved model, at the end of its training.
    pub bytes: u64,
    /// Whether the model can be sent in chunks, so that clients can draw it themselves.
    pub has_chunks: bool,
    /// Number of edits that can be undone.
    pub edits: usize,
    /// Number of undone edits that can be redone.
    pub undone_edits: usize,
    /// The erased boxes, for clients that draw the model themselves. They need the boxes because a
    /// box can cut splats.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub erased_boxes: Vec<ErasedBox>,
    /// Mean PSNR over the test keyframes, dB; `None` before the first evaluation.
    pub psnr: Option<f64>,
    /// `(seconds, psnr)` of every evaluation so far, in order.
    pub psnr_history: Vec<(f64, f64)>,
}

impl ModelStatus {
    /// Sets the fields on edits.
    ///
    /// * `page_from_model`: pose of the frame in which the coordinates of the edits are.
    #[must_use]
    pub fn with_edits(self, edits: &Edits, page_from_model: &Transform) -> Self {
        Self {
            edits: edits.len(),
            undone_edits: edits.n_undone(),
            erased_boxes: ErasedBox::list(edits, page_from_model),
            ..self
        }
    }
}

impl Status {
    /// Returns the same status with curves that are short enough to send several times per second.
    /// The first and last points are kept.
    pub(crate) fn thinned(mut self) -> Self {
        for model in std::iter::once(&mut self.model).chain(&mut self.others) {
            let n = model.psnr_history.len();
            if n > MAX_HISTORY {
                let last = n - 1;
                // The indices are spread from 0 to `last`, both included, because the page shows
                // the newest score.
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
    use kinematics::Transform;
    use model_files::edits::{CellGrid, CellSet, Edit};
    use model_files::{Aabb, Edits};
    use nalgebra::Vector3;
    use serde_json::json;

    #[test]
    fn erased_boxes_are_in_the_frame_of_the_page() {
        let page_from_model = Transform::new(Vector3::new(1.0, 2.0, 3.0), Vector3::zeros());
        let status_of = |edits: &Edits| {
            let status = ModelStatus::default().with_edits(edits, &page_from_model);
            serde_json::to_value(status).expect("numbers and text")
        };
        let mut edits = Edits::default();
        let nothing = status_of(&edits);
        assert_eq!(
            (&nothing["edits"], nothing.get("erased_boxes")),
            (&json!(0), None)
        );
        let grid = CellGrid {
            center_m: [0.0; 3],
            radius_m: 1.0,
            n_cells: 4,
        };
        let cells = CellSet::new(grid, [1]);
        edits.push(Edit::Cells(cells)).expect("valid cells");
        for x in [10.0, 20.0] {
            let aabb = Aabb {
                world_from_box: Transform::new(Vector3::new(x, 0.0, 0.0), Vector3::zeros()),
                min_m: [-1.0; 3],
                max_m: [1.0; 3],
            };
            edits.push(Edit::Box(aabb)).expect("a valid box");
        }
        edits.undo().expect("there are three");
        let status = status_of(&edits);
        assert_eq!(
            (&status["edits"], &status["undone_edits"]),
            (&json!(2), &json!(1))
        );
        let world_from_box = [
            1.0, 0.0, 0.0, 11.0, 0.0, 1.0, 0.0, 2.0, 0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 1.0,
        ];
        assert_eq!(
            status["erased_boxes"],
            json!([{
                "world_from_box": world_from_box,
                "min_m": [-1.0, -1.0, -1.0],
                "max_m": [1.0, 1.0, 1.0],
            }])
        );
    }

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
