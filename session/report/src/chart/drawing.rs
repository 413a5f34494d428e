//! A drawing as plain data, which consists of lines, areas and text. Its units are pixels of the
//! SVG file.

use std::fmt::Write;

/// `[red, green, blue]`, sRGB.
pub type Color = [u8; 3];

/// Text sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TextSize {
    /// Labels and numbers.
    Normal,
    /// The title of a chart.
    Title,
}

impl TextSize {
    /// Font size.
    pub fn height(self) -> f64 {
        match self {
            Self::Normal => 12.0,
            Self::Title => 16.0,
        }
    }
}

/// Which part of a text is at its position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// The text begins at the position.
    Start,
    /// The text is centered on the position.
    Middle,
    /// The text ends at the position.
    End,
}

/// A shape. The y axis points down.
#[derive(Clone, Debug, PartialEq)]
pub enum VectorShape {
    /// A line through points.
    Line {
        /// Corners, units.
        points: Vec<[f64; 2]>,
        /// Color of the line.
        color: Color,
        /// Width of the line, units.
        width: f64,
        /// Lengths of dashes and gaps, units. `None` for a solid line.
        dash: Option<[f64; 2]>,
    },
    /// A filled polygon.
    Area {
        /// Corners, units.
        points: Vec<[f64; 2]>,
        /// Color of the area.
        color: Color,
        /// Opacity, 0 to 1.
        opacity_frac: f64,
    },
    /// One line of text.
    Text {
        /// Position of the anchor, units. Vertically, the anchor is in the middle of the line.
        at: [f64; 2],
        /// The text.
        text: String,
        /// Color of the letters.
        color: Color,
        /// Size of the letters.
        size: TextSize,
        /// The part of the text that is at the position.
        anchor: Anchor,
        /// Whether the text runs from bottom to top.
        vertical: bool,
    },
}

/// Shapes in drawing order, on a white background.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawing {
    /// Width and height, units.
    pub size: [f64; 2],
    /// The shapes, from back to front.
    pub shapes: Vec<VectorShape>,
}

impl Drawing {
    /// The drawing as an SVG file. Text is kept as text, so that it can be searched and read aloud.
    pub fn svg(&self) -> String {
        let [width, height] = self.size;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
             font-family=\"DejaVu Sans,Verdana,sans-serif\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
        );
        for shape in &self.shapes {
            svg.push_str(&element(shape));
        }
        svg.push_str("</svg>\n");
        svg
    }
}

fn element(shape: &VectorShape) -> String {
    match shape {
        VectorShape::Line {
            points,
            color,
            width,
            dash,
        } => {
            let dash = dash.map_or(String::new(), |[dash, gap]| {
                format!(" stroke-dasharray=\"{dash} {gap}\"")
            });
            format!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"{dash}/>\n",
                coordinates(points),
                hex(*color)
            )
        }
        VectorShape::Area {
            points,
            color,
            opacity_frac,
        } => {
            let opacity = if *opacity_frac < 1.0 {
                format!(" fill-opacity=\"{opacity_frac}\"")
            } else {
                String::new()
            };
            format!(
                "<polygon points=\"{}\" fill=\"{}\"{opacity}/>\n",
                coordinates(points),
                hex(*color)
            )
        }
        VectorShape::Text {
            at: [x, y],
            text,
            color,
            size,
            anchor,
            vertical,
        } => {
            let anchor = match anchor {
                Anchor::Start => "start",
                Anchor::Middle => "middle",
                Anchor::End => "end",
            };
            let rotation = if *vertical {
                format!(" transform=\"rotate(-90 {x:.2} {y:.2})\"")
            } else {
                String::new()
            };
            format!(
                "<text x=\"{x:.2}\" y=\"{y:.2}\" font-size=\"{}\" fill=\"{}\" text-anchor=\"{anchor}\" dominant-baseline=\"central\"{rotation}>{}</text>\n",
                size.height(),
                hex(*color),
                escaped(text)
            )
        }
    }
}

fn coordinates(points: &[[f64; 2]]) -> String {
    let mut text = String::new();
    for [x, y] in points {
        let space = if text.is_empty() { "" } else { " " };
        write!(text, "{space}{x:.2},{y:.2}").expect("writing to a string cannot fail");
    }
    text
}

fn hex([red, green, blue]: Color) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}

/// Escapes text for SVG and HTML, inside elements and quoted attributes.
pub fn escaped(text: &str) -> String {
    // `&` is replaced first. Otherwise, the entities of the other characters would be escaped
    // again.
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn svg_text_is_escaped() {
        let at = [1.0, 2.0];
        let (color, size, anchor) = ([0, 114, 178], TextSize::Normal, Anchor::Start);
        let text = VectorShape::Text {
            at,
            text: "a<b> & \"c\"".into(),
            color,
            size,
            anchor,
            vertical: true,
        };
        let svg = Drawing {
            size: [10.0, 5.0],
            shapes: vec![text],
        }
        .svg();
        assert!(
            svg.contains("a&lt;b&gt; &amp; &quot;c&quot;</text>"),
            "{svg}"
        );
        assert!(
            svg.contains("fill=\"#0072b2\"") && svg.contains("rotate(-90 1.00 2.00)"),
            "{svg}"
        );
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
    }
}
