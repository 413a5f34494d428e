//! Initial solution that most samples agree with, and the board pose of each sample that fits it
//! best.
//!
//! Least trimmed squares over solutions of three samples (Rousseeuw 1984; concentration steps of
//! Rousseeuw and Van Driessen 1999). It resolves the two-fold ambiguity of planar boards and boards
//! with rotational symmetry, and tolerates wrong samples up to almost one half.

use super::closed_form::{ClosedForm, motions};
use super::geometry::{self, Solution};
use super::samples::Sample;
use kinematics::Transform;
use kinematics::random::Random;

/// An initial solution.
#[derive(Clone, Debug)]
pub(super) struct Consensus {
    pub(super) solution: Solution,
    /// Candidate of each sample.
    pub(super) choice: Vec<usize>,
    /// Distance of each sample: see [`Metric`].
    pub(super) distances_m: Vec<f64>,
}

impl Consensus {
    /// Median distance of the samples, meters.
    pub(super) fn median_m(&self) -> f64 {
        kinematics::quantile::median(&self.distances_m).unwrap_or(f64::INFINITY)
    }

    /// Whether each sample agrees with the solution.
    pub(super) fn is_inlier(&self) -> Vec<bool> {
        /// With two fifths of wrong samples, the median is the 83 % quantile of the good ones.
        const MEDIANS: f64 = 4.0;
        const ROUNDING_M: f64 = 1e-9;
        let limit = MEDIANS * self.median_m() + ROUNDING_M;
        self.distances_m
            .iter()
            .map(|distance| *distance <= limit)
            .collect()
    }
}

/// Number of samples whose agreement decides: `(n + p + 1) / 2` for solutions of `p = 3` samples,
/// which tolerates the most wrong samples (Rousseeuw 1984).
fn n_deciding(n: usize) -> usize {
    (n + 4).div_ceil(2).min(n)
}

/// Distance between poses: translation, and rotation times the typical distance of the board,
/// meters.
#[derive(Clone, Copy, Debug)]
struct Metric {
    lever_m: f64,
}

impl Metric {
    fn of(samples: &[Sample]) -> Self {
        let distances: Vec<f64> = samples
            .iter()
            .map(|sample| {
                sample.candidates[0]
                    .camera_from_board
                    .translation
                    .vector
                    .norm()
            })
            .collect();
        // A rotation error moves the board in the image as much as a translation of the angle times
        // the distance.
        Self {
            lever_m: kinematics::quantile::median(&distances)
                .unwrap_or(1.0)
                .max(1e-3),
        }
    }

    fn distance_m(self, predicted: &Transform, measured: &Transform) -> f64 {
        let residual = geometry::residual(predicted, measured);
        let rotation = residual.fixed_rows::<3>(0).norm() * self.lever_m;
        rotation.hypot(residual.fixed_rows::<3>(3).norm())
    }
}

/// The best solution found. `None` if no three samples determine one.
pub(super) fn find(samples: &[Sample]) -> Option<Consensus> {
    /// Three good samples with the right choice among four poses each are drawn with 99 %
    /// probability if two fifths of the samples are wrong.
    const TRIALS: usize = 1500;
    /// Without a choice, this number suffices.
    const TRIALS_WITHOUT_CHOICE: usize = 200;
    let metric = Metric::of(samples);
    // A fixed seed, so that the same samples give the same result.
    let mut random = Random::new(1);
    let mut best: Option<(f64, Solution)> = None;
    let has_choice = samples.iter().any(|sample| sample.candidates.len() > 1);
    for trial in 0..if has_choice {
        TRIALS
    } else {
        TRIALS_WITHOUT_CHOICE
    } {
        let Some(picked) = pick(samples, trial, &mut random) else {
            continue;
        };
        let Some(solution) = solve(&picked, ClosedForm::ParkMartin) else {
            continue;
        };
        let score = trimmed_squares(&distances(samples, &solution, metric).1);
        if best.as_ref().is_none_or(|(least, _)| score < *least) {
            best = Some((score, solution));
        }
    }
    // Concentration steps: solutions of half of the samples are more accurate than those of three.
    // Each step decreases the sum of squares until the set of samples no longer changes.
    let (mut least, mut solution) = best?;
    for _ in 0..10 {
        let Some(next) = concentrate(samples, &solution, metric) else {
            break;
        };
        let score = trimmed_squares(&distances(samples, &next, metric).1);
        if score.is_nan() || score >= least {
            break;
        }
        (least, solution) = (score, next);
    }
    let (choice, distances_m) = distances(samples, &solution, metric);
    Some(Consensus {
        solution,
        choice,
        distances_m,
    })
}

