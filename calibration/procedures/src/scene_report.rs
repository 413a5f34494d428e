//! Report of a calibration from a static scene.

use calibration::{Estimate, PoseEstimate, PoseSigmas, ScalarEstimate, Trial};
use capture::config::Rig;
use kinematics::Transform;
use report::calibration_report::page::{self, Page};
use report::calibration_report::{Heading, with_sigma};
use session::SceneCalibration;

/// Contents of the report.
#[derive(Clone, Debug)]
pub(crate) struct SceneReport<'a> {
    /// Input, verdict and warnings.
    pub(crate) heading: &'a Heading,
    /// The rig before the calibration, if there is one.
    pub(crate) rig: Option<&'a Rig>,
    /// Names of the cameras and the number of images of each.
    pub(crate) n_images: &'a [(String, usize)],
    /// The result. `None` if the data are not sufficient.
    pub(crate) calibration: Option<&'a SceneCalibration>,
}

impl SceneReport<'_> {
    /// The page.
    pub(crate) fn html(&self) -> String {
        let verdict = self.calibration.map_or(String::new(), verdict);
        let mut page = Page::new(
            "Calibration from a static scene",
            self.heading,
            &verdict,
            &self.figures(),
        );
        if let Some(calibration) = self.calibration {
            self.add_corrections(&mut page, calibration);
        }
        page.table(
            "Cameras",
            &["camera", "images", "accepted gain, dB", "extrinsics"],
            self.n_images
                .iter()
                .map(|(name, n_images)| self.camera(name, *n_images))
                .collect(),
        );
        if let Some(calibration) = self.calibration {
            self.add_poses(&mut page, calibration);
        }
        page.finish()
    }

    fn figures(&self) -> Vec<page::Figure> {
        let n_images: usize = self.n_images.iter().map(|(_, n)| n).sum();
        let mut figures: Vec<page::Figure> = vec![
            ("images", n_images.to_string(), ""),
            ("cameras", self.n_images.len().to_string(), ""),
        ];
        let Some(calibration) = self.calibration else {
            return figures;
        };
        let alignment = &calibration.alignment;
        figures.push(("pairs of images", alignment.n_pairs.to_string(), ""));
        figures.push((
            "accepted corrections",
            alignment.estimates.len().to_string(),
            "",
        ));
        // Each trial is compared with the result of all earlier trials, so the gains can be added.
        let gains_db: Vec<f64> = alignment
            .trials
            .iter()
            .filter(|trial| trial.kept)
            .map(|trial| trial.gain_db)
            .collect();
        if !gains_db.is_empty() {
            figures.push((
                "gain on validation images",
                format!("{:+.2}", gains_db.iter().sum::<f64>()),
                "dB",
            ));
        }
        figures
    }

    /// Adds the tables of corrections, and of the trials by which corrections were accepted or
    /// rejected.
    fn add_corrections(&self, page: &mut Page, calibration: &SceneCalibration) {
        let alignment = &calibration.alignment;
        let corrections: Vec<Vec<String>> = alignment
            .estimates
            .iter()
            .flat_map(|of| self.rows(of))
            .collect();
        page.table(
            "Corrections",
            &["parameter", "value ± standard deviation", "direction"],
            corrections,
        );
        let head = [
            "tested parameters",
            "gain on validation images, dB",
            "by camera, dB",
            "images",
            "decision",
        ];
        page.table(
            "Trials",
            &head,
            alignment.trials.iter().map(trial).collect(),
        );
    }

    /// Adds the tables of poses and of their uncertainty.
    fn add_poses(&self, page: &mut Page, calibration: &SceneCalibration) {
        let unobservable = calibration
            .alignment
            .unobservable
            .iter()
            .map(|direction| vec![direction.to_string()]);
        page.table(
            "Unobservable directions",
            &["combination"],
            unobservable.collect(),
        );
        page.table("Poses of the cameras", &POSE_HEAD, self.poses(calibration));
        page.table(
            "Standard deviations of the poses",
            &SIGMA_HEAD,
            self.sigmas(calibration),
        );
        page.table(
            "Relative camera poses",
            &POSE_HEAD,
            self.relative_poses(calibration),
        );
    }

    /// The row of a camera with its number of images, the accepted gain, and whether the camera was
    /// corrected.
    fn camera(&self, name: &str, n_images: usize) -> Vec<String> {
        let refused = self
            .calibration
            .and_then(|calibration| calibration.refused.get(name));
        let state = match (refused, self.calibration) {
            (Some(reason), _) => format!("kept: {reason}"),
            (None, Some(calibration)) if is_corrected(calibration, name) => "corrected".to_owned(),
            (None, Some(_)) => "not changed".to_owned(),
            (None, None) => "–".to_owned(),
        };
        let kept = self
            .calibration
            .iter()
            .flat_map(|calibration| &calibration.alignment.trials);
        let gains_db: Vec<f64> = kept
            .filter(|trial| trial.kept)
            .filter_map(|trial| trial.gain_by_camera_db.get(name).copied())
            .collect();
        let gain = if gains_db.is_empty() {
            "–".to_owned()
        } else {
            format!("{:+.2}", gains_db.iter().sum::<f64>())
        };
        vec![name.to_owned(), n_images.to_string(), gain, state]
    }

    /// Poses relative to the parents, before and after.
    fn poses(&self, calibration: &SceneCalibration) -> Vec<Vec<String>> {
        let (Some(before), Some(after)) = (self.rig, &calibration.rig) else {
            return Vec::new();
        };
        let both = before
            .cameras
            .iter()
            .zip(&after.cameras)
            .flat_map(|(before, after)| {
                [
                    pose(
                        format!("{} before, in the parent", &*before.name),
                        &before.parent_from_camera,
                    ),
                    pose(
                        format!("{} after, in the parent", &*after.name),
                        &after.parent_from_camera,
                    ),
                ]
            });
        both.collect()
    }

    /// Standard deviations of the camera poses, along and about the axes of the camera. The table
    /// lists the poses of the cameras relative to their parents, and then the poses of the cameras
    /// relative to each other.
    fn sigmas(&self, calibration: &SceneCalibration) -> Vec<Vec<String>> {
        let mut rows = Vec::new();
        for (name, _) in self.n_images {
            if let Some(sigmas) = calibration.sigmas(name) {
                rows.push(sigma_row(format!("{name} in its parent"), sigmas));
            }
            // Two cameras may be well determined relative to each other even if their common parent
            // is not.
            if let Some(relative) = calibration.relative(name)
                && let Some(sigmas) = relative.sigmas
            {
                rows.push(sigma_row(format!("{name} in {}", relative.first), sigmas));
            }
        }
        rows
    }

    fn relative_poses(&self, calibration: &SceneCalibration) -> Vec<Vec<String>> {
        let mut rows = Vec::new();
        for (name, _) in self.n_images {
            if let Some(relative) = calibration.relative(name) {
                let title = format!("{name} in {}", relative.first);
                rows.push(pose(title, &relative.first_from_camera));
            }
        }
        rows
    }

    fn rows(&self, estimate: &Estimate) -> Vec<Vec<String>> {
        match estimate {
            Estimate::HandEye(estimate) => {
                pose_rows(&format!("camera {}", estimate.camera), estimate)
            }
            Estimate::DepthPose(estimate) => {
                pose_rows(&format!("depth frame of {}", estimate.camera), estimate)
            }
            Estimate::TimeOffset(estimate) => vec![scalar("time offset", estimate, 1e3, "ms", 3)],
            Estimate::DepthScale(estimate) => vec![scalar("depth scale", estimate, 1e2, "%", 3)],
            Estimate::Readout(estimate) => vec![scalar("readout time", estimate, 1e3, "ms", 3)],
            Estimate::Joint {
                joint_ix,
                value,
                sigma,
                unobservable_frac,
            } => {
                let name = self
                    .rig
                    .and_then(|rig| rig.arm.joints.get(*joint_ix))
                    .map(ToString::to_string);
                let name = name.unwrap_or_else(|| joint_ix.to_string());
                let shared = format!(
                    "{:.0} % not separable from other parameters",
                    100.0 * unobservable_frac
                );
                vec![vec![
                    format!("offset of joint {name}"),
                    format!("{value:.5} ± {sigma:.5} rad or m"),
                    shared,
                ]]
            }
            Estimate::Lens {
                camera,
                focal_frac,
                focal_sigma,
                principal_offset_focals,
                principal_offset_sigma,
            } => {
                let mut rows = Vec::new();
                for (axis, letter) in ["x", "y"].into_iter().enumerate() {
                    let name = format!("focal length {letter} of {camera}");
                    rows.push(lens_row(name, focal_frac[axis], focal_sigma[axis]));
                }
                for (axis, letter) in ["x", "y"].into_iter().enumerate() {
                    let name = format!("principal point {letter} of {camera}");
                    let sigma = principal_offset_sigma[axis];
                    rows.push(lens_row(name, principal_offset_focals[axis], sigma));
                }
                rows
            }
            Estimate::ImagePoses {
                camera,
                n_images,
                rms_m,
                rms_rad,
            } => {
                let value = format!("{:.2} mm, {:.3}° RMS", 1e3 * rms_m, rms_rad.to_degrees());
                vec![vec![
                    format!("poses of {n_images} images of {camera}"),
                    value,
                    String::new(),
                ]]
            }
        }
    }
}

