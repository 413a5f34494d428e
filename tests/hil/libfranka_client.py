"""A libfranka client: moves for 2000 cycles, commands a step that triggers a reflex, recovers, moves again; prints one JSON object.

usage: libfranka_client.py ADDRESS      libfranka always uses port 1337
"""

import json
import sys

from pylibfranka import ControlException, ControllerMode, JointPositions, RealtimeConfig, Robot, RobotMode

CYCLES = 2000
BY_RAD = 0.2
JUMP_RAD = 0.001


def move(robot, position_at):
    """Commands one position per cycle until `position_at` reports the end. Returns the number of cycles and the mean success rate."""
    control = robot.start_joint_position_control(ControllerMode.JointImpedance)
    cycles, seconds, shares, start = 0, 0.0, [], None
    while True:
        state, period = control.readOnce()
        start = start or list(state.q_d)
        seconds += period.to_sec()
        cycles += 1
        if cycles > 100:  # The rate covers the last 100 cycles.
            shares.append(state.control_command_success_rate)
        position, finished = position_at(start, seconds)
        command = JointPositions(position)
        command.motion_finished = finished
        control.writeOnce(command)
        if finished:
            return cycles, sum(shares) / max(len(shares), 1)


def trajectory(start, seconds):
    share = min(seconds / (CYCLES * 1e-3), 1.0)
    by = BY_RAD * share**3 * (10 - 15 * share + 6 * share * share)
    return start[:3] + [start[3] + by] + start[4:], share >= 1.0


def jump(start, seconds):
    by = JUMP_RAD if seconds > 0.1 else 0.0
    return start[:3] + [start[3] + by] + start[4:], False


def main():
    robot = Robot(sys.argv[1], RealtimeConfig.kIgnore)
    before = list(robot.read_once().q)
    cycles, share = move(robot, trajectory)
    after = list(robot.read_once().q)
    stopped = ""
    try:
        move(robot, jump)
    except ControlException as error:
        stopped = str(error)
    reflex = robot.read_once().robot_mode == RobotMode.Reflex
    robot.automatic_error_recovery()
    mode = RobotMode.Reflex
    for _ in range(1000):  # States sent before the recovery may still arrive.
        mode = robot.read_once().robot_mode
        if mode == RobotMode.Idle:
            break
    again, _ = move(robot, trajectory)
    moved = [b - a for a, b in zip(before, after)]
    print(
        json.dumps(
            {
                "cycles": cycles,
                "answered": share,
                "moved_rad": moved,
                "stopped": stopped,
                "reflex": reflex,
                "recovered": mode == RobotMode.Idle,
                "cycles_again": again,
            }
        )
    )


main()
