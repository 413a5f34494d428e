//! Names of devices in messages and statistics. Programs match the statistics of a device with its
//! samples by these names.

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
