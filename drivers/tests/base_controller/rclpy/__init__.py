"""The part of rclpy that ros2_drive.py uses. The robot reaches the last published velocity immediately, and its
odometry reports it. Nothing is published before the first command."""

import time

from nav_msgs.msg import Odometry


class Node:
    def create_publisher(self, _message_type, topic, _depth):
        assert topic == "/cmd_vel"
        return self

    def create_subscription(self, _message_type, topic, callback, _qos):
        assert topic == "/odom"
        self.report = callback
        self.odometry = Odometry()

    def create_timer(self, period_secs, callback):
        self.period_secs, self.on_timer = period_secs, callback

    def publish(self, twist):
        self.odometry.twist.twist = twist


def init():
    pass


def create_node(_name):
    return Node()


def spin(node):
    while True:
        node.report(node.odometry)
        node.on_timer()
        time.sleep(node.period_secs)
