//! Tests of erased parts of a distance field, which pictures, meshes and exports leave out, and of
//! floaters.

use super::mesh::floaters;
use super::tests::{BALL_CENTER, ball_on_floor, fused_model, gpu, same, view_of};
use super::{TsdfModel, TsdfOptions};
use crate::method_entry::{ExportRequest, ExportWriter};
use crate::test_scenes::{self as scenes, TestShape};
use crate::{Method, ModelKind, RenderRequest};
use kinematics::Transform;
use model_files::Aabb;
use model_files::edits::{Edit, Edits};
use model_files::mesh::Mesh;
use nalgebra::{Point3, Vector3};
use std::sync::Arc;

/// A box around the ball that ends 5 cm above the floor.
fn ball_box() -> Aabb {
    let world_from_box = Transform::translation(BALL_CENTER.x, BALL_CENTER.y, BALL_CENTER.z);
    Aabb {
        world_from_box,
        min_m: [-0.35, -0.35, -0.25],
        max_m: [0.35; 3],
    }
}

fn without_ball() -> Arc<Edits> {
    let mut edits = Edits::default();
    edits.push(Edit::Box(ball_box())).unwrap();
    Arc::new(edits)
}

fn positions(mesh: &Mesh) -> Vec<[f64; 3]> {
    let origin = Vector3::from(mesh.origin_m);
    mesh.positions_m
        .iter()
        .map(|at| (Vector3::from(at.map(f64::from)) + origin).into())
        .collect()
}

#[test]
fn erased_object_shows_what_is_behind_it() {
    let keyframes = ball_on_floor(6);
    let mut model = fused_model(scenes::options(), &keyframes);
    let view = scenes::request(view_of(&keyframes[0]));
    let whole = model.render(&view).unwrap();
    let edited = model
        .render(&RenderRequest {
            edits: without_ball(),
            ..view.clone()
        })
        .unwrap();
    let erased = ball_box();
    let mut n_revealed = 0;
    let mut n_kept = 0;
    for (ix, (before, after)) in whole.depth_m.iter().zip(&edited.depth_m).enumerate() {
        let point = |depth_m: f32| point_at(&view.world_from_camera, ix, depth_m);
        if *before > 0.0 && !erased.contains(point(*before)) {
            n_kept += 1;
            assert_eq!(
                before.to_bits(),
                after.to_bits(),
                "pixel {ix} shows something else"
            );
        } else if *after > 0.0 {
            n_revealed += 1;
            // Rounding to f32 may move a point that lies on a side of the box.
            assert!(
                !erased.contains(point(*after + 1e-5)),
                "pixel {ix} shows erased space"
            );
            assert!(after > before, "pixel {ix} shows something nearer");
        }
    }
    assert!(
        n_kept > 2000 && n_revealed > 300,
        "{n_kept} pixels kept, {n_revealed} show what is behind the ball"
    );
    assert!(same(&model.render(&view).unwrap(), &whole), "after an undo");
}

/// The point in world that a pixel of a view shows.
fn point_at(world_from_camera: &Transform, pixel_ix: usize, depth_m: f32) -> [f64; 3] {
    let width = scenes::SIZE_PX[0] as usize;
    let position_px = [pixel_ix % width, pixel_ix / width].map(|at| at as f64 + 0.5);
    let along =
        |axis: usize| (position_px[axis] - scenes::PRINCIPAL_PX[axis]) / scenes::FOCAL_PX[axis];
    (world_from_camera * (Point3::new(along(0), along(1), 1.0) * f64::from(depth_m)))
        .coords
        .into()
}

#[test]
fn mesh_files_and_exports_lack_erased_triangles() {
    let mut model = fused_model(scenes::options(), &ball_on_floor(6));
    let whole = model.mesh().unwrap();
    let edits = without_ball();
    let left = model.mesh_without(&edits).unwrap();
    let margin = Vector3::repeat(0.02);
    let inner = Aabb {
        min_m: (Vector3::from(ball_box().min_m) + margin).into(),
        max_m: (Vector3::from(ball_box().max_m) - margin).into(),
        ..ball_box()
    };
    let n_inside = |mesh: &Mesh| {
        positions(mesh)
            .into_iter()
            .filter(|at| inner.contains(*at))
            .count()
    };
    let n_outside = |mesh: &Mesh| {
        positions(mesh)
            .into_iter()
            .filter(|at| !ball_box().contains(*at))
            .count()
    };
    assert!(
        n_inside(&whole) > 1000 && n_inside(&left) == 0,
        "{} and {}",
        n_inside(&whole),
        n_inside(&left)
    );
    assert_eq!(n_outside(&whole), n_outside(&left));

    let folder = tempfile::tempdir().unwrap();
    model.save(folder.path()).unwrap();
    edits.write(folder.path()).unwrap();
    let saved = std::fs::read(folder.path().join("mesh.ply")).unwrap();
    let kind = ModelKind::of_saved(folder.path()).unwrap().unwrap();
    let out = folder.path().join("exported.ply");
    let export = kind
        .entry()
        .exports
        .iter()
        .find(|export| export.format == "ply")
        .unwrap();
    let ExportWriter::Gpu(write) = export.write else {
        panic!("the mesh is extracted on the GPU")
    };
    let exported = write(
        gpu(),
        &ExportRequest {
            model: folder.path(),
            out: &out,
            cell_m: None,
        },
    )
    .unwrap();
    assert_eq!(exported.n_items, left.triangles.len() as u64);
    model.write_for_others(folder.path(), &edits).unwrap();
    let rewritten = std::fs::read(folder.path().join("mesh.ply")).unwrap();
    assert!(rewritten == std::fs::read(&out).unwrap() && rewritten.len() < saved.len());
    let mut loaded = TsdfModel::load(gpu(), folder.path()).unwrap();
    assert!(
        loaded.mesh().unwrap() == whole,
        "the folder holds the complete field"
    );
}

