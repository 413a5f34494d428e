//! Times rendering and training steps on a given cloud, in total and pass by pass.
//!
//! The setup matches the benchmark of the peer implementation. A pinhole camera at
//! [`Eye::Outside`] looks along z with a focal length of 0.9 image widths. The target is uniform
//! noise, the loss is L1, and each step updates every splat. [`Losses::Training`] adds the other
//! losses of training with depth.

use super::buffers::{ImageBuffers, Scratch, ScratchSize, SplatBuffers, n_bins, n_tiles};
use super::few_images::Scarcity;
use super::kernels::{DrawPipelines, TrainPipelines};
use super::options::SplatOptions;
use super::params::{Camera, LOW_PASS_PX2, MIN_OPACITY, Rule, Supervision, status};
use super::passes::{Target, ViewPasses};
use super::work_counts::WorkCounts;
use crate::packing::{JPEG_QUALITY, Output, Reader};
use crate::{Error, Packing};
use gpu::{Buffer, Gpu, PassTiming, Passes};
use kinematics::Transform;
use model_files::splat::arrays::SplatArrays;
use numbers::f32_of;
use numbers::quantile::{Rank, quantile};
use serde::Serialize;
use std::cell::RefCell;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Learning rate of every parameter. It is small, so that the cloud hardly changes.
const RATE: f32 = 1e-5;

/// Depth that the images of [`Losses::Training`] show, meters.
const DEPTH_M: f32 = 3.2;
/// Number of images. It is large enough to turn off the regularization for few images.
const N_IMAGES: usize = 1000;

/// Results for one image size and cloud.
#[derive(Clone, Debug, Serialize)]
pub struct KernelFigures {
    /// Lists of the tiles.
    #[serde(flatten)]
    pub work: WorkCounts,
    /// Median GPU time of a picture, from the first pass to the last, milliseconds. Wall time if
    /// timestamps are unavailable.
    pub render_millis: f64,
    /// Median GPU time of a picture that is also packed as JPEG and depth for a viewer,
    /// milliseconds. `None` on the CPU, where pictures are not packed.
    pub packed_millis: Option<f64>,
    /// Median GPU time of a step that updates every splat, milliseconds.
    pub step_millis: f64,
    /// Median GPU time of a step that updates only visible splats, milliseconds.
    pub step_visible_millis: f64,
    /// Number of splats in view.
    pub n_splats_in_view: u64,
    /// Mean wall time of consecutive pictures, milliseconds.
    pub render_wall_millis: f64,
    /// Mean wall time of consecutive steps, milliseconds.
    pub step_wall_millis: f64,
    /// Mean color of the first picture.
    pub mean_rgb: [f64; 3],
    /// Peak size of all GPU buffers, bytes.
    pub peak_bytes: u64,
    /// GPU time of each pass of one step, then of each pass that packs a picture. The list is empty
    /// without timestamps.
    #[serde(skip)]
    pub passes: Vec<PassTiming>,
}

/// Position of the camera on the z axis, meters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Eye {
    /// The z coordinate of the camera is -3.2, as in the peer's benchmark. The whole cloud is
    /// visible.
    Outside,
    /// The z coordinate of the camera is 0, inside the cloud, as in a room. Only a part of the
    /// cloud is visible.
    Inside,
}

impl Eye {
    fn z_m(self) -> f64 {
        match self {
            Self::Outside => -3.2,
            Self::Inside => 0.0,
        }
    }
}

/// The loss of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Losses {
    /// L1.
    L1,
    /// L1, D-SSIM and depth, as in training with depth.
    Training,
}

/// What is rendered and compared.
#[derive(Clone, Copy, Debug)]
pub struct KernelSetup {
    /// Size of the image, pixels.
    pub size_px: [u32; 2],
    /// Position of the camera.
    pub eye: Eye,
    /// The loss.
    pub losses: Losses,
}

/// Numbers of repetitions.
#[derive(Clone, Copy, Debug)]
pub struct Repeats {
    /// Minimum number of warm-up runs.
    pub n_warm_up: usize,
    /// Minimum duration of the warm-up. It ends earlier after 100 times `n_warm_up` runs.
    pub warm_up: Duration,
    /// Runs timed with timestamps.
    pub n_timed: usize,
    /// Consecutive runs timed with the wall clock.
    pub n_consecutive: usize,
}

