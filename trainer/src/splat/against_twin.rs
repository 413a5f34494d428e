//! Tests of the kernels against their f64 twin: pictures, gradients and invalid input.
#![expect(
    clippy::needless_range_loop,
    reason = "channels and axes index several arrays at once"
)]

use super::buffers::{ImageBuffers, Scratch, ScratchSize, SplatBuffers, n_bins, n_tiles};
use super::camera_params::CameraParams;
use super::kernels::{DrawPipelines, TrainPipelines};
use super::params::{Camera, LOW_PASS_PX2, Rule, Supervision, status};
use super::passes::{Target, ViewPasses};
use super::reference::random::uniform3;
use super::reference::{self, RenderedImage, Splat, Upstream, View, scene};
use crate::loss::reference as loss_reference;
use crate::mismatches::Mismatches;
use calibration::ParamSet;
use gpu::testing::test_gpu_with;
use gpu::{Buffer, Gpu, GpuOptions, Passes};
use keyframe::{Keyframe, Shutter, Split};
use kinematics::{Stamp, Transform, Twist};
use model_files::splat::arrays::SplatArrays;
use nalgebra::Vector3;
use numbers::f32_of;
use std::sync::Arc;

/// Colors are near 1, and f32 has 24 bits of precision. Sums of a few dozen terms and `exp` lose a
/// few of these bits.
const COLOR_ABS: f64 = 2e-5;
/// Gradients are f32 sums over hundreds of pixels.
const GRADIENT_REL: f64 = 2e-3;
/// Within this relative distance of a threshold, f32 and f64 may decide differently.
pub(super) const MARGIN: f64 = 1e-4;

pub(super) struct KernelFixture {
    pub(super) gpu: Arc<Gpu>,
    pub(super) draw: DrawPipelines,
    pub(super) train: TrainPipelines,
    pub(super) splats: SplatBuffers,
    pub(super) scratch: Scratch,
    pub(super) image_buffers: ImageBuffers,
    pub(super) status: Buffer,
    pub(super) view: Buffer,
    pub(super) size_px: [u32; 2],
}

pub(super) fn arrays_of(splats: &[Splat]) -> SplatArrays {
    let f = |values: [f64; 3]| values.map(f32_of);
    SplatArrays {
        means: splats.iter().map(|splat| f(splat.mean)).collect(),
        log_scales: splats.iter().map(|splat| f(splat.log_scale)).collect(),
        rotations_wxyz: splats
            .iter()
            .map(|splat| splat.rotation_wxyz.map(f32_of))
            .collect(),
        opacity_logits: splats
            .iter()
            .map(|splat| f32_of(splat.opacity_logit))
            .collect(),
        sh: splats
            .iter()
            .flat_map(|splat| (0..16).map(|ix| splat.sh.get(ix).map_or([0.0; 3], |rgb| f(*rgb))))
            .collect(),
        sh_degree: 3,
        is_antialiased: false,
    }
}

pub(super) fn camera_of(view: &View) -> Camera {
    let twist = Twist {
        linear_m_s: Vector3::from(view.linear_m),
        angular_rad_s: Vector3::from(view.angular_rad),
    };
    Camera {
        world_from_camera: view.camera_from_world.inverse(),
        size_px: view.size_px,
        focal_px: view.focal_px,
        principal_px: view.principal_px,
        shutter: Some(Shutter {
            twist,
            readout_secs: 1.0,
        }),
        near_m: view.near_m,
        far_m: 1e6,
        crop: None,
        edits: Arc::default(),
        low_pass_px2: LOW_PASS_PX2,
    }
}

impl KernelFixture {
    pub(super) fn new(options: &GpuOptions, view: &View, arrays: &SplatArrays) -> Self {
        let gpu = test_gpu_with(options);
        let draw = DrawPipelines::new(&gpu).unwrap();
        let train = TrainPipelines::new(&gpu).unwrap();
        let n_splats = u32::try_from(arrays.means.len()).unwrap();
        let mut splats = SplatBuffers::new(&gpu, n_splats, 3).unwrap();
        splats.append(&gpu, arrays);
        let tiles = n_tiles(view.size_px);
        let scratch = Scratch::new(
            &gpu,
            &draw,
            ScratchSize {
                n_splats,
                n_entries: 1 << 15,
                n_slots: 1 << 17,
                n_bins: n_bins(view.size_px),
            },
        )
        .unwrap();
        let image_buffers =
            ImageBuffers::new(&gpu, view.size_px[0] * view.size_px[1], tiles, true).unwrap();
        let mut counters = [0u32; status::LEN];
        counters[status::N_SPLATS as usize] = n_splats;
        let status = gpu
            .storage_with("status", bytemuck::cast_slice(&counters))
            .unwrap();
        let view_buffer = gpu.uniform_with("view", &camera_of(view).view());
        Self {
            draw,
            train,
            splats,
            scratch,
            image_buffers,
            status,
            view: view_buffer,
            size_px: view.size_px,
            gpu,
        }
    }

