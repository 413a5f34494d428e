//! The files that calibrations write, which are a rig file with the result and a report.

use anyhow::Context;
use calibration::hand_eye::{JointOffset, Setup};
use capture::config::{Camera, Parent, Rig};
use kinematics::{Intrinsics, Transform};
use messages::{BadInput, ErrorClass, Setting, listed};
use nalgebra::DMatrix;
use report::calibration_report::{Heading, is_report};
use session::{Data, DataOptions, corrected_rig, run_folder};
use std::path::{Path, PathBuf};

/// How the images of one camera are read, and where its calibration is written.
#[derive(Clone, Debug, Default)]
pub struct RigOptions {
    /// Name of the camera to calibrate in a recording or rig file. With images, it is the camera to
    /// change in the rig file for `write_rig`. `None` selects the only camera.
    pub camera: Option<String>,
    /// With a recording, this rig file replaces the rig file that is stored in the recording. With
    /// image files, the result is written into this rig file.
    pub rig: Option<PathBuf>,
    /// The rig file to write, with the result.
    pub write_rig: Option<PathBuf>,
    /// Whether all devices are simulated. This requires a rig file as input.
    pub sim: bool,
    /// Time for which devices are read, seconds. This requires a rig file as input.
    pub seconds: Option<f64>,
    /// Whether flags of the page were given. They are only allowed if the input is a rig file.
    pub has_page_flags: bool,
}

/// What a command calibrates from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum InputKind {
    /// A folder of images, or a file with samples.
    Files,
    Recording,
    /// The devices of a rig file.
    Rig,
}

impl InputKind {
    pub(crate) fn of(input: &Path) -> Self {
        if is_rig_file(input) {
            Self::Rig
        } else if run_folder::is_recording(input) {
            Self::Recording
        } else {
            Self::Files
        }
    }
}

/// Whether a path leads to a rig file.
pub(crate) fn is_rig_file(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension == "toml")
}

impl RigOptions {
    /// Rejects flags that do not apply to the input.
    pub(crate) fn check(&self, input: &Path) -> Result<(), BadInput> {
        let kind = InputKind::of(input);
        let problem = if kind != InputKind::Rig
            && (self.sim || self.seconds.is_some() || self.has_page_flags)
        {
            format!(
                "{}, {} and the flags of the page ({}, {}) need a rig file (.toml) as input",
                Setting::Sim,
                Setting::Seconds,
                Setting::Listen,
                Setting::Share
            )
        } else if kind == InputKind::Rig && self.rig.is_some() {
            let setting = Setting::Rig;
            format!(
                "{setting}: the input {} is a rig file, which is used; remove {setting}",
                input.display()
            )
        } else if kind != InputKind::Files {
            return Ok(());
        } else if self.write_rig.is_some() && self.rig.is_none() {
            format!(
                "{}: the input contains no rig file; name the one to change with {} RIG.toml",
                Setting::WriteRig,
                Setting::Rig
            )
        } else if self.rig.is_some() && self.write_rig.is_none() {
            format!(
                "{}: the rig file is only used to write the result into it; add {} FILE",
                Setting::Rig,
                Setting::WriteRig
            )
        } else if self.camera.is_some() && self.write_rig.is_none() {
            format!(
                "{} needs a recording or rig file as input, or {}",
                Setting::Camera,
                Setting::WriteRig
            )
        } else {
            return Ok(());
        };
        Err(BadInput(problem))
    }

    /// Reads the rig file into which the result will be written. This is the input itself, the rig
    /// file of a recording, or `--rig`. Returns `None` without `--write-rig`.
    pub(crate) fn open(&self, input: &Path) -> anyhow::Result<Option<RigOutput>> {
        self.check(input)?;
        let Some(file) = &self.write_rig else {
            return Ok(None);
        };
        // All commands recognize rig files by this extension.
        if !is_rig_file(file) {
            return Err(BadInput(format!(
                "{} {}: must have the extension .toml",
                Setting::WriteRig,
                file.display()
            ))
            .into());
        }
        let rig = match (InputKind::of(input), &self.rig) {
            (InputKind::Recording, rig) => {
                session::expect(input)?;
                Data::rig_as_given(
                    input,
                    &DataOptions {
                        rig: rig.clone(),
                        ..DataOptions::default()
                    },
                )?
            }
            (InputKind::Files, Some(rig)) => Rig::load(rig, &[])?,
            (InputKind::Rig | InputKind::Files, _) => Rig::load(input, &[])?,
        };
        let camera = self.camera_of(&rig)?.name.to_string();
        // This is checked before images are taken, because otherwise the result could not be
        // written.
        corrected_rig::check_target_file(&rig, file)?;
        Ok(Some(RigOutput {
            rig,
            camera,
            file: file.clone(),
        }))
    }

