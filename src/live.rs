//! A model growing while keyframes come in and people look.

use crate::feed::{Change, Feed, Leftover};
use crate::scene_hint;
use crate::session::Session;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{Keyframe, Split};
use viz::{Hub, KeyframePose, Status};

/// The status is told this often.
const PUBLISH_EVERY: Duration = Duration::from_millis(250);
/// Where there is nothing to do, this long is waited for something.
const IDLE: Duration = Duration::from_millis(10);
/// Share of the time that goes into scores between the marks.
const SCORE_FRAC: f64 = 0.03;
/// A slice of training this short still leaves this much to the renders.
const LEAST_RENDER_TIME: Duration = Duration::from_millis(10);

/// What sets the pace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    /// The devices' clock: keyframes are taken as they come.
    RealTime,
    /// The trainer: a keyframe is taken every so many steps, so that a seed gives one result.
    Lockstep {
        /// Steps between two keyframes.
        steps_per_keyframe: u64,
    },
}

/// The moving parts of a run.
pub(crate) struct Live {
    pub(crate) session: Session,
    feed: Feed,
    hub: Hub,
    pace: Pace,
    method_name: &'static str,
    start_keyframes: usize,
    keyframes: Vec<Arc<Keyframe>>,
    /// Step at which the next keyframe is due in lockstep.
    next_keyframe_at: u64,
    trained: Duration,
    published: Option<Instant>,
    scoring: Duration,
    notes: Vec<String>,
}

impl Live {
    /// Puts the parts together; nothing happens yet.
    pub(crate) fn new(session: Session, feed: Feed, hub: Hub, options: LiveOptions) -> Self {
        Self {
            session,
            feed,
            hub,
            pace: options.pace,
            method_name: options.method_name,
            start_keyframes: options.start_keyframes,
            keyframes: Vec::new(),
            next_keyframe_at: 0,
            trained: Duration::ZERO,
            published: None,
            scoring: Duration::ZERO,
            notes: options.notes,
        }
    }

    /// Whether a limit was reached, the devices failed, or they ended and left nothing to train on.
    pub(crate) fn is_over(&self) -> bool {
        self.session.is_over() || self.feed.broke_off() || (self.feed.ended() && !self.can_train())
    }

