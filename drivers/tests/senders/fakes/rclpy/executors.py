"""The part of rclpy.executors that the senders for ROS 2 use."""


class ExternalShutdownException(Exception):
    pass
