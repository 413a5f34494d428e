#!/usr/bin/env python3
"""Sends the joint states of a ROS 2 topic to fieldrig (arm.driver = "udp"). Only subscribes; moves nothing.

    source /opt/ros/jazzy/setup.bash
    scripts/senders/ros2_joints.py --topic /joint_states

The topic may contain other joints, and several nodes may publish to it. The URDF of the rig file needs the same names.
"""

import sys
import time

from joint_sender import JointSender, arguments


class Relay:
    """Sends messages of a topic, at most `rate_hz` per second of each set of joints."""

    def __init__(self, sender, rate_hz, is_publisher_here):
        self._sender = sender
        self._period_secs = 1 / rate_hz
        self._is_publisher_here = is_publisher_here
        # Sets of joints are counted separately, so that a gripper does not use up the rate of the arm.
        self._next_secs = {}

    def on_state(self, state):
        now_secs = time.monotonic()
        names = tuple(state.name)
        next_secs = self._next_secs.get(names, now_secs)
        if now_secs < next_secs:
            return
        self._next_secs[names] = max(next_secs + self._period_secs, now_secs)
        stamp_nanos, clock = self._stamp(state.header.stamp)
        self._sender.send(names, state.position, state.velocity, state.effort, stamp_nanos, clock)

    def _stamp(self, stamp):
        nanos = stamp.sec * 1_000_000_000 + stamp.nanosec
        if nanos == 0:  # The publisher sets no stamp, so the time of arrival is used.
            return None, "device"
        if self._is_publisher_here:
            return nanos + time.monotonic_ns() - time.time_ns(), "monotonic"
        return nanos, "device"


def main():
    parser = arguments(__doc__.splitlines()[0], rate_hz=200)
    parser.add_argument("--topic", default="/joint_states", help="default: /joint_states")
    parser.add_argument("--same-computer", action="store_true",
                        help="publisher, this program and fieldrig use the time of day of one computer: convert stamps "
                        "exactly, instead of letting fieldrig estimate how the clocks are related")
    args = parser.parse_args()
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
    except ImportError as error:
        sys.exit(f"error: the Python package {error.name} is missing; first run: source /opt/ros/jazzy/setup.bash")
    rclpy.init()
    node = rclpy.create_node("fieldrig_joint_sender")
    relay = Relay(JointSender(args.to), args.rate, args.same_computer)
    # This profile also accepts publishers that are reliable.
    node.create_subscription(JointState, args.topic, relay.on_state, qos_profile_sensor_data)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
