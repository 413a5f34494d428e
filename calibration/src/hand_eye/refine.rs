//! Refinement of the initial solution: outliers, noise and, with corners, the reprojection error.

use super::closed_form::ClosedForm;
use super::consensus::{self, Consensus};
use super::corner_fit::{self, CornerState};
use super::evaluation;
use super::geometry::{self, N_PARAMS, Solution};
use super::intrinsics_doubt::IntrinsicsDoubt;
use super::planar_pose;
use super::pose_fit::{self, HandEyeNoise, Measurement, PoseFit};
use super::propagation::propagated;
use super::samples::{self, Sample};
use super::selection::{
    Free, Selection, Stage, corner_fit, corner_noise, corners, reject_and_fit, select,
};
use super::{HandEyeInput, Refusal};
use crate::Error;
use crate::least_squares::Fit;
use kinematics::{Intrinsics, Transform};
use nalgebra::{DMatrix, Vector6};

/// Result of [`refine`].
#[derive(Clone, Debug)]
pub(super) struct Refined {
    pub(super) solution: Solution,
    pub(super) noise: HandEyeNoise,
    /// Noise that determines the weights of the fit.
    pub(super) weighting: HandEyeNoise,
    /// Covariance of the parameters of [`Solution::moved`], enlarged for the uncertainty of the
    /// noise.
    pub(super) covariance: DMatrix<f64>,
    /// All samples with a board pose, and the candidate of each.
    pub(super) samples: Vec<Sample>,
    pub(super) choice: Vec<usize>,
    pub(super) is_inlier: Vec<bool>,
    /// Per sample: squared Mahalanobis distance, six degrees of freedom.
    pub(super) squared_distances: Vec<f64>,
    pub(super) closed_form: ClosedForm,
    /// Intrinsics that were used or estimated.
    pub(super) intrinsics: Option<Intrinsics>,
    pub(super) intrinsics_sigma: Vec<f64>,
    /// Offsets of the inner joints and their standard deviations.
    pub(super) joint_offsets: Vec<(f64, f64)>,
    /// Why the given intrinsics may be wrong.
    pub(super) intrinsics_doubt: Option<String>,
}

impl Refined {
    /// Samples that agree with the solution.
    pub(super) fn used(&self) -> impl Iterator<Item = &Sample> {
        self.samples
            .iter()
            .zip(&self.is_inlier)
            .filter(|(_, is_inlier)| **is_inlier)
            .map(|(sample, _)| sample)
    }

    /// Measurements of the samples that agree.
    pub(super) fn measurements(&self) -> Vec<Measurement> {
        select(
            &pose_fit::measurements(&self.samples, &self.choice),
            &self.is_inlier,
        )
    }
}

/// Samples, the candidate of each, and the fit so far.
struct Progress {
    samples: Vec<Sample>,
    choice: Vec<usize>,
    stage: Stage,
    closed_form: ClosedForm,
}

/// Refines a consensus.
///
/// # Errors
/// [`Error::Refused`] if fewer than three samples, or less than half of them, agree.
pub(super) fn refine(
    input: &HandEyeInput<'_>,
    mut samples: Vec<Sample>,
    consensus: Consensus,
) -> Result<Refined, Error> {
    // First from board poses: this estimates the noise and finds the outliers, which the
    // minimization of reprojection errors would not tolerate.
    let is_inlier = consensus.is_inlier();
    let mut choice = consensus.choice;
    let chosen = select(&pose_fit::measurements(&samples, &choice), &is_inlier);
    let (closed_form, initial) = best_closed_form(&chosen, consensus.solution);
    let corner_px = corner_noise(&samples, &choice, &is_inlier);
    let noise = pose_fit::initial_noise(&chosen, &initial, corner_px);
    let mut stage = reject_and_fit(input, &samples, &mut choice, is_inlier, initial, noise)?;

    let Some(given) = input.intrinsics.clone().filter(|_| corner_px.is_some()) else {
        let progress = Progress {
            samples,
            choice,
            stage,
            closed_form,
        };
        return Ok(progress.finish(input.intrinsics.clone()));
    };
    // The pose that fits one image best is biased for a board that faces the camera. Steps from the
    // predicted poses are not, so outliers are searched again with them.
    relinearize(input, &mut samples, &choice, &stage, &given);
    let solution = stage.fit.solution;
    let noise = stage.fit.noise;
    stage = reject_and_fit(
        input,
        &samples,
        &mut choice,
        stage.is_inlier,
        solution,
        noise,
    )?;
    // Then from corners.
    let progress = Progress {
        samples,
        choice,
        stage,
        closed_form,
    };
    if input.options.estimate_intrinsics || input.options.estimate_joint_offsets {
        progress.refine_with_others(input, given)
    } else {
        progress.refine_with_given(input, given)
    }
}

