//! Learning rates and costs of the splats' parameters.

use crate::model_options::ModelOptions;
use crate::splat::options::SplatOptions;
use crate::splat::params::{MIN_OPACITY, Rule};
use crate::splat::schedule::Schedule;
use crate::splat::snapshot::ObservedScene;
use numbers::f32_of;

// The rates and Adam's parameters are from Kerbl et al. 2023 and the reference implementation of
// this paper.

/// Initial learning rate of the means, in scene sizes.
const MEAN_RATE: f32 = 1.6e-4;
/// Fraction of [`MEAN_RATE`] that remains after the planned steps.
const FINAL_MEAN_RATE_FRAC: f32 = 0.01;
const LOG_SCALE_RATE: f32 = 5e-3;
const ROTATION_RATE: f32 = 1e-3;
const OPACITY_RATE: f32 = 5e-2;
/// Learning rate of the constant color term. For all other SH coefficients, it is divided by
/// [`SH_REST_DIVISOR`].
const SH_DC_RATE: f32 = 2.5e-3;
const SH_REST_DIVISOR: f32 = 20.0;
/// Adam's decay rates.
const BETAS: [f32; 2] = [0.9, 0.999];
/// Adam's epsilon. It is far below the usual 1e-8. Gradients of single splats are tiny, because the
/// loss is a mean over all pixels.
const EPSILON: f32 = 1e-15;
/// Range of the splats' standard deviations, in scene sizes. The lower end keeps the covariance
/// invertible in f32. The upper end prevents splats that cover everything.
const SCALE_RANGE: [f32; 2] = [1e-5, 2.0];
/// Maximum costs of opacity and size relative to the color loss. With 6 and 11 images, three times
/// these costs gained nothing (docs/benchmarks/2026-11-25-few-images.md).
const MAX_COST: f64 = 0.1;

/// Returns the update rule for the next steps. These steps train `n_splats` splats on `n_views`
/// images.
pub(super) fn rule(
    options: &ModelOptions<SplatOptions>,
    schedule: &Schedule,
    scene: &ObservedScene,
    n_views: usize,
    n_splats: u32,
) -> Rule {
    let size = f32_of(scene.size_m);
    // The fewer the images, the more splats overfit, so the cost is `(13 / n)^2` by default
    // (docs/design/splats.md, section "Loss"). The cost is divided by the number of splats, because
    // the loss contains the mean opacity and the mean scale.
    let cost = (options.specific.cost_images / n_views.max(1) as f64)
        .powi(2)
        .min(MAX_COST);
    let cost = f32_of(cost / f64::from(n_splats.max(1)));
    #[expect(
        clippy::cast_possible_truncation,
        reason = "both halves of the seed are used"
    )]
    let seed = (options.common.seed ^ (options.common.seed >> 32)) as u32;
    Rule {
        mean_rate_m: MEAN_RATE * size,
        log_scale_rate: LOG_SCALE_RATE,
        rotation_rate: ROTATION_RATE,
        opacity_rate: OPACITY_RATE,
        sh_dc_rate: SH_DC_RATE,
        sh_rest_rate: SH_DC_RATE / SH_REST_DIVISOR,
        noise: f32_of(options.specific.noise),
        final_mean_rate_frac: FINAL_MEAN_RATE_FRAC,
        betas: BETAS,
        epsilon: EPSILON,
        n_planned_steps: f32_of(schedule.n_planned_steps as f64),
        schedule_start: f32_of(schedule.start as f64),
        opacity_cost: cost,
        scale_cost: cost,
        log_scale_range: SCALE_RANGE.map(|scale| (scale * size).ln()),
        seed,
        // Without depth, many splats start at wrong positions. Costs and noise then act in every
        // step, also on splats that the image of the step does not show.
        update_all: u32::from(!scene.has_depth),
        noise_center: MIN_OPACITY,
    }
}
