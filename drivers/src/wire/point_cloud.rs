//! Range scans as Foxglove's `PointCloud`.
//!
//! A point has 20 bytes, little-endian. It consists of x, y and z as f32 in meters, the ring as
//! u16, two unused bytes, and the microseconds since the stamp as u32. The encoding is lossless.

use super::Malformed;
use super::foxglove::{numbers, stamp_from, timestamp};
use super::protobuf::{Field, Message, fields};
use crate::{RangePoint, RangeScan};
use std::sync::Arc;

const STRIDE: u32 = 20;
/// Name, offset in the point, and Foxglove's number of the type. The number 3 is u16, 5 is u32, and
/// 7 is f32.
const FIELDS: [(&str, u32, u64); 5] = [
    ("x", 0, 7),
    ("y", 4, 7),
    ("z", 8, 7),
    ("ring", 12, 3),
    ("time_offset_micros", 16, 5),
];

/// Encodes a scan as the message [`super::descriptor::POINT_CLOUD`].
pub fn encode(scan: &RangeScan) -> Vec<u8> {
    let mut data = Vec::with_capacity(scan.points.len() * STRIDE as usize);
    for point in scan.points.iter() {
        data.extend(
            point
                .position_m
                .iter()
                .flat_map(|meters| meters.to_le_bytes()),
        );
        data.extend(point.ring.to_le_bytes());
        // The padding aligns the last number to four bytes.
        data.extend([0; 2]);
        data.extend(point.offset_micros.to_le_bytes());
    }
    let mut message = Message::with_capacity(data.len() + 256);
    message
        .message(1, &timestamp(scan.stamp))
        .bytes(2, scan.scanner.as_bytes());
    message.message(3, &identity()).fixed32(4, STRIDE);
    for (name, offset, kind) in FIELDS {
        let mut field = Message::default();
        field
            .bytes(1, name.as_bytes())
            .fixed32(2, offset)
            .varint(3, kind);
        message.message(5, &field);
    }
    message.bytes(6, &data);
    message.into_bytes()
}

/// The identity as a pose, because the points are in the frame of the scanner.
fn identity() -> Message {
    let mut position = Message::default();
    let mut orientation = Message::default();
    let mut pose = Message::default();
    position.double(1, 0.0).double(2, 0.0).double(3, 0.0);
    orientation
        .double(1, 0.0)
        .double(2, 0.0)
        .double(3, 0.0)
        .double(4, 1.0);
    pose.message(1, &position).message(2, &orientation);
    pose
}

/// Decodes the scan that [`encode`] encoded. A cloud with another layout is an error.
pub fn decode(bytes: &[u8]) -> Result<RangeScan, Malformed> {
    let mut stamp = None;
    let mut scanner = Arc::from("");
    let mut stride = None;
    let mut points = None;
    let mut layout = Vec::new();
    for field in fields(bytes) {
        let field = field?;
        match field.number {
            1 => stamp = Some(stamp_from(&field)?),
            2 => scanner = field.text()?.into(),
            3 => expect_identity(&field)?,
            4 => stride = Some(field.fixed32()?),
            5 => layout.push(point_field(&field)?),
            6 => points = Some(field.bytes()?),
            _ => {}
        }
    }
    let data = points.ok_or(Malformed::Missing { name: "data" })?;
    if stride != Some(STRIDE) || data.len() % STRIDE as usize != 0 {
        return Err(Malformed::Range { field: 4 });
    }
    // A cloud of another program may have points of the same length with other contents. Its bytes
    // would be read as wrong positions.
    if layout != FIELDS {
        return Err(Malformed::Unsupported {
            name: "fields",
            found: described(&layout),
            expected: described(&FIELDS),
        });
    }
    let stamp = stamp.ok_or(Malformed::Missing { name: "timestamp" })?;
    Ok(RangeScan {
        scanner,
        stamp,
        points: data
            .as_chunks::<{ STRIDE as usize }>()
            .0
            .iter()
            .map(point)
            .collect(),
    })
}

