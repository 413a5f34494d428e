"""The part of rclpy.executors that ros2_drive.py uses."""


class ExternalShutdownException(Exception):
    pass