    /// Keyframes held, in order of acceptance.
    pub(crate) fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.keyframes
    }

    /// Gives new keyframes to the model: all that wait in real time, the one that is due in lockstep.
    pub(crate) fn take_keyframes(&mut self) -> anyhow::Result<()> {
        if let Some(first_image) = self.feed.first_image() {
            self.session.start_clock(first_image);
        }
        let n_before = self.keyframes.len();
        match self.pace {
            Pace::RealTime => {
                let patience = if self.is_training() && !self.session.is_idle() { Duration::ZERO } else { IDLE };
                while let Some(change) = self.feed.next(patience) {
                    self.apply(change)?;
                }
            }
            Pace::Lockstep { steps_per_keyframe } => {
                let step = self.session.progress().step;
                while !self.feed.ended() && (step >= self.next_keyframe_at || self.session.is_idle()) {
                    let Some(change) = self.feed.next(IDLE) else { break };
                    let is_new = matches!(change, Change::Accepted(_));
                    self.apply(change)?;
                    if is_new && self.is_training() {
                        self.next_keyframe_at = step + steps_per_keyframe;
                    }
                }
            }
        }
        if self.keyframes.len() != n_before {
            self.hub.set_keyframes(self.keyframes.iter().map(|keyframe| frustum(keyframe)).collect());
            if self.keyframes.len() <= self.start_keyframes
                && let Some(hint) = scene_hint::from_keyframes(&self.keyframes)
            {
                self.hub.set_scene_hint(hint);
            }
        }
        Ok(())
    }

    /// Trains a slice, once there are keyframes enough.
    pub(crate) fn step(&mut self) -> anyhow::Result<()> {
        self.trained = Duration::ZERO;
        if !self.is_training() {
            return Ok(());
        }
        let n_most = match self.pace {
            Pace::RealTime => u64::MAX,
            Pace::Lockstep { .. } if self.feed.ended() => u64::MAX,
            Pace::Lockstep { .. } => self.next_keyframe_at.saturating_sub(self.session.progress().step),
        };
        if n_most == 0 {
            return Ok(());
        }
        if self.is_finished() {
            std::thread::sleep(IDLE);
            return Ok(());
        }
        let before = Instant::now();
        self.session.step(n_most)?;
        self.trained = before.elapsed();
        Ok(())
    }

    /// Draws what people asked for, for about as long as the last slice of training took.
    pub(crate) fn render(&mut self) {
        let before = Instant::now();
        let budget = self.trained.max(LEAST_RENDER_TIME);
        while before.elapsed() < budget {
            let Some(pending) = self.hub.next_request() else { break };
            if self.keyframes.is_empty() {
                pending.fail("nothing was seen yet");
                continue;
            }
            match self.session.render(&pending.request) {
                Ok(picture) => pending.deliver(picture),
                Err(error) => pending.fail(&error.to_string()),
            }
        }
    }

    /// Tells whoever looks where the run stands, a few times a second.
    pub(crate) fn publish(&mut self) -> anyhow::Result<()> {
        if self.published.is_some_and(|published| published.elapsed() < PUBLISH_EVERY) {
            return Ok(());
        }
        self.published = Some(Instant::now());
        let progress = self.session.progress();
        if progress.step > 0 && self.scoring.as_secs_f64() < SCORE_FRAC * self.session.secs() {
            let before = Instant::now();
            self.session.refresh_psnr()?;
            self.scoring += before.elapsed();
        }
        self.hub.set_status(Status {
            state: self.state().to_owned(),
            method: self.method_name.to_owned(),
            seconds: self.session.secs(),
            step: progress.step,
            step_millis: (progress.step > 0).then_some(progress.step_millis),
            primitives: progress.primitives,
            bytes: progress.bytes,
            keyframes: self.keyframes.len() as u64,
            refused: self.feed.refused(),
            psnr: self.session.psnr(),
            psnr_history: self.session.psnr_history().to_vec(),
            notes: self.notes.clone(),
        });
        Ok(())
    }

    /// Ends the input; the session and what is left of the input come back.
    pub(crate) fn finish(self) -> (Session, anyhow::Result<Leftover>) {
        self.hub.set_status(Status {
            state: "saving".to_owned(),
            method: self.method_name.to_owned(),
            ..Status::default()
        });
        (self.session, self.feed.finish())
    }

    fn is_training(&self) -> bool {
        self.can_train() && (self.keyframes.len() >= self.start_keyframes || self.feed.ended())
    }

    /// Several cameras begin with a test keyframe each: their number alone says nothing.
    fn can_train(&self) -> bool {
        self.keyframes.iter().any(|keyframe| keyframe.split == Split::Train)
    }

    /// Whether the model knows all there is to know; it is shown until somebody ends the run.
    fn is_finished(&self) -> bool {
        self.feed.ended() && self.session.is_idle()
    }

    fn state(&self) -> &'static str {
        if self.is_finished() {
            "finished"
        } else if self.is_training() {
            "training"
        } else if self.feed.first_image().is_some() {
            "collecting keyframes"
        } else {
            "waiting for images"
        }
    }

    fn apply(&mut self, change: Change) -> anyhow::Result<()> {
        match change {
            Change::Accepted(keyframe) => {
                self.session.push(&keyframe)?;
                self.keyframes.push(keyframe);
            }
            Change::Evicted { camera, stamp } => {
                self.session.remove(&camera, stamp)?;
                self.keyframes.retain(|keyframe| keyframe.camera != camera || keyframe.stamp != stamp);
            }
        }
        Ok(())
    }
}

/// How a run goes.
pub(crate) struct LiveOptions {
    /// What sets the pace.
    pub(crate) pace: Pace,
    /// Name of the scene model.
    pub(crate) method_name: &'static str,
    /// Keyframes with which training starts.
    pub(crate) start_keyframes: usize,
    /// Sentences for the page.
    pub(crate) notes: Vec<String>,
}

fn frustum(keyframe: &Keyframe) -> KeyframePose {
    KeyframePose {
        camera: keyframe.camera.clone(),
        world_from_camera: keyframe.world_from_camera,
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
    }
}
