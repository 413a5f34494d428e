//! Combines live devices into one source of samples. Each device has a thread and a bounded queue
//! to the caller.

use crate::{Arm, Base, Camera, Error, Image, RangeScanner, Sample, Source};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Queue capacity of a camera, in images. If the queue is full, the oldest image is dropped. At 30
/// Hz, eight images bridge a pause of the caller of a quarter of a second. A longer queue would
/// keep stale images of up to several megabytes each in memory.
const MAX_IMAGES: usize = 8;
/// Queue capacity for joint states and for base poses. The queue holds one second of samples at 1
/// kHz.
const MAX_JOINTS: usize = 1000;
/// Queue capacity of a range scanner, in scans. The queue holds two seconds of scans at the usual
/// rate of 10 Hz.
const MAX_SCANS: usize = 20;
/// A device that delivers no samples for this long causes an error. The limit must be longer than
/// the few seconds that some devices need to start. It should be short, so that an operator does
/// not wait long for the message.
const MAX_SILENCE: Duration = Duration::from_secs(5);
/// Duration of one wait on a device. It bounds the time until its thread notices that it has to
/// stop.
const POLL: Duration = Duration::from_millis(100);

/// The devices of a rig.
#[derive(Default)]
pub struct Devices {
    /// Cameras.
    pub cameras: Vec<Box<dyn Camera>>,
    /// The arm, if there is one.
    pub arm: Option<Box<dyn Arm>>,
    /// Source of base poses, if the base moves.
    pub base: Option<Box<dyn Base>>,
    /// Range scanners.
    pub scanners: Vec<Box<dyn RangeScanner>>,
}

/// A source that reads all devices of a rig, each in its own thread.
///
/// If the caller is too slow, the oldest samples of a device are dropped. [`Image::n_skipped`] of
/// the next image of the same kind counts the dropped images. [`Source::n_other_samples_dropped`]
/// counts all other dropped samples. A camera that waits for its caller is blocked instead.
///
/// The first error of a device ends the source, unless it was created with
/// [`LiveDevices::continuing_after_errors`]; [`Source::next_sample`] returns it once. If all cameras are played back from files, the source also ends at the end of the last file. All
/// samples that were read until then are returned first. Dropping the source stops the threads.
#[derive(Debug)]
pub struct LiveDevices {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    arrived: Condvar,
    /// Signaled when a sample was taken or the threads have to stop.
    taken: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// One queue per device.
    queues: Vec<VecDeque<Sample>>,
    /// Dropped images that are not reported yet, by device: color and depth.
    dropped: Vec<[u64; 2]>,
    n_other_samples_dropped: u64,
    /// Errors that the caller has not received.
    errors: VecDeque<Error>,
    /// Whether an error has ended the source.
    failed: bool,
    /// Whether the other devices are still read after an error.
    continues_after_errors: bool,
    n_running: usize,
    /// Number of cameras whose images have not ended.
    n_cameras: usize,
    /// Whether devices are no longer read. Queued samples may still be taken.
    stop: bool,
}

impl LiveDevices {
    /// Starts reading.
    ///
    /// # Errors
    ///
    /// If a thread cannot be started.
    pub fn new(devices: Devices) -> Result<Self, Error> {
        Self::start(devices, false)
    }

    /// Like [`LiveDevices::new`], but a device that fails does not end the source: its error is
    /// returned, and the other devices are still read. A silent device is also still read, and its
    /// error is returned again every few seconds, so that the caller never waits for long. The
    /// source ends when no device is left.
    ///
    /// # Errors
    ///
    /// If a thread cannot be started.
    pub fn continuing_after_errors(devices: Devices) -> Result<Self, Error> {
        Self::start(devices, true)
    }

