//! Estimates pose corrections of individual images. There are many unknowns, but the equations are
//! sparse, because each pair constrains only two images.

use super::corrections::{Corrections, rotation_and_translation, twist};
use super::fit::{INITIAL_NOISE, OCCLUSION_FRAC};
use super::layout::Layout;
use super::pairs::Pair;
use super::prepared_image::PreparedImage;
use super::residual::Side;
use super::solve::INFLATION;
use super::sums::{self, PairSums, PixelSubset, ResidualOptions};
use super::view::CorrectedView;
use crate::{CameraCorrection, drift_weight, rigid_transform};
use kinematics::{Twist, transform};
use nalgebra::{DVector, Matrix6, Vector6};
use numbers::quantile::{Rank, quantile};
use std::collections::BTreeMap;

/// Upper bounds of the expected pose error of an image, meters and radians. The next constant holds
/// the lower bounds, which are the accuracy of arms.
const MAX_POSE_ERROR: [f64; 2] = [0.02, 0.02];
const MIN_POSE_ERROR: [f64; 2] = [2e-4, 3.5e-4];
/// Maximum number of steps at each level, the finest first. The coarsest of the four levels has the
/// most steps, because it starts farthest from the solution.
const MAX_ITERATIONS: [usize; 4] = [6, 4, 4, 6];
/// Maximum step, relative to the expected pose errors.
const MAX_STEP: f64 = 2.0;

/// Estimates the poses of all images that are connected by pairs, starting from given corrections.
/// Other images get the interpolated drift of their neighbors, weighted by its predictability.
///
/// The expected pose error is estimated from the corrections themselves at each level. If almost
/// all poses are correct, the expected error becomes small, so noise does not move the poses.
pub(super) fn fit(
    images: &[PreparedImage],
    pairs: &[Pair],
    from: &Corrections,
) -> Option<Corrections> {
    let layout = Layout::default();
    let mut corrections = from.clone();
    let slot_of_image = slots(pairs);
    // Motion of each image so far, meters and radians. The prior applies to this total motion.
    let mut total = vec![Vector6::zeros(); slot_of_image.len()];
    let mut pose_error = MAX_POSE_ERROR;
    let n_levels = images.iter().map(|image| image.levels.len()).max()?;
    let mut options = ResidualOptions {
        level: n_levels - 1,
        occlusion_frac: OCCLUSION_FRAC[n_levels - 1],
        noise: INITIAL_NOISE,
        part: PixelSubset::All,
    };
    options.noise = sums::noise_of(&sums::of_free_pairs(
        images,
        &corrections.views(images, &layout),
        pairs,
        &options,
    ))?;
    for level in (0..n_levels).rev() {
        options.level = level;
        options.occlusion_frac = OCCLUSION_FRAC[level];
        let scales = scales(pose_error);
        for _ in 0..MAX_ITERATIONS[level] {
            let sums =
                sums::of_free_pairs(images, &corrections.views(images, &layout), pairs, &options);
            options.noise = sums::noise_of(&sums)?;
            let scaled_total: Vec<Vector6<f64>> = total
                .iter()
                .map(|total| total.component_div(&scales))
                .collect();
            let mut steps =
                NormalEquations::new(pairs, &sums, &slot_of_image, &scales, &scaled_total).solve();
            for step in &mut steps {
                let max_component = step.amax();
                *step = step.component_mul(&scales) * (MAX_STEP / max_component.max(MAX_STEP));
            }
            remove_mean(&mut steps, &total, &slot_of_image, images);
            for (ix, slot) in &slot_of_image {
                total[*slot] += steps[*slot];
                apply_step(
                    &mut corrections.by_camera[images[*ix].camera],
                    &images[*ix],
                    &steps[*slot],
                );
            }
            log::debug!("alignment: poses, level {level}, {:?}", options.noise);
        }
        pose_error = rms_motion(&total);
    }
    let depth_m = median_depth_m(images);
    for correction in &mut corrections.by_camera {
        correction.drift_weight = drift_weight(&correction.drift, depth_m);
    }
    Some(corrections)
}

/// Indices of the images of pairs among the unknowns, in the order of their image indices.
fn slots(pairs: &[Pair]) -> BTreeMap<usize, usize> {
    let mut ixs: Vec<usize> = pairs.iter().flat_map(|pair| [pair.from, pair.to]).collect();
    ixs.sort_unstable();
    ixs.dedup();
    ixs.into_iter()
        .enumerate()
        .map(|(slot, ix)| (ix, slot))
        .collect()
}

/// Root mean square of the motions along one axis, meters and radians, within the bounds of the
/// expected pose error.
fn rms_motion(motions: &[Vector6<f64>]) -> [f64; 2] {
    [0, 1].map(|part| {
        let squares = motions
            .iter()
            .map(|motion| motion.fixed_rows::<3>(3 * part).norm_squared())
            .sum::<f64>();
        (squares / (3 * motions.len()) as f64)
            .sqrt()
            .clamp(MIN_POSE_ERROR[part], MAX_POSE_ERROR[part])
    })
}

