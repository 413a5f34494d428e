//! Gradients against central differences, and the parts against what they are defined by.

use super::field::{Field, FieldGrad};
use super::grid::{self, GridShape};
use super::network::Network;
use super::ray::{self, Sample, Target, Weights};
use super::space::Space;
use crate::mismatches::Mismatches;
use crate::splat::reference::scene::Random;

const NUDGE: f64 = 1e-5;
const ABS: f64 = 1e-9;
const REL: f64 = 1e-5;
const N_CODE: usize = 3;

fn shape() -> GridShape {
    GridShape::between(2, 13, 4, 6) // The first level has an entry a corner, the others share 64.
}

fn network(random: &mut Random, sizes: Vec<usize>) -> Network {
    let weights = (0..Network::n_weights(&sizes)).map(|_| random.uniform(-0.6, 0.6)).collect();
    Network { sizes, weights }
}

fn field(seed: u64) -> Field {
    let mut random = Random::new(seed);
    let shape = shape();
    let [density, color] = Field::sizes(&shape, 7, N_CODE);
    Field {
        space: Space { center_m: [0.1, -0.2, 0.3], radius_m: 1.3 },
        table: (0..shape.n_entries_in_all()).map(|_| random.array(-0.8, 0.8)).collect(),
        density: network(&mut random, density),
        color: network(&mut random, color),
        shape,
    }
}

/// A ray with samples within the inner cube and outside of it, its image's code and target.
struct Ray {
    origin_m: [f64; 3],
    direction: [f64; 3],
    spans_m: Vec<[f64; 2]>,
    code: Vec<f64>,
    target: Target,
}

fn ray(seed: u64) -> Ray {
    let mut random = Random::new(seed);
    let direction = nalgebra::Vector3::from(random.array(-1.0, 1.0)).normalize();
    let mut at_m = 0.2;
    let span = |_| {
        let begin = at_m + random.uniform(0.02, 0.2);
        at_m = begin + random.uniform(0.1, 0.6);
        [begin, at_m]
    };
    let spans_m = (0..7).map(span).collect();
    let code = random.array::<N_CODE>(-0.5, 0.5).to_vec();
    let target = Target { rgb: random.array(0.1, 0.9), distance_m: 1.7 };
    Ray { origin_m: random.array(-0.4, 0.4), direction: direction.into(), spans_m, code, target }
}

const WEIGHTS: Weights = Weights {
    distance_per_m: 0.4,
    distance_clip_m: 5.0,
    distortion: 0.3,
    near_m: 0.1,
    background_rgb: [0.2, 0.5, 0.7],
};

fn place(ray: &Ray, span_m: [f64; 2]) -> [f64; 3] {
    std::array::from_fn(|axis| ray.origin_m[axis] + 0.5 * (span_m[0] + span_m[1]) * ray.direction[axis])
}

fn samples(field: &Field, ray: &Ray) -> Vec<Sample> {
    let sample = |span_m: &[f64; 2]| {
        let point = field.point(place(ray, *span_m), ray.direction, &ray.code);
        Sample { span_m: *span_m, density: point.density, rgb: point.rgb }
    };
    ray.spans_m.iter().map(sample).collect()
}

fn loss(field: &Field, ray: &Ray) -> f64 {
    let samples = samples(field, ray);
    ray::loss(&samples, &ray::composite(&samples), &ray.target, &WEIGHTS).0
}

/// Gradient by the parameters, by the ray's origin, and by the image's code.
fn gradient(field: &Field, ray: &Ray) -> (FieldGrad, [f64; 3], Vec<f64>) {
    let samples = samples(field, ray);
    let seen = ray::composite(&samples);
    let (_, upstream) = ray::loss(&samples, &seen, &ray.target, &WEIGHTS);
    let slopes = ray::composite_backward(&samples, &seen, &upstream);
    let (mut gradient, mut v_origin, mut v_code) = (FieldGrad::zeros(field), [0.0; 3], vec![0.0; N_CODE]);
    for (span_m, (v_density, v_rgb)) in ray.spans_m.iter().zip(slopes) {
        let world_m = place(ray, *span_m);
        let point = field.point(world_m, ray.direction, &ray.code);
        let (v_world, v_own) = field.point_backward(world_m, &point, v_density, v_rgb, &mut gradient);
        for axis in 0..3 {
            v_origin[axis] += v_world[axis];
        }
        v_code.iter_mut().zip(v_own).for_each(|(sum, v)| *sum += v);
    }
    (gradient, v_origin, v_code)
}

