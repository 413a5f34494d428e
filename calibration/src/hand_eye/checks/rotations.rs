//! Checks whether the rotations of the robot determine all parameters, and which rotations are
//! missing.
//!
//! If the robot rotates about only one axis, the position along this axis and the rotation around
//! it remain undetermined (Tsai and Lenz 1989, section III). Errors of the robot poses are
//! amplified by the reciprocal of the rotation about the second axis.

use super::super::geometry::{nearest_rotation, rotation_sum};
use super::super::{Refusal, Setup};
use kinematics::Transform;
use nalgebra::{Matrix3, SymmetricEigen, UnitQuaternion, Vector3};
use std::fmt;

/// Pose errors may be amplified by at most this factor. The amplification is the reciprocal of the
/// rotation about the second axis, in radians. Robots whose poses are accurate to 0.1 to 1 mm then
/// give a hand-eye transform that is accurate to 2 to 20 mm.
const MAX_AMPLIFICATION: f64 = 20.0;

/// Recommended rotation about each axis, degrees. Errors of the robot poses are then amplified by a
/// factor of about 3, instead of up to [`MAX_AMPLIFICATION`].
const RECOMMENDED_DEG: f64 = 20.0;

/// Checks that the rotations span at least two directions.
///
/// # Errors
/// The error names the only axis of rotation.
pub(super) fn check_rotations(base_from_flange: &[Transform]) -> Result<(), Refusal> {
    let Some((spreads, axes)) = rotation_spread(base_from_flange) else {
        return Err(Refusal::new(
            "the rotations have no mean",
            "remove poses that are upside down relative to the others",
        ));
    };
    let [first, second, _] = spreads;
    let min_rad = 1.0 / MAX_AMPLIFICATION;
    if second >= min_rad {
        return Ok(());
    }
    if first < min_rad {
        return Err(Refusal::new(
            format!(
                "the flange hardly rotates (by {:.1} degrees RMS; at least {:.1} degrees around two axes are needed): the hand-eye transform is not observable",
                first.to_degrees(),
                min_rad.to_degrees()
            ),
            format!(
                "rotate the flange by at least {RECOMMENDED_DEG:.0} degrees around two different axes"
            ),
        ));
    }
    let axis = axes.column(0).into_owned();
    let name = axis_name(&axis, "flange");
    Err(Refusal {
        why: format!(
            "all rotations are around {name} (within {:.1} degrees RMS; at least {:.1} degrees around a second axis are needed): the position along it and the rotation around it are not observable",
            second.to_degrees(),
            min_rad.to_degrees()
        ),
        axis: Some(axis.into()),
        motion: format!("rotate {}", rotations_across(&axis, "flange")),
    })
}

/// How far the robot rotated about three orthogonal axes of the flange, the largest rotation first.
#[derive(Clone, Debug, PartialEq)]
pub struct RotationExcitation {
    /// RMS rotations about the axes, radians.
    pub rms_rad: [f64; 3],
    /// The axes in the flange frame, as text.
    pub axes: [String; 3],
    /// Smallest RMS rotation about the second axis that is accepted, radians.
    pub min_rad: f64,
}

impl RotationExcitation {
    /// The rotations of the given flange poses. `None` without poses.
    pub fn of(base_from_flange: &[Transform]) -> Option<Self> {
        let (rms_rad, axes) = rotation_spread(base_from_flange)?;
        let axes = [0, 1, 2].map(|ix| axis_name(&axes.column(ix).into_owned(), "flange"));
        Some(Self {
            rms_rad,
            axes,
            min_rad: 1.0 / MAX_AMPLIFICATION,
        })
    }
}

