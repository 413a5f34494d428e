//! Maps over the area of an image, as SVG. They show values on a grid, points and arrows.

use calibration::{ImageGrid, PointFit};
use std::fmt::Write;

/// Colors of a grid.
#[derive(Clone, Copy, Debug)]
pub(super) enum Shade {
    /// More is better.
    Good,
    /// More is worse.
    Bad,
}

impl Shade {
    fn class(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Bad => "bad",
        }
    }
}

/// A rectangle in an image, given by its first pixel and its size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ImagePart {
    pub(super) first_px: [u32; 2],
    pub(super) size_px: [u32; 2],
}

/// A picture with the coordinates of an image.
pub(super) struct ImageMap {
    first_px: [f64; 2],
    size_px: [f64; 2],
    shapes: String,
}

impl ImageMap {
    pub(super) fn new(size_px: [u32; 2]) -> Self {
        Self::of_part(ImagePart {
            first_px: [0, 0],
            size_px,
        })
    }

    /// A part of an image, in the coordinates of the whole image.
    pub(super) fn of_part(ImagePart { first_px, size_px }: ImagePart) -> Self {
        Self {
            first_px: first_px.map(f64::from),
            size_px: size_px.map(f64::from),
            shapes: String::new(),
        }
    }

    /// Length in image pixels of one unit of line width.
    fn unit(&self) -> f64 {
        // A map is shown about 640 CSS pixels wide, whatever the size of the image. Lines then have
        // the same width in all maps.
        self.size_px[0].max(self.size_px[1]) / 640.0
    }

    /// Draws an embedded photo of the part.
    pub(super) fn photo(&mut self, uri: &str) {
        let [x, y] = self.first_px;
        let [width, height] = self.size_px;
        self.push(&format!(
            "<image x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" preserveAspectRatio=\"none\" href=\"{uri}\"/>\n"
        ));
    }

