//! Tests of the kernels against their f64 twins.

use super::buffers::{
    FieldBuffers, FieldGradients, FieldMoments, ImageParamBuffers, RaySlot, SampleBuffers,
    StepBuffers,
};
use super::kernels::{FieldPipelines, N_CHUNK, Widths};
use super::params::{self, AdamRule, Batch, ImageParamRule, RayLoss, Span};
use super::passes::{Canvas, FieldPasses};
use super::reference::field::{Field, FieldGrad};
use super::reference::network::Network;
use super::reference::pose::ImagePose;
use super::reference::ray as reference;
use super::reference::scene::{EMBEDDING_DIM, Ray, WEIGHTS, field, gradient, ray, samples};
use crate::mismatches::Mismatches;
use crate::optim::reference::{Adam, Moments};
use gpu::testing::test_gpu_with;
use gpu::{Buffer, Gpu, GpuOptions, Passes};
use model_files::contraction::contract;
use numbers::{f32_of, f32s_of};

/// Number of rays. Their samples exceed the number that one partial sum covers.
const N_RAYS: u32 = 90;

/// Rows of a matrix, padded with zeros.
fn padded(
    weights: &[f64],
    [n_in, n_out]: [usize; 2],
    [n_in_padded, n_out_padded]: [u32; 2],
) -> Vec<f32> {
    let mut padded = vec![0.0; (n_in_padded * n_out_padded) as usize];
    for row in 0..n_out {
        for column in 0..n_in {
            padded[row * n_in_padded as usize + column] = f32_of(weights[row * n_in + column]);
        }
    }
    padded
}

/// Layer sizes of both networks, in the twin and in the kernels.
fn layers<'a>(
    twin: &'a Field,
    widths: &Widths,
) -> impl Iterator<Item = ([usize; 2], [u32; 2])> + use<'a> {
    let of = |network: &'a Network| network.sizes.windows(2).map(|pair| [pair[0], pair[1]]);
    of(&twin.density)
        .chain(of(&twin.color))
        .zip(widths.layers())
}

/// Weights of both networks in the layout of the kernels.
fn weights(twin: &Field, widths: &Widths) -> Vec<f32> {
    let mut rest = &[&twin.density.weights[..], &twin.color.weights].concat()[..];
    let mut all = Vec::new();
    for (sizes, widths) in layers(twin, widths) {
        let (layer, others) = rest.split_at(sizes[0] * sizes[1]);
        all.extend(padded(layer, sizes, widths));
        rest = others;
    }
    all
}

/// Compares weights, or gradients with respect to them, of both networks in sequence. The padding
/// must be zero.
fn check_weights(
    mismatches: &mut Mismatches,
    got: &[f32],
    twin: &Field,
    widths: &Widths,
    expected: &[f64],
    abs: [f64; 2],
) {
    let mut got = got;
    let mut expected = expected;
    for (layer, ([n_in, n_out], [n_in_padded, n_out_padded])) in layers(twin, widths).enumerate() {
        let (here, others) = got.split_at((n_in_padded * n_out_padded) as usize);
        for (at, got) in here.iter().enumerate() {
            let row = at / n_in_padded as usize;
            let column = at % n_in_padded as usize;
            let is_real = row < n_out && column < n_in;
            let expected = if is_real {
                expected[row * n_in + column]
            } else {
                0.0
            };
            mismatches.check(
                format!("layer {layer}: {row} {column}"),
                (*got).into(),
                expected,
                abs[usize::from(layer > 1)],
                1e-4,
            );
        }
        (got, expected) = (others, &expected[n_in * n_out..]);
    }
}

/// Gradients with respect to weights, summed over the chunks of samples.
fn summed(gpu: &Gpu, step: &StepBuffers, widths: &Widths, n_samples: u32) -> Vec<f32> {
    let n_sums = widths.n_padded_weights() as usize;
    let n_chunks = n_samples.div_ceil(N_CHUNK) as usize;
    let partial: Vec<f32> = gpu.read(&step.partial_sums, n_chunks * n_sums).unwrap();
    (0..widths.n_weights() as usize)
        .map(|ix| partial.iter().skip(ix).step_by(n_sums).sum())
        .collect()
}

fn max_abs_of(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |max_abs, v| max_abs.max(v.abs()))
}

