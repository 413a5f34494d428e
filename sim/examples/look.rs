//! Runs the default rig and writes its images into a folder, for inspection and timing.
//!
//! `cargo run --release -p sim --example look -- FOLDER N_IMAGES [EVERY]
//! [720p|two|notruth|global|ideal|mobile-base|mobile-arm]`

use drivers::{PixelFormat, Sample, Source};
use nalgebra::{Isometry3, Point3, Vector3};
use sim::{CameraConfig, Config, Parent};
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let folder = std::path::PathBuf::from(args.first().map_or("look", String::as_str));
    let n_images: u64 = args.get(1).map_or(Ok(20), |text| text.parse())?;
    let every: u64 = args.get(2).map_or(Ok(1), |text| text.parse())?;
    std::fs::create_dir_all(&folder)?;
    let mut config = Config {
        n_images: Some(n_images),
        ..Config::default()
    };
    match args.get(3).map_or("", String::as_str) {
        "720p" => {
            let camera = &mut config.cameras[0];
            camera.intrinsics = camera.intrinsics.resized([1280, 720]);
            camera.intrinsics.focal_px = [915.2, 914.8];
            camera.sensor.supersample = 2;
        }
        "two" => {
            let mut fixed = CameraConfig::wrist("fixed");
            fixed.intrinsics = fixed.intrinsics.resized([1280, 720]);
            fixed.intrinsics.focal_px = [1480.0, 1478.0];
            fixed.intrinsics.lens =
                kinematics::Lens::BrownConrady([0.06, -0.12, 0.0005, -0.0003, 0.0]);
            fixed.parent = Parent::World;
            fixed.parent_from_camera = Isometry3::face_towards(
                &Point3::new(1.04, 0.0, 0.75),
                &Point3::new(0.74, 0.0, 0.15),
                &-Vector3::z(),
            );
            fixed.depth = None;
            fixed.rate_hz = 5.0;
            config.cameras.push(fixed);
        }
        "notruth" => config.truth = false,
        "global" => {
            config.truth = false;
            config.cameras[0].sensor.readout_micros = 0.0;
        }
        "ideal" => config.ideal = true,
        "mobile-base" => mobile_base(&mut config),
        "mobile-arm" => {
            config.scene = sim::Scene::MobileArm;
            config.light_inside_frac = 0.6;
            config.cameras = vec![CameraConfig::mobile_wrist("wrist")];
            config.cameras[0].rate_hz = 1.0;
        }
        _ => {}
    }
    let began = Instant::now();
    let mut rig = sim::open(&config)?.into_lockstep();
    let opened = began.elapsed();
    let (mut n_taken, mut n_points) = (0, 0);
    let mut ceiling = 0.0;
    let began = Instant::now();
    while let Some(sample) = rig.next_sample()? {
        match sample {
            Sample::Image(image) => {
                let is_color = image.format == PixelFormat::Rgb8;
                n_taken += u64::from(is_color);
                if n_taken % every == 0 {
                    let kind = if is_color { "color" } else { "depth" };
                    let file = folder.join(format!("{}_{kind}_{n_taken:04}.png", image.camera));
                    let [width, height] = image.size_px;
                    if is_color {
                        image::save_buffer(
                            file,
                            &image.data,
                            width,
                            height,
                            image::ExtendedColorType::Rgb8,
                        )?;
                    } else {
                        let near: Vec<u8> = image
                            .data
                            .chunks_exact(2)
                            .map(|count| {
                                u8::try_from(u16::from_le_bytes([count[0], count[1]]) / 40)
                                    .unwrap_or(255)
                            })
                            .collect();
                        image::save_buffer(
                            file,
                            &near,
                            width,
                            height,
                            image::ExtendedColorType::L8,
                        )?;
                    }
                }
            }
            Sample::Truth(truth) => {
                ceiling += truth.psnr_ceiling.unwrap_or(0.0);
                if n_taken % every == 0 {
                    let file =
                        folder.join(format!("{}_truth_{n_taken:04}.png", truth.image.camera));
                    let [width, height] = truth.image.size_px;
                    image::save_buffer(
                        file,
                        &truth.image.data,
                        width,
                        height,
                        image::ExtendedColorType::Rgb8,
                    )?;
                }
            }
            Sample::Range(scan) => n_points += scan.points.len(),
            Sample::Joints(_) | Sample::Base(_) | Sample::BaseTruth(_) => {}
        }
    }
    let millis = began.elapsed().as_secs_f64() * 1e3 / n_taken as f64;
    eprintln!(
        "{}: opened in {opened:?}, {millis:.1} ms per image, mean PSNR ceiling {:.2} dB, {n_points} echoes",
        rig.info().renderer,
        ceiling / n_taken as f64
    );
    Ok(())
}

/// Front and rear cameras, and a scanner.
fn mobile_base(config: &mut Config) {
    config.scene = sim::Scene::MobileBase;
    (config.joint_names, config.reading_order) = (Vec::new(), Vec::new());
    config.cameras.clear();
    for (name, x, ahead) in [("front", 0.43, 1.0), ("rear", -0.40, -1.0)] {
        let mut camera = CameraConfig::wrist(name);
        camera.intrinsics = camera.intrinsics.resized([1280, 720]);
        camera.intrinsics.focal_px = [640.0, 640.0];
        camera.parent = Parent::Base;
        let eye = Point3::new(x, 0.0, 0.06);
        camera.parent_from_camera = Isometry3::face_towards(
            &eye,
            &(eye + Vector3::new(ahead, 0.0, 0.05)),
            &-Vector3::z(),
        );
        camera.depth = None;
        camera.rate_hz = 1.0;
        config.cameras.push(camera);
    }
    config
        .scanners
        .push(sim::ScannerConfig::sixteen_rings("lidar"));
}
