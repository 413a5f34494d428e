//! Stores the keyframes of a live run on disk, next to its checkpoint, for `run --resume`. The page
//! shows the photographs of a saved run from these files.
//!
//! Each keyframe is a separate file in the layout of a checkpoint (`docs/reference/files.md`), with
//! its color and depth as PNG. Ground truth from a simulator is left out.

use crate::run_folder::KEYFRAMES;
use crate::stored_robot::{self, RobotDescription};
use anyhow::{Context, ensure};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use keyframe::masked_robot::ConvexPiece;
use keyframe::{BaseState, DepthMap, Keyframe, split_from_name, split_name};
use kinematics::transform::{from_xyz_xyzw, to_xyz_xyzw};
use kinematics::{Stamp, Twist};
use model_files::checkpoint::{Array, Checkpoint};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const EXTENSION: &str = "keyframe";
const METHOD: &str = "keyframe";
const COLOR: &str = "rgba_srgb.png";
const DEPTH: &str = "depth_m.png";

/// A folder of keyframes.
#[derive(Clone, Debug)]
pub struct StoredKeyframes {
    folder: PathBuf,
}

/// A keyframe without its pixels.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    camera: String,
    stamp_nanos: i64,
    size_px: [u32; 2],
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    world_from_camera: [f64; 7],
    twist: Option<[f64; 6]>,
    readout_secs: f64,
    joint_twists: Vec<[f64; 6]>,
    split: String,
    depth: Option<DepthDescription>,
    base: Option<BaseDescription>,
    /// The robot that is masked. Keyframes of older versions lack it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    robot: Option<RobotDescription>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DepthDescription {
    size_px: [u32; 2],
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    world_from_camera: [f64; 7],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BaseDescription {
    station: Option<usize>,
    world_from_base: [f64; 7],
    map_from_odom: [f64; 7],
}

impl StoredKeyframes {
    /// The stored keyframes of the run in this folder. Does not access the disk.
    pub fn of_run(run: &Path) -> Self {
        Self {
            folder: run.join(KEYFRAMES),
        }
    }

    /// Writes the keyframes that are not stored yet, and those that are stored with an earlier pose.
    pub fn add(
        &self,
        keyframes: &[Arc<Keyframe>],
        revised: &[Arc<Keyframe>],
    ) -> anyhow::Result<()> {
        std::fs::create_dir_all(&self.folder)
            .with_context(|| format!("cannot create {}", self.folder.display()))?;
        let existing = self.names()?;
        for keyframe in keyframes {
            let name = name_of(keyframe);
            let is_revised = revised.iter().any(|revised| Arc::ptr_eq(revised, keyframe));
            if is_revised || !existing.contains(&name) {
                to_checkpoint(keyframe)?.write(&self.folder.join(name))?;
            }
        }
        Ok(())
    }

    /// Removes all files except those of these keyframes.
    pub fn keep_only(&self, keyframes: &[Arc<Keyframe>]) -> anyhow::Result<()> {
        let stored: BTreeSet<String> = keyframes.iter().map(|keyframe| name_of(keyframe)).collect();
        for name in self.names()?.difference(&stored) {
            let path = self.folder.join(name);
            std::fs::remove_file(&path)
                .with_context(|| format!("cannot remove {}", path.display()))?;
        }
        Ok(())
    }

    /// Reads all keyframes, ordered by stamp. Those that cannot be read are left out, each with a
    /// warning.
    ///
    /// # Errors
    ///
    /// Fails if the folder cannot be listed, or if none of its keyframes can be read.
    pub fn read(&self) -> anyhow::Result<Vec<Arc<Keyframe>>> {
        let names = self.names()?;
        let mut keyframes = Vec::new();
        let mut errors = Vec::new();
        let mut links = None;
        for name in &names {
            let path = self.folder.join(name);
            let mut read = || keyframe_of(&Checkpoint::read(&path)?, &mut links);
            match read().with_context(|| format!("cannot read the keyframe {}", path.display())) {
                Ok(keyframe) => keyframes.push(Arc::new(keyframe)),
                Err(error) => errors.push(error),
            }
        }
        // Without any keyframe, the cause probably concerns the whole folder, and there is nothing
        // to continue with.
        if keyframes.is_empty()
            && let Some(error) = errors.pop()
        {
            return Err(error);
        }
        for error in errors {
            log::warn!("{error:#}; the run continues without it");
        }
        // File names begin with the camera, so they are not in the order of the stamps.
        keyframes.sort_by(|one, other| (one.stamp, &one.camera).cmp(&(other.stamp, &other.camera)));
        Ok(keyframes)
    }

    /// Whether the folder exists.
    pub fn exist(&self) -> bool {
        self.folder.is_dir()
    }

