"""The part of lerobot.motors.feetech that lerobot_joints.py uses. The arm stands in one pose."""

from . import MotorNormMode

# Readings of the servos with IDs 1 to 5, 0 to 4095 for one turn.
POSITIONS = [2048, 1024, 3000, 2100, 2047]


class FeetechMotorsBus:
    def __init__(self, port, motors, calibration):
        self.port = port
        self.motors = motors
        self.calibration = calibration

    def connect(self):
        if self.port != "/dev/arm":
            raise ConnectionError(f"could not open {self.port}")

    @property
    def is_calibrated(self):
        return self.calibration["shoulder_pan"].homing_offset == -12

    def sync_read(self, name, num_retry):
        assert name == "Present_Position", name
        assert num_retry >= 0
        return {joint: self._degrees(joint, motor) for joint, motor in self.motors.items()}

    def _degrees(self, joint, motor):
        assert (motor.model, motor.norm_mode) == ("sts3215", MotorNormMode.DEGREES)
        middle = (self.calibration[joint].range_min + self.calibration[joint].range_max) / 2
        return (POSITIONS[motor.id - 1] - middle) * 360 / 4095
