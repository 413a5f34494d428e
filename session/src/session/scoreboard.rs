//! The test keyframes of a session, their evaluation schedule, and their scores so far.

use crate::evaluate::{Evaluator, ImageScores};
use crate::evaluation_schedule::EvaluationSchedule;
use crate::pending_evaluation::PendingEvaluation;
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;
use trainer::AlignedModel;

/// Maximum time of one scheduled evaluation, during which nothing is trained. In a long run, the
/// allowed fraction of the training time would permit evaluations of many minutes.
const MAX_EVALUATION: Duration = Duration::from_secs(60);
/// Maximum number of points of the PSNR curve. When it is reached, every other point is removed.
/// The curve is sent to viewers with each status, so its length must not grow with the run.
const MAX_HISTORY: usize = 512;

/// How a session is evaluated.
#[derive(Clone)]
pub struct Evaluators {
    /// Evaluator for scheduled evaluations. In `train`, it computes all scores; in a live run, only
    /// PSNR.
    pub during_training: Evaluator,
    /// Maximum number of test keyframes in a scheduled evaluation, evenly spread. The final
    /// evaluation scores all.
    pub max_images_during_training: usize,
    /// Maximum time of all scheduled evaluations, as a fraction of the training time. To stay near
    /// this limit, evaluations score fewer images, or are skipped. `None` means no limit.
    pub max_frac_during_training: Option<f64>,
    /// Evaluator for the end of training.
    pub at_end: Evaluator,
}

/// Test keyframes and their scores.
pub struct Scoreboard {
    evaluators: Evaluators,
    /// Test keyframes, those with the oldest score first.
    tests: VecDeque<Arc<Keyframe>>,
    schedule: EvaluationSchedule,
    /// An evaluation that is due or in progress.
    pending: Option<PendingEvaluation>,
    /// Time that the completed evaluations took.
    spent: Duration,
    /// Whether the caller scores an evaluation image by image.
    is_stepwise: bool,
    /// Latest PSNR of each test keyframe, by camera and stamp.
    newest_psnr: BTreeMap<(String, i64), f64>,
    history: Vec<(f64, f64)>,
}

impl Scoreboard {
    /// A scoreboard without test keyframes. If `is_stepwise`, the caller scores each evaluation,
    /// image by image.
    pub(super) fn new(evaluators: Evaluators, is_stepwise: bool) -> Self {
        Self {
            evaluators,
            tests: VecDeque::new(),
            schedule: EvaluationSchedule::default(),
            pending: None,
            spent: Duration::ZERO,
            is_stepwise,
            newest_psnr: BTreeMap::new(),
            history: Vec::new(),
        }
    }

    /// Begins the curve with the scores of earlier runs.
    pub(super) fn with_history(self, history: Vec<(f64, f64)>) -> Self {
        Self { history, ..self }
    }

    /// Whether the caller scores an evaluation image by image.
    pub(super) fn is_stepwise(&self) -> bool {
        self.is_stepwise
    }

    /// Skips the evaluations up to the training time of earlier runs.
    pub(super) fn skip_until(&mut self, previous_secs: f64) {
        self.schedule.reached(previous_secs);
    }

    /// Keeps a test keyframe for evaluation; ignores other keyframes.
    pub(super) fn hold(&mut self, keyframe: &Arc<Keyframe>) {
        if keyframe.split != Split::Test {
            return;
        }
        // Masked pixels have no alpha and are not compared. Without any other pixel, there is no
        // score.
        if keyframe.rgba_srgb.chunks_exact(4).any(|pixel| pixel[3] > 0) {
            self.tests.push_back(keyframe.clone());
        } else {
            let Keyframe { camera, stamp, .. } = &**keyframe;
            log::warn!(
                "the test image of {camera} at {} ns is not scored: all of its pixels are masked",
                stamp.0
            );
        }
    }

    /// Removes a keyframe and its score.
    pub(super) fn remove(&mut self, camera: &str, stamp: Stamp) {
        self.tests
            .retain(|held| held.camera.as_ref() != camera || held.stamp != stamp);
        self.newest_psnr
            .retain(|(of, nanos), _| of != camera || *nanos != stamp.0);
    }

    /// The test keyframes, in the order of [`Self::score_all`].
    pub(super) fn tests(&self) -> impl ExactSizeIterator<Item = &Arc<Keyframe>> {
        self.tests.iter()
    }

    /// Whether an evaluation should begin at this training time.
    pub(super) fn is_due(&mut self, secs: f64) -> bool {
        self.pending.is_none() && self.schedule.reached(secs)
    }

    /// Begins an evaluation at this training time, unless the earlier ones have taken too long.
    pub(super) fn begin(&mut self, secs: f64) {
        let Evaluators {
            max_images_during_training,
            max_frac_during_training,
            ..
        } = self.evaluators;
        let max_frac = max_frac_during_training.unwrap_or(f64::INFINITY);
        // Without a limit, the product is infinite, or NaN at 0 s. Neither is a `Duration`, and
        // both become the longest one.
        let allowed = Duration::try_from_secs_f64(max_frac * secs)
            .unwrap_or(Duration::MAX)
            .saturating_sub(self.spent);
        if !allowed.is_zero() {
            let max_spent = allowed.min(MAX_EVALUATION);
            let tests = self.tests.iter();
            self.pending = Some(PendingEvaluation::new(
                secs,
                tests,
                max_images_during_training,
                max_spent,
            ));
        }
    }

