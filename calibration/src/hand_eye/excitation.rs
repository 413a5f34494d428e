//! Whether the rotations of the robot determine all parameters.
//!
//! A rotation about one axis leaves the position along it and the rotation around it undetermined
//! (Tsai and Lenz 1989, section III). Errors of the robot poses are amplified by the reciprocal of
//! the rotation about the second axis.

use super::geometry::Solution;
use super::refusal::Refusal;
use crate::least_squares::sigma_of;
use kinematics::Transform;
use nalgebra::{DMatrix, Matrix3, SymmetricEigen, Vector3};

/// Pose errors may be amplified by at most this factor: the reciprocal of the rotation about the
/// second axis, in radians. Robots whose poses are accurate to 0.1 to 1 mm then give a hand-eye
/// transform that is accurate to 2 to 20 mm.
const MAX_AMPLIFICATION: f64 = 20.0;

/// Recommended rotation about each axis, degrees. Errors of the robot poses are then amplified by a
/// factor of about 3, instead of up to [`MAX_AMPLIFICATION`].
const RECOMMENDED_DEG: f64 = 20.0;

/// Checks that the rotations span at least two directions.
///
/// # Errors
/// Names the only axis of rotation.
pub(crate) fn check_rotations(base_from_flange: &[Transform], body: &str) -> Result<(), Refusal> {
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
                "the {body} hardly rotates (by {:.1} degrees RMS; at least {:.1} degrees around two axes are needed): the hand-eye transform is not observable",
                first.to_degrees(),
                min_rad.to_degrees()
            ),
            format!(
                "rotate the {body} by at least {RECOMMENDED_DEG:.0} degrees around two different axes"
            ),
        ));
    }
    let axis = axes.column(0).into_owned();
    let name = axis_name(&axis, body);
    Err(Refusal {
        why: format!(
            "all rotations are around {name} (within {:.1} degrees RMS; at least {:.1} degrees around a second axis are needed): the position along it and the rotation around it are not observable",
            second.to_degrees(),
            min_rad.to_degrees()
        ),
        axis: Some(axis.into()),
        motion: format!(
            "rotate the {body} by at least {RECOMMENDED_DEG:.0} degrees around {}",
            other_axes(&axis, body)
        ),
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
pub(super) fn rotation_spread(poses: &[Transform]) -> Option<([f64; 3], Matrix3<f64>)> {
    // Rotation vectors relative to the mean rotation are small, so that their covariance describes
    // the spread.
    let sum: Matrix3<f64> = poses
        .iter()
        .map(|pose| pose.rotation.to_rotation_matrix().into_inner())
        .sum();
    let mean = super::closed_form::nearest_rotation(&sum)
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

/// Checks the predicted uncertainty of position and rotation along every direction.
///
/// # Errors
/// Names the direction that is determined worst.
pub(super) fn check_uncertainty(
    covariance: &DMatrix<f64>,
    solution: &Solution,
    max_sigma_m: f64,
    max_sigma_rad: f64,
    camera_in_flange: bool,
) -> Result<(), Refusal> {
    let (sigma_rad, rotation_axis) = worst_direction(covariance, 0);
    let (sigma_m, direction) = worst_direction(covariance, 3);
    // Written so that NaN is refused.
    if sigma_m <= max_sigma_m && sigma_rad <= max_sigma_rad {
        return Ok(());
    }
    let (in_camera, what) = if sigma_m > max_sigma_m {
        let what = format!(
            "the position is uncertain by {:.1} mm (at most {:.1} mm) along",
            1e3 * sigma_m,
            1e3 * max_sigma_m
        );
        (direction, what)
    } else {
        let is = sigma_rad.to_degrees();
        let at_most = max_sigma_rad.to_degrees();
        (
            rotation_axis,
            format!(
                "the rotation is uncertain by {is:.2} degrees (at most {at_most:.2} degrees) around"
            ),
        )
    };
    // People move the flange, so its axes are named if the camera is on it.
    let (axis, body) = if camera_in_flange {
        (solution.x.rotation * in_camera, "flange")
    } else {
        (in_camera, "camera")
    };
    Err(Refusal {
        why: format!("{what} {}", axis_name(&axis, body)),
        axis: camera_in_flange.then(|| axis.into()),
        motion: format!(
            "add poses that rotate the flange by at least {RECOMMENDED_DEG:.0} degrees around {}",
            other_axes(&axis, body)
        ),
    })
}

/// Largest standard deviation in any direction of three parameters, starting with parameter
/// `first`, and this direction.
fn worst_direction(covariance: &DMatrix<f64>, first: usize) -> (f64, Vector3<f64>) {
    let eigen = SymmetricEigen::new(covariance.fixed_view::<3, 3>(first, first).into_owned());
    let ix = eigen.eigenvalues.imax();
    (
        sigma_of(eigen.eigenvalues[ix]),
        eigen.eigenvectors.column(ix).into_owned(),
    )
}

/// Name of an axis: "the flange's z axis", or its components if it is not close to a coordinate
/// axis.
pub(super) fn axis_name(axis: &Vector3<f64>, body: &str) -> String {
    // 15 degrees: a person who moves an arm does not aim more accurately.
    const CLOSE_RAD: f64 = 0.26;
    let largest = axis.iamax();
    if axis[largest].abs() >= CLOSE_RAD.cos() {
        return format!("the {body}'s {} axis", ["x", "y", "z"][largest]);
    }
    // Adding zero turns a negative zero into a positive one.
    let signed = axis.map(|value| (100.0 * value * axis[largest].signum()).round() / 100.0 + 0.0);
    format!(
        "the axis [{:.2}, {:.2}, {:.2}] of the {body}",
        signed.x, signed.y, signed.z
    )
}

/// Names of the axes across an axis.
fn other_axes(axis: &Vector3<f64>, body: &str) -> String {
    let pair = [["y", "z"], ["x", "z"], ["x", "y"]][axis.iamax()];
    format!("its {} or {} axis", pair[0], pair[1]).replace("its", &format!("the {body}'s"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses(axes: &[[f64; 3]]) -> Vec<Transform> {
        axes.iter()
            .map(|axis| Transform::new(Vector3::zeros(), Vector3::from(*axis)))
            .collect()
    }

    #[test]
    fn single_axis_is_named() {
        let refusal = check_rotations(
            &poses(&[[0.0, 0.0, -1.0], [0.01, 0.0, 0.5], [0.0, 0.02, 1.5]]),
            "flange",
        )
        .unwrap_err();
        assert!(
            refusal.why.contains("around the flange's z axis"),
            "{refusal}"
        );
        assert!(
            refusal.motion.contains("the flange's x or y axis"),
            "{refusal}"
        );
        assert!(refusal.axis.unwrap()[2].abs() > 0.99);
        let tilted = check_rotations(
            &poses(&[[0.5, 0.5, 0.0], [0.1, 0.1, 0.0], [-0.4, -0.4, 0.0]]),
            "flange",
        )
        .unwrap_err();
        assert!(tilted.why.contains("[0.71, 0.71, 0.00]"), "{tilted}");
    }

    #[test]
    fn two_axes_are_accepted_and_small_rotations_are_refused() {
        check_rotations(
            &poses(&[[0.3, 0.0, 0.0], [-0.3, 0.3, 0.0], [0.0, -0.3, 0.0]]),
            "flange",
        )
        .unwrap();
        let still = check_rotations(
            &poses(&[[0.01, 0.0, 0.0], [-0.01, 0.01, 0.0], [0.0; 3]]),
            "flange",
        )
        .unwrap_err();
        assert!(
            still.why.contains("hardly rotates") && still.axis.is_none(),
            "{still}"
        );
    }
}
