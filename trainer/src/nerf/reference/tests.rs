//! Tests of gradients against central differences, and of each part against its definition.

use super::field::Field;
use super::grid::{self, GridShape};
use super::pose::ImagePose;
use super::ray::{self, Sample};
use super::scene::{EMBEDDING_DIM, Ray, field, gradient, loss, loss_viewed_along, ray};
use super::space::contract_backward;
use crate::mismatches::Mismatches;
use model_files::contraction::contract;

const NUDGE: f64 = 1e-5;
const ABS: f64 = 1e-9;
const REL: f64 = 1e-5;
fn central(at: impl Fn(f64) -> f64) -> f64 {
    (at(NUDGE) - at(-NUDGE)) / (2.0 * NUDGE)
}

#[test]
fn ray_gradients_match_central_differences() {
    let mut mismatches = Mismatches::default();
    for seed in [3, 4, 5] {
        let field = field(seed);
        let ray = ray(seed + 10);
        let (gradients, v_positions, v_embedding) = gradient(&field, &ray);
        let nudged = |change: &dyn Fn(&mut Field, f64), step: f64| {
            let mut field = field.clone();
            change(&mut field, step);
            loss(&field, &ray)
        };
        for (ix, entry) in gradients.table.iter().enumerate() {
            for (feature, derivative) in entry.iter().enumerate() {
                let numeric =
                    central(|step| nudged(&|field, step| field.table[ix][feature] += step, step));
                mismatches.check(
                    format!("{seed}: entry {ix} {feature}"),
                    *derivative,
                    numeric,
                    ABS,
                    REL,
                );
            }
        }
        for (ix, derivative) in gradients.density.iter().enumerate() {
            let numeric =
                central(|step| nudged(&|field, step| field.density.weights[ix] += step, step));
            mismatches.check(
                format!("{seed}: density {ix}"),
                *derivative,
                numeric,
                ABS,
                REL,
            );
        }
        for (ix, derivative) in gradients.color.iter().enumerate() {
            let numeric =
                central(|step| nudged(&|field, step| field.color.weights[ix] += step, step));
            mismatches.check(
                format!("{seed}: color {ix}"),
                *derivative,
                numeric,
                ABS,
                REL,
            );
        }
        let pose = ImagePose::gradients(ray.direction, &v_positions);
        for axis in 0..3 {
            let moved = |pose: ImagePose| {
                let (origin, direction) = pose.apply_pose(ray.origin, ray.direction);
                let moved = Ray {
                    origin,
                    direction,
                    spans: ray.spans.clone(),
                    embedding: ray.embedding.clone(),
                    ..ray
                };
                loss_viewed_along(&field, &moved, ray.direction)
            };
            let along =
                |step: f64| std::array::from_fn(|other| if other == axis { step } else { 0.0 });
            let translated = |step: f64| {
                moved(ImagePose {
                    translation: along(step),
                    ..ImagePose::default()
                })
            };
            mismatches.check(
                format!("{seed}: translation {axis}"),
                pose.translation[axis],
                central(translated),
                ABS,
                REL,
            );
            let rotated = |step: f64| {
                moved(ImagePose {
                    rotation_rad: along(step),
                    ..ImagePose::default()
                })
            };
            mismatches.check(
                format!("{seed}: rotation {axis}"),
                pose.rotation_rad[axis],
                central(rotated),
                ABS,
                REL,
            );
        }
        for ix in 0..EMBEDDING_DIM {
            let moved = |step: f64| {
                let mut embedding = ray.embedding.clone();
                embedding[ix] += step;
                loss(
                    &field,
                    &Ray {
                        embedding,
                        spans: ray.spans.clone(),
                        ..ray
                    },
                )
            };
            mismatches.check(
                format!("{seed}: embedding {ix}"),
                v_embedding[ix],
                central(moved),
                ABS,
                REL,
            );
        }
    }
    mismatches.assert_none();
}

#[test]
fn gradients_of_the_contraction_match_central_differences() {
    let mut mismatches = Mismatches::default();
    let upstream = [0.7, -0.4, 0.9];
    for at in [
        [0.15, -0.4, 0.45],
        [4.0, -2.5, 0.5],
        [-10.5, 14.0, -26.5],
        [0.5, 0.25, -5.0],
    ] {
        let gradients = contract_backward(at, upstream);
        for axis in 0..3 {
            let numeric = central(|step| {
                let mut moved = at;
                moved[axis] += step;
                contract(moved)
                    .iter()
                    .zip(upstream)
                    .map(|(x, v)| x * v)
                    .sum()
            });
            mismatches.check(
                format!("{at:?} {axis}"),
                gradients[axis],
                numeric,
                1e-9,
                1e-6,
            );
        }
    }
    mismatches.assert_none();
}

