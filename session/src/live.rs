//! The loop of a live run: takes keyframes, trains models, and draws pictures for viewers.

use crate::chunk_publisher::ChunkPublisher;
use crate::editing::Editor;
use crate::ledger::{KeyframeTimes, Ledger};
use crate::observations::{ModelState, ObservationPublisher, PosedKeyframe};
use crate::recoveries::{self, OpenGpu, Recoveries};
use crate::render_budget::RenderBudget;
use crate::session::Session;
use crate::{methods, scene_hint, time_slices};
use calibration::CalibratedCamera;
use capture::{Change, Feed, FeedItem, InputResult, Notes};
use keyframe::{Keyframe, Split};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{AlignTiming, QueuedPicture, RenderRequest};
use viz::{Control, EditRequest, Hub, KeyframePose, ModelStatus, PendingRender, Status};

/// Minimum number of keyframes that determine the first view of the scene.
const HINT_KEYFRAMES: usize = 5;
/// Period of status messages.
const PUBLISH_PERIOD: Duration = Duration::from_millis(250);
/// Maximum wait for a keyframe when there is nothing to do.
const IDLE: Duration = Duration::from_millis(10);
/// Maximum fraction of the time that is spent on scoring between scheduled evaluations.
const SCORE_FRAC: f64 = 0.03;
/// Polling period while waiting for a keyframe or a picture request.
const POLL_PERIOD: Duration = Duration::from_millis(2);
/// Maximum number of pictures in the GPU's queue.
const MAX_QUEUED_PICTURES: usize = 8;
/// Maximum time for which pictures are drawn before other work continues.
const MAX_RENDER_TIME: Duration = Duration::from_millis(100);

/// When the models receive keyframes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// In real time: as soon as a keyframe arrives.
    RealTime,
    /// In lockstep with training: one keyframe per fixed number of steps, so that a seed determines the result.
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
pub struct Live {
    /// The first model is drawn for requests that name no method.
    sessions: Vec<Session>,
    feed: Feed,
    hub: Hub,
    pace: Pace,
    start_keyframes: usize,
    keyframes: Vec<Arc<Keyframe>>,
    n_evicted: u64,
    /// Step of each session at which the next keyframe is due in lockstep.
    next_keyframe_at: Vec<u64>,
    budget: RenderBudget,
    /// Session whose latest score is refreshed next.
    next_refreshed: usize,
    published: Option<Instant>,
    /// Corrected cameras of the published keyframes.
    published_cameras: Vec<CalibratedCamera>,
    scoring_time: Duration,
    notes: Vec<String>,
    device_notes: Notes,
    recoveries: Recoveries,
    /// Times of the keyframes.
    ledger: Ledger,
    keyframe_change: Option<KeyframeChange>,
    /// Whether an operator has paused training.
    is_paused: bool,
    /// Result of the last checkpoint that an operator requested.
    checkpoint_note: Option<String>,
    editor: Editor,
    /// What the last edit did.
    edit_note: Option<String>,
    /// Number of times that edits of any model have changed.
    edit_revision: u64,
    chunk_publisher: ChunkPublisher,
    observation_publisher: ObservationPublisher,
}

/// Changes a keyframe before the models receive it.
pub type KeyframeChange = Box<dyn FnMut(Arc<Keyframe>) -> Arc<Keyframe>>;

impl Live {
    /// Combines the parts. Training starts with the first call of [`Self::advance`].
    pub fn new(sessions: Vec<Session>, feed: Feed, hub: Hub, options: LiveOptions) -> Self {
        let is_software = sessions.first().is_some_and(Session::is_software);
        Self {
            next_keyframe_at: vec![0; sessions.len()],
            sessions,
            feed,
            chunk_publisher: ChunkPublisher::new(hub.clone()),
            observation_publisher: ObservationPublisher::new(hub.clone()),
            hub,
            pace: options.pace,
            start_keyframes: options.start_keyframes,
            keyframes: Vec::new(),
            n_evicted: 0,
            budget: RenderBudget::new(is_software),
            next_refreshed: 0,
            published: None,
            published_cameras: Vec::new(),
            scoring_time: Duration::ZERO,
            notes: options.notes,
            device_notes: options.device_notes,
            recoveries: Recoveries::new(options.open_gpu),
            ledger: Ledger::default(),
            keyframe_change: None,
            is_paused: false,
            checkpoint_note: None,
            editor: Editor::default(),
            edit_note: None,
            edit_revision: 0,
        }
    }