fn central(at: impl Fn(f64) -> f64) -> f64 {
    (at(NUDGE) - at(-NUDGE)) / (2.0 * NUDGE)
}

#[test]
fn gradients_of_a_ray_match_central_differences() {
    let mut wrong = Mismatches::default();
    for seed in [3, 4, 5] {
        let (field, ray) = (field(seed), ray(seed + 10));
        let (slopes, v_origin, v_code) = gradient(&field, &ray);
        let nudged = |change: &dyn Fn(&mut Field, f64), step: f64| {
            let mut field = field.clone();
            change(&mut field, step);
            loss(&field, &ray)
        };
        for (ix, entry) in slopes.table.iter().enumerate() {
            for feature in 0..2 {
                let numeric = central(|step| nudged(&|field, step| field.table[ix][feature] += step, step));
                wrong.check(format!("{seed}: entry {ix} {feature}"), entry[feature], numeric, ABS, REL);
            }
        }
        for (ix, slope) in slopes.density.iter().enumerate() {
            let numeric = central(|step| nudged(&|field, step| field.density.weights[ix] += step, step));
            wrong.check(format!("{seed}: density {ix}"), *slope, numeric, ABS, REL);
        }
        for (ix, slope) in slopes.color.iter().enumerate() {
            let numeric = central(|step| nudged(&|field, step| field.color.weights[ix] += step, step));
            wrong.check(format!("{seed}: color {ix}"), *slope, numeric, ABS, REL);
        }
        for axis in 0..3 {
            let moved = |step: f64| {
                let mut origin_m = ray.origin_m;
                origin_m[axis] += step;
                loss(&field, &Ray { origin_m, spans_m: ray.spans_m.clone(), code: ray.code.clone(), ..ray })
            };
            wrong.check(format!("{seed}: origin {axis}"), v_origin[axis], central(moved), ABS, REL);
        }
        for ix in 0..N_CODE {
            let moved = |step: f64| {
                let mut code = ray.code.clone();
                code[ix] += step;
                loss(&field, &Ray { code, spans_m: ray.spans_m.clone(), ..ray })
            };
            wrong.check(format!("{seed}: code {ix}"), v_code[ix], central(moved), ABS, REL);
        }
    }
    wrong.assert_none();
}

#[test]
fn contraction_keeps_the_inside_and_draws_in_the_outside() {
    let space = Space { center_m: [1.0, 2.0, 3.0], radius_m: 2.0 };
    assert_eq!(space.contract([1.0, 2.0, 3.0]), [0.5; 3]);
    assert_eq!(space.contract([3.0, 0.0, 3.0]), [0.75, 0.25, 0.5]);
    let far = space.contract([1e9, 2.0, 3.0]);
    assert!(far[0] > 0.999_999 && far[0] < 1.0 && (far[1] - 0.5).abs() < 1e-9, "{far:?}");
    let mut wrong = Mismatches::default();
    let upstream = [0.7, -0.4, 0.9];
    for world_m in [[1.3, 1.2, 3.9], [9.0, -3.0, 4.0], [-20.0, 30.0, -50.0], [2.0, 2.5, -7.0]] {
        let slopes = space.contract_backward(world_m, upstream);
        for axis in 0..3 {
            let numeric = central(|step| {
                let mut moved = world_m;
                moved[axis] += step;
                space.contract(moved).iter().zip(upstream).map(|(x, v)| x * v).sum()
            });
            wrong.check(format!("{world_m:?} {axis}"), slopes[axis], numeric, 1e-9, 1e-6);
        }
    }
    wrong.assert_none();
}

