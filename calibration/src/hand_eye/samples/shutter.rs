//! Corrects detected corners for the motion during the readout of a rolling shutter.

use super::super::Setup;
use crate::{BoardPoint, board_pose};
use kinematics::{Intrinsics, Transform};
use nalgebra::Point3;

/// Motion of the flange while the rows of an image are exposed.
pub struct FlangeMotion<'a> {
    /// Where the camera is mounted.
    pub setup: Setup,
    /// Pose of the flange at mid-exposure.
    pub base_from_flange: Transform,
    /// Pose of the flange when a row is exposed. The argument is the position of the row, from 0
    /// (first row) to 1 (last row).
    pub base_from_flange_at: &'a dyn Fn(f64) -> Transform,
    /// Approximate pose of the camera on the flange (eye in hand) or in the base (eye to hand).
    pub parent_from_camera: Transform,
}

/// Moves the corners in one image of a target to the positions at which a global shutter would see
/// them at mid-exposure.
///
/// The correction is the predicted image motion of each corner between mid-exposure and the
/// exposure of its row. It is small, so approximate intrinsics and an approximate camera pose
/// suffice. Returns the corners unchanged if they do not determine the pose of the target.
pub fn corners_at_mid_exposure(
    intrinsics: &Intrinsics,
    points: &[BoardPoint],
    motion: &FlangeMotion<'_>,
) -> Vec<BoardPoint> {
    let Some(pose) = board_pose(intrinsics, points) else {
        return points.to_vec();
    };
    points
        .iter()
        .map(|point| corrected(intrinsics, &pose.camera_from_board, point, motion))
        .collect()
}

/// One corner at mid-exposure.
fn corrected(
    intrinsics: &Intrinsics,
    camera_from_board: &Transform,
    point: &BoardPoint,
    motion: &FlangeMotion<'_>,
) -> BoardPoint {
    let at_mid = camera_from_board * Point3::from(point.point_in_board);
    // The detected corner was exposed together with the row in which it lies.
    let at_row = motion.row_from_mid(point.pixel[1] / f64::from(intrinsics.size_px[1])) * at_mid;
    let pixels = intrinsics
        .project(&at_mid.coords)
        .zip(intrinsics.project(&at_row.coords));
    let Some((mid, row)) = pixels else {
        return *point;
    };
    // Only the difference of the two predictions is applied, so that errors of the pose cancel.
    BoardPoint {
        pixel: [0, 1].map(|axis| point.pixel[axis] + mid[axis] - row[axis]),
        ..*point
    }
}

impl FlangeMotion<'_> {
    /// Maps a point of the board in the camera frame from mid-exposure to the exposure of a row.
    fn row_from_mid(&self, row_frac: f64) -> Transform {
        let at_row = (self.base_from_flange_at)(row_frac);
        let x = &self.parent_from_camera;
        match self.setup {
            Setup::EyeInHand => (at_row * x).inverse() * self.base_from_flange * x,
            Setup::EyeToHand => x.inverse() * at_row * self.base_from_flange.inverse() * x,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::tests::{self as scene, Scene};
    use super::*;
    use kinematics::{Twist, transform};
    use nalgebra::Vector3;

    #[test]
    fn corrected_corners_are_those_of_a_global_shutter() {
        const READOUT_SECS: f64 = 0.015;
        for setup in [Setup::EyeInHand, Setup::EyeToHand] {
            let scene = Scene::new(setup, 1, 0.4, 3);
            let mid = scene.base_from_flange[0];
            let twist = Twist {
                linear_m_s: Vector3::new(0.05, -0.08, 0.03),
                angular_rad_s: Vector3::new(0.1, 0.05, -0.2),
            };
            let at = |row_frac: f64| mid * transform::exp(&twist, READOUT_SECS * (row_frac - 0.5));
            let intrinsics = scene::intrinsics();
            let pixel = |flange: &Transform, point: &Vector3<f64>| {
                let point = scene.camera_from_board(flange) * Point3::from(*point);
                intrinsics
                    .project(&point.coords)
                    .expect("in front of the camera")
            };
            let height = f64::from(intrinsics.size_px[1]);
            let seen = |point_in_board: Vector3<f64>| {
                // The row in which the moving corner is exposed.
                let row = (0..5).fold(0.5, |row_frac, _| {
                    pixel(&at(row_frac), &point_in_board)[1] / height
                });
                BoardPoint {
                    point_in_board,
                    pixel: pixel(&at(row), &point_in_board),
                }
            };
            let points: Vec<BoardPoint> = scene::board_points().into_iter().map(seen).collect();
            // The pose of the camera is wrong by 2 degrees and 10 mm.
            let wrong = Transform::new(
                Vector3::new(0.006, -0.008, 0.0),
                Vector3::new(0.0, 0.035, 0.0),
            );
            let corrected = |error: Transform| {
                let motion = FlangeMotion {
                    setup,
                    base_from_flange: mid,
                    base_from_flange_at: &at,
                    parent_from_camera: scene.parent_from_camera * error,
                };
                corners_at_mid_exposure(&intrinsics, &points, &motion)
            };
            let largest = |points: &[BoardPoint]| {
                let error = |point: &BoardPoint| {
                    let truth = pixel(&mid, &point.point_in_board);
                    (point.pixel[0] - truth[0]).hypot(point.pixel[1] - truth[1])
                };
                points.iter().map(error).fold(0.0, f64::max)
            };
            let before = largest(&points);
            let [approximate, exact] =
                [wrong, Transform::identity()].map(|error| largest(&corrected(error)));
            assert!(before > 0.5, "{setup:?}: {before} px");
            assert!(
                approximate < 0.1 * before && exact < 0.02 * before,
                "{setup:?}: {approximate} px, {exact} px"
            );
        }
    }
}
