"""The parts of a pose that ros2_base.py receives."""

from collections import namedtuple

Point = namedtuple("Point", "x y z")
Quaternion = namedtuple("Quaternion", "x y z w")
Pose = namedtuple("Pose", "position orientation")
PoseWithCovariance = namedtuple("PoseWithCovariance", "pose covariance")
