//! Continuous-time refinement. Orientations of one stream are interpolated at the times of the
//! other stream.

use super::stream::Stream;
use crate::Error;
use crate::hand_eye::{Refusal, nearest_rotation};
use crate::least_squares::{self, BlockSums, Fit, Loss, sigma_of};
use nalgebra::{DMatrix, DVector, Matrix3, UnitQuaternion, Vector3};

/// Number of parameters without the drift. The parameters are the rotation vectors of the hand-eye
/// and the reference rotation, the offset, and the drift.
const N_WITHOUT_DRIFT: usize = 7;
const OFFSET_IX: usize = 6;
const DRIFT_IX: usize = 7;

/// The estimate, for `secs_a = secs_b + offset_secs + drift * (secs_b - mid_secs)`.
#[derive(Clone, Debug)]
pub(super) struct Fine {
    pub(super) offset_secs: f64,
    pub(super) sigma_secs: f64,
    /// Drift and its standard deviation, seconds per second. `None` if the drift is not
    /// significant.
    pub(super) drift: Option<[f64; 2]>,
    pub(super) mid_secs: f64,
    /// RMS rotation residual, radians.
    pub(super) rms_rad: f64,
    /// Rotation residuals. Each entry is a time in seconds on B's clock and an angle in radians.
    pub(super) residuals: Vec<[f64; 2]>,
    /// Deviation of the residuals per axis from their median, radians.
    pub(super) median_rad: f64,
    /// RMS rotation of B from its mean orientation, radians.
    pub(super) motion_rad: f64,
}

/// Refines an offset.
///
/// * `a`: the stream that is interpolated, which has the higher rate.
///
/// # Errors
/// Fails if the streams do not overlap.
pub(super) fn refine(a: &Stream, b: &Stream, offset_secs: f64) -> Result<Fine, Error> {
    const MIN_SIGMAS: f64 = 3.0;
    // The fit is done first without a drift, and then with a drift. An insignificant drift is not
    // used, because it would only increase the uncertainty of the offset.
    let problem = Orientations::new(a, b, offset_secs)?;
    let initial = problem.initial_state(offset_secs)?;
    let without = problem.fit(initial)?;
    let sigma = problem.sigmas(&without);
    let with = Orientations {
        has_drift: true,
        ..problem.clone()
    };
    let drifting = with.fit(without.state)?;
    let drift_sigmas = with.sigmas(&drifting);
    let drift = drifting.state.drift;
    let is_significant = drift.abs() > MIN_SIGMAS * drift_sigmas[DRIFT_IX];
    let (fit, sigma_secs) = if is_significant {
        (&drifting, drift_sigmas[OFFSET_IX])
    } else {
        (&without, sigma[OFFSET_IX])
    };
    Ok(Fine {
        offset_secs: fit.state.offset_secs,
        sigma_secs,
        drift: is_significant.then_some([drift, drift_sigmas[DRIFT_IX]]),
        mid_secs: problem.mid_secs,
        rms_rad: problem.rms_rad(&fit.state),
        residuals: problem.residuals_over_time(&fit.state),
        median_rad: problem.median_rad(&fit.state),
        motion_rad: problem.motion_rad(),
    })
}

/// Values of all parameters.
#[derive(Clone, Copy, Debug)]
struct State {
    a_body_from_b_body: UnitQuaternion<f64>,
    a_reference_from_b_reference: UnitQuaternion<f64>,
    offset_secs: f64,
    drift: f64,
}

/// Residuals `log((R_a(t) x)^-1 y R_b)` of all poses of B.
#[derive(Clone)]
struct Orientations<'a> {
    a: &'a Stream,
    /// Half of the window in which angular velocities are averaged. Shorter windows amplify the
    /// noise of the poses.
    rate_half_secs: f64,
    times_b: Vec<(f64, UnitQuaternion<f64>)>,
    mid_secs: f64,
    half_secs: f64,
    has_drift: bool,
    /// Standard deviation of the residuals, radians.
    scale_rad: f64,
}

/// Number of consecutive parts of the stream whose errors count as independent.
const N_PARTS: usize = 20;

