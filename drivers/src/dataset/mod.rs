//! Datasets on disk: posed photos in nerfstudio and TUM RGB-D folders.

pub mod nerfstudio;
mod other_formats;
mod posed_image;
pub mod tum;

pub use posed_image::{DatasetImage, DepthFile, DepthImage, ListedSplit, LoadedImage};

use crate::Error;
use kinematics::{Intrinsics, Lens};
use std::path::{Path, PathBuf};

/// The usable images of a folder.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// The folder.
    pub path: PathBuf,
    /// Images, sorted by file name (nerfstudio) or time (TUM). The list is never empty.
    pub images: Vec<DatasetImage>,
    /// PLY file of points on the surfaces of the scene, in the world frame of the images. The file
    /// may not exist. `None` if the dataset names no such file.
    pub points_path: Option<PathBuf>,
    /// Number of images skipped because their file does not exist.
    pub n_missing: usize,
    /// Number of images skipped because their file is corrupt, or no pose or depth is close enough
    /// in time.
    pub n_unusable: usize,
    /// Notes for the user. Each note is one sentence and contains the names of the first skipped
    /// images.
    pub notes: Vec<String>,
    /// Messages about corrupt data. These data are missing from the result. Each message is one
    /// sentence.
    pub data_losses: Vec<String>,
}

impl Dataset {
    /// Whether the stamps are real times. If not, they only number the images.
    pub fn has_times(&self) -> bool {
        !is_nerfstudio(&self.path) && self.path.join(tum::COLOR_LIST).is_file()
    }
}

fn is_nerfstudio(path: &Path) -> bool {
    path.is_file() || path.join(nerfstudio::FILE_NAME).is_file()
}

/// Whether [`read`] accepts `path` as a dataset folder. The contents of the folder are not checked.
pub fn is_dataset_folder(path: &Path) -> bool {
    [nerfstudio::FILE_NAME, tum::COLOR_LIST]
        .iter()
        .any(|name| path.join(name).is_file())
}

/// Reads a dataset folder of either kind. `path` may also name a `transforms.json`.
pub fn read(path: &Path) -> Result<Dataset, Error> {
    if path.is_file()
        && let Some(hint) = other_formats::hint(path)
    {
        return Err(Error::DatasetFile {
            path: path.to_owned(),
            reason: format!("{}{hint}", nerfstudio::OTHER_FILE),
        });
    }
    if is_nerfstudio(path) {
        return nerfstudio::read(path);
    }
    if path.join(tum::COLOR_LIST).is_file() {
        return tum::read(path);
    }
    Err(Error::NotADataset {
        path: path.to_owned(),
        hint: other_formats::hint(path).unwrap_or_default(),
    })
}

/// Describes implausible lens parameters. These are a focal length or principal point that no
/// camera has, such as the result of a division by almost zero, or coefficients that no lens has.
fn implausible(intrinsics: &Intrinsics) -> Option<String> {
    /// Range of focal lengths relative to the longer side of the image. It corresponds to fields of
    /// view from 0.06 to 176 degrees.
    const FOCAL: std::ops::RangeInclusive<f64> = 0.02..=1000.0;
    /// Range of principal points relative to the image size. It is wide because images may be cut
    /// out of larger images.
    const CENTER: std::ops::RangeInclusive<f64> = -1.0..=2.0;
    let [width, height] = intrinsics.size_px.map(f64::from);
    let longer = width.max(height);
    let focal = intrinsics
        .focal_px
        .iter()
        .any(|focal_px| !FOCAL.contains(&(focal_px / longer)));
    let [x, y] = intrinsics.principal_px;
    let center = !(CENTER.contains(&(x / width)) && CENTER.contains(&(y / height)));
    if focal || center {
        return Some(format!(
            "focal lengths {:?} and principal point {:?} are implausible for {width} x {height} pixels",
            intrinsics.focal_px, intrinsics.principal_px
        ));
    }
    implausible_lens(intrinsics)
}

fn implausible_lens(intrinsics: &Intrinsics) -> Option<String> {
    /// Maximum fraction of the image in which lens coefficients may be implausible. Coefficients
    /// that were fitted without measurements in the corners are often wrong there.
    const MAX_IMPLAUSIBLE_FRAC: f64 = 1.0 / 3.0;
    let implausible_frac = intrinsics.implausible_lens_frac();
    (implausible_frac > MAX_IMPLAUSIBLE_FRAC).then(|| {
        format!(
            "the lens coefficients ({}) are implausible in {:.0} % of the image: no lens distorts so strongly; check them and the \
             focal length",
            named_coefficients(&intrinsics.lens),
            100.0 * implausible_frac
        )
    })
}

