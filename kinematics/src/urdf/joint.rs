//! Reads one joint of a robot description.

use super::element::{Element, Notes, Problem};
use super::model::{Joint, JointKind, JointLimits, Mimic};
use crate::{Error, Transform};
use nalgebra::{Quaternion, Translation3, Unit, UnitQuaternion, Vector3};

const ATTRIBUTES: [&str; 2] = ["name", "type"];
/// Known children of a joint. The last three do not affect kinematics.
const CHILDREN: [&str; 9] = [
    "parent",
    "child",
    "origin",
    "axis",
    "limit",
    "mimic",
    "dynamics",
    "calibration",
    "hardwareInterface",
];
/// Known attributes of a limit. The last three are not used.
const LIMIT_ATTRIBUTES: [&str; 7] = [
    "lower",
    "upper",
    "velocity",
    "effort",
    "acceleration",
    "deceleration",
    "jerk",
];
/// Shortest quaternion that is normalized instead of refused. Rounding in a file changes the length
/// of a unit quaternion only slightly. A quaternion as short as this is a mistake, and its
/// direction is noise.
const MIN_QUATERNION_NORM: f64 = 1e-6;

/// Reads a joint. An invalid pose, axis, type or mimic rule is stored in [`Joint::problem`],
/// because only chains through this joint need it.
///
/// # Errors
/// Fails if the name of the joint or one of its links is missing.
pub(super) fn read(element: Element<'_>, notes: &mut Notes) -> Result<Joint, Error> {
    let invalid =
        |what: String| move |Problem { line, why }| Error::UrdfElement { line, what, why };
    let name = element
        .required("name")
        .map_err(invalid("a joint".to_owned()))?;
    let what = format!("joint {name:?}");
    let parent = link_in(element, "parent").map_err(invalid(what.clone()))?;
    let child = link_in(element, "child").map_err(invalid(what.clone()))?;
    note_unknown(element, notes);
    let (motion, problem) = match Motion::read(element, &what, notes) {
        Ok(motion) => (motion, None),
        Err(problem) => {
            notes.add(problem.line, &format!("{what}: {}", problem.why));
            (Motion::INVALID, Some(invalid(what)(problem)))
        }
    };
    let Motion {
        kind,
        parent_from_joint,
        axis,
        limits,
        mimic,
    } = motion;
    Ok(Joint {
        name: name.to_owned(),
        kind,
        parent,
        child,
        parent_from_joint,
        axis,
        limits,
        mimic,
        problem,
    })
}

/// The name of the link in the `<parent>` or `<child>` of a joint.
fn link_in(joint: Element<'_>, tag: &'static str) -> Result<String, Problem> {
    let link = joint
        .only(tag)?
        .ok_or_else(|| joint.problem(format!("it has no <{tag}>")))?;
    Ok(link.required("link")?.to_owned())
}

fn note_unknown(element: Element<'_>, notes: &mut Notes) {
    element.note_unknown(&ATTRIBUTES, &CHILDREN, notes);
    for child in element.children() {
        let attributes: &[&str] = match child.tag() {
            "parent" | "child" => &["link"],
            "origin" => &ORIGIN_ATTRIBUTES,
            "axis" => &["xyz"],
            "limit" => &LIMIT_ATTRIBUTES,
            "mimic" => &["joint", "multiplier", "offset"],
            _ => continue,
        };
        child.note_unknown(attributes, &[], notes);
    }
}

struct Motion {
    kind: JointKind,
    parent_from_joint: Transform,
    axis: Unit<Vector3<f64>>,
    limits: JointLimits,
    mimic: Option<Mimic>,
}

impl Motion {
    const INVALID: Self = Self {
        kind: JointKind::Unsupported("invalid"),
        parent_from_joint: Transform {
            rotation: UnitQuaternion::new_unchecked(Quaternion::from_vector(
                nalgebra::Vector4::new(0.0, 0.0, 0.0, 1.0),
            )),
            translation: Translation3::new(0.0, 0.0, 0.0),
        },
        axis: Unit::new_unchecked(Vector3::new(1.0, 0.0, 0.0)),
        limits: JointLimits::NONE,
        mimic: None,
    };

    fn read(element: Element<'_>, what: &str, notes: &mut Notes) -> Result<Self, Problem> {
        let type_name = element.required("type")?;
        let kind = match type_name {
            "fixed" => JointKind::Fixed,
            "revolute" | "continuous" => JointKind::Revolute,
            "prismatic" => JointKind::Prismatic,
            "floating" => JointKind::Unsupported("floating"),
            "planar" => JointKind::Unsupported("planar"),
            "spherical" => JointKind::Unsupported("spherical"),
            other => return Err(element.problem(format!(
                "unknown type {other:?}, expected fixed, revolute, continuous, prismatic, floating, planar or spherical"
            ))),
        };
        // Axis, limits and mimic rule of a fixed joint have no meaning. They are not read, so
        // errors in them do not matter.
        let parent_from_joint = origin(element)?;
        let is_movable = matches!(kind, JointKind::Revolute | JointKind::Prismatic);
        if !is_movable {
            return Ok(Self {
                kind,
                parent_from_joint,
                ..Self::INVALID
            });
        }
        let limits = match element.only("limit") {
            Ok(None) => JointLimits::NONE,
            Ok(Some(limit)) => read_limits(limit, type_name == "continuous", what, notes),
            Err(Problem { line, why }) => {
                notes.add(line, &format!("{what}: {why}"));
                JointLimits {
                    // The joint is still part of the kinematics, but it must not be moved, because
                    // its real range is unknown.
                    is_range_valid: false,
                    ..JointLimits::NONE
                }
            }
        };
        Ok(Self {
            kind,
            parent_from_joint,
            axis: axis(element)?,
            limits,
            mimic: mimic(element)?,
        })
    }
}

