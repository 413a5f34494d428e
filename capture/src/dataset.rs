//! Converts the photos of a dataset to keyframes: decodes, undistorts, scales, and splits them.

use crate::{downscale, memory};
use anyhow::{Context, ensure};
use drivers::dataset::{Dataset, DatasetImage, DepthImage, ListedSplit};
use keyframe::{DepthMap, Holdout, Keyframe, Split};
use kinematics::{Intrinsics, Undistortion};
use messages::{BadInput, Setting, counted};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

/// Name of the only camera of a dataset.
const CAMERA: &str = "camera";
/// Maximum number of pixels of the photos that are decoded at the same time. It is 134 million,
/// which is also the maximum of a single photo. Each pixel takes 4 to 12 bytes until the photo is
/// scaled, so decoding needs at most about 1.6 GB. With a larger limit, more threads would decode
/// large photos at once and need more memory.
const MAX_PX_AT_ONCE: u64 = 1 << 27;

/// The photos of a dataset as keyframes: undistorted and scaled, with the poses of the dataset.
#[derive(Debug)]
pub struct LoadedDataset {
    /// Keyframes, in the order of the dataset.
    pub keyframes: Vec<Arc<Keyframe>>,
    /// Names of the photos, in the same order.
    pub names: Vec<String>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Messages about files that did not decode.
    pub data_losses: Vec<String>,
}

/// Decodes all photos in parallel, few at a time if they are large.
///
/// `holdout` assigns the splits. Without `holdout`, the lists of the dataset assign them. If the
/// dataset has no lists, [`Holdout::default`] assigns them. `scale_frac` scales the undistorted
/// photos by averaging areas, and 1 keeps their size. Depth is not scaled. `on_progress` receives
/// the number of finished photos, from any thread. A photo that does not decode is skipped and
/// reported in `data_losses`.
///
/// # Errors
///
/// If no photo decodes, if the scaled photos would be too small or would not fit into memory, or if
/// `holdout` does not match the names.
pub fn load(
    dataset: &Dataset,
    holdout: Option<&Holdout>,
    scale_frac: f64,
    on_progress: &(dyn Fn(usize) + Sync),
) -> anyhow::Result<LoadedDataset> {
    load_few_at_once(dataset, holdout, scale_frac, MAX_PX_AT_ONCE, on_progress)
}

/// Like [`load`], but decodes photos with at most `max_px_at_once` pixels in total at the same
/// time.
fn load_few_at_once(
    dataset: &Dataset,
    holdout: Option<&Holdout>,
    scale_frac: f64,
    max_px_at_once: u64,
    on_progress: &(dyn Fn(usize) + Sync),
) -> anyhow::Result<LoadedDataset> {
    // Errors that need no decoding are reported before minutes are spent on it.
    for image in &dataset.images {
        downscale::intrinsics(&image.intrinsics, scale_frac).with_context(|| image.name.clone())?;
    }
    if let Some(available_bytes) = memory::available_bytes() {
        check_memory(dataset, scale_frac, available_bytes)?;
    }
    let names: Vec<&str> = dataset
        .images
        .iter()
        .map(|image| image.name.as_str())
        .collect();
    let splits = splits_of(dataset, holdout, &names)?;
    let results = decode_all(dataset, &splits, scale_frac, max_px_at_once, on_progress);
    collect(dataset, results)
}

/// The split of each photo. `holdout` has priority over the lists of the dataset. The default is
/// used if there is neither.
fn splits_of(
    dataset: &Dataset,
    holdout: Option<&Holdout>,
    names: &[&str],
) -> anyhow::Result<Vec<Split>> {
    // The lists count only if they contain every photo.
    let listed = dataset
        .images
        .iter()
        .map(|image| image.listed.map(split_of))
        .collect::<Option<Vec<Split>>>();
    match (holdout, listed) {
        (None, Some(listed)) => Ok(listed),
        _ => {
            let holdout = holdout.cloned().unwrap_or_default();
            holdout
                .splits(names)
                .with_context(|| dataset.path.display().to_string())
        }
    }
}

