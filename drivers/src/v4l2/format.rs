//! Which pixel formats, sizes and rates V4L2 devices offer, and which of them is taken.
//!
//! Source of the codes and layouts: Linux `videodev2.h` and its documentation of image formats.

use super::abi::{DISCRETE, Fraction, FrameInterval, FrameSize};
use crate::{Error, PixelFormat, V4l2Colors, YuvColors, YuvLayout};
use std::fmt;

/// Rates that differ by less than this share are the same: devices tell fractions of whole numbers.
const SAME_RATE_FRAC: f64 = 0.01;

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
    /// All of them with their names in rig files; those of color in the order in which they are preferred: what is
    /// not compressed before what is, colors before grey.
    pub const ALL: [(&str, Self); 8] = [
        ("yuyv", Self::Yuyv),
        ("uyvy", Self::Uyvy),
        ("nv12", Self::Nv12),
        ("rgb", Self::Rgb),
        ("bgr", Self::Bgr),
        ("mjpeg", Self::Mjpeg),
        ("grey", Self::Grey),
        ("z16", Self::Z16),
    ];

    /// Its name in rig files.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(_, format)| *format == self).map_or("", |(name, _)| name)
    }

    /// The format of a code of the kernel.
    pub(super) fn from_fourcc(fourcc: u32) -> Option<Self> {
        Some(match &fourcc.to_le_bytes() {
            b"YUYV" => Self::Yuyv,
            b"UYVY" => Self::Uyvy,
            b"NV12" => Self::Nv12,
            b"RGB3" => Self::Rgb,
            b"BGR3" => Self::Bgr,
            b"MJPG" | b"JPEG" => Self::Mjpeg,
            b"GREY" => Self::Grey,
            b"Z16 " => Self::Z16,
            _ => return None,
        })
    }

    /// Bytes a second of images of a size at a rate; `None` where compression decides.
    pub fn bytes_per_sec(self, [width, height]: [u32; 2], rate_hz: f64) -> Option<f64> {
        let bytes_per_pixel = match self {
            Self::Mjpeg => return None,
            Self::Yuyv | Self::Uyvy | Self::Z16 => 2.0,
            Self::Nv12 => 1.5,
            Self::Rgb | Self::Bgr => 3.0,
            Self::Grey => 1.0,
        };
        Some(bytes_per_pixel * f64::from(width) * f64::from(height) * rate_hz)
    }

    /// How its bytes are read; `metres_per_count` counts for depth only.
    pub(super) fn pixels(self, colors: V4l2Colors, metres_per_count: f64) -> Result<PixelFormat, Error> {
        let yuv = |layout| Ok(PixelFormat::Yuv { layout, colors: YuvColors::from_v4l2(colors)? });
        match self {
            Self::Yuyv => yuv(YuvLayout::Yuyv),
            Self::Uyvy => yuv(YuvLayout::Uyvy),
            Self::Nv12 => yuv(YuvLayout::Nv12),
            Self::Rgb => Ok(PixelFormat::Rgb8),
            Self::Bgr => Ok(PixelFormat::Bgr8),
            Self::Mjpeg => Ok(PixelFormat::Jpeg),
            Self::Grey => Ok(PixelFormat::Gray8),
            Self::Z16 => Ok(PixelFormat::DepthU16 { metres_per_count }),
        }
    }
}

/// One thing that a device offers: a format at a size, with its rates.
#[derive(Clone, Debug, PartialEq)]
pub struct Mode {
    /// Its code, which the device is asked with.
    pub(super) fourcc: u32,
    /// The format.
    pub format: V4l2Format,
    /// The sizes.
    pub sizes: Sizes,
    /// Images a second at these sizes (at the largest, where there are several).
    pub rates: Rates,
}

/// Sizes of images, pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sizes {
    /// One.
    One([u32; 2]),
    /// Any from the least to the most, in steps, by width and height.
    Range {
        /// Least.
        least: [u32; 2],
        /// Most.
        most: [u32; 2],
        /// Steps.
        step: [u32; 2],
    },
}

/// Images a second.
#[derive(Clone, Debug, PartialEq)]
pub enum Rates {
    /// The device does not tell.
    Untold,
    /// One of these.
    List(Vec<f64>),
    /// Any in this range.
    Range {
        /// Slowest.
        least_hz: f64,
        /// Fastest.
        most_hz: f64,
    },
}

