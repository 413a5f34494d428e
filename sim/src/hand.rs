//! A hand that moves a printed target in front of a camera. Like a person who calibrates a lens, it
//! holds the target at one place after the other, at different distances and tilts.

use crate::config::CameraConfig;
use kinematics::{Transform, transform};
use nalgebra::{Point3, UnitQuaternion, Vector2, Vector3};
use targets::TargetSpec;

/// Time for which the target is held at each place, seconds. The next constant is the time of each
/// motion.
const HOLD_SECS: f64 = 1.2;
const MOVE_SECS: f64 = 0.9;
/// Amplitude of the slow wavering of a hand that holds something still, meters. The next constants
/// are the amplitude in radians and the frequencies along the axes.
const WAVER_M: f64 = 0.0003;
const WAVER_RAD: f64 = 0.001;
const WAVER_HZ: [f64; 3] = [0.7, 0.9, 0.5];

/// A place of the target.
#[derive(Clone, Copy)]
struct Place {
    /// Middle of the target in the image, as fractions of its width and height.
    at_frac: [f64; 2],
    /// Width or height of the target, whichever is longer, as a fraction of the width of the image.
    span_frac: f64,
    /// Rotation about the x and the y axis of the camera, degrees. It is zero if the target faces
    /// the camera.
    tilt_deg: [f64; 2],
    /// Rotation about the line of sight, degrees.
    roll_deg: f64,
}

const fn place(at_frac: [f64; 2], span_frac: f64, tilt_deg: [f64; 2], roll_deg: f64) -> Place {
    Place {
        at_frac,
        span_frac,
        tilt_deg,
        roll_deg,
    }
}

const LEFT: f64 = 0.2;
const RIGHT: f64 = 0.8;
const TOP: f64 = 0.22;
const BOTTOM: f64 = 0.78;

/// The places in order. The calibration of a lens asks for these tilts, distances and parts of the
/// image. They vary slightly.
const PLACES: [Place; 21] = [
    place([0.5, 0.5], 0.5, [0.0, 0.0], 0.0),
    place([0.5, 0.5], 0.55, [0.0, 30.0], 5.0),
    place([0.48, 0.5], 0.55, [0.0, -30.0], -5.0),
    place([0.5, 0.5], 0.55, [30.0, 0.0], 0.0),
    place([0.52, 0.5], 0.55, [-30.0, 0.0], 8.0),
    place([0.44, 0.45], 0.6, [5.0, 38.0], 20.0),
    place([0.56, 0.55], 0.6, [-5.0, -38.0], -20.0),
    place([0.44, 0.55], 0.6, [38.0, 5.0], 10.0),
    place([0.56, 0.45], 0.6, [-38.0, -5.0], -10.0),
    place([0.5, 0.5], 0.95, [8.0, -8.0], 0.0),
    place([0.45, 0.52], 0.8, [-12.0, 12.0], 4.0),
    place([LEFT, TOP], 0.48, [-10.0, 10.0], 0.0),
    place([RIGHT, BOTTOM], 0.48, [10.0, -10.0], 0.0),
    place([RIGHT, TOP], 0.48, [-10.0, -10.0], 0.0),
    place([LEFT, BOTTOM], 0.48, [10.0, 10.0], 0.0),
    place([LEFT, 0.5], 0.48, [0.0, 12.0], 90.0),
    place([RIGHT, 0.5], 0.48, [0.0, -12.0], -90.0),
    place([0.5, TOP], 0.48, [-12.0, 0.0], 0.0),
    place([0.5, BOTTOM], 0.48, [12.0, 0.0], 0.0),
    place([0.4, 0.45], 0.36, [0.0, 10.0], 15.0),
    place([0.62, 0.55], 0.34, [10.0, 0.0], -15.0),
];

/// The motion of a target in front of a camera. It repeats.
#[derive(Clone, Debug)]
pub(crate) struct Hand {
    /// Poses at which the target is held, with the middle of the target as its origin.
    camera_from_middle: Vec<Transform>,
    middle_from_board: Transform,
}

