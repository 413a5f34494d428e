//! One emulated servo: its registers, its shaft and its watchdog.

use crate::servos::dynamixel::register as dynamixel;
use crate::servos::feetech::{self, register as feetech_register};
use kinematics::Stamp;
use std::time::Duration;

/// Gain of the position loop, 1/s. The shaft lags a moving goal by the velocity divided by this
/// gain.
const FOLLOWING_HZ: f64 = 40.0;
/// Speed of a servo without a speed limit, counts/s. It is that of an STS3215 at 7.4 V.
const MAX_COUNTS_S: f64 = 3400.0;
/// Length of a simulation step. It must be short compared with the time constant of the position
/// loop, which is 25 ms.
const STEP: Duration = Duration::from_millis(1);
/// Maximum time to simulate at once. After a longer time without instructions, the shaft is at its
/// goal.
const MAX_SIMULATED: Duration = Duration::from_secs(2);
/// Unit of the velocity of Dynamixel servos, counts/s.
const DYNAMIXEL_VELOCITY_COUNTS_S: f64 = 0.229 / 60.0 * 4096.0;
const WATCHDOG_UNIT: Duration = Duration::from_millis(20);
const WATCHDOG_EXPIRED: u8 = 0xFF;
/// Error of Dynamixel servos for a value that is not allowed.
const RANGE_ERROR: u8 = 4;
const ALERT: u8 = 0x80;
const N_REGISTERS: usize = 256;

/// Maker of a servo, which determines its protocol and its registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ServoKind {
    /// An STS3215.
    Feetech,
    /// An XL430-W250.
    Dynamixel,
}

/// An emulated servo.
#[derive(Clone, Debug)]
pub struct EmulatedServo {
    kind: ServoKind,
    id: u8,
    registers: Vec<u8>,
    position_counts: f64,
    velocity_counts_s: f64,
    /// Mechanical stops, counts.
    stops_counts: [f64; 2],
    /// Whether the servo has power. Without power, it does not answer.
    is_powered: bool,
    faults: u8,
    simulated_until: Option<Stamp>,
    watchdog_reset_at: Option<Stamp>,
    n_goals: u64,
}

impl EmulatedServo {
    /// Creates a disabled servo at rest.
    pub fn new(kind: ServoKind, id: u8, position_counts: i32) -> Self {
        let mut servo = Self {
            kind,
            id,
            registers: vec![0; N_REGISTERS],
            position_counts: f64::from(position_counts),
            velocity_counts_s: 0.0,
            stops_counts: [f64::NEG_INFINITY, f64::INFINITY],
            is_powered: true,
            faults: 0,
            simulated_until: None,
            watchdog_reset_at: None,
            n_goals: 0,
        };
        match kind {
            ServoKind::Feetech => {
                // Firmware 3.10, low byte first, model 777.
                servo.set(feetech_register::FIRMWARE, &[3, 10, 0, 9, 3, id]);
                servo.set(feetech_register::LIMITS, &[0, 0, 0xFF, 0x0F]);
                // Velocities are in counts per second, and a speed of 0 is full speed.
                servo.set(feetech_register::PHASE, &[0b1100]);
            }
            ServoKind::Dynamixel => {
                servo.set(dynamixel::MODEL, &1060_u16.to_le_bytes());
                servo.set(dynamixel::FIRMWARE, &[46, id]);
                // Velocity-based profiles, position mode.
                servo.set(dynamixel::DRIVE_MODE, &[0, 3]);
                servo.set(dynamixel::VELOCITY_LIMIT, &265_u32.to_le_bytes());
                servo.set(dynamixel::LIMITS, &4095_u32.to_le_bytes());
            }
        }
        servo
    }

    /// Its ID.
    pub fn id(&self) -> u8 {
        self.id
    }

    /// Current position, counts.
    pub fn position_counts(&self) -> f64 {
        self.position_counts
    }

