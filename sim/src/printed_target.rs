//! Printed calibration targets as objects of a scene. A target is a textured rectangle on a plate.

use crate::Error;
use crate::config::TargetConfig;
use crate::mesh::{Mesh, WHOLE};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use nalgebra::{Point3, Vector3};
use targets::Raster;

/// Side of the square texture, pixels. It is a power of two, so that no mipmap level is shifted.
const SIDE_PX: u32 = 2048;
/// Thickness of the plate, meters. The next constant is the gap between print and plate, which
/// avoids z-fighting.
const PLATE_M: f64 = 0.003;
const GAP_M: f64 = 1e-4;
/// Gray values of ink and paper. White would be overexposed where the light is bright.
const INK: f64 = 16.0;
const PAPER: f64 = 205.0;

/// Meshes in the board frame, and the texture of the print.
pub(crate) struct Printed {
    pub(crate) png: Vec<u8>,
    pub(crate) mesh: Mesh,
    pub(crate) plate: Mesh,
}

/// Draws a target.
pub(crate) fn print(config: &TargetConfig) -> Result<Printed, Error> {
    let target = config.target()?;
    let failed = |source| Error::DrawTarget {
        target: config.name.clone(),
        source,
    };
    // The size of the raster in pixels depends on the target's shape, which only the rasterizer
    // knows. The target is therefore first rasterized at 1 px per mm to get the size.
    let coarse = target.raster(1000.0).map_err(failed)?;
    let longest_px = coarse.size_px.into_iter().max().unwrap_or(1);
    let picture = target
        .raster(1000.0 * f64::from(SIDE_PX - 1) / f64::from(longest_px))
        .map_err(failed)?;
    let png = png(&picture).map_err(|source| Error::Texture {
        name: config.name.clone(),
        source,
    })?;

    let side_m = |px: u32| f64::from(px) / picture.px_per_m;
    let half_m = picture.size_px.map(|px| 0.5 * side_m(px));
    let center = Point3::new(
        picture.origin_m[0] + half_m[0],
        picture.origin_m[1] + half_m[1],
        0.0,
    );
    let [right, bottom] = picture.size_px.map(|px| f64::from(px) / f64::from(SIDE_PX));
    let mut mesh = Mesh::default();
    mesh.rectangle(
        center,
        Vector3::x() * half_m[0],
        Vector3::y() * -half_m[1],
        [0.0, 0.0, right, bottom],
    );
    let mut plate = Mesh::default();
    let behind = center.coords + Vector3::z() * (GAP_M + 0.5 * PLATE_M);
    plate.append(
        Mesh::cuboid([half_m[0], half_m[1], 0.5 * PLATE_M], &[WHOLE; 6]),
        behind,
    );
    Ok(Printed { png, mesh, plate })
}

/// A square texture with the picture at its top left. The rest of the texture is paper.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "between ink and paper"
)]
fn png(picture: &Raster) -> Result<Vec<u8>, image::ImageError> {
    let shade = |white: u8| (INK + (PAPER - INK) * f64::from(white) / 255.0).round() as u8;
    let side = SIDE_PX as usize;
    let width = picture.size_px[0] as usize;
    let mut gray = vec![shade(255); side * side];
    for (row, line) in picture.pixels.chunks_exact(width).enumerate() {
        for (pixel, white) in gray[side * row..].iter_mut().zip(line) {
            *pixel = shade(*white);
        }
    }
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Up);
    encoder.write_image(&gray, SIDE_PX, SIDE_PX, ExtendedColorType::L8)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraConfig, Config, SensorConfig, TargetParent, layout};
    use drivers::{Sample, Source, TruthImage};
    use kinematics::Transform;
    use nalgebra::Rotation3;
    use targets::{GrayImage, TargetSpec};

    /// Differences between detected and true corners in all images of a scan, pixels.
    fn errors_px(spec: &str) -> Vec<[f64; 2]> {
        let target: TargetSpec = spec.parse().expect("a target");
        let [low, high] = target.bounds_m();
        let center = Vector3::new(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.0);
        // The target is in front of the objects on the table and faces the middle of the scan.
        let (sin, cos) = 40f64.to_radians().sin_cos();
        let forward = Vector3::new(cos, 0.0, -sin);
        let down = Vector3::new(-sin, 0.0, -cos);
        let rotation = Rotation3::from_basis_unchecked(&[-Vector3::y(), down, forward]);
        let [x, y] = layout::TARGET_XY_M;
        let at = Vector3::new(x, y, layout::TABLE_Z_M + 0.06) - forward * 0.11 - rotation * center;
        let world_from_board = Transform::from_parts(at.into(), rotation.into());
        let sensor = SensorConfig {
            supersample: 2,
            ..SensorConfig::default()
        };
        let camera = CameraConfig {
            sensor,
            rate_hz: 1.0,
            depth: None,
            ..CameraConfig::wrist("wrist")
        };
        let config = Config {
            ideal: true,
            n_images: Some(6),
            cameras: vec![camera],
            targets: vec![TargetConfig {
                name: "board".to_owned(),
                spec: spec.to_owned(),
                parent: TargetParent::World,
                parent_from_board: world_from_board,
            }],
            ..Config::default()
        };
        let rig = crate::open(&config).expect("a scene");
        let intrinsics = rig.info().cameras[0].intrinsics.clone();
        let mut samples = rig.into_lockstep();
        let mut errors = Vec::new();
        while let Some(sample) = samples.next_sample().expect("the rig works") {
            let Sample::Truth(TruthImage {
                image,
                world_from_camera,
                ..
            }) = sample
            else {
                continue;
            };
            let gray: Vec<u8> = image.data.chunks_exact(3).map(|rgb| rgb[1]).collect();
            assert!(
                gray.iter().filter(|value| **value == u8::MAX).count() < gray.len() / 50,
                "overexposed"
            );
            let Ok(found) = target.detect(GrayImage {
                size_px: image.size_px,
                pixels: &gray,
            }) else {
                continue;
            };
            for corner in found.corners {
                let point = world_from_camera.inverse()
                    * world_from_board
                    * Point3::from(corner.point_in_board);
                let pixel = intrinsics.project(&point.coords).expect("a pixel");
                errors.push([corner.pixel[0] - pixel[0], corner.pixel[1] - pixel[1]]);
            }
        }
        errors
    }

    #[test]
    fn corners_are_where_the_specification_says() {
        /// The measured values are below 0.003 px and 0.023 px.
        const MAX_BIAS_PX: f64 = 0.005;
        const MAX_RMS_PX: f64 = 0.03;
        for (spec, min_corners) in [
            ("charuco:5x7:24mm:18mm:5X5_100", 100),
            ("chessboard:7x5:20mm", 100),
            ("aprilgrid:4x4:25mm:0.3", 200),
            ("tag:36h11:5:80mm", 16),
        ] {
            let errors = errors_px(spec);
            let n = errors.len() as f64;
            let mean = [0, 1].map(|axis| errors.iter().map(|error| error[axis]).sum::<f64>() / n);
            let rms = (errors.iter().map(|[x, y]| x * x + y * y).sum::<f64>() / n).sqrt();
            assert!(
                errors.len() >= min_corners,
                "{spec}: only {n} corners detected"
            );
            let is_unbiased = mean.iter().all(|mean| mean.abs() < MAX_BIAS_PX);
            assert!(
                is_unbiased && rms < MAX_RMS_PX,
                "{spec}: bias {mean:?} px, RMS {rms} px"
            );
        }
    }
}