    fn start(devices: Devices, continues_after_errors: bool) -> Result<Self, Error> {
        let Devices {
            cameras,
            arm,
            base,
            scanners,
        } = devices;
        let n_devices = cameras.len()
            + usize::from(arm.is_some())
            + usize::from(base.is_some())
            + scanners.len();
        let state = State {
            queues: vec![VecDeque::new(); n_devices],
            dropped: vec![[0; 2]; n_devices],
            n_running: n_devices,
            n_cameras: cameras.len(),
            continues_after_errors,
            ..State::default()
        };
        let mut live = Self {
            shared: Arc::new(Shared {
                state: Mutex::new(state),
                arrived: Condvar::new(),
                taken: Condvar::new(),
            }),
            threads: Vec::new(),
        };
        // Each device takes the queue with the index of its thread, so the number of queues is
        // known before the first thread starts.
        for camera in cameras {
            live.read_camera(camera)?;
        }
        if let Some(arm) = arm {
            live.read_arm(arm)?;
        }
        if let Some(base) = base {
            live.read_base(base)?;
        }
        for scanner in scanners {
            live.read_scanner(scanner)?;
        }
        Ok(live)
    }

    fn read_camera(&mut self, mut camera: Box<dyn Camera>) -> Result<(), Error> {
        let name = camera.name().to_owned();
        let timeout_error = move |waited| Error::NoImage {
            camera: name.clone(),
            waited,
        };
        let policy = QueuePolicy {
            capacity: MAX_IMAGES,
            blocks_device: camera.waits_for_caller(),
        };
        let device = format!("camera {:?}", camera.name());
        self.read(device, policy, timeout_error, move || {
            match camera.next_image(POLL) {
                Err(Error::Ended { .. }) => Ok(ReadOutcome::End),
                Err(Error::NoImage { .. }) => Ok(ReadOutcome::NoSample),
                // The driver has its own time limit for reconnecting, and a file has its own clock.
                Err(
                    Error::Reconnecting { .. }
                    | Error::NotDue { .. }
                    | Error::SimulationLags { .. },
                ) => Ok(ReadOutcome::Pending),
                image => image.map(Sample::Image).map(ReadOutcome::Sample),
            }
        })
    }

    fn read_arm(&mut self, mut arm: Box<dyn Arm>) -> Result<(), Error> {
        let timeout_error = |waited| Error::NoJoints { waited };
        let policy = QueuePolicy::drop_oldest(MAX_JOINTS);
        self.read("arm".to_owned(), policy, timeout_error, move || {
            match arm.read(POLL) {
                Err(Error::NoJoints { .. }) => Ok(ReadOutcome::NoSample),
                // The driver has its own time limit for reconnecting.
                Err(Error::ArmReconnecting { .. } | Error::SimulationLags { .. }) => {
                    Ok(ReadOutcome::Pending)
                }
                state => state.map(Sample::Joints).map(ReadOutcome::Sample),
            }
        })
    }

    fn read_base(&mut self, mut base: Box<dyn Base>) -> Result<(), Error> {
        let timeout_error = |waited| Error::NoBasePose { waited };
        let policy = QueuePolicy::drop_oldest(MAX_JOINTS);
        self.read(
            "base".to_owned(),
            policy,
            timeout_error,
            move || match base.next_pose(POLL) {
                Err(Error::NoBasePose { .. }) => Ok(ReadOutcome::NoSample),
                Err(Error::SimulationLags { .. }) => Ok(ReadOutcome::Pending),
                pose => pose.map(Sample::Base).map(ReadOutcome::Sample),
            },
        )
    }

    fn read_scanner(&mut self, mut scanner: Box<dyn RangeScanner>) -> Result<(), Error> {
        let name = scanner.name().to_owned();
        let timeout_error = move |waited| Error::NoScan {
            scanner: name.clone(),
            waited,
        };
        let policy = QueuePolicy::drop_oldest(MAX_SCANS);
        let device = format!("range scanner {:?}", scanner.name());
        self.read(device, policy, timeout_error, move || {
            match scanner.next_scan(POLL) {
                Err(Error::NoScan { .. }) => Ok(ReadOutcome::NoSample),
                Err(Error::SimulationLags { .. }) => Ok(ReadOutcome::Pending),
                scan => scan.map(Sample::Range).map(ReadOutcome::Sample),
            }
        })
    }

