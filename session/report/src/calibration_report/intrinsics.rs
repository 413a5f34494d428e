//! Report of a calibration of intrinsics.

use super::bars::{self, BarRow};
use super::image_map::{ImageMap, Shade};
use super::page::{self, Page};
use super::photo::{self, Photos};
use super::{Heading, Unused, number, with_sigma};
use calibration::{
    BoardView, ImageGrid, IntrinsicsCalibration, LensTrial, NextView, PointFit, RejectionReason,
};
use nalgebra::{Point3, Vector3};

/// Contents of the report.
#[derive(Clone, Copy, Debug)]
pub struct IntrinsicsReport<'a> {
    /// Input, verdict and warnings.
    pub heading: &'a Heading,
    /// Specification of the target.
    pub target: &'a str,
    /// Size of the images.
    pub size_px: [u32; 2],
    /// The target in all images in which it was detected.
    pub views: &'a [BoardView],
    /// Images in which the target was not detected.
    pub unused: &'a [Unused],
    /// The result. `None` if the calibration was refused.
    pub calibration: Option<&'a IntrinsicsCalibration>,
    /// Line for the rig file.
    pub rig_line: Option<&'a str>,
    /// Files of the images.
    pub photos: &'a Photos,
}

impl IntrinsicsReport<'_> {
    /// The page.
    pub fn html(&self) -> String {
        let n_images = self.views.len() + self.unused.len();
        let figures = self
            .calibration
            .map_or_else(|| self.input_figures(), figures);
        let verdict = self.calibration.map_or(String::new(), |calibration| {
            let n_corners: usize = calibration
                .images
                .iter()
                .map(|image| image.points.len())
                .sum();
            format!(
                "{} explains {n_corners} corners in {} of {n_images} images.",
                calibration.model,
                calibration.images.len()
            )
        });
        let heading = Heading {
            input: format!("{} · {}", self.heading.input, self.target),
            ..self.heading.clone()
        };
        let mut page = Page::new("Calibration of intrinsics", &heading, &verdict, &figures);
        if let Some(calibration) = self.calibration {
            page.table(
                "Result",
                &["parameter", "value ± standard deviation"],
                parameters(calibration),
            );
            page.section("Line for the rig file", "", &page::code(self.rig_line));
        }
        let next = self
            .calibration
            .and_then(|calibration| calibration.next_view.as_ref());
        page.section(
            "Next image to take",
            "",
            &page::note(next.map(describe).as_deref()),
        );
        page.section(
            "Image coverage, uncertainty and residuals",
            "",
            &page::gallery(&self.maps(next)),
        );
        if let Some(calibration) = self.calibration {
            page.table(
                "Selection of the lens model",
                &TRIAL_HEAD,
                calibration.trials.iter().map(trial).collect(),
            );
        }
        self.add_images(&mut page);
        page.finish()
    }

    /// Adds the sections about single images.
    fn add_images(&self, page: &mut Page) {
        let legend = "RMS distance between detected and projected corners. Bars are relative to the largest error of a used image.";
        let columns = [("error, px", 3), ("corners", 0)];
        page.section(
            "Images",
            legend,
            &bars::table("image", &columns, &self.rows()),
        );
        page.table("Not used", &["image", "reason"], self.reasons());
        let legend = match self.calibration {
            Some(_) => "Circles: detected corners. Crosses: corners predicted by the result.",
            None => "Circles: detected corners.",
        };
        let title = if self.calibration.is_some() {
            "Worst and median image"
        } else {
            "Images with the fewest and a median number of corners"
        };
        page.section(title, legend, &page::gallery(&self.pictures()));
    }

    fn input_figures(&self) -> Vec<page::Figure> {
        let n_corners: usize = self.views.iter().map(|view| view.points.len()).sum();
        let n_images = self.views.len() + self.unused.len();
        vec![
            (
                "images with the target",
                format!("{} of {n_images}", self.views.len()),
                "",
            ),
            ("corners", n_corners.to_string(), ""),
        ]
    }

    fn maps(&self, next: Option<&NextView>) -> Vec<String> {
        let pixels: Vec<[f64; 2]> = match self.calibration {
            Some(calibration) => corners(calibration).map(|point| point.pixel).collect(),
            None => self
                .views
                .iter()
                .flat_map(|view| &view.points)
                .map(|point| point.pixel)
                .collect(),
        };
        if pixels.is_empty() {
            return Vec::new();
        }
        let mut maps = vec![self.coverage_map(pixels, next)];
        // The other maps show properties of a result.
        if let Some(calibration) = self.calibration {
            maps.push(self.uncertainty_map(calibration));
            maps.push(self.residual_map(calibration));
        }
        maps
    }

    /// Map of the corners in all images, with the outline of the target in the suggested next
    /// image.
    fn coverage_map(&self, pixels: Vec<[f64; 2]>, next: Option<&NextView>) -> String {
        let counted = ImageGrid::coverage(self.size_px, pixels.iter().copied());
        let values: Vec<Option<f64>> = counted.values.iter().map(|n| Some(*n as f64)).collect();
        let n_empty = counted.values.iter().filter(|n| **n == 0).count();
        let coverage = ImageGrid {
            n_columns: counted.n_columns,
            n_rows: counted.n_rows,
            values,
        };
        let mut map = ImageMap::new(self.size_px);
        map.grid(&coverage, Shade::Good, 0);
        map.dots(pixels.into_iter());
        let mut caption = format!(
            "Coverage: corners per part of the image. {n_empty} of {} parts have none.",
            coverage.values.len()
        );
        if let Some(outline) = next.and_then(|next| self.outline(next)) {
            map.outline(&outline);
            caption.push_str(" Dashed: the target in the suggested next image.");
        }
        page::figure(&caption, &map.svg("corners per part of the image"))
    }

    /// Map of the uncertainty of the projection in each part of the image.
    fn uncertainty_map(&self, calibration: &IntrinsicsCalibration) -> String {
        let mut map = ImageMap::new(self.size_px);
        map.grid(&calibration.uncertainty_px, Shade::Bad, 2);
        let [low, high] = range(&calibration.uncertainty_px);
        let caption = format!(
            "Projection uncertainty: standard deviation of the projection of a distant point, {low:.2} px (light) to {high:.2} px (dark)."
        );
        page::figure(&caption, &map.svg("projection uncertainty"))
    }

    /// The residuals of all corners.
    fn residual_map(&self, calibration: &IntrinsicsCalibration) -> String {
        let mut map = ImageMap::new(self.size_px);
        let points: Vec<PointFit> = corners(calibration).copied().collect();
        let magnification = map.arrows(&points);
        let caption = format!(
            "Residuals: detected minus projected corners, magnified {magnification:.0} times. If neighboring arrows point the same way, the lens model does not fit or the target is not flat."
        );
        page::figure(&caption, &map.svg("residuals of all corners"))
    }

    /// Corners of the target in the suggested image.
    fn outline(&self, next: &NextView) -> Option<[[f64; 2]; 4]> {
        let intrinsics = &self.calibration?.intrinsics;
        let infinite = Vector3::repeat(f64::INFINITY);
        let points = self
            .views
            .iter()
            .flat_map(|view| &view.points)
            .map(|point| point.point_in_board);
        let (low, high) = points.fold((infinite, -infinite), |(low, high), point| {
            (low.inf(&point), high.sup(&point))
        });
        // The target is flat, so all of its points have the same z.
        let corner = |[x, y]: [f64; 2]| {
            intrinsics.project(&(next.camera_from_board * Point3::new(x, y, low.z)).coords)
        };
        let corners = [
            [low.x, low.y],
            [high.x, low.y],
            [high.x, high.y],
            [low.x, high.y],
        ]
        .map(corner);
        corners
            .into_iter()
            .collect::<Option<Vec<_>>>()?
            .try_into()
            .ok()
    }

    fn rows(&self) -> Vec<BarRow> {
        if self.views.is_empty() {
            return Vec::new();
        }
        let without = self.unused.iter().map(|unused| BarRow {
            name: unused.name.clone(),
            tag: "not used".to_owned(),
            values: vec![None, None],
        });
        self.views
            .iter()
            .map(|view| self.row(view))
            .chain(without)
            .collect()
    }

    /// The row of an image in which the target was detected.
    fn row(&self, view: &BoardView) -> BarRow {
        let images = self
            .calibration
            .map_or(&[][..], |calibration| &calibration.images);
        let used = images.iter().find(|image| image.name == view.name);
        let n_corners = used.map_or(view.points.len(), |image| image.points.len());
        // Without a result, it is unknown which images are used, so there is no tag.
        let tag = match (used, self.calibration) {
            (None, Some(_)) => "not used",
            (Some(_), _) if n_corners < view.points.len() => "some corners rejected",
            _ => "",
        };
        BarRow {
            name: view.name.clone(),
            tag: tag.to_owned(),
            values: vec![used.map(|image| image.rms_px), Some(n_corners as f64)],
        }
    }

    fn reasons(&self) -> Vec<Vec<String>> {
        let rejected = self
            .calibration
            .map_or(&[][..], |calibration| &calibration.rejected);
        let rejected = rejected
            .iter()
            .map(|rejected| vec![rejected.image.clone(), rejected.reason.to_string()]);
        let unused = self
            .unused
            .iter()
            .map(|unused| vec![unused.name.clone(), unused.reason.clone()]);
        unused.chain(rejected).collect()
    }

    fn pictures(&self) -> Vec<String> {
        let pictures = match self.calibration {
            Some(calibration) => {
                let errors: Vec<f64> = calibration
                    .images
                    .iter()
                    .map(|image| image.rms_px)
                    .collect();
                let rejected = calibration
                    .rejected
                    .iter()
                    .filter(|rejected| {
                        matches!(rejected.reason, RejectionReason::Inconsistent { .. })
                    })
                    .filter_map(|rejected| self.detected(&rejected.image, "not used"));
                let chosen = photo::worst_and_median(&errors).into_iter().map(|ix| {
                    let image = &calibration.images[ix];
                    let caption =
                        format!("{}: {} px RMS", image.name, number(Some(image.rms_px), 3));
                    photo::with_corners(self.photos, &image.name, &caption, &image.points)
                });
                chosen.chain(rejected.take(1)).collect::<Vec<_>>()
            }
            None => {
                // The worst view has the fewest corners.
                let badness: Vec<f64> = self
                    .views
                    .iter()
                    .map(|view| -(view.points.len() as f64))
                    .collect();
                let chosen = photo::worst_and_median(&badness).into_iter();
                chosen
                    .filter_map(|ix| self.detected(&self.views[ix].name, "detected corners"))
                    .collect()
            }
        };
        let shown = pictures.into_iter().filter(|picture| !picture.is_empty());
        // After a refusal, an image without the target often shows the reason, such as blur.
        let none = self.unused.first().map(|unused| {
            photo::with_corners(
                self.photos,
                &unused.name,
                &format!("{}: {}", unused.name, unused.reason),
                &[],
            )
        });
        shown
            .chain(none.filter(|picture| !picture.is_empty() && self.calibration.is_none()))
            .collect()
    }

    /// The photo of a view with the detected corners only.
    fn detected(&self, name: &str, what: &str) -> Option<String> {
        let view = self.views.iter().find(|view| view.name == name)?;
        let points: Vec<PointFit> = detected_points(view);
        Some(photo::with_corners(
            self.photos,
            name,
            &format!("{name}: {what}"),
            &points,
        ))
    }
}

