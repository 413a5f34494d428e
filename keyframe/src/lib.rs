//! Posed images for training, which `capture` produces and trainers consume.
//!
//! A [`Keyframe`] is an undistorted image with the pose of its camera at mid-exposure. It may also
//! have a [`DepthMap`], the motion of a rolling shutter and, from a simulator, the [`Truth`].
//! [`RangePoints`] is one revolution of a range scanner. All these types are plain arrays without
//! driver or GPU types. A [`KeyframeList`] or [`Holdout`] selects keyframes and assigns their
//! splits. Camera axes are x right, y down, z forward. In the world, z is up.
//!
//! ```
//! use keyframe::{Keyframe, Split};
//! use kinematics::{Stamp, Transform};
//!
//! let gray = Keyframe {
//!     camera: "wrist".into(),
//!     stamp: Stamp(1_000_000_000),
//!     size_px: [4, 3],
//!     focal_px: [4.0, 4.0],
//!     principal_px: [2.0, 1.5],
//!     rgba_srgb: vec![128; 4 * 3 * 4].into(),
//!     depth: None,
//!     world_from_camera: Transform::translation(0.0, 0.0, 1.0),
//!     twist: None,
//!     readout_secs: 0.0,
//!     joint_twists: [].into(),
//!     base: None,
//!     split: Split::Train,
//!     truth: None,
//!     robot: None,
//! };
//! gray.check()?;
//! assert!(gray.is_finite() && gray.lacks_dense_depth());
//! # Ok::<(), keyframe::Error>(())
//! ```

mod error;
mod fingerprint;
mod holdout;
mod keyframe;
mod list;
pub mod masked_robot;
mod range_points;
mod robot_masking;
#[cfg(any(test, feature = "scenes"))]
pub mod scenes;
mod shutter;
mod viewer_data;

pub use error::Error;
pub use fingerprint::fingerprint;
pub use holdout::Holdout;
pub use keyframe::{BaseState, DepthMap, Keyframe, Split, Truth};
pub use list::{KeyframeList, list_text, split_from_name, split_name};
pub use range_points::RangePoints;
pub use robot_masking::MaskViews;
pub use shutter::Shutter;
pub use viewer_data::{LiveImage, LivePixels, RangeScan, RobotState};
