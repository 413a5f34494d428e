//! Exports keyframes, such as those of a recording, as a nerfstudio dataset: color PNG, 16-bit
//! depth, poses, split lists.

use anyhow::{Context, bail, ensure};
use capture::config::{Override, Rig};
use capture::{Join, SampleUse, Stations, open};
use drivers::dataset::nerfstudio;
use image::ExtendedColorType;
use keyframe::{DepthMap, Keyframe, KeyframeList, Split};
use kinematics::{Transform, transform};
use messages::counted;
use serde_json::{Map, Value, json};
use std::fmt::{Display, Formatter};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Depth unit: millimeters, which readers assume if the file does not specify a unit.
const METERS_PER_COUNT: f64 = 0.001;
/// Maximum difference between the intrinsics of depth and color, in pixels of the depth image. If
/// the difference is larger, depth is not exported. Rounding a position to pixels has an error of
/// up to half a pixel. Smaller differences therefore do not matter to readers that look up depth at
/// a color pixel.
const MAX_LENS_DIFFERENCE_PX: f64 = 0.5;
/// List of the test images, one per line, in the format of `--holdout`.
const TEST_LIST: &str = "test.txt";
/// The split lists of nerfstudio.
const LISTS: [(&str, Split); 3] = [
    ("train_filenames", Split::Train),
    ("val_filenames", Split::Validation),
    ("test_filenames", Split::Test),
];

/// The entries of a dataset folder, in the order of writing. The last entry identifies a dataset,
/// so a folder with this entry is complete.
const ENTRIES: [&str; 5] = [IMAGES, MASKS, DEPTH, TEST_LIST, nerfstudio::FILE_NAME];
const IMAGES: &str = "images";
const MASKS: &str = "masks";
const DEPTH: &str = "depth";

/// Numbers of exported images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Written {
    /// Number of images.
    pub n_images: usize,
    /// Number of depth images.
    pub n_depth: usize,
    /// Number of depth images that were left out, because their intrinsics differ from the
    /// intrinsics of the color image. The format cannot express this.
    pub n_depth_skipped: usize,
}

impl Display for Written {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let Self {
            n_images,
            n_depth,
            n_depth_skipped,
        } = *self;
        let skipped = match n_depth_skipped as u64 {
            0 => String::new(),
            n => format!(
                ", {} skipped: their lens differs from the lens of the photo",
                counted(n, "depth image")
            ),
        };
        write!(
            f,
            "{}, {n_depth} of them with depth{skipped}",
            counted(n_images as u64, "photo")
        )
    }
}

/// Writes a dataset to a folder that does not contain one yet. The folder is written under a
/// temporary name, so it is complete or absent even if the program is killed. If the folder exists
/// already, its files are moved into it, `transforms.json` last.
///
/// Depth is rounded to millimeters and limited to 65 m. Velocities, readout times and ground truth
/// of simulators are not exported.
pub fn write_nerfstudio(
    out: &Path,
    keyframes: impl Iterator<Item = Arc<Keyframe>>,
) -> anyhow::Result<Written> {
    if let Some(existing) = ENTRIES
        .iter()
        .map(|entry| out.join(entry))
        .find(|entry| entry.exists())
    {
        bail!("{} already exists: give another folder", existing.display());
    }
    for entry in ENTRIES {
        files::check_no_link(&out.join(entry)).context("cannot export")?;
    }
    // The keyframes are checked before anything is created.
    let mut keyframes = keyframes.peekable();
    ensure!(keyframes.peek().is_some(), "no keyframe to export");
    let in_out = || format!("cannot write {}", out.display());
    out.parent()
        .map_or(Ok(()), std::fs::create_dir_all)
        .with_context(in_out)?;
    files::create_folder(out, &ENTRIES, |folder| write_dataset(folder, keyframes))
        .with_context(in_out)
}

/// A recording to export as a dataset.
#[derive(Clone, Debug)]
pub struct RecordingExport {
    /// The recording.
    pub recording: PathBuf,
    /// Rig file that replaces the one stored in the recording.
    pub rig: Option<PathBuf>,
    /// List of the keyframes to export. `None` exports the keyframes that a run would accept.
    pub keyframes: Option<PathBuf>,
    /// Folder to write.
    pub out: PathBuf,
}

