//! Reduces the size of the model. Splats that contribute least are pruned, and the SH degree is
//! lowered.

use super::optimizer::StepContext;
use super::recorder::Recorder;
use super::training::Training;
use super::view_set::VIEWS_AT_ONCE;
use crate::Error;
use crate::splat::kernels::TrainPipelines;
use crate::splat::params::status;
use gpu::Buffer;

/// Maximum number of views over which contributions are summed. Each view takes about as long as a
/// training step at full resolution. With fewer views, splats that only the skipped views show
/// would be pruned.
const MAX_VIEWS: usize = 64;

/// Contribution of each splat to the views. It is the sum of the splat's blending weights, in
/// pixels.
fn contributions(training: &mut Training, learn: &TrainPipelines) -> Result<Vec<f32>, Error> {
    let n_splats = training.model.splats.n_splats;
    let contributions = training
        .recorder
        .gpu
        .storage("splat.contributions", 4 * u64::from(n_splats))?;
    let stride = training.views.len().div_ceil(MAX_VIEWS).max(1);
    let sampled_views: Vec<usize> = (0..training.views.len()).step_by(stride).collect();
    // Buffers for all sizes are reserved first. The errors that are written next would be lost if
    // the image buffers were replaced later.
    for view_ix in &sampled_views {
        training.reserve_view(training.views.size_px((*view_ix, 0)))?;
    }
    training.optimizer.set_unit_errors(&mut training.recorder);
    training
        .optimizer
        .set_n_splats(&training.recorder.gpu, n_splats);
    // Dropped splats would contribute nothing.
    training
        .optimizer
        .write_drop_frac(&training.recorder.gpu, 0.0);
    for chunk in sampled_views.chunks(VIEWS_AT_ONCE) {
        let next = chunk.iter().map(|view_ix| (*view_ix, 0)).collect();
        training
            .views
            .upload(&mut training.recorder, &next, training.schedule.step)?;
        for view_ix in chunk {
            add_contributions(training, learn, *view_ix, &contributions)?;
        }
    }
    training.recorder.passes.clear_bindings();
    Ok(training
        .recorder
        .gpu
        .read(&contributions, n_splats as usize)?)
}

/// Adds the blending weights of each splat in a view to `contributions`.
fn add_contributions(
    training: &mut Training,
    learn: &TrainPipelines,
    view_ix: usize,
    contributions: &Buffer,
) -> Result<(), Error> {
    // The pass is repeated with larger buffers until they are sufficient.
    loop {
        let Training {
            recorder: Recorder { gpu, passes },
            model,
            renderer,
            optimizer,
            views,
            ..
        } = &mut *training;
        let context = StepContext {
            gpu,
            learn,
            renderer,
            model,
        };
        let view = optimizer
            .prepared_view(&context, passes, views.ready_level((view_ix, 0))?)?
            .view;
        view.draw_for_backward(passes, &renderer.pipelines, learn);
        view.backward(passes, learn);
        // This pass has no effect if a buffer was too small, so no view is counted twice.
        view.contribute(passes, learn, contributions);
        passes.submit(gpu);
        let counters: Vec<u32> = gpu.read(&optimizer.status, status::LEN)?;
        if !training
            .renderer
            .grow_scratch(&mut training.recorder, &counters, true)?
        {
            return Ok(());
        }
        training.optimizer.clear_failure(&training.recorder.gpu);
    }
}

/// Keeps the `n_kept` splats that contribute most, without changing their order.
pub(super) fn keep_most_contributing(training: &mut Training, n_kept: u32) -> Result<(), Error> {
    let learn = training.learn()?;
    let contributions = contributions(training, &learn)?;
    let mut by_contribution: Vec<u32> = (0..training.model.splats.n_splats).collect();
    // Ties are resolved by index, so that the same seed gives the same result.
    by_contribution.sort_by(|a, b| {
        contributions[*b as usize]
            .total_cmp(&contributions[*a as usize])
            .then(a.cmp(b))
    });
    by_contribution.truncate(n_kept as usize);
    by_contribution.sort_unstable();
    training
        .model
        .keep(&mut training.recorder, &learn, &by_contribution, n_kept)
}

