//! Names of pixel formats, as rig files have them on every system.

/// The pixel formats that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum V4l2Format {
    /// `YUYV`: two bytes a pixel.
    Yuyv,
    /// `UYVY`: two bytes a pixel.
    Uyvy,
    /// `NV12`: three bytes for two pixels.
    Nv12,
    /// `RGB3`: three bytes a pixel.
    Rgb,
    /// `BGR3`: three bytes a pixel.
    Bgr,
    /// `MJPG` or `JPEG`: compressed, far less than a byte a pixel.
    Mjpeg,
    /// `GREY`: one byte a pixel.
    Grey,
    /// `Z16`: depth, two bytes a pixel.
    Z16,
}

impl V4l2Format {
    /// Those of color with their names in rig files, in the order in which they are preferred: what is not compressed before
    /// what is, colors before grey.
    pub const COLOR_FORMATS: [(&str, Self); 7] = [
        ("yuyv", Self::Yuyv),
        ("uyvy", Self::Uyvy),
        ("nv12", Self::Nv12),
        ("rgb", Self::Rgb),
        ("bgr", Self::Bgr),
        ("mjpeg", Self::Mjpeg),
        ("grey", Self::Grey),
    ];

    /// Its name in rig files.
    pub fn name(self) -> &'static str {
        Self::COLOR_FORMATS.iter().find(|(_, format)| *format == self).map_or("z16", |(name, _)| name)
    }
}
