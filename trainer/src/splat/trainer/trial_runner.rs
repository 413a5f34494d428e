//! Runs the trials that decide which camera parameters are optimized and how large the model is.

use super::SplatTrainer;
use crate::Error;
use crate::splat::params::status;
use crate::splat::snapshot::Snapshot;
use crate::splat::trials::{Due, SecondHalf, TrialContext, TrialEnd};
use calibration::Candidate;
use keyframe::Keyframe;
use std::sync::Arc;

impl SplatTrainer {
    fn trial_context(&self) -> TrialContext {
        TrialContext {
            step: self.schedule.step,
            n_splats: self.model.splats.n_splats,
            is_mature: self.schedule.is_mature(),
            sh_degree: self.model.splats.sh_degree,
        }
    }

    fn due_trial(&self) -> Due {
        self.trials.due(self.trial_context())
    }

    /// Starts, advances and ends trials until nothing is due, so that all effects of a trial's end
    /// apply at the same step. Postponing them to the next submit would make training depend on
    /// timing.
    pub(super) fn try_when_due(&mut self) -> Result<(), Error> {
        while self.due_trial() != Due::Nothing {
            self.finish_in_flight()?; // A failed submit may reduce the step count.
            match self.due_trial() {
                Due::Nothing => {}
                Due::Begin(candidate) => self.begin_trial(candidate)?,
                Due::BeginSecondHalf => self.begin_second_half()?,
                Due::Arrival => self.add_next_arrival()?,
                Due::Gains => self.try_gains()?,
                Due::End => self.decide_trial()?,
                Due::ReleaseValidation => self.release_validation()?,
            }
        }
        Ok(())
    }

    fn begin_trial(&mut self, candidate: Candidate) -> Result<(), Error> {
        match self.snapshot() {
            Ok(snapshot) => self.trials.begin(candidate, snapshot, self.views.len()),
            Err(error) => self.end_trials_without_memory(error)?,
        }
        Ok(())
    }

    /// Restores the state at the start of the trial and applies the tested change.
    fn begin_second_half(&mut self) -> Result<(), Error> {
        let baseline_db = self.score_validation()?;
        // The trained baseline is kept: it is displayed during the second half, and restored if
        // the change is rejected.
        let snapshot = match self.snapshot() {
            Ok(snapshot) => snapshot,
            Err(error) => return self.end_trials_without_memory(error),
        };
        let Some(SecondHalf {
            from,
            candidate,
            arrived,
        }) = self.trials.begin_second_half(snapshot, baseline_db)
        else {
            return Ok(());
        };
        self.restore_snapshot(from)?;
        // Keyframes of the first half are added again at the steps of their arrival.
        self.views
            .retain(|keyframe| !arrived.iter().any(|other| Arc::ptr_eq(other, keyframe)));
        match candidate {
            Candidate::Cameras(params) => self.model.cameras.enable(params),
            Candidate::Halved { to, .. } => self.keep_most_contributing(to)?,
            Candidate::ShDegree { to, .. } => self.lower_degree(to)?,
        }
        self.prepare_training()
    }

    /// Adds a keyframe in the second half, at the same step at which it arrived in the first half.
    fn add_next_arrival(&mut self) -> Result<(), Error> {
        let Some(keyframe) = self.trials.next_arrival() else {
            return Ok(());
        };
        self.add_arrival(keyframe)?;
        self.prepare_training()
    }

    fn decide_trial(&mut self) -> Result<(), Error> {
        let variant_db = self.score_validation()?;
        let Some(finished) = self.trials.end(&variant_db) else {
            return Ok(());
        };
        self.end_trial(finished)?;
        self.prepare_training()
    }

    /// Ends a trial. Restores the state without the change if the change was rejected. Then adds
    /// the keyframes that arrived in the second half.
    fn end_trial(
        &mut self,
        TrialEnd {
            restored,
            seeded,
            deferred,
        }: TrialEnd,
    ) -> Result<(), Error> {
        if let Some(snapshot) = restored {
            self.restore_snapshot(snapshot)?;
            // The baseline was trained on these keyframes, so their splats exist. Seeding them
            // again would double the splats.
            seeded
                .into_iter()
                .for_each(|keyframe| self.views.push(keyframe));
        }
        deferred
            .into_iter()
            .try_for_each(|keyframe| self.add_arrival(keyframe))
    }

    /// Cancels a trial that is in its second half.
    pub(super) fn cancel_trial(&mut self) -> Result<(), Error> {
        // In the first half, the model in training is the one without the change.
        let Some(canceled) = self.trials.cancel() else {
            return Ok(());
        };
        log::info!("training stopped during a trial; saving the model without the tested change");
        self.end_trial(canceled)
    }

    /// Ends a trial without a decision; it is repeated.
    pub(super) fn abort_trial(&mut self) -> Result<(), Error> {
        self.trials
            .abort()
            .map_or(Ok(()), |aborted| self.end_trial(aborted))
    }

    /// Ends all trials, which need copies of the model, if there is no memory for them. Training
    /// continues.
    fn end_trials_without_memory(&mut self, error: Error) -> Result<(), Error> {
        if !error.is_out_of_memory() {
            return Err(error);
        }
        log::warn!("stopped testing model changes: {error}");
        self.release_validation()
    }

    pub(super) fn release_validation(&mut self) -> Result<(), Error> {
        let released: Vec<Arc<Keyframe>> = self.trials.finish();
        released
            .into_iter()
            .try_for_each(|keyframe| self.add_view(keyframe))?;
        self.prepare_training()
    }

    pub(super) fn snapshot(&self) -> Result<Snapshot, Error> {
        let gpu = &self.recorder.gpu;
        let splats = &self.model.splats;
        let cameras = &self.model.cameras;
        Ok(Snapshot {
            // Resizing to the same size copies the buffers.
            splats: splats.resized(gpu, splats.capacity, splats.sh_degree)?,
            cameras: (cameras.set, cameras.copy(gpu)?),
            schedule: self.schedule,
            scene: self.seeding.scene.clone(),
        })
    }

    pub(super) fn restore_snapshot(&mut self, snapshot: Snapshot) -> Result<(), Error> {
        self.recorder.passes.clear_bindings();
        // The sum of steps and reverted steps stays the number of steps that were trained.
        // The snapshot may be from a later step, if the second half of a trial is canceled. Its first
        // half was reverted before, so the result is not negative.
        self.trials.n_reverted_steps =
            self.trials.n_reverted_steps + self.schedule.step - snapshot.schedule.step;
        self.model.splats = snapshot.splats;
        self.model
            .cameras
            .restore_snapshot(&self.recorder.gpu, snapshot.cameras)?;
        self.schedule = snapshot.schedule;
        self.seeding.scene = snapshot.scene;
        // Kernels derive learning rates and random numbers from their own step counter.
        let step = u32::try_from(self.schedule.step).unwrap_or(u32::MAX);
        self.optimizer
            .write_counter(&self.recorder.gpu, status::STEP, step);
        Ok(())
    }
}
