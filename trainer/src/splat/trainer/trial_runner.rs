//! Runs the trials that decide which camera parameters are optimized and how large the model is.

use super::training::Training;
use super::{gains, model_size, scoring};
use crate::Error;
use crate::splat::snapshot::Snapshot;
use crate::splat::trials::{Due, SecondHalf, SplatTrials, TrialContext, TrialEnd};
use calibration::Candidate;
use keyframe::Keyframe;
use std::sync::Arc;

/// Runs the trials on the model in training.
pub(super) struct TrialRunner<'a> {
    pub(super) training: &'a mut Training,
    pub(super) trials: &'a mut SplatTrials,
}

impl TrialRunner<'_> {
    fn due(&self) -> Due {
        let Training {
            schedule, model, ..
        } = &*self.training;
        self.trials.due(TrialContext {
            step: schedule.step,
            n_splats: model.splats.n_splats,
            is_mature: schedule.is_mature(),
            sh_degree: model.splats.sh_degree,
        })
    }

    /// Starts, advances and ends trials until nothing is due, so that all effects of a trial's end
    /// apply at the same step. Postponing them to the next submit would make training depend on
    /// timing.
    pub(super) fn run_due(&mut self) -> Result<(), Error> {
        while self.due() != Due::Nothing {
            self.training.finish_in_flight()?; // A failed submit may reduce the step count.
            match self.due() {
                Due::Nothing => {}
                Due::Begin(candidate) => self.begin(candidate)?,
                Due::BeginSecondHalf => self.begin_second_half()?,
                Due::Arrival => self.add_next_arrival()?,
                Due::Gains => gains::try_gains(self.training, self.trials)?,
                Due::End => self.decide()?,
                Due::ReleaseValidation => self.release_validation()?,
            }
        }
        Ok(())
    }

    fn begin(&mut self, candidate: Candidate) -> Result<(), Error> {
        match self.training.snapshot() {
            Ok(snapshot) => {
                let n_views = self.training.views.len();
                self.trials.begin(candidate, snapshot, n_views);
            }
            Err(error) => self.finish_without_memory(error)?,
        }
        Ok(())
    }

    /// Restores the state at the start of the trial and applies the tested change.
    fn begin_second_half(&mut self) -> Result<(), Error> {
        let baseline_db = scoring::score_validation(self.training, self.trials)?;
        // The trained baseline is kept. It is displayed during the second half, and restored if the
        // change is rejected.
        let snapshot = match self.training.snapshot() {
            Ok(snapshot) => snapshot,
            Err(error) => return self.finish_without_memory(error),
        };
        let Some(SecondHalf {
            from,
            candidate,
            arrived,
        }) = self.trials.begin_second_half(snapshot, baseline_db)
        else {
            return Ok(());
        };
        self.restore(from)?;
        // Keyframes of the first half are added again at the steps of their arrival.
        self.training
            .views
            .retain(|keyframe| !arrived.iter().any(|other| Arc::ptr_eq(other, keyframe)));
        match candidate {
            Candidate::Cameras(params) => self.training.model.cameras.enable(params),
            Candidate::Halved { to, .. } => {
                model_size::keep_most_contributing(self.training, to)?;
            }
            Candidate::ShDegree { to, .. } => model_size::lower_degree(self.training, to)?,
        }
        self.training.prepare_model()
    }

    /// Adds a keyframe in the second half, at the same step at which it arrived in the first half.
    fn add_next_arrival(&mut self) -> Result<(), Error> {
        let Some(keyframe) = self.trials.next_arrival() else {
            return Ok(());
        };
        self.training.add_arrival(keyframe)?;
        self.training.prepare_model()
    }

    fn decide(&mut self) -> Result<(), Error> {
        let variant_db = scoring::score_validation(self.training, self.trials)?;
        let Some(finished) = self.trials.end(&variant_db) else {
            return Ok(());
        };
        self.end(finished)?;
        self.training.prepare_model()
    }

    /// Ends a trial. Restores the state without the change if the change was rejected. Then adds
    /// the keyframes that arrived in the second half.
    fn end(
        &mut self,
        TrialEnd {
            restored,
            seeded,
            deferred,
        }: TrialEnd,
    ) -> Result<(), Error> {
        if let Some(snapshot) = restored {
            self.restore(snapshot)?;
            // The baseline was trained on these keyframes, so their splats exist. Seeding them
            // again would double the splats.
            seeded
                .into_iter()
                .for_each(|keyframe| self.training.views.push(keyframe));
        }
        deferred
            .into_iter()
            .try_for_each(|keyframe| self.training.add_arrival(keyframe))
    }

    /// Cancels a trial that is in its second half.
    pub(super) fn cancel(&mut self) -> Result<(), Error> {
        // In the first half, the model without the change is in training.
        let Some(canceled) = self.trials.cancel() else {
            return Ok(());
        };
        log::info!("training stopped during a trial; saving the model without the tested change");
        self.end(canceled)
    }

    /// Ends a trial without a decision. The trial is repeated later.
    pub(super) fn abort(&mut self) -> Result<(), Error> {
        self.trials
            .abort()
            .map_or(Ok(()), |aborted| self.end(aborted))
    }

    /// Ends all trials if there is no memory for the copies of the model that they need. Training
    /// continues.
    fn finish_without_memory(&mut self, error: Error) -> Result<(), Error> {
        if !error.is_out_of_memory() {
            return Err(error);
        }
        log::warn!("stopped testing model changes: {error}");
        self.release_validation()
    }

    fn release_validation(&mut self) -> Result<(), Error> {
        let released: Vec<Arc<Keyframe>> = self.trials.finish();
        released
            .into_iter()
            .try_for_each(|keyframe| self.training.add_view(keyframe))?;
        self.training.prepare_model()
    }

    /// Restores a state and counts the reverted steps.
    fn restore(&mut self, snapshot: Snapshot) -> Result<(), Error> {
        // The sum of steps and reverted steps must remain equal to the number of steps that were
        // trained. If the second half of a trial is canceled, the snapshot may be from a later
        // step. The result is still not negative, because the steps of the first half were counted
        // as reverted before.
        self.trials.n_reverted_steps =
            self.trials.n_reverted_steps + self.training.schedule.step - snapshot.schedule.step;
        self.training.restore_snapshot(snapshot)
    }
}
