//! A picture of the whole scene for the report: the final model, seen obliquely from above.

use super::seen_places::SeenPlaces;
use kinematics::Transform;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use report::inline_picture::data_uri;
use trainer::{AlignedModel, Projection, RenderRequest};

/// Maximum size of the picture, pixels.
const MAX_SIZE_PX: [u32; 2] = [720, 450];
/// Maximum number of pixels, relative to the largest image. Small images give models without fine
/// detail. Without a GPU, a picture of the maximum size would then take longer than the test
/// images.
const MAX_IMAGES: f64 = 4.0;
const QUALITY: u8 = 82;
/// Focal length in heights of the picture: a vertical field of view of 50 degrees.
const FOCAL_HEIGHTS: f64 = 1.072;
/// Angle above the horizon. With a much larger angle, the picture would look like a map. With a
/// much smaller angle, walls and furniture would hide each other.
const ELEVATION_RAD: f64 = 0.7;
/// Distance of the eye from the center in radii of the scene, so that the scene fills most of the
/// picture.
const DISTANCE_RADII: f64 = 1.9;
/// Parts of the model that are farther from the center than this, toward the eye, are not drawn.
/// Otherwise, the wall behind the cameras would hide the room.
const CUT_RADII: f64 = 1.15;
const FAR_RADII: f64 = 50.0;

/// An oblique picture of the model as a data URI; `None` without keyframes.
///
/// * `image_px`: number of pixels of the largest image.
pub(super) fn draw(
    method: &mut AlignedModel,
    seen: &SeenPlaces,
    image_px: u64,
) -> anyhow::Result<Option<String>> {
    let Some(world_from_camera) = oblique_view(seen) else {
        return Ok(None);
    };
    let size_px = size_for(image_px);
    let [width, height] = size_px.map(f64::from);
    let background_srgb = method.model().background_srgb();
    let picture = method.model_mut().render(&RenderRequest {
        world_from_camera,
        size_px,
        projection: Projection::Pinhole {
            focal_px: [FOCAL_HEIGHTS * height; 2],
            principal_px: [0.5 * width, 0.5 * height],
        },
        shutter: None,
        near_m: (DISTANCE_RADII - CUT_RADII) * seen.radius_m,
        far_m: FAR_RADII * seen.radius_m,
        crop: None,
        edits: std::sync::Arc::default(),
        background_srgb,
        appearance_of: None,
        depth: false,
    })?;
    let rgb: Vec<u8> = picture
        .rgba_srgb
        .as_chunks::<4>()
        .0
        .iter()
        .flat_map(|[red, green, blue, _]| [*red, *green, *blue])
        .collect();
    data_uri(&rgb, size_px, QUALITY).map(Some)
}

/// Width and height at which pages show the picture, CSS pixels.
pub(super) fn shown_size() -> [u32; 2] {
    MAX_SIZE_PX
}

/// Size of the picture, pixels, for images of this many pixels.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    reason = "pixels of a picture"
)]
fn size_for(image_px: u64) -> [u32; 2] {
    let max_px: f64 = MAX_SIZE_PX.map(f64::from).iter().product();
    let scale = (MAX_IMAGES * image_px as f64 / max_px).sqrt().min(1.0);
    MAX_SIZE_PX.map(|side| ((f64::from(side) * scale) as u32).max(1))
}

/// An upright view of the center from the side of the cameras; `None` without any place.
fn oblique_view(seen: &SeenPlaces) -> Option<Transform> {
    let center = Vector3::from(seen.center_m);
    let n = seen.cameras.len();
    let mean = seen
        .cameras
        .iter()
        .map(|camera| Vector3::from(camera.eye_m) - center)
        .sum::<Vector3<f64>>()
        / (n.max(1) as f64);
    // Cameras that look from all sides, or straight down, have no side.
    let side = Vector3::new(mean.x, mean.y, 0.0)
        .try_normalize(0.1 * seen.radius_m)
        .unwrap_or_else(|| -Vector3::y());
    let direction = ELEVATION_RAD.cos() * side + ELEVATION_RAD.sin() * Vector3::z();
    // The axes of a camera: x right, y down, z forward. `right` is horizontal.
    let forward = -direction;
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let eye = center + DISTANCE_RADII * seen.radius_m * direction;
    (n > 0 && eye.iter().all(|coordinate| coordinate.is_finite()))
        .then(|| Transform::from_parts(Translation3::from(eye), rotation))
}

#[cfg(test)]
mod tests {
    use super::super::seen_places::SeenCamera;
    use super::*;
    use nalgebra::Point3;

    #[test]
    fn pictures_are_no_finer_than_the_images() {
        assert_eq!(size_for(640 * 480), MAX_SIZE_PX);
        assert_eq!(size_for(160 * 120), [350, 219]);
    }

    #[test]
    fn view_is_oblique_upright_and_from_the_side_of_the_cameras() {
        const TOLERANCE_M: f64 = 1e-9;
        let camera = |eye_m: [f64; 3]| SeenCamera {
            eye_m,
            corners_m: [[0.0; 3]; 4],
            is_test: false,
        };
        let mut seen = SeenPlaces {
            center_m: [1.0, 2.0, 0.5],
            radius_m: 0.8,
            cameras: vec![camera([3.0, 2.2, 1.0]), camera([3.0, 1.8, 1.0])],
        };
        let view = oblique_view(&seen).expect("cameras");
        let center_in_camera = view.inverse() * Point3::from(seen.center_m);
        let expected = Point3::new(0.0, 0.0, DISTANCE_RADII * seen.radius_m);
        assert!(
            (center_in_camera - expected).norm() < TOLERANCE_M,
            "{center_in_camera}"
        );
        let eye = view.translation.vector;
        assert!(
            eye.x > 1.5 && (eye.y - 2.0).abs() < TOLERANCE_M && eye.z > 1.0,
            "{eye}"
        );
        assert!(
            (view.rotation * Vector3::x()).z.abs() < TOLERANCE_M,
            "it is upright"
        );
        // Cameras straight above the center.
        seen.cameras = vec![camera([1.0, 2.0, 2.0])];
        let above = oblique_view(&seen).expect("cameras").translation.vector;
        assert!(above.y < 1.5, "{above}");
        seen.cameras.clear();
        assert!(oblique_view(&seen).is_none());
    }
}