impl Hand {
    pub(crate) fn new(camera: &CameraConfig, target: &TargetSpec) -> Self {
        let [low, high] = target.bounds_m().map(Vector2::from);
        let middle = 0.5 * (low + high);
        let longest_m = (high - low).max();
        Self {
            camera_from_middle: PLACES
                .iter()
                .map(|place| camera_from_middle(camera, place, longest_m))
                .collect(),
            middle_from_board: Transform::translation(-middle.x, -middle.y, 0.0),
        }
    }

    /// Pose of the board in the frame of the camera.
    pub(crate) fn camera_from_board(&self, secs: f64) -> Transform {
        let n = self.camera_from_middle.len();
        let period_secs = HOLD_SECS + MOVE_SECS;
        let n_periods = (secs / period_secs).floor();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "at most the number of places"
        )]
        let ix = n_periods.rem_euclid(n as f64) as usize % n;
        let moved_secs = secs - n_periods * period_secs - HOLD_SECS;
        let held = transform::interpolate(
            &self.camera_from_middle[ix],
            &self.camera_from_middle[(ix + 1) % n],
            smooth_frac(moved_secs / MOVE_SECS),
        );
        held * waver(secs) * self.middle_from_board
    }
}

/// Completed fraction of a motion of a hand after a fraction of its time. Speed and acceleration
/// are zero at both ends (minimum jerk, Flash and Hogan 1985).
fn smooth_frac(time_frac: f64) -> f64 {
    let t = time_frac.clamp(0.0, 1.0);
    t * t * t * (10.0 + t * (6.0 * t - 15.0))
}

fn waver(secs: f64) -> Transform {
    let waves = WAVER_HZ.map(|hz| (std::f64::consts::TAU * hz * secs).sin());
    let waves = Vector3::from(waves);
    Transform::from_parts(
        (WAVER_M * waves).into(),
        UnitQuaternion::from_scaled_axis(WAVER_RAD * waves),
    )
}

