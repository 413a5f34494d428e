//! Folders with a `transforms.json`, as written by nerfstudio and instant-ngp.
//!
//! Cameras in these files look along -z with y up (OpenGL). Only this module converts their poses
//! to the convention of fieldrig.

use super::posed_image::image_size_px;
use super::{
    Dataset, DatasetImage, DepthFile, ListedSplit, MAX_POSITION_M, SkippedImages, first_names,
    implausible, plural,
};
use crate::Error;
use crate::wire::json;
use kinematics::{Intrinsics, Lens, Stamp, Transform, transform};
use nalgebra::{UnitQuaternion, Vector3};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

/// File that identifies such a folder.
pub const FILE_NAME: &str = "transforms.json";
/// Reason of the error about a file that is not an input.
pub(super) const OTHER_FILE: &str =
    "not a recording (.mcap), a dataset folder or a transforms.json";
/// Relative difference of two focal lengths that are meant to be equal. Focal lengths from rounded
/// angles differ by far less. Focal lengths of another camera or axis differ by more.
const MAX_FOCAL_DIFFERENCE: f64 = 0.01;
/// Depth counts are millimeters unless the file specifies another unit.
const DEFAULT_METERS_PER_COUNT: f64 = 0.001;
/// Range of accepted units. With 65535 counts, the maximum depth is between 6.5 cm and 65 km.
const METERS_PER_COUNT: std::ops::RangeInclusive<f64> = 1e-6..=1.0;
/// Extensions tried when a path has none, in lower and upper case.
const EXTENSIONS: [&str; 7] = ["png", "jpg", "jpeg", "webp", "bmp", "tif", "tiff"];
/// Keys of the file that are not used, because they do not change images, poses or lenses.
const UNUSED: [&str; 14] = [
    "aabb_scale",
    "applied_scale",
    "applied_transform",
    "auto_scale_poses_override",
    "fps",
    "offset",
    "orientation_override",
    "scale",
    // Keys of one frame.
    "colmap_im_id",
    "depth_width",
    "depth_height",
    "sharpness",
    "timestamp",
    "name",
];

/// Reads a folder, or the file itself.
///
/// Images are sorted by file name. The following images are skipped and counted: duplicates,
/// missing or broken files, poses that are not finite or not rigid, and poses that are implausibly
/// far away. If the file lists the images of the splits, images that are in no list are left out.
/// The keys are explained in docs/reference/datasets.md.
///
/// # Errors
/// Fails if the file cannot be parsed, if no image is usable, or if a frame uses an unsupported
/// camera model. In the last case, the error names the frame.
pub fn read(path: &Path) -> Result<Dataset, Error> {
    let file = if path.is_file() {
        path.to_owned()
    } else {
        path.join(FILE_NAME)
    };
    let folder = file.parent().unwrap_or(Path::new(".")).to_owned();
    let text = files::read_text(&file).map_err(|source| Error::Open {
        path: file.clone(),
        source,
    })?;
    if !text.trim_start().starts_with('{') {
        return Err(file_error(&file, OTHER_FILE.to_owned()));
    }
    let mut document: Document = serde_json::from_str(&json::nan_as_null(&text))
        .map_err(|error| file_error(&file, error.to_string()))?;
    // Files list frames in any order. After sorting by name, the numbered images of a video follow
    // each other, and repeated entries are neighbors.
    document
        .frames
        .sort_by(|a, b| a.file_path.cmp(&b.file_path));
    let splits = document
        .splits()
        .map_err(|reason| file_error(&file, reason))?;
    let meters_per_count = document
        .meters_per_count()
        .map_err(|reason| file_error(&file, reason))?;
    let mut reading = Reading {
        file: &file,
        folder: &folder,
        document: &document,
        splits: &splits,
        meters_per_count,
        images: Vec::new(),
        skipped: SkippedImages::default(),
        notes: document.notes(),
        unlisted: Vec::new(),
        rounded: Vec::new(),
        has_other_size: false,
    };
    for (ix, entry) in document.frames.iter().enumerate() {
        reading.add(ix, entry)?;
    }
    reading.finish()
}

fn file_error(file: &Path, reason: String) -> Error {
    Error::DatasetFile {
        path: file.to_owned(),
        reason,
    }
}

