//! Checkpoints: a model that stopped and went on is, bit for bit, one that never stopped.

use super::learning::{keyframes, options, train};
use super::{SplatOptions, SplatTrainer};
use crate::checkpoint::Checkpoint;
use crate::gpu::{Gpu, GpuOptions};
use crate::{Error, Keyframe, Method};
use std::sync::Arc;

/// Past a change of the splat count and of the degree, and in the middle between two.
const STOPS: [u64; 3] = [7, 230, 310];
const END: u64 = 340;

fn taken(trainer: &mut SplatTrainer) -> Checkpoint {
    trainer.checkpoint().unwrap().finish().unwrap()
}

fn started(gpu: &Arc<Gpu>, keyframes: &[Arc<Keyframe>], max_splats: u32) -> SplatTrainer {
    let options = SplatOptions { n_planned_steps: 500, max_splats, ..options() };
    let mut trainer = SplatTrainer::new(gpu.clone(), options).unwrap();
    for keyframe in keyframes {
        trainer.push(keyframe.clone()).unwrap();
    }
    trainer
}

/// The whole state, its arrays' names only: a difference should not print megabytes.
fn assert_same(one: &Checkpoint, other: &Checkpoint) {
    assert_eq!(one.state, other.state);
    for (one, other) in one.arrays.iter().zip(&other.arrays) {
        assert!(one == other, "{} differ", one.name);
    }
    assert_eq!(one.arrays.len(), other.arrays.len());
}

#[test]
fn stopping_and_going_on_changes_no_bit() {
    let gpu = Gpu::open(&GpuOptions::default()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("training.ckpt");
    for with_depth in [true, false] {
        let keyframes = keyframes(&gpu, with_depth);
        let mut whole = started(&gpu, &keyframes[..8], 3000);
        train(&mut whole, 100);
        whole.push(keyframes[9].clone()).unwrap();
        train(&mut whole, END - 100);

        let mut parts = started(&gpu, &keyframes[..8], 3000);
        for stop in STOPS.into_iter().chain([100, END]).collect::<std::collections::BTreeSet<u64>>() {
            let step = parts.progress().step;
            train(&mut parts, stop - step);
            if stop == 100 {
                parts.push(keyframes[9].clone()).unwrap(); // Without depth it waits for its splats in the checkpoint.
            }
            let before = taken(&mut parts);
            before.write(&path).unwrap();
            drop(parts);
            let rest;
            (parts, rest) = SplatTrainer::resume(gpu.clone(), &Checkpoint::read(&path).unwrap(), &keyframes).unwrap();
            assert_eq!(rest.len(), if stop < 100 { 3 } else { 2 }, "two are for testing, one is yet to come");
            assert_same(&taken(&mut parts), &before);
        }
        assert_same(&taken(&mut parts), &taken(&mut whole));
        assert!(parts.progress().primitives > 400, "{:?}", parts.progress());
        assert_eq!(parts.progress().bytes, whole.progress().bytes);
        assert!(parts.arrays().unwrap() == whole.arrays().unwrap());
    }
}

#[test]
fn taking_a_checkpoint_disturbs_nothing_and_nothing_disturbs_it() {
    let gpu = Gpu::open(&GpuOptions::default()).unwrap();
    let keyframes = keyframes(&gpu, true);
    let [mut left_alone, mut watched] = [(); 2].map(|()| started(&gpu, &keyframes, 3000));
    train(&mut left_alone, 210);
    train(&mut watched, 195);
    let pending = watched.checkpoint().unwrap();
    train(&mut watched, 15);
    assert_same(&taken(&mut watched), &taken(&mut left_alone));
    let early = pending.finish().unwrap();
    assert_eq!(early.state["step"], 195);
    let (mut again, _) = SplatTrainer::resume(gpu, &early, &keyframes).unwrap();
    train(&mut again, 15);
    assert_same(&taken(&mut again), &taken(&mut left_alone));
}

#[test]
fn other_data_and_unknown_states_are_refused() {
    let gpu = Gpu::open(&GpuOptions::default()).unwrap();
    let keyframes = keyframes(&gpu, true);
    let mut trainer = started(&gpu, &keyframes, 500);
    let checkpoint = taken(&mut trainer);
    let refused = |checkpoint: &Checkpoint, keyframes: &[Arc<Keyframe>]| {
        SplatTrainer::resume(gpu.clone(), checkpoint, keyframes).unwrap_err()
    };
    assert!(SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes).is_ok());
    let told = refused(&checkpoint, &keyframes[..5]).to_string();
    assert_eq!(told, "the checkpoint is of other data: image 5 of camera \"test\" is not there to be learned from");
    let changed = |change: &dyn Fn(&mut Keyframe)| {
        let mut other = keyframes.clone();
        change(Arc::make_mut(&mut other[3]));
        refused(&checkpoint, &other).to_string()
    };
    assert!(changed(&|keyframe| keyframe.size_px = [48, 40]).contains("has 48x40 pixels, had 96x80"));
    assert!(changed(&|keyframe| keyframe.depth = None).contains("another depth image"));
    assert!(changed(&|keyframe| keyframe.focal_px[0] += 1.0).contains("another lens"));
    assert!(changed(&|keyframe| keyframe.world_from_camera.translation.x += 1e-6).contains("another pose"));
    assert!(changed(&|keyframe| keyframe.camera = "other".into()).contains("not there"));

    let broken = |change: &dyn Fn(&mut Checkpoint)| {
        let mut other = checkpoint.clone();
        change(&mut other);
        let error = refused(&other, &keyframes);
        assert!(matches!(error, Error::CheckpointState { .. }), "{error}");
        error.to_string()
    };
    assert!(broken(&|other| other.method = "nerf".into()).contains("\"nerf\""));
    assert!(broken(&|other| other.state["future"] = 1.into()).contains("unknown field `future`"));
    assert!(broken(&|other| other.state["n_splats"] = 4_000_000.into()).contains("do not fit"));
    assert!(broken(&|other| other.state["active_degree"] = 3.into()).contains("do not fit"));
    assert!(broken(&|other| other.state["unseeded"] = vec![99].into()).contains("view"));
    assert!(broken(&|other| other.arrays[2].bytes.truncate(1)).contains("\"shapes\" has"));
}