impl RecordingExport {
    /// Exports the keyframes. Returns what was written, and descriptions of data that are missing.
    ///
    /// * `on_sample`: called after each sample.
    pub fn run(&self, on_sample: &mut dyn FnMut()) -> anyhow::Result<(Written, Vec<String>)> {
        // An export has the full resolution, whatever the scale of training.
        let overrides = [Override::new("train.scale", 1.0)];
        let rig = self
            .rig
            .as_deref()
            .map(|file| Rig::load(file, &overrides))
            .transpose()?;
        let mut opened = open::recording(&self.recording, rig, &overrides)?;
        let mut join = Join::new(&opened.rig)?;
        if let Some(list) = &self.keyframes {
            join = join.taking_only(KeyframeList::load(list)?);
        }
        while let Some(sample) = opened.source.next_sample()? {
            join.push(sample);
            on_sample();
        }
        // Images that still wait for a later joint state are decided now.
        join.finish();
        let missing_from_list = join.check_list()?;
        let mut keyframes: Vec<_> = join.keyframes().cloned().collect();
        // Base poses are corrected as in training, so that a model trained on the export uses the
        // same poses.
        if let Some(mut stations) = Stations::new(&opened.rig) {
            keyframes = stations.corrected(keyframes);
        }
        let written = write_nerfstudio(&self.out, keyframes.into_iter())
            .with_context(|| format!("cannot export {}", self.recording.display()))?;
        log::info!("{}", join.counts());
        let mut data_losses = join.counts().data_losses(SampleUse::ProcessedOnly);
        data_losses.extend(opened.damage.get().cloned());
        data_losses.extend(missing_from_list);
        Ok((written, data_losses))
    }
}

/// Writes the files of a dataset. Errors name them relative to the folder, which has a temporary
/// name.
fn write_dataset(
    folder: &Path,
    keyframes: impl Iterator<Item = Arc<Keyframe>>,
) -> anyhow::Result<Written> {
    let mut written = Written::default();
    let mut cameras = Vec::new();
    let mut frames = Vec::new();
    let mut splits = Vec::new();
    // Keyframes are read and written one by one, because all images together may not fit into
    // memory.
    for keyframe in keyframes {
        frames.push(write_frame(folder, &keyframe, &mut written)?);
        cameras.push(camera_keys(&keyframe));
        splits.push(keyframe.split);
    }
    let names = |split: Split| names_of_split(&frames, &splits, split);
    write_text(folder, TEST_LIST, &(names(Split::Test).join("\n") + "\n"))?;
    let mut document = Map::new();
    document.insert("camera_model".to_owned(), json!("PINHOLE"));
    document.insert(
        "depth_unit_scale_factor".to_owned(),
        json!(METERS_PER_COUNT),
    );
    document.extend(LISTS.map(|(key, split)| (key.to_owned(), json!(names(split)))));
    // A single camera is written once at the top level, because every reader supports this. Several
    // cameras are written per frame.
    if cameras.iter().all(|camera| *camera == cameras[0]) {
        document.append(&mut cameras[0]);
    } else {
        frames
            .iter_mut()
            .zip(&mut cameras)
            .for_each(|(frame, camera)| frame.append(camera));
    }
    document.insert("frames".to_owned(), json!(frames));
    write_text(
        folder,
        nerfstudio::FILE_NAME,
        &serde_json::to_string_pretty(&document)?,
    )?;
    Ok(written)
}

/// File names of the images of one split, given the entries and splits of all images.
fn names_of_split(frames: &[Map<String, Value>], splits: &[Split], wanted: Split) -> Vec<String> {
    frames
        .iter()
        .zip(splits)
        .filter(|(_, split)| **split == wanted)
        .filter_map(|(frame, _)| frame["file_path"].as_str().map(str::to_owned))
        .collect()
}

/// Writes the images of one keyframe and returns its entry.
fn write_frame(
    folder: &Path,
    keyframe: &Keyframe,
    written: &mut Written,
) -> anyhow::Result<Map<String, Value>> {
    let name = format!("{}_{:020}.png", keyframe.camera, keyframe.stamp.0);
    let [image, mask, depth_image] = [IMAGES, MASKS, DEPTH].map(|entry| format!("{entry}/{name}"));
    let mut frame = Map::new();
    let mut insert = |key: &str, value: Value| frame.insert(key.to_owned(), value);
    insert("file_path", json!(image));
    insert("transform_matrix", opengl_rows(&keyframe.world_from_camera));

    let pixels = keyframe.rgba_srgb.as_chunks::<4>().0;
    let rgb: Vec<u8> = pixels
        .iter()
        .flat_map(|&[red, green, blue, _]| [red, green, blue])
        .collect();
    write_png(
        folder,
        &image,
        keyframe.size_px,
        &rgb,
        ExtendedColorType::Rgb8,
    )?;
    written.n_images += 1;
    // Masks are separate files: a reader may take transparency for a property of the scene.
    if pixels.iter().any(|pixel| pixel[3] == 0) {
        let alpha: Vec<u8> = pixels.iter().map(|pixel| pixel[3]).collect();
        write_png(
            folder,
            &mask,
            keyframe.size_px,
            &alpha,
            ExtendedColorType::L8,
        )?;
        insert("mask_path", json!(mask));
    }
    match &keyframe.depth {
        Some(depth) if has_lens_of(depth, keyframe) => {
            write_png(
                folder,
                &depth_image,
                depth.size_px,
                &depth_counts(depth),
                ExtendedColorType::L16,
            )?;
            insert("depth_file_path", json!(depth_image));
            // This key is specific to fieldrig, and other readers ignore it.
            if depth.world_from_camera != keyframe.world_from_camera {
                insert(
                    "depth_transform_matrix",
                    opengl_rows(&depth.world_from_camera),
                );
            }
            written.n_depth += 1;
        }
        Some(_) => written.n_depth_skipped += 1,
        None => {}
    }
    Ok(frame)
}

