//! Calibration parameters of cameras and their estimation from keyframes.
//!
//! A [`CameraCorrection`] holds the estimated errors of one camera: extrinsics (hand-eye), time
//! offset, intrinsics, joint offsets, and the pose, scale and timing of its depth camera. A
//! [`ParamSet`] selects which of them are estimated. [`align`] estimates the selected parameters by
//! registering keyframes with depth. It keeps the estimates that improve validation images
//! ([`Trial`]), and reports their uncertainty. Without depth, it estimates extrinsics from matched
//! features. [`AlignmentTask`] runs [`align`] in parallel with training. [`register_station`]
//! estimates the pose of a mobile base at one station. [`hand_eye`] calibrates a camera with a
//! target, and [`time_offset`] finds the offset between the clocks of two pose streams.
//!
//! [`calibrate_intrinsics`] estimates focal length, principal point and lens of one camera from
//! images of a flat calibration target.
//!
//! ```
//! use calibration::CameraCorrection;
//! # use keyframe::{Keyframe, Split};
//! # use kinematics::{Stamp, Transform};
//! # let keyframe = Keyframe {
//! #     camera: "wrist".into(), stamp: Stamp(0), size_px: [1, 1], focal_px: [1.0; 2], principal_px: [0.5; 2],
//! #     rgba_srgb: [0; 4].into(), depth: None, world_from_camera: Transform::identity(), twist: None,
//! #     readout_secs: 0.0, joint_twists: [].into(), base: None, split: Split::Train, truth: None,
//! #     robot: None,
//! # };
//! // The camera is 5 mm further along its x axis than in its extrinsics.
//! let correction = CameraCorrection { translation_m: [-0.005, 0.0, 0.0], ..CameraCorrection::default() };
//! let corrected = correction.corrected(&keyframe);
//! assert!((corrected.world_from_camera.translation.x - 0.005).abs() < 1e-12);
//! ```

mod background;
mod board;
mod correction;
mod error;
pub mod hand_eye;
mod intrinsics;
pub mod least_squares;
mod params;
mod redrawn;
mod registration;
mod scan_matching;
#[cfg(any(test, feature = "scenes"))]
pub mod scenes;
mod tag_check;
pub mod time_offset;
mod trial;

pub use background::{AlignmentTask, MovementTask, alignment_step};
pub use board::{BoardPoint, BoardView};
pub use correction::{
    CalibratedCamera, CameraCorrection, EMBEDDING_DIM, drift_weight, interpolate, rigid_transform,
    shares_lens,
};
pub use error::Error;
pub use intrinsics::{
    BoardPose, CoverageGoal, EstimatedParam, GoalProgress, ImageFit, ImageGrid, ImagePart,
    IntrinsicsCalibration, IntrinsicsInput, LensCoverage, LensModel, LensTrial, NextPhotograph,
    NextView, PointFit, RECOMMENDED_IMAGES, Rejected, RejectionReason, Side, board_pose,
    calibrate_intrinsics,
};
pub use params::ParamSet;
pub use registration::{
    Alignment, CameraMovement, Estimate, ExtrinsicsCovariance, HalvesAgreement, MOVEMENT_WINDOW,
    MovementDetector, PoseEstimate, PoseSigmas, ScalarEstimate, StationCorrection, Unobservable,
    align, candidates, compare_halves, register_station,
};
pub use scan_matching::{DriftTracker, RangeSensor, ScanMatch};
pub use tag_check::{ContradictionCause, TagCheck, TagContradiction, TagObservation};
pub use trial::{CameraRefinement, Candidate, MIN_VALIDATION_IMAGES, Trial, TrialReport};
