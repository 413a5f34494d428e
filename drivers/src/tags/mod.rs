//! Camera poses from AprilTags at known poses.
//!
//! `detector` finds tags in images on a separate thread, with the reference implementation of
//! AprilTag 3. `locate` estimates the camera pose from the corners of all tags in an image.
//! `pose_filter` averages the poses of a stationary object.

mod detector;
mod locate;
mod pose_filter;

pub use detector::{Family, TagDetection, TagDetections, TagDetector};
pub use locate::{CameraPoseEstimate, LocateError, RollingShutterCamera, TagPlacement, locate};
pub use pose_filter::StationaryPoseFilter;
