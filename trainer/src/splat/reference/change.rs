//! Plain CPU version of the kernels that change splats: the optimizer step (update.wgsl) and growth
//! (grow_*.wgsl).
//!
//! Sources: Kingma and Ba 2015 for the optimizer, and Kheradmand et al. 2024 (3DGS-MCMC), sections
//! 4.1 and 4.2, for noise and growth. Parents are chosen by error instead of opacity, as in Bulo et
//! al. 2024.

use super::random::{normal3, uniform3};
use super::{Splat, SplatGrad};
use crate::optim::reference::{Adam, Moments};
use crate::splat::params::{Growth, Rule};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// Adam's moments of every value of one splat, in the order of [`values`]. The higher SH
/// coefficients share one second moment.
pub(crate) type SplatMoments = Vec<Moments>;

/// Mean, log scale, rotation, opacity logit, then the color coefficients.
fn values(splat: &Splat) -> Vec<f64> {
    let rest = splat.sh.as_flattened().iter().copied();
    let shape = splat
        .mean
        .into_iter()
        .chain(splat.log_scale)
        .chain(splat.rotation_wxyz)
        .chain([splat.opacity_logit]);
    shape.chain(rest).collect()
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Takes one optimizer step for one splat. `step` counts from 0.
pub(crate) fn update(
    splat: &Splat,
    gradient: &SplatGrad,
    moments: &mut SplatMoments,
    rule: &Rule,
    step: u32,
    splat_ix: u32,
) -> Splat {
    let [
        of_mean,
        of_scale,
        of_rotation,
        of_opacity,
        of_dc,
        of_rest,
        noise,
        final_frac,
    ] = [
        rule.mean_rate_m,
        rule.log_scale_rate,
        rule.rotation_rate,
        rule.opacity_rate,
        rule.sh_dc_rate,
        rule.sh_rest_rate,
        rule.noise,
        rule.final_mean_rate_frac,
    ]
    .map(f64::from);
    // Phase 1 computes the gradients of the loss and of the costs, and the rates at this step.
    let since = f64::from(step) - f64::from(rule.schedule_start);
    let progress = (since / f64::from(rule.n_planned_steps).max(1.0)).clamp(0.0, 1.0);
    let mean_rate = of_mean * final_frac.powf(progress);
    let opacity = sigmoid(splat.opacity_logit);
    let mut gradient = gradient.clone();
    // The costs are the mean opacity and the mean scale. They double over the planned steps,
    // because models start to overfit late.
    gradient.opacity_logit +=
        (1.0 + progress) * f64::from(rule.opacity_cost) * opacity * (1.0 - opacity);
    for axis in 0..3 {
        gradient.log_scale[axis] +=
            (1.0 + progress) * f64::from(rule.scale_cost) * splat.log_scale[axis].exp();
    }
    let rates: Vec<f64> = [mean_rate; 3]
        .into_iter()
        .chain([of_scale; 3])
        .chain([of_rotation; 4])
        .chain([of_opacity])
        .chain([of_dc; 3])
        .collect();
    // Phase 2 is Adam. The higher coefficients, which follow the other values, share a moment.
    let mut updated = values(splat);
    let gradients = values(&gradient);
    let adam = Adam {
        beta1: rule.betas[0].into(),
        beta2: rule.betas[1].into(),
        epsilon: rule.epsilon.into(),
    };
    let n_own = rates.len();
    adam.update_all(
        step + 1,
        &rates,
        &mut updated[..n_own],
        &gradients[..n_own],
        &mut moments[..n_own],
    );
    adam.update_shared(
        step + 1,
        of_rest,
        &mut updated[n_own..],
        &gradients[n_own..],
        &mut moments[n_own].second,
    );

    // In phase 3, noise moves nearly transparent splats to positions where they may be useful
    // (Kheradmand et al. 2024, section 4.1). The noise is the product of the covariance and a
    // normal vector. It fades out above the opacity below which splats are dead.
    let [w, x, y, z] = splat.rotation_wxyz;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let along = rotation.inverse() * Vector3::from(normal3([splat_ix, step, rule.seed]));
    let variance = Vector3::from(splat.log_scale.map(|scale| (2.0 * scale).exp()));
    let noise_weight = 1.0 / (1.0 + (100.0 * (opacity - f64::from(rule.noise_center))).exp());
    let jitter = rotation * variance.component_mul(&along) * (noise * mean_rate * noise_weight);

    // Phase 4 limits values to their ranges. At a logit of 12, the opacity differs from 1 by 6e-6.
    // Closer to 1, its gradient would vanish.
    let range = rule.log_scale_range.map(f64::from);
    let norm = updated[6..10]
        .iter()
        .map(|part| part * part)
        .sum::<f64>()
        .sqrt();
    Splat {
        mean: std::array::from_fn(|axis| updated[axis] + jitter[axis]),
        log_scale: std::array::from_fn(|axis| updated[3 + axis].clamp(range[0], range[1])),
        rotation_wxyz: std::array::from_fn(|part| updated[6 + part] / norm),
        opacity_logit: updated[10].clamp(-12.0, 12.0),
        sh: updated[11..].as_chunks::<3>().0.to_vec(),
    }
}

/// Maximum family size. Larger families are treated as if they had this size. The alternating sum
/// of [`share_opacity`] has terms that grow with the size and would cancel in f32.
const MAX_FAMILY: u32 = 16;

/// Splats after a change of the splat count, and the parent of each new splat.
pub(crate) struct Grown {
    pub(crate) splats: Vec<Splat>,
    pub(crate) parents: Vec<Option<usize>>,
    /// Smallest change of a random threshold that would select another parent, as a fraction of the
    /// total error.
    pub(crate) margin: f64,
}

/// Replaces dead splats and creates new splats, as children of parents that are chosen by error. A
/// child gets a position within its parent and a share of its parent's opacity.
pub(crate) fn grow(splats: &[Splat], errors: &[f64], growth: &Growth) -> Grown {
    // Dead splats are replaced, so they cannot be parents.
    let is_dead = |splat: &Splat| sigmoid(splat.opacity_logit) < f64::from(growth.min_opacity);
    let mut cumulative = Vec::with_capacity(splats.len());
    let mut total = 0.0;
    for (splat, error) in splats.iter().zip(errors) {
        total += if is_dead(splat) { 0.0 } else { *error };
        cumulative.push(total);
    }
    let mut grown = splats.to_vec();
    grown.resize(growth.n_after as usize, Splat::default());
    let mut parents = vec![None; grown.len()];
    let mut n_children = vec![0u32; splats.len()];
    let mut margin = f64::INFINITY;
    for child in 0..growth.n_after {
        let ix = child as usize;
        if splats.get(ix).is_some_and(|splat| !is_dead(splat)) {
            continue;
        }
        // The constants 7 and 11 separate the random numbers of this kernel.
        let threshold = uniform3([child, growth.key, 7])[0] * total;
        let parent = cumulative.partition_point(|sum| *sum <= threshold);
        let before = if parent > 0 {
            cumulative[parent - 1]
        } else {
            0.0
        };
        margin = margin.min((cumulative[parent] - threshold).min(threshold - before) / total);
        parents[ix] = Some(parent);
        n_children[parent] += 1;
        let [w, x, y, z] = splats[parent].rotation_wxyz;
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        // The offset is clamped, so that no child leaves its parent.
        let normal = normal3([child, growth.key, 11]);
        let offset_in_parent: [f64; 3] = std::array::from_fn(|axis| {
            splats[parent].log_scale[axis].exp() * normal[axis].clamp(-2.0, 2.0)
        });
        let offset = rotation * Vector3::from(offset_in_parent) * f64::from(growth.child_spread);
        grown[ix] = splats[parent].clone();
        for axis in 0..3 {
            grown[ix].mean[axis] += offset[axis];
        }
    }
    // A parent and its children get the same share. For a child, `n_children` of its parent is
    // used.
    for (ix, splat) in grown.iter_mut().enumerate() {
        let n = n_children
            .get(parents[ix].unwrap_or(ix))
            .copied()
            .unwrap_or(0);
        if n > 0 {
            share_opacity(
                splat,
                (n + 1).min(MAX_FAMILY),
                f64::from(growth.min_opacity),
            );
        }
    }
    Grown {
        splats: grown,
        parents,
        margin,
    }
}

/// Binomial coefficient: number of ways to choose `k` of `n`.
fn choose(n: u32, k: u32) -> f64 {
    (0..k)
        .map(|i| f64::from(n - i) / f64::from(i + 1))
        .product::<f64>()
}

/// Sets the opacity and size of one of `n` splats so that together they look like the original
/// splat.
fn share_opacity(splat: &mut Splat, n: u32, min_opacity: f64) {
    // Together, `n` splats of the new opacity at the same position are as opaque as the original
    // splat. The new scale follows from Kheradmand et al. 2024, equation 9.
    let opacity = sigmoid(splat.opacity_logit).clamp(1e-4, 0.9999);
    let shared = (1.0 - (1.0 - opacity).powf(1.0 / f64::from(n))).clamp(min_opacity, 0.9999);
    let term = |i: u32, k: u32| {
        let sign = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
        sign * choose(i - 1, k) * shared.powf(f64::from(k + 1)) / f64::from(k + 1).sqrt()
    };
    let weight: f64 = (1..=n).flat_map(|i| (0..i).map(move |k| term(i, k))).sum();
    let shrink = (opacity / weight).clamp(0.05, 1.0).ln();
    splat.log_scale = splat.log_scale.map(|scale| scale + shrink);
    splat.opacity_logit = (shared / (1.0 - shared)).ln();
}
