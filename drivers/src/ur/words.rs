//! The modes of a robot in words, with what a person has to do.

use super::state::RobotState;

/// Robot modes. Source: RTDE guide; names as in Universal Robots' client library.
const IDLE: i32 = 5;
const BACKDRIVE: i32 = 6;
const RUNNING: i32 = 7;
/// Safety modes and statuses in which the robot may move.
const NORMAL: i32 = 1;
const REDUCED: i32 = 2;
const PROTECTIVE_STOP: i32 = 3;
/// Value of `runtime_state` while a program runs.
pub(super) const PLAYING: u32 = 2;
/// Bit of `robot_status_bits` for the freedrive button at the back of the pendant.
const TEACH_BUTTON: u32 = 1 << 2;

/// Whether the joint angles are measured. Without power at the joints, a controller reports angles
/// that may be wrong.
pub(super) fn has_joint_power(state: &RobotState) -> bool {
    (IDLE..=RUNNING).contains(&state.robot_mode)
}

/// Description of the robot mode and, if it differs from normal, of the safety mode.
pub(super) fn describe(state: &RobotState) -> String {
    let mode = robot_mode(state.robot_mode);
    match safety_stop(state) {
        Some(stop) => format!("{mode}; {stop}"),
        None => mode,
    }
}

/// The reason why the robot accepts no motion, and the remedy; `None` if it is ready. A program
/// that runs is not considered.
pub(super) fn blocking_reason(state: &RobotState) -> Option<String> {
    if let Some(stop) = safety_stop(state) {
        return Some(stop);
    }
    if state.robot_mode != RUNNING {
        return Some(robot_mode(state.robot_mode));
    }
    (state.status_bits & TEACH_BUTTON != 0)
        .then(|| "its freedrive button is pressed: release it".to_owned())
}

/// Whether the safety system has stopped the robot.
pub(super) fn is_stopped(state: &RobotState) -> bool {
    safety_stop(state).is_some()
}

/// Whether the robot is in a protective stop, which can be ended from the network.
pub(super) fn is_protective_stop(state: &RobotState) -> bool {
    state.safety_mode == PROTECTIVE_STOP
}

fn robot_mode(mode: i32) -> String {
    let text = match mode {
        -1 => "the robot controller is not running: restart the control box",
        0 => "the robot is disconnected from its controller: restart the control box",
        1 => "the safety configuration is not confirmed: confirm it at the pendant",
        2 => "it is booting",
        3 => "the joints have no power: switch the robot on at the pendant",
        4 => "the joints are being switched on",
        IDLE => "the brakes are engaged: release them at the pendant (Start)",
        BACKDRIVE => "it is guided by hand (freedrive): end freedrive",
        RUNNING => "it is running",
        8 => "the firmware is being updated",
        mode => return format!("it is in the unknown robot mode {mode}"),
    };
    text.to_owned()
}

/// The stop of the safety system; `None` if there is none.
fn safety_stop(state: &RobotState) -> Option<String> {
    let text = match state.safety_status.unwrap_or(state.safety_mode) {
        NORMAL | REDUCED => return None,
        PROTECTIVE_STOP => {
            "it is in a protective stop: look at the arm and remove the cause, then recover"
        }
        4 => "it is in recovery mode, outside its safety limits: move it back at the pendant",
        5 => "its safeguard input stops it: close the guard or reset the input",
        6 => "the emergency stop of the system is pressed: release it, and switch the robot on",
        7 => "its emergency stop is pressed: release it, and switch the robot on at the pendant",
        8 => "its safety system reports a violation: look at the pendant",
        9 => "its safety system reports a fault: look at the pendant, and restart the control box",
        10 => "its joints are being identified: confirm them at the pendant",
        12 | 18 => "the safeguard stop of the automatic mode is active: reset its input",
        13 | 14 => "the three-position switch stops it: hold the switch in its middle position",
        15 | 20 => "an external emergency stop is pressed: release it, and switch the robot on",
        16 | 19 | 22 => "an external safeguard stop is active: reset it",
        17 => "it waits for the parameters of PROFIsafe",
        status => {
            return Some(format!(
                "its safety system reports the unknown status {status}"
            ));
        }
    };
    Some(text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ready() -> RobotState {
        RobotState {
            robot_mode: RUNNING,
            safety_mode: NORMAL,
            ..RobotState::default()
        }
    }

    #[test]
    fn every_mode_that_blocks_a_motion_has_a_remedy() {
        assert_eq!(blocking_reason(&ready()), None);
        let reduced = RobotState {
            safety_mode: REDUCED,
            ..ready()
        };
        assert_eq!(blocking_reason(&reduced), None, "slower, but it moves");
        let reason = |change: fn(&mut RobotState)| {
            let mut state = ready();
            change(&mut state);
            blocking_reason(&state).expect("the robot is not ready")
        };
        let protective = reason(|state| state.safety_mode = PROTECTIVE_STOP);
        assert!(protective.contains("protective stop"), "{protective}");
        let teach = reason(|state| state.status_bits = TEACH_BUTTON);
        assert!(teach.contains("freedrive button"), "{teach}");
        let guided = reason(|state| state.robot_mode = BACKDRIVE);
        assert!(guided.contains("by hand"), "{guided}");
        let off = reason(|state| state.robot_mode = 3);
        assert!(off.contains("switch the robot on"), "{off}");
        // The status has more values than the mode, so it is used if it is reported.
        let switch = reason(|state| state.safety_status = Some(13));
        assert!(switch.contains("three-position"), "{switch}");
        let unknown = reason(|state| state.safety_mode = 99);
        assert!(unknown.contains("99"), "{unknown}");
    }

    #[test]
    fn angles_count_as_measured_only_with_power_at_the_joints() {
        let with_mode = |robot_mode| RobotState {
            robot_mode,
            ..ready()
        };
        for (robot_mode, is_measured) in [(2, false), (3, false), (4, false), (5, true), (7, true)]
        {
            assert_eq!(has_joint_power(&with_mode(robot_mode)), is_measured);
        }
    }
}
