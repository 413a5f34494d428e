//! Measures time and error of each method over the number of poses.

use super::method::Method;
use super::scene::{Noise, Scene};
use numbers::quantile::median;
use serde::Serialize;
use std::time::Instant;

const N_POSES: [usize; 5] = [10, 20, 50, 100, 200];
const SPREAD_RAD: f64 = 0.4;
const NOISE: Noise = Noise {
    corner_px: 0.1,
    robot_rad: 1e-4,
    robot_m: 1e-4,
};

/// Medians over the seeds for one method and number of poses.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Speed {
    pub(super) method: &'static str,
    pub(super) n_poses: usize,
    /// Time on one thread, including the poses of the board, milliseconds.
    pub(super) millis: f64,
    pub(super) mm: f64,
    pub(super) deg: f64,
}

/// Measures all methods with `n_seeds` scenes for each number of poses.
pub(super) fn measure(n_seeds: u64) -> Vec<Speed> {
    let mut results = Vec::new();
    for n_poses in N_POSES {
        let scenes: Vec<Scene> = (0..n_seeds)
            .map(|seed| Scene::new(n_poses, SPREAD_RAD, 3000 + seed))
            .collect();
        for method in Method::ALL {
            let mut millis = Vec::new();
            let mut mm = Vec::new();
            let mut deg = Vec::new();
            for (seed, scene) in (0..).zip(&scenes) {
                let samples = scene.samples(NOISE, seed);
                let started = Instant::now();
                let outcome = method.calibrate(&samples, &scene.flange_from_camera);
                // A refused calibration takes time, too, but has no error.
                millis.push(started.elapsed().as_secs_f64() * 1e3);
                if let Some(errors) = outcome.errors() {
                    mm.push(errors.mm);
                    deg.push(errors.deg);
                }
            }
            let [millis, mm, deg] =
                [millis, mm, deg].map(|values| median(&values).unwrap_or(f64::NAN));
            results.push(Speed {
                method: method.name(),
                n_poses,
                millis,
                mm,
                deg,
            });
        }
    }
    results
}
