//! Second link: the arm follows a device only while its dead-man switch is held.
//!
//! A grip moves the arm only if it was seen to begin: the device was heard with an open switch, or
//! with an earlier grip, while motion was permitted. Everything that stops the arm uses the grip
//! up.

use crate::reason::Reason;
use crate::request::{Command, Device, Intent};
use drivers::motion::exact;
use kinematics::{Stamp, Transform};
use serde::{Deserialize, Serialize};

/// How devices move the arm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClutchConfig {
    /// Silence of the device after which the arm brakes.
    pub max_silence_secs: f64,
    /// Greatest age of a command when it arrives.
    pub max_age_secs: f64,
    /// How far a stamp may be ahead, because the clock of the device is known only approximately.
    pub max_ahead_secs: f64,
    /// Greatest speed of a hand. A faster motion is a jump of the tracking.
    pub max_hand_m_s: f64,
    /// Greatest angular speed of a hand.
    pub max_hand_rad_s: f64,
    /// Motion of the tip divided by the motion of the hand.
    pub translation_scale: f64,
    /// Rotation of the tip divided by the rotation of the hand.
    pub rotation_scale: f64,
}

impl Default for ClutchConfig {
    fn default() -> Self {
        Self {
            // Pages send at 30 Hz or more, so three samples in a row are missing by then.
            max_silence_secs: 0.12,
            max_age_secs: 0.3,
            max_ahead_secs: 0.05,
            // People move their hands at 2 to 3 m/s when they throw.
            max_hand_m_s: 5.0,
            max_hand_rad_s: 30.0,
            translation_scale: 1.0,
            rotation_scale: 1.0,
        }
    }
}

/// Maximum number of devices that are remembered. The device that was silent for longest is
/// forgotten first; it is then treated like a new one, which must be seen with an open switch.
const MAX_DEVICES: usize = 8;

/// Two samples of a hand are treated as if this time was between them, if it was less. The stamps
/// of a browser are rounded to as much as a tenth of a millisecond, some to a millisecond.
const MIN_SAMPLE_SECS: f64 = 1e-3;

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Known {
    device: Device,
    newest_sequence: Option<u64>,
    /// The greatest grip that may not move the arm any more.
    used_up: Option<u64>,
    #[serde(with = "exact::stamp")]
    heard_at: Stamp,
}

/// A device with a closed switch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Held {
    pub(crate) device: Device,
    grip: u64,
    /// When the newest command arrived, however long it then waited for a decision.
    #[serde(with = "exact::stamp")]
    pub(crate) received_at: Stamp,
    #[serde(with = "exact::stamp")]
    captured_at: Stamp,
    pub(crate) intent: Intent,
    /// Hand and tip at the start of the grip; `None` until the arm is at rest.
    anchor: Option<Anchor>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Anchor {
    #[serde(with = "exact::pose")]
    base_from_hand: Transform,
    #[serde(with = "exact::pose")]
    base_from_tip: Transform,
}

/// The state of a clutch, for records.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ClutchState {
    known: Vec<Known>,
    held: Option<Held>,
}

/// Devices of the holder of the lease, and the one that moves the arm.
#[derive(Clone, Debug)]
pub(crate) struct Clutch {
    config: ClutchConfig,
    n_joints: usize,
    known: Vec<Known>,
    held: Option<Held>,
}

impl ClutchState {
    /// Number of joint values of the intent that is followed, if it has any.
    pub(crate) fn n_joints(&self) -> Option<usize> {
        self.held.as_ref()?.intent.n_joints()
    }
}

/// How a command changed the clutch.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Change {
    /// The switch is open, and it was before.
    Open,
    /// The switch was opened.
    Opened,
    /// The switch was closed: a new grip.
    Closed,
    /// The same grip with a newer intent.
    Updated,
}

impl Clutch {
    /// An open clutch that knows no device.
    pub(crate) fn new(config: ClutchConfig, n_joints: usize) -> Self {
        Self {
            config,
            n_joints,
            known: Vec::new(),
            held: None,
        }
    }

    /// The devices and the grip, for records.
    pub(crate) fn state(&self) -> ClutchState {
        ClutchState {
            known: self.known.clone(),
            held: self.held.clone(),
        }
    }

