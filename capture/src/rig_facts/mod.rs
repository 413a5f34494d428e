//! What a rig file means: frames and which of them move together, poses and fields of view of the
//! cameras, and the reach of the arm, in sentences and as a picture.
//!
//! A valid rig file may still describe another robot than the real one: a camera that looks into
//! the flange, a lens of another resolution, or lengths in other units. People notice this at once
//! when they read where the camera is, or see it.

mod camera;
mod drawing;
mod robot;
mod sentences;
#[cfg(test)]
mod tests;

pub use camera::{CameraFacts, FieldOfView, ScannerFacts};
pub use drawing::svg;
pub use robot::{ArmFacts, Bone};
pub use sentences::{Sentence, sentences};

use crate::config::{BaseDriver, Rig};
use anyhow::Context;
use kinematics::Transform;
use messages::{BadInput, Setting};
use robot::RobotAtRest;
use std::path::Path;

/// What a rig file means.
#[derive(Clone, Debug)]
pub struct RigFacts {
    /// Link of the URDF that is the base of the robot.
    pub base_link: String,
    /// Source of the pose of the base.
    pub base_driver: BaseDriver,
    /// Pose of the base in the world. The identity if the base moves.
    pub world_from_base: Transform,
    /// The arm; `None` if no joint moves the flange.
    pub arm: Option<ArmFacts>,
    /// All links of the robot at rest.
    pub bones: Vec<Bone>,
    /// Cameras in the order of the rig.
    pub cameras: Vec<CameraFacts>,
    /// Range scanners in the order of the rig.
    pub scanners: Vec<ScannerFacts>,
}

/// Draws a rig into a file, which is replaced if it exists.
///
/// # Errors
///
/// If the file has another extension than `.svg`, or cannot be written.
pub fn write_picture(rig: &Rig, file: &Path) -> anyhow::Result<()> {
    if file.extension().is_none_or(|ending| ending != "svg") {
        return Err(BadInput(format!(
            "{} {}: must have the extension .svg",
            Setting::Picture,
            file.display()
        ))
        .into());
    }
    let picture = svg(&RigFacts::of(rig)?);
    files::write(file, picture).with_context(|| format!("cannot write {}", file.display()))
}

impl RigFacts {
    /// The facts of a rig.
    ///
    /// # Errors
    ///
    /// If the URDF of the rig has no chain from base to flange, which a checked rig rules out.
    pub fn of(rig: &Rig) -> anyhow::Result<Self> {
        let world_from_base = if rig.has_moving_base() {
            Transform::identity()
        } else {
            rig.base.world_from_base
        };
        let robot = RobotAtRest::of(rig)?;
        let arm = ArmFacts::of(rig, &robot)?;
        let cameras = rig
            .cameras
            .iter()
            .map(|camera| CameraFacts::of(camera, &world_from_base, &robot, arm.as_ref()))
            .collect();
        let scanners = rig.scanners.iter().map(ScannerFacts::of).collect();
        Ok(Self {
            base_link: rig.arm.base_link.clone(),
            base_driver: rig.base.driver,
            world_from_base,
            arm,
            bones: robot.bones,
            cameras,
            scanners,
        })
    }
}
