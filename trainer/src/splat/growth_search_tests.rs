//! Tests of the growth search: few images limit the number of splats, many images do not, and
//! interruptions of a search have no effect.

use super::growth_search::FEW_IMAGES;
use super::training_tests::{FEW_STEPS, n_keyframes, noisy, options, train};
use super::trials::CountPolicy;
use super::{SplatOptions, SplatTrainer};
use crate::Method;
use crate::gpu::Gpu;
use crate::gpu::testing::test_gpu;
use crate::model_options::ModelOptions;
use calibration::{Candidate, Trial};
use keyframe::{Keyframe, Split};
use model_files::checkpoint::Checkpoint;
use std::sync::Arc;

const N_PLANNED_STEPS: u64 = 400;

fn tested() -> ModelOptions<SplatOptions> {
    options().with(|options| {
        options.common.n_planned_steps = N_PLANNED_STEPS;
        options.specific.count = CountPolicy::Tested;
        options.specific.max_splats = 8000;
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

/// Keyframes without validation keyframes, because releasing them during the search would add
/// splats.
fn without_validation(keyframes: Vec<Arc<Keyframe>>) -> Vec<Arc<Keyframe>> {
    let train = |keyframe: Arc<Keyframe>| match keyframe.split {
        Split::Validation => Arc::new(Keyframe {
            split: Split::Train,
            ..keyframe.as_ref().clone()
        }),
        Split::Train | Split::Test => keyframe,
    };
    keyframes.into_iter().map(train).collect()
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

fn checkpoint_of(trainer: &mut SplatTrainer) -> Checkpoint {
    trainer.checkpoint().unwrap().finish().unwrap()
}

/// The images are noisy, so more splats represent the noise of the training images.
#[test]
fn few_noisy_images_stop_growth() {
    let gpu = test_gpu();
    let keyframes = without_validation(noisy(&n_keyframes(&gpu, 9, true)));
    let n_images = keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test)
        .count();
    let mut trainer = new_trainer(&gpu, tested(), &keyframes);
    train(&mut trainer, FEW_STEPS.search);
    let n_before = trainer.progress().primitives;
    train(&mut trainer, 10);
    let reported = doublings(&trainer);
    let [
        Trial {
            gain_db,
            n_images: n_scored,
            kept: false,
            ..
        },
    ] = reported[..]
    else {
        panic!("{reported:?}")
    };
    assert!(
        gain_db < 0.1 && n_scored == n_images,
        "every image is scored once: {reported:?}"
    );
    train(&mut trainer, N_PLANNED_STEPS - FEW_STEPS.search - 10);
    assert_eq!(
        (trainer.progress().primitives, trainer.n_active_views()),
        (n_before, n_images)
    );
    let mut unlimited = new_trainer(
        &gpu,
        tested().with(|options| options.specific.count = CountPolicy::ToCap),
        &keyframes,
    );
    train(&mut unlimited, N_PLANNED_STEPS);
    assert!(
        unlimited.progress().primitives > n_before,
        "{:?}",
        unlimited.progress()
    );
}

/// Without noise, a model with too few splats for the details of the scene improves if it grows.
#[test]
fn useful_growth_continues() {
    let gpu = test_gpu();
    let keyframes = without_validation(n_keyframes(&gpu, 28, true));
    let options = tested().with(|options| options.specific.seeds_per_image = Some(60.0));
    let mut trainer = new_trainer(&gpu, options, &keyframes);
    train(&mut trainer, FEW_STEPS.search);
    let n_before = trainer.arrays().unwrap().n_splats();
    assert!(n_before < 3000, "{n_before}");
    while trainer.n_finished_rounds() == Some(0) || !trainer.is_growth_search_running() {
        trainer.step(50).unwrap();
    }
    let n_both_rounds: u64 = 3 * (FEW_STEPS.search + 2 * 2 * FEW_STEPS.comparison);
    let n_needed = trainer.n_steps_for_size_search();
    assert!(
        (n_both_rounds..=n_both_rounds + 3 * 2 * FEW_STEPS.comparison).contains(&n_needed),
        "{n_needed}"
    );
    // A search that ends early keeps the accepted doubling.
    assert!(trainer.end_size_search().unwrap() && trainer.n_steps_for_size_search() == 0);
    let reported = doublings(&trainer);
    assert!(
        reported.len() == 1 && reported[0].kept && reported[0].gain_db > 0.1,
        "{reported:?}"
    );
    assert_eq!(
        trainer.growth_limit().map(|n| n as usize),
        Some(2 * n_before)
    );
    train(&mut trainer, 300);
    assert!(
        trainer.arrays().unwrap().n_splats() > n_before,
        "{:?}",
        trainer.progress()
    );
}

/// A search that ends early leaves the model as if the search had not started.
#[test]
fn search_without_enough_time_ends_at_the_current_number() {
    const N_FOLDS: u64 = 3;
    const N_SEARCH: u64 = N_FOLDS * (FEW_STEPS.search + 2 * FEW_STEPS.comparison);
    let gpu = test_gpu();
    let keyframes = without_validation(n_keyframes(&gpu, 9, true));
    let run = |n_searched: u64| {
        let mut trainer = new_trainer(&gpu, tested(), &keyframes);
        assert!(!trainer.end_size_search().unwrap(), "no search is due");
        train(&mut trainer, FEW_STEPS.search);
        let n_splats = trainer.arrays().unwrap().n_splats();
        assert_eq!(trainer.n_steps_for_size_search(), 2 * N_SEARCH);
        while trainer.n_total_steps().unwrap() < FEW_STEPS.search + n_searched {
            let n_left = FEW_STEPS.search + n_searched - trainer.n_total_steps().unwrap();
            trainer.step(n_left).unwrap();
        }
        assert_eq!(trainer.n_steps_for_size_search(), 2 * N_SEARCH - n_searched);
        assert!(trainer.end_size_search().unwrap() && !trainer.is_growth_search_running());
        assert_eq!(
            trainer.n_total_steps().unwrap(),
            FEW_STEPS.search + n_searched
        );
        train(&mut trainer, 250);
        assert!(trainer.trials().is_empty());
        let arrays = trainer.arrays().unwrap();
        assert_eq!(arrays.n_splats(), n_splats);
        arrays
    };
    assert!(run(0) == run(FEW_STEPS.search + FEW_STEPS.comparison + 30));
}

#[test]
fn many_images_are_not_tested() {
    let gpu = test_gpu();
    let keyframes = noisy(&n_keyframes(&gpu, 8 * FEW_IMAGES / 7 + 1, true));
    let options = tested().with(|options| options.specific.max_splats = 3000);
    let mut trainer = new_trainer(&gpu, options, &keyframes);
    train(&mut trainer, FEW_STEPS.search + 20);
    assert!(
        trainer.trials().is_empty()
            && !trainer.is_growth_search_running()
            && trainer.growth_limit().is_none()
    );
    assert_eq!(trainer.n_total_steps().unwrap(), FEW_STEPS.search + 20);
}

/// A keyframe that arrives during a search restarts it. A checkpoint continues with the same
/// result.
#[test]
fn interrupted_search_is_repeated() {
    const END: u64 = FEW_STEPS.search + FEW_STEPS.search_pause + 50;
    let gpu = test_gpu();
    // With noise, the search ends after one round.
    let keyframes = without_validation(noisy(&n_keyframes(&gpu, 12, true)));
    let start_search = || {
        // The repeated search starts before growth ends.
        let options = tested().with(|options| options.common.n_planned_steps = 2 * N_PLANNED_STEPS);
        let mut trainer = new_trainer(&gpu, options, &keyframes[..11]);
        train(&mut trainer, FEW_STEPS.search);
        let n_before = trainer.progress().primitives;
        trainer.step(30).unwrap();
        assert!(trainer.is_growth_search_running());
        assert_eq!(
            (trainer.progress().step, trainer.progress().primitives),
            (FEW_STEPS.search, n_before),
            "not displayed"
        );
        trainer
    };
    let finish = |trainer: &mut SplatTrainer| {
        trainer.push(keyframes[11].clone()).unwrap();
        assert!(!trainer.is_growth_search_running());
        let n_left = END - trainer.progress().step;
        train(trainer, n_left);
        assert_eq!(doublings(trainer).len(), 1, "{:?}", trainer.trials());
        checkpoint_of(trainer)
    };
    let mut uninterrupted = start_search();
    let checkpoint = checkpoint_of(&mut uninterrupted);
    assert!(uninterrupted.is_growth_search_running());
    let (mut resumed, untrained) =
        SplatTrainer::resume(gpu.clone(), &checkpoint, &keyframes[..11]).unwrap();
    untrained
        .into_iter()
        .for_each(|keyframe| resumed.push(keyframe).unwrap());
    let (one, other) = (finish(&mut uninterrupted), finish(&mut resumed));
    assert_eq!(one.state, other.state);
    assert!(one.arrays == other.arrays, "the models differ");
    // A saved model is the model that is trained on all images.
    let mut saved = start_search();
    let n_before = saved.progress().primitives;
    saved.save(tempfile::tempdir().unwrap().path()).unwrap();
    assert_eq!(saved.arrays().unwrap().n_splats() as u64, n_before);
    assert_eq!(
        (
            saved.progress().step,
            saved.n_total_steps().unwrap() > FEW_STEPS.search
        ),
        (FEW_STEPS.search, true)
    );
}