    /// Continues from a state.
    pub(crate) fn set_state(&mut self, state: ClutchState) {
        self.known = state.known;
        self.held = state.held;
    }

    /// The device that moves the arm.
    pub(crate) fn held(&self) -> Option<&Held> {
        self.held.as_ref()
    }

    /// Latest time at which the arm may still follow the newest command.
    pub(crate) fn deadline(&self) -> Option<Stamp> {
        let held = self.held.as_ref()?;
        Some(held.received_at.plus_secs(self.config.max_silence_secs))
    }

    /// Opens the clutch and uses the grip up.
    pub(crate) fn open(&mut self) {
        if let Some(held) = self.held.take() {
            self.use_up(held.device, held.grip);
        }
    }

    /// Opens the clutch and forgets all devices, because the operator changed.
    pub(crate) fn forget_devices(&mut self) {
        self.held = None;
        self.known.clear();
    }

    /// Opens the clutch if the device is silent.
    pub(crate) fn expire(&mut self, now: Stamp) -> Option<Reason> {
        let held = self.held.as_ref()?;
        let silent_secs = now.secs_since(held.received_at);
        if silent_secs <= self.config.max_silence_secs {
            return None;
        }
        let device = held.device;
        self.open();
        Some(Reason::DeviceSilent {
            device,
            silent_secs,
        })
    }

    /// Takes a command of the holder of the lease. With `may_move` false, all grips are used up.
    pub(crate) fn receive(
        &mut self,
        now: Stamp,
        command: &Command,
        may_move: bool,
    ) -> Result<Change, Reason> {
        let Some(grip) = command.grip else {
            return Ok(self.release(now, command));
        };
        let ix = self.known_ix(now, command);
        self.check(now, command, self.known[ix].newest_sequence)?;
        self.known[ix].newest_sequence = Some(command.sequence);
        self.known[ix].heard_at = command.received_by(now);
        if !may_move {
            self.use_up(command.device, grip);
        }
        let device = command.device;
        if self.known[ix].used_up.is_some_and(|used| grip <= used) {
            return Err(Reason::GripUsedUp { device, grip });
        }
        match &self.held {
            Some(held) if held.device != device => Err(Reason::AnotherDevice {
                device,
                active: held.device,
            }),
            Some(held) if held.grip == grip => self.update(now, command),
            Some(held) if held.grip > grip => Err(Reason::GripUsedUp { device, grip }),
            _ => {
                // A higher number than that of the grip that is held means that a release was lost.
                self.open();
                self.held = Some(Held {
                    device,
                    grip,
                    received_at: command.received_by(now),
                    captured_at: command.captured_at,
                    intent: command.intent.clone(),
                    anchor: None,
                });
                Ok(Change::Closed)
            }
        }
    }

    /// The goal pose of the tip, if the intent has one. The first call of a grip sets the anchor:
    /// there, the goal is the pose that the tip has.
    pub(crate) fn goal(&mut self, base_from_tip: &Transform) -> Option<Transform> {
        let ClutchConfig {
            translation_scale,
            rotation_scale,
            ..
        } = self.config;
        let held = self.held.as_mut()?;
        let pose = held.intent.pose()??;
        if matches!(held.intent, Intent::Pose { .. }) {
            return Some(pose);
        }
        let anchor = held.anchor.get_or_insert(Anchor {
            base_from_hand: pose,
            base_from_tip: *base_from_tip,
        });
        // Translation and rotation act separately, in axes of the base. The rigid motion of the
        // hand as a whole would swing the tip about the origin of the hand's frame.
        let translation = pose.translation.vector - anchor.base_from_hand.translation.vector;
        let rotation = pose.rotation * anchor.base_from_hand.rotation.inverse();
        let scaled =
            nalgebra::UnitQuaternion::from_scaled_axis(rotation.scaled_axis() * rotation_scale);
        Some(Transform::from_parts(
            (anchor.base_from_tip.translation.vector + translation * translation_scale).into(),
            scaled * anchor.base_from_tip.rotation,
        ))
    }

    /// A command with an open switch. It opens the clutch even if it is old, repeated or invalid.
    fn release(&mut self, now: Stamp, command: &Command) -> Change {
        let ix = self.known_ix(now, command);
        let known = &mut self.known[ix];
        known.heard_at = command.received_by(now);
        known.newest_sequence = known.newest_sequence.max(Some(command.sequence));
        if self
            .held
            .as_ref()
            .is_some_and(|held| held.device == command.device)
        {
            self.open();
            return Change::Opened;
        }
        Change::Open
    }

