//! Kinematics and limits of the Panda, and a body of simple primitives.
//!
//! Source of the numbers: Franka's published Denavit-Hartenberg table (Craig's convention) and
//! joint limits.

use crate::config::N_JOINTS;
use kinematics::Transform;
use nalgebra::{Matrix6xX, SMatrix, SVector, Translation3, UnitQuaternion, Vector3};
use std::fmt::Write as _;

/// Joint positions, velocities or torques.
pub(crate) type Joints = SVector<f64, N_JOINTS>;
/// Linear velocity of a frame's origin and angular velocity, both in world axes, per unit of joint
/// velocity.
pub(crate) type Jacobian = SMatrix<f64, 6, N_JOINTS>;

/// Craig's parameters of a joint: distance a along the previous x axis, angle alpha about it, and
/// offset d along the joint axis.
struct Link {
    a_m: f64,
    alpha_rad: f64,
    d_m: f64,
}

const QUARTER: f64 = std::f64::consts::FRAC_PI_2;
const LINKS: [Link; N_JOINTS] = [
    Link {
        a_m: 0.0,
        alpha_rad: 0.0,
        d_m: 0.333,
    },
    Link {
        a_m: 0.0,
        alpha_rad: -QUARTER,
        d_m: 0.0,
    },
    Link {
        a_m: 0.0,
        alpha_rad: QUARTER,
        d_m: 0.316,
    },
    Link {
        a_m: 0.0825,
        alpha_rad: QUARTER,
        d_m: 0.0,
    },
    Link {
        a_m: -0.0825,
        alpha_rad: -QUARTER,
        d_m: 0.384,
    },
    Link {
        a_m: 0.0,
        alpha_rad: QUARTER,
        d_m: 0.0,
    },
    Link {
        a_m: 0.088,
        alpha_rad: QUARTER,
        d_m: 0.0,
    },
];
/// Distance from the last joint to the flange along its axis, meters.
const FLANGE_M: f64 = 0.107;

/// Lower limits of the joints, radians.
pub(crate) const LOWER_RAD: [f64; N_JOINTS] = [
    -2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973,
];
/// Upper limits of the joints, radians.
pub(crate) const UPPER_RAD: [f64; N_JOINTS] =
    [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973];
/// Largest joint velocities, radians per second.
pub(crate) const MAX_SPEED_RAD_S: [f64; N_JOINTS] = [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61];
/// Largest joint accelerations, radians per second squared.
pub(crate) const MAX_ACCELERATION_RAD_S2: [f64; N_JOINTS] =
    [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0];
/// Largest joint jerks, radians per second cubed.
pub(crate) const MAX_JERK_RAD_S3: [f64; N_JOINTS] =
    [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10_000.0, 10_000.0];
/// Largest joint torques, newton meters.
pub(crate) const MAX_TORQUE_NM: [f64; N_JOINTS] = [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0];

impl Link {
    fn parent_from_joint(&self) -> Transform {
        let link_rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), self.alpha_rad);
        let link_translation =
            Vector3::new(self.a_m, 0.0, 0.0) + link_rotation * Vector3::new(0.0, 0.0, self.d_m);
        Transform::from_parts(Translation3::from(link_translation), link_rotation)
    }
}

/// Pose of each joint's frame in the base, and pose of the flange in the base.
fn frames(position_rad: &Joints) -> ([Transform; N_JOINTS], Transform) {
    let mut base_from_link = Transform::identity();
    let mut frames = [Transform::identity(); N_JOINTS];
    for (ix, link) in LINKS.iter().enumerate() {
        base_from_link *= link.parent_from_joint();
        base_from_link *= UnitQuaternion::from_axis_angle(&Vector3::z_axis(), position_rad[ix]);
        frames[ix] = base_from_link;
    }
    (
        frames,
        base_from_link * Translation3::new(0.0, 0.0, FLANGE_M),
    )
}

/// Pose of the flange.
pub(crate) fn base_from_flange(position_rad: &Joints) -> Transform {
    frames(position_rad).1
}

/// Pose and Jacobian of a frame fixed to the flange.
pub(crate) fn jacobian(
    position_rad: &Joints,
    flange_from_tip: &Transform,
) -> (Transform, Jacobian) {
    let (frames, base_from_flange) = frames(position_rad);
    let base_from_tip = base_from_flange * flange_from_tip;
    let mut jacobian = Matrix6xX::zeros(N_JOINTS);
    for (ix, frame) in frames.iter().enumerate() {
        // Each joint rotates the tip about the joint's z axis. The angular velocity is the axis,
        // and the linear velocity is the cross product of the axis and the lever arm.
        let axis = frame.rotation * Vector3::z();
        let arm = base_from_tip.translation.vector - frame.translation.vector;
        jacobian
            .fixed_view_mut::<3, 1>(0, ix)
            .copy_from(&axis.cross(&arm));
        jacobian.fixed_view_mut::<3, 1>(3, ix).copy_from(&axis);
    }
    (
        base_from_tip,
        Jacobian::from_fn(|row, column| jacobian[(row, column)]),
    )
}