#[test]
fn grid_interpolates_linearly_between_corners() {
    let shape = GridShape {
        n_cells: vec![4],
        log2_entries: 10,
    };
    // Interpolation reproduces a linear function everywhere.
    let linear = |at: [f64; 3]| [0.3 + at[0] - 2.0 * at[1] + 0.5 * at[2], at[0] * 3.0 - at[2]];
    let mut table = vec![[0.0; 2]; shape.n_entries_total() as usize];
    for ix in 0..125u32 {
        let corner = [ix % 5, ix / 5 % 5, ix / 25];
        table[shape.entry(0, corner) as usize] = linear(corner.map(|x| f64::from(x) / 4.0));
    }
    for at in [[0.0; 3], [1.0; 3], [0.25, 0.5, 0.75], [0.13, 0.99, 0.47]] {
        let found = grid::interpolate(&shape, &table, at);
        let expected = linear(at);
        assert!(
            found
                .iter()
                .zip(expected)
                .all(|(found, expected)| (found - expected).abs() < 1e-12),
            "{at:?}: {found:?}"
        );
    }
}

#[test]
fn levels_grow_evenly_and_large_levels_hash() {
    let shape = GridShape::between(16, 2048, 16, 19);
    assert_eq!((shape.n_cells[0], shape.n_cells[15]), (16, 2048));
    assert!(
        shape
            .n_cells
            .windows(2)
            .all(|pair| pair[1] > pair[0] && pair[1] < 2 * pair[0])
    );
    assert_eq!(
        (shape.n_entries(0), shape.n_entries(15)),
        (17 * 17 * 17, 1 << 19)
    );
    let hit: std::collections::BTreeSet<u32> = (0..20_000)
        .map(|ix| shape.entry(15, [ix % 29, ix / 29 % 31, ix / 899]))
        .collect();
    assert!(
        hit.len() > 19_000,
        "few corners may share an entry while entries are plentiful: {} distinct",
        hit.len()
    );
    assert!(
        hit.iter()
            .all(|entry| *entry >= shape.begin(15) && *entry < shape.n_entries_total())
    );
}

#[test]
fn weights_sum_to_one_and_opaque_samples_occlude() {
    let sample = |begin: f64, density: f64, red: f64| Sample {
        span: [begin, begin + 0.5],
        density,
        rgb: [red, 0.0, 1.0],
    };
    let samples = [
        sample(1.0, 0.5, 0.2),
        sample(1.5, 1e3, 0.9),
        sample(2.0, 2.0, 0.1),
    ];
    let rendered = ray::composite(&samples);
    assert!((rendered.weights.iter().sum::<f64>() + rendered.transmittance - 1.0).abs() < 1e-12);
    let first = 1.0 - (-0.25f64).exp();
    assert!(
        (rendered.rgb[0] - (first * 0.2 + (1.0 - first) * 0.9)).abs() < 1e-9
            && rendered.weights[2] < 1e-9
    );
    assert!((rendered.distance - (first * 1.25 + (1.0 - first) * 1.75)).abs() < 1e-9);
}

/// Compares with the sum over all pairs, which is the definition.
#[test]
fn one_pass_distortion_equals_pairwise_sum() {
    let samples: Vec<Sample> = [[1.0, 1.4], [1.5, 1.9], [1.9, 4.0], [6.0, 7.0]]
        .map(|span| Sample {
            span,
            density: 1.0,
            rgb: [0.0; 3],
        })
        .to_vec();
    let weights = [0.1, 0.4, 0.2, 0.15];
    let normalized_distance = |t: f64| 1.0 - 0.5 / t;
    let middle = |ix: usize| {
        0.5 * (normalized_distance(samples[ix].span[0]) + normalized_distance(samples[ix].span[1]))
    };
    let mut expected = 0.0;
    for i in 0..4 {
        for j in 0..4 {
            expected += weights[i] * weights[j] * (middle(i) - middle(j)).abs();
        }
        expected += weights[i]
            * weights[i]
            * (normalized_distance(samples[i].span[1]) - normalized_distance(samples[i].span[0]))
            / 3.0;
    }
    assert!((ray::distortion(&samples, &weights, 0.5).0 - expected).abs() < 1e-12);
    let alone = ray::distortion(&samples, &[0.0, 1e-9, 0.0, 0.0], 0.5);
    assert!(
        alone.0 < 1e-12,
        "weight at one position has no distortion: {}",
        alone.0
    );
}
