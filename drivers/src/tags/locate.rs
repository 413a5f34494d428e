//! Estimates the pose of a camera from tags at known poses.
//!
//! All tag corners are projected with the lens model of the camera, and the reprojection error is
//! minimized with the Levenberg-Marquardt method. The image of a small square hardly determines in
//! which direction the square is tilted (Schweighofer and Pinz 2006, "Robust Pose Estimation from a
//! Planar Target"). Two poses therefore fit a single tag almost equally well, and the optimization
//! starts from both. If neither pose fits clearly better, no pose is returned.

use kinematics::{Intrinsics, Transform, Twist, transform};
use nalgebra::{
    Matrix2x3, Matrix3, Matrix3x6, Matrix6, Rotation3, SMatrix, SVector, UnitQuaternion, Vector3,
    Vector6,
};

/// Standard deviation of detected corners in a sharp image, pixels. It is the lower limit of the
/// assumed noise.
const CORNER_SIGMA_PX: f64 = 0.2;
/// Residual above which the cost is linear instead of quadratic (Huber 1964). It reduces the effect
/// of unreliable corners, such as the corners of tags that are viewed at a grazing angle.
const HUBER_PX: f64 = 3.0 * CORNER_SIGMA_PX;
/// Maximum root mean square error, pixels. If it is larger, the corners do not match the tags of
/// the rig file. The limit is several times the noise of corners. It accepts poses from inaccurate
/// intrinsics or inaccurately measured tags, which cause errors of this size.
const MAX_RMS_ERROR_PX: f64 = 3.0;
/// Minimum ratio of the cost of the second-best pose to the best cost. Below this ratio, the pose
/// is ambiguous. A larger value rejects more correct poses of small or distant tags. A smaller
/// value accepts more poses with the wrong tilt.
const MIN_AMBIGUITY_RATIO: f64 = 3.0;
/// Maximum number of iterations. Both starting poses need far fewer. The limit only bounds the time
/// for corners that no pose fits.
const MAX_ITERATIONS: usize = 50;

/// A tag with a known pose.
#[derive(Clone, Debug, PartialEq)]
pub struct TagPlacement {
    /// Side length of the tag, meters. It is measured at the border where black meets white.
    pub size_m: f64,
    /// Pose of the center of the tag. On the print, x points right, y down, and z into the print.
    pub world_from_tag: Transform,
}

/// A camera and its motion during the exposure.
#[derive(Clone, Debug)]
pub struct RollingShutterCamera<'a> {
    /// Its lens parameters.
    pub intrinsics: &'a Intrinsics,
    /// Velocity of the camera in its own axes. Rows are exposed one after another, so each corner
    /// is observed from a different pose.
    pub twist: Twist,
    /// Time from the exposure of the first row to the exposure of the last row, seconds. It is 0
    /// for a global shutter.
    pub readout_secs: f64,
}

impl RollingShutterCamera<'_> {
    /// Maps the camera frame at mid-exposure to the camera frame at the time of a row.
    fn row_from_mid_exposure(&self, row_px: f64) -> Transform {
        // Rows are exposed from the top to the bottom at a constant rate. Corners just outside of
        // the image belong to its first or last row.
        let since_mid_exposure_frac = row_px / f64::from(self.intrinsics.size_px[1].max(1)) - 0.5;
        transform::exp(
            &self.twist,
            since_mid_exposure_frac.clamp(-0.5, 0.5) * self.readout_secs,
        )
        .inverse()
    }
}

/// Estimated pose of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPoseEstimate {
    /// Pose of the camera at mid-exposure.
    pub world_from_camera: Transform,
    /// Covariance of a small motion of the world in the axes of the camera. Meters come first, then
    /// radians.
    pub covariance: Matrix6<f64>,
    /// Root mean square reprojection error of the corners, pixels.
    pub rms_error_px: f64,
}

