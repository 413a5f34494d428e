//! Tests of the whole model: rendering, carving, memory limits, saving and resuming.

use super::{TsdfModel, TsdfOptions};
use crate::test_scenes::{self as scenes, SIZE_PX, TestShape};
use crate::{Error, Method, ModelKind, ModelOptions, Picture, Projection, RenderRequest};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::Keyframe;
use kinematics::{Stamp, Transform};
use model_files::Aabb;
use model_files::checkpoint::Checkpoint;
use nalgebra::{Point3, Vector3};
use numbers::f32_of;
use numbers::quantile::{Rank, quantile};
use numbers::random::Random;
use std::sync::Arc;

pub(super) fn gpu() -> Arc<Gpu> {
    test_gpu()
}

fn model_with(options: ModelOptions<TsdfOptions>, keyframes: &[Arc<Keyframe>]) -> TsdfModel {
    let mut model = TsdfModel::new(gpu(), options).unwrap();
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    model
}

/// Fuses all pending keyframes.
pub(super) fn fuse_all(model: &mut TsdfModel) {
    while !model.is_idle() {
        model.step(u64::MAX).unwrap();
    }
}

pub(super) fn fused_model(
    options: ModelOptions<TsdfOptions>,
    keyframes: &[Arc<Keyframe>],
) -> TsdfModel {
    let mut model = model_with(options, keyframes);
    fuse_all(&mut model);
    model
}

pub(super) const BALL_CENTER: Point3<f64> = Point3::new(0.3, -0.2, 0.1);

pub(super) fn ball_on_floor(n: usize) -> Vec<Arc<Keyframe>> {
    scenes::ring(
        &[scenes::ball(BALL_CENTER), scenes::floor()],
        BALL_CENTER,
        n,
    )
}

pub(super) fn same(one: &Picture, other: &Picture) -> bool {
    let bits = |picture: &Picture| {
        picture
            .depth_m
            .iter()
            .map(|depth| depth.to_bits())
            .collect::<Vec<_>>()
    };
    one.rgba_srgb == other.rgba_srgb && bits(one) == bits(other)
}

pub(super) fn view_of(keyframe: &Keyframe) -> Transform {
    keyframe.depth.as_ref().unwrap().world_from_camera
}

#[test]
fn rendered_view_matches_input_depth() {
    let keyframes = ball_on_floor(6);
    let mut model = fused_model(scenes::options(), &keyframes);
    let depth = keyframes[2].depth.as_ref().unwrap();
    let picture = model
        .render(&scenes::request(view_of(&keyframes[2])))
        .unwrap();
    let mut errors: Vec<f64> = picture
        .depth_m
        .iter()
        .zip(depth.depth_m.iter())
        .filter(|(got, seen)| **got > 0.0 && **seen > 0.0 && **seen < 2.0)
        .map(|(got, seen)| f64::from(got - seen).abs())
        .collect();
    assert!(errors.len() > 4000, "{}", errors.len());
    let [half, most, nearly_all] =
        [0.5, 0.95, 0.98].map(|frac| quantile(&mut errors, frac, Rank::Upper).unwrap());
    // At the rim of the ball, a pixel may hit the background instead.
    assert!(
        half < 0.0005 && most < 0.002 && nearly_all < 0.02,
        "{half} {most} {nearly_all}"
    );
    assert!(
        picture
            .rgba_srgb
            .chunks_exact(4)
            .zip(&picture.depth_m)
            .all(|(rgba, z)| (rgba[3] == 255) == (*z > 0.0))
    );
}

#[test]
fn removed_object_is_carved() {
    let mut keyframes = ball_on_floor(4);
    let mut without_ball = scenes::ring(&[scenes::floor()], BALL_CENTER, 4);
    for (ix, keyframe) in without_ball.iter_mut().enumerate() {
        Arc::make_mut(keyframe).stamp = Stamp(100 + i64::try_from(ix).unwrap());
    }
    let near_ball = |model: &mut TsdfModel| {
        let mesh = model.mesh().unwrap();
        let origin = Vector3::from(mesh.origin_m);
        let positions = mesh
            .positions_m
            .iter()
            .map(|position| Point3::from(Vector3::from(position.map(f64::from)) + origin));
        positions
            .filter(|position| (position - BALL_CENTER).norm() < 0.33 && position.z > -0.2)
            .count()
    };
    let mut model = fused_model(scenes::options(), &keyframes);
    let n_before = near_ball(&mut model);
    keyframes.extend(without_ball);
    let mut model = fused_model(scenes::options(), &keyframes);
    let n_after = near_ball(&mut model);
    assert!(
        n_before > 500 && n_after * 50 < n_before,
        "{n_after} of {n_before} vertices of the ball remain"
    );
    // The floor must remain.
    let picture = model
        .render(&scenes::request(view_of(&keyframes[0])))
        .unwrap();
    assert!(picture.depth_m.iter().filter(|depth| **depth > 0.0).count() > 5000);
}

