//! The offset between the clocks of two pose streams.

use crate::outputs::{self, ReportOptions};
use calibration::time_offset::{
    MotionProfile, PoseSample, TimeOffset, TimeOffsetOptions, estimate_time_offset, motion_profile,
};
use kinematics::Transform;
use messages::BadInput;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use report::calibration_report::TimeOffsetReport;
use std::path::{Path, PathBuf};

/// Input and options of the estimation of a time offset.
#[derive(Clone, Debug)]
pub struct TimeOffsetTask {
    /// File with the poses of the first body. Its rows are t,x,y,z,qx,qy,qz,qw in seconds and
    /// meters.
    pub a: PathBuf,
    /// Poses of the second body, which is rigidly attached to the first.
    pub b: PathBuf,
    /// How they are compared.
    pub options: TimeOffsetOptions,
    /// The report to write.
    pub report: Option<ReportOptions>,
}

/// The outcome of an estimation.
pub struct TimeOffsetOutcome {
    /// The result, or the reason why there is no result.
    pub result: anyhow::Result<TimeOffset>,
    /// The result of writing the report.
    pub written: anyhow::Result<()>,
}

impl TimeOffsetTask {
    /// Reads both files, estimates the offset, and writes the report. If there is no result, the
    /// outcome contains the reason.
    ///
    /// # Errors
    /// Fails if a file cannot be read, or if no report can be written to the given path.
    pub fn run(&self) -> anyhow::Result<TimeOffsetOutcome> {
        // The paths are checked first, so that a wrong path does not cost a calibration.
        self.report.as_ref().map_or(Ok(()), ReportOptions::check)?;
        let a = read(&self.a)?;
        let b = read(&self.b)?;
        let result = estimate_time_offset(&a, &b, &self.options).map_err(anyhow::Error::from);
        let written = match &self.report {
            Some(report) => self.write_report(
                report,
                // A report without the profile is better than no report.
                motion_profile(&a, &b, &self.options).ok().as_ref(),
                &result,
            ),
            None => Ok(()),
        };
        Ok(TimeOffsetOutcome { result, written })
    }

    fn write_report(
        &self,
        report: &ReportOptions,
        profile: Option<&MotionProfile>,
        result: &anyhow::Result<TimeOffset>,
    ) -> anyhow::Result<()> {
        let offset = result.as_ref().ok();
        let refusal = offset.and_then(|offset| offset.hand_eye.as_ref()?.as_ref().err());
        let warning = refusal
            .map(|refusal| format!("the transform between the bodies is refused: {refusal}"));
        let input = format!("{} and {}", self.a.display(), self.b.display());
        let Some(heading) =
            report.heading(Path::new(&input), result, warning.into_iter().collect())
        else {
            return Ok(());
        };
        let page = TimeOffsetReport {
            heading: &heading,
            profile,
            offset,
        };
        report.write(&page.html())
    }
}

/// Reads the rows of a file. Comments and a header are skipped. A row of numbers that is not a pose
/// is an error.
fn read(path: &Path) -> anyhow::Result<Vec<PoseSample>> {
    let text = outputs::read_text(path)?;
    let mut samples = Vec::new();
    for (ix, line) in text.lines().enumerate() {
        let parsed = line
            // All usual separators are accepted, because such files come from many programs.
            .split([',', ' ', ';', '\t'])
            .filter(|field| !field.is_empty())
            .map(str::parse::<f64>);
        // A line that contains anything but numbers counts as a comment or header.
        let Ok(numbers) = parsed.collect::<Result<Vec<f64>, _>>() else {
            continue;
        };
        if numbers.is_empty() {
            continue;
        }
        let place = || format!("{}, line {}", path.display(), ix + 1);
        let [secs, x, y, z, qx, qy, qz, qw] = <[f64; 8]>::try_from(numbers).map_err(|numbers| {
            BadInput(format!(
                "{}: {} numbers, expected 8: t,x,y,z,qx,qy,qz,qw",
                place(),
                numbers.len()
            ))
        })?;
        const MAX_NORM_ERROR: f64 = 0.01;
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if ![secs, x, y, z].iter().all(|value| value.is_finite()) {
            return Err(BadInput(format!("{}: t, x, y and z must be finite", place())).into());
        }
        let norm = quaternion.norm();
        // Quaternions are normalized afterwards. A larger deviation indicates a different order of
        // the columns.
        let is_unit = (norm - 1.0).abs() < MAX_NORM_ERROR; // This comparison is false for NaN.
        if !is_unit {
            return Err(BadInput(format!(
                "{}: |qx,qy,qz,qw| is {norm:.3}, expected 1",
                place()
            ))
            .into());
        }
        let pose = Transform::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_quaternion(quaternion),
        );
        samples.push(PoseSample { secs, pose });
    }
    if samples.is_empty() {
        return Err(BadInput(format!("{}: no row t,x,y,z,qx,qy,qz,qw", path.display())).into());
    }
    Ok(samples)
}
