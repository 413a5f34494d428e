//! Line charts, drawn once for both SVG and PNG.
//!
//! The colors are the color-blind safe palette of Okabe and Ito (2008). Lines also differ in the
//! shape of their dots, for readers of grayscale prints.

mod axis;
pub mod drawing;
pub mod raster;

pub use axis::{Axis, Scale, compact_number};
use drawing::{Anchor, Color, Drawing, TextSize, VectorShape};
use raster::text_width;

/// Contents of a chart.
#[derive(Clone, Debug)]
pub struct Chart {
    /// Title above the chart.
    pub title: String,
    /// Explanation of the points and bands.
    pub subtitle: String,
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// The lines, in the order of the legend.
    pub lines: Vec<Line>,
    /// Values on the y axis to mark with a dashed line, with their labels.
    pub thresholds: Vec<(f64, String)>,
    /// Values on the x axis to mark with a dashed line.
    pub markers: Vec<Marker>,
}

/// One line of a chart.
#[derive(Clone, Debug)]
pub struct Line {
    /// Name in the legend.
    pub label: String,
    /// Points, ordered by x.
    pub points: Vec<Point>,
    /// Whether the line is drawn dashed, for example because it belongs to another trainer.
    pub is_peer: bool,
}

/// A point and the range of the values it summarizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Position on the horizontal axis.
    pub x: f64,
    /// Position on the vertical axis. The line is interrupted where it is not finite.
    pub y: f64,
    /// Lower end of the band around the line.
    pub low: f64,
    /// Upper end of the band around the line.
    pub high: f64,
}

/// A marked value on the x axis, with a label above the plot.
#[derive(Clone, Debug)]
pub struct Marker {
    /// Position on the horizontal axis.
    pub x: f64,
    /// Text at the marker.
    pub label: String,
    /// Index of the line to which it belongs.
    pub line_ix: usize,
}

const COLORS: [Color; 7] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [230, 159, 0],
    [86, 180, 233],
    [0, 0, 0],
];
const INK: Color = [40, 40, 40];
const FAINT_INK: Color = [95, 95, 95];
const GRID: Color = [226, 226, 226];

const WIDTH: f64 = 960.0;
const PLOT_HEIGHT: f64 = 380.0;
const LEFT: f64 = 66.0;
const MARGIN: f64 = 18.0;
/// Space below the plot for tick labels and the axis label.
const MARGIN_BELOW: f64 = 56.0;
const TITLE_HEIGHT: f64 = 54.0;
const MARKER_ROW: f64 = 15.0;
const LEGEND_SWATCH: f64 = 34.0;
const LEGEND_ROW: f64 = 15.0;
/// Maximum characters per row of the legend. Longer rows would leave less width for the plot.
const MAX_LEGEND_CHARS: usize = 26;

/// Position of the plot and the ranges of its axes.
struct Plot {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
    x: axis::AxisRange,
    y: axis::AxisRange,
}

impl Plot {
    fn x(&self, value: f64) -> f64 {
        self.left + (self.right - self.left) * self.x.frac(value)
    }

    fn y(&self, value: f64) -> f64 {
        self.bottom - (self.bottom - self.top) * self.y.frac(value)
    }

    fn at(&self, point: &Point) -> [f64; 2] {
        [self.x(point.x), self.y(point.y)]
    }
}

impl Chart {
    /// Draws the chart. The legend is next to the plot and never covers it.
    pub fn draw(&self) -> Drawing {
        let legend = self.legend();
        let longest = legend
            .iter()
            .flat_map(|entry| &entry.rows)
            .map(|row| text_width(row, TextSize::Normal));
        let legend_width = LEGEND_SWATCH + longest.fold(0.0, f64::max);
        let top = TITLE_HEIGHT + MARKER_ROW * self.markers.len() as f64;
        let points = || self.lines.iter().flat_map(|line| &line.points);
        let ys = points()
            .flat_map(|point| [point.low, point.high])
            .chain(self.thresholds.iter().map(|floor| floor.0));
        let xs = points()
            .map(|point| point.x)
            .chain(self.markers.iter().map(|marker| marker.x));
        let plot = Plot {
            left: LEFT,
            right: WIDTH - legend_width - 2.0 * MARGIN,
            top,
            bottom: top + PLOT_HEIGHT,
            x: self.x.span(xs),
            y: self.y.span(ys),
        };
        let size = [WIDTH, plot.bottom + MARGIN_BELOW];
        let mut shapes = Vec::new();
        self.draw_grid(&plot, &mut shapes);
        self.draw_thresholds(&plot, &mut shapes);
        // All bands are drawn before all lines, so that no band hides a line of the chart.
        for (ix, line) in self.lines.iter().enumerate() {
            draw_band(line, color_of(ix), &plot, &mut shapes);
        }
        self.draw_markers(&plot, &mut shapes);
        for (ix, line) in self.lines.iter().enumerate() {
            draw_line(line, ix, &plot, &mut shapes);
        }
        self.draw_titles(&plot, &mut shapes);
        draw_legend(&legend, &plot, &mut shapes);
        Drawing { size, shapes }
    }

