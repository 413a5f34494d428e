//! The servos of an arm that is moved: prepares and enables them, exchanges setpoints and readings
//! with them in each cycle, and applies the fail-safe.

use super::arm::state;
use super::bus::{BusCounts, ServoBus};
use super::config::MovableServoArmConfig;
use super::packet::{Instruction, Status};
use super::plan;
use super::protocol::{Block, ServoError, ServoProtocol, write};
use super::servo::{Reading, Servo, joint_error, servo_error};
use crate::motion::{MotionLimits, OnLoss, Setpoint};
use crate::{Error, clock};
use kinematics::{JointState, Stamp};
use std::time::Duration;

/// Largest speed of a servo, relative to the speed limit of its joint. The servo must be faster
/// than its setpoints, so that it can catch up. Any larger speed would be a fault of the command.
const SPEED_RESERVE: f64 = 2.0;
/// Part of a cycle that is left for delays of adapter and computer.
const MAX_BUS_LOAD_FRAC: f64 = 0.7;
/// Cycles between two checks of whether a servo still follows commands. The servos take turns. A
/// check is an exchange of its own, so checking all servos in each cycle would lower the rate.
const VITALS_INTERVAL: u64 = 4;
/// A servo counts as silent only after this many cycles without an answer, so that a few disturbed
/// packets at a high rate do not stop the arm.
const MIN_MISSED_CYCLES: u64 = 3;

/// Enabled servos on an open bus.
#[derive(Debug)]
pub(super) struct MovedServos {
    bus: ServoBus,
    protocol: &'static dyn ServoProtocol,
    servos: Vec<Servo>,
    ids: Vec<u8>,
    period: Duration,
    latest: Vec<Option<Reading>>,
    /// Time and cycle of the last answer of each servo.
    last_heard: Vec<(Stamp, u64)>,
    /// The last answer that reported a fault, with the index of its servo, since the last check.
    faulty: Option<(usize, Status)>,
    /// Last commanded position of each joint.
    sent_rad: Vec<f64>,
    cycle_ix: u64,
}

impl MovedServos {
    /// Opens the bus, finds all servos, and checks that they can be moved. Changes nothing.
    ///
    /// # Errors
    /// If a servo does not answer, reports a fault, or is in an unsuitable mode.
    pub(super) fn find(config: &MovableServoArmConfig) -> Result<Self, Error> {
        let arm = &config.arm;
        let mut bus = ServoBus::open(&arm.port, arm.protocol.format())?;
        let servos = Servo::find_all(&mut bus, arm)?;
        for servo in &servos {
            if let Some(problem) = &servo.info.mode_problem {
                return Err(joint_error(&servo.config, bus.device(), problem.clone()));
            }
        }
        let ids = arm.ids();
        let period = period(&bus, arm.protocol, &ids, arm.rate_hz);
        plan::check_timeout(config.motion.timeout, period)?;
        let n = servos.len();
        let mut found = Self {
            bus,
            protocol: arm.protocol,
            servos,
            ids,
            period,
            latest: vec![None; n],
            last_heard: vec![(clock::now(), 0); n],
            faulty: None,
            sent_rad: vec![0.0; n],
            cycle_ix: 0,
        };
        found.measure()?;
        Ok(found)
    }

    /// Period of the cycle, which the speed of the bus limits.
    pub(super) fn period(&self) -> Duration {
        self.period
    }

    pub(super) fn n_cycles(&self) -> u64 {
        self.cycle_ix
    }

    pub(super) fn counts(&self) -> BusCounts {
        self.bus.counts()
    }

    /// The limits of the joints, clipped to the ranges that the servos accept.
    pub(super) fn limits(&self, joints: &[MotionLimits]) -> Vec<MotionLimits> {
        let clipped = |(servo, joint): (&Servo, &MotionLimits)| {
            let [lower, upper] = servo.range_rad();
            MotionLimits {
                position: [joint.position[0].max(lower), joint.position[1].min(upper)],
                ..*joint
            }
        };
        self.servos.iter().zip(joints).map(clipped).collect()
    }

    /// Positions of all joints; `None` if some have not been read.
    pub(super) fn positions(&self) -> Option<Vec<f64>> {
        self.latest
            .iter()
            .map(|reading| reading.map(|reading| reading.position_rad))
            .collect()
    }

    /// Reads all servos until each has answered.
    fn measure(&mut self) -> Result<(), Error> {
        const N_ATTEMPTS: usize = 5;
        for _ in 0..N_ATTEMPTS {
            let is_complete = self.read()?.is_some();
            self.check_faults()?;
            if is_complete {
                return Ok(());
            }
        }
        let silent = self.latest.iter().position(Option::is_none).unwrap_or(0);
        Err(self.fault(silent, "the servo reported no position".to_owned()))
    }