/// Pose of a target of this size at a place in the image. Distortion is not considered, so a target
/// at the border of the image is a few pixels away from its place.
fn camera_from_middle(camera: &CameraConfig, place: &Place, longest_m: f64) -> Transform {
    let lens = &camera.intrinsics;
    let [width, height] = lens.size_px.map(f64::from);
    let depth_m = lens.focal_px[0] * longest_m / (place.span_frac * width);
    let ray = Vector3::new(
        (place.at_frac[0] * width - lens.principal_px[0]) / lens.focal_px[0],
        (place.at_frac[1] * height - lens.principal_px[1]) / lens.focal_px[1],
        1.0,
    );
    let facing =
        UnitQuaternion::rotation_between(&Vector3::z(), &ray).unwrap_or(UnitQuaternion::identity());
    let [about_x, about_y] = place.tilt_deg.map(f64::to_radians);
    let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(about_x, about_y, 0.0));
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), place.roll_deg.to_radians());
    let position = Point3::from(depth_m * ray);
    Transform::from_parts(position.coords.into(), facing * tilt * roll)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Config, SensorConfig, TargetConfig, TargetParent};
    use drivers::{Sample, Source, TruthImage};
    use targets::GrayImage;

    const SPEC: &str = "charuco:7x5:17mm:13mm:5X5_100";

    fn target() -> TargetSpec {
        SPEC.parse().expect("a target")
    }

    fn camera() -> CameraConfig {
        CameraConfig {
            parent: crate::config::Parent::World,
            // It looks down at 60 degrees.
            parent_from_camera: Transform::from_parts(
                Vector3::new(0.0, 0.0, 0.9).into(),
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -std::f64::consts::FRAC_PI_2)
                    * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -150_f64.to_radians()),
            ),
            rate_hz: 1.0 / (HOLD_SECS + MOVE_SECS),
            depth: None,
            sensor: SensorConfig {
                supersample: 2,
                ..SensorConfig::default()
            },
            ..CameraConfig::wrist("webcam")
        }
    }

    #[test]
    fn the_target_is_held_nearly_still_and_moves_on() {
        const CLOSE_M: f64 = 0.002;
        let hand = Hand::new(&camera(), &target());
        let position = |secs: f64| hand.camera_from_board(secs).translation.vector;
        let period_secs = HOLD_SECS + MOVE_SECS;
        for ix in 0..PLACES.len() {
            let began = ix as f64 * period_secs;
            let held_m = (position(began + 0.1) - position(began + HOLD_SECS - 0.1)).norm();
            assert!(held_m < CLOSE_M, "place {ix}: {held_m} m");
            let moved_m = (position(began) - position(began + period_secs)).norm();
            assert!(moved_m > CLOSE_M, "place {ix}: {moved_m} m");
            // There is no jump, also not at the end of a round.
            let step_m =
                (position(began + period_secs - 1e-6) - position(began + period_secs)).norm();
            assert!(step_m < 1e-4, "place {ix}: {step_m} m");
        }
    }

    #[test]
    fn the_target_is_in_front_of_the_camera_and_faces_it() {
        let hand = Hand::new(&camera(), &target());
        for (ix, pose) in hand.camera_from_middle.iter().enumerate() {
            let position = pose.translation.vector;
            // The z axis of the board points into the board, away from the camera.
            let normal = pose.rotation * Vector3::z();
            assert!(
                position.z > 0.1 && normal.dot(&position) > 0.5 * position.norm(),
                "{ix}"
            );
        }
    }

    #[test]
    fn images_show_the_target_where_the_hand_holds_it() {
        /// Most corners are found at the places in the middle of the image.
        const MIN_CORNERS: usize = 12;
        /// Measured values are below 0.1 px. The pose of a wrong place would give errors of tens of
        /// pixels.
        const MAX_RMS_PX: f64 = 0.3;
        const N_PLACES: u64 = 12;
        // The exposures are in the middle of the holds.
        let config = Config {
            ideal: true,
            n_images: Some(N_PLACES),
            cameras: vec![camera()],
            joint_names: Vec::new(),
            reading_order: Vec::new(),
            targets: vec![TargetConfig {
                name: "board".to_owned(),
                spec: SPEC.to_owned(),
                parent: TargetParent::Hand { camera_ix: 0 },
                parent_from_board: Transform::identity(),
            }],
            robot: Some(crate::RobotConfig {
                urdf: r#"<robot name="none"><link name="base"/></robot>"#.to_owned(),
                base_link: "base".to_owned(),
                flange_link: "base".to_owned(),
                meshes: std::collections::BTreeMap::new(),
                world_from_base: Transform::identity(),
                has_moving_base: false,
                max_blur_px: 1.0,
                max_shear_px: 1.0,
            }),
            ..Config::default()
        };
        let hand = Hand::new(&camera(), &target());
        let rig = crate::open(&config).expect("a scene");
        let lens = rig.info().cameras[0].intrinsics.clone();
        let mut samples = rig.into_lockstep();
        let mut n_found = 0;
        while let Some(sample) = samples.next_sample().expect("the rig works") {
            let Sample::Truth(TruthImage { image, .. }) = sample else {
                continue;
            };
            let gray: Vec<u8> = image.data.chunks_exact(3).map(|rgb| rgb[1]).collect();
            let found = target().detect(GrayImage {
                size_px: image.size_px,
                pixels: &gray,
            });
            let Ok(found) = found else {
                continue;
            };
            let camera_from_board = hand.camera_from_board(image.stamp.secs());
            let squares = found.corners.iter().map(|corner| {
                let point = camera_from_board * Point3::from(corner.point_in_board);
                let [x, y] = lens.project(&point.coords).expect("in front of the camera");
                (corner.pixel[0] - x).powi(2) + (corner.pixel[1] - y).powi(2)
            });
            let rms_px = (squares.sum::<f64>() / found.corners.len() as f64).sqrt();
            assert!(
                rms_px < MAX_RMS_PX,
                "at {} s: {rms_px} px",
                image.stamp.secs()
            );
            n_found += u64::from(found.corners.len() >= MIN_CORNERS);
        }
        assert!(
            n_found >= N_PLACES - 2,
            "only in {n_found} of {N_PLACES} images"
        );
    }
}
