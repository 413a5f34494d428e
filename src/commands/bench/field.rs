//! `fieldrig bench field`: measures the training speed of a neural field.

use crate::open_gpu::open_gpu;
use crate::print;
use bench::field::FieldOptions;

/// Flags of `bench field`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rays per step, 1 to 65536
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    rays: u32,
    /// Numbers of samples per step, separated by commas. Each is rounded down to a multiple of the
    /// rays, with at least one sample per ray [default: 131072,262144; without a GPU 16384]
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

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    bench::field::measure(&args.options(), open_gpu, |row| {
        print::json_or_lines(args.json, row, row.lines())
    })
}

impl Args {
    fn options(&self) -> FieldOptions {
        FieldOptions {
            n_rays: self.rays,
            n_samples: self.samples.clone(),
            n_repeats: self.repeats,
            profile: self.profile,
        }
    }
}
