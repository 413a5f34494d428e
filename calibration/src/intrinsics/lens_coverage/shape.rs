//! How a target appears in an image: where, how large, and how tilted.

use super::super::board_pose::board_pose;
use super::goals::Side;
use crate::BoardView;
use kinematics::Intrinsics;
use nalgebra::{Matrix2, Vector2, Vector3};

/// Two photographs differ if the target has moved by this fraction of the width of the image, if
/// its tilt has changed by this angle, or if its size has changed by this factor. With smaller
/// limits, the trembling of a hand would count as another photograph.
const MIN_SHIFT_FRAC: f64 = 0.06;
const MIN_TILT_CHANGE_DEG: f64 = 8.0;
const MIN_SIZE_RATIO: f64 = 1.12;

/// The appearance of a target in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ViewShape {
    /// Mean of the corners, as a fraction of the width of the image.
    center_frac: Vector2<f64>,
    /// Square root of the fraction of the image that the corners span.
    pub(super) span_frac: f64,
    /// Rotation of the target about the x and the y axis of the camera, degrees. It is zero if the
    /// target is parallel to the image, or if its pose is not determined.
    tilt_deg: [f64; 2],
}

impl ViewShape {
    pub(super) fn of(view: &BoardView, intrinsics: &Intrinsics) -> Self {
        let [width, height] = intrinsics.size_px.map(f64::from);
        let n = view.points.len().max(1) as f64;
        let pixels = || view.points.iter().map(|point| Vector2::from(point.pixel));
        let center = pixels().sum::<Vector2<f64>>() / n;
        let covariance = pixels()
            .map(|pixel| (pixel - center) * (pixel - center).transpose())
            .sum::<Matrix2<f64>>()
            / n;
        // The variance of points that fill an interval evenly is the square of its length divided
        // by 12. Unlike the area of a box around the corners, this area does not depend on the
        // rotation.
        let area_px2 = 12.0 * covariance.determinant().max(0.0).sqrt();
        Self {
            center_frac: center / width,
            span_frac: (area_px2 / (width * height)).sqrt(),
            tilt_deg: tilt_deg(view, intrinsics).unwrap_or_default(),
        }
    }

    /// Angle by which a side of the target is turned away from the camera, degrees.
    pub(super) fn tilt_away_deg(&self, side: Side) -> f64 {
        let [about_x, about_y] = self.tilt_deg;
        match side {
            Side::Left => about_y,
            Side::Right => -about_y,
            Side::Upper => -about_x,
            Side::Lower => about_x,
        }
    }

    /// Whether the target appears differently in two photographs.
    pub(super) fn differs_from(&self, other: &Self) -> bool {
        let shift_frac = (self.center_frac - other.center_frac).norm();
        let tilt_change = Vector2::from(self.tilt_deg) - Vector2::from(other.tilt_deg);
        let ratio = self.span_frac / other.span_frac;
        shift_frac >= MIN_SHIFT_FRAC
            || tilt_change.norm() >= MIN_TILT_CHANGE_DEG
            || ratio.max(1.0 / ratio) >= MIN_SIZE_RATIO
    }
}

/// Rotation of the target about the x and the y axis of the camera, degrees. It is zero if the
/// target is parallel to the image. With a positive angle about y, the left side is farther away.
/// With a positive angle about x, the lower side is farther away.
///
/// The angle is relative to the optical axis and not to the line of sight, because parallel targets
/// add no constraints, wherever they are in the image.
fn tilt_deg(view: &BoardView, intrinsics: &Intrinsics) -> Option<[f64; 2]> {
    let pose = board_pose(intrinsics, &view.points)?.camera_from_board;
    let center = view
        .points
        .iter()
        .map(|point| point.point_in_board)
        .sum::<Vector3<f64>>()
        / view.points.len() as f64;
    let sight = (pose * nalgebra::Point3::from(center))
        .coords
        .try_normalize(0.0)?;
    // A numbering of the points may be mirrored, so the normal may point to either side.
    let normal = pose.rotation * Vector3::z();
    let normal = if normal.dot(&sight) < 0.0 {
        -normal
    } else {
        normal
    };
    let tilt = Vector3::z().cross(&normal);
    let angle = tilt.norm().clamp(0.0, 1.0).asin().to_degrees();
    let axis = tilt.try_normalize(0.0).unwrap_or_default();
    Some([angle * axis.x, angle * axis.y])
}

#[cfg(test)]
mod tests {
    use super::super::tests::{camera, view};
    use super::*;

    #[test]
    fn tilts_have_the_signs_of_their_sides() {
        // A positive rotation about y moves the left side (negative x) to larger z: z' = -x
        // sin(angle).
        let left = view([0.0, 0.0, 0.5], [0.0, 30.0, 0.0]);
        let [about_x, about_y] = tilt_deg(&left, &camera()).expect("a pose");
        assert!(
            about_x.abs() < 0.1 && (about_y - 30.0).abs() < 0.1,
            "{about_x} {about_y}"
        );
        let height_px = |is_left: bool| {
            let ys: Vec<f64> = left
                .points
                .iter()
                .filter(|point| point.point_in_board.x.abs() > 0.09)
                .filter(|point| (point.point_in_board.x < 0.0) == is_left)
                .map(|point| point.pixel[1])
                .collect();
            ys.iter().fold(f64::MIN, |a, b| a.max(*b)) - ys.iter().fold(f64::MAX, |a, b| a.min(*b))
        };
        assert!(
            height_px(true) < height_px(false),
            "the left side looks smaller"
        );
    }

    #[test]
    fn the_span_does_not_depend_on_the_rotation_in_the_image() {
        const CLOSE: f64 = 0.01;
        let [upright, rotated] = [0.0, 40.0]
            .map(|deg| ViewShape::of(&view([0.0, 0.0, 0.4], [0.0, 0.0, deg]), &camera()));
        assert!((upright.span_frac - rotated.span_frac).abs() < CLOSE);
        // The board has 9 x 7 points, which span 0.2 x 0.15 m. The variance of these discrete
        // points is larger by (n + 1) / (n - 1).
        let area_px2 =
            (0.2 * 500.0 / 0.4) * (0.15 * 500.0 / 0.4) * (10.0_f64 / 8.0 * 8.0 / 6.0).sqrt();
        let expected = (area_px2 / (640.0 * 480.0)).sqrt();
        assert!(
            (upright.span_frac - expected).abs() < CLOSE,
            "{} {expected}",
            upright.span_frac
        );
    }

    #[test]
    fn a_trembling_hand_does_not_make_another_photograph() {
        let of = |center, rotation_deg| ViewShape::of(&view(center, rotation_deg), &camera());
        let first = of([0.0, 0.0, 0.4], [0.0, 20.0, 0.0]);
        assert!(!of([0.004, -0.003, 0.405], [1.0, 22.0, 3.0]).differs_from(&first));
        assert!(of([0.06, 0.0, 0.4], [0.0, 20.0, 0.0]).differs_from(&first));
        assert!(of([0.0, 0.0, 0.4], [0.0, 31.0, 0.0]).differs_from(&first));
        assert!(of([0.0, 0.0, 0.47], [0.0, 20.0, 0.0]).differs_from(&first));
    }
}