    /// Reads the keyframe with this camera and stamp; `None` if it is not stored.
    ///
    /// # Errors
    ///
    /// Fails if its file cannot be read.
    pub fn read_one(&self, camera: &str, stamp: Stamp) -> anyhow::Result<Option<Keyframe>> {
        let name = file_name(camera, stamp);
        // The names of the cameras of a saved model come from a file, which may be from elsewhere.
        if Path::new(&name).file_name() != Some(OsStr::new(&name)) {
            return Ok(None);
        }
        let path = self.folder.join(name);
        if !path.is_file() {
            return Ok(None);
        }
        let read = || keyframe_of(&Checkpoint::read(&path)?, &mut None);
        let keyframe =
            read().with_context(|| format!("cannot read the keyframe {}", path.display()))?;
        Ok(Some(keyframe))
    }

    fn names(&self) -> anyhow::Result<BTreeSet<String>> {
        let names = file_names(&self.folder)
            .with_context(|| format!("cannot list {}", self.folder.display()))?;
        let names = names.into_iter().filter_map(|name| name.into_string().ok());
        // Other files, such as temporary ones, are neither read nor removed.
        Ok(names
            .filter(|name| {
                Path::new(name)
                    .extension()
                    .is_some_and(|extension| extension == EXTENSION)
            })
            .collect())
    }
}

/// Names of the files in a folder.
fn file_names(folder: &Path) -> std::io::Result<Vec<OsString>> {
    std::fs::read_dir(folder)?
        .map(|entry| entry.map(|entry| entry.file_name()))
        .collect()
}

/// File name of a keyframe.
fn name_of(keyframe: &Keyframe) -> String {
    file_name(&keyframe.camera, keyframe.stamp)
}

/// File name of the keyframe with this camera and stamp. The stamp is padded with zeros to 20
/// digits, so that the names of a camera are in the order of its stamps.
fn file_name(camera: &str, stamp: Stamp) -> String {
    format!("{camera}_{:020}.{EXTENSION}", stamp.0)
}

fn to_checkpoint(keyframe: &Keyframe) -> anyhow::Result<Checkpoint> {
    let robot = keyframe.robot.as_deref().map(stored_robot::to_stored);
    let (robot, arrays_of_robot) = robot.unzip();
    let description = Description {
        camera: keyframe.camera.to_string(),
        stamp_nanos: keyframe.stamp.0,
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
        world_from_camera: to_xyz_xyzw(&keyframe.world_from_camera),
        twist: keyframe.twist.as_ref().map(twist_numbers),
        readout_secs: keyframe.readout_secs,
        joint_twists: keyframe.joint_twists.iter().map(twist_numbers).collect(),
        split: split_name(keyframe.split).to_owned(),
        depth: keyframe.depth.as_ref().map(|depth| DepthDescription {
            size_px: depth.size_px,
            focal_px: depth.focal_px,
            principal_px: depth.principal_px,
            world_from_camera: to_xyz_xyzw(&depth.world_from_camera),
        }),
        base: keyframe.base.as_ref().map(|base| BaseDescription {
            station: base.station,
            world_from_base: to_xyz_xyzw(&base.world_from_base),
            map_from_odom: to_xyz_xyzw(&base.map_from_odom),
        }),
        robot,
    };
    let mut arrays = vec![Array {
        name: COLOR.to_owned(),
        bytes: png(keyframe.size_px, &keyframe.rgba_srgb)?,
    }];
    if let Some(depth) = &keyframe.depth {
        let bytes: Vec<u8> = depth
            .depth_m
            .iter()
            .flat_map(|depth_m| depth_m.to_le_bytes())
            .collect();
        arrays.push(Array {
            name: DEPTH.to_owned(),
            bytes: png(depth.size_px, &bytes)?,
        });
    }
    arrays.extend(arrays_of_robot.into_iter().flatten());
    Ok(Checkpoint {
        method: METHOD.to_owned(),
        seconds: 0.0,
        depth_from: None,
        flags: BTreeMap::new(),
        is_finished: false,
        edits: model_files::Edits::default(),
        history: model_files::RunHistory::default(),
        state: serde_json::to_value(description)?,
        arrays,
    })
}

