//! Input of `train` and `eval`: a dataset folder or a recording, as keyframes in host memory.

use crate::depth_from::{DepthSource, RenderedDepth};
use crate::holdout::parse_holdout;
use crate::methods::methods_of;
use crate::read_progress::{OnReadProgress, ReadProgress};
use crate::run_folder::{hex, is_recording};
use crate::training_options::{AvailableData, MIN_IMAGES_PER_CAMERA};
use anyhow::ensure;
use capture::config::{Override, Rig};
use capture::open::{self, Opened};
use capture::{DriftReport, Join, JoinEvent, SampleUse, StationReport, Stations, dataset};
use drivers::Sample;
use gpu::Gpu;
use keyframe::{Holdout, Keyframe, KeyframeList, Split};
use kinematics::Stamp;
use messages::{BadInput, InsufficientData, Setting, counted};
use model_files::InitialPoints;
use model_files::splat::ply;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::ModelKind;

/// Which images are read, and how they are scaled and split.
#[derive(Clone, Debug, Default)]
pub struct DataOptions {
    /// Test images: a number n for every n-th image, or a file that lists them. `None` selects
    /// every 8th image.
    pub holdout: Option<String>,
    /// List of the keyframes to use.
    pub keyframes: Option<PathBuf>,
    /// Rig file that replaces the rig file stored in a recording.
    pub rig: Option<PathBuf>,
    /// Fraction of the width and height to which color images are scaled. Depth images are not
    /// scaled.
    pub scale: Option<f64>,
}

/// The options in the order of [`DataOptions::flags`], with their names in checkpoints.
const SETTINGS: [(&str, Setting); 4] = [
    ("holdout", Setting::Holdout),
    ("keyframes", Setting::Keyframes),
    ("rig", Setting::Rig),
    ("scale", Setting::Scale),
];

impl DataOptions {
    /// The selected test images, if any are selected.
    pub fn holdout(&self) -> anyhow::Result<Option<Holdout>> {
        Ok(self.holdout.as_deref().map(parse_holdout).transpose()?)
    }

    /// Names and values of the given flags that affect keyframes. Paths of files are absolute.
    pub fn flags(&self) -> BTreeMap<String, String> {
        let given = [
            ("holdout", self.holdout.as_deref().map(holdout_value)),
            ("keyframes", self.keyframes.as_deref().map(absolute)),
            ("rig", self.rig.as_deref().map(absolute)),
            ("scale", self.scale.map(|scale| scale.to_string())),
        ];
        given
            .into_iter()
            .filter_map(|(name, value)| Some((name.to_owned(), value?)))
            .collect()
    }

    /// The flags that affect the pixels of listed keyframes, as command-line arguments.
    pub fn flags_of_images(&self) -> Vec<String> {
        let rig = self
            .rig
            .as_ref()
            .map(|file| [Setting::Rig.to_string(), file.display().to_string()]);
        let scale = self
            .scale
            .map(|scale| [Setting::Scale.to_string(), scale.to_string()]);
        rig.into_iter().chain(scale).flatten().collect()
    }

    /// Fills in missing flags from the flags of an earlier run, `before`. A number must be the same
    /// as before. A path may differ, because the file may have moved. The contents of the file are
    /// compared later.
    ///
    /// `subject`: name of the earlier result in messages.
    pub fn completed_with(
        &self,
        subject: &str,
        before: &BTreeMap<String, String>,
    ) -> anyhow::Result<Self> {
        let now = self.flags();
        for (name, setting) in SETTINGS {
            // A file with other contents is detected later, when keyframes are compared.
            let is_other =
                |now: &str, value: &str| now != value && is_number(now) && is_number(value);
            if let (Some(now), Some(value)) = (now.get(name), before.get(name))
                && is_other(now, value)
            {
                return Err(BadInput(format!(
                    "{setting} {now}: {subject} was trained with {setting} {value}"
                ))
                .into());
            }
        }
        let unset_flag = |name: &str| before.get(name).filter(|_| !now.contains_key(name));
        // `--holdout` and `--keyframes` both select images, so giving either one discards both
        // earlier values.
        let image_flag = |name: &str| {
            unset_flag(name).filter(|_| self.holdout.is_none() && self.keyframes.is_none())
        };
        let scale = unset_flag("scale").map(|scale| scale.parse());
        let scale = scale
            .transpose()
            .map_err(|_| BadInput(format!("{subject}: the scale is not a number")))?;
        let restored = Self {
            holdout: self.holdout.clone().or(image_flag("holdout").cloned()),
            keyframes: self
                .keyframes
                .clone()
                .or(image_flag("keyframes").map(PathBuf::from)),
            rig: self.rig.clone().or(unset_flag("rig").map(PathBuf::from)),
            scale: self.scale.or(scale),
        };
        let all = restored.flags();
        let restored_flags: Vec<String> = SETTINGS
            .iter()
            .filter(|(name, _)| !now.contains_key(*name))
            .filter_map(|(name, setting)| Some(format!("{setting} {}", all.get(*name)?)))
            .collect();
        if !restored_flags.is_empty() {
            log::info!(
                "using the flags that {subject} was trained with: {}",
                restored_flags.join(" ")
            );
        }
        Ok(restored)
    }
}

