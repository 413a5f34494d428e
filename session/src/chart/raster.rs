//! Draws a drawing as a PNG image. The bitmap font is part of the program, so no system fonts are needed.

use super::drawing::{Anchor, Color, Drawing, TextSize, VectorShape};
use crate::error::Context;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use tiny_skia::{FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Stroke, StrokeDash, Transform};

/// Pixels per unit of the drawing; the font heights match it.
const PIXELS_PER_UNIT: u32 = 2;

fn raster_height(size: TextSize) -> RasterHeight {
    match size {
        TextSize::Normal => RasterHeight::Size24,
        TextSize::Title => RasterHeight::Size32,
    }
}

/// Width of a text in units of the drawing; the font is monospaced.
pub fn text_width(text: &str, size: TextSize) -> f64 {
    let width = get_raster_width(FontWeight::Regular, raster_height(size)) as f64;
    text.chars().count() as f64 * width / f64::from(PIXELS_PER_UNIT)
}

/// The drawing as the bytes of a PNG file.
pub fn png(drawing: &Drawing) -> crate::Result<Vec<u8>> {
    #[expect(clippy::cast_possible_truncation, reason = "a chart is a few thousand pixels wide")]
    let [width, height] = drawing.size.map(|units| (units.ceil() as u32) * PIXELS_PER_UNIT);
    let mut picture = Pixmap::new(width, height).context("a chart has a size")?;
    picture.fill(tiny_skia::Color::WHITE);
    for shape in &drawing.shapes {
        match shape {
            VectorShape::Line { points, color, width, dash } => line(&mut picture, points, *color, *width, *dash),
            VectorShape::Area { points, color, opacity_frac } => area(&mut picture, points, *color, *opacity_frac),
            VectorShape::Text { at, text, color, size, anchor, vertical } => {
                let start = match anchor {
                    Anchor::Start => 0.0,
                    Anchor::Middle => -0.5 * text_width(text, *size),
                    Anchor::End => -text_width(text, *size),
                };
                TextRun { at: *at, start, color: *color, size: *size, vertical: *vertical }.draw(&mut picture, text);
            }
        }
    }
    let mut file = Vec::new();
    PngEncoder::new(&mut file)
        .write_image(picture.data(), width, height, ExtendedColorType::Rgba8)
        .context("cannot encode a chart as PNG")?;
    Ok(file)
}

fn line(picture: &mut Pixmap, points: &[[f64; 2]], color: Color, width: f64, dash: Option<[f64; 2]>) {
    let Some(path) = path(points, false) else { return };
    let dash = dash.and_then(|lengths| StrokeDash::new(lengths.map(to_f32).to_vec(), 0.0));
    let (line_cap, line_join) = (LineCap::Butt, LineJoin::Round);
    let stroke = Stroke { width: to_f32(width), dash, line_cap, line_join, ..Stroke::default() };
    picture.stroke_path(&path, &paint(color, 1.0), &stroke, to_pixels(), None);
}

fn area(picture: &mut Pixmap, points: &[[f64; 2]], color: Color, opacity_frac: f64) {
    let Some(path) = path(points, true) else { return };
    picture.fill_path(&path, &paint(color, opacity_frac), FillRule::Winding, to_pixels(), None);
}

fn path(points: &[[f64; 2]], closed: bool) -> Option<Path> {
    let mut path = PathBuilder::new();
    for (ix, point) in points.iter().enumerate() {
        let [x, y] = point.map(to_f32);
        if ix == 0 { path.move_to(x, y) } else { path.line_to(x, y) }
    }
    if closed {
        path.close();
    }
    path.finish()
}

fn paint([red, green, blue]: Color, opacity_frac: f64) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color_rgba8(red, green, blue, byte(255.0 * opacity_frac));
    paint
}

fn to_pixels() -> Transform {
    let scale = PIXELS_PER_UNIT as f32;
    Transform::from_scale(scale, scale)
}

