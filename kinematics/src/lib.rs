//! Transforms, time, camera models and kinematic chains: pure maths in f64, no I/O, no clock, no GPU.

pub mod camera;
pub mod joints;
pub mod stamp;
pub mod transform;

pub use camera::{Intrinsics, Lens};
pub use joints::JointState;
pub use stamp::Stamp;
pub use transform::{Transform, Twist};