    /// Sets the motion of the shaft, as a hand does that moves a disabled arm.
    pub fn set_motion(&mut self, position_counts: f64, velocity_counts_s: f64) {
        self.position_counts = position_counts;
        self.velocity_counts_s = velocity_counts_s;
        // Otherwise, the next step would move the shaft away from this position.
        self.simulated_until = None;
    }

    /// Sets mechanical stops. They simulate an obstacle.
    pub fn set_stops(&mut self, stops_counts: [f64; 2]) {
        self.stops_counts = stops_counts;
    }

    /// Sets the fault bits that the servo reports.
    pub fn set_faults(&mut self, faults: u8) {
        self.faults = faults;
        if self.kind == ServoKind::Dynamixel {
            self.set(dynamixel::HARDWARE_ERROR, &[faults]);
        }
    }

    /// Connects or cuts the power. The servo is disabled afterwards.
    pub fn set_powered(&mut self, is_powered: bool) {
        self.is_powered = is_powered;
        self.set(self.torque_register(), &[0]);
    }

    /// Whether the servo is enabled.
    pub fn is_enabled(&self) -> bool {
        self.register(self.torque_register()) == 1
    }

    /// Whether the watchdog has expired.
    pub fn has_watchdog_expired(&self) -> bool {
        self.kind == ServoKind::Dynamixel && self.register(dynamixel::WATCHDOG) == WATCHDOG_EXPIRED
    }

    /// Number of goals that it has accepted.
    pub fn n_goals(&self) -> u64 {
        self.n_goals
    }

    /// Writes registers as the maker's software does, for example the operating mode.
    pub fn set(&mut self, address: u16, data: &[u8]) {
        let start = usize::from(address).min(N_REGISTERS);
        let n = data.len().min(N_REGISTERS - start);
        self.registers[start..start + n].copy_from_slice(&data[..n]);
    }

    pub(super) fn is_powered(&self) -> bool {
        self.is_powered
    }

    /// The error byte of its answers.
    pub(super) fn error(&self) -> u8 {
        match self.kind {
            ServoKind::Feetech => self.faults,
            ServoKind::Dynamixel if self.faults != 0 => ALERT,
            ServoKind::Dynamixel => 0,
        }
    }

    /// The contents of registers.
    pub(super) fn read(&mut self, address: u16, len: u16) -> Vec<u8> {
        self.update_feedback();
        let start = usize::from(address).min(N_REGISTERS);
        let end = (start + usize::from(len)).min(N_REGISTERS);
        self.registers[start..end].to_vec()
    }

    /// Writes registers. Returns the error byte.
    pub(super) fn write(&mut self, address: u16, data: &[u8]) -> u8 {
        let is_goal = address == self.goal_register();
        if is_goal && self.has_watchdog_expired() {
            return self.error() | RANGE_ERROR;
        }
        let was_enabled = self.is_enabled();
        self.set(address, data);
        self.n_goals += u64::from(is_goal);
        // An enabled servo without a goal stays where it is.
        if self.is_enabled() && !was_enabled && self.kind == ServoKind::Dynamixel {
            let goal = rounded(self.position_counts);
            self.set(dynamixel::GOAL, &goal.to_le_bytes());
        }
        self.error()
    }

    /// An instruction arrived.
    pub(super) fn reset_watchdog(&mut self, now: Stamp) {
        self.watchdog_reset_at = Some(now);
    }

    /// Simulates the shaft and the watchdog up to `now`.
    pub fn advance(&mut self, now: Stamp) {
        let Some(mut at) = self.simulated_until.replace(now) else {
            return;
        };
        at = at.max(Stamp(
            now.0 - i64::try_from(MAX_SIMULATED.as_nanos()).unwrap_or(0),
        ));
        while at < now {
            let next = Stamp(at.0 + i64::try_from(STEP.as_nanos()).unwrap_or(1)).min(now);
            self.expire_watchdog(next);
            self.step(next.secs_since(at));
            at = next;
        }
    }

