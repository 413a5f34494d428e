//! `fieldrig calibrate intrinsics`: the lens of a camera from images of a target.

use super::guide::Purpose;
use super::images::{self, OtherSize};
use super::lens::LensFile;
use super::outputs::{self, ReportFlag, RigFlags, RigOutput};
use super::scan::ScanOptions;
use super::target_argument;
use crate::exit::Exit;
use crate::print;
use calibration::{
    BoardView, ImageGrid, IntrinsicsCalibration, IntrinsicsInput, LensModel, LensTrial,
    calibrate_intrinsics,
};
use messages::InsufficientData;
use serde::Serialize;
use session::calibration_report::{IntrinsicsReport, Photos, Unused};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use targets::TargetSpec;

const TARGET_HELP: &str = "The target, such as chessboard:9x6:25mm, charuco:5x7:34mm:26mm:5X5_100 or aprilgrid:6x6:20mm:0.3";

/// Flags of `calibrate intrinsics`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of images (.jpg, .png) of the target, all of one camera and one size; or a recording
    /// (.mcap) or rig file (.toml) whose camera sees the target
    #[arg(value_name = "IMAGES|RECORDING|RIG")]
    input: PathBuf,
    #[arg(long, value_name = "SPEC", value_parser = target_argument, help = TARGET_HELP)]
    target: TargetSpec,
    /// Lens model
    #[arg(long, value_name = "MODEL", value_enum, default_value_t = ModelArg::Auto)]
    model: ModelArg,
    #[command(flatten)]
    rig: RigFlags,
    #[command(flatten)]
    report: ReportFlag,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ModelArg {
    /// The simplest model that explains the images
    Auto,
    /// No distortion
    Pinhole,
    /// k1, k2, p1, p2, k3
    BrownConrady,
    /// k1, k2, p1, p2, k3, k4, k5, k6
    RationalBrownConrady,
    /// k1 to k4 of OpenCV's fisheye model
    KannalaBrandt,
}

/// The printed result.
#[derive(Debug, Serialize)]
struct Printed<'a> {
    #[serde(flatten)]
    lens: LensFile,
    /// Names of the estimated coefficients; the others are zero.
    coefficients: Vec<&'static str>,
    rms_px: f64,
    /// Standard deviation of a detected corner along one axis.
    noise_px: f64,
    /// Standard deviations of the parameters, by name.
    sigma: BTreeMap<&'static str, f64>,
    rejected: Vec<PrintedRejection>,
    images: Vec<PrintedImage<'a>>,
    /// Number of corners in each part of the image.
    coverage: PrintedGrid<usize>,
    /// Standard deviation of the projection of a distant point in each part of the image; null
    /// beyond the lens model.
    projection_sigma_px: PrintedGrid<Option<f64>>,
    trials: Vec<PrintedTrial<'a>>,
    next_view: Option<&'a str>,
}

#[derive(Debug, Serialize)]
struct PrintedRejection {
    image: String,
    reason: String,
    #[serde(skip)]
    is_unreadable: bool,
}

#[derive(Debug, Serialize)]
struct PrintedImage<'a> {
    image: &'a str,
    n_corners: usize,
    rms_px: f64,
}

/// Values of the parts of the image, row by row.
#[derive(Debug, Serialize)]
struct PrintedGrid<T> {
    columns: usize,
    rows: usize,
    values: Vec<T>,
}

/// Comparison of two lens models on held-out corners.
#[derive(Debug, Serialize)]
struct PrintedTrial<'a> {
    baseline: &'a str,
    variant: &'a str,
    gain_db: f64,
    standard_error_db: f64,
    kept: bool,
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
}

