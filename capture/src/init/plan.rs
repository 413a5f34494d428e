//! Decides on the contents of a rig file.

use super::arm_plan::{self, ArmPlan};
use super::camera_guess;
use super::findings::{Findings, FoundCamera};
use super::wishes::{WantedCamera, Wishes};
use crate::calibration_commands::CalibrationCommand;
use crate::config::{CameraDriver, Parent};
use crate::doctor::Finding;
use anyhow::bail;
use kinematics::Transform;
use messages::{Setting, quoted_for_shell};
use std::path::Path;

/// Size and rate of the images of a camera that was not found: a usual mode of webcams.
const DEFAULT_SIZE_PX: [u32; 2] = [640, 480];
const DEFAULT_RATE_HZ: f64 = 30.0;

/// The contents of a rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct RigPlan {
    pub(super) arm: Option<ArmPlan>,
    pub(super) cameras: Vec<CameraPlan>,
    pub(super) has_moving_base: bool,
    pub(super) field_of_view_deg: f64,
    /// One sentence for each decision that may be wrong, with the flag that changes it.
    pub assumptions: Vec<String>,
}

/// A camera of a rig file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CameraPlan {
    /// Name of its table.
    pub name: String,
    /// The camera. `None`: it is simulated.
    pub found: Option<FoundCamera>,
    pub size_px: [u32; 2],
    pub rate_hz: f64,
    pub parent: Parent,
    /// Whether nobody has said where the camera is.
    pub is_parent_guessed: bool,
    /// Guess of its pose.
    pub parent_from_camera: Transform,
    /// Guess of its focal length; `None` if the camera reports its intrinsics.
    pub focal_px: Option<f64>,
}

impl RigPlan {
    /// Decides on a rig file.
    ///
    /// # Errors
    ///
    /// If the robot description has no arm, or the devices that were found need one.
    pub fn new(wishes: &Wishes, findings: &Findings) -> anyhow::Result<Self> {
        let mut assumptions = Vec::new();
        let arm = arm_plan::choose(wishes, findings, &mut assumptions)?;
        let wanted = wanted_cameras(wishes, findings, arm.is_some(), &mut assumptions)?;
        let mut cameras: Vec<CameraPlan> = Vec::new();
        for (wanted, found) in assign(wanted, findings) {
            let plan = camera(&wanted, found, arm.as_ref(), wishes, &cameras);
            if plan.found.is_none() {
                assumptions.push(format!(
                    "camera {:?} is simulated, because no camera was found for it",
                    plan.name
                ));
            }
            if plan.focal_px.is_some() {
                assumptions.push(format!(
                    "camera {:?} has a horizontal field of view of {} degrees ({}), and a guessed pose",
                    plan.name,
                    wishes.field_of_view_deg,
                    Setting::FieldOfView
                ));
            }
            cameras.push(plan);
        }
        Ok(Self {
            arm,
            cameras,
            has_moving_base: wishes.has_moving_base,
            field_of_view_deg: wishes.field_of_view_deg,
            assumptions,
        })
    }

    /// What was assumed and written, and the commands to run next, as lines of text.
    ///
    /// * `rig`: path of the rig file that was written.
    /// * `warnings`: problems of the robot description.
    #[must_use]
    pub fn report(&self, rig: &Path, warnings: &[Finding]) -> Vec<String> {
        let mut lines = vec!["Assumed".to_owned()];
        lines.extend((self.assumptions.iter()).map(|assumption| format!("  {assumption}")));
        if !warnings.is_empty() {
            lines.push("Warnings".to_owned());
            lines.extend(warnings.iter().map(|warning| format!("  {warning}")));
        }
        lines.push(format!("Wrote {}. Next", rig.display()));
        let rig = quoted_for_shell(&rig.to_string_lossy());
        lines.push(format!("  fieldrig doctor {rig}"));
        lines.push(format!("  fieldrig run {rig} {}", Setting::Sim));
        for camera in self.cameras_without_lens() {
            let command = CalibrationCommand::Intrinsics.line(&rig, camera);
            lines.push(format!("  {command}"));
        }
        lines
    }

    /// Names of the cameras that are found, but whose intrinsics are guesses.
    #[must_use]
    pub fn cameras_without_lens(&self) -> Vec<&str> {
        let is_guess = |camera: &&CameraPlan| camera.found.is_some() && camera.focal_px.is_some();
        self.cameras
            .iter()
            .filter(is_guess)
            .map(|camera| &*camera.name)
            .collect()
    }
}