    pub(super) fn passes(&self) -> ViewPasses<'_> {
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

    /// Sets one counter of the status.
    fn write_counter(&self, counter: usize, value: u32) {
        self.gpu
            .write(&self.status, 4 * counter as u64, &value.to_le_bytes());
    }

    pub(super) fn render(&self) -> (Vec<[f32; 4]>, Vec<f32>) {
        self.render_passes(&self.passes(), Passes::default())
    }

    /// Renders with these passes for the view, recorded after `passes`.
    pub(super) fn render_passes(
        &self,
        view_passes: &ViewPasses<'_>,
        mut passes: Passes,
    ) -> (Vec<[f32; 4]>, Vec<f32>) {
        view_passes.draw(&mut passes, &self.draw);
        passes.submit(&self.gpu);
        let n = (self.size_px[0] * self.size_px[1]) as usize;
        (
            self.gpu.read(&self.image_buffers.image, n).unwrap(),
            self.gpu.read(&self.image_buffers.depth, n).unwrap(),
        )
    }
}

/// Options for both kernel variants: with and without the adapter's optional features.
pub(super) fn adapter_options() -> [GpuOptions; 2] {
    [
        GpuOptions::default(),
        GpuOptions {
            optional_features: false,
            ..GpuOptions::default()
        },
    ]
}

pub(super) fn unambiguous_pixels(view: &View, splats: &[Splat]) -> Vec<bool> {
    let margins = reference::rasterize::threshold_margins(view, splats);
    are_unambiguous(margins.iter().map(|margin| *margin > MARGIN))
}

/// Collects which pixels are unambiguous. Asserts that almost all pixels are unambiguous.
pub(super) fn are_unambiguous(pixels: impl Iterator<Item = bool>) -> Vec<bool> {
    let unambiguous: Vec<bool> = pixels.collect();
    assert!(
        unambiguous
            .iter()
            .filter(|unambiguous| **unambiguous)
            .count()
            * 10
            > unambiguous.len() * 9,
        "too many pixels of the scene are close to a threshold"
    );
    unambiguous
}

fn check_pictures(options: &GpuOptions) {
    for (view, seed) in [(scene::tilted_view(), 1), (scene::rolling_view(), 2)] {
        let mut splats = scene::small_scene(seed, 40);
        check_picture(
            &KernelFixture::new(options, &view, &arrays_of(&splats)),
            &view,
            &splats,
        );
        // Some splats are thinner than the low-pass.
        splats
            .iter_mut()
            .step_by(2)
            .for_each(|splat| splat.log_scale = splat.log_scale.map(|log_scale| log_scale - 2.0));
        let view = View {
            is_antialiased: true,
            ..view
        };
        let arrays = SplatArrays {
            is_antialiased: true,
            ..arrays_of(&splats)
        };
        let plain = reference::render(
            &View {
                is_antialiased: false,
                ..view.clone()
            },
            &splats,
        );
        assert_ne!(
            reference::render(&view, &splats),
            plain,
            "the correction has an effect"
        );
        check_picture(&KernelFixture::new(options, &view, &arrays), &view, &splats);
    }
}

#[test]
fn pictures_match_the_twin() {
    check_pictures(&GpuOptions::default());
}

