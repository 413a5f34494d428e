"""The part of rclpy.qos that the senders for ROS 2 use."""

qos_profile_sensor_data = object()
