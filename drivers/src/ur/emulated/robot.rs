//! An emulated robot without sockets: modes, registers, and the program that moves it.

use super::urscript::{Call, Machine, MachineState, Outcome, Value, parse};
use super::variables::{N_REGISTERS, Values, register_ix};
use super::{CommandedJoints, ControllerConfig, Joints, Modes, N_JOINTS};

/// Values of `runtime_state`.
const STOPPED: u32 = 1;
const PLAYING: u32 = 2;
const PAUSED: u32 = 4;
/// Values of `safety_mode`.
const NORMAL: i32 = 1;
const PROTECTIVE_STOP: i32 = 3;
/// Value of `robot_mode` in which programs run.
const RUNNING: i32 = 7;
/// Maximum speed of all joints of a UR5e. A faster setpoint is a jump, and causes a protective
/// stop.
const MAX_SPEED_RAD_S: f64 = 3.2;
/// Deceleration when a program is stopped from outside.
const STOP_RAD_S2: f64 = 4.0;

/// A robot that is advanced cycle by cycle.
#[derive(Debug)]
pub(super) struct Robot {
    pub(super) values: Values,
    step_secs: f64,
    inputs: Inputs,
    program: Option<Machine>,
    watchdog: Option<Watchdog>,
    velocity_rad_s: [f64; N_JOINTS],
    /// Whether the joints brake after the end of a program.
    is_braking: bool,
    /// Whether the program followed a setpoint in its last cycle.
    is_servoing: bool,
}

/// Input registers of RTDE.
#[derive(Debug)]
struct Inputs {
    ints: [i32; N_REGISTERS],
    doubles: [f64; N_REGISTERS],
    /// Cycles since the last update of each integer register.
    int_ages: [u64; N_REGISTERS],
}

/// A watchdog that a program has set.
#[derive(Clone, Copy, Debug)]
struct Watchdog {
    register: usize,
    max_age_secs: f64,
}

impl Robot {
    /// * `start`: the joints at the start
    pub(super) fn new(config: &ControllerConfig, start: Joints, timestamp_secs: f64) -> Self {
        let values = Values {
            timestamp_secs,
            joints: start,
            target_rad: start.position_rad,
            base_from_tool: config.flange_from_tool,
            flange_from_tool: config.flange_from_tool,
            modes: Modes::default(),
            runtime_state: STOPPED,
            output_ints: [0; N_REGISTERS],
        };
        Self {
            values,
            step_secs: 1.0 / config.rate_hz(),
            inputs: Inputs {
                ints: [0; N_REGISTERS],
                doubles: [0.0; N_REGISTERS],
                int_ages: [0; N_REGISTERS],
            },
            program: None,
            watchdog: None,
            velocity_rad_s: [0.0; N_JOINTS],
            is_braking: false,
            is_servoing: false,
        }
    }

    /// What the controller commands to the joints.
    pub(super) fn commanded(&self) -> CommandedJoints {
        CommandedJoints {
            position_rad: self.values.target_rad,
            velocity_rad_s: self.velocity_rad_s,
            is_moving: self.program.is_some() || self.is_braking,
        }
    }

    /// Sets the measured joints. While no program runs, the commanded positions follow them.
    pub(super) fn measure(&mut self, joints: Joints) {
        self.values.joints = joints;
        if !self.commanded().is_moving {
            self.values.target_rad = joints.position_rad;
        }
    }

    pub(super) fn set_modes(&mut self, modes: Modes) {
        self.values.modes = modes;
        if !self.is_ready() {
            self.pause();
        }
    }