/// Size and intrinsics of a keyframe under nerfstudio's keys.
fn camera_keys(keyframe: &Keyframe) -> Map<String, Value> {
    let [[fl_x, fl_y], [cx, cy]] = [keyframe.focal_px, keyframe.principal_px];
    let keys = [("fl_x", fl_x), ("fl_y", fl_y), ("cx", cx), ("cy", cy)]
        .map(|(key, value)| (key.to_owned(), json!(value)));
    let [width, height] = keyframe.size_px;
    let size = [("w", width), ("h", height)].map(|(key, value)| (key.to_owned(), json!(value)));
    keys.into_iter().chain(size).collect()
}

/// The pose as four rows, for a camera that looks along -z with y up.
fn opengl_rows(world_from_camera: &Transform) -> Value {
    // `opengl_from_camera` is half a turn, so it equals its inverse `camera_from_opengl`.
    let rows = transform::to_rows(&(world_from_camera * nerfstudio::opengl_from_camera()));
    json!(rows.as_chunks::<4>().0)
}

/// Whether depth and color have the same intrinsics, apart from the size of their images.
fn has_lens_of(depth: &DepthMap, keyframe: &Keyframe) -> bool {
    (0..2).all(|axis| {
        let ratio = f64::from(depth.size_px[axis]) / f64::from(keyframe.size_px[axis]);
        let focal_difference = depth.focal_px[axis] - ratio * keyframe.focal_px[axis];
        let principal_difference = depth.principal_px[axis] - ratio * keyframe.principal_px[axis];
        focal_difference.abs() < MAX_LENS_DIFFERENCE_PX
            && principal_difference.abs() < MAX_LENS_DIFFERENCE_PX
    })
}

/// Depth in millimeters, in native byte order as the encoder expects; 0 where unknown or too far.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "the range is checked first"
)]
fn depth_counts(depth: &DepthMap) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(2 * depth.depth_m.len());
    for depth_m in depth.depth_m.iter() {
        let count = (f64::from(*depth_m) / METERS_PER_COUNT).round();
        // A NaN fails the comparison, too.
        let count = if (0.0..=f64::from(u16::MAX)).contains(&count) {
            count as u16
        } else {
            0
        };
        bytes.extend(count.to_ne_bytes());
    }
    bytes
}

/// Writes pixels in the given format to a file with a relative path.
fn write_png(
    folder: &Path,
    file: &str,
    [width, height]: [u32; 2],
    bytes: &[u8],
    color: ExtendedColorType,
) -> anyhow::Result<()> {
    let path = folder.join(file);
    let write = || {
        path.parent().map_or(Ok(()), std::fs::create_dir_all)?;
        image::save_buffer(&path, bytes, width, height, color)
    };
    write().with_context(|| file.to_owned())
}