fn is_number(text: &str) -> bool {
    text.parse::<f64>().is_ok()
}

/// The stored value of `--holdout`. A number is stored unchanged, and a file with its
/// absolute path.
fn holdout_value(text: &str) -> String {
    if is_number(text) {
        text.to_owned()
    } else {
        absolute(Path::new(text))
    }
}

/// The absolute path of a file, because a later run may be started in another folder.
fn absolute(file: &Path) -> String {
    file.canonicalize()
        .unwrap_or_else(|_| file.to_owned())
        .display()
        .to_string()
}

/// Loaded keyframes and their metadata.
pub struct Data {
    /// The keyframes, in the order of the data.
    pub keyframes: Vec<Arc<Keyframe>>,
    /// Names of the images, in the same order.
    pub names: Vec<String>,
    /// PLY file of points from which models without depth start; `None` if the data names none.
    pub points_path: Option<PathBuf>,
    /// The rig of the recording; `None` for a folder.
    pub rig: Option<Rig>,
    /// Whether the stamps are times rather than image indices.
    pub has_times: bool,
    /// Descriptions of data that could not be read. The exit code is 3 unless this is empty.
    pub data_losses: Vec<String>,
    /// The correction of the base pose at each station after the first.
    pub stations: Vec<StationReport>,
    /// What range scans showed about the drift of the base; `None` if they did not correct it.
    pub drift: Option<DriftReport>,
    /// Depth that was rendered from a model for images without depth.
    pub rendered_depth: Option<RenderedDepth>,
    /// Time spent on station registration and depth rendering, which precede training but count as
    /// training time.
    pub preparation_time: Duration,
}

/// Purpose of the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Needs at least one training image.
    Training,
    /// Needs at least one test image.
    Scoring,
}

/// The resolved selection of images.
struct DataSelection {
    list: Option<KeyframeList>,
    holdout: Option<Holdout>,
    scale: Option<f64>,
    /// Replaces the rig stored in a recording.
    rig: Option<PathBuf>,
    /// Whether base poses are used as reported, without corrections at stations.
    use_reported_poses: bool,
}

impl Data {
    /// Reads a dataset folder, or a recording whose images are joined with poses.
    pub fn load(
        path: &Path,
        args: &DataOptions,
        purpose: Purpose,
        overrides: &[Override],
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        let list = args
            .keyframes
            .as_deref()
            .map(KeyframeList::load)
            .transpose()?;
        let holdout = args.holdout()?;
        Self::load_selected(
            path,
            DataSelection {
                list,
                holdout,
                scale: args.scale,
                rig: args.rig.clone(),
                use_reported_poses: false,
            },
            purpose,
            overrides,
            progress,
        )
    }

    /// Reads the keyframes of a list. Images are scaled by `scale`, and base poses are used as
    /// reported.
    pub fn of_list(
        path: &Path,
        list: KeyframeList,
        rig: Option<PathBuf>,
        scale: f64,
        overrides: &[Override],
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        let selection = DataSelection {
            list: Some(list),
            holdout: None,
            scale: Some(scale),
            rig,
            use_reported_poses: true,
        };
        Self::load_selected(path, selection, Purpose::Training, overrides, progress)
    }