/// The images read so far, and the facts for the notes about images that were skipped.
struct Reading<'a> {
    file: &'a Path,
    folder: &'a Path,
    document: &'a Document,
    splits: &'a HashMap<String, ListedSplit>,
    meters_per_count: f64,
    images: Vec<DatasetImage>,
    skipped: SkippedImages,
    notes: Vec<String>,
    /// Images in no list of a split.
    unlisted: Vec<String>,
    /// Images whose poses are rounded.
    rounded: Vec<String>,
    /// Whether the size of an image differed from the size in its lens parameters.
    has_other_size: bool,
}

/// The poses of one frame.
struct FramePoses {
    world_from_camera: Transform,
    /// Whether the numbers of the photo's pose are rounded.
    is_rounded: bool,
    /// Pose of the depth camera, if it has its own.
    world_from_depth: Option<Transform>,
}

impl Reading<'_> {
    /// Adds the image of a frame, or notes why it is skipped.
    ///
    /// # Errors
    /// Fails if the frame has a malformed matrix or unsupported lens parameters. Such a mistake is
    /// usually in all frames, so a dataset without these frames would be empty.
    fn add(&mut self, ix: usize, entry: &FrameEntry) -> Result<(), Error> {
        let name = &entry.file_path;
        if ix > 0 && self.document.frames[ix - 1].file_path == *name {
            self.skipped.unusable.push((
                name.clone(),
                "listed twice, only the first entry is used".to_owned(),
            ));
            return Ok(());
        }
        let listed = self.splits.get(normalized(name).as_str()).copied();
        if !self.splits.is_empty() && listed.is_none() {
            self.unlisted.push(name.clone());
            return Ok(());
        }
        let (rows, depth_rows) = entry
            .matrices()
            .map_err(|why| self.frame_error(name, &why))?;
        let Some(image_path) = find_image(self.folder, name) else {
            self.skipped.missing.push(name.clone());
            return Ok(());
        };
        // Only the header is read here, because decoding all images would take long. Each image is
        // decoded when it is needed.
        let size_px = match image_size_px(&image_path) {
            Ok(size_px) => size_px,
            Err(error) => {
                self.skipped.broken.push((name.clone(), reason_of(&error)));
                return Ok(());
            }
        };
        let Some(poses) = self.poses_of(name, &rows, depth_rows.as_ref()) else {
            return Ok(());
        };
        let camera = entry.camera.or(&self.document.camera);
        let intrinsics = camera
            .intrinsics(size_px)
            .map_err(|why| self.frame_error(name, &why))?;
        if camera.size_px().is_some_and(|reported| reported != size_px) {
            self.note_other_size(size_px);
        }
        let depth = self.depth_of(entry, &poses);
        self.images.push(DatasetImage {
            name: name.clone(),
            intrinsics,
            world_from_camera: poses.world_from_camera,
            // The stamp is computed from the index in the list. The stamps of the other images thus
            // stay the same if an image is removed from the folder.
            stamp: Stamp(
                i64::try_from(ix)
                    .unwrap_or(i64::MAX)
                    .saturating_mul(1_000_000),
            ),
            image_path,
            depth,
            // If a named mask is missing, loading the image fails. Otherwise, pixels that the mask
            // should exclude would be used for training without a message.
            mask_path: entry.mask_path.as_ref().map(|name| {
                find_image(self.folder, name).unwrap_or_else(|| self.folder.join(name))
            }),
            listed,
        });
        Ok(())
    }

    fn frame_error(&self, name: &str, reason: &str) -> Error {
        file_error(self.file, format!("frame {name:?}: {reason}"))
    }

    /// The poses of an image, or `None` after noting why the image is skipped.
    fn poses_of(
        &mut self,
        name: &str,
        rows: &[f64; 16],
        depth_rows: Option<&[f64; 16]>,
    ) -> Option<FramePoses> {
        let poses = match FramePoses::new(rows, depth_rows) {
            Ok(poses) => poses,
            Err(reason) => {
                self.skipped.broken.push((name.to_owned(), reason));
                return None;
            }
        };
        if poses.is_rounded {
            self.rounded.push(name.to_owned());
        }
        if let Some(excessive_distance_m) = poses.excessive_distance_m() {
            self.skipped.broken.push((
                name.to_owned(),
                format!("its pose is {excessive_distance_m:e} m away, the maximum is {MAX_POSITION_M:e} m"),
            ));
            return None;
        }
        Some(poses)
    }

    /// Notes that the size of images differs from the size in the file. The note is written only
    /// once, because all images of a downscaled dataset have the same size.
    fn note_other_size(&mut self, [width, height]: [u32; 2]) {
        if !std::mem::replace(&mut self.has_other_size, true) {
            self.notes.push(format!(
                "images are {width}x{height}, which differs from transforms.json; lens parameters are scaled"
            ));
        }
    }

    /// The depth image of a frame, if its file exists.
    fn depth_of(&self, entry: &FrameEntry, poses: &FramePoses) -> Option<DepthFile> {
        let name = entry.depth_file_path.as_ref()?;
        Some(DepthFile {
            path: find_image(self.folder, name)?,
            meters_per_count: self.meters_per_count,
            world_from_camera: poses.world_from_depth.unwrap_or(poses.world_from_camera),
        })
    }

    /// Adds notes about everything that was left out, and builds the dataset.
    ///
    /// # Errors
    /// Fails if the dataset has no images.
    fn finish(mut self) -> Result<Dataset, Error> {
        let absent = self.absent();
        self.note_splits(&absent);
        if !self.rounded.is_empty() {
            let (images, _) = plural(self.rounded.len(), "image");
            self.notes.push(format!(
                "the rotations of {images} are rounded to about three decimals, so the poses may be off by 0.1 degrees; write at \
                 least four decimals: {}",
                first_names(&self.rounded)
            ));
        }
        // This error comes before the error of an empty dataset, because it names the cause.
        if self.images.is_empty() && !self.unlisted.is_empty() {
            return Err(file_error(
                self.file,
                format!(
                    "train_filenames, val_filenames and test_filenames contain no image of frames: they name {}, frames {}",
                    first_names(&absent),
                    first_names(&self.unlisted)
                ),
            ));
        }
        self.note_missing_depth();
        // The points are in the frame of the poses, because nerfstudio applies `applied_transform`
        // to both when it writes them.
        let folder = self.folder;
        let points_path = self
            .document
            .ply_file_path
            .as_ref()
            .map(|name| find_file(folder, name).unwrap_or_else(|| folder.join(name)));
        Ok(Dataset {
            points_path,
            ..self.skipped.dataset(folder, self.images, self.notes)?
        })
    }

    /// Names in the lists of splits that are not names of frames.
    fn absent(&self) -> Vec<String> {
        let names: BTreeSet<String> = self
            .document
            .frames
            .iter()
            .map(|entry| normalized(&entry.file_path))
            .collect();
        let mut absent: Vec<String> = self
            .splits
            .keys()
            .filter(|name| !names.contains(*name))
            .cloned()
            .collect();
        // The order of a hash map differs between runs.
        absent.sort_unstable();
        absent
    }

    /// Notes the differences between the frames and the lists of splits.
    fn note_splits(&mut self, absent: &[String]) {
        for (names, what) in [
            (
                &self.unlisted[..],
                "not used, because train_filenames, val_filenames and test_filenames do not contain them",
            ),
            (
                absent,
                "only in train_filenames, val_filenames or test_filenames, but not in frames",
            ),
        ] {
            if !names.is_empty() {
                let (images, verb) = plural(names.len(), "image");
                self.notes
                    .push(format!("{images} {verb} {what}: {}", first_names(names)));
            }
        }
    }

    /// Notes the depth images that are named but missing, although the photo exists.
    fn note_missing_depth(&mut self) {
        let lacking = self
            .document
            .frames
            .iter()
            .filter(|entry| entry.lacks_depth(self.folder));
        let missing_depth: Vec<String> = lacking
            .filter_map(|entry| entry.depth_file_path.clone())
            .collect();
        if !missing_depth.is_empty() {
            let (images, verb) = plural(missing_depth.len(), "depth image");
            self.notes.push(format!(
                "{images} {verb} missing: {}",
                first_names(&missing_depth)
            ));
        }
    }
}

