//! Tests of the kernels against their f64 twins, with and without the optional features of the
//! adapter.

use super::TsdfModel;
use super::block::{Blocks, GridCoord, N_VOXELS, stored_distance};
use super::buffers::FieldBuffers;
use super::capacity::Capacity;
use super::chosen_grid::VoxelGrid;
use super::kernels::Pipelines;
use super::mesh::{BlockMesh, unit_of};
use super::mesh_buffers::{MeshBuffers, MeshCapacity};
use super::params::MeshVertex;
use super::reference::{self, BlockTriangles, Ray, Vertex, VoxelBlocks};
use super::tests::fuse_all;
use crate::mismatches::Mismatches;
use crate::model_options::ModelOptions;
use crate::test_scenes::{self as scenes, FOCAL_PX, PRINCIPAL_PX, SIZE_PX};
use crate::{Method, RenderRequest};
use gpu::testing::test_gpu;
use keyframe::Keyframe;
use kinematics::Transform;
use model_files::Aabb;
use model_files::edits::{Edit, Edits};
use nalgebra::{Point3, Vector3};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Tolerance for rounding distances to 16 bits, and weights to whole 256ths, over a few images.
const DISTANCE_QUANTA: f64 = 4.0;
const COLOR_ABS: f64 = 5e-4;
/// Fraction of voxels and pixels for which f32 rounding may change a decision.
const MAX_UNDECIDED_FRAC: f64 = 2e-3;

fn scene() -> Vec<Arc<Keyframe>> {
    let at = Point3::new(0.3, -0.2, 0.1);
    scenes::ring(&[scenes::ball(at), scenes::floor()], at, 3)
}

fn fused(keyframes: &[Arc<Keyframe>]) -> (Blocks, VoxelGrid, TsdfModel) {
    let gpu = test_gpu();
    let mut model = TsdfModel::new(gpu, scenes::options()).unwrap();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    fuse_all(&mut model);
    let voxel_grid = model.voxel_grid().unwrap().clone();
    (model.blocks().unwrap(), voxel_grid, model)
}

#[test]
fn blocks_are_allocated_along_rays() {
    let (got, voxel_grid, _) = fused(&scene()[..1]);
    let depth = scene()[0].depth.clone().unwrap();
    let readings = reference::readings(&depth, &voxel_grid);
    let required = reference::required_blocks(&depth, &readings, &voxel_grid, 1e-3);
    let got: BTreeSet<GridCoord> = got.into_keys().collect();
    assert!(required.definite.len() > 100, "{}", required.definite.len());
    let missing: Vec<_> = required.definite.difference(&got).collect();
    assert!(missing.is_empty(), "{missing:?}");
    let surplus: Vec<_> = got.difference(&required.possible).collect();
    assert!(surplus.is_empty(), "{surplus:?}");
}

#[test]
fn fused_voxels_match_twin() {
    let keyframes = scene();
    let (got, twin, voxel_grid) = fused_with_twin(&keyframes);
    compare(&got, &twin, &voxel_grid);
}

/// Fuses the keyframes one after the other, on the GPU and in the twin. The twin allocates the
/// blocks that the GPU allocates.
fn fused_with_twin(keyframes: &[Arc<Keyframe>]) -> (Blocks, VoxelBlocks, VoxelGrid) {
    let mut model = TsdfModel::new(test_gpu(), scenes::options()).unwrap();
    let mut twin = VoxelBlocks::new();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
        fuse_all(&mut model);
        let voxel_grid = model.voxel_grid().unwrap().clone();
        for block_coord in model.blocks().unwrap().into_keys() {
            twin.entry(block_coord)
                .or_insert_with(reference::unobserved);
        }
        let readings = reference::readings(keyframe.depth.as_ref().unwrap(), &voxel_grid);
        reference::integrate(&mut twin, keyframe, &readings, &voxel_grid);
    }
    let voxel_grid = model.voxel_grid().unwrap().clone();
    (model.blocks().unwrap(), twin, voxel_grid)
}