/// Detects the target, calibrates, and prints the result.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    // Checked first, so that a wrong path does not cost a calibration.
    let report = args.report.open()?;
    let mut rig = args.rig.open(&args.input)?;
    let detected = args.detect(report.is_some(), rig.as_mut())?;
    // Before the calibration, because its result could not be written.
    if let (Some(rig), Some(size_px)) = (&rig, detected.sizes_px.first()) {
        rig.expect_size(*size_px)?;
    }
    let result = args.calibrate(&detected);
    let (calibration, written) = outputs::reported(result, report, |path, result| {
        args.write_report(path, &detected, result)
    })?;
    let printed = printed(&calibration, &detected.unused);
    if args.json {
        print::json(&printed)?
    } else {
        describe(&printed)?
    }
    for warning in warnings(&calibration) {
        log::warn!("{warning}");
    }
    if let Some(rig) = &mut rig {
        rig.set_intrinsics(
            &calibration.intrinsics,
            Some(&calibration.intrinsics_covariance()),
        )?;
        rig.write()?;
    }
    // The report comes last: the rig file is written even if the report could not be.
    written?;
    Ok(Exit::Done)
}

impl Args {
    /// Reads the images and detects the target. `output` gets the calibration that devices report.
    fn detect(
        &self,
        keeps_photos: bool,
        output: Option<&mut RigOutput>,
    ) -> anyhow::Result<Detected> {
        let options = ScanOptions {
            keeps_photos,
            is_hidden: self.json,
            purpose: Purpose::Lens,
        };
        let (images, photos, no_images, warnings) =
            match self
                .rig
                .read(&self.input, Some(&self.target), options, output)?
            {
                Some(mut scan) => (
                    scan.detected(),
                    scan.take_photos(),
                    scan.no_images,
                    scan.warnings,
                ),
                None => {
                    let files = images::files(&self.input)?;
                    let images = images::detect(&files, &self.target, self.json)?;
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
        // If the other size prevails, `calibrate` refuses with this text instead.
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
        // A board of another size would be calibrated with wrong corners, so this is an error if
        // most images show it.
        if let Some(size) = other_size.as_ref().filter(|size| size.prevails) {
            return Err(
                InsufficientData(format!("{}: {}", self.input.display(), size.text)).into(),
            );
        }
        if views.is_empty() {
            // All images usually fail for the same reason. Those that cannot be read were reported
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
            model: self.model.into(),
        })?)
    }

