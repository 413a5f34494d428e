//! The samples file of `fieldrig calibrate hand-eye`, and the target in its images.

use super::super::images::{self, DetectedImage, ImageFile, OtherSize};
use super::super::json_object::JsonObject;
use super::super::lens::LensFile;
use super::super::{outputs, target_argument};
use crate::exit::{BadArgument, InsufficientData};
use calibration::hand_eye::{BoardObservation, HandEyeSample, Setup};
use capture::camera_info;
use kinematics::{Intrinsics, Transform};
use nalgebra::DMatrix;
use serde_json::Value;
use session::calibration_report::{Photos, Unused};
use std::path::{Path, PathBuf};
use targets::TargetSpec;

/// Contents of the samples file.
#[derive(Debug)]
pub(super) struct SamplesFile {
    path: PathBuf,
    intrinsics: Option<LensFile>,
    pub(super) target: Option<TargetSpec>,
    pub(super) setup: Setup,
    entries: Vec<Entry>,
}

#[derive(Debug)]
struct Entry {
    base_from_flange: Transform,
    board: EntryBoard,
    joints: Option<Vec<f64>>,
}

#[derive(Debug)]
enum EntryBoard {
    Pose(Transform),
    Image(ImageFile),
}

/// Samples of the file that can be used, and what is known about the others.
#[derive(Debug, Default)]
pub(super) struct Samples {
    pub(super) used: Vec<HandEyeSample>,
    /// Samples whose image cannot be read or does not show the target.
    pub(super) unused: Vec<Unused>,
    pub(super) other_size: Option<OtherSize>,
    /// Size of the images, if there are any.
    pub(super) size_px: Option<[u32; 2]>,
    pub(super) photos: Photos,
}

const FILE_KEYS: [&str; 4] = ["intrinsics", "target", "setup", "samples"];
const SAMPLE_KEYS: [&str; 4] = ["base_from_flange", "camera_from_board", "image", "joints"];

impl SamplesFile {
    pub(super) fn read(path: &Path) -> Result<Self, BadArgument> {
        let name = path.display().to_string();
        let text = outputs::read_text(path)?;
        let mut value: Value = serde_json::from_str(&text)
            .map_err(|error| BadArgument(format!("{name}: {error}{}", not_json_hint(&text))))?;
        if let Some(intrinsics) = value.get_mut("intrinsics") {
            camera_info::convert(intrinsics).map_err(|error| BadArgument(format!("{name}: intrinsics: {error}")))?;
        }
        let file = JsonObject::new(&name, String::new(), &value, &FILE_KEYS)?;
        let intrinsics = file.object("intrinsics", &LensFile::KEYS)?;
        let target = file.text("target")?.map(target_argument).transpose();
        let setup = match file.text("setup")? {
            None | Some("eye-in-hand") => Setup::EyeInHand,
            Some("eye-to-hand") => Setup::EyeToHand,
            Some(other) => {
                return Err(file.invalid("setup", format!("{other:?}, expected \"eye-in-hand\" or \"eye-to-hand\"")));
            }
        };
        let folder = path.parent().unwrap_or(Path::new(""));
        let samples = file.objects("samples", &SAMPLE_KEYS)?;
        if samples.is_empty() {
            return Err(file.invalid("samples", "the list is empty; add 12 or more robot poses with their images"));
        }
        let read = Self {
            path: path.to_owned(),
            intrinsics: intrinsics.map(|lens| LensFile::read(&lens)).transpose()?,
            target: target.map_err(|why| file.invalid("target", why))?,
            setup,
            entries: samples.iter().map(|sample| Entry::read(sample, folder)).collect::<Result<_, _>>()?,
        };
        if read.has_images() && read.target.is_none() {
            return Err(file.invalid(
                "target",
                "missing; samples with images need it, for example \"charuco:5x7:34mm:26mm:5X5_100\"",
            ));
        }
        if read.has_images() && read.intrinsics.is_none() {
            return Err(file.invalid(
                "intrinsics",
                "missing; samples with images need them: {\"focal_px\": [fx, fy], \"principal_px\": [cx, cy]}",
            ));
        }
        Ok(read)
    }

    /// The given intrinsics, for images of this size.
    pub(super) fn intrinsics(&self, size_px: [u32; 2]) -> Result<Option<Intrinsics>, BadArgument> {
        let of_file = |error: BadArgument| BadArgument(format!("{}: {error}", self.path.display()));
        self.intrinsics.as_ref().map(|lens| lens.intrinsics(size_px).map_err(of_file)).transpose()
    }

