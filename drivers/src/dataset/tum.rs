//! TUM RGB-D folders: `rgb.txt`, `depth.txt`, `groundtruth.txt`.
//!
//! Source: Sturm, Engelhard, Endres, Burgard, Cremers 2012, and the file formats documented on the
//! web pages of the benchmark.

use super::posed_image::image_size_px;
use super::{
    Dataset, DatasetImage, DepthFile, MAX_POSITION_M, SkippedImages, first_names, implausible,
    plural,
};
use crate::Error;
use kinematics::{Intrinsics, Lens, Stamp, Transform, transform};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// File that identifies such a folder.
pub const COLOR_LIST: &str = "rgb.txt";
const DEPTH_LIST: &str = "depth.txt";
const POSE_LIST: &str = "groundtruth.txt";
/// Optional file with the lens parameters: `fx fy cx cy`, then optionally `k1 k2 p1 p2 k3`, with
/// pixel centers at integers as in OpenCV.
const CAMERA_FILE: &str = "calibration.txt";
/// Maximum time between an image and its depth image or pose. The `associate.py` of the benchmark
/// has the same default. At 30 Hz, this is slightly more than half of the interval between images,
/// so every color image finds the closest depth image.
const MAX_GAP_NANOS: i64 = 20_000_000;
/// Upper limit of the time between two poses that are interpolated, whatever their median interval.
const MAX_POSE_INTERVAL_NANOS: i64 = 110_000_000;
/// Poses are not interpolated over a gap of more than this number of usual intervals.
const MAX_USUAL_INTERVALS: f64 = 1.5;
/// The depth images of the benchmark have 5000 counts per meter.
const METERS_PER_COUNT: f64 = 1.0 / 5000.0;
/// Image size of the benchmark's cameras.
const BENCHMARK_PX: [u32; 2] = [640, 480];

/// Lens parameters of the cameras of the benchmark, by a part of the folder name: `fx fy cx cy`,
/// then `k1 k2 p1 p2 k3`.
const CAMERAS: [(&str, [f64; 9]); 3] = [
    (
        "freiburg1",
        [
            517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358,
            0.002628, 1.163314,
        ],
    ),
    (
        "freiburg2",
        [
            520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257,
            -0.000105, 0.917205,
        ],
    ),
    (
        "freiburg3",
        [535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0],
    ),
];

/// Reads a folder.
///
/// Each photo gets the depth image closest in time, within 20 ms. The pose of a photo is
/// interpolated at its stamp between two poses. The two poses may be at most 40 ms apart. If the
/// usual interval of the poses is longer, 1.5 times this interval is allowed, up to 110 ms. Photos
/// without a pose, photos of another size and invalid lines are skipped and counted. Lens
/// parameters come from `calibration.txt`. Without this file, they follow from the folder name. The
/// details are in docs/reference/datasets.md.
pub fn read(folder: &Path) -> Result<Dataset, Error> {
    let (camera, lens_px) = camera_of(folder)?;
    let mut skipped = SkippedImages::default();
    let colors = stamped_names(folder, COLOR_LIST, &mut skipped)?;
    let mut depths = if exists(&folder.join(DEPTH_LIST)) {
        Some(stamped_names(folder, DEPTH_LIST, &mut skipped)?)
    } else {
        None
    };
    let repeated_depth = depths.as_mut().map(remove_repeated).unwrap_or_default();
    let poses = Poses::read(folder, &mut skipped)?;
    let mut reading = Reading {
        folder,
        camera,
        lens_px,
        depths,
        poses,
        images: Vec::new(),
        skipped,
        n_without_depth: 0,
        missing_depth: Vec::new(),
        depth_without_pose: Vec::new(),
    };
    for (stamp, name) in colors {
        reading.add(stamp, name)?;
    }
    reading.finish(&repeated_depth)
}

/// The photos read so far, and the facts for the notes about photos that were skipped.
struct Reading<'a> {
    folder: &'a Path,
    camera: Intrinsics,
    /// Image size of the lens parameters. If the size is unknown, it is `None` until the first
    /// photo.
    lens_px: Option<[u32; 2]>,
    /// Depth images by time. `None` if the folder has no list of depth images.
    depths: Option<Vec<(Stamp, String)>>,
    poses: Poses,
    images: Vec<DatasetImage>,
    skipped: SkippedImages,
    /// Number of photos without a depth image that is close in time.
    n_without_depth: usize,
    missing_depth: Vec<String>,
    depth_without_pose: Vec<String>,
}

