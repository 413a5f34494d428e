//! Scenes of known shapes, and exact keyframes of them.

use crate::{DepthMap, Keyframe, Split};
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use numbers::f32_of;
use std::f64::consts::PI;
use std::sync::Arc;

/// Size of the depth images, pixels.
pub const SIZE_PX: [u32; 2] = [96, 80];
/// Focal length of the depth camera, pixels.
pub const FOCAL_PX: [f64; 2] = [90.0, 88.0];
/// Principal point of the depth camera, pixels.
pub const PRINCIPAL_PX: [f64; 2] = [47.0, 41.5];

/// A shape with a surface.
#[derive(Clone, Copy, Debug)]
pub enum TestShape {
    /// A sphere.
    Sphere {
        /// Center in world, meters.
        center_m: Point3<f64>,
        /// Radius, meters.
        radius_m: f64,
    },
    /// The points whose dot product with the unit normal equals the offset.
    Plane {
        /// Unit normal.
        normal: Vector3<f64>,
        /// Offset along the normal, meters.
        offset_m: f64,
    },
}

impl TestShape {
    /// Depth of the first surface along a ray. The depth is a multiple of `direction`, whose z is 1
    /// in the camera.
    fn depth_m(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let depth_m = match self {
            Self::Sphere { center_m, radius_m } => {
                let from = origin - center_m;
                // The nearer root of `a t² + 2 b t + c = 0`.
                let a = direction.norm_squared();
                let b = direction.dot(&from);
                let root = b * b - a * (from.norm_squared() - radius_m * radius_m);
                (root >= 0.0).then(|| (-b - root.sqrt()) / a)?
            }
            Self::Plane { normal, offset_m } => {
                (offset_m - normal.dot(&origin.coords)) / normal.dot(direction)
            }
        };
        (depth_m > 0.0).then_some(depth_m)
    }

    /// Distance to the surface. It is unsigned for planes. For spheres, it is signed, and positive
    /// outside.
    pub fn distance_m(&self, point: &Point3<f64>) -> f64 {
        match self {
            Self::Sphere { center_m, radius_m } => (point - center_m).norm() - radius_m,
            Self::Plane { normal, offset_m } => (normal.dot(&point.coords) - offset_m).abs(),
        }
    }
}

/// Color of the world at a point.
pub fn color_srgb(point: &Point3<f64>) -> [f64; 3] {
    [0, 1, 2].map(|axis| 0.5 + 0.4 * (3.0 * point[axis] + axis as f64).sin())
}

/// Pose of a camera at `eye` that faces `target`, z up.
pub fn look_at(eye: Point3<f64>, target: Point3<f64>) -> Transform {
    // If the camera faces straight up or down, z does not determine the rotation about the line of
    // sight.
    let up = if (target - eye).xy().norm() < 1e-9 {
        Vector3::y()
    } else {
        Vector3::z()
    };
    Transform::face_towards(&eye, &target, &up)
        // nalgebra looks along z with y up, but a camera has y down.
        * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI)
}

/// A keyframe of the shapes with exact depth and color.
pub fn keyframe(ix: i64, shapes: &[TestShape], world_from_camera: Transform) -> Keyframe {
    // The color camera is 4 cm to the side of the depth camera and has a different size.
    let color_pose = world_from_camera * Transform::translation(0.04, 0.0, 0.0);
    let depth_m: Vec<f32> =
        cast_pixels(shapes, &world_from_camera, SIZE_PX, FOCAL_PX, PRINCIPAL_PX)
            .map(|hit| hit.map_or(0.0, |(depth, _)| f32_of(depth)))
            .collect();
    let color_size = [120, 100];
    let color_focal = [110.0, 110.0];
    let color_principal = [60.0, 50.0];
    let rgba: Vec<u8> = cast_pixels(
        shapes,
        &color_pose,
        color_size,
        color_focal,
        color_principal,
    )
    .flat_map(|hit| {
        let [red, green, blue] = hit.map_or([0; 3], |(_, point)| bytes(color_srgb(&point)));
        [red, green, blue, 255]
    })
    .collect();
    Keyframe {
        camera: "test".into(),
        stamp: Stamp(ix),
        size_px: color_size,
        focal_px: color_focal,
        principal_px: color_principal,
        rgba_srgb: rgba.into(),
        depth: Some(DepthMap {
            size_px: SIZE_PX,
            focal_px: FOCAL_PX,
            principal_px: PRINCIPAL_PX,
            depth_m: depth_m.into(),
            world_from_camera,
        }),
        world_from_camera: color_pose,
        twist: None,
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: None,
        split: Split::Train,
        truth: None,
        robot: None,
    }
}