/// Lowers the SH degree.
pub(super) fn lower_degree(training: &mut Training, sh_degree: u32) -> Result<(), Error> {
    let splats = &mut training.model.splats;
    *splats = splats.resized(&training.recorder.gpu, splats.capacity, sh_degree)?;
    training.recorder.passes.clear_bindings();
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::eval::{PixelPair, psnr};
    use crate::splat::SplatTrainer;
    use crate::splat::trainer::model::n_splats_u32;
    use crate::splat::training_tests::{n_keyframes, noisy, options, request, test_psnr, train};
    use crate::splat::trials::CountPolicy;
    use calibration::Candidate;
    use calibration::Trial;
    use gpu::Gpu;
    use gpu::testing::test_gpu;
    use keyframe::{Keyframe, Split};
    use std::sync::Arc;

    fn trained(
        count: CountPolicy,
        keyframes: &[Arc<Keyframe>],
        gpu: Arc<Gpu>,
        n_steps: u64,
    ) -> SplatTrainer {
        let options = options().with(|options| {
            options.common.n_planned_steps = 1500;
            options.specific.count = count;
            options.specific.max_splats = 4000;
        });
        let mut trainer = SplatTrainer::new(gpu, options).unwrap();
        for keyframe in keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, n_steps);
        trainer
    }

    fn some_trained(n_steps: u64) -> (SplatTrainer, Vec<Arc<Keyframe>>) {
        let gpu = test_gpu();
        let keyframes = n_keyframes(&gpu, 12, true);
        (
            trained(CountPolicy::Tested, &keyframes, gpu, n_steps),
            keyframes,
        )
    }

    /// At each pixel, the blending weights and the transmittance sum to one.
    #[test]
    fn contributions_sum_to_coverage() {
        let (mut trainer, _) = some_trained(60);
        let training = &mut trainer.training;
        let only = training.views.keyframe(0).clone();
        training
            .views
            .retain(|keyframe| Arc::ptr_eq(keyframe, &only));
        let learn = training.learn().unwrap();
        let contributions = contributions(training, &learn).unwrap();
        let n_pixels = only.size_px.iter().product::<u32>() as usize;
        let image = &training.optimizer.image_buffers.as_ref().unwrap().image;
        let colors: Vec<[f32; 4]> = training.recorder.gpu.read(image, n_pixels).unwrap();
        let covered: f64 = colors
            .iter()
            .map(|[.., transmittance]| 1.0 - f64::from(*transmittance))
            .sum();
        let reported: f64 = contributions.iter().map(|sum| f64::from(*sum)).sum();
        assert!(
            covered > 0.2 * n_pixels as f64 && (reported / covered - 1.0).abs() < 1e-4,
            "{reported} of {covered}"
        );
    }

    #[test]
    fn the_least_opaque_splats_make_room_for_new_ones() {
        let (mut trainer, _) = some_trained(120);
        let training = &mut trainer.training;
        let gpu = Arc::clone(&training.recorder.gpu);
        let before = training.model.splats.read(&gpu).unwrap();
        let limit = training.model.limit() as usize;
        let n_free = limit - before.n_splats();
        // Nothing is removed while there is room.
        training.make_room(n_splats_u32(n_free)).unwrap();
        assert_eq!(training.model.splats.read(&gpu).unwrap(), before);
        // One splat too many frees a sixteenth, and as many as the limit free a quarter.
        let mut n_expected = before.n_splats();
        for (n_new, n_removed) in [(n_free + 1, limit / 16), (limit, limit / 4)] {
            let before = training.model.splats.read(&gpu).unwrap();
            training.make_room(n_splats_u32(n_new)).unwrap();
            let after = training.model.splats.read(&gpu).unwrap();
            let n_removed = n_removed.min(before.n_splats() / 2);
            n_expected -= n_removed;
            assert_eq!(after.n_splats(), n_expected);
            let mut by_opacity: Vec<usize> = (0..before.n_splats()).collect();
            by_opacity
                .sort_by(|a, b| before.opacity_logits[*a].total_cmp(&before.opacity_logits[*b]));
            let removed = &by_opacity[..n_removed];
            assert_eq!(after, before.filtered(|ix| !removed.contains(&ix)));
        }
        // New splats are added within the limit, and training goes on.
        let added = before.filtered(|ix| ix < limit / 8);
        training.add(&added).unwrap();
        assert_eq!(
            training.model.splats.n_splats as usize,
            n_expected + added.n_splats()
        );
        train(&mut trainer, 10);
    }

    #[test]
    fn most_contributing_splats_are_kept_unchanged() {
        let (mut trainer, _) = some_trained(120);
        let training = &mut trainer.training;
        let learn = training.learn().unwrap();
        let contributions = contributions(training, &learn).unwrap();
        let before = words(training);
        let n_kept = training.model.splats.n_splats / 3;
        keep_most_contributing(training, n_kept).unwrap();
        let after = words(training);
        assert!(
            training.model.splats.n_splats == n_kept && n_kept > 50,
            "{n_kept}"
        );
        let mut sorted = contributions.clone();
        sorted.sort_by(|a, b| b.total_cmp(a));
        let min_kept = sorted[n_kept as usize - 1];
        let kept: Vec<usize> = (0..contributions.len())
            .filter(|ix| contributions[*ix] >= min_kept)
            .collect();
        assert_eq!(kept.len(), n_kept as usize, "contributions are distinct");
        for (before, after) in before.iter().zip(&after) {
            let expected: Vec<u32> = kept
                .iter()
                .flat_map(|ix| before[*ix].iter().copied())
                .collect();
            assert_eq!(expected, after.concat());
        }
    }

    /// The words of each splat, for every plane of every buffer.
    fn words(training: &Training) -> Vec<Vec<Vec<u32>>> {
        let splats = &training.model.splats;
        let mut all = Vec::new();
        for (buffer, n_planes, bytes) in splats.planes() {
            let words: Vec<u32> = training
                .recorder
                .gpu
                .read(buffer, (buffer.bytes() / 4) as usize)
                .unwrap();
            let per_plane = splats.capacity as usize * (bytes / 4) as usize;
            for plane in words.chunks_exact(per_plane.max(1)).take(n_planes as usize) {
                all.push(
                    plane
                        .chunks_exact((bytes / 4) as usize)
                        .take(splats.n_splats as usize)
                        .map(<[u32]>::to_vec)
                        .collect(),
                );
            }
        }
        all
    }

    /// Noise hides the details, so a few splats with view-independent colors suffice.
    #[test]
    fn model_size_fits_the_scene_and_is_reproducible() {
        let gpu = test_gpu();
        let clean = n_keyframes(&gpu, 36, false); // Without depth, training starts at the maximum number of splats.
        let keyframes = noisy(&clean);
        let mut tested = trained(CountPolicy::Tested, &keyframes, gpu.clone(), 1050);
        let mut again = trained(CountPolicy::Tested, &keyframes, gpu, 1050);
        assert!(again.arrays().unwrap() == tested.arrays().unwrap());
        train(&mut tested, 1900);
        let reported: Vec<Trial> = tested.trials().to_vec();
        assert!(
            reported
                .iter()
                .any(|trial| matches!(trial.candidate, Candidate::Halved { .. }) && trial.kept),
            "{reported:?}"
        );
        let n_learned = keyframes
            .iter()
            .filter(|keyframe| keyframe.split != Split::Test)
            .count();
        assert!(
            !tested.trials.holds_validation() && tested.training.views.len() == n_learned,
            "{reported:?}"
        );
        assert!(
            tested.progress().primitives <= 2000 && tested.training.model.splats.sh_degree == 0,
            "{reported:?}"
        );
        let tests = keyframes
            .iter()
            .zip(&clean)
            .filter(|(keyframe, _)| keyframe.split == Split::Test);
        let ceilings: Vec<f64> = tests
            .map(|(noisy, clean)| {
                psnr(&PixelPair::new(noisy.size_px, &clean.rgba_srgb, &noisy.rgba_srgb).unwrap())
                    .unwrap()
            })
            .collect();
        let ceiling = ceilings.iter().sum::<f64>() / ceilings.len() as f64;
        let reached = test_psnr(&mut tested, &keyframes);
        assert!(
            reached > ceiling - 1.5,
            "{reached} of {ceiling} dB, {reported:?}"
        );
    }

    /// While a trial tests half of the splats, all splats are still displayed.
    #[test]
    fn running_trial_is_not_displayed() {
        let (mut trainer, keyframes) = some_trained(400);
        let state = trainer.training.snapshot().unwrap();
        trainer
            .trials
            .begin(Candidate::Halved { from: 0, to: 0 }, state, 1);
        let view = request(keyframes[0].world_from_camera);
        let before = trainer.render(&view).unwrap();
        let n_before = trainer.progress().primitives;
        let baseline = trainer.training.snapshot().unwrap();
        trainer
            .trials
            .begin_second_half(baseline, super::super::super::trials::Scores::new());
        keep_most_contributing(&mut trainer.training, 50).unwrap();
        assert_eq!(trainer.progress().primitives, n_before);
        assert!(trainer.render(&view).unwrap().rgba_srgb == before.rgba_srgb);
        let baseline = trainer.trials.cancel().unwrap().restored.unwrap();
        trainer.training.restore_snapshot(baseline).unwrap();
        assert!(trainer.render(&view).unwrap().rgba_srgb == before.rgba_srgb);
    }
}
