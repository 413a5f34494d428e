//! A small motion of every image on its own: many unknowns, of which each pair ties two together.

use super::corrections::{Corrections, parts, twist};
use super::fit::{FIRST_NOISE, HIDDEN_FRAC};
use super::frame::Frame;
use super::layout::Layout;
use super::pairs::Pair;
use super::residual::Side;
use super::solve::INFLATION;
use super::sums::{self, Looks, PairSums, Part};
use super::view::View;
use crate::splat::{CameraFix, drift_share, moved};
use kinematics::{Twist, transform};
use nalgebra::{DVector, Matrix6, Vector6};
use std::collections::BTreeMap;

/// How far an image's pose may be off, metres and radians, and what is taken for none: the poses of an arm are that good.
const MOST_OFF: [f64; 2] = [0.02, 0.02];
const LEAST_OFF: [f64; 2] = [2e-4, 3.5e-4];
const ROUNDS: [usize; 4] = [6, 4, 4, 6];
const LONGEST_STEP: f64 = 2.0;

/// Finds the poses of all images that pairs tie together, from given corrections on; others drift with their neighbours as
/// far as drift was found.
///
/// How far poses are off is learned from the poses themselves, level by level: where all are nearly right, noise moves none.
pub(super) fn fit(frames: &[Frame], pairs: &[Pair], from: &Corrections) -> Option<Corrections> {
    let layout = Layout::default();
    let mut corrections = from.clone();
    let tied: BTreeMap<usize, usize> = {
        let mut ixs: Vec<usize> = pairs.iter().flat_map(|pair| [pair.from, pair.to]).collect();
        ixs.sort_unstable();
        ixs.dedup();
        ixs.into_iter().enumerate().map(|(place, ix)| (ix, place)).collect()
    };
    // Metres and radians.
    let mut total = vec![Vector6::zeros(); tied.len()];
    let mut off = MOST_OFF;
    let n_levels = frames.iter().map(|frame| frame.levels.len()).max()?;
    let mut how =
        Looks { level: n_levels - 1, hidden_frac: HIDDEN_FRAC[n_levels - 1], noise: FIRST_NOISE, part: Part::All };
    how.noise = sums::noise_of(&sums::of_free_pairs(frames, &corrections.views(frames, &layout), pairs, &how))?;
    for level in (0..n_levels).rev() {
        (how.level, how.hidden_frac) = (level, HIDDEN_FRAC[level]);
        let scales = scales(off);
        for _ in 0..ROUNDS[level] {
            let sums = sums::of_free_pairs(frames, &corrections.views(frames, &layout), pairs, &how);
            how.noise = sums::noise_of(&sums)?;
            let in_scales: Vec<Vector6<f64>> = total.iter().map(|total| total.component_div(&scales)).collect();
            let mut steps = Equations::new(pairs, &sums, &tied, &scales, &in_scales).solve();
            for step in &mut steps {
                let longest = step.amax();
                *step = step.component_mul(&scales) * (LONGEST_STEP / longest.max(LONGEST_STEP));
            }
            without_mean(&mut steps, &total, &tied, frames);
            for (ix, place) in &tied {
                total[*place] += steps[*place];
                take(&mut corrections.fixes[frames[*ix].camera], &frames[*ix], &steps[*place]);
            }
            log::debug!("alignment: poses, level {level}, {:?}", how.noise);
        }
        off = [0, 1].map(|part| {
            let squares = total.iter().map(|total| total.fixed_rows::<3>(3 * part).norm_squared()).sum::<f64>();
            (squares / (3 * total.len()) as f64).sqrt().clamp(LEAST_OFF[part], MOST_OFF[part])
        });
    }
    let depth_m = median_depth_m(frames);
    for fix in &mut corrections.fixes {
        fix.drift_share = drift_share(&fix.drift, depth_m);
    }
    Some(corrections)
}

