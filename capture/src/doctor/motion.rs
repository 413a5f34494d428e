//! Checks the settings for moving the arm.

use super::{Finding, Verdict};
use crate::config::{ArmDriver, Rig};
use crate::open;

/// Checks whether this kind of arm supports the settings in `[arm.motion]`, as far as possible
/// without the arm.
pub(super) fn motion(rig: &Rig) -> Option<Finding> {
    rig.arm.motion.as_ref()?;
    let verdict = match rig.arm.driver {
        ArmDriver::Franka
        | ArmDriver::Ur
        | ArmDriver::Can
        | ArmDriver::Feetech
        | ArmDriver::Dynamixel => Verdict::Fail,
        ArmDriver::Udp => Verdict::Warn, // It can still be read.
        ArmDriver::None | ArmDriver::Sim => return None,
    };
    Some(match open::check_motion(rig) {
        Ok(()) => Finding::ok(
            "motion",
            "the driver of the arm supports the settings in [arm.motion]",
        ),
        Err(error) => {
            let remedy = "docs/guide/moving-arms.md describes the keys of [arm.motion]";
            Finding {
                verdict,
                ..Finding::fail("motion", format!("{error:#}"), remedy)
            }
        }
    })
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn unsupported_settings_are_reported_without_the_arm() {
        assert_eq!(
            motion(&bundled_rig::<&str>("static-arm.toml", &[])),
            None,
            "the arm is only read"
        );
        for (on_loss, verdict) in [("hold", Verdict::Ok), ("release", Verdict::Fail)] {
            let rig = bundled_rig("wire/static-arm.toml", &[("arm.motion.on_loss", on_loss)]);
            let finding = motion(&rig).expect("the arm can be moved");
            assert_eq!(finding.verdict, verdict, "{finding:?}");
        }
        let rig = bundled_rig(
            "wire/static-arm.toml",
            &[("arm.driver", "udp"), ("arm.address", "")],
        );
        let finding = motion(&rig).expect("this driver only reads");
        assert_eq!(finding.verdict, Verdict::Warn, "{finding:?}");
        assert!(
            finding
                .message
                .contains("arm.driver = \"franka\", \"ur\", \"can\", \"feetech\" or \"dynamixel\""),
            "{finding:?}"
        );
    }
}
