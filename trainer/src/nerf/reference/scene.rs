//! A small field and rays through it, for tests of the reference and of the kernels. Uses numbers
//! that f32 holds exactly.

use super::field::{Field, FieldGrad};
use super::grid::GridShape;
use super::network::Network;
use super::ray::{self, Sample, Target, Weights};
use crate::random::F32Random;

fn rounded(value: f64) -> f64 {
    f64::from(numbers::f32_of(value))
}

pub(crate) const EMBEDDING_DIM: usize = 3;

fn shape() -> GridShape {
    GridShape::between(2, 13, 4, 6) // The first level has one entry per corner, the others share 64.
}

fn network(random: &mut F32Random, sizes: Vec<usize>) -> Network {
    let weights = (0..Network::n_weights(&sizes))
        .map(|_| random.uniform(-0.6, 0.6))
        .collect();
    Network { sizes, weights }
}

pub(crate) fn field(seed: u64) -> Field {
    let mut random = F32Random::new(seed);
    let shape = shape();
    let [density, color] = Field::sizes(&shape, 7, EMBEDDING_DIM);
    Field {
        table: (0..shape.n_entries_total())
            .map(|_| random.array(-0.8, 0.8))
            .collect(),
        density: network(&mut random, density),
        color: network(&mut random, color),
        shape,
    }
}

/// A ray with samples inside and outside the inner cube, with appearance embedding and target.
pub(crate) struct Ray {
    pub(crate) origin: [f64; 3],
    pub(crate) direction: [f64; 3],
    pub(crate) spans: Vec<[f64; 2]>,
    pub(crate) embedding: Vec<f64>,
    pub(crate) target: Target,
}

pub(crate) fn ray(seed: u64) -> Ray {
    let mut random = F32Random::new(seed);
    let direction = nalgebra::Vector3::from(random.array(-1.0, 1.0))
        .normalize()
        .map(rounded);
    let mut cursor = 0.2;
    let mut spans = Vec::new();
    for _ in 0..7 {
        let begin = rounded(cursor + random.uniform(0.02, 0.2));
        cursor = rounded(begin + random.uniform(0.1, 0.6));
        spans.push([begin, cursor]);
    }
    let embedding = random.array::<EMBEDDING_DIM>(-0.5, 0.5).to_vec();
    let target = Target {
        rgb: random
            .array(0.1, 0.9)
            .map(|value: f64| (255.0 * value).round() / 255.0),
        distance: 1.75,
    };
    Ray {
        origin: random.array(-0.4, 0.4),
        direction: direction.into(),
        spans,
        embedding,
        target,
    }
}

pub(crate) const WEIGHTS: Weights = Weights {
    distance_weight: 0.5,
    distance_clip: 5.0,
    distortion: 0.25,
    near: 0.125,
    line_of_sight: 0.5,
    band: [0.0625, 0.125],
    background_rgb: [0.25, 0.5, 0.75],
};

fn sample_position(ray: &Ray, span: [f64; 2]) -> [f64; 3] {
    std::array::from_fn(|axis| ray.origin[axis] + 0.5 * (span[0] + span[1]) * ray.direction[axis])
}

pub(crate) fn samples(field: &Field, ray: &Ray) -> Vec<Sample> {
    samples_viewed_along(field, ray, ray.direction)
}

/// The samples of a ray, with colors viewed along another direction.
fn samples_viewed_along(field: &Field, ray: &Ray, direction: [f64; 3]) -> Vec<Sample> {
    ray.spans
        .iter()
        .map(|span| {
            let point = field.point(sample_position(ray, *span), direction, &ray.embedding);
            Sample {
                span: *span,
                density: point.density,
                rgb: point.rgb,
            }
        })
        .collect()
}

pub(crate) fn loss(field: &Field, ray: &Ray) -> f64 {
    loss_viewed_along(field, ray, ray.direction)
}

/// Like [`loss`], with colors viewed along another direction.
pub(crate) fn loss_viewed_along(field: &Field, ray: &Ray, direction: [f64; 3]) -> f64 {
    let samples = samples_viewed_along(field, ray, direction);
    ray::loss(&samples, &ray::composite(&samples), &ray.target, &WEIGHTS).0
}

/// Distance along a ray and gradient of each of its samples.
pub(crate) type SamplePositions = Vec<(f64, [f64; 3])>;

/// Gradient with respect to the parameters, the positions of the samples (with their distance along
/// the ray), and the appearance embedding.
pub(crate) fn gradient(field: &Field, ray: &Ray) -> (FieldGrad, SamplePositions, Vec<f64>) {
    let samples = samples(field, ray);
    let rendered = ray::composite(&samples);
    let (_, upstream) = ray::loss(&samples, &rendered, &ray.target, &WEIGHTS);
    let gradients = ray::composite_backward(&samples, &rendered, &upstream);
    let mut gradient = FieldGrad::zeros(field);
    let mut v_positions = Vec::new();
    let mut v_embedding = vec![0.0; EMBEDDING_DIM];
    for (span, (v_density, v_rgb)) in ray.spans.iter().zip(gradients) {
        let at = sample_position(ray, *span);
        let point = field.point(at, ray.direction, &ray.embedding);
        let (v_at, v_ray_embedding) =
            field.point_backward(at, &point, v_density, v_rgb, &mut gradient);
        v_positions.push((0.5 * (span[0] + span[1]), v_at));
        v_embedding
            .iter_mut()
            .zip(v_ray_embedding)
            .for_each(|(sum, v)| *sum += v);
    }
    (gradient, v_positions, v_embedding)
}