/// A step renders the splats that it does not leave out, with higher opacities.
#[test]
fn pictures_with_dropped_splats_match_the_twin() {
    const DROP_FRAC: f32 = 0.25;
    const SEED: u32 = 7;
    let view = scene::tilted_view();
    let mut splats = scene::small_scene(1, 40);
    // Opacities are at most 0.62, so that the raised opacity stays below 1.
    splats
        .iter_mut()
        .for_each(|splat| splat.opacity_logit = splat.opacity_logit.min(0.5));
    let fixture = KernelFixture::new(&GpuOptions::default(), &view, &arrays_of(&splats));
    fixture.write_counter(status::DROP_FRAC, DROP_FRAC.to_bits());
    fixture.write_counter(status::DROP_SEED, SEED);
    let [at_0, at_1] = [0, 1].map(|step| kept_splats(40, step, SEED, DROP_FRAC));
    assert!((20..40).contains(&at_0.len()) && at_0 != at_1, "{at_0:?}");
    for step in [0, 1] {
        fixture.write_counter(status::STEP, step);
        let rendered: Vec<Splat> = kept_splats(40, step, SEED, DROP_FRAC)
            .into_iter()
            .map(|splat_ix| more_opaque(&splats[splat_ix as usize], DROP_FRAC))
            .collect();
        check_picture(&fixture, &view, &rendered);
    }
}

/// Indices of the first `n` splats that a step does not leave out.
fn kept_splats(n: u32, step: u32, seed: u32, drop_frac: f32) -> Vec<u32> {
    (0..n)
        .filter(|splat_ix| uniform3([*splat_ix, step, seed])[0] >= drop_frac.into())
        .collect()
}

/// The splat with the opacity that makes up for dropped splats.
fn more_opaque(splat: &Splat, drop_frac: f32) -> Splat {
    let mut splat = splat.clone();
    let opacity = 1.0 / (1.0 + (-splat.opacity_logit).exp()) / (1.0 - f64::from(drop_frac));
    splat.opacity_logit = (opacity / (1.0 - opacity)).ln();
    splat
}

/// Compares the fixture's picture with the picture of the twin.
fn check_picture(fixture: &KernelFixture, view: &View, splats: &[Splat]) {
    check_image(
        &fixture.render(),
        &reference::render(view, splats),
        &unambiguous_pixels(view, splats),
    );
}

/// Compares a color image with transmittance, and a depth image, with the images of the twin.
pub(super) fn check_image(
    (image, depth): &(Vec<[f32; 4]>, Vec<f32>),
    expected: &RenderedImage,
    unambiguous: &[bool],
) {
    let mut mismatches = Mismatches::default();
    for pixel in (0..image.len()).filter(|pixel| unambiguous[*pixel]) {
        for channel in 0..3 {
            mismatches.check(
                format!("pixel {pixel} channel {channel}"),
                image[pixel][channel].into(),
                expected.rgb[pixel][channel],
                COLOR_ABS,
                0.0,
            );
        }
        mismatches.check(
            format!("transmittance {pixel}"),
            image[pixel][3].into(),
            expected.transmittance[pixel],
            COLOR_ABS,
            0.0,
        );
        mismatches.check(
            format!("depth {pixel}"),
            depth[pixel].into(),
            expected.depth[pixel],
            10.0 * COLOR_ABS,
            0.0,
        );
    }
    mismatches.assert_none();
}

pub(super) fn target_of(image: &RenderedImage, size_px: [u32; 2]) -> loss_reference::Target {
    let n = image.rgb.len();
    // The target differs so much from the picture that rounding cannot change the sign of any
    // absolute difference.
    let byte = |value: f64| ((value + 0.25).rem_euclid(1.0) * 255.0).round() / 255.0;
    loss_reference::Target {
        size_px: size_px.map(|size| size as usize),
        rgb: image.rgb.iter().map(|rgb| rgb.map(byte)).collect(),
        visible: (0..n).map(|pixel| pixel % 37 != 0).collect(),
        depth_m: (0..n)
            .map(|pixel| {
                if pixel % 3 == 0 {
                    0.0
                } else {
                    1.5 + 0.01 * (pixel % 50) as f64
                }
            })
            .collect(),
    }
}

fn check_short_lists(variants: &[GpuOptions]) {
    for (view, seed) in [(scene::tilted_view(), 3), (scene::rolling_view(), 4)] {
        check_gradients_with_loss(&view, &scene::small_scene(seed, 40), variants);
    }
}

/// Checks lists of several segments. Their splats touch more tiles than one lane of `update` sums.
fn check_long_lists(variants: &[GpuOptions]) {
    let (view, splats) = long_lists(400, 2.5, -4.4);
    check_gradients_with_loss(&view, &splats, variants);
}

