//! The kernels against their f64 twins, with optional features and without.

use super::block::{Blocks, N_VOXELS, Place, stored_distance};
use super::buffers::{Capacity, FieldBuffers};
use super::chosen::Lattice;
use super::kernels::Pipelines;
use super::marching::{MeshBuffers, MeshRoom};
use super::mesh::{BlockMesh, unit_of};
use super::params::MeshVertex;
use super::reference::{self, BlockTriangles, Ray, Vertex, VoxelBlocks};
use super::tests::fuse_all;
use super::{TsdfModel, TsdfOptions};
use crate::gpu::{Gpu, GpuOptions};
use crate::mismatches::Mismatches;
use crate::test_scenes::{self as scenes, FOCAL_PX, PRINCIPAL_PX, SIZE_PX};
use crate::{Keyframe, Method, RenderRequest};
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What rounding of distances to 16 bits, and of weights to whole 256ths, may make over a few frames.
const DISTANCE_QUANTA: f64 = 4.0;
const COLOR_ABS: f64 = 5e-4;
/// Share of voxels and pixels where a decision may fall the other way in f32.
const MOST_UNDECIDED: f64 = 2e-3;

fn forms() -> [GpuOptions; 2] {
    [GpuOptions::default(), GpuOptions { optional_features: false, ..GpuOptions::default() }]
}

fn scene() -> Vec<Arc<Keyframe>> {
    let at = Point3::new(0.3, -0.2, 0.1);
    scenes::ring(&[scenes::ball(at), scenes::floor()], at, 3)
}

fn fused(options: &GpuOptions, keyframes: &[Arc<Keyframe>]) -> (Blocks, Lattice, TsdfModel) {
    let gpu = Gpu::open(options).unwrap();
    let mut model = TsdfModel::new(gpu, scenes::options()).unwrap();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    fuse_all(&mut model);
    let lattice = model.lattice().unwrap().clone();
    (model.blocks().unwrap(), lattice, model)
}

#[test]
fn blocks_are_given_room_where_rays_cross_them() {
    for options in forms() {
        let (got, lattice, _) = fused(&options, &scene()[..1]);
        let depth = scene()[0].depth.clone().unwrap();
        let readings = reference::readings(&depth, &lattice);
        let wanted = reference::wanted_blocks(&depth, &readings, &lattice, 1e-3);
        let got: BTreeSet<Place> = got.into_keys().collect();
        assert!(wanted.surely.len() > 100, "{}", wanted.surely.len());
        let missing: Vec<_> = wanted.surely.difference(&got).collect();
        assert!(missing.is_empty(), "{missing:?}");
        let surplus: Vec<_> = got.difference(&wanted.at_most).collect();
        assert!(surplus.is_empty(), "{surplus:?}");
    }
}

#[test]
fn distances_weights_and_colors_are_those_of_the_twin() {
    for options in forms() {
        let keyframes = scene();
        let (got, twin, lattice) = fused_with_twin(&options, &keyframes);
        compare(&got, &twin, &lattice);
    }
}

/// Fuses the keyframes one after the other, on the GPU and in the twin; both give room to the same blocks.
fn fused_with_twin(options: &GpuOptions, keyframes: &[Arc<Keyframe>]) -> (Blocks, VoxelBlocks, Lattice) {
    let mut model = TsdfModel::new(Gpu::open(options).unwrap(), scenes::options()).unwrap();
    let mut twin = VoxelBlocks::new();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
        fuse_all(&mut model);
        let lattice = model.lattice().unwrap().clone();
        for place in model.blocks().unwrap().into_keys() {
            twin.entry(place).or_insert_with(reference::unseen);
        }
        let readings = reference::readings(keyframe.depth.as_ref().unwrap(), &lattice);
        reference::integrate(&mut twin, keyframe, &readings, &lattice);
    }
    let lattice = model.lattice().unwrap().clone();
    (model.blocks().unwrap(), twin, lattice)
}