    fn draw_grid(&self, plot: &Plot, shapes: &mut Vec<VectorShape>) {
        // This is the x position at which the last drawn label ends. A label that would start
        // before this position is left out, but its grid line is drawn.
        let mut free_from = f64::MIN;
        for (value, label) in &plot.x.ticks {
            let x = plot.x(*value);
            shapes.push(line_between([x, plot.top], [x, plot.bottom], GRID, 1.0));
            let half = 0.5 * text_width(label, TextSize::Normal);
            if x - half < free_from {
                continue;
            }
            free_from = x + half + 6.0;
            shapes.push(text([x, plot.bottom + 14.0], label, INK, Anchor::Middle));
        }
        for (value, label) in &plot.y.ticks {
            let y = plot.y(*value);
            shapes.push(line_between([plot.left, y], [plot.right, y], GRID, 1.0));
            shapes.push(text([plot.left - 8.0, y], label, INK, Anchor::End));
        }
        let corners = [
            [plot.left, plot.top],
            [plot.left, plot.bottom],
            [plot.right, plot.bottom],
        ];
        shapes.push(VectorShape::Line {
            points: corners.to_vec(),
            color: FAINT_INK,
            width: 1.0,
            dash: None,
        });
    }

    fn draw_thresholds(&self, plot: &Plot, shapes: &mut Vec<VectorShape>) {
        for (value, _) in &self.thresholds {
            let y = plot.y(*value);
            let points = vec![[plot.left, y], [plot.right, y]];
            shapes.push(VectorShape::Line {
                points,
                color: FAINT_INK,
                width: 1.2,
                dash: Some([2.0, 3.0]),
            });
        }
    }

    /// Each marker has its own row above the plot, so that labels do not overlap.
    fn draw_markers(&self, plot: &Plot, shapes: &mut Vec<VectorShape>) {
        for (row, marker) in self.markers.iter().enumerate() {
            let x = plot.x(marker.x);
            let color = color_of(marker.line_ix);
            let y = TITLE_HEIGHT + MARKER_ROW * (row as f64 + 0.4);
            let points = vec![[x, y + 7.0], [x, plot.bottom]];
            shapes.push(VectorShape::Line {
                points,
                color,
                width: 1.2,
                dash: Some([5.0, 4.0]),
            });
            // The label is centered on its line, but stays inside the plot.
            let half = 0.5 * text_width(&marker.label, TextSize::Normal);
            let center = x.min(plot.right - half).max(plot.left + half);
            shapes.push(text([center, y], &marker.label, color, Anchor::Middle));
        }
    }

    fn draw_titles(&self, plot: &Plot, shapes: &mut Vec<VectorShape>) {
        shapes.push(VectorShape::Text {
            at: [LEFT, 20.0],
            text: self.title.clone(),
            color: INK,
            size: TextSize::Title,
            anchor: Anchor::Start,
            vertical: false,
        });
        shapes.push(text([LEFT, 40.0], &self.subtitle, FAINT_INK, Anchor::Start));
        let middle = 0.5 * (plot.left + plot.right);
        shapes.push(text(
            [middle, plot.bottom + 38.0],
            &self.x.label,
            INK,
            Anchor::Middle,
        ));
        shapes.push(VectorShape::Text {
            at: [18.0, 0.5 * (plot.top + plot.bottom)],
            text: self.y.label.clone(),
            color: INK,
            size: TextSize::Normal,
            anchor: Anchor::Middle,
            vertical: true,
        });
    }

