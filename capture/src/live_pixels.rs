//! The pixels of a camera image in a form that viewers can show.

use drivers::{Image, PixelFormat};
use keyframe::LivePixels;

/// The pixels of a color image for viewers. `None` for depth images, and for images that do not
/// decode.
#[must_use]
pub fn live_pixels(image: &Image) -> Option<LivePixels> {
    match image.format {
        PixelFormat::Rgb8 => Some(LivePixels::Rgb(image.data.clone())),
        // Some cameras send JPEG without tables, which browsers cannot show.
        PixelFormat::Jpeg => {
            let jpeg = drivers::jpeg::first_image(&image.data).ok()?;
            Some(LivePixels::Jpeg(jpeg.as_ref().into()))
        }
        PixelFormat::Bgr8 | PixelFormat::Gray8 | PixelFormat::Yuv { .. } | PixelFormat::Png => {
            Some(LivePixels::Rgb(image.decode_rgb().ok()?.into()))
        }
        PixelFormat::DepthU16 { .. } => None,
    }
}