impl Reading<'_> {
    /// Adds a photo, or notes why it is skipped.
    ///
    /// # Errors
    /// Fails if the lens parameters are implausible for the first photo.
    fn add(&mut self, stamp: Stamp, name: String) -> Result<(), Error> {
        // Camera and stamp identify a keyframe, so two images must not have the same stamp. Equal
        // stamps are neighbors, because lists are sorted by time.
        if self.images.last().is_some_and(|last| last.stamp == stamp) {
            self.skipped
                .unusable
                .push((name, "another photo has the same time".to_owned()));
            return Ok(());
        }
        let Some(image_path) = find_file(self.folder, &name) else {
            self.skipped.missing.push(name);
            return Ok(());
        };
        let world_from_camera = match self.poses.at(stamp) {
            Ok(pose) => pose,
            Err(reason) => {
                self.skipped.unusable.push((name, reason));
                return Ok(());
            }
        };
        let Ok(size_px) = image_size_px(&image_path) else {
            self.skipped.broken.push((name, "not an image".to_owned()));
            return Ok(());
        };
        let intrinsics = Intrinsics {
            size_px,
            ..self.camera.clone()
        };
        // All photos have the same lens parameters, so they are checked only for the first photo.
        if self.images.is_empty()
            && let Some(reason) = implausible(&intrinsics)
        {
            return Err(Error::DatasetFile {
                path: self.folder.to_owned(),
                reason,
            });
        }
        // If the image size of the lens parameters is unknown, it is assumed to be the size of the
        // first photo.
        let expected_px = *self.lens_px.get_or_insert(size_px);
        if size_px != expected_px {
            let [width, height] = size_px;
            let [lens_width, lens_height] = expected_px;
            let reason = format!(
                "it has {width}x{height} pixels, but the lens parameters are for {lens_width}x{lens_height}"
            );
            self.skipped.broken.push((name, reason));
            return Ok(());
        }
        let depth = self.depth_at(stamp);
        self.images.push(DatasetImage {
            name,
            intrinsics,
            world_from_camera,
            stamp,
            image_path,
            depth,
            mask_path: None,
            listed: None,
        });
        Ok(())
    }

    /// The depth image that is closest in time. It has its own pose, because color and depth are
    /// not taken at the same time, and the camera moves in between.
    fn depth_at(&mut self, stamp: Stamp) -> Option<DepthFile> {
        let depths = self.depths.as_ref()?;
        let Some((depth_stamp, depth_name)) = nearest(depths, stamp) else {
            self.n_without_depth += 1;
            return None;
        };
        match (
            self.poses.at(*depth_stamp),
            find_file(self.folder, depth_name),
        ) {
            (Err(reason), _) => {
                self.depth_without_pose
                    .push(format!("{depth_name} ({reason})"));
                None
            }
            (Ok(_), None) => {
                self.missing_depth.push(depth_name.clone());
                None
            }
            (Ok(world_from_camera), Some(path)) => Some(DepthFile {
                path,
                meters_per_count: METERS_PER_COUNT,
                world_from_camera,
            }),
        }
    }

    /// Adds notes about depth images that are not used, and builds the dataset.
    ///
    /// # Errors
    /// Fails if the dataset has no photos.
    fn finish(self, repeated_depth: &[String]) -> Result<Dataset, Error> {
        let mut notes = match self.n_without_depth {
            0 => Vec::new(),
            1 => vec!["1 photo has no depth image within 20 ms".to_owned()],
            n => vec![format!("{n} photos have no depth image within 20 ms")],
        };
        for (names, what) in [
            (&self.missing_depth[..], "missing"),
            (
                &self.depth_without_pose[..],
                "not used, because no pose belongs to the time",
            ),
            (
                repeated_depth,
                "not used, because an earlier line has the same time; write times with more decimals",
            ),
        ] {
            if !names.is_empty() {
                let (images, verb) = plural(names.len(), "depth image");
                notes.push(format!("{images} {verb} {what}: {}", first_names(names)));
            }
        }
        self.skipped.dataset(self.folder, self.images, notes)
    }
}

/// Whether a file, folder or link has this name, even if the link is broken. An optional file is
/// skipped only if this is not the case. Otherwise, errors in reading it are reported.
fn exists(path: &Path) -> bool {
    !matches!(path.symlink_metadata(), Err(error) if error.kind() == ErrorKind::NotFound)
}

