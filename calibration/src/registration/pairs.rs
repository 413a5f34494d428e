//! Selection of pairs of images that show the same surface, from nearby to distant viewpoints.

use super::prepared_image::{PreparedImage, depth_at, point};
use super::view::CorrectedView;
use rayon::prelude::*;

/// Minimum fraction of an image's samples that its partner must show. With less overlap, a pair
/// takes the same time but has fewer residuals, and more of them are at occlusions.
const MIN_OVERLAP: f64 = 0.3;
/// Number of samples that are tested for the overlap, which gives it a standard deviation of about
/// 7 %. All pairs of images are tested, so this determines the time of the selection.
const N_PROBES: usize = 40;
/// Readings that differ by more than this fraction belong to different surfaces. The fraction is
/// large because poses may have errors of centimeters.
const SAME_SURFACE_FRAC: f64 = 0.1;
/// Minimum distance of a partner. The distance is the rotation in radians plus the translation
/// divided by the depth. Closer partners carry no information.
const MIN_MOTION: f64 = 0.01;

/// A pair of images. Samples of image `from` are compared with image `to`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Pair {
    pub(super) from: usize,
    pub(super) to: usize,
}

/// Chooses at most `max_partners` partners among `candidates` for each image of `targets`, spread
/// evenly over their distances.
pub(super) fn choose(
    images: &[PreparedImage],
    views: &[CorrectedView],
    candidates: &[usize],
    targets: &[usize],
    max_partners: usize,
) -> Vec<Pair> {
    targets
        .par_iter()
        .map(|to| {
            let others = candidates.iter().filter(|from| *from != to);
            let overlapping = others.filter_map(|from| {
                let distance = distance(images, views, *from, *to)?;
                (distance > MIN_MOTION).then_some((distance, *from))
            });
            spread_evenly(overlapping.collect(), max_partners)
                .into_iter()
                .map(|from| Pair { from, to: *to })
                .collect::<Vec<Pair>>()
        })
        .collect::<Vec<_>>()
        .concat()
}

/// Chooses at most `max` of the images, which are given with their distances, spread evenly over
/// the ranks of the distances.
///
/// Near partners have accurate residuals and converge from large errors. Distant partners determine
/// the parameters better.
pub(super) fn spread_evenly(mut images: Vec<(f64, usize)>, max: usize) -> Vec<usize> {
    // Equal distances are ordered by index, so that the result does not depend on the sort.
    images.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)));
    let n = images.len();
    if n <= max {
        images.into_iter().map(|(_, ix)| ix).collect()
    } else {
        (0..max)
            .map(|rank| images[rank * (n - 1) / (max - 1).max(1)].1)
            .collect()
    }
}

/// Distance between two images. It is the rotation in radians plus the translation in mean depths.
/// `None` without sufficient overlap.
fn distance(
    images: &[PreparedImage],
    views: &[CorrectedView],
    from: usize,
    to: usize,
) -> Option<f64> {
    let i = &views[from];
    let j = &views[to];
    let depth = images[to].keyframe.depth.as_ref()?;
    let samples = &images[from].uniform_samples;
    let stride = samples.len().div_ceil(N_PROBES).max(1);
    let mut n_visible = 0.0;
    let mut n = 0.0;
    let mut depths_m = 0.0;
    for sample in samples.iter().step_by(stride) {
        let in_i = i
            .color_from_depth
            .apply(&point(i.depth_focal_px, i.depth_principal_px, sample));
        let at = j.color_from_depth.apply_inverse(
            &j.world_from_camera
                .apply_inverse(&i.world_from_camera.apply(&in_i)),
        );
        n += 1.0;
        depths_m += sample.z_m;
        if at.z <= 0.0 {
            continue;
        }
        let reading = depth_at(depth, j.depth_pixel(&at));
        n_visible += if reading
            .is_some_and(|sampled| (sampled.value - at.z).abs() < SAME_SURFACE_FRAC * at.z)
        {
            1.0
        } else {
            0.0
        };
    }
    if n_visible < MIN_OVERLAP * n || n == 0.0 {
        return None;
    }
    let rotation = i
        .world_from_camera
        .rotation
        .tr_mul(&j.world_from_camera.rotation);
    // The trace of a rotation matrix is 1 + 2 cos(angle).
    let angle = (0.5 * (rotation.trace() - 1.0)).clamp(-1.0, 1.0).acos();
    let translation = (i.world_from_camera.translation - j.world_from_camera.translation).norm();
    Some(angle + translation * n / depths_m)
}