struct Bench {
    gpu: std::sync::Arc<Gpu>,
    pipelines: FieldPipelines,
    widths: Widths,
    field: FieldBuffers,
    samples: SampleBuffers,
    step: StepBuffers,
    gradients: FieldGradients,
    slot: RaySlot,
    /// One appearance embedding per ray.
    image_params: Buffer,
}

/// Middle of a sample in the unit cube.
fn point_of(ray: &Ray, [begin, end]: &[f64; 2]) -> [f32; 4] {
    let at =
        std::array::from_fn(|axis| ray.origin[axis] + 0.5 * (begin + end) * ray.direction[axis]);
    let [x, y, z] = f32s_of(contract(at));
    [x, y, z, 0.0]
}

fn bench(options: &GpuOptions, twin: &Field, rays: &[Ray], scales: &[f32]) -> Bench {
    let gpu = test_gpu_with(options);
    let widths = Widths::new(
        &gpu,
        u32::try_from(twin.shape.n_cells.len()).unwrap(),
        7,
        u32::try_from(EMBEDDING_DIM).unwrap(),
    );
    let n_samples = u32::try_from(rays.iter().map(|ray| ray.spans.len()).sum::<usize>()).unwrap();
    let n_rays = u32::try_from(rays.len()).unwrap();
    let field = FieldBuffers::new(&gpu, &twin.shape, &widths).unwrap();
    let entries: Vec<[f32; 2]> = twin.table.iter().map(|entry| f32s_of(*entry)).collect();
    gpu.write(&field.grid, 0, bytemuck::cast_slice(&entries));
    gpu.write(
        &field.weights,
        0,
        bytemuck::cast_slice(&weights(twin, &widths)),
    );
    // Capacity for more samples than there are.
    let samples = SampleBuffers::new(&gpu, n_samples + 600).unwrap();
    let step = StepBuffers::new(&gpu, &widths, n_rays + 3, n_samples + 600).unwrap();
    gpu.write(
        &samples.batch,
        0,
        bytemuck::bytes_of(&Batch {
            n_samples,
            ..Batch::of(n_rays)
        }),
    );
    let mut gpu_rays = Vec::new();
    let mut spans = Vec::new();
    let mut points = Vec::new();
    for (ray, embedding) in rays.iter().zip(0..) {
        let byte = |value: f64| u32::from(format!("{:.0}", 255.0 * value).parse::<u8>().unwrap());
        let [red, green, blue] = ray.target.rgb.map(byte);
        gpu_rays.push(params::Ray {
            origin: f32s_of(ray.origin),
            first_sample: u32::try_from(spans.len()).unwrap(),
            direction: f32s_of(ray.direction),
            n_samples: u32::try_from(ray.spans.len()).unwrap(),
            embedding,
            target_rgb: red | green << 8 | blue << 16 | 0xff00_0000,
            target_distance: f32_of(ray.target.distance),
            ..params::Ray::default()
        });
        let span = |[begin, end]: &[f64; 2]| Span {
            begin: f32_of(*begin),
            end: f32_of(*end),
            ray: embedding,
            sample: 0,
        };
        spans.extend(ray.spans.iter().map(span));
        points.extend(ray.spans.iter().flat_map(|span| point_of(ray, span)));
    }
    let slot = RaySlot::new(&gpu, n_rays + 3).unwrap();
    gpu.write(&slot.rays, 0, bytemuck::cast_slice(&gpu_rays));
    gpu.write(&samples.points, 0, bytemuck::cast_slice(&points));
    gpu.write(&samples.spans, 0, bytemuck::cast_slice(&spans));
    let embeddings: Vec<[f64; EMBEDDING_DIM]> = rays
        .iter()
        .map(|ray| ray.embedding.clone().try_into().unwrap())
        .collect();
    let image_params = gpu
        .storage_with(
            "image_params",
            bytemuck::cast_slice(&params::image_params_of(&embeddings)),
        )
        .unwrap();
    let gradients = FieldGradients::new(&gpu, &twin.shape).unwrap();
    gpu.write(&gradients.scales, 0, bytemuck::cast_slice(scales));
    let loss = RayLoss {
        background_srgb: [0, 1, 2, 0].map(|channel| f32_of(WEIGHTS.background_rgb[channel])),
        distance_weight: f32_of(WEIGHTS.distance_weight),
        distance_clip: f32_of(WEIGHTS.distance_clip),
        distortion: f32_of(WEIGHTS.distortion),
        near: f32_of(WEIGHTS.near),
        line_of_sight: f32_of(WEIGHTS.line_of_sight),
        band: f32_of(WEIGHTS.band[1]),
        band_frac: f32_of(WEIGHTS.band[0]),
        unused: 0.0,
    };
    gpu.write(&slot.loss, 0, bytemuck::bytes_of(&loss));
    Bench {
        pipelines: FieldPipelines::new(&gpu, &widths, n_samples + 600, 0).unwrap(),
        gpu,
        widths,
        field,
        samples,
        step,
        gradients,
        slot,
        image_params,
    }
}

