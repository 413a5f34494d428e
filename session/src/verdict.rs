//! The verdict on a result in one sentence, for the page, the terminal and reports.

use messages::listed;
use serde_json::Value;
use viz::{Grade, Verdict};

/// Minimum PSNR of a good model, dB. Its pictures differ from photos by 8 of 255 gray levels (RMS),
/// which is hardly visible. Splats reach 29 dB on the indoor scenes of Deep Blending, but only 24 dB
/// on the outdoor scenes of Tanks and Temples (Kerbl et al. 2023, table 1).
const GOOD_DB: f64 = 30.0;
/// Minimum PSNR of a fair model, dB. At this PSNR, pictures differ from photos by 16 gray levels
/// (RMS), twice as much as for a good model. Shapes are in place, but details are blurred. Below
/// this PSNR, poses or lens are often wrong.
pub(crate) const FAIR_DB: f64 = 24.0;
/// Minimum fraction of lost images that verdicts and reports mention. Cameras drop single images now and
/// then, which the next image replaces.
const MIN_LOST_FRAC: f64 = 0.05;

/// The score of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelScore<'a> {
    /// Name of the method.
    pub method: &'a str,
    /// Mean PSNR over the test images, dB; `None` if it was not scored.
    pub psnr_db: Option<f64>,
}

/// What a verdict depends on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Findings<'a> {
    /// The models that were saved.
    pub models: Vec<ModelScore<'a>>,
    /// Number of test images.
    pub n_tests: usize,
    /// Number of images that were received; 0 if it is not known.
    pub n_received: u64,
    /// Number of images that devices or queues dropped before they were received.
    pub n_lost: u64,
}

/// Judges a result. The best model determines the grade.
#[must_use]
pub fn verdict(findings: &Findings<'_>) -> Verdict {
    let (grade, mut text) = judge_scores(findings);
    if let Some(lost) = describe_lost(findings) {
        text = format!("{text}; {lost}");
    }
    Verdict { grade, text }
}

/// The verdict on a saved model, from its `report.json`; `None` without a report.
#[must_use]
pub fn of_report(report: &Value) -> Option<Verdict> {
    let done = report["done"].as_object()?;
    let loss = ImageLoss::of_report(report);
    let method = done.get("method").and_then(Value::as_str);
    Some(verdict(&Findings {
        models: vec![ModelScore {
            method: method.unwrap_or_default(),
            psnr_db: done.get("psnr").and_then(Value::as_f64),
        }],
        n_tests: report["per_image"].as_array().map_or(0, Vec::len),
        n_received: loss.n_received,
        n_lost: loss.n_lost,
    }))
}

/// How many color images of a run were received, and how many were dropped before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ImageLoss {
    pub(crate) n_received: u64,
    pub(crate) n_lost: u64,
}

impl ImageLoss {
    /// The images according to `report.json`.
    pub(crate) fn of_report(report: &Value) -> Self {
        let count = |key: &str| report[key].as_u64();
        let rejected = report["rejected"].as_object();
        let n_rejected: u64 = rejected
            .into_iter()
            .flat_map(|reasons| reasons.values())
            .filter_map(Value::as_u64)
            .sum();
        let accepted = ["keyframes", "evicted"].into_iter().filter_map(count);
        // Older reports have no count of the color images alone.
        let n_lost = count("color_skipped").or_else(|| count("device_skipped"));
        Self {
            n_received: accepted.sum::<u64>() + n_rejected,
            n_lost: n_lost.unwrap_or_default(),
        }
    }

    /// Number of images that the cameras have taken.
    pub(crate) fn n_sent(self) -> u64 {
        self.n_received + self.n_lost
    }

    /// Fraction of the images that were lost; `None` if they are too few to mention.
    pub(crate) fn noticeable_frac(self) -> Option<f64> {
        let lost_frac = self.n_lost as f64 / self.n_sent() as f64;
        // Without images, the fraction is NaN, which is not enough either.
        (lost_frac >= MIN_LOST_FRAC).then_some(lost_frac)
    }
}