impl FramePoses {
    /// Converts the poses of a frame. The error is the reason why one of them is invalid.
    fn new(rows: &[f64; 16], depth_rows: Option<&[f64; 16]>) -> Result<Self, String> {
        let (world_from_camera, is_rounded) = world_from_camera(rows)?;
        let depth = depth_rows.map(self::world_from_camera).transpose()?;
        Ok(Self {
            world_from_camera,
            is_rounded,
            world_from_depth: depth.map(|(pose, _)| pose),
        })
    }

    /// Largest absolute coordinate of a pose, if it exceeds the maximum.
    fn excessive_distance_m(&self) -> Option<f64> {
        [Some(self.world_from_camera), self.world_from_depth]
            .into_iter()
            .flatten()
            .find_map(excessive_distance_m)
    }
}

/// The whole file.
#[derive(Deserialize)]
struct Document {
    frames: Vec<FrameEntry>,
    depth_unit_scale_factor: Option<f64>,
    #[serde(default)]
    train_filenames: Vec<String>,
    #[serde(default)]
    val_filenames: Vec<String>,
    #[serde(default)]
    test_filenames: Vec<String>,
    ply_file_path: Option<String>,
    #[serde(flatten)]
    camera: CameraEntry,
    #[serde(flatten)]
    other: BTreeMap<String, Value>,
}