/// Records passes to be timed.
type Recorded = fn(&KernelBench, &mut Passes) -> Result<(), Error>;

struct KernelBench {
    gpu: Arc<Gpu>,
    draw: DrawPipelines,
    train: TrainPipelines,
    splats: SplatBuffers,
    scratch: Scratch,
    image_buffers: ImageBuffers,
    status: Buffer,
    view: Buffer,
    image: Buffer,
    depth: Buffer,
    supervision: Buffer,
    gains: Buffer,
    rule: Buffer,
    rule_visible: Buffer,
    reader: RefCell<Reader>,
    size_px: [u32; 2],
    losses: Losses,
}

/// Times the kernels on `cloud`.
pub fn time_kernels(
    gpu: &Arc<Gpu>,
    cloud: &SplatArrays,
    setup: KernelSetup,
    repeats: Repeats,
) -> Result<KernelFigures, Error> {
    let mut bench = KernelBench::new(gpu.clone(), cloud, setup)?;
    bench.size_buffers()?;
    let mut passes = Passes::default();
    let mean_rgb = bench.mean_rgb(&mut passes)?;
    let (render_millis, render_wall_millis) =
        bench.time(&mut passes, repeats, KernelBench::record_picture)?;
    let (step_millis, step_wall_millis) =
        bench.time(&mut passes, repeats, KernelBench::record_step)?;
    // Timestamps around every pass slow down a step, so passes are timed in an additional step.
    bench.record_step(&mut passes)?;
    let mut timings = passes.submit_timed(gpu)?;
    let mut packed_millis = None;
    if !gpu.is_software() {
        packed_millis = Some(
            bench
                .time(&mut passes, repeats, KernelBench::record_packed_picture)?
                .0,
        );
        bench.record_packing(&mut passes)?;
        timings.extend(passes.submit_timed(gpu)?);
    }
    let peak_bytes = gpu.peak_bytes();
    let (step_visible_millis, _) =
        bench.time(&mut passes, repeats, KernelBench::record_step_visible)?;
    let n_splats_in_view = bench.n_splats_in_view()?;
    Ok(KernelFigures {
        work: WorkCounts::read(
            gpu,
            &bench.scratch,
            &bench.image_buffers,
            bench.splats.n_splats,
            setup.size_px,
        )?,
        render_millis,
        packed_millis,
        step_millis,
        step_visible_millis,
        n_splats_in_view,
        render_wall_millis,
        step_wall_millis,
        mean_rgb,
        peak_bytes,
        passes: timings,
    })
}

impl KernelBench {
    fn new(gpu: Arc<Gpu>, cloud: &SplatArrays, setup: KernelSetup) -> Result<Self, Error> {
        let KernelSetup {
            size_px,
            eye,
            losses,
        } = setup;
        let draw = DrawPipelines::new(&gpu)?;
        let train = TrainPipelines::new(&gpu)?;
        let n_splats = u32::try_from(cloud.n_splats())
            .map_err(|_| model_files::Error::SplatArrays("more than 2^32 splats".to_owned()))?;
        let mut splats = SplatBuffers::new(&gpu, n_splats, cloud.sh_degree)?;
        splats.append(&gpu, cloud);
        let n_pixels = size_px[0] * size_px[1];
        let camera = camera(size_px, eye);
        let noise: Vec<u32> = (0..n_pixels).map(noise_pixel).collect();
        let (depth_m, supervision) = match losses {
            Losses::L1 => (0.0, <Supervision as bytemuck::Zeroable>::zeroed()),
            Losses::Training => (
                DEPTH_M,
                Scarcity::of_images(N_IMAGES).supervision(&SplatOptions::default(), [0.0; 3]),
            ),
        };
        let tiles = n_tiles(size_px);
        let initial_size = ScratchSize {
            n_splats,
            n_entries: 1 << 14,
            n_slots: 1 << 14,
            n_bins: n_bins(size_px),
        };
        let mut counters = [0u32; status::LEN];
        counters[status::N_SPLATS as usize] = n_splats;
        Ok(Self {
            scratch: Scratch::new(&gpu, &draw, initial_size)?,
            image_buffers: ImageBuffers::new(&gpu, n_pixels, tiles, true)?,
            status: gpu.storage_with("bench.status", bytemuck::cast_slice(&counters))?,
            view: gpu.uniform_with("bench.view", &camera.view()),
            image: gpu.storage_with("bench.target", bytemuck::cast_slice(&noise))?,
            depth: gpu.storage_with(
                "bench.depth",
                bytemuck::cast_slice(&vec![depth_m; n_pixels as usize]),
            )?,
            supervision: gpu.uniform_with("bench.supervision", &supervision),
            gains: gpu.storage_with("bench.gains", bytemuck::cast_slice(&[1.0f32; 4]))?,
            rule: gpu.uniform_with("bench.rule", &rule()),
            // There are two rules, because rewriting a single rule would add an upload to the
            // timing.
            rule_visible: gpu.uniform_with(
                "bench.rule_touched",
                &Rule {
                    update_all: 0,
                    ..rule()
                },
            ),
            reader: RefCell::default(),
            draw,
            train,
            splats,
            size_px,
            losses,
            gpu,
        })
    }

