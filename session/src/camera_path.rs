//! Viewpoints for rendering: a single pose, or a camera path exported by nerfstudio's viewer.

use crate::Error;
use crate::error::Context;
use keyframe::ensure;
use kinematics::Transform;
use nalgebra::{Matrix3, Matrix4, Rotation3, Translation3, UnitQuaternion};
use serde::Deserialize;
use std::path::Path;

/// One viewpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathCamera {
    /// Pose of the camera: x right, y down, z forward.
    pub world_from_camera: Transform,
    /// Vertical field of view in radians, if the path specifies it.
    pub fov_y_rad: Option<f64>,
}

/// A camera path.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPath {
    /// The cameras, in the order of the path.
    pub cameras: Vec<PathCamera>,
    /// Width and height of the pictures in pixels, if the path specifies them.
    pub size_px: Option<[u32; 2]>,
}

/// The only camera type that is supported in a path.
const PERSPECTIVE: &str = "perspective";

/// The file format of nerfstudio.
#[derive(Debug, Deserialize)]
struct PathFile {
    render_height: Option<u32>,
    render_width: Option<u32>,
    camera_type: Option<String>,
    camera_path: Vec<PathFileCamera>,
}

#[derive(Debug, Deserialize)]
struct PathFileCamera {
    /// Row major, OpenGL axes: the camera looks along -z, y is up.
    camera_to_world: Vec<f64>,
    /// Vertical field of view, degrees.
    fov: Option<f64>,
}

impl CameraPath {
    /// Reads a nerfstudio camera path and converts its cameras to the axes of [`kinematics::camera`].
    pub fn load(path: &Path) -> crate::Result<Self> {
        let text = files::read_text(path).with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("the nerfstudio camera path {}", path.display()))
    }

    /// A path with one viewpoint, from the 16 numbers of `world_from_camera`, row major, with the axes of
    /// [`kinematics::camera`].
    pub fn of_pose(numbers: &[f64]) -> Result<Self, Error> {
        let world_from_camera = rigid(numbers).map_err(|error| Error::BadInput(format!("--pose: {error}")))?;
        Ok(Self { cameras: vec![PathCamera { world_from_camera, fov_y_rad: None }], size_px: None })
    }

    fn parse(text: &str) -> crate::Result<Self> {
        let file: PathFile = serde_json::from_str(text)?;
        ensure!(!file.camera_path.is_empty(), "it contains no cameras");
        let camera_type = file.camera_type.as_deref().unwrap_or(PERSPECTIVE);
        ensure!(
            camera_type == PERSPECTIVE,
            "camera_type is {camera_type:?}, but only {PERSPECTIVE:?} is supported (for panoramas, use --equirect)"
        );
        let camera = |(ix, camera): (usize, &PathFileCamera)| {
            let world_from_opengl = rigid(&camera.camera_to_world).with_context(|| format!("camera {ix}"))?;
            let opengl_from_camera = drivers::dataset::nerfstudio::opengl_from_camera();
            Ok::<_, crate::Error>(PathCamera {
                world_from_camera: world_from_opengl * opengl_from_camera,
                fov_y_rad: camera.fov.map(f64::to_radians),
            })
        };
        Ok(Self {
            cameras: file.camera_path.iter().enumerate().map(camera).collect::<Result<_, _>>()?,
            size_px: file.render_width.zip(file.render_height).map(|(width, height)| [width, height]),
        })
    }
}

/// Converts a row-major 4x4 matrix to a rigid transform.
pub fn rigid(numbers: &[f64]) -> crate::Result<Transform> {
    /// Numbers in files are often rounded to about six digits.
    const TOLERANCE: f64 = 1e-3;
    ensure!(numbers.len() == 16, "a pose has 16 numbers, got {}", numbers.len());
    ensure!(numbers.iter().all(|number| number.is_finite()), "the pose has a non-finite number");
    let matrix = Matrix4::from_row_slice(numbers);
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
    let deviation = (rotation * rotation.transpose() - Matrix3::identity()).amax();
    ensure!(deviation < TOLERANCE && rotation.determinant() > 0.0, "the upper left 3x3 block is not a rotation");
    ensure!(
        (matrix.row(3) - nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0)).amax() < TOLERANCE,
        "the last row is not 0 0 0 1"
    );
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
    Ok(Transform::from_parts(Translation3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]), rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    const IDENTITY: [f64; 16] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];

    #[test]
    fn nerfstudio_camera_axes_are_converted() {
        let text = serde_json::json!({
            "render_height": 480, "render_width": 640,
            "camera_path": [{ "camera_to_world": [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1], "fov": 90.0, "aspect": 1.33 }],
        });
        let path = CameraPath::parse(&text.to_string()).expect("a path");
        assert_eq!(path.size_px, Some([640, 480]));
        let camera = path.cameras[0];
        assert_eq!(camera.fov_y_rad, Some(std::f64::consts::FRAC_PI_2));
        let ahead_in_world = camera.world_from_camera * Point3::new(0.0, 0.0, 1.0);
        assert!((ahead_in_world - Point3::new(1.0, 2.0, 2.0)).norm() < 1e-12, "{ahead_in_world}");
        let below_in_world = camera.world_from_camera * Point3::new(0.0, 1.0, 0.0);
        assert!((below_in_world - Point3::new(1.0, 1.0, 3.0)).norm() < 1e-12, "{below_in_world}");
    }

    #[test]
    fn only_perspective_cameras_are_supported() {
        let of_type = |camera_type: &str| {
            let text =
                serde_json::json!({ "camera_type": camera_type, "camera_path": [{ "camera_to_world": IDENTITY }] });
            CameraPath::parse(&text.to_string())
        };
        assert!(of_type("perspective").is_ok());
        assert!(of_type("fisheye").expect_err("a fisheye").to_string().contains("fisheye"));
    }

    #[test]
    fn invalid_poses_are_reported() {
        assert!(CameraPath::of_pose(&IDENTITY).is_ok());
        let mut stretched = IDENTITY;
        stretched[0] = 2.0;
        let mut mirrored = IDENTITY;
        mirrored[0] = -1.0;
        let mut unknown = IDENTITY;
        unknown[3] = f64::NAN;
        for (numbers, word) in
            [(&IDENTITY[..15], "16 numbers"), (&stretched, "rotation"), (&mirrored, "rotation"), (&unknown, "finite")]
        {
            let error = CameraPath::of_pose(numbers).expect_err(word).to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
