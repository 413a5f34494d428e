//! Report of a hand-eye calibration.

use super::bars::{self, BarRow};
use super::intrinsics::detected_points;
use super::page::{self, Page};
use super::photo::{self, Photos};
use super::scatter::{self, ScatterPoint};
use super::{Heading, Unused, number, with_sigma};
use calibration::hand_eye::{
    BoardObservation, HandEyeCalibration, HandEyeSample, MAX_FOLDS, NextPose, RotationExcitation,
    SampleReport, SampleStatus, Setup,
};
use kinematics::Transform;

/// Contents of the report.
#[derive(Clone, Copy, Debug)]
pub struct HandEyeReport<'a> {
    /// Input, verdict and warnings.
    pub heading: &'a Heading,
    /// Where the camera is mounted.
    pub setup: Setup,
    /// The samples with a usable image or pose.
    pub samples: &'a [HandEyeSample],
    /// Samples whose image does not show the target.
    pub unused: &'a [Unused],
    /// The result. `None` if the calibration was refused.
    pub calibration: Option<&'a HandEyeCalibration>,
    /// Poses that would lower the uncertainty.
    pub next_poses: &'a [NextPose],
    /// Line for the rig file.
    pub rig_line: Option<&'a str>,
    /// Files of the images.
    pub photos: &'a Photos,
}