/// The reason why the camera pose cannot be estimated.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum LocateError {
    /// The image contains no tag with a known pose.
    #[error("no tag of the rig file is visible")]
    NoTag,
    /// No pose fits the corners.
    #[error(
        "the corners of the tags are {rms_error_px:.1} px off: check the sizes and poses of the tags, and the intrinsics of the camera"
    )]
    LargeReprojectionError {
        /// Root mean square error, pixels.
        rms_error_px: f64,
    },
    /// Two poses fit the tags almost equally well.
    #[error(
        "the only visible tag is too small in the image: its pose is ambiguous (two tilts fit)"
    )]
    Ambiguous,
}

/// A corner of a tag, in the world and in the image.
struct Corner {
    point_in_world: Vector3<f64>,
    observed_px: [f64; 2],
    /// Maps the camera frame at mid-exposure to the camera frame at the time of the corner's row.
    row_from_mid_exposure: Transform,
}

/// Estimates the pose of a camera from tags and their corners in the image, in the order of
/// [`super::TagDetection`].
///
/// # Errors
/// Fails if no tag is given, if no pose fits the corners, or if two poses fit them almost equally
/// well.
pub fn locate(
    camera: &RollingShutterCamera<'_>,
    tags: &[(&TagPlacement, [[f64; 2]; 4])],
) -> Result<CameraPoseEstimate, LocateError> {
    let intrinsics = camera.intrinsics;
    let corners: Vec<Corner> = tags
        .iter()
        .flat_map(|(tag, observed_px)| corners(camera, tag, observed_px))
        .collect();
    let initial_poses = tags
        .iter()
        .flat_map(|(tag, observed_px)| initial_poses(intrinsics, tag, observed_px));
    let mut solutions: Vec<(f64, Transform)> = initial_poses
        .filter_map(|initial_pose| refine(intrinsics, &corners, initial_pose))
        .collect();
    solutions.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    let Some(&(cost, camera_from_world)) = solutions.first() else {
        return Err(LocateError::NoTag);
    };
    let rms_error_px = rms_error_px(intrinsics, &corners, &camera_from_world);
    if rms_error_px > MAX_RMS_ERROR_PX {
        return Err(LocateError::LargeReprojectionError { rms_error_px });
    }
    // This is the contribution of noise to the cost. It is added to the costs of both poses. If
    // both fits are nearly perfect, the ratio of their costs is then about 1, so the difference of
    // their tiny costs does not decide which tilt is right.
    let floor = corners.len() as f64 * CORNER_SIGMA_PX * CORNER_SIGMA_PX;
    // With several tags, both solutions usually converge to one pose. If they differ by less than
    // 0.05 rad (3 degrees), they are the same minimum with rounding differences. Otherwise, they
    // are two minima, which are mirror images of each other.
    let is_different_pose = |(_, pose): &&(f64, Transform)| {
        (pose * camera_from_world.inverse()).rotation.angle() > 0.05
    };
    if solutions
        .iter()
        .find(is_different_pose)
        .is_some_and(|(other, _)| other + floor < MIN_AMBIGUITY_RATIO * (cost + floor))
    {
        return Err(LocateError::Ambiguous);
    }
    // The residuals of four corners may be small by chance, because there are only two more
    // measurements than unknowns.
    let sigma_px = rms_error_px.max(CORNER_SIGMA_PX);
    // The inverse of the normal matrix, times the variance of a corner, is the covariance of the
    // least-squares solution.
    let (_, normal_matrix, _) =
        equations(intrinsics, &corners, &camera_from_world).ok_or(LocateError::NoTag)?;
    let covariance =
        normal_matrix.try_inverse().ok_or(LocateError::Ambiguous)? * sigma_px * sigma_px;
    Ok(CameraPoseEstimate {
        world_from_camera: camera_from_world.inverse(),
        covariance,
        rms_error_px,
    })
}

