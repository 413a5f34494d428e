//! Tests of trials while keyframes arrive and are removed. Both halves train on the same data, no
//! seed is lost, and a checkpoint contains the whole trial.

use super::training_tests::{n_keyframes, options};
use super::trials::MAX_SCORED;
use super::{SplatTrainer, TrialSteps};
use crate::Method;
use calibration::{CameraRefinement, ParamSet, Trial};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::{Keyframe, Split};
use model_files::checkpoint::Checkpoint;
use std::sync::Arc;

const START: u64 = 250;
/// Steps of each half of a trial of shared parameters.
const HALF: u64 = 125;
const END: u64 = START + 2 * HALF;

fn trainer_with_candidate(gpu: &Arc<Gpu>, candidate: ParamSet) -> SplatTrainer {
    // The splat count changes only when seeds are added.
    let options = options().with(|options| {
        options.common.cameras = CameraRefinement::Try(vec![candidate]);
        options.common.n_planned_steps = 750;
        options.specific.growth_frac = 0.0;
        options.specific.max_splats = 20_000;
        options.specific.seeds_per_image = Some(300.0);
        options.specific.trial_steps = TrialSteps {
            first_trial: START,
            trial_half: HALF,
            ..TrialSteps::default()
        };
    });
    SplatTrainer::new(gpu.clone(), options).unwrap()
}

fn with_split(keyframe: &Arc<Keyframe>, split: Split) -> Arc<Keyframe> {
    Arc::new(Keyframe {
        split,
        ..keyframe.as_ref().clone()
    })
}

/// Trains up to a total number of updates, including updates that trials reverted.
fn train_to(trainer: &mut SplatTrainer, n_total_steps: u64) {
    while trainer.n_total_steps().unwrap() < n_total_steps {
        let n_left = n_total_steps - trainer.n_total_steps().unwrap();
        trainer.step(n_left.min(7)).unwrap();
    }
}

fn lens() -> ParamSet {
    ParamSet::LENS
}

const N_EARLY: usize = 30;

/// Keyframes all around the scene. Every fourth is a validation keyframe.
fn around(gpu: &Arc<Gpu>) -> Vec<Arc<Keyframe>> {
    let split = |ix: usize| {
        if ix.is_multiple_of(4) {
            Split::Validation
        } else {
            Split::Train
        }
    };
    n_keyframes(gpu, 46, true)
        .iter()
        .enumerate()
        .map(|(ix, keyframe)| with_split(keyframe, split(ix)))
        .collect()
}

/// Adds keyframes before a trial, in its first half and in its second half, and trains past the end
/// of the trial.
fn trial_with_arrivals(
    gpu: &Arc<Gpu>,
    candidate: ParamSet,
    keyframes: &[Arc<Keyframe>],
) -> SplatTrainer {
    let (early, late) = keyframes.split_at(N_EARLY);
    let (first_half, second_half) = late.split_at(8);
    let mut trainer = trainer_with_candidate(gpu, candidate);
    early
        .iter()
        .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
    for (begin, arriving) in [(START, first_half), (START + HALF, second_half)] {
        for (ix, keyframe) in arriving.iter().enumerate() {
            train_to(&mut trainer, begin + 10 + 10 * ix as u64);
            trainer.push(keyframe.clone()).unwrap();
        }
    }
    train_to(&mut trainer, END + 3);
    trainer
}

fn assert_all_seeds_kept(trainer: &SplatTrainer, keyframes: &[Arc<Keyframe>]) {
    assert_eq!(
        trainer.progress().primitives,
        trainer.n_seeds() as u64,
        "splats against seeded positions"
    );
    for keyframe in keyframes
        .iter()
        .filter(|keyframe| keyframe.split == Split::Train)
    {
        assert_eq!(trainer.n_views_of(keyframe), 1, "{:?}", keyframe.stamp);
    }
    assert!(trainer.n_seeds() > 500, "{}", trainer.n_seeds());
}

#[test]
fn no_op_trial_has_zero_gain_while_keyframes_arrive() {
    let gpu = test_gpu();
    let keyframes = around(&gpu);
    let trainer = trial_with_arrivals(&gpu, ParamSet::empty(), &keyframes);
    let [
        Trial {
            gain_db,
            standard_error_db,
            n_images,
            kept,
            ..
        },
    ] = trainer.trials()
    else {
        panic!("{:?}", trainer.trials())
    };
    assert_eq!((*gain_db, *standard_error_db, *kept), (0.0, 0.0, false));
    assert_eq!(
        *n_images,
        N_EARLY.div_ceil(4),
        "validation keyframes at the start of the trial"
    );
    assert_all_seeds_kept(&trainer, &keyframes);
}