fn judge_scores(findings: &Findings<'_>) -> (Grade, String) {
    if findings.models.is_empty() {
        return (Grade::Unknown, "No model was saved".to_owned());
    }
    if findings.n_tests == 0 {
        let text = "Not scored, because there are no test images";
        return (Grade::Unknown, text.to_owned());
    }
    // NaN cannot be judged. Scores are rounded, so that the grade agrees with the number that is
    // shown.
    let scored: Vec<(&str, f64)> = findings
        .models
        .iter()
        .filter_map(|model| Some((model.method, model.psnr_db.filter(|psnr| !psnr.is_nan())?)))
        .map(|(method, psnr_db)| (method, (10.0 * psnr_db).round() / 10.0))
        .collect();
    let Some(best_db) = scored.iter().map(|(_, psnr_db)| *psnr_db).reduce(f64::max) else {
        return (Grade::Unknown, "Not scored".to_owned());
    };
    let (grade, word) = if best_db >= GOOD_DB {
        (Grade::Good, "Good")
    } else if best_db >= FAIR_DB {
        (Grade::Fair, "Fair")
    } else {
        (Grade::Poor, "Poor")
    };
    let scores: Vec<String> = match &*scored {
        [(_, psnr_db)] => vec![format!("{psnr_db:.1} dB")],
        several => several
            .iter()
            .map(|(method, psnr_db)| format!("{psnr_db:.1} dB ({method})"))
            .collect(),
    };
    let scores: Vec<&str> = scores.iter().map(String::as_str).collect();
    let tests = messages::counted(findings.n_tests as u64, "test image");
    (
        grade,
        format!("{word}: {} on {tests}", listed(&scores, "and")),
    )
}

fn describe_lost(findings: &Findings<'_>) -> Option<String> {
    let loss = ImageLoss {
        n_received: findings.n_received,
        n_lost: findings.n_lost,
    };
    loss.noticeable_frac()
        .map(|lost_frac| format!("{:.0} % of the images were lost", 100.0 * lost_frac))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn scores<'a>(models: &[(&'a str, Option<f64>)]) -> Vec<ModelScore<'a>> {
        let score = |(method, psnr_db): &(&'a str, Option<f64>)| ModelScore {
            method,
            psnr_db: *psnr_db,
        };
        models.iter().map(score).collect()
    }

    #[test]
    fn verdict_names_grade_score_and_losses() {
        let splat = |psnr_db| vec![("splat", Some(psnr_db))];
        let cases: [(_, usize, [u64; 2], Grade, &str); 10] = [
            (
                splat(31.24),
                12,
                [2653, 18_343],
                Grade::Good,
                "Good: 31.2 dB on 12 test images; 87 % of the images were lost",
            ),
            (
                splat(29.96),
                12,
                [100, 5],
                Grade::Good,
                "Good: 30.0 dB on 12 test images",
            ),
            (
                splat(29.94),
                1,
                [95, 5],
                Grade::Fair,
                "Fair: 29.9 dB on 1 test image; 5 % of the images were lost",
            ),
            (
                splat(23.9),
                3,
                [0, 0],
                Grade::Poor,
                "Poor: 23.9 dB on 3 test images",
            ),
            (
                vec![("splat", Some(26.6)), ("tsdf", Some(18.04))],
                9,
                [9, 0],
                Grade::Fair,
                "Fair: 26.6 dB (splat) and 18.0 dB (tsdf) on 9 test images",
            ),
            (
                vec![("splat", Some(f64::NAN)), ("tsdf", Some(24.0))],
                9,
                [9, 0],
                Grade::Fair,
                "Fair: 24.0 dB on 9 test images",
            ),
            (
                vec![("nerf", None)],
                9,
                [9, 0],
                Grade::Unknown,
                "Not scored",
            ),
            (
                splat(f64::INFINITY),
                2,
                [9, 0],
                Grade::Good,
                "Good: inf dB on 2 test images",
            ),
            (
                splat(31.0),
                0,
                [9, 9],
                Grade::Unknown,
                "Not scored, because there are no test images; 50 % of the images were lost",
            ),
            (vec![], 0, [0, 0], Grade::Unknown, "No model was saved"),
        ];
        for (models, n_tests, [n_received, n_lost], grade, text) in cases {
            let found = verdict(&Findings {
                models: scores(&models),
                n_tests,
                n_received,
                n_lost,
            });
            assert_eq!((found.grade, &*found.text), (grade, text));
        }
    }

    #[test]
    fn saved_model_has_the_verdict_of_its_run() {
        let report = json!({
            "done": { "method": "splat", "psnr": 31.24, "seconds": 8.0 },
            "keyframes": 400, "evicted": 1532, "rejected": { "blurred": 700, "not_moved": 21 },
            "device_skipped": 18_343, "per_image": [{}, {}],
        });
        let found = of_report(&report).expect("a report");
        let expected = "Good: 31.2 dB on 2 test images; 87 % of the images were lost";
        assert_eq!((found.grade, &*found.text), (Grade::Good, expected));
        assert_eq!(of_report(&Value::Null), None);
        let of_dataset = json!({ "done": { "psnr": 25.0 }, "per_image": [{}] });
        let text = of_report(&of_dataset).expect("a report").text;
        assert_eq!(text, "Fair: 25.0 dB on 1 test image");
    }
}
