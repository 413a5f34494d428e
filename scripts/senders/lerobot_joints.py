#!/usr/bin/env python3
"""Sends the joint states of an SO-101 arm, calibrated with LeRobot, to fieldrig (arm.driver = "udp").

    pip install 'lerobot[feetech]'
    scripts/senders/lerobot_joints.py /dev/ttyACM0 --calibration \\
        ~/.cache/huggingface/lerobot/calibration/robots/so101_follower/NAME.json

Only reads the servos and leaves their torque as it is. A serial port can be opened by one program: if another LeRobot
program controls the arm, let that program send its observations with `observed` and JointSender instead.
"""

import json
import math
import sys
import time

from joint_sender import JointSender, arguments, ticks

# In the order of the servo IDs. At 0, a joint is in the middle of its calibrated range, as in builtin:so101.
NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]


def observed(degrees):
    """Positions in rad, in the order of NAMES, of an observation in degrees, with or without ".pos" in its keys."""
    return [math.radians(degrees.get(name, degrees.get(f"{name}.pos"))) for name in NAMES]


def open_bus(port, calibration_file):
    try:
        from lerobot.motors import Motor, MotorCalibration, MotorNormMode
        from lerobot.motors.feetech import FeetechMotorsBus
    except ImportError as error:
        sys.exit(f"error: the Python package {error.name} is missing; install it: pip install 'lerobot[feetech]'")
    try:
        with open(calibration_file) as file:
            entries = json.load(file)
        calibration = {name: MotorCalibration(**entries[name]) for name in NAMES}
    except (OSError, ValueError, KeyError, TypeError) as error:
        sys.exit(f"error: {calibration_file} is not a calibration of LeRobot ({error!r}); run: lerobot-calibrate")
    motors = {name: Motor(calibration[name].id, "sts3215", MotorNormMode.DEGREES) for name in NAMES}
    bus = FeetechMotorsBus(port, motors, calibration)
    try:
        bus.connect()
        is_calibrated = bus.is_calibrated
    except (ConnectionError, RuntimeError) as error:
        sys.exit(f"error: no connection to the servos on {port}: {error}")
    if not is_calibrated:
        sys.exit(f"error: the servos have another calibration than {calibration_file}; run: lerobot-calibrate")
    return bus


def main():
    parser = arguments(__doc__.splitlines()[0], rate_hz=100)
    parser.add_argument("port", help="serial port of the arm, such as /dev/ttyACM0")
    parser.add_argument("--calibration", required=True, metavar="FILE.json", help="written by lerobot-calibrate")
    args = parser.parse_args()
    bus = open_bus(args.port, args.calibration)
    sender = JointSender(args.to)
    for _ in ticks(args.rate):
        start_nanos = time.monotonic_ns()
        try:
            position = observed(bus.sync_read("Present_Position", num_retry=2))
        except (ConnectionError, RuntimeError) as error:
            sys.exit(f"error: the servos on {args.port} do not answer; check power and cable: {error}")
        middle_nanos = (start_nanos + time.monotonic_ns()) // 2
        sender.send(NAMES, position, stamp_nanos=middle_nanos, clock=sender.own_clock)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
