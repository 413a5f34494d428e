//! Photos of a dataset -> keyframes: decoded, undistorted, scaled, split.

use crate::holdout::Holdout;
use anyhow::{Context, ensure};
use drivers::dataset::{Dataset, DatasetFrame, DepthImage};
use kinematics::{Intrinsics, Undistortion};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use trainer::{DepthMap, Keyframe, Split};

/// Name of the one camera of a dataset.
const CAMERA: &str = "camera";

/// The photos of a dataset as keyframes.
#[derive(Debug)]
pub(crate) struct Loaded {
    /// In the order of the dataset.
    pub(crate) keyframes: Vec<Arc<Keyframe>>,
    /// Names of the photos, in the same order.
    pub(crate) names: Vec<String>,
    /// What a user should know: of the dataset, and of the photos that did not decode.
    pub(crate) notes: Vec<String>,
}

/// Decodes all photos on all cores.
///
/// `scale_frac` shrinks the undistorted photos (not their depth) by averaging areas; 1 leaves them as they are.
/// `on_progress` is told how many photos are done. A photo that does not decode is left out with a note; none at all is an error.
pub(crate) fn load(
    dataset: &Dataset,
    holdout: &Holdout,
    scale_frac: f64,
    on_progress: &(dyn Fn(usize) + Sync),
) -> anyhow::Result<Loaded> {
    ensure!(scale_frac > 0.0 && scale_frac <= 1.0, "--scale {scale_frac}: must be above 0 and at most 1");
    let names: Vec<&str> = dataset.frames.iter().map(|frame| frame.name.as_str()).collect();
    let splits = holdout.splits(&names).with_context(|| dataset.path.display().to_string())?;
    let n_done = AtomicUsize::new(0);
    let camera: Arc<str> = CAMERA.into();
    let load_one = |(lens, frame, split): (&LensMaps, &DatasetFrame, Split)| {
        let keyframe = keyframe(lens, frame, scale_frac);
        on_progress(n_done.fetch_add(1, Ordering::Relaxed) + 1);
        (frame.name.clone(), keyframe.map(|keyframe| Keyframe { camera: camera.clone(), split, ..keyframe }))
    };

    // Photos of one lens follow each other; only their maps are in memory at a time.
    let mut results = Vec::with_capacity(names.len());
    let mut start = 0;
    for run in dataset.frames.chunk_by(|a, b| a.intrinsics == b.intrinsics) {
        let lens = LensMaps::of(&run[0].intrinsics);
        let jobs = run.par_iter().zip(&splits[start..start + run.len()]);
        results.par_extend(jobs.map(|(frame, split)| load_one((&lens, frame, *split))));
        start += run.len();
    }

    let mut loaded = Loaded { keyframes: Vec::new(), names: Vec::new(), notes: dataset.notes.clone() };
    let mut broken = Vec::new();
    for (name, keyframe) in results {
        match keyframe {
            Ok(keyframe) => {
                loaded.keyframes.push(Arc::new(keyframe));
                loaded.names.push(name);
            }
            Err(error) => broken.push(format!("{error:#}")),
        }
    }
    let trained = loaded.keyframes.iter().any(|keyframe| keyframe.split == Split::Train);
    ensure!(trained, "{}: no photo to train on can be used: {}", dataset.path.display(), broken.join("; "));
    if !broken.is_empty() {
        loaded.notes.push(format!("{} images cannot be used: {}", broken.len(), broken.join("; ")));
    }
    Ok(loaded)
}

/// What undoes the distortion of one lens; nothing where there is none.
struct LensMaps {
    color: Option<Undistortion>,
    /// For depth images of another size than the photos; made when the first one comes.
    depth: OnceLock<Undistortion>,
}

impl LensMaps {
    fn of(intrinsics: &Intrinsics) -> Self {
        let color = (!intrinsics.is_pinhole()).then(|| Undistortion::new(intrinsics));
        Self { color, depth: OnceLock::new() }
    }

    fn undistorted_color(&self, rgba: Vec<u8>) -> Result<Vec<u8>, kinematics::Error> {
        match &self.color {
            Some(map) => map.apply_rgba(&rgba),
            None => Ok(rgba),
        }
    }

