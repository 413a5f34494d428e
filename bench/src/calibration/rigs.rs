//! Measures the calibration of a rig without a target. The simulated rigs have a camera pose that
//! is wrong in a random direction.

use super::method::Errors;
use anyhow::Result;
use capture::config::{Override, Rig};
use capture::open::{self, Devices};
use kinematics::{Stamp, Transform};
use messages::InsufficientData;
use nalgebra::Vector3;
use numbers::random::Random;
use serde::Serialize;
use session::{Data, Refine, calibrate_scene, ignore_progress};
use std::path::Path;
use std::time::Instant;

/// Error of the given camera poses.
const ERROR_DEG: f64 = 3.0;
const ERROR_MM: f64 = 20.0;

/// Result of one rig.
#[derive(Clone, Debug, Serialize)]
pub(super) struct RigResult {
    pub(super) seed: u64,
    pub(super) n_images: usize,
    /// Errors after the calibration. `None` if it was refused.
    pub(super) errors: Option<Errors>,
    /// Euclidean norms of the reported per-axis standard deviations.
    pub(super) sigma_mm: Option<f64>,
    pub(super) sigma_deg: Option<f64>,
    /// Time of the estimation, without the scan, seconds.
    pub(super) seconds: f64,
}

/// Calibrates the first camera of a rig file once.
pub(super) fn measure(rig_file: &Path, seed: u64, scan_secs: f64) -> Result<RigResult> {
    let seed_of_scene = i64::try_from(seed).unwrap_or(i64::MAX);
    let overrides = [
        Override::new("sim.lockstep", true),
        Override::new("sim.seed", seed_of_scene),
    ];
    let mut rig = Rig::load(rig_file, &overrides)?;
    // The simulated camera stays where it is. Only the pose in the rig file becomes wrong.
    let camera = &mut rig.cameras[0];
    let truth = camera
        .sim
        .truth
        .parent_from_camera
        .unwrap_or(camera.parent_from_camera);
    camera.sim.truth.parent_from_camera = Some(truth);
    camera.parent_from_camera = truth * random_error(seed);
    let name = camera.name.to_string();
    let given = rig.clone();
    let opened = open::rig(rig, Devices::Sim)?;
    let mut first: Option<Stamp> = None;
    let data = Data::from_devices(
        opened,
        |sample| {
            let stamp = sample.stamp();
            stamp.secs_since(*first.get_or_insert(stamp)) > scan_secs
        },
        &ignore_progress,
    )?;
    // Only the estimation is timed, because the scan takes as long as the robot moves.
    let started = Instant::now();
    let found = match calibrate_scene(&data, &[Refine::Auto], Some(&given)) {
        Ok(found) => found,
        Err(error) if error.is::<InsufficientData>() => {
            return Ok(RigResult::refused(seed, data.keyframes.len(), started));
        }
        Err(error) => return Err(error),
    };
    let corrected = found
        .rig
        .as_ref()
        .filter(|_| !found.refused.contains_key(&name));
    let Some(corrected) = corrected else {
        return Ok(RigResult::refused(seed, data.keyframes.len(), started));
    };
    let sigmas = found
        .alignment
        .extrinsics_covariance
        .as_ref()
        .and_then(|covariance| covariance.of_camera(&name));
    let norm = |sigmas: [f64; 3]| Vector3::from(sigmas).norm();
    Ok(RigResult {
        errors: Some(Errors::of(
            &corrected.cameras[0].parent_from_camera,
            &truth,
            None,
        )),
        sigma_mm: sigmas.map(|sigmas| 1e3 * norm(sigmas.m)),
        sigma_deg: sigmas.map(|sigmas| norm(sigmas.rad).to_degrees()),
        ..RigResult::refused(seed, data.keyframes.len(), started)
    })
}

impl RigResult {
    fn refused(seed: u64, n_images: usize, started: Instant) -> Self {
        let seconds = started.elapsed().as_secs_f64();
        Self {
            seed,
            n_images,
            errors: None,
            sigma_mm: None,
            sigma_deg: None,
            seconds,
        }
    }

    /// Whether the error is at most 0.2 mm and 0.02 degrees.
    pub(super) fn reaches_goal(&self) -> bool {
        const MAX_MM: f64 = 0.2;
        const MAX_DEG: f64 = 0.02;
        self.errors
            .is_some_and(|errors| errors.mm <= MAX_MM && errors.deg <= MAX_DEG)
    }
}

/// A rotation and a translation of fixed size in random directions.
fn random_error(seed: u64) -> Transform {
    let mut random = Random::new(9000 + seed);
    let mut direction =
        || Vector3::new(random.normal(), random.normal(), random.normal()).normalize();
    Transform::new(
        direction() * (1e-3 * ERROR_MM),
        direction() * ERROR_DEG.to_radians(),
    )
}
