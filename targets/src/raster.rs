//! Pictures of targets in pixels, for tests and as textures.

use crate::error::PrintError;
use crate::spec::{Pattern, TargetSpec};
use crate::surface::{Surface, pixel_mean};

/// Largest side of a picture, pixels. A square picture of this size has 256 MiB.
const MAX_SIDE_PX: u32 = 16_384;

/// A picture of a target.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    /// Width and height in pixels.
    pub size_px: [u32; 2],
    /// One byte per pixel, row by row from the top left. A value of 0 is black, and 255 is white.
    pub pixels: Vec<u8>,
    /// Position of the upper left corner of the picture in the board frame, meters.
    pub origin_m: [f64; 2],
    /// Resolution. Pixel position `p` shows the point `origin_m + p / px_per_m`.
    pub px_per_m: f64,
}

impl TargetSpec {
    /// White margin that pictures have around the pattern, meters.
    fn margin_m(&self) -> f64 {
        let [low, high] = self.bounds_m();
        // A single tag has no squares around its corners, so the margin is needed to detect them.
        let frac = if matches!(self.pattern, Pattern::Tag { .. }) {
            0.2
        } else {
            0.05
        };
        frac * (high[0] - low[0]).min(high[1] - low[1])
    }

    /// Draws the target with a white margin. The gray value of a pixel on an edge is proportional
    /// to its white part.
    ///
    /// # Errors
    /// Fails if the resolution is not a positive number or the picture would be larger than 16384
    /// pixels.
    pub fn raster(&self, px_per_m: f64) -> Result<Raster, PrintError> {
        let [low, high] = self.bounds_m();
        let margin_m = self.margin_m();
        let side_px =
            [0, 1].map(|axis| ((high[axis] - low[axis] + 2.0 * margin_m) * px_per_m).ceil());
        // Comparisons with NaN are false, so NaN is also rejected.
        let is_valid = px_per_m > 0.0
            && side_px
                .iter()
                .all(|&side| side >= 1.0 && side <= f64::from(MAX_SIDE_PX));
        if !is_valid {
            return Err(PrintError::Resolution {
                px_per_m,
                size_px: side_px,
                max: MAX_SIDE_PX,
            });
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "checked to be small and positive"
        )]
        let size_px = side_px.map(|side| side as u32);
        let origin_m = low.map(|value| value - margin_m);
        let surface = self.surface();
        let pixels =
            (0..size_px[1]).flat_map(|row| (0..size_px[0]).map(move |column| [column, row]));
        let pixels = pixels
            .map(|cell| white_part(&surface, cell, origin_m, px_per_m))
            .collect();
        Ok(Raster {
            size_px,
            pixels,
            origin_m,
            px_per_m,
        })
    }
}

/// The part of a pixel that is white, 0 to 255.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "between 0 and 255"
)]
fn white_part(surface: &Surface<'_>, cell: [u32; 2], origin_m: [f64; 2], px_per_m: f64) -> u8 {
    let [column, row] = cell.map(f64::from);
    let mean = pixel_mean(|x, y| {
        let point = [
            origin_m[0] + (column + x) / px_per_m,
            origin_m[1] + (row + y) / px_per_m,
        ];
        f64::from(u8::from(!surface.is_black(point)))
    });
    (255.0 * mean).round() as u8
}