    /// Measures the required size of the intersection buffers and allocates them.
    fn size_buffers(&mut self) -> Result<(), Error> {
        // The first pass measures the lists. The second pass verifies that they fit.
        for _ in 0..2 {
            let mut passes = Passes::default();
            self.view_passes().draw(&mut passes, &self.draw);
            passes.submit(&self.gpu);
            let counters = self.counters()?;
            let with_headroom = |need: u32| need + need / 16 + 64;
            let size = ScratchSize {
                n_splats: self.splats.n_splats,
                n_entries: with_headroom(counters[status::NEED_ENTRIES]),
                n_slots: with_headroom(counters[status::NEED_SLOTS]),
                n_bins: n_bins(self.size_px),
            };
            // A minimal buffer replaces the previous buffer before the larger buffer is allocated.
            // Otherwise, both would count toward the peak of memory.
            drop(passes);
            self.scratch = Scratch::new(
                &self.gpu,
                &self.draw,
                ScratchSize {
                    n_splats: 1,
                    n_entries: 1,
                    n_slots: 1,
                    n_bins: 1,
                },
            )?;
            self.scratch = Scratch::new(&self.gpu, &self.draw, size)?;
            self.gpu
                .write(&self.status, 4 * status::FAILED as u64, &[0; 12]);
        }
        Ok(())
    }

