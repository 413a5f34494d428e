//! A map of the places that the keyframes show, seen from above.

use super::seen_places::{SeenCamera, SeenPlaces};
use numbers::quantile::trimmed_range;
use std::fmt::Write;

/// Maximum number of keyframes drawn. More would only make the page larger.
const MAX_CAMERAS: usize = 400;
/// Width of the map, and limits of its height, in units of the drawing.
const WIDTH: f64 = 720.0;
const MIN_HEIGHT: f64 = 240.0;
const MAX_HEIGHT: f64 = 640.0;
/// Margin around the places, relative to their extent.
const MARGIN_FRAC: f64 = 0.06;
/// Fraction of the points that may be outside of the map at each end. For example, a camera that
/// looks through a door sees places far away.
const OUTSIDE_FRAC: f64 = 0.02;
/// Approximate number of grid lines across the width.
const N_GRID: f64 = 8.0;
/// Total opacity of all footprints on one place, if half of the keyframes showed it.
const TOTAL_OPACITY: f64 = 6.0;

/// The map as SVG, with the spacing of its grid in meters; `None` without keyframes.
pub(super) fn map(seen: &SeenPlaces) -> Option<(String, f64)> {
    let stride = seen.cameras.len().div_ceil(MAX_CAMERAS).max(1);
    let cameras: Vec<&SeenCamera> = seen.cameras.iter().step_by(stride).collect();
    let frame = Frame::around(&cameras)?;
    let opacity = (TOTAL_OPACITY / cameras.len() as f64).clamp(0.02, 0.35);
    let mut svg = format!(
        "<svg class=\"coverage\" viewBox=\"0 0 {WIDTH} {:.0}\" role=\"img\" aria-label=\"Map of the places in the keyframes\">\n",
        frame.height
    );
    let spacing_m = frame.grid_spacing_m();
    svg.push_str(&frame.grid(spacing_m));
    for camera in &cameras {
        let corners: Vec<String> = camera
            .corners_m
            .iter()
            .map(|corner| {
                let [x, y] = frame.place(*corner);
                format!("{x:.1},{y:.1}")
            })
            .collect();
        writeln!(
            svg,
            "<polygon points=\"{}\" fill-opacity=\"{opacity:.3}\"/>",
            corners.join(" ")
        )
        .expect("a String never fails");
    }
    for camera in &cameras {
        let [x, y] = frame.place(camera.eye_m);
        let class = if camera.is_test { "test" } else { "train" };
        writeln!(
            svg,
            "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.5\"/>"
        )
        .expect("a String never fails");
    }
    svg.push_str("</svg>");
    Some((svg, spacing_m))
}

/// The part of the world on the map: x to the right, y up.
struct Frame {
    /// Left and upper edge, meters.
    left_m: f64,
    top_m: f64,
    units_per_m: f64,
    height: f64,
}

impl Frame {
    /// A frame around most of the cameras and of the places that they show.
    fn around(cameras: &[&SeenCamera]) -> Option<Self> {
        let range = |axis: usize| {
            let points = cameras
                .iter()
                .flat_map(|camera| camera.corners_m.iter().chain([&camera.eye_m]));
            let mut values: Vec<f64> = points
                .map(|point| point[axis])
                .filter(|value| value.is_finite())
                .collect();
            trimmed_range(&mut values, OUTSIDE_FRAC)
        };
        let ([min_x, max_x], [min_y, max_y]) = (range(0)?, range(1)?);
        let width_m = ((max_x - min_x) * (1.0 + 2.0 * MARGIN_FRAC)).max(1e-3);
        let height_m = ((max_y - min_y) * (1.0 + 2.0 * MARGIN_FRAC)).max(1e-3);
        // The height follows the shape of the scene within limits.
        let height = (WIDTH * height_m / width_m).clamp(MIN_HEIGHT, MAX_HEIGHT);
        let units_per_m = (WIDTH / width_m).min(height / height_m);
        Some(Self {
            left_m: 0.5 * (min_x + max_x) - 0.5 * WIDTH / units_per_m,
            top_m: 0.5 * (min_y + max_y) + 0.5 * height / units_per_m,
            units_per_m,
            height,
        })
    }