/// Options without cooperative matrices, as on software adapters.
fn without_matrices() -> GpuOptions {
    GpuOptions {
        matrices: false,
        ..GpuOptions::default()
    }
}

/// Factor on gradient tolerances. With cooperative matrices, gradients are f16 numbers with 11
/// bits, although sums are f32.
fn tolerance_scale_of(widths: &Widths) -> f64 {
    if widths.is_half_precision { 200.0 } else { 1.0 }
}

fn rays() -> Vec<Ray> {
    (0..u64::from(N_RAYS)).map(|seed| ray(seed + 50)).collect()
}

/// Mean gradient over the rays.
fn expected(twin: &Field, rays: &[Ray]) -> FieldGrad {
    let mut sum = FieldGrad::zeros(twin);
    let add = |sum: &mut f64, v: f64| *sum += v / f64::from(N_RAYS);
    for ray in rays {
        let (gradient, ..) = gradient(twin, ray);
        sum.table
            .as_flattened_mut()
            .iter_mut()
            .zip(gradient.table.as_flattened())
            .for_each(|(sum, v)| add(sum, *v));
        sum.density
            .iter_mut()
            .zip(gradient.density)
            .for_each(|(sum, v)| add(sum, v));
        sum.color
            .iter_mut()
            .zip(gradient.color)
            .for_each(|(sum, v)| add(sum, v));
    }
    sum
}

fn check_colors_and_gradients(options: &GpuOptions) {
    let twin = field(7);
    let rays = rays();
    let expected = expected(&twin, &rays);
    let largest = expected
        .table
        .as_flattened()
        .iter()
        .fold(0.0f64, |max_abs, v| max_abs.max(v.abs()));
    let scale = f32_of((2f64.powi(28) / largest).log2().floor().exp2());
    let bench = bench(
        options,
        &twin,
        &rays,
        &vec![scale; twin.shape.n_cells.len()],
    );
    let Bench {
        gpu,
        pipelines,
        widths,
        field,
        samples: batch,
        step,
        gradients,
        slot,
        image_params,
    } = &bench;
    let passes = FieldPasses {
        gpu,
        pipelines,
        field,
        samples: batch,
        slot,
        image_params,
    };
    let mut list = Passes::default();
    passes.convert_weights(&mut list);
    passes.forward(&mut list, step);
    passes.backward(&mut list, step, gradients);
    list.submit(gpu);

    let tolerance_scale = tolerance_scale_of(widths);
    // Forward values have twice as many bits as gradients.
    let (abs, rel) = if widths.is_half_precision {
        (5e-5, 5e-5)
    } else {
        (1e-5, 1e-5)
    };
    let mut mismatches = Mismatches::default();
    let ray_colors: Vec<[f32; 4]> = gpu.read(&step.ray_colors, rays.len()).unwrap();
    let errors: Vec<[f32; 2]> = gpu.read(&step.ray_errors, rays.len()).unwrap();
    for (ix, ray) in rays.iter().enumerate() {
        let picture = reference::composite(&samples(&twin, ray));
        for (channel, (got, expected)) in ray_colors[ix].iter().zip(picture.rgb).enumerate() {
            mismatches.check(
                format!("color {ix} {channel}"),
                (*got).into(),
                expected,
                abs,
                rel,
            );
        }
        mismatches.check(
            format!("transmittance {ix}"),
            ray_colors[ix][3].into(),
            picture.transmittance,
            abs,
            rel,
        );
        mismatches.check(
            format!("distance {ix}"),
            errors[ix][1].into(),
            picture.distance,
            abs,
            rel,
        );
    }
    let n_samples = gpu.read::<u32>(&batch.batch, 2).unwrap()[1];
    let got = summed(gpu, step, widths, n_samples);
    let of_weights = [&expected.density[..], &expected.color].concat();
    let abs = [&expected.density, &expected.color]
        .map(|gradients| 2e-5 * tolerance_scale * max_abs_of(gradients));
    check_weights(&mut mismatches, &got, &twin, widths, &of_weights, abs);
    let got: Vec<i32> = gpu.read(&gradients.grid, 2 * twin.table.len()).unwrap();
    for (ix, (got, expected)) in got.iter().zip(expected.table.as_flattened()).enumerate() {
        mismatches.check(
            format!("entry {ix}"),
            f64::from(*got) / f64::from(scale),
            *expected,
            2e-5 * tolerance_scale * largest,
            1e-4 * tolerance_scale,
        );
    }
    mismatches.assert_none();
    assert_eq!(gpu.read::<u32>(&gradients.counts, 1).unwrap(), [0]);
}

