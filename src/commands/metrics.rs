//! `fieldrig metrics`: compares two images.

use crate::print;
use session::ImageComparison;
use std::path::PathBuf;

/// Flags of `metrics`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Image to score (PNG or JPEG)
    #[arg(value_name = "A")]
    rendered: PathBuf,
    /// Ground truth; its transparent pixels are ignored
    #[arg(value_name = "B")]
    truth: PathBuf,
    /// Print one JSON object; null means unavailable or, for PSNR, infinite
    #[arg(long)]
    json: bool,
    /// `SqueezeNet` weights for LPIPS (safetensors) [default: `FIELDRIG_LPIPS_WEIGHTS`, else no
    /// LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Meters per count, if both images are 16-bit depth
    #[arg(long, value_name = "METERS", default_value_t = 0.001, value_parser = positive)]
    meters_per_count: f64,
}

fn positive(text: &str) -> Result<f64, String> {
    let number = text
        .parse::<f64>()
        .ok()
        // With a value of 0, all depths and their error would be 0.
        .filter(|number| number.is_finite() && *number > 0.0);
    number.ok_or_else(|| "must be a number above 0".to_owned())
}

/// Prints PSNR, SSIM and LPIPS of two images, or the error of two depth images.
pub(crate) fn run(args: Args) -> anyhow::Result<()> {
    let comparison = ImageComparison {
        rendered: args.rendered,
        truth: args.truth,
        lpips_weights: args.lpips_weights,
        meters_per_count: args.meters_per_count,
    };
    let scores = comparison.run()?;
    print::json_or_lines(args.json, &scores, [scores.to_text()])
}
