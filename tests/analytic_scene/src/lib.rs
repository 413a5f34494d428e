//! Exact pictures of two small scenes by ray casting, as the reference for wire and page: three balls
//! on a checkered floor, and checkered boxes. A crate for the tests, so that it can be optimized
//! while they are not.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use trainer::{Picture, Projection, RenderRequest};

/// A ball: center and radius in meters, sRGB color.
struct Ball {
    center: Point3<f64>,
    radius_m: f64,
    color: [f64; 3],
}

/// Red on the x axis, green on the y axis, blue above the origin, so that mirrored or rotated
/// pictures are detected.
const BALLS: [Ball; 3] = [
    Ball {
        center: Point3::new(0.5, 0.0, 0.15),
        radius_m: 0.15,
        color: [0.85, 0.2, 0.15],
    },
    Ball {
        center: Point3::new(0.0, 0.5, 0.15),
        radius_m: 0.15,
        color: [0.2, 0.7, 0.25],
    },
    Ball {
        center: Point3::new(0.0, 0.0, 0.5),
        radius_m: 0.12,
        color: [0.2, 0.35, 0.9],
    },
];
/// Half size of the floor. Beyond it, background is visible.
const FLOOR_HALF_M: f64 = 1.0;

/// A camera at (0, -2, 0.5) that looks along the world's y axis.
pub fn looking_along_y() -> Isometry3<f64> {
    let rotation =
        Rotation3::from_matrix_unchecked(Matrix3::new(1., 0., 0., 0., 0., 1., 0., -1., 0.));
    Isometry3::from_parts(
        Translation3::new(0.0, -2.0, 0.5),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// Renders a request.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "colors are between 0 and 1, depths are meters"
)]
pub fn draw(request: &RenderRequest) -> Picture {
    let [width, height] = request.size_px;
    let eye = Point3::from(request.world_from_camera.translation.vector);
    let (mut rgba_srgb, mut depth_m) = (Vec::new(), Vec::new());
    for y in 0..height {
        for x in 0..width {
            let (_, direction) = ray_in_world(request, f64::from(x) + 0.5, f64::from(y) + 0.5);
            let hit = nearest_hit(request, eye, direction);
            let color = hit.map_or(request.background_srgb.map(f64::from), |hit| hit.1);
            rgba_srgb.extend(color.map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8));
            rgba_srgb.push(if hit.is_some() { 255 } else { 0 });
            depth_m.push(hit.map_or(0.0, |hit| hit.0 as f32));
        }
    }
    Picture {
        size_px: request.size_px,
        rgba_srgb,
        depth_m,
    }
}

/// Eye and direction of a pixel in world; hits of the direction are depths.
pub fn ray_in_world(request: &RenderRequest, u: f64, v: f64) -> (Point3<f64>, Vector3<f64>) {
    let eye = Point3::from(request.world_from_camera.translation.vector);
    (
        eye,
        request.world_from_camera.rotation * ray_in_camera(request, u, v),
    )
}

/// Direction of a pixel; its length is 1 along z (pinhole) or 1 (equirectangular), so that hits are
/// depths.
fn ray_in_camera(request: &RenderRequest, u: f64, v: f64) -> Vector3<f64> {
    match request.projection {
        Projection::Pinhole {
            focal_px,
            principal_px,
        } => Vector3::new(
            (u - principal_px[0]) / focal_px[0],
            (v - principal_px[1]) / focal_px[1],
            1.0,
        ),
        Projection::Equirectangular => {
            let longitude = (u / f64::from(request.size_px[0]) - 0.5) * std::f64::consts::TAU;
            let latitude = (0.5 - v / f64::from(request.size_px[1])) * std::f64::consts::PI;
            Vector3::new(
                latitude.cos() * longitude.sin(),
                -latitude.sin(),
                latitude.cos() * longitude.cos(),
            )
        }
    }
}

fn nearest_hit(
    request: &RenderRequest,
    eye: Point3<f64>,
    direction: Vector3<f64>,
) -> Option<(f64, [f64; 3])> {
    let balls = BALLS.iter().filter_map(|ball| {
        let from_center = eye - ball.center;
        let (a, b) = (direction.norm_squared(), direction.dot(&from_center));
        let discriminant = b * b - a * (from_center.norm_squared() - ball.radius_m * ball.radius_m);
        let depth = (discriminant >= 0.0).then(|| (-b - discriminant.sqrt()) / a)?;
        let normal = (eye + direction * depth - ball.center) / ball.radius_m;
        let light = 0.35 + 0.65 * normal.dot(&Vector3::new(0.36, -0.48, 0.8)).max(0.0);
        Some((depth, ball.color.map(|value| value * light)))
    });
    let floor_depth = -eye.z / direction.z;
    let on_floor = eye + direction * floor_depth;
    let is_on_floor = on_floor.x.abs() < FLOOR_HALF_M && on_floor.y.abs() < FLOOR_HALF_M;
    let is_dark = ((on_floor.x * 5.0).floor() + (on_floor.y * 5.0).floor()).rem_euclid(2.0) < 0.5;
    let floor = is_on_floor.then_some((
        floor_depth,
        if is_dark {
            [0.42, 0.4, 0.38]
        } else {
            [0.72, 0.7, 0.66]
        },
    ));
    balls
        .chain(floor)
        .filter(|(depth, _)| (request.near_m..=request.far_m).contains(depth))
        .min_by(|a, b| a.0.total_cmp(&b.0))
}

/// Draws boxes, each given by two corners in meters, which are visible from both sides.
#[expect(clippy::cast_possible_truncation, reason = "depths are meters")]
pub fn draw_boxes(request: &RenderRequest, boxes: &[[[f64; 3]; 2]]) -> Picture {
    let [width, height] = request.size_px;
    let (mut rgba_srgb, mut depth_m) = (Vec::new(), Vec::new());
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        let (eye, direction) = ray_in_world(request, f64::from(x) + 0.5, f64::from(y) + 0.5);
        let depth = boxes
            .iter()
            .filter_map(|corners| crossings(eye, direction, *corners))
            .flatten()
            .filter(|depth| *depth > request.near_m)
            .fold(f64::INFINITY, f64::min);
        let hit = eye + direction * depth;
        let is_dark = hit
            .iter()
            .map(|along| (along * 4.0).floor())
            .sum::<f64>()
            .rem_euclid(2.0)
            < 0.5;
        rgba_srgb.extend(if is_dark {
            [90, 85, 80, 255]
        } else {
            [190, 185, 175, 255]
        });
        depth_m.push(if depth.is_finite() { depth as f32 } else { 0.0 });
    }
    Picture {
        size_px: request.size_px,
        rgba_srgb,
        depth_m,
    }
}

/// Distances along a ray at which it enters and leaves a box.
fn crossings(
    eye: Point3<f64>,
    direction: Vector3<f64>,
    [min, max]: [[f64; 3]; 2],
) -> Option<[f64; 2]> {
    let mut range = [f64::NEG_INFINITY, f64::INFINITY];
    for axis in 0..3 {
        let at = [min, max].map(|corner| (corner[axis] - eye[axis]) / direction[axis]);
        range = [
            range[0].max(at[0].min(at[1])),
            range[1].min(at[0].max(at[1])),
        ];
    }
    (range[0] < range[1]).then_some(range)
}