/// Corners in the frame of the tag, meters, in the order of the detector.
fn corners_in_tag(size_m: f64) -> [Vector3<f64>; 4] {
    [[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]
        .map(|[x, y]| Vector3::new(x, y, 0.0) * (0.5 * size_m))
}

fn corners(
    camera: &RollingShutterCamera<'_>,
    tag: &TagPlacement,
    observed_px: &[[f64; 2]; 4],
) -> [Corner; 4] {
    let corners_in_tag = corners_in_tag(tag.size_m);
    std::array::from_fn(|ix| Corner {
        point_in_world: (tag.world_from_tag * nalgebra::Point3::from(corners_in_tag[ix])).coords,
        observed_px: observed_px[ix],
        row_from_mid_exposure: camera.row_from_mid_exposure(observed_px[ix][1]),
    })
}

/// Both candidate poses of the world in the camera frame from a single tag. The list is empty if a
/// corner cannot be unprojected.
fn initial_poses(
    intrinsics: &Intrinsics,
    tag: &TagPlacement,
    observed_px: &[[f64; 2]; 4],
) -> Vec<Transform> {
    let rays = observed_px.map(|pixel| intrinsics.unproject(pixel));
    let [Some(a), Some(b), Some(c), Some(d)] = rays else {
        return Vec::new();
    };
    let Some(first) = pose_from_homography(tag.size_m, [a, b, c, d]) else {
        return Vec::new();
    };
    // For the second candidate, the normal of the tag is mirrored about the viewing direction.
    let view_direction = first.translation.vector.normalize();
    let normal = first.rotation * Vector3::z();
    let mirrored = view_direction * (2.0 * view_direction.dot(&normal)) - normal;
    let rotation = UnitQuaternion::rotation_between(&normal, &mirrored).unwrap_or_default();
    let second = Transform::from_parts(first.translation, rotation * first.rotation);
    let tag_from_world = tag.world_from_tag.inverse();
    vec![first * tag_from_world, second * tag_from_world]
}

/// Pose of a tag in the camera frame from the homography between the plane of the tag and the plane
/// `z` = 1 of the camera.
///
/// Source: Zhang 2000, "A flexible new technique for camera calibration", section 3.1.
fn pose_from_homography(size_m: f64, rays: [Vector3<f64>; 4]) -> Option<Transform> {
    let mut rows = SMatrix::<f64, 8, 8>::zeros();
    let mut rhs = SVector::<f64, 8>::zeros();
    for (ix, (corner, ray)) in corners_in_tag(size_m).iter().zip(rays).enumerate() {
        let [x, y] = [corner.x, corner.y];
        let [u, v] = [ray.x / ray.z, ray.y / ray.z];
        // The rows are `u = (h0 x + h1 y + h2) / (h6 x + h7 y + 1)` and the corresponding equation
        // for v, both multiplied by the denominator. The last element is set to 1, because the
        // tag's center is in front of the camera.
        rows.set_row(2 * ix, &[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y].into());
        rows.set_row(
            2 * ix + 1,
            &[0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y].into(),
        );
        rhs[2 * ix] = u;
        rhs[2 * ix + 1] = v;
    }
    let h = rows.lu().solve(&rhs)?;
    let first = Vector3::new(h[0], h[3], h[6]);
    let second = Vector3::new(h[1], h[4], h[7]);
    let center = Vector3::new(h[2], h[5], 1.0);
    // The columns are the axes of the tag and its position, up to a common factor. Noise makes the
    // lengths of both axes differ, so their mean is used.
    let scale = 2.0 / (first.norm() + second.norm());
    let x = first * scale;
    let y = second * scale;
    // Noise also tilts the axes against each other. `from_matrix` finds a rotation close to them.
    let approximate = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&approximate));
    let pose = Transform::from_parts((center * scale).into(), rotation);
    transform::is_finite(&pose).then_some(pose)
}

/// Refines a pose of the world in the camera frame by least squares. Returns the cost and the pose.
fn refine(
    intrinsics: &Intrinsics,
    corners: &[Corner],
    mut pose: Transform,
) -> Option<(f64, Transform)> {
    let (mut cost, mut normal_matrix, mut rhs) = equations(intrinsics, corners, &pose)?;
    let mut damping = 1e-4;
    for _ in 0..MAX_ITERATIONS {
        // The damping is scaled by the diagonal (Marquardt), because meters and radians have
        // different magnitudes.
        let damped = normal_matrix + Matrix6::from_diagonal(&(normal_matrix.diagonal() * damping));
        let step = damped.cholesky()?.solve(&rhs);
        let twist = Twist {
            linear_m_s: step.fixed_rows::<3>(0).into(),
            angular_rad_s: step.fixed_rows::<3>(3).into(),
        };
        // The step is a motion of the world in the axes of the camera, so it is applied from the
        // left.
        let next = transform::exp(&twist, 1.0) * pose;
        match equations(intrinsics, corners, &next) {
            Some(improved) if improved.0 < cost => {
                let decrease = cost - improved.0;
                pose = next;
                damping *= 0.1;
                (cost, normal_matrix, rhs) = improved;
                // Further steps would only change the last digits of the pose.
                if decrease < 1e-9 * cost {
                    break;
                }
            }
            _ if damping > 1e6 => break,
            _ => damping *= 10.0,
        }
    }
    Some((cost, pose))
}

