//! Tests of the kernels that bin, update and grow splats, against their f64 twins.

use super::against_twin::{KernelFixture, TargetBuffers, arrays_of, target_of, unambiguous_pixels};
use super::params::{Growth, MIN_OPACITY, Rule, status};
use super::passes::{GrowthBuffers, grow};
use super::reference::change::{self, SplatMoments};
use super::reference::{self, Splat, scene};
use crate::loss::reference as loss_reference;
use crate::mismatches::Mismatches;
use gpu::{Gpu, GpuOptions, Passes};
use model_files::splat::arrays::SplatArrays;
use numbers::f32_of;

/// A small scene of splats with SH degree 3 and with values that f32 represents exactly.
fn full_degree_scene(seed: u64, n: usize) -> Vec<Splat> {
    let mut splats = scene::small_scene(seed, n);
    for splat in &mut splats {
        splat.sh.resize(16, [0.0; 3]);
    }
    splats_of(&arrays_of(&splats))
}

fn splats_of(arrays: &SplatArrays) -> Vec<Splat> {
    let one = |ix: usize| Splat {
        mean: arrays.means[ix].map(f64::from),
        log_scale: arrays.log_scales[ix].map(f64::from),
        rotation_wxyz: arrays.rotations_wxyz[ix].map(f64::from),
        opacity_logit: arrays.opacity_logits[ix].into(),
        sh: arrays.sh[16 * ix..16 * (ix + 1)]
            .iter()
            .map(|rgb| rgb.map(f64::from))
            .collect(),
    };
    (0..arrays.n_splats()).map(one).collect()
}

/// Checks every value. `tolerances` apply to means, log scales, rotations, opacities and colors, in
/// this order.
fn check(got: &[Splat], expected: &[Splat], tolerances: [f64; 5]) {
    let [of_mean, of_scale, of_rotation, of_opacity, of_color] = tolerances;
    let mut mismatches = Mismatches::default();
    for (ix, (got, expected)) in got.iter().zip(expected).enumerate() {
        for axis in 0..3 {
            mismatches.check(
                format!("mean {ix} {axis}"),
                got.mean[axis],
                expected.mean[axis],
                of_mean,
                0.0,
            );
            mismatches.check(
                format!("scale {ix} {axis}"),
                got.log_scale[axis],
                expected.log_scale[axis],
                of_scale,
                0.0,
            );
        }
        for part in 0..4 {
            let [got, expected] = [got, expected].map(|splat| splat.rotation_wxyz[part]);
            mismatches.check(
                format!("rotation {ix} {part}"),
                got,
                expected,
                of_rotation,
                0.0,
            );
        }
        mismatches.check(
            format!("opacity {ix}"),
            got.opacity_logit,
            expected.opacity_logit,
            of_opacity,
            0.0,
        );
        let colors = got.sh.as_flattened().iter().zip(expected.sh.as_flattened());
        for (part, (got, expected)) in colors.enumerate() {
            mismatches.check(format!("sh {ix} {part}"), *got, *expected, of_color, 0.0);
        }
    }
    mismatches.assert_none();
}

/// The value is large enough that a step depends on the magnitude of a gradient, and not only on
/// its sign.
const EPSILON: f32 = 1e-4;
const RULE: Rule = Rule {
    mean_rate_m: 1e-2,
    log_scale_rate: 2e-2,
    rotation_rate: 3e-2,
    opacity_rate: 5e-2,
    sh_dc_rate: 4e-2,
    sh_rest_rate: 1e-2,
    noise: 50.0,
    final_mean_rate_frac: 0.1,
    betas: [0.9, 0.99],
    epsilon: EPSILON,
    n_planned_steps: 5.0,
    schedule_start: 1.0,
    opacity_cost: 1e-3,
    scale_cost: 2e-3,
    log_scale_range: [-3.0, -1.5], // Some of the scene's splats are outside.
    seed: 11,
    update_all: 1,
    noise_center: MIN_OPACITY,
};

