//! Pixel formats, sizes and rates of V4L2 devices, and the choice among them.
//!
//! Source of the codes and layouts: Linux `videodev2.h` and its documentation of image formats.

use super::V4l2Format;
use super::abi::{DISCRETE, Fraction, FrameInterval, FrameSize};
use crate::{Error, PixelFormat, V4l2Colors, YuvColors, YuvLayout};

/// Rates with a smaller relative difference count as equal, because devices report rates as
/// fractions of integers. For example, 29.97 Hz differs from 30 Hz by 0.1 %. With a larger value,
/// 24 Hz could count as 25 Hz.
const SAME_RATE_FRAC: f64 = 0.01;

impl V4l2Format {
    /// Kernel codes of the formats. Some devices use another code for MJPEG.
    const CODES: [(&[u8; 4], Self); 9] = [
        (b"YUYV", Self::Yuyv),
        (b"UYVY", Self::Uyvy),
        (b"NV12", Self::Nv12),
        (b"RGB3", Self::Rgb),
        (b"BGR3", Self::Bgr),
        (b"MJPG", Self::Mjpeg),
        (b"JPEG", Self::Mjpeg),
        (b"GREY", Self::Grey),
        (b"Z16 ", Self::Z16),
    ];

    /// Format of a kernel code.
    pub(super) fn from_fourcc(fourcc: u32) -> Option<Self> {
        Self::CODES
            .iter()
            .find(|(code, _)| u32::from_le_bytes(**code) == fourcc)
            .map(|(_, format)| *format)
    }

    /// Default kernel code of a format.
    fn fourcc(self) -> u32 {
        let default_code = Self::CODES.iter().find(|(_, format)| *format == self);
        default_code.map_or(0, |(code, _)| u32::from_le_bytes(**code))
    }

    /// Bytes per second for images of this size and rate. `None` for compressed formats.
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

    /// Pixel format for decoding. `meters_per_count` is only used for depth.
    pub(super) fn pixels(
        self,
        colors: V4l2Colors,
        meters_per_count: f64,
    ) -> Result<PixelFormat, Error> {
        let layout = match self {
            Self::Yuyv => YuvLayout::Yuyv,
            Self::Uyvy => YuvLayout::Uyvy,
            Self::Nv12 => YuvLayout::Nv12,
            Self::Rgb => return Ok(PixelFormat::Rgb8),
            Self::Bgr => return Ok(PixelFormat::Bgr8),
            Self::Mjpeg => return Ok(PixelFormat::Jpeg),
            Self::Grey => return Ok(PixelFormat::Gray8),
            Self::Z16 => return Ok(PixelFormat::DepthU16 { meters_per_count }),
        };
        // Only YUV depends on the reported color encoding, so an unknown color encoding is no error
        // for other formats.
        Ok(PixelFormat::Yuv {
            layout,
            colors: YuvColors::from_v4l2(colors)?,
        })
    }
}

/// A mode of a device, which is a format with its sizes and rates.
#[derive(Clone, Debug, PartialEq)]
pub struct Mode {
    /// Kernel code of the format.
    pub(super) fourcc: u32,
    /// The format.
    pub format: V4l2Format,
    /// Supported sizes.
    pub sizes: Sizes,
    /// Images per second at these sizes. For a range of sizes, these are the rates at the largest
    /// size.
    pub rates: Rates,
}

/// Sizes of images, pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sizes {
    /// A single size.
    One([u32; 2]),
    /// Any size within a range of widths and a range of heights, in steps.
    Range {
        /// Minimum.
        min: [u32; 2],
        /// Maximum.
        max: [u32; 2],
        /// Step.
        step: [u32; 2],
    },
}

/// Rates, images per second.
#[derive(Clone, Debug, PartialEq)]
pub enum Rates {
    /// The device does not report rates.
    Unknown,
    /// A list of supported rates.
    List(Vec<f64>),
    /// Any rate in this range.
    Range {
        /// Lowest rate.
        min_hz: f64,
        /// Highest rate.
        max_hz: f64,
    },
}

impl Mode {
    /// A format at one size with a list of rates.
    pub fn new(format: V4l2Format, size_px: [u32; 2], rates_hz: &[f64]) -> Self {
        Self {
            fourcc: format.fourcc(),
            format,
            sizes: Sizes::One(size_px),
            rates: Rates::List(rates_hz.to_vec()),
        }
    }
}

impl Sizes {
    pub(super) fn from_kernel(reported: &FrameSize) -> Self {
        let [a, b, c, d, e, f] = reported.numbers;
        match reported.kind {
            DISCRETE => Self::One([a, b]),
            _ => Self::Range {
                min: [a, d],
                max: [b, e],
                step: [c, f],
            },
        }
    }

