//! The result of a lens calibration as JSON and as text.

use crate::intrinsics::IntrinsicsOutcome;
use crate::lens::LensFile;
use calibration::{ImageGrid, IntrinsicsCalibration, LensTrial};
use report::calibration_report::Unused;
use serde::Serialize;
use std::collections::BTreeMap;

/// The result of a lens calibration. It serializes as JSON.
#[derive(Debug, Serialize)]
pub struct IntrinsicsDocument<'a> {
    #[serde(flatten)]
    lens: LensFile,
    /// Names of the estimated coefficients; the others are zero.
    coefficients: Vec<&'static str>,
    rms_px: f64,
    /// Standard deviation of a detected corner along one axis.
    noise_px: f64,
    /// Standard deviations of the parameters, by name.
    sigma: BTreeMap<&'static str, f64>,
    rejected: Vec<Rejection>,
    images: Vec<ImageUse<'a>>,
    /// Number of corners in each part of the image.
    coverage: GridValues<usize>,
    /// Standard deviation of the projection of a distant point, for each part of the image. It is
    /// null where the lens model does not apply.
    projection_sigma_px: GridValues<Option<f64>>,
    trials: Vec<TrialResult<'a>>,
    next_view: Option<&'a str>,
}

#[derive(Debug, Serialize)]
struct Rejection {
    image: String,
    reason: String,
    #[serde(skip)]
    is_unreadable: bool,
}

#[derive(Debug, Serialize)]
struct ImageUse<'a> {
    image: &'a str,
    n_corners: usize,
    rms_px: f64,
}

/// Values of the parts of the image, row by row.
#[derive(Debug, Serialize)]
struct GridValues<T> {
    columns: usize,
    rows: usize,
    values: Vec<T>,
}

/// Comparison of two lens models on held-out corners.
#[derive(Debug, Serialize)]
struct TrialResult<'a> {
    baseline: &'a str,
    variant: &'a str,
    gain_db: f64,
    standard_error_db: f64,
    kept: bool,
}

impl IntrinsicsOutcome {
    /// The result.
    pub fn document(&self) -> IntrinsicsDocument<'_> {
        of_calibration(&self.calibration, &self.unused)
    }
}

fn of_calibration<'a>(
    calibration: &'a IntrinsicsCalibration,
    unused: &[Unused],
) -> IntrinsicsDocument<'a> {
    let unused = unused.iter().map(|unused| Rejection {
        image: unused.name.clone(),
        reason: unused.reason.clone(),
        is_unreadable: unused.is_unreadable,
    });
    let rejected = calibration.rejected.iter().map(|rejected| Rejection {
        image: rejected.image.clone(),
        reason: rejected.reason.to_string(),
        is_unreadable: false,
    });
    let rejected = unused.chain(rejected).collect();
    // The first parameters are the focal lengths and the principal point, which have separate
    // fields.
    const N_PINHOLE_PARAMS: usize = 4;
    let names = calibration.params.iter().map(|param| param.name);
    IntrinsicsDocument {
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
            .map(|image| ImageUse {
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

fn grid<T: Clone>(grid: &ImageGrid<T>) -> GridValues<T> {
    GridValues {
        columns: grid.n_columns,
        rows: grid.n_rows,
        values: grid.values.clone(),
    }
}

fn trial(trial: &LensTrial) -> TrialResult<'_> {
    let LensTrial {
        baseline,
        variant,
        gain_db,
        standard_error_db,
        kept,
        ..
    } = trial;
    TrialResult {
        baseline,
        variant,
        gain_db: *gain_db,
        standard_error_db: *standard_error_db,
        kept: *kept,
    }
}

impl IntrinsicsDocument<'_> {
    /// The result as text.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = Vec::new();
        let Self {
            lens,
            sigma,
            rms_px,
            images,
            rejected,
            ..
        } = self;
        let n_corners: usize = images.iter().map(|image| image.n_corners).sum();
        let [width, height] = lens.size_px.unwrap_or_default();
        lines.push(format!(
            "{} of {width}x{height} pixels, {} images with {n_corners} corners, RMS error {rms_px:.3} px",
            lens.model_name(),
            images.len()
        ));
        // Parameters that were not estimated have no standard deviation.
        let with_sigma = |name: &str, value: f64| match sigma.get(name) {
            Some(sigma) => format!("{value:.3} +- {sigma:.3}"),
            None => format!("{value:.3}"),
        };
        let [fx, fy] = lens.focal_px;
        let [cx, cy] = lens.principal_px;
        lines.push(format!(
            "focal lengths    {}, {} px",
            with_sigma("fx", fx),
            with_sigma("fy", fy)
        ));
        lines.push(format!(
            "principal point  {}, {} px",
            with_sigma("cx", cx),
            with_sigma("cy", cy)
        ));
        if !lens.distortion.is_empty() {
            let distortion: Vec<String> = lens
                .distortion
                .iter()
                .map(|value| format!("{value:.5}"))
                .collect();
            lines.push(format!("distortion       {}", distortion.join(", ")));
        }
        let sigmas_px = self.projection_sigma_px.values.iter().flatten();
        let worst = sigmas_px.copied().fold(0.0, f64::max);
        lines.push(format!(
            "projection       +- {worst:.2} px (largest standard deviation in the image)"
        ));
        // Images that cannot be read were reported in a warning.
        for rejection in rejected.iter().filter(|rejection| !rejection.is_unreadable) {
            lines.push(format!(
                "not used: {}: {}",
                rejection.image, rejection.reason
            ));
        }
        if let Some(next) = self.next_view {
            lines.push(format!("next image: {next}"));
        }
        lines.push(format!("rig file:\nintrinsics = {}", lens.to_toml()));
        lines
    }
}
