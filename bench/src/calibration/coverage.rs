//! Measures how often the confidence ellipsoid of the reported uncertainty contains the truth.

use super::CoverageScenes;
use super::method::squared_error;
use super::scene::{self, Noise, Scene, brown_conrady, camera_from_board, intrinsics, view};
use calibration::hand_eye::{HandEyeOptions, calibrate_hand_eye};
use calibration::{
    BoardView, IntrinsicsCalibration, IntrinsicsInput, LensModel, calibrate_intrinsics,
};
use kinematics::{Intrinsics, Lens};
use nalgebra::DVector;
use numbers::quantile::median;
use numbers::random::Random;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};
use serde::Serialize;

/// Standard deviation of the rotation of the camera, radians.
const SPREAD_RAD: f64 = 0.4;

/// Results of one kind of calibration.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Coverage {
    pub(super) name: &'static str,
    pub(super) n_runs: usize,
    /// Runs without a result.
    pub(super) n_refused: usize,
    /// Fraction of the results whose 95 % ellipsoid contains the truth.
    pub(super) covered_frac: f64,
    /// Medians of two errors. `p95` has the 95th percentiles of the same errors. For a camera pose,
    /// these are the position (mm) and the rotation (degrees). For intrinsics, they are the focal
    /// length and the principal point (px).
    pub(super) median: [f64; 2],
    pub(super) p95: [f64; 2],
    pub(super) units: [&'static str; 2],
    /// Smallest confidence level of the ellipsoid that contains the truth, for each result, in
    /// ascending order.
    #[serde(skip)]
    pub(super) levels: Vec<f64>,
}

/// Confidence level of the ellipsoid through the truth, and two errors.
type Run = (f64, [f64; 2]);

impl Coverage {
    fn of(name: &'static str, units: [&'static str; 2], runs: Vec<Option<Run>>) -> Self {
        let found: Vec<Run> = runs.iter().copied().flatten().collect();
        let mut levels: Vec<f64> = found.iter().map(|(level, _)| *level).collect();
        levels.sort_by(f64::total_cmp);
        let n_covered = levels.iter().filter(|level| **level < 0.95).count();
        Self {
            name,
            n_runs: runs.len(),
            n_refused: runs.len() - found.len(),
            covered_frac: n_covered as f64 / found.len().max(1) as f64,
            median: [0, 1].map(|ix| median(&column(&found, ix)).unwrap_or(f64::NAN)),
            p95: [0, 1].map(|ix| p95(column(&found, ix))),
            units,
            levels,
        }
    }
}

/// One of the two errors of each run.
fn column(runs: &[Run], ix: usize) -> Vec<f64> {
    runs.iter().map(|(_, errors)| errors[ix]).collect()
}

fn p95(mut values: Vec<f64>) -> f64 {
    numbers::quantile::quantile(&mut values, 0.95, numbers::quantile::Rank::Upper)
        .unwrap_or(f64::NAN)
}

/// Measures all kinds.
pub(super) fn measure(scenes: CoverageScenes) -> Vec<Coverage> {
    let no_robot_noise = Noise {
        corner_px: scenes.corner_px,
        robot_rad: 0.0,
        robot_m: 0.0,
    };
    let robot_noise = Noise {
        robot_rad: 3e-4,
        robot_m: 3e-4,
        ..no_robot_noise
    };
    let default = HandEyeOptions::default();
    let with_lens = HandEyeOptions {
        estimate_intrinsics: true,
        ..default
    };
    // The kinds of calibration differ in the source of uncertainty. The sources are the corners,
    // the robot poses, the given lens, and a lens that is estimated together with the pose.
    let hand_eye = |name, noise, given, options| hand_eye(scenes, name, noise, given, options);
    let lens = |name, lens, model| intrinsics_coverage(scenes, name, lens, model);
    vec![
        hand_eye(
            "hand-eye, no robot pose noise",
            no_robot_noise,
            Given::Lens,
            default,
        ),
        hand_eye(
            "hand-eye, robot pose noise of 0.3 mm and 0.3 mrad",
            robot_noise,
            Given::Lens,
            default,
        ),
        hand_eye(
            "hand-eye, lens from other images, no robot pose noise",
            no_robot_noise,
            Given::LensEstimate,
            default,
        ),
        hand_eye(
            "hand-eye with lens, no robot pose noise",
            no_robot_noise,
            Given::Lens,
            with_lens,
        ),
        hand_eye(
            "hand-eye from board poses, robot pose noise of 0.3 mm and 0.3 mrad",
            robot_noise,
            Given::BoardPoses,
            default,
        ),
        lens("lens, pinhole", Lens::Pinhole, LensModel::Pinhole),
        lens(
            "lens, Brown-Conrady",
            brown_conrady(),
            LensModel::BrownConrady5,
        ),
        lens(
            "lens, Kannala-Brandt",
            Lens::KannalaBrandt([0.03, -0.01, 0.002, 0.0]),
            LensModel::KannalaBrandt,
        ),
    ]
}

