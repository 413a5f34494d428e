//! Tests of chunks of meshes, which are decoded as `docs/reference/protocol.md` says.

use crate::test_scenes as scenes;
use crate::tsdf::TsdfModel;
use crate::{ChunkLayout, Method, ModelChunk, ModelChunks};
use flate2::read::ZlibDecoder;
use gpu::testing::test_gpu;
use kinematics::Transform;
use model_files::Aabb;
use model_files::edits::{Edit, Edits};
use model_files::mesh::Mesh;
use nalgebra::{Point3, Vector3};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::Read;
use std::sync::Arc;

/// A vertex: position in world in meters, and color.
type Vertex = (Vector3<f64>, [u8; 3]);
type Triangles = Vec<[Vertex; 3]>;

fn u16_at(bytes: &[u8], ix: usize) -> u16 {
    u16::from_le_bytes([bytes[2 * ix], bytes[2 * ix + 1]])
}

fn decoded(chunk: &ModelChunk) -> Triangles {
    let ChunkLayout::Mesh {
        origin_m,
        meters_per_count,
        n_vertices,
        n_triangles,
    } = chunk.fine.layout
    else {
        panic!("a mesh")
    };
    assert!(
        n_vertices <= 1 << 16,
        "{n_vertices} vertices: indices would have 32 bits"
    );
    let mut bytes = Vec::new();
    ZlibDecoder::new(&chunk.fine.bytes[..])
        .read_to_end(&mut bytes)
        .unwrap();
    assert_eq!(bytes.len(), 9 * n_vertices + 6 * n_triangles);
    let (positions, rest) = bytes.split_at(6 * n_vertices);
    let (colors, indices) = rest.split_at(3 * n_vertices);
    let mut counts = [0_u16; 3];
    let mut color = [0_u8; 3];
    let vertices: Vec<Vertex> = (0..n_vertices)
        .map(|ix| {
            counts = std::array::from_fn(|axis| {
                counts[axis].wrapping_add(u16_at(positions, 3 * ix + axis))
            });
            color = std::array::from_fn(|part| color[part].wrapping_add(colors[3 * ix + part]));
            (
                Vector3::from(origin_m) + Vector3::from(counts.map(f64::from)) * meters_per_count,
                color,
            )
        })
        .collect();
    let mut last = 0_u16;
    let corners: Vec<Vertex> = (0..3 * n_triangles)
        .map(|ix| {
            last = last.wrapping_add(u16_at(indices, ix));
            vertices[usize::from(last)]
        })
        .collect();
    corners.as_chunks::<3>().0.to_vec()
}

/// The triangles of a client that applies these messages one after the other.
#[derive(Default)]
struct Replica {
    chunks: BTreeMap<u64, Triangles>,
    n_bytes: usize,
}

impl Replica {
    fn apply(&mut self, new: &ModelChunks) {
        if new.is_complete {
            self.chunks.clear();
        }
        for id in &new.removed {
            self.chunks.remove(id);
        }
        for chunk in &new.chunks {
            assert!(chunk.id < 1 << 53 && chunk.change > 0.0);
            self.n_bytes += chunk.fine.bytes.len();
            self.chunks.insert(chunk.id, decoded(chunk));
        }
    }

    /// Checks that both meshes have the same triangles and colors, except for rounding.
    fn assert_equals(&self, mesh: &Mesh, voxel_m: f64) {
        let cell_m = 0.01 * voxel_m;
        #[expect(clippy::cast_possible_truncation, reason = "cells of a small scene")]
        let cell = |position: &Vector3<f64>| {
            <[i64; 3]>::from(position.map(|along| (along / cell_m).floor() as i64))
        };
        let mut by_cell: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
        let positions: Vec<Vector3<f64>> = mesh
            .positions_m
            .iter()
            .map(|at| Vector3::from(mesh.origin_m) + Vector3::from(at.map(f64::from)))
            .collect();
        for (ix, position) in positions.iter().enumerate() {
            by_cell.entry(cell(position)).or_default().push(ix);
        }
        let nearest = |(position, color): &Vertex| -> usize {
            let [x, y, z] = cell(position);
            let near = (0..27).filter_map(|ix| {
                by_cell.get(&[x + ix % 3 - 1, y + ix / 3 % 3 - 1, z + ix / 9 - 1])
            });
            let distance = |ix: &usize| (positions[*ix] - position).norm();
            let ix = near
                .flatten()
                .copied()
                .min_by(|a, b| distance(a).total_cmp(&distance(b)))
                .expect("a vertex");
            assert!(
                distance(&ix) <= voxel_m / 1024.0,
                "{} m away",
                distance(&ix)
            );
            assert_eq!(mesh.colors_srgb[ix], *color);
            ix
        };
        let canonical = |corners: [usize; 3]| {
            let first = (0..3).min_by_key(|at| corners[*at]).unwrap_or(0);
            [0, 1, 2].map(|at| corners[(first + at) % 3])
        };
        let got: BTreeSet<_> = self
            .chunks
            .values()
            .flatten()
            .map(|corners| canonical(corners.each_ref().map(nearest)))
            .collect();
        let expected: BTreeSet<_> = mesh
            .triangles
            .iter()
            .map(|corners| canonical(corners.map(|ix| ix as usize)))
            .collect();
        // Rounding may swap vertices whose distance is less than one count.
        let n_different = got.symmetric_difference(&expected).count();
        assert!(
            1000 * n_different < expected.len(),
            "{n_different} of {} triangles differ",
            expected.len()
        );
    }
}

