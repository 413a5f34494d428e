//! Simulated rigs in MuJoCo, behind the traits of `drivers`.

pub mod config;
mod error;

pub use config::{CameraConfig, Config, DepthConfig, Parent, Scene, SensorConfig};
pub use error::Error;