    /// Continues with the keyframes of an earlier run, which the sessions already hold.
    pub fn resume_from(mut self, keyframes: Vec<Arc<Keyframe>>) -> Self {
        self.keyframes = keyframes;
        self.publish_keyframes();
        if let Some(hint) = scene_hint::from_keyframes(&self.keyframes) {
            self.hub.set_scene_hint(hint);
        }
        self
    }

    /// Changes all following keyframes before the models receive them, for benchmarks with disturbed data.
    pub fn change_keyframes(&mut self, change: KeyframeChange) {
        self.keyframe_change = Some(change);
    }

    /// Publishes the keyframes and the corrections of live images, as estimated by the first model.
    fn publish_keyframes(&mut self) {
        let cameras: Vec<_> = self.keyframes.iter().map(|keyframe| self.sessions[0].camera_of(keyframe)).collect();
        let posed = || self.keyframes.iter().zip(&cameras);
        // Live images get the correction of their camera's newest keyframe.
        let correction = |(keyframe, camera): (&Arc<Keyframe>, &CalibratedCamera)| {
            (keyframe.camera.clone(), keyframe.world_from_camera.inverse() * camera.world_from_camera)
        };
        self.hub.set_camera_corrections(posed().map(correction).collect());
        self.hub.set_keyframe_sources(&self.keyframes);
        self.hub.set_keyframes(posed().map(|(keyframe, camera)| frustum(keyframe, camera)).collect());
        self.published_cameras = cameras;
    }

    /// Publishes the keyframes again if corrections have moved one of them noticeably.
    fn publish_moved_keyframes(&mut self) {
        let has_moved = |(keyframe, published): (&Arc<Keyframe>, &CalibratedCamera)| {
            self.sessions[0].camera_of(keyframe).differs_noticeably(published)
        };
        if self.keyframes.iter().zip(&self.published_cameras).any(has_moved) {
            self.publish_keyframes();
        }
    }

    /// Applies the results of alignments that are ready.
    fn apply_alignments(&mut self) -> crate::Result<()> {
        let mut is_applied = false;
        for session in &mut self.sessions {
            is_applied |= session.poll_alignment(false)?;
        }
        if is_applied {
            self.publish_keyframes();
        }
        Ok(())
    }

    /// Whether the run is over: a limit was reached or cannot be reached, the devices failed, or the input ended
    /// without training data.
    pub fn is_over(&self) -> bool {
        if self.is_scoring() {
            return false; // An evaluation in progress is completed first.
        }
        // After one session has reached its limit, the run waits for all other sessions that can still reach theirs.
        let is_done = |session: &Session| session.is_over() || (self.feed.ended() && session.is_idle());
        let reached = self.sessions.iter().any(Session::is_over) && self.sessions.iter().all(is_done);
        reached || self.has_exhausted_input() || self.feed.source_failed() || (self.feed.ended() && !self.can_train())
    }

    /// Whether the input ended and a model cannot reach its step limit without more keyframes. Without a step limit,
    /// the run does not end, so that the result stays visible.
    pub fn has_exhausted_input(&self) -> bool {
        self.is_finished() && self.sessions.iter().any(|session| session.n_steps_remaining().is_some_and(|n| n > 0))
    }

    /// The hub that clients are connected to.
    pub fn hub(&self) -> Hub {
        self.hub.clone()
    }