/// Observes a ball `n_with` times, then observes the scene without it until its mesh is gone.
/// Returns the number of later observations until the upper part was gone, and until the part
/// within five voxels of the floor was gone.
fn n_views_until_removed(n_with: usize) -> [usize; 2] {
    const MAX_VIEWS: usize = 200;
    let [with_ball, without_ball] = [
        &[scenes::ball(BALL_CENTER), scenes::floor()][..],
        &[scenes::floor()],
    ]
    .map(|shapes| scenes::ring(shapes, BALL_CENTER, 4));
    let mut n_pushed = 0;
    let mut model = TsdfModel::new(gpu(), scenes::options()).unwrap();
    let mut add_view = |model: &mut TsdfModel, views: &[Arc<Keyframe>]| {
        let mut keyframe = views[n_pushed % views.len()].clone();
        Arc::make_mut(&mut keyframe).stamp = Stamp(i64::try_from(n_pushed).unwrap());
        n_pushed += 1;
        model.push(keyframe).unwrap();
        fuse_all(model);
    };
    let n_left = |model: &mut TsdfModel| {
        let mesh = model.mesh().unwrap();
        let origin = Vector3::from(mesh.origin_m);
        let positions = mesh
            .positions_m
            .iter()
            .map(|position| Point3::from(Vector3::from(position.map(f64::from)) + origin));
        let ball_vertices = positions
            .filter(|position| (position - BALL_CENTER).norm() < 0.33 && position.z > -0.28);
        let (upper, lower): (Vec<_>, Vec<_>) =
            ball_vertices.partition(|position| position.z > -0.2);
        [upper.len(), lower.len()]
    };
    for _ in 0..n_with {
        add_view(&mut model, &with_ball);
    }
    let before = n_left(&mut model);
    let mut n_views = [MAX_VIEWS; 2];
    for n in 1..=MAX_VIEWS {
        add_view(&mut model, &without_ball);
        let now = n_left(&mut model);
        for part in 0..2 {
            if 50 * now[part] <= before[part] {
                n_views[part] = n_views[part].min(n);
            }
        }
        if n_views.iter().all(|n| *n < MAX_VIEWS) {
            break;
        }
    }
    n_views
}

#[test]
fn removed_object_fades_faster_than_it_was_built() {
    // The measured numbers are 2, 7 and 17 observations. The lower part is overwritten by new
    // distances and disappears at once.
    for (n_with, max_views) in [(8, 3), (32, 9), (100, 20)] {
        let n_views = n_views_until_removed(n_with);
        assert!(
            n_views.iter().all(|n| *n <= max_views),
            "observed {n_with} times, gone after {n_views:?}"
        );
    }
}

#[test]
fn keyframes_without_depth_are_ignored() {
    let mut model = TsdfModel::new(gpu(), ModelOptions::default()).unwrap();
    let request = scenes::request(Transform::identity());
    let check = |model: &mut TsdfModel| {
        let picture = model.render(&request).unwrap();
        assert!(picture.depth_m.iter().all(|depth| *depth == 0.0));
        assert!(
            picture
                .rgba_srgb
                .chunks_exact(4)
                .all(|rgba| *rgba == [0, 128, 255, 0])
        );
        assert!(model.mesh().unwrap().triangles.is_empty());
        assert_eq!(model.step(5).unwrap(), 0);
        assert!(model.profile_step().unwrap().is_empty());
    };
    check(&mut model);
    let mut without_depth_keyframe = (*ball_on_floor(1)[0]).clone();
    without_depth_keyframe.depth = None;
    model.push(Arc::new(without_depth_keyframe)).unwrap();
    check(&mut model);
    let folder = tempfile::tempdir().unwrap();
    model.save(folder.path()).unwrap();
    check(&mut TsdfModel::load(gpu(), folder.path()).unwrap());
}

