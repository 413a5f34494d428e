//! Selection of the samples that agree with each other, and fits to their corners.

use super::consensus;
use super::corner_fit::{CornerProblem, CornerState, View};
use super::geometry::{N_PARAMS, Solution};
use super::pose_fit::{self, HandEyeNoise, Measurement, PoseFit};
use super::samples::{self, Sample};
use super::{BoardObservation, HandEyeInput, MIN_SAMPLES, Refusal};
use crate::least_squares::Fit;
use crate::{BoardPoint, Error};
use kinematics::Intrinsics;
use nalgebra::Vector6;

/// A fit and the samples that agree with it.
pub(super) struct Stage {
    pub(super) fit: PoseFit,
    /// Noise that determines the weights of the fit.
    pub(super) weighting: HandEyeNoise,
    pub(super) is_inlier: Vec<bool>,
    pub(super) squared_distances: Vec<f64>,
}

/// Alternates between fits and the selection of samples and candidates.
pub(super) fn reject_and_fit(
    input: &HandEyeInput<'_>,
    samples: &[Sample],
    choice: &mut Vec<usize>,
    mut is_inlier: Vec<bool>,
    initial: Solution,
    mut noise: HandEyeNoise,
) -> Result<Stage, Error> {
    /// Squared distance with six degrees of freedom that one good sample in 100 000 exceeds.
    const MAX_SQUARED_DISTANCE: f64 = 33.1;
    // Sets that alternate end here.
    const MAX_ROUNDS: usize = 8;
    let mut solution = initial;
    let mut stage = None;
    for _ in 0..MAX_ROUNDS {
        // If a minority agrees, another group of samples may be the right one.
        let n_used = is_inlier.iter().filter(|is_inlier| **is_inlier).count();
        if 2 * n_used < samples.len() || samples::n_stops(samples, &is_inlier) < MIN_SAMPLES {
            return Err(Error::Refused(Box::new(Refusal::new(
                format!(
                    "only {n_used} of {} samples agree with each other",
                    samples.len()
                ),
                "check that each robot pose belongs to its image and that neither board nor camera was moved",
            ))));
        }
        let measurements = pose_fit::measurements(samples, choice);
        let fit = pose_fit::fit(
            input.setup,
            &select(&measurements, &is_inlier),
            solution,
            noise,
        )?;
        solution = fit.solution;
        noise = fit.noise;
        // All samples are checked again, so that a sample that was excluded by a bad start returns.
        let next_choice = consensus::choose(samples, &solution);
        let measurements = pose_fit::measurements(samples, &next_choice);
        let squared_distances: Vec<f64> = measurements
            .iter()
            .zip(&is_inlier)
            .map(|(measurement, is_used)| {
                pose_fit::squared_distance(input.setup, measurement, &fit, *is_used)
            })
            .collect();
        let next: Vec<bool> = squared_distances
            .iter()
            .map(|squared| *squared <= MAX_SQUARED_DISTANCE)
            .collect();
        let is_settled = next == is_inlier && next_choice == *choice;
        stage = Some(Stage {
            weighting: fit.noise,
            fit,
            is_inlier: is_inlier.clone(),
            squared_distances,
        });
        if is_settled {
            break;
        }
        (is_inlier, *choice) = (next, next_choice);
    }
    stage.ok_or(Error::TooFewResiduals {
        n_residuals: 0,
        n_params: N_PARAMS,
    })
}

/// Corners of a sample in the chosen board frame, without outliers.
pub(super) fn corners(input: &HandEyeInput<'_>, sample: &Sample, choice: usize) -> Vec<BoardPoint> {
    let candidate = &sample.candidates[choice];
    let (BoardObservation::View(view), Some(corners)) =
        (&input.samples[sample.sample_ix].board, &candidate.corners)
    else {
        return Vec::new();
    };
    // All samples must describe the same board, so corners are rotated to the chosen orientation.
    let equivalent_from_board = candidate.board_from_equivalent.inverse();
    view.points
        .iter()
        .zip(&corners.is_inlier)
        .filter(|(_, is_inlier)| **is_inlier)
        .map(|(point, _)| BoardPoint {
            point_in_board: (equivalent_from_board * nalgebra::Point3::from(point.point_in_board))
                .coords,
            pixel: point.pixel,
        })
        .collect()
}

