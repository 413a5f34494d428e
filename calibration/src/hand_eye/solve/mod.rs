//! Refinement of the initial solution: outliers, noise and, with corners, the reprojection error.

mod corner_fit;
mod initial;
mod pose_fit;

pub use initial::ClosedForm;
pub(crate) use initial::{Consensus, consensus, motions, relative_scale};
pub use pose_fit::{HandEyeNoise, MAX_FOLDS};
pub(crate) use pose_fit::{Measurement, covariance, held_out_solutions, measurements};

use super::geometry::{self, N_PARAMS, Solution};
use super::samples::{self, Sample, used};
use super::{HandEyeInput, MIN_SAMPLES, Refusal};
use crate::Error;
use crate::least_squares::Fit;
use corner_fit::{CornerState, Free, IntrinsicsDoubt, Start, propagated};
use kinematics::{Intrinsics, Transform};
use nalgebra::DMatrix;
use pose_fit::PoseFit;

/// Result of [`refine`].
#[derive(Clone, Debug)]
pub(crate) struct Refined {
    pub(crate) solution: Solution,
    pub(crate) noise: HandEyeNoise,
    /// Noise that determines the weights of the fit.
    pub(crate) weighting: HandEyeNoise,
    /// Covariance of the parameters of [`Solution::moved`], enlarged for the uncertainty of the
    /// noise.
    pub(crate) covariance: DMatrix<f64>,
    /// All samples with a board pose.
    pub(crate) samples: Vec<Sample>,
    /// Intrinsics that were used or estimated.
    pub(crate) intrinsics: Option<Intrinsics>,
    pub(crate) intrinsics_sigma: Vec<f64>,
    /// Offsets of the inner joints and their standard deviations.
    pub(crate) joint_offsets: Vec<(f64, f64)>,
    /// Why the given intrinsics may be wrong.
    pub(crate) intrinsics_doubt: Option<String>,
}

impl Refined {
    /// The result of a fit that estimates only the hand-eye transform and the board pose.
    fn new(samples: Vec<Sample>, fit: PoseFit, intrinsics: Option<Intrinsics>) -> Self {
        // The noise was estimated with n degrees of freedom, so the errors follow an F distribution
        // instead of a chi squared distribution. The covariance is multiplied by the ratio of the
        // 95 % quantiles of these two distributions, to first order. The F distribution has 6 and n
        // degrees of freedom. The chi squared distribution has 6, and its quantile is divided by 6.
        const CHI_SQUARED_95: f64 = 12.59;
        let enlarged = 1.0 + (CHI_SQUARED_95 - 4.0) / (2.0 * fit.n_free);
        Self {
            solution: fit.solution,
            noise: fit.noise,
            weighting: fit.weighting,
            covariance: fit.covariance * enlarged,
            samples,
            intrinsics,
            intrinsics_sigma: Vec::new(),
            joint_offsets: Vec::new(),
            intrinsics_doubt: None,
        }
    }
}

/// Refines the initial solution on which most samples agree.
///
/// # Errors
/// Returns [`Error::Refused`] if fewer than three samples agree, or fewer than half of all samples.
pub(crate) fn refine(
    input: &HandEyeInput<'_>,
    mut samples: Vec<Sample>,
    consensus: &Consensus,
) -> Result<Refined, Error> {
    // The first fit uses board poses. It estimates the noise and finds the outliers, which would
    // spoil a minimization of reprojection errors.
    consensus.apply_to(&mut samples);
    let start = initial::best_closed_form(&samples).unwrap_or(consensus.solution);
    let corner_px = corner_noise(&samples);
    let noise = pose_fit::initial_noise(&measurements(&samples), &start, corner_px);
    let fit = reject_and_fit(input, &mut samples, start, noise)?;
    let Some(given) = input.intrinsics.clone().filter(|_| corner_px.is_some()) else {
        return Ok(Refined::new(samples, fit, input.intrinsics.clone()));
    };
    // For a board that faces the camera, the pose that fits one image best is biased. Single
    // Gauss-Newton steps from the predicted poses are not biased, so these steps are used to find
    // the outliers again.
    relinearize(input, &mut samples, &fit.solution, &given);
    let fit = reject_and_fit(input, &mut samples, fit.solution, fit.noise)?;
    // The second fit uses the corners of the board.
    if input.options.estimate_intrinsics || input.options.estimate_joint_offsets {
        refine_with_others(input, samples, fit, given)
    } else {
        refine_with_given(input, samples, fit, given)
    }
}

