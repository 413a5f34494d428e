//! Names of devices in messages and statistics. Programs match the statistics of a device with its
//! samples by these names.

use crate::Sample;

/// The arm.
pub const ARM: &str = "arm";
/// The base.
pub const BASE: &str = "base";

/// The camera with this name in the rig file.
#[must_use]
pub fn camera(name: &str) -> String {
    format!("camera {name:?}")
}

/// The depth images of the camera with this name in the rig file.
#[must_use]
pub fn camera_depth(name: &str) -> String {
    format!("camera {name:?} depth")
}

/// The range scanner with this name in the rig file.
#[must_use]
pub fn range_scanner(name: &str) -> String {
    format!("range scanner {name:?}")
}

/// The device that delivered a sample. `None` for ground truth, which no device delivers.
#[must_use]
pub fn of_sample(sample: &Sample) -> Option<String> {
    Some(match sample {
        Sample::Image(image) if image.is_depth() => camera_depth(&image.camera),
        Sample::Image(image) => camera(&image.camera),
        Sample::Joints(_) => ARM.to_owned(),
        Sample::Base(_) => BASE.to_owned(),
        Sample::Range(scan) => range_scanner(&scan.scanner),
        Sample::Truth(_) | Sample::BaseTruth(_) => return None,
    })
}
