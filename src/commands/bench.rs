//! `fieldrig bench`: how fast the kernels are.

use anyhow::Context;
use clap::{Parser, Subcommand};
use serde::Serialize;
use std::io::Write;
use std::path::PathBuf;
use trainer::splat::arrays::SplatArrays;
use trainer::splat::bench::{Repeats, time_kernels};
use trainer::splat::cloud::{load_cloud_npz, synthetic_cloud};

/// What to measure.
#[derive(Debug, Parser)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Time of a picture and of a training step on a synthetic cloud of splats, by size and count
    Kernels(KernelArgs),
}

#[derive(Debug, Parser)]
struct KernelArgs {
    /// Take the cloud from a file of arrays `means`, `quats`, `log_scales`, `opacities_logit` and `sh`, in place of our own
    #[arg(long, value_name = "FILE.npz")]
    cloud: Option<PathBuf>,
    /// Image sizes, `WIDTHxHEIGHT`, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "1024x1024,1280x720,1920x1080", value_parser = parse_size)]
    size: Vec<Size>,
    /// Numbers of splats, separated by commas (with --cloud: the file's)
    #[arg(long, value_delimiter = ',', default_value = "100000,300000,1000000,3000000")]
    splats: Vec<usize>,
    /// Pictures and steps timed; the median counts
    #[arg(long, default_value_t = 30)]
    repeats: usize,
    /// Print the GPU time of each pass of a step
    #[arg(long)]
    profile: bool,
    /// Print one JSON object a line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug)]
struct Size([u32; 2]);

fn parse_size(text: &str) -> Result<Size, String> {
    let parse = |part: &str| part.parse::<u32>().ok().filter(|size| (1..=16_384).contains(size));
    text.split_once('x')
        .and_then(|(width, height)| Some(Size([parse(width)?, parse(height)?])))
        .ok_or_else(|| "a size is WIDTHxHEIGHT in pixels, each from 1 to 16384".to_owned())
}

#[derive(Serialize)]
struct Row {
    w: u32,
    h: u32,
    n: usize,
    isect: u64,
    render_ms: f64,
    step_ms: f64,
    render_wall_ms: f64,
    step_wall_ms: f64,
    mean_rgb: [f64; 3],
    peak_mb: u64,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    passes: Vec<(&'static str, f64)>,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let What::Kernels(args) = &args.what;
    let given = args
        .cloud
        .as_deref()
        .map(|path| load_cloud_npz(path).with_context(|| format!("cloud {path:?}")))
        .transpose()?;
    let counts = given.as_ref().map_or_else(|| args.splats.clone(), |cloud| vec![cloud.n_splats()]);
    let mut out = std::io::stdout().lock();
    for (place, Size(size)) in args.size.iter().enumerate() {
        for n_splats in &counts {
            // A fresh device for each row, so that the peak of memory is the row's own.
            let gpu = super::open_gpu()?;
            if place == 0 && counts.first() == Some(n_splats) {
                log::info!("{}", gpu.describe());
            }
            let made;
            let cloud: &SplatArrays = match &given {
                Some(cloud) => cloud,
                None => {
                    made = synthetic_cloud(*n_splats, 0);
                    &made
                }
            };
            let repeats = Repeats {
                n_warm_up: args.repeats.div_ceil(3),
                n_timed: args.repeats.max(1),
                n_row: (3 * args.repeats).max(1),
            };
            let figures = time_kernels(&gpu, cloud, *size, repeats)?;
            let row = Row {
                w: size[0],
                h: size[1],
                n: *n_splats,
                isect: figures.n_isect,
                render_ms: figures.render_millis,
                step_ms: figures.step_millis,
                render_wall_ms: figures.render_wall_millis,
                step_wall_ms: figures.step_wall_millis,
                mean_rgb: figures.mean_rgb,
                peak_mb: figures.peak_bytes >> 20,
                passes: if args.profile {
                    figures.passes.iter().map(|pass| (pass.name, pass.millis)).collect()
                } else {
                    Vec::new()
                },
            };
            if args.json {
                writeln!(out, "{}", serde_json::to_string(&row)?)?;
                continue;
            }
            writeln!(
                out,
                "{}x{} {:>8} splats {:>9} intersections: picture {:.3} ms, step {:.3} ms (wall {:.3}, {:.3}), mean {:.5?}, peak {} MB",
                row.w,
                row.h,
                row.n,
                row.isect,
                row.render_ms,
                row.step_ms,
                row.render_wall_ms,
                row.step_wall_ms,
                row.mean_rgb,
                row.peak_mb
            )?;
            for (name, millis) in &row.passes {
                writeln!(out, "    {millis:>9.4} ms  {name}")?;
            }
        }
    }
    Ok(())
}
