//! Decides whether image gains are needed, and computes their initial values.

use super::products;
use super::scoring::{Comparer, compare_validation};
use super::training::Training;
use super::view_set::VIEWS_AT_ONCE;
use crate::Error;
use crate::splat::trials::SplatTrials;
use calibration::{ParamSet, interpolate};
use keyframe::Keyframe;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Number of latest views whose gains are computed when gains are enabled in a live run. It is
/// twice the number of keyframes that the decision is based on, so it usually includes all
/// keyframes that arrived after the change of exposure. Each view costs one picture.
const MAX_NEW_EXPOSURES: usize = 16;

/// Logarithms of the red, green and blue gains of views, by the index of the view.
type LogGains = BTreeMap<usize, [f64; 3]>;

/// Scores the validation keyframes with and without gains, and enables gains if their benefit
/// is significant. The gains of a validation keyframe are interpolated in time between the
/// neighboring training images.
pub(super) fn try_gains(training: &mut Training, trials: &mut SplatTrials) -> Result<(), Error> {
    let comparer = Comparer::new(training, trials)?;
    let validation = compare_validation(training, trials, &comparer)?;
    let neighbors: Vec<Vec<usize>> = validation
        .iter()
        .map(|(keyframe, _)| training.views.neighbors(keyframe))
        .collect();
    // Gains of the validation keyframe itself would be fitted to the image on which they are
    // scored. Gains of its neighbors predict its gains only if the exposure really changes.
    let mut known = LogGains::new();
    let neighbor_ixs = neighbors.iter().flatten().copied().collect();
    add_gains(training, &comparer, &mut known, neighbor_ixs)?;
    // The mean over all images is subtracted, because it is an error of the model's brightness.
    let mean = [0, 1, 2].map(|color| mean_gain(&known, color));
    let mut baseline_db = Vec::new();
    let mut variant_db = Vec::new();
    for ((keyframe, products), neighbors) in validation.iter().zip(&neighbors) {
        let mut neighbor_gains: BTreeMap<i64, [f64; 3]> = BTreeMap::new();
        for view_ix in neighbors {
            if let Some(gains) = known.get(view_ix) {
                let stamp = training.views.keyframe(*view_ix).stamp.0;
                let relative = [0, 1, 2].map(|color| gains[color] - mean[color]);
                neighbor_gains.insert(stamp, relative);
            }
        }
        let gains = interpolate(&neighbor_gains, keyframe.stamp)
            .unwrap_or_default()
            .map(f64::exp);
        baseline_db.extend(products::psnr_with_gains(products, [1.0; 3]));
        variant_db.extend(products::psnr_with_gains(products, gains));
    }
    match trials.decide_gains(&baseline_db, &variant_db) {
        Some(gains) => {
            let initial = InitialGains {
                known,
                mean,
                first_ix: 0,
            };
            enable_gains(training, trials, gains, initial)
        }
        None => Ok(()),
    }
}

/// The views whose gains are initialized when gains are enabled.
struct InitialGains {
    /// Gains that are already computed.
    known: LogGains,
    /// The mean gains, to which the initial values are relative.
    mean: [f64; 3],
    /// The first view to initialize, besides the views in `known`.
    first_ix: usize,
}

/// Optimizes image gains from now on. They start with the gains that best match pictures to images.
fn enable_gains(
    training: &mut Training,
    trials: &SplatTrials,
    gains: ParamSet,
    InitialGains {
        mut known,
        mean,
        first_ix,
    }: InitialGains,
) -> Result<(), Error> {
    // The comparer is created before gains are enabled, because the pictures for the initial gains
    // must not have gains.
    let comparer = Comparer::new(training, trials)?;
    training.model.cameras.enable(gains);
    // Assigns the slots that the gains are written to.
    training.prepare_model()?;
    let view_ixs = (first_ix..training.views.len()).collect();
    add_gains(training, &comparer, &mut known, view_ixs)?;
    for (view_ix, gains) in &known {
        let log_gains = [0, 1, 2].map(|color| gains[color] - mean[color]);
        let keyframe = training.views.keyframe(*view_ix);
        training
            .model
            .cameras
            .initialize_gains(&training.recorder.gpu, keyframe, log_gains);
    }
    Ok(())
}

