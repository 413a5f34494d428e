//! Homographies between a flat target and an image plane, and the pose that a homography contains.

use kinematics::Transform;
use nalgebra::{
    Matrix3, Rotation3, SMatrix, SVector, Translation3, UnitQuaternion, Vector2, Vector3,
};

/// Minimum number of points of a homography.
pub(super) const MIN_POINTS: usize = 4;

/// Least-squares homography from points `from` to points `to`. `None` if the points are too few,
/// collinear or not finite.
///
/// Source: Hartley and Zisserman 2004, algorithm 4.2 (normalized DLT), with the inhomogeneous
/// solution. After the normalization, the element of the last row and column is the depth of the
/// centroid, which is not zero for a target in front of the camera.
pub(crate) fn homography(pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Option<Matrix3<f64>> {
    if pairs.len() < MIN_POINTS {
        return None;
    }
    let normalize_from = normalization(pairs.iter().map(|pair| pair.0))?;
    let normalize_to = normalization(pairs.iter().map(|pair| pair.1))?;
    let mut normal_matrix = SMatrix::<f64, 8, 8>::zeros();
    let mut rhs = SVector::<f64, 8>::zeros();
    for (from, to) in pairs {
        let from = normalize_from.apply(from);
        let to = normalize_to.apply(to);
        let x = from.x;
        let y = from.y;
        // The projection equations, multiplied by the depth.
        let rows = [
            (
                SVector::from([x, y, 1.0, 0.0, 0.0, 0.0, -to.x * x, -to.x * y]),
                to.x,
            ),
            (
                SVector::from([0.0, 0.0, 0.0, x, y, 1.0, -to.y * x, -to.y * y]),
                to.y,
            ),
        ];
        for (row, value) in rows {
            normal_matrix.ger(1.0, &row, &row, 1.0);
            rhs.axpy(value, &row, 1.0);
        }
    }
    // Points on a line leave some elements undetermined.
    const MIN_PIVOT: f64 = 1e-9;
    let factor = normal_matrix.cholesky()?;
    let pivots = factor.l_dirty().diagonal();
    if pivots.min() < MIN_PIVOT * pivots.max() {
        return None;
    }
    let h = factor.solve(&rhs);
    let normalized = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
    let result = normalize_to.inverse_matrix() * normalized * normalize_from.matrix();
    result
        .iter()
        .all(|value| value.is_finite())
        .then_some(result)
}

/// Moves points to a mean of zero and a mean distance of `sqrt(2)` from it.
struct Normalization {
    mean: Vector2<f64>,
    scale: f64,
}

/// `None` if all points are the same, or if a point is not finite.
fn normalization(points: impl Iterator<Item = Vector2<f64>> + Clone) -> Option<Normalization> {
    let n = points.clone().count() as f64;
    let mean = points.clone().sum::<Vector2<f64>>() / n;
    let distance = points.map(|point| (point - mean).norm()).sum::<f64>() / n;
    (distance > 0.0 && distance.is_finite()).then(|| Normalization {
        mean,
        scale: std::f64::consts::SQRT_2 / distance,
    })
}

impl Normalization {
    fn apply(&self, point: &Vector2<f64>) -> Vector2<f64> {
        (point - self.mean) * self.scale
    }

    fn matrix(&self) -> Matrix3<f64> {
        let Self { mean, scale } = self;
        Matrix3::new(
            *scale,
            0.0,
            -scale * mean.x,
            0.0,
            *scale,
            -scale * mean.y,
            0.0,
            0.0,
            1.0,
        )
    }

    fn inverse_matrix(&self) -> Matrix3<f64> {
        let Self { mean, scale } = self;
        Matrix3::new(
            1.0 / scale,
            0.0,
            mean.x,
            0.0,
            1.0 / scale,
            mean.y,
            0.0,
            0.0,
            1.0,
        )
    }
}

/// The pose `camera_from_plane` of the plane z = 0 from its homography to the plane `z = 1` of the
/// camera.
///
/// Source: Zhang 2000, section 3.1. The result is the rotation that is nearest to the matrix
/// (appendix C).
pub(super) fn pose(homography: &Matrix3<f64>) -> Option<Transform> {
    // The first two columns are the columns of the rotation, up to the scale. With noise, their
    // lengths differ a little.
    let first = homography.column(0).into_owned();
    let second = homography.column(1).into_owned();
    let length = 0.5 * (first.norm() + second.norm());
    if !(length > 0.0 && length.is_finite()) {
        return None;
    }
    // The target is in front of the camera.
    let scale = if homography[(2, 2)] < 0.0 { -1.0 } else { 1.0 } / length;
    let x = first * scale;
    let y = second * scale;
    let svd = Matrix3::from_columns(&[x, y, x.cross(&y)]).svd(true, true);
    let u = svd.u?;
    let v_t = svd.v_t?;
    let mut rotation = u * v_t;
    if rotation.determinant() < 0.0 {
        rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0)) * v_t;
    }
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation: Vector3<f64> = homography.column(2) * scale;
    let pose = Transform::from_parts(Translation3::from(translation), rotation);
    pose.to_homogeneous()
        .iter()
        .all(|value| value.is_finite())
        .then_some(pose)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> impl Iterator<Item = Vector2<f64>> {
        (0..6).flat_map(|row| {
            (0..8).map(move |column| Vector2::new(f64::from(column), f64::from(row)) * 0.03)
        })
    }

    #[test]
    fn homographies_and_their_poses_are_recovered() {
        let truth = Transform::new(Vector3::new(0.1, -0.2, 0.9), Vector3::new(0.4, -0.3, 0.8));
        let pairs: Vec<_> = grid()
            .map(|point| {
                let in_camera = truth * nalgebra::Point3::new(point.x, point.y, 0.0);
                (point, in_camera.xy().coords / in_camera.z)
            })
            .collect();
        let found = homography(&pairs).unwrap();
        for (from, to) in &pairs {
            let mapped = found * from.push(1.0);
            assert!((mapped.xy() / mapped.z - to).norm() < 1e-12);
        }
        let pose = pose(&found).unwrap();
        assert!(
            (pose.to_homogeneous() - truth.to_homogeneous()).amax() < 1e-10,
            "{pose}"
        );
    }

    #[test]
    fn degenerate_points_have_no_homography() {
        let map = |point: Vector2<f64>| (point, point * 2.0);
        assert!(homography(&[]).is_none());
        assert!(homography(&grid().take(3).map(map).collect::<Vec<_>>()).is_none());
        assert!(
            homography(&grid().take(8).map(map).collect::<Vec<_>>()).is_none(),
            "all points on one line"
        );
        assert!(
            homography(&vec![map(Vector2::new(1.0, 2.0)); 9]).is_none(),
            "all points equal"
        );
        assert!(homography(&[map(Vector2::new(f64::NAN, 0.0)); 9]).is_none());
    }
}
