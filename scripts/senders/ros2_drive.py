#!/usr/bin/env python3
"""Lets fieldrig drive a ROS 2 robot (base.motion.address in rig files). It publishes velocities, so the robot moves.

    source /opt/ros/jazzy/setup.bash
    scripts/senders/ros2_drive.py --odometry /odom --command /cmd_vel

The odometry (nav_msgs/Odometry) must have the twist of the frame to which the rig file attaches its cameras. Without it,
the robot does not move. The program publishes while fieldrig moves the robot, and zeros for a second afterward. It
does not replace an emergency stop, and the robot must also stop if this program ends.
"""

import argparse
import sys
import time

from base_controller import LISTEN, STOP, BaseController, address

PERIOD_SECS = 0.02
MAX_ODOMETRY_AGE_SECS = 0.5
ZEROS_SECS = 1.0  # time for which zeros are published after a motion


class Relay:
    """Publishes the velocities of the controller, and reports the measured velocities of the odometry."""

    def __init__(self, controller, publish, odometry_topic):
        self._controller = controller
        self._publish = publish
        self._topic = odometry_topic
        self._measured = STOP
        self._measured_at = None
        self._moved_at = None

    def on_odometry(self, odometry):
        twist = odometry.twist.twist
        self._measured = (twist.linear.x, twist.linear.y, twist.angular.z)
        self._measured_at = time.monotonic()

    def on_timer(self):
        now = time.monotonic()
        is_fresh = self._measured_at is not None and now - self._measured_at < MAX_ODOMETRY_AGE_SECS
        fault = None if is_fresh else f"no odometry on {self._topic} for {MAX_ODOMETRY_AGE_SECS} s"
        wanted = self._controller.wanted(self._measured, fault)
        if wanted != STOP:
            self._moved_at = now
        if self._moved_at is not None and now - self._moved_at < ZEROS_SECS:
            self._publish(wanted)

    def stop(self):
        if self._moved_at is not None:
            self._publish(STOP)


def publisher(node, topic, is_stamped, messages):
    """A function that publishes a velocity."""
    message_type = messages.TwistStamped if is_stamped else messages.Twist
    topic_publisher = node.create_publisher(message_type, topic, 10)

    def publish(velocity):
        message = message_type()
        twist = message
        if is_stamped:
            message.header.stamp = node.get_clock().now().to_msg()
            twist = message.twist
        twist.linear.x, twist.linear.y, twist.angular.z = velocity
        topic_publisher.publish(message)

    return publish


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--listen", type=address, default=LISTEN, metavar="IP:PORT",
                        help="base.motion.address in the rig file (default: 127.0.0.1:7020)")
    parser.add_argument("--odometry", default="/odom", help="default: /odom")
    parser.add_argument("--command", default="/cmd_vel", help="default: /cmd_vel")
    parser.add_argument("--stamped", action="store_true", help="publish TwistStamped instead of Twist")
    args = parser.parse_args()
    try:
        import geometry_msgs.msg
        import rclpy
        from nav_msgs.msg import Odometry
        from rclpy.executors import ExternalShutdownException
        from rclpy.qos import qos_profile_sensor_data
    except ImportError as error:
        sys.exit(f"error: the Python package {error.name} is missing; first run: source /opt/ros/jazzy/setup.bash")
    rclpy.init()
    node = rclpy.create_node("fieldrig_drive")
    controller = BaseController(args.listen)
    publish = publisher(node, args.command, args.stamped, geometry_msgs.msg)
    relay = Relay(controller, publish, args.odometry)
    node.create_subscription(Odometry, args.odometry, relay.on_odometry, qos_profile_sensor_data)
    node.create_timer(PERIOD_SECS, relay.on_timer)
    print(f"listening on port {controller.port}", flush=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        relay.stop()


if __name__ == "__main__":
    main()
