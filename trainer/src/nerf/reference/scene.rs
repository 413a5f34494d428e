//! A small field and rays through it, for tests of the reference and of the kernels; numbers that f32 holds exactly.

use super::field::{Field, FieldGrad};
use super::grid::GridShape;
use super::network::Network;
use super::ray::{self, Sample, Target, Weights};
use crate::splat::reference::scene::Random;

fn rounded(value: f64) -> f64 {
    f64::from(crate::gpu::f32_of(value))
}

pub(crate) const N_CODE: usize = 3;

fn shape() -> GridShape {
    GridShape::between(2, 13, 4, 6) // The first level has an entry a corner, the others share 64.
}

fn network(random: &mut Random, sizes: Vec<usize>) -> Network {
    let weights = (0..Network::n_weights(&sizes)).map(|_| random.uniform(-0.6, 0.6)).collect();
    Network { sizes, weights }
}

pub(crate) fn field(seed: u64) -> Field {
    let mut random = Random::new(seed);
    let shape = shape();
    let [density, color] = Field::sizes(&shape, 7, N_CODE);
    Field {
        table: (0..shape.n_entries_in_all()).map(|_| random.array(-0.8, 0.8)).collect(),
        density: network(&mut random, density),
        color: network(&mut random, color),
        shape,
    }
}

/// A ray with samples within the inner cube and outside of it, its image's code and target.
pub(crate) struct Ray {
    pub(crate) origin: [f64; 3],
    pub(crate) direction: [f64; 3],
    pub(crate) spans: Vec<[f64; 2]>,
    pub(crate) code: Vec<f64>,
    pub(crate) target: Target,
}

pub(crate) fn ray(seed: u64) -> Ray {
    let mut random = Random::new(seed);
    let direction = nalgebra::Vector3::from(random.array(-1.0, 1.0)).normalize().map(rounded);
    let mut walked = 0.2;
    let span = |_| {
        let begin = rounded(walked + random.uniform(0.02, 0.2));
        walked = rounded(begin + random.uniform(0.1, 0.6));
        [begin, walked]
    };
    let spans = (0..7).map(span).collect();
    let code = random.array::<N_CODE>(-0.5, 0.5).to_vec();
    let target =
        Target { rgb: random.array(0.1, 0.9).map(|value: f64| (255.0 * value).round() / 255.0), distance: 1.75 };
    Ray { origin: random.array(-0.4, 0.4), direction: direction.into(), spans, code, target }
}

pub(crate) const WEIGHTS: Weights = Weights {
    distance_weight: 0.5,
    distance_clip: 5.0,
    distortion: 0.25,
    near: 0.125,
    sight: 0.5,
    band: [0.0625, 0.125],
    background_rgb: [0.25, 0.5, 0.75],
};

fn place(ray: &Ray, span: [f64; 2]) -> [f64; 3] {
    std::array::from_fn(|axis| ray.origin[axis] + 0.5 * (span[0] + span[1]) * ray.direction[axis])
}

pub(crate) fn samples(field: &Field, ray: &Ray) -> Vec<Sample> {
    samples_seen_along(field, ray, ray.direction)
}

/// The samples of a ray as they look along another direction.
fn samples_seen_along(field: &Field, ray: &Ray, direction: [f64; 3]) -> Vec<Sample> {
    let sample = |span: &[f64; 2]| {
        let point = field.point(place(ray, *span), direction, &ray.code);
        Sample { span: *span, density: point.density, rgb: point.rgb }
    };
    ray.spans.iter().map(sample).collect()
}

pub(crate) fn loss(field: &Field, ray: &Ray) -> f64 {
    loss_seen_along(field, ray, ray.direction)
}

/// As [`loss`], with colors as they look along another direction.
pub(crate) fn loss_seen_along(field: &Field, ray: &Ray, direction: [f64; 3]) -> f64 {
    let samples = samples_seen_along(field, ray, direction);
    ray::loss(&samples, &ray::composite(&samples), &ray.target, &WEIGHTS).0
}

/// Distance along a ray and slope of each of its samples.
pub(crate) type Places = Vec<(f64, [f64; 3])>;

/// Gradient by the parameters, by the places of the samples (with their distance along the ray), and by the image's code.
pub(crate) fn gradient(field: &Field, ray: &Ray) -> (FieldGrad, Places, Vec<f64>) {
    let samples = samples(field, ray);
    let seen = ray::composite(&samples);
    let (_, upstream) = ray::loss(&samples, &seen, &ray.target, &WEIGHTS);
    let slopes = ray::composite_backward(&samples, &seen, &upstream);
    let (mut gradient, mut v_places, mut v_code) = (FieldGrad::zeros(field), Vec::new(), vec![0.0; N_CODE]);
    for (span, (v_density, v_rgb)) in ray.spans.iter().zip(slopes) {
        let at = place(ray, *span);
        let point = field.point(at, ray.direction, &ray.code);
        let (v_at, v_own) = field.point_backward(at, &point, v_density, v_rgb, &mut gradient);
        v_places.push((0.5 * (span[0] + span[1]), v_at));
        v_code.iter_mut().zip(v_own).for_each(|(sum, v)| *sum += v);
    }
    (gradient, v_places, v_code)
}
