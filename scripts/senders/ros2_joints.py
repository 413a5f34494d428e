#!/usr/bin/env python3
"""Sends the joint states of a ROS 2 topic to fieldrig (arm.driver = "udp"). Only subscribes; moves nothing.

    source /opt/ros/jazzy/setup.bash
    scripts/senders/ros2_joints.py --topic /joint_states

The topic may contain other joints, and several nodes may publish to it. The URDF of the rig file needs the same names.
"""

from joint_sender import JointSender, RateLimit, arguments
from ros2_node import add_arguments, stamp_nanos_and_clock, subscribe


class Relay:
    """Sends messages of a topic, at most `rate_hz` per second of each set of joints."""

    def __init__(self, sender, rate_hz, is_publisher_here):
        self._sender = sender
        self._rate_hz = rate_hz
        self._is_publisher_here = is_publisher_here
        # Sets of joints are limited separately, so that a gripper does not use up the rate of the arm.
        self._limits = {}

    def on_state(self, state):
        names = tuple(state.name)
        if not self._limits.setdefault(names, RateLimit(self._rate_hz)).is_due():
            return
        stamp_nanos, clock = stamp_nanos_and_clock(state.header.stamp, self._is_publisher_here)
        self._sender.send(names, state.position, state.velocity, state.effort, stamp_nanos, clock)


def main():
    parser = arguments(__doc__.splitlines()[0], rate_hz=200)
    add_arguments(parser, topic="/joint_states")
    args = parser.parse_args()
    relay = Relay(JointSender(args.to), args.rate, args.same_computer)
    subscribe(args.topic, "sensor_msgs", "JointState", relay.on_state)


if __name__ == "__main__":
    main()