/// Pixels that end in different segments of the same list.
fn check_ends_in_long_lists(variants: &[GpuOptions]) {
    let (view, splats) = long_lists(1000, 0.5, -3.7);
    let mut n_contributors: Vec<usize> = reference::decide(&view, &splats)
        .contributors
        .iter()
        .map(Vec::len)
        .collect();
    n_contributors.sort_unstable();
    let n_pixels = n_contributors.len();
    let [low, high] = [
        n_contributors[n_pixels / 10],
        n_contributors[n_pixels * 9 / 10],
    ];
    assert!(
        low > 256 && high > low + 100 && high < 900,
        "{low} to {high} splats per pixel"
    );
    check_gradients_with_loss(&view, &splats, variants);
}

/// Splats with about the given logarithm of their size in meters and logit of their opacity.
fn long_lists(n: usize, log_scale: f64, opacity_logit: f64) -> (View, Vec<Splat>) {
    let view = scene::tilted_view();
    let view = View {
        focal_px: view.focal_px.map(|focal_px| 4.0 * focal_px),
        principal_px: view.principal_px.map(|principal_px| 4.0 * principal_px),
        size_px: view.size_px.map(|size_px| 4 * size_px),
        ..view
    };
    let world_from_camera = view.camera_from_world.inverse();
    let mut splats = scene::small_scene(5, n);
    for (ix, splat) in splats.iter_mut().enumerate() {
        // The depths differ, and their order differs from the order of the indices.
        let z = 1.5 + 0.0025 * (ix * 149 % n) as f64;
        splat.mean = (world_from_camera * nalgebra::Point3::new(splat.mean[0], splat.mean[1], z))
            .coords
            .into();
        splat.log_scale = splat.log_scale.map(|variation| log_scale + 0.5 * variation);
        splat.opacity_logit = opacity_logit + 0.1 * splat.opacity_logit;
    }
    (view, splats)
}

/// Compares the gradients of a loss with color, D-SSIM and depth, for kernel variants.
fn check_gradients_with_loss(view: &View, splats: &[Splat], variants: &[GpuOptions]) {
    let rendered = reference::render(view, splats);
    let unambiguous = unambiguous_pixels(view, splats);
    let mut target = target_of(&rendered, view.size_px);
    // At other pixels, f32 may draw another set of splats, whose gradients differ completely.
    for (visible, unambiguous) in target.visible.iter_mut().zip(&unambiguous) {
        *visible &= unambiguous;
    }
    for (depth_m, unambiguous) in target.depth_m.iter_mut().zip(&unambiguous) {
        *depth_m = if *unambiguous {
            f64::from(f32_of(*depth_m))
        } else {
            0.0
        };
    }
    let weights = loss_reference::Weights {
        dssim_frac: 0.25,
        depth_per_m: 0.5,
        depth_clip_m: 50.0,
        background_rgb: [0.125, 0.25, 0.5],
    };
    let (_, upstream) = loss_reference::loss(&rendered, &target, &weights);
    for options in variants {
        check_gradients(options, view, splats, &target, &weights, &upstream);
    }
}

/// The target image and depth on the GPU, with the weights of the loss.
pub(super) struct TargetBuffers {
    image: Buffer,
    depth: Buffer,
    supervision: Buffer,
    gains: Buffer,
}

impl TargetBuffers {
    pub(super) fn new(
        gpu: &Gpu,
        target: &loss_reference::Target,
        weights: &loss_reference::Weights,
    ) -> Self {
        let byte = |value: f64| u32::from(format!("{:.0}", value * 255.0).parse::<u8>().unwrap());
        let packed: Vec<u32> = target
            .rgb
            .iter()
            .zip(&target.visible)
            .map(|(rgb, visible)| {
                byte(rgb[0])
                    | byte(rgb[1]) << 8
                    | byte(rgb[2]) << 16
                    | if *visible { 0xff00_0000 } else { 0 }
            })
            .collect();
        let depth: Vec<f32> = target
            .depth_m
            .iter()
            .map(|depth_m| f32_of(*depth_m))
            .collect();
        let image = gpu
            .storage_with("target", bytemuck::cast_slice(&packed))
            .unwrap();
        let depth = gpu
            .storage_with("target depth", bytemuck::cast_slice(&depth))
            .unwrap();
        let supervision = Supervision {
            background_srgb: [0, 1, 2, 0].map(|channel| f32_of(weights.background_rgb[channel])),
            dssim_frac: f32_of(weights.dssim_frac),
            depth_weight: f32_of(weights.depth_per_m),
            depth_clip_m: f32_of(weights.depth_clip_m),
            random_background: 0.0,
        };
        let gains = gpu
            .storage_with("gains", bytemuck::cast_slice(&[1.0f32; 4]))
            .unwrap();
        Self {
            image,
            depth,
            supervision: gpu.uniform_with("supervision", &supervision),
            gains,
        }
    }

