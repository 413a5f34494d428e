//! The pose of a camera that sees tags whose places are known.
//!
//! Every corner of every tag is projected through the camera's own lens, and the pose with the least squares of what is off is found
//! by Gauss and Newton's method with Levenberg's damping. It begins at the two poses that explain one tag almost equally well: the
//! picture of a small square hardly tells to which side it is tilted (Schweighofer and Pinz 2006, "Robust Pose Estimation from a
//! Planar Target"). Where the better one is not clearly better, no pose is told.

use kinematics::{Intrinsics, Transform, Twist, transform};
use nalgebra::{Matrix2x3, Matrix3, Matrix3x6, Matrix6, Rotation3, SMatrix, SVector, UnitQuaternion, Vector3, Vector6};

/// Corners are found this well in a sharp image, pixels; nobody sees better.
const CORNER_SIGMA_PX: f64 = 0.2;
/// What is off by more counts by its size, not by its square (Huber 1964): sides seen from far aside have corners that are anywhere.
const HUBER_PX: f64 = 3.0 * CORNER_SIGMA_PX;
/// Corners further off than this, root mean square, are not those of the tags that the rig file tells of; in pixels.
const MAX_OFF_PX: f64 = 3.0;
/// The second best pose explains a tag so much worse, by squares, or the best one is not trusted.
const MIN_RATIO: f64 = 3.0;
const MAX_ITERATIONS: usize = 50;

/// A tag whose place is known.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedTag {
    /// Side of its border, where black meets white, metres.
    pub size_m: f64,
    /// Its centre; x to the right of the print, y down, z into it.
    pub world_from_tag: Transform,
}

/// A camera that looks.
#[derive(Clone, Debug)]
pub struct Seeing<'a> {
    /// Its lens.
    pub intrinsics: &'a Intrinsics,
    /// How it moves by what carries it, in its own axes. Rows are exposed one after the other: corners are seen from where it was then.
    pub twist: Twist,
    /// From the first row to the last, seconds; 0 where all are exposed at once.
    pub readout_secs: f64,
}

impl Seeing<'_> {
    /// The camera at the middle of its exposure, seen by itself at the instant of a row.
    fn row_from_middle(&self, row_px: f64) -> Transform {
        let since_middle_frac = row_px / f64::from(self.intrinsics.size_px[1].max(1)) - 0.5;
        transform::exp(&self.twist, since_middle_frac.clamp(-0.5, 0.5) * self.readout_secs).inverse()
    }
}

/// Where a camera is.
#[derive(Clone, Debug, PartialEq)]
pub struct Located {
    /// Pose of the camera at the middle of its exposure.
    pub world_from_camera: Transform,
    /// Covariance of the pose: of a small motion of the world seen by the camera, in its axes; metres first, then radians.
    pub covariance: Matrix6<f64>,
    /// How far corners are off, root mean square, pixels.
    pub off_px: f64,
}

/// Why it cannot be told where a camera is.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Unlocated {
    /// No tag with a known place is in the image.
    #[error("no tag of the rig file is seen")]
    NoTag,
    /// Corners are not where any pose puts them.
    #[error(
        "the corners of the tags are {off_px:.1} px off: sizes and places of the tags, and the lens, are to be looked at"
    )]
    FarOff {
        /// Root mean square, pixels.
        off_px: f64,
    },
    /// Two poses are as good.
    #[error("a tag alone, so small that it may be tilted to either side")]
    Ambiguous,
}

/// A corner of a tag, in the world and in the image.
struct Corner {
    world_m: Vector3<f64>,
    seen_px: [f64; 2],
    /// From the camera in the middle of the exposure to that at the instant of the corner's row.
    row_from_middle: Transform,
}