/// Corners without a prediction.
pub(super) fn detected_points(view: &BoardView) -> Vec<PointFit> {
    let unknown = [f64::NAN; 2];
    view.points
        .iter()
        .map(|point| PointFit {
            pixel: point.pixel,
            residual_px: unknown,
        })
        .collect()
}

fn corners(calibration: &IntrinsicsCalibration) -> impl Iterator<Item = &PointFit> {
    calibration.images.iter().flat_map(|image| &image.points)
}

fn range(grid: &ImageGrid<Option<f64>>) -> [f64; 2] {
    let known = grid
        .values
        .iter()
        .flatten()
        .copied()
        .filter(|value| value.is_finite());
    [
        known.clone().fold(f64::INFINITY, f64::min),
        known.fold(0.0, f64::max),
    ]
}

/// Value and standard deviation of a parameter. The text is empty if the lens model does not have
/// this parameter.
fn with_deviation(calibration: &IntrinsicsCalibration, name: &str) -> String {
    calibration
        .params
        .iter()
        .find(|param| param.name == name)
        .map_or(String::new(), |param| {
            with_sigma(param.value, param.sigma, 1)
        })
}

fn figures(calibration: &IntrinsicsCalibration) -> Vec<page::Figure> {
    let with_deviation = |name: &str| with_deviation(calibration, name);
    vec![
        ("RMS error", number(Some(calibration.rms_px), 3), "px"),
        (
            "projection, worst part",
            number(Some(range(&calibration.uncertainty_px)[1]), 2),
            "px",
        ),
        ("focal length x", with_deviation("fx"), "px"),
        ("focal length y", with_deviation("fy"), "px"),
        ("principal point x", with_deviation("cx"), "px"),
        ("principal point y", with_deviation("cy"), "px"),
    ]
}

