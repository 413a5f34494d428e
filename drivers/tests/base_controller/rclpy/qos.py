"""The part of rclpy.qos that ros2_drive.py uses."""

qos_profile_sensor_data = object()