fn compare(got: &Blocks, twin: &VoxelBlocks, lattice: &Lattice) {
    let (mut n_seen, mut n_off, mut n_colored) = (0_usize, 0_usize, 0_usize);
    let quantum_m = DISTANCE_QUANTA * lattice.scale_m / 32767.0;
    for (place, block) in got {
        for (ix, expected) in twin[place].iter().enumerate() {
            let word = block.geometry[ix];
            let weight = f64::from(word >> 16);
            let distance_m = stored_distance(word) * lattice.scale_m;
            n_seen += usize::from(expected.weight > 0.0);
            let mut right = (weight - expected.weight).abs() <= 3.0
                && (expected.weight == 0.0
                    || (distance_m - expected.distance_m).abs() <= quantum_m + 1e-3 * expected.distance_m.abs());
            if let Some(color) = block.color_srgb(ix) {
                n_colored += 1;
                right &= (0..3).all(|part| (color[part] - expected.color_srgb[part]).abs() <= COLOR_ABS);
            } else {
                right &= expected.color_weight == 0.0;
            }
            n_off += usize::from(!right);
        }
    }
    assert!(n_seen > 50 * N_VOXELS && n_colored > 20 * N_VOXELS, "{n_seen} {n_colored}");
    assert!((n_off as f64) < MOST_UNDECIDED * n_seen as f64, "{n_off} of {n_seen} are off");
}

#[test]
fn carving_is_that_of_the_twin() {
    let at = Point3::new(0.0, 0.0, 0.0);
    let with = scenes::ring(&[scenes::ball(at), scenes::floor()], at, 2);
    let mut without = scenes::ring(&[scenes::floor()], at, 2);
    for (ix, keyframe) in without.iter_mut().enumerate() {
        Arc::make_mut(keyframe).stamp.0 = 10 + i64::try_from(ix).unwrap();
    }
    let keyframes: Vec<_> = with.into_iter().chain(without).collect();
    for options in forms() {
        let (got, twin, lattice) = fused_with_twin(&options, &keyframes);
        compare(&got, &twin, &lattice);
    }
}

fn rays(pose: &Transform, lattice: &Lattice) -> Vec<Ray> {
    let field_from_camera = lattice.field_from_world() * pose;
    let [width, height] = SIZE_PX;
    (0..height)
        .flat_map(|y| (0..width).map(move |x| [f64::from(x) + 0.5, f64::from(y) + 0.5]))
        .map(|place| {
            let along = |axis: usize| (place[axis] - PRINCIPAL_PX[axis]) / FOCAL_PX[axis];
            Ray {
                origin_m: field_from_camera.translation.vector.into(),
                along: field_from_camera.rotation * Vector3::new(along(0), along(1), 1.0),
                range_m: [0.01, 3.0],
            }
        })
        .collect()
}

#[test]
fn pictures_are_those_of_the_twin() {
    for options in forms() {
        let keyframes = scene();
        let (blocks, lattice, mut model) = fused(&options, &keyframes);
        let pose = scenes::looking(Point3::new(1.3, 0.4, 0.6), Point3::new(0.3, -0.2, 0.1));
        let picture = model.render(&RenderRequest { far_m: 3.0, ..scenes::request(pose) }).unwrap();
        let (mut n_hits, mut n_off) = (0_usize, 0_usize);
        let mut wrong = Mismatches::default();
        for (ix, ray) in rays(&pose, &lattice).iter().enumerate() {
            let hit = reference::cast(&blocks, &lattice, ray);
            let got = picture.depth_m[ix];
            n_hits += usize::from(hit.is_some());
            let rgba = &picture.rgba_srgb[4 * ix..4 * ix + 4];
            assert_eq!(rgba[3] == 255, got > 0.0);
            let Some(hit) = hit.filter(|hit| got > 0.0 && (f64::from(got) - hit.depth_m).abs() < 0.2 * lattice.voxel_m)
            else {
                n_off += usize::from(hit.is_some() || got > 0.0);
                continue;
            };
            for (got, expected) in rgba.iter().zip(hit.color_srgb) {
                wrong.check(ix, f64::from(*got), 255.0 * expected, 3.0, 0.0);
            }
        }
        assert!(n_hits > 2000, "{n_hits}");
        assert!((n_off as f64) < 0.01 * n_hits as f64, "{n_off} of {n_hits} are off");
        wrong.assert_none();
    }
}