    /// Enables the servos, which hold their positions. If a servo cannot be enabled, those that
    /// this call has enabled are disabled again.
    ///
    /// # Errors
    /// If a servo does not accept a value.
    pub(super) fn enable(
        &mut self,
        limits: &[MotionLimits],
        timeout: Duration,
    ) -> Result<(), Error> {
        let mut newly_enabled = Vec::new();
        let result = self.try_enable(limits, timeout, &mut newly_enabled);
        if result.is_err() {
            // A servo that was enabled before may hold the arm, so it is left as it was.
            for ix in newly_enabled {
                let _ = self.set_torque(ix, false);
            }
        }
        result
    }

    fn try_enable(
        &mut self,
        limits: &[MotionLimits],
        timeout: Duration,
        newly_enabled: &mut Vec<usize>,
    ) -> Result<(), Error> {
        for (ix, joint) in limits.iter().enumerate() {
            let servo = &self.servos[ix];
            let max_counts_s = SPEED_RESERVE * servo.counts_s(joint.velocity);
            self.protocol
                .prepare(&mut self.bus, self.ids[ix], &servo.info, max_counts_s)
                .map_err(|error| servo_error(&servo.config, self.bus.device(), error))?;
        }
        // The goals come first, because a servo moves to its goal as soon as it is enabled. Some
        // Feetech servos are already enabled by a goal.
        self.measure()?;
        let positions = self.positions().unwrap_or_default();
        for ix in 0..self.servos.len() {
            let is_enabled = self
                .bus
                .read(self.ids[ix], self.protocol.torque_address(), 1)?
                .is_some_and(|status| status.data == [1]);
            if !is_enabled {
                newly_enabled.push(ix);
            }
        }
        self.send_goals(&positions)?;
        for ix in 0..self.servos.len() {
            self.set_torque(ix, true)?;
            // While they were disabled, some servos ignore goals.
            self.send_goals(&positions)?;
        }
        // A watchdog that holds is also started if the arm is to be released: holding is better
        // than following an old command.
        if self.protocol.watchdog_address().is_some() {
            // The watchdogs are started last, because enabling the servos may take longer than
            // their timeout.
            for ix in 0..self.servos.len() {
                self.protocol
                    .set_watchdog(&mut self.bus, self.ids[ix], Some(timeout))
                    .map_err(|error| self.error_of(ix, error))?;
            }
        }
        let now = clock::now();
        self.last_heard.fill((now, self.cycle_ix));
        Ok(())
    }

    /// Reads all servos, and checks that they answer, follow, and report no fault. Returns the
    /// state if all joints were read.
    ///
    /// # Errors
    /// If a check fails, or the port was disconnected.
    pub(super) fn read_and_check(
        &mut self,
        max_silence: Duration,
    ) -> Result<Option<JointState>, Error> {
        self.cycle_ix += 1;
        let joint_state = self.read()?;
        self.check_faults()?;
        self.check_vitals()?;
        for (ix, servo) in self.servos.iter().enumerate() {
            let Some(reading) = self.latest[ix] else {
                continue;
            };
            let following = &servo.config.following;
            if let Some(violation) =
                following.violation(self.sent_rad[ix], reading.position_rad, None)
            {
                return Err(self.fault(ix, violation));
            }
        }
        self.check_silence(max_silence)?;
        Ok(joint_state)
    }

