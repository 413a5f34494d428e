//! Where methods break: small rotations, few poses, wrong corners, wrong images.

use super::method::{Method, Outcome};
use super::scene::{Noise, Scene};
use calibration::hand_eye::{BoardObservation, HandEyeSample};
use kinematics::quantile::median;
use kinematics::random::Random;
use nalgebra::Vector3;
use rayon::prelude::{IntoParallelIterator, IntoParallelRefIterator, ParallelIterator};
use serde::Serialize;

const SPREADS_DEG: [f64; 6] = [2.0, 5.0, 10.0, 20.0, 40.0, 90.0];
const POSES: [usize; 6] = [3, 5, 8, 12, 20, 40];
const WRONG_PERCENT: [u32; 5] = [0, 10, 20, 30, 40];
const NOISE: Noise = Noise { corner_px: 0.2, robot_rad: 3e-4, robot_m: 3e-4 };

/// Errors that are added to a part of the measurements.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) enum Mistake {
    /// Some corners of each image are off by up to 30 px along each axis.
    WrongCorners,
    /// The robot poses of some images are wrong by about 100 mm and 17 degrees.
    WrongImages,
}

/// One combination of conditions.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Condition {
    pub(super) spread_deg: f64,
    pub(super) n_poses: usize,
    pub(super) mistake: Mistake,
    pub(super) wrong_percent: u32,
}

/// Results of one method under one condition.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Cell {
    pub(super) condition: Condition,
    pub(super) method: &'static str,
    pub(super) n_runs: usize,
    pub(super) n_refused: usize,
    /// Results that are wrong by more than 5 mm or 0.5 degrees.
    pub(super) n_broken: usize,
    /// Broken results outside the 99.99 % ellipsoid of the stated uncertainty.
    pub(super) n_misleading: usize,
    /// Medians of the results.
    pub(super) mm: Option<f64>,
    pub(super) deg: Option<f64>,
}

/// The compared methods. The lens is known.
pub(super) fn methods() -> impl Iterator<Item = Method> {
    Method::ALL.into_iter().filter(|method| *method != Method::JointWithLens)
}

/// Measures every combination with `n_seeds` scenes.
pub(super) fn measure(n_seeds: u64) -> Vec<Cell> {
    let mut conditions = Vec::new();
    for spread_deg in SPREADS_DEG {
        for n_poses in POSES {
            for mistake in [Mistake::WrongCorners, Mistake::WrongImages] {
                for wrong_percent in WRONG_PERCENT {
                    // Without mistakes, their kind does not matter.
                    if wrong_percent > 0 || mistake == Mistake::WrongCorners {
                        conditions.push(Condition { spread_deg, n_poses, mistake, wrong_percent });
                    }
                }
            }
        }
    }
    conditions.par_iter().flat_map_iter(|condition| cells(*condition, n_seeds)).collect()
}

fn cells(condition: Condition, n_seeds: u64) -> Vec<Cell> {
    let runs: Vec<(Scene, Vec<HandEyeSample>)> = (0..n_seeds)
        .into_par_iter()
        .map(|seed| {
            let scene = Scene::new(condition.n_poses, condition.spread_deg.to_radians(), 5000 + seed);
            let mut samples = scene.samples(NOISE, seed);
            condition.spoil(&mut samples, seed);
            (scene, samples)
        })
        .collect();
    let cell = |method: Method| {
        let calibrate =
            |(scene, samples): &(Scene, Vec<HandEyeSample>)| method.calibrate(samples, &scene.flange_from_camera);
        Cell::of(condition, method, &runs.iter().map(calibrate).collect::<Vec<_>>())
    };
    methods().map(cell).collect()
}

impl Condition {
    fn spoil(&self, samples: &mut [HandEyeSample], seed: u64) {
        const MAX_OFFSET_PX: f64 = 30.0;
        let mut random = Random::new(seed ^ 0xbad);
        let n_wrong = |n: usize| n * self.wrong_percent as usize / 100;
        match self.mistake {
            Mistake::WrongCorners => {
                for sample in samples {
                    let BoardObservation::View(view) = &mut sample.board else { continue };
                    let n = n_wrong(view.points.len());
                    random.shuffle(&mut view.points);
                    for point in &mut view.points[..n] {
                        let offset = [0, 1].map(|_| random.uniform(-MAX_OFFSET_PX, MAX_OFFSET_PX));
                        point.pixel = [point.pixel[0] + offset[0], point.pixel[1] + offset[1]];
                    }
                }
            }
            Mistake::WrongImages => {
                let n = n_wrong(samples.len());
                for sample in &mut samples[..n] {
                    let wrong = Vector3::new(random.normal(), random.normal(), random.normal());
                    sample.base_from_flange *= kinematics::Transform::new(wrong * 0.1, wrong * 0.3);
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
        let broken = solved.iter().filter(|errors| errors.is_broken());
        let column = |value: fn(&super::method::Errors) -> f64| median(&solved.iter().map(value).collect::<Vec<_>>());
        Self {
            condition,
            method: method.name(),
            n_runs: outcomes.len(),
            n_refused: outcomes.len() - solved.len(),
            n_broken: broken.clone().count(),
            n_misleading: broken.filter(|errors| errors.squared.is_none_or(|squared| squared > MAX_SQUARED)).count(),
            mm: column(|errors| errors.mm),
            deg: column(|errors| errors.deg),
        }
    }
}
