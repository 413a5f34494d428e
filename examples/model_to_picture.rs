//! Loads a saved model of any method, and renders it to a PNG file.
//!
//! The virtual camera looks at the center of the model from outside. Without an argument, the
//! program loads the model that the example `keyframes_to_model` saves. The argument can be the
//! folder of a saved model, or a file of splats.
//!
//! ```text
//! cargo run --release --example model_to_picture
//! cargo run --release --example model_to_picture -- MODEL
//! ```
#![expect(clippy::print_stdout, reason = "an example prints its result")]

use anyhow::Context;
use gpu::{Gpu, GpuOptions};
use keyframe::scenes::look_at;
use nalgebra::{Point3, Vector3};
use std::path::PathBuf;
use std::sync::Arc;
use trainer::{LoadedModel, Projection, RenderRequest};

const DEFAULT_MODEL: &str = "target/example-model";
const PICTURE: &str = "target/example.png";
const SIZE_PX: [u32; 2] = [640, 480];
/// Focal length of the virtual camera in pixels. The horizontal field of view is 65 degrees.
const FOCAL_PX: f64 = 500.0;

fn main() -> anyhow::Result<()> {
    let path = match std::env::args_os().nth(1) {
        Some(path) => PathBuf::from(path),
        None => PathBuf::from(DEFAULT_MODEL),
    };
    let gpu = Gpu::open(&GpuOptions::default())?;
    let LoadedModel {
        method: mut model,
        edits,
        ..
    } = trainer::load(gpu, &path)?;

    let bounds = model.model_mut().bounds()?.context("the model is empty")?;
    let center = Point3::from(bounds.center_m);
    let eye = center + bounds.radius_m * Vector3::new(2.0, 1.0, 1.0);
    let [width, height] = SIZE_PX;
    let picture = model.model_mut().render(&RenderRequest {
        world_from_camera: look_at(eye, center),
        size_px: SIZE_PX,
        projection: Projection::Pinhole {
            focal_px: [FOCAL_PX; 2],
            principal_px: [0.5 * f64::from(width), 0.5 * f64::from(height)],
        },
        shutter: None,
        near_m: 0.01,
        far_m: 1000.0,
        crop: None,
        edits: Arc::new(edits),
        background_srgb: [1.0; 3],
        appearance_of: None,
        depth: false,
    })?;

    // The colors already include the background. The saved picture is opaque, so it needs no alpha.
    let rgb: Vec<u8> = picture
        .rgba_srgb
        .as_chunks::<4>()
        .0
        .iter()
        .flat_map(|[red, green, blue, _]| [*red, *green, *blue])
        .collect();
    image::save_buffer(PICTURE, &rgb, width, height, image::ExtendedColorType::Rgb8)?;
    println!("{} rendered to {PICTURE}", path.display());
    Ok(())
}