impl Document {
    /// The split of each listed image. The map is empty if the file has no lists. Its keys are
    /// [`normalized`] paths. If the file lists no test images, its validation images become the
    /// test images, because nerfstudio also scores them.
    fn splits(&self) -> Result<HashMap<String, ListedSplit>, String> {
        let validation = if self.test_filenames.is_empty() {
            ListedSplit::Test
        } else {
            ListedSplit::Validation
        };
        let mut splits = HashMap::new();
        for (list, names, split) in [
            ("train_filenames", &self.train_filenames, ListedSplit::Train),
            ("val_filenames", &self.val_filenames, validation),
            ("test_filenames", &self.test_filenames, ListedSplit::Test),
        ] {
            for name in names {
                if let Some((other_list, other)) = splits.insert(normalized(name), (list, split))
                    && other != split
                {
                    return Err(format!("{name:?} is in both {other_list} and {list}"));
                }
            }
        }
        // Some files list only the images that are held out. The other images are then for
        // training.
        if self.train_filenames.is_empty() && !splits.is_empty() {
            for entry in &self.frames {
                splits
                    .entry(normalized(&entry.file_path))
                    .or_insert(("train_filenames", ListedSplit::Train));
            }
        }
        Ok(splits
            .into_iter()
            .map(|(name, (_, split))| (name, split))
            .collect())
    }

    /// The unit of depth images, meters.
    fn meters_per_count(&self) -> Result<f64, String> {
        let meters_per_count = self
            .depth_unit_scale_factor
            .unwrap_or(DEFAULT_METERS_PER_COUNT);
        if METERS_PER_COUNT.contains(&meters_per_count) {
            return Ok(meters_per_count);
        }
        Err(format!(
            "depth_unit_scale_factor is {meters_per_count:e} meters per count, expected a number from 1e-6 to 1"
        ))
    }

    /// Notes about keys that are not used.
    fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let of_file = unknown_keys(&self.other);
        let of_frames: BTreeSet<String> = self
            .frames
            .iter()
            .flat_map(|entry| unknown_keys(&entry.other))
            .collect();
        for (keys, place) in [
            (of_file, ""),
            (of_frames.into_iter().collect(), " of frames"),
        ] {
            if !keys.is_empty() {
                notes.push(format!(
                    "unknown keys{place} are not used: {}",
                    first_names(&keys)
                ));
            }
        }
        notes
    }
}

/// The keys that this reader does not know, quoted.
fn unknown_keys(keys: &BTreeMap<String, Value>) -> Vec<String> {
    keys.keys()
        .filter(|key| !UNUSED.contains(&key.as_str()))
        .map(|key| format!("{key:?}"))
        .collect()
}

/// Converts a path to the form in which paths are compared: with slashes, and without `./` at its
/// start.
fn normalized(path: &str) -> String {
    let path = path.replace('\\', "/");
    path.strip_prefix("./").unwrap_or(&path).to_owned()
}

/// One frame. Lens parameters of the frame override the common lens parameters of the file.
#[derive(Deserialize)]
struct FrameEntry {
    file_path: String,
    depth_file_path: Option<String>,
    mask_path: Option<String>,
    transform_matrix: Matrix,
    /// Pose of the depth camera, if it differs from the pose of the photo. This field is an
    /// extension by fieldrig.
    depth_transform_matrix: Option<Matrix>,
    #[serde(flatten)]
    camera: CameraEntry,
    #[serde(flatten)]
    other: BTreeMap<String, Value>,
}

/// Rows of a pose. Numbers that are not finite are `None`.
type Matrix = Vec<Vec<Option<f64>>>;

/// Lens parameters under the names used in the file.
#[derive(Clone, Default, Deserialize)]
struct CameraEntry {
    camera_model: Option<String>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    w: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    h: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    fl_x: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    fl_y: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    cx: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    cy: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    camera_angle_x: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    camera_angle_y: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    k1: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    k2: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    k3: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    k4: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    k5: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    k6: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    p1: Option<f64>,
    #[serde(default, deserialize_with = "deserialize_finite")]
    p2: Option<f64>,
    is_fisheye: Option<bool>,
}