/// The coefficients that are not 0, with their names.
fn named_coefficients(lens: &Lens) -> String {
    const BROWN_CONRADY: [&str; 8] = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
    const KANNALA_BRANDT: [&str; 4] = ["k1", "k2", "k3", "k4"];
    let names: &[&str] = match lens {
        Lens::KannalaBrandt(_) => &KANNALA_BRANDT,
        Lens::Pinhole | Lens::BrownConrady(_) | Lens::RationalBrownConrady(_) => &BROWN_CONRADY,
    };
    let named: Vec<String> = std::iter::zip(names, lens.coefficients())
        .filter(|(_, value)| **value != 0.0)
        .map(|(name, value)| format!("{name} = {value}"))
        .collect();
    named.join(", ")
}

/// Positions beyond this limit are assumed to be mistakes, meters. Scenes are far smaller, and f32,
/// in which models are trained, has a resolution of 1 mm at this distance.
const MAX_POSITION_M: f64 = 1e4;

/// Images skipped while reading.
#[derive(Debug, Default)]
struct SkippedImages {
    missing: Vec<String>,
    /// Names of unusable images, each with the reason. The list `broken` has the same form.
    unusable: Vec<(String, String)>,
    broken: Vec<(String, String)>,
    /// Messages about other parts of the dataset that cannot be used.
    lost: Vec<String>,
}

impl SkippedImages {
    /// Maximum number of names in a note.
    const MAX_NAMED: usize = 5;

    /// Reports lines of a list that cannot be used.
    fn lines(&mut self, list: &str, reasons: &[String]) {
        if !reasons.is_empty() {
            let (lines, _) = plural(reasons.len(), "line");
            self.lost.push(format!(
                "{list}: {lines} cannot be used: {}",
                first_names(reasons)
            ));
        }
    }

    /// Builds the dataset. Fails if it is empty.
    fn dataset(
        self,
        path: &Path,
        images: Vec<DatasetImage>,
        mut notes: Vec<String>,
    ) -> Result<Dataset, Error> {
        let n_missing = self.missing.len();
        let n_unusable = self.unusable.len() + self.broken.len();
        // One example shows more about the cause than the counts.
        if images.is_empty() {
            let first_broken = self.broken.iter().chain(&self.unusable).next();
            let first_broken = first_broken.map(|(name, reason)| format!(" ({name}: {reason})"));
            let first_missing = self
                .missing
                .first()
                .map(|name| format!(" (such as {name})"));
            let first_reason = first_broken.or(first_missing).unwrap_or_default();
            return Err(Error::EmptyDataset {
                path: path.to_owned(),
                n_missing,
                n_unusable,
                first_reason,
            });
        }
        if n_missing > 0 {
            let (what, verb) = plural(n_missing, "image");
            notes.push(format!(
                "{what} {verb} missing: {}",
                first_names(&self.missing)
            ));
        }
        notes.extend(unusable_note(&self.unusable));
        let data_losses = self
            .lost
            .into_iter()
            .chain(unusable_note(&self.broken))
            .collect();
        Ok(Dataset {
            path: path.to_owned(),
            images,
            points_path: None,
            n_missing,
            n_unusable,
            notes,
            data_losses,
        })
    }
}

fn unusable_note(images: &[(String, String)]) -> Option<String> {
    let named: Vec<_> = images
        .iter()
        .map(|(name, reason)| format!("{name} ({reason})"))
        .collect();
    let (n_images, _) = plural(images.len(), "image");
    (!named.is_empty()).then(|| format!("{n_images} cannot be used: {}", first_names(&named)))
}

/// Returns a noun with its count, and the matching verb: `1 image` and `is`, `2 images` and `are`.
fn plural(n: usize, noun: &str) -> (String, &'static str) {
    if n == 1 {
        (format!("1 {noun}"), "is")
    } else {
        (format!("{n} {noun}s"), "are")
    }
}

/// The first names, and how many more there are.
fn first_names(names: &[String]) -> String {
    messages::shortened(names, SkippedImages::MAX_NAMED, ", ")
}

#[cfg(test)]
mod tests;