/// Like [`keyframe`], in the size of a depth camera's images.
pub fn large_keyframe(ix: i64, shapes: &[TestShape], world_from_camera: Transform) -> Keyframe {
    let size_px = [640, 480];
    let focal_px = [525.0; 2];
    let principal_px = [320.0, 240.0];
    let mut keyframe = keyframe(ix, shapes, world_from_camera);
    let hits: Vec<_> =
        cast_pixels(shapes, &world_from_camera, size_px, focal_px, principal_px).collect();
    let colors = hits.iter().flat_map(|hit| {
        let [red, green, blue] = hit.map_or([0; 3], |(_, point)| bytes(color_srgb(&point)));
        [red, green, blue, 255]
    });
    keyframe.rgba_srgb = colors.collect::<Vec<u8>>().into();
    keyframe.size_px = size_px;
    keyframe.focal_px = focal_px;
    keyframe.principal_px = principal_px;
    keyframe.world_from_camera = world_from_camera;
    let depth_m: Vec<f32> = hits
        .iter()
        .map(|hit| hit.map_or(0.0, |(depth, _)| f32_of(depth)))
        .collect();
    keyframe.depth = Some(DepthMap {
        size_px,
        focal_px,
        principal_px,
        depth_m: depth_m.into(),
        world_from_camera,
    });
    keyframe
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "colors are between 0 and 1"
)]
fn bytes(color: [f64; 3]) -> [u8; 3] {
    color.map(|part| (255.0 * part).round() as u8)
}

/// Depth and position of the first surface along each pixel's ray.
fn cast_pixels(
    shapes: &[TestShape],
    world_from_camera: &Transform,
    [width, height]: [u32; 2],
    focal: [f64; 2],
    principal: [f64; 2],
) -> impl Iterator<Item = Option<(f64, Point3<f64>)>> {
    let origin: Point3<f64> = world_from_camera.translation.vector.into();
    let pixels = (0..height)
        .flat_map(move |y| (0..width).map(move |x| [f64::from(x) + 0.5, f64::from(y) + 0.5]));
    pixels.map(move |pixel| {
        let in_camera = Vector3::new(
            (pixel[0] - principal[0]) / focal[0],
            (pixel[1] - principal[1]) / focal[1],
            1.0,
        );
        let direction = world_from_camera.rotation * in_camera;
        let depth = shapes
            .iter()
            .filter_map(|shape| shape.depth_m(&origin, &direction))
            .min_by(f64::total_cmp)?;
        Some((depth, origin + direction * depth))
    })
}

/// A ball with a radius of 30 cm, centered at `at`.
pub fn ball(at: Point3<f64>) -> TestShape {
    TestShape::Sphere {
        center_m: at,
        radius_m: 0.3,
    }
}

/// The floor below a ball at the origin.
pub fn floor() -> TestShape {
    TestShape::Plane {
        normal: Vector3::z(),
        offset_m: -0.3,
    }
}

/// `n` views of a point from all sides, evenly distributed over the sphere (Vogel 1979).
pub fn all_around(shapes: &[TestShape], target: Point3<f64>, n: usize) -> Vec<Arc<Keyframe>> {
    (0..n)
        .map(|ix| {
            let height = 1.0 - (2 * ix + 1) as f64 / n as f64;
            // This is the golden angle, pi (3 - sqrt 5). It separates views of similar height as
            // far as possible.
            let angle = ix as f64 * 2.399_963;
            let radius = (1.0 - height * height).sqrt();
            let eye =
                target + 1.0 * Vector3::new(radius * angle.cos(), radius * angle.sin(), height);
            Arc::new(keyframe(
                i64::try_from(ix).expect("few images"),
                shapes,
                look_at(eye, target),
            ))
        })
        .collect()
}

/// Views from a part of a ring above the floor.
pub fn ring(shapes: &[TestShape], target: Point3<f64>, n: usize) -> Vec<Arc<Keyframe>> {
    (0..n)
        .map(|ix| {
            let angle = 0.35 * ix as f64;
            let eye = target + Vector3::new(1.1 * angle.cos(), 1.1 * angle.sin(), 0.5);
            Arc::new(keyframe(
                i64::try_from(ix).expect("few images"),
                shapes,
                look_at(eye, target),
            ))
        })
        .collect()
}