fn compare(got: &Blocks, twin: &VoxelBlocks, voxel_grid: &VoxelGrid) {
    let mut n_observed = 0_usize;
    let mut n_off = 0_usize;
    let mut n_colored = 0_usize;
    let quantum_m = DISTANCE_QUANTA * voxel_grid.scale_m / 32767.0;
    for (block_coord, block) in got {
        for (ix, expected) in twin[block_coord].iter().enumerate() {
            let word = block.geometry[ix];
            let weight = f64::from(word >> 16);
            let distance_m = stored_distance(word) * voxel_grid.scale_m;
            n_observed += usize::from(expected.weight > 0.0);
            let mut is_equal = (weight - expected.weight).abs() <= 3.0
                && (expected.weight == 0.0
                    || (distance_m - expected.distance_m).abs()
                        <= quantum_m + 1e-3 * expected.distance_m.abs());
            if let Some(color) = block.color_srgb(ix) {
                n_colored += 1;
                is_equal &=
                    (0..3).all(|part| (color[part] - expected.color_srgb[part]).abs() <= COLOR_ABS);
            } else {
                is_equal &= expected.color_weight == 0.0;
            }
            n_off += usize::from(!is_equal);
        }
    }
    assert!(
        n_observed > 50 * N_VOXELS && n_colored > 20 * N_VOXELS,
        "{n_observed} {n_colored}"
    );
    assert!(
        (n_off as f64) < MAX_UNDECIDED_FRAC * n_observed as f64,
        "{n_off} of {n_observed} voxels differ"
    );
}

#[test]
fn carving_matches_twin() {
    let at = Point3::new(0.0, 0.0, 0.0);
    let with = scenes::ring(&[scenes::ball(at), scenes::floor()], at, 2);
    let mut without = scenes::ring(&[scenes::floor()], at, 2);
    for (ix, keyframe) in without.iter_mut().enumerate() {
        Arc::make_mut(keyframe).stamp.0 = 10 + i64::try_from(ix).unwrap();
    }
    let keyframes: Vec<_> = with.into_iter().chain(without).collect();
    let (got, twin, voxel_grid) = fused_with_twin(&keyframes);
    compare(&got, &twin, &voxel_grid);
}

fn rays(pose: &Transform, voxel_grid: &VoxelGrid) -> Vec<Ray> {
    let field_from_camera = voxel_grid.field_from_world() * pose;
    let [width, height] = SIZE_PX;
    (0..height)
        .flat_map(|y| (0..width).map(move |x| [f64::from(x) + 0.5, f64::from(y) + 0.5]))
        .map(|block_coord| {
            let along = |axis: usize| (block_coord[axis] - PRINCIPAL_PX[axis]) / FOCAL_PX[axis];
            Ray {
                origin_m: field_from_camera.translation.vector.into(),
                along: field_from_camera.rotation * Vector3::new(along(0), along(1), 1.0),
                range_m: [0.01, 3.0],
            }
        })
        .collect()
}

#[test]
fn pictures_match_twin() {
    check_pictures(&Arc::default(), 2000);
}

#[test]
fn pictures_without_erased_space_match_twin() {
    let mut edits = Edits::default();
    let world_from_box = scenes::look_at(Point3::new(0.3, -0.2, 0.3), Point3::new(1.0, 0.4, 0.6));
    edits
        .push(Edit::Box(Aabb {
            world_from_box,
            min_m: [-0.2; 3],
            max_m: [0.2; 3],
        }))
        .unwrap();
    check_pictures(&Arc::new(edits), 1500);
}

/// Compares a picture with the twin's picture, which must contain at least this number of pixels
/// with a surface.
fn check_pictures(edits: &Arc<Edits>, min_hits: usize) {
    let keyframes = scene();
    let (blocks, voxel_grid, mut model) = fused(&keyframes);
    let pose = scenes::look_at(Point3::new(1.3, 0.4, 0.6), Point3::new(0.3, -0.2, 0.1));
    let picture = model
        .render(&RenderRequest {
            far_m: 3.0,
            edits: Arc::clone(edits),
            ..scenes::request(pose)
        })
        .unwrap();
    let mut n_hits = 0_usize;
    let mut n_off = 0_usize;
    let mut mismatches = Mismatches::default();
    for (ix, ray) in rays(&pose, &voxel_grid).iter().enumerate() {
        let hit = reference::cast(&blocks, &voxel_grid, ray, edits);
        let got = picture.depth_m[ix];
        n_hits += usize::from(hit.is_some());
        let rgba = &picture.rgba_srgb[4 * ix..4 * ix + 4];
        assert_eq!(rgba[3] == 255, got > 0.0);
        let Some(hit) = hit.filter(|hit| {
            got > 0.0 && (f64::from(got) - hit.depth_m).abs() < 0.2 * voxel_grid.voxel_m
        }) else {
            n_off += usize::from(hit.is_some() || got > 0.0);
            continue;
        };
        for (got, expected) in rgba.iter().zip(hit.color_srgb) {
            mismatches.check(ix, f64::from(*got), 255.0 * expected, 3.0, 0.0);
        }
    }
    assert!(n_hits > min_hits, "{n_hits}");
    assert!(
        (n_off as f64) < 0.01 * n_hits as f64,
        "{n_off} of {n_hits} pixels differ"
    );
    mismatches.assert_none();
}

