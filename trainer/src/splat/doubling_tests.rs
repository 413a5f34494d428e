//! Tests of trials that double the number of splats: useful doublings are accepted, others are
//! rejected, and growth restarts when new images arrive.

use super::training_tests::{FEW_STEPS, n_keyframes, noisy, options, train};
use super::trials::CountPolicy;
use super::{SplatOptions, SplatTrainer, TrialSteps};
use crate::Method;
use crate::model_options::ModelOptions;
use calibration::{Candidate, Trial};
use gpu::Gpu;
use gpu::testing::test_gpu;
use keyframe::{Keyframe, Split};
use std::sync::Arc;

fn tested_growth(n_planned_steps: u64) -> ModelOptions<SplatOptions> {
    options().with(|options| {
        options.common.n_planned_steps = n_planned_steps;
        options.specific.count = CountPolicy::TestedGrowth;
        options.specific.max_splats = 8000;
        options.specific.seeds_per_image = Some(60.0);
        options.specific.trial_steps = FEW_STEPS;
    })
}

fn new_trainer(
    gpu: &Arc<Gpu>,
    options: ModelOptions<SplatOptions>,
    keyframes: &[Arc<Keyframe>],
) -> SplatTrainer {
    let mut trainer = SplatTrainer::new(gpu.clone(), options).unwrap();
    keyframes
        .iter()
        .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
    trainer
}

fn train_to_total(trainer: &mut SplatTrainer, n_total_steps: u64) {
    while trainer.n_total_steps().unwrap() < n_total_steps {
        let n_left = n_total_steps - trainer.n_total_steps().unwrap();
        trainer.step(n_left).unwrap();
    }
}

fn doublings(trainer: &SplatTrainer) -> Vec<Trial> {
    let is_doubling = |trial: &&Trial| matches!(trial.candidate, Candidate::Doubled { .. });
    trainer
        .trials()
        .iter()
        .filter(is_doubling)
        .cloned()
        .collect()
}

/// Every second image is scored, so that the trials are significant.
fn with_many_validation_images(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
    let split = |ix: usize| {
        if ix % 2 == 1 {
            Split::Validation
        } else {
            Split::Train
        }
    };
    let of = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
        Arc::new(Keyframe {
            split: split(ix),
            ..keyframe.as_ref().clone()
        })
    };
    keyframes.iter().enumerate().map(of).collect()
}

/// A model with too few splats for the scene doubles. A run that is resumed in either half of the
/// trial gives the same result.
#[test]
fn useful_doubling_is_accepted_also_after_resuming() {
    let gpu = test_gpu();
    let keyframes = with_many_validation_images(&n_keyframes(&gpu, 28, true));
    let run = |stop: Option<u64>| {
        let mut trainer = new_trainer(&gpu, tested_growth(1500), &keyframes);
        train(&mut trainer, FEW_STEPS.first_doubling);
        let n_before = trainer.progress().primitives;
        if let Some(n_steps) = stop {
            train_to_total(&mut trainer, FEW_STEPS.first_doubling + n_steps);
            assert_eq!(
                trainer.progress().primitives,
                n_before,
                "the doubled model is not displayed during the trial"
            );
            let checkpoint = trainer.checkpoint().unwrap().finish().unwrap();
            let untrained;
            (trainer, untrained) =
                SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes).unwrap();
            untrained
                .into_iter()
                .for_each(|keyframe| trainer.push(keyframe).unwrap());
        }
        while doublings(&trainer).is_empty() {
            trainer.step(10).unwrap();
        }
        let n_left =
            FEW_STEPS.first_doubling + FEW_STEPS.doubling_half + 20 - trainer.progress().step;
        train(&mut trainer, n_left);
        let reported = doublings(&trainer);
        assert!(
            reported[0].kept && reported[0].gain_db > 0.1,
            "{reported:?}"
        );
        assert_eq!(trainer.arrays().unwrap().n_splats() as u64, 2 * n_before);
        (reported, trainer.arrays().unwrap())
    };
    let uninterrupted = run(None);
    for stop in [30, FEW_STEPS.doubling_half + 30] {
        assert!(
            run(Some(stop)) == uninterrupted,
            "stopped after {stop} steps"
        );
    }
}

/// Noise hides the details, so that more splats do not improve other images. Growth restarts with
/// new images, but not with a few of them.
#[test]
fn useless_doubling_is_rejected_until_images_arrive() {
    const N_EARLY: usize = 28;
    const N_LATE: usize = 24;
    let gpu = test_gpu();
    let keyframes = with_many_validation_images(&noisy(&n_keyframes(&gpu, N_EARLY + N_LATE, true)));
    let (early, late) = keyframes.split_at(N_EARLY);
    // With fewer steps, the model does not yet represent the noise, and doubling improves it.
    let steps = TrialSteps::default();
    let options = tested_growth(1400).with(|options| {
        options.specific.seeds_per_image = Some(400.0);
        options.specific.trial_steps = steps;
    });
    let mut trainer = new_trainer(&gpu, options, early);
    train(&mut trainer, steps.first_doubling);
    let n_before = trainer.progress().primitives;
    train(&mut trainer, 2 * steps.doubling_half);
    let reported = doublings(&trainer);
    assert!(reported.len() == 1 && !reported[0].kept, "{reported:?}");
    // After densification, the model is reduced, and all images are trained on.
    train(&mut trainer, 2700);
    assert!(
        trainer.progress().primitives <= n_before && trainer.n_active_views() == N_EARLY,
        "{:?}",
        trainer.trials()
    );
    let n_trials = trainer.trials().len();
    late[..4]
        .iter()
        .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
    train(&mut trainer, 10);
    assert_eq!(
        (trainer.n_active_views(), trainer.trials().len()),
        (N_EARLY + 4, n_trials),
        "too few new images"
    );
    late[4..]
        .iter()
        .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
    train(&mut trainer, 2 * steps.doubling_half);
    let n_active = trainer.n_active_views();
    assert!(
        n_active > N_EARLY + N_LATE / 2 && n_active < N_EARLY + N_LATE,
        "{n_active}: some are not trained on"
    );
    assert_eq!(
        doublings(&trainer).len(),
        reported.len() + 1,
        "{:?}",
        trainer.trials()
    );
}