/// RMS rotations about three orthogonal axes of the body, radians, the largest first, and the axes
/// as columns.
fn rotation_spread(poses: &[Transform]) -> Option<([f64; 3], Matrix3<f64>)> {
    // Rotation vectors relative to the mean rotation are small. Their covariance therefore
    // describes the spread of the rotations.
    let mean = nearest_rotation(&rotation_sum(poses))
        .or_else(|| poses.first().map(|pose| pose.rotation))?;
    let vectors: Vec<Vector3<f64>> = poses
        .iter()
        .map(|pose| (mean.inverse() * pose.rotation).scaled_axis())
        .collect();
    let n = vectors.len() as f64;
    let center = vectors.iter().sum::<Vector3<f64>>() / n;
    let covariance: Matrix3<f64> = vectors
        .iter()
        .map(|vector| (vector - center) * (vector - center).transpose())
        .sum::<Matrix3<f64>>()
        / n;
    if !covariance.iter().all(|value| value.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let spreads = order.map(|ix| eigen.eigenvalues[ix].max(0.0).sqrt());
    Some((
        spreads,
        Matrix3::from_columns(&order.map(|ix| eigen.eigenvectors.column(ix).into_owned())),
    ))
}

/// Name of an axis: "the flange's z axis", or its components if it is not close to a coordinate
/// axis.
pub(crate) fn axis_name(axis: &Vector3<f64>, body: &str) -> String {
    // The limit is 15 degrees. A person who moves an arm by hand does not aim more accurately.
    const CLOSE_RAD: f64 = 0.26;
    let largest = axis.iamax();
    if axis[largest].abs() >= CLOSE_RAD.cos() {
        return format!("the {body}'s {} axis", ["x", "y", "z"][largest]);
    }
    // Adding zero changes a negative zero to a positive zero.
    let signed = axis.map(|value| (100.0 * value * axis[largest].signum()).round() / 100.0 + 0.0);
    format!(
        "the axis [{:.2}, {:.2}, {:.2}] of the {body}",
        signed.x, signed.y, signed.z
    )
}

/// Describes the missing rotations. These are rotations about the axes that are perpendicular to
/// `axis`.
pub(super) fn rotations_across(axis: &Vector3<f64>, body: &str) -> String {
    let [first, second] = [["y", "z"], ["x", "z"], ["x", "y"]][axis.iamax()];
    format!(
        "the flange by at least {RECOMMENDED_DEG:.0} degrees around the {body}'s {first} or {second} axis"
    )
}

/// Recommended number of poses. It is sufficient if the poses also have sufficient rotations.
pub const RECOMMENDED_POSES: usize = 12;
/// Rotation about each axis that the poses should span, degrees. It corresponds to 20 degrees in
/// both directions.
const MIN_SPAN_DEG: f64 = 40.0;
/// Number of poses that are requested at a time. Two poses are rotated in one direction, and two in
/// the opposite direction.
const POSES_AT_A_TIME: usize = 4;
/// A pose counts as rotated about an axis if the angle is at least this, degrees. The limit is half
/// of the requested angle, because people estimate rotations by eye.
const ROTATED_DEG: f64 = 10.0;

/// Coverage of the robot poses so far.
#[derive(Clone, Debug, PartialEq)]
pub struct HandEyeGuidance {
    /// Number of poses at which the target was seen.
    pub n_poses: usize,
    /// Range of the rotations about the x, y and z axis, degrees. With the eye in hand, these axes
    /// are the axes of the camera. With the eye to hand, they are the axes of the flange.
    pub span_deg: [f64; 3],
    /// What to do next.
    pub advice: HandEyeAdvice,
}

/// What to do next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HandEyeAdvice {
    /// Move the arm until the camera sees the whole target.
    ShowTarget,
    /// Add poses that are rotated about an axis.
    Rotate {
        /// Number of poses.
        n_poses: usize,
        /// Index of the axis, from 0 (x) to 2 (z).
        axis: usize,
        /// The body that the axis belongs to, which is the camera or the flange.
        body: &'static str,
    },
    /// Add this many poses in any direction.
    More(usize),
    /// The poses suffice.
    Enough,
}

impl HandEyeGuidance {
    /// Guidance for the flange poses at which the target was seen.
    ///
    /// * `parent_from_camera`: an approximate pose of the camera on the flange, for the axes of the
    ///   camera.
    pub fn new(
        base_from_flange: &[Transform],
        setup: Setup,
        parent_from_camera: &Transform,
    ) -> Self {
        let (body, flange_from_body) = match setup {
            Setup::EyeInHand => ("camera", parent_from_camera.rotation),
            Setup::EyeToHand => ("flange", UnitQuaternion::identity()),
        };
        let rotations: Vec<Vector3<f64>> = rotations(base_from_flange, flange_from_body);
        let span_deg = [0, 1, 2].map(|axis| span(rotations.iter().map(|rotation| rotation[axis])));
        let n_poses = base_from_flange.len();
        let advice = match span_deg
            .into_iter()
            .enumerate()
            .min_by(|a, b| a.1.total_cmp(&b.1))
        {
            _ if n_poses == 0 => HandEyeAdvice::ShowTarget,
            // The axis with the smallest span determines the accuracy.
            Some((axis, span)) if span < MIN_SPAN_DEG => {
                let n_rotated = rotations
                    .iter()
                    .filter(|rotation| rotation[axis].abs() > ROTATED_DEG)
                    .count();
                HandEyeAdvice::Rotate {
                    n_poses: POSES_AT_A_TIME.saturating_sub(n_rotated).max(1),
                    axis,
                    body,
                }
            }
            _ if n_poses < RECOMMENDED_POSES => HandEyeAdvice::More(RECOMMENDED_POSES - n_poses),
            _ => HandEyeAdvice::Enough,
        };
        Self {
            n_poses,
            span_deg,
            advice,
        }
    }
}

/// Rotations relative to the first pose, in the axes of the body, degrees.
fn rotations(
    base_from_flange: &[Transform],
    flange_from_body: UnitQuaternion<f64>,
) -> Vec<Vector3<f64>> {
    let in_base = |pose: &Transform| pose.rotation * flange_from_body;
    let Some(first) = base_from_flange.first().map(in_base) else {
        return Vec::new();
    };
    base_from_flange
        .iter()
        .map(|pose| {
            (first.inverse() * in_base(pose))
                .scaled_axis()
                .map(f64::to_degrees)
        })
        .collect()
}