    /// Reads all servos. Returns the state if all joints were read. Faults of servos are checked
    /// later.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub(super) fn read(&mut self) -> Result<Option<JointState>, Error> {
        let Block { address, len } = self.protocol.feedback_block();
        let answers = self.bus.sync_read(address, len, &self.ids)?;
        let mut readings = Vec::with_capacity(self.servos.len());
        for (ix, status) in answers.statuses.into_iter().enumerate() {
            let Some(status) = status else { continue };
            let reading = self.servos[ix].reading(self.protocol, &status);
            if self.protocol.has_fault(&status) {
                self.faulty = Some((ix, status));
            }
            if let Some(reading) = reading {
                self.latest[ix] = Some(reading);
                self.last_heard[ix] = (answers.stamp, self.cycle_ix);
                readings.push(reading);
            }
        }
        let is_complete = readings.len() == self.servos.len();
        Ok(is_complete.then(|| state(answers.stamp, &readings)))
    }

    /// Returns an error if a servo has reported a fault since the last check.
    fn check_faults(&mut self) -> Result<(), Error> {
        let Some((ix, status)) = self.faulty.take() else {
            return Ok(());
        };
        let faults = self.protocol.faults(&mut self.bus, &status)?;
        Err(self.fault(ix, format!("the servo reports: {faults}")))
    }

    /// Checks whether the servo whose turn it is still follows commands.
    fn check_vitals(&mut self) -> Result<(), Error> {
        if !self.cycle_ix.is_multiple_of(VITALS_INTERVAL) {
            return Ok(());
        }
        let turn = (self.cycle_ix / VITALS_INTERVAL) % self.servos.len() as u64;
        let ix = usize::try_from(turn).unwrap_or(0);
        let Block { address, len } = self.protocol.vitals_block();
        // A missing answer counts as silence, which the next exchanges show, too.
        let status = self.bus.read_once(self.ids[ix], address, len)?;
        match status.and_then(|status| self.protocol.vitals_problem(&status.data)) {
            Some(problem) => Err(self.fault(ix, problem)),
            None => Ok(()),
        }
    }

    fn check_silence(&self, max_silence: Duration) -> Result<(), Error> {
        let now = clock::now();
        for (ix, (heard, cycle_ix)) in self.last_heard.iter().enumerate() {
            let silence = now.duration_since(*heard);
            if silence > max_silence && self.cycle_ix - cycle_ix > MIN_MISSED_CYCLES {
                let millis = 1e3 * silence.as_secs_f64();
                return Err(self.fault(ix, format!("no answer from the servo for {millis:.0} ms")));
            }
        }
        Ok(())
    }

    /// Sends each servo its setpoint.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub(super) fn command(&mut self, setpoint: &Setpoint) -> Result<(), Error> {
        self.send_goals(&setpoint.position)
    }

    fn send_goals(&mut self, positions_rad: &[f64]) -> Result<(), Error> {
        let goals: Vec<_> = self
            .servos
            .iter()
            .zip(positions_rad)
            .map(|(servo, position_rad)| {
                let counts = servo.counts(*position_rad);
                (servo.config.id, self.protocol.goal(counts))
            })
            .collect();
        // The following error is measured against these positions.
        self.sent_rad = positions_rad.to_vec();
        self.bus.sync_write(self.protocol.goal_address(), &goals)
    }

    /// Applies `on_loss` to all servos.
    ///
    /// * `is_blocked`: whether a joint may be blocked. The servos then hold where they are. Holding
    ///   their last goals would push against the obstacle.
    ///
    /// Returns the joints whose servos have not confirmed it. Errors of the port are not returned,
    /// because the remaining servos must still get their command.
    pub(super) fn apply(&mut self, on_loss: OnLoss, is_blocked: bool) -> Vec<String> {
        match on_loss {
            OnLoss::Release => self.release(),
            OnLoss::Hold | OnLoss::Damp => {
                let here = self.positions().filter(|_| is_blocked);
                if let Some(positions) = &here {
                    let _ = self.send_goals(positions);
                }
                self.stop_watchdogs();
                // A servo whose watchdog had expired has refused the first goal.
                if let Some(positions) = &here {
                    let _ = self.send_goals(positions);
                }
                Vec::new()
            }
        }
    }

    /// Disables all servos. Returns the joints whose servos have not confirmed it.
    fn release(&mut self) -> Vec<String> {
        // All servos are disabled at the same time. Otherwise, the arm would swing around the
        // joints that are still held.
        let off: Vec<_> = self.ids.iter().map(|id| (*id, vec![0])).collect();
        let _ = self.bus.sync_write(self.protocol.torque_address(), &off);
        let mut unconfirmed = Vec::new();
        for (servo, id) in self.servos.iter().zip(&self.ids) {
            let contents = self.bus.read_once(*id, self.protocol.torque_address(), 1);
            if !contents.is_ok_and(|status| status.is_some_and(|status| status.data == [0])) {
                unconfirmed.push(servo.config.joint.clone());
            }
        }
        self.stop_watchdogs();
        unconfirmed
    }

    /// Stops the watchdogs, so that other programs can command the servos afterwards. An expired
    /// watchdog makes a servo refuse all goals.
    fn stop_watchdogs(&mut self) {
        let Some(address) = self.protocol.watchdog_address() else {
            return;
        };
        let off: Vec<_> = self.ids.iter().map(|id| (*id, vec![0])).collect();
        // Servos do not confirm this instruction, so it is sent twice. A servo that misses both
        // holds when its watchdog expires.
        for _ in 0..2 {
            let _ = self.bus.sync_write(address, &off);
        }
    }

    fn set_torque(&mut self, ix: usize, is_on: bool) -> Result<(), Error> {
        let address = self.protocol.torque_address();
        write(&mut self.bus, self.ids[ix], address, &[u8::from(is_on)])
            .map_err(|error| self.error_of(ix, error))
    }

    fn error_of(&self, ix: usize, error: ServoError) -> Error {
        servo_error(&self.servos[ix].config, self.bus.device(), error)
    }

    fn fault(&self, ix: usize, reason: String) -> Error {
        joint_error(&self.servos[ix].config, self.bus.device(), reason)
    }
}

/// Period of the cycle: that of the requested rate, or the shortest that the bus permits.
fn period(bus: &ServoBus, protocol: &dyn ServoProtocol, ids: &[u8], rate_hz: f64) -> Duration {
    let feedback = protocol.feedback_block();
    let vitals = protocol.vitals_block();
    let goals: Vec<_> = ids.iter().map(|id| (*id, protocol.goal(0))).collect();
    let busy = bus.duration(&[
        Instruction::SyncRead {
            address: feedback.address,
            len: feedback.len,
            ids,
        },
        Instruction::SyncWrite {
            address: protocol.goal_address(),
            values: &goals,
        },
        Instruction::Read {
            address: vitals.address,
            len: vitals.len,
        },
    ]);
    busy.div_f64(MAX_BUS_LOAD_FRAC)
        .max(Duration::from_secs_f64(1.0 / rate_hz))
}
