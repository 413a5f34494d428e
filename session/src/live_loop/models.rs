//! The models of a live run.

use crate::session::{EndViewers, MAX_LIVE_STEP_MILLIS, Session};
use crate::{methods, time_slices};
use keyframe::Keyframe;
use kinematics::Stamp;
use std::sync::Arc;

/// The models in training, and the steps at which their next keyframe is due.
pub(super) struct Models {
    /// The first model is drawn for requests that name no method.
    pub(super) sessions: Vec<Session>,
    /// Step of each session at which the next keyframe is due in lockstep.
    next_keyframe_at: Vec<u64>,
}

impl Models {
    pub(super) fn new(sessions: Vec<Session>) -> Self {
        Self {
            next_keyframe_at: vec![0; sessions.len()],
            sessions,
        }
    }

    /// Index of the session of a method, or of the first one if no method is given. The error is
    /// the reason why there is none.
    pub(super) fn session_ix(&self, method: Option<&str>) -> Result<usize, String> {
        self.sessions
            .iter()
            .position(|session| method.is_none_or(|name| session.kind().name() == name))
            .ok_or_else(|| methods::unknown(self.sessions.iter().map(Session::kind), method))
    }

    pub(super) fn is_scoring(&self) -> bool {
        self.sessions
            .iter()
            .any(|session| session.scoreboard().is_scoring())
    }

    /// Number of scored images, and of all images, of the evaluation in progress.
    pub(super) fn scoring_progress(&self) -> Option<(usize, usize)> {
        self.sessions
            .iter()
            .find_map(|session| session.scoreboard().progress())
    }

    /// Serves viewers for a moment, while work on another thread is in progress.
    pub(super) fn serve_waiting(&mut self, viewers: &mut EndViewers) {
        let mut viewed: Vec<_> = self.sessions.iter_mut().map(Session::viewed).collect();
        let spent = viewers.serve_waiting(&mut viewed);
        // All sessions share one clock, so the time is excluded only once.
        self.sessions
            .iter()
            .take(1)
            .for_each(|session| session.time().exclude(spent));
    }

    /// Whether no model can train before the next keyframe arrives.
    pub(super) fn is_idle(&self) -> bool {
        self.sessions
            .iter()
            .all(|session| session.is_idle() || session.has_finished_steps())
    }

    /// Steps of each model.
    pub(super) fn steps(&self) -> Vec<u64> {
        self.sessions
            .iter()
            .map(|session| session.progress().step)
            .collect()
    }

    /// Pushes a keyframe to the models.
    pub(super) fn push(&mut self, keyframe: &Arc<Keyframe>) -> anyhow::Result<()> {
        let mut pushed = Ok(());
        for session in self.unfinished() {
            // The loop continues after a GPU failure, so that every session holds the keyframe for
            // its restored model.
            pushed = pushed.and(session.push(keyframe));
        }
        pushed
    }

    /// Replaces a keyframe with a version that has a more accurate pose.
    pub(super) fn revise(&mut self, keyframe: &Arc<Keyframe>) -> anyhow::Result<()> {
        let mut revised = Ok(());
        for session in self.unfinished() {
            // As in `push`, a failure must not leave the sessions with different keyframes.
            revised = revised.and(session.revise(keyframe));
        }
        revised
    }

    /// Removes an evicted keyframe from the models.
    pub(super) fn remove(&mut self, camera: &str, stamp: Stamp) -> anyhow::Result<()> {
        let mut removed = Ok(());
        for session in self.unfinished() {
            // As in `push`, a failure must not leave the sessions with different keyframes.
            removed = removed.and(session.remove(camera, stamp));
        }
        removed
    }

    /// The models that receive keyframes. A model that has made all its steps receives no more
    /// keyframes, so that it equals a model trained alone.
    fn unfinished(&mut self) -> impl Iterator<Item = &mut Session> {
        self.sessions
            .iter_mut()
            .filter(|session| !session.has_finished_steps())
    }

    /// Applies the results of alignments that are ready. Returns whether there were any.
    pub(super) fn apply_alignments(&mut self) -> anyhow::Result<bool> {
        let mut is_applied = false;
        for session in &mut self.sessions {
            is_applied |= session.poll_alignment(false)?;
        }
        Ok(is_applied)
    }

    /// Whether each model has reached the step at which the next keyframe is due, or cannot train
    /// further without it.
    pub(super) fn is_keyframe_due(&self) -> bool {
        let is_due = |(session, at): (&Session, &u64)| {
            session.progress().step >= *at || session.is_idle() || session.has_finished_steps()
        };
        self.sessions.iter().zip(&self.next_keyframe_at).all(is_due)
    }

    /// Makes the next keyframe due after this number of further steps.
    pub(super) fn schedule_next_keyframe(&mut self, n_steps: u64) {
        for (at, session) in self.next_keyframe_at.iter_mut().zip(&self.sessions) {
            *at = session.progress().step + n_steps;
        }
    }

    /// Pauses the growth of each model while its steps take too long for a live run. A larger model
    /// would be trained and drawn even more slowly, so that an operator would see less.
    pub(super) fn pause_growth_when_slow(&mut self) -> anyhow::Result<()> {
        for session in &mut self.sessions {
            // Growth continues only below half of the limit. With a single limit, small changes of
            // the machine's load would pause and continue growth repeatedly, and each change would
            // be logged.
            match session.progress().step_millis {
                millis if millis > MAX_LIVE_STEP_MILLIS => session.pause_growth(true)?,
                millis if millis < 0.5 * MAX_LIVE_STEP_MILLIS => session.pause_growth(false)?,
                _ => {}
            }
        }
        Ok(())
    }

    /// Trains the next model for one slice; see [`time_slices::train_next`]. If `is_paced`, no model
    /// trains beyond the step at which its next keyframe is due.
    pub(super) fn train_next(
        &mut self,
        is_paced: bool,
        is_render_pending: impl Fn() -> bool,
    ) -> anyhow::Result<()> {
        let due = is_paced.then_some(&self.next_keyframe_at[..]);
        let max_steps = |ix: usize, session: &Session| n_steps_until_due(due, ix, session);
        time_slices::train_next(&mut self.sessions, max_steps, is_render_pending)
    }
}

/// Number of steps of a session until its next keyframe is due; unlimited without due steps.
fn n_steps_until_due(due: Option<&[u64]>, session_ix: usize, session: &Session) -> u64 {
    due.map_or(u64::MAX, |due| {
        due[session_ix].saturating_sub(session.progress().step)
    })
}