/// The wanted cameras. Without a wish, the first camera that was found is on the arm, and the
/// others stand in the room.
fn wanted_cameras(
    wishes: &Wishes,
    findings: &Findings,
    has_arm: bool,
    assumptions: &mut Vec<String>,
) -> anyhow::Result<Vec<WantedCamera>> {
    if !wishes.cameras.is_empty() {
        let is_on_arm = |camera: &WantedCamera| camera.parent == Parent::Flange;
        if !has_arm && wishes.cameras.iter().any(is_on_arm) {
            bail!(
                "a robot without an arm has no camera on a flange: use {0} base or {0} world",
                Setting::Camera
            );
        }
        return Ok(wishes.cameras.clone());
    }
    let n = findings.cameras.len().max(1);
    let parents: Vec<Parent> = (0..n)
        .map(|ix| default_parent(ix, has_arm, wishes.has_moving_base))
        .collect();
    let places: Vec<&str> = parents.iter().map(|parent| place(*parent)).collect();
    assumptions.push(format!(
        "the places of the cameras: {} ({} flange, base or world, once for each camera)",
        places.join(", "),
        Setting::Camera
    ));
    let camera = |parent| WantedCamera {
        parent,
        device: None,
    };
    Ok(parents.into_iter().map(camera).collect())
}

/// The place of camera `ix` if nobody has said where it is.
#[must_use]
pub fn default_parent(ix: usize, has_arm: bool, has_moving_base: bool) -> Parent {
    if ix == 0 && has_arm {
        Parent::Flange
    } else if has_moving_base {
        Parent::Base
    } else {
        Parent::World
    }
}

/// Where a camera is, in words.
pub(super) fn place(parent: Parent) -> &'static str {
    match parent {
        Parent::Flange => "on the flange of the arm",
        Parent::Base => "on the base",
        Parent::World => "fixed in the room",
    }
}

/// Gives each wanted camera its device. Cameras without a named device get the found cameras that
/// nobody named, in their order.
fn assign(
    wanted: Vec<WantedCamera>,
    findings: &Findings,
) -> Vec<(WantedCamera, Option<FoundCamera>)> {
    let is_named = |found: &FoundCamera| {
        wanted
            .iter()
            .any(|camera| camera.device.as_deref() == Some(&found.device))
    };
    let mut free = findings.cameras.iter().filter(|found| !is_named(found));
    let device = |camera: &WantedCamera| match &camera.device {
        None => free.next().cloned(),
        Some(device) => {
            let known = findings
                .cameras
                .iter()
                .find(|found| found.device == *device);
            Some(known.cloned().unwrap_or_else(|| unknown_camera(device)))
        }
    };
    let devices: Vec<_> = wanted.iter().map(device).collect();
    wanted.into_iter().zip(devices).collect()
}

/// A camera that the user named, but that is not connected.
fn unknown_camera(device: &str) -> FoundCamera {
    FoundCamera {
        driver: CameraDriver::V4l2,
        device: device.to_owned(),
        name: "camera".to_owned(),
        size_px: DEFAULT_SIZE_PX,
        rate_hz: DEFAULT_RATE_HZ,
    }
}

fn camera(
    wanted: &WantedCamera,
    found: Option<FoundCamera>,
    arm: Option<&ArmPlan>,
    wishes: &Wishes,
    earlier: &[CameraPlan],
) -> CameraPlan {
    let size_px = found
        .as_ref()
        .map_or(DEFAULT_SIZE_PX, |found| found.size_px);
    let rate_hz = found
        .as_ref()
        .map_or(DEFAULT_RATE_HZ, |found| found.rate_hz);
    let reports_intrinsics = found
        .as_ref()
        .is_some_and(|found| found.driver == CameraDriver::Realsense);
    let links = arm.map(|arm| &arm.links);
    CameraPlan {
        name: free_name(wanted.parent, earlier),
        found,
        size_px,
        rate_hz,
        parent: wanted.parent,
        is_parent_guessed: wishes.cameras.is_empty(),
        parent_from_camera: camera_guess::parent_from_camera(wanted.parent, links),
        focal_px: (!reports_intrinsics)
            .then(|| camera_guess::focal_px(size_px[0], wishes.field_of_view_deg)),
    }
}

/// A name that no earlier camera has.
fn free_name(parent: Parent, earlier: &[CameraPlan]) -> String {
    let stem = match parent {
        Parent::Flange => "wrist",
        Parent::Base => "front",
        Parent::World => "overview",
    };
    let n_same = earlier
        .iter()
        .filter(|camera| camera.parent == parent)
        .count();
    match n_same {
        0 => stem.to_owned(),
        n => format!("{stem}{}", n + 1),
    }
}
