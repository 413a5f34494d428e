//! Tests of checkpoints. A resumed model is bit-identical to a model trained without interruption.

use super::SplatTrainer;
use super::training_tests::{keyframes, options, train};
use crate::{Error, Method};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::Keyframe;
use model_files::checkpoint::Checkpoint;
use std::sync::Arc;

/// Steps at which training stops. They are before the first change of splat count and SH degree,
/// and between later changes.
const STOPS: [u64; 3] = [7, 230, 310];
const END: u64 = 340;

fn checkpoint_of(trainer: &mut SplatTrainer) -> Checkpoint {
    trainer.checkpoint().unwrap().finish().unwrap()
}

fn new_trainer(gpu: &Arc<Gpu>, keyframes: &[Arc<Keyframe>], max_splats: u32) -> SplatTrainer {
    let options = options().with(|options| {
        options.common.n_planned_steps = 500;
        options.specific.max_splats = max_splats;
    });
    let mut trainer = SplatTrainer::new(gpu.clone(), options).unwrap();
    for keyframe in keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    trainer
}

/// Compares the whole state. Prints only the names of arrays, because a difference could be
/// megabytes long.
fn assert_same(one: &Checkpoint, other: &Checkpoint) {
    assert_eq!(one.state, other.state);
    for (one, other) in one.arrays.iter().zip(&other.arrays) {
        assert!(one == other, "{} differ", one.name);
    }
    assert_eq!(one.arrays.len(), other.arrays.len());
}

/// Earlier versions searched for the number of splats, and stored the settings and results.
#[test]
fn checkpoint_with_a_search_for_the_number_of_splats_is_resumed() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let mut trainer = new_trainer(&gpu, &keyframes, 3000);
    train(&mut trainer, 10);
    let checkpoint = checkpoint_of(&mut trainer);
    let mut older = checkpoint.clone();
    older.state["growth_search"] = serde_json::json!({
        "limit": {"n_splats": 500, "n_images": 8}, "not_before": 0, "is_off": false
    });
    older.state["remaining_trials"]["doubling"] = serde_json::Value::Null;
    older.state["options"]["specific"]["count"] = "TestedGrowth".into();
    for name in [
        "first_doubling",
        "doubling_half",
        "search",
        "search_pause",
        "comparison",
    ] {
        older.state["options"]["specific"]["trial_steps"][name] = 250.into();
    }
    older.state["finished_trials"] = serde_json::json!([{
        "candidate": {"doubled": {"from": 500, "to": 1000}}, "gain_db": 0.2,
        "standard_error_db": 0.1, "n_images": 8, "kept": true
    }]);
    let mut resumed = SplatTrainer::resume(gpu, &older, &keyframes).unwrap().0;
    let mut state = checkpoint_of(&mut resumed).state;
    assert_eq!(state["options"]["specific"]["count"], "Tested");
    state["options"]["specific"]["count"] =
        checkpoint.state["options"]["specific"]["count"].clone();
    assert_eq!(state, checkpoint.state);
}

#[test]
fn paused_growth_continues_on_request_and_after_resuming() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let mut trainer = new_trainer(&gpu, &keyframes[..8], 3000);
    let n_splats = |trainer: &SplatTrainer| trainer.progress().primitives;
    train(&mut trainer, 150);
    assert!(trainer.pause_growth(true).unwrap());
    assert!(!trainer.pause_growth(true).unwrap(), "already paused");
    let paused_at = n_splats(&trainer);
    train(&mut trainer, 100);
    assert_eq!(
        n_splats(&trainer),
        paused_at,
        "no splats are added at step 200"
    );
    let checkpoint = checkpoint_of(&mut trainer);
    let mut resumed = SplatTrainer::resume(gpu, &checkpoint, &keyframes)
        .unwrap()
        .0;
    assert!(
        !resumed.pause_growth(true).unwrap(),
        "the pause is in the checkpoint"
    );
    assert!(resumed.pause_growth(false).unwrap());
    train(&mut resumed, 100);
    assert!(
        n_splats(&resumed) > paused_at,
        "splats are added at step 300"
    );
}