    /// Largest size.
    pub(super) fn max(&self) -> [u32; 2] {
        match self {
            Self::One(size) => *size,
            Self::Range { max, .. } => *max,
        }
    }

    fn has(&self, requested: [u32; 2]) -> bool {
        match self {
            Self::One(size) => *size == requested,
            Self::Range { min, max, step } => (0..2).all(|side| {
                let requested = requested[side];
                let min = min[side];
                let max = max[side];
                (min..=max).contains(&requested)
                    && (requested - min).is_multiple_of(step[side].max(1))
            }),
        }
    }
}

impl Rates {
    pub(super) fn from_kernel(reported: &[FrameInterval]) -> Self {
        match reported.first() {
            None => Self::Unknown,
            Some(first) if first.kind == DISCRETE => Self::List(
                reported
                    .iter()
                    .map(|interval| rate_of(interval.fractions[0]))
                    .collect(),
            ),
            // The longest interval is the lowest rate.
            Some(range) => Self::Range {
                min_hz: rate_of(range.fractions[1]),
                max_hz: rate_of(range.fractions[0]),
            },
        }
    }

    fn has(&self, requested_hz: f64) -> bool {
        match self {
            Self::Unknown => true,
            Self::List(rates) => rates
                .iter()
                .any(|rate_hz| is_same_rate(*rate_hz, requested_hz)),
            Self::Range { min_hz, max_hz } => (min_hz * (1.0 - SAME_RATE_FRAC)
                ..=max_hz * (1.0 + SAME_RATE_FRAC))
                .contains(&requested_hz),
        }
    }
}

/// Selects a mode of the given format. Without a format, selects a mode of the first suitable
/// format in [`V4l2Format::COLOR_FORMATS`].
pub(super) fn choose(
    modes: &[Mode],
    format: Option<V4l2Format>,
    size_px: [u32; 2],
    rate_hz: f64,
) -> Option<&Mode> {
    let suitable: Vec<&Mode> = modes
        .iter()
        .filter(|mode| mode.sizes.has(size_px) && mode.rates.has(rate_hz))
        .collect();
    match format {
        Some(format) => first_of_format(&suitable, format),
        // The order of preference determines the format, not the order in which the device lists
        // its formats.
        None => V4l2Format::COLOR_FORMATS
            .iter()
            .find_map(|(_, format)| first_of_format(&suitable, *format)),
    }
}

fn first_of_format<'a>(modes: &[&'a Mode], format: V4l2Format) -> Option<&'a Mode> {
    modes.iter().find(|mode| mode.format == format).copied()
}

/// Rank of a format in the order of preference. Depth comes last because it is only selected
/// explicitly.
pub(super) fn rank(format: V4l2Format) -> usize {
    V4l2Format::COLOR_FORMATS
        .iter()
        .position(|(_, each)| *each == format)
        .unwrap_or(V4l2Format::COLOR_FORMATS.len())
}

/// USB bandwidth for one camera in bytes per second at the speed reported by sysfs. It is the
/// largest isochronous transfer of an endpoint.
///
/// Sources: USB 2.0, section 5.6.3 (full speed: 1023 bytes per millisecond, high speed: 3072 bytes
/// in 125 us), and USB 3.2, section 8.12.6 (48 KiB in 125 us, and 96 KiB in 125 us at 10 Gbit/s).
pub(super) fn usb_bytes_per_sec(mbits: f64) -> f64 {
    match mbits {
        mbits if mbits < 480.0 => 1023.0 * 1e3,
        mbits if mbits < 5000.0 => 3072.0 * 8e3,
        mbits if mbits < 10_000.0 => 49_152.0 * 8e3,
        _ => 98_304.0 * 8e3,
    }
}

/// Describes the modes that exceed a bandwidth, each with the lowest rate that exceeds it.
pub(super) fn modes_exceeding(modes: &[Mode], bytes_per_sec: f64) -> Vec<String> {
    modes
        .iter()
        .filter_map(|mode| excess(mode, bytes_per_sec))
        .collect()
}