#[test]
fn back_faces_are_not_drawn() {
    let keyframes = ball_on_floor(4);
    let mut model = fused_model(scenes::options(), &keyframes);
    // The camera is just below the floor's surface and looks up and forward. The back of the floor
    // must not be rendered.
    let eye = Point3::new(BALL_CENTER.x, BALL_CENTER.y - 0.5, -0.33);
    let picture = model
        .render(&scenes::request(scenes::look_at(
            eye,
            eye + Vector3::new(0.0, 0.3, 1.0),
        )))
        .unwrap();
    let nearest = picture
        .depth_m
        .iter()
        .copied()
        .filter(|depth| *depth > 0.0)
        .fold(f32::INFINITY, f32::min);
    assert!(nearest > 0.05, "{nearest}");
    // Looking down from inside, nothing is visible.
    let down = scenes::look_at(eye, eye - Vector3::new(0.0, 0.3, 1.0));
    assert!(
        model
            .render(&scenes::request(down))
            .unwrap()
            .depth_m
            .iter()
            .all(|depth| *depth == 0.0)
    );
}

#[test]
fn precision_does_not_depend_on_distance_from_origin() {
    let origin = Vector3::new(4.1e5, -2.3e5, 80.0);
    let mut keyframes = Vec::new();
    let mut balls = Vec::new();
    for ix in 0..5 {
        let at = Point3::from(origin + Vector3::new(25.0 * f64::from(ix), 0.0, 0.0));
        balls.push(at);
        for mut keyframe in scenes::ring(&[scenes::ball(at)], at, 2) {
            Arc::make_mut(&mut keyframe).stamp = Stamp(i64::try_from(keyframes.len()).unwrap());
            keyframes.push(keyframe);
        }
    }
    let mut model = fused_model(scenes::options(), &keyframes);
    assert_eq!(model.n_outside(), 0);
    let mesh = model.mesh().unwrap();
    let far = Vector3::from(mesh.origin_m);
    let mut n = [0; 5];
    for position in &mesh.positions_m {
        let position = Point3::from(Vector3::from(position.map(f64::from)) + far);
        let (ix, at) = balls
            .iter()
            .enumerate()
            .min_by(|(_, a), (_, b)| (position - **a).norm().total_cmp(&(position - **b).norm()))
            .unwrap();
        n[ix] += 1;
        assert!(
            scenes::ball(*at).distance_m(&position).abs() < 0.015,
            "ball {ix}: {}",
            scenes::ball(*at).distance_m(&position)
        );
    }
    assert!(n.iter().all(|n| *n > 300), "{n:?}");
    let last = keyframes.last().unwrap();
    assert!(
        model
            .render(&scenes::request(view_of(last)))
            .unwrap()
            .depth_m
            .iter()
            .filter(|depth| **depth > 0.0)
            .count()
            > 1000
    );
}

#[test]
fn fusion_is_deterministic() {
    let keyframes = ball_on_floor(7);
    let mut whole = fused_model(scenes::options(), &keyframes);
    let mut again = fused_model(scenes::options(), &keyframes);
    let mut one_by_one = model_with(scenes::options(), &keyframes);
    while one_by_one.progress().step < 7 {
        one_by_one.step(1).unwrap();
    }
    let expected = whole.blocks().unwrap();
    assert!(again.blocks().unwrap() == expected && one_by_one.blocks().unwrap() == expected);
    let request = scenes::request(view_of(&keyframes[3]));
    let picture = whole.render(&request).unwrap();
    assert!(
        same(&again.render(&request).unwrap(), &picture)
            && same(&one_by_one.render(&request).unwrap(), &picture)
    );
    assert!(again.mesh().unwrap() == whole.mesh().unwrap());
}

#[test]
fn rendering_fuses_at_most_one_keyframe() {
    // The voxels are so fine that the first depth image initially overflows the pool.
    let mut model = model_with(
        scenes::options().with(|options| options.specific.voxel_m = Some(0.006)),
        &ball_on_floor(3),
    );
    model.step(2).unwrap();
    model
        .render(&scenes::request(view_of(&ball_on_floor(1)[0])))
        .unwrap();
    assert!(
        (1..=2).contains(&model.progress().step),
        "{:?}",
        model.progress()
    );
}

