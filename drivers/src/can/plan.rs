//! Checks the configuration of an arm before any frame is sent to its motors, and plans its cycle.

use super::bus_load::max_cycle_rate_hz;
use super::config::{MotorConfig, MovableArmConfig};
use super::watchdog::{Watchdog, WatchdogPlan};
use crate::Error;
use crate::wire::can::canopen::{self, NodeState};
use std::time::Duration;

/// Minimum watchdog timeout, in cycles. The arm is stopped after 80 % of the timeout. A motor may
/// always be silent for three cycles. Four is the smallest number of cycles of which 80 % are more
/// than three.
const MIN_CYCLES: u32 = 4;

/// Makes all checks that are possible before any frame is sent, and returns the watchdog
/// configuration of the motors.
///
/// # Errors
/// If a motor does not support the configuration.
pub(super) fn watchdog_plan(config: &MovableArmConfig) -> Result<WatchdogPlan, Error> {
    let arm = &config.arm;
    let motion_config = &config.motion;
    if motion_config.limits.len() != arm.motors.len() {
        let reason = format!(
            "limits are given for {} joints, but the arm has {}",
            motion_config.limits.len(),
            arm.motors.len()
        );
        return Err(Error::Motion { reason });
    }
    let host = unused_node(config)?;
    let plan = WatchdogPlan {
        on_loss: motion_config.on_loss,
        timeout: motion_config.timeout,
        accept_no_watchdog: motion_config.accept_no_watchdog,
        period: period(config, host),
        host,
    };
    for motor in &arm.motors {
        check_motor(&plan, motor, &arm.buses[motor.bus_ix].interface)?;
    }
    // The number of cycles in the timeout is checked here, because the period depends on the bus
    // load.
    if plan.timeout < MIN_CYCLES * plan.period {
        let reason = format!(
            "arm.motion.timeout_millis must be at least {MIN_CYCLES} cycles of {:.1} ms",
            1e3 * plan.period.as_secs_f64()
        );
        return Err(Error::Motion { reason });
    }
    Ok(plan)
}

/// Checks whether a motor may be moved as planned.
pub(super) fn check_motor(
    plan: &WatchdogPlan,
    config: &MotorConfig,
    interface: &str,
) -> Result<(), Error> {
    let watchdog = config.protocol.watchdog();
    // Without a watchdog, the motor would continue after a crash of this computer. Only the author
    // of the rig file may accept this risk.
    if let Watchdog::Missing { reason, .. } = watchdog
        && !plan.accept_no_watchdog
    {
        let reason = format!(
            "{reason}: it would execute its last command forever if this computer stopped sending; it is moved only with \
             arm.motion.accept_no_watchdog = true"
        );
        return Err(motor_error(config, interface, reason));
    }
    let can = watchdog.actions();
    // All motors of an arm must react alike. If one motor held its joint while the others released
    // theirs, the arm would swing around the held joint.
    if !can.contains(&plan.on_loss) {
        let can: Vec<_> = can.iter().map(|can| format!("{:?}", can.name())).collect();
        let requested = plan.on_loss.name();
        let reason = format!(
            "arm.motion.on_loss is {requested:?}, but this motor can only {}",
            can.join(" or ")
        );
        return Err(motor_error(config, interface, reason));
    }
    // A command in MIT mode without gains would leave the joint limp, and there are no gains that
    // suit every arm.
    if config.gains.is_none() && config.protocol.family().has_gains() {
        let reason = "to move this motor, set its stiffness_nm_rad and damping_nm_s_rad".to_owned();
        return Err(motor_error(config, interface, reason));
    }
    Ok(())
}

/// The error of a motor that cannot be moved as planned.
fn motor_error(config: &MotorConfig, interface: &str, reason: String) -> Error {
    Error::Motor {
        joint: config.joint.clone(),
        interface: interface.to_owned(),
        reason,
    }
}

/// Returns an unused CANopen node number for this computer.
fn unused_node(config: &MovableArmConfig) -> Result<canopen::Node, Error> {
    // The search starts at the highest number, because drives are usually numbered from 1. A low
    // number could belong to a drive that the rig file does not list.
    let mut numbers = (1..=127)
        .rev()
        .filter_map(|number| canopen::Node::new(number).ok());
    let unused = numbers.find(|node| !is_used(config, *node));
    let reason = "no free CANopen node number is left for this computer".to_owned();
    unused.ok_or(Error::Motion { reason })
}