    fn legend(&self) -> Vec<Entry> {
        let lines = self.lines.iter().enumerate().map(|(ix, line)| Entry {
            swatch: Swatch::Line {
                ix,
                is_peer: line.is_peer,
            },
            rows: wrap(&line.label, MAX_LEGEND_CHARS),
        });
        let thresholds = self.thresholds.iter();
        let thresholds = thresholds.map(|(_, label)| Entry {
            swatch: Swatch::Threshold,
            rows: wrap(label, MAX_LEGEND_CHARS),
        });
        lines.chain(thresholds).collect()
    }
}

/// One entry of the legend.
struct Entry {
    swatch: Swatch,
    rows: Vec<String>,
}

enum Swatch {
    Line { ix: usize, is_peer: bool },
    Threshold,
}

fn draw_legend(legend: &[Entry], plot: &Plot, shapes: &mut Vec<VectorShape>) {
    let left = plot.right + MARGIN;
    let mut y = plot.top + 8.0;
    for entry in legend {
        let points = vec![[left, y], [left + 24.0, y]];
        match entry.swatch {
            Swatch::Line { ix, is_peer } => {
                let dash = is_peer.then_some(PEER_DASH);
                shapes.push(VectorShape::Line {
                    points,
                    color: color_of(ix),
                    width: 2.0,
                    dash,
                });
                draw_dot([left + 12.0, y], ix, shapes);
            }
            Swatch::Threshold => {
                shapes.push(VectorShape::Line {
                    points,
                    color: FAINT_INK,
                    width: 1.2,
                    dash: Some([2.0, 3.0]),
                });
            }
        }
        for row in &entry.rows {
            shapes.push(text([left + LEGEND_SWATCH, y], row, INK, Anchor::Start));
            y += LEGEND_ROW;
        }
        y += 6.0;
    }
}

/// Lines with more points are thinner and have no dots, which would hide the line.
const MAX_DOTS: usize = 100;
const PEER_DASH: [f64; 2] = [6.0, 3.0];

fn color_of(line_ix: usize) -> Color {
    COLORS[line_ix % COLORS.len()]
}

fn draw_band(line: &Line, color: Color, plot: &Plot, shapes: &mut Vec<VectorShape>) {
    if line.points.len() < 2
        || line
            .points
            .iter()
            .all(|point| point.low == point.high || !point.y.is_finite())
    {
        return;
    }
    let above = line
        .points
        .iter()
        .map(|point| [plot.x(point.x), plot.y(point.high)]);
    let below = line
        .points
        .iter()
        .rev()
        .map(|point| [plot.x(point.x), plot.y(point.low)]);
    shapes.push(VectorShape::Area {
        points: above.chain(below).collect(),
        color,
        opacity_frac: 0.2,
    });
}

/// Draws a line, with gaps at points that are not finite.
fn draw_line(line: &Line, ix: usize, plot: &Plot, shapes: &mut Vec<VectorShape>) {
    let dash = line.is_peer.then_some(PEER_DASH);
    let is_dense = line.points.len() > MAX_DOTS;
    let width = if is_dense { 1.4 } else { 2.0 };
    for part in line.points.split(|point| !point.y.is_finite()) {
        let points: Vec<[f64; 2]> = part.iter().map(|point| plot.at(point)).collect();
        if points.len() > 1 {
            shapes.push(VectorShape::Line {
                points: points.clone(),
                color: color_of(ix),
                width,
                dash,
            });
        }
        if !is_dense {
            points.into_iter().for_each(|at| draw_dot(at, ix, shapes));
        }
    }
}

/// Draws a dot whose shape identifies the line. The shapes are disc, square, triangle and diamond.
fn draw_dot([x, y]: [f64; 2], line_ix: usize, shapes: &mut Vec<VectorShape>) {
    // Each shape has a number of corners, the direction of the first corner as a fraction of a
    // turn, and a radius. The shapes have about the same area. A shape with 24 corners looks like a
    // circle.
    let (n_corners, first_angle_frac, radius) = [
        (24, 0.0, 3.6),
        (4, 0.125, 4.6),
        (3, 0.75, 5.2),
        (4, 0.0, 5.0),
    ][line_ix % 4];
    let mut points = Vec::new();
    for ix in 0_u32..n_corners {
        let angle =
            std::f64::consts::TAU * (f64::from(ix) / f64::from(n_corners) + first_angle_frac);
        points.push([x + radius * angle.cos(), y + radius * angle.sin()]);
    }
    shapes.push(VectorShape::Area {
        points,
        color: color_of(line_ix),
        opacity_frac: 1.0,
    });
}

