//! Which frames are compared with which: those that see the same surface, from near and from far.

use super::frame::{Frame, depth_at, point};
use super::view::View;
use rayon::prelude::*;

/// Share of a frame's spots that its partner must show.
const LEAST_OVERLAP: f64 = 0.3;
/// Spots that are looked up for the overlap.
const PROBES: usize = 40;
/// Readings that differ by more show another surface; poses may be wrong by centimetres.
const SAME_FRAC: f64 = 0.1;
/// A partner that hardly moved tells nothing: radians, and the share of the depth.
const LEAST_MOTION: f64 = 0.01;

/// Spots of frame `from` are looked at in frame `to`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Pair {
    pub(super) from: usize,
    pub(super) to: usize,
}

/// At most `most` partners among `candidates` for each frame of `tos`, spread over how far they have turned and moved.
pub(super) fn choose(frames: &[Frame], views: &[View], candidates: &[usize], tos: &[usize], most: usize) -> Vec<Pair> {
    let of = |to: &usize| {
        let mut seen: Vec<(f64, usize)> = candidates
            .iter()
            .filter(|from| *from != to)
            .filter_map(|from| {
                let distance = distance(frames, views, *from, *to)?;
                (distance > LEAST_MOTION).then_some((distance, *from))
            })
            .collect();
        seen.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)));
        let n = seen.len();
        let picks: Vec<usize> =
            if n <= most { (0..n).collect() } else { (0..most).map(|ix| ix * (n - 1) / (most - 1).max(1)).collect() };
        picks.into_iter().map(|ix| Pair { from: seen[ix].1, to: *to }).collect::<Vec<Pair>>()
    };
    tos.par_iter().map(of).collect::<Vec<_>>().concat()
}

/// How far `from` is from `to`: the turn in radians plus the way in depths; none where they do not see the same.
fn distance(frames: &[Frame], views: &[View], from: usize, to: usize) -> Option<f64> {
    let (i, j) = (&views[from], &views[to]);
    let depth = frames[to].keyframe.depth.as_ref()?;
    let spots = &frames[from].even_spots;
    let stride = spots.len().div_ceil(PROBES).max(1);
    let (mut n_seen, mut n, mut depths_m) = (0.0, 0.0, 0.0);
    for spot in spots.iter().step_by(stride) {
        let in_i = i.color_from_depth.then(&point(i.depth_focal_px, i.depth_principal_px, spot));
        let at = j.color_from_depth.back(&j.world_from_camera.back(&i.world_from_camera.then(&in_i)));
        n += 1.0;
        depths_m += spot.z_m;
        if at.z <= 0.0 {
            continue;
        }
        let reading = depth_at(depth, j.depth_pixel(&at));
        n_seen += if reading.is_some_and(|seen| (seen.value - at.z).abs() < SAME_FRAC * at.z) { 1.0 } else { 0.0 };
    }
    if n_seen < LEAST_OVERLAP * n || n == 0.0 {
        return None;
    }
    let turn = i.world_from_camera.rotation.tr_mul(&j.world_from_camera.rotation);
    let angle = (0.5 * (turn.trace() - 1.0)).clamp(-1.0, 1.0).acos();
    let way = (i.world_from_camera.shift - j.world_from_camera.shift).norm();
    Some(angle + way * n / depths_m)
}
