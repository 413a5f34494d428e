//! Points on the surfaces of a scene, from depth images.

use clearance_map::DepthImage;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use numbers::random::Random;

/// Number of pixels of each image that are taken.
const N_PER_IMAGE: usize = 24;

/// A point on a surface, in the frame of the robot's base.
#[derive(Clone, Copy, Debug)]
pub(super) struct SurfacePoint {
    pub(super) at_m: Point3<f64>,
    /// Direction in which the camera saw it.
    pub(super) seen_along: Vector3<f64>,
}

/// Random pixels of an image that have depth.
pub(super) fn surface_points(
    image: &DepthImage,
    world_from_base: &Transform,
    random: &mut Random,
) -> Vec<SurfacePoint> {
    let base_from_camera = world_from_base.inverse() * image.world_from_camera;
    let [width, height] = image.size_px.map(|side| side as usize);
    let pixels = (0..N_PER_IMAGE).map(|_| [random.below(width), random.below(height)]);
    pixels
        .filter_map(|[column, row]| {
            let depth_m = f64::from(*image.depth_m.get(row * width + column)?);
            // Pixels without depth are 0.
            if depth_m <= 0.0 {
                return None;
            }
            let in_camera = Vector3::new(
                (column as f64 + 0.5 - image.principal_px[0]) / image.focal_px[0],
                (row as f64 + 0.5 - image.principal_px[1]) / image.focal_px[1],
                1.0,
            );
            Some(SurfacePoint {
                at_m: base_from_camera * Point3::from(in_camera * depth_m),
                seen_along: (base_from_camera.rotation * in_camera).normalize(),
            })
        })
        .collect()
}