    fn load_selected(
        path: &Path,
        selection: DataSelection,
        purpose: Purpose,
        overrides: &[Override],
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        let DataSelection {
            list,
            holdout,
            scale,
            rig,
            use_reported_poses,
        } = selection;
        expect(path)?;
        let is_recording = is_recording(path);
        let mut data = if is_recording {
            let scale = scale.map(|scale| Override::new("train.scale", scale));
            let overrides: Vec<Override> = overrides.iter().cloned().chain(scale).collect();
            let rig = rig
                .as_deref()
                .map(|file| Rig::load(file, &overrides))
                .transpose()?;
            Self::from_recording(path, rig, list, overrides, progress)?
        } else if let Some(rig) = rig {
            return Err(BadInput(format!(
                "{} {}: only recordings take a rig file",
                Setting::Rig,
                rig.display()
            ))
            .into());
        } else {
            Self::from_folder(path, holdout.as_ref(), scale.unwrap_or(1.0), list, progress)?
        };
        // A folder is split when it is read. Keyframes of a recording have the splits of a live
        // run, which `--holdout` replaces.
        if is_recording && let Some(holdout) = &holdout {
            data.assign_splits(holdout)?;
        }
        if !use_reported_poses {
            data.realign();
        }
        data.check_split(path, purpose)?;
        data.check_masks(path)?;
        Ok(data)
    }

    /// Returns an error if there is no image for this purpose.
    fn check_split(&self, path: &Path, purpose: Purpose) -> anyhow::Result<()> {
        let (required_split, message) = match purpose {
            Purpose::Training => (Split::Train, "no training image"),
            Purpose::Scoring => (Split::Test, "no test image"),
        };
        if self.of_split(required_split).is_empty() {
            let n_images = counted(self.keyframes.len() as u64, "image");
            return Err(InsufficientData(format!(
                "{}: {message} among {n_images}",
                path.display()
            ))
            .into());
        }
        Ok(())
    }

    /// Returns an error if all pixels of all images are masked. Logs a warning if some images are
    /// masked completely.
    fn check_masks(&self, path: &Path) -> anyhow::Result<()> {
        let n_masked = self
            .keyframes
            .iter()
            .filter(|keyframe| is_masked(keyframe))
            .count();
        // The usual cause is an inverted mask. Training would succeed with an empty model.
        if n_masked == self.keyframes.len() {
            return Err(InsufficientData(format!(
                "{}: no pixel of any image can be used: masks, transparency or lens parameters exclude all of them (black in \
                 a mask means \"do not use\")",
                path.display()
            ))
            .into());
        }
        if n_masked > 0 {
            let n_images = counted(n_masked as u64, "image");
            log::warn!(
                "{}: no pixel of {n_images} can be used, because all are masked",
                path.display()
            );
        }
        Ok(())
    }

    /// The rig of a recording, before flags override its keys.
    pub fn rig_as_given(path: &Path, args: &DataOptions) -> anyhow::Result<Rig> {
        let rig = args
            .rig
            .as_deref()
            .map(|file| Rig::load(file, &[]))
            .transpose()?;
        Ok(open::recording(path, rig, &[])?.rig)
    }

    /// The methods to train if no flag names any. They come from the rig file of a recording.
    /// Otherwise, the default method is returned.
    pub fn default_methods(path: &Path, args: &DataOptions) -> anyhow::Result<Vec<ModelKind>> {
        expect(path)?;
        if is_recording(path) {
            methods_of(&Self::rig_as_given(path, args)?)
        } else {
            Ok(vec![ModelKind::default()])
        }
    }

    /// Keyframes of one split.
    pub fn of_split(&self, split: Split) -> Vec<Arc<Keyframe>> {
        self.keyframes
            .iter()
            .filter(|keyframe| keyframe.split == split)
            .cloned()
            .collect()
    }

    /// Names of the images by camera and stamp.
    pub fn image_names(&self) -> BTreeMap<(String, i64), String> {
        let key = |keyframe: &Arc<Keyframe>| (keyframe.camera.to_string(), keyframe.stamp.0);
        self.keyframes
            .iter()
            .map(key)
            .zip(self.names.iter().cloned())
            .collect()
    }

    /// Properties of the data that limit which parameters can be estimated.
    pub fn available(&self) -> AvailableData {
        let n_cameras = self
            .keyframes
            .iter()
            .map(|keyframe| &keyframe.camera)
            .collect::<HashSet<_>>()
            .len();
        AvailableData {
            joints: self.rig.is_some(),
            drifts: self.rig.as_ref().is_none_or(Rig::has_moving_base),
            // Depth rendered from reported camera poses contains no information about the true
            // poses.
            depth: self.has_depth()
                && self
                    .rendered_depth
                    .as_ref()
                    .is_none_or(|rendered| rendered.n_images == 0),
            color_only: !self.has_depth(),
            many_images_per_camera: self.keyframes.len() >= MIN_IMAGES_PER_CAMERA * n_cameras,
        }
    }

