//! The lens of a camera, from images of a target.

use crate::guide::Purpose;
use crate::host::Host;
use crate::images::{self, OtherSize};
use crate::lens::LensFile;
use crate::outputs::{self, ReportOptions, RigOptions, RigOutput, is_rig_file};
use crate::scan::{Scan, ScanOptions};
use calibration::{
    BoardView, IntrinsicsCalibration, IntrinsicsInput, LensModel, calibrate_intrinsics,
};
use messages::{BadInput, InsufficientData, Setting};
use report::calibration_report::{IntrinsicsReport, Photos, Unused};
use std::path::PathBuf;
use targets::TargetSpec;

/// Input and options of an intrinsic calibration.
#[derive(Clone, Debug)]
pub struct IntrinsicsTask {
    /// A folder of images, a recording, or a rig file whose devices are read.
    pub input: PathBuf,
    /// The target.
    pub target: TargetSpec,
    /// The lens model.
    pub model: LensModel,
    /// The camera, and the rig file to write.
    pub rig: RigOptions,
    /// The report to write.
    pub report: Option<ReportOptions>,
    /// Folder for the images of the devices of a rig that show the target.
    pub save_images: Option<PathBuf>,
}

/// The outcome of an intrinsic calibration.
pub struct IntrinsicsOutcome {
    /// The estimates.
    pub calibration: IntrinsicsCalibration,
    /// Images that cannot be read or do not show the target.
    pub unused: Vec<Unused>,
    rig: Option<RigOutput>,
    /// The result of writing the report and of saving the images.
    written: anyhow::Result<()>,
}

/// What was detected in the images.
struct Detected {
    views: Vec<BoardView>,
    sizes_px: Vec<[u32; 2]>,
    /// Images without the target.
    unused: Vec<Unused>,
    photos: Photos,
    /// Why there are no images.
    no_images: Option<String>,
    other_size: Option<OtherSize>,
    warnings: Vec<String>,
    /// Whether the images were saved as requested.
    saved: anyhow::Result<()>,
}

impl IntrinsicsTask {
    /// Detects the target, calibrates, and writes the report.
    ///
    /// # Errors
    /// Fails if the images cannot be read, or do not determine the lens.
    pub fn run(&self, host: &dyn Host) -> anyhow::Result<IntrinsicsOutcome> {
        // The paths are checked first, so that a wrong path does not cost a calibration.
        self.report.as_ref().map_or(Ok(()), ReportOptions::check)?;
        self.check_save_images()?;
        let mut rig = self.rig.open(&self.input)?;
        let detected = self.detect(host, rig.as_mut())?;
        // The size of the images is checked before the calibration, because the result for another
        // image size could not be written to the rig file.
        if let (Some(rig), Some(size_px)) = (&rig, detected.sizes_px.first()) {
            rig.expect_size(*size_px)?;
        }
        let result = self.calibrate(&detected);
        let (calibration, written) =
            outputs::reported(result, self.report.as_ref(), |report, result| {
                self.write_report(report, &detected, result)
            })?;
        Ok(IntrinsicsOutcome {
            calibration,
            unused: detected.unused,
            rig,
            written: written.and(detected.saved),
        })
    }

    /// Takes or reads the images of a rig or recording. Returns `None` if the input is a folder.
    /// `output` gets the calibration that devices report.
    fn scan(
        &self,
        options: ScanOptions<'_>,
        mut output: Option<&mut RigOutput>,
    ) -> anyhow::Result<Option<Scan>> {
        let save = self.save_images.as_deref();
        let target = &self.target;
        let photographs =
            self.rig
                .take_photographs(&self.input, target, options, output.as_deref_mut(), save)?;
        match photographs {
            Some(scan) => Ok(Some(scan)),
            None => self.rig.read(&self.input, Some(target), options, output),
        }
    }

    /// Photographs are only saved while they are taken with guidance.
    fn check_save_images(&self) -> Result<(), BadInput> {
        let is_guided = self.rig.seconds.is_none() && is_rig_file(&self.input);
        match &self.save_images {
            Some(folder) if !is_guided => Err(BadInput(format!(
                "{} {}: needs a rig file (.toml) as input, without {}",
                Setting::SaveImages,
                folder.display(),
                Setting::Seconds
            ))),
            _ => Ok(()),
        }
    }

    /// Reads the images and detects the target. `output` gets the calibration that devices report.
    fn detect(&self, host: &dyn Host, output: Option<&mut RigOutput>) -> anyhow::Result<Detected> {
        let options = ScanOptions {
            host,
            keeps_photos: self.report.is_some(),
            purpose: Purpose::Lens,
        };
        let mut saved = Ok(());
        let (images, photos, no_images, warnings) = match self.scan(options, output)? {
            Some(mut scan) => {
                saved = scan.save_error.take().map_or(Ok(()), Err);
                (
                    scan.detected(),
                    scan.take_photos(),
                    scan.no_images,
                    scan.warnings,
                )
            }
            None => {
                let files = images::files(&self.input)?;
                let images = images::detect(&files, &self.target, host)?;
                (images, images::photos(&files), None, Vec::new())
            }
        };
        let unused = images::unused(&images);
        let other_size = images::other_size(images.iter(), &self.target);
        let mut views = Vec::new();
        let mut sizes_px = Vec::new();
        for board in images.into_iter().filter_map(|image| image.board.ok()) {
            views.push(board.view);
            sizes_px.push(board.size_px);
        }
        let mut warnings = warnings;
        // A warning is not needed if more images show the other size than the size of the target.
        // In that case, `calibrate` fails with this text.
        if let Some(size) = other_size.as_ref().filter(|size| !size.prevails) {
            log::warn!("{}", size.text);
            warnings.push(size.text.clone());
        }
        Ok(Detected {
            views,
            sizes_px,
            unused,
            photos,
            no_images,
            other_size,
            warnings,
            saved,
        })
    }