#[test]
fn readings_are_those_of_the_twin() {
    use super::kernels::Pipelines;
    use super::params::{DepthFrame, Field};
    use super::passes::FrameSlot;
    let keyframe = &scene()[0];
    let depth = keyframe.depth.as_ref().unwrap();
    for options in forms() {
        let gpu = Gpu::open(&options).unwrap();
        let lattice = Lattice::choose(&scenes::options(), depth).unwrap();
        let field = super::buffers::FieldBuffers::new(
            &gpu,
            &lattice,
            super::buffers::Capacity { n_blocks: 2048, n_chunks: 256 },
        )
        .unwrap();
        assert_eq!(field.field.bytes(), size_of::<Field>() as u64);
        let n = depth.depth_m.len();
        let mut slot = FrameSlot::new(&gpu, n as u64, u64::from(keyframe.size_px[0] * keyframe.size_px[1])).unwrap();
        slot.upload(&gpu, keyframe, &DepthFrame::of(keyframe, &lattice).unwrap());
        let mut list = crate::gpu::Passes::default();
        let pipelines = Pipelines::new(&gpu).unwrap();
        super::passes::fuse(&gpu, &mut list, &pipelines, &field, &slot);
        list.submit(&gpu);
        let got: Vec<[f32; 2]> = gpu.read(slot.readings(), n).unwrap();
        let mut wrong = Mismatches::default();
        for (ix, (got, expected)) in got.iter().zip(reference::readings(depth, &lattice)).enumerate() {
            wrong.check(format!("depth {ix}"), got[0].into(), expected.depth_m, 1e-9, 1e-6);
            wrong.check(format!("turned {ix}"), got[1].into(), expected.turned, 2e-4, 1e-4);
        }
        wrong.assert_none();
    }
}

#[test]
fn poisoned_depth_gives_no_blocks_and_the_rest_is_as_without_it() {
    let clean = scene();
    let mut poisoned = clean.clone();
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 1e30, f32::MIN_POSITIVE, -0.0];
    let spoil = |keyframe: &mut Arc<Keyframe>, fill: &dyn Fn(usize, f32) -> f32| {
        let depth = Arc::make_mut(keyframe).depth.as_mut().unwrap();
        depth.depth_m = depth.depth_m.iter().enumerate().map(|(ix, z)| fill(ix, *z)).collect::<Vec<_>>().into();
    };
    // Holes in one, the same places poisoned in the other.
    let mut holes = clean.clone();
    spoil(&mut holes[1], &|ix, z| if ix % 11 == 3 { 0.0 } else { z });
    spoil(&mut poisoned[1], &|ix, z| if ix % 11 == 3 { bad[ix % bad.len()] } else { z });
    for options in forms() {
        let expected = fused(&options, &holes).0;
        assert!(fused(&options, &poisoned).0 == expected);
        let all_bad: Vec<_> = poisoned
            .iter()
            .cloned()
            .map(|mut keyframe| {
                spoil(&mut keyframe, &|ix, _| bad[ix % bad.len()]);
                keyframe
            })
            .collect();
        let gpu = Gpu::open(&options).unwrap();
        let mut model = TsdfModel::new(gpu, TsdfOptions::default()).unwrap();
        for keyframe in all_bad {
            model.push(keyframe).unwrap();
        }
        fuse_all(&mut model);
        assert!(model.blocks().unwrap().is_empty());
        assert_eq!(model.progress().step, 3);
    }
}