/// Describes a mode at the lowest rate that exceeds a bandwidth, if any does.
fn excess(mode: &Mode, bytes_per_sec: f64) -> Option<String> {
    let [width, height] = mode.sizes.max();
    let required_bytes_per_sec = |rate_hz: f64| mode.format.bytes_per_sec([width, height], rate_hz);
    let rates: &[f64] = match &mode.rates {
        Rates::Unknown => &[],
        Rates::List(rates) => rates,
        Rates::Range { max_hz, .. } => std::slice::from_ref(max_hz),
    };
    // Compressed formats require `None`, which is below any bandwidth.
    let slowest = rates
        .iter()
        .copied()
        .filter(|hz| required_bytes_per_sec(*hz) > Some(bytes_per_sec))
        .fold(f64::INFINITY, f64::min);
    // The value is infinite if no rate exceeds the bandwidth.
    let megabytes = required_bytes_per_sec(slowest)
        .filter(|required_bytes_per_sec| required_bytes_per_sec.is_finite())?
        * 1e-6;
    Some(format!(
        "{} {width}x{height} at {slowest:.0} Hz ({megabytes:.0} MB/s)",
        mode.format.name()
    ))
}

/// Whether two rates, in images per second, are considered equal.
pub(super) fn is_same_rate(one_hz: f64, other_hz: f64) -> bool {
    (one_hz - other_hz).abs() <= SAME_RATE_FRAC * other_hz
}

/// Rate in images per second of an interval.
pub(super) fn rate_of(interval: Fraction) -> f64 {
    f64::from(interval.denominator) / f64::from(interval.numerator.max(1))
}

/// Interval of a rate as a kernel fraction. It is exact for integer rates, and accurate to one
/// millionth for other rates.
pub(super) fn interval_of(rate_hz: f64) -> Fraction {
    const PARTS: f64 = 1e6;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a rig's rates are 0.01 to 1000"
    )]
    let whole = |number: f64| number.round() as u32;
    if rate_hz.fract() == 0.0 {
        Fraction {
            numerator: 1,
            denominator: whole(rate_hz),
        }
    } else {
        Fraction {
            numerator: whole(PARTS),
            denominator: whole(PARTS * rate_hz),
        }
    }
}

/// Describes modes for messages. Lists each format with its sizes and the highest rate at each
/// size.
pub fn summary(modes: &[Mode]) -> String {
    let formats = V4l2Format::COLOR_FORMATS
        .iter()
        .map(|(_, format)| *format)
        .chain([V4l2Format::Z16]);
    let all: Vec<_> = formats
        .filter_map(|format| summary_of_format(modes, format))
        .collect();
    if all.is_empty() {
        "no supported format".to_owned()
    } else {
        all.join("; ")
    }
}

/// A format with its sizes and the highest rate at each, if the device offers it.
fn summary_of_format(modes: &[Mode], format: V4l2Format) -> Option<String> {
    let sizes: Vec<_> = modes
        .iter()
        .filter(|mode| mode.format == format)
        .map(sizes_and_rate)
        .collect();
    (!sizes.is_empty()).then(|| format!("{}: {}", format.name(), sizes.join(", ")))
}