/// Estimates the pose of one image from a subset of its pixels, relative to other images that stay
/// fixed. All `pairs` must lead to this image. Returns the correction of its camera with an entry
/// for this image. `None` if the other images do not show the same surfaces.
pub(super) fn fit_one(
    images: &[PreparedImage],
    views: &[CorrectedView],
    pairs: &[Pair],
    correction: &CameraCorrection,
    part: PixelSubset,
) -> Option<CameraCorrection> {
    let image = &images[pairs.first()?.to];
    let mut image_correction = correction.clone();
    // The image gets its own entry, which starts at its current drift.
    image_correction.drift.insert(
        image.keyframe.stamp.0,
        correction.drift_at(image.keyframe.stamp),
    );
    let scales = scales(MAX_POSE_ERROR);
    let mut total = Vector6::zeros();
    let n_levels = image.levels.len();
    let mut options = ResidualOptions {
        level: n_levels - 1,
        occlusion_frac: OCCLUSION_FRAC[n_levels - 1],
        noise: INITIAL_NOISE,
        part,
    };
    let sums_of = |image_correction: &CameraCorrection, options: &ResidualOptions| {
        let view = CorrectedView::new(image, image_correction, &Layout::default())?;
        Some(sums_to(images, views, pairs, &view, options))
    };
    options.noise = sums::noise_of(&sums_of(&image_correction, &options)?)?;
    for level in (0..n_levels).rev() {
        options.level = level;
        options.occlusion_frac = OCCLUSION_FRAC[level];
        for _ in 0..MAX_ITERATIONS[level] {
            let sums = sums_of(&image_correction, &options)?;
            options.noise = sums::noise_of(&sums)?;
            let mut information = Matrix6::identity() * INFLATION;
            let mut rhs = -total * INFLATION;
            for sums in &sums {
                let block = |y: usize, x: usize| sums.information[(y, x)] * scales[y] * scales[x];
                information += Matrix6::from_fn(block);
                rhs += sums.gradient.fixed_rows::<6>(0).component_mul(&scales);
            }
            let step = information.try_inverse()? * rhs;
            let step = step * (MAX_STEP / step.amax().max(MAX_STEP));
            total += step;
            apply_step(&mut image_correction, image, &step.component_mul(&scales));
        }
    }
    Some(image_correction)
}

/// Contributions of pairs to the motion of the second image of each pair. `view` is the view of
/// this image.
fn sums_to(
    images: &[PreparedImage],
    views: &[CorrectedView],
    pairs: &[Pair],
    view: &CorrectedView,
    options: &ResidualOptions,
) -> Vec<PairSums> {
    pairs
        .iter()
        .map(|pair| {
            let from = Side {
                image: &images[pair.from],
                view: &views[pair.from],
            };
            let to = Side {
                image: &images[pair.to],
                view,
            };
            sums::of_second([from, to], options)
        })
        .collect()
}

/// Scales of the six parameters of a pose.
fn scales([translation_m, rotation_rad]: [f64; 2]) -> Vector6<f64> {
    Vector6::new(
        translation_m,
        translation_m,
        translation_m,
        rotation_rad,
        rotation_rad,
        rotation_rad,
    )
}

/// Median depth of all samples, which converts rotations to lengths.
fn median_depth_m(images: &[PreparedImage]) -> f64 {
    let mut depths: Vec<f64> = images
        .iter()
        .flat_map(|image| &image.uniform_samples)
        .map(|sample| sample.z_m)
        .collect();
    quantile(&mut depths, 0.5, Rank::Upper).unwrap_or(1.0)
}

/// Removes the significant part of the mean correction of a camera's images from the steps, because
/// other parameters explain that part.
///
/// A mean within its tolerance is not removed. Independent errors also have a nonzero mean, and
/// without this mean, the images would be misaligned.
fn remove_mean(
    steps: &mut [Vector6<f64>],
    total: &[Vector6<f64>],
    slot_of_image: &BTreeMap<usize, usize>,
    images: &[PreparedImage],
) {
    const MAX_STANDARD_ERRORS: f64 = 2.0;
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (ix, slot) in slot_of_image {
        of_camera.entry(images[*ix].camera).or_default().push(*slot);
    }
    for slots in of_camera.values() {
        let n = slots.len() as f64;
        let after = |slot: &usize| total[*slot] + steps[*slot];
        let mean = slots.iter().map(after).sum::<Vector6<f64>>() / n;
        let squares = slots
            .iter()
            .map(|slot| (after(slot) - mean).map(|x| x * x))
            .sum::<Vector6<f64>>();
        let tolerance = squares.map(|squares| MAX_STANDARD_ERRORS * squares.sqrt() / n);
        let excess =
            Vector6::from_fn(|row, _| mean[row] - mean[row].clamp(-tolerance[row], tolerance[row]));
        for slot in slots {
            steps[*slot] -= excess;
        }
    }
}

