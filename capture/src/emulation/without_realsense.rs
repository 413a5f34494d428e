//! Stands in for the bag files of `RealSense` cameras in a program without librealsense2. It serves
//! rigs without such cameras.

use crate::config::{CameraDriver, Rig};
use drivers::Image;
use messages::BadInput;
use std::path::Path;

/// The bag files of a rig without RealSense cameras: none.
pub(super) struct CameraFiles;

impl CameraFiles {
    /// # Errors
    ///
    /// If the rig has a RealSense camera.
    pub(super) fn new(rig: &Rig, _folder: &Path) -> anyhow::Result<Self> {
        check(rig)?;
        Ok(Self)
    }

    /// Images of cameras that are not emulated are not needed.
    pub(super) fn take(&mut self, _image: Image) -> anyhow::Result<()> {
        Ok(())
    }

    pub(super) fn finish(self, _rig: &mut Rig) -> anyhow::Result<Vec<String>> {
        Ok(Vec::new())
    }
}

/// Checks that the rig has no camera that needs the library.
///
/// # Errors
///
/// If it has one.
pub(super) fn check(rig: &Rig) -> Result<(), BadInput> {
    let needs_library = rig
        .cameras
        .iter()
        .find(|camera| camera.driver == CameraDriver::Realsense);
    match needs_library {
        None => Ok(()),
        Some(camera) => Err(BadInput(format!(
            "camera {:?}: this program was built without RealSense support, which the emulation of this camera needs: \
             install the RealSense SDK or run scripts/fetch-realsense.sh, then build with \
             `cargo build --release --features sim,realsense`",
            camera.name
        ))),
    }
}
