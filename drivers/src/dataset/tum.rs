//! TUM RGB-D folders: `rgb.txt`, `depth.txt`, `groundtruth.txt`.
//!
//! Source: Sturm, Engelhard, Endres, Burgard, Cremers 2012, and the file formats documented on the web pages of the
//! benchmark.

use super::posed_image::image_size_px;
use super::{Dataset, DatasetImage, DepthFile, MAX_POSITION_M, SkippedImages};
use crate::Error;
use kinematics::{Intrinsics, Lens, Stamp, Transform, transform};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use std::path::Path;

/// File that identifies such a folder.
pub const COLOR_LIST: &str = "rgb.txt";
const DEPTH_LIST: &str = "depth.txt";
const POSE_LIST: &str = "groundtruth.txt";
/// Optional file with the lens parameters: `fx fy cx cy`, then optionally `k1 k2 p1 p2 k3`, with pixel centers at
/// integers as in OpenCV.
const CAMERA_FILE: &str = "calibration.txt";
/// Maximum time between samples that are matched to each other.
const MAX_GAP_NANOS: i64 = 20_000_000;
const METERS_PER_COUNT: f64 = 1.0 / 5000.0;

/// Lens parameters of the cameras of the benchmark, by a part of the folder name: `fx fy cx cy`, then `k1 k2 p1 p2 k3`.
const CAMERAS: [(&str, [f64; 9]); 3] = [
    ("freiburg1", [517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314]),
    (
        "freiburg2",
        [520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205],
    ),
    ("freiburg3", [535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0]),
];

/// Reads a folder.
///
/// Each photo gets the pose interpolated at its stamp and the depth image closest in time, both within 20 ms. Photos
/// without a pose are skipped and counted. Lens parameters come from `calibration.txt`, else from the folder name.
pub fn read(folder: &Path) -> Result<Dataset, Error> {
    let camera = camera_of(folder)?;
    let colors = stamped_names(folder, COLOR_LIST)?;
    let depths = match folder.join(DEPTH_LIST).is_file() {
        true => stamped_names(folder, DEPTH_LIST)?,
        false => Vec::new(),
    };
    let poses = Poses::read(folder)?;
    let (mut images, mut skipped) = (Vec::new(), SkippedImages::default());
    let mut n_without_depth = 0;
    for (stamp, name) in colors {
        let image_path = folder.join(&name);
        if !image_path.is_file() {
            skipped.missing.push(name);
            continue;
        }
        let Some(world_from_camera) = poses.at(stamp) else {
            skipped.unusable.push((name, "no pose within 20 ms".to_owned()));
            continue;
        };
        let Ok(size_px) = image_size_px(&image_path) else {
            skipped.broken.push((name, "not an image".to_owned()));
            continue;
        };
        let depth = nearest(&depths, stamp).and_then(|(depth_stamp, depth_name)| {
            let (path, pose) = (folder.join(depth_name), poses.at(*depth_stamp)?);
            path.is_file().then_some(DepthFile { path, meters_per_count: METERS_PER_COUNT, world_from_camera: pose })
        });
        n_without_depth += usize::from(depth.is_none());
        let intrinsics = Intrinsics { size_px, ..camera.clone() };
        images.push(DatasetImage { name, intrinsics, world_from_camera, stamp, image_path, depth, mask_path: None });
    }
    let notes = match n_without_depth {
        0 => Vec::new(),
        1 => vec!["1 photo has no depth image within 20 ms".to_owned()],
        n => vec![format!("{n} photos have no depth image within 20 ms")],
    };
    skipped.dataset(folder, images, notes)
}

/// Lens parameters of a folder. The caller sets the size to that of each photo.
fn camera_of(folder: &Path) -> Result<Intrinsics, Error> {
    let path = folder.join(CAMERA_FILE);
    let numbers = match files::read_text(&path) {
        Ok(text) => camera_numbers(&text).map_err(|reason| Error::DatasetFile { path, reason })?,
        Err(_) => camera_by_name(folder).ok_or_else(|| Error::NoIntrinsics { path: folder.to_owned() })?,
    };
    let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = numbers;
    let lens = if numbers[4..] == [0.0; 5] { Lens::Pinhole } else { Lens::BrownConrady([k1, k2, p1, p2, k3]) };
    // Pixel centers are at integers in these files and at half-integers in ours.
    let (focal_px, principal_px) = ([fx, fy], [cx + 0.5, cy + 0.5]);
    let intrinsics = Intrinsics { size_px: [640, 480], focal_px, principal_px, lens, rectified: false };
    intrinsics
        .validate()
        .map_err(|error| Error::DatasetFile { path: folder.join(CAMERA_FILE), reason: error.to_string() })?;
    Ok(intrinsics)
}

fn camera_numbers(text: &str) -> Result<[f64; 9], String> {
    let words = text.lines().filter(|line| !line.starts_with('#')).flat_map(str::split_whitespace);
    let mut numbers = words.map(str::parse).collect::<Result<Vec<f64>, _>>().map_err(|error| error.to_string())?;
    if !matches!(numbers.len(), 4 | 8 | 9) {
        return Err(format!("{} numbers, expected fx fy cx cy and optionally k1 k2 p1 p2 k3", numbers.len()));
    }
    numbers.resize(9, 0.0);
    Ok(numbers.try_into().unwrap_or([0.0; 9]))
}

