//! The most likely cause of a poor result, and what to do about it, from the figures in the report.

use crate::advice::{self, ImageFlow};
use crate::verdict::{FAIR_DB, ImageLoss};
use messages::{Setting, counted};
use serde_json::Value;
use std::collections::BTreeMap;
use trainer::ModelKind;

/// With fewer images, large parts of a scene are seen once or never. A scan of a table needs about
/// 60 keyframes.
const MIN_KEYFRAMES: u64 = 30;
/// Splats and neural fields reach their level after some thousand steps. Before this many, the step count
/// alone explains a poor result.
const MIN_STEPS: u64 = 1000;
/// A PSNR that rises faster than this has not reached its level, dB per doubling of the time.
const MIN_RISE_DB: f64 = 0.5;
/// Range of the times, relative to the end, of the evaluation with which the end is compared. A
/// later one is too close to the end, and an earlier one has too little in common with it.
const COMPARED_FRAC: std::ops::RangeInclusive<f64> = 0.2..=0.75;
/// Minimum difference between the quartiles of the test images for which a scene counts as unevenly
/// covered, dB. A uniformly wrong calibration spreads them by 2 to 3 dB.
const MIN_SPREAD_DB: f64 = 5.0;
/// Minimum number of test images whose quartiles mean something.
const MIN_TESTS: usize = 4;

/// The checks in the order in which they are made. A cause can only be recognized if the causes
/// before it are absent.
const CHECKS: [fn(&Figures) -> Option<String>; 4] =
    [few_keyframes, few_steps, useless_images, uneven_coverage];

/// The figures of a report on which the cause depends.
struct Figures {
    kind: Option<ModelKind>,
    seconds: f64,
    steps: u64,
    psnr_db: f64,
    /// Time and PSNR of the evaluations during training.
    evaluations: Vec<[f64; 2]>,
    /// PSNR of the test images in ascending order.
    tests_db: Vec<f64>,
    /// Images that train the model or test it; `None` if the report has no count.
    n_keyframes: Option<u64>,
    images: ImageFlow,
    is_software: bool,
    /// The command that continues the run; `None` if it has no checkpoint.
    resume_command: Option<String>,
    /// Whether errors of the calibration were estimated.
    is_calibrated: bool,
}

/// The likely cause and its remedy, in one or two sentences without the last period. `None` if the
/// result is not poor, or was not scored.
///
/// * `report`: the content of `report.json`.
pub(crate) fn of_report(report: &Value) -> Option<String> {
    // The PSNR is rounded as in the verdict.
    let is_poor = |figures: &Figures| (10.0 * figures.psnr_db).round() < 10.0 * FAIR_DB;
    let figures = Figures::of(report).filter(is_poor)?;
    let found = CHECKS.iter().find_map(|check| check(&figures));
    Some(found.unwrap_or_else(|| wrong_calibration(&figures)))
}

impl Figures {
    fn of(report: &Value) -> Option<Self> {
        let done = &report["done"];
        let number = |value: &Value, key: &str| value[key].as_f64();
        let list = |key: &str| report[key].as_array().map_or(&[][..], Vec::as_slice);
        let evaluations = list("evaluations").iter().filter_map(|evaluation| {
            Some([number(evaluation, "seconds")?, number(evaluation, "psnr")?])
        });
        let mut tests_db: Vec<f64> = list("per_image")
            .iter()
            .filter_map(|image| number(image, "psnr"))
            .collect();
        tests_db.sort_by(f64::total_cmp);
        let count = |key: &str| report[key].as_u64();
        let adapter = report["adapter"].as_str().unwrap_or_default();
        Some(Self {
            kind: done["method"].as_str().and_then(ModelKind::from_name),
            seconds: number(done, "seconds")?,
            steps: done["steps"].as_u64()?,
            psnr_db: number(done, "psnr")?,
            evaluations: evaluations.collect(),
            tests_db,
            // `train` counts the images of each split, and `run` all keyframes.
            n_keyframes: count("keyframes").or_else(|| count("n_train")),
            images: images(report),
            is_software: adapter.contains("(Cpu, "),
            resume_command: report["resume_command"].as_str().map(str::to_owned),
            is_calibrated: !report["alignment"].is_null()
                || report["cameras"]
                    .as_object()
                    .is_some_and(|all| !all.is_empty()),
        })
    }

    /// Whether the model is optimized step by step. A TSDF fuses each image once.
    fn is_optimized(&self) -> bool {
        self.kind.is_none_or(|kind| kind.name() != "tsdf")
    }