pub(crate) const ORIGIN_ATTRIBUTES: [&str; 3] = ["xyz", "rpy", "quat_xyzw"];

/// The pose in an element's `<origin>`. Without an `<origin>`, it is the identity.
pub(crate) fn origin(element: Element<'_>) -> Result<Transform, Problem> {
    let Some(origin) = element.only("origin")? else {
        return Ok(Transform::identity());
    };
    let xyz = origin.numbers("xyz")?.unwrap_or([0.0; 3]);
    let rotation = match (origin.numbers("rpy")?, origin.numbers("quat_xyzw")?) {
        (Some(_), Some(_)) => {
            return Err(origin.problem("<origin> has both rpy and quat_xyzw; remove one"));
        }
        // Roll, pitch and yaw rotate about the parent's fixed axes x, y, z in both URDF and
        // nalgebra.
        (rpy, None) => {
            let [roll, pitch, yaw] = rpy.unwrap_or([0.0; 3]);
            UnitQuaternion::from_euler_angles(roll, pitch, yaw)
        }
        (None, Some([x, y, z, w])) => {
            UnitQuaternion::try_new(Quaternion::new(w, x, y, z), MIN_QUATERNION_NORM)
                .ok_or_else(|| origin.problem("quat_xyzw of <origin> is zero"))?
        }
    };
    Ok(Transform::from_parts(
        Translation3::from(Vector3::from(xyz)),
        rotation,
    ))
}

fn axis(joint: Element<'_>) -> Result<Unit<Vector3<f64>>, Problem> {
    let Some(axis) = joint.only("axis")? else {
        // The default of the URDF specification.
        return Ok(Vector3::x_axis());
    };
    let Some(xyz) = axis.numbers("xyz")? else {
        return Ok(Vector3::x_axis());
    };
    // Any length but zero is accepted, because only the direction matters.
    Unit::try_new(Vector3::from(xyz), f64::MIN_POSITIVE)
        .ok_or_else(|| axis.problem("xyz of <axis> is zero, expected a direction"))
}

fn mimic(joint: Element<'_>) -> Result<Option<Mimic>, Problem> {
    let Some(mimic) = joint.only("mimic")? else {
        return Ok(None);
    };
    Ok(Some(Mimic {
        source: mimic.required("joint")?.to_owned(),
        multiplier: mimic.number("multiplier")?.unwrap_or(1.0),
        offset: mimic.number("offset")?.unwrap_or(0.0),
    }))
}

/// Reads limits. Forward kinematics do not depend on limits, so invalid limits are only noted.
fn read_limits(
    limit: Element<'_>,
    is_continuous: bool,
    what: &str,
    notes: &mut Notes,
) -> JointLimits {
    let mut number = |name: &str| match limit.number(name) {
        Ok(number) => number,
        Err(Problem { line, why }) => {
            notes.add(line, &format!("{what}: {why}"));
            Some(f64::NAN)
        }
    };
    let [lower, upper] = ["lower", "upper"].map(&mut number);
    // Zero means unknown, because exporters of CAD programs write zero for missing values.
    let [velocity, effort] = ["velocity", "effort"].map(|name| {
        number(name)
            .filter(|max| *max > 0.0)
            .unwrap_or(f64::INFINITY)
    });
    let unlimited = JointLimits {
        velocity,
        effort,
        ..JointLimits::NONE
    };
    // Two zeros are missing values and not a range, because a joint without motion would be a fixed
    // joint.
    if is_continuous || (lower.unwrap_or(0.0), upper.unwrap_or(0.0)) == (0.0, 0.0) {
        return unlimited;
    }
    let lower = lower.unwrap_or(0.0);
    let upper = upper.unwrap_or(0.0);
    // The comparison is false for NaN, which represents a number that could not be read.
    if lower <= upper {
        return JointLimits {
            lower,
            upper,
            ..unlimited
        };
    }
    // NaN has been noted with its own message.
    if !(lower.is_nan() || upper.is_nan()) {
        notes.add(limit.line(), &format!("{what}: lower of <limit> is {lower}, above upper, which is {upper}; the joint has no range and is not moved"));
    }
    JointLimits {
        is_range_valid: false,
        ..unlimited
    }
}