/// Rendered colors differ from the twin, because skipped samples get the color of the selected
/// sample.
fn check_pictures(options: &GpuOptions) {
    let twin = field(7);
    let rays = rays();
    let bench = bench(options, &twin, &rays, &vec![1.0; twin.shape.n_cells.len()]);
    let Bench {
        gpu,
        pipelines,
        widths,
        field,
        samples: batch,
        slot,
        image_params,
        ..
    } = &bench;
    let passes = FieldPasses {
        gpu,
        pipelines,
        field,
        samples: batch,
        slot,
        image_params,
    };
    let n_rays = u32::try_from(rays.len()).unwrap();
    let canvas = Canvas::new(
        gpu,
        widths,
        field.n_entries,
        n_rays.into(),
        n_rays,
        batch.n_samples,
    )
    .unwrap();
    let n_spans = rays.iter().map(|ray| ray.spans.len()).sum::<usize>();
    let spans: Vec<Span> = gpu.read(&batch.spans, n_spans).unwrap();
    let numbered: Vec<Span> = (0..)
        .zip(spans)
        .map(|(sample, span)| Span { sample, ..span })
        .collect();
    gpu.write(&batch.spans, 0, bytemuck::cast_slice(&numbered));
    gpu.write(&canvas.selected, 0, bytemuck::bytes_of(&Batch::of(n_rays)));
    let march = params::March {
        max_found: u32::MAX,
        ..bytemuck::Zeroable::zeroed()
    };
    gpu.write(&slot.march, 0, bytemuck::bytes_of(&march));
    let dark = [[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, 1e9, 0.0]];
    gpu.write(
        &canvas.light,
        0,
        bytemuck::cast_slice(&vec![dark; rays.len()]),
    );
    let mut list = Passes::default();
    passes.convert_for_picture(&mut list, &canvas);
    passes.select(&mut list, &canvas);
    passes.picture_colors(&mut list, &canvas);
    passes.show(&mut list, &canvas);
    list.submit(gpu);

    let light: Vec<[[f32; 4]; 2]> = gpu.read(&canvas.light, rays.len()).unwrap();
    let mut mismatches = Mismatches::default();
    for (ix, (ray, [[red, green, blue, transmittance], [distance, ..]])) in
        rays.iter().zip(light).enumerate()
    {
        let picture = reference::composite(&samples(&twin, ray));
        for (channel, (got, expected)) in
            [red, green, blue].into_iter().zip(picture.rgb).enumerate()
        {
            mismatches.check(
                format!("color {ix} {channel}"),
                got.into(),
                expected,
                0.02,
                0.0,
            );
        }
        // Rays end at a transmittance of 1/512.
        mismatches.check(
            format!("transmittance {ix}"),
            transmittance.into(),
            picture.transmittance,
            0.002,
            0.0,
        );
        mismatches.check(
            format!("distance {ix}"),
            distance.into(),
            picture.distance,
            0.002,
            0.002,
        );
    }
    mismatches.assert_none();
}

