//! Lets operators drive the base of a run.
//!
//! A separate thread takes the requests of the clients of `/steer`, and decides about the motion of
//! the base with the chain of the crate `steering`. It sends the decision to the base's own thread,
//! which brakes as soon as targets expire. `base_loop.rs` contains one cycle. `robot_watch.rs`
//! stores the newest reports of the devices of the run about the robot.

mod base_loop;
#[cfg(test)]
mod base_loop_tests;
mod pose_tracker;
mod robot_watch;

use super::observer::SteeringObserver;
use super::steering_log::LoopLog;
use super::time_base::TimeBase;
use super::{Admission, MIN_PERIOD, PERIOD, SteeringThread};
use crate::viewers::Viewers;
use anyhow::Context;
use base_loop::BaseLoop;
use capture::InputObserver;
use capture::config::{ArmDriver, Rig};
use capture::open::SteeredBase;
use robot_watch::RobotWatch;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use steering::{BaseSteeringConfig, Stowed};
use viz::{ArmDescription, BaseDescription, Hub, SteeringServer};

/// The steered base of a run, before its input is read.
pub(crate) struct PreparedBase {
    base: SteeredBase,
    config: BaseSteeringConfig,
    base_link: String,
    tip_link: String,
    watch: Arc<RobotWatch>,
    joint_offsets: Vec<f64>,
}

impl PreparedBase {
    /// Prepares the base of a rig for its operators.
    pub(crate) fn new(base: SteeredBase, rig: &Rig) -> Self {
        let times = TimeBase::now();
        Self {
            config: config(&base, rig),
            base,
            base_link: rig.arm.base_link.clone(),
            tip_link: rig.arm.flange_link.clone(),
            watch: Arc::new(RobotWatch::new(times)),
            joint_offsets: rig.arm.joint_offsets.clone(),
        }
    }

    /// An observer of the run's input, from which the pose of the base and the posture of its arm
    /// are known. It also passes everything on to viewers.
    pub(crate) fn observer(&self, viewers: Viewers) -> Box<dyn InputObserver> {
        Box::new(SteeringObserver::new(
            viewers,
            Arc::<RobotWatch>::clone(&self.watch),
        ))
    }

    /// Lets clients of the hub drive the base.
    ///
    /// * `log_folder`: where all decisions are logged, if they are.
    ///
    /// # Errors
    ///
    /// If the configuration is not valid, or no thread can be started.
    pub(crate) fn start(
        self,
        hub: &Hub,
        log_folder: Option<&Path>,
    ) -> anyhow::Result<SteeringThread> {
        let server = SteeringServer::new(self.description());
        let mut base_loop =
            BaseLoop::new(self.config, self.base.port().clone(), self.watch.times())
                .context("the base cannot be driven")?;
        if let Some(folder) = log_folder {
            let log = LoopLog::of_base(folder, base_loop.steering());
            base_loop.log_into(log.context("cannot start a thread")?);
        }
        let must_stop = Arc::new(AtomicBool::new(false));
        let running = Running {
            base_loop,
            base: self.base,
            watch: self.watch,
            joint_offsets: self.joint_offsets,
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

    fn description(&self) -> ArmDescription {
        let limits = &self.config.limits;
        ArmDescription {
            base_link: self.base_link.clone(),
            tip_link: self.tip_link.clone(),
            joints: Vec::new(),
            expiry_secs: self.config.clutch.max_silence_secs,
            lease_secs: self.config.lease.expiry_secs,
            // Velocities of a base need no preview, whatever the round trip.
            servo_round_trip_millis: f64::from(u16::MAX),
            base: Some(BaseDescription {
                max_forward_m_s: limits.max_forward_m_s,
                max_left_m_s: limits.max_left_m_s,
                max_yaw_rad_s: limits.max_yaw_rad_s,
                area_m: self.config.area_m,
            }),
        }
    }
}

/// The configuration of the chain of decisions.
fn config(base: &SteeredBase, rig: &Rig) -> BaseSteeringConfig {
    let motion = rig.base.motion.clone().unwrap_or_default();
    let has_arm = rig.arm.driver != ArmDriver::None && !rig.arm.joints.is_empty();
    let stowed = has_arm.then(|| Stowed {
        joints: rig.arm.joints.clone(),
        position: motion.stowed,
        tolerance: motion.stowed_tolerance,
    });
    BaseSteeringConfig {
        area_m: motion.area_m,
        stowed,
        ..BaseSteeringConfig::new(*base.port().limits())
    }
}

/// Data of the thread.
struct Running {
    base_loop: BaseLoop,
    base: SteeredBase,
    watch: Arc<RobotWatch>,
    joint_offsets: Vec<f64>,
    server: Arc<SteeringServer>,
    must_stop: Arc<AtomicBool>,
    _admission: Admission,
}

impl Running {
    fn run(mut self) {
        let mut decided = Instant::now();
        while !self.must_stop.load(Ordering::Relaxed) {
            let left = (decided + PERIOD).saturating_duration_since(Instant::now());
            self.server.wait_for_requests(left);
            std::thread::sleep((decided + MIN_PERIOD).saturating_duration_since(Instant::now()));
            decided = Instant::now();
            self.decide();
        }
        self.base_loop.finish();
    }

    fn decide(&mut self) {
        let received = self.server.take_requests();
        let now = drivers::clock::now();
        if let Some(pose) = self.base.reported_pose() {
            self.watch.report_pose(pose.stamp, pose.world_from_base);
        }
        if let Some(joints) = self.base.reported_joints() {
            self.watch.report_joints(&joints, &self.joint_offsets);
        }
        let outcome = self.base_loop.cycle(now, &received, &self.watch.seen());
        if outcome.ends_tour {
            self.base.begin();
        }
        for (client, kind, text) in outcome.refusals {
            self.server.refuse(client, kind, text);
        }
        let mut state = outcome.state;
        state.contacts = self.base.n_contacts();
        self.server.publish(state);
    }
}