    pub(super) fn target(&self) -> Target<'_> {
        Target {
            image: &self.image,
            depth: &self.depth,
            supervision: &self.supervision,
            gains: &self.gains,
            ssim: true,
        }
    }
}

fn check_gradients(
    options: &GpuOptions,
    view: &View,
    splats: &[Splat],
    target: &loss_reference::Target,
    weights: &loss_reference::Weights,
    upstream: &Upstream,
) {
    let expected = reference::render_backward(view, splats, upstream);
    let fixture = KernelFixture::new(options, view, &arrays_of(splats));
    let gpu = &fixture.gpu;
    let target_buffers = TargetBuffers::new(gpu, target, weights);
    // A variant of `update` stores the gradients in place of the values, so no rule is needed.
    let rule = gpu.uniform_with("rule", &<Rule as bytemuck::Zeroable>::zeroed());
    let gradients_only = TrainPipelines::gradients_only(gpu).unwrap();
    let mut passes = Passes::default();
    let view_passes = fixture.passes();
    view_passes.draw_for_backward(&mut passes, &fixture.draw, &fixture.train);
    view_passes.compare(&mut passes, &fixture.train, &target_buffers.target());
    view_passes.backward(&mut passes, &fixture.train);
    view_passes.update(&mut passes, &gradients_only, &rule, true);
    let all = ParamSet::EXTRINSICS
        | ParamSet::TIME_OFFSET
        | ParamSet::LENS
        | ParamSet::IMAGE_POSES
        | ParamSet::IMAGE_GAINS;
    let mut cameras = CameraParams::new(gpu, all).unwrap();
    let lens = cameras.lens(gpu, &moving_keyframe()).unwrap();
    let refine = TrainPipelines::camera_gradients_only(gpu).unwrap();
    cameras.refine_with(&view_passes, &mut passes, &refine, &lens);
    passes.submit(gpu);
    check_camera_gradients(
        &cameras.param_values(gpu),
        view,
        splats,
        &expected.view,
        upstream,
        weights.background_rgb,
    );
    // The loss is compared first, because an error in it would appear in all gradients.
    let n = target.rgb.len();
    let param_values: Vec<[f32; 4]> = gpu.read(&fixture.image_buffers.upstream, n).unwrap();
    let mut mismatches = Mismatches::default();
    let largest = upstream
        .rgb
        .iter()
        .flatten()
        .fold(0.0f64, |max, value| max.max(value.abs()));
    for (pixel, gradient) in param_values.iter().enumerate() {
        for channel in 0..3 {
            mismatches.check(
                format!("upstream {pixel} {channel}"),
                gradient[channel].into(),
                upstream.rgb[pixel][channel],
                1e-3 * largest,
                1e-3,
            );
        }
        mismatches.check(
            format!("upstream depth {pixel}"),
            gradient[3].into(),
            upstream.depth[pixel],
            1e-9,
            1e-5,
        );
    }
    mismatches.assert_none();

    check_splat_gradients(&fixture.splats.read(gpu).unwrap(), &expected.splats);
}

/// Largest magnitude of some values of all splats.
fn largest(splats: &[Splat], of: fn(&Splat) -> Vec<f64>) -> f64 {
    splats
        .iter()
        .flat_map(of)
        .fold(1e-12f64, |max, value| max.max(value.abs()))
}

