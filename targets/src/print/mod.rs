//! Prints targets to scale, as vector graphics.

mod paper;
mod pdf;

pub use paper::Paper;

use crate::error::PrintError;
use crate::spec::TargetSpec;
use crate::surface::Shape;
use pdf::Page;

/// Margin that printers cannot print on, millimeters.
const PAGE_MARGIN_MM: f64 = 6.0;
/// Height of the ruler with its caption below the pattern, millimeters.
const FOOTER_MM: f64 = 16.0;
/// Width of the space for the mark at the first corner, left of and above the pattern, millimeters.
const MARK_MM: f64 = 7.0;
/// Text size, millimeters.
const TEXT_MM: f64 = 3.0;

impl TargetSpec {
    /// Returns a PDF file with this target at true scale, a ruler to verify the scale, the axes of
    /// the board frame and a caption.
    ///
    /// # Errors
    /// Fails if the target does not fit the paper in either orientation. The message names a paper
    /// that fits.
    pub fn pdf(&self, paper: Paper) -> Result<Vec<u8>, PrintError> {
        let [low, high] = self.bounds_m();
        let pattern_mm = [0, 1].map(|axis| (high[axis] - low[axis]) * 1e3);
        let need_mm = [
            pattern_mm[0] + 2.0 * (PAGE_MARGIN_MM + MARK_MM),
            pattern_mm[1] + 2.0 * PAGE_MARGIN_MM + MARK_MM + FOOTER_MM,
        ];
        // The tolerance absorbs rounding errors, because a paper of exactly this size must fit.
        let fits = |paper: &Paper| (0..2).all(|axis| need_mm[axis] <= paper.size_mm()[axis] + 1e-6);
        let Some(sheet) = [paper, paper.rotated()].into_iter().find(fits) else {
            return Err(PrintError::TooLarge {
                need_mm,
                paper: paper.to_string(),
                paper_mm: paper.size_mm(),
                suggestion: Paper::for_size(need_mm).to_string(),
            });
        };
        let size_mm = sheet.size_mm();
        // The pattern is centered in the space that mark and ruler leave free.
        let corner_mm = [
            (size_mm[0] - pattern_mm[0]) / 2.0,
            MARK_MM + PAGE_MARGIN_MM + (size_mm[1] - need_mm[1]) / 2.0,
        ];
        let mut page = Page::new(size_mm);
        self.draw_pattern(&mut page, corner_mm);
        draw_axes(&mut page, corner_mm);
        self.draw_footer(&mut page, corner_mm, pattern_mm, size_mm);
        Ok(page.into_pdf(&self.to_string()))
    }

    fn draw_pattern(&self, page: &mut Page, corner_mm: [f64; 2]) {
        let low = self.bounds_m()[0];
        let on_page =
            |point: [f64; 2]| [0, 1].map(|axis| (point[axis] - low[axis]) * 1e3 + corner_mm[axis]);
        let shapes = self.surface().shapes();
        let rectangles: Vec<[[f64; 2]; 2]> = shapes
            .iter()
            .filter_map(|shape| match shape {
                Shape::Rectangle(corners) => Some(corners.map(on_page)),
                Shape::Disk { .. } => None,
            })
            .collect();
        // Rectangles are drawn first, because the dots of puzzleboards cover the squares.
        page.set_gray(0.0);
        page.fill_rectangles(&rectangles);
        for shape in shapes {
            if let Shape::Disk {
                center,
                radius,
                is_black,
            } = shape
            {
                page.set_gray(if is_black { 0.0 } else { 1.0 });
                page.fill_disk(on_page(center), radius * 1e3);
            }
        }
        page.set_gray(0.0);
    }

    fn draw_footer(
        &self,
        page: &mut Page,
        corner_mm: [f64; 2],
        pattern_mm: [f64; 2],
        size_mm: [f64; 2],
    ) {
        const RULERS_MM: [u32; 4] = [100, 50, 20, 10];
        let width_mm = size_mm[0] - 2.0 * PAGE_MARGIN_MM;
        // The label next to the ruler takes 12 mm.
        let is_short = |length: &u32| f64::from(*length) + 12.0 <= width_mm;
        let length = RULERS_MM.into_iter().find(is_short).unwrap_or(RULERS_MM[3]);
        let left = PAGE_MARGIN_MM;
        // The ruler is below the white margin that the detection of outer corners needs.
        let top = corner_mm[1] + pattern_mm[1] + 4.0;
        page.line([left, top], [left + f64::from(length), top], 0.2);
        for at in 0..=length {
            let tick_mm = if at % 10 == 0 {
                3.0
            } else if at % 5 == 0 {
                2.0
            } else {
                1.2
            };
            let x = left + f64::from(at);
            page.line([x, top], [x, top + tick_mm], 0.1);
        }
        page.text(
            [left + f64::from(length) + 1.5, top + 2.5],
            TEXT_MM,
            &format!("{length} mm"),
        );
        page.text([left, top + 7.0], TEXT_MM, &self.to_string());
        page.text(
            [left, top + 11.0],
            TEXT_MM,
            "Print at 100 % (no fit to page); check with the ruler.",
        );
    }
}

