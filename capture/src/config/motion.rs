//! The keys in `[arm.motion]`, which define how an arm may be moved.

use super::section::Section;
use super::values::{is, name_of, table};
use drivers::motion::OnLoss;
use toml::{Table, Value};

/// How an arm may be moved; an arm without this table is only read.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmMotion {
    /// Fail-safe behavior of the motors when communication with this computer is lost.
    pub on_loss: OnLoss,
    /// Time without communication until then, milliseconds, 5 to 2000.
    pub timeout_millis: f64,
    /// Time from rest to [`max_speed_rad_s`](super::Arm::max_speed_rad_s) at full acceleration, seconds, 0.01 to 10.
    pub acceleration_secs: f64,
    /// Time from rest to full acceleration, seconds, 0.001 to 10.
    pub jerk_secs: f64,
    /// Whether motors without a watchdog may be moved.
    pub accept_no_watchdog: bool,
    /// External torques at which a Franka arm stops, Nm, in the order of its joints, 1 to 100; `None` here and below:
    /// the driver's default.
    pub contact_torque_nm: Option<[f64; 7]>,
    /// External forces at the end effector at which it stops, along x, y and z of the robot base, N, 1 to 100.
    pub contact_force_n: Option<[f64; 3]>,
    /// External moments about the same axes at which it stops, Nm, 1 to 100.
    pub contact_moment_nm: Option<[f64; 3]>,
    /// Joint stiffness of a Franka arm, Nm/rad, in the order of its joints, 10 to 14,250.
    pub stiffness_nm_rad: Option<[f64; 7]>,
    /// Path of ODrive's `flat_endpoints.json`; empty if not given.
    pub odrive_endpoints: String,
}

const ON_LOSS: [(&str, OnLoss); 3] = [("hold", OnLoss::Hold), ("damp", OnLoss::Damp), ("release", OnLoss::Release)];

pub(super) fn read(mut keys: Section<'_>) -> Option<ArmMotion> {
    let on_loss = keys.choice("on_loss", &ON_LOSS);
    if on_loss.is_none() {
        keys.missing("on_loss", "hold, damp or release: what the motors do when communication is lost");
    }
    let timeout_millis = keys.number("timeout_millis", 5.0..=2000.0).unwrap_or(100.0);
    let acceleration_secs = keys.number("acceleration_secs", 0.01..=10.0).unwrap_or(0.5);
    let jerk_secs = keys.number("jerk_secs", 0.001..=10.0).unwrap_or(0.1);
    let accept_no_watchdog = keys.flag("accept_no_watchdog").unwrap_or(false);
    let contact_torque_nm = keys.numbers("contact_torque_nm", 1.0..=100.0);
    let contact_force_n = keys.numbers("contact_force_n", 1.0..=100.0);
    let contact_moment_nm = keys.numbers("contact_moment_nm", 1.0..=100.0);
    let stiffness_nm_rad = keys.numbers("stiffness_nm_rad", 10.0..=14250.0);
    let odrive_endpoints = keys.text("odrive_endpoints").unwrap_or_default();
    keys.end();
    Some(ArmMotion {
        on_loss: on_loss?,
        timeout_millis,
        acceleration_secs,
        jerk_secs,
        accept_no_watchdog,
        contact_torque_nm,
        contact_force_n,
        contact_moment_nm,
        stiffness_nm_rad,
        odrive_endpoints,
    })
}

pub(super) fn write(motion: &ArmMotion) -> Table {
    table([
        ("on_loss", name_of(&ON_LOSS, &motion.on_loss)),
        ("timeout_millis", is(motion.timeout_millis)),
        ("acceleration_secs", is(motion.acceleration_secs)),
        ("jerk_secs", is(motion.jerk_secs)),
        ("accept_no_watchdog", is(motion.accept_no_watchdog)),
        ("contact_torque_nm", numbers(&motion.contact_torque_nm)),
        ("contact_force_n", numbers(&motion.contact_force_n)),
        ("contact_moment_nm", numbers(&motion.contact_moment_nm)),
        ("stiffness_nm_rad", numbers(&motion.stiffness_nm_rad)),
        ("odrive_endpoints", is(motion.odrive_endpoints.as_str())),
    ])
}

fn numbers<const N: usize>(numbers: &Option<[f64; N]>) -> Option<Value> {
    numbers.as_ref().map(|numbers| Value::from(numbers.to_vec()))
}
