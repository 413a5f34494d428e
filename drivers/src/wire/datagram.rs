//! UDP datagrams of arms, range scanners and bases. Each datagram is one JSON object.
//! `docs/reference/udp.md` documents the fields.

use super::{Malformed, json};
use crate::RangePoint;
use kinematics::Transform;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Version of the format.
pub const VERSION: u32 = 1;
/// Maximum number of datagrams per scan.
pub const MAX_PARTS: u32 = 64;
/// Maximum absolute value of coordinates, ranges and joint values in their units. Larger values are
/// errors of the sender.
const MAX_ABS_VALUE: f64 = 1e4;
/// Maximum absolute angle, rad. Larger angles are errors of the sender.
const MAX_ANGLE_RAD: f64 = 100.0;
/// Maximum number of characters of a parser message in an error.
const MAX_ERROR_CHARS: usize = 200;
/// Maximum length of a list of names in an error message.
const MAX_LIST_CHARS: usize = 400;
/// Maximum asymmetry of a covariance matrix, as a fraction of the maximum covariance. Matrices in
/// single precision have a smaller asymmetry.
const SYMMETRY_TOLERANCE: f64 = 1e-4;
/// Maximum deviation of a quaternion's norm from 1.
const UNIT_NORM_TOLERANCE: f64 = 1e-3;

/// Clock of a stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// `CLOCK_MONOTONIC` of the receiving computer. The sender must run on the same computer.
    Monotonic,
    /// Any other clock with a steady rate. The arrival times are used to map it to the clock of the
    /// receiving computer.
    Device,
}

/// Fields of every datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DatagramHeader {
    /// Sequence number. It increases by one with every scan, pose or joint state.
    pub seq: u64,
    /// Clock of the stamp.
    pub clock: Clock,
    /// Time of the measurement, or of the start of the scan's rotation, nanoseconds.
    pub stamp_nanos: i64,
}

/// A range scan, or a part of one.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanPart {
    /// Header, which is equal in all parts of a scan.
    pub header: DatagramHeader,
    /// Name of the scanner in the rig file.
    pub frame: String,
    /// Index of this part, from 0.
    pub part: u32,
    /// Number of parts, 1 to [`MAX_PARTS`].
    pub n_parts: u32,
    /// The echoes. Directions without an echo are left out.
    pub points: Vec<RangePoint>,
}

/// Pose of a base.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseDatagram {
    /// Header.
    pub header: DatagramHeader,
    /// Pose of the base.
    pub world_from_base: Transform,
    /// Covariance of the pose, row-major, if the sender reports it. The order is the same as in
    /// `geometry_msgs/PoseWithCovariance` of ROS. The position along the world's axes comes first,
    /// then small rotations about these axes. Units are m², m rad and rad².
    pub covariance: Option<Box<[f64; 36]>>,
}

impl PoseDatagram {
    /// Root mean square errors of position (meters) and rotation (radians), computed from the
    /// covariance. `None` without a covariance.
    pub fn sigmas(&self) -> Option<[f64; 2]> {
        let covariance = self.covariance.as_ref()?;
        let trace = |first: usize| (first..first + 3).map(|ix| covariance[7 * ix]).sum::<f64>();
        Some([trace(0).sqrt(), trace(3).sqrt()])
    }
}

/// State of an arm's joints.
#[derive(Clone, Debug, PartialEq)]
pub struct JointsDatagram {
    /// Header.
    pub header: DatagramHeader,
    /// Positions, radians or meters.
    pub position: Vec<f64>,
    /// Velocities, radians or meters per second. The list is empty if the sender does not report
    /// velocities.
    pub velocity: Vec<f64>,
    /// Efforts, newton meters or newtons. The list is empty if the sender does not report efforts.
    pub effort: Vec<f64>,
}

