//! Lets operators steer the robot of a run: its arm, its base, or both.
//!
//! A separate thread takes the requests of the clients of `/steer` ([`SteeringServer`]), decides
//! with the chain of the crate `steering` what the robot does, and sends it to the own threads of
//! its arm and its base, which brake as soon as targets expire. The thread needs neither the trainer
//! nor the GPU, so both may be busy for any time. `steering_loop.rs` has one cycle, and the other
//! files its parts. The folder `base` has what only bases need.

mod base;
mod clearance_feed;
mod followed_command;
mod joint_map;
mod observer;
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
pub use standalone::{drive_standalone, steer_standalone};
pub use surroundings::Surroundings;

use crate::viewers::Viewers;
use anyhow::{Context, bail};
use base::{PreparedBase, RobotWatch};
use capture::config::{ArmSteering, Rig};
use capture::open::{SteeredArm, SteeredBase, SteeredRobot};
use drivers::motion::ArmState;
use kinematics::Stamp;
use observer::RobotObserver;
use robot::ChainAndBody;
use scene_clearance::{MovingBase, SceneClearance};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use steering::{Clearance, LeaseConfig, LimitConfig, Seen, SteeringConfig};
use steering_log::About;
use steering_loop::{Reply, Reports, SteeringLoop};
use time_base::TimeBase;
use viz::{ArmDescription, Hub, SteeredJoint, SteeringServer};

/// Period of the decisions: 200 Hz, twice as often as the fastest devices send commands.
const PERIOD: Duration = Duration::from_millis(5);
/// Minimum time between two decisions. Requests are decided when they arrive, but a flood of them
/// must not take the processor.
const MIN_PERIOD: Duration = Duration::from_millis(2);
/// Maximum time until an enabled arm reports its state for the first time.
const MAX_FIRST_REPORT: Duration = Duration::from_secs(5);

/// The steered robot of a run, before its input is read.
pub(crate) struct PreparedSteering<S = SceneClearance> {
    arm: Option<PreparedArm>,
    base: Option<PreparedBase>,
    base_link: String,
    tip_link: String,
    watch: Arc<RobotWatch>,
    /// What is known about the space around the robot; `None` if nothing is asked about it.
    scene: Option<Arc<S>>,
    about: About,
}

/// The arm of a robot, before its input is read.
struct PreparedArm {
    arm: SteeredArm,
    robot: ChainAndBody,
    config: SteeringConfig,
    servo_round_trip_millis: f64,
    joint_names: Vec<String>,
    joint_offsets: Vec<f64>,
}

impl PreparedSteering {
    /// Prepares the robot of a rig for its operators.
    ///
    /// # Errors
    ///
    /// If the robot description has no shapes, because nothing would then protect the robot, or the
    /// footprint of its base is not known.
    pub(crate) fn new(steered: SteeredRobot, rig: &Rig) -> anyhow::Result<Self> {
        let watch = Arc::new(RobotWatch::new(TimeBase::now()));
        let SteeredRobot { arm, base } = steered;
        // A base needs shapes only for its footprint, which the rig file may give instead.
        let robot = match robot::chain_and_body(rig) {
            Ok(robot) => Some(robot),
            Err(error) if arm.is_some() => return Err(error),
            Err(error) => {
                log::debug!("steering: {error:#}");
                None
            }
        };
        let prepare = |base| PreparedBase::new(base, rig, robot.as_ref(), arm.is_some());
        let base = base.map(prepare).transpose()?;
        let in_map = base.as_ref().and_then(|base| base.in_map.as_ref());
        let moving = in_map.map(|in_map| MovingBase {
            in_map,
            watch: Arc::clone(&watch),
        });
        let scene = if arm.is_some() || moving.is_some() {
            Some(Arc::new(SceneClearance::new(rig, robot.as_ref(), moving)?))
        } else {
            None
        };
        Ok(Self {
            arm: arm
                .zip(robot)
                .map(|(arm, robot)| PreparedArm::new(arm, rig, robot)),
            base,
            watch,
            scene,
            ..Self::of(rig)
        })
    }