/// Minimizes the reprojection error with the given intrinsics and joints.
fn refine_with_given(
    input: &HandEyeInput<'_>,
    samples: Vec<Sample>,
    fit: PoseFit,
    given: Intrinsics,
) -> Result<Refined, Error> {
    // A fit with free intrinsics shows whether the given intrinsics are right, and how their
    // uncertainty changes the result. With few images, this fit may fail. In that case, both
    // answers are unknown.
    let start = Start {
        input,
        samples: &samples,
        fit: &fit,
        intrinsics: &given,
        joint_offsets: &[],
    };
    let free = start.minimize(Free {
        intrinsics: true,
        joints: false,
    });
    let free = free.ok();
    let lens = input.intrinsics_covariance.as_ref();
    let doubt = free
        .as_ref()
        .and_then(|free| IntrinsicsDoubt::new(start, free, lens));
    let by_lens = free.as_ref().and_then(|free| propagated(free, Some(lens?)));
    let mut fit = minimize_weighted(start)?;
    // The covariance of `doubt` already contains the uncertainty of the given lens parameters,
    // which is `by_lens`. For this reason, `by_lens` is added only if there is no doubt.
    if let Some(doubt) = &doubt {
        fit.covariance += doubt.covariance(&fit.solution);
    } else if let Some(by_lens) = by_lens {
        fit.covariance += by_lens;
    }
    Ok(Refined {
        intrinsics_doubt: doubt.map(|doubt| doubt.warning),
        ..Refined::new(samples, fit, Some(given))
    })
}

/// Minimizes the reprojection error together with intrinsics, joint offsets, or both.
fn refine_with_others(
    input: &HandEyeInput<'_>,
    mut samples: Vec<Sample>,
    mut fit: PoseFit,
    given: Intrinsics,
) -> Result<Refined, Error> {
    let free = minimize_free(input, &mut samples, &mut fit, given)?;
    // The solution is computed with intrinsics and joint offsets fixed at their estimates. The
    // uncertainty of these estimates is then added to the covariance of the solution.
    let intrinsics = free.state.intrinsics.clone();
    let mut fit = minimize_weighted(Start {
        input: &with_offsets(input, &free.state.joint_offsets),
        samples: &samples,
        fit: &fit,
        intrinsics: &intrinsics,
        joint_offsets: &[],
    })?;
    match propagated(&free, None) {
        Some(by_others) => fit.covariance += by_others,
        None => fit.covariance += free.covariance.view((0, 0), (N_PARAMS, N_PARAMS)),
    }
    let is_estimated = input.options.estimate_intrinsics;
    let n_intrinsics = usize::from(is_estimated) * intrinsics.params().len();
    // The order of the shared parameters is: solution, intrinsics, joint offsets.
    let offsets = free.state.joint_offsets.iter().enumerate();
    let offsets = offsets.map(|(ix, offset)| (*offset, free.sigma(N_PARAMS + n_intrinsics + ix)));
    Ok(Refined {
        intrinsics_sigma: (0..n_intrinsics)
            .map(|ix| free.sigma(N_PARAMS + ix))
            .collect(),
        joint_offsets: offsets.collect(),
        ..Refined::new(samples, fit, Some(intrinsics))
    })
}

