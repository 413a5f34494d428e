//! Lets operators steer the arm of a run.
//!
//! A separate thread takes the requests of the clients of `/steer` ([`SteeringServer`]), decides
//! with the chain of the crate `steering` what the arm does, and sends it to the arm's own thread,
//! which brakes as soon as targets expire. The thread needs neither the trainer nor the GPU, so
//! both may be busy for any time. `steering_loop.rs` has one cycle, and the other files its parts.
//! The folder `base` does the same for a base.

mod base;
mod clearance_feed;
mod followed_command;
mod joint_map;
mod observer;
mod prepared_robot;
mod previews;
mod recovery;
mod requests;
mod robot;
mod scene_clearance;
mod standalone;
pub mod steering_log;
mod steering_loop;
#[cfg(test)]
mod steering_loop_tests;
mod surroundings;
#[cfg(test)]
mod test_arm;
mod time_base;
mod undrawn;

pub(crate) use clearance_feed::{ClearanceFeed, MIN_STEPS};
pub(crate) use observer::SteeringObserver;
pub(crate) use prepared_robot::{PreparedRobot, SteeredRobot};
pub use standalone::{drive_standalone, steer_standalone};
pub use surroundings::Surroundings;

use crate::viewers::Viewers;
use anyhow::{Context, bail};
use capture::config::{ArmSteering, Rig};
use capture::open::SteeredArm;
use drivers::motion::ArmState;
use scene_clearance::SceneClearance;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use steering::{LimitConfig, SteeringConfig};
use steering_log::About;
use steering_loop::{Reply, SteeringLoop};
use time_base::TimeBase;
use viz::{ArmDescription, Hub, SteeredJoint, SteeringServer};

/// Period of the decisions: 200 Hz, twice as often as the fastest devices send commands.
const PERIOD: Duration = Duration::from_millis(5);
/// Minimum time between two decisions. Requests are decided when they arrive, but a flood of them
/// must not take the processor.
const MIN_PERIOD: Duration = Duration::from_millis(2);
/// Maximum time until an enabled arm reports its state for the first time.
const MAX_FIRST_REPORT: Duration = Duration::from_secs(5);

/// The steered arm of a run, before its input is read.
pub(crate) struct PreparedSteering<S = SceneClearance> {
    arm: SteeredArm,
    robot: robot::ChainAndBody,
    scene: Arc<S>,
    config: SteeringConfig,
    servo_round_trip_millis: f64,
    joint_names: Vec<String>,
    joint_offsets: Vec<f64>,
    about: About,
}

impl PreparedSteering {
    /// Prepares the arm of a rig for its operators.
    ///
    /// # Errors
    ///
    /// If the robot description has no shapes, because nothing would then protect the robot.
    pub(crate) fn new(arm: SteeredArm, rig: &Rig) -> anyhow::Result<Self> {
        let robot = robot::chain_and_body(rig)?;
        let scene = Arc::new(SceneClearance::new(rig, &robot)?);
        Ok(Self::of(arm, rig, robot, scene))
    }

    /// An observer of the run's input, from which the free space around the arm is known. It also
    /// passes everything on to viewers.
    pub(crate) fn observer(&self, viewers: Viewers) -> SteeringObserver {
        SteeringObserver::new(viewers, Arc::<SceneClearance>::clone(&self.scene))
    }

    /// Passes depth that the live model draws to the map of free space.
    pub(crate) fn clearance_feed(&self) -> ClearanceFeed {
        ClearanceFeed::new(Arc::clone(&self.scene))
    }
}

impl<S: Surroundings> PreparedSteering<S> {
    fn of(arm: SteeredArm, rig: &Rig, robot: robot::ChainAndBody, scene: Arc<S>) -> Self {
        let settings = rig.arm.motion.as_ref().map(|motion| &motion.steering);
        let settings = settings.cloned().unwrap_or_default();
        Self {
            arm,
            robot,
            scene,
            config: config(&settings),
            servo_round_trip_millis: settings.servo_round_trip_millis,
            joint_names: rig.arm.joints.clone(),
            joint_offsets: rig.arm.joint_offsets.clone(),
            about: About {
                urdf: rig.arm.urdf_text.clone(),
                world_from_base: rig.base.world_from_base,
            },
        }
    }