    fn calibrate(&self, detected: &Detected) -> anyhow::Result<IntrinsicsCalibration> {
        let Detected {
            views,
            sizes_px,
            unused,
            no_images,
            other_size,
            ..
        } = detected;
        if let Some(reason) = no_images {
            return Err(InsufficientData(reason.clone()).into());
        }
        // With a board of another size, the calibration would use wrong corners. It is an error if
        // most images show such a board.
        if let Some(size) = other_size.as_ref().filter(|size| size.prevails) {
            return Err(
                InsufficientData(format!("{}: {}", self.input.display(), size.text)).into(),
            );
        }
        if views.is_empty() {
            // All images usually fail for the same reason. Images that cannot be read were reported
            // before.
            let read: Vec<&Unused> = unused
                .iter()
                .filter(|unused| !unused.is_unreadable)
                .collect();
            let reason = read.first().map_or(String::new(), |first| {
                format!("; {}: {}", first.name, first.reason)
            });
            let input = self.input.display();
            let target = &self.target;
            let n = read.len();
            let text = format!("{input}: {target} was not detected in any of {n} images{reason}");
            return Err(InsufficientData(text).into());
        }
        Ok(calibrate_intrinsics(&IntrinsicsInput {
            views,
            sizes_px,
            model: self.model,
        })?)
    }

    fn write_report(
        &self,
        report: &ReportOptions,
        detected: &Detected,
        result: &anyhow::Result<IntrinsicsCalibration>,
    ) -> anyhow::Result<()> {
        let calibration = result.as_ref().ok();
        let warnings = detected
            .warnings
            .iter()
            .cloned()
            .chain(calibration.into_iter().flat_map(warnings))
            .collect();
        let Some(heading) = report.heading(&self.input, result, warnings) else {
            return Ok(());
        };
        let rig_line = calibration.map(|calibration| {
            format!(
                "intrinsics = {}",
                LensFile::of(&calibration.intrinsics).to_toml()
            )
        });
        // Without images, the charts of the report still need a size.
        const NO_IMAGE_PX: [u32; 2] = [640, 480];
        let page = IntrinsicsReport {
            heading: &heading,
            target: &self.target.to_string(),
            size_px: detected.sizes_px.first().copied().unwrap_or(NO_IMAGE_PX),
            views: &detected.views,
            unused: &detected.unused,
            calibration,
            rig_line: rig_line.as_deref(),
            photos: &detected.photos,
        };
        report.write(&page.html())
    }
}

impl IntrinsicsOutcome {
    /// Problems of the result, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        warnings(&self.calibration)
    }

    /// Writes the rig file, if it was requested. This is called after the result was printed.
    ///
    /// # Errors
    /// Fails if the rig file or the report cannot be written, or if images were not saved.
    pub fn finish(self) -> anyhow::Result<()> {
        if let Some(mut rig) = self.rig {
            rig.set_intrinsics(
                &self.calibration.intrinsics,
                Some(&self.calibration.intrinsics_covariance()),
            )?;
            rig.write()?;
        }
        // This error is returned last, so that the rig file is written even if the report could not
        // be written.
        self.written
    }
}

/// Problems of a result, one sentence each.
fn warnings(calibration: &IntrinsicsCalibration) -> Vec<String> {
    [
        uncertainty_warning(calibration),
        aspect_warning(calibration.intrinsics.focal_px),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// A warning if pixels are not square.
fn aspect_warning([fx, fy]: [f64; 2]) -> Option<String> {
    const MAX_RATIO: f64 = 1.05;
    let ratio = fy / fx;
    // This comparison is false for NaN.
    let is_square = (1.0 / MAX_RATIO..=MAX_RATIO).contains(&ratio);
    (!is_square).then(|| {
        format!(
            "the focal lengths differ by a factor of {ratio:.2} (fy / fx), but pixels of almost all cameras are square: check that the images were not stretched or scaled in one direction, that interlaced lines were not dropped, and that {} has the right squares (width and height)",
            Setting::Target
        )
    })
}

/// A warning if the result is not accurate.
fn uncertainty_warning(calibration: &IntrinsicsCalibration) -> Option<String> {
    const MAX_SIGMA_FRAC: f64 = 0.01;
    let worst = largest(&calibration.uncertainty_px.values);
    (worst > MAX_SIGMA_FRAC * f64::from(calibration.intrinsics.size_px[0])).then(|| {
        format!(
            "the projection is uncertain by {worst:.1} px; add images with the target tilted and near the corners of the image"
        )
    })
}

fn largest(values: &[Option<f64>]) -> f64 {
    values
        .iter()
        .flatten()
        .fold(0.0f64, |largest, value| largest.max(*value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretched_images_are_named() {
        assert_eq!(aspect_warning([600.0, 601.0]), None);
        for [fx, fy] in [[600.0, 1200.0], [600.0, 300.0], [600.0, f64::NAN]] {
            let warning = aspect_warning([fx, fy]).expect("pixels are not square");
            assert!(warning.contains(&format!("{:.2}", fy / fx)), "{warning}");
        }
    }
}