    /// Checks a command before it changes anything.
    fn check(&self, now: Stamp, command: &Command, newest: Option<u64>) -> Result<(), Reason> {
        let sequence = command.sequence;
        if let Some(newest) = newest.filter(|newest| sequence <= *newest) {
            return Err(Reason::OutOfOrder { sequence, newest });
        }
        let age_secs = now.secs_since(command.captured_at);
        let max_secs = self.config.max_age_secs;
        if age_secs > max_secs {
            return Err(Reason::Stale { age_secs, max_secs });
        }
        if -age_secs > self.config.max_ahead_secs {
            return Err(Reason::FromFuture {
                ahead_secs: -age_secs,
            });
        }
        let intent = &command.intent;
        let is_finite = intent.numbers().iter().all(|number| number.is_finite());
        if !is_finite || intent.pose().is_some_and(|pose| pose.is_none()) {
            let what = intent.kind().to_owned();
            return Err(Reason::NotFinite { what });
        }
        match intent.n_joints() {
            Some(got) if got != self.n_joints => Err(Reason::JointCount {
                got,
                expected: self.n_joints,
            }),
            _ => Ok(()),
        }
    }

    /// Takes a newer intent of the grip that is held.
    fn update(&mut self, now: Stamp, command: &Command) -> Result<Change, Reason> {
        let Some(held) = &mut self.held else {
            return Ok(Change::Open);
        };
        if held.intent.is_of_base() != command.intent.is_of_base() {
            // A person who moves one part must not move the other one unawares.
            self.open();
            return Err(Reason::OtherPart);
        }
        let secs = command
            .captured_at
            .secs_since(held.captured_at)
            .max(MIN_SAMPLE_SECS);
        let is_hand = |intent: &Intent| matches!(intent, Intent::Hand { .. });
        if is_hand(&held.intent) && is_hand(&command.intent) {
            let jump = jump(&held.intent, &command.intent, secs, &self.config);
            if let Some(reason) = jump {
                self.open();
                return Err(reason);
            }
        } else {
            // Another kind of intent starts where the tip is then.
            held.anchor = None;
        }
        held.intent = command.intent.clone();
        held.received_at = command.received_by(now).max(held.received_at);
        held.captured_at = command.captured_at;
        Ok(Change::Updated)
    }

    fn use_up(&mut self, device: Device, grip: u64) {
        for known in &mut self.known {
            if known.device == device {
                known.used_up = known.used_up.max(Some(grip));
            }
        }
    }

    /// Index of a device. A new device is added. If its switch is closed, nobody saw it close, so
    /// this grip is used up.
    fn known_ix(&mut self, now: Stamp, command: &Command) -> usize {
        let device = command.device;
        if let Some(ix) = self.known.iter().position(|known| known.device == device) {
            return ix;
        }
        if self.known.len() >= MAX_DEVICES {
            self.forget_longest_silent();
        }
        self.known.push(Known {
            device,
            newest_sequence: None,
            used_up: command.grip,
            heard_at: command.received_by(now),
        });
        self.known.len() - 1
    }

    fn forget_longest_silent(&mut self) {
        let active = self.held.as_ref().map(|held| held.device);
        let longest_silent = self
            .known
            .iter()
            .filter(|known| Some(known.device) != active)
            .min_by_key(|known| (known.heard_at, known.device))
            .map(|known| known.device);
        self.known
            .retain(|known| Some(known.device) != longest_silent);
    }
}

/// Whether the hand moved faster than a person can.
fn jump(before: &Intent, after: &Intent, secs: f64, config: &ClutchConfig) -> Option<Reason> {
    let (before, after) = (before.pose()??, after.pose()??);
    let distance_m = (after.translation.vector - before.translation.vector).norm();
    let angle_rad = before.rotation.angle_to(&after.rotation);
    let is_jump =
        distance_m > config.max_hand_m_s * secs || angle_rad > config.max_hand_rad_s * secs;
    is_jump.then_some(Reason::HandJumped {
        distance_m,
        angle_rad,
    })
}
