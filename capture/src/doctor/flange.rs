//! Compares the forward kinematics of a rig's robot description with the poses that a controller
//! or the simulator reports.

use super::Finding;
use crate::config::Rig;
use drivers::FlangeDifference;

pub(super) const CHECK: &str = "flange pose";

/// Difference up to which poses agree. The drivers of controllers have the same limits.
const SAME_M: f64 = 2e-3;
const SAME_RAD: f64 = 0.5 / 180.0 * std::f64::consts::PI;

/// The finding about the flange of an open arm. An arm whose controller contradicts the description
/// is not opened, so a larger difference is one that nominal dimensions or an unknown tool explain.
pub(super) fn of_controller(difference: &FlangeDifference) -> Finding {
    if difference.is_within(SAME_M, SAME_RAD) {
        Finding::ok(
            CHECK,
            format!("the URDF and the controller agree: their flanges are {difference} apart"),
        )
    } else {
        Finding::warn(
            CHECK,
            format!("the flanges of the URDF and of the controller are {difference} apart"),
            "use a URDF with the calibration of this robot, see docs/guide/arms.md",
        )
    }
}

/// Compares the robot description with the robot of the simulated scene that the rig file names.
/// `None` if it names none, or the scene has no arm. With a difference, the scene has the robot of
/// the rig file instead of its own.
#[cfg(feature = "sim")]
pub(super) fn simulator(rig: &Rig) -> Option<Finding> {
    use crate::open::chain_of;
    let scene = sim::Scene::from_name(rig.sim.scene.as_deref()?)?;
    let difference = sim::difference_to_robot_of(scene, &chain_of(rig).ok()?)?;
    let name = scene.name();
    Some(if difference.is_within(SAME_M, SAME_RAD) {
        Finding::ok(
            CHECK,
            format!(
                "the URDF and the arm of the scene {name:?} agree: their flanges are at most {difference} apart"
            ),
        )
    } else {
        Finding::warn(
            CHECK,
            format!(
                "the URDF is another robot than the arm of the scene {name:?}: their flanges are up to {difference} apart; the simulation uses the URDF"
            ),
            "if the URDF should describe this arm, correct arm.urdf, arm.base_link or arm.flange_link; otherwise, nothing",
        )
    })
}

#[cfg(not(feature = "sim"))]
pub(super) fn simulator(_rig: &Rig) -> Option<Finding> {
    None
}

#[cfg(all(test, feature = "sim"))]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn the_description_is_compared_with_the_arm_of_the_scene() {
        let rig = bundled_rig::<&str>("calibration-board.toml", &[]);
        let same = simulator(&rig).expect("its scene has an arm");
        assert_eq!(same.verdict, Verdict::Ok);
        assert!(same.message.contains("0.0 mm and 0.00 degrees"), "{same}");
        // An upper arm that is 200 mm longer.
        let mut longer = rig.clone();
        longer.arm.urdf_text = rig.arm.urdf_text.replacen("-0.316", "-0.516", 1);
        assert_ne!(longer.arm.urdf_text, rig.arm.urdf_text);
        let other = simulator(&longer).expect("its scene has an arm");
        assert!(
            other.verdict == Verdict::Warn && other.message.contains("200.0 mm"),
            "{other}"
        );
        let base = bundled_rig::<&str>("mobile-base-small.toml", &[]);
        assert_eq!(simulator(&base), None);
    }
}
