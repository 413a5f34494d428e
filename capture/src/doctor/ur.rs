//! Checks the controller of a rig with an arm of Universal Robots. The check reads one state, and
//! does not disturb other clients of the controller.

use super::{Finding, flange as flange_pose};
use crate::config::{ArmDriver, Rig};
use crate::open;
use drivers::ur::{FlangePose, Inspection, inspect};

/// Checks connection, mode and flange pose; empty if the rig has another kind of arm.
pub(super) fn ur(rig: &Rig) -> Vec<Finding> {
    if rig.arm.driver != ArmDriver::Ur {
        return Vec::new();
    }
    let inspected = open::ur_config(rig).and_then(|config| Ok(inspect(&config)?));
    match inspected {
        Ok(inspection) => findings(&rig.arm.address, &inspection, rig.arm.motion.is_some()),
        Err(error) => {
            let remedy = "check the cable, and at the pendant: the address (Settings, System, Network), the power of the robot, and RTDE (Settings, Security, Services)";
            vec![Finding::fail("RTDE", format!("{error:#}"), remedy)]
        }
    }
}

/// Findings about a controller that responds.
fn findings(address: &str, inspection: &Inspection, is_moved: bool) -> Vec<Finding> {
    let Inspection {
        version,
        mode,
        blocking_reason,
        is_in_remote_control,
        flange,
    } = inspection;
    let rate_hz = version.rate_hz();
    let mut findings = vec![Finding::ok(
        "RTDE",
        format!("{address} has PolyScope {version} and sends {rate_hz} states per second"),
    )];
    findings.push(match blocking_reason {
        // An arm that does not move can be read in any mode.
        Some(reason) if is_moved => Finding::warn(
            "robot",
            reason,
            "docs/guide/moving-arms.md#universal-robots",
        ),
        _ => Finding::ok("robot", mode),
    });
    if is_moved && *is_in_remote_control == Some(false) {
        findings.push(Finding::warn(
            "remote control",
            "the controller is in local control, and ignores programs from the network",
            "select Remote Control in the upper right corner of the pendant before you move the arm",
        ));
    }
    let remedy = "docs/guide/arms.md#universal-robots describes which URDF and which link to use";
    findings.push(match flange {
        FlangePose::Same(difference) => flange_pose::of_controller(difference),
        FlangePose::Doubtful(reason) => Finding::warn(flange_pose::CHECK, reason, remedy),
        FlangePose::Different(reason) => Finding::fail(flange_pose::CHECK, reason, remedy),
    });
    findings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use drivers::FlangeDifference;
    use drivers::ur::ControllerVersion;

    #[test]
    fn controller_mode_and_flange_are_reported() {
        let inspection = Inspection {
            version: ControllerVersion {
                major: 5,
                minor: 24,
                bugfix: 0,
            },
            mode: "it is running; it is in a protective stop".to_owned(),
            blocking_reason: Some("it is in a protective stop".to_owned()),
            is_in_remote_control: Some(false),
            flange: FlangePose::Doubtful("8 mm".to_owned()),
        };
        let verdicts = |is_moved| -> Vec<Verdict> {
            let findings = findings("192.168.1.10", &inspection, is_moved);
            findings.iter().map(|finding| finding.verdict).collect()
        };
        assert_eq!(verdicts(false), [Verdict::Ok, Verdict::Ok, Verdict::Warn]);
        assert_eq!(
            verdicts(true),
            [Verdict::Ok, Verdict::Warn, Verdict::Warn, Verdict::Warn]
        );
        let same = Inspection {
            flange: FlangePose::Same(FlangeDifference {
                translation_m: 0.0004,
                rotation_rad: 0.0,
            }),
            ..inspection.clone()
        };
        let message = &findings("192.168.1.10", &same, false)[2].message;
        assert!(message.contains("0.4 mm and 0.00 degrees"), "{message}");
        let different = Inspection {
            flange: FlangePose::Different("90 mm".to_owned()),
            ..inspection
        };
        let findings = findings("192.168.1.10", &different, false);
        assert_eq!(findings[2].verdict, Verdict::Fail);
        assert!(findings[0].message.contains("5.24.0") && findings[0].message.contains("500"));
    }
}