/// Deserializes a number and rejects null, which stands for NaN. Missing keys are allowed.
fn deserialize_finite<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
    let number = Option::<f64>::deserialize(from)?;
    number
        .map(Some)
        .ok_or_else(|| D::Error::custom("a lens parameter is not a finite number"))
}

impl FrameEntry {
    /// The matrix of the photo, and the matrix of the depth camera if the frame has one.
    fn matrices(&self) -> Result<([f64; 16], Option<[f64; 16]>), String> {
        let rows = rows_of(&self.transform_matrix)?;
        let depth_rows = self.depth_transform_matrix.as_ref().map(rows_of);
        Ok((rows, depth_rows.transpose()?))
    }

    fn lacks_depth(&self, folder: &Path) -> bool {
        let exists = |name: &String| find_image(folder, name).is_some();
        exists(&self.file_path)
            && self
                .depth_file_path
                .as_ref()
                .is_some_and(|name| !exists(name))
    }
}

fn rows_of(matrix: &Matrix) -> Result<[f64; 16], String> {
    let mut rows: Vec<f64> = matrix
        .iter()
        .flatten()
        .map(|value| value.unwrap_or(f64::NAN))
        .collect();
    // Some programs leave out the constant last row.
    if rows.len() == 12 {
        rows.extend([0.0, 0.0, 0.0, 1.0]);
    }
    rows.try_into().map_err(|rows: Vec<f64>| {
        format!(
            "transform_matrix has {} numbers, expected 4 rows of 4",
            rows.len()
        )
    })
}

/// Converts an OpenGL camera pose to the convention of fieldrig. Also returns whether its numbers
/// are rounded.
fn world_from_camera(rows: &[f64; 16]) -> Result<(Transform, bool), String> {
    let (world_from_opengl, is_rounded) =
        transform::from_rounded_rows(rows).map_err(|error| error.to_string())?;
    Ok((world_from_opengl * opengl_from_camera(), is_rounded))
}

/// Largest absolute coordinate of a pose, if it exceeds the maximum.
fn excessive_distance_m(pose: Transform) -> Option<f64> {
    let excessive_distance_m = pose.translation.vector.amax();
    (excessive_distance_m > MAX_POSITION_M).then_some(excessive_distance_m)
}

/// Rotation by 180 degrees about x. OpenGL cameras look along -z with y up, and cameras of fieldrig
/// look along z with y down.
pub fn opengl_from_camera() -> Transform {
    let half_turn = UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(0.0, 1.0, 0.0, 0.0));
    Transform::from_parts(Vector3::zeros().into(), half_turn)
}

