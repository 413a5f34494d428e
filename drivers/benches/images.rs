//! Benchmarks of work on every image of a camera: decoding, and aligning depth to color.

use criterion::{Criterion, criterion_group, criterion_main};
use drivers::align::DepthAlignment;
use drivers::{Image, PixelFormat, YuvColors, YuvLayout, YuvMatrix, YuvRange};
use kinematics::{Intrinsics, Lens, Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion};
use std::hint::black_box;

fn image(format: PixelFormat, size_px: [u32; 2], data: Vec<u8>) -> Image {
    Image {
        camera: "wrist".into(),
        stamp: Stamp(7),
        size_px,
        format,
        data: data.into(),
        exposure_secs: None,
        n_skipped: 0,
    }
}

/// JPEG with edges, gradients and noise, so that the size is that of a webcam image of a room.
fn jpeg_1080p() -> Image {
    let size_px = [1920, 1080];
    let pixel = |x: u32, y: u32| {
        let noise = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503)).to_le_bytes()[1] % 12;
        let gradient = ((x / 60 + y / 40) * 11 + x / 16).to_le_bytes()[0] / 2;
        [
            gradient + noise,
            gradient / 2 + 40 + noise,
            200 - gradient + noise,
        ]
    };
    let rgb: Vec<u8> = (0..size_px[1])
        .flat_map(|y| (0..size_px[0]).flat_map(move |x| pixel(x, y)))
        .collect();
    let mut file = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 85);
    image::ImageEncoder::write_image(
        encoder,
        &rgb,
        size_px[0],
        size_px[1],
        image::ExtendedColorType::Rgb8,
    )
    .expect("an image");
    image(PixelFormat::Jpeg, size_px, file)
}

fn yuv_1080p(layout: YuvLayout) -> Image {
    let colors = YuvColors {
        matrix: YuvMatrix::Bt601,
        range: YuvRange::Limited,
    };
    let n_bytes = match layout {
        YuvLayout::Yuyv | YuvLayout::Uyvy => 2 * 1920 * 1080,
        YuvLayout::Nv12 => 1920 * 1080 * 3 / 2,
    };
    let data = (0..n_bytes)
        .map(|ix: usize| (ix * 37).to_le_bytes()[0])
        .collect();
    image(PixelFormat::Yuv { layout, colors }, [1920, 1080], data)
}

fn decoding(criterion: &mut Criterion) {
    let jpeg = jpeg_1080p();
    criterion.bench_function(
        &format!("decode JPEG 1920x1080, {} kB", jpeg.data.len() / 1000),
        |bench| {
            bench.iter(|| black_box(&jpeg).decode_rgb().expect("an image"));
        },
    );
    for layout in [YuvLayout::Yuyv, YuvLayout::Uyvy, YuvLayout::Nv12] {
        let yuv = yuv_1080p(layout);
        criterion.bench_function(&format!("decode {layout:?} 1920x1080"), |bench| {
            bench.iter(|| black_box(&yuv).decode_rgb().expect("an image"));
        });
    }
}

/// Depth of a slanted wall with a box in front of it, and holes.
fn depth_640x480() -> Image {
    let [width, height] = [640, 480];
    let count = |column: u32, row: u32| match (column * 7 + row * 13) % 41 {
        0 => 0,
        _ if column > width / 3 && column < width / 2 && row > height / 4 => 600 + (column % 50),
        _ => 900 + 400 * column / width + 300 * row / height,
    };
    let pixels = (0..height).flat_map(|row| (0..width).map(move |column| count(column, row)));
    let bytes = pixels.flat_map(|count| {
        u16::try_from(count)
            .expect("below two meters")
            .to_le_bytes()
    });
    image(
        PixelFormat::DepthU16 {
            meters_per_count: 1e-3,
        },
        [width, height],
        bytes.collect(),
    )
}

fn camera([width, height]: [u32; 2], focal_px: f64, lens: Lens) -> Intrinsics {
    Intrinsics {
        size_px: [width, height],
        focal_px: [focal_px, focal_px * 1.003],
        principal_px: [f64::from(width) * 0.503, f64::from(height) * 0.494],
        lens,
        rectified: false,
    }
}

fn alignment(criterion: &mut Criterion) {
    // As on a D435, the color camera is 15 mm to the side of the depth camera and slightly rotated.
    let color_from_depth = Transform::from_parts(
        Translation3::new(0.0148, 0.0002, 0.0003),
        UnitQuaternion::from_euler_angles(0.003, -0.006, 0.002),
    );
    let d455 = Lens::BrownConrady([-0.0555, 0.0657, -0.0006, 0.0004, -0.0213]);
    let depth = depth_640x480();
    let depth_camera = camera(depth.size_px, 385.0, Lens::Pinhole);
    for (name, lens, color_px, focal_px) in [
        ("pinhole", Lens::Pinhole, [640, 480], 610.0),
        ("distorted", d455, [640, 480], 610.0),
        ("distorted", d455, [1280, 720], 910.0),
    ] {
        let alignment = DepthAlignment::new(
            &depth_camera,
            &camera(color_px, focal_px, lens),
            &color_from_depth,
        );
        let [width, height] = color_px;
        criterion.bench_function(
            &format!("align depth 640x480 to {name} {width}x{height}"),
            |bench| {
                bench.iter(|| alignment.align(black_box(&depth)).expect("depth"));
            },
        );
    }
}

criterion_group!(benches, decoding, alignment);
criterion_main!(benches);