/// The fields that are checked first. Other fields are ignored.
#[derive(Deserialize)]
struct Kind {
    kind: String,
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct WireScan {
    kind: String,
    version: u32,
    seq: u64,
    clock: Clock,
    stamp_nanos: i64,
    frame: String,
    #[serde(default)]
    part: u32,
    #[serde(default = "default_parts")]
    parts: u32,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    points_m: Option<Vec<f32>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    ranges_m: Option<Vec<Option<f32>>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    first_rad: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    step_rad: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    elevation_rad: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    rings: Option<Vec<u16>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    offsets_micros: Option<Vec<u32>>,
}

#[derive(Serialize, Deserialize)]
struct WirePose {
    kind: String,
    version: u32,
    seq: u64,
    clock: Clock,
    stamp_nanos: i64,
    world_from_base: Pose,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    covariance: Option<Vec<f64>>,
}

#[derive(Serialize, Deserialize)]
struct Pose {
    xyz_m: [f64; 3],
    quat_xyzw: [f64; 4],
}

/// `N` is a number. In datagrams from other programs, it is an optional number.
#[derive(Serialize, Deserialize)]
struct WireJoints<N> {
    kind: String,
    version: u32,
    seq: u64,
    clock: Clock,
    stamp_nanos: i64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    names: Option<Vec<String>>,
    position: Vec<N>,
    #[serde(default = "Vec::new", skip_serializing_if = "Vec::is_empty")]
    velocity: Vec<N>,
    #[serde(default = "Vec::new", skip_serializing_if = "Vec::is_empty")]
    effort: Vec<N>,
}

const SCAN: &str = "range";
const POSE: &str = "base";
const JOINTS: &str = "joints";

fn default_parts() -> u32 {
    1
}

/// Encodes a part of a scan. [`decode_scan`] restores it exactly.
pub fn encode_scan(part: &ScanPart) -> Vec<u8> {
    let ScanPart {
        header,
        frame,
        part,
        n_parts,
        points,
    } = part;
    let wire = WireScan {
        kind: SCAN.to_owned(),
        version: VERSION,
        seq: header.seq,
        clock: header.clock,
        stamp_nanos: header.stamp_nanos,
        frame: frame.clone(),
        part: *part,
        parts: *n_parts,
        points_m: Some(points.iter().flat_map(|point| point.position_m).collect()),
        ranges_m: None,
        first_rad: None,
        step_rad: None,
        elevation_rad: None,
        rings: Some(points.iter().map(|point| point.ring).collect()),
        offsets_micros: Some(points.iter().map(|point| point.offset_micros).collect()),
    };
    serde_json::to_vec(&wire).expect("numbers and lists always serialize")
}

/// Encodes a base pose. [`decode_pose`] restores it exactly.
pub fn encode_pose(pose: &PoseDatagram) -> Vec<u8> {
    let PoseDatagram {
        header,
        world_from_base,
        covariance,
    } = pose;
    let wire = WirePose {
        kind: POSE.to_owned(),
        version: VERSION,
        seq: header.seq,
        clock: header.clock,
        stamp_nanos: header.stamp_nanos,
        world_from_base: Pose {
            xyz_m: world_from_base.translation.vector.into(),
            quat_xyzw: world_from_base.rotation.coords.into(),
        },
        covariance: covariance.as_ref().map(|covariance| covariance.to_vec()),
    };
    serde_json::to_vec(&wire).expect("numbers and lists always serialize")
}

/// Encodes the state of joints with these names. [`decode_joints`] restores it exactly.
pub fn encode_joints(joints: &JointsDatagram, names: &[String]) -> Vec<u8> {
    let JointsDatagram {
        header,
        position,
        velocity,
        effort,
    } = joints;
    let wire = WireJoints {
        kind: JOINTS.to_owned(),
        version: VERSION,
        seq: header.seq,
        clock: header.clock,
        stamp_nanos: header.stamp_nanos,
        names: Some(names.to_vec()),
        position: position.clone(),
        velocity: velocity.clone(),
        effort: effort.clone(),
    };
    serde_json::to_vec(&wire).expect("numbers and lists always serialize")
}

/// Decodes a part of a scan.
pub fn decode_scan(bytes: &[u8]) -> Result<ScanPart, Malformed> {
    check_kind(bytes, SCAN)?;
    let wire: WireScan = parse_json(bytes)?;
    if wire.parts == 0 || wire.parts > MAX_PARTS || wire.part >= wire.parts {
        return Err(invalid(format!(
            "part is {} and parts {}; part must be below parts, and parts 1 to {MAX_PARTS}",
            wire.part, wire.parts
        )));
    }
    let echo_positions = echo_positions(&wire)?;
    let n = echo_positions.len();
    check_length("rings", wire.rings.as_ref().map(Vec::len), n)?;
    check_length(
        "offsets_micros",
        wire.offsets_micros.as_ref().map(Vec::len),
        n,
    )?;
    // Directions without an echo are left out only here, because the lists of rings and offsets
    // also contain these directions.
    let points = echo_positions
        .into_iter()
        .enumerate()
        .filter_map(|(ix, echo_position)| {
            Some(RangePoint {
                position_m: echo_position?,
                ring: wire.rings.as_ref().map_or(0, |rings| rings[ix]),
                offset_micros: wire
                    .offsets_micros
                    .as_ref()
                    .map_or(0, |offsets| offsets[ix]),
            })
        })
        .collect();
    Ok(ScanPart {
        header: DatagramHeader {
            seq: wire.seq,
            clock: wire.clock,
            stamp_nanos: wire.stamp_nanos,
        },
        points,
        frame: wire.frame,
        part: wire.part,
        n_parts: wire.parts,
    })
}

/// Checks the length of an optional list with one entry per point or range.
fn check_length(name: &str, len: Option<usize>, n: usize) -> Result<(), Malformed> {
    match len {
        Some(len) if len != n => Err(invalid(format!(
            "{name} has {len} entries, but there are {n} points or ranges"
        ))),
        _ => Ok(()),
    }
}

/// Decodes a base pose.
pub fn decode_pose(bytes: &[u8]) -> Result<PoseDatagram, Malformed> {
    check_kind(bytes, POSE)?;
    let wire: WirePose = parse_json(bytes)?;
    let Pose {
        xyz_m: [x, y, z],
        quat_xyzw: [i, j, k, w],
    } = wire.world_from_base;
    if ![x, y, z]
        .iter()
        .all(|coordinate| coordinate.abs() <= MAX_ABS_VALUE)
    {
        return Err(invalid(format!(
            "xyz_m has an absolute value above {MAX_ABS_VALUE} m"
        )));
    }
    let quaternion = Quaternion::new(w, i, j, k);
    // The comparison is written so that NaN fails it.
    let is_unit = (quaternion.norm() - 1.0).abs() <= UNIT_NORM_TOLERANCE;
    if !is_unit {
        return Err(invalid("quat_xyzw is not a unit quaternion".to_owned()));
    }
    // A quaternion with the precision of f64 is kept bit for bit, so that encoding and decoding do
    // not change a pose. A quaternion that was rounded is normalized.
    let rotation = if (quaternion.norm() - 1.0).abs() < 1e-12 {
        UnitQuaternion::new_unchecked(quaternion)
    } else {
        UnitQuaternion::new_normalize(quaternion)
    };
    Ok(PoseDatagram {
        header: DatagramHeader {
            seq: wire.seq,
            clock: wire.clock,
            stamp_nanos: wire.stamp_nanos,
        },
        world_from_base: Transform::from_parts(Translation3::new(x, y, z), rotation),
        covariance: wire.covariance.map(covariance).transpose()?,
    })
}

fn covariance(numbers: Vec<f64>) -> Result<Box<[f64; 36]>, Malformed> {
    let n = numbers.len();
    let covariance: Box<[f64; 36]> = numbers
        .try_into()
        .map_err(|_| invalid(format!("covariance has {n} numbers, expected 36")))?;
    if !(0..6).all(|ix| (0.0..=MAX_ABS_VALUE).contains(&covariance[7 * ix])) {
        return Err(invalid(format!(
            "covariance has a variance outside 0 to {MAX_ABS_VALUE}"
        )));
    }
    for (row, column) in (0..6).flat_map(|row| (0..row).map(move |column| (row, column))) {
        let [lower, upper] = [covariance[6 * row + column], covariance[6 * column + row]];
        // According to the Cauchy-Schwarz inequality, a covariance is at most the product of both
        // standard deviations.
        let max_covariance = (covariance[7 * row] * covariance[7 * column]).sqrt();
        if (lower - upper).abs() > SYMMETRY_TOLERANCE * max_covariance
            || lower.abs() > (1.0 + SYMMETRY_TOLERANCE) * max_covariance
        {
            return Err(invalid(format!(
                "covariance: row {row}, column {column} (from 0) differs from the transposed entry, or is larger than the variances allow"
            )));
        }
    }
    Ok(covariance)
}

/// Decodes the state of joints with these names. `None` if the datagram names only other joints,
/// such as the joints of a gripper.
///
/// Joints are found by their names. Without names, the numbers must be in the order of `names`.
/// Velocities and efforts count as not reported if one of them is null or NaN.
pub fn decode_joints(
    bytes: &[u8],
    names: &[String],
) -> Result<(DatagramHeader, Option<JointsDatagram>), Malformed> {
    check_kind(bytes, JOINTS)?;
    let joints: WireJoints<Option<f64>> = parse_json(bytes)?;
    let WireJoints {
        seq,
        clock,
        stamp_nanos,
        names: reported,
        position,
        velocity,
        effort,
        ..
    } = joints;
    let header = DatagramHeader {
        seq,
        clock,
        stamp_nanos,
    };
    let layout = match &reported {
        None => JointLayout {
            order: (0..names.len()).collect(),
            n: names.len(),
            per: "joint",
        },
        Some(reported) => match order_of(names, reported)? {
            Some(order) => JointLayout {
                order,
                n: reported.len(),
                per: "name",
            },
            None => return Ok((header, None)),
        },
    };
    let position = layout.numbers("position", &position, false)?;
    let velocity = layout.numbers("velocity", &velocity, true)?;
    let effort = layout.numbers("effort", &effort, true)?;
    Ok((
        header,
        Some(JointsDatagram {
            header,
            position,
            velocity,
            effort,
        }),
    ))
}

/// The reason why a valid state is not a state of these joints. It contains the names in the
/// datagram and the expected names.
pub fn unmatched_names(bytes: &[u8], joints: &[String]) -> Result<String, Malformed> {
    let state: WireJoints<Option<f64>> = parse_json(bytes)?;
    let reported = state.names.unwrap_or_default();
    Ok(format!(
        "names has {}, and arm.joints has {}",
        shown(&reported),
        shown(joints)
    ))
}

/// Positions of the requested joints in the lists of a datagram.
struct JointLayout {
    /// Index of each requested joint in the lists.
    order: Vec<usize>,
    /// Length of the lists.
    n: usize,
    /// The items for which the lists have one number each, in the words of messages.
    per: &'static str,
}

impl JointLayout {
    /// The numbers of the requested joints. An optional list may be empty. If such a list has null
    /// or NaN for a requested joint, it counts as empty.
    fn numbers(
        &self,
        what: &str,
        numbers: &[Option<f64>],
        is_optional: bool,
    ) -> Result<Vec<f64>, Malformed> {
        if is_optional && numbers.is_empty() {
            return Ok(Vec::new());
        }
        if numbers.len() != self.n {
            return Err(invalid(format!(
                "{what} has {} numbers, expected {}, one per {}",
                numbers.len(),
                self.n,
                self.per
            )));
        }
        let ordered: Option<Vec<f64>> = self.order.iter().map(|ix| numbers[*ix]).collect();
        match ordered {
            Some(ordered) if ordered.iter().any(|number| number.abs() > MAX_ABS_VALUE) => {
                Err(invalid(format!(
                    "{what} has an absolute value above {MAX_ABS_VALUE}"
                )))
            }
            Some(ordered) => Ok(ordered),
            None if is_optional => Ok(Vec::new()),
            None => Err(invalid(format!("{what} has null or NaN"))),
        }
    }
}

/// Index of each joint in `reported`. `None` if `reported` contains none of the joints.
fn order_of(joints: &[String], reported: &[String]) -> Result<Option<Vec<usize>>, Malformed> {
    let found = joints
        .iter()
        .map(|joint| only_index_of(joint, reported))
        .collect::<Result<Vec<_>, _>>()?;
    // Several devices may send to one port, so a datagram may contain none of the joints. If it
    // contains only some of them, the names are wrong.
    if found.iter().all(Option::is_none) && !joints.is_empty() {
        return Ok(None);
    }
    let missing = joints
        .iter()
        .zip(&found)
        .find(|(_, ix)| ix.is_none())
        .map(|(joint, _)| joint);
    match missing {
        None => Ok(Some(found.into_iter().flatten().collect())),
        Some(missing) => Err(invalid(format!(
            "names lacks {missing:?}; it has {}, and arm.joints has {}",
            shown(reported),
            shown(joints)
        ))),
    }
}

/// Index of a joint in `reported`, which must not contain it twice.
fn only_index_of(joint: &str, reported: &[String]) -> Result<Option<usize>, Malformed> {
    let mut found = (0..reported.len()).filter(|ix| reported[*ix] == *joint);
    let first = found.next();
    match found.next() {
        None => Ok(first),
        Some(_) => Err(invalid(format!("names has {joint:?} twice"))),
    }
}

/// Names for a message. Control characters are removed, because the names come from the network and
/// are logged.
fn shown(names: &[String]) -> String {
    names
        .join(", ")
        .chars()
        .filter(|c| !c.is_control())
        .take(MAX_LIST_CHARS)
        .collect()
}

/// Positions of the echoes. The list has one entry per direction of a part. An entry is `None` if
/// there was no echo.
fn echo_positions(wire: &WireScan) -> Result<Vec<Option<[f32; 3]>>, Malformed> {
    match (&wire.points_m, &wire.ranges_m) {
        (Some(numbers), None) => {
            let (points, rest) = numbers.as_chunks::<3>();
            if !rest.is_empty() {
                return Err(invalid(format!(
                    "points_m has {} numbers, expected three per point",
                    numbers.len()
                )));
            }
            // This comparison is false for NaN, too.
            let is_near = points
                .iter()
                .flatten()
                .all(|coordinate| f64::from(coordinate.abs()) <= MAX_ABS_VALUE);
            if !is_near {
                return Err(invalid(format!(
                    "points_m has an absolute value above {MAX_ABS_VALUE} m"
                )));
            }
            Ok(points.iter().map(|point| Some(*point)).collect())
        }
        (None, Some(ranges)) => positions_from_ranges(wire, ranges),
        _ => Err(invalid(
            "expected either points_m or ranges_m, not both".to_owned(),
        )),
    }
}

/// Positions of the echoes of a planar scan, which has one range per direction.
fn positions_from_ranges(
    wire: &WireScan,
    ranges: &[Option<f32>],
) -> Result<Vec<Option<[f32; 3]>>, Malformed> {
    let first_rad = angle("first_rad", wire.first_rad)?;
    let step_rad = angle("step_rad", wire.step_rad)?;
    let elevation_rad = angle("elevation_rad", Some(wire.elevation_rad.unwrap_or(0.0)))?;
    let mut positions = Vec::with_capacity(ranges.len());
    for (ix, range) in ranges.iter().enumerate() {
        let Some(range_m) = range.map(f64::from) else {
            positions.push(None);
            continue;
        };
        if !(0.0..=MAX_ABS_VALUE).contains(&range_m) {
            return Err(invalid(format!(
                "ranges_m has a number outside 0 to {MAX_ABS_VALUE} m"
            )));
        }
        // The step is multiplied by the index instead of added repeatedly, so that rounding errors
        // do not accumulate.
        let azimuth_rad = first_rad + ix as f64 * step_rad;
        positions.push(Some(position_from_polar(
            range_m,
            azimuth_rad,
            elevation_rad,
        )));
    }
    Ok(positions)
}

/// A required angle, rad. A value in degrees is usually above the maximum and thus rejected.
fn angle(name: &str, angle_rad: Option<f64>) -> Result<f64, Malformed> {
    match angle_rad {
        Some(angle_rad) if angle_rad.abs() <= MAX_ANGLE_RAD => Ok(angle_rad),
        _ => Err(invalid(format!(
            "ranges_m requires {name} between -{MAX_ANGLE_RAD} and {MAX_ANGLE_RAD} rad"
        ))),
    }
}

/// Position of an echo. The azimuth is measured from x towards y, the elevation from that plane
/// towards z.
#[expect(clippy::cast_possible_truncation, reason = "meters within 10 km")]
fn position_from_polar(range_m: f64, azimuth_rad: f64, elevation_rad: f64) -> [f32; 3] {
    let horizontal_m = range_m * elevation_rad.cos();
    [
        horizontal_m * azimuth_rad.cos(),
        horizontal_m * azimuth_rad.sin(),
        range_m * elevation_rad.sin(),
    ]
    .map(|coordinate| coordinate as f32)
}

fn check_kind(bytes: &[u8], expected: &'static str) -> Result<(), Malformed> {
    let Kind { kind, version } = parse_json(bytes)?;
    if kind != expected {
        // The text from the sender is not repeated, because it may be of any length.
        return Err(invalid(format!("the kind is not {expected:?}")));
    }
    if version != VERSION {
        return Err(invalid(format!(
            "version {version} is not supported, expected {VERSION}"
        )));
    }
    Ok(())
}

/// Parses JSON. `NaN` and `Infinity`, which Python writes, are read as null.
fn parse_json<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, Malformed> {
    let parse =
        |bytes: &[u8]| serde_json::from_slice(bytes).map_err(|error| invalid(reported(&error)));
    // `NaN` and `Infinity` are replaced only if the original text is not valid JSON, because the
    // replacement requires a copy of the text.
    parse(bytes).or_else(|error| match std::str::from_utf8(bytes) {
        Ok(text) if text.contains("NaN") || text.contains("Infinity") => {
            parse(json::nan_as_null(text).as_bytes())
        }
        _ => Err(error),
    })
}

/// Makes the message of the parser safe to log. The parser may repeat the sender's text, which may
/// be long and contain any characters.
fn reported(error: &serde_json::Error) -> String {
    error
        .to_string()
        .chars()
        .take(MAX_ERROR_CHARS)
        .map(|c| if c.is_control() { '?' } else { c })
        .collect()
}

fn invalid(reason: String) -> Malformed {
    Malformed::Json { reason }
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    const HEADER: DatagramHeader = DatagramHeader {
        seq: 7,
        clock: Clock::Monotonic,
        stamp_nanos: 1_234_567_890_123,
    };

    fn part() -> ScanPart {
        let point = |ix: u16| RangePoint {
            position_m: [0.1 + f32::from(ix), -1.0 / 3.0, 1e-7],
            ring: ix,
            offset_micros: 100 * u32::from(ix),
        };
        ScanPart {
            header: HEADER,
            frame: "lidar".into(),
            part: 1,
            n_parts: 3,
            points: (0..5).map(point).collect(),
        }
    }

    fn pose() -> PoseDatagram {
        let rotation = UnitQuaternion::from_euler_angles(0.1, -0.2, 3.0);
        let world_from_base =
            Transform::from_parts(Translation3::new(0.1, -1.0 / 3.0, 1e3), rotation);
        let covariance = Some(Box::new(std::array::from_fn(|ix| {
            if ix % 7 == 0 {
                1e-4
            } else {
                1e-6 * (ix / 6 + ix % 6) as f64
            }
        })));
        PoseDatagram {
            header: DatagramHeader {
                clock: Clock::Device,
                ..HEADER
            },
            world_from_base,
            covariance,
        }
    }

    fn names() -> Vec<String> {
        ["a", "b", "c"].map(str::to_owned).to_vec()
    }

    fn joints() -> JointsDatagram {
        JointsDatagram {
            header: HEADER,
            position: vec![0.1, -1.0 / 3.0, 3.0],
            velocity: vec![1e-7, 0.0, -2.0],
            effort: Vec::new(),
        }
    }

    fn scan_error(fields: &str) -> String {
        let text = format!(
            r#"{{"kind":"range","version":1,"seq":1,"clock":"device","stamp_nanos":5,"frame":"lidar",{fields}}}"#
        );
        decode_scan(text.as_bytes()).expect_err(fields).to_string()
    }

    #[test]
    fn datagrams_round_trip_exactly() {
        assert_eq!(
            decode_scan(&encode_scan(&part())).expect("own bytes"),
            part()
        );
        assert_eq!(
            decode_pose(&encode_pose(&pose())).expect("own bytes"),
            pose()
        );
        let (header, decoded) =
            decode_joints(&encode_joints(&joints(), &names()), &names()).expect("own bytes");
        assert_eq!((header, decoded), (HEADER, Some(joints())));
    }

    #[test]
    fn documented_datagrams_are_decoded() {
        let page = include_str!("../../../docs/reference/udp.md");
        let examples: Vec<&str> = page
            .lines()
            // Datagrams that drive a base have another format, which `base_drive.rs` tests.
            .filter(|line| line.starts_with(r#"{"kind""#) && !line.contains(r#":"drive"#))
            .collect();
        let scans: Vec<ScanPart> = examples
            .iter()
            .filter_map(|text| decode_scan(text.as_bytes()).ok())
            .collect();
        let poses = examples
            .iter()
            .filter(|text| decode_pose(text.as_bytes()).is_ok())
            .count();
        let names: Vec<String> = (1..=7).map(|n| format!("panda_joint{n}")).collect();
        let joints = examples
            .iter()
            .filter(|text| {
                decode_joints(text.as_bytes(), &names).is_ok_and(|(_, joints)| joints.is_some())
            })
            .count();
        assert_eq!((examples.len(), scans.len(), poses, joints), (5, 2, 1, 2));
        // The directions are ahead, one without echo, and to the left.
        let ranges = &scans[1].points;
        assert_eq!(ranges.len(), 2);
        assert!(
            (ranges[0].position_m[0] - 2.0).abs() < 1e-6 && ranges[0].position_m[1].abs() < 1e-6,
            "{ranges:?}"
        );
        assert!(
            (ranges[1].position_m[1] - 1.5).abs() < 1e-3 && ranges[1].offset_micros == 200,
            "{ranges:?}"
        );
    }

    #[test]
    fn invalid_fields_are_named() {
        for (fields, named) in [
            (r#""points_m":[1,2,3,4]"#, "three per point"),
            (r#""points_m":[1,2,1e5]"#, "absolute value above"),
            (r#""points_m":[1,2,1e39]"#, "out of range"),
            (r#""points_m":[1,2,null]"#, "null"),
            (r#""points_m":[1,2,3],"ranges_m":[1]"#, "not both"),
            (r#""rings":[]"#, "points_m or ranges_m"),
            (r#""points_m":[1,2,3],"rings":[1,2]"#, "rings has 2"),
            (r#""points_m":[1,2,3],"rings":[70000]"#, "70000"),
            (
                r#""points_m":[1,2,3],"offsets_micros":[]"#,
                "offsets_micros has 0",
            ),
            (r#""ranges_m":[1],"step_rad":0.1"#, "first_rad"),
            (r#""ranges_m":[1],"first_rad":0,"step_rad":1e9"#, "step_rad"),
            (r#""ranges_m":[-1],"first_rad":0,"step_rad":0.1"#, "outside"),
            (r#""points_m":[],"parts":0"#, "parts"),
            (r#""points_m":[],"parts":65"#, "parts"),
            (r#""points_m":[],"part":2,"parts":2"#, "part is 2"),
            (r#""points_m":[],"seq":2"#, "duplicate"),
        ] {
            let reported = scan_error(fields);
            assert!(reported.contains(named), "{fields}: {reported}");
        }
        let other = String::from_utf8(encode_pose(&pose())).expect("text");
        for (from, to, named) in [
            (r#""version":1"#, r#""version":2"#, "version 2"),
            (r#""kind":"base""#, r#""kind":"range""#, "base"),
            (r#""clock":"device""#, r#""clock":"sundial""#, "sundial"),
            (
                r#""stamp_nanos":"#,
                r#""stamp_nanos":1e99,"x":"#,
                "floating point",
            ),
            (
                r#""quat_xyzw":["#,
                r#""quat_xyzw":[0,0,0,0],"x":["#,
                "unit quaternion",
            ),
            (
                r#""xyz_m":["#,
                r#""xyz_m":[0,-1e300,0],"x":["#,
                "absolute value above",
            ),
            (r#""covariance":["#, r#""covariance":[1],"x":["#, "36"),
            (r#""covariance":["#, r#""covariance":[-1],"x":["#, "36"),
            (
                r#""covariance":[0.0001"#,
                r#""covariance":[-0.0001"#,
                "variance outside",
            ),
            (
                r#""covariance":[0.0001,1e-6"#,
                r#""covariance":[0.0001,2e-6"#,
                "row 1, column 0",
            ),
            (
                r#""covariance":[0.0001"#,
                r#""covariance":[0.0"#,
                "row 1, column 0",
            ),
        ] {
            assert!(other.contains(from), "{from}");
            let reported = decode_pose(other.replace(from, to).as_bytes())
                .expect_err(to)
                .to_string();
            assert!(reported.contains(named), "{to}: {reported}");
        }
    }

    #[test]
    fn invalid_joints_are_named() {
        let good = String::from_utf8(encode_joints(&joints(), &names())).expect("text");
        for (from, to, named) in [
            (
                r#"["a","b","c"]"#,
                r#"["a","x","c"]"#,
                "names lacks \"b\"; it has a, x, c, and arm.joints has a, b, c",
            ),
            (
                r#"["a","b","c"]"#,
                r#"["a","b","c","b"]"#,
                "names has \"b\" twice",
            ),
            (
                r#"["a","b","c"]"#,
                r#"["a","b","c","d"]"#,
                "position has 3 numbers, expected 4",
            ),
            (r#""position":["#, r#""position":[1,"#, "position has 4"),
            (
                r#""position":["#,
                r#""position":[],"x":["#,
                "position has 0",
            ),
            (
                r#""position":["#,
                r#""position":[0,1e5,0],"x":["#,
                "absolute value above",
            ),
            (
                r#""position":["#,
                r#""position":[0,null,0],"x":["#,
                "position has null or NaN",
            ),
            (
                r#""position":["#,
                r#""position":[0,NaN,0],"x":["#,
                "position has null or NaN",
            ),
            (
                r#""velocity":["#,
                r#""velocity":[1],"x":["#,
                "velocity has 1",
            ),
            (
                r#""version":1"#,
                r#""version":1,"effort":[1,2]"#,
                "effort has 2",
            ),
        ] {
            assert!(good.contains(from), "{from}");
            let reported = decode_joints(good.replace(from, to).as_bytes(), &names())
                .expect_err(to)
                .to_string();
            assert!(reported.contains(named), "{to}: {reported}");
        }
    }

    #[test]
    fn joints_are_found_by_name_and_other_joints_ignored() {
        let decode = |fields: &str| {
            let text = format!(
                r#"{{"kind":"joints","version":1,"seq":1,"clock":"device","stamp_nanos":5,{fields}}}"#
            );
            decode_joints(text.as_bytes(), &names()).expect(fields).1
        };
        let shuffled = decode(
            r#""names":["left","c","a","right","b"],"position":[9,3,1,9,2],"velocity":[9,-3,-1,9,-2],"effort":[NaN,0,0,-Infinity,0]"#,
        );
        let shuffled = shuffled.expect("all joints");
        assert_eq!(
            (shuffled.position, shuffled.velocity),
            (vec![1.0, 2.0, 3.0], vec![-1.0, -2.0, -3.0])
        );
        assert_eq!(
            shuffled.effort, [0.0; 3],
            "those of other joints do not matter"
        );
        let unknown =
            decode(r#""position":[1,2,3],"velocity":[0,NaN,0],"effort":[null,null,null]"#)
                .expect("all joints");
        assert!(unknown.velocity.is_empty() && unknown.effort.is_empty());
        assert_eq!(decode(r#""names":["left","right"],"position":[9,9]"#), None);
    }

    #[test]
    fn sender_text_in_errors_is_truncated() {
        let long = format!(r#""a\n{}""#, "b".repeat(50_000));
        let text = String::from_utf8(encode_pose(&pose()))
            .expect("text")
            .replace(r#""device""#, &long);
        let reported = decode_pose(text.as_bytes())
            .expect_err("no such clock")
            .to_string();
        assert!(
            reported.contains("unknown variant `a?b") && reported.len() <= MAX_ERROR_CHARS,
            "{reported}"
        );
    }

    #[test]
    fn corrupted_bytes_never_panic() {
        for complete in [
            encode_scan(&part()),
            encode_pose(&pose()),
            encode_joints(&joints(), &names()),
        ] {
            for end in 0..complete.len() {
                assert!(
                    decode_scan(&complete[..end]).is_err()
                        && decode_pose(&complete[..end]).is_err(),
                    "{end}"
                );
                assert!(decode_joints(&complete[..end], &names()).is_err(), "{end}");
            }
            for ix in 0..8 * complete.len() {
                let mut corrupted = complete.clone();
                corrupted[ix / 8] ^= 1 << (ix % 8);
                let _ = (
                    decode_scan(&corrupted),
                    decode_pose(&corrupted),
                    decode_joints(&corrupted, &names()),
                );
            }
        }
        let mut random = Random::new(1);
        for len in 0..2000 {
            let bytes = random.bytes(len % 300);
            assert!(decode_scan(&bytes).is_err() && decode_pose(&bytes).is_err());
            assert!(decode_joints(&bytes, &names()).is_err());
        }
        let deep = "[".repeat(60_000);
        assert!(
            decode_scan(format!(r#"{{"kind":"range","version":1,"points_m":{deep}"#).as_bytes())
                .is_err()
        );
    }
}
