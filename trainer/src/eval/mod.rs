//! Metrics that compare a rendered picture with the truth: PSNR, SSIM, LPIPS and depth error.

mod depth;
#[cfg(feature = "lpips")]
mod lpips;
#[cfg(not(feature = "lpips"))]
mod no_lpips;
mod psnr;
mod ssim;

pub use depth::{SurfaceError, depth_rmse_m, surface_error};
#[cfg(feature = "lpips")]
pub use lpips::Lpips;
#[cfg(not(feature = "lpips"))]
pub use no_lpips::Lpips;
pub use psnr::psnr;
pub use ssim::ssim;

use crate::Error;

/// Two pictures of equal size to be compared, `[height, width, 4]`, 8-bit sRGB.
///
/// Pixels whose alpha in the truth is 0 are masked and do not count. The alpha of the rendered
/// picture is ignored.
#[derive(Clone, Copy, Debug)]
pub struct PixelPair<'a> {
    size_px: [u32; 2],
    rendered_rgba: &'a [u8],
    truth_rgba: &'a [u8],
}

impl<'a> PixelPair<'a> {
    /// Pairs two pictures. Fails if either does not have width x height x 4 bytes.
    pub fn new(
        size_px: [u32; 2],
        rendered_rgba: &'a [u8],
        truth_rgba: &'a [u8],
    ) -> Result<Self, Error> {
        let expected = size_px[0] as usize * size_px[1] as usize * 4;
        for (what, bytes) in [("rendered", rendered_rgba), ("true", truth_rgba)] {
            if bytes.len() != expected {
                let [width, height] = size_px;
                return Err(Error::PictureBytes {
                    what,
                    width,
                    height,
                    got: bytes.len(),
                    expected,
                });
            }
        }
        Ok(Self {
            size_px,
            rendered_rgba,
            truth_rgba,
        })
    }

    /// Fails if a side is shorter than `min_px`, the minimum of `metric`.
    fn require_side(&self, metric: &'static str, min_px: u32) -> Result<(), Error> {
        let [width, height] = self.size_px;
        if width < min_px || height < min_px {
            return Err(Error::PictureTooSmall {
                metric,
                min_px,
                width,
                height,
            });
        }
        Ok(())
    }

    /// Whether the truth is not masked at this pixel.
    fn is_visible(&self, pixel_ix: usize) -> bool {
        self.truth_rgba[4 * pixel_ix + 3] != 0
    }
}

#[cfg(test)]
mod oracle;
