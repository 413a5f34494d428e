//! Poses in messages: 16 numbers, row-major.

use kinematics::Transform;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

/// Maximum deviation of a rotation matrix from an orthonormal one. Products computed in f32 by a
/// browser stay below 1e-5.
const MAX_SKEW: f64 = 1e-3;

/// The row-major 4x4 matrix of a pose.
pub(crate) fn row_major(pose: &Transform) -> [f64; 16] {
    // The library stores columns, so the columns of the transposed matrix are the rows.
    let rows = pose.to_homogeneous().transpose();
    let mut numbers = [0.0; 16];
    numbers.copy_from_slice(rows.as_slice());
    numbers
}

/// The pose of a row-major 4x4 matrix; `None` if the matrix is not a rigid transform.
pub(crate) fn from_row_major(rows: &[f64; 16]) -> Option<Transform> {
    let rotation = Matrix3::new(
        rows[0], rows[1], rows[2], rows[4], rows[5], rows[6], rows[8], rows[9], rows[10],
    );
    let skew = (rotation.transpose() * rotation - Matrix3::identity()).amax();
    // The comparisons are written so that NaN is rejected. The determinant excludes reflections,
    // because they are orthonormal, too.
    let is_rigid = rows.iter().all(|number| number.is_finite())
        && skew <= MAX_SKEW
        && rotation.determinant() > 0.0
        && rows[12..] == [0.0, 0.0, 0.0, 1.0];
    is_rigid.then(|| {
        // The small skew that is allowed above disappears here, because the quaternion is
        // normalized.
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        Isometry3::from_parts(Translation3::new(rows[3], rows[7], rows[11]), rotation)
    })
}

#[cfg(test)]
mod tests {
    use super::{from_row_major, row_major};
    use nalgebra::{Isometry3, Vector3};

    #[test]
    fn poses_round_trip() {
        let pose = Isometry3::new(Vector3::new(0.5, -2.0, 1.25), Vector3::new(0.3, -1.1, 0.7));
        let back = from_row_major(&row_major(&pose)).expect("rigid");
        assert!((back.to_homogeneous() - pose.to_homogeneous()).amax() < 1e-12);
        assert!(
            (row_major(&pose)[3] - 0.5).abs() < 1e-15,
            "row major: the translation is the last column"
        );
    }

    #[test]
    fn non_rigid_matrices_are_rejected() {
        let good = row_major(&Isometry3::identity());
        for (ix, wrong) in [
            (0, 2.0),
            (0, -1.0),
            (5, f64::NAN),
            (3, f64::INFINITY),
            (1, 0.1),
            (12, 0.5),
            (15, 2.0),
        ] {
            let mut rows = good;
            rows[ix] = wrong;
            assert!(from_row_major(&rows).is_none(), "entry {ix} = {wrong}");
        }
        assert!(from_row_major(&good).is_some());
    }
}
