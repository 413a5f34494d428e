//! Publishes keyframes, models and the status of a run to viewers.

use super::LiveLoop;
use super::keyframe_intake::KeyframeIntake;
use super::requests::Requests;
use crate::advice::{Advisor, Situation};
use crate::chunk_publisher::ChunkPublisher;
use crate::ledger::Ledger;
use crate::observations::{ModelState, ObservationPublisher, PosedKeyframe};
use crate::recent_images::RecentImages;
use crate::run_state::RunState;
use crate::session::Session;
use calibration::CalibratedCamera;
use capture::Notes;
use keyframe::Keyframe;
use kinematics::Transform;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::RenderRequest;
use viz::{Hub, Identity, KeyframePose, ModelStatus, OperatorStatus, Status};

/// Period of status messages. With a shorter period, the numbers of the page would be harder to
/// read, and more data would be sent. With a longer period, the results of controls and edits would
/// appear later.
const PUBLISH_PERIOD: Duration = Duration::from_millis(250);
/// Maximum fraction of the time that is spent on scoring between scheduled evaluations. Scoring
/// adds points to the PSNR curve, but takes training time.
const SCORE_FRAC: f64 = 0.03;

/// What was published, and what to publish next.
pub(super) struct Publishing {
    hub: Hub,
    identity: Identity,
    started: Instant,
    recent_images: RecentImages,
    advisor: Advisor,
    /// When the status was published; `None` before the first time.
    status_at: Option<Instant>,
    /// Corrected cameras of the published keyframes.
    cameras: Vec<CalibratedCamera>,
    /// Session whose latest score is refreshed next.
    next_refreshed: usize,
    scoring_time: Duration,
    /// Notes on the run.
    notes: Vec<String>,
    device_notes: Notes,
    chunks: ChunkPublisher,
    observations: ObservationPublisher,
}

impl Publishing {
    pub(super) fn new(
        hub: Hub,
        identity: Identity,
        notes: Vec<String>,
        device_notes: Notes,
    ) -> Self {
        Self {
            identity,
            started: Instant::now(),
            recent_images: RecentImages::default(),
            advisor: Advisor::default(),
            status_at: None,
            cameras: Vec::new(),
            next_refreshed: 0,
            scoring_time: Duration::ZERO,
            notes,
            device_notes,
            chunks: ChunkPublisher::new(hub.clone()),
            observations: ObservationPublisher::new(hub.clone()),
            hub,
        }
    }

    /// Takes the publisher of chunks, which is also needed while the run ends.
    pub(super) fn take_chunks(&mut self) -> ChunkPublisher {
        std::mem::replace(&mut self.chunks, ChunkPublisher::new(self.hub.clone()))
    }

    /// Publishes the keyframes and the corrections of live images, as estimated by the first model.
    pub(super) fn publish_keyframes(&mut self, keyframes: &[Arc<Keyframe>], session: &Session) {
        let cameras: Vec<_> = keyframes
            .iter()
            .map(|keyframe| session.camera_of(keyframe))
            .collect();
        let posed = || keyframes.iter().zip(&cameras);
        // The keyframes are in order of arrival, and the last value of a key remains in the map.
        // Live images therefore get the correction of their camera's newest keyframe.
        self.hub.set_camera_corrections(
            posed()
                .map(|(keyframe, camera)| camera_correction(keyframe, camera))
                .collect(),
        );
        self.hub.keyframes().set_sources(keyframes);
        self.hub.keyframes().set(
            posed()
                .map(|(keyframe, camera)| frustum(keyframe, camera))
                .collect(),
        );
        self.cameras = cameras;
    }

    /// Publishes the keyframes again if corrections have moved one of them noticeably.
    fn publish_moved_keyframes(&mut self, keyframes: &[Arc<Keyframe>], session: &Session) {
        let has_moved = keyframes
            .iter()
            .zip(&self.cameras)
            .any(|(keyframe, published)| session.camera_of(keyframe).differs_noticeably(published));
        if has_moved {
            self.publish_keyframes(keyframes, session);
        }
    }

    /// Publishes when and how precisely each part of the scene was observed, if this map is due.
    /// Depth of cameras without depth is rendered with the first model. Returns the time spent.
    fn publish_observations(
        &mut self,
        keyframes: &[Arc<Keyframe>],
        session: &mut Session,
        ledger: &Ledger,
    ) -> Duration {
        if !self.observations.is_due() {
            return Duration::ZERO;
        }
        let keyframes: Vec<PosedKeyframe> = keyframes
            .iter()
            .map(|keyframe| posed_keyframe(session, keyframe))
            .collect();
        let captured_at = |pose: &KeyframePose| captured_at(ledger, pose);
        let edits = Arc::clone(session.edits());
        let model = ModelState {
            step: session.progress().step,
            edits: &edits,
            captured_at: &captured_at,
        };
        let render = |request: &RenderRequest| session.viewed().render(request);
        self.observations.publish(&keyframes, &model, render)
    }

