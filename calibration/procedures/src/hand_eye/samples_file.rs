//! The samples file of `fieldrig calibrate hand-eye`, and the target in its images.

use crate::host::Host;
use crate::images::{self, DetectedImage, ImageFile, OtherSize};
use crate::json_object::{self, JsonObject};
use crate::lens::LensFile;
use crate::outputs;
use calibration::hand_eye::{BoardObservation, HandEyeSample, Setup};
use capture::camera_info;
use kinematics::{Intrinsics, Transform};
use messages::{BadInput, InsufficientData, Setting};
use nalgebra::DMatrix;
use report::calibration_report::{Photos, Unused};
use std::collections::BTreeMap;
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

/// Usable samples of the file, and the reasons why other samples cannot be used.
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
    pub(super) fn read(path: &Path) -> Result<Self, BadInput> {
        let name = path.display().to_string();
        let text = outputs::read_text(path)?;
        let mut value = json_object::parse(&text)
            // Such files often come from other programs, so the error describes what to change.
            .map_err(|error| BadInput(format!("{name}: {error}{}", not_json_hint(&text))))?;
        // Paths in the file are relative to it, so that its folder can be moved.
        let folder = path.parent().unwrap_or(Path::new(""));
        // The intrinsics may be written in several formats, or be in a separate file. They are
        // converted in place, so that the code below reads one format.
        if let Some(intrinsics) = value.get_mut("intrinsics") {
            let invalid = |why: String| BadInput(format!("{name}: intrinsics: {why}"));
            let mut source = String::new();
            if let Some(file) = intrinsics.as_str() {
                let file = folder.join(file);
                source = format!("{}: ", file.display());
                let text = outputs::read_text(&file)?;
                *intrinsics = camera_info::parse_value(&text)
                    .map_err(|why| invalid(format!("{source}{why}")))?;
            }
            let notes = camera_info::convert(intrinsics)
                .map_err(|why| invalid(format!("{source}{why}")))?;
            notes
                .iter()
                .for_each(|note| log::warn!("{name}: intrinsics: {source}{note}"));
        }
        // Unknown keys are errors, because a misspelled key would be ignored silently.
        let file = JsonObject::new(&name, String::new(), &value, &FILE_KEYS)?;
        let intrinsics = file.object("intrinsics", &LensFile::KEYS)?;
        let target = file
            .text("target")?
            .map(str::parse::<TargetSpec>)
            .transpose();
        let setup = match file.text("setup")? {
            None | Some("eye-in-hand") => Setup::EyeInHand,
            Some("eye-to-hand") => Setup::EyeToHand,
            Some(other) => {
                return Err(file.invalid(
                    "setup",
                    format!("{other:?}, expected \"eye-in-hand\" or \"eye-to-hand\""),
                ));
            }
        };
        let samples = file.objects("samples", &SAMPLE_KEYS)?;
        if samples.is_empty() {
            return Err(file.invalid(
                "samples",
                "the list is empty; add 12 or more robot poses with their images",
            ));
        }
        let entries: Vec<Entry> = samples
            .iter()
            .map(|sample| Entry::read(sample, folder))
            .collect::<Result<_, _>>()?;
        check_images(&samples, &entries)?;
        let read = Self {
            path: path.to_owned(),
            intrinsics: intrinsics.map(|lens| LensFile::read(&lens)).transpose()?,
            target: target.map_err(|why| file.invalid("target", why))?,
            setup,
            entries,
        };
        // The target and the intrinsics are optional keys, because samples may contain poses of the
        // board instead of images.
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
    pub(super) fn intrinsics(&self, size_px: [u32; 2]) -> Result<Option<Intrinsics>, BadInput> {
        let of_file = |error: BadInput| BadInput(format!("{}: {error}", self.path.display()));
        self.intrinsics
            .as_ref()
            .map(|lens| lens.intrinsics(size_px).map_err(of_file))
            .transpose()
    }

    /// Covariance of the given intrinsics, if the file contains it.
    pub(super) fn intrinsics_covariance(
        &self,
        intrinsics: &Intrinsics,
    ) -> Result<Option<DMatrix<f64>>, BadInput> {
        let of_file = |error: BadInput| BadInput(format!("{}: {error}", self.path.display()));
        Ok(match &self.intrinsics {
            Some(lens) => lens.covariance(intrinsics).map_err(of_file)?,
            None => None,
        })
    }

    /// Notes about parts of the file that do not affect the result. They do not end with a period.
    ///
    /// * `estimates_joints`: whether the offsets of joints are estimated.
    pub(super) fn unused(&self, estimates_joints: bool) -> Vec<String> {
        let without_images = self.intrinsics.is_some() && !self.has_images();
        let without_flag =
            !estimates_joints && self.entries.iter().any(|entry| entry.joints.is_some());
        let notes = [
            (
                without_images,
                "intrinsics are not used, because no sample has an image".to_owned(),
            ),
            (
                without_flag,
                format!("joints are only used with {}", Setting::WithJoints),
            ),
        ];
        notes
            .into_iter()
            .filter(|(applies, _)| *applies)
            .map(|(_, note)| note)
            .collect()
    }

    fn has_images(&self) -> bool {
        self.entries
            .iter()
            .any(|entry| matches!(entry.board, EntryBoard::Image(_)))
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Detects the target in all images.
    pub(super) fn detect(&self, host: &dyn Host) -> anyhow::Result<Samples> {
        let image = |entry: &Entry| match &entry.board {
            EntryBoard::Image(file) => Some(file.clone()),
            EntryBoard::Pose(_) => None,
        };
        let files: Vec<ImageFile> = self.entries.iter().filter_map(image).collect();
        let detected = match &self.target {
            // Without images, there is nothing to detect, so the target is optional.
            Some(target) if !files.is_empty() => images::detect(&files, target, host)?,
            _ => Vec::new(),
        };
        let mut samples = Samples {
            unused: images::unused(&detected),
            other_size: self
                .target
                .as_ref()
                .and_then(|target| images::other_size(detected.iter(), target)),
            photos: images::photos(&files),
            ..Samples::default()
        };
        // The results are in the order of the images, so the next result belongs to the next entry
        // with an image.
        let mut detected = detected.into_iter();
        for (ix, entry) in self.entries.iter().enumerate() {
            let (name, board) = match &entry.board {
                EntryBoard::Pose(pose) => (format!("sample {ix}"), BoardObservation::Pose(*pose)),
                EntryBoard::Image(_) => {
                    let DetectedImage { name, board, .. } =
                        detected.next().expect("one result per image");
                    // This key is listed in `unused` above.
                    let Ok(board) = board else { continue };
                    // One lens model applies to all images, and it depends on their size.
                    samples.expect_size(&name, board.size_px)?;
                    (name, BoardObservation::View(board.view))
                }
            };
            samples.used.push(HandEyeSample {
                name,
                base_from_flange: entry.base_from_flange,
                board,
                joints: entry.joints.clone(),
            });
        }
        Ok(samples)
    }

    /// An error if no image shows the target.
    pub(super) fn check_detected(&self, samples: &Samples) -> Result<(), InsufficientData> {
        // Without any image, the samples are poses. The calibration itself checks the number of
        // poses.
        if samples.used.is_empty() && !samples.unused.is_empty() {
            Err(InsufficientData(format!(
                "{}: no image shows the target",
                self.path.display()
            )))
        } else {
            Ok(())
        }
    }
}

/// Returns a hint if the text contains numbers that other programs write but that are not valid
/// JSON.
fn not_json_hint(text: &str) -> &'static str {
    // Only whole words count, because "inf" is also a part of other words.
    let has = |word: &str| {
        text.split(|c: char| !c.is_ascii_alphabetic())
            .any(|found| found == word)
    };
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
    /// Rejects images whose size differs from the size of the first image.
    fn expect_size(&mut self, name: &str, size_px: [u32; 2]) -> Result<(), calibration::Error> {
        let first_px = *self.size_px.get_or_insert(size_px);
        // The first image defines the size.
        if first_px == size_px {
            return Ok(());
        }
        let first = self
            .used
            .first()
            .map(|sample| sample.name.clone())
            .unwrap_or_default();
        Err(calibration::Error::MixedImageSizes {
            first,
            first_px,
            other: name.to_owned(),
            other_px: size_px,
        })
    }
}

