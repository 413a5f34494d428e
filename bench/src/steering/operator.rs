//! An operator who moves the arm or base through a client of `/steer`, as a page does.

use super::arms::{ArmKind, Moved};
use super::client::SteeringClient;
use super::rig::SteeredRig;
use anyhow::{Context, Result, bail};
use drivers::motion::ArmState;
use nalgebra::Vector3;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// Time between two samples of a device: 90 Hz, as a headset.
pub(super) const SAMPLE_PERIOD: Duration = Duration::from_micros(11_111);
/// Number of samples with an open switch before a grip, so that the server sees it begin.
const N_OPEN_SAMPLES: usize = 3;
/// Number of samples for which the hand holds still at the start of a grip.
const N_STILL_SAMPLES: usize = 5;
/// Maximum time until the arm is at rest, or the operator has control. A lease ends after five
/// seconds.
const MAX_WAIT: Duration = Duration::from_secs(60);
/// Time between two tries.
const RETRY: Duration = Duration::from_millis(50);
/// Distance from its first posture up to which the tip need not be brought back, meters.
const NEAR_HOME_M: f64 = 0.1;
/// Distance from its first posture at which the arm has returned, in the unit of the joints.
const HOME_JOINTS: f64 = 0.02;

/// An operator with a connected client.
pub(super) struct Operator<'rig> {
    pub(super) rig: &'rig SteeredRig,
    pub(super) client: SteeringClient,
    /// Number of the newest grip.
    grip: u64,
    /// First position of the tip; zero for a base, which may be anywhere.
    home_m: Vector3<f64>,
    next_sample_at: Instant,
}

impl<'rig> Operator<'rig> {
    /// Connects. The arm is at its first posture.
    ///
    /// # Errors
    ///
    /// If the server does not accept the client.
    pub(super) fn connect(rig: &'rig SteeredRig) -> Result<Self> {
        let home_m = match &rig.robot.moved {
            Moved::Arm(arm) => arm.chain.forward(&arm.start)?.translation.vector,
            Moved::Base(_) => Vector3::zeros(),
        };
        Ok(Self {
            rig,
            client: rig.connect()?,
            grip: 0,
            home_m,
            next_sample_at: Instant::now(),
        })
    }

    /// Gets control of an arm that is at rest near its first posture, and may move.
    ///
    /// # Errors
    ///
    /// If this does not succeed within a minute.
    pub(super) fn prepare(&mut self) -> Result<()> {
        self.take_control()?;
        self.wait_for_rest()?;
        if self.offset_from_home_m()?.norm() > NEAR_HOME_M {
            self.return_home()?;
            self.wait_for_rest()?;
        }
        self.client.forget();
        Ok(())
    }

    /// From the first position of the tip to the current one, meters.
    pub(super) fn offset_from_home_m(&self) -> Result<Vector3<f64>> {
        Ok(self.tip_m()? - self.home_m)
    }

    /// Position of the tip, meters; zero for a base.
    pub(super) fn tip_m(&self) -> Result<Vector3<f64>> {
        match &self.rig.robot.moved {
            Moved::Arm(arm) => {
                let pose = arm.chain.forward(&self.arm()?.position)?;
                Ok(pose.translation.vector)
            }
            Moved::Base(_) => Ok(Vector3::zeros()),
        }
    }

    /// The intent that moves the arm as the hand moves, or the base with its velocity.
    pub(super) fn intent(&self, hand: &Hand) -> Value {
        intent_of(self.rig.robot.kind, hand)
    }

    /// The newest state that the arm's thread reported.
    pub(super) fn arm(&self) -> Result<ArmState> {
        let state = self.rig.robot.state();
        state.context("the robot has reported no state")
    }

    /// Waits until the next sample is due.
    pub(super) fn wait_for_sample(&mut self) {
        let now = Instant::now();
        std::thread::sleep(self.next_sample_at.saturating_duration_since(now));
        self.schedule_sample();
    }

    /// Whether the next sample is due. If it is, the one after it is scheduled.
    pub(super) fn is_sample_due(&mut self) -> bool {
        let is_due = Instant::now() >= self.next_sample_at;
        if is_due {
            self.schedule_sample();
        }
        is_due
    }

    /// A page that was held up does not send the samples that it missed.
    fn schedule_sample(&mut self) {
        self.next_sample_at = (self.next_sample_at + SAMPLE_PERIOD).max(Instant::now());
    }

    /// A sample with an open switch.
    pub(super) fn open_sample(&mut self) -> Value {
        self.client.command(None, &Value::Null)
    }

    /// A sample with a closed switch.
    pub(super) fn closed_sample(&mut self, intent: &Value) -> Value {
        self.client.command(Some(self.grip), intent)
    }

