//! One trial: an operator moves the arm, a fault happens, and the arm comes to rest.

use super::arms::Moved;
use super::braking::{Braking, braking};
use super::client::SteeringClient;
use super::faults::{Event, Fault, FaultyDevice};
use super::operator::{Hand, Operator};
use super::trace::{Excess, largest_excess};
use anyhow::Result;
use drivers::clock;
use kinematics::Stamp;
use nalgebra::Vector3;
use numbers::random::Random;
use serde_json::Value;
use std::time::{Duration, Instant};

/// Speed of the hand, m/s.
const HAND_M_S: f64 = 0.1;
/// Speed of a base, m/s.
const BASE_M_S: f64 = 0.25;
/// Speed of the joints above which the arm moves, rad/s. At the speed of the hand, it is two to
/// three times as fast.
const MOVING_RAD_S: f64 = 0.05;
/// Time for which the arm moves before the event, seconds. It is random, so that events do not
/// coincide with cycles.
const MOVING_SECS: [f64; 2] = [0.5, 0.8];
/// Time for which a fault lasts before the operator releases the switch.
const FAULT_TIME: Duration = Duration::from_secs(1);
/// Maximum time until the arm moves.
const MAX_START: Duration = Duration::from_secs(10);
/// Maximum time until the arm is at rest.
const MAX_BRAKE: Duration = Duration::from_secs(10);
/// How long the arm must be at rest until the trial ends.
const REST_TIME: Duration = Duration::from_millis(50);
/// Minimum time after the event until the trial ends: longer than the arm may take to brake after
/// the last message of a silent link.
const MIN_TIME: Duration = Duration::from_millis(300);
/// Time between two looks at the state of the arm.
const POLL: Duration = Duration::from_micros(500);
/// Distance of the tip from its first position above which the hand moves back, meters.
const MOVE_BACK_M: f64 = 0.02;

/// Result of a trial.
#[derive(Clone, Debug)]
pub(super) struct Outcome {
    /// The brake; `None` if the arm did not come to rest.
    pub(super) braking: Option<Braking>,
    /// The largest excess over a limit in any cycle of the trial.
    pub(super) excess: Option<Excess>,
    /// Why the arm stopped because the arm itself reported a fault, if it did.
    pub(super) stopped: Option<String>,
    /// How often the fault alone made the arm brake before the operator released the switch.
    pub(super) n_own_brakes: u32,
}

/// A trial of a fault.
pub(super) struct Trial<'a, 'rig> {
    operator: &'a mut Operator<'rig>,
    other: &'a SteeringClient,
    fault: Fault,
    /// Speed and direction of the hand.
    hand_m_s: Vector3<f64>,
    grip_began: Instant,
    /// The number that the arm reported at the start of the grip, see
    /// [`ArmState::braked_motion`](drivers::motion::ArmState::braked_motion).
    braked_before_grip: u64,
    last_sample: Option<Value>,
    n_own_brakes: u32,
}

/// Tries a fault. `None` if the arm stopped before the event, for example because this computer was
/// busy: the trial must then be repeated.
///
/// * `other`: another client, which does not steer.
///
/// # Errors
///
/// If the arm cannot be steered at all.
pub(super) fn run(
    operator: &mut Operator<'_>,
    other: &SteeringClient,
    fault: Fault,
    random: &mut Random,
) -> Result<Option<Outcome>> {
    operator.prepare()?;
    let hand_m_s = match operator.rig.robot.moved {
        Moved::Arm(_) => HAND_M_S * direction(operator.offset_from_home_m()?, random),
        Moved::Base(_) if random.unit() < 0.5 => BASE_M_S * Vector3::x(),
        Moved::Base(_) => -BASE_M_S * Vector3::x(),
    };
    let moving_secs = random.uniform(MOVING_SECS[0], MOVING_SECS[1]);
    operator.rig.robot.recorder.take();
    let mut trial = Trial {
        operator,
        other,
        fault,
        hand_m_s,
        grip_began: Instant::now(),
        braked_before_grip: 0,
        last_sample: None,
        n_own_brakes: 0,
    };
    let outcome = trial.run(Duration::from_secs_f64(moving_secs));
    // The fault ends also if the trial failed.
    let ended = fault.end(trial.operator, other);
    let outcome = outcome?;
    ended?;
    Ok(outcome)
}

/// An axis of the base, toward the first position of the tip if it is away from there.
fn direction(offset_from_home_m: Vector3<f64>, random: &mut Random) -> Vector3<f64> {
    let axis = random.below(3);
    let is_positive = if offset_from_home_m[axis].abs() > MOVE_BACK_M {
        offset_from_home_m[axis] < 0.0
    } else {
        random.unit() < 0.5
    };
    let mut direction = Vector3::zeros();
    direction[axis] = if is_positive { 1.0 } else { -1.0 };
    direction
}