    /// Keyframes in the store, in order of acceptance.
    pub fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.keyframes
    }

    /// Number of keyframes evicted so far.
    pub fn n_evicted(&self) -> u64 {
        self.n_evicted
    }

    /// Times at which each keyframe passed the stages from the camera to the screens of viewers.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The models in training.
    pub fn sessions(&self) -> &[Session] {
        &self.sessions
    }

    /// Runs one cycle: takes keyframes, trains, draws and publishes. Reopens the GPU if it fails.
    pub fn advance(&mut self) -> crate::Result<()> {
        self.apply_controls();
        self.record_shown_pictures();
        self.apply_edits();
        let advanced = self
            .take_keyframes()
            .and_then(|()| self.step())
            .and_then(|()| self.render())
            .map(|()| self.publish_chunks())
            .map(|()| self.publish_observations())
            .and_then(|()| self.publish());
        advanced.or_else(|error| self.recoveries.recover(&mut self.sessions, error))
    }

    /// Waits for queued work. Reopens the GPU if it failed, and returns whether it did.
    pub fn wait(&mut self) -> crate::Result<bool> {
        match self.sessions.iter().try_for_each(Session::wait) {
            Ok(()) => Ok(false),
            Err(error) => self.recoveries.recover(&mut self.sessions, error).map(|()| true),
        }
    }

    /// Describes how to continue if the run fails now.
    pub fn describe_recoverable(&mut self) -> String {
        recoveries::describe_recoverable(&mut self.sessions)
    }

    /// Applies the actions that operators have requested. An evaluation is completed first.
    fn apply_controls(&mut self) {
        if self.is_scoring() {
            return;
        }
        for control in self.hub.take_controls() {
            match control {
                Control::Pause => self.is_paused = true,
                Control::Resume => self.is_paused = false,
                Control::Save => {
                    let mut is_due = true;
                    for session in &mut self.sessions {
                        is_due &= session.request_checkpoint();
                    }
                    self.checkpoint_note = Some(match is_due {
                        true => format!("checkpoint requested after {:.0} s", self.sessions[0].secs()),
                        false => "this run writes no checkpoints".to_owned(),
                    });
                }
            }
        }
    }

    /// Records which pictures of the first model clients have shown.
    fn record_shown_pictures(&mut self) {
        for picture in self.hub.take_shown_pictures() {
            if session_for_method(&self.sessions, picture.method.as_deref()) == Some(0) {
                self.ledger.shown(&picture);
            }
        }
    }

    /// Erases the floaters that were found, and applies the edits that operators have requested.
    fn apply_edits(&mut self) {
        self.erase_found(false);
        for request in self.hub.take_edits() {
            let edited = match session_for_method(&self.sessions, request.method()) {
                Some(session_ix) => self.sessions[session_ix].edit(&mut self.editor, &request),
                None => Err(self.unknown_method(request.method())),
            };
            self.report_edit(&request, edited);
        }
    }

    /// Erases floaters once they are found, or waits for them if `wait`. Returns whether a search has ended.
    fn erase_found(&mut self, wait: bool) -> bool {
        let Some((request, found)) = self.editor.take_found(wait) else { return false };
        let session_ix = session_for_method(&self.sessions, request.method()).unwrap_or_default();
        let erased = found.and_then(|floaters| self.sessions[session_ix].erase_floaters(floaters));
        self.report_edit(&request, erased.map(Some));
        true
    }

    /// Shows the note on an edit, or sends the reason why it was not possible.
    fn report_edit(&mut self, request: &EditRequest, edited: Result<Option<String>, String>) {
        match edited {
            Ok(note) => {
                if note.is_some() {
                    self.edit_note = note;
                    self.edit_revision += 1;
                }
                self.published = None; // Viewers wait for the new status.
            }
            Err(reason) => self.hub.reject_edit(request, &reason),
        }
    }

    /// Why there is no model of this method.
    fn unknown_method(&self, method: Option<&str>) -> String {
        methods::unknown(self.sessions.iter().map(Session::kind), method)
    }

    /// Pushes new keyframes to the models: all waiting keyframes in real time, or the keyframe that is due in lockstep.
    /// Does nothing during an evaluation.
    fn take_keyframes(&mut self) -> crate::Result<()> {
        if self.is_scoring() {
            return Ok(());
        }
        if self.is_paused && self.pace != Pace::RealTime {
            self.hub.wait_for_request(IDLE); // The next keyframe is due at a later step.
            return Ok(());
        }
        self.apply_alignments()?;
        if let Some(first_image) = self.feed.first_image() {
            self.sessions.iter_mut().for_each(|session| session.start_clock(first_image));
        }
        let n_before = self.keyframes.len();
        match self.pace {
            Pace::RealTime => {
                if !self.is_training() || self.is_idle() || self.is_paused {
                    let first = self.wait_for_change();
                    first.map_or(Ok(()), |item| self.apply(item))?;
                }
                while let Some(item) = self.feed.next(Duration::ZERO) {
                    self.apply(item)?;
                }
            }
            Pace::Lockstep { steps_per_keyframe } => {
                while !self.feed.ended() && self.is_keyframe_due() {
                    let Some(item) = self.wait_for_change() else { break };
                    let is_new = matches!(item.change, Change::Accepted(_));
                    self.apply(item)?;
                    if is_new && self.is_training() {
                        for (at, session) in self.next_keyframe_at.iter_mut().zip(&self.sessions) {
                            *at = session.progress().step + steps_per_keyframe;
                        }
                    }
                }
            }
        }
        if self.keyframes.len() != n_before {
            self.publish_keyframes();
            if self.keyframes.len() <= self.start_keyframes.max(HINT_KEYFRAMES)
                && let Some(hint) = scene_hint::from_keyframes(&self.keyframes)
            {
                self.hub.set_scene_hint(hint);
            }
        }
        Ok(())
    }

    /// Waits for the next added or removed keyframe. Returns `None` if a requested picture may be drawn now, or after
    /// [`IDLE`].
    fn wait_for_change(&mut self) -> Option<FeedItem> {
        if self.hub.n_clients() == 0 {
            return self.feed.next(IDLE);
        }
        let started = Instant::now();
        loop {
            let before = Instant::now();
            let timeout = if self.budget.may_render() { Duration::ZERO } else { POLL_PERIOD };
            if let Some(item) = self.feed.next(timeout) {
                return Some(item);
            }
            let is_requested = self.budget.may_render() && self.hub.wait_for_request(POLL_PERIOD);
            self.budget.add_training(before.elapsed()); // Training was idle, so drawing does not delay it.
            if started.elapsed() >= IDLE || is_requested {
                return None;
            }
        }
    }

    /// Trains for one slice once there are enough keyframes. During an evaluation, scores one test image instead. Does
    /// not train if a requested picture may be drawn now.
    fn step(&mut self) -> crate::Result<()> {
        self.sessions.iter().try_for_each(Session::check_gpu)?;
        if !self.is_training() {
            return Ok(());
        }
        if let Some(session) = self.sessions.iter_mut().find(|session| session.is_scoring()) {
            let before = Instant::now();
            session.score_next()?;
            self.budget.add_training(before.elapsed());
            return Ok(());
        }
        if self.is_paused {
            // Keyframes are still accepted, and checkpoints can be requested.
            self.sessions.iter_mut().try_for_each(Session::write_checkpoint_when_due)?;
        }
        if self.is_finished() || self.is_paused {
            self.hub.wait_for_request(IDLE);
            return Ok(());
        }
        if self.is_render_pending() {
            return Ok(());
        }
        let is_watched = self.hub.n_clients() > 0;
        self.sessions.iter_mut().for_each(|session| session.set_watched(is_watched));
        let is_paced = self.pace != Pace::RealTime && !self.feed.ended();
        let due = &self.next_keyframe_at;
        let max_steps = |ix: usize, session: &Session| match is_paced {
            true => due[ix].saturating_sub(session.progress().step),
            false => u64::MAX,
        };
        if self.pace == Pace::RealTime {
            self.sessions.iter_mut().try_for_each(Session::pause_growth_when_slow)?;
        }
        let before = Instant::now();
        let step_before = self.sessions[0].progress().step;
        let (hub, budget) = (&self.hub, self.budget);
        time_slices::train_next(&mut self.sessions, max_steps, || {
            budget.may_render() && hub.wait_for_request(Duration::ZERO)
        })?;
        self.budget.add_training(before.elapsed());
        // Steps before this slice are complete, because at most one submit is in flight.
        self.ledger.completed(step_before);
        Ok(())
    }

    /// Whether a picture is requested and may be drawn now.
    fn is_render_pending(&self) -> bool {
        self.budget.may_render() && self.hub.wait_for_request(Duration::ZERO)
    }

    /// Draws requested pictures as long as training keeps its share of the time.
    fn render(&mut self) -> crate::Result<()> {
        let started = Instant::now();
        if !self.is_training() || self.is_idle() || self.is_paused {
            self.budget.refill(); // Training is idle, so drawing does not delay it.
        }
        while started.elapsed() < MAX_RENDER_TIME
            && self.budget.may_render()
            && self.hub.wait_for_request(Duration::ZERO)
        {
            // Work queued before the pictures counts as training time.
            let before = Instant::now();
            for session in &mut self.sessions {
                session.n_total_steps()?;
            }
            self.budget.add_training(before.elapsed());
            let before = Instant::now();
            // The GPU draws the next pictures while the first ones are delivered.
            let mut queued = Vec::new();
            let mut is_any_on_gpu = false;
            while let Some(picture) = self.queue_picture() {
                let is_on_gpu = picture.queued.as_ref().is_ok_and(|queued| !queued.is_ready());
                is_any_on_gpu |= is_on_gpu;
                queued.push(picture);
                if !is_on_gpu || queued.len() == MAX_QUEUED_PICTURES {
                    break;
                }
            }
            let trained = if is_any_on_gpu { self.queue_steps() } else { Ok(()) };
            let mut began = before;
            for picture in queued {
                self.deliver(picture, began);
                began = Instant::now();
            }
            self.budget.add_render(before.elapsed());
            trained?;
        }
        Ok(())
    }

    /// Queues steps behind pictures, which keeps the GPU busy while the pictures are delivered. Only for a single model in
    /// real time, where this needs no other work.
    fn queue_steps(&mut self) -> crate::Result<()> {
        let is_training = self.is_training() && !self.is_idle() && !self.is_scoring() && !self.is_paused;
        let (Pace::RealTime, [session], true) = (self.pace, &mut self.sessions[..], is_training) else { return Ok(()) };
        if !session.is_over() {
            session.train_steps(u64::MAX)?;
        }
        Ok(())
    }

    /// Starts to draw the next requested picture. Requests that cannot be drawn are answered.
    fn queue_picture(&mut self) -> Option<QueuedRender> {
        loop {
            let mut pending = self.hub.next_request()?;
            if self.keyframes.is_empty() {
                pending.fail("no keyframe yet");
                continue;
            }
            let Some(session_ix) = session_for_method(&self.sessions, pending.method()) else {
                let reason = self.unknown_method(pending.method());
                pending.fail(&reason);
                continue;
            };
            let session = &mut self.sessions[session_ix];
            pending.request.edits = Arc::clone(session.edits());
            let queued = session.queue_picture(&pending.request, pending.packing());
            let trained_on = self.ledger.trained_keyframes(session_ix, session.progress().step);
            return Some(QueuedRender { pending: pending.of_keyframes(trained_on), session_ix, queued });
        }
    }

    /// Waits for a picture, whose rendering began at `began`, and sends it to its client.
    fn deliver(&mut self, QueuedRender { pending, session_ix, queued }: QueuedRender, began: Instant) {
        let pending = pending.began_at(began);
        let session = &mut self.sessions[session_ix];
        match queued.and_then(|queued| session.finish_picture(queued, &pending.request, pending.packing())) {
            Ok(picture) => pending.deliver(picture),
            Err(error) => pending.fail(&error.to_string()),
        }
    }

    /// Publishes the models that clients draw themselves. Pictures and chunks share one budget.
    fn publish_chunks(&mut self) {
        if !self.is_scoring() && self.budget.may_render() {
            for session in &mut self.sessions {
                self.budget.add_render(session.publish_chunks(&mut self.chunk_publisher));
            }
        }
    }

    /// Publishes when and how precisely each part of the scene was observed. Depth of cameras without depth is rendered with
    /// the first model.
    fn publish_observations(&mut self) {
        let can_render = self.is_training() && !self.is_scoring() && self.budget.may_render();
        if !can_render || !self.observation_publisher.is_due() {
            return;
        }
        let session = &mut self.sessions[0];
        let posed = |keyframe: &Arc<Keyframe>| {
            let camera = session.camera_of(keyframe);
            PosedKeyframe {
                pose: frustum(keyframe, &camera),
                keyframe: Some(Arc::clone(keyframe)),
                color_from_depth: camera.color_from_depth.unwrap_or_default(),
            }
        };
        let keyframes: Vec<PosedKeyframe> = self.keyframes.iter().map(posed).collect();
        let captured_at = |pose: &KeyframePose| {
            let mut newest_first = self.ledger.keyframes().iter().rev();
            let times = newest_first.find(|times| times.camera == pose.camera && times.stamp == pose.stamp)?;
            Some(times.captured_at())
        };
        let edits = Arc::clone(session.edits());
        let model = ModelState { step: session.progress().step, edits: &edits, captured_at: &captured_at };
        let render = |request: &RenderRequest| session.render(request);
        let spent = self.observation_publisher.publish(&keyframes, &model, render);
        self.budget.add_render(spent);
    }

    /// Publishes the status of the run to viewers, a few times per second.
    fn publish(&mut self) -> crate::Result<()> {
        if self.published.is_some_and(|published| published.elapsed() < PUBLISH_PERIOD) {
            return Ok(());
        }
        self.published = Some(Instant::now());
        let clock_secs = self.sessions[0].secs();
        if self.scoring_time.as_secs_f64() < SCORE_FRAC * clock_secs && !self.is_scoring() {
            let before = Instant::now();
            // Scores only one image at a time, so that viewers do not wait.
            self.next_refreshed = (self.next_refreshed + 1) % self.sessions.len();
            let session = &mut self.sessions[self.next_refreshed];
            if session.progress().step > 0 {
                session.n_total_steps()?;
                session.refresh_psnr()?;
                // No work is queued here, so reading the corrections does not delay training.
                session.refresh_corrections()?;
            }
            self.scoring_time += before.elapsed();
            self.budget.add_training(before.elapsed());
            self.publish_moved_keyframes();
        }
        self.publish_status();
        Ok(())
    }

    fn publish_status(&self) {
        let own_notes = [self.checkpoint_note.clone(), self.edit_note.clone(), self.editor.note()];
        let movements = self.sessions[0].alignment().map_or(&[][..], |alignment| &alignment.movements[..]);
        let mut models = self.sessions.iter().map(model_status);
        self.hub.set_status(Status {
            state: self.state().to_owned(),
            seconds: self.sessions[0].secs(),
            keyframes: self.keyframes.len() as u64,
            rejected: self.feed.rejected(),
            model: models.next().unwrap_or_default(),
            others: models.collect(),
            edit_revision: self.edit_revision,
            notes: [
                self.notes.clone(),
                self.device_notes.list(),
                movements.iter().map(ToString::to_string).collect(),
                own_notes.into_iter().flatten().collect(),
            ]
            .concat(),
            ..Status::default()
        });
    }

    /// Ends the input and a search for floaters. Returns the sessions and the results of the input.
    pub fn finish(mut self) -> (Vec<Session>, crate::Result<InputResult>) {
        // Changes only the state; the rest of the status stays visible until the scores are published.
        self.hub.set_state("saving");
        if self.erase_found(true) {
            self.publish_status();
            self.hub.set_state("saving");
        }
        (self.sessions, self.feed.finish().map_err(Into::into))
    }

    fn is_scoring(&self) -> bool {
        self.sessions.iter().any(Session::is_scoring)
    }

    fn is_training(&self) -> bool {
        self.can_train() && (self.keyframes.len() >= self.start_keyframes || self.feed.ended())
    }

    /// Whether there is a training keyframe. With several cameras, the first keyframe of each is a test keyframe.
    fn can_train(&self) -> bool {
        self.keyframes.iter().any(|keyframe| keyframe.split == Split::Train)
    }

    /// Whether no model can train before the next keyframe arrives.
    fn is_idle(&self) -> bool {
        self.sessions.iter().all(|session| session.is_idle() || session.has_finished_steps())
    }

    /// Whether each model has reached the step at which the next keyframe is due, or cannot train further without it.
    fn is_keyframe_due(&self) -> bool {
        let is_due = |(session, at): (&Session, &u64)| {
            session.progress().step >= *at || session.is_idle() || session.has_finished_steps()
        };
        self.sessions.iter().zip(&self.next_keyframe_at).all(is_due)
    }

    /// Whether the input ended and all training is done; the models stay visible until the user ends the run.
    fn is_finished(&self) -> bool {
        self.feed.ended() && self.is_idle()
    }

    fn state(&self) -> &'static str {
        if self.is_finished() {
            "finished"
        } else if self.is_paused {
            "paused"
        } else if self.is_training() {
            "training"
        } else if self.feed.first_image().is_some() {
            "collecting keyframes"
        } else {
            "waiting for images"
        }
    }

    fn apply(&mut self, FeedItem { change, times }: FeedItem) -> crate::Result<()> {
        match change {
            Change::Accepted(keyframe) => {
                let keyframe = match &mut self.keyframe_change {
                    Some(change) => change(keyframe),
                    None => keyframe,
                };
                let pushed_at_steps = self.sessions.iter().map(|session| session.progress().step).collect();
                self.keyframes.push(keyframe.clone());
                let mut pushed = Ok(());
                // A model that has made all its steps gets no more keyframes, so that it equals a model trained alone.
                for session in self.sessions.iter_mut().filter(|session| !session.has_finished_steps()) {
                    // Continues after a GPU failure, so that every session holds the keyframe for its restored model.
                    pushed = pushed.and(session.push(&keyframe));
                }
                if let Some(input) = times {
                    self.ledger.push(KeyframeTimes {
                        camera: keyframe.camera.clone(),
                        stamp: keyframe.stamp,
                        input,
                        pushed: Instant::now(),
                        pushed_at_steps,
                        trained: None,
                        sent: None,
                        shown: None,
                    });
                }
                pushed
            }
            Change::Evicted { camera, stamp } => {
                self.n_evicted += 1;
                self.keyframes.retain(|keyframe| keyframe.camera != camera || keyframe.stamp != stamp);
                let mut removed = Ok(());
                for session in self.sessions.iter_mut().filter(|session| !session.has_finished_steps()) {
                    removed = removed.and(session.remove(&camera, stamp));
                }
                removed
            }
        }
    }
}