/// Where a camera is by the tags that it sees, each with its corners as [`super::Spotted`] tells them.
pub fn locate(camera: &Seeing<'_>, tags: &[(&PlacedTag, [[f64; 2]; 4])]) -> Result<Located, Unlocated> {
    let intrinsics = camera.intrinsics;
    let corners: Vec<Corner> = tags.iter().flat_map(|(tag, seen_px)| corners(camera, tag, seen_px)).collect();
    let starts = tags.iter().flat_map(|(tag, seen_px)| starts(intrinsics, tag, seen_px));
    let mut found: Vec<(f64, Transform)> = starts.filter_map(|start| refine(intrinsics, &corners, start)).collect();
    found.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    let Some(&(squares, camera_from_world)) = found.first() else { return Err(Unlocated::NoTag) };
    let off_px = off_px(intrinsics, &corners, &camera_from_world);
    if off_px > MAX_OFF_PX {
        return Err(Unlocated::FarOff { off_px });
    }
    // Noise alone puts this much between a pose and itself.
    let floor = corners.len() as f64 * CORNER_SIGMA_PX * CORNER_SIGMA_PX;
    let is_another = |(_, pose): &&(f64, Transform)| (pose * camera_from_world.inverse()).rotation.angle() > 0.05;
    if found.iter().find(is_another).is_some_and(|(other, _)| other + floor < MIN_RATIO * (squares + floor)) {
        return Err(Unlocated::Ambiguous);
    }
    let sigma_px = off_px.max(CORNER_SIGMA_PX);
    let (_, normal, _) = equations(intrinsics, &corners, &camera_from_world).ok_or(Unlocated::NoTag)?;
    let covariance = normal.try_inverse().ok_or(Unlocated::Ambiguous)? * sigma_px * sigma_px;
    Ok(Located { world_from_camera: camera_from_world.inverse(), covariance, off_px })
}

/// Corners on the tag, metres, in the order of the detector.
fn on_tag(size_m: f64) -> [Vector3<f64>; 4] {
    [[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]].map(|[x, y]| Vector3::new(x, y, 0.0) * (0.5 * size_m))
}

fn corners(camera: &Seeing<'_>, tag: &PlacedTag, seen_px: &[[f64; 2]; 4]) -> [Corner; 4] {
    let on_tag = on_tag(tag.size_m);
    std::array::from_fn(|ix| Corner {
        world_m: (tag.world_from_tag * nalgebra::Point3::from(on_tag[ix])).coords,
        seen_px: seen_px[ix],
        row_from_middle: camera.row_from_middle(seen_px[ix][1]),
    })
}

/// The poses of the world in the camera that one tag alone suggests; none where the lens has no ray to a corner.
fn starts(intrinsics: &Intrinsics, tag: &PlacedTag, seen_px: &[[f64; 2]; 4]) -> Vec<Transform> {
    let rays = seen_px.map(|pixel| intrinsics.unproject(pixel));
    let [Some(a), Some(b), Some(c), Some(d)] = rays else { return Vec::new() };
    let Some(first) = by_homography(tag.size_m, [a, b, c, d]) else { return Vec::new() };
    // The other one: the tag mirrored at the plane through it that faces the camera.
    let sight = first.translation.vector.normalize();
    let normal = first.rotation * Vector3::z();
    let mirrored = sight * (2.0 * sight.dot(&normal)) - normal;
    let turn = UnitQuaternion::rotation_between(&normal, &mirrored).unwrap_or_default();
    let second = Transform::from_parts(first.translation, turn * first.rotation);
    let tag_from_world = tag.world_from_tag.inverse();
    vec![first * tag_from_world, second * tag_from_world]
}