/// Estimates intrinsics and joint offsets. The variances depend on the poses of the board, and
/// these poses depend on the intrinsics. Variances and intrinsics are therefore estimated
/// alternately.
fn minimize_free(
    input: &HandEyeInput<'_>,
    samples: &mut Vec<Sample>,
    fit: &mut PoseFit,
    given: Intrinsics,
) -> Result<Fit<CornerState>, Error> {
    // The noise determines only the weights, which need not be exact.
    const ROUNDS: usize = 3;
    let parameters = Free {
        intrinsics: input.options.estimate_intrinsics,
        joints: input.options.estimate_joint_offsets,
    };
    let mut intrinsics = given;
    let mut joint_offsets = Vec::new();
    let mut n_rounds = 0;
    loop {
        n_rounds += 1;
        let start = Start {
            input,
            samples,
            fit,
            intrinsics: &intrinsics,
            joint_offsets: &joint_offsets,
        };
        let free = start.minimize(parameters)?;
        intrinsics = free.state.intrinsics.clone();
        joint_offsets.clone_from(&free.state.joint_offsets);
        let corrected = with_offsets(input, &joint_offsets);
        // The poses of the board follow from the corners with the new lens.
        let mut usable = samples::sort(&corrected, Some(&intrinsics)).usable;
        if usable.len() != samples.len() {
            let refusal = Refusal::new(
                "with the estimated intrinsics, some images have no board pose",
                "keep the intrinsics fixed, or add images in which the board covers the corners of the image",
            );
            return Err(refusal.into());
        }
        for (sample, before) in usable.iter_mut().zip(samples.iter()) {
            sample.is_used = before.is_used;
        }
        *samples = usable;
        initial::choose(samples, &free.state.solution);
        // The lens fits better now, so the error of the corners is smaller.
        let noise = HandEyeNoise {
            residual_px: corner_noise(samples),
            ..fit.noise
        };
        *fit = reject_and_fit(&corrected, samples, free.state.solution, noise)?;
        relinearize(&corrected, samples, &fit.solution, &intrinsics);
        if n_rounds == ROUNDS {
            return Ok(free);
        }
    }
}

/// Alternates between fits and the selection of samples and candidates.
fn reject_and_fit(
    input: &HandEyeInput<'_>,
    samples: &mut [Sample],
    mut solution: Solution,
    mut noise: HandEyeNoise,
) -> Result<PoseFit, Error> {
    /// Squared distance with six degrees of freedom. Of 100 000 good samples, about one exceeds
    /// this limit.
    const MAX_SQUARED_DISTANCE: f64 = 33.1;
    // This limit ends the loop if two sets of samples alternate.
    const MAX_ROUNDS: usize = 8;
    let mut n_rounds = 0;
    loop {
        n_rounds += 1;
        // If only a minority agrees, another group of samples may be right.
        let n_used = used(samples).count();
        if 2 * n_used < samples.len() || samples::n_stops(samples) < MIN_SAMPLES {
            let refusal = Refusal::new(
                format!(
                    "only {n_used} of {} samples agree with each other",
                    samples.len()
                ),
                "check that each robot pose belongs to its image and that neither board nor camera was moved",
            );
            return Err(refusal.into());
        }
        let measured = measurements(samples);
        let fit = pose_fit::fit(input.setup, &measured, solution, noise, false)?;
        solution = fit.solution;
        noise = fit.noise;
        // All samples are checked again, so that a sample that was excluded because of a bad start
        // can be used again.
        let mut has_changed = initial::choose(samples, &solution);
        for sample in samples.iter_mut() {
            let measured = Measurement::of(sample);
            sample.squared_distance =
                pose_fit::squared_distance(input.setup, &measured, &fit, sample.is_used);
            has_changed |= sample.is_used != (sample.squared_distance <= MAX_SQUARED_DISTANCE);
        }
        if !has_changed || n_rounds == MAX_ROUNDS {
            return Ok(fit);
        }
        for sample in samples.iter_mut() {
            sample.is_used = sample.squared_distance <= MAX_SQUARED_DISTANCE;
        }
    }
}

/// Standard deviation of the corners from the residuals of the single images, pixels. `None` for
/// given poses.
fn corner_noise(samples: &[Sample]) -> Option<f64> {
    // Lower limit for the exact corners of a simulation.
    const MIN_PX: f64 = 0.003;
    let mut squares = 0.0;
    let mut n_free = 0.0;
    for sample in used(samples) {
        let corners = sample.chosen().corners.as_ref()?;
        squares += corners.squares_px2;
        // Each corner has two coordinates, and six parameters were fitted to each image.
        n_free += 2.0 * corners.n_inliers() as f64 - 6.0;
    }
    Some((squares / f64::max(n_free, 1.0)).sqrt().max(MIN_PX))
}

