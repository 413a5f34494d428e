//! The likely cause of large errors of an accepted result.

use super::evaluation::Scatter;
use super::pose_fit::HandEyeNoise;

/// Errors that industrial arms, boards and calibrated cameras stay below. Lower limits would warn
/// of inexpensive arms, whose errors are no mistake.
const MAX_RMS_PX: f64 = 3.0;
const MAX_SCATTER: Scatter = Scatter { mm: 5.0, deg: 0.5 };
/// Residual of sharp corners after a separate fit of each image, pixels. A right lens leaves a few
/// tenths of a pixel at most.
const MAX_RESIDUAL_PX: f64 = 0.7;

/// A sentence on the likely cause if the errors are larger than those of usual arms and cameras.
///
/// If each image on its own fits the board, lens and board are right, and the robot poses are not
/// those of the images.
pub(super) fn warning(
    noise: &HandEyeNoise,
    scatter: Scatter,
    rms_px: Option<f64>,
) -> Option<String> {
    let has_large_error = rms_px.is_some_and(|rms_px| rms_px > MAX_RMS_PX)
        || scatter.mm > MAX_SCATTER.mm
        || scatter.deg > MAX_SCATTER.deg;
    has_large_error.then_some(())?;
    let reprojection = rms_px.map_or_else(String::new, |rms_px| format!("{rms_px:.1} px, "));
    let errors = format!(
        "the errors are large ({reprojection}{:.1} mm and {:.2} degrees; errors are usually at most {MAX_RMS_PX} px, {} mm and {} degrees)",
        scatter.mm, scatter.deg, MAX_SCATTER.mm, MAX_SCATTER.deg
    );
    // Checks of everything between a robot pose and its image, the most common mistakes first.
    let robot = "check that the arm stood still in each image, that each pose belongs to its image (time offset), that the flange or tool frame is the same in all poses, and that the target and the camera did not move";
    Some(match noise.residual_px {
        Some(residual_px) if residual_px > MAX_RESIDUAL_PX => format!(
            "{errors}; even single images differ from the board by {residual_px:.1} px, so the lens or the target is wrong: calibrate the intrinsics, and check that the target is flat and has the given size"
        ),
        Some(residual_px) => format!(
            "{errors}, but single images fit the board within {residual_px:.1} px, so lens and target are right and the robot poses do not match the images: {robot}"
        ),
        None => format!("{errors}; {robot}, and that the intrinsics of the board poses are right"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cause_of_large_errors_is_named() {
        let noise = |residual_px| HandEyeNoise {
            corner_px: residual_px,
            residual_px,
            rotation_rad: 1e-3,
            translation_m: 1e-3,
        };
        let (small, large) = (Scatter { mm: 1.0, deg: 0.1 }, Scatter { mm: 4.0, deg: 0.8 });
        assert_eq!(warning(&noise(Some(0.2)), small, Some(1.0)), None);
        let robot = warning(&noise(Some(0.2)), large, Some(9.0)).unwrap();
        assert!(
            robot.contains("9.0 px, 4.0 mm and 0.80 degrees")
                && robot.contains("robot poses do not match"),
            "{robot}"
        );
        let lens = warning(&noise(Some(2.0)), small, Some(9.0)).unwrap();
        assert!(lens.contains("the lens or the target is wrong"), "{lens}");
        let poses = warning(&noise(None), large, None).unwrap();
        assert!(
            poses.contains("(4.0 mm") && poses.contains("time offset"),
            "{poses}"
        );
    }
}