#[test]
fn step_fuses_exactly_the_requested_keyframes() {
    for n_requested in [1, 5, 7, 9] {
        let mut model = model_with(scenes::options(), &ball_on_floor(14));
        while model.progress().step < n_requested {
            model.step(n_requested - model.progress().step).unwrap();
        }
        assert_eq!(
            (model.progress().step, model.n_total_steps().unwrap()),
            (n_requested, n_requested)
        );
    }
}

#[test]
fn growing_pool_keeps_results() {
    // The voxels are so fine that the initial pool and table are too small.
    let fine = scenes::options().with(|options| options.specific.voxel_m = Some(0.006));
    let keyframes = ball_on_floor(3);
    let mut grown = fused_model(fine.clone(), &keyframes);
    assert!(grown.progress().primitives > 4096, "{:?}", grown.progress());
    let mut one_by_one = model_with(fine, &keyframes);
    while one_by_one.progress().step < 3 {
        one_by_one.step(1).unwrap();
    }
    assert!(grown.blocks().unwrap() == one_by_one.blocks().unwrap());
}

#[test]
fn swapping_to_host_memory_is_lossless() {
    // Two places are observed alternately, twice each. Only one of them fits into memory at a time.
    let far = Point3::new(8.0, 0.0, 0.1);
    let shapes = [scenes::ball(BALL_CENTER), scenes::ball(far)];
    let options = || scenes::options().with(|options| options.specific.max_depth_m = 3.0);
    let mut keyframes = Vec::new();
    for (from, at) in [(0, BALL_CENTER), (0, far), (2, BALL_CENTER), (2, far)] {
        for keyframe in &scenes::ring(&shapes, at, 4)[from..from + 2] {
            let mut keyframe = keyframe.clone();
            Arc::make_mut(&mut keyframe).stamp = Stamp(i64::try_from(keyframes.len()).unwrap());
            keyframes.push(keyframe);
        }
    }
    let mut unlimited = fused_model(options(), &keyframes);
    let n_all = unlimited.progress().primitives;
    let model_with_budget = |max_bytes| {
        let options = options().with(|options| options.common.max_bytes = Some(max_bytes));
        let mut model = TsdfModel::without_budget_check(gpu(), options).unwrap();
        keyframes
            .iter()
            .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
        fuse_all(&mut model);
        model
    };
    let table_bytes = unlimited.progress().bytes - super::capacity::BYTES_PER_BLOCK * n_all;
    let mut limited =
        model_with_budget(table_bytes + super::capacity::BYTES_PER_BLOCK * n_all * 6 / 10);
    assert_eq!(limited.n_skipped(), 0);
    assert!(limited.n_host_blocks() > 0);
    assert!(limited.blocks().unwrap() == unlimited.blocks().unwrap());
    for keyframe in [&keyframes[0], &keyframes[2], &keyframes[5]] {
        let request = RenderRequest {
            far_m: 3.0,
            ..scenes::request(view_of(keyframe))
        };
        assert!(same(
            &limited.render(&request).unwrap(),
            &unlimited.render(&request).unwrap()
        ));
    }
    assert!(limited.mesh().unwrap() == unlimited.mesh().unwrap());
    // The budget is too small for one image, so images are skipped and counted.
    let mut too_small = model_with_budget(20_000);
    assert_eq!((too_small.n_skipped(), too_small.progress().step), (8, 8));
    assert!(
        too_small
            .render(&scenes::request(view_of(&keyframes[0])))
            .is_ok()
    );
}

#[test]
fn memory_budget_is_kept_or_rejected() {
    let min_bytes = super::model::MIN_BYTES;
    let of = |max_bytes| {
        ModelOptions::<TsdfOptions>::default()
            .with(|options| options.common.max_bytes = Some(max_bytes))
    };
    let message = TsdfModel::new(gpu(), of(min_bytes - 1))
        .unwrap_err()
        .to_string();
    assert!(
        message.contains(&min_bytes.to_string()) && message.contains("distance field"),
        "{message}"
    );
    let small = fused_model(of(min_bytes), &ball_on_floor(4));
    assert_eq!(small.n_skipped(), 0);
    assert!(
        (min_bytes / 2..=min_bytes).contains(&small.progress().bytes),
        "{:?}",
        small.progress()
    );
}