/// The pose of a tag in the camera by the homography from its plane to the plane `z` = 1 of the camera.
///
/// Source: Zhang 2000, "A flexible new technique for camera calibration", section 3.1.
fn by_homography(size_m: f64, rays: [Vector3<f64>; 4]) -> Option<Transform> {
    let mut rows = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (ix, (corner, ray)) in on_tag(size_m).iter().zip(rays).enumerate() {
        let ([x, y], [u, v]) = ([corner.x, corner.y], [ray.x / ray.z, ray.y / ray.z]);
        rows.set_row(2 * ix, &[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y].into());
        rows.set_row(2 * ix + 1, &[0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y].into());
        (right[2 * ix], right[2 * ix + 1]) = (u, v);
    }
    let h = rows.lu().solve(&right)?;
    let (first, second, center) =
        (Vector3::new(h[0], h[3], h[6]), Vector3::new(h[1], h[4], h[7]), Vector3::new(h[2], h[5], 1.0));
    let scale = 2.0 / (first.norm() + second.norm());
    let (x, y) = (first * scale, second * scale);
    let nearly = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&nearly));
    let found = Transform::from_parts((center * scale).into(), rotation);
    transform::is_finite(&found).then_some(found)
}

/// The pose of the world in the camera with the least squares near one, and those squares.
fn refine(intrinsics: &Intrinsics, corners: &[Corner], mut pose: Transform) -> Option<(f64, Transform)> {
    let (mut squares, mut normal, mut right) = equations(intrinsics, corners, &pose)?;
    let mut damping = 1e-4;
    for _ in 0..MAX_ITERATIONS {
        let damped = normal + Matrix6::from_diagonal(&(normal.diagonal() * damping));
        let step = damped.cholesky()?.solve(&right);
        let twist = Twist { linear_m_s: step.fixed_rows::<3>(0).into(), angular_rad_s: step.fixed_rows::<3>(3).into() };
        let next = transform::exp(&twist, 1.0) * pose;
        match equations(intrinsics, corners, &next) {
            Some(better) if better.0 < squares => {
                let gained = squares - better.0;
                (pose, damping) = (next, damping * 0.1);
                (squares, normal, right) = better;
                if gained < 1e-9 * squares {
                    break;
                }
            }
            _ if damping > 1e6 => break,
            _ => damping *= 10.0,
        }
    }
    Some((squares, pose))
}

/// Sum of the squares of what is off, px², large ones tempered, and the normal equations for a small motion of the world in the camera's axes; `None`
/// where a corner is not before the camera.
fn equations(
    intrinsics: &Intrinsics,
    corners: &[Corner],
    camera_from_world: &Transform,
) -> Option<(f64, Matrix6<f64>, Vector6<f64>)> {
    let (mut squares, mut normal, mut right) = (0.0, Matrix6::zeros(), Vector6::zeros());
    for Corner { world_m, seen_px, row_from_middle } in corners {
        let point = camera_from_world.rotation * world_m + camera_from_world.translation.vector;
        let at_row = row_from_middle.rotation * point + row_from_middle.translation.vector;
        let (pixel, by_point): (_, Matrix2x3<f64>) = intrinsics.project_with_jacobian(&at_row)?;
        let off = nalgebra::Vector2::new(seen_px[0] - pixel[0], seen_px[1] - pixel[1]);
        let mut by_motion = Matrix3x6::identity();
        by_motion.fixed_view_mut::<3, 3>(0, 3).copy_from(&-point.cross_matrix());
        let jacobian = by_point * row_from_middle.rotation.to_rotation_matrix().matrix() * by_motion;
        let off_px = off.norm();
        let weight = HUBER_PX / off_px.max(HUBER_PX);
        squares += weight * (2.0 - weight) * off_px * off_px;
        normal += jacobian.transpose() * jacobian * weight;
        right += jacobian.transpose() * off * weight;
    }
    Some((squares, normal, right))
}

