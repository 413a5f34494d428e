//! Rasterizes a drawing to PNG. The font is built into the program, so no system fonts are needed.

use super::drawing::{Drawing, TextSize};
use anyhow::Context;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use resvg::tiny_skia::{Color, Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb};
use std::sync::{Arc, LazyLock};

/// The Latin letters of Noto Sans Mono 2.014, under the SIL Open Font License in `font/OFL.txt`.
const FONT: &[u8] = include_bytes!("font/NotoSansMono-Latin.ttf");
const FONT_FAMILY: &str = "Noto Sans Mono";
/// Width of every letter of the monospaced font, as a fraction of the font size.
const LETTER_WIDTH_FRAC: f64 = 0.6;
/// Pixels per unit of the drawing. Screens with a high resolution show two pixels per CSS pixel.
const PIXELS_PER_UNIT: u32 = 2;

/// The built-in font, which replaces all sans-serif fonts.
static FONTS: LazyLock<Arc<fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = fontdb::Database::new();
    fonts.load_font_data(FONT.to_vec());
    fonts.set_sans_serif_family(FONT_FAMILY);
    Arc::new(fonts)
});

/// Width of a text in units of the drawing.
pub fn text_width(text: &str, size: TextSize) -> f64 {
    text.chars().count() as f64 * LETTER_WIDTH_FRAC * size.height()
}

/// The drawing as the bytes of a PNG file.
pub fn png(drawing: &Drawing) -> anyhow::Result<Vec<u8>> {
    let options = Options {
        fontdb: Arc::clone(&FONTS),
        ..Options::default()
    };
    let tree =
        Tree::from_str(&drawing.svg(), &options).context("cannot read the SVG of a chart")?;
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a chart is a few thousand pixels wide"
    )]
    let [width, height] = drawing
        .size
        .map(|units| (units.ceil() as u32) * PIXELS_PER_UNIT);
    let mut picture = Pixmap::new(width, height).context("a chart is empty or too large")?;
    picture.fill(Color::WHITE);
    let scale = PIXELS_PER_UNIT as f32;
    resvg::render(
        &tree,
        Transform::from_scale(scale, scale),
        &mut picture.as_mut(),
    );
    let mut file = Vec::new();
    PngEncoder::new(&mut file)
        .write_image(picture.data(), width, height, ExtendedColorType::Rgba8)
        .context("cannot encode a chart as PNG")?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::drawing::{Anchor, VectorShape};

    #[test]
    fn shapes_and_text_are_rasterized() {
        let color = [213, 94, 0];
        let (size, anchor) = (TextSize::Normal, Anchor::Middle);
        let text = |at, vertical| VectorShape::Text {
            at,
            text: "H".into(),
            color,
            size,
            anchor,
            vertical,
        };
        let shapes = vec![
            VectorShape::Line {
                points: vec![[0.0, 2.0], [40.0, 2.0]],
                color,
                width: 2.0,
                dash: None,
            },
            VectorShape::Area {
                points: vec![[0.0, 30.0], [10.0, 30.0], [10.0, 40.0], [0.0, 40.0]],
                color,
                opacity_frac: 0.5,
            },
            text([20.0, 15.0], false),
            text([1000.0, 15.0], true),
        ];
        let file = png(&Drawing {
            size: [40.0, 40.0],
            shapes,
        })
        .expect("a picture");
        let picture = image::load_from_memory(&file)
            .expect("a PNG file")
            .into_rgb8();
        assert_eq!(picture.dimensions(), (80, 80));
        assert_eq!(picture.get_pixel(40, 4).0, color);
        let half = picture.get_pixel(5, 70).0;
        // Halfway to white, rounded either way.
        assert!(
            half.iter()
                .zip([234, 175, 128])
                .all(|(got, expected)| got.abs_diff(expected) <= 1),
            "{half:?}"
        );
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
