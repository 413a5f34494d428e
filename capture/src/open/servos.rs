//! Opens arms with servos on a serial bus.

use crate::config::Rig;
#[cfg(target_os = "linux")]
use crate::config::{ArmDriver, ArmSerial, ArmServo};
use drivers::Arm;
#[cfg(target_os = "linux")]
use drivers::motion::{MotionConfig, MovableArm};
#[cfg(target_os = "linux")]
use drivers::servos::{
    DynamixelProtocol, FeetechProtocol, MovableServoArm, MovableServoArmConfig, PortConfig,
    ServoArm, ServoArmConfig, ServoConfig, ServoProtocol,
};
#[cfg(target_os = "linux")]
use std::time::Duration;

/// The servo arm of a rig.
#[cfg(target_os = "linux")]
pub(crate) fn servo_config(rig: &Rig) -> ServoArmConfig {
    let protocol: &'static dyn ServoProtocol = match rig.arm.driver {
        ArmDriver::Dynamixel => &DynamixelProtocol,
        _ => &FeetechProtocol,
    };
    let ArmSerial {
        device,
        baud_hz,
        reconnect_secs,
        ..
    } = &rig.arm.serial;
    ServoArmConfig {
        protocol,
        port: PortConfig {
            device: device.into(),
            baud_hz: *baud_hz,
            reconnect_for: Duration::from_secs_f64(*reconnect_secs),
            max_answer_delay: PortConfig::MAX_ANSWER_DELAY,
        },
        servos: rig.arm.servos.iter().map(servo).collect(),
        rate_hz: rig.arm.rate_hz,
    }
}

#[cfg(target_os = "linux")]
fn servo(servo: &ArmServo) -> ServoConfig {
    ServoConfig {
        joint: servo.joint.clone(),
        id: servo.id,
        zero_counts: servo.zero_counts,
        is_reversed: servo.is_reversed,
        gear_ratio: servo.gear_ratio,
        following: servo.following,
    }
}

/// Opens the arm for reading.
#[cfg(target_os = "linux")]
pub(super) fn servo_arm(rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    Ok(Box::new(ServoArm::open(&servo_config(rig))?))
}

/// Opens the arm for motion.
#[cfg(target_os = "linux")]
pub(super) fn movable_servo_arm(
    rig: &Rig,
    motion: MotionConfig,
) -> anyhow::Result<Box<dyn MovableArm>> {
    Ok(Box::new(MovableServoArm::open(&movable_config(
        rig, motion,
    ))?))
}

/// Checks the motion settings as far as possible without the arm.
#[cfg(target_os = "linux")]
pub(super) fn check_motion(rig: &Rig, motion: MotionConfig) -> anyhow::Result<()> {
    Ok(MovableServoArm::check(&movable_config(rig, motion))?)
}

#[cfg(target_os = "linux")]
fn movable_config(rig: &Rig, motion: MotionConfig) -> MovableServoArmConfig {
    MovableServoArmConfig {
        arm: servo_config(rig),
        motion,
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn servo_arm(_rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    anyhow::bail!("arms with servos can only be read on Linux")
}