impl<'a> Orientations<'a> {
    fn new(a: &'a Stream, b: &'a Stream, offset_secs: f64) -> Result<Self, Error> {
        // Poses near the ends could leave the stream when the offset changes.
        let rate_half_secs = a.step_secs().max(b.step_secs());
        let margin = 4.0 * rate_half_secs;
        let is_inside = |secs: f64| {
            let at = secs + offset_secs;
            [at - margin, at, at + margin]
                .iter()
                .all(|secs| a.at_with_rate(*secs, rate_half_secs).is_some())
        };
        let times_b: Vec<(f64, UnitQuaternion<f64>)> = b
            .samples
            .iter()
            .filter(|sample| is_inside(sample.secs))
            .map(|s| (s.secs, s.pose.rotation))
            .collect();
        if times_b.len() < 2 * N_PARTS {
            return Err(Error::Refused(Box::new(Refusal::new(
                format!(
                    "only {} poses of the streams overlap; at least {} are needed",
                    times_b.len(),
                    2 * N_PARTS
                ),
                "record both streams for at least ten seconds at the same time",
            ))));
        }
        let first = times_b[0].0;
        let last = times_b[times_b.len() - 1].0;
        Ok(Self {
            a,
            rate_half_secs,
            times_b,
            // The drift is relative to the middle of the overlap, because the offset at this time
            // is not correlated with the drift.
            mid_secs: 0.5 * (first + last),
            half_secs: 0.5 * (last - first),
            has_drift: false,
            scale_rad: 1.0,
        })
    }

    /// Time on A's clock.
    fn secs_a(&self, secs_b: f64, state: &State) -> f64 {
        secs_b + state.offset_secs + state.drift * (secs_b - self.mid_secs)
    }

    /// Rotations from the correlation of rotation vectors over about half a second (Kabsch 1976).
    fn initial_state(&self, offset_secs: f64) -> Result<State, Error> {
        // The time is long enough for rotations above the noise of the poses, and short enough for
        // rotations of less than half a turn.
        const SPAN_SECS: f64 = 0.5;
        let mut correlation = Matrix3::zeros();
        let mut later_ix = 0;
        for (secs, rotation) in &self.times_b {
            while later_ix < self.times_b.len() && self.times_b[later_ix].0 < secs + SPAN_SECS {
                later_ix += 1;
            }
            let Some((later_secs, later)) = self.times_b.get(later_ix) else {
                break;
            };
            let start = self.a.at(secs + offset_secs);
            let end = self.a.at(later_secs + offset_secs);
            let (Some(start), Some(end)) = (start, end) else {
                continue;
            };
            let in_a = (start.rotation.inverse() * end.rotation).scaled_axis();
            correlation += in_a * (rotation.inverse() * later).scaled_axis().transpose();
        }
        // If all rotations are about one axis, the rotation about that axis is not determined. Any
        // value can then be used as a start.
        let smallest = 1e-6 * correlation.norm().max(f64::MIN_POSITIVE);
        let undetermined = || Error::TimeOffsetInput {
            why: "the rotations of the streams have no mean".to_owned(),
        };
        let rotation = nearest_rotation(&(correlation + Matrix3::identity() * smallest))
            .ok_or_else(undetermined)?;
        // With the rotation between the bodies, each pair of poses gives the rotation between the
        // reference frames.
        let references: Matrix3<f64> = self
            .times_b
            .iter()
            .filter_map(|(secs, in_b)| {
                Some(self.a.at(secs + offset_secs)?.rotation * rotation * in_b.inverse())
            })
            .map(|reference| reference.to_rotation_matrix().into_inner())
            .sum();
        let reference = nearest_rotation(&references).ok_or_else(undetermined)?;
        Ok(State {
            a_body_from_b_body: rotation,
            a_reference_from_b_reference: reference,
            offset_secs,
            drift: 0.0,
        })
    }