/// How far corners are off, root mean square, pixels.
fn off_px(intrinsics: &Intrinsics, corners: &[Corner], camera_from_world: &Transform) -> f64 {
    let squares = corners.iter().map(|Corner { world_m, seen_px, row_from_middle }| {
        let point = row_from_middle * camera_from_world * nalgebra::Point3::from(*world_m);
        let [u, v] = intrinsics.project(&point.coords).unwrap_or([f64::INFINITY; 2]);
        (seen_px[0] - u).powi(2) + (seen_px[1] - v).powi(2)
    });
    (squares.sum::<f64>() / corners.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Lens;

    fn camera(lens: Lens) -> Intrinsics {
        Intrinsics {
            size_px: [640, 480],
            focal_px: [600.0, 602.0],
            principal_px: [322.0, 238.0],
            lens,
            rectified: false,
        }
    }

    /// All rows are exposed at the same time.
    fn at_once(intrinsics: &Intrinsics) -> Seeing<'_> {
        Seeing { intrinsics, twist: Twist::zero(), readout_secs: 0.0 }
    }

    #[test]
    fn a_camera_that_moves_while_its_rows_are_exposed_is_found_where_it_was_in_the_middle() {
        let (intrinsics, middle, tag) = (camera(Lens::Pinhole), before(0.5), tag(0.0, [0.2, -0.6, 2.5]));
        let twist = Twist { linear_m_s: Vector3::new(0.2, -0.1, 0.1), angular_rad_s: Vector3::new(0.3, 0.5, -0.4) };
        let camera = Seeing { intrinsics: &intrinsics, twist, readout_secs: 0.03 };
        // Each corner from where the camera is at the instant of the row that it is seen in.
        let mut pixels = seen(&intrinsics, &middle, &tag, [[0.0; 2]; 4]);
        for _ in 0..20 {
            pixels = std::array::from_fn(|ix| {
                let then = middle * camera.row_from_middle(pixels[ix][1]).inverse();
                seen(&intrinsics, &then, &tag, [[0.0; 2]; 4])[ix]
            });
        }
        let off = |camera: &Seeing<'_>| error(&locate(camera, &[(&tag, pixels)]).expect("a large tag"), &middle);
        let [m, rad] = off(&camera);
        assert!(m < 1e-8 && rad < 1e-8, "{m} m, {rad} rad");
        assert!(off(&at_once(&intrinsics))[0] > 1e-3, "it does not matter here");
    }

    fn tag(x: f64, turn: [f64; 3]) -> PlacedTag {
        PlacedTag { size_m: 0.1, world_from_tag: Transform::new(Vector3::new(x, 0.2, 0.4), Vector3::from(turn)) }
    }

    /// What a camera sees of a tag; `off_px` from corner to corner.
    fn seen(
        camera: &Intrinsics,
        world_from_camera: &Transform,
        tag: &PlacedTag,
        off_px: [[f64; 2]; 4],
    ) -> [[f64; 2]; 4] {
        let on_tag = on_tag(tag.size_m);
        std::array::from_fn(|ix| {
            let world = tag.world_from_tag * nalgebra::Point3::from(on_tag[ix]);
            let [u, v] = camera.project(&(world_from_camera.inverse() * world).coords).expect("before the camera");
            [u + off_px[ix][0], v + off_px[ix][1]]
        })
    }

    /// A camera at so many metres before the tag at `x` = 0, turned a little.
    fn before(distance_m: f64) -> Transform {
        Transform::new(Vector3::new(0.05, 0.15, 0.4 - distance_m), Vector3::new(0.1, -0.15, 0.05))
    }

    fn error(located: &Located, truth: &Transform) -> [f64; 2] {
        let off = located.world_from_camera.inverse() * truth;
        [off.translation.vector.norm(), off.rotation.angle()]
    }

    #[test]
    fn without_noise_the_pose_comes_back_through_every_lens() {
        let d455 = Lens::BrownConrady([-0.0555, 0.0657, -0.0006, 0.0004, -0.0213]);
        for lens in [Lens::Pinhole, d455, Lens::KannalaBrandt([-0.01, 0.02, -0.015, 0.003])] {
            let (camera, truth) = (camera(lens), before(0.6));
            for turn in [[0.0; 3], [0.5, 0.0, 0.0], [0.2, -0.6, 2.5]] {
                let tag = tag(0.0, turn);
                let pixels = seen(&camera, &truth, &tag, [[0.0; 2]; 4]);
                let located = locate(&at_once(&camera), &[(&tag, pixels)]).expect("a large tag");
                let [m, rad] = error(&located, &truth);
                assert!(m < 1e-8 && rad < 1e-8 && located.off_px < 1e-6, "{lens:?} {turn:?}: {m} m, {rad} rad");
            }
        }
    }

    #[test]
    fn errors_are_as_large_as_the_covariance_says() {
        let (camera, truth, tag) = (camera(Lens::Pinhole), before(0.5), tag(0.0, [0.4, 0.3, 0.1]));
        let mut random = 88_172_645_463_325_252_u64;
        let mut normal = || {
            // The sum of twelve even numbers, less six.
            (0..12)
                .map(|_| {
                    random ^= random << 13;
                    random ^= random >> 7;
                    random ^= random << 17;
                    (random >> 11) as f64 / (1_u64 << 53) as f64
                })
                .sum::<f64>()
                - 6.0
        };
        let (mut chi2, n) = (0.0, 400);
        for _ in 0..n {
            let off = std::array::from_fn(|_| [CORNER_SIGMA_PX * normal(), CORNER_SIGMA_PX * normal()]);
            let located = locate(&at_once(&camera), &[(&tag, seen(&camera, &truth, &tag, off))]).expect("a large tag");
            let off = transform::log(&(located.world_from_camera.inverse() * truth), 1.0);
            let off = Vector6::from_iterator(off.linear_m_s.iter().chain(&off.angular_rad_s).copied());
            let expected = located.covariance * (CORNER_SIGMA_PX / located.off_px.max(CORNER_SIGMA_PX)).powi(2);
            chi2 += (off.transpose() * expected.try_inverse().expect("it is one") * off).x;
        }
        let mean = chi2 / f64::from(n);
        assert!((5.0..7.2).contains(&mean), "6 numbers are free: {mean}");
    }

    #[test]
    fn a_small_tag_alone_is_ambiguous_and_two_are_not() {
        let (camera, truth) = (camera(Lens::Pinhole), before(3.0));
        let (one, other) = (tag(0.0, [0.05, 0.1, 0.0]), tag(0.8, [0.0, -0.2, 0.0]));
        let noise = [[0.3, -0.2], [-0.25, 0.3], [0.2, 0.25], [-0.3, -0.2]];
        let see = |tag: &PlacedTag| seen(&camera, &truth, tag, noise);
        assert_eq!(locate(&at_once(&camera), &[(&one, see(&one))]), Err(Unlocated::Ambiguous));
        let located = locate(&at_once(&camera), &[(&one, see(&one)), (&other, see(&other))]).expect("two tags");
        let [m, rad] = error(&located, &truth);
        // The other tilt is 0.28 rad away.
        assert!(m < 0.1 && rad < 0.05, "{m} m, {rad} rad");
    }

    #[test]
    fn tags_that_are_elsewhere_than_told_are_noticed() {
        let (camera, truth) = (camera(Lens::Pinhole), before(0.7));
        let (one, other) = (tag(0.0, [0.1, 0.0, 0.0]), tag(0.25, [0.0, 0.1, 0.0]));
        let see = |tag: &PlacedTag| seen(&camera, &truth, tag, [[0.0; 2]; 4]);
        let moved = PlacedTag {
            world_from_tag: Transform::translation(0.0, 0.03, 0.0) * other.world_from_tag,
            ..other.clone()
        };
        let told = locate(&at_once(&camera), &[(&one, see(&one)), (&moved, see(&other))]);
        assert!(matches!(told, Err(Unlocated::FarOff { off_px }) if off_px > MAX_OFF_PX), "{told:?}");
        assert_eq!(locate(&at_once(&camera), &[]), Err(Unlocated::NoTag));
        let behind = [[f64::NAN; 2]; 4];
        assert_eq!(locate(&at_once(&camera), &[(&one, behind)]), Err(Unlocated::NoTag));
        let at_one_point = [[100.0, 100.0]; 4];
        assert!(locate(&at_once(&camera), &[(&one, at_one_point)]).is_err());
    }
}