/// One line of text to draw.
struct TextRun {
    at: [f64; 2],
    /// Offset of the start of the text from `at`, along the text.
    start: f64,
    color: Color,
    size: TextSize,
    vertical: bool,
}

impl TextRun {
    fn draw(&self, picture: &mut Pixmap, text: &str) {
        let height = raster_height(self.size);
        let mut cursor = pixel(self.start);
        for letter in text.chars() {
            let glyph = get_raster(letter, FontWeight::Regular, height)
                .or_else(|| get_raster('?', FontWeight::Regular, height))
                .expect("the font has a question mark");
            for (row, opacities) in glyph.rows().enumerate() {
                for (column, opacity) in opacities.iter().enumerate() {
                    let right = cursor + column as i64;
                    let down = row as i64 - height.val() as i64 / 2;
                    self.blend(picture, right, down, *opacity);
                }
            }
            cursor += glyph.width() as i64;
        }
    }

    /// Blends the color into one pixel; `right` and `down` are relative to `at`, in the direction of the text.
    fn blend(&self, picture: &mut Pixmap, right: i64, down: i64, opacity: u8) {
        let [x, y] = self.at.map(pixel);
        let [x, y] = if self.vertical { [x + down, y - right] } else { [x + right, y + down] };
        let (width, height) = (i64::from(picture.width()), i64::from(picture.height()));
        if opacity == 0 || !(0..width).contains(&x) || !(0..height).contains(&y) {
            return;
        }
        let first = usize::try_from(4 * (y * width + x)).expect("inside the picture");
        let alpha = f64::from(opacity) / 255.0;
        for (under, over) in picture.data_mut()[first..first + 3].iter_mut().zip(self.color) {
            *under = byte(f64::from(*under) * (1.0 - alpha) + f64::from(over) * alpha);
        }
    }
}

#[expect(clippy::cast_possible_truncation, reason = "pictures are drawn in f32")]
fn to_f32(value: f64) -> f32 {
    value as f32
}

#[expect(clippy::cast_possible_truncation, reason = "casts of floats saturate")]
fn byte(value: f64) -> u8 {
    value.round() as u8
}

#[expect(clippy::cast_possible_truncation, reason = "casts of floats saturate")]
fn pixel(units: f64) -> i64 {
    (units * f64::from(PIXELS_PER_UNIT)).round() as i64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_and_text_are_rasterized() {
        let color = [213, 94, 0];
        let (size, anchor) = (TextSize::Normal, Anchor::Middle);
        let text = |at, vertical| VectorShape::Text { at, text: "H".into(), color, size, anchor, vertical };
        let shapes = vec![
            VectorShape::Line { points: vec![[0.0, 2.0], [40.0, 2.0]], color, width: 2.0, dash: None },
            VectorShape::Area {
                points: vec![[0.0, 30.0], [10.0, 30.0], [10.0, 40.0], [0.0, 40.0]],
                color,
                opacity_frac: 0.5,
            },
            text([20.0, 15.0], false),
            text([1000.0, 15.0], true),
        ];
        let file = png(&Drawing { size: [40.0, 40.0], shapes }).expect("a picture");
        let picture = image::load_from_memory(&file).expect("a PNG file").into_rgb8();
        assert_eq!(picture.dimensions(), (80, 80));
        assert_eq!(picture.get_pixel(40, 4).0, color);
        let half = picture.get_pixel(5, 70).0;
        // Halfway to white, rounded either way.
        assert!(half.iter().zip([234, 175, 128]).all(|(got, expected)| got.abs_diff(expected) <= 1), "{half:?}");
        assert_eq!(picture.get_pixel(60, 70).0, [255; 3]);
        let inked = |x: std::ops::Range<u32>, y: std::ops::Range<u32>| {
            x.flat_map(|x| y.clone().map(move |y| (x, y)))
                .filter(|(x, y)| picture.get_pixel(*x, *y).0 != [255; 3])
                .count()
        };
        assert!(inked(33..47, 18..42) > 40, "no letter");
        assert_eq!(inked(50..80, 8..80), 0, "ink outside the letter");
    }
}
