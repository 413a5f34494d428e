//! Emulates motors on CAN buses, one thread per bus. Shafts follow a script until a client enables
//! a motor.

use super::JointTrack;
use drivers::can::emulated::{EmulatedMotor, State};
use drivers::can::{ArmConfig, Bus, BusEvent, MotorConfig};
use drivers::wire::can::mit::{Limits, Motion};
use drivers::{Error, clock};
use kinematics::JointState;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Encoding ranges of a Damiao DM4310: rad, rad/s and Nm.
const DAMIAO_LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
/// Time to wait for messages on a bus before servicing motors that report periodically. It must be
/// shorter than the period of their reports.
const RECEIVE_TIMEOUT: Duration = Duration::from_millis(1);

/// Motors that reply until they are dropped.
#[derive(Debug)]
pub struct EmulatedMotors {
    flags: Arc<SharedFlags>,
    threads: Vec<JoinHandle<()>>,
}

/// State shared by the threads of an arm.
#[derive(Debug, Default)]
struct SharedFlags {
    stop: AtomicBool,
    /// Whether a client has enabled a motor.
    is_client_controlled: AtomicBool,
}

impl EmulatedMotors {
    /// Opens the buses, which must be up, and emulates all motors of the arm. The track's joints
    /// are in the order of the motors. Once a client has enabled a motor, all motors follow only
    /// client commands.
    pub fn start(track: &JointTrack, arm: &ArmConfig) -> Result<Self, Error> {
        let mut motors = Self {
            flags: Arc::default(),
            threads: Vec::new(),
        };
        for (bus_ix, bus) in arm.buses.iter().enumerate() {
            // Like the driver, the emulation uses one thread per bus. Motors on one bus answer in
            // the order of the messages.
            let joints_of_bus = arm
                .motors
                .iter()
                .enumerate()
                .filter(|(_, motor)| motor.bus_ix == bus_ix);
            let joints_of_bus = joints_of_bus.map(|(joint_ix, motor)| EmulatedJoint {
                joint_ix,
                config: motor.clone(),
                motor: EmulatedMotor::new(&*motor.protocol, DAMIAO_LIMITS),
            });
            let bus = Bus::open(bus)?;
            let joints_of_bus = joints_of_bus.collect();
            let track = track.clone();
            let flags = Arc::clone(&motors.flags);
            let device = format!("emulated motors on {}", bus.config().interface);
            let thread = std::thread::Builder::new()
                .name(device.clone())
                .spawn(move || {
                    if let Err(error) = run_bus(&bus, joints_of_bus, &track, &flags) {
                        log::error!("{error}");
                    }
                });
            motors
                .threads
                .push(thread.map_err(|source| Error::Thread { device, source })?);
        }
        Ok(motors)
    }
}

impl Drop for EmulatedMotors {
    fn drop(&mut self) {
        self.flags.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// A motor and the joint it moves.
struct EmulatedJoint {
    joint_ix: usize,
    config: MotorConfig,
    motor: EmulatedMotor,
}

impl EmulatedJoint {
    /// Moves the motor to the position of its joint.
    fn follow(&mut self, joints: &JointState) {
        let MotorConfig {
            gear_ratio,
            is_reversed,
            offset_rad,
            ..
        } = self.config;
        // This is the inverse of the conversion in the driver. Position and velocity scale with the
        // gear ratio, and torque scales with the inverse of the ratio.
        let motor_per_joint = gear_ratio * if is_reversed { -1.0 } else { 1.0 };
        let of = |numbers: &[f64]| numbers.get(self.joint_ix).copied().unwrap_or(0.0);
        self.motor.set_motion(Motion {
            position_rad: (of(&joints.position) - offset_rad) * motor_per_joint,
            velocity_rad_s: of(&joints.velocity) * motor_per_joint,
            torque_nm: of(&joints.effort) / motor_per_joint,
        });
    }
}

fn run_bus(
    bus: &Bus,
    mut joints_on_bus: Vec<EmulatedJoint>,
    track: &JointTrack,
    flags: &SharedFlags,
) -> Result<(), Error> {
    while !flags.stop.load(Ordering::Relaxed) {
        let arrived = bus.receive(RECEIVE_TIMEOUT)?;
        let now = clock::now();
        // The script moves the motors until a client takes over any of them. From then on, all
        // motors stay where they are, because a script that moves some joints would interfere with
        // the client.
        let joints = (!flags.is_client_controlled.load(Ordering::Relaxed)).then(|| track.at(now));
        for emulated_joint in &mut joints_on_bus {
            if let Some(joints) = &joints {
                emulated_joint.follow(joints);
            }
            let answers = match &arrived {
                Some((_, BusEvent::Frame(frame))) => emulated_joint.motor.take(frame),
                _ => Ok(Vec::new()),
            };
            for frames in [answers, emulated_joint.motor.report(now)] {
                match frames {
                    Ok(frames) => frames
                        .iter()
                        .try_for_each(|frame| bus.send(frame).map(drop))?,
                    Err(error) => log::debug!("joint {:?}: {error}", emulated_joint.config.joint),
                }
            }
            if emulated_joint.motor.state() != State::Free
                && !flags.is_client_controlled.swap(true, Ordering::Relaxed)
            {
                log::info!("a client controls the arm: it no longer follows the script");
            }
        }
    }
    Ok(())
}