impl HandEyeReport<'_> {
    /// The page.
    pub fn html(&self) -> String {
        let n_samples = self.samples.len() + self.unused.len();
        let verdict = self.calibration.map_or(String::new(), |calibration| {
            let used = calibration
                .samples
                .iter()
                .filter(|sample| sample.status == SampleStatus::Used);
            format!("{} of {n_samples} samples are inliers.", used.count())
        });
        let figures = match self.calibration {
            Some(calibration) => figures(calibration),
            None => vec![(
                "usable samples",
                format!("{} of {n_samples}", self.samples.len()),
                "",
            )],
        };
        let mut page = Page::new("Hand-eye calibration", self.heading, &verdict, &figures);
        // After a refusal, the page shows the data on which the refusal is based.
        if let Some(calibration) = self.calibration {
            page.table(
                "Result",
                &["parameter", "value ± standard deviation"],
                self.parameters(calibration),
            );
            page.section("Line for the rig file", "", &page::code(self.rig_line));
        }
        page.section(
            "Rotations of the flange",
            "RMS rotation about three orthogonal axes. The second-largest rotation limits the accuracy: turn the flange by 20 degrees or more about different axes.",
            &self.excitation(),
        );
        // The fraction is the part of the standard deviation that would remain.
        let next = self.next_poses.iter().map(|next| {
            let percent = format!("{:.0} %", 100.0 * (1.0 - next.sigma_frac));
            vec![next.motion.clone(), percent]
        });
        page.table(
            "Next poses to add",
            &["motion", "reduction of the standard deviation"],
            next.collect(),
        );
        if let Some(calibration) = self.calibration {
            add_errors(&mut page, calibration);
        }
        let reasons = self
            .unused
            .iter()
            .map(|unused| vec![unused.name.clone(), unused.reason.clone()]);
        page.table("Not used", &["sample", "reason"], reasons.collect());
        let legend = match self.calibration {
            Some(_) => {
                "Circles: detected corners. Crosses: corners predicted by the result, assuming exact robot poses."
            }
            None => "Circles: detected corners.",
        };
        page.section("Images", legend, &page::gallery(&self.pictures()));
        page.finish()
    }

    fn parameters(&self, calibration: &HandEyeCalibration) -> Vec<Vec<String>> {
        let (parent, board_parent) = match self.setup {
            Setup::EyeInHand => ("flange", "base"),
            Setup::EyeToHand => ("base", "flange"),
        };
        let camera = &calibration.parent_from_camera;
        let mut rows = vec![
            vec![
                format!("position of the camera in the {parent} (x, y, z), mm"),
                millimeters(camera),
            ],
            vec![
                format!("rotation of the camera in the {parent} (quaternion x, y, z, w)"),
                quaternion(camera),
            ],
            vec![
                "standard deviation along the camera's x, y, z, mm".to_owned(),
                three(calibration.sigma_mm, 3),
            ],
            vec![
                "standard deviation about the camera's x, y, z, degrees".to_owned(),
                three(calibration.sigma_deg, 4),
            ],
            vec![
                format!("position of the board in the {board_parent}, mm"),
                millimeters(&calibration.parent_from_board),
            ],
        ];
        if let Some((intrinsics, sigma)) = &calibration.intrinsics {
            for (ix, name) in [
                "focal length x, px",
                "focal length y, px",
                "principal point x, px",
                "principal point y, px",
            ]
            .into_iter()
            .enumerate()
            {
                let sigma = sigma.get(ix).copied().unwrap_or(f64::NAN);
                rows.push(vec![
                    name.to_owned(),
                    with_sigma(intrinsics.params()[ix], sigma, 2),
                ]);
            }
        }
        rows.extend(calibration.joint_offsets.iter().map(|offset| {
            let value = match offset.estimate {
                Some([value, sigma]) => format!("{value:.5} ± {sigma:.5}"),
                None => "cannot be observed".to_owned(),
            };
            vec![
                format!("offset of {} (radians or meters)", offset.joint),
                value,
            ]
        }));
        rows
    }

    fn excitation(&self) -> String {
        let poses: Vec<Transform> = self
            .samples
            .iter()
            .map(|sample| sample.base_from_flange)
            .collect();
        let Some(excitation) = RotationExcitation::of(&poses) else {
            return String::new();
        };
        let min_rad = excitation.min_rad;
        let rows: Vec<BarRow> = excitation
            .axes
            .into_iter()
            .zip(excitation.rms_rad)
            .map(|(axis, rms_rad)| excitation_row(axis, rms_rad, min_rad))
            .collect();
        bars::table("rotation around", &[("RMS, °", 1)], &rows)
    }

    fn pictures(&self) -> Vec<String> {
        let pictures: Vec<String> = match self.calibration {
            Some(calibration) => self.pictures_of_result(calibration),
            None => self
                .samples
                .iter()
                .filter_map(|sample| self.picture_of_input(sample))
                .take(2)
                .collect(),
        };
        // A photo that cannot be read again has no picture.
        pictures
            .into_iter()
            .filter(|picture| !picture.is_empty())
            .collect()
    }

    /// Photos of the worst and the median sample, and of two outliers, with detected and predicted
    /// corners.
    fn pictures_of_result(&self, calibration: &HandEyeCalibration) -> Vec<String> {
        // Samples whose pose was given without an image have no error in pixels.
        let used: Vec<&SampleReport> = with_status(calibration, SampleStatus::Used).collect();
        let errors: Vec<f64> = used
            .iter()
            .map(|sample| sample.rms_px.unwrap_or(0.0))
            .collect();
        let chosen = photo::worst_and_median(&errors)
            .into_iter()
            .map(|ix| used[ix]);
        chosen
            .chain(with_status(calibration, SampleStatus::Outlier).take(2))
            .map(|sample| self.picture_of_sample(sample))
            .collect()
    }

    /// Photo of a sample with detected and predicted corners.
    fn picture_of_sample(&self, report: &SampleReport) -> String {
        let tag = if report.status == SampleStatus::Used {
            ""
        } else {
            ", not used"
        };
        let caption = format!("{}: {} px RMS{tag}", report.name, number(report.rms_px, 3));
        photo::with_corners(self.photos, &report.name, &caption, &report.points)
    }

    /// Photo of a sample with its detected corners. `None` if its pose was given without an image.
    fn picture_of_input(&self, sample: &HandEyeSample) -> Option<String> {
        match &sample.board {
            BoardObservation::View(view) => {
                let caption = format!("{}: detected corners", sample.name);
                Some(photo::with_corners(
                    self.photos,
                    &sample.name,
                    &caption,
                    &detected_points(view),
                ))
            }
            BoardObservation::Pose(_) => None,
        }
    }
}

/// Samples of a status that have corners.
fn with_status(
    calibration: &HandEyeCalibration,
    status: SampleStatus,
) -> impl Iterator<Item = &SampleReport> {
    calibration
        .samples
        .iter()
        .filter(move |sample| sample.status == status && sample.rms_px.is_some())
}

/// A row for the rotation about one axis, with a tag if it is too small.
fn excitation_row(axis: String, rms_rad: f64, min_rad: f64) -> BarRow {
    let is_weak = rms_rad < min_rad;
    let tag = if is_weak { "hardly any rotation" } else { "" };
    BarRow {
        name: axis,
        tag: tag.to_owned(),
        values: vec![Some(rms_rad.to_degrees())],
    }
}