    fn undistorted_depth(&self, depth: &DepthImage) -> Result<Vec<f32>, kinematics::Error> {
        let Some(color) = &self.color else { return Ok(depth.depth_m.clone()) };
        let wanted_px = depth.intrinsics.size_px;
        if color.size_px() == wanted_px {
            return color.apply_depth(&depth.depth_m);
        }
        let kept = self.depth.get_or_init(|| Undistortion::new(&depth.intrinsics));
        match kept.size_px() == wanted_px {
            true => kept.apply_depth(&depth.depth_m),
            false => Undistortion::new(&depth.intrinsics).apply_depth(&depth.depth_m),
        }
    }
}

/// The keyframe of one photo; its camera and split are filled in by the caller.
fn keyframe(lens: &LensMaps, frame: &DatasetFrame, scale_frac: f64) -> anyhow::Result<Keyframe> {
    let images = frame.load()?;
    let in_frame = || frame.name.clone();
    let depth = images.depth.as_ref().zip(frame.depth.as_ref()).map(|(depth, file)| {
        anyhow::Ok(DepthMap {
            size_px: depth.intrinsics.size_px,
            focal_px: depth.intrinsics.focal_px,
            principal_px: depth.intrinsics.principal_px,
            depth_m: lens.undistorted_depth(depth).with_context(in_frame)?.into(),
            world_from_camera: file.world_from_camera,
        })
    });
    let depth = depth.transpose()?;
    let full_px = frame.intrinsics.size_px;
    let mut rgba = lens.undistorted_color(images.rgba_srgb).with_context(in_frame)?;
    let scaled = frame.intrinsics.scaled(scale_frac);
    if scaled.size_px != full_px {
        rgba = area_mean(&rgba, full_px, scaled.size_px);
    }
    // What is partly masked is masked: no pixel mixes in what must not be seen.
    for alpha in rgba.iter_mut().skip(3).step_by(4) {
        *alpha = if *alpha == 255 { 255 } else { 0 };
    }
    Ok(Keyframe {
        camera: CAMERA.into(),
        stamp: frame.stamp,
        size_px: scaled.size_px,
        focal_px: scaled.focal_px,
        principal_px: scaled.principal_px,
        rgba_srgb: rgba.into(),
        depth,
        world_from_camera: frame.world_from_camera,
        twist: None,
        readout_secs: 0.0,
        split: Split::Train,
        truth: None,
    })
}

/// Shrinks `[height, width, 4]`: each new pixel is the mean over the area it covers, fractions of pixels included.
fn area_mean(rgba: &[u8], from_px: [u32; 2], to_px: [u32; 2]) -> Vec<u8> {
    let [from_width, to_width] = [from_px[0] as usize, to_px[0] as usize];
    let (columns, rows) = (coverage(from_px[0], to_px[0]), coverage(from_px[1], to_px[1]));
    let mut out = Vec::with_capacity(4 * to_width * rows.len());
    let mut sums = vec![[0.0_f32; 4]; from_width];
    for covered_rows in &rows {
        sums.fill([0.0; 4]);
        for &(y, share) in covered_rows {
            let row = rgba[4 * y * from_width..4 * (y + 1) * from_width].as_chunks::<4>().0;
            for (sum, pixel) in sums.iter_mut().zip(row) {
                (0..4).for_each(|channel| sum[channel] += share * f32::from(pixel[channel]));
            }
        }
        for covered_columns in &columns {
            let mean = |channel: usize| covered_columns.iter().map(|&(x, share)| share * sums[x][channel]).sum::<f32>();
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a mean of bytes is a byte")]
            out.extend((0..4).map(|channel| mean(channel).round() as u8));
        }
    }
    out
}

/// For each new pixel of a line, the old ones it covers and their shares, which add up to 1.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "positions lie inside the line")]
fn coverage(from: u32, to: u32) -> Vec<Vec<(usize, f32)>> {
    let ratio = f64::from(from) / f64::from(to);
    let covered = |ix: u32| {
        let (start, end) = (f64::from(ix) * ratio, (f64::from(ix + 1) * ratio).min(f64::from(from)));
        let overlap = |old: usize| ((old as f64 + 1.0).min(end) - (old as f64).max(start)) / ratio;
        let olds = start as usize..(end.ceil() as usize).min(from as usize);
        olds.map(|old| (old, overlap(old) as f32)).filter(|(_, share)| *share > 1e-6).collect()
    };
    (0..to).map(covered).collect()
}

#[cfg(test)]
mod tests;
