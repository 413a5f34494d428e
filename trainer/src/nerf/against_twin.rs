//! The kernels against their twins in f64.

use super::buffers::{FieldBuffers, FieldMoments, FieldSlopes, RaySlot, SampleBuffers, StepBuffers, TermBuffers};
use super::kernels::{FieldPipelines, KERNELS, N_CHUNK, Widths};
use super::params::{self, Batch, LearnRule, Level, RayLoss, Span, TermRule};
use super::passes::FieldPasses;
use super::reference::field::{Field, FieldGrad};
use super::reference::network::Network;
use super::reference::pose::ImagePose;
use super::reference::ray as reference;
use super::reference::scene::{N_CODE, Ray, WEIGHTS, field, gradient, ray, samples};
use super::reference::space::contract;
use crate::gpu::{Buffer, Gpu, GpuOptions, Passes, f32_of, f32s_of, reflect, resolve};
use crate::mismatches::Mismatches;
use crate::optim::reference::{Adam, Moments};

/// More samples than one partial sum goes over.
const N_RAYS: u32 = 90;

/// Rows of a matrix with zeros around it.
fn padded(weights: &[f64], [n_in, n_out]: [usize; 2], [n_in_padded, n_out_padded]: [u32; 2]) -> Vec<f32> {
    let mut padded = vec![0.0; (n_in_padded * n_out_padded) as usize];
    for row in 0..n_out {
        for column in 0..n_in {
            padded[row * n_in_padded as usize + column] = f32_of(weights[row * n_in + column]);
        }
    }
    padded
}

/// Sizes of the layers of both networks, and those of the kernels.
fn layers<'a>(twin: &'a Field, widths: &Widths) -> impl Iterator<Item = ([usize; 2], [u32; 2])> + use<'a> {
    let of = |network: &'a Network| network.sizes.windows(2).map(|pair| [pair[0], pair[1]]);
    of(&twin.density).chain(of(&twin.color)).zip(widths.layers())
}

/// Weights of both networks as the kernels have them.
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

