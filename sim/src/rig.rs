//! Builds a rig from its configuration.

use crate::arm::Arm;
use crate::base::{BaseMotion, base_from_arm};
use crate::cabinet_tour::CabinetTour;
use crate::commanded::CommandedRig;
use crate::config::{Config, Parent, Scene};
use crate::engine::{Cameras, Engine, history_nanos};
use crate::follower::{Follower, Tour};
use crate::live_rig::LiveRig;
use crate::lockstep::Lockstep;
use crate::motors::MotorHistory;
use crate::render::Renderer;
use crate::rig_info::{CameraInfo, RigInfo};
use crate::robot::Robot;
use crate::scan::Scan;
use crate::{CameraConfig, Error, scene};
use drivers::Camera;
use drivers::motion::MotionLimits;
use kinematics::{Stamp, Transform};
use std::sync::Arc;

/// The simulated arm as a URDF, with the same kinematics and limits. The base is `panda_link0`, and
/// the flange is `panda_link8`.
pub const PANDA_URDF: &str = include_str!("../../rigs/robots/panda.urdf");

/// The mobile arm as a URDF. Its root is `base`, and its arm is the one above.
const MOBILE_ARM_URDF: &str = include_str!("../../rigs/robots/mobile-arm.urdf");
/// The quadruped as a URDF. Its root is `base`, and `top_plate` is on its back.
const QUADRUPED_URDF: &str = include_str!("../../rigs/robots/quadruped.urdf");

/// URDF of a scene's robot.
pub(crate) fn urdf_of(scene: Scene) -> &'static str {
    match scene {
        Scene::StaticArm => PANDA_URDF,
        Scene::MobileBase => QUADRUPED_URDF,
        Scene::MobileArm => MOBILE_ARM_URDF,
    }
}

/// A rig that is ready to run.
pub struct Rig {
    engine: Engine,
    info: RigInfo,
}

/// Builds the scene and starts its render thread. Takes one to two seconds.
pub fn open(config: &Config) -> Result<Rig, Error> {
    // This check comes before anything reaches MuJoCo, which aborts the process on invalid numbers.
    config.check()?;
    let cameras = Cameras::new(config)?;
    // Dynamics, rendering and ray casting share one model, but each has its own data.
    let model = Arc::new(scene::build(config, cameras.largest_view_px())?);
    let renderer = Renderer::start(Arc::clone(&model), scene::near_far_m(config.scene))?;
    let motion = BaseMotion::of(config.scene, config.speed);
    let tour = match config.scene {
        Scene::StaticArm => Some(Tour::Table(Scan::new(config.speed, config.azimuth_only))),
        Scene::MobileBase => None,
        Scene::MobileArm => Some(Tour::Cabinet(CabinetTour::new(motion, config.speed))),
    };
    let arm = match tour {
        Some(tour) => {
            let follower = Follower::new(tour, scanning_camera(config))?;
            Some(Arm::new(
                Arc::clone(&model),
                follower,
                history_nanos(config),
            )?)
        }
        None => None,
    };
    let base_from_arm = if config.scene.has_moving_base() {
        base_from_arm()
    } else {
        Transform::identity()
    };
    let robot = Robot::new(arm, motion, base_from_arm);
    let engine = Engine::new(config.clone(), robot, cameras, renderer, model)?;
    let info = RigInfo {
        cameras: config
            .cameras
            .iter()
            .map(|camera| camera_info(camera, config.ideal))
            .collect(),
        joint_names: config.reading_order.clone(),
        scanner_names: config
            .scanners
            .iter()
            .map(|scanner| scanner.name.clone())
            .collect(),
        has_moving_base: config.scene.has_moving_base(),
        urdf: urdf_of(config.scene),
        world_from_base: motion.world_from_base(0.0),
        renderer: engine.renderer_name().to_owned(),
    };
    Ok(Rig { engine, info })
}

/// `flange_from_camera` of the camera that follows the tour. This is the first camera on the
/// flange. Without such a camera, a default pose is returned.
fn scanning_camera(config: &Config) -> Transform {
    let on_flange = config
        .cameras
        .iter()
        .find(|camera| camera.parent == Parent::Flange);
    on_flange.map_or_else(
        || CameraConfig::wrist("wrist").parent_from_camera,
        |camera| camera.parent_from_camera,
    )
}

fn camera_info(camera: &CameraConfig, ideal: bool) -> CameraInfo {
    CameraInfo {
        name: camera.name.clone(),
        intrinsics: camera.intrinsics.clone(),
        parent: camera.parent,
        parent_from_camera: camera.parent_from_camera,
        rate_hz: camera.rate_hz,
        readout_micros: if ideal {
            0.0
        } else {
            camera.sensor.readout_micros
        },
        has_depth: camera.depth.is_some(),
    }
}

impl Rig {
    /// True parameters of the rig.
    pub fn info(&self) -> &RigInfo {
        &self.info
    }

    /// Lets the rig run as fast as the caller takes its samples. Simulated time zero has the stamp
    /// 0.
    pub fn into_lockstep(self) -> Lockstep {
        Lockstep::new(self.engine, self.info)
    }

    /// Lets the rig run as fast as its devices are read. The caller moves the arm with commands.
    /// The arm moves only within `limits`, which are in the order of the joint readings. Simulated
    /// time zero has the stamp 0.
    pub fn into_commanded(self, limits: &[MotionLimits]) -> Result<CommandedRig, Error> {
        CommandedRig::new(self.engine, self.info, limits)
    }

    /// The joint positions that the arm reports at the start, in the order of the joint readings.
    pub fn start_position(&mut self) -> Result<Vec<f64>, Error> {
        self.engine.reported_joints()
    }

    /// Lets the rig run in real time, with an arm that follows emulated motors. Returns its
    /// cameras. Simulated time zero is the time of this call, which is `start` on the clock of the
    /// motors.
    pub fn into_motorized(
        mut self,
        motors: MotorHistory,
        start: Stamp,
    ) -> Result<Vec<Box<dyn Camera>>, Error> {
        self.engine.follow_motors(motors, start)?;
        Ok(LiveRig::start(self.engine, self.info, start)?
            .devices
            .cameras)
    }

    /// Lets the rig run in real time. Simulated time zero is the time of this call, which is
    /// `start` on the caller's clock.
    pub fn into_live(self, start: Stamp) -> Result<LiveRig, Error> {
        LiveRig::start(self.engine, self.info, start)
    }
}
