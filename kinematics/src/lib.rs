//! Transforms, time, camera models and kinematic chains: pure math in f64, no I/O, no clock, no GPU.

pub mod camera;
pub mod chain;
pub mod clock;
mod error;
pub mod history;
pub mod joints;
mod lens;
mod rounding;
pub mod stamp;
pub mod transform;
pub mod undistort;
pub mod urdf;

pub use camera::{Intrinsics, Lens};
pub use chain::Chain;
pub use clock::ClockMap;
pub use error::Error;
pub use history::{HistoryError, JointHistory, PoseHistory};
pub use joints::JointState;
pub use rounding::{f32_of, f32s_of};
pub use stamp::Stamp;
pub use transform::{Transform, Twist};
pub use undistort::Undistortion;
