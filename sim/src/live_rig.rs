//! A rig in real time: devices behind the traits of `drivers`, fed by one thread.

use crate::Error;
use crate::contacts::ContactCounter;
use crate::engine::{Delivery, Engine};
use crate::handover::Handover;
use crate::rig_info::RigInfo;
use crate::steered_arm::{Controller, SteeredArm, SteeredLimits};
use crate::steered_base::SteeredBase;
use drivers::base_motion::MovableBase;
use drivers::{
    Arm, Base, BasePose, Camera, Devices, Image, PixelFormat, RangeScan, RangeScanner, Sample,
};
use kinematics::{Intrinsics, JointState, Stamp};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Queue length for the images of one camera.
const MAX_IMAGES: usize = 8;
/// Queue length for joint readings: one second.
const MAX_READINGS: usize = 1000;
/// Queue length for range scans.
const MAX_SCANS: usize = 20;
/// Queue length for the ground-truth images of a camera, which are large.
const MAX_TRUTH_IMAGES: usize = 8;
/// Delay beyond which the simulation skips images. With a smaller value, images are skipped after
/// short pauses of the computer. With a larger value, samples arrive later than those of a real
/// device.
const MAX_LATE: Duration = Duration::from_millis(50);
/// Lag of the simulation beyond which a device without samples counts as silent. A slow computer
/// may take many seconds to render an image.
const MAX_LAG: Duration = Duration::from_secs(120);

/// Simulated devices that deliver in real time.
pub struct LiveRig {
    /// Cameras in the order of the configuration, the arm, the base if it moves, and the scanners.
    pub devices: Devices,
    /// Ground truth of color images and base poses. If its queue is full, the oldest entry is
    /// dropped.
    pub truth: LiveTruth,
    /// True parameters of the rig.
    pub info: RigInfo,
}

/// Simulated devices in real time, with a base that an operator may drive, and its arm.
pub struct SteeredBaseRig {
    /// The devices.
    pub live: LiveRig,
    /// The arm on the base, if it is steered, too.
    pub arm: Option<SteeredArm>,
    /// The base, for the program.
    pub base: SteeredBase,
    /// The base, for the thread that drives it.
    pub driven: Box<dyn MovableBase>,
    /// Simulated time zero on the clock of this computer.
    pub start: Stamp,
}

/// Ground truth of the live devices.
pub struct LiveTruth {
    simulation: Arc<SimulationThread>,
}

impl LiveTruth {
    /// Returns the oldest queued ground truth without waiting. Base poses are returned before
    /// images.
    pub fn take(&self) -> Option<Sample> {
        let mut state = self.simulation.shared.state.lock();
        state
            .truth_poses
            .pop_front()
            .or_else(|| state.truth_images.pop_front())
    }
}

