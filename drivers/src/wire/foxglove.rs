//! Foxglove messages for images, intrinsics and poses.
//!
//! Color images keep the bytes of the device, and depth images keep their raw counts. Stamps are
//! exact to the nanosecond, and numbers are bit-exact. Field numbers are the same as in
//! [`super::descriptor`].

use super::protobuf::{Field, Message, fields};
use super::{Malformed, descriptor};
use crate::{Image, PixelFormat, YuvColors, YuvLayout, YuvMatrix, YuvRange};
use kinematics::transform::{from_xyz_xyzw, to_xyz_xyzw};
use kinematics::{Intrinsics, Lens, Stamp, Transform};
use std::sync::Arc;

const EXPOSURE_SECS: u32 = 1001;
const N_SKIPPED: u32 = 1002;
const WIDTH_PX: u32 = 1003;
const HEIGHT_PX: u32 = 1004;
const METERS_PER_COUNT: u32 = 1005;
const PSNR_CEILING: u32 = 1006;
const YUV_COLORS: u32 = 1007;
/// Values of field `YUV_COLORS`.
const YUV_COLORS_NAMES: [(&str, YuvColors); 4] = [
    (
        "bt601-limited",
        YuvColors {
            matrix: YuvMatrix::Bt601,
            range: YuvRange::Limited,
        },
    ),
    (
        "bt601-full",
        YuvColors {
            matrix: YuvMatrix::Bt601,
            range: YuvRange::Full,
        },
    ),
    (
        "bt709-limited",
        YuvColors {
            matrix: YuvMatrix::Bt709,
            range: YuvRange::Limited,
        },
    ),
    (
        "bt709-full",
        YuvColors {
            matrix: YuvMatrix::Bt709,
            range: YuvRange::Full,
        },
    ),
];
/// Foxglove's names of layouts. The first name of a layout is written, and all names are accepted
/// when reading.
const YUV_LAYOUTS: [(&str, YuvLayout); 5] = [
    ("yuyv", YuvLayout::Yuyv),
    ("uyvy", YuvLayout::Uyvy),
    ("nv12", YuvLayout::Nv12),
    ("yuv422_yuy2", YuvLayout::Yuyv),
    ("yuv422", YuvLayout::Uyvy),
];
/// Encoding of depth in meters.
const DEPTH_M: &str = "32FC1";
const NANOS_PER_SEC: i64 = 1_000_000_000;

/// The message type for images of this format.
pub fn schema_of(format: PixelFormat) -> descriptor::Schema {
    match format {
        PixelFormat::Jpeg | PixelFormat::Png => descriptor::COMPRESSED_IMAGE,
        PixelFormat::Rgb8
        | PixelFormat::Bgr8
        | PixelFormat::Gray8
        | PixelFormat::Yuv { .. }
        | PixelFormat::DepthU16 { .. } => descriptor::RAW_IMAGE,
    }
}

/// Encodes an image as `CompressedImage` or `RawImage`, see [`schema_of`].
pub fn encode_image(image: &Image) -> Vec<u8> {
    // 256 bytes are usually enough for all other fields, so the message is allocated once.
    let mut message = Message::with_capacity(image.data.len() + 256);
    message.message(1, &timestamp(image.stamp));
    match image.format {
        PixelFormat::Jpeg | PixelFormat::Png => {
            let format: &[u8] = if image.format == PixelFormat::Jpeg {
                b"jpeg"
            } else {
                b"png"
            };
            message
                .bytes(2, &image.data)
                .bytes(3, format)
                .bytes(4, image.camera.as_bytes());
            message
                .fixed32(WIDTH_PX, image.size_px[0])
                .fixed32(HEIGHT_PX, image.size_px[1]);
        }
        PixelFormat::Rgb8 => raw_image(&mut message, image, "rgb8"),
        PixelFormat::Bgr8 => raw_image(&mut message, image, "bgr8"),
        PixelFormat::Gray8 => raw_image(&mut message, image, "mono8"),
        PixelFormat::Yuv { layout, colors } => {
            raw_image(&mut message, image, name_of(&YUV_LAYOUTS, layout));
            message.bytes(YUV_COLORS, name_of(&YUV_COLORS_NAMES, colors).as_bytes());
        }
        PixelFormat::DepthU16 { meters_per_count } => {
            raw_image(&mut message, image, "16UC1");
            message.double(METERS_PER_COUNT, meters_per_count);
        }
    }
    if let Some(exposure_secs) = image.exposure_secs {
        message.double(EXPOSURE_SECS, exposure_secs);
    }
    message.varint(N_SKIPPED, image.n_skipped);
    message.into_bytes()
}

