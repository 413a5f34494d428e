//! A rig whose arm follows commands instead of a tour. The rig advances only when its devices are
//! read.
//!
//! Cameras and the arm share one simulation. Reading the arm advances the simulation by a
//! millisecond. Waiting for an image advances it until the image arrives. Timeouts count simulated
//! time, so that results do not depend on the speed of the computer.

use crate::Error;
use crate::arm::STEP_NANOS;
use crate::commands::Commands;
use crate::engine::Engine;
use crate::rig_info::RigInfo;
use drivers::motion::{JointTarget, Motion, MotionLimits, MovableArm, SteeringPort};
use drivers::{Arm, Camera, Image, Sample};
use kinematics::{Intrinsics, JointState};
use parking_lot::Mutex;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// Queue length for the images of one camera. A caller that reads only the arm must not fill the
/// memory.
const MAX_IMAGES: usize = 8;
/// Queue length for joint readings: one second.
const MAX_READINGS: usize = 1000;

/// Simulated devices of which the arm can be moved.
pub struct CommandedRig {
    /// The arm, at rest in the first pose of the scan.
    pub arm: Box<dyn MovableArm>,
    /// The cameras in the order of the configuration.
    pub cameras: Vec<Box<dyn Camera>>,
    /// True parameters of the rig.
    pub info: RigInfo,
}

impl CommandedRig {
    pub(crate) fn new(
        mut engine: Engine,
        info: RigInfo,
        limits: &[MotionLimits],
    ) -> Result<Self, Error> {
        let commands = Commands::new(
            limits,
            &engine.reported_joints()?,
            Duration::from_nanos(STEP_NANOS.unsigned_abs()),
        )?;
        engine.follow_commands(commands.clone())?;
        let simulation = Simulation {
            engine,
            camera_names: info
                .cameras
                .iter()
                .map(|camera| camera.name.clone())
                .collect(),
            images: vec![VecDeque::new(); info.cameras.len()],
            readings: VecDeque::new(),
            nanos: 0,
        };
        let simulation = Arc::new(Mutex::new(simulation));
        let arm = CommandedArm {
            simulation: Arc::clone(&simulation),
            commands,
            joint_names: info.joint_names.clone(),
        };
        let cameras = info.cameras.iter().enumerate().map(|(camera_ix, camera)| {
            Box::new(SharedCamera {
                simulation: Arc::clone(&simulation),
                camera_ix,
                name: camera.name.clone(),
                intrinsics: camera.intrinsics.clone(),
            }) as Box<dyn Camera>
        });
        Ok(Self {
            arm: Box::new(arm),
            cameras: cameras.collect(),
            info,
        })
    }
}

struct Simulation {
    engine: Engine,
    camera_names: Vec<String>,
    /// One queue per camera.
    images: Vec<VecDeque<Image>>,
    readings: VecDeque<JointState>,
    /// Simulated time of the newest sample.
    nanos: i64,
}

impl Simulation {
    /// Advances until `take` returns a value, at most for `timeout` of simulated time.
    fn wait<T>(
        &mut self,
        timeout: Duration,
        mut take: impl FnMut(&mut Self) -> Option<T>,
    ) -> Result<Option<T>, drivers::Error> {
        let until = self
            .nanos
            .saturating_add(i64::try_from(timeout.as_nanos()).unwrap_or(i64::MAX));
        loop {
            // The queue is checked before the simulation advances, because a sample may have
            // arrived while another device was read.
            if let Some(taken) = take(self) {
                return Ok(Some(taken));
            }
            if self.nanos >= until {
                return Ok(None);
            }
            let failed = |error: Error| drivers::Error::Simulation {
                reason: error.to_string(),
            };
            let Some((nanos, sample)) = self.engine.next().map_err(failed)? else {
                let reason = "the simulation reached its end".to_owned();
                return Err(drivers::Error::Simulation { reason });
            };
            // Samples are delivered in the order of their arrival, but images have a latency, so
            // times may go back.
            self.nanos = self.nanos.max(nanos);
            match sample {
                Sample::Image(image) => {
                    if let Some(ix) = self
                        .camera_names
                        .iter()
                        .position(|name| **name == *image.camera)
                    {
                        push_bounded(&mut self.images[ix], MAX_IMAGES, image);
                    }
                }
                Sample::Joints(reading) => push_bounded(&mut self.readings, MAX_READINGS, reading),
                // Only devices of a commanded rig have queues.
                Sample::Base(_) | Sample::Range(_) | Sample::Truth(_) | Sample::BaseTruth(_) => {}
            }
        }
    }
}

