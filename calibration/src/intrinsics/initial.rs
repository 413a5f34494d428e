//! Initial intrinsics and poses from homographies.

use super::board_pose;
use super::bundle::Bundle;
use super::homography::{self, homography};
use crate::BoardPoint;
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Matrix2, Matrix3, Matrix6, Translation3, Vector2, Vector6};
use numbers::quantile::median;

/// Focal lengths that are tried, relative to the longer side of the image. They correspond to
/// fields of view of about 20 to 100 degrees for a pinhole, and of 20 to 200 degrees for an
/// equidistant fisheye.
const PINHOLE_FOCAL_FRACS: [f64; 6] = [0.4, 0.6, 0.9, 1.3, 2.0, 3.0];
const FISHEYE_FOCAL_FRACS: [f64; 9] = [0.27, 0.33, 0.4, 0.5, 0.65, 0.8, 1.1, 1.6, 2.4];

/// Intrinsics without distortion coefficients and the pose in each image, if one was found.
#[derive(Clone, Debug)]
pub(super) struct Start {
    pub(super) intrinsics: Intrinsics,
    pub(super) poses: Vec<Option<Transform>>,
    /// Root mean square of the reprojection error of each image, pixels. It is infinite without a
    /// pose.
    pub(super) errors_px: Vec<f64>,
}

impl Start {
    fn new(
        intrinsics: Intrinsics,
        poses: Vec<Option<Transform>>,
        images: &[&[BoardPoint]],
    ) -> Self {
        let errors_px = poses
            .iter()
            .zip(images)
            .map(|(pose, points)| {
                pose.map_or(f64::INFINITY, |pose| rms_px(&intrinsics, pose, points))
            })
            .collect();
        Self {
            intrinsics,
            poses,
            errors_px,
        }
    }

    /// Median over the images, so that up to half of them may be wrong.
    pub(super) fn median_error_px(&self) -> f64 {
        median(&self.errors_px).unwrap_or(f64::INFINITY)
    }
}

/// Root mean square of the reprojection error of one image, pixels.
fn rms_px(intrinsics: &Intrinsics, pose: Transform, points: &[BoardPoint]) -> f64 {
    let bundle = Bundle {
        intrinsics: intrinsics.clone(),
        poses: vec![pose],
    };
    let squares = bundle
        .errors_px(0, points)
        .into_iter()
        .map(|error| error * error)
        .sum::<f64>();
    (squares / points.len() as f64).sqrt()
}

/// Initial values for lenses that are close to a pinhole. They are the best of three results:
/// Zhang's closed form, the closed form with the principal point at the center of the image, and a
/// scan over focal lengths.
///
/// Returns `None` if none of these results has poses for at least half of the images.
pub(super) fn pinhole(images: &[&[BoardPoint]], size_px: [u32; 2]) -> Option<Start> {
    let homographies: Vec<Option<Matrix3<f64>>> = images
        .iter()
        .map(|points| pixel_from_plane(points))
        .collect();
    let known: Vec<Matrix3<f64>> = homographies.iter().flatten().copied().collect();
    let normalized: Vec<Matrix3<f64>> = known
        .iter()
        .map(|homography| centered(homography, size_px))
        .collect();
    // Closed forms are exact without distortion, but fail for few or similar tilts. The scan is
    // coarse, but never fails.
    let closed_forms = [zhang(&normalized), single_focal(&normalized)];
    let scan = PINHOLE_FOCAL_FRACS.map(|frac| Some(([frac; 2], [0.0; 2])));
    let candidates = closed_forms.into_iter().chain(scan).flatten();
    let starts = candidates.filter_map(|candidate| {
        let intrinsics = denormalized(candidate, size_px, Lens::Pinhole)?;
        let [fx, fy] = intrinsics.focal_px;
        let [cx, cy] = intrinsics.principal_px;
        let pixel_from_camera = Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0);
        let camera_from_pixel = pixel_from_camera.try_inverse()?;
        let pose = |(homography, points): (&Option<Matrix3<f64>>, &&[BoardPoint])| {
            let camera_from_plane = homography::pose(&(camera_from_pixel * (*homography)?))?;
            Some(camera_from_plane * Translation3::new(0.0, 0.0, -points.first()?.point_in_board.z))
        };
        let poses = homographies.iter().zip(images).map(pose).collect();
        Some(Start::new(intrinsics, poses, images))
    });
    best(starts)
}