/// The first name of a value in a table that contains all values.
fn name_of<T: PartialEq>(names: &[(&'static str, T)], value: T) -> &'static str {
    names
        .iter()
        .find(|(_, lookup)| *lookup == value)
        .expect("the table names every value")
        .0
}

fn lookup<T: Copy>(names: &[(&str, T)], name: &str) -> Option<T> {
    names
        .iter()
        .find(|(known, _)| *known == name)
        .map(|(_, value)| *value)
}

fn raw_image(message: &mut Message, image: &Image, encoding: &str) {
    let row_bytes = image
        .format
        .raw_size(image.size_px)
        .map_or(0, |[row_bytes, _]| row_bytes);
    message
        .fixed32(2, image.size_px[0])
        .fixed32(3, image.size_px[1])
        .bytes(4, encoding.as_bytes());
    message
        .fixed32(5, u32::try_from(row_bytes).unwrap_or(u32::MAX))
        .bytes(6, &image.data)
        .bytes(7, image.camera.as_bytes());
}

/// Decodes an image from the message type given by [`schema_of`]. Removes the padding of rows.
pub fn decode_image(schema: &str, bytes: &[u8]) -> Result<Image, Malformed> {
    let compressed = schema == descriptor::COMPRESSED_IMAGE.name;
    let mut stamp = None;
    let mut size_px = [0; 2];
    let mut format = "";
    let mut meters_per_count = None;
    let mut colors = None;
    let mut step = None;
    let mut image = Image {
        camera: Arc::from(""),
        stamp: Stamp::default(),
        size_px,
        format: PixelFormat::Rgb8,
        data: Arc::from([]),
        exposure_secs: None,
        n_skipped: 0,
    };
    for field in fields(bytes) {
        let field = field?;
        match (field.number, compressed) {
            (1, _) => stamp = Some(stamp_from(&field)?),
            (2, true) | (6, false) => image.data = field.bytes()?.into(),
            (3, true) | (4, false) => format = field.text()?,
            (4, true) | (7, false) => image.camera = field.text()?.into(),
            (WIDTH_PX, true) | (2, false) => size_px[0] = field.fixed32()?,
            (HEIGHT_PX, true) | (3, false) => size_px[1] = field.fixed32()?,
            (5, false) => step = Some(field.fixed32()?),
            (EXPOSURE_SECS, _) => image.exposure_secs = Some(field.double()?),
            (N_SKIPPED, _) => image.n_skipped = field.varint()?,
            (YUV_COLORS, false) => colors = Some(field.text()?),
            (METERS_PER_COUNT, false) => meters_per_count = Some(field.double()?),
            // These are unknown fields of a newer version, see
            // `descriptor::Schema::unknown_fields`.
            _ => {}
        }
    }
    image.stamp = stamp.ok_or(Malformed::Missing { name: "timestamp" })?;
    // An absent number is 0 in proto3, so an absent size cannot be distinguished from 0.
    if size_px.contains(&0) {
        return Err(Malformed::Missing {
            name: if compressed {
                "width_px or height_px"
            } else {
                "width or height"
            },
        });
    }
    image.size_px = size_px;
    // Fields may be in any order, so the format is determined after all fields have been read.
    image.format = if compressed {
        compressed_format(format)?
    } else {
        raw_format(format, meters_per_count, colors)?
    };
    without_padding(image, step)
}

fn compressed_format(name: &str) -> Result<PixelFormat, Malformed> {
    match name {
        "jpeg" => Ok(PixelFormat::Jpeg),
        "png" => Ok(PixelFormat::Png),
        _ => Err(Malformed::PixelFormat {
            name: name.to_owned(),
        }),
    }
}

/// The format of a `RawImage` from its encoding and the fields that only some encodings have.
fn raw_format(
    name: &str,
    meters_per_count: Option<f64>,
    colors: Option<&str>,
) -> Result<PixelFormat, Malformed> {
    Ok(match name {
        "rgb8" => PixelFormat::Rgb8,
        "bgr8" => PixelFormat::Bgr8,
        "mono8" => PixelFormat::Gray8,
        "16UC1" => PixelFormat::DepthU16 {
            meters_per_count: positive(meters_per_count.ok_or(Malformed::Missing {
                name: "meters_per_count",
            })?)?,
        },
        _ => match lookup(&YUV_LAYOUTS, name) {
            Some(layout) => PixelFormat::Yuv {
                layout,
                colors: yuv_colors(colors)?,
            },
            None => {
                return Err(Malformed::PixelFormat {
                    name: name.to_owned(),
                });
            }
        },
    })
}

fn positive(meters_per_count: f64) -> Result<f64, Malformed> {
    if meters_per_count > 0.0 && meters_per_count.is_finite() {
        return Ok(meters_per_count);
    }
    Err(Malformed::Unsupported {
        name: "meters_per_count",
        found: meters_per_count.to_string(),
        expected: "a positive number".to_owned(),
    })
}

/// Removes the padding of rows whose starts are `step` bytes apart. This program writes rows
/// without padding.
fn without_padding(image: Image, step: Option<u32>) -> Result<Image, Malformed> {
    let (Some(step), Some([row_bytes, _])) = (step, image.format.raw_size(image.size_px)) else {
        return Ok(image);
    };
    let row_bytes = u32::try_from(row_bytes).unwrap_or(u32::MAX);
    if step == row_bytes {
        return Ok(image);
    }
    let n_bytes = image.data.len();
    image
        .pack_rows(step as usize)
        .map_err(|_| Malformed::Unsupported {
            name: "step",
            found: format!("{step}, with {n_bytes} bytes of data"),
            expected: format!("at least {row_bytes} bytes, and data for all rows"),
        })
}

fn yuv_colors(name: Option<&str>) -> Result<YuvColors, Malformed> {
    let name = name.ok_or(Malformed::Missing { name: "yuv_colors" })?;
    lookup(&YUV_COLORS_NAMES, name).ok_or_else(|| Malformed::PixelFormat {
        name: name.to_owned(),
    })
}

/// Encodes depth in meters as a `RawImage` of 32-bit floats.
pub fn encode_depth_m(camera: &str, stamp: Stamp, size_px: [u32; 2], depth_m: &[f32]) -> Vec<u8> {
    let mut message = Message::with_capacity(depth_m.len() * 4 + 256);
    let data: Vec<u8> = depth_m
        .iter()
        .flat_map(|depth_m| depth_m.to_le_bytes())
        .collect();
    message
        .message(1, &timestamp(stamp))
        .fixed32(2, size_px[0])
        .fixed32(3, size_px[1])
        .bytes(4, DEPTH_M.as_bytes());
    message
        .fixed32(5, size_px[0].saturating_mul(4))
        .bytes(6, &data)
        .bytes(7, camera.as_bytes());
    message.into_bytes()
}

/// Decodes the depth in meters that [`encode_depth_m`] encoded.
pub fn decode_depth_m(bytes: &[u8]) -> Result<Arc<[f32]>, Malformed> {
    let mut size_px = [0; 2];
    let mut encoding = "";
    let mut data = None;
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            2 => size_px[0] = field.fixed32()?,
            3 => size_px[1] = field.fixed32()?,
            4 => encoding = field.text()?,
            6 => data = Some(field.bytes()?),
            _ => {}
        }
    }
    let data = data.ok_or(Malformed::Missing { name: "data" })?;
    if encoding != DEPTH_M {
        return Err(Malformed::PixelFormat {
            name: encoding.to_owned(),
        });
    }
    let [width, height] = size_px;
    if data.len() as u128 != 4 * u128::from(width) * u128::from(height) {
        return Err(Malformed::Unsupported {
            name: "data",
            found: format!("{} bytes", data.len()),
            expected: format!("4 bytes for each of {width} x {height} pixels"),
        });
    }
    Ok(data
        .as_chunks::<4>()
        .0
        .iter()
        .map(|meters| f32::from_le_bytes(*meters))
        .collect())
}

/// Encodes intrinsics as a `CameraCalibration`.
pub fn encode_calibration(camera: &str, stamp: Stamp, intrinsics: &Intrinsics) -> Vec<u8> {
    let [fx, fy] = intrinsics.focal_px;
    let [cx, cy] = intrinsics.principal_px;
    let (model, distortion): (&str, &[f64]) = match &intrinsics.lens {
        // Viewers undistort images with these coefficients, and a rectified image must not be
        // undistorted again.
        _ if intrinsics.rectified => ("", &[]),
        Lens::Pinhole => ("", &[]),
        Lens::BrownConrady(k) => ("plumb_bob", k),
        Lens::KannalaBrandt(k) => ("kannala_brandt", k),
        Lens::RationalBrownConrady(k) => ("rational_polynomial", k),
    };
    let mut message = Message::default();
    message
        .message(1, &timestamp(stamp))
        .fixed32(2, intrinsics.size_px[0])
        .fixed32(3, intrinsics.size_px[1]);
    message.bytes(4, model.as_bytes()).doubles(5, distortion);
    message.doubles(6, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    message.doubles(7, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    message.doubles(8, &[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]);
    message.bytes(9, camera.as_bytes());
    message.into_bytes()
}

/// Encodes a pose as a `FrameTransform`.
pub fn encode_transform(
    parent: &str,
    child: &str,
    stamp: Stamp,
    parent_from_child: &Transform,
) -> Vec<u8> {
    let [x, y, z, i, j, k, w] = to_xyz_xyzw(parent_from_child);
    let mut translation = Message::default();
    translation.double(1, x).double(2, y).double(3, z);
    let mut rotation = Message::default();
    rotation.double(1, i).double(2, j).double(3, k).double(4, w);
    let mut message = Message::default();
    message
        .message(1, &timestamp(stamp))
        .bytes(2, parent.as_bytes())
        .bytes(3, child.as_bytes());
    message.message(4, &translation).message(5, &rotation);
    message.into_bytes()
}

/// Decodes stamp and pose from a `FrameTransform`. Poses that this program wrote are restored bit
/// for bit. Quaternions of other programs may be rounded, and are normalized.
pub fn decode_transform(bytes: &[u8]) -> Result<(Stamp, Transform), Malformed> {
    let mut stamp = None;
    let mut translation = None;
    let mut rotation = None;
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            1 => stamp = Some(stamp_from(&field)?),
            4 => translation = Some(numbers::<3>(&field)?),
            5 => rotation = Some(numbers::<4>(&field)?),
            _ => {}
        }
    }
    let [x, y, z] = translation.ok_or(Malformed::Missing {
        name: "translation",
    })?;
    let [i, j, k, w] = rotation.ok_or(Malformed::Missing { name: "rotation" })?;
    let stamp = stamp.ok_or(Malformed::Missing { name: "timestamp" })?;
    let [i, j, k, w] = unit_quaternion([i, j, k, w])?;
    Ok((stamp, from_xyz_xyzw([x, y, z, i, j, k, w])))
}

/// Normalizes a quaternion. A quaternion whose length is 1 up to rounding is returned unchanged,
/// because normalizing would change its last bits. A quaternion that is not finite is also returned
/// unchanged, because users of the pose reject it.
fn unit_quaternion(quaternion: [f64; 4]) -> Result<[f64; 4], Malformed> {
    /// Products of many rotations, and quaternions in f32, deviate from unit length by less than
    /// this value.
    const EXACT: f64 = 1e-6;
    /// Quaternions with two decimals deviate from unit length by less than this value.
    const ROUNDED: f64 = 0.01;
    let length = quaternion
        .iter()
        .map(|number| number * number)
        .sum::<f64>()
        .sqrt();
    let deviation = (length - 1.0).abs();
    if !length.is_finite() || deviation <= EXACT {
        return Ok(quaternion);
    }
    if deviation <= ROUNDED {
        return Ok(quaternion.map(|number| number / length));
    }
    Err(Malformed::Unsupported {
        name: "rotation",
        found: format!("a quaternion of length {length}"),
        expected: "one of length 1".to_owned(),
    })
}

/// Decodes the names of the parent and the child of a `FrameTransform`. A name is empty if it is
/// absent.
pub fn decode_frames(bytes: &[u8]) -> Result<[&str; 2], Malformed> {
    let mut names = [""; 2];
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            2 => names[0] = field.text()?,
            3 => names[1] = field.text()?,
            _ => {}
        }
    }
    Ok(names)
}

