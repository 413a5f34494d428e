//! Transforms, time, camera models and kinematic chains. The crate contains only math in f64,
//! without I/O, clocks or the GPU.
//!
//! ```
//! use kinematics::{Chain, Intrinsics, Lens};
//! use nalgebra::Vector3;
//!
//! let urdf = r#"<robot name="lamp">
//!   <link name="base"/> <link name="head"/>
//!   <joint name="neck" type="revolute">
//!     <parent link="base"/> <child link="head"/> <origin xyz="0 0 0.5"/> <axis xyz="0 0 1"/>
//!     <limit lower="-1.5" upper="1.5" effort="1" velocity="1"/>
//!   </joint>
//! </robot>"#;
//! let chain = Chain::from_urdf(urdf, "base", "head")?;
//! let base_from_head = chain.forward(&[0.3])?;
//! assert!((base_from_head.translation.z - 0.5).abs() < 1e-12);
//!
//! let intrinsics = Intrinsics {
//!     size_px: [640, 480],
//!     focal_px: [600.0, 600.0],
//!     principal_px: [320.0, 240.0],
//!     lens: Lens::Pinhole,
//!     rectified: false,
//! };
//! // A point 2 m in front of the camera and 0.1 m to the right.
//! assert_eq!(intrinsics.project(&Vector3::new(0.1, 0.0, 2.0)), Some([350.0, 240.0]));
//! # Ok::<(), kinematics::Error>(())
//! ```

pub mod camera;
pub mod chain;
pub mod collada;
pub mod device_clock;
mod error;
pub mod history;
pub mod inertial;
pub mod inverse;
pub mod joints;
mod lens;
mod polynomial;
mod projection;
pub mod shape;
pub mod stamp;
pub mod transform;
pub mod undistort;
pub mod urdf;
mod xml_limits;

pub use camera::{Intrinsics, Lens};
pub use chain::Chain;
pub use device_clock::ClockMap;
pub use error::Error;
pub use history::{HistoryError, JointHistory, PoseHistory};
pub use joints::JointState;
pub use projection::{MAX_INTRINSICS_PARAMS, Projection};
pub use stamp::Stamp;
pub use transform::{Transform, Twist};
pub use undistort::Undistortion;