fn push_bounded<T>(queue: &mut VecDeque<T>, max: usize, item: T) {
    if queue.len() >= max {
        queue.pop_front();
    }
    queue.push_back(item);
}

struct CommandedArm {
    simulation: Arc<Mutex<Simulation>>,
    commands: Commands,
    joint_names: Vec<String>,
}

impl Arm for CommandedArm {
    fn joint_names(&self) -> &[String] {
        &self.joint_names
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, drivers::Error> {
        let reading = self
            .simulation
            .lock()
            .wait(timeout, |simulation| simulation.readings.pop_front())?;
        reading.ok_or(drivers::Error::NoJoints { waited: timeout })
    }
}

impl MovableArm for CommandedArm {
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, drivers::Error> {
        self.commands
            .set_target(target)
            .map_err(|reason| drivers::Error::Simulation { reason })
    }

    fn motion(&self) -> Motion {
        self.commands.motion()
    }

    fn stop(&mut self) -> Result<(), drivers::Error> {
        self.commands.stop();
        Ok(())
    }

    fn recover(&mut self) -> Result<(), drivers::Error> {
        self.commands
            .recover()
            .map_err(|reason| drivers::Error::Simulation { reason })
    }

    /// The times of targets are those of the joint readings, not those of the computer's clock. The
    /// arm brakes when the simulation is advanced beyond the expiry of its target.
    fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, drivers::Error> {
        self.commands
            .steer(brake_factor)
            .map_err(|reason| drivers::Error::Simulation { reason })
    }
}

struct SharedCamera {
    simulation: Arc<Mutex<Simulation>>,
    camera_ix: usize,
    name: String,
    intrinsics: Intrinsics,
}

impl Camera for SharedCamera {
    fn name(&self) -> &str {
        &self.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, drivers::Error> {
        let image = self.simulation.lock().wait(timeout, |simulation| {
            simulation.images[self.camera_ix].pop_front()
        })?;
        image.ok_or_else(|| drivers::Error::NoImage {
            camera: self.name.clone(),
            waited: timeout,
        })
    }

    fn waits_for_caller(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraConfig, Config, SensorConfig};
    use drivers::motion::{Output, Target};
    use kinematics::Stamp;

    const SPEED_RAD_S: f64 = 0.4;

    fn limits(reading_order: &[usize]) -> Vec<MotionLimits> {
        let of = |ix: &usize| MotionLimits {
            position: [crate::panda::LOWER_RAD[*ix], crate::panda::UPPER_RAD[*ix]],
            velocity: SPEED_RAD_S,
            acceleration: 1.0,
            jerk: 10.0,
        };
        reading_order.iter().map(of).collect()
    }

    fn rig(reading_order: &[usize], joint_offsets: Vec<f64>) -> CommandedRig {
        let camera = CameraConfig {
            rate_hz: 2.0,
            depth: None,
            ..CameraConfig::wrist("wrist")
        };
        let camera = CameraConfig {
            sensor: SensorConfig {
                latency_millis: 5.0,
                ..camera.sensor
            },
            ..camera
        };
        let names = Config::default().joint_names;
        let config = Config {
            ideal: true,
            cameras: vec![camera],
            reading_order: reading_order.iter().map(|ix| names[*ix].clone()).collect(),
            joint_offsets,
            ..Config::default()
        };
        crate::open(&config)
            .expect("a scene")
            .into_commanded(&limits(reading_order))
            .expect("the arm is in its range")
    }

    #[test]
    fn arm_reaches_targets_within_its_speed_and_images_show_the_motion() {
        let offsets = vec![0.02, 0.0, -0.01, 0.0, 0.0, 0.03, 0.0];
        let CommandedRig {
            mut arm,
            mut cameras,
            ..
        } = rig(&[6, 0, 1, 2, 3, 4, 5], offsets);
        let start = arm.read(Duration::from_secs(1)).expect("a reading");
        assert_eq!(arm.joint_names()[0], "panda_joint7");
        let before = cameras[0]
            .next_image(Duration::from_secs(1))
            .expect("an image");
        let mut target = start.position.clone();
        target[0] += 0.3;
        target[3] -= 0.1;
        let accepted = arm
            .command(&JointTarget {
                position: target.clone(),
            })
            .expect("a valid target");
        assert_eq!(accepted.position, target);
        assert_eq!(arm.motion(), Motion::Moving);
        let mut fastest = 0.0f64;
        let mut last = start;
        while arm.motion() == Motion::Moving {
            last = arm.read(Duration::from_secs(1)).expect("a reading");
            fastest = last
                .velocity
                .iter()
                .fold(fastest, |fastest, speed| fastest.max(speed.abs()));
            assert!(last.stamp.0 < 5_000_000_000, "it does not arrive");
        }
        assert!(
            fastest > 0.2 && fastest < 1.1 * SPEED_RAD_S,
            "{fastest} rad/s"
        );
        for _ in 0..500 {
            last = arm.read(Duration::from_secs(1)).expect("a reading");
        }
        for (ix, (target, actual)) in target.iter().zip(&last.position).enumerate() {
            assert!(
                (target - actual).abs() < 1e-3,
                "joint {ix}: {actual}, commanded {target}"
            );
        }
        let mut after = before.clone();
        while after.stamp < last.stamp {
            after = cameras[0]
                .next_image(Duration::from_secs(1))
                .expect("an image");
        }
        assert!(before.data != after.data && after.stamp > before.stamp);
    }

    #[test]
    fn stop_brings_the_arm_to_rest_before_its_target() {
        let CommandedRig { mut arm, .. } = rig(&[0, 1, 2, 3, 4, 5, 6], Vec::new());
        let start = arm.read(Duration::from_secs(1)).expect("a reading");
        let mut target = start.position.clone();
        target[1] += 0.5;
        arm.command(&JointTarget {
            position: target.clone(),
        })
        .expect("a valid target");
        for _ in 0..700 {
            arm.read(Duration::from_secs(1)).expect("a reading");
        }
        arm.stop().expect("a simulated arm stops");
        while arm.motion() == Motion::Moving {
            arm.read(Duration::from_secs(1)).expect("a reading");
        }
        let rest = arm.read(Duration::from_secs(1)).expect("a reading");
        assert!(
            rest.position[1] > start.position[1] + 0.01 && rest.position[1] < target[1] - 0.05,
            "{rest:?}"
        );
        assert!(
            arm.command(&JointTarget {
                position: vec![f64::NAN; 7]
            })
            .is_err()
        );
        assert_eq!(arm.motion(), Motion::Holding);
    }

    #[test]
    fn steered_arm_brakes_when_its_target_expires_in_simulated_time() {
        const VALIDITY: Duration = Duration::from_millis(100);
        let CommandedRig { mut arm, .. } = rig(&[0, 1, 2, 3, 4, 5, 6], Vec::new());
        let mut newest = arm.read(Duration::from_secs(1)).expect("a reading");
        let mut goal = newest.position.clone();
        goal[1] += 0.5;
        let port = arm.steering_port(2.0).expect("it is enabled");
        let send = |motion, serial, at: Stamp| {
            port.send(&Output::Follow(Target {
                motion,
                serial,
                position: goal.clone(),
                expires_at: at + VALIDITY,
            }));
        };
        let start = newest.position[1];
        for serial in 1..=700 {
            send(1, serial, newest.stamp);
            newest = arm.read(Duration::from_secs(1)).expect("a reading");
        }
        let refusal = arm
            .command(&JointTarget {
                position: goal.clone(),
            })
            .expect_err("it is steered");
        assert!(refusal.to_string().contains("steered"), "{refusal}");
        let state = || port.state().expect("a report");
        assert!(!state().is_at_rest && state().position[1] > start + 0.01);
        let ended_at = newest.stamp;
        while state().braked_motion < 1 {
            newest = arm.read(Duration::from_secs(1)).expect("a reading");
            assert!(newest.stamp < ended_at + 2 * VALIDITY, "it brakes");
        }
        while !state().is_at_rest {
            newest = arm.read(Duration::from_secs(1)).expect("a reading");
            assert!(newest.stamp < ended_at + 20 * VALIDITY, "it comes to rest");
        }
        assert_eq!(arm.motion(), Motion::Holding);
        let rest = state().position;
        assert!(rest[1] < goal[1] - 0.05, "{rest:?}");
        for serial in 701..=800 {
            send(1, serial, newest.stamp);
            newest = arm.read(Duration::from_secs(1)).expect("a reading");
        }
        assert_eq!(state().position, rest);
        send(2, 1, newest.stamp);
        for _ in 0..100 {
            arm.read(Duration::from_secs(1)).expect("a reading");
        }
        assert!(state().position[1] > rest[1]);
    }
}