    /// An observer of the run's input, from which the robot and the free space around it are known.
    /// It also passes everything on to viewers.
    pub(crate) fn observer(&self, viewers: Viewers) -> SteeringObserver {
        // The place of the base is needed before what is seen from there.
        let mut parts: Vec<Arc<dyn RobotObserver>> = vec![Arc::<RobotWatch>::clone(&self.watch)];
        if let Some(scene) = &self.scene {
            parts.push(Arc::<SceneClearance>::clone(scene));
        }
        SteeringObserver::new(viewers, parts)
    }

    /// Passes depth that the live model draws to the map of free space.
    pub(crate) fn clearance_feed(&self) -> Option<ClearanceFeed> {
        let scene = self.scene.as_ref()?;
        Some(ClearanceFeed::new(Arc::clone(scene)))
    }
}

impl PreparedArm {
    fn new(arm: SteeredArm, rig: &Rig, robot: ChainAndBody) -> Self {
        let settings = rig.arm.motion.as_ref().map(|motion| &motion.steering);
        let settings = settings.cloned().unwrap_or_default();
        Self {
            arm,
            robot,
            config: config(&settings),
            servo_round_trip_millis: settings.servo_round_trip_millis,
            joint_names: rig.arm.joints.clone(),
            joint_offsets: rig.arm.joint_offsets.clone(),
        }
    }

    fn start(&self, times: TimeBase) -> anyhow::Result<(SteeringLoop, Vec<SteeredJoint>)> {
        let first = first_report(&self.arm)?;
        let robot = self
            .robot
            .steered(&self.joint_names, &self.joint_offsets, &self.arm)?;
        let joints = self.joints(&robot);
        let steering_loop = SteeringLoop::new(self.config.clone(), robot, times, &first)
            .context("the arm cannot be steered")?;
        Ok((steering_loop, joints))
    }

    fn joints(&self, robot: &steering_loop::SteeredRobot) -> Vec<SteeredJoint> {
        let limits = robot.joints.limits_in_chain(robot.port.limits());
        let names = robot.chain.joint_names().iter();
        let joints = names.zip(&limits).zip(&self.robot.is_prismatic);
        let finite = |bound: f64| bound.is_finite().then_some(bound);
        joints
            .map(|((name, limits), is_prismatic)| SteeredJoint {
                name: name.clone(),
                lower: finite(limits.position[0]),
                upper: finite(limits.position[1]),
                is_prismatic: *is_prismatic,
                velocity: limits.velocity,
            })
            .collect()
    }
}

impl<S: Surroundings> PreparedSteering<S> {
    /// A robot without steered parts.
    fn of(rig: &Rig) -> Self {
        Self {
            arm: None,
            base: None,
            base_link: rig.arm.base_link.clone(),
            tip_link: rig.arm.flange_link.clone(),
            watch: Arc::new(RobotWatch::new(TimeBase::now())),
            scene: None,
            about: About {
                urdf: rig.arm.urdf_text.clone(),
                world_from_base: rig.base.world_from_base,
            },
        }
    }