    /// Starts the thread of the next device.
    fn read(
        &mut self,
        device: String,
        policy: QueuePolicy,
        timeout_error: impl Fn(Duration) -> Error + Send + 'static,
        read: impl FnMut() -> Result<ReadOutcome, Error> + Send + 'static,
    ) -> Result<(), Error> {
        let device_ix = self.threads.len();
        self.spawn(device, move |shared| {
            read_until_stopped(shared, device_ix, policy, read, timeout_error)
        })
    }

    fn spawn(
        &mut self,
        device: String,
        read: impl FnOnce(&Shared) + Send + 'static,
    ) -> Result<(), Error> {
        let shared = Arc::clone(&self.shared);
        let thread = std::thread::Builder::new()
            .name(device.clone())
            .spawn(move || {
                read(&shared);
                // This is also done after an error or at the end of a file, so that the caller does
                // not wait for a device that no longer delivers samples.
                shared.state.lock().n_running -= 1;
                shared.arrived.notify_all();
            });
        self.threads
            .push(thread.map_err(|source| Error::Thread { device, source })?);
        Ok(())
    }
}

/// Policy of the queue between a device and the caller.
#[derive(Clone, Copy)]
struct QueuePolicy {
    capacity: usize,
    /// Whether the device waits if the queue is full. If not, its oldest sample is dropped.
    blocks_device: bool,
}

impl QueuePolicy {
    fn drop_oldest(capacity: usize) -> Self {
        Self {
            capacity,
            blocks_device: false,
        }
    }
}

/// Result of one wait on a device.
enum ReadOutcome {
    Sample(Sample),
    /// The device is connected but sent nothing.
    NoSample,
    /// The driver is trying to reconnect for a limited time, the next image of a file is not due
    /// yet, or a simulation is late.
    Pending,
    /// The file has ended.
    End,
}

/// Thread function of a device. `read` waits for [`POLL`].
fn read_until_stopped(
    shared: &Shared,
    device_ix: usize,
    policy: QueuePolicy,
    mut read: impl FnMut() -> Result<ReadOutcome, Error>,
    timeout_error: impl Fn(Duration) -> Error,
) {
    let mut waited = Duration::ZERO;
    loop {
        // The device is read without the lock, so that the devices do not wait for each other.
        let sample = read();
        let mut state = shared.state.lock();
        if state.stop {
            return;
        }
        let error = match sample {
            Ok(ReadOutcome::Sample(sample)) => {
                waited = Duration::ZERO;
                // Without this wait, most images of a file that is read as fast as possible would
                // be dropped.
                while policy.blocks_device
                    && state.queues[device_ix].len() >= policy.capacity
                    && !state.stop
                {
                    shared.taken.wait(&mut state);
                }
                state.put(device_ix, policy.capacity, sample);
                shared.arrived.notify_all();
                continue;
            }
            Ok(ReadOutcome::End) => {
                state.n_cameras -= 1;
                // The samples of arm and base never end. They are useless once there are no more
                // images.
                state.stop |= state.n_cameras == 0;
                return;
            }
            Ok(ReadOutcome::Pending) => {
                waited = Duration::ZERO;
                continue;
            }
            Ok(ReadOutcome::NoSample) if waited + POLL < MAX_SILENCE => {
                waited += POLL;
                continue;
            }
            Ok(ReadOutcome::NoSample) if state.continues_after_errors => {
                state.fail(timeout_error(waited + POLL));
                shared.arrived.notify_all();
                waited = Duration::ZERO;
                continue;
            }
            Ok(ReadOutcome::NoSample) => timeout_error(waited + POLL),
            Err(error) => error,
        };
        state.fail(error);
        return;
    }
}

impl State {
    /// Reports that a device has failed.
    fn fail(&mut self, error: Error) {
        if self.continues_after_errors {
            self.errors.push_back(error);
        } else if !self.failed {
            // Only the first error is reported, because later ones often have the same cause. For
            // example, two devices may be connected to the same unplugged hub.
            self.failed = true;
            self.errors.push_back(error);
        }
    }

