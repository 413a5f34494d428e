//! Steps the rig and creates samples in the order in which devices would deliver them.

use crate::arm::{JointReading, ReadingOrder, STEP_NANOS};
use crate::base::Drift;
use crate::cabinet_tour::light_frac;
use crate::commands::Commands;
use crate::config::{CameraConfig, Config, Parent, Scene, SensorConfig, StampConfig, TargetParent};
use crate::contacts::ContactCounter;
use crate::hand::Hand;
use crate::handover::Handover;
use crate::joints::Joints;
use crate::lidar::{self, RayCaster};
use crate::motors::{MotorHistory, MotorizedArm};
use crate::noise;
use crate::optics::{Optics, RowMotion};
use crate::random::RandomStream;
use crate::render::{Pending, Renderer};
use crate::robot::{Robot, RobotPose};
use crate::steered_base::BasePath;
use crate::{Error, render};
use drivers::{BasePose, Image, PixelFormat, RangeScan, Sample, TruthImage};
use kinematics::{JointState, Stamp, Transform};
use mujoco_rs::prelude::MjModel;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

/// Simulated arrival time of a sample, nanoseconds, and the sample.
pub(crate) type Delivery = (i64, Sample);

/// A running rig.
pub(crate) struct Engine {
    config: Config,
    /// Joint index of each value in a reading.
    joint_ixs: Vec<usize>,
    robot: Robot,
    drift: Drift,
    /// Ray caster. `None` without range scanners.
    rays: Option<RayCaster>,
    n_base_poses: u64,
    n_scans: Vec<u64>,
    cameras: Vec<Camera>,
    /// The targets that are moved by hand, each with the camera in front of which it is moved.
    hands: Vec<(CameraConfig, Hand)>,
    renderer: Renderer,
    /// Stamp of simulated time zero.
    start: Stamp,
    /// Counts contacts while commands move the arm or the base, if there is a counter.
    contacts: Option<ContactCounter>,
    /// Whether the robot moves ahead of its samples while images are rendered.
    looks_ahead: bool,
    /// Maximum number of images that are being rendered. When the maximum is reached, the engine
    /// waits for the oldest image before it submits another.
    max_pending: usize,
    /// Images that would arrive before this simulated time are skipped. The real-time loop sets the
    /// time when it is late.
    skip_before_nanos: i64,
    /// Simulated time until which the robot has moved, nanoseconds.
    time_nanos: Arc<AtomicI64>,
    slots: VecDeque<Slot>,
    n_pending: usize,
    ready: VecDeque<Delivery>,
    n_images: u64,
    has_ended: bool,
}

/// Next item to deliver.
enum Slot {
    Joints(JointReading),
    Image(Exposure),
    /// A base pose at a time in nanoseconds.
    Base(i64),
    /// A revolution of a scanner, with scanner index, revolution number, and start time in
    /// nanoseconds.
    Scan(usize, u64, i64),
}

struct Camera {
    name: Arc<str>,
    config: CameraConfig,
    sensor: SensorConfig,
    optics: Optics,
    /// Optics of a separate depth sensor, if any.
    depth_optics: Option<Optics>,
    ix: u64,
    n_exposed: u64,
    n_skipped: u64,
}

/// An image being rendered.
struct Exposure {
    camera_ix: usize,
    image_ix: u64,
    stamp_nanos: i64,
    arrival_nanos: i64,
    n_skipped: u64,
    world_from_camera: Transform,
    /// Camera poses at the exposure instants of the rows, relative to `world_from_camera`. The list
    /// is empty if all poses are the same.
    row_motions: Vec<RowMotion>,
    picture: Pending,
    depth_picture: Option<Pending>,
}

/// Time of the first exposure of the first camera. The first exposure is delayed, because the pose
/// of the camera needs joint readings from before the exposure.
const FIRST_NANOS: i64 = 50_000_000;
/// Additional delay of each further camera. The cameras have different delays, because cameras of a
/// real rig are not synchronized either.
const STAGGER_NANOS: i64 = 3_700_000;