/// Three samples with one candidate each; `None` if the rotation angles of their motions disagree.
fn pick(
    samples: &[Sample],
    trial: usize,
    random: &mut Random,
) -> Option<[(Transform, Transform); 3]> {
    // Flange and camera rotate by the same angle, so different angles show a wrong sample or
    // candidate without solving. The limit is far above the errors of good samples.
    const MAX_DIFFERENCE_RAD: f64 = 0.2;
    let n = samples.len();
    (n >= 3).then_some(())?;
    let first = random.below(n);
    let second = (first + 1 + random.below(n - 1)) % n;
    let third = loop {
        let ix = random.below(n);
        if ix != first && ix != second {
            break ix;
        }
    };
    let picked = [first, second, third].map(|ix| {
        let sample = &samples[ix];
        let n_candidates = sample.candidates.len();
        // The first trials use the best poses only.
        let candidate_ix = if trial < 100 {
            0
        } else {
            random.below(n_candidates)
        };
        (sample.a, sample.candidates[candidate_ix].camera_from_board)
    });
    let agrees = motions(&picked).iter().all(|motion| {
        (motion.a.rotation.angle() - motion.b.rotation.angle()).abs() < MAX_DIFFERENCE_RAD
    });
    agrees.then_some(picked)
}

/// Closed-form solution of samples.
pub(super) fn solve(pairs: &[(Transform, Transform)], solver: ClosedForm) -> Option<Solution> {
    let x = solver.solve(&motions(pairs))?;
    let boards: Vec<Transform> = pairs
        .iter()
        .map(|(a, camera_from_board)| a * x * camera_from_board)
        .collect();
    Some(Solution {
        x,
        y: geometry::mean(&boards)?,
    })
}

/// For each sample the candidate that fits best, and its distance in meters.
fn distances(samples: &[Sample], solution: &Solution, metric: Metric) -> (Vec<usize>, Vec<f64>) {
    samples
        .iter()
        .map(|sample| nearest(sample, solution, metric))
        .unzip()
}

/// The candidate of a sample that fits best, and its distance in meters.
fn nearest(sample: &Sample, solution: &Solution, metric: Metric) -> (usize, f64) {
    let predicted = solution.camera_from_board(&sample.a);
    sample
        .candidates
        .iter()
        .map(|candidate| metric.distance_m(&predicted, &candidate.camera_from_board))
        .enumerate()
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap_or((0, f64::INFINITY))
}

/// The candidate of each sample that fits a solution best.
pub(super) fn choose(samples: &[Sample], solution: &Solution) -> Vec<usize> {
    distances(samples, solution, Metric::of(samples)).0
}

/// Sum of the squares of the smallest distances. The others may be arbitrarily wrong.
fn trimmed_squares(distances_m: &[f64]) -> f64 {
    let mut sorted = distances_m.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted
        .iter()
        .take(n_deciding(sorted.len()))
        .map(|distance| distance * distance)
        .sum()
}

/// Solution of the samples with the smallest distances.
fn concentrate(samples: &[Sample], solution: &Solution, metric: Metric) -> Option<Solution> {
    let (choice, distances_m) = distances(samples, solution, metric);
    let mut order: Vec<usize> = (0..samples.len()).collect();
    order.sort_by(|&i, &j| distances_m[i].total_cmp(&distances_m[j]));
    let pairs: Vec<_> = order
        .into_iter()
        .take(n_deciding(samples.len()))
        .map(|ix| {
            (
                samples[ix].a,
                samples[ix].candidates[choice[ix]].camera_from_board,
            )
        })
        .collect();
    solve(&pairs, ClosedForm::ParkMartin)
}