/// Decodes a keyframe.
///
/// * `links`: see [`stored_robot::of_stored`].
fn keyframe_of(
    checkpoint: &Checkpoint,
    links: &mut Option<Arc<[Vec<ConvexPiece>]>>,
) -> anyhow::Result<Keyframe> {
    ensure!(
        checkpoint.method == METHOD,
        "it contains a {}, expected a {METHOD}",
        checkpoint.method
    );
    let metadata: Description = serde_json::from_value(checkpoint.state.clone())?;
    let depth = metadata
        .depth
        .as_ref()
        .map(|depth| depth_of(checkpoint, depth));
    let robot = metadata
        .robot
        .as_ref()
        .map(|robot| stored_robot::of_stored(robot, &checkpoint.arrays, links))
        .transpose()?;
    Ok(Keyframe {
        camera: metadata.camera.into(),
        stamp: Stamp(metadata.stamp_nanos),
        size_px: metadata.size_px,
        focal_px: metadata.focal_px,
        principal_px: metadata.principal_px,
        rgba_srgb: pixels_of(checkpoint, COLOR, metadata.size_px)?.into(),
        depth: depth.transpose()?,
        world_from_camera: from_xyz_xyzw(metadata.world_from_camera),
        twist: metadata.twist.map(twist),
        readout_secs: metadata.readout_secs,
        joint_twists: metadata.joint_twists.into_iter().map(twist).collect(),
        base: metadata.base.map(|base| BaseState {
            station: base.station,
            world_from_base: from_xyz_xyzw(base.world_from_base),
            map_from_odom: from_xyz_xyzw(base.map_from_odom),
            truth: None,
        }),
        split: split_from_name(&metadata.split)
            .with_context(|| format!("unknown split {:?}", metadata.split))?,
        truth: None,
        robot: robot.map(Arc::new),
    })
}

/// Decodes the depth map of a stored keyframe.
fn depth_of(checkpoint: &Checkpoint, description: &DepthDescription) -> anyhow::Result<DepthMap> {
    let bytes = pixels_of(checkpoint, DEPTH, description.size_px)?;
    // The four channels of a pixel are the bytes of its depth, as `png` has encoded them.
    let depth_m = bytes
        .as_chunks::<4>()
        .0
        .iter()
        .map(|bytes| f32::from_le_bytes(*bytes));
    Ok(DepthMap {
        size_px: description.size_px,
        focal_px: description.focal_px,
        principal_px: description.principal_px,
        depth_m: depth_m.collect(),
        world_from_camera: from_xyz_xyzw(description.world_from_camera),
    })
}

/// Decodes a PNG of a stored keyframe to four bytes per pixel.
fn pixels_of(checkpoint: &Checkpoint, name: &str, size_px: [u32; 2]) -> anyhow::Result<Vec<u8>> {
    let array = checkpoint.arrays.iter().find(|array| array.name == name);
    let png = &array
        .with_context(|| format!("array {name:?} is missing"))?
        .bytes;
    let image = image::load_from_memory_with_format(png, image::ImageFormat::Png)?;
    // Other code relies on the number of pixels, and the file may be damaged or from elsewhere.
    ensure!(
        [image.width(), image.height()] == size_px,
        "array {name:?} has the wrong size, expected {size_px:?}"
    );
    Ok(image.into_rgba8().into_raw())
}

/// Losslessly encodes four bytes per pixel. For depth, these are the bytes of an f32, which
/// compress well because neighboring pixels are similar.
fn png([width, height]: [u32; 2], bytes: &[u8]) -> anyhow::Result<Vec<u8>> {
    let mut png = Vec::new();
    // A fast level and one fixed filter: keyframes arrive several times per second, and this thread
    // shares the processors with training and devices.
    let encoder = PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub);
    encoder.write_image(bytes, width, height, ExtendedColorType::Rgba8)?;
    Ok(png)
}

fn twist_numbers(twist: &Twist) -> [f64; 6] {
    let [x, y, z]: [f64; 3] = twist.linear_m_s.into();
    let [a, b, c]: [f64; 3] = twist.angular_rad_s.into();
    [x, y, z, a, b, c]
}