#[test]
fn a_grid_returns_what_its_corners_hold_and_lines_between_them() {
    let shape = GridShape { n_cells: vec![4], log2_entries: 10 };
    // A linear function is found again everywhere.
    let linear = |at: [f64; 3]| [0.3 + at[0] - 2.0 * at[1] + 0.5 * at[2], at[0] * 3.0 - at[2]];
    let mut table = vec![[0.0; 2]; shape.n_entries_in_all() as usize];
    for ix in 0..125u32 {
        let corner = [ix % 5, ix / 5 % 5, ix / 25];
        table[shape.entry(0, corner) as usize] = linear(corner.map(|x| f64::from(x) / 4.0));
    }
    for at in [[0.0; 3], [1.0; 3], [0.25, 0.5, 0.75], [0.13, 0.99, 0.47]] {
        let (found, expected) = (grid::look_up(&shape, &table, at), linear(at));
        assert!(
            found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-12),
            "{at:?}: {found:?}"
        );
    }
}

#[test]
fn levels_grow_evenly_and_large_ones_share_entries() {
    let shape = GridShape::between(16, 2048, 16, 19);
    assert_eq!((shape.n_cells[0], shape.n_cells[15]), (16, 2048));
    assert!(shape.n_cells.windows(2).all(|pair| pair[1] > pair[0] && pair[1] < 2 * pair[0]));
    assert_eq!((shape.n_entries(0), shape.n_entries(15)), (17 * 17 * 17, 1 << 19));
    let hit: std::collections::BTreeSet<u32> =
        (0..20_000).map(|ix| shape.entry(15, [ix % 29, ix / 29 % 31, ix / 899])).collect();
    assert!(hit.len() > 19_000, "few share an entry while there are many more entries: {}", hit.len());
    assert!(hit.iter().all(|entry| *entry >= shape.begin(15) && *entry < shape.n_entries_in_all()));
}

#[test]
fn a_ray_adds_up_to_one_and_an_opaque_sample_hides_the_rest() {
    let sample = |begin_m: f64, density: f64, red: f64| Sample {
        span_m: [begin_m, begin_m + 0.5],
        density,
        rgb: [red, 0.0, 1.0],
    };
    let samples = [sample(1.0, 0.5, 0.2), sample(1.5, 1e3, 0.9), sample(2.0, 2.0, 0.1)];
    let seen = ray::composite(&samples);
    assert!((seen.weights.iter().sum::<f64>() + seen.transmittance - 1.0).abs() < 1e-12);
    let first = 1.0 - (-0.25f64).exp();
    assert!((seen.rgb[0] - (first * 0.2 + (1.0 - first) * 0.9)).abs() < 1e-9 && seen.weights[2] < 1e-9);
    assert!((seen.distance_m - (first * 1.25 + (1.0 - first) * 1.75)).abs() < 1e-9);
}

/// The sum over all pairs, as it is defined.
#[test]
fn distortion_in_one_pass_is_the_sum_over_pairs() {
    let samples: Vec<Sample> = [[1.0, 1.4], [1.5, 1.9], [1.9, 4.0], [6.0, 7.0]]
        .map(|span_m| Sample { span_m, density: 1.0, rgb: [0.0; 3] })
        .to_vec();
    let weights = [0.1, 0.4, 0.2, 0.15];
    let place = |t_m: f64| 1.0 - 0.5 / t_m;
    let middle = |ix: usize| 0.5 * (place(samples[ix].span_m[0]) + place(samples[ix].span_m[1]));
    let mut expected = 0.0;
    for i in 0..4 {
        for j in 0..4 {
            expected += weights[i] * weights[j] * (middle(i) - middle(j)).abs();
        }
        expected += weights[i] * weights[i] * (place(samples[i].span_m[1]) - place(samples[i].span_m[0])) / 3.0;
    }
    assert!((ray::distortion(&samples, &weights, 0.5).0 - expected).abs() < 1e-12);
    let alone = ray::distortion(&samples, &[0.0, 1e-9, 0.0, 0.0], 0.5);
    assert!(alone.0 < 1e-12, "light from one short place is not spread: {}", alone.0);
}
