//! The verdict on models that have just been saved and scored, and the likely cause of a poor one.

use crate::session::FinishedModel;
use crate::verdict::{self, Findings, ImageLoss, ModelScore};
use crate::{likely_cause, run_folder};
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

/// The likely cause of the poor result of a run, and its remedy, from the report of its best model.
/// `None` if the result is not poor.
pub(crate) fn likely_cause_of(models: &[FinishedModel]) -> Option<String> {
    let psnr_db = |model: &&FinishedModel| model.scores.psnr.unwrap_or(f64::NEG_INFINITY);
    let best = models
        .iter()
        .max_by(|a, b| psnr_db(a).total_cmp(&psnr_db(b)))?;
    likely_cause::of_report(&run_folder::report(&best.folder))
}
