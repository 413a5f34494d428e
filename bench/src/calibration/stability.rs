//! Measures the failures of the methods with small rotations, few poses, outlier corners and
//! outlier robot poses.

use super::method::{Method, Outcome};
use super::scene::{Noise, Scene};
use calibration::hand_eye::{BoardObservation, HandEyeSample};
use nalgebra::Vector3;
use numbers::quantile::median;
use numbers::random::Random;
use rayon::prelude::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};
use serde::Serialize;

const SPREADS_DEG: [f64; 6] = [2.0, 5.0, 10.0, 20.0, 40.0, 90.0];
const POSES: [usize; 6] = [3, 5, 8, 12, 20, 40];
const OUTLIER_PERCENT: [u32; 5] = [0, 10, 20, 30, 40];
const NOISE: Noise = Noise {
    corner_px: 0.2,
    robot_rad: 3e-4,
    robot_m: 3e-4,
};

/// Measurements that become outliers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) enum OutlierType {
    /// Some corners of each image, with errors of up to 30 px along each axis.
    Corners,
    /// The robot poses of some images, with errors of about 100 mm and 17 degrees.
    RobotPoses,
}

/// One combination of conditions.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Condition {
    pub(super) spread_deg: f64,
    pub(super) n_poses: usize,
    pub(super) outlier_type: OutlierType,
    pub(super) outlier_percent: u32,
}

/// Results of one method under one condition.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Cell {
    pub(super) condition: Condition,
    pub(super) method: &'static str,
    pub(super) n_runs: usize,
    pub(super) n_refused: usize,
    /// Results with an error above 5 mm or 0.5 degrees.
    pub(super) n_failed: usize,
    /// Failed results whose 99.99 % confidence region does not contain the truth.
    pub(super) n_failed_outside_region: usize,
    /// Medians of the results.
    pub(super) mm: Option<f64>,
    pub(super) deg: Option<f64>,
}

/// The compared methods. The lens is known.
pub(super) fn methods() -> impl Iterator<Item = Method> {
    Method::ALL
        .into_iter()
        .filter(|method| *method != Method::BundleAdjustmentWithLens)
}

/// Measures every combination with `n_seeds` scenes.
pub(super) fn measure(n_seeds: u64) -> Vec<Cell> {
    let mut conditions = Vec::new();
    for spread_deg in SPREADS_DEG {
        for n_poses in POSES {
            for outlier_type in [OutlierType::Corners, OutlierType::RobotPoses] {
                for outlier_percent in OUTLIER_PERCENT {
                    // Without outliers, the outlier type has no effect.
                    if outlier_percent > 0 || outlier_type == OutlierType::Corners {
                        conditions.push(Condition {
                            spread_deg,
                            n_poses,
                            outlier_type,
                            outlier_percent,
                        });
                    }
                }
            }
        }
    }
    conditions
        .par_iter()
        .flat_map_iter(|condition| cells(*condition, n_seeds))
        .collect()
}

fn cells(condition: Condition, n_seeds: u64) -> Vec<Cell> {
    let runs: Vec<(Scene, Vec<HandEyeSample>)> = (0..n_seeds)
        .into_par_iter()
        .map(|seed| {
            let scene = Scene::new(
                condition.n_poses,
                condition.spread_deg.to_radians(),
                5000 + seed,
            );
            let mut samples = scene.samples(NOISE, seed);
            condition.add_outliers(&mut samples, seed);
            (scene, samples)
        })
        .collect();
    let mut cells = Vec::new();
    // All methods get the same measurements.
    for method in methods() {
        let outcomes: Vec<Outcome> = runs
            .iter()
            .map(|(scene, samples)| method.calibrate(samples, &scene.flange_from_camera))
            .collect();
        cells.push(Cell::of(condition, method, &outcomes));
    }
    cells
}

impl Condition {
    fn add_outliers(&self, samples: &mut [HandEyeSample], seed: u64) {
        const MAX_OFFSET_PX: f64 = 30.0;
        let mut random = Random::new(seed ^ 0xbad);
        let n_outliers = |n: usize| n * self.outlier_percent as usize / 100;
        match self.outlier_type {
            OutlierType::Corners => {
                for sample in samples {
                    let BoardObservation::View(view) = &mut sample.board else {
                        continue;
                    };
                    let n = n_outliers(view.points.len());
                    // Without shuffling, the outliers of all images would be in the same part of
                    // the board.
                    random.shuffle(&mut view.points);
                    for point in &mut view.points[..n] {
                        let offset = [0, 1].map(|_| random.uniform(-MAX_OFFSET_PX, MAX_OFFSET_PX));
                        point.pixel = [point.pixel[0] + offset[0], point.pixel[1] + offset[1]];
                    }
                }
            }
            OutlierType::RobotPoses => {
                let n = n_outliers(samples.len());
                for sample in &mut samples[..n] {
                    let error = Vector3::new(random.normal(), random.normal(), random.normal());
                    sample.base_from_flange *= kinematics::Transform::new(error * 0.1, error * 0.3);
                }
            }
        }
    }
}

impl Cell {
    fn of(condition: Condition, method: Method, outcomes: &[Outcome]) -> Self {
        /// 99.99 % quantile of the chi-squared distribution with six degrees of freedom.
        const MAX_SQUARED: f64 = 27.86;
        let solved: Vec<_> = outcomes.iter().filter_map(Outcome::errors).collect();
        let failed = solved.iter().filter(|errors| errors.has_failed());
        let column = |value: fn(&super::method::Errors) -> f64| {
            median(&solved.iter().map(value).collect::<Vec<_>>())
        };
        Self {
            condition,
            method: method.name(),
            n_runs: outcomes.len(),
            n_refused: outcomes.len() - solved.len(),
            n_failed: failed.clone().count(),
            n_failed_outside_region: failed
                .filter(|errors| errors.squared.is_none_or(|squared| squared > MAX_SQUARED))
                .count(),
            mm: column(|errors| errors.mm),
            deg: column(|errors| errors.deg),
        }
    }
}
