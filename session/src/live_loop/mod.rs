//! The loop of a live run: takes keyframes, trains models, and draws pictures for viewers.

mod clearance;
mod growing_scene;
mod keyframe_intake;
mod keyframe_warning;
mod keyframes;
mod models;
mod pictures;
mod publishing;
mod requests;

use crate::error::is_gpu_error;
use crate::ledger::Ledger;
use crate::recoveries::{self, OpenGpu, Recoveries};
use crate::render_budget::RenderBudget;
use crate::run_state::RunState;
use crate::session::{EndViewers, Session};
use crate::steering::ClearanceFeed;
use background::Task;
use capture::{Feed, InputResult, Notes};
use growing_scene::GrowingScene;
use keyframe::Keyframe;
pub use keyframe_intake::KeyframeChange;
use keyframe_intake::KeyframeIntake;
use models::Models;
use publishing::Publishing;
use requests::Requests;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::AlignTiming;
use viz::{Hub, Identity, StateProgress};

/// Maximum wait for a keyframe when there is nothing to do. Controls, edits and the status may be
/// delayed by this time. A shorter wait would use more processor time for checks without a result.
const IDLE: Duration = Duration::from_millis(10);

/// When the models receive keyframes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// In real time: as soon as a keyframe arrives.
    RealTime,
    /// In lockstep with training: one keyframe per fixed number of steps, so that a seed determines
    /// the result.
    Lockstep {
        /// Steps between two keyframes.
        steps_per_keyframe: u64,
    },
}

impl Pace {
    /// When the cameras are aligned.
    pub fn align_timing(self) -> AlignTiming {
        match self {
            Self::RealTime => AlignTiming::RealTime,
            Self::Lockstep { .. } => AlignTiming::Lockstep,
        }
    }
}

/// A live run.
pub struct LiveLoop {
    models: Models,
    intake: KeyframeIntake,
    hub: Hub,
    pace: Pace,
    scene: GrowingScene,
    budget: RenderBudget,
    recoveries: Recoveries,
    /// Times of the keyframes.
    ledger: Ledger,
    /// Receives drawn depth, if an arm is steered.
    clearance: Option<ClearanceFeed>,
    requests: Requests,
    publishing: Publishing,
}

impl LiveLoop {
    /// Combines the parts. Training starts with the first call of [`Self::advance`].
    pub fn new(sessions: Vec<Session>, feed: Feed, hub: Hub, options: LiveOptions) -> Self {
        let is_software = sessions
            .first()
            .is_some_and(|session| session.gpu().is_software());
        Self {
            models: Models::new(sessions),
            intake: KeyframeIntake::new(feed, options.start_keyframes, options.earlier_rejected),
            publishing: Publishing::new(
                hub.clone(),
                options.identity,
                options.notes,
                options.device_notes,
            ),
            hub,
            pace: options.pace,
            scene: GrowingScene::default(),
            budget: RenderBudget::new(is_software),
            recoveries: Recoveries::new(options.open_gpu),
            ledger: Ledger::default(),
            clearance: None,
            requests: Requests::default(),
        }
    }

    /// Continues with the keyframes of an earlier run, which the sessions already hold.
    pub fn resume_from(mut self, keyframes: Vec<Arc<Keyframe>>) -> Self {
        self.intake.accepted.list = keyframes;
        self.publishing
            .publish_keyframes(&self.intake.accepted.list, &self.models.sessions[0]);
        self.scene.publish(&self.intake.accepted.list, &self.hub);
        self
    }

    /// Changes all following keyframes before the models receive them, for benchmarks with
    /// disturbed data.
    pub fn change_keyframes(&mut self, change: KeyframeChange) {
        self.intake.change = Some(change);
    }

    /// Whether the run is over: a limit was reached or cannot be reached, the devices failed, or
    /// the input ended without training data.
    pub fn is_over(&self) -> bool {
        if self.models.is_scoring() {
            return false; // An evaluation in progress is completed first.
        }
        // After one session has reached its limit, the run waits for all other sessions that can
        // still reach theirs.
        let is_done = |session: &Session| {
            session.is_over() || (self.intake.feed.ended() && session.is_idle())
        };
        let sessions = &self.models.sessions;
        let reached = sessions.iter().any(Session::is_over) && sessions.iter().all(is_done);
        reached || self.has_exhausted_input() || self.intake.is_over_without_data()
    }