/// Compares the gradients of all splats, relative to the largest gradient of the same kind, because
/// small gradients are differences of large sums.
fn check_splat_gradients(got: &SplatArrays, expected: &[Splat]) {
    let mut mismatches = Mismatches::default();
    let mean = largest(expected, |splat| splat.mean.to_vec());
    let scale = largest(expected, |splat| splat.log_scale.to_vec());
    let rotation = largest(expected, |splat| splat.rotation_wxyz.to_vec());
    let opacity = largest(expected, |splat| vec![splat.opacity_logit]);
    let sh = largest(expected, |splat| splat.sh.as_flattened().to_vec());
    for (ix, splat) in expected.iter().enumerate() {
        for axis in 0..3 {
            mismatches.check(
                format!("mean {ix} {axis}"),
                got.means[ix][axis].into(),
                splat.mean[axis],
                GRADIENT_REL * mean,
                GRADIENT_REL,
            );
            mismatches.check(
                format!("log_scale {ix} {axis}"),
                got.log_scales[ix][axis].into(),
                splat.log_scale[axis],
                GRADIENT_REL * scale,
                GRADIENT_REL,
            );
        }
        for part in 0..4 {
            mismatches.check(
                format!("rotation {ix} {part}"),
                got.rotations_wxyz[ix][part].into(),
                splat.rotation_wxyz[part],
                GRADIENT_REL * rotation,
                GRADIENT_REL,
            );
        }
        mismatches.check(
            format!("opacity {ix}"),
            got.opacity_logits[ix].into(),
            splat.opacity_logit,
            GRADIENT_REL * opacity,
            GRADIENT_REL,
        );
        for (coeff, rgb) in splat.sh.iter().enumerate() {
            for channel in 0..3 {
                let gpu = got.sh[16 * ix + coeff][channel].into();
                mismatches.check(
                    format!("sh {ix} {coeff} {channel}"),
                    gpu,
                    rgb[channel],
                    GRADIENT_REL * sh,
                    GRADIENT_REL,
                );
            }
        }
    }
    mismatches.assert_none();
}

fn moving_keyframe() -> Keyframe {
    Keyframe {
        camera: "test".into(),
        stamp: Stamp(0),
        size_px: [1, 1],
        focal_px: [1.0; 2],
        principal_px: [0.5; 2],
        rgba_srgb: [0; 4].into(),
        depth: None,
        world_from_camera: Transform::identity(),
        twist: Some(Twist {
            linear_m_s: Vector3::new(0.25, -0.5, 0.125),
            angular_rad_s: Vector3::new(-0.5, 0.75, 1.0),
        }),
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: None,
        split: Split::Train,
        truth: None,
        robot: None,
    }
}

/// Checks pose gradients against the twin, and lens gradients against central differences of the
/// twin's picture.
fn check_camera_gradients(
    got: &[f64],
    view: &View,
    splats: &[Splat],
    by_view: &reference::ViewGrad,
    upstream: &Upstream,
    background_rgb: [f64; 3],
) {
    const STEP: f64 = 1e-5;
    // Decisions stay fixed, because the differences would jump if a splat appeared or vanished.
    let decisions = reference::decide(view, splats);
    let loss_of =
        |changed: &View| upstream.dot(&reference::render_decided(changed, splats, &decisions));
    let along = |change: &dyn Fn(&mut View, f64)| {
        let mut high = view.clone();
        let mut low = view.clone();
        change(&mut high, STEP);
        change(&mut low, -STEP);
        (loss_of(&high) - loss_of(&low)) / (2.0 * STEP)
    };
    let [x, y, z, rotation_x, rotation_y, rotation_z] = by_view.pose;
    let twist = moving_keyframe().twist.unwrap();
    let translation = Vector3::new(x, y, z);
    let rotation = Vector3::new(rotation_x, rotation_y, rotation_z);
    let mut expected = vec![rotation_x, rotation_y, rotation_z, x, y, z];
    // The pose lags behind the image by the time offset, so the camera moves back along its twist.
    expected.push(-twist.angular_rad_s.dot(&rotation) - twist.linear_m_s.dot(&translation));
    for axis in 0..2 {
        expected.push(along(&|view, step| view.focal_px[axis] *= step.exp()));
    }
    for axis in 0..2 {
        expected.push(along(&|view, step| {
            view.principal_px[axis] += step * view.focal_px[axis]
        }));
    }
    let image = reference::render_decided(view, splats, &decisions);
    // A gain multiplies the picture including its background. The derivative with respect to the
    // logarithm of the gain, at 0, is therefore the picture itself.
    for channel in 0..3 {
        let picture = |pixel: usize| {
            image.rgb[pixel][channel] + image.transmittance[pixel] * background_rgb[channel]
        };
        expected.push(
            (0..image.rgb.len())
                .map(|pixel| upstream.rgb[pixel][channel] * picture(pixel))
                .sum(),
        );
    }
    // Parameters of one group have the same unit, and their gradients about the same magnitude.
    let mut mismatches = Mismatches::default();
    for group in [0..3, 3..6, 6..7, 7..9, 9..11, 11..14] {
        let largest = expected[group.clone()]
            .iter()
            .fold(1e-12f64, |max, value| max.max(value.abs()));
        for param in group {
            mismatches.check(
                format!("camera {param}"),
                got[param],
                expected[param],
                GRADIENT_REL * largest,
                GRADIENT_REL,
            );
        }
    }
    mismatches.assert_none();
}

