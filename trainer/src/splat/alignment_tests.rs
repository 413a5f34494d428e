//! Tests of training with alignment: the correction is applied to every camera, and resuming from a checkpoint is
//! bit-exact.

use super::training_tests::train;
use super::{SplatOptions, SplatTrainer};
use crate::Method;
use crate::gpu::{Gpu, GpuOptions};
use crate::model_options::{CommonOptions, ModelOptions};
use calibration::scenes::{Miscalibration, capture, remaining, wrong_extrinsics};
use calibration::{CameraRefinement, ParamSet};
use keyframe::{Keyframe, Split};
use std::sync::Arc;

fn new_trainer(gpu: &Arc<Gpu>, keyframes: &[Arc<Keyframe>]) -> SplatTrainer {
    let common = CommonOptions {
        align: CameraRefinement::Try(vec![ParamSet::EXTRINSICS]),
        cameras: CameraRefinement::Try(vec![ParamSet::IMAGE_POSES]),
        n_planned_steps: 120,
        ..CommonOptions::default()
    };
    let specific =
        SplatOptions { max_splats: 2000, coarse_steps: Some([1000, 1000]), sh_degree: 0, ..SplatOptions::default() };
    let mut trainer = SplatTrainer::new(gpu.clone(), ModelOptions { common, specific }).unwrap();
    for keyframe in keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    trainer
}

#[test]
fn wrong_extrinsics_are_corrected_and_resuming_is_exact() {
    const ALIGNMENT_STEP: u64 = 30;
    let gpu = Gpu::open(&GpuOptions::default()).unwrap();
    let miscalibration = Miscalibration { extrinsics: wrong_extrinsics(), ..Miscalibration::none() };
    let keyframes = capture(&miscalibration);
    let mut uninterrupted = new_trainer(&gpu, &keyframes);
    // The step at which the result is applied is step 0 of the new model.
    train(&mut uninterrupted, ALIGNMENT_STEP);
    assert!(uninterrupted.alignment().is_none());
    uninterrupted.step(1).unwrap();
    assert_eq!(uninterrupted.progress().step, 1, "training restarted");
    let correction = uninterrupted.alignment().unwrap().corrections["wrist"].clone();
    let (degrees, mm) = remaining(&correction, &miscalibration.extrinsics);
    assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
    let test = keyframes.iter().find(|keyframe| keyframe.split == Split::Test).unwrap();
    assert_eq!(uninterrupted.calibrated_camera(test).unwrap(), correction.apply(test));
    train(&mut uninterrupted, 9);

    // Interrupted before and after the result is applied.
    let mut interrupted = new_trainer(&gpu, &keyframes);
    train(&mut interrupted, 10);
    for n_steps in [21, 6, 3] {
        let checkpoint = interrupted.checkpoint().unwrap().finish().unwrap();
        let untrained;
        (interrupted, untrained) = SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes).unwrap();
        for keyframe in untrained {
            interrupted.push(keyframe).unwrap();
        }
        let end = if n_steps == 21 { 1 } else { interrupted.progress().step + n_steps };
        while interrupted.progress().step != end {
            interrupted.step(1).unwrap();
        }
    }
    assert_eq!(interrupted.progress().step, uninterrupted.progress().step);
    assert_eq!(interrupted.alignment(), uninterrupted.alignment());
    assert!(interrupted.arrays().unwrap() == uninterrupted.arrays().unwrap(), "splats differ");

    // The saved model contains the correction, too.
    let folder = tempfile::tempdir().unwrap();
    uninterrupted.save(folder.path()).unwrap();
    let arrays = uninterrupted.arrays().unwrap();
    let loaded = SplatTrainer::from_arrays(gpu, ModelOptions::default(), &arrays).unwrap();
    let mut loaded = loaded.with_saved_corrections(folder.path()).unwrap();
    assert_eq!(loaded.calibrated_camera(test).unwrap(), correction.apply(test));
}
