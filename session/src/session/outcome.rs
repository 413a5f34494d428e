//! The result of training.

use crate::evaluate::{ImageScores, Scores};
use crate::observer::Evaluation;

/// Result of training.
pub struct TrainingOutcome {
    /// Training time, seconds.
    pub seconds: f64,
    /// Number of optimizer steps.
    pub steps: u64,
    /// Mean scores of the test images.
    pub scores: Scores,
    /// Number of primitives of the model, such as splats.
    pub primitives: u64,
    /// Size of the model, bytes.
    pub bytes: u64,
    /// The scheduled evaluations.
    pub evaluations: Vec<Evaluation>,
    pub(super) per_image: Vec<ImageScores>,
}