/// Gradients with respect to poses and appearance embeddings of images, and the first step of each
/// parameter. Images have seven rays each, except for the last image, which has fewer.
fn check_image_param_gradients(options: &GpuOptions) {
    const RAYS_PER_IMAGE: usize = 7;
    const N_IMAGES: usize = (N_RAYS as usize).div_ceil(RAYS_PER_IMAGE);
    const ALL: u32 = (1 << params::IMAGE_PARAM_STRIDE) - 1;
    const RATES: [f64; 3] = [0.25, 0.125, 0.0625];
    let twin = field(7);
    let rays = rays();
    // These are the gradients of each ray with respect to rotation, translation and appearance
    // embedding.
    let expected: Vec<[[f64; 3]; 3]> = rays
        .iter()
        .map(|ray| {
            let (_, sample_positions, embedding) = gradient(&twin, ray);
            let ImagePose {
                rotation_rad,
                translation,
            } = ImagePose::gradients(ray.direction, &sample_positions);
            [rotation_rad, translation, embedding.try_into().unwrap()]
                .map(|part| part.map(|v| v / f64::from(N_RAYS)))
        })
        .collect();
    let largest = [0, 1, 2].map(|part| {
        expected
            .iter()
            .flat_map(|ray| ray[part])
            .fold(0.0f64, |max_abs, v| max_abs.max(v.abs()))
    });
    for learned in [ALL, 0b1_1100_0000] {
        let bench = bench(options, &twin, &rays, &vec![1.0; twin.shape.n_cells.len()]);
        let Bench {
            gpu,
            pipelines,
            widths,
            field,
            samples: batch,
            step,
            gradients,
            slot,
            image_params,
        } = &bench;
        let passes = FieldPasses {
            gpu,
            pipelines,
            field,
            samples: batch,
            slot,
            image_params,
        };
        let rule = AdamRule {
            rate: 1.0,
            final_rate_frac: 1.0,
            betas: [0.9, 0.99],
            epsilon: 1e-15,
            weight_decay: 0.0,
            n_planned_steps: 1.0,
            unused: 0.0,
        };
        let moments = FieldMoments::new(gpu, &twin.shape, widths, &rule).unwrap();
        let n_images = u32::try_from(N_IMAGES + 1).unwrap(); // One image has no rays.
        let [rotation_rate, translation_rate, embedding_rate] = RATES.map(f32_of);
        let rule = ImageParamRule {
            learned,
            n_images,
            rotation_rate,
            translation_rate,
            embedding_rate,
            weight_decay: 0.5,
            unused: [0; 2],
        };
        let images = ImageParamBuffers::new(gpu, &rule, N_RAYS + 3, batch.n_samples).unwrap();
        let mut list = Passes::default();
        passes.convert_weights(&mut list);
        passes.forward(&mut list, step);
        passes.backward(&mut list, step, gradients);
        list.submit(gpu);
        let mut of_images: Vec<params::Ray> = gpu.read(&slot.rays, rays.len()).unwrap();
        for (ix, ray) in of_images.iter_mut().enumerate() {
            ray.embedding = u32::try_from(ix / RAYS_PER_IMAGE).unwrap();
        }
        gpu.write(&slot.rays, 0, bytemuck::cast_slice(&of_images));
        passes.pose_gradients(&mut list, step, &images);
        passes.embedding_gradients(&mut list, step, &images);
        passes.update_images(&mut list, &moments, &images);
        list.submit(gpu);

        let tolerance_scale = tolerance_scale_of(widths);
        let mut mismatches = Mismatches::default();
        let got: Vec<[[f32; 4]; 2]> = gpu.read(&images.v_rays, rays.len()).unwrap();
        let v_embeddings: Vec<[f32; 4]> = gpu
            .read(&images.v_embeddings, batch.n_samples as usize)
            .unwrap();
        for (ix, (got, expected)) in got.iter().zip(&expected).enumerate() {
            let samples = of_images[ix].first_sample as usize
                ..(of_images[ix].first_sample + of_images[ix].n_samples) as usize;
            let of_ray = &v_embeddings[samples];
            for axis in 0..3 {
                let embedding = of_ray.iter().map(|v| v[axis]).sum::<f32>();
                for (part, got) in [got[0][axis], got[1][axis], embedding]
                    .into_iter()
                    .enumerate()
                {
                    let label = format!("ray {ix}, part {part}, axis {axis}");
                    mismatches.check(
                        label,
                        got.into(),
                        expected[part][axis],
                        2e-5 * tolerance_scale * largest[part],
                        2e-4 * tolerance_scale,
                    );
                }
            }
        }
        let image_params: Vec<[params::ImageParam; params::IMAGE_PARAM_STRIDE]> =
            gpu.read(&images.image_params, N_IMAGES + 1).unwrap();
        for (image, of_image) in expected.chunks(RAYS_PER_IMAGE).enumerate() {
            for (image_param, got) in image_params[image].iter().enumerate() {
                if learned & (1 << image_param) == 0 {
                    assert_eq!(
                        *got, [0.0; 4],
                        "image {image}: parameter {image_param} is not optimized"
                    );
                    continue;
                }
                let part = image_param / 3;
                let axis = image_param % 3;
                let sum: f64 = of_image.iter().map(|ray| ray[part][axis]).sum();
                let [value, first, second, n_steps] = got.map(f64::from);
                let label = |name: &str| format!("image {image}, parameter {image_param}, {name}");
                mismatches.check(
                    label("gradient"),
                    first / 0.1,
                    sum,
                    5e-5 * tolerance_scale * largest[part],
                    2e-4 * tolerance_scale,
                );
                mismatches.check(
                    label("square"),
                    second / 0.01,
                    (first / 0.1).powi(2),
                    1e-12,
                    1e-4,
                );
                // The length of the first step is the learning rate. Weight decay then undoes half
                // of the step.
                mismatches.check(
                    label("value"),
                    value,
                    -0.5 * RATES[part] * first.signum(),
                    1e-6,
                    1e-5,
                );
                mismatches.check(label("steps"), n_steps, 1.0, 1e-9, 0.0);
            }
        }
        mismatches.assert_none();
        assert_eq!(
            image_params[N_IMAGES],
            [[0.0; 4]; params::IMAGE_PARAM_STRIDE],
            "an image without rays must not change"
        );

        gpu.write(&slot.rays, 0, bytemuck::cast_slice(&of_images));
        FieldPasses {
            image_params: &images.image_params,
            ..passes
        }
        .apply_pose(&mut list);
        list.submit(gpu);
        let posed: Vec<params::Ray> = gpu.read(&slot.rays, rays.len()).unwrap();
        for (ix, (ray, got)) in rays.iter().zip(posed).enumerate() {
            let value =
                |image_param: usize| f64::from(image_params[ix / RAYS_PER_IMAGE][image_param][0]);
            let pose = ImagePose {
                rotation_rad: [0, 1, 2].map(value),
                translation: [3, 4, 5].map(value),
            };
            let (origin, direction) = pose.apply_pose(ray.origin, ray.direction);
            for axis in 0..3 {
                mismatches.check(
                    format!("origin {ix} {axis}"),
                    got.origin[axis].into(),
                    origin[axis],
                    1e-6,
                    1e-6,
                );
                mismatches.check(
                    format!("direction {ix} {axis}"),
                    got.direction[axis].into(),
                    direction[axis],
                    1e-6,
                    1e-6,
                );
            }
        }
        mismatches.assert_none();
    }
}