/// Finds a file of a list. Windows programs write `\\` as separator.
fn find_file(folder: &Path, name: &str) -> Option<PathBuf> {
    [name, &name.replace('\\', "/")]
        .into_iter()
        .map(|name| folder.join(name))
        .find(|path| path.is_file())
}

/// Removes entries that have the same time as an earlier entry. Returns the names of the removed
/// entries, except for entries with the same name as the earlier entry.
fn remove_repeated(entries: &mut Vec<(Stamp, String)>) -> Vec<String> {
    let mut repeated = Vec::new();
    entries.dedup_by(|later, first| {
        if later.0 == first.0 && later.1 != first.1 {
            repeated.push(later.1.clone());
        }
        later.0 == first.0
    });
    repeated
}

/// Lens parameters of a folder, and the image size for which they are valid, if it is known. The
/// caller sets the size in the lens parameters to the size of each photo.
fn camera_of(folder: &Path) -> Result<(Intrinsics, Option<[u32; 2]>), Error> {
    let path = folder.join(CAMERA_FILE);
    let (numbers, lens_px) = if exists(&path) {
        let text = files::read_text(&path).map_err(|source| Error::Open {
            path: path.clone(),
            source,
        })?;
        (
            camera_numbers(&text).map_err(|reason| Error::DatasetFile { path, reason })?,
            None,
        )
    } else {
        let numbers = camera_by_name(folder).ok_or_else(|| Error::NoIntrinsics {
            path: folder.to_owned(),
        })?;
        (numbers, Some(BENCHMARK_PX))
    };
    let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = numbers;
    let lens = if numbers[4..] == [0.0; 5] {
        Lens::Pinhole
    } else {
        Lens::BrownConrady([k1, k2, p1, p2, k3])
    };
    // Pixel centers are at integers in these files, and at half-integers in fieldrig.
    let principal_px = [cx + 0.5, cy + 0.5];
    let intrinsics = Intrinsics {
        size_px: BENCHMARK_PX,
        focal_px: [fx, fy],
        principal_px,
        lens,
        rectified: false,
    };
    intrinsics.validate().map_err(|error| Error::DatasetFile {
        path: folder.join(CAMERA_FILE),
        reason: error.to_string(),
    })?;
    Ok((intrinsics, lens_px))
}

fn camera_numbers(text: &str) -> Result<[f64; 9], String> {
    let mut numbers = Vec::new();
    for (line_ix, line) in text
        .lines()
        .enumerate()
        .filter(|(_, line)| !line.trim_start().starts_with('#'))
    {
        for word in words(line) {
            let number: f64 = word
                .parse()
                .map_err(|_| format!("line {}: {word:?} is not a number", line_ix + 1))?;
            numbers.push(number);
        }
    }
    if !matches!(numbers.len(), 4 | 8 | 9) {
        return Err(format!(
            "{} numbers, expected fx fy cx cy and optionally k1 k2 p1 p2 k3",
            numbers.len()
        ));
    }
    numbers.resize(9, 0.0);
    Ok(numbers.try_into().unwrap_or([0.0; 9]))
}

fn camera_by_name(folder: &Path) -> Option<[f64; 9]> {
    let absolute = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    let name = absolute.file_name()?.to_string_lossy().to_lowercase();
    CAMERAS
        .iter()
        .find(|(part, _)| name.contains(part))
        .map(|(_, numbers)| *numbers)
}

/// One line of a list.
struct Line {
    /// Number in the file, from 1.
    number: usize,
    stamp: Stamp,
    /// What follows the time.
    rest: String,
}

/// Whether columns are separated by this character. Commas are accepted, because the programs of
/// the benchmark also accept them.
fn is_separator(c: char) -> bool {
    c.is_whitespace() || c == ','
}

/// The columns of a line.
fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split(is_separator).filter(|word| !word.is_empty())
}