/// Replaces the board pose of each sample by one Gauss-Newton step from the predicted pose.
fn relinearize(
    input: &HandEyeInput<'_>,
    samples: &mut [Sample],
    solution: &Solution,
    intrinsics: &Intrinsics,
) {
    /// At larger distances, the step may be inaccurate. The limit is three times the limit of
    /// outliers, so that excluded samples can be used again.
    const MAX_SQUARED_DISTANCE: f64 = 100.0;
    let near = samples
        .iter_mut()
        .filter(|sample| sample.squared_distance <= MAX_SQUARED_DISTANCE);
    for sample in near {
        let predicted = solution.camera_from_board(&sample.a);
        let stepped = samples::stepped(&predicted, &sample.corners(input), intrinsics);
        let candidate = &mut sample.candidates[sample.choice];
        if let (Some((pose, covariance)), Some(corners)) = (stepped, &mut candidate.corners) {
            candidate.camera_from_board = pose;
            corners.unit_covariance = covariance;
        }
    }
}

/// Minimizes the reprojection error with the intrinsics and joints of the start, and with the
/// weights that predict held-out images best.
///
/// If the lens model has errors that are common to all images, the estimated robot errors are too
/// large. Weights for smaller robot errors then predict held-out images better. Weights without
/// robot errors minimize the reprojection error alone. The alternatives are compared by the product
/// of three held-out errors: the reprojection error, and the errors of the position and rotation of
/// the board. This product does not depend on units. The covariance follows from the estimated
/// noise in all cases.
fn minimize_weighted(start: Start<'_>) -> Result<PoseFit, Error> {
    const FACTORS: [f64; 5] = [1.0, 0.5, 0.25, 0.1, 0.0];
    let setup = start.input.setup;
    let estimated = start.fit;
    let measured = measurements(start.samples);
    let best = FACTORS
        .into_iter()
        .map(|factor| estimated.noise.with_robot_errors(factor))
        .filter_map(|weighting| Some((held_out_error(start, &measured, weighting)?, weighting)))
        .min_by(|a, b| a.0.total_cmp(&b.0));
    let mut fit = estimated.clone();
    fit.weighting = estimated.noise;
    if let Some((_, weighting)) = best {
        let known = pose_fit::fit(setup, &measured, estimated.solution, weighting, true)?;
        fit.solution = known.solution;
        fit.weighting = weighting;
        // The weights are no longer the inverse of the noise, so the covariance is not simply the
        // inverse of the information.
        if let Some(covariance) = pose_fit::sandwich_covariance(
            setup,
            &measured,
            &fit.solution,
            &weighting,
            &estimated.noise,
        ) {
            fit.covariance = covariance;
        }
    }
    let weighted = Start { fit: &fit, ..start };
    fit.solution = weighted.minimize(Free::NONE)?.state.solution;
    Ok(fit)
}

/// Product of the errors of held-out samples with these weights: reprojection, and position and
/// rotation of the board.
///
/// * `measured`: the used samples.
fn held_out_error(
    start: Start<'_>,
    measured: &[Measurement],
    weighting: HandEyeNoise,
) -> Option<f64> {
    let input = start.input;
    let solution = start.fit.solution;
    let folds = held_out_solutions(input.setup, measured, solution, weighting, true);
    let folds: Vec<Solution> = folds.into_iter().collect::<Option<_>>()?;
    let squares_px2 = used(start.samples).zip(&folds).map(|(sample, solution)| {
        let predicted = solution.camera_from_board(&sample.a);
        geometry::reprojection_squares(&predicted, &sample.corners(input), start.intrinsics)
    });
    let boards: Vec<Transform> = folds
        .iter()
        .zip(measured)
        .map(|(solution, m)| solution.board(&m.a, &m.camera_from_board))
        .collect();
    let scatter = geometry::scatter(&boards)?;
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
