//! What motors do on their own when our commands stop, how this is configured, and what they cannot do.
//!
//! - Damiao: register `TIMEOUT`; the motor leaves the enabled state and reports "communication lost". Source: Damiao
//!   DM-J4310-2EC manual V1.0, as in `jia-xie/python-damiao-driver` `docs/concept/`.
//! - Robstride: parameter `canTimeout`; the motor goes to its reset mode. The damping of its parameter `damper`
//!   protects unpowered motors against surges, and cannot be relied on. Source: RS00 to RS06 user manuals, sections
//!   4.2 and 4.3.5.
//! - ODrive: `axis0.config.watchdog_timeout` and `enable_watchdog`; the axis is disarmed. Source: ODrive documentation, error
//!   `WATCHDOG_TIMER_EXPIRED`.
//! - CiA 402: consumer heartbeat (`0x1016`) with abort connection option code (`0x6007`): either a quick stop after
//!   which the drive stays stopped (`0x605A` = 6), or voltage off. Source: CiA 301, section 7.5.2.20; CiA 402-2,
//!   objects 6007h and 605Ah. The reaction of the drive to its own faults (`0x605E`) is left unchanged.
//! - T-Motor AK: nothing; the motor executes its last command forever. Source: CubeMars AK Series Module Product
//!   Manual, MIT mode.

use super::config::{Family, MotorConfig};
use super::query::MotorQuery;
use crate::Error;
use crate::motion::OnLoss;
use crate::wire::can::canopen::{self, CONSUMER_HEARTBEAT};
use crate::wire::can::cia402;
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage};
use crate::wire::can::mit::Limits;
use crate::wire::can::odrive::{self, Endpoints};
use crate::wire::can::robstride::{self, Parameter};
use std::time::Duration;

/// Watchdog configuration of all motors of an arm.
#[derive(Clone, Debug)]
pub(super) struct WatchdogPlan {
    pub(super) on_loss: OnLoss,
    pub(super) timeout: Duration,
    pub(super) accept_no_watchdog: bool,
    /// Endpoint numbers of `ODrive` axes. Without them their watchdog cannot be set.
    pub(super) endpoints: Option<Endpoints>,
    /// Our CANopen node number, whose heartbeat the drives monitor.
    pub(super) host: canopen::Node,
    /// Cycle period.
    pub(super) period: Duration,
}

impl WatchdogPlan {
    /// Whether a motor detects missing commands.
    pub(super) fn has_watchdog(&self, family: &Family) -> bool {
        match family {
            Family::TMotor { .. } => false,
            Family::Odrive { .. } => self.endpoints.is_some(),
            Family::Damiao { .. } | Family::Robstride { .. } | Family::Cia402 { .. } => true,
        }
    }

    /// Checks whether a motor may be moved as planned, before anything is sent to it.
    pub(super) fn check(&self, config: &MotorConfig, interface: &str) -> Result<(), Error> {
        let fault = |reason| Err(Error::Motor { joint: config.joint.clone(), interface: interface.to_owned(), reason });
        let has_watchdog = self.has_watchdog(&config.family);
        if !has_watchdog && !self.accept_no_watchdog {
            let what = match config.family {
                Family::Odrive { .. } => {
                    "without arm.motion.odrive_endpoints the watchdog of this axis cannot be set: it"
                }
                _ => "a motor of this family has no watchdog: it",
            };
            return fault(format!(
                "{what} would execute its last command forever if this computer stopped sending; it is moved only with \
                 arm.motion.accept_no_watchdog = true"
            ));
        }
        let can = supported_actions(&config.family, has_watchdog);
        if !can.contains(&self.on_loss) {
            let can: Vec<_> = can.iter().map(|can| format!("{:?}", can.name())).collect();
            let requested = self.on_loss.name();
            return fault(format!("arm.motion.on_loss is {requested:?}, but this motor can only {}", can.join(" or ")));
        }
        if config.gains.is_none() && has_gains(&config.family) {
            return fault("to move this motor, set its stiffness_nm_rad and damping_nm_s_rad".to_owned());
        }
        Ok(())
    }
}

