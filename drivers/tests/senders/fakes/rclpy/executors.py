"""The part of rclpy.executors that ros2_joints.py uses."""


class ExternalShutdownException(Exception):
    pass
