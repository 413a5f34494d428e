//! Commands that calibrate a camera, for messages and comments. They work as printed.

use messages::{EXAMPLE_TARGET, Setting};

/// What a command calibrates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CalibrationCommand {
    /// The lens of a camera.
    Intrinsics,
    /// The pose of a camera on or near an arm.
    HandEye,
}

impl CalibrationCommand {
    /// The command line, which writes the result into the rig file. The rig file is also its input.
    ///
    /// * `rig`: path of the rig file, quoted for a shell.
    #[must_use]
    pub fn line(self, rig: &str, camera: &str) -> String {
        let name = match self {
            Self::Intrinsics => "intrinsics",
            Self::HandEye => "hand-eye",
        };
        format!(
            "fieldrig calibrate {name} {rig} {} {camera} {} {EXAMPLE_TARGET} {} {rig}",
            Setting::Camera,
            Setting::Target,
            Setting::WriteRig
        )
    }
}

/// How to get the target in the command lines, as the end of a sentence.
pub(crate) fn where_the_target_is_from() -> String {
    format!(
        "with the target that `fieldrig calibrate target {} target.pdf` draws",
        Setting::Out
    )
}