    /// By how much the PSNR rose at last, per doubling of the training time.
    fn rise_db(&self) -> Option<f64> {
        let compared = self
            .evaluations
            .iter()
            .rev()
            .find(|[secs, _]| COMPARED_FRAC.contains(&(secs / self.seconds)));
        let [secs, psnr_db] = compared?;
        Some((self.psnr_db - psnr_db) / (self.seconds / secs).log2())
    }
}

/// The color images of a run. Images that were dropped because the computer was slow are replaced by
/// later ones, so they count only as long as there are few.
fn images(report: &Value) -> ImageFlow {
    let loss = ImageLoss::of_report(report);
    let rejected: BTreeMap<String, u64> = report["rejected"]
        .as_object()
        .into_iter()
        .flatten()
        .filter_map(|(why, n)| Some((why.clone(), n.as_u64()?)))
        .collect();
    ImageFlow {
        received: loss.n_received,
        dropped: loss.n_lost,
        accepted: loss.n_received.saturating_sub(rejected.values().sum()),
        rejected,
    }
}

fn few_keyframes(figures: &Figures) -> Option<String> {
    let n = figures.n_keyframes.filter(|n| *n < MIN_KEYFRAMES)?;
    let remedy = advice::problem(&figures.images).unwrap_or_else(|| {
        "Scan for longer: move the camera around the scene, and look at it from all sides"
            .to_owned()
    });
    Some(format!(
        "too few images: {}. {remedy}",
        counted(n, "keyframe")
    ))
}

fn few_steps(figures: &Figures) -> Option<String> {
    let rise_db = figures.rise_db().filter(|rise_db| *rise_db >= MIN_RISE_DB);
    let is_early = figures.steps < MIN_STEPS || rise_db.is_some();
    if !is_early || !figures.is_optimized() {
        return None;
    }
    let rise = rise_db.map_or(String::new(), |rise_db| {
        format!(", and the PSNR still rose by {rise_db:.1} dB per doubling of the time")
    });
    let without_gpu = if figures.is_software {
        " without a GPU"
    } else {
        ""
    };
    Some(format!(
        "too few steps: {} in {:.0} s{without_gpu}{rise}. {}",
        counted(figures.steps, "step"),
        figures.seconds,
        longer_training(figures)
    ))
}

/// How to train for longer.
fn longer_training(figures: &Figures) -> String {
    let time = format!("{} {:.0}", Setting::Seconds, longer_secs(figures.seconds));
    match &figures.resume_command {
        Some(command) => format!("Train for longer: `{command} {time}` continues the run"),
        None => format!("Train for longer, for example with {time}"),
    }
}

/// Twice the time or more, in whole minutes.
fn longer_secs(secs: f64) -> f64 {
    60.0 * (2.0 * secs / 60.0).ceil().max(1.0)
}

fn useless_images(figures: &Figures) -> Option<String> {
    let recorded = ImageFlow {
        dropped: 0,
        ..figures.images.clone()
    };
    let problem = advice::problem(&recorded)?;
    let n_rejected: u64 = recorded.rejected.values().sum();
    Some(format!(
        "useless images: {n_rejected} of {} became no keyframe. {problem}",
        recorded.received
    ))
}

fn uneven_coverage(figures: &Figures) -> Option<String> {
    let tests_db = &figures.tests_db;
    let quartile_db = |quarters: usize| tests_db[(tests_db.len() - 1) * quarters / 4];
    let is_uneven = tests_db.len() >= MIN_TESTS
        && quartile_db(3) >= FAIR_DB
        && quartile_db(3) - quartile_db(1) >= MIN_SPREAD_DB;
    is_uneven.then(|| {
        let n_poor = tests_db.partition_point(|psnr_db| *psnr_db < FAIR_DB);
        format!(
            "uneven coverage: {n_poor} of {} test images have less than {FAIR_DB:.0} dB, and the others reach {:.1} dB. Scan \
             the places of the poor ones from more sides: report.html shows them",
            tests_db.len(),
            tests_db[tests_db.len() - 1]
        )
    })
}