    /// What the operator's header shows.
    fn operator_status(
        &mut self,
        state: RunState,
        intake: &KeyframeIntake,
        requests: &Requests,
    ) -> OperatorStatus {
        // After the end of the input, a run can be finished although training is still paused.
        let paused_by = requests.paused_by.filter(|_| state == RunState::Paused);
        let counts = intake.counts();
        let situation = Situation {
            state,
            has_input_ended: intake.feed.source_ended(),
            run_secs: self.started.elapsed().as_secs_f64(),
            recent: self.recent_images.push(Instant::now(), counts.flow),
            store: counts.store,
            start_keyframes: intake.start_keyframes,
            paused_by,
        };
        OperatorStatus {
            identity: Some(self.identity.clone()),
            advice: Some(self.advisor.advise(&situation)),
            input_ended: situation.has_input_ended,
            images: Some(counts.images),
            store: Some(counts.shown_store),
            paused_by,
            checkpoint: requests.checkpoint(),
            infos: requests.infos().collect(),
            ..OperatorStatus::default()
        }
    }
}

impl LiveLoop {
    /// Publishes the models that clients draw themselves, and the observations of the scene.
    /// Pictures, chunks and observations share one budget.
    pub(super) fn publish_models(&mut self) {
        if self.budget.may_render() {
            for session in &mut self.models.sessions {
                self.budget
                    .add_render(session.viewed().publish_chunks(&mut self.publishing.chunks));
            }
        }
        let is_idle = !self.intake.has_enough() || self.models.is_scoring();
        if !is_idle && self.budget.may_render() {
            let session = &mut self.models.sessions[0];
            let spent = self.publishing.publish_observations(
                &self.intake.accepted.list,
                session,
                &self.ledger,
            );
            self.budget.add_render(spent);
        }
    }

    /// Publishes the status of the run to viewers, a few times per second.
    pub(super) fn publish(&mut self) -> anyhow::Result<()> {
        // After an edit, viewers wait for the new status.
        let has_edited = std::mem::take(&mut self.requests.has_edited);
        let published = self.publishing.status_at;
        if !has_edited && published.is_some_and(|at| at.elapsed() < PUBLISH_PERIOD) {
            return Ok(());
        }
        self.publishing.status_at = Some(Instant::now());
        let clock_secs = self.models.sessions[0].time().secs();
        if self.publishing.scoring_time.as_secs_f64() < SCORE_FRAC * clock_secs
            && !self.models.is_scoring()
        {
            let before = Instant::now();
            // Scores only one image at a time, so that viewers do not wait. The models take turns.
            self.publishing.next_refreshed =
                (self.publishing.next_refreshed + 1) % self.models.sessions.len();
            let session = &mut self.models.sessions[self.publishing.next_refreshed];
            // A model without steps has no score yet, and drawing it would create its splats.
            if session.progress().step > 0 {
                session.n_total_steps()?;
                session.refresh_psnr()?;
                // No work is queued here, so reading the corrections does not delay training.
                session.refresh_corrections()?;
            }
            self.publishing.scoring_time += before.elapsed();
            self.budget.add_training(before.elapsed());
            self.publishing
                .publish_moved_keyframes(&self.intake.accepted.list, &self.models.sessions[0]);
        }
        self.publish_status();
        Ok(())
    }

    pub(super) fn publish_status(&mut self) {
        let rejected = self.intake.rejected();
        for session in &mut self.models.sessions {
            session.persistence().set_rejected(&rejected);
        }
        self.requests.update_checkpoint(&mut self.models);
        let state = self.state();
        let operator = self
            .publishing
            .operator_status(state, &self.intake, &self.requests);
        let sessions = &self.models.sessions;
        let movements = sessions[0]
            .alignment()
            .map_or(&[][..], |alignment| &alignment.movements[..]);
        let mut models = sessions.iter().map(model_status);
        self.hub.set_status(Status {
            state: state.name().to_owned(),
            progress: self.state_progress(),
            seconds: sessions[0].time().secs(),
            keyframes: self.intake.accepted.list.len() as u64,
            rejected,
            model: models.next().unwrap_or_default(),
            others: models.collect(),
            edit_revision: self.requests.edit_revision,
            last_edit: self.requests.last_edit.clone(),
            notes: (self.publishing.notes.iter().cloned())
                .chain(self.publishing.device_notes.list())
                .chain(movements.iter().map(ToString::to_string))
                .chain(self.requests.warnings())
                .chain(operator.infos.iter().cloned())
                .collect(),
            operator,
            ..Status::default()
        });
    }
}

/// Name of a keyframe's camera, and the correction of its pose: the corrected camera in the frame
/// of the reported one.
fn camera_correction(keyframe: &Keyframe, camera: &CalibratedCamera) -> (Arc<str>, Transform) {
    (
        keyframe.camera.clone(),
        keyframe.world_from_camera.inverse() * camera.world_from_camera,
    )
}

/// A keyframe with the corrections of a model.
fn posed_keyframe(session: &Session, keyframe: &Arc<Keyframe>) -> PosedKeyframe {
    let camera = session.camera_of(keyframe);
    PosedKeyframe {
        pose: frustum(keyframe, &camera),
        keyframe: Some(Arc::clone(keyframe)),
        color_from_depth: camera.color_from_depth.unwrap_or_default(),
    }
}

/// When the image of a keyframe was captured; `None` for keyframes of an earlier run.
fn captured_at(ledger: &Ledger, pose: &KeyframePose) -> Option<Instant> {
    // Callers usually ask for the newest keyframe, so the search begins at the end.
    let mut newest_first = ledger.keyframes().iter().rev();
    let times =
        newest_first.find(|times| times.camera == pose.camera && times.stamp == pose.stamp)?;
    Some(times.captured_at())
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
        psnr: session.scoreboard().psnr(),
        psnr_history: session.scoreboard().psnr_history().to_vec(),
        ..ModelStatus::default()
    }
    .with_edits(session.edits(), &Transform::identity())
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
