//! The part that emulated motors of all families share: a drive that moves the shaft, with
//! settings, faults and a watchdog.

use super::shaft::{Actuation, Shaft};
use crate::wire::can::mit::{Command, Limits, Motion};
use kinematics::Stamp;
use std::collections::BTreeMap;

/// Control state of a motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Disabled: the shaft turns freely.
    Free,
    /// Enabled: the motor executes its last command.
    Enabled,
    /// Stopped by the watchdog or a quick stop: the motor holds its position.
    Holding,
}

/// The drive of an emulated motor.
#[derive(Debug)]
pub struct EmulatedDrive {
    /// Ranges of the motor's raw values.
    pub(in crate::can) limits: Limits,
    shaft: Shaft,
    pub(in crate::can) actuation: Actuation,
    now: Option<Stamp>,
    /// Time up to which the shaft has been simulated.
    simulated_until: Option<Stamp>,
    /// Registers, parameters, endpoints or objects that were written, by number.
    settings: BTreeMap<u32, u32>,
    pub(super) ignores_timeout: bool,
    /// Time at which the watchdog was last reset. The next field is the time at which it last
    /// expired.
    pub(super) watchdog_reset_at: Option<Stamp>,
    pub(super) timed_out_at: Option<Stamp>,
    /// Fault bits in the numbering of the family.
    pub(in crate::can) faults: u32,
    pub(in crate::can) target: Option<Command>,
}

impl EmulatedDrive {
    /// Creates a disabled drive at rest at position 0.
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            limits,
            shaft: Shaft::at_rest(),
            actuation: Actuation::Free,
            now: None,
            simulated_until: None,
            settings: BTreeMap::new(),
            ignores_timeout: false,
            watchdog_reset_at: None,
            timed_out_at: None,
            faults: 0,
            target: None,
        }
    }

    pub(super) fn set_motion(&mut self, motion: Motion) {
        self.shaft.motion = motion;
        // Otherwise, the next step would simulate the time since the previous step and move the
        // shaft away from the position that was just set.
        self.simulated_until = None;
    }

    /// Sets mechanical stops of the shaft.
    pub(super) fn set_stops(&mut self, stops_rad: [f64; 2]) {
        self.shaft.stops_rad = stops_rad;
    }

    /// Current motion of the shaft.
    pub(in crate::can) fn motion(&self) -> Motion {
        self.shaft.motion
    }

    /// Advances the simulation of the shaft to `now`.
    pub(super) fn advance(&mut self, now: Stamp) {
        self.now = Some(now);
        if let Some(before) = self.simulated_until.replace(now) {
            self.shaft
                .advance(now.secs_since(before), &self.actuation, &self.limits);
        }
    }

    /// Control state of the motor.
    pub(in crate::can) fn state(&self) -> State {
        match self.actuation {
            Actuation::Free => State::Free,
            Actuation::Mit(_) | Actuation::Follow(_) => State::Enabled,
            Actuation::Stop => State::Holding,
        }
    }

    /// Resets the watchdog.
    pub(in crate::can) fn reset_watchdog(&mut self) {
        self.watchdog_reset_at = self.now;
    }

    /// Follows an MIT-mode command if the motor is enabled.
    pub(in crate::can) fn obey(&mut self, command: Command) {
        // A command resets the watchdog only if the motor follows it. Polling a disabled motor must
        // not count as commanding it.
        if self.state() == State::Enabled {
            self.actuation = Actuation::Mit(command);
            self.target = Some(command);
            self.reset_watchdog();
        }
    }

    /// Writes a setting. Does nothing if the setting is a timeout and the motor ignores timeouts.
    pub(in crate::can) fn set(&mut self, number: u32, value: u32, is_timeout: bool) {
        if !(is_timeout && self.ignores_timeout) {
            self.settings.insert(number, value);
        }
    }

    pub(in crate::can) fn setting(&self, number: u32) -> Option<u32> {
        self.settings.get(&number).copied()
    }

    /// Enables the motor, holding the current position.
    pub(in crate::can) fn switch_on(&mut self) {
        self.actuation = Actuation::Mit(Command {
            position_rad: self.shaft.motion.position_rad,
            ..Command::default()
        });
        self.reset_watchdog();
    }
}
