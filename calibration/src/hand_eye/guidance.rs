//! How far the robot poses so far determine a hand-eye transform, and how to move next, without a
//! calibration.

use super::Setup;
use kinematics::Transform;
use nalgebra::{UnitQuaternion, Vector3};
use std::fmt;

/// Number of poses after which no more are needed, if the rotations suffice.
pub const RECOMMENDED_POSES: usize = 12;
/// Rotation about each axis that the poses should span, degrees: 20 in both directions.
const MIN_SPAN_DEG: f64 = 40.0;
/// Number of poses that are asked for at a time: two in each direction.
const POSES_AT_A_TIME: usize = 4;
/// A pose counts as rotated about an axis from this angle, degrees. It is half of the angle that is
/// asked for, because people rotate an arm by eye.
const ROTATED_DEG: f64 = 10.0;

/// Coverage of the robot poses so far.
#[derive(Clone, Debug, PartialEq)]
pub struct HandEyeGuidance {
    /// Number of poses at which the target was seen.
    pub n_poses: usize,
    /// Range of the rotations about the x, y and z axis, degrees: of the camera (eye in hand) or
    /// the flange.
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
        /// Index of the axis: x, y or z.
        axis: usize,
        /// The body that the axis belongs to: the camera or the flange.
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

/// Difference of the largest and the smallest value; 0 without values.
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

    const QUARTER: f64 = std::f64::consts::FRAC_PI_2;

    fn poses(rotations_deg: &[[f64; 3]]) -> Vec<Transform> {
        let pose = |rotation: &[f64; 3]| {
            Transform::new(
                Vector3::zeros(),
                Vector3::from(*rotation).map(f64::to_radians),
            )
        };
        rotations_deg.iter().map(pose).collect()
    }

    #[test]
    fn axis_without_rotation_is_named() {
        let camera = Transform::new(Vector3::zeros(), Vector3::z() * QUARTER);
        let about_x = poses(&[
            [0.0; 3],
            [25.0, 0.0, 0.0],
            [-25.0, 0.0, 0.0],
            [0.0, 0.0, 25.0],
            [0.0, 0.0, -25.0],
        ]);
        let flange = HandEyeGuidance::new(&about_x, Setup::EyeToHand, &camera);
        assert_eq!(
            flange.advice,
            HandEyeAdvice::Rotate {
                n_poses: 4,
                axis: 1,
                body: "flange"
            }
        );
        // The flange's x axis is the camera's -y axis, so the camera lacks rotations about x.
        let camera = HandEyeGuidance::new(&about_x, Setup::EyeInHand, &camera);
        assert_eq!(
            camera.advice,
            HandEyeAdvice::Rotate {
                n_poses: 4,
                axis: 0,
                body: "camera"
            }
        );
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
