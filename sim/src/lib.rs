//! Simulated rigs in MuJoCo, behind the traits of `drivers`.
//!
//! [`open`] builds a rig. [`Rig::into_lockstep`] runs it as fast as the caller takes samples. In
//! this mode, the same seed gives bit-identical samples. [`Rig::into_live`] runs the rig in real
//! time as devices, and [`Rig::into_steered`] lets an operator take the arm over. [`Rig::into_commanded`] returns an arm that moves by commands.
//! [`Rig::into_motorized`] returns cameras on an arm that emulated motors move.
//!
//! ```no_run
//! use sim::Config;
//!
//! # let config = || -> Config { unimplemented!() };
//! let config = config(); // cameras, arm, scene and seed
//! let rig = sim::open(&config)?;
//! let samples = rig.into_lockstep();
//! # drop(samples);
//! # Ok::<(), sim::Error>(())
//! ```

mod arm;
mod base;
mod cabinet;
mod cabinet_tour;
mod commanded;
mod commands;
pub mod config;
mod contacts;
mod convex_pieces;
mod egl;
mod engine;
mod error;
mod follower;
mod furniture;
mod hand;
mod handover;
mod joints;
mod lab;
mod lab_texture;
mod lidar;
mod light;
mod live_rig;
mod lockstep;
mod mesh;
mod motors;
mod noise;
mod objects;
mod optics;
mod panda;
mod printed_target;
mod random;
mod render;
mod rig;
mod rig_info;
mod robot;
mod robot_masks;
mod scan;
mod scene;
mod steered_arm;
mod steered_base;
pub mod tag;
mod texture;
mod texture_cache;
mod toy;
mod twin;
pub mod wire;

/// Positions and dimensions in the scenes, for tests that check images and scans.
pub mod layout {
    pub use crate::lab::{PEDESTAL_HALF_M, ROOM_HALF_M, ROOM_HEIGHT_M};
    pub use crate::objects::{
        BLOCK_HALF_M, CUBE_HALF_M, TABLE_Z_M, TARGET_XY_M, world_from_block, world_from_cube,
        world_from_tag,
    };
}

pub use commanded::CommandedRig;
pub use config::{
    BaseConfig, CameraConfig, Config, DepthConfig, DepthSensor, Parent, ScannerConfig, Scene,
    SensorConfig, StampConfig, TargetConfig, TargetParent,
};
pub use error::Error;
pub use live_rig::{LiveRig, LiveTruth, SteeredBaseRig};
pub use lockstep::Lockstep;
pub use motors::MotorHistory;
pub use rig::{PANDA_URDF, Rig, difference_to_robot_of, has_robot_of, open, suits_own_robot};
pub use rig_info::{CameraInfo, RigInfo};
pub use robot_masks::{PinholeView, RobotMasks};
pub use steered_arm::{SteeredArm, SteeredLimits};
pub use steered_base::SteeredBase;
pub use texture_cache::keep_textures_in;
pub use twin::RobotConfig;