/// Converts the photos in the order of the dataset; returns the name and the result of each.
fn decode_all(
    dataset: &Dataset,
    splits: &[Split],
    scale_frac: f64,
    max_px_at_once: u64,
    on_progress: &(dyn Fn(usize) + Sync),
) -> Vec<(String, anyhow::Result<Converted>)> {
    let n_done = AtomicUsize::new(0);
    let camera: Arc<str> = CAMERA.into();
    // Photos with the same lens follow each other, so only one set of maps is in memory at a time.
    let mut results = Vec::with_capacity(dataset.images.len());
    let mut start = 0;
    for run in dataset.images.chunk_by(|a, b| a.intrinsics == b.intrinsics) {
        let lens = LensMaps::of(&run[0].intrinsics);
        let n_at_once = n_at_once(
            run[0].intrinsics.size_px,
            max_px_at_once,
            rayon::current_num_threads(),
        );
        let n_at_once = n_at_once.unwrap_or(run.len());
        let run_splits = &splits[start..start + run.len()];
        // The photos of a chunk are decoded in parallel. The next chunk waits until all of these
        // photos are scaled. At most one chunk of full-size photos is therefore in memory.
        for (images, image_splits) in run.chunks(n_at_once).zip(run_splits.chunks(n_at_once)) {
            let jobs = images.par_iter().zip(image_splits);
            results.par_extend(jobs.map(|(image, split)| {
                let converted = keyframe(&lens, image, scale_frac);
                on_progress(n_done.fetch_add(1, Ordering::Relaxed) + 1);
                let converted = converted.map(|converted| converted.assigned_to(&camera, *split));
                (image.name.clone(), converted)
            }));
        }
        start += run.len();
    }
    results
}

/// Collects the results. If a single photo does not decode, its error becomes a message, so that
/// the other photos can still be used.
fn collect(
    dataset: &Dataset,
    results: Vec<(String, anyhow::Result<Converted>)>,
) -> anyhow::Result<LoadedDataset> {
    let mut loaded = LoadedDataset {
        keyframes: Vec::new(),
        names: Vec::new(),
        notes: dataset.notes.clone(),
        data_losses: dataset.data_losses.clone(),
    };
    let mut image_errors = Vec::new();
    let mut depth_errors = Vec::new();
    let mut mask_warnings = Vec::new();
    for (name, result) in results {
        match result {
            Ok(Converted {
                keyframe,
                depth_error,
                mask_warning,
            }) => {
                loaded.keyframes.push(Arc::new(keyframe));
                loaded.names.push(name);
                depth_errors.extend(depth_error);
                mask_warnings.extend(mask_warning);
            }
            Err(error) => image_errors.push(format!("{error:#}")),
        }
    }
    if !mask_warnings.is_empty() {
        let n_masks = counted(mask_warnings.len() as u64, "mask");
        loaded.notes.push(format!(
            "{n_masks} may exclude the wrong pixels: {}",
            first_of(&mask_warnings)
        ));
    }
    ensure!(
        !loaded.keyframes.is_empty(),
        "{}: no photo can be used: {}",
        dataset.path.display(),
        first_of(&image_errors)
    );
    for (what, errors) in [("image", image_errors), ("depth image", depth_errors)] {
        if !errors.is_empty() {
            let n_unusable = counted(errors.len() as u64, what);
            loaded.data_losses.push(format!(
                "{n_unusable} cannot be used: {}",
                first_of(&errors)
            ));
        }
    }
    Ok(loaded)
}

/// Number of photos of this size that may be decoded at the same time. Together, they have at most
/// `max_px` pixels, but a single photo is always allowed. `None` if each thread may decode a photo.
fn n_at_once(size_px: [u32; 2], max_px: u64, n_threads: usize) -> Option<usize> {
    let n_px: u64 = size_px.map(u64::from).iter().product();
    let n_photos = usize::try_from(max_px / n_px.max(1)).unwrap_or(usize::MAX);
    (n_photos < n_threads).then_some(n_photos.max(1))
}

/// Checks that the photos fit into memory once they are scaled. Their depth images are not counted.
///
/// * `available_bytes`: memory that programs can still use.
fn check_memory(dataset: &Dataset, scale_frac: f64, available_bytes: u64) -> anyhow::Result<()> {
    let n_bytes: u64 = dataset
        .images
        .iter()
        .map(|image| {
            4 * image
                .intrinsics
                .scaled(scale_frac)
                .size_px
                .map(u64::from)
                .iter()
                .product::<u64>()
        })
        .sum();
    if n_bytes <= available_bytes {
        return Ok(());
    }
    // Memory is proportional to the square of the scale.
    let fitting = scale_frac * (available_bytes as f64 / n_bytes as f64).sqrt();
    // The scale is rounded down, so that the suggested scale fits.
    let remedy = match (100.0 * fitting).floor() / 100.0 {
        scale if scale >= downscale::MIN_SCALE => {
            format!(
                "scale them to {scale} or less ({} of `fieldrig train`, `eval` and `bench`)",
                Setting::Scale
            )
        }
        _ => "use fewer photos".to_owned(),
    };
    Err(BadInput(format!(
        "{}: {} take {:.1} GB of memory, but only {:.1} GB are available: {remedy}",
        dataset.path.display(),
        counted(dataset.images.len() as u64, "photo"),
        n_bytes as f64 / 1e9,
        available_bytes as f64 / 1e9
    ))
    .into())
}

