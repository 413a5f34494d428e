//! A small motion of every image on its own: many unknowns, of which each pair ties two together.

use super::corrections::{Corrections, parts, twist};
use super::fit::{FIRST_NOISE, HIDDEN_FRAC};
use super::frame::Frame;
use super::layout::Layout;
use super::pairs::Pair;
use super::solve::INFLATION;
use super::sums::{self, Looks, Noise, PairSums};
use crate::splat::moved;
use kinematics::{Twist, transform};
use nalgebra::{DVector, Matrix6, Vector6};
use std::collections::BTreeMap;

/// How far an image's pose may be off where it comes from joints, metres and radians, and where it does not.
const FROM_JOINTS: [f64; 2] = [2e-4, 3.5e-4];
const FROM_ELSEWHERE: [f64; 2] = [0.02, 0.02];
const ROUNDS: [usize; 4] = [5, 3, 3, 4];
const LONGEST_STEP: f64 = 2.0;

/// Finds the poses of all images that pairs tie together, from given corrections on; others drift with their neighbours.
pub(super) fn fit(
    frames: &[Frame],
    pairs: &[Pair],
    from: &Corrections,
    from_joints: bool,
) -> Option<(Corrections, Noise)> {
    let layout = Layout::default();
    let mut corrections = from.clone();
    let [shift, turn] = if from_joints { FROM_JOINTS } else { FROM_ELSEWHERE };
    let scales = Vector6::new(shift, shift, shift, turn, turn, turn);
    let tied: BTreeMap<usize, usize> = {
        let mut ixs: Vec<usize> = pairs.iter().flat_map(|pair| [pair.from, pair.to]).collect();
        ixs.sort_unstable();
        ixs.dedup();
        ixs.into_iter().enumerate().map(|(place, ix)| (ix, place)).collect()
    };
    let mut total = vec![Vector6::zeros(); tied.len()];
    let n_levels = frames.iter().map(|frame| frame.levels.len()).max()?;
    let mut how = Looks { level: n_levels - 1, hidden_frac: HIDDEN_FRAC[n_levels - 1], noise: FIRST_NOISE };
    how.noise = sums::noise_of(&sums::of_free_pairs(frames, &corrections.views(frames, &layout), pairs, &how))?;
    for level in (0..n_levels).rev() {
        (how.level, how.hidden_frac) = (level, HIDDEN_FRAC[level]);
        for _ in 0..ROUNDS[level] {
            let sums = sums::of_free_pairs(frames, &corrections.views(frames, &layout), pairs, &how);
            how.noise = sums::noise_of(&sums)?;
            let equations = Equations::new(pairs, &sums, &tied, &scales, &total);
            let mut steps = equations.solve();
            without_mean(&mut steps, &tied, frames);
            for (ix, place) in &tied {
                let longest = steps[*place].amax();
                let step = steps[*place] * (LONGEST_STEP / longest.max(LONGEST_STEP));
                total[*place] += step;
                take(&mut corrections, &frames[*ix], &step.component_mul(&scales));
            }
        }
    }
    Some((corrections, how.noise))
}

/// Zero mean for each camera: what all its images share is another term.
fn without_mean(steps: &mut [Vector6<f64>], tied: &BTreeMap<usize, usize>, frames: &[Frame]) {
    let mut sums: BTreeMap<usize, (f64, Vector6<f64>)> = BTreeMap::new();
    for (ix, place) in tied {
        let (n, sum) = sums.entry(frames[*ix].camera).or_insert((0.0, Vector6::zeros()));
        *n += 1.0;
        *sum += steps[*place];
    }
    for (ix, place) in tied {
        let (n, sum) = &sums[&frames[*ix].camera];
        steps[*place] -= sum / *n;
    }
}

/// Moves a frame's camera in its own axes: metres, then radians.
fn take(corrections: &mut Corrections, frame: &Frame, step: &Vector6<f64>) {
    let fix = &mut corrections.fixes[frame.camera];
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
