//! Opens the simulated twin of a rig: the same cameras and joints in MuJoCo.

use super::twin;
use crate::StampClock;
use crate::config::{
    ArmDriver, Camera, CameraDriver, Depth, Parent, Rig, Scanner, ScannerDriver, SimTarget,
};
use anyhow::bail;
use drivers::base_motion::MovableBase;
use drivers::motion::MotionLimits;
use drivers::{Devices, Error, LiveDevices, Sample, Source};
use kinematics::{Intrinsics, Stamp, Transform};
use std::sync::Arc;

/// Opens the simulated rig, in lockstep or in real time according to the rig file. In real time,
/// `real` devices run in parallel. Also returns the clock of the stamps.
pub(super) fn open(rig: &Rig, real: Devices) -> anyhow::Result<(Box<dyn Source>, StampClock)> {
    let config = config_of(rig)?;
    let any_real = real.arm.is_some()
        || real.base.is_some()
        || !real.scanners.is_empty()
        || !real.cameras.is_empty();
    if rig.sim.lockstep {
        if any_real {
            bail!(
                "sim.lockstep does not work with real devices, which cannot wait: set sim.lockstep = false"
            );
        }
        return Ok((
            Box::new(sim::open(&config)?.into_lockstep()),
            StampClock::Simulation,
        ));
    }
    // Real devices use the clock of this computer. Without them, the simulation starts at 0.
    let (start, stamp_clock) = if any_real {
        (drivers::clock::now(), StampClock::Computer)
    } else {
        (Stamp::default(), StampClock::Simulation)
    };
    let mut live = sim::open(&without_end(config))?.into_live(start)?;
    // A real device replaces the simulated one of the same kind.
    let devices = &mut live.devices;
    devices.arm = real.arm.or(devices.arm.take());
    devices.base = devices.base.take().or(real.base);
    devices.scanners.extend(real.scanners);
    devices.cameras.extend(real.cameras);
    Ok((Box::new(RealTime::new(rig, live, start)?), stamp_clock))
}

/// Opens a simulated rig in real time, with an arm that an operator may take over from its tour. Its
/// stamps are on the clock of this computer, like those of operators.
pub(super) fn steered(
    rig: &Rig,
    limits: sim::SteeredLimits<'_>,
) -> anyhow::Result<(Box<dyn Source>, sim::SteeredArm)> {
    let opened = sim::open(&without_end(config_of(rig)?))?;
    let start = drivers::clock::now();
    let (live, arm) = opened.into_steered(start, limits)?;
    Ok((Box::new(RealTime::new(rig, live, start)?), arm))
}

/// A simulated base, the same base for the thread that drives it, and its arm if it is steered.
pub(super) struct DrivenRobot {
    pub(super) base: sim::SteeredBase,
    pub(super) driven: Box<dyn MovableBase>,
    pub(super) arm: Option<sim::SteeredArm>,
}

/// Opens a simulated rig in real time, with a base that an operator may take over from its tour.
/// Stamps are on the clock of this computer.
///
/// * `limits`: those of the arm on the base, if the operator may take it over, too.
pub(super) fn with_steered_base(
    rig: &Rig,
    limits: Option<sim::SteeredLimits<'_>>,
) -> anyhow::Result<(Box<dyn Source>, DrivenRobot)> {
    let opened = sim::open(&without_end(config_of(rig)?))?.into_steered_base(limits)?;
    let source = RealTime::new(rig, opened.live, opened.start)?;
    let robot = DrivenRobot {
        base: opened.base,
        driven: opened.driven,
        arm: opened.arm,
    };
    Ok((Box::new(source), robot))
}

/// A configuration without limits. In real time, the source checks them itself: if the simulated
/// devices ended instead, they would look like devices that have failed.
fn without_end(config: sim::Config) -> sim::Config {
    sim::Config {
        duration_secs: None,
        n_images: None,
        ..config
    }
}

/// Opens a simulated rig with an arm that moves by commands.
pub(super) fn commanded(rig: &Rig, limits: &[MotionLimits]) -> anyhow::Result<sim::CommandedRig> {
    Ok(sim::open(&unlimited(rig)?)?.into_commanded(limits)?)
}

/// The simulator configuration of a rig whose arm is commanded. It has no end and no ground truth.
pub(super) fn unlimited(rig: &Rig) -> anyhow::Result<sim::Config> {
    Ok(sim::Config {
        duration_secs: None,
        n_images: None,
        truth: false,
        ..config_of(rig)?
    })
}