#[test]
fn optimizer_steps_match_the_twin() {
    const N_STEPS: u32 = 3;
    let view = scene::rolling_view();
    let mut splats = full_degree_scene(7, 40);
    splats[3].opacity_logit = -5.5; // Barely visible, so noise moves it.
    splats = splats_of(&arrays_of(&splats));
    let fixture = KernelFixture::new(&GpuOptions::default(), &view, &arrays_of(&splats));
    let gpu = &fixture.gpu;
    let rule = gpu.uniform_with("rule", &RULE);
    let weights = loss_reference::Weights {
        dssim_frac: 0.25,
        depth_per_m: 0.5,
        depth_clip_m: 50.0,
        background_rgb: [0.125, 0.25, 0.5],
    };
    // At other pixels, f32 may draw another set of splats.
    let mut target = target_of(&reference::render(&view, &splats), view.size_px);
    for (visible, unambiguous) in target
        .visible
        .iter_mut()
        .zip(unambiguous_pixels(&view, &splats))
    {
        *visible &= unambiguous;
    }
    target
        .depth_m
        .iter_mut()
        .for_each(|depth_m| *depth_m = f64::from(f32_of(*depth_m)));
    let target_buffers = TargetBuffers::new(gpu, &target, &weights);
    // Several steps are taken, because the first step does not show whether moments are carried
    // over.
    let mut moments: Vec<SplatMoments> = vec![vec![Default::default(); 11 + 48]; splats.len()];
    for step in 0..N_STEPS {
        let (_, upstream) =
            loss_reference::loss(&reference::render(&view, &splats), &target, &weights);
        let gradients = reference::render_backward(&view, &splats, &upstream).splats;
        let moved = splats.iter().zip(&gradients).zip(&mut moments).zip(0..);
        splats = moved
            .map(|(((splat, gradient), moments), ix)| {
                change::update(splat, gradient, moments, &RULE, step, ix)
            })
            .collect();

        let mut passes = Passes::default();
        let view_passes = fixture.passes();
        view_passes.draw_for_backward(&mut passes, &fixture.draw, &fixture.train);
        view_passes.compare(&mut passes, &fixture.train, &target_buffers.target());
        view_passes.backward(&mut passes, &fixture.train);
        view_passes.update(&mut passes, &fixture.train.update, &rule, false);
        passes.submit(gpu);
        gpu.write(
            &fixture.status,
            4 * status::STEP as u64,
            bytemuck::bytes_of(&(step + 1)),
        );
    }
    // A step is at most about as large as the learning rate. Gradients differ by a few thousandths
    // of the largest gradient, and `EPSILON` damps the steps of small gradients.
    let of = |rate: f32| 0.02 * f64::from(rate);
    let tolerances = [
        RULE.mean_rate_m,
        RULE.log_scale_rate,
        RULE.rotation_rate,
        RULE.opacity_rate,
        RULE.sh_dc_rate,
    ]
    .map(of);
    check(
        &splats_of(&fixture.splats.read(gpu).unwrap()),
        &splats,
        tolerances,
    );
}

fn growth_buffers(gpu: &Gpu, growth: &Growth) -> GrowthBuffers {
    let words = |name: &str, n: u32| gpu.storage(name, 4 * u64::from(n)).unwrap();
    GrowthBuffers {
        growth: gpu.uniform_with("growth", growth),
        weights: words("weights", growth.n_before),
        cumulative: words("cumulative", growth.n_before),
        block_weights: words("block_weights", growth.n_before.div_ceil(256)),
        n_children: words("n_children", growth.n_before),
        parents: words("parents", growth.n_after),
    }
}

#[test]
fn growth_matches_the_twin() {
    const N_BEFORE: u32 = 700; // Three blocks, the last one partly filled.
    const N_AFTER: u32 = 900;
    let mut splats = full_degree_scene(8, N_BEFORE as usize);
    for ix in [0, 255, 256, 699] {
        splats[ix].opacity_logit = -9.0; // Dead.
    }
    let mut random = scene::F32Random::new(9);
    // A few errors are large, so that some families have many children.
    let errors: Vec<f32> = (0..N_BEFORE)
        .map(|_| f32_of(random.uniform(0.0, 1.0).powi(8)))
        .collect();
    let mut fixture = KernelFixture::new(
        &GpuOptions::default(),
        &scene::tilted_view(),
        &arrays_of(&splats),
    );
    let gpu = fixture.gpu.clone();
    fixture.splats = fixture
        .splats
        .resized(&gpu, N_AFTER, fixture.splats.sh_degree)
        .unwrap();
    let growth = Growth {
        n_before: N_BEFORE,
        n_after: N_AFTER,
        key: 5,
        capacity: fixture.splats.capacity,
        n_sh_rest: 45,
        child_spread: 0.5,
        min_opacity: MIN_OPACITY,
        unused: 0.0,
    };
    let expected = change::grow(
        &splats,
        &errors
            .iter()
            .map(|error| f64::from(*error))
            .collect::<Vec<_>>(),
        &growth,
    );
    assert!(
        expected.margin > 1e-6,
        "f32 may choose another parent: {}",
        expected.margin
    );
    let n_children = expected.parents.iter().flatten().count();
    assert_eq!(n_children, 204, "the number of dead and new splats");

    // If all moments differ, the test shows which moments are reset.
    gpu.write(&fixture.splats.error_sums, 0, bytemuck::cast_slice(&errors));
    let n_planes = 6 * growth.capacity as usize;
    let moments: Vec<[f32; 4]> = (0..n_planes)
        .map(|ix| [f32_of(1.0 + ix as f64); 4])
        .collect();
    gpu.write(&fixture.splats.moments, 0, bytemuck::cast_slice(&moments));
    let buffers = growth_buffers(&gpu, &growth);
    let mut passes = Passes::default();
    grow(
        &gpu,
        &mut passes,
        &fixture.train,
        &fixture.splats,
        &buffers,
        &growth,
    );
    passes.submit(&gpu);
    fixture.splats.set_n_splats(&gpu, N_AFTER);
    let parents: Vec<u32> = gpu.read(&buffers.parents, N_AFTER as usize).unwrap();
    let expected_parents: Vec<u32> = expected
        .parents
        .iter()
        .map(|parent| parent.map_or(u32::MAX, |ix| u32::try_from(ix).unwrap()))
        .collect();
    assert_eq!(parents, expected_parents);
    let after: Vec<[f32; 4]> = gpu.read(&fixture.splats.moments, n_planes).unwrap();
    for (ix, parent) in expected.parents.iter().enumerate() {
        let is_parent = expected.parents.contains(&Some(ix));
        for plane in 0..6 {
            let at = |ix: usize| plane * growth.capacity as usize + ix;
            let kept = if is_parent || parent.is_some() {
                [0.0; 4]
            } else {
                moments[at(ix)]
            };
            assert_eq!(after[at(ix)], kept, "splat {ix}, plane {plane}");
        }
    }
    let sums: Vec<f32> = gpu
        .read(&fixture.splats.error_sums, N_AFTER as usize)
        .unwrap();
    assert!(sums.iter().all(|sum| *sum == 0.0), "error sums are reset");
    check(
        &splats_of(&fixture.splats.read(&gpu).unwrap()),
        &expected.splats,
        [2e-5, 2e-4, 1e-6, 1e-3, 1e-6],
    );
}

