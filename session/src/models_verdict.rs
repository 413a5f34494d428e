//! The verdict on models that have just been saved and scored.

use crate::session::FinishedModel;
use crate::verdict::{self, Findings, ImageLoss, ModelScore};
use viz::Verdict;

/// Judges the models of one run. `loss` is zero if the images come from a dataset, which loses none.
pub(crate) fn verdict_of(models: &[FinishedModel], loss: ImageLoss) -> Verdict {
    let score = |model: &'_ FinishedModel| ModelScore {
        method: model.kind.name(),
        psnr_db: model.scores.psnr,
    };
    let n_tests = models.iter().map(FinishedModel::n_tests).max();
    verdict::verdict(&Findings {
        models: models.iter().map(score).collect(),
        n_tests: n_tests.unwrap_or_default(),
        n_received: loss.n_received,
        n_lost: loss.n_lost,
    })
}