/// The first few splats in a stack of opaque splats saturate every tile. The splats behind them
/// must get no gradient, even if their slots contain gradients of an earlier step.
fn check_hidden_splats(variants: &[GpuOptions]) {
    const N_VISIBLE: usize = 8;
    let view = scene::tilted_view();
    let world_from_camera = view.camera_from_world.inverse();
    let size = view.size_px.map(|size| f64::from(size) / 2.0);
    let mut stack = vec![scene::small_scene(6, 1)[0].clone(); 600];
    for (ix, splat) in stack.iter_mut().enumerate() {
        let z = 2.0 + 0.001 * ix as f64;
        let on_axis =
            [0, 1].map(|axis| (size[axis] - view.principal_px[axis]) / view.focal_px[axis] * z);
        splat.mean = (world_from_camera * nalgebra::Point3::new(on_axis[0], on_axis[1], z))
            .coords
            .into();
        splat.log_scale = [3.0; 3]; // Far larger than the image.
        splat.opacity_logit = 8.0;
    }
    for options in variants {
        let fixture = KernelFixture::new(options, &view, &arrays_of(&stack));
        let gpu = &fixture.gpu;
        let n_pixels = (view.size_px[0] * view.size_px[1]) as usize;
        // The slots contain gradients of an earlier step, and every pixel has a gradient.
        gpu.write(
            &fixture.scratch.gradients,
            0,
            bytemuck::cast_slice(&vec![1.0f32; 12 << 14]),
        );
        gpu.write(
            &fixture.image_buffers.upstream,
            0,
            bytemuck::cast_slice(&vec![1.0f32; 4 * n_pixels]),
        );
        gpu.write(
            &fixture.image_buffers.pixel_totals,
            0,
            bytemuck::cast_slice(&vec![1.0f32; 2 * n_pixels]),
        );
        let rule = gpu.uniform_with("rule", &<Rule as bytemuck::Zeroable>::zeroed());
        let gradients_only = TrainPipelines::gradients_only(gpu).unwrap();
        let mut passes = Passes::default();
        let view_passes = fixture.passes();
        view_passes.draw_for_backward(&mut passes, &fixture.draw, &fixture.train);
        view_passes.backward(&mut passes, &fixture.train);
        view_passes.update(&mut passes, &gradients_only, &rule, true);
        passes.submit(gpu);
        let got = fixture.splats.read(gpu).unwrap();
        let has_gradient = |ix: usize| got.sh[16 * ix].iter().any(|value| *value != 0.0);
        assert!(has_gradient(0), "the front splat is visible");
        let hidden: Vec<usize> = (N_VISIBLE..stack.len())
            .filter(|ix| has_gradient(*ix))
            .collect();
        assert!(
            hidden.is_empty(),
            "hidden splats have gradients: {hidden:?}"
        );
    }
}

#[test]
fn invalid_splats_are_not_drawn() {
    let view = scene::tilted_view();
    let splats = scene::small_scene(5, 30);
    let mut invalid_splats = splats.clone();
    let corrupt: [fn(&mut Splat); 6] = [
        |splat| splat.mean[0] = f64::NAN,
        |splat| splat.mean[2] = f64::INFINITY,
        |splat| splat.rotation_wxyz = [0.0; 4],
        |splat| splat.log_scale[1] = f64::NAN,
        |splat| splat.log_scale = [80.0; 3],
        |splat| splat.opacity_logit = f64::NAN,
    ];
    for corrupt in corrupt {
        let mut splat = splats[0].clone();
        corrupt(&mut splat);
        invalid_splats.push(splat);
    }
    // Its projection divides by zero.
    let mut on_camera_plane = splats[1].clone();
    on_camera_plane.mean = view.camera_from_world.inverse().translation.vector.into();
    invalid_splats.push(on_camera_plane);
    let (image, depth) =
        KernelFixture::new(&GpuOptions::default(), &view, &arrays_of(&invalid_splats)).render();
    assert!(
        image
            .as_flattened()
            .iter()
            .chain(&depth)
            .all(|value| value.is_finite())
    );
}