fn parameters(calibration: &IntrinsicsCalibration) -> Vec<Vec<String>> {
    const MEANINGS: [(&str, &str); 4] = [
        ("fx", "focal length x, px"),
        ("fy", "focal length y, px"),
        ("cx", "principal point x, px"),
        ("cy", "principal point y, px"),
    ];
    let mut rows = Vec::new();
    for param in &calibration.params {
        let meaning = MEANINGS.iter().find(|(name, _)| *name == param.name);
        // Pixels need fewer decimals than coefficients of distortion, which are below 1.
        let digits = if meaning.is_some() { 3 } else { 5 };
        rows.push(vec![
            meaning
                .map_or(param.name, |(_, meaning)| meaning)
                .to_owned(),
            with_sigma(param.value, param.sigma, digits),
        ]);
    }
    rows.push(vec![
        "noise of a corner along one axis, px".to_owned(),
        number(Some(calibration.noise_px), 3),
    ]);
    rows
}

const TRIAL_HEAD: [&str; 5] = [
    "from",
    "to",
    "gain on held-out corners, dB",
    "images",
    "decision",
];

fn trial(trial: &LensTrial) -> Vec<String> {
    let decision = if trial.kept {
        "accepted"
    } else {
        "not significant"
    };
    vec![
        trial.baseline.clone(),
        trial.variant.clone(),
        format!("{:+.2} ± {:.2}", trial.gain_db, trial.standard_error_db),
        trial.n_images.to_string(),
        decision.to_owned(),
    ]
}

fn describe(next: &NextView) -> String {
    let mut words = next.instruction.clone();
    if let Some(first) = words.get_mut(..1) {
        first.make_ascii_uppercase();
    }
    format!(
        "{words}. This lowers the mean projection uncertainty from {:.2} to {:.2} px.",
        next.sigma_px, next.predicted_sigma_px
    )
}