impl CoverageScenes {
    fn seeds(self) -> std::ops::Range<u64> {
        self.first_seed..self.first_seed + self.runs
    }
}

/// Coverage of a hand-eye calibration.
fn hand_eye(
    scenes: CoverageScenes,
    name: &'static str,
    noise: Noise,
    given: Given,
    options: HandEyeOptions,
) -> Coverage {
    let runs = scenes
        .seeds()
        .into_par_iter()
        .map(|seed| hand_eye_run(seed, scenes.n_poses, noise, given, options));
    Coverage::of(name, ["mm", "degrees"], runs.collect())
}

/// Coverage of a calibration of intrinsics.
fn intrinsics_coverage(
    scenes: CoverageScenes,
    name: &'static str,
    lens: Lens,
    model: LensModel,
) -> Coverage {
    let runs = scenes
        .seeds()
        .into_par_iter()
        .map(|seed| intrinsics_run(seed, scenes, lens, model));
    Coverage::of(name, ["px", "px"], runs.collect())
}

/// What is given besides the robot poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Given {
    /// Corners and the true lens.
    Lens,
    /// A calibration from corners, with a lens and its covariance that were estimated from other
    /// images.
    LensEstimate,
    /// Board poses.
    BoardPoses,
}

fn hand_eye_run(
    seed: u64,
    n_poses: usize,
    noise: Noise,
    given: Given,
    options: HandEyeOptions,
) -> Option<Run> {
    const N_PARAMS: usize = 6;
    let scene = Scene::new(n_poses, SPREAD_RAD, 1000 + seed);
    let samples = scene.samples(noise, seed);
    let samples = if given == Given::BoardPoses {
        scene::with_board_poses(&samples)
    } else {
        samples
    };
    let mut input = scene::input(samples, options);
    if given == Given::LensEstimate {
        let lens = lens_from_views(
            seed,
            n_poses,
            noise.corner_px,
            &intrinsics(brown_conrady()),
            LensModel::BrownConrady5,
        )?;
        input.intrinsics = Some(lens.intrinsics.clone());
        input.intrinsics_covariance = Some(lens.intrinsics_covariance());
    }
    let found = calibrate_hand_eye(&input).ok()?;
    let error = scene.flange_from_camera.inverse() * found.parent_from_camera;
    let errors = [
        1e3 * error.translation.vector.norm(),
        error.rotation.angle().to_degrees(),
    ];
    Some((
        chi_squared_cdf(squared_error(&found, &scene.flange_from_camera), N_PARAMS),
        errors,
    ))
}

/// A lens from simulated images.
fn lens_from_views(
    seed: u64,
    n_views: usize,
    corner_px: f64,
    truth: &Intrinsics,
    model: LensModel,
) -> Option<IntrinsicsCalibration> {
    let mut random = Random::new(2000 + seed);
    let views: Vec<BoardView> = (0..n_views)
        .map(|ix| {
            let pose = camera_from_board(truth, SPREAD_RAD, &mut random);
            BoardView {
                name: format!("{ix}"),
                ..view(truth, &pose, corner_px, &mut random)
            }
        })
        .collect();
    let sizes_px = vec![truth.size_px; n_views];
    calibrate_intrinsics(&IntrinsicsInput {
        views: &views,
        sizes_px: &sizes_px,
        model,
    })
    .ok()
}