/// Adds the sections about the errors of a result.
fn add_errors(page: &mut Page, calibration: &HandEyeCalibration) {
    let legend = "Position of the board according to each sample, relative to the result. An elongated cloud or two clusters indicate a systematic error.";
    page.section(
        "Scatter of the board",
        legend,
        &page::gallery(&scatter_plots(calibration)),
    );
    page.section(
        "Held-out samples",
        "",
        &page::note(Some(&held_out(calibration))),
    );
    let legend = "Difference between the measured and predicted board pose. Bars are relative to the largest error of a used sample.";
    let columns = [("position, mm", 2), ("rotation, °", 3), ("corners, px", 3)];
    let rows: Vec<BarRow> = calibration.samples.iter().map(row).collect();
    page.section("Samples", legend, &bars::table("sample", &columns, &rows));
}

fn three(values: [f64; 3], digits: usize) -> String {
    values.map(|value| format!("{value:.digits$}")).join(", ")
}

fn millimeters(pose: &Transform) -> String {
    three((1e3 * pose.translation.vector).into(), 2)
}

fn quaternion(pose: &Transform) -> String {
    let [x, y, z, w]: [f64; 4] = pose.rotation.coords.into();
    [x, y, z, w].map(|value| format!("{value:.5}")).join(", ")
}

fn figures(calibration: &HandEyeCalibration) -> Vec<page::Figure> {
    let largest = |values: [f64; 3]| values.into_iter().fold(0.0, f64::max);
    let mut figures = vec![
        (
            "position, worst axis",
            format!("± {}", number(Some(largest(calibration.sigma_mm)), 2)),
            "mm",
        ),
        (
            "rotation, worst axis",
            format!("± {}", number(Some(largest(calibration.sigma_deg)), 3)),
            "°",
        ),
        (
            "scatter of the board",
            number(Some(calibration.scatter.mm), 2),
            "mm",
        ),
    ];
    if let Some(held_out) = calibration.held_out_scatter {
        figures.push(("scatter, held out", number(Some(held_out.mm), 2), "mm"));
        figures.push(("rotation, held out", number(Some(held_out.deg), 3), "°"));
    }
    if let Some(rms_px) = calibration.rms_px {
        figures.push(("reprojection error", number(Some(rms_px), 3), "px"));
    }
    figures
}

/// How the held-out errors were obtained.
fn held_out(calibration: &HandEyeCalibration) -> String {
    let n_used = calibration
        .samples
        .iter()
        .filter(|sample| sample.status == SampleStatus::Used)
        .count();
    let Some(scatter) = calibration.held_out_scatter else {
        return "There are too few samples to leave one out.".to_owned();
    };
    let method = if n_used > MAX_FOLDS {
        format!(
            "The samples are divided into {MAX_FOLDS} groups, and each group is evaluated with a calibration from the others"
        )
    } else {
        "Each sample is evaluated with a calibration from the others".to_owned()
    };
    let mm = number(Some(scatter.mm), 2);
    let deg = number(Some(scatter.deg), 3);
    format!(
        "{method}: scatter of the board {mm} mm and {deg}°. With all samples: {} mm and {}°.",
        number(Some(calibration.scatter.mm), 2),
        number(Some(calibration.scatter.deg), 3)
    )
}

fn row(report: &SampleReport) -> BarRow {
    let tag = match report.status {
        SampleStatus::Used => "",
        SampleStatus::Outlier => "outlier",
        SampleStatus::NoBoard => "too few corners",
        SampleStatus::Repeated => "identical to an earlier sample",
    };
    let values = vec![report.position_mm, report.rotation_deg, report.rms_px];
    BarRow {
        name: report.name.clone(),
        tag: tag.to_owned(),
        values,
    }
}

fn scatter_plots(calibration: &HandEyeCalibration) -> Vec<String> {
    let parent = match calibration.setup {
        Setup::EyeInHand => "base",
        Setup::EyeToHand => "flange",
    };
    let label = |axis: usize| format!("{} of the {parent}, mm", ["x", "y", "z"][axis]);
    // Two plots with a common axis show all three coordinates.
    [[0, 1], [0, 2]]
        .into_iter()
        .map(|[across, up]| {
            let points = scatter_points(&calibration.samples, [across, up]);
            page::figure("", &scatter::svg([&label(across), &label(up)], &points))
        })
        .collect()
}

/// Positions of the board according to each sample, along two axes.
fn scatter_points(samples: &[SampleReport], [across, up]: [usize; 2]) -> Vec<ScatterPoint> {
    let point = |sample: &SampleReport| {
        let offset = sample.board_offset_mm?;
        Some(ScatterPoint {
            name: sample.name.clone(),
            at: [offset[across], offset[up]],
            is_outlier: sample.status != SampleStatus::Used,
        })
    };
    samples.iter().filter_map(point).collect()
}
