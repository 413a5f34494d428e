//! Times a training step on synthetic rays, pass by pass.
//!
//! Rays start at random positions in a fully occupied cube and have equal lengths, so that a step
//! has a known number of samples. Their colors are noise. The occupancy is not updated.

use super::field_trainer::{Compiled, FieldTrainer, STEPS_PER_SUBMIT};
use super::options::{NerfBudget, NerfOptions};
use super::params::Ray;
use super::reference::grid::GridShape;
use super::sizes::Sizes;
use crate::Error;
use crate::model_options::ModelOptions;
use calibration::ParamSet;
use gpu::{Gpu, PassTiming, PendingRead};
use nalgebra::Vector3;
use numbers::random::{hash, unit_from_bits};
use numbers::{f32_of, f32s_of};
use std::sync::Arc;
use std::time::Instant;

/// Shape of the hash grid, as in Mueller et al. 2022. The numbers are the number of levels, the
/// numbers of cells along an axis of the coarsest and of the finest level, and log2 of the entries
/// per level.
const GRID_SHAPE: (u32, u32, u32, u32) = (16, 16, 2048, 19);
/// Step at which no occupancy update is due.
const STEP: u64 = 1;

/// Timings for one number of samples.
#[derive(Clone, Debug)]
pub struct StepFigures {
    /// Rays per step.
    pub n_rays: u32,
    /// Samples per step.
    pub n_samples: u32,
    /// GPU time of a step, milliseconds. It is the median of the sum over the passes of the step,
    /// or the wall time if there are no timestamps.
    pub step_millis: f64,
    /// Mean wall time of consecutive steps, milliseconds.
    pub step_wall_millis: f64,
    /// Median GPU time to render the colors of `n_samples` samples of a picture, milliseconds. It
    /// is the wall time if there are no timestamps.
    pub colors_millis: f64,
    /// GPU time of each pass of one step. The list is empty without timestamps.
    pub passes: Vec<PassTiming>,
    /// Peak size of live GPU buffers, bytes.
    pub peak_bytes: u64,
}

/// Times steps of `n_rays` rays with `n_samples` samples in total, which is a multiple of `n_rays`.
pub fn time_steps(
    gpu: &Gpu,
    n_rays: u32,
    n_samples: u32,
    n_repeats: usize,
) -> Result<StepFigures, Error> {
    let options = ModelOptions::default();
    let nerf_budget = NerfBudget {
        n_rays,
        n_samples,
        ..NerfBudget::FULL
    };
    let (n_levels, coarsest, finest, log2_entries) = GRID_SHAPE;
    let shape = GridShape::between(coarsest, finest, n_levels, log2_entries);
    let sizes = Sizes {
        n_cells: shape.n_cells,
        log2_entries,
        has_depth: false,
        can_refine: false,
        nerf_budget,
    };
    let compiled = Arc::new(Compiled::new(gpu, &sizes.nerf_budget)?);
    let field_trainer = FieldTrainer::new(gpu, &options, sizes, compiled)?;
    let mut timed_field = TimedField {
        gpu,
        options,
        field_trainer,
        rays: synthetic_rays(nerf_budget),
    };
    // The first submit allocates buffers, so it is not timed.
    timed_field.submit()?.finish::<u32>(gpu)?;
    let n_submits = n_repeats.div_ceil(STEPS_PER_SUBMIT);
    let since = Instant::now();
    let mut before = None;
    for _ in 0..n_submits {
        // As in training, the next submit is encoded while the previous submit runs.
        if let Some(before) = before.replace(timed_field.submit()?) {
            before.finish::<u32>(gpu)?;
        }
    }
    let counters = match before {
        Some(last) => last.finish::<u32>(gpu)?,
        None => Vec::new(),
    };
    let step_wall_millis =
        since.elapsed().as_secs_f64() * 1e3 / (n_submits * STEPS_PER_SUBMIT) as f64;
    let (step_millis, passes) = timed_field.median(n_repeats, |field| field.record_step(0))?;
    let (colors_millis, _) = timed_field.median(n_repeats, |field| {
        field.field_trainer.record_colors(field.gpu)
    })?;
    Ok(StepFigures {
        n_rays,
        n_samples: counters.get(1).copied().unwrap_or(0),
        step_millis,
        step_wall_millis,
        colors_millis,
        passes,
        peak_bytes: gpu.peak_bytes(),
    })
}

