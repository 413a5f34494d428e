//! `fieldrig bench kernels`: measures the speed of the splat kernels.

use crate::open_gpu::open_gpu;
use crate::print;
use bench::kernels::{KernelsOptions, KernelsRow};
use std::path::PathBuf;

/// Maximum number of splats in a rig file.
const MAX_CLOUD_SPLATS: i64 = 100_000_000;

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
    /// Numbers of splats, 1 to 100000000, separated by commas; cannot be combined with --cloud [default:
    /// 100000,300000,1000000,3000000; without a GPU 10000,30000]
    #[arg(long, value_delimiter = ',', conflicts_with = "cloud", value_parser = clap::value_parser!(u32).range(1..=MAX_CLOUD_SPLATS))]
    splats: Vec<u32>,
    /// Number of timed images and steps, 1 to 10000; the median is reported [default: 30; without a GPU 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    repeats: Option<u32>,
    /// Put the camera in the middle of the cloud, where only some of the splats are visible
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

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    bench::kernels::measure(&args.options(), open_gpu, |row| args.print(row))
}

impl Args {
    fn options(&self) -> KernelsOptions {
        KernelsOptions {
            cloud: self.cloud.clone(),
            sizes_px: self.size.iter().map(|Size(size_px)| *size_px).collect(),
            n_splats: self.splats.clone(),
            n_repeats: self.repeats,
            inside: self.inside,
            profile: self.profile,
        }
    }

    fn print(&self, row: &KernelsRow) -> anyhow::Result<()> {
        if self.json {
            return print::json(row);
        }
        print::line(format_args!(
            "{}x{} {:>8} splats {:>9} intersections: image {:.3} ms, packed {:.3}, step {:.3} ms (wall {:.3}, {:.3}; only the {} visible splats {:.3} ms), mean {:.5?}, peak {} MB",
            row.size_px[0],
            row.size_px[1],
            row.n_splats,
            row.figures.n_intersections,
            row.figures.render_millis,
            row.figures.packed_millis.unwrap_or(f64::NAN),
            row.figures.step_millis,
            row.figures.render_wall_millis,
            row.figures.step_wall_millis,
            row.figures.n_visible,
            row.figures.step_visible_millis,
            row.figures.mean_rgb,
            row.figures.peak_bytes >> 20
        ))?;
        for (name, millis) in &row.passes {
            print::line(format_args!("    {millis:>9.4} ms  {name}"))?;
        }
        Ok(())
    }
}