    /// Covariance of the given intrinsics, if the file contains it.
    pub(super) fn intrinsics_covariance(&self, intrinsics: &Intrinsics) -> Result<Option<DMatrix<f64>>, BadArgument> {
        let of_file = |error: BadArgument| BadArgument(format!("{}: {error}", self.path.display()));
        Ok(match &self.intrinsics {
            Some(lens) => lens.covariance(intrinsics).map_err(of_file)?,
            None => None,
        })
    }

    fn has_images(&self) -> bool {
        self.entries.iter().any(|entry| matches!(entry.board, EntryBoard::Image(_)))
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Detects the target in all images.
    ///
    /// * `is_hidden`: no progress bar.
    pub(super) fn detect(&self, is_hidden: bool) -> anyhow::Result<Samples> {
        let image = |entry: &Entry| match &entry.board {
            EntryBoard::Image(file) => Some(file.clone()),
            EntryBoard::Pose(_) => None,
        };
        let files: Vec<ImageFile> = self.entries.iter().filter_map(image).collect();
        let detected = match &self.target {
            Some(target) if !files.is_empty() => images::detect(&files, target, is_hidden)?,
            _ => Vec::new(),
        };
        let mut samples = Samples {
            unused: images::unused(&detected),
            other_size: self.target.as_ref().and_then(|target| images::other_size(detected.iter(), target)),
            photos: images::photos(&files),
            ..Samples::default()
        };
        let mut detected = detected.into_iter();
        for (ix, entry) in self.entries.iter().enumerate() {
            let (name, board) = match &entry.board {
                EntryBoard::Pose(pose) => (format!("sample {ix}"), BoardObservation::Pose(*pose)),
                EntryBoard::Image(_) => {
                    let DetectedImage { name, board, .. } = detected.next().expect("one result per image");
                    let Ok(board) = board else { continue };
                    samples.expect_size(&name, board.size_px)?;
                    (name, BoardObservation::View(board.view))
                }
            };
            let Entry { base_from_flange, joints, .. } = entry;
            let (base_from_flange, joints) = (*base_from_flange, joints.clone());
            samples.used.push(HandEyeSample { name, base_from_flange, board, joints });
        }
        Ok(samples)
    }

    /// An error if no image shows the target.
    pub(super) fn check_detected(&self, samples: &Samples) -> Result<(), InsufficientData> {
        match samples.used.is_empty() && !samples.unused.is_empty() {
            true => Err(InsufficientData(format!("{}: no image shows the target", self.path.display()))),
            false => Ok(()),
        }
    }
}

/// A hint at numbers that other programs write but JSON does not have.
fn not_json_hint(text: &str) -> &'static str {
    let has = |word: &str| text.split(|c: char| !c.is_ascii_alphabetic()).any(|found| found == word);
    if ["NaN", "nan", "Infinity", "inf"].into_iter().any(has) {
        "; NaN and infinity are not JSON: remove the samples that contain them"
    } else if text.starts_with("%YAML:") {
        "; this is YAML of OpenCV, expected JSON with the keys of docs/guide/calibration.md"
    } else if camera_info::is_yaml(text) {
        "; this is YAML, expected JSON with the keys of docs/guide/calibration.md. To convert YAML: python3 -c \"import json, sys, yaml; \
         json.dump(yaml.safe_load(sys.stdin), sys.stdout)\" < FILE.yaml > FILE.json"
    } else {
        ""
    }
}

impl Samples {
    /// Rejects images of another size than that of the first one.
    fn expect_size(&mut self, name: &str, size_px: [u32; 2]) -> Result<(), calibration::Error> {
        let first_px = *self.size_px.get_or_insert(size_px);
        if first_px == size_px {
            return Ok(());
        }
        let first = self.used.first().map(|sample| sample.name.clone()).unwrap_or_default();
        Err(calibration::Error::MixedImageSizes { first, first_px, other: name.to_owned(), other_px: size_px })
    }
}

impl Entry {
    fn read(sample: &JsonObject<'_>, folder: &Path) -> Result<Self, BadArgument> {
        let base_from_flange = sample.required("base_from_flange", sample.transform("base_from_flange")?)?;
        let board = match (sample.transform("camera_from_board")?, sample.text("image")?) {
            (Some(pose), None) => EntryBoard::Pose(pose),
            (None, Some(image)) => {
                let path = folder.join(image);
                if !path.is_file() {
                    return Err(sample.invalid("image", format!("{} does not exist", path.display())));
                }
                // The name in messages is the path from here, not from the samples file.
                EntryBoard::Image(ImageFile { name: path.display().to_string(), path })
            }
            (None, None) => return Err(sample.invalid("image", "missing; give \"image\" or \"camera_from_board\"")),
            (Some(_), Some(_)) => {
                return Err(sample.invalid("image", "give either \"image\" or \"camera_from_board\", not both"));
            }
        };
        Ok(Self { base_from_flange, board, joints: sample.numbers("joints")? })
    }
}
