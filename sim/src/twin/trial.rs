//! Tries a tour without rendering images. Determines what the camera sees, and how fast the images
//! move.

use super::follower::TwinFollower;
use crate::config::CameraConfig;
use kinematics::{Intrinsics, Transform};
use nalgebra::{Point3, Vector3};

/// What the camera of a tour sees.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Trial {
    /// Fraction of the time at which the target area is in the image.
    pub(crate) visible_frac: f64,
    /// Root mean square angle between the directions from which the target area is seen and their
    /// mean, radians.
    pub(crate) spread_rad: f64,
    /// Image speed that is exceeded during a tenth of the time, pixels per second.
    pub(crate) fast_px_s: f64,
}

/// Length of a trial, and its time step, seconds.
const TRIAL_SECS: f64 = 30.0;
const STEP_SECS: f64 = 0.005;
/// Steps from one sample to the next.
const SAMPLE_STEPS: u32 = 10;
/// A target area closer to a border of the image than this fraction does not count as seen.
const BORDER_FRAC: f64 = 0.06;
/// Smallest and largest distance at which the target area counts as seen, meters.
const SEEN_RANGE_M: [f64; 2] = [0.08, 6.0];
/// Spread of the views of a good scan, radians.
const GOOD_SPREAD_RAD: f64 = 0.3;

impl Trial {
    /// Follows a tour. The value of `follower` is used up.
    ///
    /// * `target_in_base`: center of the target area.
    pub(crate) fn of(
        mut follower: TwinFollower,
        camera: &CameraConfig,
        target_in_base: &Point3<f64>,
    ) -> Self {
        let mut directions = Vec::new();
        let mut speeds_px_s = Vec::new();
        let (mut n_samples, mut secs) = (0_u32, 0.0);
        let mut before = follower.base_from_camera(&camera.parent_from_camera);
        let mut step = 0;
        while secs < TRIAL_SECS {
            secs += STEP_SECS;
            step += 1;
            follower.advance(secs, STEP_SECS);
            let is_sampled = step % SAMPLE_STEPS == 0;
            if !is_sampled && (step + 1) % SAMPLE_STEPS != 0 {
                continue;
            }
            let pose = follower.base_from_camera(&camera.parent_from_camera);
            if is_sampled {
                n_samples += 1;
                if sees(&camera.intrinsics, &pose, target_in_base) {
                    let from_target = Point3::from(pose.translation.vector) - target_in_base;
                    directions.push(from_target.normalize());
                    let motion = pose.inverse() * before;
                    let depth_m = from_target.norm();
                    speeds_px_s
                        .push(image_motion_px(&camera.intrinsics, &motion, depth_m) / STEP_SECS);
                }
            }
            before = pose;
        }
        speeds_px_s.sort_by(f64::total_cmp);
        Self {
            visible_frac: directions.len() as f64 / f64::from(n_samples),
            spread_rad: spread_rad(&directions),
            fast_px_s: speeds_px_s
                .get(speeds_px_s.len() * 9 / 10)
                .copied()
                .unwrap_or_default(),
        }
    }

    /// How good the scan is, 0 to 1.
    pub(crate) fn quality(&self) -> f64 {
        self.visible_frac * (self.spread_rad / GOOD_SPREAD_RAD).min(1.0)
    }
}

/// Whether a camera sees a point. Both are in the same frame.
pub(crate) fn sees(
    intrinsics: &Intrinsics,
    frame_from_camera: &Transform,
    point: &Point3<f64>,
) -> bool {
    let in_camera = frame_from_camera.inverse_transform_point(point);
    let [nearest, farthest] = SEEN_RANGE_M;
    if in_camera.z < nearest || in_camera.z > farthest {
        return false;
    }
    let Some(pixel) = intrinsics.project(&in_camera.coords) else {
        return false;
    };
    (0..2).all(|axis| {
        let size = f64::from(intrinsics.size_px[axis]);
        (BORDER_FRAC * size..=(1.0 - BORDER_FRAC) * size).contains(&pixel[axis])
    })
}

fn spread_rad(directions: &[Vector3<f64>]) -> f64 {
    let sum: Vector3<f64> = directions.iter().sum();
    let Some(mean) = sum.try_normalize(1e-9) else {
        return 0.0;
    };
    let squares: f64 = directions
        .iter()
        .map(|direction| direction.angle(&mean).powi(2))
        .sum();
    (squares / directions.len() as f64).sqrt()
}

/// Mean motion of five image points of a surface at a constant depth, pixels.
fn image_motion_px(intrinsics: &Intrinsics, camera_from_previous: &Transform, depth_m: f64) -> f64 {
    // Rotation about the optical axis moves only outer points, and translation along it moves no
    // point at the center.
    const POINTS: [[f64; 2]; 5] = [
        [0.0, 0.0],
        [-0.25, -0.25],
        [0.25, -0.25],
        [-0.25, 0.25],
        [0.25, 0.25],
    ];
    let sum: f64 = POINTS
        .iter()
        .map(|fraction| {
            let [x, y]: [f64; 2] = std::array::from_fn(|axis| {
                fraction[axis] * f64::from(intrinsics.size_px[axis]) / intrinsics.focal_px[axis]
            });
            let before = Point3::new(x, y, 1.0) * depth_m;
            let after = camera_from_previous * before;
            let du = intrinsics.focal_px[0] * (after.x / after.z - x);
            let dv = intrinsics.focal_px[1] * (after.y / after.z - y);
            du.hypot(dv)
        })
        .sum();
    sum / POINTS.len() as f64
}
