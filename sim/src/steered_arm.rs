//! The controller of a simulated arm that an operator steers.
//!
//! Until the operator begins, the arm moves on its tour. It then brakes, and follows the port of
//! the operator. Where the operator leaves it, it stays. The controller runs in real time on a
//! separate thread, so that the arm brakes in time, however long an image takes to render.

use crate::Error;
use crate::arm::STEP_NANOS;
use crate::handover::Handover;
use drivers::clock;
use drivers::motion::{MotionLimits, Setpoint, Steered, SteeringPort, TrajectoryGenerator};
use kinematics::Stamp;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Duration of a step.
const PERIOD: Duration = Duration::from_nanos(STEP_NANOS.unsigned_abs());
/// Time between two reports while the arm is on its tour.
const REPORT_PERIOD: Duration = Duration::from_millis(5);
/// Time in which the brake of the tour reaches its full deceleration, seconds. Tours are jerkier
/// than motions of operators.
const TOUR_BRAKE_JERK_SECS: f64 = 0.05;

/// A simulated arm that an operator steers. Clones refer to the same arm.
#[derive(Clone, Debug)]
pub struct SteeredArm {
    port: SteeringPort,
    requests: Arc<Requests>,
    n_contacts: Option<Arc<AtomicU64>>,
}

/// What the controller is asked for.
#[derive(Debug, Default)]
struct Requests {
    begin: AtomicBool,
    recover: AtomicBool,
}

impl SteeredArm {
    /// Steers the arm.
    pub fn port(&self) -> &SteeringPort {
        &self.port
    }

    /// Ends the tour: the arm brakes, and follows the port from then on.
    pub fn begin(&self) {
        self.requests.begin.store(true, Ordering::Relaxed);
    }

    /// How often a part of the robot has touched a part of the scene; `None` if it is not counted.
    pub fn n_contacts(&self) -> Option<u64> {
        let n_contacts = self.n_contacts.as_ref()?;
        Some(n_contacts.load(Ordering::Relaxed))
    }
}