/// Difference of the largest and the smallest value. It is 0 without values.
fn span(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    if high >= low { high - low } else { 0.0 }
}

/// A number of poses in words.
fn more_poses(n: usize) -> String {
    if n == 1 {
        "one more pose".to_owned()
    } else {
        format!("{n} more poses")
    }
}

impl fmt::Display for HandEyeAdvice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ShowTarget => f.write_str("move the arm until the camera sees the whole target"),
            Self::Rotate {
                n_poses,
                axis,
                body,
            } => {
                let name = ["x", "y", "z"][*axis % 3];
                write!(
                    f,
                    "{}, rotated by 20 degrees or more in both directions about the {body}'s {name} axis",
                    more_poses(*n_poses)
                )
            }
            Self::More(n) => write!(f, "{} in other directions", more_poses(*n)),
            Self::Enough => f.write_str("the poses suffice"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses(rotations_deg: &[[f64; 3]]) -> Vec<Transform> {
        let pose = |rotation: &[f64; 3]| {
            let rotation = Vector3::from(*rotation).map(f64::to_radians);
            Transform::new(Vector3::zeros(), rotation)
        };
        rotations_deg.iter().map(pose).collect()
    }

    #[test]
    fn single_axis_is_named() {
        let about_z = [[0.0, 0.0, -60.0], [0.5, 0.0, 30.0], [0.0, 1.0, 90.0]];
        let refusal = check_rotations(&poses(&about_z)).unwrap_err();
        let named = refusal.why.contains("around the flange's z axis");
        assert!(named, "{refusal}");
        let named = refusal.motion.contains("the flange's x or y axis");
        assert!(named, "{refusal}");
        assert!(refusal.axis.unwrap()[2].abs() > 0.99);
        let tilted = [[30.0, 30.0, 0.0], [6.0, 6.0, 0.0], [-24.0, -24.0, 0.0]];
        let tilted = check_rotations(&poses(&tilted)).unwrap_err();
        assert!(tilted.why.contains("[0.71, 0.71, 0.00]"), "{tilted}");
    }

    #[test]
    fn two_axes_are_accepted_and_small_rotations_are_refused() {
        check_rotations(&poses(&[
            [17.0, 0.0, 0.0],
            [-17.0, 17.0, 0.0],
            [0.0, -17.0, 0.0],
        ]))
        .unwrap();
        let still = [[0.6, 0.0, 0.0], [-0.6, 0.6, 0.0], [0.0; 3]];
        let still = check_rotations(&poses(&still)).unwrap_err();
        assert!(
            still.why.contains("hardly rotates") && still.axis.is_none(),
            "{still}"
        );
    }

    #[test]
    fn axis_without_rotation_is_named() {
        let camera = Transform::new(Vector3::zeros(), Vector3::z() * std::f64::consts::FRAC_PI_2);
        let about_x = poses(&[
            [0.0; 3],
            [25.0, 0.0, 0.0],
            [-25.0, 0.0, 0.0],
            [0.0, 0.0, 25.0],
            [0.0, 0.0, -25.0],
        ]);
        let rotate = |axis: usize, body: &'static str| HandEyeAdvice::Rotate {
            n_poses: 4,
            axis,
            body,
        };
        let flange = HandEyeGuidance::new(&about_x, Setup::EyeToHand, &camera);
        assert_eq!(flange.advice, rotate(1, "flange"));
        // The flange's x axis is the camera's -y axis, so the camera lacks rotations about x.
        let camera = HandEyeGuidance::new(&about_x, Setup::EyeInHand, &camera);
        assert_eq!(camera.advice, rotate(0, "camera"));
        assert!(
            (camera.span_deg[1] - 50.0).abs() < 1e-9 && camera.span_deg[0] < 1e-9,
            "{camera:?}"
        );
        let text = camera.advice.to_string();
        assert!(
            text.starts_with("4 more poses, rotated by 20 degrees or more")
                && text.ends_with("camera's x axis")
        );
    }

    #[test]
    fn enough_rotations_and_poses_end_the_guidance() {
        let identity = Transform::identity();
        assert_eq!(
            HandEyeGuidance::new(&[], Setup::EyeInHand, &identity).advice,
            HandEyeAdvice::ShowTarget
        );
        let mut rotations = vec![[0.0; 3]];
        for axis in 0..3 {
            for angle in [25.0, -25.0] {
                let mut rotation = [0.0; 3];
                rotation[axis] = angle;
                rotations.push(rotation);
            }
        }
        let few = HandEyeGuidance::new(&poses(&rotations), Setup::EyeInHand, &identity);
        assert_eq!(few.advice, HandEyeAdvice::More(RECOMMENDED_POSES - 7));
        rotations.extend([[5.0, 5.0, 0.0]; 5]);
        let enough = HandEyeGuidance::new(&poses(&rotations), Setup::EyeInHand, &identity);
        assert_eq!(enough.advice, HandEyeAdvice::Enough);
    }
}
