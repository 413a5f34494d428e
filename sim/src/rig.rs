//! Builds a rig and tells what it is made of.

use crate::arm::Arm;
use crate::config::{Config, Parent};
use crate::engine::{Cameras, Engine, history_nanos};
use crate::live::LiveRig;
use crate::lockstep::Lockstep;
use crate::render::Renderer;
use crate::scan::{Follower, Scan};
use crate::{CameraConfig, Error, scene};
use kinematics::{Intrinsics, Stamp, Transform};
use std::sync::Arc;

/// The simulated arm as a URDF: same kinematics and limits, base `panda_link0`, flange `panda_link8`.
pub const PANDA_URDF: &str = include_str!("../../rigs/robots/panda.urdf");

/// A rig that is ready to play.
pub struct Rig {
    engine: Engine,
    info: RigInfo,
}

/// What a rig truly is: what calibration would find.
#[derive(Clone, Debug, PartialEq)]
pub struct RigInfo {
    /// The cameras in the order of the configuration.
    pub cameras: Vec<CameraInfo>,
    /// Names of the joints in the order of the readings.
    pub joint_names: Vec<String>,
    /// The arm; base `panda_link0`, flange `panda_link8`. Its joints keep their own names.
    pub urdf: &'static str,
    /// Pose of the arm's base.
    pub world_from_base: Transform,
    /// What draws, as OpenGL names it.
    pub renderer: String,
}

/// What a camera truly is.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Name in the rig file.
    pub name: String,
    /// Lens parameters of colour and depth.
    pub intrinsics: Intrinsics,
    /// What the camera is fixed to.
    pub parent: Parent,
    /// Pose on the parent.
    pub parent_from_camera: Transform,
    /// Images a second.
    pub rate_hz: f64,
    /// Time from the first row's exposure to the last row's, microseconds.
    pub readout_micros: f64,
    /// Whether it delivers depth.
    pub has_depth: bool,
}

/// Builds the scene and starts its render thread; takes a second or two.
pub fn open(config: &Config) -> Result<Rig, Error> {
    config.check()?;
    let cameras = Cameras::new(config)?;
    let model = Arc::new(scene::build(config, cameras.largest_view_px())?);
    let renderer = Renderer::start(Arc::clone(&model))?;
    let follower = Follower::new(Scan::new(config.speed, config.azimuth_only), scanning_camera(config))?;
    let arm = Arm::new(model, follower, history_nanos(config))?;
    let engine = Engine::new(config.clone(), arm, cameras, renderer)?;
    let info = RigInfo {
        cameras: config.cameras.iter().map(|camera| camera_info(camera, config.ideal)).collect(),
        joint_names: config.reading_order.clone(),
        urdf: PANDA_URDF,
        world_from_base: Transform::identity(),
        renderer: engine.renderer_name().to_owned(),
    };
    Ok(Rig { engine, info })
}

/// The camera that the scan points: the first one on the flange, else where one would sit.
fn scanning_camera(config: &Config) -> Transform {
    let on_flange = config.cameras.iter().find(|camera| camera.parent == Parent::Flange);
    on_flange.map_or_else(|| CameraConfig::wrist("wrist").parent_from_camera, |camera| camera.parent_from_camera)
}

fn camera_info(camera: &CameraConfig, ideal: bool) -> CameraInfo {
    CameraInfo {
        name: camera.name.clone(),
        intrinsics: camera.intrinsics.clone(),
        parent: camera.parent,
        parent_from_camera: camera.parent_from_camera,
        rate_hz: camera.rate_hz,
        readout_micros: if ideal { 0.0 } else { camera.sensor.readout_micros },
        has_depth: camera.depth.is_some(),
    }
}

impl Rig {
    /// What the rig is made of.
    pub fn info(&self) -> &RigInfo {
        &self.info
    }

    /// Plays as fast as samples are taken. Simulated time zero has the stamp 0.
    pub fn into_lockstep(self) -> Lockstep {
        Lockstep::new(self.engine, self.info)
    }

    /// Plays in real time. Simulated time zero is now, which is `start` on the caller's clock.
    pub fn into_live(self, start: Stamp) -> Result<LiveRig, Error> {
        LiveRig::start(self.engine, self.info, start)
    }
}
