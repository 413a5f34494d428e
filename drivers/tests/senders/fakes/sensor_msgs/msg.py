"""The message that ros2_joints.py receives."""

from array import array


class Stamp:
    def __init__(self, sec, nanosec):
        self.sec = sec
        self.nanosec = nanosec


class Header:
    def __init__(self, stamp):
        self.stamp = stamp


class JointState:
    def __init__(self, stamp, name, position, velocity):
        self.header = Header(stamp)
        self.name = name
        self.position = position
        self.velocity = velocity
        self.effort = array("d")