#[test]
fn saved_model_renders_identically() {
    let keyframes = ball_on_floor(4);
    let mut model = fused_model(scenes::options(), &keyframes);
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(ModelKind::of_saved(folder.path()).unwrap(), None);
    model.save(folder.path()).unwrap();
    assert_eq!(
        ModelKind::of_saved(folder.path())
            .unwrap()
            .map(ModelKind::name),
        Some("tsdf")
    );
    for name in ["mesh.ply", "mesh.glb", "model.json"] {
        assert!(
            std::fs::metadata(folder.path().join(name)).unwrap().len() > 100,
            "{name}"
        );
    }
    let mut loaded = TsdfModel::load(gpu(), folder.path()).unwrap();
    let mut requests = vec![scenes::request(view_of(&keyframes[1]))];
    requests.push(RenderRequest {
        projection: Projection::Equirectangular,
        size_px: [64, 32],
        ..requests[0].clone()
    });
    for request in requests {
        let without_depth = model
            .render(&RenderRequest {
                depth: false,
                ..request.clone()
            })
            .unwrap();
        assert!(without_depth.depth_m.is_empty());
        assert!(without_depth.rgba_srgb == model.render(&request).unwrap().rgba_srgb);
        assert!(same(
            &loaded.render(&request).unwrap(),
            &model.render(&request).unwrap()
        ));
    }
    assert!(loaded.mesh().unwrap() == model.mesh().unwrap());
    std::fs::write(folder.path().join("field.blocks"), b"nonsense").unwrap();
    assert!(matches!(
        TsdfModel::load(gpu(), folder.path()),
        Err(Error::ModelFile(model_files::Error::Checkpoint { .. }))
    ));
}

fn checkpoint_of(model: &mut TsdfModel) -> Checkpoint {
    model.checkpoint().unwrap().finish().unwrap()
}

#[test]
fn resume_is_bit_exact() {
    let keyframes = ball_on_floor(6);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("training.ckpt");
    let mut whole = fused_model(scenes::options(), &keyframes);
    let mut parts = model_with(scenes::options(), &keyframes[..5]);
    for stop in [0, 2, 5] {
        while parts.progress().step < stop {
            let n_left = stop - parts.progress().step;
            parts.step(n_left).unwrap();
        }
        let before = checkpoint_of(&mut parts);
        before.write(&path).unwrap();
        let rest;
        (parts, rest) =
            TsdfModel::resume(gpu(), &Checkpoint::read(&path).unwrap(), &keyframes).unwrap();
        assert_eq!(rest.len(), 1);
        assert_eq!(rest[0].stamp, keyframes[5].stamp);
        assert!(checkpoint_of(&mut parts) == before);
    }
    parts.push(keyframes[5].clone()).unwrap();
    fuse_all(&mut parts);
    assert!(checkpoint_of(&mut parts) == checkpoint_of(&mut whole));
    assert!(parts.mesh().unwrap() == whole.mesh().unwrap());
    let refused = |checkpoint: &Checkpoint, keyframes: &[Arc<Keyframe>]| {
        TsdfModel::resume(gpu(), checkpoint, keyframes)
            .map(drop)
            .unwrap_err()
            .to_string()
    };
    let checkpoint = checkpoint_of(&mut parts);
    assert!(
        refused(&checkpoint, &keyframes[1..]).contains("the first is image 0 of camera \"test\"")
    );
    let broken = |change: &dyn Fn(&mut Checkpoint)| {
        let mut other = checkpoint.clone();
        change(&mut other);
        refused(&other, &keyframes)
    };
    assert!(broken(&|other| other.method = "splat".into()).contains("\"splat\""));
    assert!(broken(&|other| other.state["n_blocks"] = 1.into()).contains("\"block_coords\" has"));
    assert!(
        broken(&|other| other.state["voxel_grid"]["voxel_m"] = (-1.0).into())
            .contains("invalid voxel grid")
    );
    assert!(broken(&|other| other.state["future"] = 1.into()).contains("unknown field"));
}