    /// Queues a sample. If the queue is full, the oldest sample of this device is dropped and
    /// counted.
    fn put(&mut self, device_ix: usize, capacity: usize, mut sample: Sample) {
        if self.queues[device_ix].len() >= capacity {
            match self.queues[device_ix].pop_front() {
                Some(Sample::Image(dropped_image)) => {
                    self.report_dropped(device_ix, &dropped_image, &mut sample)
                }
                Some(_) => self.n_other_samples_dropped += 1,
                None => {}
            }
        }
        self.queues[device_ix].push_back(sample);
    }

    /// Adds a dropped image and the images dropped before it to the count of the next image of its
    /// kind.
    fn report_dropped(&mut self, device_ix: usize, dropped_image: &Image, newest: &mut Sample) {
        let same_kind = |sample: &&mut Sample| matches!(sample, Sample::Image(image) if image.is_depth() == dropped_image.is_depth());
        // The next image of the same kind that is still delivered contains the count. The count
        // thus appears at the gap, and dropped color and depth images are counted separately.
        let pending = &mut self.dropped[device_ix][usize::from(dropped_image.is_depth())];
        *pending += dropped_image.n_skipped + 1;
        if let Some(Sample::Image(next)) = self.queues[device_ix]
            .iter_mut()
            .chain(std::iter::once(newest))
            .find(same_kind)
        {
            next.n_skipped += std::mem::take(pending);
        }
    }

    /// Removes the oldest queued sample of all devices.
    fn take(&mut self) -> Option<Sample> {
        // Each queue is in stamp order, so the oldest sample of all is at the head of a queue. If
        // stamps are equal, the index decides, so that the result is always the same.
        let heads = self
            .queues
            .iter()
            .enumerate()
            .filter_map(|(ix, queue)| Some((queue.front()?.stamp(), ix)));
        let (_, device_ix) = heads.min()?;
        self.queues[device_ix].pop_front()
    }
}

impl Source for LiveDevices {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        let mut state = self.shared.state.lock();
        loop {
            // The error is returned before queued samples. The samples are useless without the
            // device, and waiting would delay the message.
            if let Some(error) = state.errors.pop_front() {
                return Err(error);
            }
            if let Some(sample) = state.take() {
                self.shared.taken.notify_all();
                return Ok(Some(sample));
            }
            if state.failed || state.stop || state.n_running == 0 {
                return Ok(None);
            }
            self.shared.arrived.wait(&mut state);
        }
    }

    fn n_other_samples_dropped(&self) -> u64 {
        self.shared.state.lock().n_other_samples_dropped
    }
}

impl Drop for LiveDevices {
    fn drop(&mut self) {
        // Threads that wait for space in a queue are woken; the others notice it after at most
        // `POLL`.
        self.shared.state.lock().stop = true;
        self.shared.taken.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has already printed its message and has stopped.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PixelFormat;
    use kinematics::{Intrinsics, JointState, Lens, Stamp};

    /// A camera that delivers numbered images without delay, then fails.
    struct FastCamera {
        intrinsics: Intrinsics,
        n_images: i64,
        next: i64,
    }

    impl Camera for FastCamera {
        fn name(&self) -> &str {
            "fast"
        }
        fn intrinsics(&self) -> &Intrinsics {
            &self.intrinsics
        }
        fn next_image(&mut self, _timeout: Duration) -> Result<Image, Error> {
            if self.next == self.n_images {
                return Err(Error::Simulation {
                    reason: "cable pulled".into(),
                });
            }
            self.next += 1;
            Ok(image(self.next, self.next % 2 == 0))
        }
    }

    fn image(stamp: i64, depth: bool) -> Image {
        let format = if depth {
            PixelFormat::DepthU16 {
                meters_per_count: 1e-3,
            }
        } else {
            PixelFormat::Gray8
        };
        Image {
            camera: "fast".into(),
            stamp: Stamp(stamp),
            size_px: [1, 1],
            format,
            data: [0].into(),
            exposure_secs: None,
            n_skipped: 0,
        }
    }

    const LENS: Intrinsics = Intrinsics {
        size_px: [1, 1],
        focal_px: [1.0; 2],
        principal_px: [0.5; 2],
        lens: Lens::Pinhole,
        rectified: true,
    };

    fn fast_camera(n_images: i64) -> Box<dyn Camera> {
        Box::new(FastCamera {
            intrinsics: LENS,
            n_images,
            next: 0,
        })
    }

    struct SlowArm {
        next: i64,
    }

    impl Arm for SlowArm {
        fn joint_names(&self) -> &[String] {
            &[]
        }
        fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
            if self.next == 3 {
                std::thread::sleep(timeout);
                return Err(Error::NoJoints { waited: timeout });
            }
            self.next += 1;
            Ok(JointState {
                stamp: Stamp(self.next),
                position: vec![],
                velocity: vec![],
                effort: vec![],
            })
        }
    }