    fn expire_watchdog(&mut self, now: Stamp) {
        let value = self.register(dynamixel::WATCHDOG);
        let is_running =
            self.kind == ServoKind::Dynamixel && self.is_enabled() && (1..=127).contains(&value);
        let Some(reset_at) = self.watchdog_reset_at.filter(|_| is_running) else {
            return;
        };
        if now.duration_since(reset_at) > WATCHDOG_UNIT * u32::from(value) {
            self.set(dynamixel::WATCHDOG, &[WATCHDOG_EXPIRED]);
            // It stops and holds where it is.
            let here = rounded(self.position_counts);
            self.set(dynamixel::GOAL, &here.to_le_bytes());
        }
    }

    fn step(&mut self, secs: f64) {
        if !self.is_powered || !self.is_enabled() {
            return;
        }
        let max_counts_s = self.max_counts_s();
        let wanted = (self.goal_counts() - self.position_counts) * FOLLOWING_HZ;
        self.velocity_counts_s = wanted.clamp(-max_counts_s, max_counts_s);
        let moved = self.position_counts + self.velocity_counts_s * secs;
        let [lower, upper] = self.stops_counts;
        self.position_counts = moved.clamp(lower, upper);
        if !(lower..=upper).contains(&moved) {
            self.velocity_counts_s = 0.0;
        }
    }

    fn goal_counts(&self) -> f64 {
        f64::from(match self.kind {
            ServoKind::Feetech => feetech::signed(self.word(feetech_register::GOAL)),
            ServoKind::Dynamixel => self.number(dynamixel::GOAL),
        })
    }

    fn max_counts_s(&self) -> f64 {
        let limit = match self.kind {
            ServoKind::Feetech => f64::from(self.word(feetech_register::SPEED)),
            ServoKind::Dynamixel => {
                f64::from(self.number(dynamixel::PROFILE + 4)) * DYNAMIXEL_VELOCITY_COUNTS_S
            }
        };
        if limit == 0.0 {
            MAX_COUNTS_S
        } else {
            limit.min(MAX_COUNTS_S)
        }
    }

    /// Writes position and velocity to their registers.
    fn update_feedback(&mut self) {
        let position = rounded(self.position_counts);
        match self.kind {
            ServoKind::Feetech => {
                // In single-turn feedback, the encoder starts again after a turn.
                let position = feetech::encode(position.rem_euclid(4096));
                let velocity = feetech::encode(rounded(self.velocity_counts_s));
                let data = [position.to_le_bytes(), velocity.to_le_bytes()].concat();
                self.set(feetech_register::POSITION, &data);
            }
            ServoKind::Dynamixel => {
                let velocity = rounded(self.velocity_counts_s / DYNAMIXEL_VELOCITY_COUNTS_S);
                let data = [velocity.to_le_bytes(), position.to_le_bytes()].concat();
                self.set(dynamixel::VELOCITY, &data);
            }
        }
    }

    fn torque_register(&self) -> u16 {
        match self.kind {
            ServoKind::Feetech => feetech_register::TORQUE,
            ServoKind::Dynamixel => dynamixel::TORQUE,
        }
    }

    fn goal_register(&self) -> u16 {
        match self.kind {
            ServoKind::Feetech => feetech_register::GOAL,
            ServoKind::Dynamixel => dynamixel::GOAL,
        }
    }

    fn register(&self, address: u16) -> u8 {
        self.registers[usize::from(address)]
    }

    fn word(&self, address: u16) -> u16 {
        u16::from_le_bytes([self.register(address), self.register(address + 1)])
    }

    fn number(&self, address: u16) -> i32 {
        let bytes = [0, 1, 2, 3].map(|ix| self.register(address + ix));
        i32::from_le_bytes(bytes)
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "positions and velocities of a servo are far below 2^31 counts"
)]
fn rounded(counts: f64) -> i32 {
    counts.round() as i32
}