const POSE_HEAD: [&str; 3] = [
    "camera",
    "position (x, y, z), mm",
    "rotation (quaternion x, y, z, w)",
];
const SIGMA_HEAD: [&str; 3] = [
    "camera",
    "along its axes (x, y, z), mm",
    "about its axes (x, y, z), °",
];

/// What was decided, in one sentence.
fn verdict(calibration: &SceneCalibration) -> String {
    match calibration.alignment.estimates.len() {
        0 => "Nothing to correct: no parameter improves the prediction of validation images."
            .to_owned(),
        1 => "1 correction was accepted.".to_owned(),
        n => format!("{n} corrections were accepted."),
    }
}

/// Whether the extrinsics of a camera were corrected.
fn is_corrected(calibration: &SceneCalibration, camera: &str) -> bool {
    calibration.alignment.estimates.iter().any(
        |estimate| matches!(estimate, Estimate::HandEye(estimate) if estimate.camera == camera),
    )
}

/// A row of standard deviations along and about the axes of a camera.
fn sigma_row(name: String, sigmas: PoseSigmas) -> Vec<String> {
    let list = |values: [f64; 3]| values.map(|value| format!("{value:.3}")).join(", ");
    vec![
        name,
        list(sigmas.m.map(|m| 1e3 * m)),
        list(sigmas.rad.map(f64::to_degrees)),
    ]
}

