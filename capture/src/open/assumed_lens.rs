//! Calibration that is assumed for a camera whose rig file omits it: in a simulation, and for advice
//! during a calibration.

use crate::config::{Camera, CameraDriver, Rig};
use drivers::realsense::Stream;
use kinematics::{Intrinsics, Lens};

/// Focal length of the color camera of a `RealSense` D435 or D435i, relative to the image height.
/// Images of 1920x1080 have a horizontal field of view of 69 degrees (Intel `RealSense` D400 series
/// datasheet, table "RGB sensor"), and 4:3 images are cropped at the sides.
const D435_COLOR_FOCAL: f64 = 1.28;
/// The same of its infrared cameras, relative to the image width: 87 degrees for 16:9 and about 75
/// degrees for 4:3 (table "Depth field of view").
const D435_INFRARED_FOCAL_WIDE: f64 = 0.527;
const D435_INFRARED_FOCAL_NARROW: f64 = 0.652;
/// Focal length of a webcam relative to the image diagonal. Common webcams have a diagonal field of
/// view of about 70 degrees.
const WEBCAM_FOCAL: f64 = 0.714;

/// Fills in the calibration that the rig file omits, and logs it. The simulated cameras have exactly
/// this calibration.
pub(crate) fn assume_calibration(rig: &mut Rig) {
    rig.cameras.iter_mut().for_each(assume);
}

/// Like [`assume_calibration`], only for the cameras with the driver `sim`.
pub(super) fn assume_calibration_of_simulated(rig: &mut Rig) {
    rig.cameras
        .iter_mut()
        .filter(|camera| camera.driver == CameraDriver::Sim)
        .for_each(assume);
}

/// The intrinsics in the rig file. If they are unknown, those of a typical camera with this driver.
/// They are good enough for advice and for limits of image motion, but not for images with poses.
#[must_use]
pub fn approximate_intrinsics(camera: &Camera) -> Intrinsics {
    if camera.unknown.intrinsics {
        typical_lens(camera).1
    } else {
        camera.intrinsics.clone()
    }
}

fn assume(camera: &mut Camera) {
    let unknown = std::mem::take(&mut camera.unknown);
    if unknown.parent_from_camera {
        // The placeholder is used: the optical frame is the frame of the parent.
        log::info!(
            "camera {:?}: the rig file has no parent_from_camera, so it is simulated in the frame of its parent, looking \
             along z",
            camera.name
        );
    }
    if unknown.intrinsics {
        let (model, intrinsics) = typical_lens(camera);
        let Intrinsics {
            size_px: [width, height],
            focal_px: [focal_px, _],
            ..
        } = intrinsics;
        camera.intrinsics = intrinsics;
        log::info!(
            "camera {:?}: the rig file has no intrinsics, so it is simulated with those of {model} at {width}x{height}: \
             focal length {focal_px:.0} px",
            camera.name
        );
    }
    let color = camera.intrinsics.clone();
    if let Some(depth) = camera
        .depth
        .as_mut()
        .filter(|_| unknown.intrinsics && unknown.depth_intrinsics)
    {
        // Simulated depth is registered to the color image, or has the same field of view.
        let size_px = depth.intrinsics.size_px;
        depth.intrinsics = if size_px == color.size_px {
            color
        } else {
            color.resized(size_px)
        };
    }
}

/// A typical camera for the driver, and its lens for images of the size in the rig file.
fn typical_lens(camera: &Camera) -> (&'static str, Intrinsics) {
    let (model, focal_px) = typical(camera);
    let size_px = camera.intrinsics.size_px;
    let intrinsics = Intrinsics {
        size_px,
        focal_px: [focal_px; 2],
        principal_px: size_px.map(|side| 0.5 * f64::from(side)),
        lens: Lens::Pinhole,
        rectified: false,
    };
    (model, intrinsics)
}

/// A typical camera for the driver, and its focal length in pixels.
fn typical(camera: &Camera) -> (&'static str, f64) {
    let [width, height] = camera.intrinsics.size_px.map(f64::from);
    match (camera.driver, camera.realsense.stream) {
        (CameraDriver::Realsense, Stream::Color) => {
            ("a RealSense D435i", D435_COLOR_FOCAL * height)
        }
        (CameraDriver::Realsense, Stream::Infrared) => {
            let focal = if width > 1.5 * height {
                D435_INFRARED_FOCAL_WIDE
            } else {
                D435_INFRARED_FOCAL_NARROW
            };
            ("the infrared camera of a RealSense D435i", focal * width)
        }
        _ => ("a webcam", WEBCAM_FOCAL * width.hypot(height)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::UnknownCalibration;

    fn rig(camera: &str) -> Rig {
        let text = format!(
            "[arm]\ndriver = \"none\"\n[camera.front]\ndriver = \"realsense\"\nrate_hz = 15\nparent = \"base\"\n{camera}"
        );
        let urdf = r#"<robot name="none"><link name="base"/></robot>"#;
        Rig::parse("rig.toml", &text, urdf, &[]).expect("a rig")
    }

    #[test]
    fn missing_intrinsics_are_those_of_a_typical_camera() {
        let mut rig = rig("size_px = [1280, 720]\n[camera.front.depth]\nsize_px = [848, 480]\n");
        assert!(rig.cameras[0].unknown.intrinsics);
        assume_calibration(&mut rig);
        let camera = &rig.cameras[0];
        assert_eq!(camera.unknown, UnknownCalibration::default());
        let [width, _] = camera.intrinsics.size_px.map(f64::from);
        let horizontal_fov = 2.0 * (0.5 * width / camera.intrinsics.focal_px[0]).atan();
        assert!(
            (horizontal_fov.to_degrees() - 69.4).abs() < 1.5,
            "{horizontal_fov}"
        );
        let depth = camera.depth.as_ref().expect("it has depth");
        assert_eq!(depth.intrinsics, camera.intrinsics.resized([848, 480]));
    }

    #[test]
    fn given_intrinsics_are_kept() {
        let mut rig = rig(
            "size_px = [640, 480]\nintrinsics = { focal_px = [600, 601], principal_px = [320, 240] }\n",
        );
        let before = rig.clone();
        assume_calibration(&mut rig);
        assert_eq!(rig.cameras[0].intrinsics, before.cameras[0].intrinsics);
    }
}