/// The running controller. It ends when this value is dropped.
#[derive(Debug)]
pub(crate) struct Controller {
    handover: Handover,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Controller {
    fn drop(&mut self) {
        self.handover.finish();
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// Limits of motions in the order of the joint readings, and the acceleration and jerk of braking
/// as a factor of them.
#[derive(Clone, Copy, Debug)]
pub struct SteeredLimits<'a> {
    /// Limits of motions.
    pub motion: &'a [MotionLimits],
    /// Acceleration and jerk of braking as a factor of `motion`; at least 1.
    pub brake_factor: f64,
}

impl Controller {
    /// Starts the controller of an arm that is at `position`.
    ///
    /// * `started`: simulated time zero.
    /// * `n_contacts`: counted by the simulation, if it is.
    pub(crate) fn start(
        limits: SteeredLimits<'_>,
        position: &[f64],
        handover: Handover,
        started: Instant,
        n_contacts: Option<Arc<AtomicU64>>,
    ) -> Result<(Self, SteeredArm), Error> {
        let requests = Arc::<Requests>::default();
        let recover = {
            let requests = Arc::clone(&requests);
            move || {
                requests.recover.store(true, Ordering::Relaxed);
                Ok(())
            }
        };
        let failed = |error: drivers::Error| Error::Motion {
            reason: error.to_string(),
        };
        let port =
            SteeringPort::new(limits.motion, limits.brake_factor, recover).map_err(failed)?;
        let control = Control {
            steered: Steered::new(port.clone(), position, PERIOD).map_err(failed)?,
            phase: Phase::Tour,
            newest: at_rest(position),
            requests: Arc::clone(&requests),
        };
        let thread = std::thread::Builder::new()
            .name("sim-arm".to_owned())
            .spawn({
                let handover = handover.clone();
                move || {
                    run(control, &handover, started);
                    // The simulation must not wait for further setpoints.
                    handover.finish();
                }
            });
        let controller = Self {
            handover,
            thread: Some(thread.map_err(Error::Thread)?),
        };
        let arm = SteeredArm {
            port,
            requests,
            n_contacts,
        };
        Ok((controller, arm))
    }
}

/// Controls the arm in real time, until either side ends.
fn run(mut control: Control, handover: &Handover, started: Instant) {
    let Some((tour_end_step, motion)) = follow_tour(&mut control, handover) else {
        return;
    };
    control.end_tour(motion);
    let mut step = tour_end_step;
    while !handover.is_over() {
        step += 1;
        // The tour was simulated ahead of real time, so the first step may be a while away.
        let due = started + PERIOD.saturating_mul(u32::try_from(step).unwrap_or(u32::MAX));
        while let Some(left) = due.checked_duration_since(Instant::now()) {
            if left > REPORT_PERIOD {
                control.report(clock::now());
            }
            std::thread::sleep(left.min(REPORT_PERIOD));
        }
        handover.push(control.step(clock::now()));
    }
}

/// Reports the state of the arm on its tour, until the operator begins. Returns the end of the
/// tour; `None` if the simulation has ended.
fn follow_tour(control: &mut Control, handover: &Handover) -> Option<(i64, Setpoint)> {
    while !handover.is_over() {
        if let Some(motion) = handover.tour() {
            control.newest = motion;
        }
        control.report(clock::now());
        if control.requests.begin.load(Ordering::Relaxed)
            && let Some(end) = handover.end_tour()
        {
            return Some(end);
        }
        std::thread::sleep(REPORT_PERIOD);
    }
    None
}

/// Setpoints of the arm. It has no clock, so that tests can set the time.
struct Control {
    steered: Steered,
    phase: Phase,
    /// The newest setpoint.
    newest: Setpoint,
    requests: Arc<Requests>,
}

/// What determines the setpoints.
enum Phase {
    /// The tour.
    Tour,
    /// The brake at the end of the tour.
    TourBrake(Box<TrajectoryGenerator>),
    /// The port.
    Steered,
    /// Nothing: the arm rests for this reason.
    Stopped(String),
}

impl Control {
    /// Brakes from a motion of the tour.
    fn end_tour(&mut self, motion: Setpoint) {
        self.phase = match tour_brake(&motion, self.steered.port().brake_limits()) {
            Ok(brake) => Phase::TourBrake(Box::new(brake)),
            Err(reason) => Phase::Stopped(reason),
        };
        self.newest = motion;
    }

    /// The setpoint of the next step.
    fn step(&mut self, now: Stamp) -> Setpoint {
        if self.requests.recover.swap(false, Ordering::Relaxed)
            && matches!(self.phase, Phase::Stopped(_))
        {
            self.rest();
        }
        match &mut self.phase {
            Phase::Tour => {}
            Phase::TourBrake(brake) => match brake.step() {
                Ok(next) => {
                    let has_ended = brake.is_at_rest();
                    self.newest = next;
                    if has_ended {
                        self.rest();
                    }
                }
                Err(reason) => self.stop(reason),
            },
            Phase::Steered => match self.steered.step(now) {
                Ok(next) => self.newest = next,
                Err(error) => self.stop(error.to_string()),
            },
            Phase::Stopped(_) => {}
        }
        if !matches!(self.phase, Phase::Steered) {
            self.report(now);
        }
        self.newest.clone()
    }

    /// Reports a state that the port does not control.
    fn report(&mut self, now: Stamp) {
        match &self.phase {
            Phase::Stopped(reason) => self.steered.report_stopped(now, reason),
            Phase::Tour | Phase::TourBrake(_) => {
                self.steered.report_moving(now, &self.newest.position);
            }
            Phase::Steered => {}
        }
    }

    /// Follows the port from the position at which the arm rests.
    fn rest(&mut self) {
        let limits = self.steered.port().limits().to_vec();
        let position = self.newest.position.clone();
        self.newest = at_rest(&position);
        self.phase = match self.steered.rest_at(&limits, &position) {
            Ok(()) => Phase::Steered,
            Err(error) => Phase::Stopped(error.to_string()),
        };
    }

    /// Stops at once. Only a simulated arm can do this.
    fn stop(&mut self, reason: String) {
        self.newest = at_rest(&self.newest.position);
        self.phase = Phase::Stopped(reason);
    }
}

fn at_rest(position: &[f64]) -> Setpoint {
    let zero = vec![0.0; position.len()];
    Setpoint {
        position: position.to_vec(),
        velocity: zero.clone(),
        acceleration: zero,
    }
}

/// A generator that brings the arm to rest from its tour, which may be faster than the limits of
/// operators.
fn tour_brake(motion: &Setpoint, limits: &[MotionLimits]) -> Result<TrajectoryGenerator, String> {
    let limits: Vec<MotionLimits> = limits
        .iter()
        .enumerate()
        .map(|(ix, limits)| {
            let acceleration = limits.acceleration.max(motion.acceleration[ix].abs());
            MotionLimits {
                // A brake is the shortest way to rest, wherever it ends.
                position: [f64::NEG_INFINITY, f64::INFINITY],
                velocity: limits.velocity.max(motion.velocity[ix].abs()),
                acceleration,
                jerk: limits.jerk.max(acceleration / TOUR_BRAKE_JERK_SECS),
            }
        })
        .collect();
    let mut brake = TrajectoryGenerator::new(&limits, &motion.position, PERIOD)?;
    brake.resume(motion)?;
    brake.stop();
    Ok(brake)
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivers::motion::{Output, Target};

    const LIMITS: MotionLimits = MotionLimits {
        position: [-2.0, 2.0],
        velocity: 0.5,
        acceleration: 1.0,
        jerk: 10.0,
    };
    const BRAKE_FACTOR: f64 = 2.0;

    fn control() -> (Control, SteeringPort) {
        let port = SteeringPort::new(&[LIMITS], BRAKE_FACTOR, || Ok(())).expect("valid limits");
        let control = Control {
            steered: Steered::new(port.clone(), &[0.0], PERIOD).expect("in its range"),
            phase: Phase::Tour,
            newest: at_rest(&[0.0]),
            requests: Arc::default(),
        };
        (control, port)
    }

    fn after_steps(n_steps: i64) -> Stamp {
        Stamp(n_steps * STEP_NANOS)
    }

    fn target(serial: u64, position: f64, expires_at: Stamp) -> Output {
        Output::Follow(Target {
            motion: 1,
            serial,
            position: vec![position],
            expires_at,
        })
    }

    #[test]
    fn the_arm_brakes_its_tour_then_follows_the_port_and_brakes_when_targets_expire() {
        let (mut control, port) = control();
        control.newest.position = vec![0.3];
        control.report(after_steps(0));
        let on_tour = port.state().expect("a report");
        assert!(!on_tour.is_at_rest && on_tour.position == [0.3]);

        // The tour is faster than an operator may move the arm.
        control.end_tour(Setpoint {
            position: vec![0.3],
            velocity: vec![0.9],
            acceleration: vec![3.0],
        });
        let mut last = control.newest.clone();
        let mut step = 0;
        while !port.state().is_some_and(|state| state.is_at_rest) {
            step += 1;
            assert!(step < 5000, "it does not come to rest");
            let next = control.step(after_steps(step));
            let change = next.velocity[0] - last.velocity[0];
            assert!(change.abs() < 0.005, "{change} in a step");
            last = next;
        }
        let rest = last.position[0];
        assert!(rest > 0.3 && rest < 1.5, "{rest}");

        // It follows a target, which expires before the arm arrives.
        port.send(&target(1, rest - 0.5, after_steps(step + 300)));
        for _ in 0..300 {
            step += 1;
            last = control.step(after_steps(step));
        }
        assert!(last.velocity[0] < -0.05, "{last:?}");
        for _ in 0..1000 {
            step += 1;
            last = control.step(after_steps(step));
        }
        let state = port.state().expect("a report");
        assert!(state.is_at_rest && state.braked_motion == 1, "{state:?}");
        assert!(
            last.position[0] > rest - 0.4,
            "it braked on the way: {last:?}"
        );
    }

    #[test]
    fn an_arm_beyond_its_range_is_stopped_with_a_reason() {
        let (mut control, port) = control();
        control.end_tour(at_rest(&[2.5]));
        for step in 0..100 {
            control.step(after_steps(step));
        }
        let stopped = port.state().and_then(|state| state.stopped);
        let reason = stopped.expect("outside its range");
        assert!(reason.contains("outside its range"), "{reason}");
    }
}
