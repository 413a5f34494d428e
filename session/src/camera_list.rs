//! The camera poses of a run, stored in `cameras.json` next to the model. Viewers draw these
//! cameras and derive the initial view from them.

use crate::{camera_path, run_folder};
use anyhow::Context;
use calibration::CalibratedCamera;
use keyframe::{Keyframe, split_name};
use kinematics::{Stamp, Transform};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;
use trainer::AlignedModel;
use viz::KeyframePose;

/// Name of the file in the run folder.
pub const FILE: &str = "cameras.json";

/// Pose and intrinsics of one keyframe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PosedCamera {
    /// Name of the camera.
    pub camera: String,
    /// Stamp of the image, nanoseconds.
    pub stamp_nanos: i64,
    /// Name of the split: train, validation or test.
    pub split: String,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
    /// 4x4 matrix, row major.
    pub world_from_camera: [f64; 16],
}

#[derive(Serialize, Deserialize)]
struct File {
    cameras: Vec<PosedCamera>,
}

/// The cameras of keyframes with the model's corrections applied.
pub(crate) fn of_model(method: &mut AlignedModel, keyframes: &[Arc<Keyframe>]) -> Vec<PosedCamera> {
    let mut cameras = Vec::new();
    for keyframe in keyframes {
        // The list is an aid for viewers. An error, such as a lost GPU, must not prevent it.
        let lens = method.calibrated_camera(keyframe).unwrap_or_else(|error| {
            log::debug!("listing a camera without its learned correction: {error}");
            CalibratedCamera::of(keyframe)
        });
        cameras.push(PosedCamera {
            camera: keyframe.camera.to_string(),
            stamp_nanos: keyframe.stamp.0,
            split: split_name(keyframe.split).to_owned(),
            size_px: keyframe.size_px,
            focal_px: lens.focal_px,
            principal_px: lens.principal_px,
            world_from_camera: row_major(&lens.world_from_camera),
        });
    }
    cameras
}

/// Writes the list, one camera per line.
pub fn write(folder: &Path, cameras: &[PosedCamera]) -> anyhow::Result<()> {
    let lines: Vec<String> = cameras
        .iter()
        .map(serde_json::to_string)
        .collect::<Result<_, _>>()?;
    run_folder::write_atomic(
        &folder.join(FILE),
        &format!("{{\"cameras\": [\n{}\n]}}\n", lines.join(",\n")),
    )
}

/// Reads the list; `None` if the folder has none.
pub fn read(folder: &Path) -> anyhow::Result<Option<Vec<KeyframePose>>> {
    let path = folder.join(FILE);
    let text = match files::read_text(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
    };
    let File { cameras } =
        serde_json::from_str(&text).with_context(|| format!("{} is damaged", path.display()))?;
    // The matrices may have been edited or rounded by other programs, so each one is checked.
    let posed = cameras.into_iter().map(|camera| {
        let world_from_camera =
            camera_path::rigid(&camera.world_from_camera).with_context(|| {
                let name = &camera.camera;
                let stamp = camera.stamp_nanos;
                format!("{}: the pose of {name} {stamp}", path.display())
            })?;
        Ok(KeyframePose {
            camera: camera.camera.into(),
            stamp: Stamp(camera.stamp_nanos),
            world_from_camera,
            size_px: camera.size_px,
            focal_px: camera.focal_px,
            principal_px: camera.principal_px,
        })
    });
    posed.collect::<anyhow::Result<_>>().map(Some)
}

/// The 4x4 matrix of a pose, row major.
pub fn row_major(pose: &Transform) -> [f64; 16] {
    let rows = pose.to_homogeneous().transpose();
    std::array::from_fn(|ix| rows[ix])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Isometry3, Vector3};

    fn camera() -> PosedCamera {
        let pose = Isometry3::new(Vector3::new(0.5, -2.0, 1.25), Vector3::new(0.3, -1.1, 0.7));
        PosedCamera {
            camera: "wrist".into(),
            stamp_nanos: -7,
            split: "test".into(),
            size_px: [64, 48],
            focal_px: [50.0, 51.0],
            principal_px: [32.0, 24.0],
            world_from_camera: row_major(&pose),
        }
    }

    #[test]
    fn camera_list_round_trips() {
        let folder = tempfile::tempdir().expect("a folder");
        assert!(read(folder.path()).expect("no file is no error").is_none());
        write(folder.path(), &[camera(), camera()]).expect("disk space");
        let cameras = read(folder.path()).expect("a list").expect("a file");
        assert_eq!(
            (
                cameras.len(),
                cameras[0].camera.as_ref(),
                cameras[1].size_px
            ),
            (2, "wrist", [64, 48])
        );
        for (number, expected) in row_major(&cameras[1].world_from_camera)
            .iter()
            .zip(camera().world_from_camera)
        {
            assert!((number - expected).abs() < 1e-12);
        }
        write(folder.path(), &[]).expect("disk space");
        assert_eq!(
            read(folder.path())
                .expect("a list")
                .map(|cameras| cameras.len()),
            Some(0)
        );
    }

    #[test]
    fn damaged_list_error_names_the_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut skewed = camera();
        skewed.world_from_camera[0] = 3.0;
        write(folder.path(), &[skewed]).expect("disk space");
        let message = format!("{:#}", read(folder.path()).expect_err("not rigid"));
        assert!(
            message.contains(FILE) && message.contains("wrist -7"),
            "{message}"
        );
        std::fs::write(folder.path().join(FILE), "{").expect("disk space");
        assert!(format!("{:#}", read(folder.path()).expect_err("truncated")).contains("damaged"));
    }
}
