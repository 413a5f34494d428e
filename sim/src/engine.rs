//! Steps the rig and makes the samples, in the order in which devices would deliver them.

use crate::arm::{Arm, Reading, STEP_NANOS};
use crate::config::{CameraConfig, Config, Parent, SensorConfig};
use crate::noise;
use crate::optics::{Optics, Shift};
use crate::panda::{self, Joints};
use crate::random::Random;
use crate::render::{Pending, Renderer};
use crate::{Error, render};
use drivers::{Image, PixelFormat, Sample, TruthImage};
use kinematics::{JointState, Stamp, Transform};
use std::collections::VecDeque;
use std::sync::Arc;

/// A sample and the simulated time at which it arrives.
pub(crate) type Delivery = (i64, Sample);

/// A rig in motion.
pub(crate) struct Engine {
    config: Config,
    /// Which joint each number of a reading is of.
    joint_ixs: Vec<usize>,
    arm: Arm,
    cameras: Vec<Camera>,
    renderer: Renderer,
    /// Stamp of simulated time zero.
    start: Stamp,
    /// Images being drawn before the engine waits for the first of them.
    max_pending: usize,
    /// Images that would arrive before this simulated time are skipped: a real-time player that is late says so.
    skip_before_nanos: i64,
    slots: VecDeque<Slot>,
    n_pending: usize,
    ready: VecDeque<Delivery>,
    n_images: u64,
    has_ended: bool,
}

/// What is delivered next.
enum Slot {
    Joints(Reading),
    Image(Exposure),
}

struct Camera {
    name: Arc<str>,
    config: CameraConfig,
    sensor: SensorConfig,
    optics: Optics,
    ix: u64,
    n_exposed: u64,
    n_skipped: u64,
}

/// An image on its way.
struct Exposure {
    camera_ix: usize,
    image_ix: u64,
    stamp_nanos: i64,
    arrival_nanos: i64,
    n_skipped: u64,
    world_from_camera: Transform,
    /// Camera poses at other instants relative to `world_from_camera`, where the shutter makes a difference.
    shifts: Vec<Shift>,
    picture: Pending,
}

/// First exposure of the first camera, and how much later each further camera starts.
const FIRST_NANOS: i64 = 50_000_000;
const STAGGER_NANOS: i64 = 3_700_000;

/// Streams of random numbers of one image.
const COLOR_NOISE: u64 = 1;
const DEPTH_NOISE: u64 = 2;
const DROPS: u64 = 3;

#[expect(clippy::cast_possible_truncation, reason = "times of a run in nanoseconds fit an i64")]
fn nanos_from_secs(secs: f64) -> i64 {
    (secs * 1e9).round() as i64
}

impl Camera {
    fn new(config: &CameraConfig, ix: usize, ideal: bool) -> Result<Self, Error> {
        let flawless = SensorConfig {
            noise_sigma: 0.0,
            blur_samples: 1,
            readout_micros: 0.0,
            latency_millis: 0.0,
            dropped_frac: 0.0,
            ..config.sensor
        };
        let sensor = if ideal { flawless } else { config.sensor };
        let is_sharp = config.parent == Parent::World || (sensor.readout_micros <= 0.0 && sensor.blur_samples <= 1);
        Ok(Self {
            name: config.name.as_str().into(),
            optics: Optics::new(config, is_sharp)?,
            config: config.clone(),
            sensor,
            ix: ix as u64,
            n_exposed: 0,
            n_skipped: 0,
        })
    }

    fn stamp_nanos(&self) -> i64 {
        let elapsed = self.n_exposed as f64 / self.config.rate_hz;
        let first = FIRST_NANOS + self.ix as i64 * STAGGER_NANOS;
        first + nanos_from_secs(elapsed)
    }

    /// Half the time over which the image's rows are exposed.
    fn half_span_nanos(&self) -> i64 {
        nanos_from_secs(0.5e-6 * (self.sensor.readout_micros + self.sensor.exposure_micros))
    }

    /// From the stamp to the arrival; never before the joints are known up to the last row.
    fn wait_nanos(&self) -> i64 {
        self.half_span_nanos() + STEP_NANOS + nanos_from_secs(1e-3 * self.sensor.latency_millis)
    }

    /// Instants at which the rows are exposed, relative to the stamp: those of the first row, then of the second.
    /// Empty where all are zero.
    fn row_offsets_nanos(&self) -> Vec<i64> {
        let sensor = &self.sensor;
        if self.config.parent == Parent::World || (sensor.readout_micros <= 0.0 && sensor.blur_samples <= 1) {
            return Vec::new();
        }
        let [_, height] = self.config.intrinsics.size_px;
        let mut offsets = Vec::new();
        for row in 0..height {
            let by_row = ((f64::from(row) + 0.5) / f64::from(height) - 0.5) * sensor.readout_micros;
            for sample in 0..sensor.blur_samples {
                let share = (f64::from(sample) + 0.5) / f64::from(sensor.blur_samples) - 0.5;
                offsets.push(nanos_from_secs(1e-6 * (by_row + share * sensor.exposure_micros)));
            }
        }
        offsets
    }

