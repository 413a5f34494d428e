//! Compares an image with another one, both read from files.

use crate::evaluate::load_lpips;
use anyhow::{Context, bail};
use image::{DynamicImage, ImageReader};
use serde::Serialize;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use trainer::eval::{PixelPair, depth_rmse_m, psnr, ssim};

/// Two images to compare.
#[derive(Clone, Debug)]
pub struct ImageComparison {
    /// Image to score (PNG or JPEG).
    pub rendered: PathBuf,
    /// Ground truth. Its transparent pixels are ignored.
    pub truth: PathBuf,
    /// Weights for LPIPS.
    pub lpips_weights: Option<PathBuf>,
    /// Meters per count, if both images are 16-bit depth.
    pub meters_per_count: f64,
}

/// Scores of an image; `None` if unavailable. They serialize as JSON.
#[derive(Debug, Default, Serialize)]
pub struct ComparisonScores {
    psnr: Option<f64>,
    ssim: Option<f64>,
    lpips: Option<f64>,
    depth_rmse_m: Option<f64>,
}

impl ImageComparison {
    /// Computes PSNR, SSIM and LPIPS of two images, or the error of two depth images.
    ///
    /// # Errors
    /// Fails if an image or the weights cannot be read, or if the images differ in size.
    pub fn run(&self) -> anyhow::Result<ComparisonScores> {
        let rendered = open(&self.rendered)?;
        let truth = open(&self.truth)?;
        let [size_px, truth_px] =
            [&rendered, &truth].map(|picture| [picture.width(), picture.height()]);
        if size_px != truth_px {
            bail!(
                "{} is {}x{} pixels, {} is {}x{}: the images must have the same size",
                self.rendered.display(),
                size_px[0],
                size_px[1],
                self.truth.display(),
                truth_px[0],
                truth_px[1]
            );
        }
        // Depth images have 16 bits and one channel; everything else is color.
        match (rendered, truth) {
            (DynamicImage::ImageLuma16(rendered), DynamicImage::ImageLuma16(truth)) => {
                depth_scores([rendered.as_raw(), truth.as_raw()], self.meters_per_count)
            }
            (rendered, truth) => {
                let rendered = rendered.into_rgba8();
                let truth = truth.into_rgba8();
                color_scores(
                    &PixelPair::new(size_px, &rendered, &truth)?,
                    self.lpips_weights.as_deref(),
                )
            }
        }
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

fn color_scores(
    pair: &PixelPair<'_>,
    lpips_weights: Option<&Path>,
) -> anyhow::Result<ComparisonScores> {
    let lpips = load_lpips(lpips_weights)?
        .map(|lpips| lpips.distance(pair))
        .transpose()?;
    Ok(ComparisonScores {
        psnr: Some(psnr(pair)?),
        ssim: Some(ssim(pair)?),
        lpips,
        depth_rmse_m: None,
    })
}

fn depth_scores(counts: [&Vec<u16>; 2], meters_per_count: f64) -> anyhow::Result<ComparisonScores> {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "16-bit counts keep more digits in f32 than sensors have"
    )]
    let meters_from_count = |count: &u16| (f64::from(*count) * meters_per_count) as f32;
    let [rendered_m, truth_m] =
        counts.map(|counts| counts.iter().map(meters_from_count).collect::<Vec<_>>());
    Ok(ComparisonScores {
        depth_rmse_m: depth_rmse_m(&rendered_m, &truth_m)?,
        ..ComparisonScores::default()
    })
}

impl ComparisonScores {
    /// The scores as one line of text.
    #[must_use]
    pub fn to_text(&self) -> String {
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