    fn write_report(
        &self,
        path: &Path,
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
        let Some(heading) = outputs::heading(&self.input, result, warnings) else {
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
        let report = IntrinsicsReport {
            heading: &heading,
            target: &self.target.to_string(),
            size_px: detected.sizes_px.first().copied().unwrap_or(NO_IMAGE_PX),
            views: &detected.views,
            unused: &detected.unused,
            calibration,
            rig_line: rig_line.as_deref(),
            photos: &detected.photos,
        };
        outputs::write_report(path, &report.html())
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
    // False for NaN.
    let is_square = (1.0 / MAX_RATIO..=MAX_RATIO).contains(&ratio);
    (!is_square).then(|| {
        format!(
            "the focal lengths differ by a factor of {ratio:.2} (fy / fx), but pixels of almost all cameras are square: check that the images were not stretched or scaled in one direction, that interlaced lines were not dropped, and that --target has the right squares (width and height)"
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

impl From<ModelArg> for LensModel {
    fn from(model: ModelArg) -> Self {
        match model {
            ModelArg::Auto => Self::Auto,
            ModelArg::Pinhole => Self::Pinhole,
            ModelArg::BrownConrady => Self::BrownConrady5,
            ModelArg::RationalBrownConrady => Self::BrownConrady8,
            ModelArg::KannalaBrandt => Self::KannalaBrandt,
        }
    }
}

fn printed<'a>(calibration: &'a IntrinsicsCalibration, unused: &[Unused]) -> Printed<'a> {
    let unused = unused.iter().map(|unused| PrintedRejection {
        image: unused.name.clone(),
        reason: unused.reason.clone(),
        is_unreadable: unused.is_unreadable,
    });
    let rejected = calibration
        .rejected
        .iter()
        .map(|rejected| PrintedRejection {
            image: rejected.image.clone(),
            reason: rejected.reason.to_string(),
            is_unreadable: false,
        });
    let rejected = unused.chain(rejected).collect();
    // The first parameters are the focal lengths and the principal point, which have fields of
    // their own.
    const N_PINHOLE_PARAMS: usize = 4;
    let names = calibration.params.iter().map(|param| param.name);
    Printed {
        lens: LensFile::of(&calibration.intrinsics)
            .with_covariance(&calibration.intrinsics_covariance()),
        coefficients: names.skip(N_PINHOLE_PARAMS).collect(),
        rms_px: calibration.rms_px,
        noise_px: calibration.noise_px,
        sigma: calibration
            .params
            .iter()
            .map(|param| (param.name, param.sigma))
            .collect(),
        rejected,
        images: calibration
            .images
            .iter()
            .map(|image| PrintedImage {
                image: &image.name,
                n_corners: image.points.len(),
                rms_px: image.rms_px,
            })
            .collect(),
        coverage: grid(&calibration.coverage),
        projection_sigma_px: grid(&calibration.uncertainty_px),
        trials: calibration.trials.iter().map(trial).collect(),
        next_view: calibration
            .next_view
            .as_ref()
            .map(|next| &*next.instruction),
    }
}

fn grid<T: Clone>(grid: &ImageGrid<T>) -> PrintedGrid<T> {
    PrintedGrid {
        columns: grid.n_columns,
        rows: grid.n_rows,
        values: grid.values.clone(),
    }
}

fn trial(trial: &LensTrial) -> PrintedTrial<'_> {
    let LensTrial {
        baseline,
        variant,
        gain_db,
        standard_error_db,
        kept,
        ..
    } = trial;
    PrintedTrial {
        baseline,
        variant,
        gain_db: *gain_db,
        standard_error_db: *standard_error_db,
        kept: *kept,
    }
}

fn describe(printed: &Printed<'_>) -> anyhow::Result<()> {
    let Printed {
        lens,
        sigma,
        rms_px,
        images,
        rejected,
        ..
    } = printed;
    let n_corners: usize = images.iter().map(|image| image.n_corners).sum();
    let [width, height] = lens.size_px.unwrap_or_default();
    print::line(format!(
        "{} of {width}x{height} pixels, {} images with {n_corners} corners, RMS error {rms_px:.3} px",
        lens.model_name(),
        images.len()
    ))?;
    // Parameters that were not estimated have no standard deviation.
    let with_sigma = |name: &str, value: f64| match sigma.get(name) {
        Some(sigma) => format!("{value:.3} +- {sigma:.3}"),
        None => format!("{value:.3}"),
    };
    let [fx, fy] = lens.focal_px;
    let [cx, cy] = lens.principal_px;
    print::line(format!(
        "focal lengths    {}, {} px",
        with_sigma("fx", fx),
        with_sigma("fy", fy)
    ))?;
    print::line(format!(
        "principal point  {}, {} px",
        with_sigma("cx", cx),
        with_sigma("cy", cy)
    ))?;
    if !lens.distortion.is_empty() {
        let distortion: Vec<String> = lens
            .distortion
            .iter()
            .map(|value| format!("{value:.5}"))
            .collect();
        print::line(format!("distortion       {}", distortion.join(", ")))?;
    }
    let worst = largest(&printed.projection_sigma_px.values);
    print::line(format!(
        "projection       +- {worst:.2} px (largest standard deviation in the image)"
    ))?;
    // Images that cannot be read were reported in a warning.
    for rejection in rejected.iter().filter(|rejection| !rejection.is_unreadable) {
        print::line(format!(
            "not used: {}: {}",
            rejection.image, rejection.reason
        ))?;
    }
    if let Some(next) = printed.next_view {
        print::line(format!("next image: {next}"))?;
    }
    print::line(format!("rig file:\nintrinsics = {}", lens.to_toml()))?;
    Ok(())
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
