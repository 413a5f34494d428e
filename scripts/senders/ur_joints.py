#!/usr/bin/env python3
"""Sends the joint states of a Universal Robots arm to fieldrig (arm.driver = "udp"). Only reads; moves nothing.

    pip install ur_rtde
    scripts/senders/ur_joints.py 192.168.0.100

Other programs may control the arm at the same time. The names of the joints are those of builtin:ur3e, ur5e and ur10e.
"""

import sys

from joint_sender import JointSender, arguments, ticks

NAMES = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
VARIABLES = ["timestamp", "actual_q", "actual_qd"]


def read(robot):
    """Stamp in seconds, positions in rad and speeds in rad/s of one state of the controller."""
    while True:
        stamp_secs = robot.getTimestamp()
        position, velocity = robot.getActualQ(), robot.getActualQd()
        # The next state may arrive between two of these calls.
        if robot.getTimestamp() == stamp_secs:
            return stamp_secs, position, velocity


def main():
    parser = arguments(__doc__.splitlines()[0], rate_hz=125)
    parser.add_argument("robot", help="host name or address of the controller")
    args = parser.parse_args()
    try:
        from rtde_receive import RTDEReceiveInterface
    except ImportError as error:
        sys.exit(f"error: the Python package {error.name} is missing; install it: pip install ur_rtde")
    try:
        robot = RTDEReceiveInterface(args.robot, args.rate, VARIABLES)
    except RuntimeError as error:
        sys.exit(f"error: no connection to {args.robot}, port 30004 (is the robot on, and RTDE enabled?): {error}")
    sender = JointSender(args.to)
    last_secs = None
    # Twice the rate, so that every state is read although the clocks of robot and computer differ.
    for _ in ticks(2 * args.rate):
        if not robot.isConnected():
            sys.exit(f"error: {args.robot} closed the connection; check the robot and start this program again")
        stamp_secs, position, velocity = read(robot)
        if stamp_secs != last_secs:
            last_secs = stamp_secs
            # The controller counts seconds since its start.
            sender.send(NAMES, position, velocity, stamp_nanos=round(stamp_secs * 1e9), clock="device")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