#[test]
fn chunks_follow_the_mesh() {
    let at = Point3::new(0.1, 0.0, 0.2);
    let keyframes = scenes::ring(&[scenes::ball(at), scenes::floor()], at, 4);
    let mut model = TsdfModel::new(test_gpu(), scenes::options()).unwrap();
    assert!(
        model
            .queue_chunks(false, &Arc::default())
            .unwrap()
            .is_none(),
        "an empty model"
    );
    let mut replica = Replica::default();
    for keyframe in &keyframes {
        model.push(keyframe.clone()).unwrap();
        while model.step(1).unwrap() > 0 {}
        replica.apply(
            &model
                .queue_chunks(true, &Arc::default())
                .unwrap()
                .unwrap()
                .finish()
                .unwrap(),
        );
    }
    let voxel_m = model.voxel_grid().unwrap().voxel_m;
    let mesh = model.mesh().unwrap();
    replica.assert_equals(&mesh, voxel_m);
    let none = model
        .queue_chunks(true, &Arc::default())
        .unwrap()
        .unwrap()
        .finish()
        .unwrap();
    assert!(!none.is_complete && none.chunks.is_empty() && none.removed.is_empty());
    let mut complete = Replica::default();
    let all = model
        .queue_chunks(false, &Arc::default())
        .unwrap()
        .unwrap()
        .finish()
        .unwrap();
    assert!(all.is_complete);
    complete.apply(&all);
    complete.assert_equals(&mesh, voxel_m);
    let bytes_per_triangle = complete.n_bytes as f64 / mesh.triangles.len() as f64;
    assert!(
        bytes_per_triangle < 9.0,
        "{bytes_per_triangle} bytes per triangle"
    );
    eprintln!(
        "{} triangles in {} chunks, {bytes_per_triangle:.1} bytes each",
        mesh.triangles.len(),
        all.chunks.len()
    );
}

#[test]
fn removed_surfaces_remove_chunks() {
    let at = Point3::new(0.1, 0.0, 0.2);
    let with = scenes::ring(&[scenes::ball(at), scenes::floor()], at, 2);
    let without = scenes::ring(&[scenes::floor()], at, 8);
    let mut model = TsdfModel::new(test_gpu(), scenes::options()).unwrap();
    let mut replica = Replica::default();
    let mut n_removed = 0;
    for keyframe in with
        .iter()
        .chain(std::iter::repeat_n(&without, 4).flatten())
    {
        model.push(keyframe.clone()).unwrap();
        while model.step(1).unwrap() > 0 {}
        let new = model
            .queue_chunks(true, &Arc::default())
            .unwrap()
            .unwrap()
            .finish()
            .unwrap();
        n_removed += new.removed.len();
        replica.apply(&new);
    }
    assert!(n_removed > 0, "the ball is gone");
    let voxel_m = model.voxel_grid().unwrap().voxel_m;
    replica.assert_equals(&model.mesh().unwrap(), voxel_m);
}

#[test]
fn chunks_lack_erased_triangles() {
    let at = Point3::new(0.1, 0.0, 0.2);
    let mut model = TsdfModel::new(test_gpu(), scenes::options()).unwrap();
    for keyframe in scenes::ring(&[scenes::ball(at), scenes::floor()], at, 4) {
        model.push(keyframe).unwrap();
    }
    while model.step(u64::MAX).unwrap() > 0 {}
    let mut edits = Edits::default();
    let world_from_box = Transform::translation(at.x, at.y, at.z + 0.1);
    edits
        .push(Edit::Box(Aabb {
            world_from_box,
            min_m: [-0.4; 3],
            max_m: [0.4; 3],
        }))
        .unwrap();
    let none = Arc::default();
    let edits = Arc::new(edits);
    let mut replica = Replica::default();
    let voxel_m = model.voxel_grid().unwrap().voxel_m;
    let n_all = model
        .queue_chunks(false, &none)
        .unwrap()
        .unwrap()
        .finish()
        .unwrap()
        .chunks
        .len();
    for applied in [&none, &edits, &none] {
        let new = model
            .queue_chunks(!replica.chunks.is_empty(), applied)
            .unwrap()
            .unwrap()
            .finish()
            .unwrap();
        let is_first = replica.chunks.is_empty();
        assert!(
            is_first || new.chunks.len() + new.removed.len() < n_all,
            "only changed chunks are sent"
        );
        replica.apply(&new);
        replica.assert_equals(&model.mesh_without(applied).unwrap(), voxel_m);
    }
}