/// A requested picture that the GPU may still be drawing.
struct QueuedRender {
    pending: PendingRender,
    session_ix: usize,
    queued: Result<QueuedPicture, trainer::Error>,
}

/// Options of a live run.
pub struct LiveOptions {
    /// When the models receive keyframes.
    pub pace: Pace,
    /// Number of keyframes with which training starts.
    pub start_keyframes: usize,
    /// Notes shown on the page.
    pub notes: Vec<String>,
    /// Notes about the devices, which are added during the run and shown, too.
    pub device_notes: Notes,
    /// Reopens the GPU after a failure.
    pub open_gpu: OpenGpu,
}

/// Index of the session of a method; of the first one if no method is given.
fn session_for_method(sessions: &[Session], method: Option<&str>) -> Option<usize> {
    sessions.iter().position(|session| method.is_none_or(|name| session.kind().name() == name))
}

fn model_status(session: &Session) -> ModelStatus {
    let progress = session.progress();
    ModelStatus {
        method: session.kind().name().to_owned(),
        step: progress.step,
        step_millis: (progress.step > 0).then_some(progress.step_millis),
        primitives: progress.primitives,
        primitives_label: session.kind().entry().primitives_label.to_owned(),
        bytes: progress.bytes,
        has_chunks: session.kind().entry().has_chunks,
        edits: session.edits().len(),
        psnr: session.psnr(),
        psnr_history: session.psnr_history().to_vec(),
    }
}

fn frustum(keyframe: &Keyframe, camera: &CalibratedCamera) -> KeyframePose {
    KeyframePose {
        camera: keyframe.camera.clone(),
        stamp: keyframe.stamp,
        world_from_camera: camera.world_from_camera,
        size_px: keyframe.size_px,
        focal_px: camera.focal_px,
        principal_px: camera.principal_px,
    }
}