/// Encodes a true camera pose in the world, with the maximum PSNR that the image noise allows, dB.
pub fn encode_true_pose(
    camera: &str,
    stamp: Stamp,
    world_from_camera: &Transform,
    psnr_ceiling: Option<f64>,
) -> Vec<u8> {
    let mut bytes = encode_transform("world", camera, stamp, world_from_camera);
    if let Some(psnr_ceiling) = psnr_ceiling {
        // Fields of a message may be in any order, so the encoded parts can be concatenated.
        let mut ceiling = Message::default();
        ceiling.double(PSNR_CEILING, psnr_ceiling);
        bytes.extend(ceiling.into_bytes());
    }
    bytes
}

/// Decodes stamp, pose and PSNR ceiling that [`encode_true_pose`] encoded.
pub fn decode_true_pose(bytes: &[u8]) -> Result<(Stamp, Transform, Option<f64>), Malformed> {
    let (stamp, world_from_camera) = decode_transform(bytes)?;
    for field in fields(bytes) {
        let field = field?;
        if field.number == PSNR_CEILING {
            return Ok((stamp, world_from_camera, Some(field.double()?)));
        }
    }
    Ok((stamp, world_from_camera, None))
}

/// The fields 1 to `N` of a message that consists only of doubles. Absent fields are zero.
pub(super) fn numbers<const N: usize>(field: &Field<'_>) -> Result<[f64; N], Malformed> {
    let mut numbers = [0.0; N];
    for inner in fields(field.bytes()?) {
        let inner = inner?;
        // Field numbers come from the file and may have any value.
        let slot = (inner.number as usize)
            .checked_sub(1)
            .and_then(|ix| numbers.get_mut(ix));
        *slot.ok_or(Malformed::Range {
            field: inner.number,
        })? = inner.double()?;
    }
    Ok(numbers)
}