    /// Position of a point on the map.
    fn place(&self, [x_m, y_m, _]: [f64; 3]) -> [f64; 2] {
        [
            (x_m - self.left_m) * self.units_per_m,
            (self.top_m - y_m) * self.units_per_m,
        ]
    }

    /// Spacing of the grid: 1, 2 or 5 times a power of ten.
    fn grid_spacing_m(&self) -> f64 {
        let rough_m = WIDTH / self.units_per_m / N_GRID;
        let power = 10_f64.powf(rough_m.log10().floor());
        let factor = [1.0, 2.0, 5.0]
            .into_iter()
            .find(|factor| factor * power >= rough_m);
        factor.unwrap_or(10.0) * power
    }

    fn grid(&self, spacing_m: f64) -> String {
        let mut lines = String::new();
        let spacing = spacing_m * self.units_per_m;
        let first =
            |from_m: f64| ((from_m / spacing_m).ceil() * spacing_m - from_m) * self.units_per_m;
        let mut x = first(self.left_m);
        while x <= WIDTH {
            writeln!(
                lines,
                "<line x1=\"{x:.1}\" y1=\"0\" x2=\"{x:.1}\" y2=\"{:.0}\"/>",
                self.height
            )
            .expect("a String never fails");
            x += spacing;
        }
        // The y axis of the world points up, and the y axis of the drawing points down.
        let mut y = first(-self.top_m);
        while y <= self.height {
            writeln!(
                lines,
                "<line x1=\"0\" y1=\"{y:.1}\" x2=\"{WIDTH}\" y2=\"{y:.1}\"/>"
            )
            .expect("a String never fails");
            y += spacing;
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(x_m: f64, is_test: bool) -> SeenCamera {
        let corner = |dx: f64, y: f64| [x_m + dx, y, 0.0];
        SeenCamera {
            eye_m: [x_m, -1.0, 1.0],
            corners_m: [
                corner(-0.2, 0.0),
                corner(0.2, 0.0),
                corner(0.2, 0.5),
                corner(-0.2, 0.5),
            ],
            is_test,
        }
    }

    fn seen(cameras: Vec<SeenCamera>) -> SeenPlaces {
        SeenPlaces {
            center_m: [0.0; 3],
            radius_m: 1.0,
            cameras,
        }
    }

    #[test]
    fn map_has_every_camera_and_a_round_grid() {
        let (svg, spacing_m) = map(&seen(vec![
            camera(0.0, false),
            camera(1.0, true),
            camera(2.0, false),
        ]))
        .expect("cameras");
        assert_eq!(svg.matches("<polygon ").count(), 3);
        assert_eq!(svg.matches("class=\"train\"").count(), 2);
        assert_eq!(svg.matches("class=\"test\"").count(), 1);
        assert!((spacing_m - 0.5).abs() < 1e-12, "{spacing_m}");
        assert!(svg.contains("<line ") && !svg.contains("NaN"), "{svg}");
    }

    #[test]
    fn world_y_points_up() {
        let cameras = [camera(0.0, false), camera(3.0, false)];
        let frame = Frame::around(&cameras.iter().collect::<Vec<_>>()).expect("cameras");
        let [low, high] = [-1.0, 0.5].map(|y| frame.place([0.0, y, 0.0])[1]);
        let [left, right] = [0.0, 3.0].map(|x| frame.place([x, 0.0, 0.0])[0]);
        assert!(
            0.0 < high && high < low && low < frame.height,
            "{high} {low}"
        );
        assert!(
            0.0 < left && left < right && right < WIDTH,
            "{left} {right}"
        );
    }

    #[test]
    fn map_of_one_place_and_of_nothing() {
        let mut point = camera(0.0, false);
        point.corners_m = [point.eye_m; 4];
        let (svg, _) = map(&seen(vec![point])).expect("a camera");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert!(svg.len() < 20_000, "few grid lines");
        assert!(map(&seen(Vec::new())).is_none());
    }

    #[test]
    fn long_runs_have_maps_of_bounded_size() {
        let many = (0..5000)
            .map(|ix| camera(f64::from(ix) * 0.01, false))
            .collect();
        let (svg, _) = map(&seen(many)).expect("cameras");
        assert!(svg.matches("<polygon ").count() <= MAX_CAMERAS);
    }
}