fn line_between(from: [f64; 2], to: [f64; 2], color: Color, width: f64) -> VectorShape {
    VectorShape::Line {
        points: vec![from, to],
        color,
        width,
        dash: None,
    }
}

fn text(at: [f64; 2], text: &str, color: Color, anchor: Anchor) -> VectorShape {
    VectorShape::Text {
        at,
        text: text.to_owned(),
        color,
        size: TextSize::Normal,
        anchor,
        vertical: false,
    }
}

/// Wraps text into rows of at most `max_chars`. Rows break after spaces. A word that is longer than
/// a row breaks anywhere.
fn wrap(text: &str, max_chars: usize) -> Vec<String> {
    let mut rows = vec![String::new()];
    for word in text.split_inclusive(' ') {
        let mut left: Vec<char> = word.chars().collect();
        while !left.is_empty() {
            let row = rows.last_mut().expect("there is always a row");
            let n_used = row.chars().count();
            let n_word = left.iter().filter(|letter| **letter != ' ').count();
            if n_used > 0 && n_used + n_word > max_chars {
                rows.push(String::new());
                continue;
            }
            // A word ends with a space, which is removed at the end of a row. Until the space is
            // removed, a row may have one character more than the maximum.
            row.extend(left.drain(..left.len().min(max_chars + 1 - n_used.min(max_chars))));
        }
    }
    rows.iter().map(|row| row.trim_end().to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_labels_are_wrapped() {
        assert_eq!(wrap("sa, splat", 26), ["sa, splat"]);
        assert_eq!(wrap("one two three", 8), ["one two", "three"]);
        let rows = wrap(&"x".repeat(60), 26);
        assert!(rows.iter().all(|row| row.len() <= 27), "{rows:?}");
        assert_eq!(rows.concat(), "x".repeat(60));
    }

    #[test]
    fn drawing_stays_in_bounds() {
        let point = |x: f64, y: f64| Point {
            x,
            y,
            low: y - 1.0,
            high: y + 0.5,
        };
        let line = |label: &str| Line {
            label: label.into(),
            points: vec![point(0.25, 11.0), point(60.0, 36.0)],
            is_peer: false,
        };
        let chart = Chart {
            title: "A title".into(),
            subtitle: "median".into(),
            x: Axis {
                label: "seconds".into(),
                scale: Scale::Log,
                ticks: vec![0.25, 1.0, 60.0],
            },
            y: Axis {
                label: "PSNR, dB".into(),
                scale: Scale::Linear,
                ticks: Vec::new(),
            },
            lines: vec![line("a"), line("a much longer name of some other data")],
            thresholds: Vec::new(),
            markers: vec![Marker {
                x: 60.0,
                label: "a long word about the very end".into(),
                line_ix: 0,
            }],
        };
        let drawing = chart.draw();
        let [width, height] = drawing.size;
        for shape in &drawing.shapes {
            let (points, padding) = match shape {
                VectorShape::Line { points, .. } | VectorShape::Area { points, .. } => {
                    (points.clone(), 0.0)
                }
                VectorShape::Text {
                    at,
                    text,
                    size,
                    anchor,
                    vertical,
                    ..
                } => {
                    let padding = if *vertical {
                        0.0
                    } else {
                        text_width(text, *size)
                    };
                    let from = match anchor {
                        Anchor::Start => 0.0,
                        Anchor::Middle => -0.5 * padding,
                        Anchor::End => -padding,
                    };
                    (vec![[at[0] + from, at[1]]], padding)
                }
            };
            for [x, y] in points {
                assert!(
                    x >= 0.0 && x + padding <= width && (0.0..=height).contains(&y),
                    "{shape:?}"
                );
            }
        }
    }

    #[test]
    fn an_empty_chart_can_be_drawn() {
        let axis = |scale| Axis {
            label: "x".into(),
            scale,
            ticks: Vec::new(),
        };
        let chart = Chart {
            title: "nothing yet".into(),
            subtitle: String::new(),
            x: axis(Scale::Log),
            y: axis(Scale::Linear),
            lines: Vec::new(),
            thresholds: Vec::new(),
            markers: Vec::new(),
        };
        let drawing = chart.draw();
        assert!(!drawing.svg().contains("NaN"));
        assert!(raster::png(&drawing).is_ok());
    }
}
