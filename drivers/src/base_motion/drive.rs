//! The thread of a base.

use super::limits::base_error;
use super::{BaseFollower, BaseLimits, BasePort, BaseReport, BaseState, BaseVelocity, MovableBase};
use crate::{Error, clock};
use kinematics::Stamp;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Period of the velocities: 50 Hz, as most controllers of bases expect.
const PERIOD: Duration = Duration::from_millis(20);
/// Maximum time at the end to wait for the base to confirm that it stands still.
const MAX_STOP: Duration = Duration::from_secs(3);

/// A base that is driven on a separate thread. Dropping this value lets the base brake, and waits
/// until it stands still, for three seconds at most.
#[derive(Debug)]
pub struct BaseDrive {
    port: BasePort,
    must_end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl BaseDrive {
    /// Starts the thread of a base.
    ///
    /// # Errors
    /// If the limits are not valid, or no thread can be started.
    pub fn start(base: Box<dyn MovableBase>, limits: BaseLimits) -> Result<Self, Error> {
        let cycle = DriveCycle::new(base, limits)?;
        let port = cycle.port.clone();
        let must_end = Arc::new(AtomicBool::new(false));
        let thread = std::thread::Builder::new()
            .name("base".to_owned())
            .spawn({
                let must_end = Arc::clone(&must_end);
                move || run(cycle, &must_end)
            })
            .map_err(|error| base_error(format!("no thread can be started: {error}")))?;
        Ok(Self {
            port,
            must_end,
            thread: Some(thread),
        })
    }

    /// Steers the base.
    #[must_use]
    pub fn port(&self) -> &BasePort {
        &self.port
    }
}

impl Drop for BaseDrive {
    fn drop(&mut self) {
        self.must_end.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

fn run(mut cycle: DriveCycle, must_end: &AtomicBool) {
    let mut due = Instant::now();
    let mut step = |cycle: &mut DriveCycle| {
        cycle.step(clock::now());
        due += PERIOD;
        let now = Instant::now();
        // After a pause of the computer, the missed cycles are skipped.
        due = due.max(now);
        std::thread::sleep(due - now);
    };
    while !must_end.load(Ordering::Relaxed) {
        step(&mut cycle);
    }
    let until = Instant::now() + MAX_STOP;
    while !cycle.brake_for_end() && Instant::now() < until {
        step(&mut cycle);
    }
    if !cycle.brake_for_end() {
        log::warn!(
            "the base has not confirmed that it stands still: its controller must stop it, because \
             it receives no more commands"
        );
    }
}

/// One cycle of the thread. It has no clock, so that tests can set the time.
pub(super) struct DriveCycle {
    base: Box<dyn MovableBase>,
    follower: BaseFollower,
    pub(super) port: BasePort,
    report: BaseReport,
    /// Why the base cannot be reached.
    unreachable: Option<String>,
}

impl DriveCycle {
    pub(super) fn new(base: Box<dyn MovableBase>, limits: BaseLimits) -> Result<Self, Error> {
        Ok(Self {
            base,
            follower: BaseFollower::new(limits)?,
            port: BasePort::new(limits),
            report: BaseReport::default(),
            unreachable: None,
        })
    }

    /// Takes orders, and sets the velocity of the base.
    pub(super) fn step(&mut self, now: Stamp) {
        self.report = self.base.report(now);
        // A base on its tour ignores velocities. Braking begins at the end of the tour, from the
        // velocity there.
        if self.report.is_on_tour
            && let Err(error) = self.follower.resume(now, self.report.velocity)
        {
            log::debug!("steering: {error}");
        }
        let orders = self.port.take_orders();
        if let Some(motion) = orders.brake_motion {
            self.follower.brake(motion);
        }
        if let Some(target) = orders.target.filter(|_| !self.report.is_on_tour)
            && let Err(why) = self.follower.follow(now, &target)
        {
            log::debug!("steering: {why}");
        }
        let velocity = if self.report.is_on_tour {
            self.follower.velocity()
        } else {
            self.follower.step(now)
        };
        let driven = self.base.drive(now, &velocity);
        self.unreachable = driven.err().map(|error| error.to_string());
        if let Some(state) = self.state() {
            self.port.report(state);
        }
    }

    /// Brakes. Returns whether the base stands still.
    fn brake_for_end(&mut self) -> bool {
        self.follower.brake(u64::MAX);
        // A base on its tour was never driven, and a base that never reported cannot confirm.
        self.report.is_on_tour || self.report.reported_at.is_none() || self.is_at_rest()
    }

    fn is_at_rest(&self) -> bool {
        self.follower.velocity() == BaseVelocity::ZERO
            && self.report.is_stop_confirmed
            && self.report.velocity.is_rest()
    }

    fn state(&self) -> Option<BaseState> {
        Some(BaseState {
            reported_at: self.report.reported_at?,
            velocity: self.report.velocity,
            is_at_rest: self.follower.is_at_rest() && self.is_at_rest(),
            braked_motion: self.follower.braked_motion(),
            fault: self.unreachable.clone().or(self.report.fault.clone()),
            refusal: self.report.refusal.clone(),
        })
    }
}
