//! Aligns the depth of a RealSense camera to its color with our code and with librealsense2. Run it
//! on one core (`taskset -c 0`), because the library uses several.

mod realsense_scene;

use criterion::{Criterion, criterion_group, criterion_main};
use drivers::align::DepthAlignment;
use kinematics::Lens;
use realsense_scene::{aligned_by_library, d435i, depth_image, depth_of, record};
use std::hint::black_box;

/// Images of the file, which the library plays.
const N_IMAGES: i64 = 12;

fn alignment(criterion: &mut Criterion) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("camera.bag");
    for color_px in [[640, 480], [1280, 720]] {
        let camera = d435i(color_px, Lens::Pinhole);
        let depth = depth_of(&camera);
        let [width, height] = color_px;
        let alignment = DepthAlignment::new(
            &depth.intrinsics,
            &camera.intrinsics,
            &depth.camera_from_depth,
        );
        let image = depth_image(&camera, 0);
        criterion.bench_function(
            &format!("align depth 640x480 to {width}x{height}"),
            |bench| {
                bench.iter(|| alignment.align(black_box(&image)).expect("depth"));
            },
        );
        record(&path, &camera, N_IMAGES);
        criterion.bench_function(
            &format!("align depth 640x480 to {width}x{height}, librealsense2"),
            |bench| {
                bench.iter_custom(|n| {
                    let aligned =
                        aligned_by_library(&path, usize::try_from(n).expect("few images"));
                    aligned.into_iter().map(|(.., elapsed)| elapsed).sum()
                });
            },
        );
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = alignment
}
criterion_main!(benches);
