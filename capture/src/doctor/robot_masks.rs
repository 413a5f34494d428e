//! The cameras in whose images the robot is masked.

use super::Finding;
use crate::config::Rig;
use crate::join::Counts;
use crate::robot_masks::RobotMasks;

const CHECK: &str = "robot in view";

/// Whether the shape of the robot is known. `None` if it is not masked in the images of any camera,
/// or if the rig file has a problem, which is reported elsewhere.
pub(super) fn known_shape(rig: &Rig) -> Option<Finding> {
    let masks = RobotMasks::new(rig).ok()??;
    Some(match masks.warning() {
        Some(warning) => Finding::warn(
            CHECK,
            warning,
            "see docs/guide/calibration.md#cameras-that-see-the-robot",
        ),
        None => {
            let cameras: Vec<&str> = masks.cameras().collect();
            Finding::ok(
                CHECK,
                format!(
                    "the robot is masked in the images of {}",
                    cameras.join(", ")
                ),
            )
        }
    })
}

/// The share of the images that the robot covers, by camera.
pub(super) fn cover(counts: &Counts) -> Vec<Finding> {
    let cameras = counts.robot_cover.keys();
    let notes = cameras.filter_map(|camera| counts.robot_note(camera));
    notes.map(|note| Finding::ok(CHECK, note)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn fixed_cameras_are_masked_if_the_shape_of_the_robot_is_known() {
        let rig = bundled_rig::<&str>("two-cameras.toml", &[]);
        let finding = known_shape(&rig).expect("a fixed camera");
        assert_eq!(finding.verdict, Verdict::Ok, "{finding}");
        assert!(finding.message.ends_with("images of overview"), "{finding}");
        let mut bare = rig.clone();
        bare.arm.urdf_text = rig
            .arm
            .urdf_text
            .lines()
            .filter(|line| !line.contains("<visual>") && !line.contains("<collision>"))
            .collect::<Vec<_>>()
            .join("\n");
        let finding = known_shape(&bare).expect("a fixed camera");
        assert_eq!(finding.verdict, Verdict::Warn, "{finding}");
        assert!(finding.message.contains("no moving link"), "{finding}");
        assert_eq!(
            known_shape(&bundled_rig::<&str>("static-arm.toml", &[])),
            None
        );
    }
}
