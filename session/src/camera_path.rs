//! Viewpoints for rendering: a single pose, or a camera path exported by nerfstudio's viewer.

use anyhow::{Context, ensure};
use kinematics::{Transform, transform};
use messages::{BadInput, Setting, shortened};
use serde::Deserialize;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// One viewpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PathCamera {
    /// Pose of the camera: x right, y down, z forward.
    pub(crate) world_from_camera: Transform,
    /// Vertical field of view in radians, if the path specifies it.
    pub(crate) fov_y_rad: Option<f64>,
}

/// A camera path.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CameraPath {
    /// The cameras, in the order of the path.
    pub(crate) cameras: Vec<PathCamera>,
    /// Width and height of the pictures in pixels, if the path specifies them.
    pub(crate) size_px: Option<[u32; 2]>,
    /// Whether the path was made for panoramas.
    pub(crate) is_panoramic: bool,
    /// Notes about parts of the file that are not used: one sentence each.
    pub(crate) notes: Vec<String>,
}

const PERSPECTIVE: &str = "perspective";
const EQUIRECTANGULAR: &str = "equirectangular";
/// Largest side of a picture: the largest texture that GPUs commonly support. A mistyped size would
/// otherwise fail only when memory runs out.
const MAX_SIDE_PX: f64 = 16384.0;
/// Keys that do not change the pictures: how the path was edited, and how its video is played.
const UNUSED: [&str; 9] = [
    "default_transition_sec",
    "fps",
    "is_cycle",
    "keyframes",
    "seconds",
    "smoothness_value",
    // Keys of one camera.
    "aspect",
    "file_path",
    "render_time",
];

/// The file format of nerfstudio. Sizes are whole numbers, but the viewer writes them with
/// decimals.
#[derive(Debug, Deserialize)]
struct PathFile {
    render_height: Option<f64>,
    render_width: Option<f64>,
    camera_type: Option<String>,
    /// Vertical field of view of cameras without their own, degrees.
    default_fov: Option<f64>,
    camera_path: Vec<PathFileCamera>,
    #[serde(flatten)]
    other: BTreeMap<String, Value>,
}

#[derive(Debug, Deserialize)]
struct PathFileCamera {
    /// Row major, OpenGL axes: the camera looks along -z, y is up.
    camera_to_world: Vec<f64>,
    /// Vertical field of view, degrees.
    fov: Option<f64>,
    #[serde(flatten)]
    other: BTreeMap<String, Value>,
}

impl PathFile {
    fn size_px(&self) -> anyhow::Result<Option<[u32; 2]>> {
        let width = whole_side("render_width", self.render_width)?;
        let height = whole_side("render_height", self.render_height)?;
        ensure!(
            width.is_some() == height.is_some(),
            "render_width and render_height must be given together"
        );
        Ok(width.zip(height).map(|(width, height)| [width, height]))
    }

    fn notes(&self) -> Vec<String> {
        // Each camera has its own keys, so a long path could name hundreds.
        const MAX_NAMED: usize = 5;
        let of_cameras = self.camera_path.iter().flat_map(|camera| &camera.other);
        let is_unknown = |key: &str, value: &Value| !UNUSED.contains(&key) && !value.is_null();
        let all = self
            .other
            .iter()
            .chain(of_cameras)
            .filter(|(key, value)| is_unknown(key, value));
        let unknown: BTreeSet<&str> = all.map(|(key, _)| key.as_str()).collect();
        if unknown.is_empty() {
            return Vec::new();
        }
        let quoted: Vec<String> = unknown.iter().map(|key| format!("{key:?}")).collect();
        let named = shortened(&quoted, MAX_NAMED, ", ");
        let advice = if unknown.contains("crop") {
            format!("; for \"crop\", use {}", Setting::Crop)
        } else {
            String::new()
        };
        vec![format!("unknown keys are not used: {named}{advice}")]
    }
}

/// A width or height as a whole number of pixels; `None` if it is not given.
fn whole_side(name: &str, side_px: Option<f64>) -> anyhow::Result<Option<u32>> {
    let Some(side_px) = side_px else {
        return Ok(None);
    };
    ensure!(
        side_px.fract() == 0.0 && (1.0..=MAX_SIDE_PX).contains(&side_px),
        "{name} is {side_px}, must be a whole number from 1 to {MAX_SIDE_PX}"
    );
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "checked above"
    )]
    Ok(Some(side_px as u32))
}

impl CameraPath {
    /// Reads a nerfstudio camera path and converts its cameras to the axes of
    /// [`kinematics::camera`].
    pub(crate) fn load(path: &Path) -> anyhow::Result<Self> {
        let text =
            files::read_text(path).with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("the nerfstudio camera path {}", path.display()))
    }

    /// A path with one viewpoint, from the 16 numbers of `world_from_camera`, row major, with the
    /// axes of [`kinematics::camera`].
    pub(crate) fn of_pose(numbers: &[f64]) -> anyhow::Result<Self> {
        let world_from_camera =
            rigid(numbers).map_err(|error| BadInput(format!("{}: {error}", Setting::Pose)))?;
        let cameras = vec![PathCamera {
            world_from_camera,
            fov_y_rad: None,
        }];
        Ok(Self {
            cameras,
            size_px: None,
            is_panoramic: false,
            notes: Vec::new(),
        })
    }

    fn parse(text: &str) -> anyhow::Result<Self> {
        let file: PathFile = serde_json::from_str(text)?;
        ensure!(!file.camera_path.is_empty(), "it contains no cameras");
        let camera_type = file.camera_type.as_deref().unwrap_or(PERSPECTIVE);
        ensure!(
            [PERSPECTIVE, EQUIRECTANGULAR].contains(&camera_type),
            "camera_type is {camera_type:?}, but only {PERSPECTIVE:?} and {EQUIRECTANGULAR:?} are supported"
        );
        let mut cameras = Vec::new();
        for (ix, camera) in file.camera_path.iter().enumerate() {
            let world_from_opengl =
                rigid(&camera.camera_to_world).with_context(|| format!("camera {ix}"))?;
            // Converted here and nowhere else; all other code has z forward and y down.
            let opengl_from_camera = drivers::dataset::nerfstudio::opengl_from_camera();
            cameras.push(PathCamera {
                world_from_camera: world_from_opengl * opengl_from_camera,
                fov_y_rad: camera.fov.or(file.default_fov).map(f64::to_radians),
            });
        }
        Ok(Self {
            cameras,
            size_px: file.size_px()?,
            is_panoramic: camera_type == EQUIRECTANGULAR,
            notes: file.notes(),
        })
    }
}