/// Adds a training keyframe that arrives at the current step. If image gains are watched for or
/// optimized, compares the keyframe with the picture before training on it. During a trial, or
/// if memory is too small for the picture, the keyframe is added without a comparison.
pub(super) fn add_live_arrival(
    training: &mut Training,
    trials: &mut SplatTrials,
    keyframe: Arc<Keyframe>,
) -> Result<(), Error> {
    // Before the first trial, the model is too coarse for a comparison. During a trial, the
    // change must not depend on which half is in training.
    let is_watched = trials.watches_gains();
    let is_compared = is_watched || training.model.cameras.set.contains(ParamSet::IMAGE_GAINS);
    if !is_compared
        || training.schedule.step < trials.steps.first_trial
        || trials.running_trial().is_some()
    {
        return training.add_arrival(keyframe);
    }
    let comparer = Comparer::new(training, trials)?;
    let products = match comparer.compare_with_upload(training, &keyframe) {
        Err(error) if error.is_out_of_memory() => return training.add_arrival(keyframe),
        products => products?,
    };
    let log_gains = products::log_gains(&products);
    training.add_arrival(keyframe.clone())?;
    // While gains are only watched for, they are not optimized, so there is nothing to initialize.
    if is_watched {
        let psnr = |gains| products::psnr_with_gains(&products, gains);
        let needed = trials.add_arrival_gains(&keyframe, log_gains, psnr);
        // The model still has the brightness of earlier views, which need no gains. The latest
        // views include the views after the change of exposure.
        let initial = InitialGains {
            known: LogGains::new(),
            mean: [0.0; 3],
            first_ix: training.views.len().saturating_sub(MAX_NEW_EXPOSURES),
        };
        return needed.map_or(Ok(()), |gains| {
            enable_gains(training, trials, gains, initial)
        });
    }
    // Without initial gains, training would need many steps on this image to reach them. Until
    // then, the brightness of the image would change the model.
    training
        .views
        .assign_lenses(&training.recorder.gpu, &mut training.model.cameras)?;
    training
        .model
        .cameras
        .initialize_gains(&training.recorder.gpu, &keyframe, log_gains);
    Ok(())
}

/// For each view that `known` does not contain yet, adds the gains that best match the picture of
/// the view to its image.
fn add_gains(
    training: &mut Training,
    comparer: &Comparer,
    known: &mut LogGains,
    view_ixs: BTreeSet<usize>,
) -> Result<(), Error> {
    let unknown: Vec<usize> = view_ixs
        .into_iter()
        .filter(|view_ix| !known.contains_key(view_ix))
        .collect();
    // Views are processed in chunks. Images are downscaled and uploaded in parallel, but on a
    // software adapter, not all of them fit into memory.
    for chunk in unknown.chunks(VIEWS_AT_ONCE) {
        let places = chunk.iter().map(|view_ix| (*view_ix, 0)).collect();
        training
            .views
            .upload(&mut training.recorder, &places, training.schedule.step)?;
        for view_ix in chunk {
            let products = comparer.compare_view(training, *view_ix)?;
            known.insert(*view_ix, products::log_gains(&products));
        }
    }
    Ok(())
}

