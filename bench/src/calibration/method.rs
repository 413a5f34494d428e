//! The compared methods of hand-eye calibration and the outcome of one calibration.

use super::scene::{input, with_board_poses};
use calibration::hand_eye::{
    BoardObservation, ClosedForm, HandEyeCalibration, HandEyeOptions, HandEyeSample,
    calibrate_hand_eye,
};
use kinematics::Transform;
use nalgebra::Vector6;
use serde::Serialize;

/// A method of hand-eye calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Method {
    /// A closed-form solver on board poses.
    ClosedForm(ClosedForm),
    /// [`calibrate_hand_eye`] with board poses.
    Refined,
    /// [`calibrate_hand_eye`] with corners.
    BundleAdjustment,
    /// [`calibrate_hand_eye`] with corners and unknown intrinsics.
    BundleAdjustmentWithLens,
}

impl Method {
    pub(super) const ALL: [Self; 6] = [
        Self::ClosedForm(ClosedForm::ParkMartin),
        Self::ClosedForm(ClosedForm::Daniilidis),
        Self::ClosedForm(ClosedForm::TsaiLenz),
        Self::Refined,
        Self::BundleAdjustment,
        Self::BundleAdjustmentWithLens,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::ClosedForm(ClosedForm::ParkMartin) => "Park-Martin",
            Self::ClosedForm(ClosedForm::Daniilidis) => "Daniilidis",
            Self::ClosedForm(ClosedForm::TsaiLenz) => "Tsai-Lenz",
            Self::Refined => "refined (board poses)",
            Self::BundleAdjustment => "bundle adjustment (corners)",
            Self::BundleAdjustmentWithLens => "bundle adjustment with lens",
        }
    }

    /// Calibrates from corners.
    pub(super) fn calibrate(self, samples: &[HandEyeSample], truth: &Transform) -> Outcome {
        let options = HandEyeOptions {
            estimate_intrinsics: self == Self::BundleAdjustmentWithLens,
            ..HandEyeOptions::default()
        };
        let found = match self {
            Self::ClosedForm(solver) => {
                let pairs: Vec<_> = with_board_poses(samples).iter().filter_map(pair).collect();
                let found = solver.flange_from_camera(&pairs);
                return found.map_or(Outcome::Refused, |found| {
                    Outcome::Solved(Errors::of(&found, truth, None))
                });
            }
            Self::Refined => calibrate_hand_eye(&input(with_board_poses(samples), options)),
            Self::BundleAdjustment | Self::BundleAdjustmentWithLens => {
                calibrate_hand_eye(&input(samples.to_vec(), options))
            }
        };
        match found {
            Ok(found) => {
                let squared = squared_error(&found, truth);
                Outcome::Solved(Errors::of(&found.parent_from_camera, truth, Some(squared)))
            }
            Err(_) => Outcome::Refused,
        }
    }
}

fn pair(sample: &HandEyeSample) -> Option<(Transform, Transform)> {
    match &sample.board {
        BoardObservation::Pose(pose) => Some((sample.base_from_flange, *pose)),
        BoardObservation::View(_) => None,
    }
}

/// Squared Mahalanobis distance of the error. It is below 12.59 in 95 % of correct calibrations.
pub(super) fn squared_error(found: &HandEyeCalibration, truth: &Transform) -> f64 {
    // The error is in the axes of the camera, with the translation first, like the reported
    // covariance.
    let error = found.parent_from_camera.inverse() * truth;
    let t = error.translation.vector;
    let r = error.rotation.scaled_axis();
    let error = Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z);
    found
        .covariance
        .cholesky()
        .map_or(f64::INFINITY, |factor| error.dot(&factor.solve(&error)))
}

/// Result of one calibration.
#[derive(Clone, Copy, Debug)]
pub(super) enum Outcome {
    Solved(Errors),
    Refused,
}

/// Errors of a solved calibration.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Errors {
    pub(super) mm: f64,
    pub(super) deg: f64,
    /// Squared Mahalanobis distance, if the method reports an uncertainty.
    pub(super) squared: Option<f64>,
}

impl Errors {
    pub(super) fn of(found: &Transform, truth: &Transform, squared: Option<f64>) -> Self {
        let error = truth.inverse() * found;
        Self {
            mm: 1e3 * error.translation.vector.norm(),
            deg: error.rotation.angle().to_degrees(),
            squared,
        }
    }

    /// Whether the result failed. This is the case if its error is above 5 mm or 0.5 degrees, or
    /// not finite.
    ///
    /// The limits are far above the noise of all conditions, so that only wrong solutions exceed
    /// them.
    pub(super) fn has_failed(&self) -> bool {
        const MAX_MM: f64 = 5.0;
        const MAX_DEG: f64 = 0.5;
        // A NaN fails both comparisons, and counts as a failure.
        !(self.mm <= MAX_MM && self.deg <= MAX_DEG)
    }
}

impl Outcome {
    pub(super) fn errors(&self) -> Option<Errors> {
        match self {
            Self::Solved(errors) => Some(*errors),
            Self::Refused => None,
        }
    }
}