/// Rounding sometimes selects a dead splat as a parent while another thread is replacing it. The
/// result must not depend on the order of these threads.
#[test]
fn dead_splats_have_no_children() {
    const N_BEFORE: u32 = 60_000;
    const N_AFTER: u32 = 1_200_000; // A few of a million choices hit a dead splat.
    let mut random = scene::F32Random::new(12);
    let n = N_BEFORE as usize;
    let is_dead: Vec<bool> = (0..n).map(|_| random.uniform(0.0, 1.0) < 0.5).collect();
    let arrays = SplatArrays {
        means: vec![[0.0; 3]; n],
        log_scales: vec![[-3.0; 3]; n],
        rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: is_dead
            .iter()
            .map(|is_dead| if *is_dead { -9.0 } else { 1.0 })
            .collect(),
        sh: vec![[0.0; 3]; n],
        sh_degree: 0,
        is_antialiased: false,
    };
    let errors: Vec<f32> = (0..n).map(|_| f32_of(random.uniform(0.5, 1.0))).collect();
    let mut fixture = KernelFixture::new(&GpuOptions::default(), &scene::tilted_view(), &arrays);
    let gpu = fixture.gpu.clone();
    fixture.splats = fixture.splats.resized(&gpu, N_AFTER, 0).unwrap();
    let growth = Growth {
        n_before: N_BEFORE,
        n_after: N_AFTER,
        key: 6,
        capacity: fixture.splats.capacity,
        n_sh_rest: 0,
        child_spread: 0.5,
        min_opacity: MIN_OPACITY,
        unused: 0.0,
    };
    gpu.write(&fixture.splats.error_sums, 0, bytemuck::cast_slice(&errors));
    let buffers = growth_buffers(&gpu, &growth);
    let mut passes = Passes::default();
    grow(
        &gpu,
        &mut passes,
        &fixture.train,
        &fixture.splats,
        &buffers,
        &growth,
    );
    passes.submit(&gpu);
    let parents: Vec<u32> = gpu.read(&buffers.parents, N_AFTER as usize).unwrap();
    let of_dead = parents
        .iter()
        .filter(|parent| {
            is_dead
                .get(**parent as usize)
                .is_some_and(|is_dead| *is_dead)
        })
        .count();
    assert_eq!(of_dead, 0);
    let n_children = parents.iter().filter(|parent| **parent != u32::MAX).count();
    let n_expected =
        is_dead.iter().filter(|is_dead| **is_dead).count() + (N_AFTER - N_BEFORE) as usize;
    assert!(
        n_children <= n_expected && n_expected - n_children < 100,
        "{n_children} of {n_expected} have a parent"
    );
}

fn column(entries: &[[u32; 4]], part: usize) -> Vec<u32> {
    entries.iter().map(|entry| entry[part]).collect()
}

