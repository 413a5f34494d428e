#!/usr/bin/env python3
"""Sends the poses of a ROS 2 topic of odometry to fieldrig (base.driver = "udp"). Only subscribes; moves nothing.

    source /opt/ros/jazzy/setup.bash
    scripts/senders/ros2_base.py --topic /odometry/filtered

The messages (nav_msgs/Odometry) must have the pose of the frame to which the rig file attaches its cameras.
"""

from joint_sender import DatagramSender, RateLimit, arguments
from ros2_node import add_arguments, stamp_nanos_and_clock, subscribe

DEFAULT_ADDRESS = ("127.0.0.1", 7009)  # default of base.address in rig files


class Relay:
    """Sends messages of a topic, at most `rate_hz` per second."""

    def __init__(self, sender, rate_hz, is_publisher_here):
        self._sender = sender
        self._limit = RateLimit(rate_hz)
        self._is_publisher_here = is_publisher_here

    def on_odometry(self, odometry):
        if not self._limit.is_due():
            return
        stamp_nanos, clock = stamp_nanos_and_clock(odometry.header.stamp, self._is_publisher_here)
        self._sender.send("base", _fields(odometry.pose), stamp_nanos, clock)


def _fields(with_covariance):
    position, rotation = with_covariance.pose.position, with_covariance.pose.orientation
    fields = {
        "world_from_base": {
            "xyz_m": [position.x, position.y, position.z],
            "quat_xyzw": [rotation.x, rotation.y, rotation.z, rotation.w],
        }
    }
    covariance = list(with_covariance.covariance)
    # Publishers that know no covariance send zeros.
    if any(covariance):
        fields["covariance"] = covariance
    return fields


def main():
    parser = arguments(__doc__.splitlines()[0], rate_hz=100, address=DEFAULT_ADDRESS, key="base.address")
    add_arguments(parser, topic="/odom")
    args = parser.parse_args()
    relay = Relay(DatagramSender(args.to), args.rate, args.same_computer)
    subscribe(args.topic, "nav_msgs", "Odometry", relay.on_odometry)


if __name__ == "__main__":
    main()