    fn world_from_camera(&self, position_rad: &Joints) -> Transform {
        match self.config.parent {
            Parent::Flange => panda::base_from_flange(position_rad) * self.config.parent_from_camera,
            Parent::World => self.config.parent_from_camera,
        }
    }

    fn random(&self, seed: u64, image_ix: u64, stream: u64) -> Random {
        Random::new(seed, &[self.ix, image_ix, stream])
    }
}

/// How much of the arm's past its cameras may still ask for, nanoseconds.
pub(crate) fn history_nanos(config: &Config) -> i64 {
    let longest = |camera: &CameraConfig| {
        let sensor = &camera.sensor;
        nanos_from_secs(1e-6 * (sensor.readout_micros + sensor.exposure_micros) + 1e-3 * sensor.latency_millis)
    };
    config.cameras.iter().map(longest).max().unwrap_or(0) + 10 * STEP_NANOS
}

/// Optics and counters of every camera, before the rest exists.
pub(crate) struct Cameras(Vec<Camera>);

impl Cameras {
    pub(crate) fn new(config: &Config) -> Result<Self, Error> {
        let cameras = config.cameras.iter().enumerate().map(|(ix, camera)| Camera::new(camera, ix, config.ideal));
        Ok(Self(cameras.collect::<Result<_, _>>()?))
    }

    /// Size that holds the pictures of all cameras.
    pub(crate) fn largest_view_px(&self) -> [u32; 2] {
        let sizes = self.0.iter().map(|camera| camera.optics.view_size_px());
        sizes.fold([1, 1], |largest, size| [largest[0].max(size[0]), largest[1].max(size[1])])
    }
}

impl Engine {
    pub(crate) fn new(config: Config, arm: Arm, cameras: Cameras, renderer: Renderer) -> Result<Self, Error> {
        Ok(Self {
            joint_ixs: config.joint_ixs()?,
            config,
            arm,
            cameras: cameras.0,
            renderer,
            start: Stamp(0),
            max_pending: 2,
            skip_before_nanos: i64::MIN,
            slots: VecDeque::new(),
            n_pending: 0,
            ready: VecDeque::new(),
            n_images: 0,
            has_ended: false,
        })
    }

    pub(crate) fn renderer_name(&self) -> &str {
        self.renderer.name()
    }

    /// Sets the stamp of simulated time zero, before the first sample is taken.
    pub(crate) fn set_start(&mut self, start: Stamp) {
        self.start = start;
    }

    /// Skips the images that arrive before a simulated time.
    pub(crate) fn skip_before(&mut self, nanos: i64) {
        self.skip_before_nanos = nanos;
    }

    /// The next sample; `None` at the end.
    pub(crate) fn next(&mut self) -> Result<Option<Delivery>, Error> {
        loop {
            if let Some(delivery) = self.ready.pop_front() {
                return Ok(Some(delivery));
            }
            while self.n_pending < self.max_pending && !self.has_ended {
                self.step()?;
            }
            match self.slots.pop_front() {
                None => return Ok(None),
                Some(Slot::Joints(reading)) => {
                    return Ok(Some((reading.nanos, Sample::Joints(self.joint_state(&reading)))));
                }
                Some(Slot::Image(exposure)) => {
                    self.n_pending -= 1;
                    self.develop(exposure)?;
                }
            }
        }
    }

    /// Moves the arm by one step and starts drawing the images that arrive by then.
    fn step(&mut self) -> Result<(), Error> {
        let reading = self.arm.step();
        if self.config.duration_secs.is_some_and(|secs| reading.nanos > nanos_from_secs(secs)) {
            self.has_ended = true;
            return Ok(());
        }
        self.slots.push_back(Slot::Joints(reading));
        for camera_ix in 0..self.cameras.len() {
            while !self.has_ended
                && self.cameras[camera_ix].stamp_nanos() + self.cameras[camera_ix].wait_nanos() <= reading.nanos
            {
                self.expose(camera_ix)?;
            }
        }
        Ok(())
    }