    /// Lets clients of the hub steer the arm.
    ///
    /// * `log_folder`: where all decisions are logged, if they are.
    ///
    /// # Errors
    ///
    /// If the arm reports nothing, its limits do not match the robot, or no thread can be started.
    pub(crate) fn start(
        self,
        hub: &Hub,
        log_folder: Option<&Path>,
    ) -> anyhow::Result<SteeringThread> {
        let first = first_report(&self.arm)?;
        let robot = self
            .robot
            .steered(&self.joint_names, &self.joint_offsets, &self.arm)?;
        let server = SteeringServer::new(self.description(&robot));
        let mut steering_loop = SteeringLoop::new(self.config, robot, TimeBase::now(), &first)
            .context("the arm cannot be steered")?;
        if let Some(folder) = log_folder {
            steering_loop
                .log_into(folder, self.about)
                .context("cannot start a thread")?;
        }
        let must_stop = Arc::new(AtomicBool::new(false));
        let running = Running {
            steering_loop,
            arm: self.arm,
            scene: self.scene,
            server: Arc::clone(&server),
            must_stop: Arc::clone(&must_stop),
            _admission: Admission::open(hub, server),
        };
        let thread = std::thread::Builder::new()
            .name("steering".to_owned())
            .spawn(|| running.run())
            .context("cannot start a thread")?;
        Ok(SteeringThread {
            must_stop,
            thread: Some(thread),
        })
    }

    fn description(&self, robot: &steering_loop::SteeredRobot) -> ArmDescription {
        let limits = robot.joints.limits_in_chain(robot.port.limits());
        let names = robot.chain.joint_names().iter();
        let joints = names.zip(&limits).zip(&self.robot.is_prismatic);
        let finite = |bound: f64| bound.is_finite().then_some(bound);
        ArmDescription {
            base_link: robot.chain.base_link().to_owned(),
            tip_link: robot.chain.tip_link().to_owned(),
            joints: joints
                .map(|((name, limits), is_prismatic)| SteeredJoint {
                    name: name.clone(),
                    lower: finite(limits.position[0]),
                    upper: finite(limits.position[1]),
                    is_prismatic: *is_prismatic,
                    velocity: limits.velocity,
                })
                .collect(),
            expiry_secs: self.config.clutch.max_silence_secs,
            lease_secs: self.config.lease.expiry_secs,
            servo_round_trip_millis: self.servo_round_trip_millis,
            base: None,
        }
    }
}

/// The configuration of the chain of decisions.
fn config(settings: &ArmSteering) -> SteeringConfig {
    SteeringConfig {
        limits: LimitConfig {
            max_speed_m_s: settings.max_speed_m_s,
            max_angular_rad_s: settings.max_angular_rad_s,
            workspace_m: settings.workspace_corners_m(),
            ..LimitConfig::default()
        },
        ..SteeringConfig::default()
    }
}

/// The first state that the arm reports.
fn first_report(arm: &SteeredArm) -> anyhow::Result<ArmState> {
    let until = Instant::now() + MAX_FIRST_REPORT;
    loop {
        if let Some(state) = arm.port().state() {
            return Ok(state);
        }
        if Instant::now() > until {
            bail!(
                "the arm has reported no state for {} s after it was enabled: start the run again",
                MAX_FIRST_REPORT.as_secs()
            );
        }
        std::thread::sleep(PERIOD);
    }
}

/// The running thread. Dropping it lets the arm brake, disconnects the clients, and waits for the
/// end of the thread.
pub struct SteeringThread {
    must_stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for SteeringThread {
    fn drop(&mut self) {
        self.must_stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// While this exists, clients may connect. It also ends if the thread panics: the arm then brakes,
/// because its targets expire, and the run goes on.
struct Admission(Hub);

impl Admission {
    fn open(hub: &Hub, server: Arc<SteeringServer>) -> Self {
        viz::publish_steering(hub, Some(server));
        Self(hub.clone())
    }
}

impl Drop for Admission {
    fn drop(&mut self) {
        viz::publish_steering(&self.0, None);
    }
}

/// What the thread owns.
struct Running<S> {
    steering_loop: SteeringLoop,
    arm: SteeredArm,
    scene: Arc<S>,
    server: Arc<SteeringServer>,
    must_stop: Arc<AtomicBool>,
    _admission: Admission,
}

impl<S: Surroundings> Running<S> {
    fn run(mut self) {
        let mut decided = Instant::now();
        while !self.must_stop.load(Ordering::Relaxed) {
            let left = (decided + PERIOD).saturating_duration_since(Instant::now());
            self.server.wait_for_requests(left);
            std::thread::sleep((decided + MIN_PERIOD).saturating_duration_since(Instant::now()));
            decided = Instant::now();
            self.decide();
        }
        self.steering_loop.finish();
    }

    fn decide(&mut self) {
        // The first report came before the thread was started.
        let Some(arm) = self.steering_loop.arm() else {
            return;
        };
        self.scene.set_posture(&arm);
        let received = self.server.take_requests();
        let now = drivers::clock::now();
        let outcome = self.steering_loop.cycle(now, &received, &arm, &*self.scene);
        if outcome.begins {
            self.scene.end_sweep();
        }
        if outcome.begins || outcome.ends_tour {
            self.arm.begin();
        }
        for (client, reply) in outcome.replies {
            match reply {
                Reply::Refused(kind, text) => self.server.refuse(client, kind, text),
                Reply::Preview(id, preview) => self.server.answer_preview(client, id, preview),
            }
        }
        if let Some(mut state) = outcome.state {
            state.contacts = self.arm.n_contacts();
            self.server.publish(state);
        }
    }
}