    /// Whether any keyframe has depth.
    pub fn has_depth(&self) -> bool {
        self.keyframes
            .iter()
            .any(|keyframe| keyframe.depth.is_some())
    }

    /// Reads the points from which models without depth start. Returns `None` if the data name no
    /// points, if the points cannot be read, or if a training or validation image has depth. The
    /// reason is logged.
    pub fn initial_points(&self) -> Option<Arc<InitialPoints>> {
        let path = self.points_path.as_deref()?;
        let shown = path.display();
        // Depth gives more points, at the surfaces that the images show.
        let is_learned_with_depth =
            |keyframe: &Arc<Keyframe>| keyframe.split != Split::Test && keyframe.depth.is_some();
        if self.keyframes.iter().any(is_learned_with_depth) {
            log::warn!("{shown}: these points are not used, because images have depth");
            return None;
        }
        match ply::read_points(path).map_err(anyhow::Error::from) {
            Ok((points, notes)) => {
                for note in notes {
                    log::warn!("{shown}: {note}");
                }
                let n_points = counted(points.points_in_world_m.len() as u64, "point");
                log::info!("{shown}: splats start at {n_points}");
                Some(Arc::new(points))
            }
            Err(error) => {
                log::warn!("training starts without the points of the dataset: {error:#}");
                None
            }
        }
    }