/// Whether a motor of the arm has this CANopen node number.
fn is_used(config: &MovableArmConfig, node: canopen::Node) -> bool {
    config
        .arm
        .motors
        .iter()
        .any(|motor| motor.protocol.canopen_node() == Some(node))
}

/// Cycle period that the slowest bus allows. If there are CiA 402 drives, it is rounded up to whole
/// milliseconds, because drives count in milliseconds.
fn period(config: &MovableArmConfig, host: canopen::Node) -> Duration {
    let mut rate_hz = config.arm.rate_hz;
    let is_drive = |motor: &&MotorConfig| motor.protocol.canopen_node().is_some();
    for (bus_ix, bus) in config.arm.buses.iter().enumerate() {
        let motors: Vec<_> = config
            .arm
            .motors
            .iter()
            .filter(|motor| motor.bus_ix == bus_ix)
            .collect();
        if motors.is_empty() {
            continue;
        }
        let mut cycle_frames = Vec::new();
        let mut unsolicited = Vec::new();
        for traffic in motors.iter().map(|motor| motor.protocol.traffic()) {
            cycle_frames.extend(traffic.cycle_frames);
            unsolicited.extend(traffic.unsolicited);
        }
        // In each cycle, drives also get our heartbeat, which their watchdog monitors, and the
        // SYNC.
        if motors.iter().any(is_drive) {
            cycle_frames.extend([
                canopen::encode_sync(),
                canopen::encode_heartbeat(host, NodeState::Operational),
            ]);
        }
        // One thread serves all buses with the same cycle, so the slowest bus determines the rate.
        rate_hz = rate_hz.min(max_cycle_rate_hz(
            bus,
            &cycle_frames,
            &unsolicited,
            config.arm.rate_hz,
        ));
    }
    let period = Duration::from_secs_f64(1.0 / rate_hz);
    if config.arm.motors.iter().any(|motor| is_drive(&motor)) {
        // Rounding up keeps the bus load within its limit.
        let millis = period.as_nanos().div_ceil(1_000_000);
        Duration::from_millis(millis.try_into().unwrap_or(u64::MAX))
    } else {
        period
    }
}

#[cfg(test)]
mod tests {
    use super::super::cia402::{Cia402, Units};
    use super::super::config::{ArmConfig, BusConfig, FollowingLimits, Gains};
    use super::super::damiao::Damiao;
    use super::super::family::MotorProtocol;
    use super::super::odrive::{self, Odrive};
    use super::super::robstride::{self, Robstride};
    use super::super::tmotor::{self, TMotor};
    use super::*;
    use crate::motion::{MotionConfig, OnLoss};
    use std::sync::Arc;

    fn config(protocols: Vec<Arc<dyn MotorProtocol>>) -> MovableArmConfig {
        let motors = protocols.into_iter().map(|protocol| MotorConfig {
            joint: "any".to_owned(),
            bus_ix: 0,
            protocol,
            gear_ratio: 1.0,
            is_reversed: false,
            offset_rad: 0.0,
            gains: None,
            following: FollowingLimits::default(),
        });
        MovableArmConfig {
            arm: ArmConfig {
                buses: vec![BusConfig {
                    interface: "can0".to_owned(),
                    bitrate_hz: 1_000_000,
                    data_bitrate_hz: None,
                    accept_no_restart: false,
                }],
                motors: motors.collect(),
                rate_hz: 1000.0,
            },
            motion: MotionConfig {
                limits: Vec::new(),
                on_loss: OnLoss::Release,
                timeout: Duration::from_millis(100),
                accept_no_watchdog: false,
            },
        }
    }

    #[test]
    fn cycle_keeps_bus_load_under_70_percent() {
        let host = canopen::Node::new(127).expect("a node");
        let damiao = |ix: u16| -> Arc<dyn MotorProtocol> {
            Arc::new(Damiao {
                motor: ix,
                feedback: 0x10 + ix,
            })
        };
        assert_eq!(
            period(&config(vec![damiao(1), damiao(2)]), host),
            Duration::from_millis(1)
        );
        // Seven motors have two frames each, of at most 135 bits per frame.
        let seven = period(&config((1..8).map(damiao).collect()), host).as_secs_f64();
        assert!((seven - 14.0 * 135e-6 / 0.7).abs() < 1e-6, "{seven}");
    }