/// Live simulated devices with their ground truth.
struct RealTime {
    live: LiveDevices,
    truth: sim::LiveTruth,
    /// `None` without cameras.
    first_camera: Option<Arc<str>>,
    n_left: Option<u64>,
    end: Option<Stamp>,
}

impl RealTime {
    /// * `start`: stamp of simulated time zero.
    fn new(rig: &Rig, live: sim::LiveRig, start: Stamp) -> Result<Self, Error> {
        Ok(Self {
            live: LiveDevices::new(live.devices)?,
            truth: live.truth,
            first_camera: rig.cameras.first().map(|camera| Arc::clone(&camera.name)),
            n_left: rig.sim.n_images,
            end: rig.sim.duration_secs.map(|secs| start.plus_secs(secs)),
        })
    }
}

impl Source for RealTime {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        // Ground truth is returned before the next sample, because an image in the join waits for
        // it.
        if let Some(truth) = self.truth.take() {
            return Ok(Some(truth));
        }
        if self.n_left == Some(0) {
            return Ok(None);
        }
        let sample = self.live.next_sample()?;
        // `sim.n_images` counts images of the first camera, as in lockstep.
        if let Some(Sample::Image(image)) = &sample
            && !image.is_depth()
            && Some(&image.camera) == self.first_camera.as_ref()
            && let Some(n_left) = &mut self.n_left
        {
            *n_left -= 1;
        }
        let past_end = |sample: &Sample| self.end.is_some_and(|end| sample.stamp() >= end);
        Ok(sample.filter(|sample| !past_end(sample)))
    }

    fn n_other_samples_dropped(&self) -> u64 {
        self.live.n_other_samples_dropped()
    }
}

/// The simulator configuration of a rig.
fn config_of(rig: &Rig) -> anyhow::Result<sim::Config> {
    let config = sim::Config {
        seed: rig.sim.seed,
        ideal: rig.sim.ideal,
        truth: rig.sim.truth,
        truth_depth: rig.sim.truth_depth,
        speed: rig.sim.speed,
        azimuth_only: rig.sim.azimuth_only,
        duration_secs: rig.sim.duration_secs,
        n_images: rig.sim.n_images,
        joint_names: twin::simulated_chain(rig)?.joint_names().to_vec(),
        reading_order: if rig.arm.driver == ArmDriver::None {
            Vec::new()
        } else {
            rig.arm.joints.clone()
        },
        joint_offsets: rig.arm.sim.true_joint_offsets.clone(),
        scanners: rig
            .scanners
            .iter()
            .filter(|scanner| scanner.driver == ScannerDriver::Sim)
            .map(scanner_of)
            .collect(),
        base: sim::BaseConfig {
            rate_hz: rig.base.rate_hz,
            drift_m: rig.base.sim.drift_m,
            drift_rad: rig.base.sim.drift_rad,
        },
        light_inside_frac: rig.sim.light_inside_frac,
        targets: rig
            .sim
            .targets
            .iter()
            .map(|target| target_of(target, rig))
            .collect::<anyhow::Result<_>>()?,
        cameras: rig
            .cameras
            .iter()
            .filter(|camera| camera.driver == CameraDriver::Sim)
            .map(camera_of)
            .collect(),
        ..sim::Config::default()
    };
    twin::choose(rig, config)
}

fn target_of(
    (name, target): (&String, &SimTarget),
    rig: &Rig,
) -> anyhow::Result<sim::TargetConfig> {
    let (parent, parent_from_board) = match (target.world_from_board, target.flange_from_board) {
        (None, None) if target.moved_before.is_some() => {
            (in_hand(name, target, rig)?, Transform::identity())
        }
        _ if target.moved_before.is_some() => {
            bail!(
                "sim.target.{name}: a board that is moved by hand (moved_before) has no world_from_board or \
                 flange_from_board: remove one of them"
            )
        }
        (Some(_), Some(_)) => {
            bail!("sim.target.{name}: give either world_from_board or flange_from_board, not both")
        }
        (None, Some(flange_from_board)) => (sim::TargetParent::Flange, flange_from_board),
        (world_from_board, None) => (
            sim::TargetParent::World,
            world_from_board.unwrap_or_default(),
        ),
    };
    Ok(sim::TargetConfig {
        name: format!("sim.target.{name}"),
        spec: target.spec.clone(),
        parent,
        parent_from_board,
    })
}

