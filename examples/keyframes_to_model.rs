//! Trains splats on keyframes, and saves the model.
//!
//! Without an argument, the keyframes show a ball on a floor, rendered with exact poses and depth.
//! With an argument, the keyframes are read from a dataset folder (nerfstudio or TUM RGB-D). The
//! saved model can be opened with the example `model_to_picture`, or with `fieldrig view`.
//!
//! ```text
//! cargo run --release --example keyframes_to_model
//! cargo run --release --example keyframes_to_model -- FOLDER
//! ```
#![expect(clippy::print_stdout, reason = "an example prints its result")]

use gpu::{Gpu, GpuOptions};
use keyframe::{Keyframe, scenes};
use nalgebra::Point3;
use std::path::Path;
use std::sync::Arc;
use trainer::splat::SplatOptions;
use trainer::{ModelOptions, ModelSpec};

/// This number of steps is enough for a recognizable scene.
const N_STEPS: u64 = 500;
const MODEL_FOLDER: &str = "target/example-model";

fn main() -> anyhow::Result<()> {
    let keyframes = match std::env::args_os().nth(1) {
        Some(folder) => dataset_keyframes(Path::new(&folder))?,
        None => synthetic_keyframes(),
    };
    let gpu = Gpu::open(&GpuOptions::default())?;
    println!("{} keyframes; {}", keyframes.len(), gpu.describe());

    let options = ModelOptions::from(SplatOptions::default())
        .with(|options| options.common.n_planned_steps = N_STEPS);
    let mut model = ModelSpec::of(&options)?.start(gpu)?;
    for keyframe in keyframes {
        model.push(keyframe)?;
    }
    // One call queues at most a few milliseconds of work, so that the caller stays responsive.
    while model.model().progress().step < N_STEPS && !model.is_idle() {
        model.step(N_STEPS - model.model().progress().step)?;
    }

    let folder = Path::new(MODEL_FOLDER);
    std::fs::create_dir_all(folder)?;
    model.save(folder)?;
    let progress = model.model().progress();
    println!(
        "{} splats after {} steps, saved in {MODEL_FOLDER}",
        progress.primitives, progress.step
    );
    Ok(())
}

/// Keyframes of a ball on a floor. The cameras are on a part of a ring around the ball.
fn synthetic_keyframes() -> Vec<Arc<Keyframe>> {
    let center = Point3::origin();
    scenes::ring(&[scenes::ball(center), scenes::floor()], center, 18)
}

/// Keyframes of a dataset folder. Their images are decoded and undistorted.
fn dataset_keyframes(folder: &Path) -> anyhow::Result<Vec<Arc<Keyframe>>> {
    let dataset = drivers::dataset::read(folder)?;
    let loaded = capture::dataset::load(&dataset, None, 1.0, &|_n_read| {})?;
    for note in dataset.notes.iter().chain(&loaded.notes) {
        println!("{note}");
    }
    Ok(loaded.keyframes)
}
