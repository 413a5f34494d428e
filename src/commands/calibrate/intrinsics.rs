//! `fieldrig calibrate intrinsics`: the lens of a camera from images of a target.

use super::flags::{ReportFlag, RigFlags};
use super::target_argument;
use super::terminal::Terminal;
use crate::exit::Exit;
use crate::print;
use calibrate::{IntrinsicsTask, LensFile};
use calibration::{ImageGrid, IntrinsicsCalibration, LensModel, LensTrial};
use messages::BadInput;
use report::calibration_report::Unused;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use targets::TargetSpec;

const TARGET_HELP: &str = "The target, such as chessboard:9x6:25mm, charuco:5x7:34mm:26mm:5X5_100 or aprilgrid:6x6:20mm:0.3";

const DETAILS: &str = "With a rig file, the photographs are taken for you. Move the target in front of the camera, or \
    let the arm move the camera. A photograph is taken when the target is still and sharp and shows something new. The \
    terminal and the page show what is missing next, such as another tilt or a corner of the image. It ends when \
    everything is covered, or with Ctrl-C, and then estimates the lens. Only this camera is opened, also if an arm carries \
    it. With --seconds, all devices are opened, and all images of that time are used that show no fast motion of the arm.\n\n\
    Examples:\n  \
    fieldrig calibrate target --target charuco:5x7:34mm:26mm:5X5_100 --out target.pdf\n  \
    fieldrig calibrate intrinsics rig.toml --target charuco:5x7:34mm:26mm:5X5_100 --write-rig rig.toml\n  \
    fieldrig calibrate intrinsics photographs/ --target chessboard:9x6:25mm";

/// Flags of `calibrate intrinsics`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = DETAILS)]
pub(crate) struct Args {
    /// Folder of images (.jpg, .png) of the target, all from one camera and of one size. Or a
    /// recording (.mcap) or rig file (.toml) whose camera sees the target
    #[arg(value_name = "IMAGES|RECORDING|RIG")]
    input: PathBuf,
    #[arg(long, value_name = "SPEC", value_parser = target_argument, help = TARGET_HELP)]
    target: TargetSpec,
    /// Lens model
    #[arg(long, value_name = "MODEL", value_enum, default_value_t = ModelArg::Auto)]
    model: ModelArg,
    #[command(flatten)]
    rig: RigFlags,
    /// With a rig file: save the photographs in this folder (PNG), which must be new or empty.
    /// `calibrate intrinsics FOLDER` repeats the calibration
    #[arg(long, value_name = "FOLDER")]
    save_images: Option<PathBuf>,
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
    /// Standard deviation of the projection of a distant point, for each part of the image. It is
    /// null where the lens model does not apply.
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

/// Detects the target, calibrates, and prints the result.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let host = Terminal::new(Some(&args.rig.page), args.json);
    let outcome = args.task()?.run(&host)?;
    let printed = printed(&outcome.calibration, &outcome.unused);
    if args.json {
        print::json(&printed)?
    } else {
        describe(&printed)?
    }
    for warning in outcome.warnings() {
        log::warn!("{warning}");
    }
    outcome.finish()?;
    Ok(Exit::Done)
}

impl Args {
    fn task(&self) -> Result<IntrinsicsTask, BadInput> {
        Ok(IntrinsicsTask {
            input: self.input.clone(),
            target: self.target.clone(),
            model: self.model.into(),
            rig: self.rig.options()?,
            report: self.report.options(),
            save_images: self.save_images.clone(),
        })
    }
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
    // The first parameters are the focal lengths and the principal point, which have separate
    // fields.
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
    let sigmas_px = printed.projection_sigma_px.values.iter().flatten();
    let worst = sigmas_px.copied().fold(0.0, f64::max);
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
