//! The camera tour of the mobile arm. The camera views the cabinet from two stations, then enters
//! it.

use crate::base::{BaseMotion, base_from_arm, oscillate, smooth};
use crate::cabinet::{CENTER_Z_M, FRONT_X_M, SCREEN_M};
use crate::scan::looking_along;
use kinematics::{Transform, transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// The camera's path. The base is stationary during scans.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CabinetTour {
    motion: BaseMotion,
    /// Poses of the base at both stations.
    world_from_station: [Transform; 2],
    /// Times at which the base leaves the first station and reaches the second, seconds.
    walk_secs: [f64; 2],
    speed: f64,
}

/// Seconds at the second station before the camera enters. The next constant is the duration of one
/// trip in and out.
const OUTSIDE_SECS: f64 = 9.0;
const IN_AND_OUT_SECS: f64 = 22.0;
/// The lamps change while the camera moves between these depths behind the opening, meters.
/// Negative depths are outside.
const LIGHT_TRANSITION_M: [f64; 2] = [-0.20, 0.02];

impl CabinetTour {
    pub(crate) fn new(motion: BaseMotion, speed: f64) -> Self {
        let walk_interval_secs = motion.walk_secs();
        let world_from_station = walk_interval_secs.map(|secs| motion.world_from_base(secs));
        Self {
            motion,
            world_from_station,
            walk_secs: walk_interval_secs,
            speed,
        }
    }

    /// Target pose of the camera in the arm's base frame.
    pub(crate) fn arm_from_camera(&self, secs: f64) -> Transform {
        let [departure_secs, arrival_secs] = self.walk_secs;
        // The tour is defined in the world, so that the camera views the target although the base
        // has a different position and heading at each station.
        match self.motion.station_at(secs) {
            Some((station, at)) => self.at_station(station, at),
            None => {
                // While the base walks, the camera moves from its last pose at the first station to
                // its first pose at the second.
                let share = smooth((secs - departure_secs) / (arrival_secs - departure_secs));
                transform::interpolate(
                    &self.at_station(0, departure_secs * self.speed),
                    &self.at_station(1, 0.0),
                    share,
                )
            }
        }
    }

    fn at_station(&self, station: usize, at: f64) -> Transform {
        let (eye, look_at, roll_rad) = if station == 0 { far(at) } else { near(at) };
        let orientation = looking_along(&(look_at - eye).normalize())
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll_rad);
        let world_from_camera = Transform::from_parts(Translation3::from(eye), orientation);
        (self.world_from_station[station] * base_from_arm()).inverse() * world_from_camera
    }
}

/// Eye, look-at point and roll at the first station, `at` seconds after the start.
fn far(at: f64) -> (Vector3<f64>, Vector3<f64>, f64) {
    let eye = Vector3::new(
        oscillate([0.60, 0.07, 6.1, 0.2], at),
        0.15 + oscillate([0.0, 0.24, 7.3, -0.2], at),
        oscillate([1.00, 0.17, 6.9, 0.6], at),
    );
    let look_at = Vector3::new(
        FRONT_X_M,
        oscillate([0.0, 0.30, 9.1, 0.1], at),
        CENTER_Z_M + oscillate([0.0, 0.25, 6.7, 0.4], at),
    );
    (eye, look_at, oscillate([0.0, 0.15, 8.3, 0.6], at))
}

/// Eye, look-at point and roll at the second station. The camera is first in front of the opening,
/// then moves repeatedly in and out.
fn near(at: f64) -> (Vector3<f64>, Vector3<f64>, f64) {
    // The cycle is a cosine, so that the camera is at rest when it starts and when it turns around.
    let cycle = ((at - OUTSIDE_SECS).max(0.0) / IN_AND_OUT_SECS * std::f64::consts::TAU).cos();
    let inside = 0.5 - 0.5 * cycle;
    // Position and look-at point move from outside to inside together.
    let blend = |outside: Vector3<f64>, deep: Vector3<f64>| outside + (deep - outside) * inside;
    let eye = blend(
        Vector3::new(
            FRONT_X_M - 0.33 + oscillate([0.0, 0.05, 5.3, 0.1], at),
            oscillate([0.0, 0.22, 8.3, 0.25], at),
            CENTER_Z_M + oscillate([0.08, 0.18, 6.1, 0.0], at),
        ),
        Vector3::new(
            FRONT_X_M - 0.05 + oscillate([0.0, 0.03, 4.3, 0.2], at),
            oscillate([0.02, 0.12, 5.9, 0.0], at),
            CENTER_Z_M + oscillate([0.07, 0.08, 4.7, 0.3], at),
        ),
    );
    let [x, y, z] = SCREEN_M;
    let look_at = blend(
        Vector3::new(
            FRONT_X_M + 0.2,
            oscillate([0.0, 0.26, 7.1, 0.4], at),
            CENTER_Z_M + oscillate([0.0, 0.24, 5.7, 0.1], at),
        ),
        Vector3::new(
            x + 0.05,
            y + oscillate([-0.10, 0.20, 6.7, 0.0], at),
            z + oscillate([0.0, 0.12, 7.9, 0.2], at),
        ),
    );
    (eye, look_at, oscillate([0.0, 0.15, 8.3, 0.1], at))
}

/// Brightness of the lamps for a camera pose. It is 1 outside and `inside_frac` inside.
pub(crate) fn light_frac(world_from_camera: &Transform, inside_frac: f64) -> f64 {
    let [from, to] = LIGHT_TRANSITION_M;
    let share = smooth((world_from_camera.translation.vector.x - FRONT_X_M - from) / (to - from));
    1.0 + (inside_frac - 1.0) * share
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CameraConfig;
    use crate::config::Scene;
    use crate::follower::{Follower, Tour};
    use crate::panda;

    #[test]
    fn arm_follows_tour_from_both_stations() {
        const STEP_SECS: f64 = 0.002;
        const MAX_POSITION_ERROR_M: f64 = 0.10;
        const MAX_ROTATION_ERROR_RAD: f64 = 0.35;
        let motion = BaseMotion::of(Scene::MobileArm, 1.0);
        let tour = CabinetTour::new(motion, 1.0);
        let flange_from_camera = CameraConfig::mobile_wrist("wrist").parent_from_camera;
        let mut follower = Follower::new(Tour::Cabinet(tour), flange_from_camera)
            .expect("the arm can reach the first pose");
        let (mut secs, mut off_tour_secs, mut worst, mut max_depth_m) =
            (0.0, 0.0, [0.0_f64; 3], f64::MIN);
        while secs < 60.0 {
            secs += STEP_SECS;
            follower.advance(secs, STEP_SECS);
            let actual = panda::base_from_flange(follower.position_rad()) * flange_from_camera;
            let pose_error = tour.arm_from_camera(secs).inverse() * actual;
            let off = [
                pose_error.translation.vector.norm(),
                pose_error.rotation.angle(),
            ];
            if off[0] > MAX_POSITION_ERROR_M || off[1] > MAX_ROTATION_ERROR_RAD {
                off_tour_secs += STEP_SECS;
            }
            if off[1] > worst[1] {
                worst = [off[0], off[1], secs];
            }
            let world_from_camera = motion.world_from_base(secs) * base_from_arm() * actual;
            max_depth_m = max_depth_m.max(world_from_camera.translation.vector.x - FRONT_X_M);
        }
        assert!(
            off_tour_secs < 3.0,
            "{off_tour_secs} s of 60 s off the tour, worst (m, rad, s) {worst:?}"
        );
        assert!(max_depth_m > -0.06, "{max_depth_m} m");
    }
}