impl CameraEntry {
    /// Returns these parameters. Parameters that are not set are taken from the common parameters.
    fn or(&self, common: &Self) -> Self {
        Self {
            camera_model: self
                .camera_model
                .clone()
                .or_else(|| common.camera_model.clone()),
            w: self.w.or(common.w),
            h: self.h.or(common.h),
            fl_x: self.fl_x.or(common.fl_x),
            fl_y: self.fl_y.or(common.fl_y),
            cx: self.cx.or(common.cx),
            cy: self.cy.or(common.cy),
            camera_angle_x: self.camera_angle_x.or(common.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(common.camera_angle_y),
            k1: self.k1.or(common.k1),
            k2: self.k2.or(common.k2),
            k3: self.k3.or(common.k3),
            k4: self.k4.or(common.k4),
            k5: self.k5.or(common.k5),
            k6: self.k6.or(common.k6),
            p1: self.p1.or(common.p1),
            p2: self.p2.or(common.p2),
            is_fisheye: self.is_fisheye.or(common.is_fisheye),
        }
    }

    /// Image size that the parameters refer to, if the file contains it.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "sizes are small; the cast saturates"
    )]
    fn size_px(&self) -> Option<[u32; 2]> {
        Some([self.w? as u32, self.h? as u32])
    }

    /// Lens parameters for images of the given size.
    fn intrinsics(&self, image_px: [u32; 2]) -> Result<Intrinsics, String> {
        // Without a size in the file, the parameters refer to the actual size of the images.
        let size_px = self.size_px().unwrap_or(image_px);
        let [width, height] = size_px.map(f64::from);
        let focal_x = focal_px(
            ("fl_x", self.fl_x),
            ("camera_angle_x", self.camera_angle_x),
            width,
        )?;
        let focal_y = focal_px(
            ("fl_y", self.fl_y),
            ("camera_angle_y", self.camera_angle_y),
            height,
        )?;
        let focal_x = focal_x.ok_or("no focal length: neither fl_x nor camera_angle_x")?;
        let reported = Intrinsics {
            size_px,
            focal_px: [focal_x, focal_y.unwrap_or(focal_x)],
            principal_px: [
                self.cx.unwrap_or(0.5 * width),
                self.cy.unwrap_or(0.5 * height),
            ],
            lens: self.lens()?,
            rectified: false,
        };
        reported.validate().map_err(|error| error.to_string())?;
        if let Some(reason) = implausible(&reported) {
            return Err(reason);
        }
        // The parameters refer to the size in the file. Images may be downscaled copies, as in the
        // folders `images_2` and `images_4` of nerfstudio.
        Ok(reported.resized(image_px))
    }

    fn lens(&self) -> Result<Lens, String> {
        for (name, value) in [("k5", self.k5), ("k6", self.k6)] {
            if value.is_some_and(|value| value != 0.0) {
                return Err(format!(
                    "{name} is not 0, but only k1 to k4, p1 and p2 are supported"
                ));
            }
        }
        let [k1, k2, k3, k4, p1, p2] =
            [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2].map(Option::unwrap_or_default);
        let fisheye = self.is_fisheye == Some(true);
        match self.camera_model.as_deref() {
            Some("OPENCV_FISHEYE") => Ok(Lens::KannalaBrandt([k1, k2, k3, k4])),
            None if fisheye => Ok(Lens::KannalaBrandt([k1, k2, k3, k4])),
            None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL") => {
                let coefficients = [k1, k2, p1, p2, k3];
                if k4 != 0.0 {
                    return Err(format!(
                        "k4 is {k4}, but a fourth radial coefficient is only supported for OPENCV_FISHEYE"
                    ));
                }
                // Without distortion, images need not be resampled.
                if coefficients == [0.0; 5] {
                    Ok(Lens::Pinhole)
                } else {
                    Ok(Lens::BrownConrady(coefficients))
                }
            }
            Some(other) => Err(format!(
                "camera_model is {other:?}, expected OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV_FISHEYE"
            )),
        }
    }
}

/// Returns the focal length along one axis in pixels. It is computed from a focal length, a field
/// of view, or both. `None` if neither is given. Each argument includes the name of its key.
fn focal_px(
    given: (&str, Option<f64>),
    angle: (&str, Option<f64>),
    side_px: f64,
) -> Result<Option<f64>, String> {
    if let (name, Some(angle_rad)) = angle
        && !(angle_rad > 0.0 && angle_rad < std::f64::consts::PI)
    {
        return Err(format!(
            "{name} is {angle_rad}, expected radians from 0 to pi; is it in degrees?"
        ));
    }
    let from_angle = angle
        .1
        .map(|angle_rad| 0.5 * side_px / (0.5 * angle_rad).tan());
    match (given.1, from_angle) {
        // Angles are usually written with fewer digits.
        (Some(focal_px), Some(from_angle))
            if (from_angle / focal_px - 1.0).abs() > MAX_FOCAL_DIFFERENCE =>
        {
            Err(format!(
                "{} is {focal_px}, but {} means {from_angle:.1} for {side_px} pixels; remove the wrong one",
                given.0, angle.0
            ))
        }
        (focal_px, from_angle) => Ok(focal_px.or(from_angle)),
    }
}

/// Finds the file with this name. Windows programs write `\\` as separator.
fn find_file(folder: &Path, name: &str) -> Option<PathBuf> {
    [name, &name.replace('\\', "/")]
        .into_iter()
        .map(|name| folder.join(name))
        .find(|path| path.is_file())
}

/// Finds the file with this name, or with this name plus one of the known extensions.
fn find_image(folder: &Path, name: &str) -> Option<PathBuf> {
    if let Some(path) = find_file(folder, name) {
        return Some(path);
    }
    for name in [name, &name.replace('\\', "/")] {
        for extension in EXTENSIONS {
            // Synthetic datasets such as NeRF's Blender scenes leave out the extension.
            for extension in [extension.to_owned(), extension.to_uppercase()] {
                let path = folder.join(format!("{name}.{extension}"));
                if path.is_file() {
                    return Some(path);
                }
            }
        }
    }
    None
}

/// Text of the source of an error, or of the error if it has no source.
fn reason_of(error: &Error) -> String {
    std::error::Error::source(error).map_or_else(|| error.to_string(), ToString::to_string)
}
