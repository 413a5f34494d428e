//! The map of free space of a simulated arm, made from the images of its camera.

use super::surface_points::{SurfacePoint, surface_points};
use anyhow::{Context, Result, bail};
use capture::config::{Parent, Rig};
use clearance_map::{ClearanceMap, DepthImage, DepthOrigin, MapConfig, Posture, reach_m};
use drivers::{Image, PixelFormat};
use kinematics::{Chain, JointState, Stamp, Transform};
use numbers::random::Random;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};
use steering::{Body, Clearance, Seen};

/// Margin of space through which the arm moved on its tour, meters, as in simulated runs.
const SWEPT_MARGIN_M: f64 = 0.15;
/// Time between two postures that are swept, seconds.
const SWEEP_PERIOD_SECS: f64 = 0.2;
/// Number of readings that are kept: images arrive later than the readings of their exposure.
const MAX_READINGS: usize = 400;
/// Maximum time until an image is integrated, on a busy computer.
const MAX_WAIT: Duration = Duration::from_secs(60);
/// Time between two looks at whether an image is integrated.
const POLL: Duration = Duration::from_micros(200);

/// A map that is complete whenever it is asked, so that the same motion gives the same map.
pub(super) struct LiveMap {
    map: ClearanceMap,
    chain: Chain,
    flange_from_camera: Transform,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    world_from_base: Transform,
    readings: VecDeque<JointState>,
    swept_at: Option<Stamp>,
    n_pushed: u64,
    /// Added to all stamps: simulations begin at zero, but the time of the map goes on.
    pub(super) offset_secs: f64,
}

impl LiveMap {
    pub(super) fn new(rig: &Rig, chain: &Chain, body: &Body) -> Result<Self> {
        let [camera] = rig.cameras.as_slice() else {
            bail!("the scene has {} cameras, not one", rig.cameras.len());
        };
        if camera.parent != Parent::Flange {
            bail!("the camera of the scene is not on the flange");
        }
        let config = MapConfig::for_reach(reach_m(body, chain));
        Ok(Self {
            map: ClearanceMap::start(&config, body.clone())?,
            chain: chain.clone(),
            flange_from_camera: camera.parent_from_camera,
            focal_px: camera.intrinsics.focal_px,
            principal_px: camera.intrinsics.principal_px,
            world_from_base: Transform::identity(),
            readings: VecDeque::new(),
            swept_at: None,
            n_pushed: 0,
            offset_secs: 0.0,
        })
    }

    /// Sets the pose of the base, which stands still from now on.
    pub(super) fn set_base(&mut self, world_from_base: Transform) {
        self.world_from_base = world_from_base;
    }

    /// Takes a reading of the joints, in the order of the chain.
    pub(super) fn observe_joints(&mut self, reading: JointState) {
        if self.readings.len() == MAX_READINGS {
            self.readings.pop_front();
        }
        self.readings.push_back(reading);
    }

    /// The space through which the arm moved on its tour is free.
    ///
    /// # Errors
    ///
    /// If the posture is invalid.
    pub(super) fn sweep(&mut self) -> Result<()> {
        let Some(reading) = self.readings.back() else {
            return Ok(());
        };
        let is_due = |last: Stamp| reading.stamp.secs_since(last) >= SWEEP_PERIOD_SECS;
        if self.swept_at.is_none_or(is_due) {
            self.swept_at = Some(reading.stamp);
            let posture = self.posture(reading.stamp, reading.position.clone());
            self.map.sweep(posture, SWEPT_MARGIN_M)?;
        }
        Ok(())
    }

    /// Tells the map where the arm is now.
    ///
    /// # Errors
    ///
    /// If the posture is invalid.
    pub(super) fn set_posture(&self, stamp: Stamp, position: &[f64]) -> Result<()> {
        let posture = self.posture(stamp, position.to_vec());
        Ok(self.map.set_posture(&posture)?)
    }

    /// Takes an image, and waits until it is part of the map. Returns points on its surfaces; none
    /// for color images.
    ///
    /// # Errors
    ///
    /// If the image is invalid, or is not integrated within a minute.
    pub(super) fn observe_image(
        &mut self,
        image: &Image,
        random: &mut Random,
    ) -> Result<Vec<SurfacePoint>> {
        let PixelFormat::DepthU16 { meters_per_count } = image.format else {
            return Ok(Vec::new());
        };
        // The first images are older than all readings that were kept.
        let Some(reading) = self.reading_at(image.stamp) else {
            return Ok(Vec::new());
        };
        let base_from_flange = self.chain.forward(&reading.position)?;
        let counts = image.data.chunks_exact(2);
        #[expect(
            clippy::cast_possible_truncation,
            reason = "depth in meters fits an f32"
        )]
        let depth_m = counts
            .map(|bytes| {
                (f64::from(u16::from_le_bytes([bytes[0], bytes[1]])) * meters_per_count) as f32
            })
            .collect::<Vec<f32>>();
        let depth = DepthImage {
            camera: Arc::clone(&image.camera),
            stamp: image.stamp.plus_secs(self.offset_secs),
            size_px: image.size_px,
            focal_px: self.focal_px,
            principal_px: self.principal_px,
            depth_m: depth_m.into(),
            world_from_camera: self.world_from_base * base_from_flange * self.flange_from_camera,
            posture: self.posture(image.stamp, reading.position.clone()),
            origin: DepthOrigin::Measured,
        };
        let points = surface_points(&depth, &self.world_from_base, random);
        self.map.push(depth)?;
        self.n_pushed += 1;
        self.wait_until_integrated()?;
        Ok(points)
    }

    fn wait_until_integrated(&self) -> Result<()> {
        let began = Instant::now();
        loop {
            let state = self.map.state();
            if state.n_integrated + state.n_unused + state.n_replaced >= self.n_pushed {
                return Ok(());
            }
            if began.elapsed() > MAX_WAIT {
                bail!(
                    "the map has not taken an image within {} s",
                    MAX_WAIT.as_secs()
                );
            }
            std::thread::sleep(POLL);
        }
    }

    /// The reading closest to a time. Readings come every millisecond.
    fn reading_at(&self, stamp: Stamp) -> Option<&JointState> {
        let oldest = self.readings.front()?;
        let newest = self.readings.back()?;
        if stamp < oldest.stamp || stamp > newest.stamp {
            return None;
        }
        let distance = |reading: &&JointState| reading.stamp.nanos_since(stamp).abs();
        self.readings.iter().min_by_key(distance)
    }

    fn posture(&self, stamp: Stamp, position: Vec<f64>) -> Posture {
        Posture {
            stamp: stamp.plus_secs(self.offset_secs),
            position,
            world_from_base: self.world_from_base,
        }
    }

    /// The newest reading.
    ///
    /// # Errors
    ///
    /// Before the first one.
    pub(super) fn newest(&self) -> Result<&JointState> {
        self.readings.back().context("the arm has reported nothing")
    }

    /// Begins again at simulated time zero.
    pub(super) fn restart(&mut self, offset_secs: f64) {
        self.readings.clear();
        self.offset_secs = offset_secs;
    }
}

impl Clearance for LiveMap {
    fn readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        self.map
            .readings(points_in_base, now.plus_secs(self.offset_secs))
    }

    fn failure(&self) -> Option<String> {
        self.map.failure()
    }
}