    #[test]
    fn slow_caller_gets_newest_images_and_drop_counts() {
        let mut live = LiveDevices::new(Devices {
            cameras: vec![fast_camera(101)],
            ..Devices::default()
        })
        .expect("threads start");
        while live.shared.state.lock().n_running > 0 {
            std::thread::yield_now();
        }
        // Errors are returned first, before samples that the failed device has sent earlier.
        assert!(
            live.next_sample()
                .expect_err("the cable")
                .to_string()
                .contains("cable pulled")
        );
        let mut stamps = Vec::new();
        let mut n_skipped = [0; 2];
        while let Some(Sample::Image(image)) =
            live.next_sample().expect("the error is returned only once")
        {
            stamps.push(image.stamp.0);
            n_skipped[usize::from(image.is_depth())] += image.n_skipped;
        }
        assert_eq!(stamps, (94..=101).collect::<Vec<_>>());
        assert_eq!(
            n_skipped,
            [47, 46],
            "51 color images with 4 delivered, 50 depth images with 4 delivered"
        );
    }

    #[test]
    fn other_devices_are_read_after_one_has_failed_or_is_silent() {
        let devices = Devices {
            cameras: vec![fast_camera(0)],
            arm: Some(Box::new(SlowArm { next: 0 })),
            ..Devices::default()
        };
        let mut live = LiveDevices::continuing_after_errors(devices).expect("threads start");
        let mut n_joint_states = 0;
        let mut errors = Vec::new();
        // The camera fails at once. The arm sends three states, is then silent, and is still read.
        while errors.len() < 2 || n_joint_states < 3 {
            match live.next_sample() {
                Ok(Some(Sample::Joints(_))) => n_joint_states += 1,
                Ok(_) => panic!("the source must not end, and only the arm sends samples"),
                Err(error) => errors.push(error.to_string()),
            }
        }
        assert!(errors[0].contains("cable pulled"), "{errors:?}");
        let silent = Error::NoJoints {
            waited: MAX_SILENCE,
        }
        .to_string();
        assert_eq!(errors[1], silent);
        assert_eq!(
            live.shared.state.lock().n_running,
            1,
            "the arm is still read"
        );
    }

    /// A camera that reports why it has no image, for longer than the silence limit. It returns
    /// without waiting.
    struct LateCamera {
        camera: FastCamera,
        reason: fn(Duration) -> Error,
        n_tries: u32,
    }