/// A row of a lens parameter, whose value and deviation are fractions of the focal length.
fn lens_row(name: String, value_frac: f64, sigma_frac: f64) -> Vec<String> {
    let value = 1e2 * value_frac;
    let sigma = 1e2 * sigma_frac;
    vec![
        name,
        format!("{value:.3} ± {sigma:.3} % of the focal length"),
        String::new(),
    ]
}

fn pose(name: String, pose: &Transform) -> Vec<String> {
    let [x, y, z]: [f64; 3] = (1e3 * pose.translation.vector).into();
    let [qx, qy, qz, qw]: [f64; 4] = pose.rotation.coords.into();
    vec![
        name,
        format!("{x:.2}, {y:.2}, {z:.2}"),
        format!("{qx:.5}, {qy:.5}, {qz:.5}, {qw:.5}"),
    ]
}

fn pose_rows(what: &str, estimate: &PoseEstimate) -> Vec<Vec<String>> {
    let direction = |[x, y, z]: [f64; 3]| format!("({x:.2} {y:.2} {z:.2})");
    let deg = estimate.rotation_rad.to_degrees();
    let sigma_deg = estimate.rotation_sigma_rad.to_degrees();
    let mm = 1e3 * estimate.translation_m;
    let sigma_mm = 1e3 * estimate.translation_sigma_m;
    vec![
        vec![
            format!("rotation of {what}"),
            format!("{deg:.3} ± {sigma_deg:.3}°"),
            format!("about {}", direction(estimate.rotation_axis)),
        ],
        vec![
            format!("translation of {what}"),
            format!("{mm:.2} ± {sigma_mm:.2} mm"),
            format!("along {}", direction(estimate.translation_axis)),
        ],
    ]
}

