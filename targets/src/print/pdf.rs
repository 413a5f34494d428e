//! Writes PDF files of one page with filled shapes, lines and text.
//!
//! Source: PDF 1.4 reference, sections 3.4 (file structure), 4.4 (paths) and 5.2 (text).

use std::fmt::Write;

/// Points per millimeter. PDF measures in points of 1/72 inch.
const POINTS_PER_MM: f64 = 72.0 / 25.4;

/// A page. Positions are millimeters from the upper left corner.
#[derive(Clone, Debug)]
pub(super) struct Page {
    size_mm: [f64; 2],
    content: String,
}

impl Page {
    pub(super) fn new(size_mm: [f64; 2]) -> Self {
        Self {
            size_mm,
            content: String::new(),
        }
    }

    fn point(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        // The origin of PDF pages is at the lower left, and y points up.
        [x * POINTS_PER_MM, (self.size_mm[1] - y) * POINTS_PER_MM]
    }

    fn operator(&mut self, numbers: &[f64], operator: &str) {
        for number in numbers {
            // Four digits are 35 nanometers.
            let _ = write!(self.content, "{number:.4} ");
        }
        self.content.push_str(operator);
        self.content.push('\n');
    }

    /// Sets the gray value of everything that is drawn afterwards, from 0 (black) to 1 (white).
    pub(super) fn set_gray(&mut self, gray: f64) {
        // PDF has one operator for filling and another operator for lines.
        self.operator(&[gray], "g");
        self.operator(&[gray], "G");
    }

    /// Fills rectangles (smallest x and y, largest x and y) as one path, so that common sides leave
    /// no gap.
    pub(super) fn fill_rectangles(&mut self, rectangles: &[[[f64; 2]; 2]]) {
        for [low, high] in rectangles {
            let [x, y] = self.point([low[0], high[1]]);
            let size = [0, 1].map(|axis| (high[axis] - low[axis]) * POINTS_PER_MM);
            self.operator(&[x, y, size[0], size[1]], "re");
        }
        if !rectangles.is_empty() {
            self.operator(&[], "f");
        }
    }

    /// Fills a disk. Its outline is made of four cubic curves, accurate to 0.03 % of the radius.
    pub(super) fn fill_disk(&mut self, center: [f64; 2], radius: f64) {
        const HANDLE: f64 = 0.552_284_75; // 4 / 3 (sqrt(2) - 1)
        let [x, y] = self.point(center);
        let r = radius * POINTS_PER_MM;
        let h = r * HANDLE;
        self.operator(&[x + r, y], "m");
        self.operator(&[x + r, y + h, x + h, y + r, x, y + r], "c");
        self.operator(&[x - h, y + r, x - r, y + h, x - r, y], "c");
        self.operator(&[x - r, y - h, x - h, y - r, x, y - r], "c");
        self.operator(&[x + h, y - r, x + r, y - h, x + r, y], "c");
        self.operator(&[], "f");
    }

    /// Draws a line.
    pub(super) fn line(&mut self, from: [f64; 2], to: [f64; 2], width_mm: f64) {
        let from = self.point(from);
        let to = self.point(to);
        self.operator(&[width_mm * POINTS_PER_MM], "w");
        self.operator(&from, "m");
        self.operator(&to, "l");
        self.operator(&[], "S");
    }

    /// Writes text in Helvetica, starting at the left end of its baseline.
    pub(super) fn text(&mut self, at: [f64; 2], size_mm: f64, text: &str) {
        let [x, y] = self.point(at);
        // The font is used with its built-in encoding, in which only ASCII is safe.
        let printable = text
            .chars()
            .filter(|character| character.is_ascii_graphic() || *character == ' ');
        let mut escaped = String::new();
        for character in printable {
            if matches!(character, '(' | ')' | '\\') {
                escaped.push('\\');
            }
            escaped.push(character);
        }
        let _ = writeln!(
            self.content,
            "BT /F1 {:.3} Tf {x:.4} {y:.4} Td ({escaped}) Tj ET",
            size_mm * POINTS_PER_MM
        );
    }

    /// The file.
    pub(super) fn into_pdf(self, title: &str) -> Vec<u8> {
        let [width, height] = self.size_mm.map(|side| side * POINTS_PER_MM);
        let title: String = title
            .chars()
            .filter(|character| character.is_ascii_alphanumeric() || " :.x_-".contains(*character))
            .collect();
        // Objects are numbered from 1 in this order, and refer to each other by these numbers.
        let objects = [
            // Printer dialogs that respect this preference do not scale the page.
            "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>"
                .to_owned(),
            "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
            format!(
                "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4} {height:.4}] /Contents 4 0 R \
                 /Resources << /Font << /F1 5 0 R >> >> >>"
            ),
            format!(
                "<< /Length {} >>\nstream\n{}endstream",
                self.content.len(),
                self.content
            ),
            "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>".to_owned(),
            format!("<< /Title ({title}) /Producer (fieldrig) >>"),
        ];
        let mut file = String::from("%PDF-1.4\n");
        let mut offsets = Vec::new();
        for (number, object) in (1..).zip(&objects) {
            offsets.push(file.len());
            let _ = write!(file, "{number} 0 obj\n{object}\nendobj\n");
        }
        // The table of positions follows. Readers start with the position of this table, which is
        // at the end of the file. Each entry has exactly 20 bytes, and object 0 heads the list of
        // free objects.
        let start = file.len();
        let n = objects.len() + 1;
        let _ = write!(file, "xref\n0 {n}\n0000000000 65535 f \n");
        for offset in offsets {
            let _ = writeln!(file, "{offset:010} 00000 n ");
        }
        let _ = write!(
            file,
            "trailer\n<< /Size {n} /Root 1 0 R /Info 6 0 R >>\nstartxref\n{start}\n%%EOF\n"
        );
        file.into_bytes()
    }
}