    /// Shades the cells of a grid by their value relative to the largest value. Cells without a
    /// value are hatched.
    pub(super) fn grid(&mut self, grid: &ImageGrid<Option<f64>>, shade: Shade, digits: usize) {
        let largest = grid
            .values
            .iter()
            .flatten()
            .copied()
            .filter(|value| value.is_finite())
            .fold(0.0, f64::max);
        let width = self.size_px[0] / grid.n_columns as f64;
        let height = self.size_px[1] / grid.n_rows as f64;
        for (ix, value) in grid.values.iter().enumerate() {
            let x = (ix % grid.n_columns) as f64 * width;
            let y = (ix / grid.n_columns) as f64 * height;
            let cell =
                format!("x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"");
            self.push(&match value.filter(|value| value.is_finite()) {
                Some(value) => {
                    let opacity = if largest > 0.0 { value / largest } else { 0.0 };
                    format!(
                        "<rect class=\"{}\" {cell} fill-opacity=\"{opacity:.2}\"><title>{value:.digits$}</title></rect>\n",
                        shade.class()
                    )
                }
                None => format!("<rect class=\"missing\" {cell}/>\n"),
            });
        }
    }

    /// Draws dots.
    pub(super) fn dots(&mut self, pixels: impl Iterator<Item = [f64; 2]>) {
        // All dots are in one path, because thousands of elements would make the page slow. Each
        // dot is a line without length, of which only the round caps are visible.
        let mut path = String::new();
        for [x, y] in pixels {
            write!(path, "M{x:.1} {y:.1}h0").expect("writing to a string cannot fail");
        }
        let width = 2.6 * self.unit();
        self.push(&format!(
            "<path class=\"dots\" d=\"{path}\" stroke-width=\"{width:.2}\"/>\n"
        ));
    }

    /// Draws circles around detected corners and crosses at predicted corners.
    pub(super) fn corners(&mut self, points: &[PointFit]) {
        let mut circles = String::new();
        let mut crosses = String::new();
        let radius = 7.0 * self.unit();
        let arm = 5.0 * self.unit();
        for PointFit {
            pixel: [x, y],
            residual_px: [dx, dy],
        } in points
        {
            // A path has no circles, so each circle consists of two half arcs.
            let left = x - radius;
            let diameter = 2.0 * radius;
            write!(circles, "M{left:.1} {y:.1}a{radius:.1} {radius:.1} 0 1 0 {diameter:.1} 0a{radius:.1} {radius:.1} 0 1 0 -{diameter:.1} 0")
                .expect("writing to a string cannot fail");
            // Without a result, there is no prediction.
            if dx.is_finite() && dy.is_finite() {
                // Residuals are detected minus predicted positions.
                let u = x - dx;
                let v = y - dy;
                let side = 2.0 * arm;
                write!(
                    crosses,
                    "M{:.1} {:.1}l{side:.1} {side:.1}m0 -{side:.1}l-{side:.1} {side:.1}",
                    u - arm,
                    v - arm
                )
                .expect("writing to a string cannot fail");
            }
        }
        let width = 2.0 * self.unit();
        self.push(&format!(
            "<path class=\"detected\" d=\"{circles}\" stroke-width=\"{width:.2}\"/>\n"
        ));
        self.push(&format!(
            "<path class=\"predicted\" d=\"{crosses}\" stroke-width=\"{width:.2}\"/>\n"
        ));
    }

    /// Draws a closed dashed outline.
    pub(super) fn outline(&mut self, corners: &[[f64; 2]]) {
        let unit = self.unit();
        let points: Vec<String> = corners
            .iter()
            .map(|[x, y]| format!("{x:.1},{y:.1}"))
            .collect();
        self.push(&format!(
            "<polygon class=\"outline\" points=\"{}\" stroke-width=\"{:.2}\" stroke-dasharray=\"{:.1} {:.1}\"/>\n",
            points.join(" "),
            2.5 * unit,
            9.0 * unit,
            6.0 * unit
        ));
    }

    /// Draws residuals as arrows from the detected corners. Returns the factor by which they are
    /// magnified.
    pub(super) fn arrows(&mut self, points: &[PointFit]) -> f64 {
        /// More arrows cannot be distinguished.
        const MAX_ARROWS: usize = 3000;
        const LONG_FRAC: f64 = 0.05; // Of the image, for the 95 % quantile.
        let mut lengths: Vec<f64> = points
            .iter()
            .map(|point| point.residual_px[0].hypot(point.residual_px[1]))
            .collect();
        // A quantile is used instead of the maximum, so that one wrong corner does not make all
        // other arrows too short to see.
        let rank = numbers::quantile::Rank::Nearest;
        let long_px = numbers::quantile::quantile(&mut lengths, 0.95, rank).unwrap_or(0.0);
        let magnification =
            round_down(LONG_FRAC * self.size_px[0].max(self.size_px[1]) / long_px.max(1e-9));
        let stride = points.len().div_ceil(MAX_ARROWS).max(1);
        let mut path = String::new();
        for PointFit {
            pixel: [x, y],
            residual_px,
        } in points.iter().step_by(stride)
        {
            let [dx, dy] = residual_px.map(|residual| magnification * residual);
            write!(path, "M{x:.1} {y:.1}l{dx:.1} {dy:.1}")
                .expect("writing to a string cannot fail");
        }
        let width = 1.2 * self.unit();
        self.push(&format!(
            "<path class=\"arrows\" d=\"{path}\" stroke-width=\"{width:.2}\"/>\n"
        ));
        self.dots(points.iter().step_by(stride).map(|point| point.pixel));
        magnification
    }

    pub(super) fn svg(&self, label: &str) -> String {
        let [x, y] = self.first_px;
        let [width, height] = self.size_px;
        let label = crate::chart::drawing::escaped(label);
        format!(
            "<svg class=\"map\" role=\"img\" aria-label=\"{label}\" viewBox=\"{x} {y} {width} {height}\">\n\
             <rect class=\"frame\" x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"/>\n{}</svg>\n",
            self.shapes
        )
    }

    fn push(&mut self, shape: &str) {
        self.shapes.push_str(shape);
    }
}

/// The largest of 1, 2, 5, 10, 20, 50, ... that is not larger than a factor. The result is at least 1.
fn round_down(factor: f64) -> f64 {
    let power = 10f64.powf(factor.max(1.0).log10().floor());
    [5.0, 2.0]
        .into_iter()
        .map(|digit| digit * power)
        .find(|value| *value <= factor)
        .unwrap_or(power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn magnification_is_a_round_number() {
        assert_eq!(
            [0.3, 1.0, 4.9, 5.0, 199.0, 234.0].map(round_down),
            [1.0, 1.0, 2.0, 5.0, 100.0, 200.0]
        );
    }

    #[test]
    fn arrows_are_magnified_by_the_returned_factor() {
        let mut map = ImageMap::new([640, 480]);
        let points = [PointFit {
            pixel: [100.0, 50.0],
            residual_px: [0.1, -0.2],
        }];
        let factor = map.arrows(&points);
        assert_eq!(factor, 100.0, "0.22 px become 22 px, less than 5 % of 640");
        assert!(
            map.svg("a <b>").contains("M100.0 50.0l10.0 -20.0"),
            "{}",
            map.shapes
        );
        assert!(map.svg("a <b>").contains("a &lt;b&gt;"));
    }

    #[test]
    fn cells_without_a_value_are_marked() {
        let mut map = ImageMap::new([20, 10]);
        map.grid(
            &ImageGrid {
                n_columns: 2,
                n_rows: 1,
                values: vec![Some(4.0), None],
            },
            Shade::Bad,
            1,
        );
        assert!(
            map.shapes.contains("fill-opacity=\"1.00\"><title>4.0")
                && map.shapes.contains("class=\"missing\"")
        );
    }
}