impl Sizes {
    pub(super) fn from_kernel(told: &FrameSize) -> Self {
        let [a, b, c, d, e, f] = told.numbers;
        match told.kind {
            DISCRETE => Self::One([a, b]),
            _ => Self::Range { least: [a, d], most: [b, e], step: [c, f] },
        }
    }

    /// The largest.
    pub(super) fn most(&self) -> [u32; 2] {
        match self {
            Self::One(size) => *size,
            Self::Range { most, .. } => *most,
        }
    }

    fn has(&self, wanted: [u32; 2]) -> bool {
        match self {
            Self::One(size) => *size == wanted,
            Self::Range { least, most, step } => (0..2).all(|side| {
                let (wanted, least, most) = (wanted[side], least[side], most[side]);
                (least..=most).contains(&wanted) && (wanted - least).is_multiple_of(step[side].max(1))
            }),
        }
    }
}

impl Rates {
    pub(super) fn from_kernel(told: &[FrameInterval]) -> Self {
        match told.first() {
            None => Self::Untold,
            Some(first) if first.kind == DISCRETE => {
                Self::List(told.iter().map(|interval| rate_of(interval.fractions[0])).collect())
            }
            // The longest interval is the lowest rate.
            Some(range) => Self::Range { least_hz: rate_of(range.fractions[1]), most_hz: rate_of(range.fractions[0]) },
        }
    }

    fn has(&self, wanted_hz: f64) -> bool {
        match self {
            Self::Untold => true,
            Self::List(rates) => rates.iter().any(|rate_hz| is_same_rate(*rate_hz, wanted_hz)),
            Self::Range { least_hz, most_hz } => {
                (least_hz * (1.0 - SAME_RATE_FRAC)..=most_hz * (1.0 + SAME_RATE_FRAC)).contains(&wanted_hz)
            }
        }
    }
}

/// The mode to take: of a format, if one is asked for, else the first in the order of [`V4l2Format::ALL`] but for depth.
pub(super) fn choose(modes: &[Mode], format: Option<V4l2Format>, size_px: [u32; 2], rate_hz: f64) -> Option<&Mode> {
    let fits = |mode: &&Mode| mode.sizes.has(size_px) && mode.rates.has(rate_hz);
    let of = |format: V4l2Format| modes.iter().filter(move |mode| mode.format == format).find(fits);
    match format {
        Some(format) => of(format),
        None => V4l2Format::ALL.iter().filter(|(_, format)| *format != V4l2Format::Z16).find_map(|(_, each)| of(*each)),
    }
}

/// Whether two rates, images a second, are one rate told in two ways.
pub(super) fn is_same_rate(one_hz: f64, other_hz: f64) -> bool {
    (one_hz - other_hz).abs() <= SAME_RATE_FRAC * other_hz
}

/// Images a second of the time between two.
pub(super) fn rate_of(interval: Fraction) -> f64 {
    f64::from(interval.denominator) / f64::from(interval.numerator.max(1))
}

