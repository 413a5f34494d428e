"""The messages of geometry_msgs that ros2_drive.py uses."""


class Vector3:
    def __init__(self):
        self.x = self.y = self.z = 0.0


class Twist:
    def __init__(self):
        self.linear, self.angular = Vector3(), Vector3()
