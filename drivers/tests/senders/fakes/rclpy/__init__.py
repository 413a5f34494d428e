"""The part of rclpy that ros2_joints.py uses. Two nodes publish: one for an arm and one for its gripper."""

import time
from array import array

from sensor_msgs.msg import JointState, Stamp

PERIOD_SECS = 0.002


class Node:
    def create_subscription(self, message_type, topic, callback, _qos):
        assert message_type is JointState, message_type
        assert topic == "/arm/joint_states", topic
        self.callback = callback


def init():
    pass


def create_node(_name):
    return Node()


def spin(node):
    while True:
        nanos = time.time_ns()
        stamp = Stamp(nanos // 1_000_000_000, nanos % 1_000_000_000)
        # rclpy passes sequences of numbers as arrays.
        node.callback(
            JointState(stamp, ["c", "extra", "a", "b"], array("d", [0.3, 9.0, 0.1, 0.2]), array("d", [3.0, 9.0, 1.0, 2.0]))
        )
        node.callback(JointState(stamp, ["finger"], array("d", [0.04]), array("d")))
        time.sleep(PERIOD_SECS)
