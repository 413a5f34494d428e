//! Benchmarks of the operations per image and per reading, which are poses, Jacobians, projection
//! and undistortion.

use criterion::{Criterion, criterion_group, criterion_main};
use kinematics::{Chain, Intrinsics, Lens, Transform, Undistortion};
use nalgebra::Vector3;
use std::hint::black_box;

fn chains(criterion: &mut Criterion) {
    let chain = Chain::from_urdf(include_str!("../tests/data/panda.urdf"), "link0", "tcp")
        .expect("the file is sound");
    let q = [0.1, -0.6, 0.3, -2.1, 0.4, 1.7, 0.8];
    let mut pose = Transform::identity();
    criterion.bench_function("panda pose", |bench| {
        bench.iter(|| chain.forward_into(black_box(&q), black_box(&mut pose)));
    });
    criterion.bench_function("panda jacobian", |bench| {
        bench.iter(|| chain.jacobian(black_box(&q)))
    });
}

fn lenses(criterion: &mut Criterion) {
    let phone = Intrinsics {
        size_px: [540, 960],
        focal_px: [687.8, 687.2],
        principal_px: [277.3, 482.6],
        lens: Lens::BrownConrady([0.058, -0.081, -0.001, 0.0002, 0.0]),
        rectified: false,
    };
    let fisheye = Intrinsics {
        lens: Lens::KannalaBrandt([-0.01, 0.02, -0.015, 0.003]),
        ..phone
    };
    let point = Vector3::new(0.2, 0.3, 1.1);
    for (name, camera) in [("brown-conrady", &phone), ("kannala-brandt", &fisheye)] {
        criterion.bench_function(&format!("{name} project"), |bench| {
            bench.iter(|| camera.project(black_box(&point)))
        });
        criterion.bench_function(&format!("{name} unproject"), |bench| {
            bench.iter(|| camera.unproject(black_box([420.0, 700.0])));
        });
    }
    criterion.bench_function("540x960 undistortion map", |bench| {
        bench.iter(|| Undistortion::new(black_box(&phone)))
    });
    let map = Undistortion::new(&phone);
    let rgb = vec![127; 540 * 960 * 3];
    criterion.bench_function("540x960 undistort", |bench| {
        bench.iter(|| map.apply_rgb(black_box(&rgb)))
    });
}

criterion_group!(benches, chains, lenses);
criterion_main!(benches);
