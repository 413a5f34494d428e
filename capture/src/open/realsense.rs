//! Opens a RealSense camera and fills in calibration that the rig file omits.

/// Opens a camera.
#[cfg(not(feature = "realsense"))]
pub(super) fn open(camera: &mut crate::config::Camera) -> anyhow::Result<Box<dyn drivers::Camera>> {
    anyhow::bail!(
        "camera {:?}: this program was built without RealSense support: install the RealSense SDK (librealsense2) \
         and build it with `cargo build --release --features realsense`",
        camera.name
    )
}

#[cfg(feature = "realsense")]
pub(super) use with_sdk::open;

#[cfg(feature = "realsense")]
mod with_sdk {
    use crate::config::{Camera, UnknownCalibration};
    use drivers::realsense::{Config, RealsenseCamera, Settings};
    use kinematics::{Intrinsics, Lens};
    use std::time::Duration;

    /// Maximum difference between the intrinsics in the rig file and the intrinsics stored in the
    /// camera, pixels. If the difference is larger, one of the two probably belongs to another
    /// camera.
    ///
    /// A recalibration of the same camera changes its projections by less. The projections of
    /// another camera of the same type usually differ by more.
    const MAX_DIFFERENCE_PX: f64 = 5.0;

    /// Opens a camera. Copies the calibration that the rig file omits from the camera to the rig.
    /// Values in the rig file take precedence.
    pub(in crate::open) fn open(camera: &mut Camera) -> anyhow::Result<Box<dyn drivers::Camera>> {
        let open = RealsenseCamera::open(config(camera))?;
        let known = open.calibration();
        let UnknownCalibration {
            intrinsics,
            depth_intrinsics,
            camera_from_depth,
            parent_from_camera,
        } = camera.unknown;
        // The marks are reset, so that the rig with these lenses can be stored in a recording.
        camera.unknown = UnknownCalibration {
            parent_from_camera,
            ..UnknownCalibration::default()
        };
        apply_known(
            "intrinsics",
            &camera.name,
            intrinsics,
            &mut camera.intrinsics,
            &known.intrinsics,
        );
        if let (Some(depth), Some(known)) = (&mut camera.depth, &known.depth) {
            apply_known(
                "depth.intrinsics",
                &camera.name,
                depth_intrinsics,
                &mut depth.intrinsics,
                &known.intrinsics,
            );
            if camera_from_depth {
                depth.camera_from_depth = known.camera_from_depth;
            }
        }
        Ok(Box::new(open))
    }

    fn config(camera: &Camera) -> Config {
        let Camera { realsense, .. } = camera;
        Config {
            name: camera.name.to_string(),
            serial: camera.device.clone(),
            file: (!realsense.file.as_os_str().is_empty()).then(|| realsense.file.clone()),
            pace: realsense.pace,
            clock_offset_nanos: realsense.clock_offset_nanos,
            stream: realsense.stream,
            size_px: camera.intrinsics.size_px,
            rate_hz: camera.rate_hz,
            depth_size_px: camera.depth.as_ref().map(|depth| depth.intrinsics.size_px),
            settings: Settings {
                exposure_micros: camera.exposure_micros,
                gain: realsense.gain,
                white_balance_kelvin: realsense.white_balance_kelvin,
                brightness: realsense.brightness,
                preset: realsense.preset.clone(),
                laser_power: realsense.laser_power,
            },
            filters: realsense.filters.clone(),
            reconnect_for: Duration::from_secs_f64(realsense.reconnect_secs),
        }
    }

    fn apply_known(
        key: &str,
        camera: &str,
        is_unknown: bool,
        rig: &mut Intrinsics,
        known: &Intrinsics,
    ) {
        let line = toml_line(known);
        if is_unknown {
            log::info!("camera {camera:?}: using {key} = {line} from the camera");
            *rig = known.clone();
            return;
        }
        let max_difference_px = difference_px(rig, known);
        if max_difference_px > MAX_DIFFERENCE_PX {
            log::warn!(
                "camera {camera:?}: {key} in the rig file differs by up to {max_difference_px:.1} px from the camera's \
                 own, {line}; remove the key to use that"
            );
        }
    }

    /// Maximum distance between the projections of the same ray through two lenses, over the image,
    /// pixels.
    fn difference_px(rig: &Intrinsics, known: &Intrinsics) -> f64 {
        const STEPS: u32 = 8;
        let pixels = (0..=STEPS).flat_map(|row| (0..=STEPS).map(move |column| [column, row]));
        let differences = pixels.filter_map(|steps| {
            // A grid from border to border, because lens models differ most in the corners.
            let side = |axis: usize| f64::from(rig.size_px[axis] * steps[axis]) / f64::from(STEPS);
            let pixel = [side(0), side(1)];
            // Pixels that one of the lenses cannot project are left out, because distortion models
            // are only defined near the image.
            let projected = known.project(&rig.unproject(pixel)?)?;
            Some((projected[0] - pixel[0]).hypot(projected[1] - pixel[1]))
        });
        differences.fold(0.0, f64::max)
    }

    fn toml_line(intrinsics: &Intrinsics) -> String {
        let lens = match &intrinsics.lens {
            Lens::Pinhole => String::new(),
            Lens::BrownConrady(k) => format!(", lens = \"brown_conrady\", distortion = {k:?}"),
            Lens::RationalBrownConrady(k) => {
                format!(", lens = \"brown_conrady\", distortion = {k:?}")
            }
            Lens::KannalaBrandt(k) => format!(", lens = \"kannala_brandt\", distortion = {k:?}"),
        };
        format!(
            "{{ focal_px = {:?}, principal_px = {:?}{lens} }}",
            intrinsics.focal_px, intrinsics.principal_px
        )
    }
}