fn camera_by_name(folder: &Path) -> Option<[f64; 9]> {
    let absolute = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    let name = absolute.file_name()?.to_string_lossy().to_lowercase();
    CAMERAS.iter().find(|(part, _)| name.contains(part)).map(|(_, numbers)| *numbers)
}

/// Lines of a list, each split into its stamp and the words after it, sorted by time.
fn stamped_lines(folder: &Path, list: &str) -> Result<Vec<(Stamp, Vec<String>)>, Error> {
    let path = folder.join(list);
    let text = files::read_text(&path).map_err(|source| Error::Open { path: path.clone(), source })?;
    let mut lines = Vec::new();
    for (line_ix, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace().map(str::to_owned);
        let Some(first) = words.next().filter(|word| !word.starts_with('#')) else { continue };
        let line_error =
            |what: &str| Error::DatasetFile { path: path.clone(), reason: format!("line {}: {what}", line_ix + 1) };
        let stamp = stamp_of(&first).ok_or_else(|| line_error(&format!("{first:?} is not a time in seconds")))?;
        let rest: Vec<String> = words.collect();
        if rest.is_empty() {
            return Err(line_error("the time is not followed by a file name"));
        }
        lines.push((stamp, rest));
    }
    lines.sort_by_key(|(stamp, _)| *stamp);
    Ok(lines)
}

fn stamped_names(folder: &Path, list: &str) -> Result<Vec<(Stamp, String)>, Error> {
    let lines = stamped_lines(folder, list)?;
    Ok(lines.into_iter().map(|(stamp, words)| (stamp, words.join(" "))).collect())
}

/// Parses seconds since 1970 with decimals. Uses two integers because f64 would round to a quarter of a microsecond.
fn stamp_of(word: &str) -> Option<Stamp> {
    let (integer, decimals) = word.split_once('.').unwrap_or((word, ""));
    let secs: i64 = integer.parse().ok()?;
    let nine_digits: String = decimals.chars().chain(std::iter::repeat('0')).take(9).collect();
    let nanos: i64 = nine_digits.chars().all(|digit| digit.is_ascii_digit()).then(|| nine_digits.parse().ok())??;
    Some(Stamp(secs.checked_mul(1_000_000_000)?.checked_add(nanos)?))
}

/// Entry closest in time, within the maximum gap.
fn nearest<T>(entries: &[(Stamp, T)], stamp: Stamp) -> Option<&(Stamp, T)> {
    let gap = |entry: &(Stamp, T)| entry.0.nanos_since(stamp).saturating_abs();
    let after = entries.partition_point(|entry| entry.0 < stamp);
    let candidates = &entries[after.saturating_sub(1)..entries.len().min(after + 1)];
    candidates.iter().min_by_key(|entry| gap(entry)).filter(|entry| gap(entry) <= MAX_GAP_NANOS)
}

/// Trajectory of the color camera.
struct Poses(Vec<(Stamp, Transform)>);

impl Poses {
    fn read(folder: &Path) -> Result<Self, Error> {
        let path = folder.join(POSE_LIST);
        let poses = stamped_lines(folder, POSE_LIST)?.into_iter().filter_map(|(stamp, words)| {
            let line_error = |what: &str| Error::DatasetFile {
                path: path.clone(),
                reason: format!("pose at {:.4} s: {what}", stamp.0 as f64 * 1e-9),
            };
            let numbers: Vec<f64> = words.iter().filter_map(|word| word.parse().ok()).collect();
            let [x, y, z, qx, qy, qz, qw] = numbers[..] else {
                return Some(Err(line_error("expected tx ty tz qx qy qz qw")));
            };
            let rotation = Quaternion::new(qw, qx, qy, qz);
            // The comparisons are written so that NaN fails them.
            let is_near = [x, y, z].iter().all(|along| along.abs() <= MAX_POSITION_M);
            if !(is_near && (rotation.norm() - 1.0).abs() <= 0.01) {
                log::warn!("{}", line_error("skipped: not finite, too far away, or the quaternion is not of length 1"));
                return None;
            }
            let rotation = UnitQuaternion::new_normalize(rotation);
            Some(Ok((stamp, Transform::from_parts(Vector3::new(x, y, z).into(), rotation))))
        });
        Ok(Self(poses.collect::<Result<_, _>>()?))
    }

    /// Pose at a stamp, interpolated between two poses that are both within the maximum gap.
    fn at(&self, stamp: Stamp) -> Option<Transform> {
        let after_ix = self.0.partition_point(|(other, _)| *other < stamp);
        let after = self.0.get(after_ix).filter(|(other, _)| other.nanos_since(stamp) <= MAX_GAP_NANOS)?;
        if after.0 == stamp {
            return Some(after.1);
        }
        let before =
            self.0.get(after_ix.checked_sub(1)?).filter(|(other, _)| stamp.nanos_since(*other) <= MAX_GAP_NANOS)?;
        let frac = (stamp.0 - before.0.0) as f64 / (after.0.0 - before.0.0) as f64;
        Some(transform::interpolate(&before.1, &after.1, frac))
    }
}