/// What f32 makes of places of a metre or two, metres.
const PLACE_ABS_M: f64 = 1e-6;
/// Normals are told in 16 bits a number.
const NORMAL_ABS: f64 = 2e-4;
/// Colors are told in 8 bits; one more where f32 rounds the other way.
const MESH_COLOR_ABS: f64 = 0.51 / 255.0;

fn edge_of(vertex: &Vertex) -> u32 {
    let ([x, y, z], axis) = vertex.between;
    u32::try_from(3 * (81 * z + 9 * y + x)).unwrap() + u32::try_from(axis).unwrap()
}

/// Every difference between a block's triangles and its twin's.
fn compare_triangles(wrong: &mut Mismatches, place: Place, got: &BlockMesh, twin: &BlockTriangles) {
    let edges = |corners: &[u32; 3]| corners.map(|ix| got.vertices[ix as usize].edge);
    let got_edges: Vec<_> = got.triangles.iter().map(edges).collect();
    let twin_edges: Vec<_> = twin.triangles.iter().map(|ixs| ixs.map(|ix| edge_of(&twin.vertices[ix]))).collect();
    assert_eq!(got_edges, twin_edges, "{place:?}");
    assert_eq!(got.vertices.len(), twin.vertices.len(), "{place:?}");
    let by_edge: BTreeMap<u32, &MeshVertex> = got.vertices.iter().map(|vertex| (vertex.edge, vertex)).collect();
    for expected in &twin.vertices {
        let vertex = by_edge[&edge_of(expected)];
        let color = vertex.color.to_le_bytes();
        let normal = unit_of(vertex.normal);
        for axis in 0..3 {
            let told = |what: &str| format!("{what} {axis} at {place:?} {:?}", expected.between);
            let along_m = f64::from(vertex.position_m[axis]);
            wrong.check(told("place"), along_m, expected.position_m[axis], PLACE_ABS_M, 0.0);
            wrong.check(told("normal"), f64::from(normal[axis]), expected.normal[axis], NORMAL_ABS, 0.0);
            let part = f64::from(color[axis]) / 255.0;
            wrong.check(told("color"), part, expected.color_srgb[axis], MESH_COLOR_ABS, 0.0);
        }
    }
}

#[test]
fn triangles_are_those_of_the_twin() {
    // The second does a few blocks at a time and has to make room first.
    let rooms = [MeshRoom::default(), MeshRoom { n_blocks: 100, n_vertices: 1, n_triangles: 1 }];
    for (options, room) in forms().into_iter().zip(rooms) {
        let (blocks, lattice, _) = fused(&options, &scene());
        let gpu = Gpu::open(&options).unwrap();
        let pipelines = Pipelines::new(&gpu).unwrap();
        let capacity = Capacity { n_blocks: 1, n_chunks: 64 };
        let field = FieldBuffers::with_blocks(&gpu, &pipelines, &lattice, &blocks, capacity).unwrap();
        let mut buffers = MeshBuffers::new(&gpu, room, field.capacity.n_blocks).unwrap();
        assert!(buffers.of_changed(&gpu, &pipelines, &field).unwrap().is_empty(), "nothing changed");
        field.mark_changed(&gpu, &blocks.keys().copied().collect()).unwrap();
        let made = buffers.of_changed(&gpu, &pipelines, &field).unwrap();
        let done: BTreeSet<Place> = made.iter().map(|(place, _)| *place).collect();
        assert!(made.len() == blocks.len() && done.into_iter().eq(blocks.keys().copied()));
        let mut wrong = Mismatches::default();
        for (place, mesh) in &made {
            compare_triangles(&mut wrong, *place, mesh, &reference::march(&blocks, *place, lattice.voxel_m));
        }
        assert!(made.iter().map(|(_, mesh)| mesh.triangles.len()).sum::<usize>() > 5000);
        wrong.assert_none();
    }
}
