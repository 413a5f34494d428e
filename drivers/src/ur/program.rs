//! The URScript program that moves the arm: in every cycle of the controller, it follows the newest
//! setpoint in the input registers of RTDE.
//!
//! The program brakes the arm (`stopj`) if the setpoints stop, and then ends. A watchdog of the
//! controller stops the program if it does not end in time. Source of the functions: "URScript
//! manual" of Universal Robots, version 5.11.

use super::N_JOINTS;
use super::connection::FIRST_REGISTER;
use std::time::Duration;

/// Why a program ended, as it reports in an output register.
pub(super) const ENDED_AS_REQUESTED: i32 = 1;
pub(super) const ENDED_BY_SILENCE: i32 = 2;
pub(super) const ENDED_WITHOUT_SETPOINTS: i32 = 3;
pub(super) const ENDED_BY_DISTANCE: i32 = 4;

/// Time for which a program waits for its first setpoint.
const MAX_START_SECS: f64 = 1.0;
/// Maximum distance of the first setpoint from the position that the controller commands, rad. The
/// driver sends the same position, so a larger distance means that the registers belong to another
/// program.
const MAX_START_DISTANCE_RAD: f64 = 0.02;
/// Smoothing of setpoints by the controller, seconds. It is close to the minimum of 0.03 s, because
/// our setpoints are smooth. A longer time delays the arm.
const LOOKAHEAD_SECS: f64 = 0.05;
/// Stiffness of the controller towards setpoints, from 100 to 2000. This is the default.
const GAIN: f64 = 300.0;
/// Reserve of the watchdog for the end of the program.
const WATCHDOG_RESERVE: Duration = Duration::from_millis(500);

/// What differs between programs.
#[derive(Clone, Copy, Debug)]
pub(super) struct ProgramConfig {
    /// Number of this motion. Setpoints of other motions are ignored.
    pub(super) session: i32,
    /// Time without new setpoints after which the program brakes the arm.
    pub(super) timeout: Duration,
    /// Deceleration of the joint with the largest speed.
    pub(super) brake_rad_s2: f64,
    /// Maximum time in which the arm comes to rest at this deceleration.
    pub(super) brake_time: Duration,
}

/// The text of the program.
pub(super) fn program(config: &ProgramConfig) -> String {
    let ProgramConfig {
        session,
        timeout,
        brake_rad_s2,
        brake_time,
    } = *config;
    let timeout_secs = timeout.as_secs_f64();
    let watchdog_hz = 1.0 / (timeout + brake_time + WATCHDOG_RESERVE).as_secs_f64();
    let number_register = FIRST_REGISTER;
    let session_register = FIRST_REGISTER + 1;
    let setpoint = setpoint();
    let is_far = is_far();
    format!(
        "def fieldrig_motion():
  session = {session}
  end_reason = 0
  waited = 0.0
  while read_input_integer_register({session_register}) != session and waited < {MAX_START_SECS:?}:
    waited = waited + get_steptime()
    sync()
  end
  start = get_target_joint_positions()
  target = {setpoint}
  if read_input_integer_register({session_register}) != session:
    end_reason = {ENDED_WITHOUT_SETPOINTS}
  elif {is_far}:
    end_reason = {ENDED_BY_DISTANCE}
  end
  number = read_input_integer_register({number_register})
  silent = 0.0
  rtde_set_watchdog(\"input_int_register_{number_register}\", {watchdog_hz:?}, \"stop\")
  write_output_integer_register({session_register}, 0)
  write_output_integer_register({number_register}, session)
  while end_reason == 0:
    newest = read_input_integer_register({number_register})
    if newest == number:
      silent = silent + get_steptime()
    else:
      silent = 0.0
    end
    number = newest
    if silent > {timeout_secs:?}:
      end_reason = {ENDED_BY_SILENCE}
    elif read_input_integer_register({session_register}) != session:
      end_reason = {ENDED_AS_REQUESTED}
    else:
      target = {setpoint}
      servoj(target, t=get_steptime(), lookahead_time={LOOKAHEAD_SECS:?}, gain={GAIN:?})
    end
  end
  stopj({brake_rad_s2:?})
  write_output_integer_register({session_register}, end_reason)
  write_output_integer_register({number_register}, 0)
end
"
    )
}

/// The setpoint in the input registers, as a list.
fn setpoint() -> String {
    let registers: Vec<String> = (0..N_JOINTS)
        .map(|ix| format!("read_input_float_register({})", FIRST_REGISTER + ix))
        .collect();
    format!("[{}]", registers.join(", "))
}

/// Whether the setpoint is far from the position of the arm.
fn is_far() -> String {
    let joints: Vec<String> = (0..N_JOINTS)
        .map(|ix| format!("norm(target[{ix}] - start[{ix}]) > {MAX_START_DISTANCE_RAD:?}"))
        .collect();
    joints.join(" or ")
}