    #[test]
    fn drives_get_whole_millisecond_period_and_unused_node() {
        let node = |number| canopen::Node::new(number).expect("a node");
        let units = Units {
            counts_per_turn: 1.0,
            rated_torque_nm: 1.0,
        };
        let drive = |number| -> Arc<dyn MotorProtocol> {
            Arc::new(Cia402 {
                node: node(number),
                units,
            })
        };
        let arm = config(vec![drive(127), drive(126), drive(1)]);
        assert_eq!(unused_node(&arm).expect("125 are free"), node(125));
        // 9 x 135 bits, a SYNC of 55 bits and a heartbeat of 65 bits take 1.34 ms. At a load of 70
        // %, the period is 1.91 ms.
        assert_eq!(period(&arm, node(125)), Duration::from_millis(2));
    }

    fn reported(
        protocol: &Arc<dyn MotorProtocol>,
        on_loss: OnLoss,
        accept_no_watchdog: bool,
    ) -> Option<String> {
        let gains = Some(Gains {
            stiffness_nm_rad: 1.0,
            damping_nm_s_rad: 1.0,
        });
        let config = MotorConfig {
            joint: "elbow".to_owned(),
            bus_ix: 0,
            protocol: Arc::clone(protocol),
            gear_ratio: 1.0,
            is_reversed: false,
            offset_rad: 0.0,
            gains,
            following: FollowingLimits::default(),
        };
        let plan = WatchdogPlan {
            on_loss,
            timeout: Duration::from_millis(100),
            accept_no_watchdog,
            host: canopen::Node::new(127).expect("a node"),
            period: Duration::from_millis(5),
        };
        check_motor(&plan, &config, "can0")
            .err()
            .map(|error| error.to_string())
    }

    #[test]
    fn unsupported_fail_safe_reports_supported_ones() {
        let units = Units {
            counts_per_turn: 1.0,
            rated_torque_nm: 1.0,
        };
        let drive: Arc<dyn MotorProtocol> = Arc::new(Cia402 {
            node: canopen::Node::new(1).expect("a node"),
            units,
        });
        let damiao: Arc<dyn MotorProtocol> = Arc::new(Damiao {
            motor: 1,
            feedback: 2,
        });
        let robstride: Arc<dyn MotorProtocol> = Arc::new(Robstride {
            motor: 1,
            model: robstride::Model::Rs00,
        });
        let node = odrive::Node::new(1).expect("a node");
        let odrive: Arc<dyn MotorProtocol> = Arc::new(Odrive {
            node,
            endpoints: None,
        });
        let ak: Arc<dyn MotorProtocol> = Arc::new(TMotor {
            motor: 1,
            model: tmotor::Model::Ak80x9,
        });
        for (protocol, on_loss, expected) in [
            (&damiao, OnLoss::Release, None),
            (&damiao, OnLoss::Hold, Some("can only \"release\"")),
            (&robstride, OnLoss::Release, None),
            (&robstride, OnLoss::Damp, Some("can only \"release\"")),
            (&drive, OnLoss::Hold, None),
            (&drive, OnLoss::Release, None),
            (
                &drive,
                OnLoss::Damp,
                Some("can only \"hold\" or \"release\""),
            ),
            (
                &odrive,
                OnLoss::Release,
                Some("arm.motion.odrive_endpoints"),
            ),
            (&ak, OnLoss::Release, Some("accept_no_watchdog = true")),
        ] {
            let reported = reported(protocol, on_loss, false);
            let is_as_expected = match (&reported, expected) {
                (Some(reported), Some(expected)) => {
                    reported.contains(expected) && reported.contains("\"elbow\" on \"can0\"")
                }
                (reported, expected) => reported.is_none() && expected.is_none(),
            };
            assert!(is_as_expected, "{protocol:?} {on_loss:?}: {reported:?}");
        }
        for on_loss in [OnLoss::Hold, OnLoss::Damp, OnLoss::Release] {
            assert_eq!(reported(&ak, on_loss, true), None, "it was accepted");
        }
        assert_eq!(reported(&odrive, OnLoss::Hold, true), None);
        let mut with_endpoints = odrive;
        odrive::set_endpoints(&mut with_endpoints, Some(&odrive::emulated::endpoints()));
        assert_eq!(reported(&with_endpoints, OnLoss::Release, false), None);
        assert!(
            reported(&with_endpoints, OnLoss::Hold, true).is_some(),
            "its watchdog can only release"
        );
        let mut other = Arc::clone(&damiao);
        odrive::set_endpoints(&mut other, Some(&odrive::emulated::endpoints()));
        assert!(
            other.as_ref() == damiao.as_ref(),
            "a motor of another family"
        );
    }
}