fn scalar(
    what: &str,
    estimate: &ScalarEstimate,
    factor: f64,
    unit: &str,
    digits: usize,
) -> Vec<String> {
    let value = with_sigma(factor * estimate.value, factor * estimate.sigma, digits);
    vec![
        format!("{what} of {}", estimate.camera),
        format!("{value} {unit}"),
        String::new(),
    ]
}

fn trial(trial: &Trial) -> Vec<String> {
    let decision = if trial.kept {
        "accepted"
    } else {
        "not significant"
    };
    let by_camera = trial
        .gain_by_camera_db
        .iter()
        .map(|(camera, gain_db)| format!("{camera} {gain_db:+.2}"));
    vec![
        trial.candidate.to_string(),
        format!("{:+.2} ± {:.2}", trial.gain_db, trial.standard_error_db),
        by_camera.collect::<Vec<_>>().join(", "),
        trial.n_images.to_string(),
        decision.to_owned(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::{Alignment, Candidate, ParamSet};
    use std::collections::BTreeMap;

    #[test]
    fn corrections_trials_and_refused_cameras_are_listed() {
        let estimate = ScalarEstimate {
            camera: "<wrist>".to_owned(),
            value: 0.008,
            sigma: 2e-5,
        };
        let alignment = Alignment {
            estimates: vec![Estimate::TimeOffset(estimate)],
            trials: vec![
                Trial::of_gains(
                    Candidate::Cameras(ParamSet::TIME_OFFSET),
                    &[0.4, 0.5, 0.3, 0.45],
                )
                .with_cameras([("side", 0.4), ("side", 0.6)].into_iter()),
            ],
            ..Alignment::default()
        };
        let refused = BTreeMap::from([("side".to_owned(), "it does not turn".to_owned())]);
        let calibration = SceneCalibration {
            alignment,
            rig: None,
            refused,
        };
        let heading = Heading {
            input: "a.mcap".to_owned(),
            utc: "2026-11-23 17:00 UTC".to_owned(),
            command: "fieldrig calibrate scene a.mcap".to_owned(),
            refused: None,
            warnings: vec!["side is kept".to_owned()],
        };
        let n_images = [("<wrist>".to_owned(), 30), ("side".to_owned(), 12)];
        let with = |calibration| {
            SceneReport {
                heading: &heading,
                rig: None,
                n_images: &n_images,
                calibration,
            }
            .html()
        };
        let page = with(Some(&calibration));
        for words in [
            "time offset of &lt;wrist&gt;",
            "8.000 ± 0.020 ms",
            "1 correction was accepted.",
            "+0.41 ± 0.04",
            "<td>+0.50</td>",
            "accepted",
            "kept: it does not turn",
            "Accepted, with warnings",
            "<dd>42</dd>",
        ] {
            assert!(page.contains(words), "{words} is missing: {page}");
        }
        assert!(!page.contains("<wrist>"));
        let page = with(None);
        assert!(
            page.contains("<td>side</td><td>12</td><td>–</td>")
                && !page.contains("accepted corrections"),
            "{page}"
        );
    }
}
