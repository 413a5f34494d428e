//! The procedures of `fieldrig calibrate`. They read or take images, estimate parameters, and write
//! a report and a rig file.
//!
//! A task holds the options of one procedure: [`IntrinsicsTask`] for the lens of a camera,
//! [`HandEyeTask`] for the pose of a camera on a robot, [`SceneTask`] for the cameras of a rig
//! without a target, and [`TimeOffsetTask`] for the clocks of two pose streams. Running a task
//! returns an outcome, which contains the estimates and can write the rig file. If requested, the
//! arm moves to the poses that determine the result best ([`MotionOptions`]).
//!
//! The estimation itself is in the crate `calibration`, and the detection of targets is in
//! `targets`. The program that runs a procedure implements [`Host`], which passes on stop requests
//! and shows the progress.

mod guide;
mod guided;
mod hand_eye;
mod host;
mod images;
mod intrinsics;
mod json_object;
mod lens;
mod lens_devices;
mod outputs;
mod photograph_quality;
mod saved_images;
mod scan;
mod scene;
mod scene_report;
mod symmetry;
mod time_offset;

pub use hand_eye::{
    CalibratedHandEye, HandEyeOutcome, HandEyeSamples, HandEyeTask, MotionOptions, MovedArm,
    RobotOptions, pose_toml,
};
pub use host::{Activity, CameraView, Host};
pub use intrinsics::{IntrinsicsOutcome, IntrinsicsTask};
pub use lens::LensFile;
pub use outputs::{ReportOptions, RigOptions};
pub use scene::{SceneOutcome, SceneTask};
pub use symmetry::symmetry_warning;
pub use time_offset::{TimeOffsetOutcome, TimeOffsetTask};
