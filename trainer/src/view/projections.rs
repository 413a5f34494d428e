//! Pictures of any projection, composed of pinhole pictures: panoramas from the six faces of a cube.
#![expect(
    clippy::cast_possible_truncation,
    reason = "pixels are rounded down on purpose, within image sizes that are u32"
)]

use super::{Camera, LOW_PASS_PX2};
use crate::{Error, Picture, Projection, RenderRequest};
use kinematics::Transform;
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};

/// Renders a request with `draw`, which renders one pinhole picture. Depth is rendered only if requested.
pub(crate) fn render(
    request: &RenderRequest,
    mut draw: impl FnMut(&Camera) -> Result<Picture, Error>,
) -> Result<Picture, Error> {
    match request.projection {
        Projection::Pinhole { focal_px, principal_px } => draw(&Camera::from_request(request, focal_px, principal_px)),
        Projection::Equirectangular => all_directions(request, draw),
    }
}

/// Draws the cube's faces with `draw` and samples them for each direction.
///
/// Longitude increases along x from -180 to 180 degrees, latitude decreases along y from 90 to -90 degrees; the
/// camera's z axis is at the center. Depth is the distance from the camera's center, not the distance along an axis.
fn all_directions(
    request: &RenderRequest,
    mut draw: impl FnMut(&Camera) -> Result<Picture, Error>,
) -> Result<Picture, Error> {
    let [width, height] = request.size_px;
    let edge = (width / 4).max(height / 2).max(1);
    let face = |rotation: Rotation3<f64>| Camera {
        world_from_camera: request.world_from_camera
            * Transform::from_parts(
                nalgebra::Translation3::identity(),
                UnitQuaternion::from_rotation_matrix(&rotation),
            ),
        size_px: [edge; 2],
        focal_px: [f64::from(edge) / 2.0; 2],
        principal_px: [f64::from(edge) / 2.0; 2],
        shutter: None,
        near_m: request.near_m,
        far_m: request.far_m,
        crop: request.crop,
        low_pass_px2: LOW_PASS_PX2,
    };
    let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
    let face_rotations = [
        Rotation3::identity(),
        about(Vector3::y_axis(), FRAC_PI_2),
        about(Vector3::y_axis(), PI),
        about(Vector3::y_axis(), -FRAC_PI_2),
        about(Vector3::x_axis(), FRAC_PI_2),
        about(Vector3::x_axis(), -FRAC_PI_2),
    ];
    let faces: Vec<Picture> = face_rotations.iter().map(|rotation| draw(&face(*rotation))).collect::<Result<_, _>>()?;
    let face_from_camera = face_rotations.map(|rotation| rotation.inverse());
    // The picture of the face that a pixel shows, the index of the pixel in it, and the cosine of the angle to its axis.
    let sample = |x: u32, y: u32| {
        let latitude = FRAC_PI_2 - PI * (f64::from(y) + 0.5) / f64::from(height);
        let longitude = 2.0 * PI * (f64::from(x) + 0.5) / f64::from(width) - PI;
        let direction =
            Vector3::new(latitude.cos() * longitude.sin(), -latitude.sin(), latitude.cos() * longitude.cos());
        let (face, in_face) = faces
            .iter()
            .zip(face_from_camera.iter().map(|rotation| rotation * direction))
            .max_by(|(_, a), (_, b)| a.z.total_cmp(&b.z))
            .expect("a cube has six faces");
        let pixel = |axis: usize| {
            let coordinate = f64::from(edge) / 2.0 * (1.0 + in_face[axis] / in_face.z);
            (coordinate.max(0.0) as u32).min(edge - 1)
        };
        (face, (pixel(1) * edge + pixel(0)) as usize, crate::gpu::f32_of(in_face.z))
    };
    let (row_px, n) = (width as usize, (width * height) as usize);
    let mut picture = Picture { size_px: request.size_px, rgba_srgb: vec![0; 4 * n], depth_m: vec![0.0; n] };
    let rows = picture.rgba_srgb.par_chunks_mut(4 * row_px).zip(picture.depth_m.par_chunks_mut(row_px));
    rows.zip(0..height).for_each(|((colors, depths), y)| {
        for ((pixel, depth_m), x) in colors.chunks_exact_mut(4).zip(depths).zip(0..) {
            let (face, at, cosine) = sample(x, y);
            pixel.copy_from_slice(&face.rgba_srgb[4 * at..4 * at + 4]);
            if request.depth {
                *depth_m = face.depth_m[at] / cosine;
            }
        }
    });
    if !request.depth {
        picture.depth_m = Vec::new();
    }
    Ok(picture)
}