#[test]
fn floaters_are_found_and_the_rest_is_kept() {
    const FLOATER: Point3<f64> = Point3::new(0.75, -0.2, 0.35);
    let options = scenes::options().with(|options| {
        options.specific = TsdfOptions {
            voxel_m: Some(0.01),
            ..options.specific.clone()
        };
    });
    let floater = TestShape::Sphere {
        center_m: FLOATER,
        radius_m: 0.02,
    };
    let shapes = [scenes::ball(BALL_CENTER), scenes::floor(), floater];
    let mut model = fused_model(options, &scenes::ring(&shapes, BALL_CENTER, 6));
    let whole = model.mesh().unwrap();
    let found = model
        .find_floaters(&Arc::default())
        .unwrap()
        .finish()
        .unwrap();
    let mut edits = Edits::default();
    edits.push(Edit::Cells(found.cells)).unwrap();
    let left = model.mesh_without(&edits).unwrap();
    let near = |mesh: &Mesh| {
        positions(mesh)
            .into_iter()
            .filter(|at| (Point3::from(*at) - FLOATER).norm() < 0.05)
            .count()
    };
    assert!(
        near(&whole) > 5 && near(&left) == 0,
        "{} vertices, then {}",
        near(&whole),
        near(&left)
    );
    assert_eq!(
        found.n_erased,
        (whole.triangles.len() - left.triangles.len()) as u64
    );
    assert_eq!(found.item, "triangle");
    assert!(
        left.triangles.len() * 100 > whole.triangles.len() * 97,
        "{} erased",
        found.n_erased
    );
    let ball = |mesh: &Mesh| {
        positions(mesh)
            .into_iter()
            .filter(|at| (Point3::from(*at) - BALL_CENTER).norm() < 0.33)
            .count()
    };
    // The ball has some small fragments where it was seen at grazing angles.
    assert!(
        ball(&left) * 100 > ball(&whole) * 98,
        "{} of {} vertices of the ball",
        ball(&left),
        ball(&whole)
    );
    // The erased cells may cut off a few triangles.
    let n_again = model
        .find_floaters(&Arc::new(edits))
        .unwrap()
        .finish()
        .map_or(0, |again| again.n_erased);
    assert!(
        10 * n_again <= found.n_erased,
        "{n_again} found again after {}",
        found.n_erased
    );
}

#[test]
fn small_part_of_a_mesh_is_a_floater() {
    const N: u32 = 60;
    #[expect(clippy::cast_precision_loss, reason = "a small grid")]
    let mut mesh = Mesh {
        origin_m: [5.0, 0.0, 0.0],
        positions_m: (0..N * N)
            .map(|ix| [(ix % N) as f32 * 0.01, (ix / N) as f32 * 0.01, 0.0])
            .collect(),
        ..Mesh::default()
    };
    for y in 0..N - 1 {
        let corners = (0..N - 1).map(|x| x + N * y);
        mesh.triangles
            .extend(corners.flat_map(|at| [[at, at + 1, at + N], [at + 1, at + N + 1, at + N]]));
    }
    assert_eq!(floaters(&mesh, 0.01), None);
    mesh.positions_m
        .extend([[0.3, 0.3, 0.2], [0.31, 0.3, 0.2], [0.3, 0.31, 0.2]]);
    mesh.triangles.push([N * N, N * N + 1, N * N + 2]);
    let found = floaters(&mesh, 0.01).unwrap();
    assert_eq!(found.n_erased, 1);
    assert!(
        found.cells.contains([5.303, 0.303, 0.2]) && !found.cells.contains([5.303, 0.303, 0.0])
    );
}