    /// Starts drawing a camera's next image, or loses it.
    fn expose(&mut self, camera_ix: usize) -> Result<(), Error> {
        let camera = &mut self.cameras[camera_ix];
        let (image_ix, stamp_nanos) = (camera.n_exposed, camera.stamp_nanos());
        let arrival_nanos = stamp_nanos + camera.wait_nanos();
        camera.n_exposed += 1;
        let luck = camera.random(self.config.seed, image_ix, DROPS).unit(0);
        if luck < camera.sensor.dropped_frac || arrival_nanos < self.skip_before_nanos {
            camera.n_skipped += 1;
            return Ok(());
        }
        let position_at = |nanos: i64| self.arm.position_at(nanos).ok_or(Error::NoHistory { nanos });
        let position_rad = position_at(stamp_nanos)?;
        let world_from_camera = camera.world_from_camera(&position_rad);
        let camera_from_world = world_from_camera.inverse();
        let mut shifts = Vec::new();
        for offset in camera.row_offsets_nanos() {
            let world_from_row = camera.world_from_camera(&position_at(stamp_nanos + offset)?);
            shifts.push(Shift::new(&(camera_from_world * world_from_row)));
        }
        // A wrist camera sees nothing of its arm; leaving it out keeps its shadow off the scene as well.
        let arm_rad = (camera.config.parent == Parent::World).then_some(position_rad);
        let view: render::View = camera.optics.view(world_from_camera, arm_rad);
        let n_skipped = std::mem::take(&mut camera.n_skipped);
        let picture = self.renderer.submit(view)?;
        self.slots.push_back(Slot::Image(Exposure {
            camera_ix,
            image_ix,
            stamp_nanos,
            arrival_nanos,
            n_skipped,
            world_from_camera,
            shifts,
            picture,
        }));
        self.n_pending += 1;
        if camera_ix == 0 {
            self.n_images += 1;
            self.has_ended = self.config.n_images.is_some_and(|n_images| self.n_images >= n_images);
        }
        Ok(())
    }

    /// Waits for the drawn picture and turns it into what the camera delivers.
    fn develop(&mut self, exposure: Exposure) -> Result<(), Error> {
        let camera = &self.cameras[exposure.camera_ix];
        let picture = exposure.picture.wait()?;
        let (seed, image_ix) = (self.config.seed, exposure.image_ix);
        let stamp = Stamp(self.start.0 + exposure.stamp_nanos);
        let image = |format: PixelFormat, data: Vec<u8>| Image {
            camera: Arc::clone(&camera.name),
            stamp,
            size_px: camera.config.intrinsics.size_px,
            format,
            data: data.into(),
            exposure_secs: Some(1e-6 * camera.sensor.exposure_micros),
            n_skipped: exposure.n_skipped,
        };
        let is_moving = !exposure.shifts.is_empty();
        let sharp = if self.config.truth || !is_moving { camera.optics.sharp(&picture) } else { Vec::new() };
        let moving = if is_moving { camera.optics.moving(&picture, &exposure.shifts) } else { Vec::new() };
        let seen = if is_moving { &moving } else { &sharp };
        let is_noisy = camera.sensor.noise_sigma > 0.0;
        let data = if is_noisy {
            noise::add_color_noise(seen, &camera.sensor, camera.random(seed, image_ix, COLOR_NOISE))
        } else {
            noise::to_bytes(seen)
        };
        let psnr_ceiling = (is_noisy && self.config.truth).then(|| noise::psnr(&data, seen));
        self.ready.push_back((exposure.arrival_nanos, Sample::Image(image(PixelFormat::Rgb8, data))));
        let wants_depth = camera.config.depth.is_some() || (self.config.truth && self.config.truth_depth);
        let depth_m = if wants_depth { camera.optics.depth_m(&picture) } else { Vec::new() };
        if let Some(depth) = &camera.config.depth {
            let width = camera.config.intrinsics.size_px[0] as usize;
            let random = camera.random(seed, image_ix, DEPTH_NOISE);
            let counts = noise::depth_counts(&depth_m, width, depth, random, self.config.ideal);
            let data = counts.iter().flat_map(|count| count.to_le_bytes()).collect();
            let format = PixelFormat::DepthU16 { metres_per_count: depth.metres_per_count };
            self.ready.push_back((exposure.arrival_nanos, Sample::Image(image(format, data))));
        }
        if self.config.truth {
            let depth_m = if self.config.truth_depth { depth_m } else { Vec::new() };
            let truth = TruthImage {
                image: image(PixelFormat::Rgb8, noise::to_bytes(&sharp)),
                depth_m: depth_m.into(),
                world_from_camera: exposure.world_from_camera,
                psnr_ceiling,
            };
            self.ready.push_back((exposure.arrival_nanos, Sample::Truth(truth)));
        }
        Ok(())
    }

    fn joint_state(&self, reading: &Reading) -> JointState {
        let ordered = |joints: &Joints| self.joint_ixs.iter().map(|ix| joints[*ix]).collect();
        JointState {
            stamp: Stamp(self.start.0 + reading.nanos),
            position: ordered(&reading.position_rad),
            velocity: ordered(&reading.velocity_rad_s),
            effort: ordered(&reading.torque_nm),
        }
    }
}