#[test]
fn readings_match_twin() {
    use super::kernels::Pipelines;
    use super::params::{DepthView, Field};
    use super::passes::KeyframeSlot;
    let keyframe = &scene()[0];
    let depth = keyframe.depth.as_ref().unwrap();
    let gpu = test_gpu();
    let voxel_grid = VoxelGrid::choose(&scenes::options().specific, None, depth).unwrap();
    let field = FieldBuffers::new(
        &gpu,
        &voxel_grid,
        Capacity {
            n_blocks: 2048,
            n_chunks: 256,
        },
    )
    .unwrap();
    assert_eq!(field.field.bytes(), size_of::<Field>() as u64);
    let n = depth.depth_m.len();
    let mut slot = KeyframeSlot::new(
        &gpu,
        n as u64,
        u64::from(keyframe.size_px[0] * keyframe.size_px[1]),
    )
    .unwrap();
    slot.upload(
        &gpu,
        keyframe,
        &DepthView::of(keyframe, &voxel_grid).unwrap(),
    );
    let mut list = gpu::Passes::default();
    let pipelines = Pipelines::new(&gpu).unwrap();
    super::passes::fuse(&gpu, &mut list, &pipelines, &field, &slot);
    list.submit(&gpu);
    let got: Vec<[f32; 2]> = gpu.read(slot.readings(), n).unwrap();
    let mut mismatches = Mismatches::default();
    for (ix, (got, expected)) in got
        .iter()
        .zip(reference::readings(depth, &voxel_grid))
        .enumerate()
    {
        mismatches.check(
            format!("depth {ix}"),
            got[0].into(),
            expected.depth_m,
            1e-9,
            1e-6,
        );
        mismatches.check(
            format!("ray_dot_normal {ix}"),
            got[1].into(),
            expected.ray_dot_normal,
            2e-4,
            1e-4,
        );
    }
    mismatches.assert_none();
}

/// Replaces each depth of a keyframe, given its index and its value.
fn replace_depth(keyframe: &mut Arc<Keyframe>, fill: &dyn Fn(usize, f32) -> f32) {
    let depth = Arc::make_mut(keyframe).depth.as_mut().unwrap();
    depth.depth_m = depth
        .depth_m
        .iter()
        .enumerate()
        .map(|(ix, z)| fill(ix, *z))
        .collect::<Vec<_>>()
        .into();
}

#[test]
fn non_finite_depth_is_ignored() {
    let finite = scene();
    let mut non_finite = finite.clone();
    let bad_values = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        -1.0,
        1e30,
        f32::MIN_POSITIVE,
        -0.0,
    ];
    // One copy has holes. The other copy has non-finite values at the same pixels.
    let mut with_holes = finite.clone();
    replace_depth(&mut with_holes[1], &|ix, z| {
        if ix % 11 == 3 { 0.0 } else { z }
    });
    replace_depth(&mut non_finite[1], &|ix, z| {
        if ix % 11 == 3 {
            bad_values[ix % bad_values.len()]
        } else {
            z
        }
    });
    let expected = fused(&with_holes).0;
    assert!(fused(&non_finite).0 == expected);
    let all_non_finite: Vec<_> = non_finite
        .iter()
        .cloned()
        .map(|mut keyframe| {
            replace_depth(&mut keyframe, &|ix, _| bad_values[ix % bad_values.len()]);
            keyframe
        })
        .collect();
    let gpu = test_gpu();
    let mut model = TsdfModel::new(gpu, ModelOptions::default()).unwrap();
    for keyframe in all_non_finite {
        model.push(keyframe).unwrap();
    }
    fuse_all(&mut model);
    assert!(model.blocks().unwrap().is_empty());
    assert_eq!(model.progress().step, 3);
}