#[test]
fn resuming_is_bit_exact() {
    let gpu = test_gpu();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("training.ckpt");
    for with_depth in [true, false] {
        let keyframes = keyframes(&gpu, with_depth);
        let mut uninterrupted = new_trainer(&gpu, &keyframes[..8], 3000);
        train(&mut uninterrupted, 100);
        uninterrupted.push(keyframes[9].clone()).unwrap();
        train(&mut uninterrupted, END - 100);

        let mut interrupted = new_trainer(&gpu, &keyframes[..8], 3000);
        for stop in STOPS
            .into_iter()
            .chain([100, END])
            .collect::<std::collections::BTreeSet<u64>>()
        {
            let step = interrupted.progress().step;
            train(&mut interrupted, stop - step);
            if stop == 100 {
                interrupted.push(keyframes[9].clone()).unwrap(); // Without depth, it is not seeded yet.
            }
            let before = checkpoint_of(&mut interrupted);
            before.write(&path).unwrap();
            drop(interrupted);
            let untrained;
            (interrupted, untrained) =
                SplatTrainer::resume(gpu.clone(), &Checkpoint::read(&path).unwrap(), &keyframes)
                    .unwrap();
            assert_eq!(
                untrained.len(),
                if stop < 100 { 3 } else { 2 },
                "two are test images, one has not arrived yet"
            );
            assert_same(&checkpoint_of(&mut interrupted), &before);
        }
        assert_same(
            &checkpoint_of(&mut interrupted),
            &checkpoint_of(&mut uninterrupted),
        );
        assert!(
            interrupted.progress().primitives > 400,
            "{:?}",
            interrupted.progress()
        );
        assert_eq!(interrupted.progress().bytes, uninterrupted.progress().bytes);
        assert!(interrupted.arrays().unwrap() == uninterrupted.arrays().unwrap());
    }
}

#[test]
fn checkpoint_and_training_do_not_affect_each_other() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let [mut undisturbed, mut watched] = [(); 2].map(|()| new_trainer(&gpu, &keyframes, 3000));
    train(&mut undisturbed, 210);
    train(&mut watched, 195);
    let pending = watched.checkpoint().unwrap();
    train(&mut watched, 15);
    assert_same(
        &checkpoint_of(&mut watched),
        &checkpoint_of(&mut undisturbed),
    );
    let early = pending.finish().unwrap();
    assert_eq!(early.state["step"], 195);
    let (mut again, _) = SplatTrainer::resume(gpu, &early, &keyframes).unwrap();
    train(&mut again, 15);
    assert_same(&checkpoint_of(&mut again), &checkpoint_of(&mut undisturbed));
}

#[test]
fn different_data_and_invalid_states_are_rejected() {
    let gpu = test_gpu();
    let keyframes = keyframes(&gpu, true);
    let mut trainer = new_trainer(&gpu, &keyframes, 500);
    let checkpoint = checkpoint_of(&mut trainer);
    let resume_error = |checkpoint: &Checkpoint, keyframes: &[Arc<Keyframe>]| {
        SplatTrainer::resume(gpu.clone(), checkpoint, keyframes).unwrap_err()
    };
    assert!(SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes).is_ok());
    let message = resume_error(&checkpoint, &keyframes[..5]).to_string();
    assert_eq!(
        message,
        "the checkpoint belongs to different data: 4 of its images are missing, the first is image 5 of camera \"test\""
    );
    let error_with_changed_keyframe = |change: &dyn Fn(&mut Keyframe)| {
        let mut other = keyframes.clone();
        change(Arc::make_mut(&mut other[3]));
        resume_error(&checkpoint, &other).to_string()
    };
    assert!(
        error_with_changed_keyframe(&|keyframe| keyframe.size_px = [48, 40])
            .contains("has 48x40 pixels, had 96x80")
    );
    assert!(
        error_with_changed_keyframe(&|keyframe| keyframe.depth = None)
            .contains("different depth image")
    );
    assert!(
        error_with_changed_keyframe(&|keyframe| keyframe.focal_px[0] += 1.0)
            .contains("different intrinsics")
    );
    assert!(
        error_with_changed_keyframe(&|keyframe| keyframe.world_from_camera.translation.x += 1e-6)
            .contains("different pose")
    );
    assert!(
        error_with_changed_keyframe(&|keyframe| keyframe.camera = "other".into())
            .contains("is missing")
    );

    let error_with_changed_checkpoint = |change: &dyn Fn(&mut Checkpoint)| {
        let mut other = checkpoint.clone();
        change(&mut other);
        let error = resume_error(&other, &keyframes);
        let is_invalid_state = matches!(
            error,
            Error::CheckpointState { .. }
                | Error::ModelFile(model_files::Error::CheckpointState { .. })
        );
        assert!(is_invalid_state, "{error}");
        error.to_string()
    };
    assert!(
        error_with_changed_checkpoint(&|other| other.method = "nerf".into()).contains("\"nerf\"")
    );
    assert!(
        error_with_changed_checkpoint(&|other| other.state["future"] = 1.into())
            .contains("unknown field `future`")
    );
    assert!(
        error_with_changed_checkpoint(&|other| other.state["model"]["n_splats"] = 4_000_000.into())
            .contains("do not fit")
    );
    assert!(
        error_with_changed_checkpoint(&|other| other.state["model"]["active_degree"] = 3.into())
            .contains("do not fit")
    );
    assert!(
        error_with_changed_checkpoint(&|other| other.state["unseeded"] = vec![99].into())
            .contains("view")
    );
    assert!(
        error_with_changed_checkpoint(&|other| other.arrays[2].bytes.truncate(1))
            .contains("\"shapes\" has")
    );
}