impl Progress {
    fn selection<'a>(&'a self, input: &'a HandEyeInput<'a>) -> Selection<'a> {
        Selection {
            input,
            samples: &self.samples,
            choice: &self.choice,
            stage: &self.stage,
        }
    }

    /// Minimizes the reprojection error with the given intrinsics and joints.
    fn refine_with_given(
        mut self,
        input: &HandEyeInput<'_>,
        given: Intrinsics,
    ) -> Result<Refined, Error> {
        // A fit with free intrinsics shows whether the given ones are right, and how their
        // uncertainty changes the result. It may fail for few images; then nothing is known.
        let selection = self.selection(input);
        let lens = input.intrinsics_covariance.as_ref();
        let free = corner_fit(
            selection,
            &given,
            &[],
            Free {
                intrinsics: true,
                joints: false,
            },
        )
        .ok();
        let doubt = free
            .as_ref()
            .and_then(|free| IntrinsicsDoubt::new(selection, &given, free, lens));
        let by_lens = free.as_ref().and_then(|free| propagated(free, Some(lens?)));
        (self.stage.fit, self.stage.weighting) = choose_weights(self.selection(input), &given)?;
        self.stage.fit.solution = minimize_corners(self.selection(input), &given)?;
        // The doubt contains the effect of the lens, so only one of both is added.
        if let Some(doubt) = &doubt {
            self.stage.fit.covariance += doubt.covariance(&self.stage.fit.solution);
        } else if let Some(by_lens) = by_lens {
            self.stage.fit.covariance += by_lens;
        }
        let mut refined = self.finish(Some(given));
        refined.intrinsics_doubt = doubt.map(|doubt| doubt.warning);
        Ok(refined)
    }

    /// Minimizes the reprojection error together with intrinsics, joint offsets, or both.
    fn refine_with_others(
        mut self,
        input: &HandEyeInput<'_>,
        given: Intrinsics,
    ) -> Result<Refined, Error> {
        let free = minimize_free(
            input,
            &mut self.samples,
            &mut self.choice,
            &mut self.stage,
            given,
        )?;
        // With the estimates of the others fixed, the solution is found as with given ones. Their
        // uncertainty is added to its covariance.
        let corrected = with_offsets(input, &free.state.joint_offsets);
        let intrinsics = free.state.intrinsics.clone();
        (self.stage.fit, self.stage.weighting) =
            choose_weights(self.selection(&corrected), &intrinsics)?;
        self.stage.fit.solution = minimize_corners(self.selection(&corrected), &intrinsics)?;
        match propagated(&free, None) {
            Some(by_others) => self.stage.fit.covariance += by_others,
            None => self.stage.fit.covariance += free.covariance.view((0, 0), (N_PARAMS, N_PARAMS)),
        }
        let n_intrinsics = if input.options.estimate_intrinsics {
            intrinsics.params().len()
        } else {
            0
        };
        let mut refined = self.finish(Some(intrinsics));
        // Order of the shared parameters: solution, intrinsics, joint offsets.
        refined.intrinsics_sigma = (0..n_intrinsics)
            .map(|ix| free.sigma(N_PARAMS + ix))
            .collect();
        let offsets = free.state.joint_offsets.iter().enumerate();
        refined.joint_offsets = offsets
            .map(|(ix, offset)| (*offset, free.sigma(N_PARAMS + n_intrinsics + ix)))
            .collect();
        Ok(refined)
    }

    /// The result, without standard deviations of other parameters and without doubts.
    fn finish(self, intrinsics: Option<Intrinsics>) -> Refined {
        // The 95 % quantile of F with 6 and n degrees of freedom relative to that of chi squared /
        // 6, to first order.
        const CHI_SQUARED_95: f64 = 12.59;
        let Self {
            samples,
            choice,
            stage,
            closed_form,
        } = self;
        let enlarged = 1.0 + (CHI_SQUARED_95 - 4.0) / (2.0 * stage.fit.n_free);
        Refined {
            solution: stage.fit.solution,
            noise: stage.fit.noise,
            weighting: stage.weighting,
            covariance: stage.fit.covariance * enlarged,
            samples,
            choice,
            is_inlier: stage.is_inlier,
            squared_distances: stage.squared_distances,
            closed_form,
            intrinsics,
            intrinsics_sigma: Vec::new(),
            joint_offsets: Vec::new(),
            intrinsics_doubt: None,
        }
    }
}