    /// Renders depth for images without depth from a model.
    pub fn render_depth(
        &mut self,
        gpu: Arc<Gpu>,
        source: &DepthSource,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<()> {
        let started = Instant::now();
        self.rendered_depth = Some(source.draw(gpu, &mut self.keyframes, progress)?);
        self.preparation_time += started.elapsed();
        Ok(())
    }

    fn from_folder(
        path: &Path,
        holdout: Option<&Holdout>,
        scale: f64,
        list: Option<KeyframeList>,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        let folder = drivers::dataset::read(path)?;
        let n_all = Some(folder.images.len());
        let on_image = |n_done: usize| report(progress, "images", n_done, n_all);
        let loaded = dataset::load(&folder, holdout, scale, &on_image)?;
        for note in &loaded.notes {
            log::warn!("{note}");
        }
        let mut data = Self {
            keyframes: loaded.keyframes,
            names: loaded.names,
            points_path: folder.points_path.clone(),
            rig: None,
            has_times: folder.has_times(),
            data_losses: loaded.data_losses,
            stations: Vec::new(),
            drift: None,
            rendered_depth: None,
            preparation_time: Duration::ZERO,
        };
        if let Some(list) = list {
            data.take_only(&list)?;
        }
        Ok(data)
    }

    fn from_recording(
        path: &Path,
        rig: Option<Rig>,
        list: Option<KeyframeList>,
        overrides: Vec<Override>,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        Self::from_source(
            open::recording(path, rig, &overrides)?,
            list,
            |_| false,
            progress,
        )
    }

    /// Joins the images of a rig's devices with poses until `is_end` returns true for a sample, or
    /// the devices end.
    pub fn from_devices(
        opened: Opened,
        is_end: impl FnMut(&Sample) -> bool,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        let mut data = Self::from_source(opened, None, is_end, progress)?;
        data.realign();
        Ok(data)
    }

    fn from_source(
        opened: Opened,
        list: Option<KeyframeList>,
        mut is_end: impl FnMut(&Sample) -> bool,
        progress: OnReadProgress<'_>,
    ) -> anyhow::Result<Self> {
        let Opened {
            rig,
            mut source,
            damage,
            ..
        } = opened;
        let mut join = Join::new(&rig)?;
        if let Some(list) = list {
            join = join.taking_only(list);
        }
        let mut keyframes: Vec<Arc<Keyframe>> = Vec::new();
        while let Some(sample) = source.next_sample()? {
            if is_end(&sample) {
                break;
            }
            apply(&mut keyframes, join.push(sample));
            report(progress, "keyframes", keyframes.len(), None);
        }
        // At the end, some images may still wait for a later pose. `finish` accepts or rejects
        // them.
        apply(&mut keyframes, join.finish());
        report(progress, "keyframes", keyframes.len(), None);
        log::info!("{}", join.counts());
        if let Some(drift) = join.drift() {
            log::info!("{drift}");
        }
        let mut data_losses = join.counts().data_losses(SampleUse::ProcessedOnly);
        data_losses.extend(damage.get().cloned());
        data_losses.extend(join.check_list()?);
        let names = keyframes.iter().map(|keyframe| name(keyframe)).collect();
        Ok(Self {
            keyframes,
            names,
            points_path: None,
            rig: Some(rig),
            has_times: true,
            data_losses,
            stations: Vec::new(),
            drift: join.drift().cloned(),
            rendered_depth: None,
            preparation_time: Duration::ZERO,
        })
    }

    /// Corrects the base poses at stations, as a live run does.
    fn realign(&mut self) {
        let Some(mut stations) = self.rig.as_ref().and_then(Stations::new) else {
            return;
        };
        self.keyframes = stations.corrected(std::mem::take(&mut self.keyframes));
        self.stations = stations.reports().to_vec();
        self.preparation_time = stations.spent();
    }

    /// Reassigns the splits, separately for each camera.
    fn assign_splits(&mut self, holdout: &Holdout) -> anyhow::Result<()> {
        let mut by_camera: BTreeMap<Arc<str>, Vec<usize>> = BTreeMap::new();
        for (ix, keyframe) in self.keyframes.iter().enumerate() {
            by_camera
                .entry(keyframe.camera.clone())
                .or_default()
                .push(ix);
        }
        // With every 8th image of the whole recording, a camera could have no test image at all.
        for ixs in by_camera.values() {
            let names: Vec<&str> = ixs.iter().map(|ix| self.names[*ix].as_str()).collect();
            for (ix, split) in ixs.iter().zip(holdout.splits(&names)?) {
                Arc::make_mut(&mut self.keyframes[*ix]).split = split;
            }
        }
        Ok(())
    }

    /// Keeps only the listed keyframes, with the splits in the list.
    fn take_only(&mut self, list: &KeyframeList) -> anyhow::Result<()> {
        let images: Vec<(&str, Stamp)> = self
            .keyframes
            .iter()
            .map(|keyframe| (&*keyframe.camera, keyframe.stamp))
            .collect();
        let missing = list.check_found(images.iter().copied(), images.first().copied())?;
        self.data_losses.extend(missing);
        let all = std::mem::take(&mut self.keyframes)
            .into_iter()
            .zip(std::mem::take(&mut self.names));
        for (mut keyframe, name) in all {
            if let Some(split) = list.split_of(&keyframe.camera, keyframe.stamp) {
                Arc::make_mut(&mut keyframe).split = split;
                self.keyframes.push(keyframe);
                self.names.push(name);
            }
        }
        Ok(())
    }
}

/// Adds and removes keyframes as a join has decided.
fn apply(keyframes: &mut Vec<Arc<Keyframe>>, events: Vec<JoinEvent>) {
    for event in events {
        match event {
            JoinEvent::Accepted(keyframe) => keyframes.push(keyframe),
            JoinEvent::Evicted { camera, stamp } => {
                keyframes.retain(|keyframe| keyframe.camera != camera || keyframe.stamp != stamp);
            }
            JoinEvent::PosedImage(_) | JoinEvent::RangeScan(_) | JoinEvent::Rejected { .. } => {}
        }
    }
}

/// Reports progress.
fn report(progress: OnReadProgress<'_>, noun: &'static str, n_done: usize, n_all: Option<usize>) {
    progress(ReadProgress {
        noun,
        n_done,
        n_all,
    });
}

/// Whether no pixel of an image can be used.
fn is_masked(keyframe: &Keyframe) -> bool {
    keyframe
        .rgba_srgb
        .chunks_exact(4)
        .all(|pixel| pixel[3] == 0)
}

/// SHA-256 of positions and colors, which identifies points in decision logs.
pub fn points_sha256(points: &InitialPoints) -> String {
    let mut hash = Sha256::new();
    for coordinate in points.points_in_world_m.as_flattened() {
        hash.update(coordinate.to_le_bytes());
    }
    hash.update(points.colors_srgb.as_flattened());
    hex(&hash.finalize())
}

/// Returns an error if the path does not exist.
pub fn expect(path: &Path) -> anyhow::Result<()> {
    ensure!(path.exists(), "{} does not exist", path.display());
    Ok(())
}

/// Name of a recorded image: camera and stamp.
fn name(keyframe: &Keyframe) -> String {
    format!("{}/{}", keyframe.camera, keyframe.stamp.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ignore_progress;
    use nalgebra::Point3;
    use serde_json::{Value, json};

    #[test]
    fn missing_flags_are_restored() {
        let none = DataOptions {
            holdout: None,
            keyframes: None,
            rig: None,
            scale: None,
        };
        let first = DataOptions {
            holdout: Some("5".into()),
            scale: Some(0.25),
            ..none.clone()
        };
        let again = |args: &DataOptions| args.completed_with("the checkpoint", &first.flags());
        assert_eq!(
            again(&none).expect("no flag is given").flags(),
            first.flags()
        );
        let listed = DataOptions {
            keyframes: Some("other.txt".into()),
            ..none.clone()
        };
        let names: Vec<String> = again(&listed)
            .expect("lists are compared later")
            .flags()
            .into_keys()
            .collect();
        assert_eq!(names, ["keyframes", "scale"]);
        let same = DataOptions {
            scale: Some(0.25),
            ..none.clone()
        };
        assert_eq!(again(&same).expect("the same").flags(), first.flags());
        let other = again(&DataOptions {
            scale: Some(0.5),
            ..none.clone()
        })
        .expect_err("another")
        .to_string();
        assert_eq!(
            other,
            "scale 0.5: the checkpoint was trained with scale 0.25"
        );
        assert!(
            again(&DataOptions {
                holdout: Some("2".into()),
                ..none
            })
            .is_err()
        );
    }

    #[test]
    fn initial_points_are_read_unless_there_is_depth_or_they_are_damaged() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let frame = |name: &str| {
            image::RgbImage::from_pixel(64, 48, image::Rgb([10, 20, 30]))
                .save(at(name))
                .expect("saved");
            let rows = [[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
            json!({ "file_path": name, "transform_matrix": rows })
        };
        let frames = [frame("test.png"), frame("train.png")];
        let mut document = json!({ "fl_x": 60.0, "frames": frames, "ply_file_path": "points.ply" });
        let load = |document: &Value| {
            std::fs::write(at("transforms.json"), document.to_string()).expect("written");
            let data = Data::load(
                folder.path(),
                &DataOptions::default(),
                Purpose::Training,
                &[],
                &ignore_progress,
            );
            data.expect("points do not affect the images")
        };
        let coordinates = "property float x\nproperty float y\nproperty float z\n";
        let channels = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
        let header =
            format!("ply\nformat ascii 1.0\nelement vertex 2\n{coordinates}{channels}end_header\n");
        let write = |rows: &str| {
            std::fs::write(at("points.ply"), format!("{header}{rows}")).expect("written")
        };

        write("5.5 1 -3 255 0 0\nnan 0 0 1 2 3\n");
        let data = load(&document);
        let points = data.initial_points().expect("one point is usable");
        assert_eq!(points.points_in_world_m, [[5.5, 1.0, -3.0]]);
        assert_eq!(points.colors_srgb, [[255, 0, 0]]);
        // The point is in the frame of the poses: to the right of the camera, above its axis, and
        // in front of it.
        let in_camera = data.keyframes[0].world_from_camera.inverse() * Point3::new(5.5, 1.0, -3.0);
        assert!(
            (in_camera - Point3::new(0.5, -1.0, 3.0)).norm() < 1e-9,
            "{in_camera}"
        );
        let first = points_sha256(&points);
        write("5.5 1 -3 255 0 1\nnan 0 0 1 2 3\n");
        let second = points_sha256(&load(&document).initial_points().expect("another color"));
        assert!(first.len() == 64 && first != second, "{first} {second}");

        let depth =
            image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(64, 48, image::Luma([1000]));
        depth.save(at("depth.png")).expect("saved");
        document["frames"][0]["depth_file_path"] = "depth.png".into();
        assert!(
            load(&document).initial_points().is_some(),
            "test images do not matter"
        );
        document["frames"][1]["depth_file_path"] = "depth.png".into();
        assert!(
            load(&document).initial_points().is_none(),
            "depth has priority"
        );
        document["frames"][1]["depth_file_path"] = Value::Null;
        write("5.5 1 -3 255 0 1\n");
        assert!(load(&document).initial_points().is_none(), "truncated");
        document["ply_file_path"] = "gone.ply".into();
        assert!(load(&document).initial_points().is_none(), "missing");
    }
}
