//! Measures the training speed of a neural field.

use crate::kernels::{pass_lines, profile};
use anyhow::{Context, Result};
use messages::Setting;
use serde::Serialize;
use session::OpenGpu;
use trainer::nerf::bench::time_steps;

/// Default samples per step on a GPU.
const DEFAULT_SAMPLES: [u32; 2] = [1 << 17, 1 << 18];
/// Default samples per step on the CPU, where a step would otherwise take many seconds.
const DEFAULT_SAMPLES_ON_CPU: [u32; 1] = [1 << 14];
/// Default number of timed steps on a GPU. The next constant is the default on the CPU.
const DEFAULT_REPEATS: u32 = 100;
const DEFAULT_REPEATS_ON_CPU: u32 = 3;

/// Options of [`measure`].
#[derive(Clone, Debug)]
pub struct FieldOptions {
    /// Rays per step.
    pub n_rays: u32,
    /// Samples per step. Each value gives one row, and an empty list stands for the defaults. Each
    /// value is rounded down to a multiple of the number of rays, but there is at least one sample
    /// per ray.
    pub n_samples: Vec<u32>,
    /// Number of timed steps, of which the median is reported. If `None`, 100 steps are timed on a
    /// GPU and 3 on the CPU.
    pub n_repeats: Option<u32>,
    /// Whether to report the GPU time of each pass.
    pub profile: bool,
}

/// Times of a training step.
#[derive(Clone, Debug, Serialize)]
pub struct FieldRow {
    /// Rays per step.
    pub rays: u32,
    /// Samples per step.
    pub samples: u32,
    /// GPU time of a step, milliseconds.
    pub step_millis: f64,
    /// Wall time of a step, milliseconds.
    pub step_wall_millis: f64,
    /// Time to render an image with the same number of samples, milliseconds.
    pub colors_millis: f64,
    /// Peak size of live GPU buffers, bytes.
    pub peak_bytes: u64,
    /// Names and milliseconds of the passes of a step, if requested.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub passes: Vec<(&'static str, f64)>,
}

impl FieldRow {
    /// The row as text: the times, then a line for each pass.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!(
            "{} rays {:>8} samples: step {:.3} ms (wall {:.3}), rendering {:.3} ms, peak {} MB",
            self.rays,
            self.samples,
            self.step_millis,
            self.step_wall_millis,
            self.colors_millis,
            self.peak_bytes >> 20
        )];
        lines.extend(pass_lines(&self.passes));
        lines
    }
}

/// Measures a training step for each number of samples in turn.
///
/// * `on_row`: receives each row. If it returns an error, the bench ends.
///
/// # Errors
///
/// Fails if the GPU cannot be opened, or if its memory is insufficient.
pub fn measure(
    options: &FieldOptions,
    open_gpu: OpenGpu,
    mut on_row: impl FnMut(&FieldRow) -> Result<()>,
) -> Result<()> {
    let is_software = open_gpu()?.is_software();
    let default_samples: &[u32] = if is_software {
        &DEFAULT_SAMPLES_ON_CPU
    } else {
        &DEFAULT_SAMPLES
    };
    let n_samples = if options.n_samples.is_empty() {
        default_samples
    } else {
        &options.n_samples
    };
    let n_repeats = options.n_repeats.unwrap_or(if is_software {
        DEFAULT_REPEATS_ON_CPU
    } else {
        DEFAULT_REPEATS
    });
    for (row_ix, n_samples) in n_samples.iter().enumerate() {
        // Each row uses a new device, so that the peak memory of earlier rows is not included.
        let gpu = open_gpu()?;
        if row_ix == 0 {
            log::info!("{}", gpu.describe());
        }
        // Every ray has the same number of samples.
        let n_samples = (n_samples / options.n_rays).max(1) * options.n_rays;
        let figures = time_steps(&gpu, options.n_rays, n_samples, n_repeats as usize)
            .with_context(|| format!("{n_samples} samples: try fewer {}", Setting::Samples))?;
        on_row(&FieldRow {
            rays: figures.n_rays,
            samples: figures.n_samples,
            step_millis: figures.step_millis,
            step_wall_millis: figures.step_wall_millis,
            colors_millis: figures.colors_millis,
            peak_bytes: figures.peak_bytes,
            passes: profile(&figures.passes, options.profile),
        })?;
    }
    Ok(())
}
