//! Checks the configuration of an arm before anything is sent to its servos.

use super::config::MovableServoArmConfig;
use super::protocol::LossReactions;
use crate::Error;
use crate::motion::OnLoss;
use std::time::Duration;

/// Minimum watchdog timeout, in cycles. The arm is stopped after 80 % of the timeout. A servo may
/// always be silent for three cycles. Four is the smallest number of cycles of which 80 % are more
/// than three.
const MIN_CYCLES: u32 = 4;

/// Makes all checks that are possible without the servos.
///
/// # Errors
/// If the servos do not support the configuration.
pub(super) fn check(config: &MovableServoArmConfig) -> Result<(), Error> {
    let n_limits = config.motion.limits.len();
    let n_servos = config.arm.servos.len();
    if n_limits != n_servos {
        return Err(refused(format!(
            "limits are given for {n_limits} joints, but the arm has {n_servos}"
        )));
    }
    check_loss(config).map_err(refused)
}

/// Checks whether the servos can do what the rig file requests if this computer stops sending.
fn check_loss(config: &MovableServoArmConfig) -> Result<(), String> {
    let LossReactions {
        by_servo,
        while_running,
        otherwise,
    } = config.arm.protocol.loss_reactions();
    let on_loss = config.motion.on_loss;
    if by_servo.contains(&on_loss) {
        return Ok(());
    }
    if !while_running.contains(&on_loss) {
        let title = config.arm.protocol.title();
        let possible: Vec<_> = by_servo
            .iter()
            .chain(while_running)
            .map(|action| format!("{:?}", action.name()))
            .collect();
        return Err(format!(
            "arm.motion.on_loss is {:?}, but {title} servos can only {}",
            on_loss.name(),
            possible.join(" or ")
        ));
    }
    // Only the author of the rig file may accept that nothing applies `on_loss` after a crash.
    if config.motion.accept_no_watchdog {
        return Ok(());
    }
    Err(format!(
        "{otherwise} if this computer stopped sending; on_loss = {:?} needs arm.motion.accept_no_watchdog = true, and is applied only while fieldrig is \
         running",
        on_loss.name()
    ))
}

/// Whether `on_loss` must be confirmed by each servo before this program ends.
pub(super) fn needs_confirmation(on_loss: OnLoss) -> bool {
    on_loss == OnLoss::Release
}

/// Checks the timeout against the period of the cycle, which depends on the speed of the bus.
///
/// # Errors
/// If the timeout is too short.
pub(super) fn check_timeout(timeout: Duration, period: Duration) -> Result<(), Error> {
    if timeout >= MIN_CYCLES * period {
        return Ok(());
    }
    Err(refused(format!(
        "arm.motion.timeout_millis must be at least {MIN_CYCLES} cycles of {:.1} ms",
        1e3 * period.as_secs_f64()
    )))
}

fn refused(reason: String) -> Error {
    Error::Motion { reason }
}