/// Optimizer steps of the kernels and the twin, each with its own gradients.
#[test]
fn optimizer_steps_match_twin() {
    const N_STEPS: u32 = 4;
    let rays = rays();
    let mut twin = field(7);
    let grid_rule = AdamRule {
        rate: 0.02,
        final_rate_frac: 0.25,
        betas: [0.75, 0.875],
        epsilon: 1e-4, // Shortens the steps of small gradients, which are less precise in f32.
        weight_decay: 0.0,
        n_planned_steps: 4.0,
        unused: 0.0,
    };
    let of_weights = AdamRule {
        rate: 0.01,
        weight_decay: 0.5,
        ..grid_rule
    };
    let first_scale = 2f32.powi(28); // Fine enough for the first step; the kernels then adapt the scales.
    // Uses f32 layers, because a step along f16 noise would be as long as a real step.
    let bench = bench(
        &without_matrices(),
        &twin,
        &rays,
        &vec![first_scale; twin.shape.n_cells.len()],
    );
    let Bench {
        gpu,
        pipelines,
        widths,
        field: buffers,
        samples,
        step: kept_step,
        gradients,
        slot,
        image_params,
    } = &bench;
    let moments = FieldMoments::new(gpu, &twin.shape, widths, &grid_rule).unwrap();
    let rules = [
        gpu.uniform_with("rule", &grid_rule),
        gpu.uniform_with("rule", &of_weights),
    ];
    let passes = FieldPasses {
        gpu,
        pipelines,
        field: buffers,
        samples,
        slot,
        image_params,
    };
    let adam = Adam {
        beta1: 0.75,
        beta2: 0.875,
        epsilon: f64::from(grid_rule.epsilon),
    };
    let mut grid_adam_state = vec![[Moments::default(); 2]; twin.table.len()];
    let mut adam_state = [
        vec![Moments::default(); twin.density.weights.len()],
        vec![Moments::default(); twin.color.weights.len()],
    ];
    for step in 0..N_STEPS {
        let mut list = Passes::default();
        passes.convert_weights(&mut list);
        passes.forward(&mut list, kept_step);
        passes.backward(&mut list, kept_step, gradients);
        passes.update(
            &mut list,
            [&rules[0], &rules[1]],
            kept_step,
            gradients,
            &moments,
        );
        list.submit(gpu);

        let gradient = expected(&twin, &rays);
        let rate_frac = 0.25f64.powf(f64::from(step) / 4.0);
        for ((entry, derivative), adam_state) in twin
            .table
            .iter_mut()
            .zip(&gradient.table)
            .zip(&mut grid_adam_state)
        {
            for feature in 0..2 {
                if *derivative != [0.0; 2] {
                    adam.update(
                        step + 1,
                        0.02 * rate_frac,
                        &mut entry[feature],
                        derivative[feature],
                        &mut adam_state[feature],
                    );
                }
            }
        }
        let networks = [
            (&mut twin.density, &gradient.density),
            (&mut twin.color, &gradient.color),
        ];
        for ((network, gradients), adam_state) in networks.into_iter().zip(&mut adam_state) {
            for ((weight, derivative), adam_state) in
                network.weights.iter_mut().zip(gradients).zip(adam_state)
            {
                let weight_decay_step = 0.01 * rate_frac * 0.5 * *weight;
                adam.update(step + 1, 0.01 * rate_frac, weight, *derivative, adam_state);
                *weight -= weight_decay_step;
            }
        }
    }
    let mut mismatches = Mismatches::default();
    let got: Vec<[f32; 2]> = gpu.read(&buffers.grid, twin.table.len()).unwrap();
    for (ix, (got, expected)) in got
        .as_flattened()
        .iter()
        .zip(twin.table.as_flattened())
        .enumerate()
    {
        mismatches.check(format!("entry {ix}"), (*got).into(), *expected, 4e-4, 1e-4);
    }
    let got: Vec<f32> = gpu
        .read(&buffers.weights, widths.n_weights() as usize)
        .unwrap();
    let of_weights = [&twin.density.weights[..], &twin.color.weights].concat();
    check_weights(&mut mismatches, &got, &twin, widths, &of_weights, [4e-4; 2]);
    mismatches.assert_none();
    assert_eq!(gpu.read::<u32>(&moments.steps, 1).unwrap(), [N_STEPS]);
    assert!(
        gpu.read::<i32>(&gradients.grid, 2 * twin.table.len())
            .unwrap()
            .iter()
            .all(|sum| *sum == 0)
    );
    // With these scales, even a tenth of a level's largest gradient has 19 bits.
    let scales: Vec<f32> = gpu
        .read(&gradients.scales, twin.shape.n_cells.len())
        .unwrap();
    assert!(
        scales.iter().all(|scale| scale.log2().fract() == 0.0),
        "{scales:?}"
    );
    assert!(
        scales.iter().any(|scale| *scale != first_scale),
        "{scales:?}"
    );
}

