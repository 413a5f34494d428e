//! Tests of ray sampling against its twin.

use super::buffers::{FieldBuffers, FieldMoments, Occupancy, RaySlot, SampleBuffers};
use super::kernels::{FieldPipelines, Widths};
use super::params::{self, Batch, OccupancyUpdate, Span};
use super::passes::FieldPasses;
use super::reference::grid::GridShape;
use super::reference::march::March;
use crate::mismatches::Mismatches;
use crate::random::F32Random;
use gpu::Passes;
use gpu::testing::test_gpu;
use model_files::contraction::contract;
use numbers::{f32_of, f32s_of};

const N_CELLS: u32 = 64;
/// More rays than a workgroup scans at once.
const N_RAYS: u32 = 300;
const CAPACITY: u32 = 16_384;
const MARCH: March = March {
    step: 0.03125,
    max_samples: 12,
    n_cells: N_CELLS as usize,
};
/// Distance to a cell's side, in cells, below which f32 may select the neighboring cell.
const MIN_MARGIN: f64 = 1e-4;

/// Marks half of the cells in half of the blocks, which are 4 cells wide.
fn is_occupied(cell: usize) -> bool {
    let n = N_CELLS as usize;
    let block = cell % n / 4 + n * (cell / n % n / 4 + n * (cell / n / n / 4));
    let is_taken = |ix: usize| ix.wrapping_mul(2_654_435_761) >> 7 & 1 == 1;
    is_taken(block + 1) && is_taken(cell)
}

/// A ray, its begin and end, and its jitter, in numbers that f32 holds exactly.
type TestRay = ([f64; 3], [f64; 3], [f64; 2], f64);

fn rays() -> Vec<TestRay> {
    (0..u64::from(N_RAYS)).map(random_ray).collect()
}

fn random_ray(seed: u64) -> TestRay {
    let rounded = |x: f64| f64::from(f32_of(x));
    let mut random = F32Random::new(seed);
    let direction = nalgebra::Vector3::from(random.array::<3>(-1.0, 1.0))
        .normalize()
        .map(rounded);
    // Some rays begin outside the inner cube, and some end inside it.
    let end = if seed.is_multiple_of(5) { 1.5 } else { 1000.0 };
    (
        random.array(-2.0, 2.0),
        direction.into(),
        [0.125, end],
        rounded(random.uniform(0.0, 0.99)),
    )
}

#[test]
fn samples_lie_in_occupied_cells_within_limit() {
    let gpu = test_gpu();
    let shape = GridShape::between(2, 4, 2, 6);
    let widths = Widths::new(&gpu, 2, 4, 0);
    let pipelines = FieldPipelines::new(&gpu, &widths, CAPACITY, 0).unwrap();
    let field = FieldBuffers::new(&gpu, &shape, &widths).unwrap();
    let batch = SampleBuffers::new(&gpu, CAPACITY).unwrap();
    let occupancy = Occupancy::new(
        &gpu,
        &OccupancyUpdate {
            n_cells: N_CELLS,
            n_points: 1,
            decay: 1.0,
            step: 0.1,
        },
        false,
    )
    .unwrap();
    let cell_occupancy: Vec<f32> = (0..N_CELLS.pow(3) as usize)
        .map(|cell| f32::from(u8::from(is_occupied(cell))))
        .collect();
    gpu.write(
        &occupancy.cell_occupancy,
        0,
        bytemuck::cast_slice(&cell_occupancy),
    );
    let rule = bytemuck::Zeroable::zeroed();
    let moments = FieldMoments::new(&gpu, &shape, &widths, &rule).unwrap();
    let slot = RaySlot::new(&gpu, N_RAYS).unwrap();
    let rays = rays();
    let gpu_ray = |(origin, direction, range, jitter): &TestRay| params::Ray {
        origin: f32s_of(*origin),
        direction: f32s_of(*direction),
        begin: f32_of(range[0]),
        end: f32_of(range[1]),
        jitter: f32_of(*jitter),
        ..params::Ray::default()
    };
    let gpu_rays: Vec<params::Ray> = rays.iter().map(gpu_ray).collect();
    gpu.write(&slot.rays, 0, bytemuck::cast_slice(&gpu_rays));
    gpu.write(&batch.batch, 0, bytemuck::bytes_of(&Batch::of(N_RAYS)));
    let march = params::March {
        step: f32_of(MARCH.step),
        max_samples: u32::try_from(MARCH.max_samples).unwrap(),
        n_cells: N_CELLS,
        first_ray: 0,
        max_found: u32::MAX,
        pixel_stride: 1,
        unused: [0; 2],
    };
    gpu.write(&slot.march, 0, bytemuck::bytes_of(&march));
    let image_params = &field.no_image_params;
    let passes = FieldPasses {
        gpu: &gpu,
        pipelines: &pipelines,
        field: &field,
        samples: &batch,
        slot: &slot,
        image_params,
    };
    let mut list = Passes::default();
    passes.mark_occupied_cells(&mut list, &occupancy, &moments);
    passes.count(&mut list, &occupancy);
    passes.place_samples_in_rays(&mut list, &occupancy);
    list.submit(&gpu);

    let [_, n_samples] = gpu.read::<u32>(&batch.batch, 2).unwrap()[..] else {
        panic!("two words")
    };
    let placed: Vec<params::Ray> = gpu.read(&slot.rays, N_RAYS as usize).unwrap();
    let spans: Vec<Span> = gpu.read(&batch.spans, n_samples as usize).unwrap();
    let points: Vec<[f32; 4]> = gpu.read(&batch.points, n_samples as usize).unwrap();
    assert_eq!(
        placed.iter().map(|ray| ray.n_samples).sum::<u32>(),
        n_samples
    );
    let mut mismatches = Mismatches::default();
    let mut n_compared = 0;
    let mut n_thinned = 0;
    for (ix, (ray, (origin, direction, range, jitter))) in placed.iter().zip(&rays).enumerate() {
        let (segments, margin) =
            MARCH.segments((*origin, *direction), *range, *jitter, is_occupied);
        assert!(
            ray.n_samples as usize <= MARCH.max_samples,
            "ray {ix}: {}",
            ray.n_samples
        );
        if margin < MIN_MARGIN {
            continue;
        }
        n_compared += 1;
        n_thinned += usize::from(segments.len() > MARCH.max_samples);
        let expected = MARCH.spans(&segments, *jitter);
        assert_eq!(
            ray.n_samples as usize,
            expected.len(),
            "ray {ix} of {} segments",
            segments.len()
        );
        let begin = ray.first_sample as usize;
        for (sample, [low, high]) in expected.into_iter().enumerate() {
            let span = spans[begin + sample];
            let point = points[begin + sample];
            assert_eq!(span.ray as usize, ix);
            mismatches.check(
                format!("begin {ix} {sample}"),
                span.begin.into(),
                low,
                1e-4,
                1e-4,
            );
            mismatches.check(
                format!("end {ix} {sample}"),
                span.end.into(),
                high,
                1e-4,
                1e-4,
            );
            let middle = 0.5 * (low + high);
            let at = contract(std::array::from_fn(|axis| {
                origin[axis] + middle * direction[axis]
            }));
            for axis in 0..3 {
                mismatches.check(
                    format!("point {ix} {sample} {axis}"),
                    point[axis].into(),
                    at[axis],
                    1e-4,
                    0.0,
                );
            }
        }
    }
    mismatches.assert_none();
    assert!(
        n_compared > 100 && n_thinned > 20,
        "only {n_compared} rays could be compared, {n_thinned} of them thinned"
    );
}