/// Squared Mahalanobis distance of the center of a pixel from a projected splat.
fn squared_distance(position: &[f32; 4], conic: &[f32; 4], pixel: [u32; 2]) -> f64 {
    let [a, b, c, _] = conic.map(f64::from);
    let [x, y] = pixel.map(|px| f64::from(px) + 0.5);
    let dx = x - f64::from(position[0]);
    let dy = y - f64::from(position[1]);
    a * dx * dx + 2.0 * b * dx * dy + c * dy * dy
}

/// Checks the bins against a direct computation: a splat belongs to a tile if it reaches a pixel of
/// the tile.
#[test]
fn tile_lists_are_complete_and_depth_ordered() {
    /// If the difference from the threshold (a squared Mahalanobis distance) is smaller than this,
    /// f32 may decide either way.
    const MARGIN: f64 = 1e-3;
    let view = scene::tilted_view();
    let splats = full_degree_scene(10, 300);
    let fixture = KernelFixture::new(&GpuOptions::default(), &view, &arrays_of(&splats));
    fixture.render();
    let gpu = &fixture.gpu;
    let projected_splats: Vec<[[f32; 4]; 3]> = gpu
        .read(&fixture.scratch.projected_splats, splats.len())
        .unwrap();
    let n_tiles = view.size_px.map(|size| size.div_ceil(16));
    let n_bins = n_tiles.map(|n| n.div_ceil(4));
    let starts: Vec<u32> = gpu
        .read(
            &fixture.scratch.bin_starts,
            (n_bins[0] * n_bins[1]) as usize + 1,
        )
        .unwrap();
    let n_entries = starts[starts.len() - 1] as usize;
    let entries: Vec<[u32; 4]> = gpu.read(&fixture.scratch.entries, n_entries).unwrap();
    let splat_of = column(&entries, 0);
    let masks = column(&entries, 1);
    let slots = column(&entries, 2);
    let mut taken: Vec<u32> = masks
        .iter()
        .zip(&slots)
        .flat_map(|(tiles, slot)| *slot..*slot + tiles.count_ones())
        .collect();
    taken.sort_unstable();
    assert!(
        taken
            .iter()
            .copied()
            .eq(0..u32::try_from(taken.len()).unwrap()),
        "every slot has one owner"
    );
    // Depth keys have 16 bits. They divide the range of depths into octaves, each with the same
    // number of steps.
    let visible_m: Vec<f32> = projected_splats
        .iter()
        .map(|[position, ..]| position[2])
        .filter(|z| *z > 0.0)
        .collect();
    let farthest_m = visible_m.iter().copied().fold(0.0, f32::max);
    let nearest_m = visible_m.iter().copied().fold(f32::INFINITY, f32::min);
    let octaves = (farthest_m / nearest_m).log2();
    let key_step = (octaves + 1.0).log2().ceil().exp2() / 65536.0;
    let mut n_listed = 0;
    let mut n_unnecessary = 0;
    for tile in 0..n_tiles[0] * n_tiles[1] {
        let at = [tile % n_tiles[0], tile / n_tiles[0]];
        let bin = (at[1] / 4 * n_bins[0] + at[0] / 4) as usize;
        let bit = 1 << (at[1] % 4 * 4 + at[0] % 4);
        let entries = (starts[bin] as usize..starts[bin + 1] as usize)
            .filter(|entry| masks[*entry] & bit != 0);
        let list: Vec<u32> = entries.map(|entry| splat_of[entry]).collect();
        let depths: Vec<f32> = list
            .iter()
            .map(|ix| projected_splats[*ix as usize][0][2])
            .collect();
        assert!(
            depths
                .windows(2)
                .all(|pair| pair[0] <= pair[1] * (1.0 + key_step)),
            "tile {tile} is out of order"
        );
        let corner = [tile % n_tiles[0] * 16, tile / n_tiles[0] * 16];
        for (splat_ix, [position, conic, _]) in (0..).zip(&projected_splats) {
            let reach = f64::from(conic[3]);
            let nearest = (0..256)
                .map(|pixel| {
                    squared_distance(
                        position,
                        conic,
                        [corner[0] + pixel % 16, corner[1] + pixel / 16],
                    )
                })
                .fold(f64::INFINITY, f64::min);
            let n_times = list.iter().filter(|listed| **listed == splat_ix).count();
            assert!(
                n_times <= 1,
                "tile {tile} lists splat {splat_ix} {n_times} times"
            );
            assert!(
                n_times == 1 || nearest > reach - MARGIN,
                "tile {tile} misses splat {splat_ix}"
            );
            n_listed += n_times;
            n_unnecessary += usize::from(n_times == 1 && nearest > reach + MARGIN);
        }
    }
    assert!(n_listed > 300, "{n_listed} intersections");
    assert!(
        n_unnecessary * 20 < n_listed,
        "{n_unnecessary} of {n_listed} reach no pixel"
    );
}