/// A hand that moves a target in front of a camera.
fn in_hand(name: &str, target: &SimTarget, rig: &Rig) -> anyhow::Result<sim::TargetParent> {
    let camera = target.moved_before.as_deref().unwrap_or_default();
    let mut simulated = rig
        .cameras
        .iter()
        .filter(|camera| camera.driver == CameraDriver::Sim);
    match simulated.position(|other| &*other.name == camera) {
        Some(camera_ix) => Ok(sim::TargetParent::Hand { camera_ix }),
        None => {
            let names: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
            bail!(
                "sim.target.{name}.moved_before is {camera:?}, but the simulated cameras are: {}",
                names.join(", ")
            )
        }
    }
}

fn scanner_of(scanner: &Scanner) -> sim::ScannerConfig {
    sim::ScannerConfig {
        name: scanner.name.to_string(),
        rate_hz: scanner.rate_hz,
        base_from_scanner: scanner.base_from_scanner,
        n_rings: scanner.sim.rings,
        elevation_rad: [scanner.sim.min_elevation_rad, scanner.sim.max_elevation_rad],
        n_columns: scanner.sim.columns,
        min_m: scanner.min_m,
        max_m: scanner.max_m,
        noise_sigma_m: scanner.sim.noise_sigma_m,
        dropped_frac: scanner.sim.dropped_frac,
    }
}

fn camera_of(camera: &Camera) -> sim::CameraConfig {
    let default = sim::SensorConfig::default();
    let truth = &camera.sim.truth;
    // The simulated camera has the true values. The rig file may contain wrong values on purpose,
    // as the input of a calibration.
    let intrinsics = truth.intrinsics.as_ref().unwrap_or(&camera.intrinsics);
    sim::CameraConfig {
        name: camera.name.to_string(),
        intrinsics: intrinsics.clone(),
        rate_hz: camera.rate_hz,
        parent: match camera.parent {
            Parent::Flange => sim::Parent::Flange,
            Parent::Base => sim::Parent::Base,
            Parent::World => sim::Parent::World,
        },
        parent_from_camera: truth
            .parent_from_camera
            .unwrap_or(camera.parent_from_camera),
        stamps: sim::StampConfig {
            to_mid_exposure_secs: 1e-3 * truth.stamp_to_mid_exposure_millis,
            drift_frac: 1e-6 * truth.clock_drift_ppm,
        },
        sensor: sim::SensorConfig {
            noise_sigma: camera.sim.noise_sigma,
            shot_frac: camera.sim.shot_frac,
            exposure_micros: camera.exposure_micros.unwrap_or(default.exposure_micros),
            blur_samples: camera.sim.blur_samples,
            readout_micros: truth
                .readout_micros
                .or(camera.readout_micros)
                .unwrap_or(0.0),
            latency_millis: camera.sim.latency_millis,
            dropped_frac: camera.sim.dropped_frac,
            supersample: camera.sim.supersample,
        },
        depth: camera.depth.as_ref().map(|depth| sim::DepthConfig {
            sensor: depth_sensor(camera, depth, intrinsics),
            factor: truth.depth_factor,
            noise_sigma_m: camera.sim.depth_noise_sigma_m,
            hole_frac: camera.sim.depth_hole_frac,
            min_m: depth.min_m,
            max_m: depth.max_m,
            meters_per_count: camera.sim.meters_per_count,
        }),
    }
}

/// The depth sensor; `None` if depth is registered to the color image.
fn depth_sensor(camera: &Camera, depth: &Depth, color: &Intrinsics) -> Option<sim::DepthSensor> {
    let camera_from_depth = camera
        .sim
        .truth
        .camera_from_depth
        .unwrap_or(depth.camera_from_depth);
    // If the lens of depth was derived from that of the color image, its true lens is derived from
    // the true color lens.
    let size_px = depth.intrinsics.size_px;
    let shares_lens = depth.intrinsics == camera.intrinsics.resized(size_px);
    let intrinsics = if shares_lens {
        color.resized(size_px)
    } else {
        depth.intrinsics.clone()
    };
    let is_registered = intrinsics == *color && camera_from_depth == Transform::identity();
    (!is_registered).then_some(sim::DepthSensor {
        intrinsics,
        camera_from_depth,
    })
}
