"""The part of rclpy that the senders for ROS 2 use. Two nodes publish joint states, for an arm and for its gripper, and
one publishes odometry."""

import time
from array import array

from geometry_msgs.msg import Point, Pose, PoseWithCovariance, Quaternion
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState, Stamp

PERIOD_SECS = 0.002


class Node:
    def create_subscription(self, message_type, topic, callback, _qos):
        self.publish = {(JointState, "/arm/joint_states"): publish_joints, (Odometry, "/odom"): publish_odometry}[
            message_type, topic
        ]
        self.callback = callback


def init():
    pass


def create_node(_name):
    return Node()


def publish_joints(callback, stamp):
    # rclpy passes sequences of numbers as arrays.
    callback(
        JointState(stamp, ["c", "extra", "a", "b"], array("d", [0.3, 9.0, 0.1, 0.2]), array("d", [3.0, 9.0, 1.0, 2.0]))
    )
    callback(JointState(stamp, ["finger"], array("d", [0.04]), array("d")))


def publish_odometry(callback, stamp):
    pose = Pose(Point(1.25, -0.5, 0.0), Quaternion(0.0, 0.0, 0.6, 0.8))
    callback(Odometry(stamp, PoseWithCovariance(pose, array("d", [0.0] * 36))))


def spin(node):
    while True:
        nanos = time.time_ns()
        node.publish(node.callback, Stamp(nanos // 1_000_000_000, nanos % 1_000_000_000))
        time.sleep(PERIOD_SECS)