/// Time between two images of a rate, in the kernel's fractions: exact for whole rates, to a millionth for others.
pub(super) fn interval_of(rate_hz: f64) -> Fraction {
    const PARTS: f64 = 1e6;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a rig's rates are 0.01 to 1000")]
    let whole = |number: f64| number.round() as u32;
    match rate_hz.fract() == 0.0 {
        true => Fraction { numerator: 1, denominator: whole(rate_hz) },
        false => Fraction { numerator: whole(PARTS), denominator: whole(PARTS * rate_hz) },
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ", self.format.name())?;
        match &self.sizes {
            Sizes::One([width, height]) => write!(f, "{width}x{height}")?,
            Sizes::Range { least: [w0, h0], most: [w1, h1], .. } => write!(f, "{w0}x{h0} to {w1}x{h1}")?,
        }
        let number = |hz: &f64| format!("{}", (hz * 100.0).round() / 100.0);
        match &self.rates {
            Rates::Untold => Ok(()),
            Rates::List(rates) => write!(f, " at {} Hz", rates.iter().map(number).collect::<Vec<_>>().join(", ")),
            Rates::Range { least_hz, most_hz } => write!(f, " at {} to {} Hz", number(least_hz), number(most_hz)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(format: V4l2Format, size: [u32; 2], rates: &[f64]) -> Mode {
        Mode { fourcc: 0, format, sizes: Sizes::One(size), rates: Rates::List(rates.to_vec()) }
    }

    #[test]
    fn what_is_not_compressed_is_taken_where_it_is_fast_enough() {
        use V4l2Format::{Grey, Mjpeg, Yuyv, Z16};
        // As a USB 2 webcam offers them.
        let modes = [
            mode(Mjpeg, [1280, 720], &[30.0, 15.0]),
            mode(Yuyv, [640, 480], &[30.0]),
            mode(Yuyv, [1280, 720], &[10.0]),
            mode(Z16, [848, 480], &[30.0]),
            mode(Grey, [848, 480], &[30.0]),
        ];
        let taken = |format, size, rate_hz| choose(&modes, format, size, rate_hz).map(|mode| mode.format);
        assert_eq!(taken(None, [640, 480], 30.0), Some(Yuyv));
        assert_eq!(taken(None, [1280, 720], 30.0), Some(Mjpeg));
        assert_eq!(taken(None, [1280, 720], 10.0), Some(Yuyv));
        assert_eq!(taken(None, [640, 480], 29.97), Some(Yuyv));
        assert_eq!(taken(None, [640, 480], 25.0), None);
        assert_eq!(taken(Some(Yuyv), [1280, 720], 30.0), None);
        assert_eq!(taken(Some(Z16), [848, 480], 30.0), Some(Z16));
        assert_eq!(taken(None, [848, 480], 30.0), Some(Grey), "depth is never taken for color");
    }

    #[test]
    fn ranges_hold_their_steps() {
        let sizes = Sizes::Range { least: [16, 16], most: [1920, 1080], step: [8, 2] };
        assert!(sizes.has([640, 480]) && sizes.has([16, 16]) && sizes.has([1920, 1080]));
        assert!(!sizes.has([644, 480]) && !sizes.has([640, 481]) && !sizes.has([8, 16]) && !sizes.has([1928, 1080]));
        let range = FrameInterval {
            kind: 3,
            fractions: [
                Fraction { numerator: 1, denominator: 60 },
                Fraction { numerator: 1, denominator: 5 },
                Fraction { numerator: 1, denominator: 60 },
            ],
            ..Default::default()
        };
        let rates = Rates::from_kernel(&[range]);
        assert_eq!(rates, Rates::Range { least_hz: 5.0, most_hz: 60.0 });
        assert!(rates.has(30.0) && rates.has(60.0) && !rates.has(61.0) && !rates.has(4.9));
        assert_eq!(Rates::from_kernel(&[]), Rates::Untold);
    }

    #[test]
    fn rates_survive_the_kernels_fractions() {
        for rate_hz in [0.01, 0.5, 7.5, 14.985, 29.97, 30.0, 60.0, 90.0, 1000.0] {
            let back_hz = rate_of(interval_of(rate_hz));
            assert!((back_hz - rate_hz).abs() <= 1e-6 * rate_hz.max(1.0), "{rate_hz}: {back_hz}");
        }
        assert!(is_same_rate(rate_of(Fraction { numerator: 333_667, denominator: 10_000_000 }), 30.0));
        assert!(rate_of(Fraction::default()).is_finite());
    }

    #[test]
    fn bandwidth_of_the_issue() {
        let bytes = V4l2Format::Yuyv.bytes_per_sec([2560, 1440], 30.0).expect("not compressed");
        assert_eq!((bytes / 1e6).round(), 221.0);
        assert_eq!(V4l2Format::Mjpeg.bytes_per_sec([2560, 1440], 30.0), None);
    }

    #[test]
    fn codes_are_the_kernels() {
        // v4l2_fourcc(a, b, c, d) is a | b << 8 | c << 16 | d << 24.
        assert_eq!(V4l2Format::from_fourcc(0x5659_5559), Some(V4l2Format::Yuyv));
        assert_eq!(V4l2Format::from_fourcc(0x2036_315a), Some(V4l2Format::Z16));
        assert_eq!(V4l2Format::from_fourcc(0), None);
        assert_eq!(mode(V4l2Format::Nv12, [640, 480], &[30.0, 14.985]).to_string(), "nv12 640x480 at 30, 14.99 Hz");
    }
}