/// Whether each command includes the stiffness and damping.
fn has_gains(family: &Family) -> bool {
    matches!(family, Family::Damiao { .. } | Family::Robstride { .. } | Family::TMotor { .. })
}

/// Actions that a motor's own watchdog supports; without a watchdog, the actions that this computer can command while
/// it is still running.
fn supported_actions(family: &Family, has_watchdog: bool) -> &'static [OnLoss] {
    match (family, has_watchdog) {
        (Family::Cia402 { .. }, _) | (Family::Odrive { .. }, false) => &[OnLoss::Hold, OnLoss::Release],
        (Family::TMotor { .. }, _) => &[OnLoss::Hold, OnLoss::Damp, OnLoss::Release],
        (Family::Damiao { .. } | Family::Robstride { .. } | Family::Odrive { .. }, _) => &[OnLoss::Release],
    }
}

/// Sets and verifies the watchdog of a disabled motor.
///
/// # Errors
/// If a value reads back differently.
pub(super) fn set(query: &MotorQuery<'_>, family: &Family, limits: &Limits, plan: &WatchdogPlan) -> Result<(), Error> {
    let seconds = plan.timeout.as_secs_f64();
    let mismatch = |reported: String| {
        Err(query.fault(format!(
            "its timeout was set to {seconds} s but reads back as {reported}; the motor is not enabled"
        )))
    };
    match *family {
        Family::Damiao { motor, feedback } => {
            let requested = damiao::Value::Integer(query.map_error(damiao::timeout_ticks(seconds))?);
            let message = RegisterMessage { motor, access: Access::Write(Register::Timeout, requested) };
            query.send(damiao::encode_register(&message, None))?;
            match query.register(motor, feedback, Register::Timeout)? {
                reported if reported == requested => Ok(()),
                reported => mismatch(format!("{reported:?} ticks")),
            }
        }
        Family::Robstride { motor, .. } => {
            let requested = query.map_error(robstride::timeout(seconds))?;
            query.robstride(motor, &robstride::Request::Write(Parameter::Timeout, requested), limits)?;
            match query.parameter(motor, Parameter::Timeout, limits)? {
                reported if reported == requested => Ok(()),
                reported => mismatch(format!("{reported:?} ticks")),
            }
        }
        Family::Odrive { node } => match &plan.endpoints {
            Some(endpoints) => set_axis(query, node, endpoints, plan.timeout, mismatch),
            None => Ok(()),
        },
        Family::Cia402 { node, .. } => {
            let millis = u16::try_from(plan.timeout.as_millis()).unwrap_or(u16::MAX);
            let heartbeat = canopen::consumer_heartbeat(plan.host, millis);
            query.set_and_check(node, CONSUMER_HEARTBEAT, heartbeat.into())?;
            let reaction = match plan.on_loss {
                OnLoss::Hold => {
                    query.set_and_check(node, cia402::QUICK_STOP_OPTION, cia402::STAY_STOPPED)?;
                    cia402::ABORT_BY_QUICK_STOP
                }
                OnLoss::Damp | OnLoss::Release => cia402::ABORT_BY_DISABLING,
            };
            query.set_and_check(node, cia402::ABORT_CONNECTION, reaction)
        }
        Family::TMotor { .. } => Ok(()),
    }
}

