//! `fieldrig metrics`: compares two images.

use crate::print;
use anyhow::{Context, bail};
use image::DynamicImage;
use image::ImageReader;
use serde::Serialize;
use session::evaluate::load_lpips;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use trainer::eval::{PixelPair, depth_rmse_m, psnr, ssim};

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

/// The printed scores; `None` if unavailable.
#[derive(Debug, Default, Serialize)]
struct Scores {
    psnr: Option<f64>,
    ssim: Option<f64>,
    lpips: Option<f64>,
    depth_rmse_m: Option<f64>,
}

/// Prints PSNR, SSIM and LPIPS of two images, or the error of two depth images.
pub(crate) fn run(args: Args) -> anyhow::Result<()> {
    let rendered = open(&args.rendered)?;
    let truth = open(&args.truth)?;
    let [size_px, truth_px] =
        [&rendered, &truth].map(|picture| [picture.width(), picture.height()]);
    if size_px != truth_px {
        bail!(
            "{} is {}x{} pixels, {} is {}x{}: the images must have the same size",
            args.rendered.display(),
            size_px[0],
            size_px[1],
            args.truth.display(),
            truth_px[0],
            truth_px[1]
        );
    }
    // Depth images have 16 bits and one channel; everything else is color.
    let scores = match (rendered, truth) {
        (DynamicImage::ImageLuma16(rendered), DynamicImage::ImageLuma16(truth)) => {
            depth_scores([rendered.as_raw(), truth.as_raw()], args.meters_per_count)?
        }
        (rendered, truth) => {
            let rendered = rendered.into_rgba8();
            let truth = truth.into_rgba8();
            color_scores(
                &PixelPair::new(size_px, &rendered, &truth)?,
                args.lpips_weights.as_deref(),
            )?
        }
    };
    if args.json {
        print::json(&scores)
    } else {
        Ok(print::line(scores.to_text())?)
    }
}

fn open(path: &Path) -> anyhow::Result<DynamicImage> {
    decode(path).with_context(|| format!("cannot read the image {}", path.display()))
}

/// Decodes an image whose format is recognized by its contents, not by its name.
fn decode(path: &Path) -> anyhow::Result<DynamicImage> {
    let reader = ImageReader::new(BufReader::new(files::open(path)?)).with_guessed_format()?;
    Ok(reader.decode()?)
}

fn color_scores(pair: &PixelPair<'_>, lpips_weights: Option<&Path>) -> anyhow::Result<Scores> {
    let lpips = load_lpips(lpips_weights)?
        .map(|lpips| lpips.distance(pair))
        .transpose()?;
    Ok(Scores {
        psnr: Some(psnr(pair)?),
        ssim: Some(ssim(pair)?),
        lpips,
        depth_rmse_m: None,
    })
}

fn depth_scores(counts: [&Vec<u16>; 2], meters_per_count: f64) -> anyhow::Result<Scores> {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "16-bit counts keep more digits in f32 than sensors have"
    )]
    let meters_from_count = |count: &u16| (f64::from(*count) * meters_per_count) as f32;
    let [rendered_m, truth_m] =
        counts.map(|counts| counts.iter().map(meters_from_count).collect::<Vec<_>>());
    Ok(Scores {
        depth_rmse_m: depth_rmse_m(&rendered_m, &truth_m)?,
        ..Scores::default()
    })
}

impl Scores {
    fn to_text(&self) -> String {
        let parts = [
            self.psnr.map(|psnr| format!("PSNR {psnr:.3} dB")),
            self.ssim.map(|ssim| format!("SSIM {ssim:.5}")),
            self.lpips.map(|lpips| format!("LPIPS {lpips:.5}")),
            self.depth_rmse_m
                .map(|rmse_m| format!("depth error {:.2} mm", 1e3 * rmse_m)),
        ];
        let known: Vec<_> = parts.into_iter().flatten().collect();
        // Color images always have a PSNR.
        if known.is_empty() {
            "no pixel has depth in both images".to_owned()
        } else {
            known.join("  ")
        }
    }
}