    /// Opens the switch, closes it, and holds the hand still until the arm has seen it.
    ///
    /// # Errors
    ///
    /// If the connection has ended.
    pub(super) fn begin_grip(&mut self) -> Result<()> {
        for _ in 0..N_OPEN_SAMPLES {
            self.wait_for_sample();
            let sample = self.open_sample();
            self.client.send(&sample)?;
        }
        self.grip += 1;
        for _ in 0..N_STILL_SAMPLES {
            self.wait_for_sample();
            let intent = self.intent(&Hand::AT_REST);
            let sample = self.closed_sample(&intent);
            self.client.send(&sample)?;
        }
        Ok(())
    }

    /// Waits until the arm is at rest.
    ///
    /// # Errors
    ///
    /// If it is not within a minute.
    pub(super) fn wait_for_rest(&self) -> Result<()> {
        let until = Instant::now() + MAX_WAIT;
        while !self.arm()?.is_at_rest {
            if Instant::now() > until {
                bail!("the arm is not at rest within {} s", MAX_WAIT.as_secs());
            }
            std::thread::sleep(RETRY);
        }
        Ok(())
    }

    /// Connects if necessary, takes the lease, and permits motion after a stop.
    fn take_control(&mut self) -> Result<()> {
        let until = Instant::now() + MAX_WAIT;
        loop {
            if self.client.is_closed() {
                self.client = self.rig.connect()?;
            }
            let state = self.client.state();
            let holds_lease = state
                .as_ref()
                .is_some_and(|state| state.holder == Some(self.client.number()));
            let sent = match state {
                Some(state) if holds_lease => match state.stop_number {
                    None => return Ok(()),
                    Some(number) => self.client.rearm(number),
                },
                _ => self.client.lease("take"),
            };
            if let Err(error) = sent {
                // The operator then connects again.
                log::debug!("the connection of the operator ended: {error:#}");
            }
            if Instant::now() > until {
                bail!(
                    "the operator did not get control of the arm within {} s; refused: {:?}",
                    MAX_WAIT.as_secs(),
                    self.client.refusals()
                );
            }
            std::thread::sleep(RETRY);
        }
    }

    /// Moves the arm to its first posture.
    fn return_home(&mut self) -> Result<()> {
        let until = Instant::now() + MAX_WAIT;
        let home = self.rig.robot.arm()?.start.clone();
        let intent = json!({ "kind": "joints", "position": home });
        self.begin_grip()?;
        loop {
            let position = self.arm()?.position;
            let joints = position.iter().zip(&home);
            if joints
                .map(|(at, home)| (at - home).abs())
                .fold(0.0, f64::max)
                < HOME_JOINTS
            {
                break;
            }
            if Instant::now() > until {
                bail!(
                    "the arm does not return to its first posture within {} s; refused: {:?}",
                    MAX_WAIT.as_secs(),
                    self.client.refusals()
                );
            }
            if !self.client.refusals().is_empty() || self.client.is_closed() {
                // On a busy computer, the arm has braked, and the grip or the control has ended.
                self.client.forget();
                self.take_control()?;
                self.begin_grip()?;
            }
            self.wait_for_sample();
            let sample = self.closed_sample(&intent);
            self.client.send(&sample)?;
        }
        let open = self.open_sample();
        self.client.send(&open)
    }
}

/// The hand of an operator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hand {
    /// Where it is, relative to the start of its grip.
    pub(super) at_m: Vector3<f64>,
    pub(super) velocity_m_s: Vector3<f64>,
}

impl Hand {
    pub(super) const AT_REST: Self = Self {
        at_m: Vector3::new(0.0, 0.0, 0.0),
        velocity_m_s: Vector3::new(0.0, 0.0, 0.0),
    };
}

/// The intent that moves an arm as the hand moves, or a base with its velocity.
pub(super) fn intent_of(kind: ArmKind, hand: &Hand) -> Value {
    if kind.is_base() {
        velocity_of_base(hand.velocity_m_s)
    } else {
        hand_at(hand.at_m)
    }
}

/// The intent to move the base at a velocity, forward and left.
fn velocity_of_base(velocity_m_s: Vector3<f64>) -> Value {
    json!({
        "kind": "base_velocity",
        "forward_m_s": velocity_m_s.x,
        "left_m_s": velocity_m_s.y,
        "yaw_rad_s": 0.0,
    })
}

/// The intent to move the tip as the hand, which is at a position.
pub(super) fn hand_at(position_m: Vector3<f64>) -> Value {
    let [x, y, z]: [f64; 3] = position_m.into();
    json!({ "kind": "hand", "base_from_hand": [x, y, z, 0.0, 0.0, 0.0, 1.0] })
}
