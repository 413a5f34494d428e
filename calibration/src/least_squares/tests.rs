//! Tests of the solver on problems with known solutions.

use super::{BlockSums, Loss, Options, Problem, minimize};
use nalgebra::{DMatrix, DVector, Vector2};
use numbers::random::Random;

/// Circles of one common radius. The radius is a shared parameter, and the centers are local
/// parameters. Each residual is the vector to a measured point from the point of the circle at a
/// known angle.
struct Circles {
    points: Vec<Vec<(f64, Vector2<f64>)>>,
}

const RADIUS: f64 = 2.0;

impl Circles {
    fn new(n_circles: usize, noise: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let points = (0..n_circles).map(|_| {
            let center = Vector2::new(random.uniform(-5.0, 5.0), random.uniform(-5.0, 5.0));
            let mut point = |ix: usize| {
                let angle = 0.7 * ix as f64;
                let error = Vector2::new(random.normal(), random.normal()) * noise;
                (
                    angle,
                    center + Vector2::new(angle.cos(), angle.sin()) * RADIUS.exp() + error,
                )
            };
            (0..7).map(&mut point).collect()
        });
        Self {
            points: points.collect(),
        }
    }

    fn start(&self) -> (f64, Vec<Vector2<f64>>) {
        (0.3, vec![Vector2::zeros(); self.points.len()])
    }
}

impl Problem for Circles {
    /// Logarithm of the radius, and the centers.
    type State = (f64, Vec<Vector2<f64>>);

    fn scales(&self) -> DVector<f64> {
        DVector::from_element(1, 1.0)
    }

    fn n_blocks(&self) -> usize {
        self.points.len()
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        2
    }

    fn evaluate(
        &self,
        (log_radius, centers): &Self::State,
        block_ix: usize,
        sums: &mut BlockSums,
    ) -> Option<()> {
        for (angle, point) in &self.points[block_ix] {
            let arm = Vector2::new(angle.cos(), angle.sin()) * log_radius.exp();
            let residual = centers[block_ix] + arm - point;
            sums.add(
                [residual.x, residual.y],
                [&[arm.x, 1.0, 0.0], &[arm.y, 0.0, 1.0]],
            );
        }
        Some(())
    }

    fn moved(
        &self,
        state: &Self::State,
        shared: &DVector<f64>,
        local: &[DVector<f64>],
    ) -> Self::State {
        let centers = state
            .1
            .iter()
            .zip(local)
            .map(|(center, step)| center + Vector2::new(step[0], step[1]));
        (state.0 + shared[0], centers.collect())
    }
}

#[test]
fn shared_and_local_parameters_are_found() {
    let problem = Circles::new(5, 0.0, 1);
    let fit = minimize(&problem, problem.start(), &Options::default()).unwrap();
    assert!(fit.converged && fit.n_steps < 30, "{} steps", fit.n_steps);
    assert!((fit.state.0 - RADIUS).abs() < 1e-9, "{}", fit.state.0);
    assert_eq!((fit.n_residuals, fit.n_params), (70, 11));
}

#[test]
fn stated_uncertainty_matches_the_scatter_of_the_errors() {
    const ALLOWED: f64 = 0.12; // Three standard errors of the ratio over this number of runs.
    let n_runs = 300;
    for loss in [Loss::Squared, Loss::Huber { threshold: 0.2 }] {
        let mut squared = 0.0;
        for seed in 0..n_runs {
            let problem = Circles::new(4, 0.1, seed);
            let fit = minimize(
                &problem,
                problem.start(),
                &Options {
                    loss,
                    ..Options::default()
                },
            )
            .unwrap();
            squared += ((fit.state.0 - RADIUS) / fit.sigma(0)).powi(2) / n_runs as f64;
        }
        assert!(
            (squared.sqrt() - 1.0).abs() < ALLOWED,
            "{loss:?}: errors are {} standard deviations",
            squared.sqrt()
        );
    }
}

#[test]
fn jackknife_is_the_change_without_each_block() {
    // The problem is nonlinear, and the jackknife is of first order.
    const REL: f64 = 0.05;
    let all = Circles::new(6, 0.01, 3);
    let fit = minimize(&all, all.start(), &Options::default()).unwrap();
    let mut squares = 0.0;
    for left_out in 0..all.points.len() {
        let mut points = all.points.clone();
        points.remove(left_out);
        let rest = Circles { points };
        let without = minimize(&rest, rest.start(), &Options::default()).unwrap();
        squares += (without.state.0 - fit.state.0).powi(2);
    }
    let scaled = fit.covariance[(0, 0)] * fit.dispersion.max(1.0);
    let jackknife = 2.0 * fit.covariance_with_shared_errors[(0, 0)] - scaled;
    assert!(
        (jackknife / squares - 1.0).abs() < REL,
        "{jackknife} instead of {squares}"
    );
    // One block cannot be left out.
    let one = Circles::new(1, 0.01, 3);
    let fit = minimize(&one, one.start(), &Options::default()).unwrap();
    let scaled = fit.covariance[(0, 0)] * fit.dispersion.max(1.0);
    assert_eq!(fit.covariance_with_shared_errors[(0, 0)], scaled);
}