/// Moves the camera of an image in its own axes (meters, then radians).
fn apply_step(correction: &mut CameraCorrection, image: &PreparedImage, step: &Vector6<f64>) {
    // Drift is applied before the extrinsics correction, so the motion is converted to the axes of
    // the camera before that correction.
    let extrinsics = rigid_transform(
        correction.rotation_rad.into(),
        correction.translation_m.into(),
    );
    let motion: Twist =
        twist(&DVector::from_column_slice(step.as_slice()), 0).of_attached(&extrinsics);
    let drift = correction.drift.entry(image.keyframe.stamp.0).or_default();
    let [x, y, z, dx, dy, dz] = *drift;
    let before = rigid_transform([x, y, z].into(), [dx, dy, dz].into());
    let (rotation, translation) =
        rotation_and_translation(&(transform::exp(&motion, -1.0) * before));
    *drift = [
        rotation[0],
        rotation[1],
        rotation[2],
        translation[0],
        translation[1],
        translation[2],
    ];
}

/// Product of a block-diagonal matrix and a vector.
fn block_products(blocks: &[Matrix6<f64>], x: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
    blocks.iter().zip(x).map(|(block, x)| block * x).collect()
}

/// Dot product of vectors of blocks.
fn dot(a: &[Vector6<f64>], b: &[Vector6<f64>]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.dot(b)).sum::<f64>()
}

/// Blocks of the normal equations, scaled by the expected pose errors.
struct NormalEquations {
    diagonal: Vec<Matrix6<f64>>,
    /// For each pair, the slots of its first image (rows) and second image (columns), and the block
    /// between them.
    off_diagonal: Vec<(usize, usize, Matrix6<f64>)>,
    rhs: Vec<Vector6<f64>>,
}

impl NormalEquations {
    fn new(
        pairs: &[Pair],
        sums: &[PairSums],
        slot_of_image: &BTreeMap<usize, usize>,
        scales: &Vector6<f64>,
        total: &[Vector6<f64>],
    ) -> Self {
        let mut equations = Self {
            diagonal: vec![Matrix6::identity() * INFLATION; total.len()],
            off_diagonal: Vec::new(),
            rhs: total.iter().map(|total| -total * INFLATION).collect(),
        };
        for (pair, sums) in pairs.iter().zip(sums) {
            let slots = [slot_of_image[&pair.from], slot_of_image[&pair.to]];
            let block = |row: usize, column: usize| {
                Matrix6::from_fn(|y, x| {
                    sums.information[(6 * row + y, 6 * column + x)] * scales[y] * scales[x]
                })
            };
            for (side, slot) in slots.into_iter().enumerate() {
                equations.diagonal[slot] += block(side, side);
                equations.rhs[slot] += sums
                    .gradient
                    .fixed_rows::<6>(6 * side)
                    .component_mul(scales);
            }
            equations
                .off_diagonal
                .push((slots[0], slots[1], block(0, 1)));
        }
        equations
    }

    /// The product of the symmetric matrix and a vector. Each block off the diagonal is used twice,
    /// the second time transposed.
    fn multiply(&self, x: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
        let mut product = block_products(&self.diagonal, x);
        for (row, column, block) in &self.off_diagonal {
            product[*row] += block * x[*column];
            product[*column] += block.tr_mul(&x[*row]);
        }
        product
    }

    /// Solves the equations by conjugate gradients, preconditioned by the blocks on the diagonal.
    fn solve(&self) -> Vec<Vector6<f64>> {
        // An inexact step is corrected by the next Gauss-Newton step.
        const MAX_CG_ITERATIONS: usize = 60;
        // The tolerance applies to the squared residual.
        const TOLERANCE: f64 = 1e-8;
        let inverses: Vec<Matrix6<f64>> = self
            .diagonal
            .iter()
            .map(|block| block.try_inverse().unwrap_or_else(Matrix6::zeros))
            .collect();
        let mut x = vec![Vector6::zeros(); self.rhs.len()];
        let mut residual = self.rhs.clone();
        let mut preconditioned = block_products(&inverses, &residual);
        let mut direction = preconditioned.clone();
        let mut residual_product = dot(&residual, &preconditioned);
        let target_product = TOLERANCE * residual_product;
        for _ in 0..MAX_CG_ITERATIONS {
            if residual_product <= target_product || residual_product <= 0.0 {
                break;
            }
            let product = self.multiply(&direction);
            let length = residual_product / dot(&direction, &product);
            for ix in 0..x.len() {
                x[ix] += direction[ix] * length;
                residual[ix] -= product[ix] * length;
            }
            preconditioned = block_products(&inverses, &residual);
            let next = dot(&residual, &preconditioned);
            for (direction, preconditioned) in direction.iter_mut().zip(&preconditioned) {
                *direction = preconditioned + *direction * (next / residual_product);
            }
            residual_product = next;
        }
        x
    }
}
