//! The calibration of a rig's cameras from images of a static scene.

use crate::host::{Activity, Host};
use crate::outputs::{self, ReportOptions, is_rig_file};
use crate::scene_report::SceneReport;
use capture::config::{Need, Override, Rig};
use capture::open::{self, Devices};
use kinematics::Stamp;
use messages::{BadInput, InsufficientData, Setting};
use session::{
    Data, DataOptions, Purpose, Refine, SceneCalibration, calibrate_scene, corrected_rig,
    run_folder,
};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Time for which devices are read if no flag limits this time, seconds.
const DEFAULT_SECS: f64 = 30.0;

/// Input and options of a calibration from a scene.
#[derive(Clone, Debug)]
pub struct SceneTask {
    /// A recording, a dataset folder, or a rig file whose devices are read.
    pub input: PathBuf,
    /// The list of the keyframes to use. This requires a recording or a folder as input.
    pub keyframes: Option<PathBuf>,
    /// The rig file for reading a recording. It replaces the rig file that is stored in the
    /// recording.
    pub rig: Option<PathBuf>,
    /// What to estimate.
    pub params: Vec<Refine>,
    /// Whether all devices are simulated. This requires a rig file as input.
    pub sim: bool,
    /// Time for which devices are read, seconds. This requires a rig file as input.
    pub seconds: Option<f64>,
    /// The rig file to write, with the accepted corrections.
    pub write_rig: Option<PathBuf>,
    /// The report to write.
    pub report: Option<ReportOptions>,
}

/// The outcome of a calibration from a scene.
pub struct SceneOutcome {
    /// The images.
    pub data: Data,
    /// The estimates.
    pub calibration: SceneCalibration,
    /// The reason why no camera could be calibrated. `None` if at least one camera was calibrated.
    pub refused: Option<String>,
    /// The requested calibration.
    pub(crate) params: Vec<Refine>,
    /// The rig before the calibration, if there is one.
    before: Option<Rig>,
    write_rig: Option<PathBuf>,
    /// The result of writing the report.
    written: anyhow::Result<()>,
}

impl SceneTask {
    /// Reads the images, calibrates, and writes the report.
    ///
    /// # Errors
    /// Fails if the options contradict each other, or if the data cannot be read or are not
    /// sufficient.
    pub fn run(&self, host: &dyn Host) -> anyhow::Result<SceneOutcome> {
        // With `auto`, the calibration chooses the parameters, so `auto` cannot be combined with a
        // list.
        if self.params.len() > 1 && self.params.contains(&Refine::Auto) {
            return Err(BadInput(format!(
                "{}: auto cannot be combined with other values",
                Setting::Params
            ))
            .into());
        }
        // The paths are checked first, because a wrong path would otherwise fail only after the
        // long calibration.
        self.report.as_ref().map_or(Ok(()), ReportOptions::check)?;
        let given = self.rig_as_given()?;
        // The rig file is checked before data is read, because reading may take long.
        if let Some(file) = &self.write_rig {
            let Some(rig) = &given else {
                let input = self.input.display();
                return Err(BadInput(format!(
                    "{} {}: {input} contains no rig file",
                    Setting::WriteRig,
                    file.display()
                ))
                .into());
            };
            corrected_rig::check_target_file(rig, file)?;
        }
        let data = self.data(host)?;
        // Devices may report calibration that the rig file does not contain.
        let rig = if self.sim || data.rig.is_none() || !is_rig_file(&self.input) {
            given
        } else {
            data.rig.clone()
        };
        let result = calibrate_scene(&data, &self.params, rig.as_ref());
        let (calibration, written) =
            outputs::reported(result, self.report.as_ref(), |report, result| {
                self.write_report(report, &data, rig.as_ref(), result)
            })?;
        Ok(SceneOutcome {
            refused: refusal(&data, &calibration),
            data,
            calibration,
            params: self.params.clone(),
            before: rig,
            write_rig: self.write_rig.clone(),
            written,
        })
    }

    fn options(&self) -> DataOptions {
        DataOptions {
            keyframes: self.keyframes.clone(),
            rig: self.rig.clone(),
            ..DataOptions::default()
        }
    }