    /// Lets clients of the hub steer the robot.
    ///
    /// * `log_folder`: where all decisions are logged, if they are.
    ///
    /// # Errors
    ///
    /// If the arm reports nothing, its limits do not match the robot, the configuration of the base
    /// is not valid, or no thread can be started.
    pub(crate) fn start(
        self,
        hub: &Hub,
        log_folder: Option<&Path>,
    ) -> anyhow::Result<SteeringThread> {
        let (mut steering_loop, joints) = self.start_loop()?;
        let server = SteeringServer::new(self.description(joints));
        if let Some(folder) = log_folder {
            steering_loop
                .log_into(folder, self.about)
                .context("cannot start a thread")?;
        }
        let must_stop = Arc::new(AtomicBool::new(false));
        let running = Running {
            steering_loop,
            arm: self.arm.map(|arm| arm.arm),
            base: self.base,
            watch: self.watch,
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

    fn start_loop(&self) -> anyhow::Result<(SteeringLoop, Vec<SteeredJoint>)> {
        let times = self.watch.times();
        let base = self.base.as_ref();
        let base = base.map(|base| (base.config.clone(), base.base.port().clone()));
        match (&self.arm, base) {
            (Some(arm), None) => arm.start(times),
            (Some(arm), Some((config, port))) => {
                let (steering_loop, joints) = arm.start(times)?;
                let steering_loop = steering_loop.with_base(config, port);
                Ok((steering_loop.context(BASE_REFUSED)?, joints))
            }
            (None, Some((config, port))) => {
                let steering_loop = SteeringLoop::of_base(config, port, times);
                Ok((steering_loop.context(BASE_REFUSED)?, Vec::new()))
            }
            (None, None) => bail!("no part of the robot is steered: this is a bug"),
        }
    }

    fn description(&self, joints: Vec<SteeredJoint>) -> ArmDescription {
        let config = match (&self.arm, &self.base) {
            (Some(arm), _) => (arm.config.clutch, arm.config.lease),
            (None, Some(base)) => (base.config.clutch, base.config.lease),
            (None, None) => Default::default(),
        };
        let (clutch, lease): (steering::ClutchConfig, LeaseConfig) = config;
        ArmDescription {
            base_link: self.base_link.clone(),
            tip_link: self.tip_link.clone(),
            joints,
            expiry_secs: clutch.max_silence_secs,
            lease_secs: lease.expiry_secs,
            // Velocities of a base need no preview, whatever the round trip.
            servo_round_trip_millis: self
                .arm
                .as_ref()
                .map_or(f64::from(u16::MAX), |arm| arm.servo_round_trip_millis),
            base: self.base.as_ref().map(PreparedBase::description),
        }
    }
}

/// Context of errors in the configuration of a base.
const BASE_REFUSED: &str = "the base cannot be driven";

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
    arm: Option<SteeredArm>,
    base: Option<PreparedBase>,
    watch: Arc<RobotWatch>,
    scene: Option<Arc<S>>,
    server: Arc<SteeringServer>,
    must_stop: Arc<AtomicBool>,
    _admission: Admission,
}

/// For a base that nobody keeps away from the scene.
struct NoScene;

impl Clearance for NoScene {
    fn readings(&self, _points_in_base: &[[f64; 3]], _now: Stamp) -> Vec<Option<Seen>> {
        Vec::new()
    }
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
        let received = self.server.take_requests();
        if let Some(base) = &self.base {
            base.report_to(&self.watch);
        }
        let reports = Reports {
            // The first report came before the thread was started.
            arm: self.steering_loop.arm(),
            robot: self.watch.seen(),
        };
        if let Some(scene) = &self.scene {
            match &reports.arm {
                Some(arm) => scene.set_posture(arm),
                None => scene.set_base(),
            }
        }
        let now = drivers::clock::now();
        let scene: &dyn Clearance = match &self.scene {
            Some(scene) => &**scene,
            None => &NoScene,
        };
        let outcome = self.steering_loop.cycle(now, &received, &reports, scene);
        if let Some(scene) = self.scene.as_ref().filter(|_| outcome.begins) {
            scene.end_sweep();
        }
        if outcome.begins || outcome.ends_tour {
            self.begin();
        }
        for (client, reply) in outcome.replies {
            match reply {
                Reply::Refused(kind, text) => self.server.refuse(client, kind, text),
                Reply::Preview(id, preview) => self.server.answer_preview(client, id, preview),
            }
        }
        if let Some(mut state) = outcome.state {
            state.contacts = self.n_contacts();
            self.server.publish(state);
        }
    }

    /// Takes all parts of the robot over, or stops them.
    fn begin(&self) {
        if let Some(arm) = &self.arm {
            arm.begin();
        }
        if let Some(base) = &self.base {
            base.base.begin();
        }
    }

    /// All parts of a simulated robot share one count.
    fn n_contacts(&self) -> Option<u64> {
        let of_arm = self.arm.as_ref().and_then(SteeredArm::n_contacts);
        let of_base = || {
            self.base
                .as_ref()
                .and_then(|it| SteeredBase::n_contacts(&it.base))
        };
        of_arm.or_else(of_base)
    }
}