/// Checks the first step of the weights against the summed gradients of the kernels. The twin's
/// gradients differ too much from f16 gradients to predict the sign of a small gradient.
fn check_first_step(options: &GpuOptions) {
    let twin = field(7);
    let rays = rays();
    let bench = bench(options, &twin, &rays, &vec![1.0; twin.shape.n_cells.len()]);
    let Bench {
        gpu,
        pipelines,
        widths,
        field,
        samples,
        step,
        gradients,
        slot,
        image_params,
    } = &bench;
    let passes = FieldPasses {
        gpu,
        pipelines,
        field,
        samples,
        slot,
        image_params,
    };
    let rule = AdamRule {
        rate: 0.01,
        final_rate_frac: 1.0,
        betas: [0.75, 0.875],
        epsilon: 1e-4,
        weight_decay: 0.5,
        n_planned_steps: 1.0,
        unused: 0.0,
    };
    let moments = FieldMoments::new(gpu, &twin.shape, widths, &rule).unwrap();
    let rules = [
        gpu.uniform_with("rule", &rule),
        gpu.uniform_with("rule", &rule),
    ];
    let mut list = Passes::default();
    passes.convert_weights(&mut list);
    passes.forward(&mut list, step);
    passes.backward(&mut list, step, gradients);
    passes.update(&mut list, [&rules[0], &rules[1]], step, gradients, &moments);
    list.submit(gpu);
    let before = weights(&twin, widths);
    let got: Vec<f32> = gpu.read(&field.weights, before.len()).unwrap();
    let n_samples = gpu.read::<u32>(&samples.batch, 2).unwrap()[1];
    let mut mismatches = Mismatches::default();
    let mut n_moved = 0;
    for (ix, (derivative, before)) in summed(gpu, step, widths, n_samples)
        .into_iter()
        .zip(before)
        .enumerate()
    {
        let derivative = f64::from(derivative);
        let before = f64::from(before);
        let expected = before - 0.01 * (derivative / (derivative.abs() + 1e-4) + 0.5 * before);
        mismatches.check(format!("weight {ix}"), got[ix].into(), expected, 2e-5, 1e-5);
        n_moved += usize::from(derivative.abs() > 1e-5);
    }
    mismatches.assert_none();
    assert!(
        n_moved > 100,
        "only {n_moved} weights have significant gradients"
    );
}

