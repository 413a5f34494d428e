"""The message of nav_msgs that ros2_drive.py uses."""

from geometry_msgs.msg import Twist


class TwistWithCovariance:
    def __init__(self):
        self.twist = Twist()


class Odometry:
    def __init__(self):
        self.twist = TwistWithCovariance()
