//! Training with alignment: what it finds is in every camera, and stopping in between changes no bit.

use super::learning::train;
use super::{CameraChoice, SplatOptions, SplatTrainer, TermSet};
use crate::align::tests::{Wrong, capture, left, wrong_mount};
use crate::gpu::{Gpu, GpuOptions};
use crate::{Keyframe, Method, Split};
use std::sync::Arc;

fn started(gpu: &Arc<Gpu>, keyframes: &[Arc<Keyframe>]) -> SplatTrainer {
    let options = SplatOptions {
        align: CameraChoice::Try(vec![TermSet { mount: true, ..TermSet::default() }]),
        cameras: CameraChoice::Try(vec![TermSet { image_poses: true, ..TermSet::default() }]),
        max_splats: 2000,
        n_planned_steps: 120,
        coarse_steps: Some([1000, 1000]),
        sh_degree: 0,
        ..SplatOptions::default()
    };
    let mut trainer = SplatTrainer::new(gpu.clone(), options).unwrap();
    for keyframe in keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    trainer
}

#[test]
fn a_wrong_mount_is_corrected_in_every_camera_and_stopping_changes_nothing() {
    const TAKEN_AT: u64 = 30;
    let gpu = Gpu::open(&GpuOptions::default()).unwrap();
    let wrong = Wrong { mount: wrong_mount(), ..Wrong::nothing() };
    let keyframes = capture(&wrong);
    let mut whole = started(&gpu, &keyframes);
    // The step at which the result is taken is step 0 of the new model.
    train(&mut whole, TAKEN_AT);
    assert!(whole.alignment().is_none());
    whole.step(1).unwrap();
    assert_eq!(whole.progress().step, 1, "training began anew");
    let fix = whole.alignment().unwrap().fixes["wrist"].clone();
    let (degrees, mm) = left(&fix, &wrong.mount);
    assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
    let test = keyframes.iter().find(|keyframe| keyframe.split == Split::Test).unwrap();
    assert_eq!(whole.posed_lens(test).unwrap(), fix.apply(test));
    train(&mut whole, 9);

    // Stopped before the result was taken, and after.
    let mut parts = started(&gpu, &keyframes);
    train(&mut parts, 10);
    for n_steps in [21, 6, 3] {
        let checkpoint = parts.checkpoint().unwrap().finish().unwrap();
        let rest;
        (parts, rest) = SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes).unwrap();
        for keyframe in rest {
            parts.push(keyframe).unwrap();
        }
        let end = if n_steps == 21 { 1 } else { parts.progress().step + n_steps };
        while parts.progress().step != end {
            parts.step(1).unwrap();
        }
    }
    assert_eq!(parts.progress().step, whole.progress().step);
    assert_eq!(parts.alignment(), whole.alignment());
    assert!(parts.arrays().unwrap() == whole.arrays().unwrap(), "splats differ");

    // The model on disk knows it, too.
    let folder = tempfile::tempdir().unwrap();
    whole.save(folder.path()).unwrap();
    let arrays = whole.arrays().unwrap();
    let loaded = SplatTrainer::from_arrays(gpu, SplatOptions::default(), &arrays).unwrap();
    let mut loaded = loaded.with_fixes(folder.path()).unwrap();
    assert_eq!(loaded.posed_lens(test).unwrap(), fix.apply(test));
}