/// Sum of squared residuals in px² with the Huber loss, and the normal equations for a small motion
/// of the world in the axes of the camera. `None` if a corner is not in front of the camera.
fn equations(
    intrinsics: &Intrinsics,
    corners: &[Corner],
    camera_from_world: &Transform,
) -> Option<(f64, Matrix6<f64>, Vector6<f64>)> {
    let mut cost = 0.0;
    let mut normal_matrix = Matrix6::zeros();
    let mut rhs = Vector6::zeros();
    for Corner {
        point_in_world,
        observed_px,
        row_from_mid_exposure,
    } in corners
    {
        let point =
            camera_from_world.rotation * point_in_world + camera_from_world.translation.vector;
        let point_at_row =
            row_from_mid_exposure.rotation * point + row_from_mid_exposure.translation.vector;
        let (pixel, d_pixel_d_point): (_, Matrix2x3<f64>) =
            intrinsics.project_with_jacobian(&point_at_row)?;
        let residual = nalgebra::Vector2::new(observed_px[0] - pixel[0], observed_px[1] - pixel[1]);
        let mut d_point_d_pose = Matrix3x6::identity();
        d_point_d_pose
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&-point.cross_matrix());
        // The chain rule multiplies three derivatives. The first is the derivative of the pixel by
        // the point at the time of its row. The second is the derivative of this point by the point
        // at mid-exposure. The third is the derivative of the point at mid-exposure by the pose.
        // The motion during the exposure is known, so the second derivative is the rotation of this
        // motion.
        let jacobian = d_pixel_d_point
            * row_from_mid_exposure.rotation.to_rotation_matrix().matrix()
            * d_point_d_pose;
        let residual_px = residual.norm();
        // The weight of iteratively reweighted least squares is 1 up to the threshold, and
        // inversely proportional to the residual above it. The cost is twice the usual Huber loss.
        // It is `r²` up to the threshold `h`, and `2 h r - h²` above it.
        let weight = HUBER_PX / residual_px.max(HUBER_PX);
        cost += weight * (2.0 - weight) * residual_px * residual_px;
        normal_matrix += jacobian.transpose() * jacobian * weight;
        rhs += jacobian.transpose() * residual * weight;
    }
    Some((cost, normal_matrix, rhs))
}

