//! Builds a rig from its configuration.

use crate::arm::Arm;
use crate::base::{BaseMotion, base_from_arm};
use crate::cabinet_tour::CabinetTour;
use crate::commanded::CommandedRig;
use crate::config::{Config, N_JOINTS, Parent, Scene};
use crate::contacts::ContactCounter;
use crate::engine::{Cameras, Engine, history_nanos};
use crate::follower::{Follower, Tour};
use crate::live_rig::{LiveRig, SteeredBaseRig};
use crate::lockstep::Lockstep;
use crate::motors::MotorHistory;
use crate::objects::{TABLE_Z_M, TARGET_XY_M};
use crate::render::Renderer;
use crate::rig_info::{CameraInfo, RigInfo};
use crate::robot::{Robot, RobotKinematics};
use crate::scan::{LOOK_AT_HEIGHT_M, Scan};
use crate::steered_arm::{SteeredArm, SteeredLimits};
use crate::twin::{self, Efforts, RobotConfig};
use crate::{CameraConfig, Error, scene};
use drivers::motion::MotionLimits;
use drivers::{Camera, FlangeDifference};
use kinematics::{Chain, Stamp, Transform};
use mujoco_rs::prelude::MjModel;
use nalgebra::Point3;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

/// The simulated arm as a URDF, with the same kinematics and limits. The base is `panda_link0`, and
/// the flange is `panda_link8`.
pub const PANDA_URDF: &str = include_str!("../../rigs/robots/panda.urdf");

/// The mobile arm as a URDF. Its root is `base`, and its arm is the arm of [`PANDA_URDF`].
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
    build_contacts: BuildContacts,
}

/// Builds the model that counts contacts. It is built only if it is needed, because this takes a
/// moment.
type BuildContacts = Box<dyn FnOnce() -> Result<MjModel, Error> + Send>;

/// Builds the scene and starts its render thread. Takes one to two seconds, and a second longer
/// with the robot of a rig file.
pub fn open(config: &Config) -> Result<Rig, Error> {
    // This check comes before anything reaches MuJoCo, which aborts the process on invalid numbers.
    config.check()?;
    let cameras = Cameras::new(config)?;
    match &config.robot {
        Some(robot) => open_twin(config, robot, cameras),
        None => open_scene(config, cameras),
    }
}