/// The simulation thread. It ends when the last device is dropped.
struct SimulationThread {
    shared: Arc<SharedQueues>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for SimulationThread {
    fn drop(&mut self) {
        // The thread checks the flag after each sample, so it ends soon.
        self.shared.state.lock().stop = true;
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

struct SharedQueues {
    state: Mutex<QueueState>,
    arrived: Condvar,
    clock: SimulationClock,
}

/// Relates simulated time to real time.
struct SimulationClock {
    /// Real time of simulated time zero.
    started: Instant,
    /// Simulated time until which the robot has moved, nanoseconds.
    time_nanos: Arc<AtomicI64>,
}

impl SimulationClock {
    /// By how much the simulation is late, if a slow computer is the likely cause.
    fn lag(&self) -> Option<Duration> {
        let simulated = u64::try_from(self.time_nanos.load(Ordering::Relaxed)).unwrap_or(0);
        let lag = self
            .started
            .elapsed()
            .saturating_sub(Duration::from_nanos(simulated));
        (lag > MAX_LATE && lag < MAX_LAG).then_some(lag)
    }
}

#[derive(Default)]
struct QueueState {
    /// One queue per camera.
    images: Vec<VecDeque<Image>>,
    /// Number of dropped color and depth images of each camera that are not yet reported.
    n_dropped: Vec<[u64; 2]>,
    readings: VecDeque<JointState>,
    poses: VecDeque<BasePose>,
    /// One queue per scanner.
    scans: Vec<VecDeque<RangeScan>>,
    truth_images: VecDeque<Sample>,
    truth_poses: VecDeque<Sample>,
    /// Why there are no more samples.
    end: Option<String>,
    stop: bool,
}

impl LiveRig {
    /// Starts a rig whose arm follows its tour.
    pub(crate) fn start(engine: Engine, info: RigInfo, start: Stamp) -> Result<Self, Error> {
        Self::start_with(engine, info, start, Instant::now(), None)
    }

    /// Starts a rig whose arm an operator may take over from its tour.
    pub(crate) fn start_steered(
        (mut engine, contacts): (Engine, Option<ContactCounter>),
        info: RigInfo,
        start: Stamp,
        limits: SteeredLimits<'_>,
    ) -> Result<(Self, SteeredArm), Error> {
        let position = engine.reported_joints()?;
        let handover = Handover::default();
        engine.hand_over_to(handover.clone())?;
        let n_contacts = contacts.as_ref().map(ContactCounter::n_contacts);
        engine.count_contacts(contacts);
        let started = Instant::now();
        let (controller, arm) =
            Controller::start(limits, &position, handover, started, n_contacts)?;
        let rig = Self::start_with(engine, info, start, started, Some(controller))?;
        Ok((rig, arm))
    }

    /// Starts a rig whose base an operator may take over from its tour.
    ///
    /// * `limits`: those of the arm on the base, if the operator may take it over, too.
    pub(crate) fn start_with_steered_base(
        (mut engine, contacts): (Engine, Option<ContactCounter>),
        info: RigInfo,
        limits: Option<SteeredLimits<'_>>,
    ) -> Result<SteeredBaseRig, Error> {
        let handover = Handover::default();
        let position = match limits {
            Some(_) => {
                let position = engine.reported_joints()?;
                engine.hand_over_to(handover.clone())?;
                position
            }
            None => Vec::new(),
        };
        let n_contacts = contacts.as_ref().map(ContactCounter::n_contacts);
        engine.count_contacts(contacts);
        let start = drivers::clock::now();
        let started = Instant::now();
        let path = engine.steer_base(start);
        let (controller, arm) = match limits {
            Some(limits) => {
                let counted = n_contacts.clone();
                let (controller, arm) =
                    Controller::start(limits, &position, handover, started, counted)?;
                (Some(controller), Some(arm))
            }
            None => (None, None),
        };
        Ok(SteeredBaseRig {
            driven: path.driven(),
            live: Self::start_with(engine, info, start, started, controller)?,
            arm,
            base: SteeredBase::new(path, n_contacts),
            start,
        })
    }

    fn start_with(
        engine: Engine,
        info: RigInfo,
        start: Stamp,
        started: Instant,
        controller: Option<Controller>,
    ) -> Result<Self, Error> {
        let names: Vec<Arc<str>> = info
            .cameras
            .iter()
            .map(|camera| camera.name.as_str().into())
            .collect();
        let state = QueueState {
            images: vec![VecDeque::new(); names.len()],
            n_dropped: vec![[0; 2]; names.len()],
            scans: vec![VecDeque::new(); info.scanner_names.len()],
            ..QueueState::default()
        };
        let shared = Arc::new(SharedQueues {
            state: Mutex::new(state),
            arrived: Condvar::new(),
            clock: SimulationClock {
                started,
                time_nanos: engine.time_nanos(),
            },
        });
        let thread = std::thread::Builder::new()
            .name("sim-live".to_owned())
            .spawn({
                let shared = Arc::clone(&shared);
                let scanner_names = info.scanner_names.clone();
                move || {
                    run_simulation(
                        engine,
                        &shared,
                        &DeviceNames {
                            cameras: names,
                            scanners: scanner_names,
                        },
                        start,
                    )
                }
            });
        let simulation = Arc::new(SimulationThread {
            shared,
            thread: Some(thread.map_err(Error::Thread)?),
        });
        let cameras = info.cameras.iter().enumerate().map(|(camera_ix, camera)| {
            Box::new(LiveCamera {
                simulation: Arc::clone(&simulation),
                camera_ix,
                name: camera.name.clone(),
                intrinsics: camera.intrinsics.clone(),
            }) as Box<dyn Camera>
        });
        let arm = LiveArm {
            _controller: controller,
            simulation: Arc::clone(&simulation),
            joint_names: info.joint_names.clone(),
        };
        let base = LiveBase {
            simulation: Arc::clone(&simulation),
        };
        let scanners = info
            .scanner_names
            .iter()
            .enumerate()
            .map(|(scanner_ix, name)| {
                Box::new(LiveScanner {
                    simulation: Arc::clone(&simulation),
                    scanner_ix,
                    name: name.clone(),
                }) as Box<dyn RangeScanner>
            });
        Ok(Self {
            devices: Devices {
                cameras: cameras.collect(),
                arm: (!info.joint_names.is_empty()).then(|| Box::new(arm) as Box<dyn Arm>),
                base: info
                    .has_moving_base
                    .then(|| Box::new(base) as Box<dyn Base>),
                scanners: scanners.collect(),
            },
            truth: LiveTruth { simulation },
            info,
        })
    }
}

/// Names of the devices, in the order of their queues.
struct DeviceNames {
    cameras: Vec<Arc<str>>,
    scanners: Vec<String>,
}

/// Delivers samples when they are due, until the rig ends or all devices are dropped. `start` is the
/// stamp of simulated time zero.
fn run_simulation(mut engine: Engine, shared: &SharedQueues, names: &DeviceNames, start: Stamp) {
    engine.set_start(start);
    let started = shared.clock.started;
    let end = loop {
        // If rendering is slower than real time, images are skipped. Joint readings then stay on
        // time, and delays do not add up.
        let skip_until = started.elapsed().saturating_sub(MAX_LATE);
        engine.skip_before(i64::try_from(skip_until.as_nanos()).unwrap_or(i64::MAX));
        match engine.next() {
            Ok(Some(delivery)) => {
                wait_until(started, delivery.0);
                if !shared.deliver(delivery, names) {
                    return;
                }
            }
            Ok(None) => break "the simulation reached its end".to_owned(),
            Err(error) => break error.to_string(),
        }
    };
    engine.end_control();
    // The end is set under the lock, so that a device that is about to wait cannot miss it.
    shared.state.lock().end = Some(end);
    shared.arrived.notify_all();
}

fn wait_until(started: Instant, nanos: i64) {
    let due = started + Duration::from_nanos(u64::try_from(nanos).unwrap_or(0));
    std::thread::sleep(due.saturating_duration_since(Instant::now()));
}

fn stream_ix(image: &Image) -> usize {
    usize::from(matches!(image.format, PixelFormat::DepthU16 { .. }))
}

impl SharedQueues {
    /// Queues a sample. Returns false once all devices are dropped.
    fn deliver(&self, (_, sample): Delivery, names: &DeviceNames) -> bool {
        let mut state = self.state.lock();
        match sample {
            Sample::Image(image) => {
                if let Some(camera_ix) = names.cameras.iter().position(|name| *name == image.camera)
                {
                    state.put_image(camera_ix, image);
                }
            }
            Sample::Joints(reading) => push_bounded(&mut state.readings, MAX_READINGS, reading),
            Sample::Base(pose) => push_bounded(&mut state.poses, MAX_READINGS, pose),
            Sample::Range(scan) => {
                if let Some(scanner_ix) = names
                    .scanners
                    .iter()
                    .position(|name| **name == *scan.scanner)
                {
                    push_bounded(&mut state.scans[scanner_ix], MAX_SCANS, scan);
                }
            }
            image @ Sample::Truth(_) => push_bounded(
                &mut state.truth_images,
                MAX_TRUTH_IMAGES * names.cameras.len(),
                image,
            ),
            pose @ Sample::BaseTruth(_) => push_bounded(&mut state.truth_poses, MAX_READINGS, pose),
        }
        // The lock is released before waiting devices are woken. Otherwise, they would block on it
        // at once.
        let is_running = !state.stop;
        drop(state);
        self.arrived.notify_all();
        is_running
    }

    /// Waits until `take` returns a value. Returns an error if nothing came in time or the rig has
    /// ended.
    ///
    /// * `device`: the device in the error if the simulation is late
    fn wait<T>(
        &self,
        device: &str,
        timeout: Duration,
        mut take: impl FnMut(&mut QueueState) -> Option<T>,
        timeout_error: impl FnOnce() -> drivers::Error,
    ) -> Result<T, drivers::Error> {
        let until = Instant::now() + timeout;
        let mut state = self.state.lock();
        loop {
            // Queued samples are delivered even after the end.
            if let Some(sample) = take(&mut state) {
                return Ok(sample);
            }
            if let Some(reason) = &state.end {
                return Err(drivers::Error::Simulation {
                    reason: reason.clone(),
                });
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(match self.clock.lag() {
                    Some(lag) => drivers::Error::SimulationLags {
                        device: device.to_owned(),
                        lag,
                    },
                    None => timeout_error(),
                });
            }
            self.arrived.wait_for(&mut state, left);
        }
    }
}

impl QueueState {
    /// Queues an image. If the queue is full, the camera's oldest image is dropped, and the next
    /// image of its kind reports it.
    fn put_image(&mut self, camera_ix: usize, mut image: Image) {
        let queue = &mut self.images[camera_ix];
        let n_dropped = &mut self.n_dropped[camera_ix];
        image.n_skipped += std::mem::take(&mut n_dropped[stream_ix(&image)]);
        queue.push_back(image);
        if queue.len() <= MAX_IMAGES {
            return;
        }
        // The newest images are kept, as the drivers of real cameras do. The loss is reported by
        // the next image of the same kind, because each kind has its own sequence.
        let Some(oldest) = queue.pop_front() else {
            return;
        };
        let n_newly_dropped = oldest.n_skipped + 1;
        match queue
            .iter_mut()
            .find(|image| stream_ix(image) == stream_ix(&oldest))
        {
            Some(next) => next.n_skipped += n_newly_dropped,
            None => n_dropped[stream_ix(&oldest)] += n_newly_dropped,
        }
    }
}

fn push_bounded<T>(queue: &mut VecDeque<T>, max: usize, item: T) {
    if queue.len() >= max {
        queue.pop_front();
    }
    queue.push_back(item);
}

struct LiveCamera {
    simulation: Arc<SimulationThread>,
    camera_ix: usize,
    name: String,
    intrinsics: Intrinsics,
}

impl Camera for LiveCamera {
    fn name(&self) -> &str {
        &self.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, drivers::Error> {
        let timeout_error = || drivers::Error::NoImage {
            camera: self.name.clone(),
            waited: timeout,
        };
        self.simulation.shared.wait(
            &format!("camera {:?}", self.name),
            timeout,
            |state| state.images[self.camera_ix].pop_front(),
            timeout_error,
        )
    }
}

struct LiveArm {
    /// Dropped first: the simulation must not wait for setpoints when it ends.
    _controller: Option<Controller>,
    simulation: Arc<SimulationThread>,
    joint_names: Vec<String>,
}

impl Arm for LiveArm {
    fn joint_names(&self) -> &[String] {
        &self.joint_names
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, drivers::Error> {
        let timeout_error = || drivers::Error::NoJoints { waited: timeout };
        self.simulation.shared.wait(
            "arm",
            timeout,
            |state| state.readings.pop_front(),
            timeout_error,
        )
    }
}

struct LiveBase {
    simulation: Arc<SimulationThread>,
}

impl Base for LiveBase {
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, drivers::Error> {
        let timeout_error = || drivers::Error::NoBasePose { waited: timeout };
        self.simulation.shared.wait(
            "base",
            timeout,
            |state| state.poses.pop_front(),
            timeout_error,
        )
    }
}

struct LiveScanner {
    simulation: Arc<SimulationThread>,
    scanner_ix: usize,
    name: String,
}

impl RangeScanner for LiveScanner {
    fn name(&self) -> &str {
        &self.name
    }

    fn next_scan(&mut self, timeout: Duration) -> Result<RangeScan, drivers::Error> {
        let timeout_error = || drivers::Error::NoScan {
            scanner: self.name.clone(),
            waited: timeout,
        };
        self.simulation.shared.wait(
            &format!("range scanner {:?}", self.name),
            timeout,
            |state| state.scans[self.scanner_ix].pop_front(),
            timeout_error,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The error of a device without samples, after this real and simulated time.
    fn error_after(real: Duration, simulated: Duration) -> String {
        let started = Instant::now().checked_sub(real);
        let nanos = i64::try_from(simulated.as_nanos()).expect("a short time");
        let shared = SharedQueues {
            state: Mutex::default(),
            arrived: Condvar::new(),
            clock: SimulationClock {
                started: started.expect("the computer has been on for longer"),
                time_nanos: Arc::new(AtomicI64::new(nanos)),
            },
        };
        let waited = Duration::ZERO;
        let silent = || drivers::Error::NoJoints { waited };
        let error = shared.wait("arm", waited, |state| state.readings.pop_front(), silent);
        error.expect_err("there are no samples").to_string()
    }

    #[test]
    fn a_late_simulation_is_not_a_silent_device() {
        let [short, hour] = [7, 3600].map(Duration::from_secs);
        let late = error_after(short, Duration::ZERO);
        assert!(late.contains("arm: the simulation lags "), "{late}");
        let silent = drivers::Error::NoJoints {
            waited: Duration::ZERO,
        };
        // A simulation in time, and one that no longer advances.
        for (real, simulated) in [(short, hour), (short + MAX_LAG, short)] {
            assert_eq!(error_after(real, simulated), silent.to_string());
        }
    }
}