    fn view_passes(&self) -> ViewPasses<'_> {
        ViewPasses {
            gpu: &self.gpu,
            splats: &self.splats,
            scratch: &self.scratch,
            image_buffers: &self.image_buffers,
            status: &self.status,
            view: &self.view,
            size_px: self.size_px,
            clipping: None,
        }
    }

    fn record_picture(&self, passes: &mut Passes) -> Result<(), Error> {
        self.view_passes().draw(passes, &self.draw);
        Ok(())
    }

    fn record_packed_picture(&self, passes: &mut Passes) -> Result<(), Error> {
        self.record_picture(passes)?;
        self.record_packing(passes)
    }

    /// Records the passes that convert and pack a picture.
    fn record_packing(&self, passes: &mut Passes) -> Result<(), Error> {
        self.view_passes()
            .finish(passes, &self.draw, &self.supervision);
        let ImageBuffers { pixels, depths, .. } = &self.image_buffers;
        let packing = Packing {
            jpeg_quality: Some(JPEG_QUALITY),
            depth: true,
        };
        let mut reader = self.reader.borrow_mut();
        let output = reader.available(&self.gpu, passes, Output::packed(packing), self.size_px)?;
        reader
            .record(&self.gpu, passes, output, self.size_px, [pixels, depths])
            .map(drop)
    }

    fn record_step(&self, passes: &mut Passes) -> Result<(), Error> {
        let view = self.record_gradients(passes);
        view.backward(passes, &self.train);
        view.update(passes, &self.train.update, &self.rule, false);
        self.record_end(passes);
        Ok(())
    }

    fn record_step_visible(&self, passes: &mut Passes) -> Result<(), Error> {
        let view = self.record_gradients(passes);
        view.backward(passes, &self.train);
        view.update(passes, &self.train.update, &self.rule_visible, false);
        self.record_end(passes);
        Ok(())
    }

    /// Records the passes that draw the picture and compare it with the target.
    fn record_gradients(&self, passes: &mut Passes) -> ViewPasses<'_> {
        let view = self.view_passes();
        view.draw_for_backward(passes, &self.draw, &self.train);
        view.compare(
            passes,
            &self.train,
            &Target {
                image: &self.image,
                depth: &self.depth,
                supervision: &self.supervision,
                gains: &self.gains,
                ssim: self.losses == Losses::Training,
            },
        );
        view
    }

    fn record_end(&self, passes: &mut Passes) {
        passes.dispatch(
            &self.gpu,
            &self.train.advance,
            1,
            &[("status", &self.status)],
        );
    }

    fn n_splats_in_view(&self) -> Result<u64, Error> {
        let tile_counts: Vec<u32> = self
            .gpu
            .read(&self.scratch.tile_counts, self.splats.n_splats as usize)?;
        Ok(tile_counts.iter().filter(|n_tiles| **n_tiles > 0).count() as u64)
    }

    fn time(
        &self,
        passes: &mut Passes,
        repeats: Repeats,
        record: Recorded,
    ) -> Result<(f64, f64), Error> {
        // The warm-up is needed, because some GPUs stay busy for tenths of a second after large
        // buffers are freed.
        let warming = Instant::now();
        let mut n_warm = 0;
        while n_warm < repeats.n_warm_up
            || (warming.elapsed() < repeats.warm_up && n_warm < 100 * repeats.n_warm_up)
        {
            record(self, passes)?;
            passes.submit(&self.gpu);
            self.gpu.wait()?;
            n_warm += 1;
        }
        // The runs follow each other without a pause, so the time includes recording on the CPU.
        let since = Instant::now();
        for _ in 0..repeats.n_consecutive {
            record(self, passes)?;
            passes.submit(&self.gpu);
        }
        self.gpu.wait()?;
        let consecutive_millis = since.elapsed().as_secs_f64() * 1e3 / repeats.n_consecutive as f64;
        // These runs are timed one by one, with timestamps on the GPU. The median ignores runs that
        // other work delayed.
        let mut spans = Vec::new();
        for _ in 0..repeats.n_timed {
            record(self, passes)?;
            let since = Instant::now();
            let span = passes.submit_timed_total(&self.gpu)?;
            spans.push(span.unwrap_or_else(|| since.elapsed().as_secs_f64() * 1e3));
        }
        let median = quantile(&mut spans, 0.5, Rank::Upper).unwrap_or(f64::NAN);
        Ok((median, consecutive_millis))
    }

    fn counters(&self) -> Result<Vec<u32>, Error> {
        Ok(self.gpu.read(&self.status, status::LEN)?)
    }

    fn mean_rgb(&self, passes: &mut Passes) -> Result<[f64; 3], Error> {
        self.record_picture(passes)?;
        passes.submit(&self.gpu);
        let n = (self.size_px[0] * self.size_px[1]) as usize;
        let image: Vec<[f32; 4]> = self.gpu.read(&self.image_buffers.image, n)?;
        Ok(std::array::from_fn(|channel| {
            image
                .iter()
                .map(|pixel| f64::from(pixel[channel]))
                .sum::<f64>()
                / n as f64
        }))
    }
}

/// The camera of the peer's benchmark.
fn camera(size_px: [u32; 2], eye: Eye) -> Camera {
    Camera {
        world_from_camera: Transform::translation(0.0, 0.0, eye.z_m()),
        size_px,
        focal_px: [0.9 * f64::from(size_px[0]); 2],
        principal_px: size_px.map(|size| f64::from(size) / 2.0),
        shutter: None,
        near_m: 0.01,
        far_m: 1e6,
        crop: None,
        edits: Arc::default(),
        low_pass_px2: LOW_PASS_PX2,
    }
}

/// Opaque color of a pixel of noise, which is a hash of its index.
fn noise_pixel(pixel: u32) -> u32 {
    pixel
        .wrapping_mul(2_654_435_761)
        .rotate_left(11)
        .wrapping_mul(0x85eb_ca6b)
        | 0xff00_0000
}

fn rule() -> Rule {
    Rule {
        mean_rate_m: RATE,
        log_scale_rate: RATE,
        rotation_rate: RATE,
        opacity_rate: RATE,
        sh_dc_rate: RATE,
        sh_rest_rate: RATE,
        noise: 0.0,
        final_mean_rate_frac: 1.0,
        betas: [0.9, 0.999],
        epsilon: f32_of(1e-15),
        n_planned_steps: 1.0,
        opacity_cost: 0.0,
        scale_cost: 0.0,
        log_scale_range: [-30.0, 30.0],
        seed: 0,
        update_all: 1,
        schedule_start: 0.0,
        noise_center: MIN_OPACITY,
    }
}