#[test]
fn saturated_gradients_are_counted_and_skipped() {
    let twin = field(7);
    let rays = rays();
    let bench = bench(
        &GpuOptions::default(),
        &twin,
        &rays,
        &vec![f32::MAX; twin.shape.n_cells.len()],
    );
    let Bench {
        gpu,
        pipelines,
        field,
        samples,
        step,
        gradients,
        slot,
        image_params,
        ..
    } = &bench;
    let mut list = Passes::default();
    let passes = FieldPasses {
        gpu,
        pipelines,
        field,
        samples,
        slot,
        image_params,
    };
    passes.convert_weights(&mut list);
    passes.forward(&mut list, step);
    passes.backward(&mut list, step, gradients);
    list.submit(gpu);
    let n_saturated = gpu.read::<u32>(&gradients.counts, 1).unwrap()[0];
    assert!(n_saturated > N_RAYS * 7 * 8, "only {n_saturated}");
    assert!(
        gpu.read::<i32>(&gradients.grid, 2 * twin.table.len())
            .unwrap()
            .iter()
            .all(|sum| *sum == 0)
    );
}

#[test]
fn colors_and_gradients_match_twin() {
    check_colors_and_gradients(&without_matrices());
}

#[test]
fn pictures_match_twin() {
    check_pictures(&without_matrices());
}

#[test]
fn image_param_gradients_match_twin() {
    check_image_param_gradients(&without_matrices());
}

#[test]
fn first_step_follows_summed_gradients() {
    check_first_step(&without_matrices());
}

/// The same tests with cooperative matrices of f16 numbers, which no software adapter has.
mod needs_matrices {
    use super::*;
    use gpu::testing::options_with_matrices;

    #[test]
    fn colors_and_gradients_match_twin() {
        if let Some(options) = options_with_matrices() {
            check_colors_and_gradients(&options);
        }
    }

    #[test]
    fn pictures_match_twin() {
        if let Some(options) = options_with_matrices() {
            check_pictures(&options);
        }
    }

    #[test]
    fn image_param_gradients_match_twin() {
        if let Some(options) = options_with_matrices() {
            check_image_param_gradients(&options);
        }
    }

    #[test]
    fn first_step_follows_summed_gradients() {
        if let Some(options) = options_with_matrices() {
            check_first_step(&options);
        }
    }
}
