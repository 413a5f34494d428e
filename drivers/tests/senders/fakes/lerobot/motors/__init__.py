"""The part of lerobot.motors that lerobot_joints.py uses."""

from dataclasses import dataclass
from enum import Enum


class MotorNormMode(Enum):
    DEGREES = "degrees"


@dataclass
class MotorCalibration:
    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int


@dataclass
class Motor:
    id: int
    model: str
    norm_mode: MotorNormMode
