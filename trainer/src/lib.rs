//! Radiance fields trained on wgpu: keyframes in, pictures out.

mod error;
pub mod keyframe;
pub mod method;
pub mod request;

pub use error::Error;
pub use keyframe::{DepthMap, Keyframe, Split, Truth};
pub use method::{Method, Progress};
pub use request::{Aabb, Picture, Projection, RenderRequest};
