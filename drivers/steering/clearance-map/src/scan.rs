//! Depth images of a scan of a range scanner, so that scans and depth cameras share one way into the
//! map.
//!
//! A scan is drawn into four square images around the scanner. Each pixel has the closest point of
//! the scan. Scanners measure along rings, so the pixels between two rings get the closer one of
//! their depths: what is smaller than the gap between two rings is not in the map.

use crate::image::{DepthImage, DepthOrigin, Posture};
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::FRAC_PI_2;
use std::sync::Arc;

/// Focal length of an image, pixels. The angle of a pixel, 1.8 degrees, is close to the angle
/// between the rings of small scanners.
const FOCAL_PX: f64 = 32.0;
/// Pixels per side of an image. The images overlap by 13 degrees on each side: the map frees a voxel
/// only if the image contains all of its surroundings, which cover this angle at a distance of
/// 0.3 m.
const SIDE_PX: u32 = 104;
/// Largest number of pixels between two rings. The rings of a scanner with 16 rings over 30 degrees
/// are 1.2 pixels apart.
const MAX_GAP_PX: usize = 2;
/// Number of images around the scanner.
const N_IMAGES: u32 = 4;

/// The depth images of a scan.
///
/// * `scanner`: its name, which must differ from those of all cameras.
/// * `world_from_scanner`: pose of the scanner in the middle of the scan.
/// * `points_in_world`: all points of the scan.
/// * `posture`: the robot at the time of the scan.
#[must_use]
pub fn images_of_scan(
    scanner: &str,
    world_from_scanner: &Transform,
    points_in_world: &[[f64; 3]],
    posture: &Posture,
) -> Vec<DepthImage> {
    let stamp: Stamp = posture.stamp;
    (0..N_IMAGES)
        .map(|ix| {
            let world_from_camera = world_from_scanner * scanner_from_camera(ix);
            let depth_m = draw(&world_from_camera, points_in_world);
            DepthImage {
                camera: format!("{scanner} {ix}").into(),
                stamp,
                size_px: [SIDE_PX; 2],
                focal_px: [FOCAL_PX; 2],
                principal_px: [0.5 * f64::from(SIDE_PX); 2],
                depth_m: Arc::from(depth_m),
                world_from_camera,
                posture: posture.clone(),
                origin: DepthOrigin::Measured,
            }
        })
        .collect()
}

/// Pose of a virtual camera: x right, y down, z forward. The scanner has z up.
fn scanner_from_camera(ix: u32) -> Transform {
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), f64::from(ix) * FRAC_PI_2);
    let forward = UnitQuaternion::face_towards(&Vector3::x(), &-Vector3::z());
    Transform::from_parts(Translation3::identity(), heading * forward)
}

/// Depth of each pixel, meters; 0 without a point.
fn draw(world_from_camera: &Transform, points_in_world: &[[f64; 3]]) -> Vec<f32> {
    let camera_from_world = world_from_camera.inverse();
    let side = SIDE_PX as usize;
    let half = 0.5 * f64::from(SIDE_PX);
    let mut depth_m = vec![f32::INFINITY; side * side];
    for point in points_in_world {
        let at = camera_from_world * Point3::from(*point);
        let (Some(column), Some(row)) = (
            pixel(half + FOCAL_PX * at.x / at.z),
            pixel(half + FOCAL_PX * at.y / at.z),
        ) else {
            continue;
        };
        if at.z > 0.0 {
            let depth = &mut depth_m[row * side + column];
            #[expect(clippy::cast_possible_truncation, reason = "depth images use f32")]
            let z = at.z as f32;
            *depth = depth.min(z);
        }
    }
    for column in 0..side {
        fill_gaps(&mut depth_m, column);
    }
    for depth in &mut depth_m {
        if !depth.is_finite() {
            *depth = 0.0;
        }
    }
    depth_m
}

/// Index of a pixel; `None` outside of the image.
fn pixel(at: f64) -> Option<usize> {
    let is_inside = at >= 0.0 && at < f64::from(SIDE_PX);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the range is checked"
    )]
    is_inside.then_some(at as usize)
}

/// Fills short gaps of a column with the closer one of the depths at both ends.
fn fill_gaps(depth_m: &mut [f32], column: usize) {
    let side = SIDE_PX as usize;
    let mut last: Option<usize> = None;
    for row in 0..side {
        if !depth_m[row * side + column].is_finite() {
            continue;
        }
        if let Some(last) = last.filter(|last| row - last - 1 <= MAX_GAP_PX) {
            let ends = [last, row].map(|row| depth_m[row * side + column]);
            for between in last + 1..row {
                depth_m[between * side + column] = ends[0].min(ends[1]);
            }
        }
        last = Some(row);
    }
}