/// Compares weights, or slopes towards them, those of both networks one after the other; those of the padding are zero.
fn check_weights(wrong: &mut Mismatches, got: &[f32], twin: &Field, widths: &Widths, expected: &[f64], abs: [f64; 2]) {
    let (mut got, mut expected) = (got, expected);
    for (layer, ([n_in, n_out], [n_in_padded, n_out_padded])) in layers(twin, widths).enumerate() {
        let (here, others) = got.split_at((n_in_padded * n_out_padded) as usize);
        for (at, got) in here.iter().enumerate() {
            let (row, column) = (at / n_in_padded as usize, at % n_in_padded as usize);
            let is_real = row < n_out && column < n_in;
            let expected = if is_real { expected[row * n_in + column] } else { 0.0 };
            wrong.check(
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

/// Slopes towards weights, summed over the chunks of samples.
fn summed(gpu: &Gpu, step: &StepBuffers, widths: &Widths, n_samples: u32) -> Vec<f32> {
    let n_sums = widths.n_padded_weights() as usize;
    let n_chunks = n_samples.div_ceil(N_CHUNK) as usize;
    let partial: Vec<f32> = gpu.read(&step.partial_sums, n_chunks * n_sums).unwrap();
    (0..widths.n_weights() as usize).map(|ix| partial.iter().skip(ix).step_by(n_sums).sum()).collect()
}

fn largest_of(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |most, v| most.max(v.abs()))
}

struct Bench {
    gpu: std::sync::Arc<Gpu>,
    pipelines: FieldPipelines,
    widths: Widths,
    field: FieldBuffers,
    samples: SampleBuffers,
    step: StepBuffers,
    slopes: FieldSlopes,
    slot: RaySlot,
    /// A code a ray.
    terms: Buffer,
}

fn bench(options: &GpuOptions, twin: &Field, rays: &[Ray], scales: &[f32]) -> Bench {
    let gpu = Gpu::open(options).unwrap();
    let widths = Widths::new(&gpu, u32::try_from(twin.shape.n_cells.len()).unwrap(), 7, u32::try_from(N_CODE).unwrap());
    let n_samples = u32::try_from(rays.iter().map(|ray| ray.spans.len()).sum::<usize>()).unwrap();
    let n_rays = u32::try_from(rays.len()).unwrap();
    let field = FieldBuffers::new(&gpu, &twin.shape, &widths).unwrap();
    let entries: Vec<[f32; 2]> = twin.table.iter().map(|entry| f32s_of(*entry)).collect();
    gpu.write(&field.grid, 0, bytemuck::cast_slice(&entries));
    gpu.write(&field.weights, 0, bytemuck::cast_slice(&weights(twin, &widths)));
    // Room for more than there are.
    let samples = SampleBuffers::new(&gpu, n_samples + 600).unwrap();
    let step = StepBuffers::new(&gpu, &widths, n_rays + 3, n_samples + 600).unwrap();
    gpu.write(&samples.batch, 0, bytemuck::bytes_of(&Batch { n_samples, ..Batch::of(n_rays) }));
    let (mut gpu_rays, mut spans, mut points) = (Vec::new(), Vec::new(), Vec::new());
    for (ray, code) in rays.iter().zip(0..) {
        let byte = |value: f64| u32::from(format!("{:.0}", 255.0 * value).parse::<u8>().unwrap());
        let [red, green, blue] = ray.target.rgb.map(byte);
        gpu_rays.push(params::Ray {
            origin: f32s_of(ray.origin),
            first_sample: u32::try_from(spans.len()).unwrap(),
            direction: f32s_of(ray.direction),
            n_samples: u32::try_from(ray.spans.len()).unwrap(),
            code,
            target_rgb: red | green << 8 | blue << 16 | 0xff00_0000,
            target_distance: f32_of(ray.target.distance),
            ..params::Ray::default()
        });
        let span = |[begin, end]: &[f64; 2]| Span { begin: f32_of(*begin), end: f32_of(*end), ray: code, unused: 0 };
        spans.extend(ray.spans.iter().map(span));
        let point = |[begin, end]: &[f64; 2]| {
            let at = std::array::from_fn(|axis| ray.origin[axis] + 0.5 * (begin + end) * ray.direction[axis]);
            let [x, y, z] = f32s_of(contract(at));
            [x, y, z, 0.0]
        };
        points.extend(ray.spans.iter().flat_map(point));
    }
    let slot = RaySlot::new(&gpu, n_rays + 3).unwrap();
    gpu.write(&slot.rays, 0, bytemuck::cast_slice(&gpu_rays));
    gpu.write(&samples.points, 0, bytemuck::cast_slice(&points));
    gpu.write(&samples.spans, 0, bytemuck::cast_slice(&spans));
    let codes: Vec<[f64; N_CODE]> = rays.iter().map(|ray| ray.code.clone().try_into().unwrap()).collect();
    let terms = gpu.storage_with("terms", bytemuck::cast_slice(&params::terms_of(&codes))).unwrap();
    let slopes = FieldSlopes::new(&gpu, &twin.shape).unwrap();
    gpu.write(&slopes.scales, 0, bytemuck::cast_slice(scales));
    let loss = RayLoss {
        background_srgb: [0, 1, 2, 0].map(|channel| f32_of(WEIGHTS.background_rgb[channel])),
        distance_weight: f32_of(WEIGHTS.distance_weight),
        distance_clip: f32_of(WEIGHTS.distance_clip),
        distortion: f32_of(WEIGHTS.distortion),
        near: f32_of(WEIGHTS.near),
        sight: f32_of(WEIGHTS.sight),
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
        slopes,
        slot,
        terms,
    }
}

/// With what the adapter has, without matrices, and with nothing but what all have.
fn forms() -> [GpuOptions; 3] {
    let all = GpuOptions::default();
    [all, GpuOptions { matrices: false, ..all }, GpuOptions { optional_features: false, ..all }]
}

/// How much farther off slopes may be where layers are matrices: they are of f16 then, with 11 bits, those that sums in f32 lose aside.
fn looser(widths: &Widths) -> f64 {
    if widths.halves { 200.0 } else { 1.0 }
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
        sum.table.as_flattened_mut().iter_mut().zip(gradient.table.as_flattened()).for_each(|(sum, v)| add(sum, *v));
        sum.density.iter_mut().zip(gradient.density).for_each(|(sum, v)| add(sum, v));
        sum.color.iter_mut().zip(gradient.color).for_each(|(sum, v)| add(sum, v));
    }
    sum
}

#[test]
fn pictures_and_gradients_match_the_twin() {
    let (twin, rays) = (field(7), rays());
    let expected = expected(&twin, &rays);
    let largest = expected.table.as_flattened().iter().fold(0.0f64, |most, v| most.max(v.abs()));
    let scale = f32_of((2f64.powi(28) / largest).log2().floor().exp2());
    for options in forms() {
        let bench = bench(&options, &twin, &rays, &vec![scale; twin.shape.n_cells.len()]);
        let Bench { gpu, pipelines, widths, field, samples: batch, step, slopes, slot, terms } = &bench;
        let passes = FieldPasses { gpu, pipelines, field, samples: batch, slot, terms };
        let mut list = Passes::default();
        passes.halve(&mut list);
        passes.forward(&mut list, step);
        passes.backward(&mut list, step, slopes);
        list.submit(gpu);

        let loose = looser(widths);
        // What is seen has twice as many bits.
        let (abs, rel) = if widths.halves { (5e-5, 5e-5) } else { (1e-5, 1e-5) };
        let mut wrong = Mismatches::default();
        let seen: Vec<[f32; 4]> = gpu.read(&step.seen, rays.len()).unwrap();
        let errors: Vec<[f32; 2]> = gpu.read(&step.ray_errors, rays.len()).unwrap();
        for (ix, ray) in rays.iter().enumerate() {
            let picture = reference::composite(&samples(&twin, ray));
            for (channel, (got, expected)) in seen[ix].iter().zip(picture.rgb).enumerate() {
                wrong.check(format!("color {ix} {channel}"), (*got).into(), expected, abs, rel);
            }
            wrong.check(format!("transmittance {ix}"), seen[ix][3].into(), picture.transmittance, abs, rel);
            wrong.check(format!("distance {ix}"), errors[ix][1].into(), picture.distance, abs, rel);
        }
        let n_samples = gpu.read::<u32>(&batch.batch, 2).unwrap()[1];
        let got = summed(gpu, step, widths, n_samples);
        let of_weights = [&expected.density[..], &expected.color].concat();
        let abs = [&expected.density, &expected.color].map(|slopes| 2e-5 * loose * largest_of(slopes));
        check_weights(&mut wrong, &got, &twin, widths, &of_weights, abs);
        let got: Vec<i32> = gpu.read(&slopes.grid, 2 * twin.table.len()).unwrap();
        for (ix, (got, expected)) in got.iter().zip(expected.table.as_flattened()).enumerate() {
            wrong.check(
                format!("entry {ix}"),
                f64::from(*got) / f64::from(scale),
                *expected,
                2e-5 * loose * largest,
                1e-4 * loose,
            );
        }
        wrong.assert_none();
        assert_eq!(gpu.read::<u32>(&slopes.counts, 1).unwrap(), [0]);
    }
}

/// Slopes towards poses and codes of images, and the first step of each: images of seven rays, the last of fewer.
#[test]
fn slopes_towards_images_match_the_twin() {
    const RAYS_PER_IMAGE: usize = 7;
    const N_IMAGES: usize = (N_RAYS as usize).div_ceil(RAYS_PER_IMAGE);
    const ALL: u32 = (1 << params::TERM_STRIDE) - 1;
    const RATES: [f64; 3] = [0.25, 0.125, 0.0625];
    let (twin, rays) = (field(7), rays());
    // Turn, shift and code of each ray.
    let expected: Vec<[[f64; 3]; 3]> = rays
        .iter()
        .map(|ray| {
            let (_, places, code) = gradient(&twin, ray);
            let ImagePose { turn_rad, shift } = ImagePose::slopes(ray.direction, &places);
            [turn_rad, shift, code.try_into().unwrap()].map(|part| part.map(|v| v / f64::from(N_RAYS)))
        })
        .collect();
    let largest =
        [0, 1, 2].map(|part| expected.iter().flat_map(|ray| ray[part]).fold(0.0f64, |most, v| most.max(v.abs())));
    for (options, learned) in forms().into_iter().flat_map(|options| [(options, ALL), (options, 0b1_1100_0000)]) {
        let bench = bench(&options, &twin, &rays, &vec![1.0; twin.shape.n_cells.len()]);
        let Bench { gpu, pipelines, widths, field, samples: batch, step, slopes, slot, terms } = &bench;
        let passes = FieldPasses { gpu, pipelines, field, samples: batch, slot, terms };
        let rule = LearnRule {
            rate: 1.0,
            final_rate_frac: 1.0,
            betas: [0.9, 0.99],
            epsilon: 1e-15,
            pull: 0.0,
            n_planned_steps: 1.0,
            unused: 0.0,
        };
        let moments = FieldMoments::new(gpu, &twin.shape, widths, &rule).unwrap();
        let n_images = u32::try_from(N_IMAGES + 1).unwrap(); // One has no rays.
        let [turn_rate, shift_rate, code_rate] = RATES.map(f32_of);
        let rule = TermRule { learned, n_images, turn_rate, shift_rate, code_rate, pull: 0.5, unused: [0; 2] };
        let images = TermBuffers::new(gpu, &rule, N_RAYS + 3, batch.n_samples).unwrap();
        let mut list = Passes::default();
        passes.halve(&mut list);
        passes.forward(&mut list, step);
        passes.backward(&mut list, step, slopes);
        list.submit(gpu);
        let mut of_images: Vec<params::Ray> = gpu.read(&slot.rays, rays.len()).unwrap();
        for (ix, ray) in of_images.iter_mut().enumerate() {
            ray.code = u32::try_from(ix / RAYS_PER_IMAGE).unwrap();
        }
        gpu.write(&slot.rays, 0, bytemuck::cast_slice(&of_images));
        passes.pose_slopes(&mut list, step, &images);
        passes.code_slopes(&mut list, step, &images);
        passes.learn_images(&mut list, &moments, &images);
        list.submit(gpu);

        let loose = looser(widths);
        let mut wrong = Mismatches::default();
        let got: Vec<[[f32; 4]; 2]> = gpu.read(&images.v_rays, rays.len()).unwrap();
        let v_codes: Vec<[f32; 4]> = gpu.read(&images.v_codes, batch.n_samples as usize).unwrap();
        for (ix, (got, expected)) in got.iter().zip(&expected).enumerate() {
            let samples =
                of_images[ix].first_sample as usize..(of_images[ix].first_sample + of_images[ix].n_samples) as usize;
            let code = |axis: usize| v_codes[samples.clone()].iter().map(|v| v[axis]).sum::<f32>();
            for axis in 0..3 {
                for (part, got) in [got[0][axis], got[1][axis], code(axis)].into_iter().enumerate() {
                    let what = format!("ray {ix}, part {part}, axis {axis}");
                    wrong.check(what, got.into(), expected[part][axis], 2e-5 * loose * largest[part], 2e-4 * loose);
                }
            }
        }
        let terms: Vec<[params::Term; params::TERM_STRIDE]> = gpu.read(&images.terms, N_IMAGES + 1).unwrap();
        for (image, of_image) in expected.chunks(RAYS_PER_IMAGE).enumerate() {
            for (term, got) in terms[image].iter().enumerate() {
                if learned & (1 << term) == 0 {
                    assert_eq!(*got, [0.0; 4], "image {image}: term {term} is not learned");
                    continue;
                }
                let (part, axis) = (term / 3, term % 3);
                let sum: f64 = of_image.iter().map(|ray| ray[part][axis]).sum();
                let [value, first, second, n_steps] = got.map(f64::from);
                let what = |name: &str| format!("image {image}, term {term}, {name}");
                wrong.check(what("slope"), first / 0.1, sum, 5e-5 * loose * largest[part], 2e-4 * loose);
                wrong.check(what("square"), second / 0.01, (first / 0.1).powi(2), 1e-12, 1e-4);
                // A first step goes as far as the rate says, and half of it is pulled back.
                wrong.check(what("value"), value, -0.5 * RATES[part] * first.signum(), 1e-6, 1e-5);
                wrong.check(what("steps"), n_steps, 1.0, 1e-9, 0.0);
            }
        }
        wrong.assert_none();
        assert_eq!(terms[N_IMAGES], [[0.0; 4]; params::TERM_STRIDE], "an image without rays stays where it is");

        gpu.write(&slot.rays, 0, bytemuck::cast_slice(&of_images));
        FieldPasses { terms: &images.terms, ..passes }.aim(&mut list);
        list.submit(gpu);
        let aimed: Vec<params::Ray> = gpu.read(&slot.rays, rays.len()).unwrap();
        for (ix, (ray, got)) in rays.iter().zip(aimed).enumerate() {
            let value = |term: usize| f64::from(terms[ix / RAYS_PER_IMAGE][term][0]);
            let pose = ImagePose { turn_rad: [0, 1, 2].map(value), shift: [3, 4, 5].map(value) };
            let (origin, direction) = pose.aim(ray.origin, ray.direction);
            for axis in 0..3 {
                wrong.check(format!("origin {ix} {axis}"), got.origin[axis].into(), origin[axis], 1e-6, 1e-6);
                wrong.check(format!("direction {ix} {axis}"), got.direction[axis].into(), direction[axis], 1e-6, 1e-6);
            }
        }
        wrong.assert_none();
    }
}

/// Steps of both, each from its own gradients.
#[test]
fn steps_of_learning_match_the_twin() {
    const N_STEPS: u32 = 4;
    let rays = rays();
    let mut twin = field(7);
    let of_grid = LearnRule {
        rate: 0.02,
        final_rate_frac: 0.25,
        betas: [0.75, 0.875],
        epsilon: 1e-4, // Small slopes, which f32 knows less well, move less.
        pull: 0.0,
        n_planned_steps: 4.0,
        unused: 0.0,
    };
    let of_weights = LearnRule { rate: 0.01, pull: 0.5, ..of_grid };
    let first_scale = 2f32.powi(28); // Fine enough for the first step; the others find their own.
    let options = GpuOptions { matrices: false, ..GpuOptions::default() }; // A step is as long for a slope of f16's noise.
    let bench = bench(&options, &twin, &rays, &vec![first_scale; twin.shape.n_cells.len()]);
    let Bench { gpu, pipelines, widths, field: buffers, samples, step: kept_step, slopes, slot, terms } = &bench;
    let moments = FieldMoments::new(gpu, &twin.shape, widths, &of_grid).unwrap();
    let rules = [gpu.uniform_with("rule", &of_grid), gpu.uniform_with("rule", &of_weights)];
    let passes = FieldPasses { gpu, pipelines, field: buffers, samples, slot, terms };
    let adam = Adam { beta1: 0.75, beta2: 0.875, epsilon: f64::from(of_grid.epsilon) };
    let mut kept_table = vec![[Moments::default(); 2]; twin.table.len()];
    let mut kept =
        [vec![Moments::default(); twin.density.weights.len()], vec![Moments::default(); twin.color.weights.len()]];
    for step in 0..N_STEPS {
        let mut list = Passes::default();
        passes.halve(&mut list);
        passes.forward(&mut list, kept_step);
        passes.backward(&mut list, kept_step, slopes);
        passes.learn(&mut list, [&rules[0], &rules[1]], kept_step, slopes, &moments);
        list.submit(gpu);

        let gradient = expected(&twin, &rays);
        let falling = 0.25f64.powf(f64::from(step) / 4.0);
        for ((entry, slope), kept) in twin.table.iter_mut().zip(&gradient.table).zip(&mut kept_table) {
            for feature in 0..2 {
                if *slope != [0.0; 2] {
                    adam.update(step + 1, 0.02 * falling, &mut entry[feature], slope[feature], &mut kept[feature]);
                }
            }
        }
        let networks = [(&mut twin.density, &gradient.density), (&mut twin.color, &gradient.color)];
        for ((network, slopes), kept) in networks.into_iter().zip(&mut kept) {
            for ((weight, slope), kept) in network.weights.iter_mut().zip(slopes).zip(kept) {
                let pulled = 0.01 * falling * 0.5 * *weight;
                adam.update(step + 1, 0.01 * falling, weight, *slope, kept);
                *weight -= pulled;
            }
        }
    }
    let mut wrong = Mismatches::default();
    let got: Vec<[f32; 2]> = gpu.read(&buffers.grid, twin.table.len()).unwrap();
    for (ix, (got, expected)) in got.as_flattened().iter().zip(twin.table.as_flattened()).enumerate() {
        wrong.check(format!("entry {ix}"), (*got).into(), *expected, 4e-4, 1e-4);
    }
    let got: Vec<f32> = gpu.read(&buffers.weights, widths.n_weights() as usize).unwrap();
    let of_weights = [&twin.density.weights[..], &twin.color.weights].concat();
    check_weights(&mut wrong, &got, &twin, widths, &of_weights, [4e-4; 2]);
    wrong.assert_none();
    assert_eq!(gpu.read::<u32>(&moments.steps, 1).unwrap(), [N_STEPS]);
    assert!(gpu.read::<i32>(&slopes.grid, 2 * twin.table.len()).unwrap().iter().all(|sum| *sum == 0));
    // A tenth of a level's largest slope still has 19 bits.
    let scales: Vec<f32> = gpu.read(&slopes.scales, twin.shape.n_cells.len()).unwrap();
    assert!(scales.iter().all(|scale| scale.log2().fract() == 0.0), "{scales:?}");
    assert!(scales.iter().any(|scale| *scale != first_scale), "{scales:?}");
}

/// The first step of the weights, along the slopes that were summed: without a twin's, which are too far off those of f16 to decide where
/// a small slope points.
#[test]
fn a_first_step_goes_along_the_slopes_that_were_summed() {
    let (twin, rays) = (field(7), rays());
    for options in forms() {
        let bench = bench(&options, &twin, &rays, &vec![1.0; twin.shape.n_cells.len()]);
        let Bench { gpu, pipelines, widths, field, samples, step, slopes, slot, terms } = &bench;
        let passes = FieldPasses { gpu, pipelines, field, samples, slot, terms };
        let rule = LearnRule {
            rate: 0.01,
            final_rate_frac: 1.0,
            betas: [0.75, 0.875],
            epsilon: 1e-4,
            pull: 0.5,
            n_planned_steps: 1.0,
            unused: 0.0,
        };
        let moments = FieldMoments::new(gpu, &twin.shape, widths, &rule).unwrap();
        let rules = [gpu.uniform_with("rule", &rule), gpu.uniform_with("rule", &rule)];
        let mut list = Passes::default();
        passes.halve(&mut list);
        passes.forward(&mut list, step);
        passes.backward(&mut list, step, slopes);
        passes.learn(&mut list, [&rules[0], &rules[1]], step, slopes, &moments);
        list.submit(gpu);
        let before = weights(&twin, widths);
        let got: Vec<f32> = gpu.read(&field.weights, before.len()).unwrap();
        let n_samples = gpu.read::<u32>(&samples.batch, 2).unwrap()[1];
        let mut wrong = Mismatches::default();
        let mut n_moved = 0;
        for (ix, (slope, before)) in summed(gpu, step, widths, n_samples).into_iter().zip(before).enumerate() {
            let (slope, before) = (f64::from(slope), f64::from(before));
            let expected = before - 0.01 * (slope / (slope.abs() + 1e-4) + 0.5 * before);
            wrong.check(format!("weight {ix}"), got[ix].into(), expected, 2e-5, 1e-5);
            n_moved += usize::from(slope.abs() > 1e-5);
        }
        wrong.assert_none();
        assert!(n_moved > 100, "only {n_moved} weights have slopes to speak of");
    }
}

#[test]
fn slopes_too_large_for_their_scale_are_counted_and_left_out() {
    let (twin, rays) = (field(7), rays());
    let bench = bench(&GpuOptions::default(), &twin, &rays, &vec![f32::MAX; twin.shape.n_cells.len()]);
    let Bench { gpu, pipelines, field, samples, step, slopes, slot, terms, .. } = &bench;
    let mut list = Passes::default();
    let passes = FieldPasses { gpu, pipelines, field, samples, slot, terms };
    passes.halve(&mut list);
    passes.forward(&mut list, step);
    passes.backward(&mut list, step, slopes);
    list.submit(gpu);
    let n_lost = gpu.read::<u32>(&slopes.counts, 1).unwrap()[0];
    assert!(n_lost > N_RAYS * 7 * 8, "only {n_lost}");
    assert!(gpu.read::<i32>(&slopes.grid, 2 * twin.table.len()).unwrap().iter().all(|sum| *sum == 0));
}

#[test]
fn every_kernel_parses_and_validates_and_structs_have_the_same_layout() {
    for kernel in KERNELS {
        let module = reflect(kernel.source.name, &resolve(kernel.source, kernel.shared).unwrap()).unwrap();
        for (_, found) in module.types.iter() {
            let wgpu::naga::TypeInner::Struct { span, .. } = &found.inner else { continue };
            let in_rust = match found.name.as_deref() {
                Some("Batch") => size_of::<Batch>(),
                Some("Ray") => size_of::<params::Ray>(),
                Some("Span") => size_of::<Span>(),
                Some("March") => size_of::<params::March>(),
                Some("Visit") => size_of::<params::Visit>(),
                Some("Backdrop") => size_of::<params::Backdrop>(),
                Some("Level") => size_of::<Level>(),
                Some("RayLoss") => size_of::<RayLoss>(),
                Some("Pace") => size_of::<params::Pace>(),
                Some("TermRule") => size_of::<TermRule>(),
                Some("LearnRule") => size_of::<LearnRule>(),
                _ => continue,
            };
            assert_eq!(*span as usize, in_rust, "{:?} in {}", found.name, kernel.source.name);
        }
    }
}