fn twist([x, y, z, a, b, c]: [f64; 6]) -> Twist {
    Twist {
        linear_m_s: Vector3::new(x, y, z),
        angular_rad_s: Vector3::new(a, b, c),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use keyframe::Split;
    use kinematics::Transform;

    pub(crate) fn keyframe(stamp_nanos: i64, depth: bool) -> Arc<Keyframe> {
        let pose = Transform::new(
            Vector3::new(0.1, 1.0 / 3.0, -2.0),
            Vector3::new(0.3, -0.2, 0.1),
        );
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(stamp_nanos),
            size_px: [5, 3],
            focal_px: [4.0, 4.1],
            principal_px: [2.5, 1.5],
            rgba_srgb: (0..60).map(|ix| ix * 4).collect(),
            depth: depth.then(|| DepthMap {
                size_px: [2, 2],
                focal_px: [1.5; 2],
                principal_px: [1.0; 2],
                depth_m: vec![0.0, 1.0 / 3.0, f32::MIN_POSITIVE, 7.25].into(),
                world_from_camera: pose.inverse(),
            }),
            world_from_camera: pose,
            twist: depth.then(|| twist([0.1, 0.2, 0.3, 0.4, 0.5, 0.7])),
            readout_secs: 0.015,
            joint_twists: vec![twist([1.0, 2.0, 3.0, 4.0, 5.0, 1.0 / 7.0])].into(),
            base: depth.then(|| BaseState {
                station: Some(3),
                world_from_base: pose,
                map_from_odom: pose * pose,
                truth: None,
            }),
            split: Split::Validation,
            truth: None,
            robot: None,
        })
    }

    #[test]
    fn keyframes_round_trip_bit_for_bit_in_order() {
        let run = tempfile::tempdir().expect("a folder");
        let stored = StoredKeyframes::of_run(run.path());
        let all = [
            keyframe(9_000_000_000, true),
            keyframe(20, false),
            keyframe(10_000_000_000, true),
        ];
        stored.add(&all[..2], &[]).expect("disk space");
        stored.add(&all, &[]).expect("disk space");
        let read = stored.read().expect("complete files");
        let in_order = [&all[1], &all[0], &all[2]];
        assert_eq!(read.len(), 3);
        for (read, expected) in read.iter().zip(in_order) {
            assert_eq!(
                (read.stamp, &read.camera, read.split),
                (expected.stamp, &expected.camera, expected.split)
            );
            assert_eq!(keyframe::fingerprint(read), keyframe::fingerprint(expected));
            assert_eq!(read.base, expected.base);
        }
        stored.keep_only(&all[1..]).expect("they are there");
        assert_eq!(stored.read().expect("complete files").len(), 2);
    }

    #[test]
    fn revised_keyframe_replaces_the_stored_one() {
        let run = tempfile::tempdir().expect("a folder");
        let stored = StoredKeyframes::of_run(run.path());
        let first = keyframe(1, true);
        let correction = Transform::translation(0.001, 0.0, 0.0);
        let revised = Arc::new(first.with_base_correction(&correction));
        let pose = || stored.read().expect("complete files")[0].world_from_camera;
        stored.add(&[Arc::clone(&first)], &[]).expect("disk space");
        stored
            .add(&[Arc::clone(&revised)], &[])
            .expect("disk space");
        assert_eq!(pose(), first.world_from_camera, "written only once");
        let again = [Arc::clone(&revised)];
        stored.add(&again, &again).expect("disk space");
        assert_eq!(pose(), revised.world_from_camera);
    }

    #[test]
    fn single_keyframes_are_read_from_the_folder_only() {
        let run = tempfile::tempdir().expect("a folder");
        let stored = StoredKeyframes::of_run(run.path());
        assert!(!stored.exist());
        stored.add(&[keyframe(7, true)], &[]).expect("disk space");
        assert!(stored.exist());
        let read = |camera: &str, stamp| stored.read_one(camera, Stamp(stamp));
        let found = read("wrist", 7).expect("a complete file").expect("stored");
        assert_eq!(
            keyframe::fingerprint(&found),
            keyframe::fingerprint(&keyframe(7, true))
        );
        assert!(read("wrist", 8).expect("no error").is_none());
        // A file beside the folder that has the right name.
        let name = file_name("wrist", Stamp(7));
        let inside = run.path().join(KEYFRAMES).join(&name);
        std::fs::copy(inside, run.path().join(&name)).expect("disk space");
        assert!(read("../wrist", 7).expect("no error").is_none());
    }

    #[test]
    fn damaged_files_are_left_out_and_named() {
        let run = tempfile::tempdir().expect("a folder");
        let stored = StoredKeyframes::of_run(run.path());
        assert!(stored.read().is_err(), "no folder yet");
        stored.add(&[keyframe(1, true)], &[]).expect("disk space");
        let path = run
            .path()
            .join(KEYFRAMES)
            .join("wrist_00000000000000000001.keyframe");
        let mut bytes = std::fs::read(&path).expect("a file");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&path, bytes).expect("disk space");
        let message = format!("{:#}", stored.read().expect_err("damaged"));
        assert!(
            message.contains("wrist_00000000000000000001.keyframe") && message.contains("damaged"),
            "{message}"
        );
        stored
            .add(&[keyframe(2, true), keyframe(3, false)], &[])
            .expect("disk space");
        std::fs::write(
            run.path()
                .join(KEYFRAMES)
                .join("wrist_00000000000000000003.keyframe"),
            "",
        )
        .expect("disk space");
        let stamps: Vec<i64> = stored
            .read()
            .expect("one is readable")
            .iter()
            .map(|read| read.stamp.0)
            .collect();
        assert_eq!(stamps, [2], "the others are left out");
    }
}