/// Root mean square reprojection error of the corners, pixels.
fn rms_error_px(intrinsics: &Intrinsics, corners: &[Corner], camera_from_world: &Transform) -> f64 {
    let squares = corners.iter().map(
        |Corner {
             point_in_world,
             observed_px,
             row_from_mid_exposure,
         }| {
            let point =
                row_from_mid_exposure * camera_from_world * nalgebra::Point3::from(*point_in_world);
            let [u, v] = intrinsics
                .project(&point.coords)
                .unwrap_or([f64::INFINITY; 2]);
            (observed_px[0] - u).powi(2) + (observed_px[1] - v).powi(2)
        },
    );
    (squares.sum::<f64>() / corners.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Lens;
    use numbers::random::Random;

    fn camera(lens: Lens) -> Intrinsics {
        Intrinsics {
            size_px: [640, 480],
            focal_px: [600.0, 602.0],
            principal_px: [322.0, 238.0],
            lens,
            rectified: false,
        }
    }

    /// A camera that exposes all rows at the same time.
    fn global_shutter(intrinsics: &Intrinsics) -> RollingShutterCamera<'_> {
        RollingShutterCamera {
            intrinsics,
            twist: Twist::zero(),
            readout_secs: 0.0,
        }
    }

    #[test]
    fn rolling_shutter_pose_is_located_at_mid_exposure() {
        let (intrinsics, mid_exposure, tag) = (
            camera(Lens::Pinhole),
            camera_in_front_of_tag(0.5),
            tag(0.0, [0.2, -0.6, 2.5]),
        );
        let twist = Twist {
            linear_m_s: Vector3::new(0.2, -0.1, 0.1),
            angular_rad_s: Vector3::new(0.3, 0.5, -0.4),
        };
        let camera = RollingShutterCamera {
            intrinsics: &intrinsics,
            twist,
            readout_secs: 0.03,
        };
        // Each corner is projected from the camera pose at the time of its row.
        let mut pixels = project_corners(&intrinsics, &mid_exposure, &tag, [[0.0; 2]; 4]);
        for _ in 0..20 {
            pixels = std::array::from_fn(|ix| {
                let pose_at_row =
                    mid_exposure * camera.row_from_mid_exposure(pixels[ix][1]).inverse();
                project_corners(&intrinsics, &pose_at_row, &tag, [[0.0; 2]; 4])[ix]
            });
        }
        let residual = |camera: &RollingShutterCamera<'_>| {
            error(
                &locate(camera, &[(&tag, pixels)]).expect("a large tag"),
                &mid_exposure,
            )
        };
        let [m, rad] = residual(&camera);
        assert!(m < 1e-8 && rad < 1e-8, "{m} m, {rad} rad");
        assert!(
            residual(&global_shutter(&intrinsics))[0] > 1e-3,
            "the rolling shutter has no effect in this test"
        );
    }

    fn tag(x: f64, rotation: [f64; 3]) -> TagPlacement {
        TagPlacement {
            size_m: 0.1,
            world_from_tag: Transform::new(Vector3::new(x, 0.2, 0.4), Vector3::from(rotation)),
        }
    }

    /// Projects the corners of a tag and adds the given errors.
    fn project_corners(
        camera: &Intrinsics,
        world_from_camera: &Transform,
        tag: &TagPlacement,
        errors_px: [[f64; 2]; 4],
    ) -> [[f64; 2]; 4] {
        let corners_in_tag = corners_in_tag(tag.size_m);
        std::array::from_fn(|ix| {
            let world = tag.world_from_tag * nalgebra::Point3::from(corners_in_tag[ix]);
            let [u, v] = camera
                .project(&(world_from_camera.inverse() * world).coords)
                .expect("in front of the camera");
            [u + errors_px[ix][0], v + errors_px[ix][1]]
        })
    }

    /// A camera at the given distance in front of the tag at `x` = 0, slightly rotated.
    fn camera_in_front_of_tag(distance_m: f64) -> Transform {
        Transform::new(
            Vector3::new(0.05, 0.15, 0.4 - distance_m),
            Vector3::new(0.1, -0.15, 0.05),
        )
    }

    fn error(located: &CameraPoseEstimate, truth: &Transform) -> [f64; 2] {
        let residual = located.world_from_camera.inverse() * truth;
        [
            residual.translation.vector.norm(),
            residual.rotation.angle(),
        ]
    }

    #[test]
    fn noise_free_pose_is_recovered_for_every_lens() {
        let d455 = Lens::BrownConrady([-0.0555, 0.0657, -0.0006, 0.0004, -0.0213]);
        for lens in [
            Lens::Pinhole,
            d455,
            Lens::KannalaBrandt([-0.01, 0.02, -0.015, 0.003]),
        ] {
            let (camera, truth) = (camera(lens), camera_in_front_of_tag(0.6));
            for rotation in [[0.0; 3], [0.5, 0.0, 0.0], [0.2, -0.6, 2.5]] {
                let tag = tag(0.0, rotation);
                let pixels = project_corners(&camera, &truth, &tag, [[0.0; 2]; 4]);
                let located =
                    locate(&global_shutter(&camera), &[(&tag, pixels)]).expect("a large tag");
                let [m, rad] = error(&located, &truth);
                assert!(
                    m < 1e-8 && rad < 1e-8 && located.rms_error_px < 1e-6,
                    "{lens:?} {rotation:?}: {m} m, {rad} rad"
                );
            }
        }
    }

    #[test]
    fn errors_match_estimated_covariance() {
        let (camera, truth, tag) = (
            camera(Lens::Pinhole),
            camera_in_front_of_tag(0.5),
            tag(0.0, [0.4, 0.3, 0.1]),
        );
        let mut random = Random::new(1);
        let (mut chi2, n) = (0.0, 400);
        for _ in 0..n {
            let residual = std::array::from_fn(|_| {
                [
                    CORNER_SIGMA_PX * random.normal(),
                    CORNER_SIGMA_PX * random.normal(),
                ]
            });
            let located = locate(
                &global_shutter(&camera),
                &[(&tag, project_corners(&camera, &truth, &tag, residual))],
            )
            .expect("a large tag");
            let residual = transform::log(&(located.world_from_camera.inverse() * truth), 1.0);
            let residual = Vector6::from_iterator(
                residual
                    .linear_m_s
                    .iter()
                    .chain(&residual.angular_rad_s)
                    .copied(),
            );
            let expected = located.covariance
                * (CORNER_SIGMA_PX / located.rms_error_px.max(CORNER_SIGMA_PX)).powi(2);
            chi2 += (residual.transpose()
                * expected.try_inverse().expect("a covariance is invertible")
                * residual)
                .x;
        }
        let mean = chi2 / f64::from(n);
        assert!(
            (5.0..7.2).contains(&mean),
            "expected about 6 degrees of freedom: {mean}"
        );
    }

    #[test]
    fn single_small_tag_is_ambiguous_and_two_are_not() {
        let (camera, truth) = (camera(Lens::Pinhole), camera_in_front_of_tag(3.0));
        let (one, other) = (tag(0.0, [0.05, 0.1, 0.0]), tag(0.8, [0.0, -0.2, 0.0]));
        let noise = [[0.3, -0.2], [-0.25, 0.3], [0.2, 0.25], [-0.3, -0.2]];
        let observe = |tag: &TagPlacement| project_corners(&camera, &truth, tag, noise);
        assert_eq!(
            locate(&global_shutter(&camera), &[(&one, observe(&one))]),
            Err(LocateError::Ambiguous)
        );
        let located = locate(
            &global_shutter(&camera),
            &[(&one, observe(&one)), (&other, observe(&other))],
        )
        .expect("two tags");
        let [m, rad] = error(&located, &truth);
        // The ambiguous tilt differs by 0.28 rad.
        assert!(m < 0.1 && rad < 0.05, "{m} m, {rad} rad");
    }

    #[test]
    fn misplaced_tags_are_detected() {
        let (camera, truth) = (camera(Lens::Pinhole), camera_in_front_of_tag(0.7));
        let (one, other) = (tag(0.0, [0.1, 0.0, 0.0]), tag(0.25, [0.0, 0.1, 0.0]));
        let observe = |tag: &TagPlacement| project_corners(&camera, &truth, tag, [[0.0; 2]; 4]);
        let displaced = TagPlacement {
            world_from_tag: Transform::translation(0.0, 0.03, 0.0) * other.world_from_tag,
            ..other.clone()
        };
        let located_result = locate(
            &global_shutter(&camera),
            &[(&one, observe(&one)), (&displaced, observe(&other))],
        );
        assert!(
            matches!(located_result, Err(LocateError::LargeReprojectionError { rms_error_px }) if rms_error_px > MAX_RMS_ERROR_PX),
            "{located_result:?}"
        );
        assert_eq!(
            locate(&global_shutter(&camera), &[]),
            Err(LocateError::NoTag)
        );
        let behind = [[f64::NAN; 2]; 4];
        assert_eq!(
            locate(&global_shutter(&camera), &[(&one, behind)]),
            Err(LocateError::NoTag)
        );
        let at_one_point = [[100.0, 100.0]; 4];
        assert!(locate(&global_shutter(&camera), &[(&one, at_one_point)]).is_err());
    }
}
