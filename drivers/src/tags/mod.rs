//! Where a camera is, by AprilTags whose places are known.
//!
//! `detector` finds tags in images, in a thread of its own, with the reference implementation of AprilTag 3; `locate` makes the
//! camera's pose of the corners of all tags in an image; `pose_filter` averages poses while nothing moves.

mod detector;
mod locate;
mod pose_filter;

pub use detector::{Family, TagDetection, TagDetections, TagDetector};
pub use locate::{CameraPoseEstimate, LocateError, RollingShutterCamera, TagPlacement, locate};
pub use pose_filter::StationaryPoseFilter;