#[test]
fn accepted_trial_keeps_seeds_of_arrived_keyframes() {
    let gpu = test_gpu();
    let miscalibrated: Vec<_> = around(&gpu)
        .iter()
        .map(|keyframe| {
            let focal_px = keyframe.focal_px.map(|focal| 1.1 * focal);
            Arc::new(Keyframe {
                focal_px,
                ..keyframe.as_ref().clone()
            })
        })
        .collect();
    let trainer = trial_with_arrivals(&gpu, lens(), &miscalibrated);
    assert!(
        trainer.trials().len() == 1 && trainer.trials()[0].kept,
        "{:?}",
        trainer.trials()
    );
    assert_all_seeds_kept(&trainer, &miscalibrated);
}

#[test]
fn both_halves_score_the_same_images() {
    const N_FIRST: usize = 20;
    let gpu = test_gpu();
    let keyframes = n_keyframes(&gpu, 60, true);
    let train = keyframes
        .iter()
        .step_by(5)
        .map(|keyframe| with_split(keyframe, Split::Train));
    let validation: Vec<_> = (0..keyframes.len())
        .filter(|ix| ix % 5 != 0)
        .map(|ix| with_split(&keyframes[ix], Split::Validation))
        .collect();
    let mut trainer = trainer_with_candidate(&gpu, ParamSet::empty());
    let (early, late) = validation.split_at(N_FIRST);
    train
        .chain(early.iter().cloned())
        .for_each(|keyframe| trainer.push(keyframe).unwrap());
    // Validation keyframes arrive in both halves, and each half loses one of the scored keyframes.
    for (ix, keyframe) in late.iter().enumerate() {
        train_to(&mut trainer, START + 5 + 12 * ix as u64);
        trainer.push(keyframe.clone()).unwrap();
        match ix {
            3 => trainer.remove("test", early[2].stamp).unwrap(),
            12 => trainer.remove("test", early[5].stamp).unwrap(),
            _ => {}
        }
    }
    assert!(validation.len() > MAX_SCORED + 4);
    train_to(&mut trainer, END + 3);
    let [
        Trial {
            gain_db,
            standard_error_db,
            n_images,
            ..
        },
    ] = trainer.trials()
    else {
        panic!("{:?}", trainer.trials())
    };
    assert_eq!(
        (*gain_db, *standard_error_db, *n_images),
        (0.0, 0.0, N_FIRST - 2)
    );
}

#[test]
fn resuming_in_either_trial_half_is_bit_exact() {
    let gpu = test_gpu();
    let keyframes = n_keyframes(&gpu, 42, true);
    // Arrivals of keyframes and interruptions of training, as total numbers of updates.
    let arrivals: Vec<u64> = (0..42)
        .map(|ix| {
            if ix < 36 {
                0
            } else {
                START - 30 + 60 * (ix - 35)
            }
        })
        .collect();
    let stops = [
        START - 5,
        START + 35,
        START + HALF + 15,
        START + HALF + 70,
        END + 10,
    ];
    let run = |stops: &[u64]| {
        let mut trainer = trainer_with_candidate(&gpu, lens());
        let mut n_taken_before = 0; // Reverted updates, which a checkpoint does not count.
        let mut n_pushed = 0;
        let times: std::collections::BTreeSet<u64> = arrivals
            .iter()
            .chain(stops)
            .copied()
            .chain([END + 20])
            .collect();
        for time in times {
            train_to(&mut trainer, time - n_taken_before);
            while n_pushed < arrivals.len() && arrivals[n_pushed] <= time {
                trainer.push(keyframes[n_pushed].clone()).unwrap();
                n_pushed += 1;
            }
            if stops.contains(&time) {
                let checkpoint = trainer.checkpoint().unwrap().finish().unwrap();
                let n_other_arrays = checkpoint
                    .arrays
                    .iter()
                    .filter(|array| array.name.starts_with("other_"))
                    .count();
                let is_in_trial = (START..END).contains(&time);
                assert_eq!(n_other_arrays > 0, is_in_trial, "at {time}");
                let untrained;
                (trainer, untrained) =
                    SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes[..n_pushed]).unwrap();
                untrained
                    .into_iter()
                    .for_each(|keyframe| trainer.push(keyframe).unwrap());
                n_taken_before = time - trainer.n_total_steps().unwrap();
            }
        }
        let trials = trainer.trials().to_vec();
        assert_eq!(trials.len(), 1);
        (trials, checkpoint_of(&mut trainer))
    };
    let (uninterrupted, interrupted) = (run(&[]), run(&stops));
    assert_eq!(uninterrupted.0, interrupted.0);
    assert_eq!(uninterrupted.1.state, interrupted.1.state);
    for (one, other) in uninterrupted.1.arrays.iter().zip(&interrupted.1.arrays) {
        assert!(one == other, "{} differ", one.name);
    }
}

fn checkpoint_of(trainer: &mut SplatTrainer) -> Checkpoint {
    trainer.checkpoint().unwrap().finish().unwrap()
}