/// Samples, the candidate of each, and the fit to those that agree.
#[derive(Clone, Copy)]
pub(super) struct Selection<'a> {
    pub(super) input: &'a HandEyeInput<'a>,
    pub(super) samples: &'a [Sample],
    pub(super) choice: &'a [usize],
    pub(super) stage: &'a Stage,
}

/// What is estimated besides hand-eye transform and board pose.
#[derive(Clone, Copy)]
pub(super) struct Free {
    pub(super) intrinsics: bool,
    pub(super) joints: bool,
}

/// Minimizes the reprojection error of the selected samples.
///
/// * `offsets`: initial joint offsets; zero if there are none.
pub(super) fn corner_fit(
    selection: Selection<'_>,
    intrinsics: &Intrinsics,
    offsets: &[f64],
    free: Free,
) -> Result<Fit<CornerState>, Error> {
    let Selection {
        input,
        samples,
        choice,
        stage,
    } = selection;
    let used = samples
        .iter()
        .zip(choice)
        .zip(&stage.is_inlier)
        .filter(|(_, is_inlier)| **is_inlier);
    let chain = input.chain.filter(|_| free.joints);
    // Images at one stop share the error of the robot pose: one block of the problem.
    let mut by_stop = std::collections::BTreeMap::<usize, Vec<View>>::new();
    for ((sample, choice), _) in used {
        let given = &input.samples[sample.sample_ix];
        let joints = chain.and(given.joints.clone()).unwrap_or_default();
        let view = View {
            base_from_flange: given.base_from_flange,
            points: corners(input, sample, *choice),
            joints,
        };
        by_stop.entry(sample.stop_ix).or_default().push(view);
    }
    let stops: Vec<Vec<View>> = by_stop.into_values().collect();
    let problem = CornerProblem {
        setup: input.setup,
        stops: &stops,
        noise: stage.weighting,
        n_intrinsics: if free.intrinsics {
            intrinsics.params().len()
        } else {
            0
        },
        chain,
    };
    let n_inner = chain.map_or(0, |chain| chain.n_joints().saturating_sub(2));
    let joint_offsets = if offsets.len() == n_inner {
        offsets.to_vec()
    } else {
        vec![0.0; n_inner]
    };
    let pose_errors = vec![Vector6::zeros(); stops.len()];
    problem.minimize(CornerState {
        solution: stage.fit.solution,
        intrinsics: intrinsics.clone(),
        joint_offsets,
        pose_errors,
    })
}

/// Standard deviation of the corners from the residuals of the single images, pixels. `None` for
/// given poses.
pub(super) fn corner_noise(
    samples: &[Sample],
    choice: &[usize],
    is_inlier: &[bool],
) -> Option<f64> {
    // Exact corners of a simulation.
    const MIN_PX: f64 = 0.003;
    let mut squares = 0.0;
    let mut n_free = 0.0;
    for ((sample, choice), _) in samples
        .iter()
        .zip(choice)
        .zip(is_inlier)
        .filter(|(_, is_inlier)| **is_inlier)
    {
        let corners = sample.candidates[*choice].corners.as_ref()?;
        squares += corners.squares_px2;
        // Two coordinates per corner; six parameters were fitted to each image.
        n_free += 2.0
            * corners
                .is_inlier
                .iter()
                .filter(|is_inlier| **is_inlier)
                .count() as f64
            - 6.0;
    }
    Some((squares / f64::max(n_free, 1.0)).sqrt().max(MIN_PX))
}

/// The selected measurements, weighted such that each stop counts once.
pub(super) fn select(measurements: &[Measurement], is_inlier: &[bool]) -> Vec<Measurement> {
    let selected = measurements
        .iter()
        .zip(is_inlier)
        .filter(|(_, is_inlier)| **is_inlier);
    pose_fit::with_weights(
        selected
            .map(|(measurement, _)| measurement.clone())
            .collect(),
    )
}