pub(super) fn timestamp(stamp: Stamp) -> Message {
    let mut message = Message::default();
    // Euclidean division is used because the nanoseconds of a `Timestamp` are never negative, even
    // for times before zero.
    message.varint(1, stamp.0.div_euclid(NANOS_PER_SEC).cast_unsigned());
    message.varint(2, stamp.0.rem_euclid(NANOS_PER_SEC).cast_unsigned());
    message
}

pub(super) fn stamp_from(field: &Field<'_>) -> Result<Stamp, Malformed> {
    let mut secs = 0_i64;
    let mut nanos = 0_i64;
    for inner in fields(field.bytes()?) {
        let inner = inner?;
        match inner.number {
            1 => secs = inner.varint()?.cast_signed(),
            2 => nanos = inner.varint()?.cast_signed(),
            _ => {}
        }
    }
    let out_of_range = Malformed::Range {
        field: field.number,
    };
    if !(0..NANOS_PER_SEC).contains(&nanos) {
        return Err(out_of_range);
    }
    let whole = secs.checked_mul(NANOS_PER_SEC);
    whole
        .and_then(|whole| whole.checked_add(nanos))
        .map(Stamp)
        .ok_or(out_of_range)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};

    fn image(format: PixelFormat) -> Image {
        Image {
            camera: "wrist".into(),
            stamp: Stamp(1_234_567_890_123_456_789),
            size_px: [3, 2],
            format,
            data: (0..12).collect(),
            exposure_secs: Some(0.004),
            n_skipped: 3,
        }
    }

    #[test]
    fn images_round_trip_exactly_in_every_format() {
        let depth = PixelFormat::DepthU16 {
            meters_per_count: 0.1 + 0.2,
        };
        let plain = [
            PixelFormat::Rgb8,
            PixelFormat::Bgr8,
            PixelFormat::Gray8,
            PixelFormat::Jpeg,
            PixelFormat::Png,
        ];
        let yuv = [YuvLayout::Yuyv, YuvLayout::Uyvy, YuvLayout::Nv12]
            .into_iter()
            .flat_map(|layout| {
                YUV_COLORS_NAMES.map(|(_, colors)| PixelFormat::Yuv { layout, colors })
            });
        for format in plain.into_iter().chain(yuv).chain([depth]) {
            for exposure_secs in [Some(0.0), None] {
                for stamp in [
                    Stamp(0),
                    Stamp(-1),
                    Stamp(i64::MAX),
                    Stamp(-1_500_000_000),
                    Stamp(999_999_999),
                ] {
                    let sent = Image {
                        exposure_secs,
                        stamp,
                        ..image(format)
                    };
                    assert_eq!(
                        decode_image(schema_of(format).name, &encode_image(&sent)),
                        Ok(sent)
                    );
                }
            }
        }
    }

    #[test]
    fn poses_round_trip_exactly() {
        let pose = Transform::from_parts(
            Translation3::new(0.1, -0.0, 1e-300),
            UnitQuaternion::from_euler_angles(0.3, -0.7, 2.9),
        );
        let (stamp, read) = decode_transform(&encode_transform("world", "base", Stamp(5), &pose))
            .expect("own bytes");
        assert_eq!(stamp, Stamp(5));
        let bits = |pose: &Transform| to_xyz_xyzw(pose).map(f64::to_bits);
        assert_eq!(bits(&read), bits(&pose));
    }

    #[test]
    fn rounded_quaternions_are_normalized_and_others_rejected() {
        let sent = |w: f64| {
            let mut pose = Message::default();
            let mut rotation = Message::default();
            rotation.double(1, 0.6).double(4, w);
            pose.message(1, &timestamp(Stamp(3)))
                .message(4, &Message::default())
                .message(5, &rotation);
            decode_transform(&pose.into_bytes()).map(|(_, pose)| to_xyz_xyzw(&pose))
        };
        let exact = 0.8 + 1e-9;
        assert_eq!(
            sent(exact),
            Ok([0.0, 0.0, 0.0, 0.6, 0.0, 0.0, exact]),
            "bit for bit"
        );
        let [.., x, _, _, w] = sent(0.805).expect("rounded");
        assert!(
            (x.hypot(w) - 1.0).abs() < 1e-12 && (w / x - 0.805 / 0.6).abs() < 1e-12,
            "{x} {w}"
        );
        for w in [0.0, 0.9, 1e9] {
            let error = sent(w).expect_err("not a rotation").to_string();
            assert!(
                error.starts_with("rotation is a quaternion of length "),
                "{error}"
            );
        }
    }

    #[test]
    fn padding_of_rows_is_removed() {
        let packed = Image {
            data: (0..18).collect(),
            ..image(PixelFormat::Rgb8)
        };
        let with_step = |step: u32, data: &[u8]| {
            let mut message = Message::default();
            message
                .message(1, &timestamp(packed.stamp))
                .fixed32(2, 3)
                .fixed32(3, 2)
                .bytes(4, b"rgb8");
            message
                .fixed32(5, step)
                .bytes(6, data)
                .bytes(7, b"wrist")
                .double(EXPOSURE_SECS, 0.004)
                .varint(N_SKIPPED, 3);
            decode_image("foxglove.RawImage", &message.into_bytes())
        };
        let rows = [&packed.data[..9], &[77; 3], &packed.data[9..], &[77; 3]].concat();
        assert_eq!(with_step(12, &rows).as_ref(), Ok(&packed));
        assert_eq!(with_step(9, &packed.data).as_ref(), Ok(&packed));
        for (step, data) in [(8, &rows[..]), (12, &rows[..20]), (u32::MAX, &rows[..])] {
            let error = with_step(step, data)
                .expect_err("rows that do not fit")
                .to_string();
            assert!(
                error.starts_with(&format!("step is {step}, with ")),
                "{error}"
            );
        }
    }

    #[test]
    fn depth_round_trips_exactly() {
        let depth_m = [0.0, 1.25, f32::NAN, f32::MIN_POSITIVE];
        let read = decode_depth_m(&encode_depth_m("wrist", Stamp(1), [2, 2], &depth_m))
            .expect("own bytes");
        assert!(
            read.iter()
                .zip(depth_m)
                .all(|(read, sent)| read.to_bits() == sent.to_bits())
                && read.len() == 4
        );
        let of_size =
            |size_px| decode_depth_m(&encode_depth_m("wrist", Stamp(1), size_px, &depth_m));
        for size_px in [[2, 1], [u32::MAX; 2]] {
            assert!(
                of_size(size_px)
                    .expect_err("another size")
                    .to_string()
                    .starts_with("data is 16 bytes")
            );
        }
    }

    #[test]
    fn missing_and_unknown_fields_are_named() {
        assert_eq!(
            decode_image("foxglove.RawImage", &[]),
            Err(Malformed::Missing { name: "timestamp" })
        );
        let jpeg_as_raw = decode_image(
            "foxglove.RawImage",
            &encode_image(&image(PixelFormat::Jpeg)),
        );
        assert!(jpeg_as_raw.is_err(), "{jpeg_as_raw:?}");
        let truncated = &encode_image(&image(PixelFormat::Rgb8))[..30];
        assert_eq!(
            decode_image("foxglove.RawImage", truncated),
            Err(Malformed::Truncated)
        );
        assert!(decode_transform(&[]).is_err());
    }
}