fn split_of(listed: ListedSplit) -> Split {
    match listed {
        ListedSplit::Train => Split::Train,
        ListedSplit::Validation => Split::Validation,
        ListedSplit::Test => Split::Test,
    }
}

/// The first messages in one line, and the number of the remaining messages.
fn first_of(errors: &[String]) -> String {
    const MAX_SHOWN: usize = 3;
    messages::shortened(errors, MAX_SHOWN, "; ")
}

/// Undistortion maps of one lens; empty for a lens without distortion.
struct LensMaps {
    color: Option<Undistortion>,
    /// Map for depth images whose size differs from that of the photos. It is computed for the
    /// first such image.
    depth: OnceLock<Undistortion>,
}

impl LensMaps {
    fn of(intrinsics: &Intrinsics) -> Self {
        let color = (!intrinsics.is_pinhole()).then(|| Undistortion::new(intrinsics));
        Self {
            color,
            depth: OnceLock::new(),
        }
    }

    /// Undistorts and scales a photo. If it becomes smaller, the undistorted photo is never in
    /// memory as a whole.
    fn scaled_color(
        &self,
        rgba: Vec<u8>,
        from_px: [u32; 2],
        to_px: [u32; 2],
    ) -> Result<Vec<u8>, kinematics::Error> {
        match &self.color {
            None => Ok(downscale::rgba(rgba, from_px, to_px)),
            Some(map) if from_px == to_px => {
                Ok(downscale::rgba(map.apply_rgba(&rgba)?, from_px, to_px))
            }
            Some(map) => Ok(downscale::rgba_of_rows(
                from_px,
                to_px,
                map.rgba_rows(&rgba)?,
            )),
        }
    }

    fn undistorted_depth(&self, depth: &DepthImage) -> Result<Vec<f32>, kinematics::Error> {
        let Some(color) = &self.color else {
            return Ok(depth.depth_m.clone());
        };
        let size_px = depth.intrinsics.size_px;
        // A depth image of the same size has the lens of the photo, and therefore uses the same
        // map.
        if color.size_px() == size_px {
            return color.apply_depth(&depth.depth_m);
        }
        let cached = self
            .depth
            .get_or_init(|| Undistortion::new(&depth.intrinsics));
        // Depth images rarely have a different size than the first one, so maps for other sizes are
        // not kept.
        if cached.size_px() == size_px {
            cached.apply_depth(&depth.depth_m)
        } else {
            Undistortion::new(&depth.intrinsics).apply_depth(&depth.depth_m)
        }
    }
}

/// The keyframe of one photo, and messages about its other files.
struct Converted {
    keyframe: Keyframe,
    depth_error: Option<String>,
    mask_warning: Option<String>,
}

impl Converted {
    /// Sets camera and split.
    fn assigned_to(self, camera: &Arc<str>, split: Split) -> Self {
        Self {
            keyframe: Keyframe {
                camera: Arc::clone(camera),
                split,
                ..self.keyframe
            },
            ..self
        }
    }
}

/// Converts one photo. The caller sets camera and split.
fn keyframe(lens: &LensMaps, image: &DatasetImage, scale_frac: f64) -> anyhow::Result<Converted> {
    let loaded = image.load()?;
    let in_image = || image.name.clone();
    let depth = loaded
        .depth
        .as_ref()
        .zip(image.depth.as_ref())
        .map(|(depth, file)| {
            Ok::<_, anyhow::Error>(DepthMap {
                size_px: depth.intrinsics.size_px,
                focal_px: depth.intrinsics.focal_px,
                principal_px: depth.intrinsics.principal_px,
                depth_m: lens.undistorted_depth(depth).with_context(in_image)?.into(),
                world_from_camera: file.world_from_camera,
            })
        });
    let depth = depth.transpose()?;
    // Only the photo is scaled. Depth keeps its size and its own intrinsics, because averages
    // across edges would lie on no surface.
    let scaled = image.intrinsics.scaled(scale_frac);
    let rgba = lens
        .scaled_color(loaded.rgba_srgb, image.intrinsics.size_px, scaled.size_px)
        .with_context(in_image)?;
    let keyframe = Keyframe {
        camera: CAMERA.into(),
        stamp: image.stamp,
        size_px: scaled.size_px,
        focal_px: scaled.focal_px,
        principal_px: scaled.principal_px,
        rgba_srgb: rgba.into(),
        depth,
        world_from_camera: image.world_from_camera,
        twist: None,
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: None,
        split: Split::Train,
        truth: None,
        robot: None,
    };
    Ok(Converted {
        keyframe,
        depth_error: loaded.depth_error,
        mask_warning: loaded.mask_warning,
    })
}

#[cfg(test)]
mod tests;
