//! Benchmarks of the map: answers for the points of an arm, and integration of a depth image.

use clearance_map::{ClearanceMap, DepthImage, DepthOrigin, MapConfig, Posture, reach_m};
use criterion::{Criterion, criterion_group, criterion_main};
use kinematics::urdf::Robot;
use kinematics::{Chain, Stamp, Transform};
use nalgebra::{Isometry3, Point3, Vector3};
use numbers::f32_of;
use std::hint::black_box;
use steering::{Body, Clearance};

const POSTURES: [[f64; 7]; 2] = [
    [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8],
    [0.2, -0.4, 0.1, -2.1, 0.1, 1.7, 0.8],
];

fn posture(ix: usize, secs: f64) -> Posture {
    Posture {
        stamp: Stamp::from_secs(secs),
        position: POSTURES[ix % 2].to_vec(),
        world_from_base: Transform::identity(),
    }
}

/// A camera 640 x 480 above a table with blocks, and holes in 2 % of the pixels.
fn image(camera: &str, from: [f64; 3], secs: f64) -> DepthImage {
    let to = Point3::new(0.3, 0.0, 0.2);
    let pose: Transform = Isometry3::face_towards(&Point3::from(from), &to, &-Vector3::z());
    let size_px = [640, 480];
    let (focal, principal) = (600.0, [320.0, 240.0]);
    let depth = |column: u32, row: u32| {
        let ray = Vector3::new(
            (f64::from(column) + 0.5 - principal[0]) / focal,
            (f64::from(row) + 0.5 - principal[1]) / focal,
            1.0,
        );
        let in_world = pose.rotation * ray;
        let is_block = (column / 80 + row / 80).is_multiple_of(3);
        let height_m = if is_block { 0.1 } else { 0.0 };
        let z_m = (height_m - from[2]) / in_world.z;
        if (column * 7 + row * 13).is_multiple_of(50) || z_m < 0.0 {
            0.0
        } else {
            f32_of(z_m)
        }
    };
    let pixels = (0..size_px[1]).flat_map(|row| (0..size_px[0]).map(move |column| (column, row)));
    DepthImage {
        camera: camera.into(),
        stamp: Stamp::from_secs(secs),
        size_px,
        focal_px: [focal; 2],
        principal_px: principal,
        depth_m: pixels.map(|(column, row)| depth(column, row)).collect(),
        world_from_camera: pose,
        posture: posture(0, secs),
        origin: DepthOrigin::Measured,
    }
}

fn panda() -> (Body, Chain) {
    let urdf = include_str!("../../../../rigs/robots/panda.urdf");
    let robot = Robot::parse(urdf).expect("a robot");
    let chain = Chain::new(&robot, "panda_link0", "panda_link8").expect("a chain");
    (Body::new(&robot, &chain, &|_| None).expect("shapes"), chain)
}

/// Pushes an image and waits until it is integrated.
fn integrate(map: &ClearanceMap, image: DepthImage) {
    let before = map.state().n_integrated;
    map.push(image).expect("a valid image");
    while map.state().n_integrated == before {
        std::hint::spin_loop();
    }
}

fn map() -> ClearanceMap {
    let (body, chain) = panda();
    let config = MapConfig::for_reach(reach_m(&body, &chain));
    let map = ClearanceMap::start(&config, body).expect("a thread");
    for (ix, from) in [[1.4, 0.5, 0.8], [0.0, -1.2, 0.9], [-0.8, 0.8, 1.2]]
        .into_iter()
        .enumerate()
    {
        integrate(&map, image("wall", from, 1.0 + ix as f64));
    }
    map
}

/// Points along the arm, and some around it.
fn points() -> Vec<[f64; 3]> {
    let point = |ix: u32| {
        let angle = f64::from(ix) * 2.4;
        let frac = f64::from(ix) / 300.0;
        [
            0.2 + 0.5 * frac + 0.1 * angle.cos(),
            0.1 * angle.sin(),
            0.1 + 0.5 * frac,
        ]
    };
    (0..300).map(point).collect()
}

fn answers(criterion: &mut Criterion) {
    let map = map();
    let points = points();
    let now = Stamp::from_secs(5.0);
    map.set_posture(&posture(0, 5.0)).expect("a posture");
    criterion.bench_function("300 readings, arm at rest", |bench| {
        bench.iter(|| map.readings(black_box(&points), now));
    });
    let mut ix = 0;
    criterion.bench_function("300 readings, arm moves before each", |bench| {
        bench.iter(|| {
            ix += 1;
            map.set_posture(&posture(ix, 5.0)).expect("a posture");
            map.readings(black_box(&points), now)
        });
    });
}

fn integration(criterion: &mut Criterion) {
    let map = map();
    let image = image("wall", [1.2, -0.4, 0.8], 9.0);
    criterion.bench_function("integrate depth 640x480", |bench| {
        bench.iter(|| integrate(&map, image.clone()));
    });
}

criterion_group!(benches, answers, integration);
criterion_main!(benches);