    /// Whether the input has ended and a model cannot reach its step limit without more keyframes.
    /// A run without a step limit does not end in this case, so that the result stays visible.
    pub fn has_exhausted_input(&self) -> bool {
        self.is_finished() && self.models.sessions.iter().any(has_steps_left)
    }

    /// The hub that clients are connected to.
    pub fn hub(&self) -> Hub {
        self.hub.clone()
    }

    /// Keyframes in the store, in order of acceptance.
    pub fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.intake.accepted.list
    }

    /// Number of keyframes evicted so far.
    pub fn n_evicted(&self) -> u64 {
        self.intake.accepted.n_evicted
    }

    /// Times at which each keyframe passed the stages from the camera to the screens of viewers.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The models in training.
    pub fn sessions(&self) -> &[Session] {
        &self.models.sessions
    }

    /// Runs one cycle: takes keyframes, trains, draws and publishes. Reopens the GPU if it fails.
    pub fn advance(&mut self) -> anyhow::Result<()> {
        self.intake.warn_if_empty();
        // Requests of operators come first, so that the pictures and the status of this cycle
        // already show their effect.
        self.requests.apply_controls(&self.hub, &mut self.models);
        self.ledger
            .set_paused(self.requests.is_paused, Instant::now());
        self.record_shown_pictures();
        self.requests.apply_edits(&self.hub, &mut self.models);
        // After a GPU failure, the remaining stages are skipped: each of them would fail, too.
        let advanced = self
            .take_keyframes()
            .and_then(|()| self.step())
            .and_then(|()| self.render())
            .and_then(|()| self.draw_clearance())
            .map(|()| self.publish_models())
            .and_then(|()| self.publish());
        advanced.or_else(|error| self.recover(error))
    }

    /// Waits for queued work. Reopens the GPU if it failed, and returns whether it did.
    pub fn wait(&mut self) -> anyhow::Result<bool> {
        let sessions = &self.models.sessions;
        match sessions.iter().try_for_each(|session| session.gpu().wait()) {
            Ok(()) => Ok(false),
            Err(error) => self.recover(error.into()).map(|()| true),
        }
    }

    /// Reopens the GPU if it caused `error`. Nothing can be drawn meanwhile, so viewers see why.
    fn recover(&mut self, error: anyhow::Error) -> anyhow::Result<()> {
        if is_gpu_error(&error) {
            self.hub.set_state("reopening the GPU");
        }
        self.recoveries.recover(&mut self.models.sessions, error)
    }

    /// Describes how to continue if the run fails now.
    pub fn describe_recoverable(&mut self) -> String {
        recoveries::describe_recoverable(&mut self.models.sessions)
    }

    /// Trains for one slice once there are enough keyframes. During an evaluation, scores one test
    /// image instead. Does not train if a requested picture may be drawn now.
    fn step(&mut self) -> anyhow::Result<()> {
        // Lost devices are detected even if no steps are made. Callbacks may report a lost device
        // at any time, and an idle run must recover, too.
        self.models
            .sessions
            .iter()
            .try_for_each(|session| session.gpu().check())?;
        if !self.intake.has_enough() {
            return Ok(());
        }
        // One image per cycle, so that requested pictures are drawn between two images.
        let sessions = &mut self.models.sessions;
        if let Some(session) = sessions
            .iter_mut()
            .find(|session| session.scoreboard().is_scoring())
        {
            let before = Instant::now();
            session.score_next()?;
            self.budget.add_training(before.elapsed());
            return Ok(());
        }
        if self.requests.is_paused {
            // Keyframes are still accepted, and checkpoints can be requested.
            sessions
                .iter_mut()
                .try_for_each(Session::write_checkpoint_when_due)?;
        }
        if self.is_finished() || self.requests.is_paused {
            // Nothing is trained. Waits for a request, so that the loop does not use a whole
            // processor.
            self.hub.pictures().wait_for_request(IDLE);
            return Ok(());
        }
        if self.budget.is_picture_due(&self.hub) {
            return Ok(());
        }
        self.train_slice()
    }

    /// Trains the next model for one slice.
    fn train_slice(&mut self) -> anyhow::Result<()> {
        // A picture waits for the submit in progress, so submits are shorter while clients are
        // connected.
        let is_watched = self.hub.n_clients() > 0;
        let sessions = &mut self.models.sessions;
        sessions
            .iter_mut()
            .for_each(|session| session.viewed().set_watched(is_watched));
        // In lockstep, no model trains beyond the step at which its next keyframe is due. After the
        // end of the input, no keyframe is due any more.
        let is_paced = self.pace != Pace::RealTime && !self.intake.feed.ended();
        // Growth is paused only in real time. The time of a step differs between runs, and a
        // lockstep run must not depend on it.
        if self.pace == Pace::RealTime {
            self.models.pause_growth_when_slow()?;
        }
        let before = Instant::now();
        let step_before = self.models.sessions[0].progress().step;
        let hub = &self.hub;
        let budget = self.budget;
        self.models
            .train_next(is_paced, || budget.is_picture_due(hub))?;
        self.budget.add_training(before.elapsed());
        // Steps before this slice are complete, because at most one submit is in flight.
        self.ledger.completed(step_before);
        Ok(())
    }

    /// Ends the input and a search for floaters. Viewers get pictures meanwhile.
    pub fn finish(mut self) -> EndedLoop {
        let chunks = self.publishing.take_chunks();
        let mut viewers = EndViewers::new(self.hub.clone(), self.budget, chunks);
        // Changes only the state; the rest of the status stays visible until the scores are
        // published.
        let closing = StateProgress {
            text: "closing the devices".to_owned(),
            ..StateProgress::default()
        };
        viewers.show("saving", closing.clone());
        while self.requests.is_searching() {
            self.models.serve_waiting(&mut viewers);
        }
        if self.requests.erase_found(true, &self.hub, &mut self.models) {
            self.publish_status();
            viewers.show("saving", closing);
        }
        let Self {
            mut models, intake, ..
        } = self;
        // The input ends on its own thread, which may still write a recording.
        let ending = Task::start("end of the input", || intake.feed.finish());
        while !ending.is_finished() {
            models.serve_waiting(&mut viewers);
        }
        let input_result = ending
            .join()
            .unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        EndedLoop {
            sessions: models.sessions,
            input_result,
            viewers,
        }
    }

    /// Whether the input has ended and all training is done. The models stay visible until the user
    /// ends the run.
    fn is_finished(&self) -> bool {
        self.intake.feed.ended() && self.models.is_idle()
    }

    /// Progress of the work that [`Self::state`] names.
    fn state_progress(&self) -> Option<StateProgress> {
        if let Some((n_scored, n_all)) = self.models.scoring_progress() {
            let text = format!("scoring {n_scored} of {n_all} test images");
            return Some(StateProgress::of_parts(text, n_scored, n_all));
        }
        if self.is_finished() || self.intake.has_enough() {
            return None;
        }
        Some(self.intake.progress().at_startup())
    }

    fn state(&self) -> RunState {
        if self.is_finished() {
            RunState::Finished
        } else if self.requests.is_paused {
            RunState::Paused
        } else if self.intake.has_enough() {
            RunState::Training
        } else if self.intake.feed.first_image().is_some() {
            RunState::Collecting
        } else {
            RunState::Waiting
        }
    }
}

/// What remains of a live run after its input has ended.
pub struct EndedLoop {
    /// The models.
    pub sessions: Vec<Session>,
    /// Results of the input.
    pub input_result: anyhow::Result<InputResult>,
    /// The viewers, who wait for pictures.
    pub viewers: EndViewers,
}

/// Whether a session has a step limit and has not reached it.
fn has_steps_left(session: &Session) -> bool {
    session
        .time()
        .n_steps_remaining(session.progress().step)
        .is_some_and(|n| n > 0)
}

/// Options of a live run.
pub struct LiveOptions {
    /// When the models receive keyframes.
    pub pace: Pace,
    /// Number of keyframes with which training starts.
    pub start_keyframes: usize,
    /// Which robot and run the page shows.
    pub identity: Identity,
    /// Number of images that did not become keyframes in earlier parts of the run, by reason.
    pub earlier_rejected: BTreeMap<String, u64>,
    /// Notes shown on the page.
    pub notes: Vec<String>,
    /// Notes about the devices, which are added during the run and shown, too.
    pub device_notes: Notes,
    /// Reopens the GPU after a failure.
    pub open_gpu: OpenGpu,
}