/// Lines of a list, sorted by time. Invalid lines are skipped.
///
/// # Errors
/// Fails if the file cannot be read, or if no line is valid.
fn stamped_lines(
    folder: &Path,
    list: &str,
    skipped: &mut SkippedImages,
) -> Result<Vec<Line>, Error> {
    let path = folder.join(list);
    let text = files::read_text(&path).map_err(|source| Error::Open {
        path: path.clone(),
        source,
    })?;
    let mut lines = Vec::new();
    let mut invalid = Vec::new();
    for (line_ix, line) in text.lines().enumerate() {
        let number = line_ix + 1;
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (first, rest) = line.split_once(is_separator).unwrap_or((line, ""));
        let rest = rest.trim_start_matches(is_separator).to_owned();
        match stamp_of(first) {
            None => invalid.push(format!("line {number}: {first:?} is not a time in seconds")),
            Some(_) if rest.is_empty() => {
                invalid.push(format!("line {number}: nothing follows the time"))
            }
            Some(stamp) => lines.push(Line {
                number,
                stamp,
                rest,
            }),
        }
    }
    // A list without any valid line has another format, which is an error. A few invalid lines are
    // not an error.
    if let (true, Some(first)) = (lines.is_empty(), invalid.first()) {
        return Err(Error::DatasetFile {
            path,
            reason: first.clone(),
        });
    }
    skipped.lines(list, &invalid);
    // Lists that were merged or edited may be out of order, and stamps are searched by bisection.
    // The sort is stable. If two lines have the same time, the first line is therefore used.
    lines.sort_by_key(|line| line.stamp);
    Ok(lines)
}

fn stamped_names(
    folder: &Path,
    list: &str,
    skipped: &mut SkippedImages,
) -> Result<Vec<(Stamp, String)>, Error> {
    let lines = stamped_lines(folder, list, skipped)?;
    Ok(lines
        .into_iter()
        .map(|line| (line.stamp, line.rest))
        .collect())
}

/// Parses a decimal number of seconds, such as `1305031102.175304` or `1.305031102175304e+09`, and
/// rounds it down to a nanosecond. Does not use f64, which would round to a quarter of a
/// microsecond.
fn stamp_of(word: &str) -> Option<Stamp> {
    const NANOS_EXPONENT: i64 = 9;
    let (mantissa, exponent) = word.split_once(['e', 'E']).unwrap_or((word, "0"));
    let (sign, mantissa) = match mantissa.strip_prefix('-') {
        Some(rest) => (-1, rest),
        None => (1, mantissa.strip_prefix('+').unwrap_or(mantissa)),
    };
    let (integer, decimals) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let digits = [integer, decimals].concat();
    if digits.is_empty() || !digits.bytes().all(|digit| digit.is_ascii_digit()) {
        return None;
    }
    // Number of digits before the decimal point of the number of nanoseconds.
    let n_digits = i64::try_from(integer.len()).ok()?
        + exponent.parse::<i32>().map(i64::from).ok()?
        + NANOS_EXPONENT;
    // Leading zeros do not count, so that long numbers such as `000000000001.5` fit, too.
    let zeros = digits.bytes().take_while(|digit| *digit == b'0').count();
    let n_significant = n_digits - i64::try_from(zeros).ok()?;
    if zeros == digits.len() || n_significant <= 0 {
        return Some(Stamp(0));
    }
    // An i64 has at most 19 digits. The limit also keeps a huge exponent from producing as many
    // digits.
    let n_significant = usize::try_from(n_significant).ok().filter(|n| *n < 20)?;
    // Digits after the last nanosecond are cut off, and missing digits are zeros.
    let padded = digits
        .bytes()
        .skip(zeros)
        .chain(std::iter::repeat(b'0'))
        .take(n_significant);
    let nanos = padded.fold(0_i128, |nanos, digit| 10 * nanos + i128::from(digit - b'0'));
    i64::try_from(sign * nanos).ok().map(Stamp)
}

/// Entry closest in time, within the maximum gap.
fn nearest<T>(entries: &[(Stamp, T)], stamp: Stamp) -> Option<&(Stamp, T)> {
    let gap = |entry: &(Stamp, T)| entry.0.nanos_since(stamp).saturating_abs();
    let after = entries.partition_point(|entry| entry.0 < stamp);
    // The closest entry is the last entry before the stamp or the first entry after it.
    let candidates = &entries[after.saturating_sub(1)..entries.len().min(after + 1)];
    candidates
        .iter()
        .min_by_key(|entry| gap(entry))
        .filter(|entry| gap(entry) <= MAX_GAP_NANOS)
}

/// Trajectory of the color camera.
struct Poses {
    poses: Vec<(Stamp, Transform)>,
    /// Maximum time between two poses that are interpolated.
    max_interval_nanos: i64,
}

