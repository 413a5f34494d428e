//! A rig's simulated twin: the same cameras and joints in MuJoCo.

use crate::config::{Camera, Parent, Rig};
use anyhow::bail;
use drivers::{Error, Live, Sample, Source};
use kinematics::{Stamp, Transform};
use std::sync::Arc;

/// Opens the simulated rig, in lockstep or in real time as the rig file says.
pub(super) fn open(rig: &Rig) -> anyhow::Result<Box<dyn Source>> {
    let mut config = config_of(rig)?;
    if rig.sim.lockstep {
        return Ok(Box::new(sim::open(&config)?.into_lockstep()));
    }
    // In real time the end is found here: devices that end would look like devices that fail.
    (config.duration_secs, config.n_images) = (None, None);
    let sim::LiveRig { cameras, arm, truth, .. } = sim::open(&config)?.into_live(Stamp::default())?;
    Ok(Box::new(RealTime {
        live: Live::new(cameras, Some(arm))?,
        truth,
        first_camera: Arc::clone(&rig.cameras[0].name),
        n_left: rig.sim.n_images,
        end: rig.sim.duration_secs.map(|secs| Stamp::default().plus_secs(secs)),
    }))
}

/// Live simulated devices with their ground truth.
struct RealTime {
    live: Live,
    truth: sim::LiveTruth,
    first_camera: Arc<str>,
    n_left: Option<u64>,
    end: Option<Stamp>,
}

impl Source for RealTime {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        if let Some(truth) = self.truth.take() {
            return Ok(Some(Sample::Truth(truth)));
        }
        if self.n_left == Some(0) {
            return Ok(None);
        }
        let sample = self.live.next_sample()?;
        if let Some(Sample::Image(image)) = &sample
            && !image.is_depth()
            && image.camera == self.first_camera
            && let Some(n_left) = &mut self.n_left
        {
            *n_left -= 1;
        }
        let past_end = |sample: &Sample| self.end.is_some_and(|end| sample.stamp() >= end);
        Ok(sample.filter(|sample| !past_end(sample)))
    }
}

/// The simulator's configuration of a rig.
fn config_of(rig: &Rig) -> anyhow::Result<sim::Config> {
    let Some(scene) = sim::Scene::from_name(&rig.sim.scene) else {
        let known: Vec<_> = sim::Scene::ALL.iter().map(|scene| scene.name()).collect();
        bail!("sim.scene is {:?}, known scenes: {}", rig.sim.scene, known.join(", "));
    };
    if rig.base.world_from_base != Transform::identity() {
        bail!("a simulated base stands in the world's origin: base.world_from_base has to be the identity");
    }
    Ok(sim::Config {
        scene,
        seed: rig.sim.seed,
        ideal: rig.sim.ideal,
        truth: rig.sim.truth,
        truth_depth: rig.sim.truth_depth,
        speed: rig.sim.speed,
        azimuth_only: rig.sim.azimuth_only,
        duration_secs: rig.sim.duration_secs,
        n_images: rig.sim.n_images,
        joint_names: super::chain_of(rig)?.joint_names().to_vec(),
        reading_order: rig.arm.joints.clone(),
        cameras: rig.cameras.iter().map(camera_of).collect::<Result<_, _>>()?,
    })
}

fn camera_of(camera: &Camera) -> anyhow::Result<sim::CameraConfig> {
    if let Some(depth) = &camera.depth
        && (depth.intrinsics != camera.intrinsics || depth.camera_from_depth != Transform::identity())
    {
        bail!(
            "camera {:?}: simulated depth is registered to the colour images: leave its size, lens and pose out",
            camera.name
        );
    }
    let default = sim::SensorConfig::default();
    Ok(sim::CameraConfig {
        name: camera.name.to_string(),
        intrinsics: camera.intrinsics.clone(),
        rate_hz: camera.rate_hz,
        parent: if camera.parent == Parent::Flange { sim::Parent::Flange } else { sim::Parent::World },
        parent_from_camera: camera.parent_from_camera,
        sensor: sim::SensorConfig {
            noise_sigma: camera.sim.noise_sigma,
            shot_frac: camera.sim.shot_frac,
            exposure_micros: camera.exposure_micros.unwrap_or(default.exposure_micros),
            blur_samples: camera.sim.blur_samples,
            readout_micros: camera.readout_micros.unwrap_or(0.0),
            latency_millis: camera.sim.latency_millis,
            dropped_frac: camera.sim.dropped_frac,
            supersample: camera.sim.supersample,
        },
        depth: camera.depth.as_ref().map(|depth| sim::DepthConfig {
            noise_sigma_m: camera.sim.depth_noise_sigma_m,
            hole_frac: camera.sim.depth_hole_frac,
            min_m: depth.min_m,
            max_m: depth.max_m,
            metres_per_count: camera.sim.metres_per_count,
        }),
    })
}
