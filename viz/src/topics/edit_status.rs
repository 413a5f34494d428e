//! Edits of models in the status, and the last change of them.

use kinematics::Transform;
use kinematics::transform::to_rows;
use model_files::edits::Edit;
use model_files::{Aabb, Edits};
use serde::Serialize;

/// An erased box in the world of the page, in the form of requests.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ErasedBox {
    /// Pose of the box's frame, row-major.
    world_from_box: [f64; 16],
    /// Corner with the smallest coordinates in that frame, meters.
    min_m: [f64; 3],
    /// Corner with the largest coordinates in that frame, meters.
    max_m: [f64; 3],
}

/// The last edit of any model.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LastEdit {
    /// Number of the client that requested it, as in its `hello`.
    pub client: u64,
    /// What was done, such as `erased a box`.
    pub text: String,
}

/// The result of the last request to save edits.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SavedEdits {
    /// Counts the requests.
    pub revision: u64,
    /// Where the edits are, or why they could not be saved.
    pub text: String,
    /// Whether the edits could not be saved.
    pub has_failed: bool,
}

impl ErasedBox {
    /// The erased boxes of a model, whose coordinates are in the frame `model`.
    pub(crate) fn list(edits: &Edits, page_from_model: &Transform) -> Vec<Self> {
        let boxes = edits.as_slice().iter().filter_map(|edit| match edit {
            Edit::Box(aabb) => Some(Self::of(aabb, page_from_model)),
            Edit::Cells(_) => None,
        });
        boxes.collect()
    }

    fn of(aabb: &Aabb, page_from_model: &Transform) -> Self {
        Self {
            world_from_box: to_rows(&(page_from_model * aabb.world_from_box)),
            min_m: aabb.min_m,
            max_m: aabb.max_m,
        }
    }
}