/// Rejects points that are not in the frame of the scanner.
fn expect_identity(pose: &Field<'_>) -> Result<(), Malformed> {
    let mut position = [0.0; 3];
    let mut orientation = [0.0, 0.0, 0.0, 1.0];
    for field in fields(pose.bytes()?) {
        let field = field?;
        match field.number {
            1 => position = numbers(&field)?,
            2 => orientation = numbers(&field)?,
            _ => {}
        }
    }
    if position == [0.0; 3] && orientation == [0.0, 0.0, 0.0, 1.0] {
        return Ok(());
    }
    let found = format!("{position:?} m, quaternion {orientation:?}");
    Err(Malformed::Unsupported {
        name: "pose",
        found,
        expected: "the identity".to_owned(),
    })
}

/// Name, offset and type of one `PackedElementField`.
fn point_field<'a>(field: &Field<'a>) -> Result<(&'a str, u32, u64), Malformed> {
    let mut name = "";
    let mut offset = 0;
    let mut kind = 0;
    for inner in fields(field.bytes()?) {
        let inner = inner?;
        match inner.number {
            1 => name = inner.text()?,
            2 => offset = inner.fixed32()?,
            3 => kind = inner.varint()?,
            _ => {}
        }
    }
    Ok((name, offset, kind))
}

fn described(layout: &[(&str, u32, u64)]) -> String {
    let field =
        |(name, offset, kind): &(&str, u32, u64)| format!("{name} at {offset} of type {kind}");
    if layout.is_empty() {
        "absent".to_owned()
    } else {
        layout.iter().map(field).collect::<Vec<_>>().join(", ")
    }
}

fn point(bytes: &[u8; STRIDE as usize]) -> RangePoint {
    let four_bytes_at = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
    RangePoint {
        position_m: [0, 4, 8].map(|at| f32::from_le_bytes(four_bytes_at(at))),
        ring: u16::from_le_bytes([bytes[12], bytes[13]]),
        offset_micros: u32::from_le_bytes(four_bytes_at(16)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Stamp;

    #[test]
    fn scans_round_trip_exactly_and_other_layouts_are_rejected() {
        let point = |x: f32, ring| RangePoint {
            position_m: [x, -0.0, 1e-30],
            ring,
            offset_micros: 7 + u32::from(ring),
        };
        let points: Arc<[RangePoint]> = [point(1.5, 0), point(-3.25, u16::MAX)].into();
        for points in [points, [].into()] {
            let scan = RangeScan {
                scanner: "lidar".into(),
                stamp: Stamp(-12_345_678_901),
                points,
            };
            let bytes = encode(&scan);
            assert_eq!(decode(&bytes).as_ref(), Ok(&scan));
            let read = decode(&bytes).expect("own bytes");
            let bits = |scan: &RangeScan| -> Vec<u32> {
                scan.points
                    .iter()
                    .flat_map(|point| point.position_m.map(f32::to_bits))
                    .collect()
            };
            assert_eq!(bits(&read), bits(&scan));
        }
        let mut other = Message::default();
        other
            .message(1, &timestamp(Stamp(1)))
            .fixed32(4, 16)
            .bytes(6, &[0; 32]);
        assert_eq!(
            decode(&other.into_bytes()),
            Err(Malformed::Range { field: 4 })
        );
        assert_eq!(decode(&[]), Err(Malformed::Missing { name: "data" }));
    }

    #[test]
    fn other_poses_and_fields_are_named() {
        let scan = RangeScan {
            scanner: "lidar".into(),
            stamp: Stamp(5),
            points: [].into(),
        };
        let changed = |change: &Message| {
            // Fields of a message may be in any order, so encoded parts can be concatenated.
            decode(&[encode(&scan), change.clone().into_bytes()].concat())
                .map_err(|error| error.to_string())
        };
        let (mut position, mut pose, mut at) =
            (Message::default(), Message::default(), Message::default());
        position.double(3, 0.5);
        pose.message(1, &position);
        at.message(3, &pose);
        assert_eq!(
            changed(&at),
            Err(
                "pose is [0.0, 0.0, 0.5] m, quaternion [0.0, 0.0, 0.0, 1.0], expected the identity"
                    .to_owned()
            )
        );
        let (mut intensity, mut more) = (Message::default(), Message::default());
        intensity.bytes(1, b"intensity").fixed32(2, 12).varint(3, 7);
        more.message(5, &intensity);
        let error = changed(&more).expect_err("another layout");
        assert!(
            error.starts_with("fields is x at 0 of type 7, ")
                && error.contains("intensity at 12 of"),
            "{error}"
        );
        assert_eq!(changed(&Message::default()), Ok(scan.clone()));
    }
}
