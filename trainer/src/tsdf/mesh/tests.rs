//! Checks that meshes of known shapes are accurate and closed.

use crate::Method;
use crate::model_options::ModelOptions;
use crate::test_scenes::{self as scenes, TestShape};
use crate::tsdf::tests::fuse_all;
use crate::tsdf::{TsdfModel, TsdfOptions};
use gpu::testing::test_gpu;
use keyframe::Keyframe;
use model_files::mesh::Mesh;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;
use std::sync::Arc;

fn model(options: ModelOptions<TsdfOptions>, keyframes: &[Arc<Keyframe>]) -> TsdfModel {
    let mut model = TsdfModel::new(test_gpu(), options).unwrap();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    fuse_all(&mut model);
    model
}

fn vertex_positions(mesh: &Mesh) -> impl Iterator<Item = Point3<f64>> {
    let origin = Vector3::from(mesh.origin_m);
    mesh.positions_m
        .iter()
        .map(move |vertex| (Vector3::from(vertex.map(f64::from)) + origin).into())
}

/// Mean and largest distance of the vertices from a shape, meters.
fn errors_m(mesh: &Mesh, shape: &TestShape) -> (f64, f64) {
    let errors: Vec<f64> = vertex_positions(mesh)
        .map(|vertex| shape.distance_m(&vertex).abs())
        .collect();
    (
        errors.iter().sum::<f64>() / errors.len() as f64,
        errors.iter().copied().fold(0.0, f64::max),
    )
}

/// Number of occurrences of each edge, in either direction.
fn edges(mesh: &Mesh) -> BTreeMap<[u32; 2], i32> {
    let mut edges = BTreeMap::new();
    for [a, b, c] in &mesh.triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            *edges.entry([*from.min(to), *from.max(to)]).or_insert(0) += 1;
        }
    }
    edges
}

fn ball_mesh() -> (Mesh, TestShape, f64) {
    let ball = scenes::ball(Point3::new(0.31, -0.22, 0.13));
    let TestShape::Sphere { center_m, .. } = ball else {
        unreachable!("a ball is a sphere")
    };
    let mut model = model(
        scenes::options(),
        &scenes::all_around(&[ball], center_m, 24),
    );
    (model.mesh().unwrap(), ball, 0.02)
}

#[test]
fn mesh_of_ball_is_closed_and_round() {
    let (mesh, ball, voxel_m) = ball_mesh();
    let (mean_m, max_m) = errors_m(&mesh, &ball);
    assert!(
        mean_m < 0.1 * voxel_m && max_m < 0.5 * voxel_m,
        "mean {mean_m} m, largest {max_m} m"
    );
    let open = edges(&mesh).into_values().filter(|n| *n != 2).count();
    assert_eq!(open, 0, "open edges of {} triangles", mesh.triangles.len());
    assert!(mesh.triangles.len() > 1000);
    // Euler characteristic of a closed surface without holes.
    let n_edges = edges(&mesh).len();
    assert_eq!(mesh.positions_m.len() + mesh.triangles.len(), n_edges + 2);
    let TestShape::Sphere { center_m, .. } = ball else {
        unreachable!("a ball is a sphere")
    };
    for (vertex, normal) in vertex_positions(&mesh).zip(&mesh.normals) {
        let normal = Vector3::from(normal.map(f64::from));
        assert!((normal.norm() - 1.0).abs() < 1e-5);
        assert!(
            normal.dot(&(vertex - center_m).normalize()) > 0.9,
            "{vertex} {normal}"
        );
    }
    let off: f64 = vertex_positions(&mesh)
        .zip(&mesh.colors_srgb)
        .map(|(vertex, color)| {
            let expected = scenes::color_srgb(&vertex);
            (0..3)
                .map(|part| (f64::from(color[part]) / 255.0 - expected[part]).abs())
                .sum::<f64>()
                / 3.0
        })
        .sum::<f64>()
        / mesh.positions_m.len() as f64;
    assert!(off < 0.02, "mean color error {off}");
}

#[test]
fn mesh_of_slanted_wall_is_flat() {
    let normal = Vector3::new(0.3, -0.2, 1.0).normalize();
    let wall = TestShape::Plane {
        normal,
        offset_m: 0.05,
    };
    let mut model = model(
        scenes::options(),
        &scenes::ring(&[wall], Point3::origin(), 4),
    );
    let mut mesh = model.mesh().unwrap();
    // The test checks only near vertices, because far away, pixels are wider than voxels and the
    // wall is seen at an angle.
    let is_near = vertex_positions(&mesh)
        .map(|vertex| vertex.coords.norm() < 0.8)
        .collect::<Vec<_>>();
    let mut near = is_near.iter();
    mesh.positions_m.retain(|_| near.next() == Some(&true));
    assert!(mesh.positions_m.len() > 1000);
    let (mean_m, max_m) = errors_m(&mesh, &wall);
    assert!(
        mean_m < 0.002 && max_m < 0.01,
        "mean {mean_m} m, largest {max_m} m"
    );
}

#[test]
fn incremental_mesh_equals_full_mesh() {
    let at = Point3::new(0.1, 0.0, 0.2);
    let keyframes = scenes::ring(&[scenes::ball(at), scenes::floor()], at, 4);
    let whole = model(scenes::options(), &keyframes).mesh().unwrap();
    let mut incremental = TsdfModel::new(test_gpu(), scenes::options()).unwrap();
    for keyframe in &keyframes {
        incremental.push(keyframe.clone()).unwrap();
        while incremental.step(1).unwrap() > 0 {}
        incremental.mesh().unwrap();
    }
    assert!(incremental.mesh().unwrap() == whole);
}

#[test]
fn clustered_mesh_is_smaller_and_close() {
    let (mesh, ball, _) = ball_mesh();
    let coarse = mesh.clustered(0.08);
    assert!(
        coarse.triangles.len() * 5 < mesh.triangles.len(),
        "{} of {}",
        coarse.triangles.len(),
        mesh.triangles.len()
    );
    assert!(!coarse.triangles.is_empty());
    let (mean_m, _) = errors_m(&coarse, &ball);
    assert!(mean_m < 0.01, "{mean_m} m");
    assert!(
        coarse
            .triangles
            .iter()
            .flatten()
            .all(|ix| (*ix as usize) < coarse.positions_m.len())
    );
    for cell_m in [0.0, -1.0, f64::NAN] {
        assert!(mesh.clustered(cell_m) == mesh);
    }
}