/// Initial values for fisheye lenses. They are the best of a set of equidistant lenses.
pub(super) fn fisheye(images: &[&[BoardPoint]], size_px: [u32; 2]) -> Option<Start> {
    /// Number of candidates whose poses are refined. Poses of homographies are inaccurate for wide
    /// angles.
    const N_REFINED: usize = 3;
    let lens = Lens::KannalaBrandt([0.0; 4]);
    let starts = FISHEYE_FOCAL_FRACS.into_iter().filter_map(|frac| {
        let intrinsics = denormalized(([frac; 2], [0.0; 2]), size_px, lens)?;
        let poses = images
            .iter()
            .map(|points| board_pose::initial_pose(&intrinsics, points))
            .collect();
        Some(Start::new(intrinsics, poses, images))
    });
    let mut starts: Vec<Start> = starts.collect();
    starts.sort_by(|a, b| a.median_error_px().total_cmp(&b.median_error_px()));
    let refined = starts.into_iter().take(N_REFINED).map(|start| {
        let pose = |(points, pose): (&&[BoardPoint], &Option<Transform>)| {
            Some(board_pose::refine(&start.intrinsics, points, (*pose)?)?.camera_from_board)
        };
        let poses = images.iter().zip(&start.poses).map(pose).collect();
        Start::new(start.intrinsics, poses, images)
    });
    best(refined)
}

/// The start with the smallest median error. `None` if half of its images have no pose.
fn best(starts: impl Iterator<Item = Start>) -> Option<Start> {
    let best = starts.min_by(|a, b| a.median_error_px().total_cmp(&b.median_error_px()))?;
    best.median_error_px().is_finite().then_some(best)
}

/// The homography from the plane of the target to the image.
fn pixel_from_plane(points: &[BoardPoint]) -> Option<Matrix3<f64>> {
    let pairs: Vec<_> = points
        .iter()
        .map(|point| (point.point_in_board.xy(), Vector2::from(point.pixel)))
        .collect();
    homography(&pairs)
}

/// Converts a homography to pixels into coordinates with the origin at the center of the image and
/// the longer side as unit. Its columns are scaled to about unit length.
fn centered(homography: &Matrix3<f64>, size_px: [u32; 2]) -> Matrix3<f64> {
    let (center, side) = frame(size_px);
    let normalize = Matrix3::new(
        1.0 / side,
        0.0,
        -center[0] / side,
        0.0,
        1.0 / side,
        -center[1] / side,
        0.0,
        0.0,
        1.0,
    );
    // The scale of a homography is arbitrary. Columns of unit length give all images the same
    // weight.
    let homography = normalize * homography;
    let length = (homography.column(0).norm() * homography.column(1).norm()).sqrt();
    homography / length
}

/// Center and longer side of the image, pixels.
fn frame(size_px: [u32; 2]) -> ([f64; 2], f64) {
    (
        size_px.map(|side| 0.5 * f64::from(side)),
        f64::from(size_px[0].max(size_px[1])),
    )
}

/// Focal lengths and principal point of a centered and normalized image.
type Plane = ([f64; 2], [f64; 2]);

/// Converts to pixels. `None` if the focal lengths are implausible or the principal point is
/// outside the image.
fn denormalized((focal, principal): Plane, size_px: [u32; 2], lens: Lens) -> Option<Intrinsics> {
    // Range of plausible focal lengths. For nearly degenerate images, closed forms give arbitrary
    // numbers.
    const FOCAL_FRACS: std::ops::Range<f64> = 0.05..100.0;
    const MAX_ASPECT: f64 = 2.0;
    let (center, side) = frame(size_px);
    let principal_px = [0, 1].map(|axis| center[axis] + side * principal[axis]);
    let is_plausible = focal.iter().all(|focal| FOCAL_FRACS.contains(focal))
        && (1.0 / MAX_ASPECT..MAX_ASPECT).contains(&(focal[0] / focal[1]))
        && (0..2).all(|axis| (0.0..=2.0 * center[axis]).contains(&principal_px[axis]));
    let focal_px = focal.map(|focal| focal * side);
    is_plausible.then_some(Intrinsics {
        size_px,
        focal_px,
        principal_px,
        lens,
        rectified: false,
    })
}

/// Closed form for focal lengths and principal point, without skew.
///
/// Source: Zhang 2000, section 3.1 and appendix B.
fn zhang(homographies: &[Matrix3<f64>]) -> Option<Plane> {
    if homographies.len() < 3 {
        return None;
    }
    let mut normal_matrix = Matrix6::zeros();
    for homography in homographies {
        // The first two columns of a rotation are orthogonal and have the same length.
        for row in [
            constraint(homography, 0, 1),
            constraint(homography, 0, 0) - constraint(homography, 1, 1),
        ] {
            normal_matrix += row * row.transpose();
        }
    }
    // Each image gets one more row, which sets the second element to zero and thus excludes skew.
    normal_matrix[(1, 1)] += homographies.len() as f64;
    let eigen = normal_matrix.symmetric_eigen();
    let b = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    // Elements of the image of the absolute conic, in the notation of Zhang's appendix B.
    let [b11, b12, b22, b13, b23, b33] = [b[0], b[1], b[2], b[3], b[4], b[5]];
    let determinant = b11 * b22 - b12 * b12;
    let cy = (b12 * b13 - b11 * b23) / determinant;
    let lambda = b33 - (b13 * b13 + cy * (b12 * b13 - b11 * b23)) / b11;
    let fx = (lambda / b11).sqrt();
    let fy = (lambda * b11 / determinant).sqrt();
    let skew = -b12 * fx * fx * fy / lambda;
    let cx = skew * cy / fy - b13 * fx * fx / lambda;
    [fx, fy, cx, cy]
        .iter()
        .all(|value| value.is_finite())
        .then_some(([fx, fy], [cx, cy]))
}

