//! Finds RealSense and V4L2 cameras.

use crate::init::findings::Findings;

/// Adds the cameras. RealSense cameras are not used through V4L2, which has neither their
/// intrinsics nor their depth.
pub(super) fn find(findings: &mut Findings) {
    find_realsense(findings);
    #[cfg(target_os = "linux")]
    v4l2::find(findings);
}

#[cfg(feature = "realsense")]
fn find_realsense(findings: &mut Findings) {
    use crate::config::CameraDriver;
    use crate::init::findings::FoundCamera;
    // All models offer this mode, also over USB 2.
    const SIZE_PX: [u32; 2] = [640, 480];
    const RATE_HZ: f64 = 30.0;
    match drivers::realsense::cameras() {
        Ok(cameras) => findings
            .cameras
            .extend(cameras.into_iter().map(|camera| FoundCamera {
                driver: CameraDriver::Realsense,
                device: camera.serial,
                name: camera.name,
                size_px: SIZE_PX,
                rate_hz: RATE_HZ,
            })),
        Err(problem) => findings.notes.push(format!("RealSense cameras: {problem}")),
    }
}

#[cfg(not(feature = "realsense"))]
fn find_realsense(findings: &mut Findings) {
    let found = crate::found_devices::realsense_cameras(std::path::Path::new("/sys"));
    // The program cannot use them, so they are only named.
    for device in found {
        findings
            .notes
            .push(format!("{}: {}", device.name, device.note));
    }
}

#[cfg(target_os = "linux")]
mod v4l2 {
    use crate::config::CameraDriver;
    use crate::init::findings::{Findings, FoundCamera};
    use drivers::v4l2::{self, Mode, Rates, Sizes};

    /// The largest image that is useful for training.
    const MAX_SIDES_PX: [u32; 2] = [1280, 960];
    /// The lowest rate at which a moving arm can be scanned, and the highest that is useful.
    const MIN_RATE_HZ: f64 = 10.0;
    const MAX_RATE_HZ: f64 = 30.0;

    /// Adds the V4L2 cameras.
    pub(super) fn find(findings: &mut Findings) {
        for camera in v4l2::cameras() {
            let camera = match camera {
                Ok(camera) => camera,
                Err(problem) => {
                    findings.notes.push(problem.to_string());
                    continue;
                }
            };
            if camera.name.contains("RealSense") {
                continue;
            }
            let device = camera.address();
            match mode(&camera.modes) {
                Some((size_px, rate_hz)) => findings.cameras.push(FoundCamera {
                    driver: CameraDriver::V4l2,
                    device,
                    name: camera.name,
                    size_px,
                    rate_hz,
                }),
                None => findings.notes.push(format!(
                    "{} ({device}) offers no color images of at least {MIN_RATE_HZ} Hz",
                    camera.name
                )),
            }
        }
    }

    /// The largest suitable size, at its highest suitable rate.
    pub(super) fn mode(modes: &[Mode]) -> Option<([u32; 2], f64)> {
        let is_color = |mode: &&Mode| {
            v4l2::V4l2Format::COLOR_FORMATS
                .iter()
                .any(|(_, format)| *format == mode.format)
        };
        let suitable = modes.iter().filter(is_color).filter_map(|mode| {
            let size_px = suitable_size(&mode.sizes)?;
            Some((size_px, suitable_rate(&mode.rates)?))
        });
        suitable.max_by(|(a, a_hz), (b, b_hz)| {
            let area = |size: &[u32; 2]| u64::from(size[0]) * u64::from(size[1]);
            area(a).cmp(&area(b)).then(a_hz.total_cmp(b_hz))
        })
    }

    fn suitable_size(sizes: &Sizes) -> Option<[u32; 2]> {
        let fits = |size: &[u32; 2]| (0..2).all(|side| size[side] <= MAX_SIDES_PX[side]);
        match sizes {
            Sizes::One(size) => Some(*size).filter(fits),
            // Cameras with ranges accept the usual size.
            Sizes::Range { min, max, .. } => {
                let usual = [640, 480];
                let is_inside = (0..2).all(|side| (min[side]..=max[side]).contains(&usual[side]));
                if is_inside {
                    Some(usual)
                } else {
                    Some(*max).filter(fits)
                }
            }
        }
    }

    fn suitable_rate(rates: &Rates) -> Option<f64> {
        let is_suitable = |rate_hz: &f64| (MIN_RATE_HZ..=MAX_RATE_HZ).contains(rate_hz);
        match rates {
            Rates::Unknown => Some(MAX_RATE_HZ),
            Rates::List(rates) => rates
                .iter()
                .copied()
                .filter(is_suitable)
                .max_by(f64::total_cmp),
            Rates::Range { min_hz, max_hz } => {
                Some(max_hz.min(MAX_RATE_HZ)).filter(|rate| rate >= min_hz && is_suitable(rate))
            }
        }
    }

    #[cfg(test)]
    mod tests {
        use super::*;
        use drivers::v4l2::V4l2Format;

        #[test]
        fn largest_useful_mode_is_chosen() {
            let modes = [
                Mode::new(V4l2Format::Yuyv, [640, 480], &[30.0]),
                Mode::new(V4l2Format::Mjpeg, [1280, 720], &[60.0, 30.0, 15.0]),
                Mode::new(V4l2Format::Yuyv, [1280, 720], &[5.0]),
                Mode::new(V4l2Format::Mjpeg, [1920, 1080], &[30.0]),
            ];
            assert_eq!(mode(&modes), Some(([1280, 720], 30.0)));
            assert_eq!(mode(&modes[2..]), None);
            assert_eq!(
                mode(&[Mode::new(V4l2Format::Z16, [640, 480], &[30.0])]),
                None
            );
        }
    }
}