    /// The camera with the given name. If no name is given, the rig's only camera is returned.
    pub(crate) fn camera_of<'a>(&self, rig: &'a Rig) -> anyhow::Result<&'a Camera> {
        match (&self.camera, &rig.cameras[..]) {
            (Some(name), _) => corrected_rig::camera(rig, name),
            (None, [only]) => Ok(only),
            (None, []) => Err(BadInput(
                "the rig has no camera: add a table [camera.NAME]; `fieldrig devices` lists the connected cameras"
                    .to_owned(),
            )
            .into()),
            (None, cameras) => {
                let names: Vec<&str> = cameras.iter().map(|camera| &*camera.name).collect();
                let names = listed(&names, "or");
                Err(BadInput(format!(
                    "the rig has several cameras; choose one with {}: {names}",
                    Setting::Camera
                ))
                .into())
            }
        }
    }
}

/// A rig file to write.
#[derive(Debug)]
pub(crate) struct RigOutput {
    rig: Rig,
    camera: String,
    file: PathBuf,
}

impl RigOutput {
    /// Uses the rig with the calibration that the devices report.
    pub(crate) fn set_rig(&mut self, rig: &Rig) {
        self.rig = rig.clone();
    }

    /// Adds offsets to the offsets in the rig file.
    pub(crate) fn add_joint_offsets(&mut self, offsets: &[JointOffset]) {
        let arm = &mut self.rig.arm;
        // The rig file may have no offsets, or fewer than joints.
        arm.joint_offsets.resize(arm.joints.len(), 0.0);
        for (name, total) in arm.joints.iter().zip(&mut arm.joint_offsets) {
            let found = offsets
                .iter()
                .find(|offset| offset.joint == *name)
                .and_then(|offset| offset.estimate);
            *total += found.map_or(0.0, |[offset, _]| offset);
        }
    }

    /// Rejects images whose size differs from the size in the rig file.
    pub(crate) fn expect_size(&self, size_px: [u32; 2]) -> anyhow::Result<()> {
        corrected_rig::expect_size(corrected_rig::camera(&self.rig, &self.camera)?, size_px)
    }

    pub(crate) fn set_intrinsics(
        &mut self,
        intrinsics: &Intrinsics,
        covariance: Option<&DMatrix<f64>>,
    ) -> anyhow::Result<()> {
        self.rig = corrected_rig::with_intrinsics(&self.rig, &self.camera, intrinsics, covariance)?;
        Ok(())
    }

    pub(crate) fn set_extrinsics(
        &mut self,
        setup: Setup,
        parent_from_camera: &Transform,
    ) -> anyhow::Result<()> {
        let parent = parent_of(setup);
        self.rig =
            corrected_rig::with_extrinsics(&self.rig, &self.camera, parent, parent_from_camera)?;
        Ok(())
    }

    /// Rejects a setup in which the camera is attached to another frame than in the rig file.
    pub(crate) fn expect_setup(&self, setup: Setup) -> anyhow::Result<()> {
        // The result is dropped, because only the error is needed.
        corrected_rig::with_extrinsics(
            &self.rig,
            &self.camera,
            parent_of(setup),
            &Transform::identity(),
        )?;
        Ok(())
    }

    /// Warns if a pose was estimated with intrinsics that differ from the intrinsics of the rig
    /// file.
    pub(crate) fn warn_if_intrinsics_differ(&self, used: &Intrinsics) -> anyhow::Result<()> {
        const MAX_PX: f64 = 0.01;
        let given = &corrected_rig::camera(&self.rig, &self.camera)?.intrinsics;
        let pairs = given.params().into_iter().zip(used.params());
        // Lens models differ in their number of parameters, and `zip` would ignore the additional
        // parameters of the longer list.
        let differ = given.params().len() != used.params().len()
            || pairs.into_iter().any(|(a, b)| (a - b).abs() > MAX_PX);
        if differ {
            log::warn!(
                "the pose of camera {:?} was estimated with other intrinsics than those of the rig file, which are kept; update them with `fieldrig calibrate intrinsics {}`",
                self.camera,
                Setting::WriteRig
            );
        }
        Ok(())
    }

