//! Files that `calibrate` writes: a rig file with the result, and a report.

use crate::exit::{self, BadArgument, Exit};
use calibration::hand_eye::Setup;
use capture::config::{Parent, Rig};
use kinematics::{Intrinsics, Transform};
use session::calibration_report::{self, Heading};
use session::corrected_rig;
use std::path::{Path, PathBuf};

/// Flags of commands that calibrate one camera.
#[derive(Debug, clap::Args)]
pub(super) struct RigFlags {
    /// Rig file to write the result into; see --write-rig
    #[arg(long, value_name = "RIG.toml", requires_all = ["camera", "write_rig"])]
    rig: Option<PathBuf>,
    /// Name of the calibrated camera in the rig file
    #[arg(long, value_name = "NAME", requires = "write_rig")]
    camera: Option<String>,
    /// Write the rig file with the result. An existing file is kept with the extension .old
    #[arg(long, value_name = "FILE", requires_all = ["rig", "camera"])]
    write_rig: Option<PathBuf>,
}

impl RigFlags {
    /// Reads the rig file. `None` if no rig file is to be written.
    pub(super) fn open(&self) -> anyhow::Result<Option<RigOutput>> {
        let (Some(rig), Some(camera), Some(file)) = (&self.rig, &self.camera, &self.write_rig) else { return Ok(None) };
        let rig = Rig::load(rig, &[])?;
        corrected_rig::camera(&rig, camera)?;
        corrected_rig::check_target_file(&rig, file)?;
        Ok(Some(RigOutput { rig, camera: camera.clone(), file: file.clone() }))
    }
}

/// A rig file to write.
#[derive(Debug)]
pub(super) struct RigOutput {
    rig: Rig,
    camera: String,
    file: PathBuf,
}

impl RigOutput {
    /// Rejects images of another size than those of the camera.
    pub(super) fn expect_size(&self, size_px: [u32; 2]) -> anyhow::Result<()> {
        Ok(corrected_rig::expect_size(corrected_rig::camera(&self.rig, &self.camera)?, size_px)?)
    }

    pub(super) fn set_intrinsics(&mut self, intrinsics: &Intrinsics) -> anyhow::Result<()> {
        self.rig = corrected_rig::with_intrinsics(&self.rig, &self.camera, intrinsics)?;
        Ok(())
    }

    pub(super) fn set_extrinsics(&mut self, setup: Setup, parent_from_camera: &Transform) -> anyhow::Result<()> {
        let parent = parent_of(setup);
        self.rig = corrected_rig::with_extrinsics(&self.rig, &self.camera, parent, parent_from_camera)?;
        Ok(())
    }

    /// Rejects a setup in which the camera is attached to another frame than in the rig file.
    pub(super) fn expect_setup(&self, setup: Setup) -> anyhow::Result<()> {
        corrected_rig::with_extrinsics(&self.rig, &self.camera, parent_of(setup), &Transform::identity())?;
        Ok(())
    }

    /// Warns if a pose was estimated with other intrinsics than those of the rig file.
    pub(super) fn warn_if_intrinsics_differ(&self, used: &Intrinsics) -> anyhow::Result<()> {
        const MAX_PX: f64 = 0.01;
        let given = &corrected_rig::camera(&self.rig, &self.camera)?.intrinsics;
        let pairs = given.params().into_iter().zip(used.params());
        let differ =
            given.params().len() != used.params().len() || pairs.into_iter().any(|(a, b)| (a - b).abs() > MAX_PX);
        if differ {
            log::warn!(
                "the pose of camera {:?} was estimated with other intrinsics than those of the rig file; write them with calibrate intrinsics --write-rig, too",
                self.camera
            );
        }
        Ok(())
    }

    pub(super) fn write(&self) -> anyhow::Result<()> {
        corrected_rig::write(&self.rig, &self.file)?;
        log::info!("rig file written to {}", self.file.display());
        Ok(())
    }
}

fn parent_of(setup: Setup) -> Parent {
    match setup {
        Setup::EyeInHand => Parent::Flange,
        Setup::EyeToHand => Parent::Base,
    }
}

/// The flag of commands that write a report.
#[derive(Debug, clap::Args)]
pub(super) struct ReportFlag {
    /// Write a report with the result, its uncertainty and the errors of all samples as an HTML page; also if the
    /// calibration is refused
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
}

impl ReportFlag {
    /// The file to write, if any.
    pub(super) fn open(&self) -> anyhow::Result<Option<&Path>> {
        let Some(file) = self.report.as_deref() else { return Ok(None) };
        calibration_report::check_target_file(file)?;
        Ok(Some(file))
    }
}

/// Writes a report and logs its path.
pub(super) fn write_report(file: &Path, html: &str) -> anyhow::Result<()> {
    calibration_report::write(file, html)?;
    log::info!("report written to {}", file.display());
    Ok(())
}

/// The heading of the report on a result. `None` for errors that are not a refusal: they have no report.
pub(super) fn heading<T>(input: &Path, result: &anyhow::Result<T>, warnings: Vec<String>) -> Option<Heading> {
    let refused = match result {
        Ok(_) => None,
        Err(error) if exit::of(error) == Exit::InsufficientData => {
            let text = format!("{error:#}");
            Some(text.strip_prefix("calibration refused: ").map_or(text.clone(), str::to_owned))
        }
        Err(_) => return None,
    };
    Some(Heading { input: input.display().to_string(), refused, warnings })
}

/// The contents of a text file; a missing or unreadable file is a bad argument.
pub(super) fn read_text(path: &Path) -> Result<String, BadArgument> {
    std::fs::read_to_string(path).map_err(|error| BadArgument(format!("cannot read {}: {error}", path.display())))
}
