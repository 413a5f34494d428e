//! The scores of saved models in the status of their run.

use crate::session::FinishedModel;
use viz::{ModelStatus, Status};

/// Replaces the scores during training with those of the saved models, so that a page shows the
/// same number as the result of the run and the report. Scores during training are means over fewer
/// images.
pub(crate) fn show_final_scores(status: &mut Status, models: &[FinishedModel]) {
    for model in models {
        show_score(status, model.kind.name(), model.seconds, model.scores.psnr);
    }
}

/// Replaces the PSNR of one model. Keeps it if the saved model has no PSNR.
fn show_score(status: &mut Status, method: &str, seconds: f64, psnr: Option<f64>) {
    let mut models = std::iter::once(&mut status.model).chain(&mut status.others);
    let shown: Option<&mut ModelStatus> = models.find(|model| model.method == method);
    if let (Some(shown), Some(psnr)) = (shown, psnr) {
        shown.psnr = Some(psnr);
        shown.psnr_history.push((seconds, psnr));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_shows_the_score_of_the_saved_model() {
        let model = |method: &str| ModelStatus {
            method: method.to_owned(),
            psnr: Some(25.6),
            psnr_history: vec![(50.0, 25.6)],
            ..ModelStatus::default()
        };
        let mut status = Status {
            model: model("splat"),
            others: vec![model("tsdf")],
            ..Status::default()
        };
        show_score(&mut status, "tsdf", 60.0, Some(26.6));
        show_score(&mut status, "splat", 60.0, None);
        assert_eq!(status.model, model("splat"));
        assert_eq!(status.others[0].psnr, Some(26.6));
        assert_eq!(status.others[0].psnr_history, [(50.0, 25.6), (60.0, 26.6)]);
    }
}