fn sizes_and_rate(mode: &Mode) -> String {
    let sizes = match &mode.sizes {
        Sizes::One([width, height]) => format!("{width}x{height}"),
        Sizes::Range {
            min: [w0, h0],
            max: [w1, h1],
            ..
        } => format!("{w0}x{h0} to {w1}x{h1}"),
    };
    let max_hz = match &mode.rates {
        Rates::Unknown => return sizes,
        Rates::List(rates) => rates.iter().copied().fold(0.0, f64::max),
        Rates::Range { max_hz, .. } => *max_hz,
    };
    format!("{sizes} up to {} Hz", (max_hz * 100.0).round() / 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uncompressed_format_is_preferred_at_sufficient_rate() {
        use V4l2Format::{Grey, Mjpeg, Yuyv, Z16};
        // Modes of a typical USB 2 webcam.
        let modes = [
            Mode::new(Mjpeg, [1280, 720], &[30.0, 15.0]),
            Mode::new(Yuyv, [640, 480], &[30.0]),
            Mode::new(Yuyv, [1280, 720], &[10.0]),
            Mode::new(Z16, [848, 480], &[30.0]),
            Mode::new(Grey, [848, 480], &[30.0]),
        ];
        let chosen =
            |format, size, rate_hz| choose(&modes, format, size, rate_hz).map(|mode| mode.format);
        assert_eq!(chosen(None, [640, 480], 30.0), Some(Yuyv));
        assert_eq!(chosen(None, [1280, 720], 30.0), Some(Mjpeg));
        assert_eq!(chosen(None, [1280, 720], 10.0), Some(Yuyv));
        assert_eq!(chosen(None, [640, 480], 29.97), Some(Yuyv));
        assert_eq!(chosen(None, [640, 480], 25.0), None);
        assert_eq!(chosen(Some(Yuyv), [1280, 720], 30.0), None);
        assert_eq!(chosen(Some(Z16), [848, 480], 30.0), Some(Z16));
        assert_eq!(
            chosen(None, [848, 480], 30.0),
            Some(Grey),
            "depth is never selected as color"
        );
    }

    #[test]
    fn size_ranges_respect_steps() {
        let sizes = Sizes::Range {
            min: [16, 16],
            max: [1920, 1080],
            step: [8, 2],
        };
        assert!(sizes.has([640, 480]) && sizes.has([16, 16]) && sizes.has([1920, 1080]));
        assert!(
            !sizes.has([644, 480])
                && !sizes.has([640, 481])
                && !sizes.has([8, 16])
                && !sizes.has([1928, 1080])
        );
        let range = FrameInterval {
            kind: 3,
            fractions: [
                Fraction {
                    numerator: 1,
                    denominator: 60,
                },
                Fraction {
                    numerator: 1,
                    denominator: 5,
                },
                Fraction {
                    numerator: 1,
                    denominator: 60,
                },
            ],
            ..Default::default()
        };
        let rates = Rates::from_kernel(&[range]);
        assert_eq!(
            rates,
            Rates::Range {
                min_hz: 5.0,
                max_hz: 60.0
            }
        );
        assert!(rates.has(30.0) && rates.has(60.0) && !rates.has(61.0) && !rates.has(4.9));
        assert_eq!(Rates::from_kernel(&[]), Rates::Unknown);
    }

    #[test]
    fn rates_round_trip_through_fractions() {
        for rate_hz in [0.01, 0.5, 7.5, 14.985, 29.97, 30.0, 60.0, 90.0, 1000.0] {
            let back_hz = rate_of(interval_of(rate_hz));
            assert!(
                (back_hz - rate_hz).abs() <= 1e-6 * rate_hz.max(1.0),
                "{rate_hz}: {back_hz}"
            );
        }
        assert!(is_same_rate(
            rate_of(Fraction {
                numerator: 333_667,
                denominator: 10_000_000
            }),
            30.0
        ));
        assert!(rate_of(Fraction::default()).is_finite());
    }

    #[test]
    fn modes_exceeding_usb_bandwidth_are_listed() {
        let bytes = V4l2Format::Yuyv
            .bytes_per_sec([2560, 1440], 30.0)
            .expect("an uncompressed format");
        assert_eq!((bytes / 1e6).round(), 221.0);
        assert_eq!(V4l2Format::Mjpeg.bytes_per_sec([2560, 1440], 30.0), None);
        let modes = [
            Mode::new(V4l2Format::Yuyv, [640, 480], &[30.0, 15.0]),
            Mode::new(V4l2Format::Yuyv, [2560, 1440], &[5.0, 30.0, 15.0]),
            Mode::new(V4l2Format::Mjpeg, [2560, 1440], &[30.0]),
        ];
        assert_eq!(
            modes_exceeding(&modes, usb_bytes_per_sec(480.0)),
            ["yuyv 2560x1440 at 5 Hz (37 MB/s)"]
        );
        assert_eq!(
            modes_exceeding(&modes, usb_bytes_per_sec(5000.0)),
            Vec::<String>::new()
        );
        assert_eq!(
            modes_exceeding(&modes, 200e6),
            ["yuyv 2560x1440 at 30 Hz (221 MB/s)"]
        );
    }

    #[test]
    fn fourccs_match_kernel() {
        // v4l2_fourcc(a, b, c, d) is a | b << 8 | c << 16 | d << 24.
        assert_eq!(V4l2Format::from_fourcc(0x5659_5559), Some(V4l2Format::Yuyv));
        assert_eq!(V4l2Format::from_fourcc(0x2036_315a), Some(V4l2Format::Z16));
        assert_eq!(V4l2Format::from_fourcc(0), None);
        for (_, format) in V4l2Format::COLOR_FORMATS {
            assert_eq!(V4l2Format::from_fourcc(format.fourcc()), Some(format));
        }
    }

    #[test]
    fn summary_groups_modes_by_format() {
        let modes = [
            Mode::new(V4l2Format::Mjpeg, [1280, 720], &[30.0, 15.0]),
            Mode::new(V4l2Format::Yuyv, [640, 480], &[14.985, 29.97]),
            Mode::new(V4l2Format::Yuyv, [1280, 720], &[10.0]),
        ];
        let reported =
            "yuyv: 640x480 up to 29.97 Hz, 1280x720 up to 10 Hz; mjpeg: 1280x720 up to 30 Hz";
        assert_eq!(summary(&modes), reported);
        assert_eq!(summary(&[]), "no supported format");
    }
}