/// Draws the directions of the axes of the board frame next to the first corner of the pattern,
/// outside its quiet zone.
fn draw_axes(page: &mut Page, corner_mm: [f64; 2]) {
    const LENGTH_MM: f64 = 8.0;
    const AWAY_MM: f64 = 4.5;
    const TIP_MM: f64 = 1.2;
    let origin = corner_mm.map(|value| value - AWAY_MM);
    let x_end = [origin[0] + LENGTH_MM, origin[1]];
    let y_end = [origin[0], origin[1] + LENGTH_MM];
    for (end, label) in [(x_end, "x"), (y_end, "y")] {
        page.line(origin, end, 0.25);
        // Directions along the axis and across it.
        let along = [0, 1].map(|axis| (end[axis] - origin[axis]) / LENGTH_MM);
        for side in [-0.5, 0.5] {
            let back = [
                end[0] - TIP_MM * (along[0] + side * along[1]),
                end[1] - TIP_MM * (along[1] + side * along[0]),
            ];
            page.line(end, back, 0.25);
        }
        page.text(
            [
                end[0] + if label == "x" { 0.8 } else { -0.7 },
                end[1] + if label == "x" { 0.8 } else { 3.0 },
            ],
            2.5,
            label,
        );
    }
    page.fill_disk(origin, 0.6);
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGETS: [&str; 6] = [
        "chessboard:9x6:20mm",
        "charuco:5x7:34mm:28mm:6X6_250",
        "aprilgrid:5x3:36mm:0.3",
        "puzzleboard:12x8:20mm",
        "tag:36h11:7:100mm",
        "chessboard:3x3:5mm",
    ];
    const MM_PER_POINT: f64 = 25.4 / 72.0;

    fn text(target: &TargetSpec) -> String {
        String::from_utf8(
            target
                .pdf(Paper::A4)
                .unwrap_or_else(|error| panic!("{error}")),
        )
        .unwrap()
    }

    /// Rectangles of the file as x, y, width and height in millimeters.
    fn rectangles(text: &str) -> Vec<[f64; 4]> {
        let numbers = |line: &str| -> Option<[f64; 4]> {
            let parts: Vec<f64> = line
                .strip_suffix(" re")?
                .split(' ')
                .filter_map(|part| part.parse().ok())
                .collect();
            parts.try_into().ok()
        };
        text.lines()
            .filter_map(numbers)
            .map(|values| values.map(|value| value * MM_PER_POINT))
            .collect()
    }

    #[test]
    fn squares_have_their_size_and_place() {
        let target: TargetSpec = TARGETS[0].parse().unwrap();
        let rectangles = rectangles(&text(&target));
        assert_eq!(rectangles.len(), 35); // Half of 10 x 7 squares.
        for [_, _, width, height] in &rectangles {
            assert!(
                (width - 20.0).abs() < 1e-4 && (height - 20.0).abs() < 1e-4,
                "{width} {height}"
            );
        }
        let left = rectangles
            .iter()
            .map(|rectangle| rectangle[0])
            .fold(f64::INFINITY, f64::min);
        let right = rectangles
            .iter()
            .map(|rectangle| rectangle[0] + rectangle[2])
            .fold(0.0, f64::max);
        assert!((right - left - 200.0).abs() < 1e-3, "{left} {right}");
        assert!(
            (left - (297.0 - 200.0) / 2.0).abs() < 1e-3,
            "landscape, centered: {left}"
        );
    }

    #[test]
    fn files_are_consistent_and_captioned() {
        for spec in TARGETS {
            let target: TargetSpec = spec.parse().unwrap();
            let text = text(&target);
            let start: usize = text
                .rsplit("startxref\n")
                .next()
                .unwrap()
                .lines()
                .next()
                .unwrap()
                .parse()
                .unwrap();
            assert!(text[start..].starts_with("xref\n0 7\n"), "{spec}");
            let offsets = text[start..]
                .lines()
                .filter_map(|line| line.strip_suffix(" 00000 n ")?.parse::<usize>().ok());
            for (number, offset) in (1..).zip(offsets) {
                assert!(
                    text[offset..].starts_with(&format!("{number} 0 obj\n")),
                    "{spec} object {number}"
                );
            }
            assert!(
                text.contains(&format!("({spec}) Tj")) && text.contains("Print at 100 %"),
                "{spec}"
            );
            assert!(text.contains("/PrintScaling /None"));
        }
    }

    #[test]
    fn large_targets_are_refused_with_a_paper_that_fits() {
        let target: TargetSpec = "chessboard:9x6:30mm".parse().unwrap();
        let message = target.pdf(Paper::A4).unwrap_err().to_string();
        assert_eq!(
            message,
            "the target needs [326, 245] mm with margins, but a4 has [210, 297] mm; use a3"
        );
        assert!(target.pdf("a3".parse().unwrap()).is_ok());
        assert!(target.pdf("326x245mm".parse().unwrap()).is_ok());
        let huge: TargetSpec = "aprilgrid:6x6:880mm:0.3".parse().unwrap();
        let message = huge.pdf(Paper::A4).unwrap_err().to_string();
        assert!(
            message.ends_with("; use 7160x7160mm") || message.contains("mm; use "),
            "{message}"
        );
    }
}