/// Time between two checks for contacts. At the speeds of operators, a robot moves by a few
/// millimeters.
const CONTACT_CHECK_NANOS: i64 = 10 * STEP_NANOS;

/// Random number streams of one image.
const COLOR_NOISE: u64 = 1;
const DEPTH_NOISE: u64 = 2;
const DROP_STREAM: u64 = 3;
/// Random number stream of one scan.
const SCANS: u64 = 4;
/// Number of samples that wait to be delivered while the robot steps ahead: some seconds.
const MAX_WAITING_SLOTS: usize = 4096;

#[expect(
    clippy::cast_possible_truncation,
    reason = "times of a run in nanoseconds fit an i64"
)]
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
        // A camera that does not move, or exposes all rows at one instant, needs no margin around
        // its rendered images.
        let is_sharp = config.parent == Parent::World
            || (sensor.readout_micros <= 0.0 && sensor.blur_samples <= 1);
        let depth_sensor = config
            .depth
            .as_ref()
            .and_then(|depth| depth.sensor.as_ref());
        let depth_optics =
            depth_sensor.map(|sensor| Optics::with_lens(config, &sensor.intrinsics, 1, true));
        Ok(Self {
            depth_optics: depth_optics.transpose()?,
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

    /// The stamp that the camera reports for a mid-exposure at `nanos`.
    fn reported_nanos(&self, nanos: i64) -> i64 {
        let StampConfig {
            to_mid_exposure_secs,
            drift_frac,
        } = self.config.stamps;
        nanos + nanos_from_secs(drift_frac * nanos as f64 * 1e-9 - to_mid_exposure_secs)
    }

    /// Half of the time span over which the image's rows are exposed.
    fn half_span_nanos(&self) -> i64 {
        nanos_from_secs(0.5e-6 * (self.sensor.readout_micros + self.sensor.exposure_micros))
    }

    /// Time from the stamp to the arrival. It is long enough for the joint readings to cover the
    /// last row.
    fn delivery_delay_nanos(&self) -> i64 {
        self.half_span_nanos() + STEP_NANOS + nanos_from_secs(1e-3 * self.sensor.latency_millis)
    }

    /// Exposure instants relative to the stamp. The list has all instants of the first row, then
    /// all instants of the second row, and so on. It is empty if the camera is stationary or
    /// exposes all rows at the stamp.
    fn row_offsets_nanos(&self) -> Vec<i64> {
        let sensor = &self.sensor;
        if self.config.parent == Parent::World
            || (sensor.readout_micros <= 0.0 && sensor.blur_samples <= 1)
        {
            return Vec::new();
        }
        let [_, height] = self.config.intrinsics.size_px;
        let mut offsets = Vec::new();
        for row in 0..height {
            // The stamp is the mid-exposure of the middle row.
            let by_row = ((f64::from(row) + 0.5) / f64::from(height) - 0.5) * sensor.readout_micros;
            for sample in 0..sensor.blur_samples {
                let share = (f64::from(sample) + 0.5) / f64::from(sensor.blur_samples) - 0.5;
                offsets.push(nanos_from_secs(
                    1e-6 * (by_row + share * sensor.exposure_micros),
                ));
            }
        }
        offsets
    }

    fn world_from_camera(&self, robot: &RobotPose) -> Transform {
        world_from_camera_of(&self.config, robot)
    }

    /// View of the depth sensor, if it is separate from the color sensor.
    fn depth_view(
        &self,
        world_from_camera: &Transform,
        robot: Option<RobotPose>,
    ) -> Option<render::View> {
        let sensor = self.config.depth.as_ref()?.sensor.as_ref()?;
        Some(self.depth_optics.as_ref()?.view(
            world_from_camera * sensor.camera_from_depth,
            robot,
            1.0,
        ))
    }

    fn random(&self, seed: u64, image_ix: u64, stream: u64) -> RandomStream {
        RandomStream::new(seed, &[self.ix, image_ix, stream])
    }
}

/// Pose of a camera.
fn world_from_camera_of(camera: &CameraConfig, robot: &RobotPose) -> Transform {
    match camera.parent {
        Parent::Flange => robot.world_from_flange * camera.parent_from_camera,
        Parent::Base => robot.world_from_base * camera.parent_from_camera,
        Parent::World => camera.parent_from_camera,
    }
}

/// The targets that are moved by hand, in the order of the configuration.
fn hands(config: &Config) -> Result<Vec<(CameraConfig, Hand)>, Error> {
    let mut hands = Vec::new();
    for target in &config.targets {
        if let TargetParent::Hand { camera_ix } = target.parent {
            // `Config::check` has checked the index.
            let camera = config.cameras[camera_ix].clone();
            let hand = Hand::new(&camera, &target.target()?);
            hands.push((camera, hand));
        }
    }
    Ok(hands)
}

/// Time from the first exposure of a camera's image to its arrival.
fn longest_span_nanos(camera: &CameraConfig) -> i64 {
    let sensor = &camera.sensor;
    nanos_from_secs(
        1e-6 * (sensor.readout_micros + sensor.exposure_micros) + 1e-3 * sensor.latency_millis,
    )
}

/// Duration of the arm's history that cameras may request, nanoseconds.
pub(crate) fn history_nanos(config: &Config) -> i64 {
    config
        .cameras
        .iter()
        .map(longest_span_nanos)
        .max()
        .unwrap_or(0)
        + 10 * STEP_NANOS
}

/// Optics and counters of all cameras, created before the rest of the engine.
pub(crate) struct Cameras(Vec<Camera>);

impl Cameras {
    pub(crate) fn new(config: &Config) -> Result<Self, Error> {
        let cameras = config
            .cameras
            .iter()
            .enumerate()
            .map(|(ix, camera)| Camera::new(camera, ix, config.ideal));
        Ok(Self(cameras.collect::<Result<_, _>>()?))
    }

    /// Size that fits the rendered images of all cameras.
    pub(crate) fn largest_view_px(&self) -> [u32; 2] {
        let all = self
            .0
            .iter()
            .flat_map(|camera| std::iter::once(&camera.optics).chain(&camera.depth_optics));
        let sizes = all.map(Optics::view_size_px);
        sizes.fold([1, 1], |largest, size| {
            [largest[0].max(size[0]), largest[1].max(size[1])]
        })
    }
}

impl Engine {
    pub(crate) fn new(
        config: Config,
        robot: Robot,
        cameras: Cameras,
        renderer: Renderer,
        model: Arc<MjModel>,
    ) -> Result<Self, Error> {
        let [drift_m, drift_rad] = if config.ideal {
            [0.0; 2]
        } else {
            [config.base.drift_m, config.base.drift_rad]
        };
        Ok(Self {
            joint_ixs: config.joint_ixs()?,
            drift: Drift::new(config.seed, drift_m, drift_rad),
            rays: (!config.scanners.is_empty()).then(|| RayCaster::new(model)),
            n_base_poses: 0,
            n_scans: vec![0; config.scanners.len()],
            hands: hands(&config)?,
            config,
            robot,
            cameras: cameras.0,
            renderer,
            start: Stamp(0),
            contacts: None,
            looks_ahead: true,
            max_pending: 2,
            skip_before_nanos: i64::MIN,
            time_nanos: Arc::default(),
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

    /// The joint positions that the arm reports now.
    pub(crate) fn reported_joints(&mut self) -> Result<Vec<f64>, Error> {
        let position = self.robot.arm_mut().ok_or(Error::NoArm)?.position();
        let zero = Joints::zeros(position.len());
        let reading = JointReading {
            nanos: 0,
            position,
            velocity: zero.clone(),
            effort: zero,
        };
        Ok(self.joint_state(&reading).position)
    }

    /// Moves the arm by commands instead of the scan.
    pub(crate) fn follow_commands(&mut self, commands: Commands) -> Result<(), Error> {
        let order = self.reading_order();
        let arm = self.robot.arm_mut().ok_or(Error::NoArm)?;
        arm.follow_commands(commands, order);
        self.looks_ahead = false;
        Ok(())
    }

    /// Lets a controller take the arm over from its tour.
    pub(crate) fn hand_over_to(&mut self, handover: Handover) -> Result<(), Error> {
        let order = self.reading_order();
        let arm = self.robot.arm_mut().ok_or(Error::NoArm)?;
        arm.hand_over_to(handover, order);
        Ok(())
    }

    /// Lets an operator take the base over from its tour. Returns the path of the base. `start` is
    /// simulated time zero on the clock of the thread that drives it.
    pub(crate) fn steer_base(&mut self, start: Stamp) -> BasePath {
        let path = BasePath::new(start, *self.robot.motion());
        self.robot.steer_base(path.clone());
        path
    }

    /// Counts contacts while commands move the arm or the base, if there is a counter.
    pub(crate) fn count_contacts(&mut self, contacts: Option<ContactCounter>) {
        self.contacts = contacts;
    }

    /// Reports the end of the simulation to the controller of the arm.
    pub(crate) fn end_control(&mut self) {
        if let Some(arm) = self.robot.arm_mut() {
            arm.end_control();
        }
    }

    fn reading_order(&self) -> ReadingOrder {
        ReadingOrder {
            joint_ixs: self.joint_ixs.clone(),
            joint_offsets: self.config.joint_offsets.clone(),
        }
    }

    /// Moves the arm by emulated motors instead of the scan. `start` is the stamp of simulated time
    /// zero.
    pub(crate) fn follow_motors(
        &mut self,
        motors: MotorHistory,
        start: Stamp,
    ) -> Result<(), Error> {
        self.robot.arm_mut().ok_or(Error::NoArm)?;
        self.robot.follow_motors(MotorizedArm {
            motors,
            start,
            joint_ixs: self.joint_ixs.clone(),
            joint_offsets: self.config.joint_offsets.clone(),
        });
        self.looks_ahead = false;
        Ok(())
    }

    /// Sets the stamp of simulated time zero. Call before taking the first sample.
    pub(crate) fn set_start(&mut self, start: Stamp) {
        self.start = start;
    }

    /// Simulated time until which the robot has moved, nanoseconds. It advances with the engine.
    pub(crate) fn time_nanos(&self) -> Arc<AtomicI64> {
        Arc::clone(&self.time_nanos)
    }

    /// Skips images that arrive before a simulated time.
    pub(crate) fn skip_before(&mut self, nanos: i64) {
        self.skip_before_nanos = nanos;
    }

    /// Returns the next sample, or `None` at the end.
    pub(crate) fn next(&mut self) -> Result<Option<Delivery>, Error> {
        loop {
            if let Some(delivery) = self.ready.pop_front() {
                return Ok(Some(delivery));
            }
            while self.may_step() && !self.has_ended {
                self.step()?;
            }
            match self.slots.pop_front() {
                None => return Ok(None),
                Some(Slot::Joints(reading)) => {
                    return Ok(Some((
                        reading.nanos,
                        Sample::Joints(self.joint_state(&reading)),
                    )));
                }
                Some(Slot::Base(nanos)) => self.emit_base_pose(nanos),
                Some(Slot::Scan(scanner_ix, scan_ix, nanos)) => {
                    self.scan(scanner_ix, scan_ix, nanos)?
                }
                Some(Slot::Image(exposure)) => {
                    self.n_pending -= 1;
                    self.finish_image(exposure)?;
                }
            }
        }
    }

    /// Whether the robot may move before the next sample is delivered.
    fn may_step(&self) -> bool {
        if self.looks_ahead && !self.robot.is_commanded() {
            // While images are rendered, the processor steps the robot. A rig without cameras has
            // no images that would limit the steps.
            self.n_pending < self.max_pending && self.slots.len() < MAX_WAITING_SLOTS
        } else {
            // Commands apply to the samples that follow them, so the robot must not be ahead of
            // its samples.
            self.slots.is_empty()
        }
    }

    /// Moves the robot by one step and starts rendering the images that arrive by then.
    fn step(&mut self) -> Result<(), Error> {
        let (nanos, reading) = self.robot.step()?;
        self.time_nanos.store(nanos, Ordering::Relaxed);
        if self
            .config
            .duration_secs
            .is_some_and(|secs| nanos > nanos_from_secs(secs))
        {
            self.has_ended = true;
            return Ok(());
        }
        if let Some(contacts) = &mut self.contacts
            && nanos % CONTACT_CHECK_NANOS == 0
            && self.robot.is_commanded()
            && let Some(robot) = self.robot.at(nanos)
        {
            contacts.check(&robot);
        }
        // Slots keep the order of the arrivals. Readings come first, then base poses and scans,
        // then images whose readout has ended by now.
        self.slots.extend(reading.map(Slot::Joints));
        self.queue_base_and_scans(nanos);
        for camera_ix in 0..self.cameras.len() {
            while !self.has_ended
                && self.cameras[camera_ix].stamp_nanos()
                    + self.cameras[camera_ix].delivery_delay_nanos()
                    <= nanos
            {
                self.expose(camera_ix)?;
            }
        }
        Ok(())
    }

    /// Queues the poses of a moving base and the scanner revolutions that have ended by now.
    fn queue_base_and_scans(&mut self, nanos: i64) {
        let due = |n_done: u64, rate_hz: f64| nanos_from_secs(n_done as f64 / rate_hz);
        while self.config.has_moving_base()
            && due(self.n_base_poses, self.config.base.rate_hz) <= nanos
        {
            self.slots
                .push_back(Slot::Base(due(self.n_base_poses, self.config.base.rate_hz)));
            self.n_base_poses += 1;
        }
        for (scanner_ix, scanner) in self.config.scanners.iter().enumerate() {
            let n_scans = &mut self.n_scans[scanner_ix];
            // A revolution is delivered when it is complete.
            while FIRST_NANOS + due(*n_scans + 1, scanner.rate_hz) <= nanos {
                self.slots.push_back(Slot::Scan(
                    scanner_ix,
                    *n_scans,
                    FIRST_NANOS + due(*n_scans, scanner.rate_hz),
                ));
                *n_scans += 1;
            }
        }
    }

    /// Emits the base pose as reported by its SLAM system, and the ground truth.
    fn emit_base_pose(&mut self, nanos: i64) {
        let stamp = Stamp(self.start.0 + nanos);
        let truth = self.robot.world_from_base(nanos);
        let reported = self.drift.reported(&truth, self.robot.walked_frac(nanos));
        self.ready.push_back((
            nanos,
            Sample::Base(BasePose {
                stamp,
                world_from_base: reported,
            }),
        ));
        // Ground truth follows its sample. A reader that waits for the ground truth therefore gets
        // it as the next sample.
        if self.config.truth {
            self.ready.push_back((
                nanos,
                Sample::BaseTruth(BasePose {
                    stamp,
                    world_from_base: truth,
                }),
            ));
        }
    }

    fn scan(&mut self, scanner_ix: usize, scan_ix: u64, nanos: i64) -> Result<(), Error> {
        let scanner = &self.config.scanners[scanner_ix];
        let arrival_nanos = nanos + nanos_from_secs(1.0 / scanner.rate_hz);
        let Some(rays) = self
            .rays
            .as_mut()
            .filter(|_| arrival_nanos >= self.skip_before_nanos)
        else {
            return Ok(());
        };
        let robot = &self.robot;
        let random = RandomStream::new(self.config.seed, &[scanner_ix as u64, scan_ix, SCANS]);
        let world_from_base = |offset_nanos: i64| robot.world_from_base(nanos + offset_nanos);
        let points =
            lidar::scan_revolution(rays, scanner, self.config.ideal, random, world_from_base)?;
        let stamp = Stamp(self.start.0 + nanos);
        let scan = RangeScan {
            scanner: scanner.name.as_str().into(),
            stamp,
            points: points.into(),
        };
        self.ready.push_back((arrival_nanos, Sample::Range(scan)));
        Ok(())
    }

    /// Starts rendering a camera's next image, or drops it.
    fn expose(&mut self, camera_ix: usize) -> Result<(), Error> {
        let camera = &mut self.cameras[camera_ix];
        let image_ix = camera.n_exposed;
        let stamp_nanos = camera.stamp_nanos();
        let arrival_nanos = stamp_nanos + camera.delivery_delay_nanos();
        camera.n_exposed += 1;
        // Random numbers depend on the image and not on the order of events, so that dropping one
        // image does not change the noise of the others.
        let drop_sample = camera
            .random(self.config.seed, image_ix, DROP_STREAM)
            .unit(0);
        if drop_sample < camera.sensor.dropped_frac || arrival_nanos < self.skip_before_nanos {
            camera.n_skipped += 1;
            return Ok(());
        }
        let robot_at = |nanos: i64| self.robot.at(nanos).ok_or(Error::NoHistory { nanos });
        let robot = robot_at(stamp_nanos)?;
        let world_from_camera = camera.world_from_camera(&robot);
        let camera_from_world = world_from_camera.inverse();
        let world_from_boards: Vec<Transform> = self
            .hands
            .iter()
            .map(|(camera, hand)| {
                let camera_from_board = hand.camera_from_board(stamp_nanos as f64 * 1e-9);
                world_from_camera_of(camera, &robot) * camera_from_board
            })
            .collect();
        let mut row_motions = Vec::new();
        // The scene is rendered once, at the stamp. The poses of the rows are needed to move the
        // pixels to the positions at which each row sees them.
        for offset in camera.row_offsets_nanos() {
            let world_from_row = camera.world_from_camera(&robot_at(stamp_nanos + offset)?);
            row_motions.push(RowMotion::new(&(camera_from_world * world_from_row)));
        }
        // Images of cameras on the robot omit the robot and its shadow, but not a target that it
        // carries.
        let is_robot_visible = camera.config.parent == Parent::World;
        let robot = (is_robot_visible || self.config.has_carried_target()).then_some(robot);
        // Only a camera on the flange enters the cabinet, so only its images change with the lamps.
        let light_frac = match self.config.scene {
            Scene::MobileArm if !self.config.ideal && camera.config.parent == Parent::Flange => {
                light_frac(&world_from_camera, self.config.light_inside_frac)
            }
            _ => 1.0,
        };
        let view = render::View {
            is_robot_visible,
            world_from_boards: world_from_boards.clone(),
            ..camera
                .optics
                .view(world_from_camera, robot.clone(), light_frac)
        };
        let depth_view = camera.depth_view(
            &world_from_camera,
            robot.filter(|_| self.config.has_carried_target()),
        );
        let depth_view = depth_view.map(|view| render::View {
            world_from_boards,
            ..view
        });
        let n_skipped = std::mem::take(&mut camera.n_skipped);
        // Rendering continues on its thread while the robot moves on.
        let picture = self.renderer.submit(view)?;
        let depth_picture = depth_view
            .map(|view| self.renderer.submit(view))
            .transpose()?;
        self.slots.push_back(Slot::Image(Exposure {
            camera_ix,
            image_ix,
            stamp_nanos,
            arrival_nanos,
            n_skipped,
            world_from_camera,
            row_motions,
            picture,
            depth_picture,
        }));
        self.n_pending += 1;
        if camera_ix == 0 {
            self.n_images += 1;
            self.has_ended = self
                .config
                .n_images
                .is_some_and(|n_images| self.n_images >= n_images);
        }
        Ok(())
    }

    /// Waits for the rendered image and converts it to the image that the camera delivers.
    fn finish_image(&mut self, exposure: Exposure) -> Result<(), Error> {
        let camera = &self.cameras[exposure.camera_ix];
        let picture = exposure.picture.wait()?;
        let seed = self.config.seed;
        let image_ix = exposure.image_ix;
        let stamp = Stamp(self.start.0 + camera.reported_nanos(exposure.stamp_nanos));
        let depth_lens = camera
            .config
            .depth
            .as_ref()
            .and_then(|depth| Some(&depth.sensor.as_ref()?.intrinsics));
        let color_px = camera.config.intrinsics.size_px;
        let depth_px = depth_lens.map_or(color_px, |lens| lens.size_px);
        let image = |format: PixelFormat, data: Vec<u8>| Image {
            camera: Arc::clone(&camera.name),
            stamp,
            size_px: if matches!(format, PixelFormat::DepthU16 { .. }) {
                depth_px
            } else {
                color_px
            },
            format,
            data: data.into(),
            exposure_secs: Some(1e-6 * camera.sensor.exposure_micros),
            n_skipped: exposure.n_skipped,
        };
        // Color comes first. The image without motion is also the ground truth. Each of the two
        // images is computed only if it is needed, because both take most of the processor time.
        let is_moving = !exposure.row_motions.is_empty();
        let motion_free = if self.config.truth || !is_moving {
            camera.optics.motion_free(&picture)
        } else {
            Vec::new()
        };
        let motion_blurred = if is_moving {
            camera
                .optics
                .motion_blurred(&picture, &exposure.row_motions)
        } else {
            Vec::new()
        };
        let sensed = if is_moving {
            &motion_blurred
        } else {
            &motion_free
        };
        let is_noisy = camera.sensor.noise_sigma > 0.0;
        let data = if is_noisy {
            noise::add_color_noise(
                sensed,
                &camera.sensor,
                camera.random(seed, image_ix, COLOR_NOISE),
            )
        } else {
            noise::to_bytes(sensed)
        };
        // A perfect model of the scene cannot score better than this PSNR, because it cannot
        // predict the noise.
        let psnr_ceiling = (is_noisy && self.config.truth).then(|| noise::psnr(&data, sensed));
        self.ready.push_back((
            exposure.arrival_nanos,
            Sample::Image(image(PixelFormat::Rgb8, data)),
        ));
        // Then comes depth. If there is a separate depth sensor, depth is taken from the view of
        // that sensor. Otherwise, it is taken from the color view.
        let sensor_depth_m = match (&camera.depth_optics, exposure.depth_picture) {
            (Some(optics), Some(picture)) => Some(optics.depth_m(&picture.wait()?)),
            _ => None,
        };
        let needs_depth = (camera.config.depth.is_some() && sensor_depth_m.is_none())
            || (self.config.truth && self.config.truth_depth);
        let depth_m = if needs_depth {
            camera.optics.depth_m(&picture)
        } else {
            Vec::new()
        };
        if let Some(depth) = &camera.config.depth {
            let width = depth_px[0] as usize;
            let random = camera.random(seed, image_ix, DEPTH_NOISE);
            let sensed_m = sensor_depth_m.as_ref().unwrap_or(&depth_m);
            let counts = noise::depth_counts(sensed_m, width, depth, random, self.config.ideal);
            let data = counts
                .iter()
                .flat_map(|count| count.to_le_bytes())
                .collect();
            let format = PixelFormat::DepthU16 {
                meters_per_count: depth.meters_per_count,
            };
            self.ready
                .push_back((exposure.arrival_nanos, Sample::Image(image(format, data))));
        }
        // Ground truth comes last. It has the pose at the stamp, without noise and motion.
        if self.config.truth {
            let depth_m = if self.config.truth_depth {
                depth_m
            } else {
                Vec::new()
            };
            let truth = TruthImage {
                image: image(PixelFormat::Rgb8, noise::to_bytes(&motion_free)),
                depth_m: depth_m.into(),
                world_from_camera: exposure.world_from_camera,
                psnr_ceiling,
            };
            self.ready
                .push_back((exposure.arrival_nanos, Sample::Truth(truth)));
        }
        Ok(())
    }

    fn joint_state(&self, reading: &JointReading) -> JointState {
        let ordered =
            |joints: &Joints| -> Vec<f64> { self.joint_ixs.iter().map(|ix| joints[*ix]).collect() };
        let mut position = ordered(&reading.position);
        position
            .iter_mut()
            .zip(&self.config.joint_offsets)
            .for_each(|(position, offset)| *position -= offset);
        JointState {
            stamp: Stamp(self.start.0 + reading.nanos),
            position,
            velocity: ordered(&reading.velocity),
            effort: ordered(&reading.effort),
        }
    }
}