/// Estimates intrinsics and joint offsets. The variances depend on the poses of the board, and
/// those on the intrinsics, so both are estimated in turns.
fn minimize_free(
    input: &HandEyeInput<'_>,
    samples: &mut Vec<Sample>,
    choice: &mut Vec<usize>,
    stage: &mut Stage,
    given: Intrinsics,
) -> Result<Fit<CornerState>, Error> {
    // The noise determines only the weights, which need not be exact.
    const ROUNDS: usize = 3;
    let mut intrinsics = given;
    let mut offsets = Vec::new();
    for round in 0.. {
        let free = Free {
            intrinsics: input.options.estimate_intrinsics,
            joints: input.options.estimate_joint_offsets,
        };
        let fit = corner_fit(
            Selection {
                input,
                samples,
                choice,
                stage,
            },
            &intrinsics,
            &offsets,
            free,
        )?;
        stage.fit.solution = fit.state.solution;
        intrinsics = fit.state.intrinsics.clone();
        offsets.clone_from(&fit.state.joint_offsets);
        let corrected = with_offsets(input, &offsets);
        // The poses of the board follow from the corners with the new lens.
        let usable = samples::samples(&corrected, Some(&intrinsics)).usable;
        if usable.len() != samples.len() {
            return Err(Error::Refused(Box::new(Refusal::new(
                "with the estimated intrinsics, some images have no board pose",
                "keep the intrinsics fixed, or add images in which the board covers the corners of the image",
            ))));
        }
        *samples = usable;
        *choice = consensus::choose(samples, &stage.fit.solution);
        // The lens fits better now, so the error of the corners is smaller.
        let noise = HandEyeNoise {
            residual_px: corner_noise(samples, choice, &stage.is_inlier),
            ..stage.fit.noise
        };
        *stage = reject_and_fit(
            &corrected,
            samples,
            choice,
            stage.is_inlier.clone(),
            stage.fit.solution,
            noise,
        )?;
        relinearize(&corrected, samples, choice, stage, &intrinsics);
        if round + 1 == ROUNDS {
            return Ok(fit);
        }
    }
    unreachable!("the loop returns in its last round")
}

/// Minimizes the reprojection error with the chosen noise model.
fn minimize_corners(selection: Selection<'_>, intrinsics: &Intrinsics) -> Result<Solution, Error> {
    let fixed = Free {
        intrinsics: false,
        joints: false,
    };
    Ok(corner_fit(selection, intrinsics, &[], fixed)?
        .state
        .solution)
}

/// Replaces the poses of the samples by steps from the predicted ones.
fn relinearize(
    input: &HandEyeInput<'_>,
    samples: &mut [Sample],
    choice: &[usize],
    stage: &Stage,
    intrinsics: &Intrinsics,
) {
    /// Beyond, the step may not be accurate. It is three times the limit of outliers, so that
    /// excluded samples can return.
    const MAX_SQUARED_DISTANCE: f64 = 100.0;
    for ix in 0..samples.len() {
        if stage.squared_distances[ix] > MAX_SQUARED_DISTANCE {
            continue;
        }
        let points = corners(input, &samples[ix], choice[ix]);
        let predicted = predicted(&stage.fit.solution, &samples[ix]);
        let candidate = &mut samples[ix].candidates[choice[ix]];
        if let (Some((pose, covariance)), Some(corners)) = (
            planar_pose::stepped(&predicted, &points, intrinsics),
            &mut candidate.corners,
        ) {
            candidate.camera_from_board = pose;
            corners.unit_covariance = covariance;
        }
    }
}

/// Chooses how far the weights allow for errors of the robot.
///
/// Errors of the lens model that are common to all images look like errors of the robot. Then
/// smaller robot errors predict held-out images better; without any, the fit minimizes the
/// reprojection error. The alternatives are compared by the product of three held-out errors, which
/// does not depend on units: reprojection, position of the board, and its rotation. The covariance
/// follows from the estimated noise in all cases.
fn choose_weights(
    selection: Selection<'_>,
    intrinsics: &Intrinsics,
) -> Result<(PoseFit, HandEyeNoise), Error> {
    const FACTORS: [f64; 5] = [1.0, 0.5, 0.25, 0.1, 0.0];
    let Selection {
        input,
        samples,
        choice,
        stage,
    } = selection;
    let estimated = &stage.fit;
    let measurements = select(&pose_fit::measurements(samples, choice), &stage.is_inlier);
    let best = FACTORS
        .into_iter()
        .map(|factor| estimated.noise.with_robot_errors(factor))
        .filter_map(|weighting| {
            let error = held_out_error(selection, &measurements, intrinsics, weighting)?;
            Some((error, weighting))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, weighting)) = best else {
        return Ok((estimated.clone(), estimated.noise));
    };
    let solution =
        pose_fit::fit_with_known_noise(input.setup, &measurements, estimated.solution, weighting)?
            .solution;
    // The weights are no longer the inverse of the noise, so the covariance is not simply the
    // inverse of the information.
    let covariance = pose_fit::sandwich_covariance(
        input.setup,
        &measurements,
        &solution,
        &weighting,
        &estimated.noise,
    )
    .unwrap_or_else(|| estimated.covariance.clone());
    Ok((
        PoseFit {
            solution,
            covariance,
            ..*estimated
        },
        weighting,
    ))
}