    pub(crate) fn write(&self) -> anyhow::Result<()> {
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

/// A report to write. The report is an HTML page with the result, its uncertainty and the errors of
/// all samples. It is also written if the calibration is refused.
#[derive(Clone, Debug)]
pub struct ReportOptions {
    /// The file, with the extension `.html`. An existing report is replaced.
    pub file: PathBuf,
    /// The command line, which is shown at the end.
    pub command: String,
}

impl ReportOptions {
    /// Checks that a report can be written to the file.
    pub(crate) fn check(&self) -> Result<(), BadInput> {
        let file = &self.file;
        let folder = file
            .parent()
            .filter(|folder| !folder.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        let is_page = file
            .extension()
            .is_some_and(|extension| extension.eq_ignore_ascii_case("html"));
        if !folder.is_dir() || file.is_dir() || !is_page {
            return Err(BadInput(format!(
                "{} {}: must be a file with the extension .html in an existing folder",
                Setting::Report,
                file.display()
            )));
        }
        // Reports are replaced, so that a command can be repeated. A mistyped name must not replace
        // another page.
        if is_other_file(file) {
            return Err(BadInput(format!(
                "{} {}: the file exists and is not a report of fieldrig; choose another name",
                Setting::Report,
                file.display()
            )));
        }
        Ok(())
    }

    /// Writes the page atomically and logs its path.
    pub(crate) fn write(&self, html: &str) -> anyhow::Result<()> {
        files::write(&self.file, html)
            .with_context(|| format!("cannot write {}", self.file.display()))?;
        log::info!("report written to {}", self.file.display());
        Ok(())
    }

    /// The heading of the report on a result. `None` for errors other than a refusal, because these
    /// errors have no report.
    pub(crate) fn heading<T>(
        &self,
        input: &Path,
        result: &anyhow::Result<T>,
        warnings: Vec<String>,
    ) -> Option<Heading> {
        let refused = match result {
            Ok(_) => None,
            // A refusal also gets a report, which shows what is missing.
            Err(error) if session::class(error) == ErrorClass::InsufficientData => {
                let text = format!("{error:#}");
                Some(
                    // The heading already states that the calibration was refused.
                    text.strip_prefix("calibration refused: ")
                        .map_or(text.clone(), str::to_owned),
                )
            }
            Err(_) => return None,
        };
        Some(Heading {
            input: input.display().to_string(),
            utc: run_folder::utc_now(),
            command: self.command.clone(),
            refused,
            warnings,
        })
    }
}

/// Whether a file exists that is neither empty nor a report.
fn is_other_file(file: &Path) -> bool {
    match files::read(file, files::Budget::TEXT) {
        Ok(bytes) => !bytes.is_empty() && !is_report(&String::from_utf8_lossy(&bytes)),
        Err(_) => false,
    }
}

/// Writes the requested report on a result or on the reason why there is no result. Returns the
/// result, and whether the report was written. The result is printed even if the report was not
/// written.
pub(crate) fn reported<T>(
    result: anyhow::Result<T>,
    report: Option<&ReportOptions>,
    write: impl FnOnce(&ReportOptions, &anyhow::Result<T>) -> anyhow::Result<()>,
) -> anyhow::Result<(T, anyhow::Result<()>)> {
    let written = report.map_or(Ok(()), |report| write(report, &result));
    match result {
        Ok(result) => Ok((result, written)),
        Err(error) => {
            log_failure(written);
            Err(error)
        }
    }
}

/// Logs why a report was not written, if another error is returned.
pub(crate) fn log_failure(written: anyhow::Result<()>) {
    if let Err(error) = written {
        log::error!("{error:#}");
    }
}

/// The contents of a text file. A missing or unreadable file is a bad argument.
pub(crate) fn read_text(path: &Path) -> Result<String, BadInput> {
    files::read_text(path)
        .map_err(|error| BadInput(format!("cannot read {}: {error}", path.display())))
}
