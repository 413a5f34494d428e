//! Opens a simulated arm whose contacts with its scene are counted.

use super::arm_config::simulated_limits;
use super::{check_arm, without_readout_if_ideal};
use crate::config::Rig;
use drivers::Camera;
use drivers::motion::{MotionLimits, MovableArm};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A simulated arm that moves by commands. The simulation runs as fast as the arm and the cameras
/// are read. The stamps begin at 0.
pub struct CountedArm {
    /// The arm, at rest in the first posture of its tour. Its base moves as on its tour.
    pub arm: Box<dyn MovableArm>,
    /// The cameras in the order of the rig file.
    pub cameras: Vec<Box<dyn Camera>>,
    /// Limits of its motions.
    pub limits: Vec<MotionLimits>,
    n_contacts: Arc<AtomicU64>,
}

impl CountedArm {
    /// How often a part of the robot has begun to touch an object of the scene.
    #[must_use]
    pub fn n_contacts(&self) -> u64 {
        self.n_contacts.load(Ordering::Relaxed)
    }
}

/// Opens the arm and the cameras of a simulated rig.
///
/// # Errors
///
/// If the rig has no simulated arm, or the scene cannot be built.
pub fn counted(rig: &Rig) -> anyhow::Result<CountedArm> {
    let mut rig = rig.clone();
    without_readout_if_ideal(&mut rig);
    check_arm(&rig)?;
    let limits = simulated_limits(&rig)?;
    let opened = sim::open(&super::simulated::unlimited(&rig)?)?;
    let (commanded, n_contacts) = opened.into_counted(&limits)?;
    Ok(CountedArm {
        arm: commanded.arm,
        cameras: commanded.cameras,
        limits,
        n_contacts,
    })
}