/// A field whose steps are timed, and the rays on which they train.
struct TimedField<'a> {
    gpu: &'a Gpu,
    options: ModelOptions<NerfOptions>,
    field_trainer: FieldTrainer,
    rays: Vec<Ray>,
}

impl TimedField<'_> {
    fn record_step(&mut self, slot_ix: usize) -> Result<(), Error> {
        self.field_trainer.record_step(
            self.gpu,
            &self.options,
            slot_ix,
            STEP,
            &self.rays,
            ParamSet::empty(),
        )
    }

    /// Submits as many steps as training does.
    fn submit(&mut self) -> Result<PendingRead, Error> {
        for slot_ix in 0..STEPS_PER_SUBMIT {
            self.record_step(slot_ix)?;
        }
        Ok(self.field_trainer.submit(self.gpu))
    }

    /// Median time of recorded passes, milliseconds, and the time of each pass in that repetition.
    fn median(
        &mut self,
        n_repeats: usize,
        record: impl Fn(&mut Self) -> Result<(), Error>,
    ) -> Result<(f64, Vec<PassTiming>), Error> {
        let mut timed = Vec::new();
        for _ in 0..n_repeats.max(1) {
            record(self)?;
            let since = Instant::now();
            let passes = self.field_trainer.submit_timed(self.gpu)?;
            let wall = since.elapsed().as_secs_f64() * 1e3;
            let sum = if passes.is_empty() {
                wall
            } else {
                passes.iter().map(|pass| pass.millis).sum()
            };
            timed.push((sum, passes));
        }
        timed.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        Ok(timed.swap_remove(timed.len() / 2))
    }
}

/// Rays with equal numbers of samples, which together fill the batch.
fn synthetic_rays(nerf_budget: NerfBudget) -> Vec<Ray> {
    let NerfBudget {
        n_rays,
        n_samples,
        n_steps,
        ..
    } = nerf_budget;
    // The rays are half a step shorter, so that rounding does not change the number of samples.
    let length = 2.0 / f64::from(n_steps) * (f64::from(n_samples / n_rays) - 0.5);
    (0..n_rays).map(|ix| synthetic_ray(ix, length)).collect()
}

/// A ray with a random middle near the center, a random direction and a random color.
fn synthetic_ray(ix: u32, length: f64) -> Ray {
    let number = |stream: u64| 2.0 * unit_from_bits(hash(u64::from(ix) << 8 | stream)) - 1.0;
    let triple = |stream: u64| Vector3::from_fn(|axis, _| number(stream + axis as u64));
    let direction = triple(0).normalize();
    // The origin is clamped so that the whole ray is in the region where steps have constant
    // length.
    let origin = (triple(3) * 0.5).map(|along| along.clamp(-0.5, 0.5)) - 0.5 * length * direction;
    let target = hash(u64::from(ix) << 8 | 6).to_le_bytes();
    Ray {
        origin: f32s_of(origin.into()),
        direction: f32s_of(direction.into()),
        begin: 0.0,
        end: f32_of(length),
        target_rgb: u32::from_le_bytes([target[0], target[1], target[2], 255]),
        ..Ray::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gpu::testing::test_gpu;

    #[test]
    fn timed_step_has_requested_sample_count() {
        let gpu = test_gpu();
        let figures = time_steps(&gpu, 64, 512, 1).unwrap();
        assert_eq!(figures.n_samples, 512);
        assert!(figures.step_millis > 0.0 && figures.step_wall_millis > 0.0);
    }
}
