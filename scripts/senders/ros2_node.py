"""What the senders for ROS 2 have in common: flags, stamps, and the subscription to a topic."""

import importlib
import sys
import time


def add_arguments(parser, topic):
    """Adds the flags of senders for ROS 2."""
    parser.add_argument("--topic", default=topic, help=f"default: {topic}")
    parser.add_argument("--same-computer", action="store_true",
                        help="publisher, this program and fieldrig use the time of day of one computer: convert stamps "
                        "exactly, instead of letting fieldrig estimate how the clocks are related")


def stamp_nanos_and_clock(stamp, is_publisher_here):
    """The stamp of a message for fieldrig, in nanoseconds, and its clock. None if the message has no stamp."""
    nanos = stamp.sec * 1_000_000_000 + stamp.nanosec
    if nanos == 0:  # The publisher sets no stamp, so the time of arrival is used.
        return None, "device"
    if is_publisher_here:
        return nanos + time.monotonic_ns() - time.time_ns(), "monotonic"
    return nanos, "device"


def subscribe(topic, package, message, callback):
    """Calls callback with each message of a topic until the program is interrupted."""
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException
        from rclpy.qos import qos_profile_sensor_data

        message_type = getattr(importlib.import_module(f"{package}.msg"), message)
    except ImportError as error:
        sys.exit(f"error: the Python package {error.name} is missing; first run: source /opt/ros/jazzy/setup.bash")
    rclpy.init()
    node = rclpy.create_node("fieldrig_sender")
    # This profile also accepts publishers that are reliable.
    node.create_subscription(message_type, topic, callback, qos_profile_sensor_data)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