/// Rejects an image with two robot poses. Identical samples are allowed.
fn check_images(samples: &[JsonObject<'_>], entries: &[Entry]) -> Result<(), BadInput> {
    let mut first_use: BTreeMap<&Path, usize> = BTreeMap::new();
    for (ix, entry) in entries.iter().enumerate() {
        let EntryBoard::Image(image) = &entry.board else {
            continue;
        };
        // The same image with the same pose is allowed, because a sample may be listed twice.
        let first = *first_use.entry(&image.path).or_insert(ix);
        if entries[first].base_from_flange != entry.base_from_flange {
            let why = format!(
                "{} is the image of samples[{first}], too, which has another robot pose",
                image.name
            );
            return Err(samples[ix].invalid("image", why));
        }
    }
    Ok(())
}

/// A pose in a sample.
fn pose(sample: &JsonObject<'_>, key: &str) -> Result<Option<Transform>, BadInput> {
    /// Positions beyond this are assumed to be mistakes.
    const MAX_POSITION_M: f64 = 1e4;
    let pose = sample.transform(key)?;
    // The largest coordinate is used instead of the distance, because the limit is only
    // approximate.
    let farthest_m = pose.map_or(0.0, |pose| pose.translation.vector.amax());
    if farthest_m > MAX_POSITION_M {
        let why = format!(
            "its position is {farthest_m:e} m away, at most {MAX_POSITION_M:e} m are accepted; write meters"
        );
        return Err(sample.invalid(key, why));
    }
    Ok(pose)
}

impl Entry {
    fn read(sample: &JsonObject<'_>, folder: &Path) -> Result<Self, BadInput> {
        let base_from_flange =
            sample.required("base_from_flange", pose(sample, "base_from_flange")?)?;
        let board = match (pose(sample, "camera_from_board")?, sample.text("image")?) {
            (Some(pose), None) => EntryBoard::Pose(pose),
            (None, Some(image)) => {
                let path = folder.join(image);
                // The path is checked before any image is searched for the target, because the
                // search takes long.
                if !path.is_file() {
                    return Err(
                        sample.invalid("image", format!("{} does not exist", path.display()))
                    );
                }
                // Messages contain the path relative to the working directory, not to the samples
                // file.
                EntryBoard::Image(ImageFile {
                    name: path.display().to_string(),
                    path,
                })
            }
            (None, None) => {
                return Err(
                    sample.invalid("image", "missing; give \"image\" or \"camera_from_board\"")
                );
            }
            // Two sources for one value are an error, because they may contradict each other.
            (Some(_), Some(_)) => {
                return Err(sample.invalid(
                    "image",
                    "give either \"image\" or \"camera_from_board\", not both",
                ));
            }
        };
        Ok(Self {
            base_from_flange,
            board,
            joints: sample.numbers("joints")?,
        })
    }
}

#[cfg(test)]
mod tests;