/// Sets the watchdog of an `ODrive` axis, after checking that the endpoint numbers are those of its firmware: the
/// numbers depend on it.
fn set_axis(
    query: &MotorQuery<'_>,
    node: odrive::Node,
    endpoints: &Endpoints,
    timeout: Duration,
    mismatch: impl Fn(String) -> Result<(), Error>,
) -> Result<(), Error> {
    let version = odrive::Request::Ask(odrive::Code::Version);
    let (hardware, firmware) = query.axis(node, &version, |answer| match answer {
        odrive::Answer::Version { hardware, firmware } => Some((hardware, firmware)),
        _ => None,
    })?;
    if !endpoints.match_versions(hardware, firmware) {
        return Err(query.fault(format!(
            "it runs firmware {firmware:?} on hardware {hardware:?}, but arm.motion.odrive_endpoints is for firmware {} on hardware {}",
            endpoints.firmware, endpoints.hardware
        )));
    }
    // A flag is one byte; the bytes after it in an answer are undefined.
    let settings = [
        (endpoints.watchdog_timeout, timeout.as_secs_f32().to_le_bytes(), 4),
        (endpoints.enable_watchdog, [1, 0, 0, 0], 1),
    ];
    for (number, bytes, n_bytes) in settings {
        query.send(odrive::encode_request(node, &odrive::Request::WriteEndpoint(number, bytes)))?;
        let reported = query.axis(node, &odrive::Request::ReadEndpoint(number), |answer| match answer {
            odrive::Answer::Endpoint(reported, bytes) => (reported == number).then_some(bytes),
            _ => None,
        })?;
        if reported[..n_bytes] != bytes[..n_bytes] {
            return mismatch(format!("{reported:?} in endpoint {number}"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::config::Gains;
    use super::*;
    use crate::wire::can::{odrive, tmotor};

    fn reported(
        family: Family,
        on_loss: OnLoss,
        accept_no_watchdog: bool,
        endpoints: Option<Endpoints>,
    ) -> Option<String> {
        let gains = Some(Gains { stiffness_nm_rad: 1.0, damping_nm_s_rad: 1.0 });
        let config = MotorConfig {
            joint: "elbow".to_owned(),
            bus_ix: 0,
            family,
            gear_ratio: 1.0,
            is_reversed: false,
            offset_rad: 0.0,
            gains,
        };
        let plan = WatchdogPlan {
            on_loss,
            timeout: Duration::from_millis(100),
            accept_no_watchdog,
            endpoints,
            host: canopen::Node::new(127).expect("a node"),
            period: Duration::from_millis(5),
        };
        plan.check(&config, "can0").err().map(|error| error.to_string())
    }

    #[test]
    fn unsupported_fail_safe_reports_supported_ones() {
        let units = cia402::Units { counts_per_turn: 1.0, rated_torque_nm: 1.0 };
        let drive = Family::Cia402 { node: canopen::Node::new(1).expect("a node"), units };
        let damiao = Family::Damiao { motor: 1, feedback: 2 };
        let robstride = Family::Robstride { motor: 1, model: robstride::Model::Rs00 };
        let odrive = Family::Odrive { node: odrive::Node::new(1).expect("a node") };
        let ak = Family::TMotor { motor: 1, model: tmotor::Model::Ak80x9 };
        for (family, on_loss, expected) in [
            (damiao, OnLoss::Release, None),
            (damiao, OnLoss::Hold, Some("can only \"release\"")),
            (robstride, OnLoss::Release, None),
            (robstride, OnLoss::Damp, Some("can only \"release\"")),
            (drive, OnLoss::Hold, None),
            (drive, OnLoss::Release, None),
            (drive, OnLoss::Damp, Some("can only \"hold\" or \"release\"")),
            (odrive, OnLoss::Release, Some("arm.motion.odrive_endpoints")),
            (ak, OnLoss::Release, Some("accept_no_watchdog = true")),
        ] {
            let reported = reported(family, on_loss, false, None);
            let is_as_expected = match (&reported, expected) {
                (Some(reported), Some(expected)) => {
                    reported.contains(expected) && reported.contains("\"elbow\" on \"can0\"")
                }
                (reported, expected) => reported.is_none() && expected.is_none(),
            };
            assert!(is_as_expected, "{family:?} {on_loss:?}: {reported:?}");
        }
        for on_loss in [OnLoss::Hold, OnLoss::Damp, OnLoss::Release] {
            assert_eq!(reported(ak, on_loss, true, None), None, "it was accepted");
        }
        let endpoints = Some(super::super::emulated::endpoints());
        assert_eq!(reported(odrive, OnLoss::Release, false, endpoints.clone()), None);
        assert!(reported(odrive, OnLoss::Hold, true, endpoints).is_some(), "its watchdog can only release");
        assert_eq!(reported(odrive, OnLoss::Hold, true, None), None);
    }
}