    /// Whether an evaluation is in progress.
    pub(crate) fn is_scoring(&self) -> bool {
        self.pending.is_some()
    }

    /// Number of scored images, and of all images, of the evaluation in progress.
    pub(crate) fn progress(&self) -> Option<(usize, usize)> {
        self.pending.as_ref().map(PendingEvaluation::progress)
    }

    /// Takes the evaluation in progress. It is aborted unless it is returned with
    /// [`Self::continue_with`].
    pub(super) fn take_pending(&mut self) -> Option<PendingEvaluation> {
        self.pending.take()
    }

    /// Continues with an evaluation that is not complete.
    pub(super) fn continue_with(&mut self, evaluation: PendingEvaluation) {
        self.pending = Some(evaluation);
    }

    /// Scores a test keyframe for a scheduled evaluation.
    pub(super) fn score(
        &self,
        method: &mut AlignedModel,
        keyframe: &Keyframe,
    ) -> anyhow::Result<ImageScores> {
        self.evaluators
            .during_training
            .score_named(method, keyframe)
    }

    /// Records the time that an evaluation took.
    pub(super) fn add_spent(&mut self, spent: Duration) {
        self.spent += spent;
    }

    /// Scores all test keyframes at the end of training; see [`Evaluator::score_all`].
    pub(super) fn score_all(
        &self,
        method: &mut AlignedModel,
        meanwhile: impl FnMut(&mut AlignedModel, usize),
    ) -> anyhow::Result<Vec<ImageScores>> {
        self.evaluators
            .at_end
            .score_all(method, self.tests.iter(), meanwhile)
    }

    /// Returns the test keyframe with the oldest score and moves it to the end of the queue.
    pub(super) fn next_to_refresh(&mut self) -> Option<Arc<Keyframe>> {
        // The tests are in a queue, so that every test keyframe is scored again once per round.
        let oldest = self.tests.pop_front()?;
        self.tests.push_back(oldest.clone());
        Some(oldest)
    }

    /// Records the scores of images at this training time.
    pub(super) fn record(&mut self, images: &[ImageScores], secs: f64) {
        // The mean is computed over the latest scores of all images. A mean over only the images of
        // this call would vary with the difficulty of these images.
        for image in images {
            self.newest_psnr
                .insert((image.camera.clone(), image.stamp_nanos), image.psnr);
        }
        let Some(psnr) = self.psnr() else { return };
        self.history.push((secs, psnr));
        if self.history.len() > MAX_HISTORY {
            // The number of points is odd here, so the first and the last one are both kept.
            let mut keep = false;
            self.history.retain(|_| {
                keep = !keep;
                keep
            });
        }
    }

    /// Mean of the latest PSNR of all test keyframes, dB.
    pub fn psnr(&self) -> Option<f64> {
        let n = self.newest_psnr.len();
        (n > 0).then(|| self.newest_psnr.values().sum::<f64>() / n as f64)
    }

    /// The history of [`Self::psnr`]: training seconds and dB.
    pub(crate) fn psnr_history(&self) -> &[(f64, f64)] {
        &self.history
    }
}

#[cfg(test)]
mod tests {
    use super::{Evaluators, Scoreboard};
    use crate::evaluate::Evaluator;
    use crate::evaluation_schedule::up_to;
    use std::time::Duration;

    fn evaluators(max_frac_during_training: Option<f64>) -> Evaluators {
        let quick = Evaluator::psnr_only;
        let max_images_during_training = usize::MAX;
        Evaluators {
            during_training: quick(),
            max_images_during_training,
            max_frac_during_training,
            at_end: quick(),
        }
    }

    /// Times of the evaluations up to 60 s of training, if each takes this long.
    fn evaluated(max_frac: Option<f64>, each: Duration) -> Vec<f64> {
        let mut scoreboard = Scoreboard::new(evaluators(max_frac), false);
        let mut evaluated = Vec::new();
        for secs in up_to(60.0) {
            assert!(scoreboard.is_due(secs));
            scoreboard.begin(secs);
            if let Some(evaluation) = scoreboard.take_pending() {
                evaluated.push(evaluation.seconds);
                scoreboard.add_spent(each);
            }
        }
        evaluated
    }

    #[test]
    fn evaluations_take_a_bounded_share_of_the_time() {
        let all: Vec<f64> = up_to(60.0).collect();
        assert_eq!(evaluated(None, Duration::from_secs(100)), all);
        assert_eq!(evaluated(Some(0.1), Duration::from_millis(20)), all);
        assert_eq!(
            evaluated(Some(0.1), Duration::from_secs(1)),
            [0.25, 16.0, 32.0, 60.0]
        );
        assert_eq!(
            evaluated(Some(0.1), Duration::from_secs(7)),
            [0.25],
            "one evaluation in any case"
        );
    }
}