/// If nothing else explains the result, poses or lenses are probably wrong.
fn wrong_calibration(figures: &Figures) -> String {
    let range = match figures.tests_db[..] {
        [first, .., last] => format!("all test images have {first:.1} to {last:.1} dB"),
        _ => format!("{:.1} dB", figures.psnr_db),
    };
    let remedy = if figures.is_calibrated {
        "The corrections that were found are in report.html. Calibrate with a target: docs/guide/calibration.md"
            .to_owned()
    } else {
        format!(
            "Its errors were not estimated: {} auto estimates them. To measure it, see docs/guide/calibration.md",
            Setting::Refine
        )
    };
    format!(
        "a wrong calibration (camera pose, lens, time offset or URDF), or a scene that moves: after {} on {}, {range}. {remedy}",
        counted(figures.steps, "step"),
        figures
            .n_keyframes
            .map_or("all images".to_owned(), |n| counted(n, "image")),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// A report on a run whose model has converged with this PSNR.
    fn report(psnr_db: f64) -> Value {
        json!({
            "done": { "method": "splat", "psnr": psnr_db, "seconds": 60.0, "steps": 9000 },
            "evaluations": [{ "seconds": 16.0, "psnr": psnr_db }, { "seconds": 32.0, "psnr": psnr_db }],
            "per_image": [
                { "psnr": psnr_db - 1.0 }, { "psnr": psnr_db }, { "psnr": psnr_db + 0.5 }, { "psnr": psnr_db + 0.5 }
            ],
            "adapter": "NVIDIA H200 (DiscreteGpu, Vulkan)", "keyframes": 200, "evicted": 0,
            "rejected": { "not_moved": 700 }, "color_skipped": 300, "alignment": null, "cameras": null,
        })
    }

    fn cause(change: impl FnOnce(&mut Value)) -> String {
        let mut report = report(20.0);
        change(&mut report);
        of_report(&report).expect("a poor result")
    }

    #[test]
    fn only_poor_results_have_a_cause() {
        assert_eq!(of_report(&report(24.0)), None);
        assert_eq!(of_report(&Value::Null), None);
        let unscored =
            json!({ "done": { "method": "splat", "psnr": null, "seconds": 1.0, "steps": 1 } });
        assert_eq!(of_report(&unscored), None);
    }

    #[test]
    fn few_keyframes_come_with_the_reason_why_there_are_few() {
        let text = cause(|report| report["keyframes"] = 9.into());
        assert!(
            text.starts_with("too few images: 9 keyframes. Scan for longer"),
            "{text}"
        );
        let text = cause(|report| {
            report["keyframes"] = 9.into();
            report["rejected"] = json!({ "blur": 80 });
            report["color_skipped"] = 0.into();
        });
        assert!(
            text.contains("9 keyframes. Most images are blurred by motion: move more slowly"),
            "{text}"
        );
    }

    #[test]
    fn models_that_still_improve_need_more_steps() {
        let text = cause(|report| {
            report["done"]["steps"] = 270.into();
            report["adapter"] = "llvmpipe (LLVM 15.0.6, 256 bits) (Cpu, Vulkan, llvmpipe)".into();
        });
        assert_eq!(
            text,
            "too few steps: 270 steps in 60 s without a GPU. Train for longer, for example with seconds 120"
        );
        let text = cause(|report| {
            report["done"]["steps"] = 270.into();
            report["resume_command"] = "fieldrig run 'my rig.toml' resume out".into();
        });
        assert_eq!(
            text,
            "too few steps: 270 steps in 60 s. Train for longer: `fieldrig run 'my rig.toml' resume out seconds 120` \
             continues the run"
        );
        let text = cause(|report| report["evaluations"][1]["psnr"] = 18.0.into());
        assert!(
            text.contains("9000 steps in 60 s, and the PSNR still rose by 2.2 dB per doubling"),
            "{text}"
        );
        // A TSDF has no optimizer.
        let text = cause(|report| {
            report["done"]["method"] = "tsdf".into();
            report["done"]["steps"] = 200.into();
        });
        assert!(text.starts_with("a wrong calibration"), "{text}");
    }

    #[test]
    fn rejected_images_are_a_cause_although_there_are_enough() {
        let text = cause(|report| report["rejected"] = json!({ "shear": 500 }));
        assert!(
            text.starts_with(
                "useless images: 500 of 700 became no keyframe. Most images are blurred"
            ),
            "{text}"
        );
    }

    #[test]
    fn places_that_are_missing_are_told_from_a_wrong_calibration() {
        let text = cause(|report| {
            report["per_image"] = json!([{ "psnr": 12.0 }, { "psnr": 14.0 }, { "psnr": 15.0 }, { "psnr": 27.0 }, { "psnr": 28.0 }]);
        });
        assert!(
            text.starts_with("uneven coverage: 3 of 5 test images have less than 24 dB, and the others reach 28.0 dB"),
            "{text}"
        );
        let text = cause(|_| ());
        assert!(
            text.contains("after 9000 steps on 200 images, all test images have 19.0 to 20.5 dB. Its errors were not estimated"),
            "{text}"
        );
        let text = cause(|report| report["alignment"] = json!({ "corrections": {} }));
        assert!(text.contains("Calibrate with a target"), "{text}");
    }
}
