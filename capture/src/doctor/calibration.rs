//! Finds camera values in the rig file that are valid but implausible. Such values are probably in
//! another unit, or were left at the default.

use super::Finding;
use crate::config::{Camera, Need, Parent, Rig};
use kinematics::{Lens, Transform};

const CHECK: &str = "calibration";
/// Maximum plausible distance of a camera from the flange that carries it. Distances that were
/// given in centimeters or millimeters exceed it.
const MAX_DISTANCE_M: f64 = 3.0;
/// Plausible horizontal fields of view. If focal lengths are in millimeters or are normalized by
/// the width, the field of view is outside this range.
const FIELD_OF_VIEW_DEG: std::ops::RangeInclusive<f64> = 5.0..=160.0;
/// Minimum plausible exposure time. Times that were given in milliseconds are below it.
const MIN_EXPOSURE_MICROS: f64 = 5.0;

/// Checks the values of all cameras. Empty if all are plausible.
pub(super) fn calibration(rig: &Rig) -> Vec<Finding> {
    rig.cameras
        .iter()
        .flat_map(problems)
        .map(|(message, remedy)| Finding::warn(CHECK, message, remedy))
        .collect()
}

/// What a run would miss, with the commands that find it. These are warnings, because a robot is
/// brought up piece by piece.
pub(super) fn missing(rig: &Rig) -> Vec<Finding> {
    rig.missing_keys(Need::PosedImages)
        .into_iter()
        .filter(|missing| !missing.is_reported)
        .map(|missing| {
            let message = format!(
                "{} is missing: it is not needed for `doctor` and `record`, but for `run` and `train`",
                missing.key
            );
            Finding::warn(CHECK, message, missing.remedy)
        })
        .collect()
}

/// Implausible values of a camera: messages with remedies.
fn problems(camera: &Camera) -> Vec<(String, String)> {
    let name = &camera.name;
    let mut problems = Vec::new();
    let mut report = |message: String, remedy: &str| {
        problems.push((format!("camera {name:?}: {message}"), remedy.to_owned()))
    };
    // A missing pose is reported separately.
    if camera.parent == Parent::Flange && !camera.unknown.parent_from_camera {
        let distance_m = camera.parent_from_camera.translation.vector.norm();
        if camera.parent_from_camera == Transform::identity() {
            report(
                "parent_from_camera is the identity: the camera would be exactly in the flange frame"
                    .to_owned(),
                "set the pose of its optical frame (x right, y down, z forward), from a hand-eye calibration or a drawing",
            );
        } else if distance_m > MAX_DISTANCE_M {
            report(
                format!("it is {distance_m:.1} m from the flange"),
                "parent_from_camera.xyz_m is in meters",
            );
        }
    }
    let intrinsics = &camera.intrinsics;
    // Placeholders of unknown intrinsics are implausible, but not an error of the user.
    if !camera.unknown.intrinsics {
        let size_px = intrinsics.size_px.map(f64::from);
        let field_of_view_deg = 2.0
            * (0.5 * size_px[0] / intrinsics.focal_px[0])
                .atan()
                .to_degrees();
        // The formula above holds for a pinhole. A fisheye lens may see more than half of the
        // space.
        let has_wide_lens =
            matches!(intrinsics.lens, Lens::KannalaBrandt(_)) && !intrinsics.rectified;
        if !FIELD_OF_VIEW_DEG.contains(&field_of_view_deg) && !has_wide_lens {
            report(
                format!(
                    "its focal length gives a horizontal field of view of {field_of_view_deg:.1} degrees"
                ),
                "intrinsics.focal_px is in pixels of images of this size",
            );
        }
        let is_inside =
            (0..2).all(|axis| (0.0..=size_px[axis]).contains(&intrinsics.principal_px[axis]));
        if !is_inside {
            report(
                format!(
                    "its principal point {:?} is outside the image",
                    intrinsics.principal_px
                ),
                "intrinsics.principal_px is in pixels of images of this size, usually near their center",
            );
        }
    }
    if let Some(exposure_micros) = camera
        .exposure_micros
        .filter(|exposure| *exposure < MIN_EXPOSURE_MICROS)
    {
        report(
            format!("it exposes for {exposure_micros} microseconds"),
            "8 milliseconds are exposure_micros = 8000",
        );
    }
    problems
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn missing_calibration_is_a_warning_with_the_command_that_finds_it() {
        let mut rig = bundled_rig::<&str>("static-arm.toml", &[("camera.wrist.driver", "v4l2")]);
        assert_eq!(missing(&rig), []);
        rig.cameras[0].unknown.intrinsics = true;
        rig.cameras[0].unknown.parent_from_camera = true;
        let findings = missing(&rig);
        let words = |finding: &Finding, words: &str| {
            finding.verdict == Verdict::Warn
                && finding
                    .remedy
                    .as_ref()
                    .is_some_and(|remedy| remedy.contains(words))
        };
        assert_eq!(findings.len(), 2, "{findings:?}");
        assert!(words(&findings[0], "calibrate intrinsics"), "{findings:?}");
        assert!(words(&findings[1], "calibrate hand-eye"), "{findings:?}");
        // Values that are not there are not implausible.
        rig.cameras[0].parent_from_camera = Transform::identity();
        assert_eq!(calibration(&rig), []);
    }

    #[test]
    fn values_in_other_units_are_reported() {
        assert_eq!(
            calibration(&bundled_rig::<&str>("static-arm.toml", &[])),
            []
        );
        for (key, value, word) in [
            ("camera.wrist.parent_from_camera", "{}", "identity"),
            (
                "camera.wrist.parent_from_camera.xyz_m",
                "[0, 60, 40]",
                "in meters",
            ),
            (
                "camera.wrist.intrinsics.focal_px",
                "[3.6, 3.6]",
                "in pixels",
            ),
            (
                "camera.wrist.intrinsics.principal_px",
                "[6400, 3600]",
                "outside",
            ),
            ("camera.wrist.exposure_micros", "0.008", "8000"),
        ] {
            let parsed: toml::Table = format!("value = {value}").parse().expect("a TOML value");
            let findings = calibration(&bundled_rig(
                "static-arm.toml",
                &[(key, parsed["value"].clone())],
            ));
            let text = |finding: &Finding| {
                format!(
                    "{} {}",
                    finding.message,
                    finding.remedy.clone().unwrap_or_default()
                )
            };
            assert!(
                findings.len() == 1 && text(&findings[0]).contains(word),
                "{key}: {findings:?}"
            );
        }
    }
}
