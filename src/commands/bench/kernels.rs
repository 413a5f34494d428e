//! `fieldrig bench kernels`: measures the speed of the splat kernels.

use crate::number_args::size_up_to;
use crate::open_gpu::open_gpu;
use crate::print;
use bench::kernels::KernelsOptions;
use std::path::PathBuf;

/// Maximum number of splats in a rig file.
const MAX_CLOUD_SPLATS: i64 = 100_000_000;

/// Flags of `bench kernels`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Use the splats of an .npz file with `means`, `quats`, `log_scales`, `opacities_logit` and
    /// `sh` instead of a synthetic cloud
    #[arg(long, value_name = "FILE.npz")]
    cloud: Option<PathBuf>,
    /// Image sizes, `WIDTHxHEIGHT`, separated by commas [default: 1024x1024,1280x720,1920x1080;
    /// without a GPU 320x240]
    #[arg(long, value_delimiter = ',', value_parser = size_up_to(16_384))]
    size: Vec<[u32; 2]>,
    /// Numbers of splats, 1 to 100000000, separated by commas; cannot be combined with --cloud
    /// [default: 100000,300000,1000000,3000000; without a GPU 10000,30000]
    #[arg(long, value_delimiter = ',', conflicts_with = "cloud", value_parser = clap::value_parser!(u32).range(1..=MAX_CLOUD_SPLATS))]
    splats: Vec<u32>,
    /// Number of timed images and steps, 1 to 10000; the median is reported [default: 30; without a
    /// GPU 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    repeats: Option<u32>,
    /// Put the camera in the middle of the cloud, where only some of the splats are visible
    #[arg(long)]
    inside: bool,
    /// Measure a step that resembles the steps of a scan with depth: unevenly distributed splats,
    /// and a loss with D-SSIM and depth [default: 640x480 and 400000 splats; without a GPU 160x120
    /// and 25000]
    #[arg(long, conflicts_with_all = ["cloud", "inside"])]
    scan: bool,
    /// Print the GPU time of each pass of a step
    #[arg(long)]
    profile: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    bench::kernels::measure(&args.options(), open_gpu, |row| {
        print::json_or_lines(args.json, row, row.lines())
    })
}

impl Args {
    fn options(&self) -> KernelsOptions {
        KernelsOptions {
            cloud: self.cloud.clone(),
            sizes_px: self.size.clone(),
            n_splats: self.splats.clone(),
            n_repeats: self.repeats,
            inside: self.inside,
            scan: self.scan,
            profile: self.profile,
        }
    }
}