impl Trial<'_, '_> {
    fn run(&mut self, moving_time: Duration) -> Result<Option<Outcome>> {
        self.begin_grip()?;
        self.fault.prepare(self.operator, self.other)?;
        if !self.move_for(moving_time)? {
            return Ok(None);
        }
        if self.fault.event() == Event::Release && !self.endure_fault(moving_time)? {
            return Ok(None);
        }
        let event_at = clock::now();
        let device = match self.fault.event() {
            Event::Fault => {
                self.fault.begin(self.operator, self.other)?;
                FaultyDevice::new(self.fault, self.last_sample.take())
            }
            Event::Release => {
                let open = self.operator.open_sample();
                self.operator.client.send(&open)?;
                FaultyDevice::new(Fault::Released, None)
            }
        };
        self.wait_for_rest(event_at, device).map(Some)
    }

    fn begin_grip(&mut self) -> Result<()> {
        self.operator.begin_grip()?;
        self.braked_before_grip = self.operator.arm()?.braked_motion;
        self.grip_began = Instant::now();
        Ok(())
    }

    /// The hand now.
    fn hand(&self) -> Hand {
        Hand {
            at_m: self.hand_m_s * self.grip_began.elapsed().as_secs_f64(),
            velocity_m_s: self.hand_m_s,
        }
    }

    /// Whether the arm follows the grip.
    fn is_following(&self) -> Result<bool> {
        let newest = self.operator.rig.robot.recorder.newest();
        let is_moving = newest.is_some_and(|sample| sample.speed() > MOVING_RAD_S);
        Ok(is_moving && !self.has_braked()?)
    }

    /// Whether the arm has braked since the start of the grip.
    fn has_braked(&self) -> Result<bool> {
        Ok(self.operator.arm()?.braked_motion != self.braked_before_grip)
    }

    /// Moves the hand until the arm has followed it for a time. Returns false if the arm does not
    /// follow.
    fn move_for(&mut self, time: Duration) -> Result<bool> {
        let until = Instant::now() + MAX_START;
        let mut following_since = None;
        while Instant::now() < until && !self.has_braked()? {
            self.operator.wait_for_sample();
            let intent = self.operator.intent(&self.hand());
            let sample = self.operator.closed_sample(&intent);
            self.operator.client.send(&sample)?;
            self.last_sample = Some(sample);
            if self.is_following()? {
                let since = *following_since.get_or_insert_with(Instant::now);
                if since.elapsed() >= time {
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }

    /// Begins a fault, and moves the hand while it lasts. If the arm brakes, the operator grips
    /// again. Returns false if the arm does not follow at the end.
    fn endure_fault(&mut self, moving_time: Duration) -> Result<bool> {
        self.fault.begin(self.operator, self.other)?;
        let mut device = FaultyDevice::new(self.fault, None);
        let until = Instant::now() + FAULT_TIME;
        while Instant::now() < until {
            self.operator.wait_for_sample();
            let hand = self.hand();
            device.send(self.operator, &hand)?;
            if self.has_braked()? {
                self.n_own_brakes += 1;
                self.operator.wait_for_rest()?;
                self.begin_grip()?;
                if !self.move_for(moving_time)? {
                    return Ok(false);
                }
            }
        }
        self.is_following()
    }

    fn wait_for_rest(&mut self, event_at: Stamp, mut device: FaultyDevice) -> Result<Outcome> {
        let began = Instant::now();
        let mut ended_at = None;
        let mut stopped = None;
        let mut rests_since = None;
        while began.elapsed() < MAX_BRAKE {
            if self.operator.is_sample_due() && !self.operator.client.is_closed() {
                let hand = self.hand();
                let sent = device.send(self.operator, &hand);
                if let Err(error) = sent {
                    // The server may end the connection because of the fault.
                    log::debug!("the connection of the operator ended: {error:#}");
                }
            }
            let state = self.operator.arm()?;
            if state.braked_motion != self.braked_before_grip {
                ended_at.get_or_insert(state.reported_at);
            }
            stopped = stopped.or(state.stopped);
            rests_since = match rests_since {
                _ if !state.is_at_rest => None,
                None => Some(Instant::now()),
                since => since,
            };
            let has_rested = rests_since.is_some_and(|since: Instant| since.elapsed() > REST_TIME);
            if has_rested && began.elapsed() > MIN_TIME {
                break;
            }
            std::thread::sleep(POLL);
        }
        Ok(self.outcome(event_at, ended_at, stopped))
    }

    fn outcome(
        &self,
        event_at: Stamp,
        ended_at: Option<Stamp>,
        stopped: Option<String>,
    ) -> Outcome {
        let robot = &self.operator.rig.robot;
        let samples = robot.recorder.take();
        let braking = braking(&samples, event_at, ended_at, &robot.brake_limits);
        Outcome {
            braking: braking.ok(),
            excess: largest_excess(&samples, &robot.checked_limits, robot.period),
            stopped,
            n_own_brakes: self.n_own_brakes,
        }
    }
}
