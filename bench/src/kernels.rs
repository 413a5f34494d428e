//! Measures the speed of the splat kernels.

use anyhow::{Context, Result};
use gpu::PassTiming;
use messages::Setting;
use model_files::splat::arrays::SplatArrays;
use model_files::splat::cloud::{load_cloud_npz, scan_cloud, synthetic_cloud};
use serde::Serialize;
use session::OpenGpu;
use std::path::PathBuf;
use std::time::Duration;
use trainer::splat::bench::{Eye, KernelFigures, KernelSetup, Losses, Repeats, time_kernels};

/// Values of options that are not given.
struct Defaults {
    sizes_px: &'static [[u32; 2]],
    n_splats: &'static [u32],
    n_repeats: u32,
}

/// Defaults on a GPU.
const DEFAULTS: Defaults = Defaults {
    sizes_px: &[[1024, 1024], [1280, 720], [1920, 1080]],
    n_splats: &[100_000, 300_000, 1_000_000, 3_000_000],
    n_repeats: 30,
};
/// Defaults on the CPU, which is about a thousand times slower than a GPU and supports only smaller
/// buffers.
const DEFAULTS_ON_CPU: Defaults = Defaults {
    sizes_px: &[[320, 240]],
    n_splats: &[10_000, 30_000],
    n_repeats: 3,
};
/// Defaults of [`KernelsOptions::scan`].
const SCAN_DEFAULTS: Defaults = Defaults {
    sizes_px: &[[640, 480]],
    n_splats: &[400_000],
    n_repeats: 30,
};
/// Defaults on the CPU, with as many splats per pixel as on a GPU.
const SCAN_DEFAULTS_ON_CPU: Defaults = Defaults {
    sizes_px: &[[160, 120]],
    n_splats: &[25_000],
    n_repeats: 3,
};

/// Options of [`measure`].
#[derive(Clone, Debug)]
pub struct KernelsOptions {
    /// An `.npz` file with splats. `None` selects a synthetic cloud.
    pub cloud: Option<PathBuf>,
    /// Image sizes, pixels. An empty list selects the defaults.
    pub sizes_px: Vec<[u32; 2]>,
    /// Numbers of splats of the synthetic cloud. An empty list selects the defaults.
    pub n_splats: Vec<u32>,
    /// Number of timed images and steps, of which the median is reported. If `None`, 30 are timed
    /// on a GPU and 3 on the CPU.
    pub n_repeats: Option<u32>,
    /// Whether the camera is inside the cloud, so that only some of the splats are visible.
    pub inside: bool,
    /// Whether to measure a step as in training on a scan with depth. In such a step, the splats
    /// are distributed unevenly, and the loss includes D-SSIM and depth. Cannot be combined with
    /// `cloud` or `inside`.
    pub scan: bool,
    /// Whether to report the GPU time of each pass.
    pub profile: bool,
}

/// Times of an image and of a training step.
#[derive(Clone, Debug, Serialize)]
pub struct KernelsRow {
    /// Size of the image, pixels.
    pub size_px: [u32; 2],
    /// Number of splats.
    pub n_splats: usize,
    /// Times and counts.
    #[serde(flatten)]
    pub figures: KernelFigures,
    /// Names and milliseconds of the passes of a step, if requested.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub passes: Vec<(&'static str, f64)>,
}

impl KernelsRow {
    /// The row as text: the times, the amount of work, then a line for each pass.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let [width, height] = self.size_px;
        let figures = &self.figures;
        let packed = figures
            .packed_millis
            .map(|millis| format!("packed {millis:.3} ms, "))
            .unwrap_or_default();
        let mut lines = vec![
            format!(
                "{width}x{height} {:>8} splats: image {:.3} ms, {packed}step {:.3} ms (wall {:.3}, {:.3}; only the {} splats in view {:.3} ms), mean {:.5?}, peak {} MB",
                self.n_splats,
                figures.render_millis,
                figures.step_millis,
                figures.render_wall_millis,
                figures.step_wall_millis,
                figures.n_splats_in_view,
                figures.step_visible_millis,
                figures.mean_rgb,
                figures.peak_bytes >> 20
            ),
            format!("    {}", figures.work),
        ];
        lines.extend(pass_lines(&self.passes));
        lines
    }
}

