//! Connects the program that steers an arm with the arm's own thread.
//!
//! The program sends targets that expire, and reads the state of the arm. Neither side waits for
//! the other.

use super::follower::{Follower, brake_limits};
use super::generator::Setpoint;
use super::target::{ArmState, NotFollowed, Output, Target, TargetOrder};
use super::{MotionLimits, motion_error};
use crate::Error;
use kinematics::Stamp;
use parking_lot::Mutex;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// Enables a stopped arm again, see [`MovableArm::recover`](super::MovableArm::recover).
type Recover = Box<dyn Fn() -> Result<(), Error> + Send + Sync>;

/// Receives each setpoint, see [`SteeringPort::observe_setpoints`].
type SetpointObserver = Box<dyn Fn(Stamp, &Setpoint) + Send + Sync>;

/// Steers an arm from any thread. Clones refer to the same arm.
///
/// The port does not keep the arm: when the arm is dropped, it comes to rest, and the port has no
/// effect any more.
#[derive(Clone)]
pub struct SteeringPort(Arc<Shared>);

struct Shared {
    limits: Vec<MotionLimits>,
    brake_limits: Vec<MotionLimits>,
    brake_factor: f64,
    exchange: Mutex<Exchange>,
    recover: Recover,
    observer: OnceLock<SetpointObserver>,
}

#[derive(Default)]
struct Exchange {
    order: TargetOrder,
    orders: Orders,
    state: Option<ArmState>,
}

/// What the arm's thread has not taken yet.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Orders {
    /// Brake, and end all motions up to this number. This comes before the target.
    pub(super) brake_motion: Option<u64>,
    /// The newest target.
    pub(super) target: Option<Target>,
}

impl SteeringPort {
    /// The port of an arm.
    ///
    /// * `limits`: limits of motions, in the order of [`Arm::joint_names`](crate::Arm::joint_names).
    /// * `brake_factor`: acceleration and jerk of braking, as a factor of `limits`.
    /// * `recover`: enables a stopped arm again, and returns when it is enabled.
    ///
    /// # Errors
    /// If the factor is below 1 or not finite, or a limit is not positive and finite.
    pub fn new(
        limits: &[MotionLimits],
        brake_factor: f64,
        recover: impl Fn() -> Result<(), Error> + Send + Sync + 'static,
    ) -> Result<Self, Error> {
        // Written so that NaN is refused.
        let is_valid = brake_factor >= 1.0 && brake_factor.is_finite();
        if !is_valid {
            return Err(motion_error(format!(
                "the factor of braking is {brake_factor}, must be at least 1: the arm brakes at least as hard as it moves"
            )));
        }
        let brake_limits = brake_limits(limits, brake_factor);
        // Limits are checked here and not by the arm's thread, so that the caller gets the error.
        let period = Duration::from_millis(1);
        Follower::new(limits, &brake_limits, &position_in(limits), period)?;
        Ok(Self(Arc::new(Shared {
            limits: limits.to_vec(),
            brake_limits,
            brake_factor,
            exchange: Mutex::new(Exchange::default()),
            recover: Box::new(recover),
            observer: OnceLock::new(),
        })))
    }

    /// Sends the arm's thread what the arm should do. The newest target replaces the ones that the
    /// thread has not taken yet; a target that is not valid, repeated or overtaken is dropped. No
    /// target replaces the order to brake, which ends the motions of all targets before it.
    pub fn send(&self, output: &Output) {
        let mut exchange = self.0.exchange.lock();
        match output {
            Output::Follow(target) => {
                let dropped = exchange.take_target(target, self.0.limits.len());
                // The lock must not be held while a log is written.
                drop(exchange);
                if let Err(why) = dropped {
                    log::debug!("steering: {why}");
                }
            }
            Output::Brake => exchange.brake(),
        }
    }

    /// The newest state of the arm; `None` before its thread has reported one.
    pub fn state(&self) -> Option<ArmState> {
        self.0.exchange.lock().state.clone()
    }

    /// Limits of motions when the arm was switched to steering, in the order of
    /// [`Arm::joint_names`](crate::Arm::joint_names).
    pub fn limits(&self) -> &[MotionLimits] {
        &self.0.limits
    }

    /// Limits of braking, in the same order.
    pub fn brake_limits(&self) -> &[MotionLimits] {
        &self.0.brake_limits
    }

    /// Enables a stopped arm again, see [`MovableArm::recover`](super::MovableArm::recover). Call
    /// this only at the request of a person. It waits until the arm is enabled, for up to a minute.
    ///
    /// # Errors
    /// If the arm cannot be enabled, or does not exist any more.
    pub fn recover(&self) -> Result<(), Error> {
        (self.0.recover)()
    }

    /// Calls `observer` with each setpoint of a motion, in the thread of the arm. It must return
    /// quickly. Only the first observer of a port counts.
    pub fn observe_setpoints(&self, observer: impl Fn(Stamp, &Setpoint) + Send + Sync + 'static) {
        // A second observer is dropped.
        let _ = self.0.observer.set(Box::new(observer));
    }

    /// Passes a setpoint to the observer, if there is one.
    pub(super) fn note_setpoint(&self, now: Stamp, setpoint: &Setpoint) {
        if let Some(observer) = self.0.observer.get() {
            observer(now, setpoint);
        }
    }

    /// Acceleration and jerk of braking, as a factor of the limits of motions.
    pub(super) fn brake_factor(&self) -> f64 {
        self.0.brake_factor
    }

    /// Takes what was sent since the last call.
    pub(super) fn take_orders(&self) -> Orders {
        std::mem::take(&mut self.0.exchange.lock().orders)
    }

    /// Discards what was sent and not taken yet, and ends all motions of which a target was sent.
    /// Returns the number of the newest one.
    pub(super) fn end_motions(&self) -> u64 {
        let mut exchange = self.0.exchange.lock();
        exchange.brake();
        exchange.orders = Orders::default();
        exchange.order.motion
    }

    /// Whether a target waits to be taken.
    pub(super) fn has_target(&self) -> bool {
        self.0.exchange.lock().orders.target.is_some()
    }

    /// Whether a target waits to be taken, and has not expired.
    pub(super) fn has_fresh_target(&self, now: Stamp) -> bool {
        let exchange = self.0.exchange.lock();
        let target = exchange.orders.target.as_ref();
        target.is_some_and(|target| now <= target.expires_at)
    }

    /// Sets the state that the program sees.
    pub(super) fn report(&self, state: ArmState) {
        self.0.exchange.lock().state = Some(state);
    }
}

/// A position within all ranges, at 0 if possible.
pub(super) fn position_in(limits: &[MotionLimits]) -> Vec<f64> {
    let in_range = |joint: &MotionLimits| 0.0_f64.max(joint.position[0]).min(joint.position[1]);
    limits.iter().map(in_range).collect()
}

impl Exchange {
    fn take_target(&mut self, target: &Target, n_joints: usize) -> Result<(), NotFollowed> {
        self.order.check(target, n_joints)?;
        self.order.accept(target);
        self.orders.target = Some(target.clone());
        Ok(())
    }

    fn brake(&mut self) {
        self.order.end_motion(self.order.motion);
        self.orders = Orders {
            brake_motion: Some(self.order.motion),
            target: None,
        };
    }
}

impl std::fmt::Debug for SteeringPort {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SteeringPort")
            .field("limits", &self.0.limits)
            .field("brake_factor", &self.0.brake_factor)
            .finish_non_exhaustive()
    }
}