/// Camera parameters of zero do not change the view. Adam's first step changes each enabled
/// parameter by its learning rate, and no other parameter.
#[test]
fn camera_params_start_at_zero_and_step_by_their_rate() {
    let view = scene::tilted_view();
    let splats = scene::small_scene(5, 30);
    for options in adapter_options() {
        let fixture = KernelFixture::new(&options, &view, &arrays_of(&splats));
        let gpu = &fixture.gpu;
        let set = ParamSet::LENS | ParamSet::IMAGE_GAINS;
        let mut cameras = CameraParams::new(gpu, set).unwrap();
        let lens = cameras.lens(gpu, &moving_keyframe()).unwrap();
        // The scene has a size of 1 m. At the start of training, all rates have their initial
        // values.
        cameras.write_rule(gpu, 0.0, 1.0);
        let target = target_of(&reference::render(&view, &splats), view.size_px);
        let weights = loss_reference::Weights {
            dssim_frac: 0.0,
            depth_per_m: 0.0,
            depth_clip_m: 1.0,
            background_rgb: [0.125, 0.25, 0.5],
        };
        let target_buffers = TargetBuffers::new(gpu, &target, &weights);
        let rule = gpu.uniform_with("rule", &<Rule as bytemuck::Zeroable>::zeroed());
        let mut passes = Passes::default();
        cameras.correct(gpu, &mut passes, &fixture.train, &fixture.view, &lens);
        let view_passes = ViewPasses {
            view: &cameras.corrected,
            ..fixture.passes()
        };
        view_passes.draw_for_backward(&mut passes, &fixture.draw, &fixture.train);
        view_passes.compare(
            &mut passes,
            &fixture.train,
            &Target {
                gains: &cameras.gains,
                ..target_buffers.target()
            },
        );
        view_passes.backward(&mut passes, &fixture.train);
        view_passes.update(&mut passes, &fixture.train.update_with_camera, &rule, true);
        cameras.refine(&view_passes, &mut passes, &fixture.train, &lens);
        passes.submit(gpu);
        // Phase 1 checks that the view was corrected before the step, with parameters of zero.
        let corrected: Vec<f32> = gpu.read(&cameras.corrected, 20).unwrap();
        let base = camera_of(&view).view();
        for (ix, (got, expected)) in corrected
            .iter()
            .zip(bytemuck::cast_slice::<_, f32>(&[base]))
            .enumerate()
        {
            assert!(
                (got - expected).abs() <= 1e-6 * expected.abs().max(1.0),
                "word {ix}: {got}, expected {expected}"
            );
        }
        // Phase 2 checks the steps. Among the parameters of the camera, only the lens is enabled.
        let steps: Vec<f64> = cameras.param_values(gpu);
        for (param, step) in steps.iter().enumerate() {
            let rate = if (7..11).contains(&param) { 1e-3 } else { 0.0 };
            assert!(
                (step.abs() - rate).abs() < 1e-5,
                "camera parameter {param} changed by {step}"
            );
        }
    }
}

#[test]
fn gradients_match_the_twin() {
    check_short_lists(&adapter_options());
}

#[test]
fn gradients_of_long_lists_match_the_twin() {
    check_long_lists(&adapter_options());
}

#[test]
fn pixels_that_end_in_long_lists_match_the_twin() {
    check_ends_in_long_lists(&adapter_options());
}

#[test]
fn hidden_splats_have_no_gradient() {
    check_hidden_splats(&adapter_options());
}

/// The same tests with the kernels for GPUs: `rasterize` and `backward` with sums over subgroups.
mod needs_large_subgroups {
    use super::*;
    use gpu::testing::options_with_large_subgroups;

    #[test]
    fn pictures_match_the_twin() {
        if let Some(options) = options_with_large_subgroups() {
            check_pictures(&options);
        }
    }

    #[test]
    fn gradients_match_the_twin() {
        if let Some(options) = options_with_large_subgroups() {
            check_short_lists(&[options]);
        }
    }

    #[test]
    fn gradients_of_long_lists_match_the_twin() {
        if let Some(options) = options_with_large_subgroups() {
            check_long_lists(&[options]);
        }
    }

    #[test]
    fn pixels_that_end_in_long_lists_match_the_twin() {
        if let Some(options) = options_with_large_subgroups() {
            check_ends_in_long_lists(&[options]);
        }
    }

    #[test]
    fn hidden_splats_have_no_gradient() {
        if let Some(options) = options_with_large_subgroups() {
            check_hidden_splats(&[options]);
        }
    }
}