/// The vector `v_ij` of Zhang 2000, equation 7, for two columns of a homography.
fn constraint(homography: &Matrix3<f64>, i: usize, j: usize) -> Vector6<f64> {
    let a = homography.column(i);
    let b = homography.column(j);
    Vector6::new(
        a[0] * b[0],
        a[0] * b[1] + a[1] * b[0],
        a[1] * b[1],
        a[2] * b[0] + a[0] * b[2],
        a[2] * b[1] + a[1] * b[2],
        a[2] * b[2],
    )
}

/// Closed form for one focal length, with the principal point at the center of the image and square
/// pixels.
///
/// The two constraints of Zhang 2000, section 2.3, are linear in the inverse of the squared focal
/// length.
fn single_focal(homographies: &[Matrix3<f64>]) -> Option<Plane> {
    let mut sums = Matrix2::<f64>::zeros();
    for homography in homographies {
        for row in [
            products(homography, 0, 1),
            products(homography, 0, 0) - products(homography, 1, 1),
        ] {
            sums += row * row.transpose();
        }
    }
    // row[0] / focal² = row[1].
    let focal = (sums[(0, 0)] / sums[(0, 1)]).sqrt();
    focal.is_finite().then_some(([focal; 2], [0.0; 2]))
}

/// Two products of two columns of a homography. The first is the product over the first two rows,
/// which is divided by the squared focal length. The second is the negative product in the last
/// row.
fn products(homography: &Matrix3<f64>, i: usize, j: usize) -> Vector2<f64> {
    let a = homography.column(i);
    let b = homography.column(j);
    Vector2::new(a[0] * b[0] + a[1] * b[1], -a[2] * b[2])
}

#[cfg(test)]
mod tests {
    use super::super::tests::{brown_conrady_camera, fisheye_camera, observed_images, poses};
    use super::*;

    #[test]
    fn closed_forms_recover_a_pinhole() {
        let camera = Intrinsics {
            lens: Lens::Pinhole,
            ..brown_conrady_camera()
        };
        let images = observed_images(&camera, &poses(8, 1), 0.0, 1);
        let images: Vec<&[BoardPoint]> = images.iter().map(|view| &view.points[..]).collect();
        let start = pinhole(&images, camera.size_px).unwrap();
        assert!(
            (start.intrinsics.focal_px[0] - camera.focal_px[0]).abs() < 1e-4,
            "{:?}",
            start.intrinsics
        );
        assert!(
            (start.intrinsics.principal_px[1] - camera.principal_px[1]).abs() < 1e-4,
            "{:?}",
            start.intrinsics
        );
        assert!(start.median_error_px() < 1e-4);

        let centered_camera = Intrinsics {
            focal_px: [600.0; 2],
            principal_px: [320.0, 240.0],
            ..camera
        };
        let images = observed_images(&centered_camera, &poses(2, 1), 0.0, 1);
        let homographies: Vec<_> = images
            .iter()
            .map(|view| {
                centered(
                    &pixel_from_plane(&view.points).unwrap(),
                    centered_camera.size_px,
                )
            })
            .collect();
        let (focal, _) = single_focal(&homographies).unwrap();
        assert!((focal[0] * 640.0 - 600.0).abs() < 1e-6);
    }

    #[test]
    fn fisheye_lenses_start_close_to_the_focal_length() {
        let camera = fisheye_camera();
        let images = observed_images(&camera, &poses(8, 1), 0.0, 1);
        let images: Vec<&[BoardPoint]> = images.iter().map(|view| &view.points[..]).collect();
        let start = fisheye(&images, camera.size_px).unwrap();
        let ratio = start.intrinsics.focal_px[0] / camera.focal_px[0];
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn images_without_homographies_have_no_start() {
        let points = [BoardPoint {
            point_in_board: nalgebra::Vector3::zeros(),
            pixel: [1.0, 2.0],
        }; 9];
        assert!(pinhole(&[&points[..]; 4], [640, 480]).is_none());
        assert!(fisheye(&[&points[..]; 4], [640, 480]).is_none());
        assert!(pinhole(&[], [640, 480]).is_none());
    }
}
