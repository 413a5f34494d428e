//! Tests of training with alignment. The correction is applied to every camera, and resuming from a
//! checkpoint is bit-exact.

use super::{SplatOptions, SplatTrainer};
use crate::method_entry::boxed;
use crate::{AlignedModel, CommonOptions, ModelOptions};
use calibration::scenes::{Miscalibration, capture, remaining, wrong_extrinsics};
use calibration::{CameraRefinement, ParamSet};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::{Keyframe, Split};
use model_files::splat::ply;
use std::sync::Arc;

const N_PLANNED_STEPS: u64 = 120;

fn new_model(gpu: &Arc<Gpu>, keyframes: &[Arc<Keyframe>]) -> AlignedModel {
    let common = CommonOptions {
        align: CameraRefinement::Try(vec![ParamSet::EXTRINSICS]),
        cameras: CameraRefinement::Try(vec![ParamSet::IMAGE_POSES]),
        n_planned_steps: N_PLANNED_STEPS,
        ..CommonOptions::default()
    };
    let specific = SplatOptions {
        max_splats: 2000,
        coarse_steps: Some([1000, 1000]),
        sh_degree: 0,
        ..SplatOptions::default()
    };
    let options = ModelOptions { common, specific };
    let trainer = SplatTrainer::new(gpu.clone(), options.clone()).unwrap();
    let mut model = AlignedModel::new(Box::new(trainer), &options.common, true);
    for keyframe in keyframes {
        model.push(keyframe.clone()).unwrap();
    }
    model
}

fn train_to(model: &mut AlignedModel, step: u64) {
    while model.model().progress().step != step {
        model.step(1).unwrap();
    }
}

#[test]
fn wrong_extrinsics_are_corrected_and_resuming_is_exact() {
    const ALIGNMENT_STEP: u64 = 30;
    let gpu = test_gpu();
    let miscalibration = Miscalibration {
        extrinsics: wrong_extrinsics(),
        ..Miscalibration::none()
    };
    let keyframes = capture(&miscalibration);
    let mut uninterrupted = new_model(&gpu, &keyframes);
    train_to(&mut uninterrupted, ALIGNMENT_STEP);
    assert!(uninterrupted.alignment().is_none());
    uninterrupted.step(1).unwrap();
    assert_eq!(
        uninterrupted.model().progress().step,
        ALIGNMENT_STEP + 1,
        "training continues"
    );
    let correction = uninterrupted.alignment().unwrap().corrections["wrist"].clone();
    let (degrees, mm) = remaining(&correction, &miscalibration.extrinsics);
    assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
    let test = keyframes
        .iter()
        .find(|keyframe| keyframe.split == Split::Test)
        .unwrap();
    assert_eq!(
        uninterrupted.calibrated_camera(test).unwrap(),
        correction.apply(test)
    );
    train_to(&mut uninterrupted, ALIGNMENT_STEP + 10);

    // The test interrupts training before and after the alignment is applied. Stored keyframes are
    // not in the order of arrival.
    let mut stored = keyframes.clone();
    stored.reverse();
    let mut interrupted = new_model(&gpu, &keyframes);
    train_to(&mut interrupted, 10);
    for end in [ALIGNMENT_STEP + 1, ALIGNMENT_STEP + 7, ALIGNMENT_STEP + 10] {
        let checkpoint = interrupted.checkpoint().unwrap().finish().unwrap();
        let untrained;
        (interrupted, untrained) =
            AlignedModel::resume(&checkpoint, &stored, &[], |own, keyframes| {
                SplatTrainer::resume(gpu.clone(), own, keyframes).map(boxed)
            })
            .unwrap();
        for keyframe in untrained.into_iter().rev() {
            interrupted.push(keyframe).unwrap();
        }
        train_to(&mut interrupted, end);
    }
    let [one, other] = [&mut uninterrupted, &mut interrupted]
        .map(|model| model.checkpoint().unwrap().finish().unwrap());
    assert_eq!(one.state, other.state);
    assert!(one.arrays == other.arrays, "arrays differ");
    assert_eq!(uninterrupted.n_total_steps().unwrap(), ALIGNMENT_STEP + 10);

    // The saved model must also contain the correction.
    let folder = tempfile::tempdir().unwrap();
    uninterrupted.save(folder.path()).unwrap();
    let arrays = ply::read(&folder.path().join("splats.ply")).unwrap();
    let trainer = SplatTrainer::from_arrays(gpu, ModelOptions::default(), &arrays).unwrap();
    let trainer = trainer.with_saved_metadata(folder.path()).unwrap();
    let mut loaded = AlignedModel::load(Box::new(trainer), folder.path()).unwrap();
    assert_eq!(
        loaded.calibrated_camera(test).unwrap(),
        correction.apply(test)
    );
}