fn intrinsics_run(seed: u64, scenes: CoverageScenes, lens: Lens, model: LensModel) -> Option<Run> {
    let truth = intrinsics(lens);
    let found = lens_from_views(seed, scenes.n_poses, scenes.corner_px, &truth, model)?;
    let difference =
        |axes: [f64; 2], truth: [f64; 2]| (axes[0] - truth[0]).hypot(axes[1] - truth[1]);
    let errors = [
        difference(found.intrinsics.focal_px, truth.focal_px),
        difference(found.intrinsics.principal_px, truth.principal_px),
    ];
    let true_params = truth.params();
    let error = DVector::from_iterator(
        found.params.len(),
        found
            .params
            .iter()
            .zip(&true_params)
            .map(|(param, truth)| param.value - truth),
    );
    // The squared Mahalanobis distance has a chi-squared distribution if the covariance is right.
    // A covariance that is not positive definite counts as a result outside of any ellipsoid.
    let squared = found
        .covariance
        .clone()
        .cholesky()
        .map_or(f64::INFINITY, |factor| error.dot(&factor.solve(&error)));
    Some((chi_squared_cdf(squared, found.params.len()), errors))
}

/// Probability that a chi-squared variable is at most `x`, by the series of the incomplete gamma
/// function.
pub(super) fn chi_squared_cdf(x: f64, degrees_of_freedom: usize) -> f64 {
    /// Larger values have a probability of 1 in f64.
    const MAX: f64 = 300.0;
    let is_small = x < MAX; // This comparison is false for NaN.
    if !is_small {
        return 1.0;
    }
    // With `a` half of the degrees of freedom and `h` half of `x`, the probability is
    // `h^a e^-h / Gamma(a + 1) * (1 + h / (a + 1) + h^2 / ((a + 1) (a + 2)) + ...)`.
    let a = 0.5 * degrees_of_freedom as f64;
    let half = 0.5 * x.max(0.0);
    // Gamma(a + 1) is computed from Gamma(1) or Gamma(1/2).
    let (mut gamma, mut at) = if degrees_of_freedom.is_multiple_of(2) {
        (1.0, 1.0)
    } else {
        (std::f64::consts::PI.sqrt(), 0.5)
    };
    while at < a + 0.5 {
        gamma *= at;
        at += 1.0;
    }
    // Terms below the rounding error of the sum do not change it.
    let mut term = 1.0;
    let mut sum = 1.0;
    let mut n = a;
    while term > 1e-16 * sum {
        n += 1.0;
        term *= half / n;
        sum += term;
    }
    (half.powf(a) * (-half).exp() / gamma * sum).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chi_squared_quantiles_match_tables() {
        for (quantile, degrees_of_freedom, probability) in [
            (12.592, 6, 0.95),
            (16.919, 9, 0.95),
            (9.488, 4, 0.95),
            (5.348, 6, 0.5),
            (3.841, 1, 0.95),
        ] {
            let found = chi_squared_cdf(quantile, degrees_of_freedom);
            assert!(
                (found - probability).abs() < 1e-4,
                "{degrees_of_freedom}: {found}"
            );
        }
        assert_eq!(
            (chi_squared_cdf(f64::NAN, 6), chi_squared_cdf(0.0, 6)),
            (1.0, 0.0)
        );
    }

    #[test]
    fn reported_uncertainty_covers_the_truth() {
        let scenes = CoverageScenes {
            runs: 12,
            first_seed: 0,
            n_poses: 15,
            corner_px: 0.1,
        };
        for coverage in measure(scenes) {
            assert!(
                coverage.covered_frac > 0.7 && coverage.n_refused == 0,
                "{coverage:?}"
            );
        }
    }
}