/// Finds the pose of one image by others that stay, `pairs` all being to it, on a part of its pixels: its camera's fix with
/// an entry for it. None where the others do not show it.
pub(super) fn fit_one(
    frames: &[Frame],
    views: &[View],
    pairs: &[Pair],
    fix: &CameraFix,
    part: Part,
) -> Option<CameraFix> {
    let frame = &frames[pairs.first()?.to];
    let mut own = fix.clone();
    // Where it is now, as an entry of its own.
    own.drift.insert(frame.keyframe.stamp.0, fix.drift_at(frame.keyframe.stamp));
    let scales = scales(MOST_OFF);
    let mut total = Vector6::zeros();
    let n_levels = frame.levels.len();
    let mut how = Looks { level: n_levels - 1, hidden_frac: HIDDEN_FRAC[n_levels - 1], noise: FIRST_NOISE, part };
    let sums_of = |own: &CameraFix, how: &Looks| -> Option<Vec<PairSums>> {
        let view = View::new(frame, own, &Layout::default())?;
        let from = |pair: &Pair| Side { frame: &frames[pair.from], view: &views[pair.from] };
        Some(pairs.iter().map(|pair| sums::of_second([from(pair), Side { frame, view: &view }], how)).collect())
    };
    how.noise = sums::noise_of(&sums_of(&own, &how)?)?;
    for level in (0..n_levels).rev() {
        (how.level, how.hidden_frac) = (level, HIDDEN_FRAC[level]);
        for _ in 0..ROUNDS[level] {
            let sums = sums_of(&own, &how)?;
            how.noise = sums::noise_of(&sums)?;
            let mut information = Matrix6::identity() * INFLATION;
            let mut right = -total * INFLATION;
            for sums in &sums {
                let block = |y: usize, x: usize| sums.information[(y, x)] * scales[y] * scales[x];
                information += Matrix6::from_fn(block);
                right += sums.gradient.fixed_rows::<6>(0).component_mul(&scales);
            }
            let step = information.try_inverse()? * right;
            let step = step * (LONGEST_STEP / step.amax().max(LONGEST_STEP));
            total += step;
            take(&mut own, frame, &step.component_mul(&scales));
        }
    }
    Some(own)
}

fn scales([shift_m, turn_rad]: [f64; 2]) -> Vector6<f64> {
    Vector6::new(shift_m, shift_m, shift_m, turn_rad, turn_rad, turn_rad)
}