/// A primitive of the arm's body in the frame of its link.
enum Shape {
    /// Between two points, meters, with a radius.
    Capsule([f64; 3], [f64; 3], f64),
    /// Between two points, meters, with a radius.
    Cylinder([f64; 3], [f64; 3], f64),
    /// Center and half sizes, meters.
    Box([f64; 3], [f64; 3]),
}
use Shape::{Box, Capsule, Cylinder};

/// Material name and shape.
type Part = (&'static str, Shape);

const BASE: &[Part] = &[
    ("arm_white", Box([-0.03, 0.0, 0.03], [0.11, 0.085, 0.03])),
    (
        "arm_white",
        Capsule([0.0, 0.0, 0.06], [0.0, 0.0, 0.12], 0.075),
    ),
    (
        "arm_gray",
        Cylinder([0.0, 0.0, 0.135], [0.0, 0.0, 0.142], 0.0765),
    ),
    ("arm_gray", Box([-0.145, 0.0, 0.045], [0.012, 0.05, 0.03])),
];
const BODY: [&[Part]; N_JOINTS] = [
    &[
        (
            "arm_white",
            Capsule([0.0, 0.0, -0.19], [0.0, 0.0, -0.06], 0.07),
        ),
        (
            "arm_white",
            Capsule([0.0, -0.055, 0.0], [0.0, 0.055, 0.0], 0.066),
        ),
        (
            "arm_gray",
            Cylinder([0.0, -0.122, 0.0], [0.0, -0.112, 0.0], 0.052),
        ),
        (
            "arm_gray",
            Cylinder([0.0, 0.112, 0.0], [0.0, 0.122, 0.0], 0.052),
        ),
    ],
    &[
        (
            "arm_white",
            Capsule([0.0, 0.0, 0.0], [0.0, -0.19, 0.0], 0.062),
        ),
        (
            "arm_gray",
            Cylinder([0.0, -0.19, 0.0], [0.0, -0.198, 0.0], 0.0635),
        ),
    ],
    &[
        (
            "arm_white",
            Capsule([0.0, 0.0, -0.09], [0.02, 0.0, -0.03], 0.06),
        ),
        (
            "arm_white",
            Capsule([0.0825, -0.045, 0.0], [0.0825, 0.045, 0.0], 0.056),
        ),
        (
            "arm_white",
            Capsule([0.02, 0.0, -0.03], [0.0825, 0.0, 0.0], 0.056),
        ),
    ],
    &[
        (
            "arm_gray",
            Cylinder([0.0, 0.0, -0.108], [0.0, 0.0, -0.1], 0.045),
        ),
        (
            "arm_gray",
            Cylinder([0.0, 0.0, 0.1], [0.0, 0.0, 0.108], 0.045),
        ),
        (
            "arm_white",
            Capsule([-0.01, 0.0, 0.0], [-0.0825, 0.075, 0.0], 0.054),
        ),
        (
            "arm_gray",
            Cylinder([-0.0825, 0.115, 0.0], [-0.0825, 0.122, 0.0], 0.0555),
        ),
    ],
    &[
        (
            "arm_white",
            Capsule([0.0, 0.0, -0.25], [0.0, 0.03, -0.12], 0.053),
        ),
        (
            "arm_white",
            Capsule([0.0, 0.06, -0.15], [0.0, 0.06, -0.02], 0.04),
        ),
        (
            "arm_white",
            Capsule([0.0, 0.02, 0.0], [0.0, 0.07, 0.0], 0.045),
        ),
    ],
    &[
        (
            "arm_white",
            Capsule([0.0, 0.0, -0.05], [0.0, 0.0, 0.01], 0.046),
        ),
        (
            "arm_white",
            Capsule([0.02, 0.0, 0.0], [0.088, 0.0, 0.0], 0.044),
        ),
        (
            "arm_gray",
            Cylinder([0.0, 0.0, -0.1], [0.0, 0.0, -0.094], 0.036),
        ),
    ],
    &[
        (
            "arm_white",
            Capsule([0.0, 0.0, 0.0], [0.0, 0.0, 0.05], 0.042),
        ),
        (
            "arm_gray",
            Cylinder([0.0, 0.0, 0.092], [0.0, 0.0, 0.099], 0.038),
        ),
        (
            "arm_white",
            Cylinder([0.0, 0.0, 0.099], [0.0, 0.0, 0.107], 0.0315),
        ),
    ],
];
/// Masses of the links, kilograms. They are approximately the masses of a Panda.
const MASS_KG: [f64; N_JOINTS] = [4.5, 2.4, 2.7, 2.2, 3.0, 1.7, 0.8];

/// The arm as MJCF bodies for the world body. `on_flange` is added to the flange.
pub(crate) fn mjcf(on_flange: &str) -> String {
    let mut xml = String::from("<body name=\"panda_link0\" childclass=\"arm\">\n");
    write_parts(&mut xml, BASE);
    for (ix, link) in LINKS.iter().enumerate() {
        let pose = pose_attributes(&link.parent_from_joint());
        // The inertia is approximately the inertia of a solid with this mass and the size of a
        // link. Its exact value does not matter, because the controller is stiff.
        let [number, inertia, mass] = [ix as f64 + 1.0, 0.012 * MASS_KG[ix], MASS_KG[ix]];
        let lower = LOWER_RAD[ix];
        let upper = UPPER_RAD[ix];
        let _ = writeln!(
            xml,
            "<body name=\"panda_link{number}\" {pose} gravcomp=\"0\">\n\
             <inertial pos=\"0 0 0\" mass=\"{mass}\" diaginertia=\"{inertia} {inertia} {inertia}\"/>\n\
             <joint name=\"panda_joint{number}\" type=\"hinge\" axis=\"0 0 1\" limited=\"true\" range=\"{lower} {upper}\" \
             armature=\"0.1\" damping=\"1\"/>"
        );
        write_parts(&mut xml, BODY[ix]);
    }
    // Writing to a string cannot fail.
    let _ = writeln!(
        xml,
        "<body name=\"panda_link8\" pos=\"0 0 {FLANGE_M}\">\n{on_flange}</body>"
    );
    // The links are nested, so all elements end here.
    xml.push_str(&"</body>\n".repeat(N_JOINTS + 1));
    xml
}

fn write_parts(xml: &mut String, parts: &[Part]) {
    for (material, shape) in parts {
        let geometry = match shape {
            Capsule(a, b, radius) => format!(
                "type=\"capsule\" fromto=\"{} {}\" size=\"{radius}\"",
                list(a),
                list(b)
            ),
            Cylinder(a, b, radius) => format!(
                "type=\"cylinder\" fromto=\"{} {}\" size=\"{radius}\"",
                list(a),
                list(b)
            ),
            Box(center, half) => format!(
                "type=\"box\" pos=\"{}\" size=\"{}\"",
                list(center),
                list(half)
            ),
        };
        let _ = writeln!(xml, "<geom {geometry} material=\"{material}\"/>");
    }
}

/// A pose as MJCF attributes, in full precision.
pub(crate) fn pose_attributes(pose: &Transform) -> String {
    let [x, y, z] = pose.translation.vector.into();
    let q = pose.rotation.coords;
    format!(
        "pos=\"{x:e} {y:e} {z:e}\" quat=\"{:e} {:e} {:e} {:e}\"",
        q.w, q.x, q.y, q.z
    )
}

fn list(numbers: &[f64]) -> String {
    numbers
        .iter()
        .map(ToString::to_string)
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jacobian_matches_central_differences() {
        const NUDGE: f64 = 1e-6;
        let position = Joints::from([0.3, -0.5, 0.2, -2.1, 0.4, 1.7, 0.6]);
        let flange_from_tip = Transform::translation(0.05, 0.01, 0.08);
        let (tip, jacobian) = jacobian(&position, &flange_from_tip);
        for ix in 0..N_JOINTS {
            let mut nudged = position;
            nudged[ix] += NUDGE;
            let ahead = base_from_flange(&nudged) * flange_from_tip;
            nudged[ix] -= 2.0 * NUDGE;
            let behind = base_from_flange(&nudged) * flange_from_tip;
            let linear = (ahead.translation.vector - behind.translation.vector) / (2.0 * NUDGE);
            let angular =
                (ahead.rotation * behind.rotation.inverse()).scaled_axis() / (2.0 * NUDGE);
            assert!(
                (linear - jacobian.fixed_view::<3, 1>(0, ix)).norm() < 1e-8,
                "joint {ix}"
            );
            assert!(
                (angular - jacobian.fixed_view::<3, 1>(3, ix)).norm() < 1e-8,
                "joint {ix}"
            );
        }
        assert!(tip.translation.vector.norm() > 0.3);
    }
}
