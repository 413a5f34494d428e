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

mod guidance_page;
mod guide;
mod guided;
mod hand_eye;
mod host;
mod images;
mod intrinsics;
mod intrinsics_document;
mod json_object;
mod lens;
mod lens_devices;
mod matrix;
mod outputs;
mod photograph_quality;
mod printed_target;
mod published_coverage;
mod saved_images;
mod scan;
mod scene;
mod scene_document;
mod scene_report;
mod symmetry;
mod time_offset;
mod time_offset_document;

pub use guidance_page::GuidancePage;
pub use hand_eye::{
    CalibratedHandEye, HandEyeDocument, HandEyeOutcome, HandEyeSamples, HandEyeTask, MotionOptions,
    MovedArm, RobotOptions,
};
pub use host::{Activity, CameraView, Host};
pub use intrinsics::{IntrinsicsOutcome, IntrinsicsTask};
pub use intrinsics_document::IntrinsicsDocument;
pub use lens::LensFile;
pub use outputs::{ReportOptions, RigOptions};
pub use printed_target::PrintedTargetTask;
pub use scene::{SceneOutcome, SceneTask};
pub use scene_document::SceneDocument;
pub use time_offset::{TimeOffsetOutcome, TimeOffsetTask};
pub use time_offset_document::TimeOffsetDocument;
