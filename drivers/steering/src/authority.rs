//! Decides whether an operator may move a robot now, from the lease, the dead-man switch and stops.
//! Each chain of decisions applies its own limits afterward.

use crate::check::positive;
use crate::clutch::{Change, Clutch, ClutchConfig, ClutchState, Held};
use crate::error::Error;
use crate::lease::{Holder, Lease, LeaseConfig};
use crate::reason::{Link, Reason};
use crate::request::{Command, Operator, Request};
use kinematics::{Stamp, Transform};
use serde::{Deserialize, Serialize};

/// The right to move a robot: one lease, one dead-man switch and one stop for all of its parts.
#[derive(Clone, Debug)]
pub struct Authority {
    lease: Lease,
    clutch: Clutch,
    stops: Stops,
    /// Why the last motion ended.
    last_brake: Option<(Link, Reason)>,
    /// Number of grips so far. A grip may follow another one whose release was lost.
    n_grips: u64,
    latest_nanos: Option<i64>,
}

/// Stops until an operator permits motion.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Stops {
    /// The first reason.
    first: Option<(Link, Reason)>,
    /// The newest reason, if another stop has followed.
    newest: Option<Reason>,
    /// Number of the newest stop; 0 before the first.
    number: u64,
}

/// All that an authority remembers, for records.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AuthorityState {
    lease: Option<Holder>,
    clutch: ClutchState,
    stops: Stops,
    last_brake: Option<(Link, Reason)>,
    n_grips: u64,
    /// Time of the last call.
    pub(crate) latest_nanos: Option<i64>,
}

impl AuthorityState {
    /// Number of joint values of the intent that is followed, if it has any.
    pub(crate) fn n_joints(&self) -> Option<usize> {
        self.clutch.n_joints()
    }
}

impl Authority {
    /// Nobody has control.
    ///
    /// * `n_joints`: number of joints that operators may move.
    ///
    /// # Errors
    /// If a value of the configuration is not positive.
    pub(crate) fn new(
        lease: LeaseConfig,
        clutch: ClutchConfig,
        n_joints: usize,
    ) -> Result<Self, Error> {
        check_operator_times(&lease, &clutch)?;
        Ok(Self {
            lease: Lease::new(lease),
            clutch: Clutch::new(clutch, n_joints),
            stops: Stops::default(),
            last_brake: None,
            n_grips: 0,
            latest_nanos: None,
        })
    }

    pub(crate) fn state(&self) -> AuthorityState {
        AuthorityState {
            lease: self.lease.holder,
            clutch: self.clutch.state(),
            stops: self.stops.clone(),
            last_brake: self.last_brake.clone(),
            n_grips: self.n_grips,
            latest_nanos: self.latest_nanos,
        }
    }

    pub(crate) fn set_state(&mut self, state: AuthorityState) {
        self.lease.holder = state.lease;
        self.clutch.set_state(state.clutch);
        self.stops = state.stops;
        self.last_brake = state.last_brake;
        self.n_grips = state.n_grips;
        self.latest_nanos = state.latest_nanos;
    }

    /// Who has control, and since when.
    pub fn holder(&self) -> Option<(Operator, Stamp)> {
        self.lease.holder()
    }

    /// Time until the lease expires if its holder is silent; `None` if nobody has control.
    pub fn lease_left_secs(&self, now: Stamp) -> Option<f64> {
        self.lease.left_secs(now)
    }

    /// The operator who may take control from its holder now.
    pub fn offered_to(&self, now: Stamp) -> Option<Operator> {
        self.lease.offered_to(now)
    }

    /// The link and the first reason of a stop that lasts: why the robot stays at rest until an
    /// operator permits motion.
    pub fn stop(&self) -> Option<&(Link, Reason)> {
        self.stops.first.as_ref()
    }

    /// Why the robot was stopped since, if somebody or something has stopped it again for another
    /// reason than [`Authority::stop`].
    pub fn newest_stop(&self) -> Option<&Reason> {
        self.stops.newest.as_ref()
    }

    /// Number of the newest stop, which a permission must name; 0 before the first. Each stop by
    /// anybody, and each fault of the robot, has its own number.
    pub fn stop_number(&self) -> u64 {
        self.stops.number
    }

    /// Checks that a permission names the newest stop.
    ///
    /// # Errors
    /// That it names another one.
    pub fn check_stop(&self, named: u64) -> Result<(), Reason> {
        let newest = self.stops.number;
        if named == newest {
            return Ok(());
        }
        Err(Reason::OtherStop { named, newest })
    }

    /// Whether the grip that is held moves the base; `None` while no grip is held.
    pub fn moves_base(&self) -> Option<bool> {
        Some(self.clutch.held()?.intent.is_of_base())
    }

    /// The device whose switch is closed.
    pub(crate) fn held(&self) -> Option<&Held> {
        self.clutch.held()
    }

    /// Number of the newest grip.
    pub(crate) fn grip_number(&self) -> u64 {
        self.n_grips
    }

    /// The goal pose of the tip, if the intent has one; see [`Clutch::goal`].
    pub(crate) fn goal(&mut self, base_from_tip: &Transform) -> Option<Transform> {
        self.clutch.goal(base_from_tip)
    }

    /// When a target of now expires: after `secs`, or when the newest command may no longer be
    /// followed. If the chain does not run any more, the thread of the robot then also brakes
    /// because of a silent device.
    pub(crate) fn expiry(&self, now: Stamp, secs: f64) -> Stamp {
        let expiry = now.plus_secs(secs);
        self.clutch.deadline().map_or(expiry, |end| end.min(expiry))
    }