    /// Robust fit. The scale of the residuals is estimated in three rounds.
    fn fit(&self, initial: State) -> Result<Fit<State>, Error> {
        const ROUNDS: usize = 4;
        // Lower limit of the scale. It is needed because exact poses of a simulation have no
        // residuals.
        const MIN_SCALE_RAD: f64 = 1e-7;
        let options = least_squares::Options {
            // The threshold is in standard deviations. The Cauchy loss is not convex, but the start
            // is close. Tracking systems report wrong poses, which have too much influence with the
            // Huber loss.
            loss: Loss::Cauchy { threshold: 2.5 },
            max_steps: 40,
            ..least_squares::Options::default()
        };
        let mut problem = self.clone();
        let mut state = initial;
        for _ in 1..ROUNDS {
            problem.scale_rad = self.median_rad(&state).max(MIN_SCALE_RAD);
            state = least_squares::minimize(&problem, state, &options)?.state;
        }
        problem.scale_rad = self.median_rad(&state).max(MIN_SCALE_RAD);
        least_squares::minimize(&problem, state, &options)
    }

    /// See [`Fine::motion_rad`].
    fn motion_rad(&self) -> f64 {
        let sum: Matrix3<f64> = self
            .times_b
            .iter()
            .map(|(_, in_b)| in_b.to_rotation_matrix().into_inner())
            .sum();
        let Some(mean) = nearest_rotation(&sum) else {
            return 0.0;
        };
        let squares = self
            .times_b
            .iter()
            .map(|(_, in_b)| in_b.angle_to(&mean).powi(2))
            .sum::<f64>();
        (squares / self.times_b.len() as f64).sqrt()
    }

    /// Residuals of all poses that are not in a gap of A.
    fn residuals(&self, state: &State) -> impl Iterator<Item = Vector3<f64>> {
        self.times_b
            .iter()
            .filter_map(|(secs, in_b)| self.residual(state, *secs, in_b).map(|found| found.0))
    }

    /// See [`Fine::residuals`].
    fn residuals_over_time(&self, state: &State) -> Vec<[f64; 2]> {
        let residual = |(secs, in_b): &(f64, UnitQuaternion<f64>)| {
            self.residual(state, *secs, in_b)
                .map(|(residual, _)| [*secs, residual.norm()])
        };
        self.times_b.iter().filter_map(residual).collect()
    }

    /// Standard deviation per axis from the median of the norms.
    fn median_rad(&self, state: &State) -> f64 {
        // Median of the norm of three normal numbers with deviation 1.
        const MEDIAN_OF_NORM: f64 = 1.538;
        let norms: Vec<f64> = self
            .residuals(state)
            .map(|residual| residual.norm())
            .collect();
        numbers::quantile::median(&norms).unwrap_or(0.0) / MEDIAN_OF_NORM
    }

    /// Root mean square of the residuals.
    fn rms_rad(&self, state: &State) -> f64 {
        (self
            .residuals(state)
            .map(|residual| residual.norm_squared())
            .sum::<f64>()
            / self.times_b.len() as f64)
            .sqrt()
    }

    /// Residual and its derivatives. `None` where A has a gap.
    fn residual(
        &self,
        state: &State,
        secs_b: f64,
        in_b: &UnitQuaternion<f64>,
    ) -> Option<(Vector3<f64>, Derivatives)> {
        let (pose, rate) = self
            .a
            .at_with_rate(self.secs_a(secs_b, state), self.rate_half_secs)?;
        let x = state.a_body_from_b_body;
        let relative = (pose.rotation * x).inverse() * (state.a_reference_from_b_reference * in_b);
        let residual = relative.scaled_axis();
        // For small residuals, a rotation on the left adds to them.
        let matrix = |rotation: UnitQuaternion<f64>| rotation.to_rotation_matrix().into_inner();
        Some((
            residual,
            Derivatives {
                by_x: -Matrix3::identity(),
                by_y: matrix(relative) * matrix(in_b.inverse()),
                by_offset: -(x.inverse() * rate),
            },
        ))
    }

