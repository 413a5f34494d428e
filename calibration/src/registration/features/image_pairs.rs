//! Selection of pairs of images that may show the same surface, without depth.

use super::feature_image::FeatureImage;
use super::moving_camera::MovingCamera;
use crate::registration::pairs::Pair;
use kinematics::Transform;
use kinematics::quantile::median;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Maximum angle between the viewing directions of a pair, radians. Corners look too different
/// beyond it.
const MAX_VIEW_ANGLE_RAD: f64 = 0.8;
/// Minimum distance between the cameras of a pair, meters, and relative to the median distance.
/// Closer images determine hardly any epipolar lines.
const MIN_BASELINE_M: f64 = 0.02;
const MIN_BASELINE_FRAC: f64 = 0.1;
/// Minimum fraction of an image that its partner must show if all points are at one, favorable,
/// depth.
const MIN_OVERLAP: f64 = 0.4;
/// Depths for the overlap, relative to the distance between the cameras.
const DEPTHS: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];
/// Columns and rows of the grid of pixels for the overlap.
const GRID: [usize; 2] = [6, 5];

/// Chooses at most `max_partners` partners for each image, spread evenly over the relative motions.
/// Two images form at most one pair.
pub(super) fn choose(
    images: &[FeatureImage],
    cameras: &[MovingCamera],
    max_partners: usize,
) -> Vec<Pair> {
    let poses: Vec<Transform> = cameras
        .iter()
        .map(|camera| camera.world_from_camera)
        .collect();
    let median_baseline_m = median_baseline_m(&poses);
    let min_baseline_m = (MIN_BASELINE_FRAC * median_baseline_m).max(MIN_BASELINE_M);
    let partners_of = |to: usize| {
        let distance = |from: usize| {
            let to_from_from = poses[to].inverse() * poses[from];
            let baseline_m = to_from_from.translation.vector.norm();
            let view_angle_rad = (to_from_from.rotation * Vector3::z()).angle(&Vector3::z());
            let is_suitable = from != to
                && baseline_m > min_baseline_m
                && view_angle_rad < MAX_VIEW_ANGLE_RAD
                && overlap(&images[from], &images[to], &to_from_from) > MIN_OVERLAP;
            is_suitable.then(|| to_from_from.rotation.angle() + baseline_m / median_baseline_m)
        };
        let mut suitable: Vec<(f64, usize)> = (0..images.len())
            .filter_map(|from| Some((distance(from)?, from)))
            .collect();
        suitable.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)));
        let n = suitable.len();
        let picks: Vec<usize> = if n <= max_partners {
            (0..n).collect()
        } else {
            (0..max_partners)
                .map(|ix| ix * (n - 1) / (max_partners - 1).max(1))
                .collect()
        };
        picks
            .into_iter()
            .map(|ix| Pair {
                from: suitable[ix].1,
                to,
            })
            .collect::<Vec<Pair>>()
    };
    let mut pairs = (0..images.len())
        .into_par_iter()
        .map(partners_of)
        .collect::<Vec<_>>()
        .concat();
    let key = |pair: &Pair| (pair.from.min(pair.to), pair.from.max(pair.to));
    pairs.sort_by_key(key);
    pairs.dedup_by_key(|pair| key(pair));
    pairs
}

fn median_baseline_m(poses: &[Transform]) -> f64 {
    let distance = |one: &Transform, other: &Transform| {
        (one.translation.vector - other.translation.vector).norm()
    };
    let with_earlier = |(ix, one)| poses[..ix].iter().map(move |other| distance(one, other));
    let distances: Vec<f64> = poses.iter().enumerate().flat_map(with_earlier).collect();
    median(&distances).unwrap_or(0.0).max(f64::MIN_POSITIVE)
}

/// Largest fraction of an image that another one shows, over the depths.
fn overlap(from: &FeatureImage, to: &FeatureImage, to_from_from: &Transform) -> f64 {
    let baseline_m = to_from_from.translation.vector.norm();
    let (from, to) = (&from.keyframe, &to.keyframe);
    let ray = |ix: usize| {
        let share = [
            (ix % GRID[0]) as f64 / GRID[0] as f64,
            (ix / GRID[0]) as f64 / GRID[1] as f64,
        ];
        let half = [0.5 / GRID[0] as f64, 0.5 / GRID[1] as f64];
        let axis = |axis: usize| {
            let px = (share[axis] + half[axis]) * f64::from(from.size_px[axis]);
            (px - from.principal_px[axis]) / from.focal_px[axis]
        };
        Vector3::new(axis(0), axis(1), 1.0)
    };
    let n = GRID[0] * GRID[1];
    let shown_at = |depth: f64| {
        let is_shown = |ix: &usize| {
            let at = to_from_from.rotation * (ray(*ix) * depth * baseline_m)
                + to_from_from.translation.vector;
            at.z > 0.0
                && (0..2).all(|axis| {
                    let px = to.focal_px[axis] * at[axis] / at.z + to.principal_px[axis];
                    (0.0..f64::from(to.size_px[axis])).contains(&px)
                })
        };
        (0..n).filter(is_shown).count() as f64 / n as f64
    };
    DEPTHS.map(shown_at).into_iter().fold(0.0, f64::max)
}