impl Poses {
    fn read(folder: &Path, skipped: &mut SkippedImages) -> Result<Self, Error> {
        let mut poses: Vec<(Stamp, Transform)> = Vec::new();
        let mut invalid = Vec::new();
        let mut repeated = Vec::new();
        for Line {
            number,
            stamp,
            rest,
        } in stamped_lines(folder, POSE_LIST, skipped)?
        {
            match pose_of(&rest) {
                Err(reason) => invalid.push(format!("line {number}: {reason}")),
                Ok(pose)
                    if poses
                        .last()
                        .is_some_and(|(last, other)| *last == stamp && *other != pose) =>
                {
                    repeated.push(format!("line {number}"));
                }
                Ok(pose) => poses.push((stamp, pose)),
            }
        }
        if let (true, Some(first)) = (poses.is_empty(), invalid.first()) {
            return Err(Error::DatasetFile {
                path: folder.join(POSE_LIST),
                reason: first.clone(),
            });
        }
        skipped.lines(POSE_LIST, &invalid);
        if !repeated.is_empty() {
            let (what, verb) = plural(repeated.len(), "pose");
            skipped.lost.push(format!(
                "{POSE_LIST}: {what} {verb} not used, because an earlier, different pose has the same time; write times with more decimals: {}",
                first_names(&repeated)
            ));
        }
        Ok(Self {
            max_interval_nanos: max_interval_nanos(&poses),
            poses,
        })
    }

    /// Pose at a stamp, interpolated between two poses. The error is the reason why there is no
    /// pose.
    fn at(&self, stamp: Stamp) -> Result<Transform, String> {
        let after_ix = self.poses.partition_point(|(other, _)| *other < stamp);
        let after = self.poses.get(after_ix);
        // A pose with exactly this time is used bit for bit, even if its neighbors are far away.
        if let Some((after_stamp, pose)) = after
            && *after_stamp == stamp
        {
            return Ok(*pose);
        }
        let before = after_ix.checked_sub(1).map(|ix| &self.poses[ix]);
        let (Some(after), Some(before)) = (after, before) else {
            return Err("its time is before the first or after the last pose".to_owned());
        };
        let interval_nanos = after.0.nanos_since(before.0);
        if interval_nanos > self.max_interval_nanos {
            let [interval_millis, max_millis] =
                [interval_nanos, self.max_interval_nanos].map(|nanos| nanos / 1_000_000);
            return Err(format!(
                "the poses before and after it are {interval_millis} ms apart, at most {max_millis} ms are interpolated"
            ));
        }
        let frac = (stamp.0 - before.0.0) as f64 / interval_nanos as f64;
        Ok(transform::interpolate(&before.1, &after.1, frac))
    }
}

/// Poses that are regularly far apart are interpolated, but a gap in dense poses is not, because
/// tracking was lost.
fn max_interval_nanos(poses: &[(Stamp, Transform)]) -> i64 {
    let mut intervals: Vec<i64> = poses
        .windows(2)
        .map(|pair| pair[1].0.nanos_since(pair[0].0))
        .collect();
    intervals.sort_unstable();
    let usual = intervals
        .get(intervals.len() / 2)
        .copied()
        .unwrap_or_default();
    #[expect(clippy::cast_possible_truncation, reason = "the cast saturates")]
    let max = (MAX_USUAL_INTERVALS * usual as f64) as i64;
    // At the lower bound, no stamp is farther than the maximum gap from the closest pose. The upper
    // bound prevents interpolation of unknown motion in a sparse trajectory.
    max.clamp(2 * MAX_GAP_NANOS, MAX_POSE_INTERVAL_NANOS)
}

fn pose_of(columns: &str) -> Result<Transform, &'static str> {
    let numbers: Option<Vec<f64>> = words(columns).map(|word| word.parse().ok()).collect();
    let Some([x, y, z, qx, qy, qz, qw]) = numbers.as_deref() else {
        return Err("expected seven numbers tx ty tz qx qy qz qw after the time");
    };
    // Files round quaternions to four decimals, which changes the length by less than 0.001. If the
    // length differs by more than 0.01, the columns are not a quaternion.
    let rotation = Quaternion::new(*qw, *qx, *qy, *qz);
    // The comparisons are written so that NaN fails them.
    let is_near = [x, y, z].iter().all(|along| along.abs() <= MAX_POSITION_M);
    if !(is_near && (rotation.norm() - 1.0).abs() <= 0.01) {
        return Err("the pose is not finite, too far away, or its quaternion is not of length 1");
    }
    Ok(Transform::from_parts(
        Vector3::new(*x, *y, *z).into(),
        UnitQuaternion::new_normalize(rotation),
    ))
}