/// Rounding error in f32 of positions up to about 2 m, meters.
const POSITION_ABS_M: f64 = 1e-6;
/// Normals are stored in 16 bits per component.
const NORMAL_ABS: f64 = 2e-4;
/// Colors are stored in 8 bits. The rounding error of f32 is added.
const MESH_COLOR_ABS: f64 = 0.51 / 255.0;

fn edge_of(vertex: &Vertex) -> u32 {
    let ([x, y, z], axis) = vertex.between;
    u32::try_from(3 * (81 * z + 9 * y + x)).unwrap() + u32::try_from(axis).unwrap()
}

/// Records all differences between a block's triangles and its twin's.
fn compare_triangles(
    mismatches: &mut Mismatches,
    block_coord: GridCoord,
    got: &BlockMesh,
    twin: &BlockTriangles,
) {
    let edges = |corners: &[u32; 3]| corners.map(|ix| got.vertices[ix as usize].edge);
    let got_edges: Vec<_> = got.triangles.iter().map(edges).collect();
    let twin_edges: Vec<_> = twin
        .triangles
        .iter()
        .map(|ixs| ixs.map(|ix| edge_of(&twin.vertices[ix])))
        .collect();
    assert_eq!(got_edges, twin_edges, "{block_coord:?}");
    assert_eq!(got.vertices.len(), twin.vertices.len(), "{block_coord:?}");
    let by_edge: BTreeMap<u32, &MeshVertex> = got
        .vertices
        .iter()
        .map(|vertex| (vertex.edge, vertex))
        .collect();
    for expected in &twin.vertices {
        let vertex = by_edge[&edge_of(expected)];
        let color = vertex.color.to_le_bytes();
        let normal = unit_of(vertex.normal);
        for axis in 0..3 {
            let label =
                |what: &str| format!("{what} {axis} at {block_coord:?} {:?}", expected.between);
            let along_m = f64::from(vertex.position_m[axis]);
            mismatches.check(
                label("position"),
                along_m,
                expected.position_m[axis],
                POSITION_ABS_M,
                0.0,
            );
            mismatches.check(
                label("normal"),
                f64::from(normal[axis]),
                expected.normal[axis],
                NORMAL_ABS,
                0.0,
            );
            let part = f64::from(color[axis]) / 255.0;
            mismatches.check(
                label("color"),
                part,
                expected.color_srgb[axis],
                MESH_COLOR_ABS,
                0.0,
            );
        }
    }
}

#[test]
fn triangles_match_twin() {
    // With the second capacity, a few blocks are processed at a time, and the buffers must grow
    // first.
    let capacities = [
        MeshCapacity::default(),
        MeshCapacity {
            n_blocks: 100,
            n_vertices: 1,
            n_triangles: 1,
        },
    ];
    for mesh_capacity in capacities {
        let (blocks, voxel_grid, _) = fused(&scene());
        let gpu = test_gpu();
        let pipelines = Pipelines::new(&gpu).unwrap();
        let capacity = Capacity {
            n_blocks: 1,
            n_chunks: 64,
        };
        let field =
            FieldBuffers::with_blocks(&gpu, &pipelines, &voxel_grid, &blocks, capacity).unwrap();
        let mut buffers = MeshBuffers::new(&gpu, mesh_capacity, field.capacity.n_blocks).unwrap();
        assert!(
            buffers
                .mesh_changed(&gpu, &pipelines, &field)
                .unwrap()
                .is_empty(),
            "nothing changed"
        );
        field
            .set_changed(&gpu, &blocks.keys().copied().collect())
            .unwrap();
        let made = buffers.mesh_changed(&gpu, &pipelines, &field).unwrap();
        let done: BTreeSet<GridCoord> = made.iter().map(|(block_coord, _)| *block_coord).collect();
        assert!(made.len() == blocks.len() && done.into_iter().eq(blocks.keys().copied()));
        let mut mismatches = Mismatches::default();
        for (block_coord, mesh) in &made {
            compare_triangles(
                &mut mismatches,
                *block_coord,
                mesh,
                &reference::march(&blocks, *block_coord, voxel_grid.voxel_m),
            );
        }
        assert!(
            made.iter()
                .map(|(_, mesh)| mesh.triangles.len())
                .sum::<usize>()
                > 5000
        );
        mismatches.assert_none();
    }
}
