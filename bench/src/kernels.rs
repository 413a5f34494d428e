//! `fieldrig bench kernels`: measures the speed of the splat kernels.

use crate::open_gpu::open_gpu;
use anyhow::Context;
use serde::Serialize;
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;
use trainer::splat::arrays::SplatArrays;
use trainer::splat::bench::{Eye, Repeats, time_kernels};
use trainer::splat::cloud::{load_cloud_npz, synthetic_cloud};

/// Maximum number of splats in a rig file.
const MAX_CLOUD_SPLATS: i64 = 100_000_000;

/// Settings if no flag is given.
struct Defaults {
    size: &'static [Size],
    splats: &'static [u32],
    repeats: u32,
}

/// Defaults on a GPU.
const DEFAULTS: Defaults = Defaults {
    size: &[Size([1024, 1024]), Size([1280, 720]), Size([1920, 1080])],
    splats: &[100_000, 300_000, 1_000_000, 3_000_000],
    repeats: 30,
};
/// Defaults on the CPU, which needs seconds for what a GPU does in a millisecond, and supports only smaller buffers.
const DEFAULTS_ON_CPU: Defaults = Defaults { size: &[Size([320, 240])], splats: &[10_000, 30_000], repeats: 3 };

/// Flags of `bench kernels`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Use the splats of an .npz file with `means`, `quats`, `log_scales`, `opacities_logit` and `sh` instead of a
    /// synthetic cloud
    #[arg(long, value_name = "FILE.npz")]
    cloud: Option<PathBuf>,
    /// Image sizes, `WIDTHxHEIGHT`, separated by commas [default: 1024x1024,1280x720,1920x1080; without a GPU 320x240]
    #[arg(long, value_delimiter = ',', value_parser = parse_size)]
    size: Vec<Size>,
    /// Numbers of splats, 1 to 100000000, separated by commas; with --cloud, that of the file
    /// [default: 100000,300000,1000000,3000000; without a GPU 10000,30000]
    #[arg(long, value_delimiter = ',', conflicts_with = "cloud", value_parser = clap::value_parser!(u32).range(1..=MAX_CLOUD_SPLATS))]
    splats: Vec<u32>,
    /// Number of timed images and steps, 1 to 10000; the median is reported [default: 30; without a GPU 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    repeats: Option<u32>,
    /// Put the camera into the middle of the cloud, where it sees only some of the splats
    #[arg(long)]
    inside: bool,
    /// Print the GPU time of each pass of a step
    #[arg(long)]
    profile: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug)]
struct Size([u32; 2]);

fn parse_size(text: &str) -> Result<Size, String> {
    let parse = |part: &str| part.parse::<u32>().ok().filter(|size| (1..=16_384).contains(size));
    text.split_once('x')
        .and_then(|(width, height)| Some(Size([parse(width)?, parse(height)?])))
        .ok_or_else(|| "expected WIDTHxHEIGHT in pixels, each from 1 to 16384".to_owned())
}

#[derive(Serialize)]
struct Row {
    size_px: [u32; 2],
    n_splats: usize,
    n_intersections: u64,
    render_millis: f64,
    /// Step that updates every splat.
    step_millis: f64,
    /// Step that updates only the visible splats.
    step_visible_millis: f64,
    n_visible: u64,
    render_wall_millis: f64,
    step_wall_millis: f64,
    mean_rgb: [f64; 3],
    peak_bytes: u64,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    passes: Vec<(&'static str, f64)>,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let given = args
        .cloud
        .as_deref()
        .map(|path| load_cloud_npz(path).with_context(|| format!("cloud {path:?}")))
        .transpose()?;
    let defaults = if open_gpu()?.is_software() { DEFAULTS_ON_CPU } else { DEFAULTS };
    let sizes = if args.size.is_empty() { defaults.size } else { &args.size };
    let splat_counts = if args.splats.is_empty() { defaults.splats } else { &args.splats };
    let counts = given.as_ref().map_or_else(
        || splat_counts.iter().map(|n_splats| *n_splats as usize).collect(),
        |cloud| vec![cloud.n_splats()],
    );
    let n_repeats = args.repeats.unwrap_or(defaults.repeats) as usize;
    let eye = if args.inside { Eye::Inside } else { Eye::Outside };
    let mut out = std::io::stdout().lock();
    for (size_ix, Size(size)) in sizes.iter().enumerate() {
        for n_splats in &counts {
            // A new device for each row, so that the memory peak is that of the row.
            let gpu = open_gpu()?;
            if size_ix == 0 && counts.first() == Some(n_splats) {
                log::info!("{}", gpu.describe());
            }
            let synthetic;
            let cloud: &SplatArrays = match &given {
                Some(cloud) => cloud,
                None => {
                    synthetic = synthetic_cloud(*n_splats, 0);
                    &synthetic
                }
            };
            let repeats = Repeats {
                n_warm_up: n_repeats.div_ceil(3),
                warm_up: Duration::from_millis(300),
                n_timed: n_repeats,
                n_consecutive: 3 * n_repeats,
            };
            let figures = time_kernels(&gpu, cloud, *size, eye, repeats).with_context(|| {
                format!("{}x{} pixels and {n_splats} splats: try fewer --splats or a smaller --size", size[0], size[1])
            })?;
            let row = Row {
                size_px: *size,
                n_splats: *n_splats,
                n_intersections: figures.n_intersections,
                render_millis: figures.render_millis,
                step_millis: figures.step_millis,
                step_visible_millis: figures.step_visible_millis,
                n_visible: figures.n_visible,
                render_wall_millis: figures.render_wall_millis,
                step_wall_millis: figures.step_wall_millis,
                mean_rgb: figures.mean_rgb,
                peak_bytes: figures.peak_bytes,
                passes: super::profile(&figures.passes, args.profile),
            };
            if args.json {
                writeln!(out, "{}", serde_json::to_string(&row)?)?;
                continue;
            }
            writeln!(
                out,
                "{}x{} {:>8} splats {:>9} intersections: image {:.3} ms, step {:.3} ms (wall {:.3}, {:.3}; only the {} visible splats {:.3} ms), mean {:.5?}, peak {} MB",
                row.size_px[0],
                row.size_px[1],
                row.n_splats,
                row.n_intersections,
                row.render_millis,
                row.step_millis,
                row.render_wall_millis,
                row.step_wall_millis,
                row.n_visible,
                row.step_visible_millis,
                row.mean_rgb,
                row.peak_bytes >> 20
            )?;
            for (name, millis) in &row.passes {
                writeln!(out, "    {millis:>9.4} ms  {name}")?;
            }
        }
    }
    Ok(())
}
