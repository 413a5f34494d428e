//! `fieldrig bench field`: measures the training speed of a neural field.

use crate::open_gpu::open_gpu;
use crate::print;
use anyhow::Context;
use serde::Serialize;
use trainer::nerf::bench::time_steps;

/// Samples of a step if the flag is not given, on a GPU and on the CPU.
const DEFAULT_SAMPLES: [u32; 2] = [1 << 17, 1 << 18];
const DEFAULT_SAMPLES_ON_CPU: [u32; 1] = [1 << 14];

/// Flags of `bench field`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rays per step, 1 to 65536
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    rays: u32,
    /// Samples per step, separated by commas; rounded down to a multiple of the rays, with at least one per ray
    /// [default: 131072,262144; without a GPU 16384]
    #[arg(long, value_name = "N,...", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=1 << 24))]
    samples: Vec<u32>,
    /// Number of timed steps, 1 to 10000; the median is reported [default: 100; without a GPU 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    repeats: Option<u32>,
    /// Print the GPU time of each pass of a step
    #[arg(long)]
    profile: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    rays: u32,
    samples: u32,
    step_millis: f64,
    step_wall_millis: f64,
    /// Time to render as many samples of an image.
    colors_millis: f64,
    peak_bytes: u64,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    passes: Vec<(&'static str, f64)>,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let is_software = open_gpu()?.is_software();
    let default_samples: &[u32] = if is_software { &DEFAULT_SAMPLES_ON_CPU } else { &DEFAULT_SAMPLES };
    let n_repeats = args.repeats.unwrap_or(if is_software { 3 } else { 100 }) as usize;
    for (row_ix, n_samples) in
        (if args.samples.is_empty() { default_samples } else { &args.samples }).iter().enumerate()
    {
        // A new device for each row, so that the memory peak is that of the row.
        let gpu = open_gpu()?;
        if row_ix == 0 {
            log::info!("{}", gpu.describe());
        }
        let n_samples = (n_samples / args.rays).max(1) * args.rays;
        let figures = time_steps(&gpu, args.rays, n_samples, n_repeats)
            .with_context(|| format!("{n_samples} samples: try fewer --samples"))?;
        let row = Row {
            rays: figures.n_rays,
            samples: figures.n_samples,
            step_millis: figures.step_millis,
            step_wall_millis: figures.step_wall_millis,
            colors_millis: figures.colors_millis,
            peak_bytes: figures.peak_bytes,
            passes: super::profile(&figures.passes, args.profile),
        };
        if args.json {
            print::json(&row)?;
            continue;
        }
        print::line(format_args!(
            "{} rays {:>8} samples: step {:.3} ms (wall {:.3}), rendering as many samples {:.3} ms, peak {} MB",
            row.rays,
            row.samples,
            row.step_millis,
            row.step_wall_millis,
            row.colors_millis,
            row.peak_bytes >> 20
        ))?;
        for (name, millis) in &row.passes {
            print::line(format_args!("    {millis:>9.4} ms  {name}"))?;
        }
    }
    Ok(())
}
