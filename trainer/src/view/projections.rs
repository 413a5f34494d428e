//! Pictures of any projection, composed of pinhole pictures: panoramas from the six faces of a cube.
#![expect(
    clippy::cast_possible_truncation,
    reason = "pixels are rounded down on purpose, within image sizes that are u32"
)]

use super::{Camera, LOW_PASS_PX2};
use crate::{Error, PendingPicture, Picture, Projection, RenderRequest};
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
        Projection::Equirectangular => {
            let faces: Vec<Picture> = faces(request).iter().map(draw).collect::<Result<_, _>>()?;
            Ok(panorama(request.size_px, &faces))
        }
    }
}

/// Renders a request with `queue`, which queues one pinhole picture.
pub(crate) fn queue(
    request: &RenderRequest,
    mut queue: impl FnMut(&Camera) -> Result<PendingPicture, Error>,
) -> Result<PendingPicture, Error> {
    match request.projection {
        Projection::Pinhole { focal_px, principal_px } => queue(&Camera::from_request(request, focal_px, principal_px)),
        Projection::Equirectangular => {
            let pending: Vec<PendingPicture> = faces(request).iter().map(queue).collect::<Result<_, _>>()?;
            let size_px = request.size_px;
            Ok(PendingPicture::new(move || {
                let finished: Vec<_> = pending.into_iter().map(PendingPicture::finish).collect::<Result<_, _>>()?;
                let faces: Option<Vec<Picture>> = finished.into_iter().collect();
                Ok(faces.map(|faces| panorama(size_px, &faces)))
            }))
        }
    }
}

/// Length of an edge of the cube's faces, pixels.
fn edge_px([width, height]: [u32; 2]) -> u32 {
    (width / 4).max(height / 2).max(1)
}

/// Rotations of the faces of a cube from the camera's axes.
fn face_rotations() -> [Rotation3<f64>; 6] {
    let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
    [
        Rotation3::identity(),
        about(Vector3::y_axis(), FRAC_PI_2),
        about(Vector3::y_axis(), PI),
        about(Vector3::y_axis(), -FRAC_PI_2),
        about(Vector3::x_axis(), FRAC_PI_2),
        about(Vector3::x_axis(), -FRAC_PI_2),
    ]
}

/// Cameras of the faces of a cube around the camera.
fn faces(request: &RenderRequest) -> [Camera; 6] {
    let edge = edge_px(request.size_px);
    face_rotations().map(|rotation| Camera {
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
    })
}

/// Samples the pictures of the faces for each direction.
///
/// Longitude increases along x from -180 to 180 degrees, latitude decreases along y from 90 to -90 degrees; the
/// camera's z axis is at the center. Depth is the distance from the camera's center, not the distance along an axis.
fn panorama([width, height]: [u32; 2], faces: &[Picture]) -> Picture {
    let edge = edge_px([width, height]);
    let has_depth = faces.iter().all(|face| !face.depth_m.is_empty());
    let face_from_camera = face_rotations().map(|rotation| rotation.inverse());
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
    let n = (width * height) as usize;
    let mut picture = Picture {
        size_px: [width, height],
        rgba_srgb: vec![0; 4 * n],
        depth_m: vec![0.0; if has_depth { n } else { 0 }],
    };
    let row_px = width as usize;
    picture.rgba_srgb.par_chunks_mut(4 * row_px).zip(0..height).for_each(|(row, y)| {
        for (pixel, x) in row.chunks_exact_mut(4).zip(0..) {
            let (face, at, _) = sample(x, y);
            pixel.copy_from_slice(&face.rgba_srgb[4 * at..4 * at + 4]);
        }
    });
    picture.depth_m.par_chunks_mut(row_px).zip(0..height).for_each(|(row, y)| {
        for (depth_m, x) in row.iter_mut().zip(0..) {
            let (face, at, cosine) = sample(x, y);
            *depth_m = face.depth_m[at] / cosine;
        }
    });
    picture
}