/// A line of text for each pass.
pub(crate) fn pass_lines(passes: &[(&'static str, f64)]) -> impl Iterator<Item = String> {
    passes
        .iter()
        .map(|(name, millis)| format!("    {millis:>9.4} ms  {name}"))
}

/// Measures every number of splats at every image size.
///
/// * `on_row`: receives each row. If it returns an error, the bench ends.
///
/// # Errors
///
/// Fails if the file of the cloud is invalid, if the GPU cannot be opened, or if its memory is
/// insufficient.
pub fn measure(
    options: &KernelsOptions,
    open_gpu: OpenGpu,
    mut on_row: impl FnMut(&KernelsRow) -> Result<()>,
) -> Result<()> {
    let given = options
        .cloud
        .as_deref()
        .map(|path| load_cloud_npz(path).with_context(|| format!("cloud {path:?}")))
        .transpose()?;
    // Only the kind of the device is needed here. It is closed before the first row.
    let defaults = match (options.scan, open_gpu()?.is_software()) {
        (false, false) => DEFAULTS,
        (false, true) => DEFAULTS_ON_CPU,
        (true, false) => SCAN_DEFAULTS,
        (true, true) => SCAN_DEFAULTS_ON_CPU,
    };
    let sizes_px = if options.sizes_px.is_empty() {
        defaults.sizes_px
    } else {
        &options.sizes_px
    };
    let splat_counts = if options.n_splats.is_empty() {
        defaults.n_splats
    } else {
        &options.n_splats
    };
    let counts = given.as_ref().map_or_else(
        || {
            splat_counts
                .iter()
                .map(|n_splats| *n_splats as usize)
                .collect()
        },
        |cloud| vec![cloud.n_splats()],
    );
    let n_repeats = options.n_repeats.unwrap_or(defaults.n_repeats) as usize;
    let eye = if options.inside {
        Eye::Inside
    } else {
        Eye::Outside
    };
    let losses = if options.scan {
        Losses::Training
    } else {
        Losses::L1
    };
    let generate: fn(usize, u64) -> SplatArrays = if options.scan {
        scan_cloud
    } else {
        synthetic_cloud
    };
    // The warm-up has a minimum duration, because drivers are slow for a while after large buffers
    // were allocated. A minimum number of steps would not be sufficient, because the steps of a GPU
    // are short.
    let repeats = Repeats {
        n_warm_up: n_repeats.div_ceil(3),
        warm_up: Duration::from_millis(300),
        n_timed: n_repeats,
        n_consecutive: 3 * n_repeats,
    };
    for (size_ix, size_px) in sizes_px.iter().enumerate() {
        for n_splats in &counts {
            // Each row uses a new device, so that the peak memory of earlier rows is not included.
            let gpu = open_gpu()?;
            if size_ix == 0 && counts.first() == Some(n_splats) {
                log::info!("{}", gpu.describe());
            }
            // A synthetic cloud is made for each row, and lives as long as the row.
            let synthetic;
            let cloud: &SplatArrays = match &given {
                Some(cloud) => cloud,
                None => {
                    synthetic = generate(*n_splats, 0);
                    &synthetic
                }
            };
            let setup = KernelSetup {
                size_px: *size_px,
                eye,
                losses,
            };
            let figures = time_kernels(&gpu, cloud, setup, repeats).with_context(|| {
                let [width, height] = size_px;
                format!(
                    "{width}x{height} pixels and {n_splats} splats: try fewer {} or a smaller {}",
                    Setting::Splats,
                    Setting::Size
                )
            })?;
            let passes = profile(&figures.passes, options.profile);
            on_row(&KernelsRow {
                size_px: *size_px,
                n_splats: *n_splats,
                figures,
                passes,
            })?;
        }
    }
    Ok(())
}

/// Names and milliseconds of the passes, if requested.
pub(crate) fn profile(passes: &[PassTiming], is_requested: bool) -> Vec<(&'static str, f64)> {
    if is_requested {
        passes.iter().map(|pass| (pass.name, pass.millis)).collect()
    } else {
        Vec::new()
    }
}