    impl Camera for LateCamera {
        fn name(&self) -> &str {
            self.camera.name()
        }
        fn intrinsics(&self) -> &Intrinsics {
            self.camera.intrinsics()
        }
        fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
            self.n_tries += 1;
            if self.n_tries <= 100 {
                return Err((self.reason)(timeout * self.n_tries));
            }
            self.camera.next_image(timeout)
        }
    }

    #[test]
    fn reconnecting_cameras_and_late_simulations_do_not_time_out() {
        let reasons: [fn(Duration) -> Error; 2] = [
            |waited| Error::Reconnecting {
                camera: "fast".into(),
                waited,
            },
            |lag| Error::SimulationLags {
                device: "fast".into(),
                lag,
            },
        ];
        for reason in reasons {
            let camera = LateCamera {
                camera: FastCamera {
                    intrinsics: LENS,
                    n_images: 1,
                    next: 0,
                },
                reason,
                n_tries: 0,
            };
            let devices = Devices {
                cameras: vec![Box::new(camera)],
                ..Devices::default()
            };
            let mut live = LiveDevices::new(devices).expect("threads start");
            while live.shared.state.lock().n_running > 0 {
                std::thread::yield_now();
            }
            // After ten seconds, the image arrives. The error follows it.
            assert!(
                live.next_sample()
                    .expect_err("the cable")
                    .to_string()
                    .contains("cable pulled")
            );
            assert_eq!(
                live.next_sample()
                    .expect("the error is returned only once")
                    .expect("an image")
                    .stamp(),
                Stamp(1)
            );
        }
    }

    /// A camera that is played back from a file as fast as possible.
    struct FileCamera(FastCamera);

    impl Camera for FileCamera {
        fn name(&self) -> &str {
            "recorded"
        }
        fn intrinsics(&self) -> &Intrinsics {
            self.0.intrinsics()
        }
        fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
            if self.0.next == self.0.n_images {
                return Err(Error::Ended {
                    camera: "recorded".into(),
                });
            }
            self.0.next_image(timeout)
        }
        fn waits_for_caller(&self) -> bool {
            true
        }
    }

    #[test]
    fn file_camera_blocks_for_slow_caller_and_ends_source() {
        let n_images = 5 * i64::try_from(MAX_IMAGES).expect("a small number");
        let camera = FileCamera(FastCamera {
            intrinsics: LENS,
            n_images,
            next: 0,
        });
        // The arm never ends.
        let arm: Box<dyn Arm> = Box::new(SlowArm { next: 0 });
        let devices = Devices {
            cameras: vec![Box::new(camera)],
            arm: Some(arm),
            ..Devices::default()
        };
        let mut live = LiveDevices::new(devices).expect("threads start");
        let mut stamps = Vec::new();
        while let Some(sample) = live.next_sample().expect("the end is not an error") {
            if let Sample::Image(image) = sample {
                assert_eq!(image.n_skipped, 0);
                stamps.push(image.stamp.0);
            }
        }
        assert_eq!(stamps, (1..=n_images).collect::<Vec<_>>());
    }

    #[test]
    fn joints_arrive_in_stamp_order_and_drop_stops_threads() {
        let mut live = LiveDevices::new(Devices {
            arm: Some(Box::new(SlowArm { next: 0 })),
            ..Devices::default()
        })
        .expect("threads start");
        let stamps: Vec<_> = (0..3)
            .map(|_| {
                live.next_sample()
                    .expect("alive")
                    .expect("three joint states")
                    .stamp()
            })
            .collect();
        assert_eq!(stamps, [Stamp(1), Stamp(2), Stamp(3)]);
        let shared = Arc::clone(&live.shared);
        drop(live);
        assert_eq!(shared.state.lock().n_running, 0);
    }

    #[test]
    fn maximum_silence_is_documented() {
        let row = format!(
            "| devices that send over UDP | {} s |",
            MAX_SILENCE.as_secs()
        );
        assert!(include_str!("../../docs/reference/rig.md").contains(&row));
    }

    #[test]
    fn samples_of_multiple_devices_are_merged_by_stamp() {
        let mut state = State {
            queues: vec![VecDeque::new(); 2],
            dropped: vec![[0; 2]; 2],
            ..State::default()
        };
        for stamp in [2, 5] {
            state.put(0, 8, Sample::Image(image(stamp, false)));
        }
        for stamp in [1, 3, 4] {
            state.put(1, 8, Sample::Image(image(stamp, true)));
        }
        let order: Vec<_> = std::iter::from_fn(|| state.take())
            .map(|sample| sample.stamp().0)
            .collect();
        assert_eq!(order, [1, 2, 3, 4, 5]);
    }
}