#[test]
fn robust_losses_resist_outliers() {
    let mut problem = Circles::new(6, 0.01, 3);
    for circle in &mut problem.points {
        circle[2].1 += Vector2::new(3.0, -2.0);
    }
    let error = |loss| {
        let options = Options {
            loss,
            ..Options::default()
        };
        let fit = minimize(&problem, problem.start(), &options).unwrap();
        assert!(fit.converged, "{loss:?}");
        (fit.state.0 - RADIUS).abs()
    };
    let (squared, huber, cauchy) = (
        error(Loss::Squared),
        error(Loss::Huber { threshold: 0.03 }),
        error(Loss::Cauchy { threshold: 0.03 }),
    );
    assert!(
        squared > 0.01 && huber < 0.004 && cauchy < 0.002,
        "{squared} {huber} {cauchy}"
    );
}

/// Linear residuals of two shared parameters, without local parameters. The second parameter has no
/// influence.
struct Line;

impl Problem for Line {
    type State = DVector<f64>;

    fn scales(&self) -> DVector<f64> {
        DVector::from_column_slice(&[10.0, 0.1])
    }

    fn n_blocks(&self) -> usize {
        1
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        0
    }

    fn evaluate(&self, state: &Self::State, _block_ix: usize, sums: &mut BlockSums) -> Option<()> {
        for (ix, measured) in [3.1, 5.9, 9.0, 12.1].into_iter().enumerate() {
            let x = ix as f64 + 1.0;
            sums.add([state[0] * x - measured], [&[x, 1e-9 * x]]);
        }
        Some(())
    }

    fn moved(
        &self,
        state: &Self::State,
        shared: &DVector<f64>,
        _local: &[DVector<f64>],
    ) -> Self::State {
        state + shared
    }
}

#[test]
fn dense_problems_and_unobservable_directions_are_handled() {
    let fit = minimize(&Line, DVector::zeros(2), &Options::default()).unwrap();
    // Sum of x y divided by the sum of x² (30).
    assert!(
        fit.converged && (fit.state[0] - 90.3 / 30.0).abs() < 1e-6,
        "{}",
        fit.state
    );
    let weakest = &fit.directions[0];
    assert!(
        weakest.components[1].abs() > 0.999 && weakest.sigma > 1e3,
        "{weakest:?}"
    );
    assert!(fit.directions[1].sigma < 0.01, "{:?}", fit.directions[1]);
    assert!((fit.information.clone() - fit.information.transpose()).amax() == 0.0);
}

#[test]
fn schur_complement_equals_the_block_of_the_full_inverse() {
    let problem = Circles::new(2, 0.05, 8);
    let fit = minimize(&problem, problem.start(), &Options::default()).unwrap();
    let mut full = DMatrix::<f64>::zeros(5, 5);
    for (block_ix, circle) in problem.points.iter().enumerate() {
        for (angle, _) in circle {
            let arm = Vector2::new(angle.cos(), angle.sin()) * fit.state.0.exp();
            for (row, derivative) in [arm.x, arm.y].into_iter().enumerate() {
                let mut jacobian = DVector::zeros(5);
                jacobian[0] = derivative;
                jacobian[1 + 2 * block_ix + row] = 1.0;
                full.ger(1.0, &jacobian, &jacobian, 1.0);
            }
        }
    }
    let expected = full.try_inverse().unwrap()[(0, 0)] * fit.variance;
    assert!((fit.covariance[(0, 0)] / expected - 1.0).abs() < 1e-9);
}

#[test]
fn too_few_residuals_and_undefined_residuals_are_errors() {
    struct Undefined;
    impl Problem for Undefined {
        type State = ();
        fn scales(&self) -> DVector<f64> {
            DVector::from_element(1, 1.0)
        }
        fn n_blocks(&self) -> usize {
            2
        }
        fn n_local(&self, _block_ix: usize) -> usize {
            0
        }
        fn evaluate(&self, (): &(), block_ix: usize, sums: &mut BlockSums) -> Option<()> {
            sums.add([if block_ix == 1 { f64::NAN } else { 0.0 }], [&[1.0]]);
            Some(())
        }
        fn moved(&self, (): &(), _shared: &DVector<f64>, _local: &[DVector<f64>]) {}
    }
    let error = minimize(&Undefined, (), &Options::default()).unwrap_err();
    assert!(error.to_string().contains("block 1"), "{error}");
    let mut problem = Circles::new(1, 0.0, 1);
    problem.points[0].truncate(1);
    let error = minimize(&problem, problem.start(), &Options::default()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "least squares: 2 residuals cannot determine 3 parameters; more measurements are needed"
    );
}