    /// Sets the time, and ends an expired lease.
    pub(crate) fn advance(&mut self, now: Stamp) {
        if let Some(latest) = self.latest_nanos.map(Stamp).filter(|latest| now < *latest) {
            // After a step back, nothing would expire for the duration of this step.
            self.lease.end();
            self.end_control(Reason::ClockWentBack {
                secs: latest.secs_since(now),
            });
        }
        self.latest_nanos = Some(now.0);
        if let Some(reason) = self.lease.expire(now) {
            self.end_control(reason);
        }
    }

    /// Decides a request.
    pub(crate) fn handle(&mut self, now: Stamp, request: &Request) -> Result<(), Reason> {
        match request {
            Request::TakeLease(operator) => {
                let was_free = self.lease.holder().is_none();
                if let Some(lost) = self.lease.take(now, *operator)? {
                    self.end_control(lost);
                } else if was_free {
                    self.last_brake = None;
                }
                Ok(())
            }
            Request::RenewLease(operator) => self.lease.renew(now, *operator),
            Request::ReleaseLease(operator) => {
                let lost = self.lease.release(now, *operator)?;
                self.end_control(lost);
                Ok(())
            }
            Request::OfferLease { from, to } => self.lease.offer(now, *from, *to),
            Request::Stop { by } => {
                let reason = by.map_or(Reason::StoppedByProgram, |operator| Reason::StoppedBy {
                    operator,
                });
                self.latch_stop(Link::Clutch, reason);
                Ok(())
            }
            Request::SceneLost { report } => {
                let report = report.clone();
                self.latch_stop(Link::Clearance, Reason::SceneLost { report });
                Ok(())
            }
            Request::Rearm { operator, stop } => self.permit_motion(now, *operator, *stop),
            Request::Command(command) => self.take_command(now, command),
        }
    }

    /// Checks that somebody holds the lease and a dead-man switch.
    pub(crate) fn permitted(&mut self, now: Stamp) -> Result<(), (Link, Reason)> {
        if let Some(stop) = &self.stops.first {
            return Err(stop.clone());
        }
        let missing = if self.lease.holder().is_none() {
            (Link::Lease, Reason::NoLease)
        } else if let Some(reason) = self.clutch.expire(now) {
            return Err(self.brake(Link::Clutch, reason));
        } else if self.clutch.held().is_none() {
            (Link::Clutch, Reason::NotGripped)
        } else {
            return Ok(());
        };
        Err(self.last_brake.clone().unwrap_or(missing))
    }

    /// Ends the motion and its grip. Returns its arguments.
    pub(crate) fn brake(&mut self, link: Link, reason: Reason) -> (Link, Reason) {
        self.clutch.open();
        self.last_brake = Some((link, reason.clone()));
        (link, reason)
    }

    /// Ends the motion until an operator permits it again. The first reason stays.
    pub(crate) fn latch_stop(&mut self, link: Link, reason: Reason) {
        self.stops.number += 1;
        let stop = self.brake(link, reason.clone());
        let (_, first) = self.stops.first.get_or_insert(stop);
        self.stops.newest = (*first != reason).then_some(reason);
    }

    fn permit_motion(&mut self, now: Stamp, operator: Operator, named: u64) -> Result<(), Reason> {
        self.lease.renew(now, operator)?;
        self.check_stop(named)?;
        // A fault is reported again in the next cycle, if it is still there.
        self.stops.first = None;
        self.stops.newest = None;
        self.clutch.open();
        Ok(())
    }

    fn take_command(&mut self, now: Stamp, command: &Command) -> Result<(), Reason> {
        self.lease.hear(now, command)?;
        let was_held = self.clutch.held().is_some();
        let may_move = self.stops.first.is_none();
        match self.clutch.receive(now, command, may_move) {
            Err(reason) => {
                if was_held && self.clutch.held().is_none() {
                    self.brake(Link::Clutch, reason.clone());
                }
                // During a stop, the reason of the stop is more important to the operator.
                Err(self.stop().map_or(reason, |(_, stop)| stop.clone()))
            }
            Ok(Change::Closed) => {
                self.n_grips += 1;
                self.last_brake = None;
                Ok(())
            }
            Ok(Change::Opened) => {
                self.brake(Link::Clutch, Reason::NotGripped);
                Ok(())
            }
            Ok(Change::Updated | Change::Open) => Ok(()),
        }
    }

    fn end_control(&mut self, reason: Reason) {
        self.brake(Link::Lease, reason);
        self.clutch.forget_devices();
    }
}

/// Checks the times and scales of operators.
///
/// # Errors
/// If one of them is not positive.
pub(crate) fn check_operator_times(
    lease: &LeaseConfig,
    clutch: &ClutchConfig,
) -> Result<(), Error> {
    for (what, value) in [
        ("lease.expiry_secs", lease.expiry_secs),
        ("lease.offer_secs", lease.offer_secs),
        ("clutch.max_silence_secs", clutch.max_silence_secs),
        ("clutch.max_age_secs", clutch.max_age_secs),
        ("clutch.max_ahead_secs", clutch.max_ahead_secs),
        ("clutch.max_hand_m_s", clutch.max_hand_m_s),
        ("clutch.max_hand_rad_s", clutch.max_hand_rad_s),
        ("clutch.translation_scale", clutch.translation_scale),
        ("clutch.rotation_scale", clutch.rotation_scale),
    ] {
        positive(what, value)?;
    }
    Ok(())
}