    /// Type of an input variable; `None` if it does not exist.
    pub(super) fn input_type(name: &str) -> Option<&'static str> {
        if register_ix(name, "input_int_register_").is_some() {
            return Some("INT32");
        }
        register_ix(name, "input_double_register_").map(|_| "DOUBLE")
    }

    /// Writes input registers. Returns false if the number of bytes is wrong.
    pub(super) fn write_inputs(&mut self, names: &[String], mut values: &[u8]) -> bool {
        for name in names {
            if let Some(ix) = register_ix(name, "input_int_register_") {
                let Some((bytes, rest)) = values.split_first_chunk() else {
                    return false;
                };
                self.inputs.ints[ix] = i32::from_be_bytes(*bytes);
                self.inputs.int_ages[ix] = 0;
                values = rest;
            } else if let Some(ix) = register_ix(name, "input_double_register_") {
                let Some((bytes, rest)) = values.split_first_chunk() else {
                    return false;
                };
                self.inputs.doubles[ix] = f64::from_be_bytes(*bytes);
                values = rest;
            }
        }
        values.is_empty()
    }

    /// Starts a program, and replaces one that runs. As a real controller, it ignores programs that
    /// it cannot run.
    pub(super) fn start_program(&mut self, text: &str) {
        if !self.values.modes.is_remote || !self.is_ready() {
            log::warn!("emulated controller: a program is ignored, because the robot is not ready");
            return;
        }
        match parse(text) {
            Ok(program) => {
                log::info!("emulated controller: the program {} starts", program.name);
                self.program = Some(Machine::new(program));
                self.values.runtime_state = PLAYING;
                self.watchdog = None;
                self.is_braking = false;
            }
            Err(reason) => log::warn!("emulated controller: a program is ignored: {reason}"),
        }
    }

    /// Answer of the dashboard server.
    pub(super) fn dashboard(&mut self, command: &str) -> String {
        match command {
            "is in remote control" => self.values.modes.is_remote.to_string(),
            "stop" => {
                self.stop_program();
                "Stopped".to_owned()
            }
            "close safety popup" => "closing safety popup".to_owned(),
            "unlock protective stop" => {
                if self.values.modes.is_unlock_refused {
                    return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking".to_owned();
                }
                if self.values.modes.safety_mode == PROTECTIVE_STOP {
                    self.values.modes.safety_mode = NORMAL;
                }
                "Protective stop releasing".to_owned()
            }
            _ => format!("could not understand: '{command}'"),
        }
    }

    /// Runs one cycle of the program and of the joints.
    pub(super) fn advance(&mut self) {
        for age in &mut self.inputs.int_ages {
            *age += 1;
        }
        if self.is_braking && brake(&mut self.velocity_rad_s, STOP_RAD_S2 * self.step_secs) {
            self.is_braking = false;
        }
        if self.is_braking {
            self.coast();
        }
        if self.values.runtime_state != PLAYING {
            return;
        }
        if self.is_watchdog_due() {
            log::warn!("emulated controller: the watchdog of RTDE stops the program");
            self.stop_program();
            return;
        }
        let Some(mut program) = self.program.take() else {
            return;
        };
        self.is_servoing = false;
        match program.run_cycle(&mut |call| self.call(call)) {
            // A call may have caused a protective stop, which pauses the program.
            Ok(MachineState::Running) => self.program = Some(program),
            Ok(MachineState::Ended) => self.stop_program(),
            Err(reason) => {
                log::warn!("emulated controller: the program is wrong: {reason}");
                self.stop_program();
            }
        }
    }

    /// Whether the program follows setpoints, and watches their number.
    pub(super) fn follows_setpoints(&self) -> bool {
        self.is_servoing && self.watchdog.is_some() && self.values.runtime_state == PLAYING
    }

    /// Whether a setpoint has arrived since the last cycle.
    pub(super) fn has_new_setpoint(&self) -> bool {
        self.watchdog
            .is_some_and(|watchdog| self.inputs.int_ages[watchdog.register] == 0)
    }

    fn is_ready(&self) -> bool {
        self.values.modes.robot_mode == RUNNING && (1..=2).contains(&self.values.modes.safety_mode)
    }

    fn is_watchdog_due(&self) -> bool {
        self.watchdog.is_some_and(|watchdog| {
            let age_secs = self.inputs.int_ages[watchdog.register] as f64 * self.step_secs;
            age_secs > watchdog.max_age_secs
        })
    }

    fn stop_program(&mut self) {
        self.program = None;
        self.watchdog = None;
        self.values.runtime_state = STOPPED;
        self.is_braking = self.velocity_rad_s != [0.0; N_JOINTS];
    }

    /// Stops the joints at once, and keeps the program.
    fn pause(&mut self) {
        self.velocity_rad_s = [0.0; N_JOINTS];
        self.is_braking = false;
        if self.program.is_some() || self.values.runtime_state == PLAYING {
            self.values.runtime_state = PAUSED;
        }
    }

    /// Moves the joints with their velocity.
    fn coast(&mut self) {
        for (position, velocity) in std::iter::zip(&mut self.values.target_rad, self.velocity_rad_s)
        {
            *position += velocity * self.step_secs;
        }
    }

    /// The functions of the controller. Source: "URScript manual".
    fn call(&mut self, call: &Call) -> Result<Outcome, String> {
        let value = match call.name.as_str() {
            "get_steptime" => Value::Number(self.step_secs),
            "get_target_joint_positions" => Value::List(self.values.target_rad.to_vec()),
            "norm" => Value::Number(call.argument(0)?.number()?.abs()),
            "read_input_integer_register" => {
                Value::Number(f64::from(self.inputs.ints[register(call)?]))
            }
            "read_input_float_register" => Value::Number(self.inputs.doubles[register(call)?]),
            "write_output_integer_register" => {
                self.values.output_ints[register(call)?] = integer(call.argument(1)?.number()?);
                Value::None
            }
            "rtde_set_watchdog" => {
                self.set_watchdog(call)?;
                Value::None
            }
            "sync" => return Ok(Outcome::NextCycle),
            "servoj" => {
                self.servo(call)?;
                return Ok(Outcome::NextCycle);
            }
            "stopj" => {
                let is_at_rest = brake(
                    &mut self.velocity_rad_s,
                    call.argument(0)?.number()? * self.step_secs,
                );
                self.coast();
                return Ok(if is_at_rest {
                    Outcome::NextCycle
                } else {
                    Outcome::Unfinished
                });
            }
            name => return Err(format!("the function {name} is not emulated")),
        };
        Ok(Outcome::Value(value))
    }

    fn set_watchdog(&mut self, call: &Call) -> Result<(), String> {
        let name = call.argument(0)?.text()?;
        let register = register_ix(name, "input_int_register_")
            .ok_or_else(|| format!("{name:?} is not an integer register"))?;
        let min_hz = call.argument(1)?.number()?;
        match call.argument(2)?.text()? {
            "stop" => {
                self.watchdog = Some(Watchdog {
                    register,
                    max_age_secs: 1.0 / min_hz,
                });
                Ok(())
            }
            action => Err(format!("the action {action:?} is not emulated")),
        }
    }

    /// Follows a setpoint at once, as with a perfect controller.
    fn servo(&mut self, call: &Call) -> Result<(), String> {
        let target_rad: [f64; N_JOINTS] = call.argument(0)?.list()?;
        let secs = call.named("t")?.number()?;
        let lookahead_secs = call.named("lookahead_time")?.number()?;
        let gain = call.named("gain")?.number()?;
        if !(0.03..=0.2).contains(&lookahead_secs) || !(100.0..=2000.0).contains(&gain) {
            return Err(format!(
                "servoj with lookahead_time {lookahead_secs} and gain {gain} is out of range"
            ));
        }
        let velocity_rad_s: [f64; N_JOINTS] = std::array::from_fn(|ix| {
            (target_rad[ix] - self.values.target_rad[ix]) / secs.max(self.step_secs)
        });
        // NaN fails the comparison.
        if !velocity_rad_s
            .iter()
            .all(|velocity| velocity.abs() <= MAX_SPEED_RAD_S)
        {
            log::warn!("emulated controller: protective stop after the setpoint {target_rad:?}");
            self.values.modes.safety_mode = PROTECTIVE_STOP;
            self.values.runtime_state = PAUSED;
            self.velocity_rad_s = [0.0; N_JOINTS];
            return Ok(());
        }
        self.velocity_rad_s = velocity_rad_s;
        self.values.target_rad = target_rad;
        self.is_servoing = true;
        Ok(())
    }
}

/// Reduces all velocities in proportion, the largest one by `step_rad_s`. Returns whether the
/// joints are at rest.
fn brake(velocity_rad_s: &mut [f64; N_JOINTS], step_rad_s: f64) -> bool {
    let max_rad_s = velocity_rad_s
        .iter()
        .fold(0.0_f64, |max, velocity| max.max(velocity.abs()));
    let factor = if max_rad_s > step_rad_s {
        1.0 - step_rad_s / max_rad_s
    } else {
        0.0
    };
    for velocity in velocity_rad_s {
        *velocity *= factor;
    }
    factor == 0.0
}

/// The register that a call names.
fn register(call: &Call) -> Result<usize, String> {
    let number = call.argument(0)?.number()?;
    let ix = usize::try_from(integer(number)).ok();
    ix.filter(|ix| *ix < N_REGISTERS)
        .ok_or_else(|| format!("there is no register {number}"))
}

#[expect(clippy::cast_possible_truncation, reason = "a cast saturates")]
fn integer(number: f64) -> i32 {
    number.round() as i32
}
