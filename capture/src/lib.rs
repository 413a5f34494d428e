//! From a rig file to keyframes: opens the devices, joins images with poses, and corrects base
//! poses.
//!
//! A [`Rig`] is a checked rig file. [`open::rig`] opens its real or simulated devices as one source
//! of samples. [`open::recording`] opens a recording as such a source. A [`Join`] turns the samples
//! into keyframes: it pairs each image with the pose of its camera at mid-exposure. It rejects
//! images that are blurred, badly exposed or too close to others, and it bounds the memory.
//! [`Stations`] corrects the drift of a moving base. [`Feed`] does all of this on a separate
//! thread. [`RecordPlan`] records the samples. [`dataset`] loads the photos of datasets, whose
//! poses are known. [`doctor`] checks whether this computer and its devices are ready.
//!
//! ```
//! use capture::{Join, Rig};
//!
//! let rig_file = r#"
//! [arm]
//! driver = "none"
//! [camera.front]
//! driver = "v4l2"
//! size_px = [640, 480]
//! rate_hz = 30
//! parent = "base"
//! parent_from_camera = { xyz_m = [0.3, 0.0, 0.2], quat_xyzw = [-0.5, 0.5, -0.5, 0.5] }
//! intrinsics = { focal_px = [600, 600], principal_px = [320, 240] }
//! "#;
//! let urdf = r#"<robot name="none"><link name="base"/></robot>"#;
//! let rig = Rig::parse("rig.toml", rig_file, urdf, &[])?;
//! assert_eq!(&*rig.cameras[0].name, "front");
//! let join = Join::new(&rig)?;
//! assert_eq!(join.counts().to_string(), "0 keyframes of 0 images");
//! # Ok::<(), anyhow::Error>(())
//! ```

mod arm_capture;
mod calibration_commands;
mod calibration_images;
pub mod camera_info;
pub mod config;
pub mod ctrl_c;
pub mod dataset;
pub mod doctor;
pub mod downscale;
#[cfg(all(feature = "sim", target_os = "linux"))]
pub mod emulation;
mod feed;
mod found_devices;
pub mod init;
mod input_counts;
mod join;
pub mod known_robots;
mod live_pixels;
mod memory;
mod mesh_files;
mod mesh_triangles;
mod nearest_name;
mod notes;
pub mod open;
mod outputs;
mod pose_distance;
mod record;
mod recorded_meshes;
mod requested_motion;
pub mod rig_facts;
mod robot_masks;
mod robot_motion;
mod separate_devices;
mod stamp_clock;
mod stations;
mod stop;
mod supervised_arm;
mod tip_poses;

pub use arm_capture::ArmCapture;
pub use calibration_commands::CalibrationCommand;
pub use calibration_images::{
    ArmDuringImage, CalibrationImage, CalibrationImages, calibration_images,
    chosen_calibration_images,
};
pub use config::{ConfigError, Override, Rig};
pub use feed::{Feed, FeedItem, Input, InputObserver, InputResult, InputTimes};
pub use found_devices::{ChangeKind, DeviceChange, DeviceInfo, DeviceWatch, found_devices};
pub use input_counts::InputCounts;
pub use join::{
    Change, Counts, DriftReport, Join, JoinEvent, PosedImage, Rejection, SampleUse, StoreUse,
};
pub use live_pixels::live_pixels;
pub use mesh_files::MeshKind;
pub use mesh_triangles::{Triangle, mesh_triangles};
pub use nearest_name::nearest_name;
pub use notes::Notes;
pub use outputs::{check_output_file, check_output_folder};
pub use pose_distance::PoseDistance;
pub use record::{RecordPlan, Recorded, WrittenRecording};
pub use recorded_meshes::RecordedMeshes;
pub use requested_motion::{Arrival, RequestedMotion, format_positions};
pub use robot_masks::RobotCover;
pub use robot_motion::RobotMotion;
pub use separate_devices::{DeviceEvent, DeviceGroup, SeparateDevices};
pub use stamp_clock::StampClock;
pub use stations::{StationReport, Stations};
pub use stop::Stop;
pub use supervised_arm::{HOLDING, MotionEnd, SupervisedArm};
pub use tip_poses::TipPoses;