/// Mean of the logarithms of the gains of one color over all views.
fn mean_gain(known: &LogGains, color: usize) -> f64 {
    known.values().map(|gains| gains[color]).sum::<f64>() / known.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::splat::SplatTrainer;
    use crate::splat::training_tests::{n_keyframes, options, train};
    use crate::test_scenes::calibrated_camera;
    use calibration::CameraRefinement;
    use gpu::Gpu;
    use gpu::testing::test_gpu;

    const GAINS: ParamSet = ParamSet::IMAGE_GAINS;

    fn trained(keyframes: &[Arc<Keyframe>], gpu: Arc<Gpu>, n_steps: u64) -> SplatTrainer {
        let options = options().with(|options| {
            options.common.cameras = CameraRefinement::Try(vec![GAINS]);
            options.common.n_planned_steps = 1000;
        });
        let mut trainer = SplatTrainer::new(gpu, options).unwrap();
        for keyframe in keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, n_steps);
        trainer
    }

    /// Darkens the second half of the images by one stop.
    fn with_exposure_step(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
        let darken = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
            let mut rgba = keyframe.rgba_srgb.to_vec();
            if ix >= keyframes.len() / 2 {
                rgba.as_chunks_mut::<4>()
                    .0
                    .iter_mut()
                    .for_each(|pixel| pixel[..3].iter_mut().for_each(|color| *color /= 2));
            }
            Arc::new(Keyframe {
                rgba_srgb: rgba.into(),
                ..keyframe.as_ref().clone()
            })
        };
        keyframes.iter().enumerate().map(darken).collect()
    }

    #[test]
    fn gains_are_learned_only_if_exposure_changes() {
        let gpu = test_gpu();
        let even = n_keyframes(&gpu, 36, true);
        let trainer = trained(&even, gpu.clone(), 510);
        assert!(
            trainer.trials().len() == 1 && !trainer.trials()[0].kept,
            "{:?}",
            trainer.trials()
        );
        let stepped = with_exposure_step(&even);
        let mut trainer = trained(&stepped, gpu, 700);
        assert!(
            trainer.trials()[0].kept && trainer.trials()[0].gain_db > 1.0,
            "{:?}",
            trainer.trials()
        );
        let gains = |trainer: &mut SplatTrainer, ix: usize| {
            calibrated_camera(trainer, &stepped[ix]).gains[1]
        };
        // Only images near the exposure step show parts of the scene that were captured with both
        // exposures.
        let ratio = gains(&mut trainer, 17) / gains(&mut trainer, 18);
        assert!((1.6..2.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn gains_are_learned_once_arriving_keyframes_show_a_change_of_exposure() {
        const FIRST_TRIAL: u64 = 250;
        let gpu = test_gpu();
        let even = n_keyframes(&gpu, 36, true);
        let watching = options().with(|options| {
            options.common.cameras = CameraRefinement::AlwaysAndWatch(ParamSet::empty(), GAINS);
            options.common.n_planned_steps = 1000;
            options.specific.trial_steps.first_trial = FIRST_TRIAL;
        });
        let trained_live = |keyframes: &[Arc<Keyframe>]| {
            let mut trainer = SplatTrainer::new(gpu.clone(), watching.clone()).unwrap();
            let (first, later) = keyframes.split_at(keyframes.len() / 2 - 3);
            first
                .iter()
                .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
            train(&mut trainer, FIRST_TRIAL);
            for keyframe in later {
                trainer.push(keyframe.clone()).unwrap();
                train(&mut trainer, 5);
            }
            trainer
        };
        let trainer = trained_live(&even);
        assert!(trainer.trials().is_empty(), "{:?}", trainer.trials());
        let stepped = with_exposure_step(&even);
        let mut trainer = trained_live(&stepped);
        assert!(
            trainer.trials().len() == 1 && trainer.trials()[0].kept,
            "{:?}",
            trainer.trials()
        );
        train(&mut trainer, 100);
        let gains = |trainer: &mut SplatTrainer, ix: usize| {
            calibrated_camera(trainer, &stepped[ix]).gains[1]
        };
        let ratio = gains(&mut trainer, 17) / gains(&mut trainer, 19);
        assert!((1.4..2.6).contains(&ratio), "{ratio}");
    }
}