#[test]
fn crop_and_depth_range_limit_the_picture() {
    let keyframes = ball_on_floor(4);
    let mut model = fused_model(scenes::options(), &keyframes);
    let mut request = scenes::request(view_of(&keyframes[0]));
    let whole = model.render(&request).unwrap();
    let corner: Vector3<f64> = Vector3::repeat(0.31);
    request.crop = Some(Aabb {
        world_from_box: Transform::translation(BALL_CENTER.x, BALL_CENTER.y, BALL_CENTER.z + 0.1),
        min_m: (-corner).into(),
        max_m: corner.into(),
    });
    let cropped = model.render(&request).unwrap();
    let mut n = 0;
    let mut n_off = 0;
    for (ix, depth) in cropped
        .depth_m
        .iter()
        .enumerate()
        .filter(|(_, depth)| **depth > 0.0)
    {
        n += 1;
        n_off += usize::from((depth - whole.depth_m[ix]).abs() > 0.001);
    }
    assert!(100 * n_off < n, "{n_off} of {n}"); // At the rim.
    let n_whole = whole.depth_m.iter().filter(|depth| **depth > 0.0).count();
    assert!(n > 500 && 2 * n < n_whole, "{n} of {n_whole}");
    request.crop = None;
    request.far_m = 0.9;
    let near = model.render(&request).unwrap();
    assert!(near.depth_m.iter().all(|depth| *depth < 0.9));
    request.near_m = 50.0;
    request.far_m = 100.0;
    assert!(
        model
            .render(&request)
            .unwrap()
            .depth_m
            .iter()
            .all(|depth| *depth == 0.0)
    );
}

#[test]
fn unfused_keyframes_are_removable_and_bad_sizes_rejected() {
    let keyframes = ball_on_floor(2);
    let mut model = model_with(scenes::options(), &keyframes);
    model.remove("test", keyframes[1].stamp).unwrap();
    fuse_all(&mut model);
    assert_eq!(model.progress().step, 1);
    assert!(
        model.blocks().unwrap()
            == fused_model(scenes::options(), &keyframes[..1])
                .blocks()
                .unwrap()
    );
    let mut short = (*keyframes[0]).clone();
    short.depth.as_mut().unwrap().depth_m = vec![1.0; 3].into();
    assert!(matches!(
        model.push(Arc::new(short)),
        Err(Error::Keyframe(keyframe::Error::DepthPixels { got: 3, .. }))
    ));
    let mut short = (*keyframes[0]).clone();
    short.rgba_srgb = vec![0; 3].into();
    assert!(matches!(
        model.push(Arc::new(short)),
        Err(Error::Keyframe(keyframe::Error::ImageBytes { .. }))
    ));
}

#[test]
fn voxel_size_follows_pixel_size_and_noise() {
    let wall = TestShape::Plane {
        normal: Vector3::z(),
        offset_m: 0.0,
    };
    let exact = scenes::keyframe(
        0,
        &[wall],
        scenes::look_at(Point3::new(0.0, 0.0, 2.0), Point3::origin()),
    );
    let depth = exact.depth.clone().unwrap();
    let chosen_grid = super::VoxelGrid::choose(&TsdfOptions::default(), None, &depth).unwrap();
    assert!(
        (chosen_grid.voxel_m - 2.0 / 89.0).abs() < 1e-3,
        "{chosen_grid:?}"
    );
    assert!(chosen_grid.noise_per_m2 < 1e-6);
    let mut noisy = depth.clone();
    let mut random = Random::new(1);
    let mut uniform = || f32_of(random.uniform(-0.5, 0.5));
    noisy.depth_m = noisy
        .depth_m
        .iter()
        .map(|z| z + 0.08 * (0..4).map(|_| uniform()).sum::<f32>())
        .collect::<Vec<_>>()
        .into();
    // The sum of four uniform numbers has a standard deviation of 1 / sqrt(3).
    let expected = 0.08 / 3.0f64.sqrt() / 4.0;
    let chosen_grid = super::VoxelGrid::choose(&TsdfOptions::default(), None, &noisy).unwrap();
    assert!(
        (chosen_grid.noise_per_m2 / expected - 1.0).abs() < 0.1,
        "{chosen_grid:?}, expected {expected}"
    );
    assert!(
        (chosen_grid.voxel_m / (4.0 * expected) - 1.0).abs() < 0.1
            && chosen_grid.truncation_m >= 4.0 * chosen_grid.voxel_m - 1e-9,
        "{chosen_grid:?}"
    );
    assert_eq!(depth.depth_m.len(), (SIZE_PX[0] * SIZE_PX[1]) as usize);
}