    /// Standard deviations that allow for errors that are correlated in time. Only the gradients of
    /// consecutive parts of the stream count as independent (Liang and Zeger 1986).
    fn sigmas(&self, fit: &Fit<State>) -> Vec<f64> {
        let n = fit.information.nrows();
        let scale = self.median_rad(&fit.state).max(1e-7);
        let per_part = self.times_b.len().div_ceil(N_PARTS);
        let mut scatter = DMatrix::zeros(n, n);
        let mut n_parts: f64 = 0.0;
        let mut information = DMatrix::zeros(n, n);
        for part in self.times_b.chunks(per_part) {
            let mut gradient = DVector::zeros(n);
            for (secs, in_b) in part {
                let Some((residual, derivatives)) = self.residual(&fit.state, *secs, in_b) else {
                    continue;
                };
                let rows = derivatives.rows(self.has_drift, secs - self.mid_secs);
                // The weight of the Cauchy loss of `fit`.
                let ratio = residual.norm_squared() / (2.5 * scale).powi(2);
                let weight = 1.0 / (1.0 + ratio);
                for (axis, row) in rows.iter().enumerate() {
                    let row = DVector::from_column_slice(row);
                    information.ger(weight, &row, &row, 1.0);
                    gradient.axpy(weight * residual[axis], &row, 1.0);
                }
            }
            scatter.ger(1.0, &gradient, &gradient, 1.0);
            n_parts += 1.0;
        }
        let Some(inverse) = information.try_inverse() else {
            return vec![f64::INFINITY; n];
        };
        // Correction for the parameters that the parts share.
        let correction = n_parts / (n_parts - 1.0 - 0.5 * n as f64).max(1.0);
        let covariance = &inverse * (scatter * correction) * &inverse;
        (0..n).map(|ix| sigma_of(covariance[(ix, ix)])).collect()
    }
}

/// Derivatives of a residual with respect to both rotations and the offset.
struct Derivatives {
    by_x: Matrix3<f64>,
    by_y: Matrix3<f64>,
    by_offset: Vector3<f64>,
}

impl Derivatives {
    fn rows(&self, has_drift: bool, secs_from_mid: f64) -> [Vec<f64>; 3] {
        [0, 1, 2].map(|axis| {
            let mut row: Vec<f64> = self
                .by_x
                .row(axis)
                .iter()
                .chain(self.by_y.row(axis).iter())
                .copied()
                .collect();
            row.push(self.by_offset[axis]);
            if has_drift {
                row.push(self.by_offset[axis] * secs_from_mid);
            }
            row
        })
    }
}

impl least_squares::Problem for Orientations<'_> {
    type State = State;

    fn scales(&self) -> DVector<f64> {
        let mut scales = vec![1.0; N_WITHOUT_DRIFT];
        if self.has_drift {
            scales.push(1.0 / self.half_secs);
        }
        DVector::from_vec(scales)
    }

    fn n_blocks(&self) -> usize {
        1
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        0
    }

    fn evaluate(&self, state: &State, _block_ix: usize, sums: &mut BlockSums) -> Option<()> {
        for (secs, in_b) in &self.times_b {
            // A step that moves a pose into a gap is rejected.
            let (residual, derivatives) = self.residual(state, *secs, in_b)?;
            let residual = residual / self.scale_rad;
            let rows = derivatives
                .rows(self.has_drift, secs - self.mid_secs)
                .map(|row| {
                    row.iter()
                        .map(|value| value / self.scale_rad)
                        .collect::<Vec<f64>>()
                });
            sums.add(
                residual.into(),
                [rows[0].as_slice(), rows[1].as_slice(), rows[2].as_slice()],
            );
        }
        Some(())
    }

    fn moved(&self, state: &State, shared: &DVector<f64>, _local: &[DVector<f64>]) -> State {
        let rotation = |first: usize| {
            let vector = shared.fixed_rows::<3>(first).into_owned();
            UnitQuaternion::from_scaled_axis(vector)
        };
        State {
            a_body_from_b_body: state.a_body_from_b_body * rotation(0),
            a_reference_from_b_reference: state.a_reference_from_b_reference * rotation(3),
            offset_secs: state.offset_secs + shared[OFFSET_IX],
            drift: state.drift
                + if self.has_drift {
                    shared[DRIFT_IX]
                } else {
                    0.0
                },
        }
    }
}
