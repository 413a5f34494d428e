//! Motors on CAN buses whose shafts follow a script until a client switches one on: a thread a bus.

use super::JointTrack;
use drivers::can::played::{Played, State};
use drivers::can::{ArmConfig, Arrived, Bus, MotorConfig};
use drivers::wire::can::mit::{Limits, Motion};
use drivers::{Error, clock};
use kinematics::JointState;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// What the counts of Damiao motors cover: rad, rad/s and Nm, as a DM4310's do.
const DAMIAO_LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
/// How long a bus is listened to before motors that report by themselves are looked after.
const TICK: Duration = Duration::from_millis(1);

/// Motors that answer until they are dropped.
#[derive(Debug)]
pub struct PlayedMotors {
    signs: Arc<Signs>,
    threads: Vec<JoinHandle<()>>,
}

/// What the threads of an arm tell each other.
#[derive(Debug, Default)]
struct Signs {
    stop: AtomicBool,
    /// A client has switched a motor on.
    is_moved: AtomicBool,
}

impl PlayedMotors {
    /// Opens the buses, which must be up, and plays every motor of the arm; the track's joints are in the order of the motors.
    /// Once a client has switched one on, all of them stay with what clients want.
    pub fn start(track: &JointTrack, arm: &ArmConfig) -> Result<Self, Error> {
        let mut motors = Self { signs: Arc::default(), threads: Vec::new() };
        for (bus_ix, bus) in arm.buses.iter().enumerate() {
            let own = arm.motors.iter().enumerate().filter(|(_, motor)| motor.bus_ix == bus_ix);
            let own = own.map(|(joint_ix, motor)| Shaft {
                joint_ix,
                config: motor.clone(),
                motor: Played::new(motor.family, DAMIAO_LIMITS),
            });
            let (bus, own, track) = (Bus::open(bus)?, own.collect(), track.clone());
            let signs = Arc::clone(&motors.signs);
            let device = format!("played motors on {}", bus.config().interface);
            let thread = std::thread::Builder::new().name(device.clone()).spawn(move || {
                if let Err(error) = play(&bus, own, &track, &signs) {
                    log::error!("{error}");
                }
            });
            motors.threads.push(thread.map_err(|source| Error::Thread { device, source })?);
        }
        Ok(motors)
    }
}

impl Drop for PlayedMotors {
    fn drop(&mut self) {
        self.signs.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A thread that panicked has said so.
            let _ = thread.join();
        }
    }
}

/// A motor and the joint it moves.
struct Shaft {
    joint_ix: usize,
    config: MotorConfig,
    motor: Played,
}

impl Shaft {
    /// Turns it to where its joint is.
    fn follow(&mut self, joints: &JointState) {
        let MotorConfig { gear_ratio, is_reversed, offset_rad, .. } = self.config;
        let per_turn = gear_ratio * if is_reversed { -1.0 } else { 1.0 };
        let of = |numbers: &[f64]| numbers.get(self.joint_ix).copied().unwrap_or(0.0);
        self.motor.set_motion(Motion {
            position_rad: (of(&joints.position) - offset_rad) * per_turn,
            velocity_rad_s: of(&joints.velocity) * per_turn,
            torque_nm: of(&joints.effort) / per_turn,
        });
    }
}

fn play(bus: &Bus, mut shafts: Vec<Shaft>, track: &JointTrack, signs: &Signs) -> Result<(), Error> {
    while !signs.stop.load(Ordering::Relaxed) {
        let arrived = bus.receive(TICK)?;
        let now = clock::now();
        let joints = (!signs.is_moved.load(Ordering::Relaxed)).then(|| track.at(now));
        for shaft in &mut shafts {
            if let Some(joints) = &joints {
                shaft.follow(joints);
            }
            let answers = match &arrived {
                Some((_, Arrived::Frame(frame))) => shaft.motor.take(frame),
                _ => Ok(Vec::new()),
            };
            for frames in [answers, shaft.motor.report(now)] {
                match frames {
                    Ok(frames) => frames.iter().try_for_each(|frame| bus.send(frame).map(drop))?,
                    Err(error) => log::debug!("joint {:?}: {error}", shaft.config.joint),
                }
            }
            if shaft.motor.state() != State::Free && !signs.is_moved.swap(true, Ordering::Relaxed) {
                log::info!("a client moves the arm: from now on it stays where clients want it");
            }
        }
    }
    Ok(())
}