/// Converts a row-major 4x4 matrix, whose numbers may be rounded, to a rigid transform.
pub(crate) fn rigid(numbers: &[f64]) -> anyhow::Result<Transform> {
    let rows: &[f64; 16] = numbers
        .try_into()
        .ok()
        .with_context(|| format!("a pose has 16 numbers, got {}", numbers.len()))?;
    let (pose, _) =
        transform::from_rounded_rows(rows).map_err(|error| BadInput(error.to_string()))?;
    Ok(pose)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    const IDENTITY: [f64; 16] = [
        1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0,
    ];

    #[test]
    fn nerfstudio_camera_axes_are_converted() {
        let text = serde_json::json!({
            "render_height": 480, "render_width": 640,
            "camera_path": [{ "camera_to_world": [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1], "fov": 90.0, "aspect": 1.33 }],
        });
        let path = CameraPath::parse(&text.to_string()).expect("a path");
        assert_eq!((path.size_px, &path.notes[..]), (Some([640, 480]), &[][..]));
        let camera = path.cameras[0];
        assert_eq!(camera.fov_y_rad, Some(std::f64::consts::FRAC_PI_2));
        let ahead_in_world = camera.world_from_camera * Point3::new(0.0, 0.0, 1.0);
        assert!(
            (ahead_in_world - Point3::new(1.0, 2.0, 2.0)).norm() < 1e-12,
            "{ahead_in_world}"
        );
        let below_in_world = camera.world_from_camera * Point3::new(0.0, 1.0, 0.0);
        assert!(
            (below_in_world - Point3::new(1.0, 1.0, 3.0)).norm() < 1e-12,
            "{below_in_world}"
        );
    }

    #[test]
    fn only_perspective_cameras_are_supported() {
        let of_type = |camera_type: &str| {
            let text = serde_json::json!({ "camera_type": camera_type, "camera_path": [{ "camera_to_world": IDENTITY }] });
            CameraPath::parse(&text.to_string())
        };
        assert!(!of_type("perspective").expect("a perspective").is_panoramic);
        assert!(of_type("equirectangular").expect("a panorama").is_panoramic);
        assert!(
            of_type("fisheye")
                .expect_err("a fisheye")
                .to_string()
                .contains("fisheye")
        );
    }

    /// The keys in docs/reference/cli.md.
    #[test]
    fn keys_are_used_or_named() {
        let camera = serde_json::json!({ "camera_to_world": IDENTITY });
        let plain =
            serde_json::json!({ "render_width": 8, "render_height": 6, "camera_path": [camera] });
        let parse = |file: &Value| CameraPath::parse(&file.to_string());
        let mut viewer = plain.clone();
        (viewer["render_width"], viewer["render_height"]) = (8.0.into(), 6.0.into());
        for key in &UNUSED[..6] {
            viewer[*key] = 1.into();
        }
        for key in &UNUSED[6..] {
            viewer["camera_path"][0][*key] = 1.into();
        }
        assert_eq!(
            parse(&viewer).expect("as the viewer writes it"),
            parse(&plain).expect("a path")
        );
        for (key, note) in [
            (
                "crop",
                "unknown keys are not used: \"crop\"; for \"crop\", use crop",
            ),
            ("smooth", "unknown keys are not used: \"smooth\""),
        ] {
            let mut changed = plain.clone();
            changed[key] = 1.into();
            assert_eq!(parse(&changed).expect("a path").notes, [note]);
            let mut changed = plain.clone();
            changed["camera_path"][0][key] = 1.into();
            assert_eq!(parse(&changed).expect("a path").notes, [note]);
        }
        let mut many = plain.clone();
        for key in ["a", "b", "c", "d", "e", "f", "g"] {
            many[key] = 1.into();
        }
        let note = r#"unknown keys are not used: "a", "b", "c", "d", "e" and 2 more"#;
        assert_eq!(parse(&many).expect("a path").notes, [note]);
        let mut wide = plain.clone();
        wide["default_fov"] = 90.into();
        assert_eq!(
            parse(&wide).expect("a path").cameras[0].fov_y_rad,
            Some(std::f64::consts::FRAC_PI_2)
        );
        for size in ["0", "7.5", "-8", "1e9", "null"] {
            let text = plain
                .to_string()
                .replace("\"render_width\":8", &format!("\"render_width\":{size}"));
            match CameraPath::parse(&text) {
                Err(error) => assert!(error.to_string().contains("render_width "), "{error}"),
                Ok(path) => panic!("{size}: {:?}", path.size_px),
            }
        }
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
        for (numbers, word) in [
            (&IDENTITY[..15], "16 numbers"),
            (&stretched, "not rigid"),
            (&mirrored, "not rigid"),
            (&unknown, "finite"),
        ] {
            let error = CameraPath::of_pose(numbers).expect_err(word).to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