/// Product of the errors of held-out samples with these weights: reprojection, and position and
/// rotation of the board.
///
/// * `measurements`: those of the samples that agree.
fn held_out_error(
    selection: Selection<'_>,
    measurements: &[Measurement],
    intrinsics: &Intrinsics,
    weighting: HandEyeNoise,
) -> Option<f64> {
    let Selection {
        input,
        samples,
        choice,
        stage,
    } = selection;
    let folds = evaluation::held_out_solutions(
        input.setup,
        measurements,
        stage.fit.solution,
        weighting,
        true,
    );
    let folds: Vec<Solution> = folds.into_iter().collect::<Option<_>>()?;
    let used = samples
        .iter()
        .zip(choice)
        .zip(&stage.is_inlier)
        .filter(|(_, is_inlier)| **is_inlier);
    let squares_px2 = used.zip(&folds).map(|(((sample, choice), _), solution)| {
        let points = corners(input, sample, *choice);
        evaluation::reprojection_squares(&predicted(solution, sample), &points, intrinsics)
    });
    let boards: Vec<Transform> = folds
        .iter()
        .zip(measurements)
        .map(|(solution, m)| board_in_parent(solution, m))
        .collect();
    let scatter = evaluation::scatter(&boards)?;
    Some(squares_px2.sum::<f64>().sqrt() * scatter.mm * scatter.deg)
}

/// The input with corrected joints applied to the robot poses.
fn with_offsets<'a>(input: &HandEyeInput<'a>, offsets: &[f64]) -> HandEyeInput<'a> {
    let mut corrected = input.clone();
    let Some(chain) = input.chain.filter(|_| !offsets.is_empty()) else {
        return corrected;
    };
    for sample in &mut corrected.samples {
        let Some(joints) = &sample.joints else {
            continue;
        };
        let forward = |joints: &[f64]| chain.forward(joints).ok();
        let moved = corner_fit::corrected_joints(joints, offsets);
        if let (Some(before), Some(after)) = (forward(joints), forward(&moved)) {
            sample.base_from_flange = after * before.inverse() * sample.base_from_flange;
        }
    }
    corrected
}

/// The closed form with the smallest leave-one-out scatter, and its solution.
fn best_closed_form(measurements: &[Measurement], fallback: Solution) -> (ClosedForm, Solution) {
    let pairs: Vec<(Transform, Transform)> = measurements
        .iter()
        .map(|m| (m.a, m.camera_from_board))
        .collect();
    ClosedForm::ALL
        .into_iter()
        .filter_map(|solver| {
            let error_mm = leave_one_out_mm(&pairs, solver)?;
            Some((error_mm, solver, consensus::solve(&pairs, solver)?))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map_or(
            (ClosedForm::ParkMartin, fallback),
            |(_, solver, solution)| (solver, solution),
        )
}

/// Scatter of the positions of the board, each from a closed form without this pair, millimeters.
fn leave_one_out_mm(pairs: &[(Transform, Transform)], solver: ClosedForm) -> Option<f64> {
    /// Enough to rank three solvers; each one solves for all pairs of the others.
    const MAX_FOLDS: usize = 20;
    let stride = pairs.len().div_ceil(MAX_FOLDS).max(1);
    let boards: Option<Vec<Transform>> = (0..pairs.len())
        .step_by(stride)
        .map(|left_out| {
            let mut others = pairs.to_vec();
            let (a, camera_from_board) = others.remove(left_out);
            Some(a * consensus::solve(&others, solver)?.x * camera_from_board)
        })
        .collect();
    Some(evaluation::scatter(&boards?)?.mm)
}

/// Pose of the board in the base or on the flange according to one measurement.
pub(super) fn board_in_parent(solution: &Solution, measurement: &Measurement) -> Transform {
    measurement.a * solution.x * measurement.camera_from_board
}

/// Predicted pose of the board.
pub(super) fn predicted(solution: &Solution, sample: &Sample) -> Transform {
    solution.camera_from_board(&sample.a)
}

/// Residual of a sample: rotation in radians and translation in meters.
pub(super) fn sample_residual(solution: &Solution, sample: &Sample, choice: usize) -> Vector6<f64> {
    geometry::residual(
        &predicted(solution, sample),
        &sample.candidates[choice].camera_from_board,
    )
}
