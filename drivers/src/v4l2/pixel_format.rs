//! Names of pixel formats in rig files, on all systems.

/// Supported pixel formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum V4l2Format {
    /// `YUYV`: two bytes per pixel.
    Yuyv,
    /// `UYVY`: two bytes per pixel.
    Uyvy,
    /// `NV12`: three bytes for two pixels.
    Nv12,
    /// `RGB3`: three bytes per pixel.
    Rgb,
    /// `BGR3`: three bytes per pixel.
    Bgr,
    /// `MJPG` or `JPEG`. Compressed images have far less than one byte per pixel.
    Mjpeg,
    /// `GREY`: one byte per pixel.
    Grey,
    /// `Z16`: depth, two bytes per pixel.
    Z16,
}

impl V4l2Format {
    /// Formats of color images by their name in rig files, in order of preference. Uncompressed
    /// formats come before compressed formats, and color comes before gray.
    pub const COLOR_FORMATS: [(&str, Self); 7] = [
        ("yuyv", Self::Yuyv),
        ("uyvy", Self::Uyvy),
        ("nv12", Self::Nv12),
        ("rgb", Self::Rgb),
        ("bgr", Self::Bgr),
        ("mjpeg", Self::Mjpeg),
        ("grey", Self::Grey),
    ];

    /// Name in rig files.
    pub fn name(self) -> &'static str {
        Self::COLOR_FORMATS
            .iter()
            .find(|(_, format)| *format == self)
            .map_or("z16", |(name, _)| name)
    }
}