    fn write_report(
        &self,
        report: &ReportOptions,
        data: &Data,
        rig: Option<&Rig>,
        result: &anyhow::Result<SceneCalibration>,
    ) -> anyhow::Result<()> {
        let calibration = result.as_ref().ok();
        let Some(mut heading) = report.heading(&self.input, result, data.data_losses.clone())
        else {
            return Ok(());
        };
        if let Some(calibration) = calibration {
            heading.refused = refusal(data, calibration);
            let kept = calibration.refused.iter().map(|(camera, reason)| {
                format!("camera {camera:?} keeps its extrinsics: {reason}")
            });
            heading
                .warnings
                // If all cameras are refused, the heading already contains the reasons.
                .extend(kept.filter(|_| heading.refused.is_none()));
        }
        let mut n_images: BTreeMap<String, usize> = BTreeMap::new();
        for keyframe in &data.keyframes {
            *n_images.entry(keyframe.camera.to_string()).or_default() += 1;
        }
        let n_images: Vec<(String, usize)> = n_images.into_iter().collect();
        let page = SceneReport {
            heading: &heading,
            rig,
            n_images: &n_images,
            calibration,
        };
        report.write(&page.html())
    }

    /// The rig file, without settings that apply only to this command. `None` for a folder.
    fn rig_as_given(&self) -> anyhow::Result<Option<Rig>> {
        if !self.input.exists() {
            return Err(BadInput(format!("{} does not exist", self.input.display())).into());
        }
        if is_rig_file(&self.input) {
            return Ok(Some(Rig::load(&self.input, &[])?));
        }
        // Dataset folders have no rig file.
        let is_recording = run_folder::is_recording(&self.input);
        is_recording
            .then(|| Data::rig_as_given(&self.input, &self.options()))
            .transpose()
    }

    fn data(&self, host: &dyn Host) -> anyhow::Result<Data> {
        if !is_rig_file(&self.input) {
            if self.sim || self.seconds.is_some() {
                return Err(BadInput(format!(
                    "{} and {} need a rig file (.toml) as input",
                    Setting::Sim,
                    Setting::Seconds
                ))
                .into());
            }
            let data = Data::load(
                &self.input,
                &self.options(),
                Purpose::Training,
                &[],
                &|read| host.on_progress(read),
            );
            host.on_progress_end();
            return data;
        }
        // Both flags apply only to data that were recorded before.
        if self.keyframes.is_some() || self.rig.is_some() {
            return Err(BadInput(format!(
                "{} and {} need a recording as input",
                Setting::Keyframes,
                Setting::Rig
            ))
            .into());
        }
        let stop = host.stop_requests(Activity::ReadImages)?;
        // In lockstep, the result does not depend on the speed of this computer.
        let overrides = if self.sim {
            vec![Override::new("sim.lockstep", true)]
        } else {
            Vec::new()
        };
        let rig = Rig::load(&self.input, &overrides)?;
        if !self.sim {
            rig.require_before_opening(Need::PosedImages)?;
        }
        let opened = open::rig(
            rig,
            if self.sim {
                Devices::Sim
            } else {
                Devices::Real
            },
        )?;
        let seconds = self.seconds.unwrap_or(DEFAULT_SECS);
        let mut first: Option<Stamp> = None;
        let data = Data::from_devices(
            opened,
            |sample| {
                // The time is measured by stamps, because a simulation does not run in real time.
                let since_first = sample
                    .stamp()
                    .secs_since(*first.get_or_insert(sample.stamp()));
                since_first > seconds || stop.requested()
            },
            &|read| host.on_progress(read),
        );
        host.on_progress_end();
        data
    }
}

impl SceneOutcome {
    /// Writes the rig file, if it was requested and a correction was accepted. This is called after
    /// the result was printed.
    ///
    /// # Errors
    /// Fails if no camera could be calibrated, or if the rig file or the report cannot be written.
    pub fn finish(self) -> anyhow::Result<()> {
        if let Some(reason) = self.refused {
            outputs::log_failure(self.written);
            return Err(InsufficientData(reason).into());
        }
        // A file without corrections would wrongly look like a result.
        if let (Some(file), Some(before), Some(after)) =
            (&self.write_rig, &self.before, &self.calibration.rig)
        {
            if after.has_same_calibration(before) {
                log::info!(
                    "no correction was accepted: {} is not written",
                    file.display()
                );
            } else {
                corrected_rig::write(after, file)?;
                log::info!("rig file written to {}", file.display());
            }
        }
        // The error of the report is returned last, so that the rig file is written even if the
        // report could not be written.
        self.written
    }
}

/// The reason why no camera could be calibrated. `None` if at least one camera was calibrated.
fn refusal(data: &Data, calibration: &SceneCalibration) -> Option<String> {
    let alignment = &calibration.alignment;
    // Without validation images, no correction can be accepted, whatever the data show.
    if alignment.estimates.is_empty() && !alignment.has_enough_validation_images() {
        return Some(
            "too few validation images to accept a correction; record more images".to_owned(),
        );
    }
    let reasons = calibration
        .refused
        .iter()
        .map(|(camera, reason)| format!("camera {camera:?}: {reason}"));
    calibration
        .is_refused(data)
        .then(|| reasons.collect::<Vec<_>>().join("; "))
}
