//! The robot description that an FCI 10 controller serves.

use super::Limits;
use std::fmt::Write;

/// Origin of each joint relative to the one before: x, y, z in meters, and the rotation about x in
/// quarter turns.
///
/// Source: `franka_description`; the FR3 has the Panda's lengths.
const JOINT_ORIGINS: [(f64, f64, f64, f64); 7] = [
    (0.0, 0.0, 0.333, 0.0),
    (0.0, 0.0, 0.0, -1.0),
    (0.0, -0.316, 0.0, 1.0),
    (0.0825, 0.0, 0.0, 1.0),
    (-0.0825, 0.384, 0.0, -1.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.088, 0.0, 0.0, 1.0),
];

/// URDF of the joints with the limits that clients read, without link geometry.
pub(super) fn urdf(limits: &Limits) -> String {
    let mut text =
        String::from("<?xml version=\"1.0\"?>\n<robot name=\"fr3\">\n<link name=\"fr3_link0\"/>\n");
    for (ix, (x, y, z, quarters)) in JOINT_ORIGINS.into_iter().enumerate() {
        let n = ix + 1;
        let [lower, upper] = limits.position_rad[ix];
        let velocity = limits.velocity_rad_s[ix];
        let effort = if ix < 4 { 87 } else { 12 };
        let roll = quarters * std::f64::consts::FRAC_PI_2;
        // Clients require the element. With these values, it limits nothing.
        let braking = limits.braking.map_or((1e3, 0.0), |braking| {
            (braking[ix].deceleration_rad_s2, braking[ix].margin_rad_s)
        });
        write!(
            text,
            "<link name=\"fr3_link{n}\"/>\n<joint name=\"fr3_joint{n}\" type=\"revolute\">\n<origin rpy=\"{roll} 0 0\" \
             xyz=\"{x} {y} {z}\"/>\n<parent link=\"fr3_link{ix}\"/>\n<child link=\"fr3_link{n}\"/>\n<axis xyz=\"0 0 1\"/>\n\
             <limit effort=\"{effort}\" lower=\"{lower}\" upper=\"{upper}\" velocity=\"{velocity}\"/>\n\
             <position_based_velocity_limits deceleration_limit=\"{}\" velocity_offset=\"{}\"/>\n</joint>\n",
            braking.0, braking.1
        )
        .expect("writing to a string cannot fail");
    }
    text.push_str(
        "<link name=\"fr3_link8\"/>\n<joint name=\"fr3_joint8\" type=\"fixed\">\n<origin rpy=\"0 0 0\" xyz=\"0 0 0.107\"/>\n\
         <parent link=\"fr3_link7\"/>\n<child link=\"fr3_link8\"/>\n</joint>\n</robot>\n",
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use franka::JointVelocityLimitsConfig;
    use kinematics::Chain;

    #[test]
    fn description_matches_panda_with_limits() {
        let text = urdf(&Limits::fr3());
        let ours = Chain::from_urdf(&text, "fr3_link0", "fr3_link8").unwrap();
        let panda = include_str!("../../../../kinematics/tests/data/panda.urdf");
        let panda = Chain::from_urdf(panda, "link0", "link8").unwrap();
        let q = [0.3, -0.7, 0.2, -2.1, 0.4, 1.9, -0.8];
        let error = ours.forward(&q).unwrap().inverse() * panda.forward(&q).unwrap();
        assert!(
            error.translation.vector.norm() < 1e-9 && error.rotation.angle() < 1e-9,
            "{error}"
        );
        // The limits that a client computes from it lie just inside the limits checked here.
        let parsed_limits = JointVelocityLimitsConfig::from_urdf(&text)
            .unwrap()
            .upper_limits(&q);
        assert!((parsed_limits[1] - 2.62).abs() < 1e-2, "{parsed_limits:?}");
    }
}