fn write_text(folder: &Path, file: &str, text: &str) -> anyhow::Result<()> {
    files::write(&folder.join(file), text).with_context(|| file.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use capture::dataset;
    use keyframe::Holdout;
    use kinematics::Stamp;
    use nalgebra::{UnitQuaternion, Vector3};

    /// A keyframe of 32 x 24 pixels with depth.
    fn keyframe(ix: usize) -> Keyframe {
        let rotation = UnitQuaternion::from_euler_angles(0.1 * ix as f64, 0.2, -1.0);
        let world_from_camera =
            Transform::from_parts(Vector3::new(ix as f64, 2.0, 3.0).into(), rotation);
        let pixels = (0..24).flat_map(|y: u8| (0..32).flat_map(move |x: u8| [3 * x, y, 9, 255]));
        let depth = DepthMap {
            size_px: [16, 12],
            focal_px: [15.0, 15.5],
            principal_px: [8.0, 6.5],
            depth_m: (0..16 * 12)
                .map(|pixel_ix| pixel_ix as f32 * 0.011)
                .collect(),
            world_from_camera,
        };
        Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(1_000_000_000 * (ix as i64 + 1)),
            size_px: [32, 24],
            focal_px: [30.0, 31.0],
            principal_px: [16.0, 13.0],
            rgba_srgb: pixels.collect(),
            depth: Some(depth),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::of(ix),
            truth: None,
            robot: None,
        }
    }

    fn read_back(out: &Path) -> Vec<Arc<Keyframe>> {
        let dataset = drivers::dataset::read(out).unwrap();
        assert!(dataset.notes.is_empty(), "{:?}", dataset.notes);
        let holdout = Holdout::from_list(&out.join(TEST_LIST)).unwrap();
        dataset::load(&dataset, Some(&holdout), 1.0, &|_| ())
            .unwrap()
            .keyframes
    }

    #[test]
    fn keyframes_survive_a_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let mut keyframes: Vec<_> = (0..10).map(keyframe).collect();
        let mut masked = keyframes[3].rgba_srgb.to_vec();
        masked[7] = 0;
        keyframes[3].rgba_srgb = masked.into();
        let moved_pose = Transform::translation(0.001, 0.0, 0.0) * keyframes[5].world_from_camera;
        keyframes[5].depth.as_mut().unwrap().world_from_camera = moved_pose;
        let written = write_nerfstudio(&out, keyframes.iter().cloned().map(Arc::new)).unwrap();
        assert_eq!(
            written,
            Written {
                n_images: 10,
                n_depth: 10,
                n_depth_skipped: 0
            }
        );
        for (got, expected) in read_back(&out).iter().zip(&keyframes) {
            assert_eq!(
                (got.size_px, got.focal_px, got.principal_px),
                (expected.size_px, expected.focal_px, expected.principal_px)
            );
            assert!(got.rgba_srgb == expected.rgba_srgb, "colors differ");
            assert_eq!(got.split == Split::Test, expected.split == Split::Test);
            assert!(
                (got.world_from_camera.inverse() * expected.world_from_camera)
                    .to_homogeneous()
                    .is_identity(1e-12)
            );
            let (got, expected) = (
                got.depth.as_ref().unwrap(),
                expected.depth.as_ref().unwrap(),
            );
            assert_eq!(
                (got.size_px, got.focal_px),
                (expected.size_px, expected.focal_px)
            );
            assert!(
                got.depth_m
                    .iter()
                    .zip(expected.depth_m.iter())
                    .all(|(a, b)| (a - b).abs() < 1e-6)
            );
            assert!(
                (got.world_from_camera.inverse() * expected.world_from_camera)
                    .to_homogeneous()
                    .is_identity(1e-12)
            );
        }
    }

    #[test]
    fn different_cameras_are_written_per_frame() {
        let folder = tempfile::tempdir().unwrap();
        let (first, mut second) = (keyframe(1), keyframe(2));
        second.camera = "overview".into();
        second.size_px = [24, 32];
        second.depth.as_mut().unwrap().focal_px = [40.0, 40.0];
        let written =
            write_nerfstudio(folder.path(), [first, second].map(Arc::new).into_iter()).unwrap();
        assert_eq!(
            written,
            Written {
                n_images: 2,
                n_depth: 1,
                n_depth_skipped: 1
            }
        );
        let sizes: Vec<_> = drivers::dataset::read(folder.path())
            .unwrap()
            .images
            .iter()
            .map(|image| image.intrinsics.size_px)
            .collect();
        assert_eq!(sizes, [[24, 32], [32, 24]]);
    }

    #[test]
    fn export_appears_when_it_is_complete() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scan");
        // The files that a killed export leaves behind.
        let leftover = files::partial::path_of(&out).join("scan").join(IMAGES);
        std::fs::create_dir_all(&leftover).unwrap();
        std::fs::write(leftover.join("old.png"), b"half of").unwrap();
        let until_complete = |ix| {
            assert!(
                !out.exists(),
                "the export can be killed before keyframe {ix}"
            );
            Arc::new(keyframe(ix))
        };
        write_nerfstudio(&out, (0..3).map(until_complete)).unwrap();
        assert_eq!(std::fs::read_dir(out.join(IMAGES)).unwrap().count(), 3);
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            1,
            "no temporary folder remains"
        );
        let error = write_nerfstudio(
            &out.join("transforms.json/new"),
            (0..3).map(|ix| Arc::new(keyframe(ix))),
        );
        let error = format!("{:#}", error.unwrap_err());
        assert!(
            error.starts_with("cannot write ") && error.contains("transforms.json/new: "),
            "{error}"
        );
    }

    #[test]
    fn empty_exports_and_existing_datasets_are_rejected() {
        let folder = tempfile::tempdir().unwrap();
        assert!(
            write_nerfstudio(folder.path(), std::iter::empty())
                .unwrap_err()
                .to_string()
                .contains("no keyframe")
        );
        write_nerfstudio(folder.path(), std::iter::once(Arc::new(keyframe(0)))).unwrap();
        let again =
            write_nerfstudio(folder.path(), std::iter::once(Arc::new(keyframe(0)))).unwrap_err();
        assert!(again.to_string().contains("already exists"), "{again}");
    }
}