/// Opens a scene with its own robot.
fn open_scene(config: &Config, cameras: Cameras) -> Result<Rig, Error> {
    // Dynamics, rendering and ray casting share one model, but each has its own data.
    let model = Arc::new(scene::build(config, cameras.largest_view_px())?);
    let motion = BaseMotion::of(config.scene, config.speed);
    let arm = match tour_of(config) {
        Some(tour) => {
            let follower = Follower::new(tour, scanning_camera(config))?;
            follower.warn_if_tour_is_unreachable();
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
    let kinematics = if config.scene.has_arm() {
        RobotKinematics::Panda(base_from_arm)
    } else {
        RobotKinematics::NoArm(base_from_arm)
    };
    let robot = Robot::new(arm, motion, kinematics);
    let build_contacts = {
        let config = config.clone();
        move || scene::build_contacts(&config, None)
    };
    let (engine, info) = finish(config, cameras, (robot, model), urdf_of(config.scene))?;
    Ok(Rig {
        engine,
        info,
        build_contacts: Box::new(build_contacts),
    })
}

/// Opens a scene with the robot of a rig file.
fn open_twin(config: &Config, robot: &RobotConfig, cameras: Cameras) -> Result<Rig, Error> {
    let mut plan = twin::plan(config, robot)?;
    let follower = plan.follower.take();
    let model = Arc::new(scene::build_twin(
        config,
        (robot, &plan),
        cameras.largest_view_px(),
    )?);
    let arm = follower.map(|follower| {
        let efforts = Efforts::new(Arc::clone(&model), Arc::clone(&plan.model));
        Arm::exact(efforts, follower, history_nanos(config))
    });
    let kinematics = RobotKinematics::Twin(Arc::clone(&plan.model));
    let moving = Robot::new(arm, plan.motion, kinematics);
    let build_contacts = {
        let (config, robot) = (config.clone(), robot.clone());
        move || scene::build_contacts(&config, Some((&robot, &plan)))
    };
    let (engine, info) = finish(config, cameras, (moving, model), &robot.urdf)?;
    Ok(Rig {
        engine,
        info,
        build_contacts: Box::new(build_contacts),
    })
}

/// Starts the render thread and the engine.
fn finish(
    config: &Config,
    cameras: Cameras,
    (robot, model): (Robot, Arc<MjModel>),
    urdf: &str,
) -> Result<(Engine, RigInfo), Error> {
    let renderer = Renderer::start(Arc::clone(&model), scene::near_far_m(config.scene))?;
    let world_from_base = robot.motion().world_from_base(0.0);
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
        has_moving_base: config.has_moving_base(),
        urdf: urdf.to_owned(),
        world_from_base,
        renderer: engine.renderer_name().to_owned(),
    };
    Ok((engine, info))
}

/// The camera tour of a scene with an arm.
fn tour_of(config: &Config) -> Option<Tour> {
    match config.scene {
        Scene::StaticArm => Some(Tour::Table(Scan::new(config.speed, config.azimuth_only))),
        Scene::MobileBase => None,
        Scene::MobileArm => {
            let motion = BaseMotion::of(config.scene, config.speed);
            Some(Tour::Cabinet(CabinetTour::new(motion, config.speed)))
        }
    }
}

/// Whether a chain from base to flange has the kinematics of a scene's own arm. The names of joints
/// and links do not matter.
pub fn has_robot_of(scene: Scene, chain: &Chain) -> bool {
    /// Tolerance, meters and radians. It is far below the length of any part, and above rounding in
    /// a file.
    const TOLERANCE: f64 = 1e-5;
    if !scene.has_arm() {
        return chain.n_joints() == 0;
    }
    difference_to_robot_of(scene, chain)
        .is_some_and(|difference| difference.is_within(TOLERANCE, TOLERANCE))
}

/// The largest differences, over several postures, between the flange poses of a chain from base to
/// flange and the flange poses of a scene's own arm. `None` if the scene has no arm, or the chain
/// has another number of joints.
pub fn difference_to_robot_of(scene: Scene, chain: &Chain) -> Option<FlangeDifference> {
    if !scene.has_arm() {
        return None;
    }
    let base_from_arm = if scene.has_moving_base() {
        base_from_arm()
    } else {
        Transform::identity()
    };
    // The postures have no symmetry, so that every length and axis matters.
    let postures = [
        [0.0; N_JOINTS],
        [0.4, -0.9, 1.3, -2.2, -0.7, 1.8, 0.6],
        [-2.1, 1.1, 0.3, -0.4, 2.2, 3.1, -1.9],
    ];
    let mut largest = FlangeDifference {
        translation_m: 0.0,
        rotation_rad: 0.0,
    };
    for position in postures {
        let own =
            base_from_arm * crate::panda::base_from_flange(&crate::panda::Joints::from(position));
        let difference = FlangeDifference::between(&own, &chain.forward(&position).ok()?);
        largest.translation_m = largest.translation_m.max(difference.translation_m);
        largest.rotation_rad = largest.rotation_rad.max(difference.rotation_rad);
    }
    Some(largest)
}

/// Whether the scene's own arm can follow its tour with the cameras of a rig. For this, the arm
/// must reach all poses, the exposure must be short enough for the speed, and fixed cameras must
/// see the scene.
pub fn suits_own_robot(config: &Config, max_blur_px: f64) -> bool {
    /// Image speed of the fastest camera motion in the scenes, relative to the focal length, per
    /// second.
    const FASTEST_PER_SEC: f64 = 0.35;
    let Some(tour) = tour_of(config) else {
        return true;
    };
    let is_followed = Follower::new(tour, scanning_camera(config))
        .is_ok_and(|follower| follower.can_follow_tour());
    let is_sharp = config.cameras.iter().all(|camera| {
        let speed_px_s = FASTEST_PER_SEC * config.speed * camera.intrinsics.focal_px[0];
        1e-6 * camera.sensor.exposure_micros * speed_px_s <= max_blur_px
    });
    is_followed && is_sharp && fixed_cameras_see(config)
}

/// Whether all cameras in the world see the objects on the table. Cameras in other scenes always
/// see something.
fn fixed_cameras_see(config: &Config) -> bool {
    let [x, y] = TARGET_XY_M;
    let center = Point3::new(x, y, TABLE_Z_M + LOOK_AT_HEIGHT_M);
    config.scene != Scene::StaticArm
        || config
            .cameras
            .iter()
            .filter(|camera| camera.parent != Parent::Flange)
            .all(|camera| twin::sees(&camera.intrinsics, &camera.parent_from_camera, &center))
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

/// The counter of contacts. Steering does not need it: contacts only measure how well it works.
fn contact_counter(build: BuildContacts) -> Option<ContactCounter> {
    build()
        .map(ContactCounter::new)
        .inspect_err(|error| log::warn!("contacts with the scene are not counted: {error}"))
        .ok()
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

    /// Like [`Self::into_commanded`], and counts how often a part of the robot touches a part of the
    /// scene.
    ///
    /// # Errors
    ///
    /// If the arm cannot be commanded, or the model of the contacts cannot be built.
    pub fn into_counted(
        self,
        limits: &[MotionLimits],
    ) -> Result<(CommandedRig, Arc<AtomicU64>), Error> {
        let Self {
            mut engine,
            info,
            build_contacts,
        } = self;
        let counter = ContactCounter::new(build_contacts()?);
        let n_contacts = counter.n_contacts();
        engine.count_contacts(Some(counter));
        Ok((CommandedRig::new(engine, info, limits)?, n_contacts))
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

    /// Lets the rig run in real time, with an arm that an operator may take over from its tour.
    /// Simulated time zero is the time of this call, which is `start` on the caller's clock.
    ///
    /// # Errors
    ///
    /// If the rig has no arm, the arm is outside its limits, or a thread cannot be started.
    pub fn into_steered(
        self,
        start: Stamp,
        limits: SteeredLimits<'_>,
    ) -> Result<(LiveRig, SteeredArm), Error> {
        let contacts = contact_counter(self.build_contacts);
        LiveRig::start_steered((self.engine, contacts), self.info, start, limits)
    }

    /// Lets the rig run in real time, with a base that an operator may take over from its tour.
    ///
    /// * `limits`: those of the arm on the base, if the operator may take it over, too.
    ///
    /// # Errors
    ///
    /// If the arm is outside its limits, or a thread cannot be started.
    pub fn into_steered_base(
        self,
        limits: Option<SteeredLimits<'_>>,
    ) -> Result<SteeredBaseRig, Error> {
        let contacts = contact_counter(self.build_contacts);
        LiveRig::start_with_steered_base((self.engine, contacts), self.info, limits)
    }

    /// Lets the rig run in real time. Simulated time zero is the time of this call, which is
    /// `start` on the caller's clock.
    pub fn into_live(self, start: Stamp) -> Result<LiveRig, Error> {
        LiveRig::start(self.engine, self.info, start)
    }
}
