//! Selection of pairs of images that may show the same surface, without depth.

use super::feature_image::FeatureImage;
use super::moving_camera::MovingCamera;
use crate::registration::pairs::{Pair, spread_evenly};
use keyframe::Keyframe;
use kinematics::Transform;
use nalgebra::Vector3;
use numbers::quantile::median;
use rayon::prelude::*;

/// Maximum angle between the viewing directions of a pair, radians. Beyond this angle, corners look
/// too different.
const MAX_VIEW_ANGLE_RAD: f64 = 0.8;
/// Minimum distance between the cameras of a pair, meters. The next constant is a second minimum,
/// relative to the median distance. The epipolar lines of closer images are hardly determined.
const MIN_BASELINE_M: f64 = 0.02;
const MIN_BASELINE_FRAC: f64 = 0.1;
/// Minimum fraction of an image that its partner must show if all points are at the same, most
/// favorable depth.
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
    let mut pairs = (0..images.len())
        .into_par_iter()
        .map(|to| {
            let suitable = (0..images.len()).filter_map(|from| {
                let to_from_from = poses[to].inverse() * poses[from];
                let baseline_m = to_from_from.translation.vector.norm();
                let is_suitable = from != to
                    && baseline_m > min_baseline_m
                    && sees_the_same(&images[from], &images[to], &to_from_from);
                // The median baseline makes translations comparable with rotations, without depth.
                let motion = to_from_from.rotation.angle() + baseline_m / median_baseline_m;
                is_suitable.then_some((motion, from))
            });
            spread_evenly(suitable.collect(), max_partners)
                .into_iter()
                .map(|from| Pair { from, to })
                .collect::<Vec<Pair>>()
        })
        .collect::<Vec<_>>()
        .concat();
    // Two images may have chosen each other.
    let key = |pair: &Pair| (pair.from.min(pair.to), pair.from.max(pair.to));
    pairs.sort_by_key(key);
    pairs.dedup_by_key(|pair| key(pair));
    pairs
}

/// Whether two images may show the same corners.
fn sees_the_same(from: &FeatureImage, to: &FeatureImage, to_from_from: &Transform) -> bool {
    let view_angle_rad = (to_from_from.rotation * Vector3::z()).angle(&Vector3::z());
    view_angle_rad < MAX_VIEW_ANGLE_RAD && overlap(from, to, to_from_from) > MIN_OVERLAP
}

/// Median distance between the positions of two images, meters. It is positive.
fn median_baseline_m(poses: &[Transform]) -> f64 {
    let distance = |one: &Transform, other: &Transform| {
        (one.translation.vector - other.translation.vector).norm()
    };
    let with_earlier = |(ix, one)| poses[..ix].iter().map(move |other| distance(one, other));
    let distances: Vec<f64> = poses.iter().enumerate().flat_map(with_earlier).collect();
    median(&distances).unwrap_or(0.0).max(f64::MIN_POSITIVE)
}

/// Largest fraction of an image that another image shows, over the depths.
fn overlap(from: &FeatureImage, to: &FeatureImage, to_from_from: &Transform) -> f64 {
    let baseline_m = to_from_from.translation.vector.norm();
    let from = &from.keyframe;
    let to = &to.keyframe;
    // The depth is unknown. Images that show nothing in common at any depth are excluded.
    let n = GRID[0] * GRID[1];
    let mut largest = 0.0;
    for depth in DEPTHS {
        let is_shown = |ix: &usize| {
            let in_from = grid_ray(from, *ix) * depth * baseline_m;
            let at = to_from_from.rotation * in_from + to_from_from.translation.vector;
            at.z > 0.0 && is_in_image(to, &at)
        };
        let share = (0..n).filter(is_shown).count() as f64 / n as f64;
        largest = f64::max(largest, share);
    }
    largest
}

/// Ray through the center of a cell of [`GRID`], at a depth of 1.
fn grid_ray(keyframe: &Keyframe, ix: usize) -> Vector3<f64> {
    let share = [
        (ix % GRID[0]) as f64 / GRID[0] as f64,
        (ix / GRID[0]) as f64 / GRID[1] as f64,
    ];
    let half = [0.5 / GRID[0] as f64, 0.5 / GRID[1] as f64];
    let [x, y] = [0, 1].map(|axis| {
        let px = (share[axis] + half[axis]) * f64::from(keyframe.size_px[axis]);
        (px - keyframe.principal_px[axis]) / keyframe.focal_px[axis]
    });
    Vector3::new(x, y, 1.0)
}

/// Whether a point in front of the camera is imaged.
fn is_in_image(keyframe: &Keyframe, point: &Vector3<f64>) -> bool {
    (0..2).all(|axis| {
        let px = keyframe.focal_px[axis] * point[axis] / point.z + keyframe.principal_px[axis];
        (0.0..f64::from(keyframe.size_px[axis])).contains(&px)
    })
}