fn median_depth_m(frames: &[Frame]) -> f64 {
    let mut depths: Vec<f64> = frames.iter().flat_map(|frame| &frame.even_spots).map(|spot| spot.z_m).collect();
    let middle = depths.len() / 2;
    if depths.is_empty() { 1.0 } else { *depths.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Takes from the steps what would give a camera's images a mean that is no accident of a few: that is another term.
///
/// Images that err independently have a mean, too, and forbidding it would leave them apart.
fn without_mean(steps: &mut [Vector6<f64>], total: &[Vector6<f64>], tied: &BTreeMap<usize, usize>, frames: &[Frame]) {
    const ACCIDENT: f64 = 2.0; // Standard errors.
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (ix, place) in tied {
        of_camera.entry(frames[*ix].camera).or_default().push(*place);
    }
    for places in of_camera.values() {
        let n = places.len() as f64;
        let after = |place: &usize| total[*place] + steps[*place];
        let mean = places.iter().map(after).sum::<Vector6<f64>>() / n;
        let squares = places.iter().map(|place| (after(place) - mean).map(|x| x * x)).sum::<Vector6<f64>>();
        let usual = squares.map(|squares| ACCIDENT * squares.sqrt() / n);
        let excess = Vector6::from_fn(|row, _| mean[row] - mean[row].clamp(-usual[row], usual[row]));
        for place in places {
            steps[*place] -= excess;
        }
    }
}

/// Moves a frame's camera in its own axes: metres, then radians.
fn take(fix: &mut CameraFix, frame: &Frame, step: &Vector6<f64>) {
    // Drift comes before the mount, so the motion is that of the unmounted camera.
    let mount = moved(fix.turn_rad.into(), fix.shift_m.into());
    let motion: Twist = twist(&DVector::from_column_slice(step.as_slice()), 0).of_attached(&mount);
    let drift = fix.drift.entry(frame.keyframe.stamp.0).or_default();
    let [x, y, z, dx, dy, dz] = *drift;
    let before = moved([x, y, z].into(), [dx, dy, dz].into());
    let (turn, shift) = parts(&(transform::exp(&motion, -1.0) * before));
    *drift = [turn[0], turn[1], turn[2], shift[0], shift[1], shift[2]];
}

/// Blocks of the normal equations in units of what a pose may be off.
struct Equations {
    diagonal: Vec<Matrix6<f64>>,
    /// Of a pair: the rows of its first frame, the columns of its second.
    ties: Vec<(usize, usize, Matrix6<f64>)>,
    right: Vec<Vector6<f64>>,
}

impl Equations {
    fn new(
        pairs: &[Pair],
        sums: &[PairSums],
        tied: &BTreeMap<usize, usize>,
        scales: &Vector6<f64>,
        total: &[Vector6<f64>],
    ) -> Self {
        let mut equations = Self {
            diagonal: vec![Matrix6::identity() * INFLATION; total.len()],
            ties: Vec::new(),
            right: total.iter().map(|total| -total * INFLATION).collect(),
        };
        for (pair, sums) in pairs.iter().zip(sums) {
            let places = [tied[&pair.from], tied[&pair.to]];
            let block = |row: usize, column: usize| {
                Matrix6::from_fn(|y, x| sums.information[(6 * row + y, 6 * column + x)] * scales[y] * scales[x])
            };
            for (side, place) in places.into_iter().enumerate() {
                equations.diagonal[place] += block(side, side);
                equations.right[place] += sums.gradient.fixed_rows::<6>(6 * side).component_mul(scales);
            }
            equations.ties.push((places[0], places[1], block(0, 1)));
        }
        equations
    }

    fn times(&self, x: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
        let mut product: Vec<Vector6<f64>> = self.diagonal.iter().zip(x).map(|(block, x)| block * x).collect();
        for (row, column, block) in &self.ties {
            product[*row] += block * x[*column];
            product[*column] += block.tr_mul(&x[*row]);
        }
        product
    }

    /// Conjugate gradients, preconditioned by the blocks on the diagonal.
    fn solve(&self) -> Vec<Vector6<f64>> {
        const MOST_ROUNDS: usize = 60;
        const SMALL: f64 = 1e-8;
        let inverses: Vec<Matrix6<f64>> =
            self.diagonal.iter().map(|block| block.try_inverse().unwrap_or_else(Matrix6::zeros)).collect();
        let dot = |a: &[Vector6<f64>], b: &[Vector6<f64>]| a.iter().zip(b).map(|(a, b)| a.dot(b)).sum::<f64>();
        let precondition = |r: &[Vector6<f64>]| inverses.iter().zip(r).map(|(block, r)| block * r).collect::<Vec<_>>();
        let mut x = vec![Vector6::zeros(); self.right.len()];
        let mut left = self.right.clone();
        let mut nearer = precondition(&left);
        let mut direction = nearer.clone();
        let mut slope = dot(&left, &nearer);
        let goal = SMALL * slope;
        for _ in 0..MOST_ROUNDS {
            if slope <= goal || slope <= 0.0 {
                break;
            }
            let product = self.times(&direction);
            let length = slope / dot(&direction, &product);
            for ix in 0..x.len() {
                x[ix] += direction[ix] * length;
                left[ix] -= product[ix] * length;
            }
            nearer = precondition(&left);
            let next = dot(&left, &nearer);
            for (direction, nearer) in direction.iter_mut().zip(&nearer) {
                *direction = nearer + *direction * (next / slope);
            }
            slope = next;
        }
        x
    }
}
