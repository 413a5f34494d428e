"""The message that ros2_base.py receives."""

from sensor_msgs.msg import Header


class Odometry:
    def __init__(self, stamp, pose):
        self.header = Header(stamp)
        self.pose = pose
