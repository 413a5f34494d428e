//! The input side of a run: a thread reads the source, records and joins the samples, and corrects
//! base poses at stations. Keyframes are delivered through a bounded queue.

use crate::input_counts::InputCounts;
use crate::join::{Change, Join, JoinEvent, PosedImage};
use crate::live_pixels::live_pixels;
use crate::robot_motion::RobotMotion;
use crate::stamp_clock::StampClock;
use crate::stations::Stations;
use crate::stop::Stop;
use anyhow::{Context, anyhow};
use drivers::recording::Recorder;
use drivers::{Sample, Source};
use keyframe::{Keyframe, LiveImage, RangePoints, RangeScan, RobotState};
use kinematics::{Stamp, Transform};
use parking_lot::Mutex;
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Maximum number of keyframes that wait for the trainer. If the queue is full, the input thread
/// waits, and live devices drop and count images. With a longer queue, more memory is used and the
/// trainer receives keyframes later. With a shorter queue, the input would stop at each long step.
const MAX_WAITING: usize = 8;

/// Number of images whose arrival times are kept until they become keyframes. The number is larger
/// than the number of images that wait for a station.
const MAX_ARRIVALS: usize = 512;

/// When a keyframe passed the stages of the input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InputTimes {
    /// Mid-exposure of its image; `None` if the stamp is on another clock.
    pub captured: Option<Instant>,
    /// Its image was returned by the driver.
    pub arrived: Instant,
    /// It was accepted and queued for training.
    pub queued: Instant,
}

/// A change of the keyframes that comes out of a [`Feed`].
#[derive(Debug)]
pub struct FeedItem {
    /// The change.
    pub change: Change,
    /// Times of an accepted keyframe.
    pub times: Option<InputTimes>,
}

/// Receives the camera images and the motion of the robot from a running input. A viewer, for
/// example, shows them.
pub trait InputObserver: Send {
    /// Whether images are needed. If not, they are not decoded.
    fn needs_images(&self) -> bool;

    /// Receives an image.
    fn observe(&self, image: LiveImage);

    /// Whether the motion of the robot is needed.
    fn needs_robot(&self) -> bool;

    /// Receives the state of the robot.
    fn observe_robot(&self, robot: RobotState);

    /// Receives a keyframe when it is accepted, before it waits for the trainer.
    fn observe_keyframe(&self, _keyframe: &Arc<Keyframe>) {}

    /// Receives a scan of a range scanner.
    fn observe_range_scan(&self, scan: RangeScan);
}

/// State of the input that the run reads while the input thread runs.
#[derive(Debug, Default)]
struct Shared {
    first_image: OnceLock<Instant>,
    rejected: Mutex<BTreeMap<String, u64>>,
    source_failed: AtomicBool,
    source_ended: AtomicBool,
    counts: Mutex<InputCounts>,
}

/// The parts of the input.
pub struct Input {
    /// The open devices or recording.
    pub source: Box<dyn Source>,
    /// Makes keyframes from the samples.
    pub join: Join,
    /// Corrects base poses at stations, if the base moves.
    pub stations: Option<Stations>,
    /// Records all samples; `None` if the run is not recorded.
    pub recorder: Option<Recorder>,
    /// Follows the robot for viewers.
    pub robot_motion: RobotMotion,
    /// The clock of the stamps.
    pub stamp_clock: StampClock,
    /// Focal length and principal point of every camera, pixels.
    pub camera_intrinsics: HashMap<Arc<str>, ([f64; 2], [f64; 2])>,
}

/// Results of an input that has ended.
pub struct InputResult {
    /// The join with its keyframes and counts.
    pub join: Join,
    /// The stations with their reports, if the base moves.
    pub stations: Option<Stations>,
    /// Error that ended the input early.
    pub input_error: Option<drivers::Error>,
    /// Error that ended the recording early.
    pub recording_error: Option<anyhow::Error>,
}

/// The running input.
pub struct Feed {
    changes: Receiver<FeedItem>,
    shared: Arc<Shared>,
    thread: JoinHandle<InputResult>,
    ended: bool,
}

impl Feed {
    /// Starts reading `input`. The feed ends when the input ends, when `stop` is requested, or when
    /// the source fails.
    ///
    /// # Errors
    ///
    /// If no thread can be started.
    pub fn start(
        input: Input,
        observer: Box<dyn InputObserver>,
        stop: Stop,
    ) -> anyhow::Result<Self> {
        let (sender, changes) = sync_channel(MAX_WAITING);
        // A resumed run has keyframes before its first sample.
        let shared = Arc::new(Shared {
            counts: Mutex::new(InputCounts::of(&input.join)),
            ..Shared::default()
        });
        let pump = Pump {
            input,
            observer,
            stop,
            sender,
            shared: shared.clone(),
            arrivals: VecDeque::new(),
        };
        let thread = std::thread::Builder::new()
            .name("input".into())
            .spawn(|| pump.run())
            .context("cannot start a thread")?;
        Ok(Self {
            changes,
            shared,
            thread,
            ended: false,
        })
    }

    /// Time at which the first image arrived; `None` if none has arrived.
    #[must_use]
    pub fn first_image(&self) -> Option<Instant> {
        self.shared.first_image.get().copied()
    }

    /// Number of rejected images so far, by [`Rejection::name`](crate::Rejection::name).
    #[must_use]
    pub fn rejected(&self) -> BTreeMap<String, u64> {
        self.shared.rejected.lock().clone()
    }

    /// What happened to the images so far, and how full the store is.
    #[must_use]
    pub fn counts(&self) -> InputCounts {
        *self.shared.counts.lock()
    }

    /// Waits at most `timeout` for the next change. Returns `None` if none arrived or the input has
    /// ended.
    pub fn next(&mut self, timeout: Duration) -> Option<FeedItem> {
        match self.changes.recv_timeout(timeout) {
            Ok(item) => Some(item),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                self.ended = true;
                None
            }
        }
    }

    /// Whether the input ended and all its changes were taken.
    #[must_use]
    pub fn ended(&self) -> bool {
        self.ended
    }

    /// Whether the source has ended or failed. Its last keyframes may still wait in the queue.
    #[must_use]
    pub fn source_ended(&self) -> bool {
        self.shared.source_ended.load(Ordering::Relaxed)
    }

    /// Whether the source failed.
    #[must_use]
    pub fn source_failed(&self) -> bool {
        self.shared.source_failed.load(Ordering::Relaxed)
    }

    /// Ends the input and waits for its thread, which closes the recording.
    ///
    /// # Errors
    ///
    /// If the thread panicked, which is a bug.
    pub fn finish(self) -> anyhow::Result<InputResult> {
        // Wakes an input thread that is waiting to send.
        drop(self.changes);
        self.thread
            .join()
            .map_err(|_| anyhow!("the input thread panicked: this is a bug"))
    }
}

struct Pump {
    input: Input,
    observer: Box<dyn InputObserver>,
    stop: Stop,
    sender: SyncSender<FeedItem>,
    shared: Arc<Shared>,
    /// The latest color images: camera, stamp, and when the driver returned them.
    arrivals: VecDeque<(Arc<str>, Stamp, Instant)>,
}

/// The trainer has ended and accepts no more keyframes.
struct TrainerGone;

impl Pump {
    fn run(mut self) -> InputResult {
        let mut recording_error = None;
        let mut input_error = None;
        let mut n_restarts = 0;
        while !self.stop.requested() {
            let sample = match self.input.source.next_sample() {
                Ok(Some(sample)) => sample,
                Ok(None) => break,
                Err(error) => {
                    // The failure is reported at once, because training on the queued keyframes may
                    // take long.
                    self.shared.source_failed.store(true, Ordering::Relaxed);
                    log::warn!("the run ends, because a device failed: {error}");
                    input_error = Some(error);
                    break;
                }
            };
            // After a restart of the source, images from before the restart are decided first, with
            // the motion from before the restart. Only then is the first sample of the new round
            // joined.
            let is_restarted = self.input.source.n_restarts() > n_restarts;
            n_restarts = self.input.source.n_restarts();
            if is_restarted && self.restart().is_err() {
                break;
            }
            // The sample is recorded before the join, so that a replay gets exactly the samples
            // that the join received.
            self.record(&sample, &mut recording_error);
            self.remember_arrival(&sample);
            // Viewers get the readings at once. The join, in contrast, may hold images back for up
            // to its longest wait.
            self.publish_robot(&sample);
            // The stations are advanced by time as well. Otherwise, earlier keyframes would wait
            // forever if no more keyframes arrive.
            let newest = sample.stamp();
            let events = self.input.join.push(sample);
            let newest = self.input.join.shifted(newest);
            if self
                .forward(events)
                .and_then(|()| self.advance_to(newest))
                .is_err()
            {
                break;
            }
        }
        self.shared.source_ended.store(true, Ordering::Relaxed);
        // The input has ended. Images that are still waiting get a decision now, and a station is
        // registered with the keyframes received so far.
        let events = self.input.join.finish();
        // An error here means that the trainer has ended and needs no more keyframes.
        let _ = self.forward(events).and_then(|()| self.release_held());
        // A recording that failed before is not finished, so that its first error is reported.
        if let (Some(recorder), None) = (self.input.recorder.take(), &recording_error)
            && let Err(error) = recorder.finish()
        {
            recording_error = Some(error.into());
        }
        InputResult {
            join: self.input.join,
            stations: self.input.stations,
            input_error,
            recording_error,
        }
    }

    /// Records a sample. If the recording fails, for example because the disk is full, it ends, and
    /// the run continues.
    fn record(&mut self, sample: &Sample, recording_error: &mut Option<anyhow::Error>) {
        if recording_error.is_some() {
            return;
        }
        if let Some(recorder) = &mut self.input.recorder
            && let Err(error) = recorder.write(sample)
        {
            let error = anyhow::Error::from(error);
            log::error!("the recording ends here, the run continues: {error:#}");
            *recording_error = Some(error);
        }
    }

    /// Remembers when a color image arrived, for the times of its keyframe.
    fn remember_arrival(&mut self, sample: &Sample) {
        let Sample::Image(image) = sample else {
            return;
        };
        self.shared.first_image.get_or_init(Instant::now);
        if !image.is_depth() {
            self.arrivals
                .push_back((image.camera.clone(), image.stamp, Instant::now()));
            self.arrivals
                .drain(..self.arrivals.len().saturating_sub(MAX_ARRIVALS));
        }
    }

    /// Handles a restart of the source: finishes pending images and stations.
    fn restart(&mut self) -> Result<(), TrainerGone> {
        let events = self.input.join.restart();
        self.forward(events)?;
        let released = self.input.stations.as_mut().map(Stations::restart);
        self.send(released.unwrap_or_default())
    }

    fn forward(&mut self, events: Vec<JoinEvent>) -> Result<(), TrainerGone> {
        // The counts are updated before the keyframes are sent, because sending waits while the
        // trainer is busy.
        *self.shared.counts.lock() = InputCounts::of(&self.input.join);
        for event in events {
            match event {
                JoinEvent::Accepted(keyframe) => self.apply(Change::Accepted(keyframe))?,
                JoinEvent::Evicted { camera, stamp } => {
                    self.apply(Change::Evicted { camera, stamp })?
                }
                JoinEvent::PosedImage(posed_image) => self.publish_image(&posed_image),
                JoinEvent::RangeScan(scan) => self.publish_range_scan(scan),
                JoinEvent::Rejected { why, .. } => {
                    *self
                        .shared
                        .rejected
                        .lock()
                        .entry(why.name().to_owned())
                        .or_default() += 1;
                }
            }
        }
        Ok(())
    }

    fn apply(&mut self, change: Change) -> Result<(), TrainerGone> {
        let forwarded = match &mut self.input.stations {
            Some(stations) => stations.push(change),
            None => vec![change],
        };
        self.send(forwarded)
    }

    fn advance_to(&mut self, newest: Stamp) -> Result<(), TrainerGone> {
        let forwarded = self
            .input
            .stations
            .as_mut()
            .map(|stations| stations.advance_to(newest));
        self.send(forwarded.unwrap_or_default())
    }

    /// Releases the keyframes that wait for a station, because no more will come.
    fn release_held(&mut self) -> Result<(), TrainerGone> {
        let forwarded = self.input.stations.as_mut().map(Stations::finish);
        self.send(forwarded.unwrap_or_default())
    }

    fn send(&self, changes: Vec<Change>) -> Result<(), TrainerGone> {
        changes.into_iter().try_for_each(|change| {
            if let Change::Accepted(keyframe) = &change {
                self.observer.observe_keyframe(keyframe);
            }
            let times = self.times(&change);
            // This blocks while the queue is full, which gives the trainer back pressure on the
            // input.
            self.sender
                .send(FeedItem { change, times })
                .map_err(|_| TrainerGone)
        })
    }

    /// Times of an accepted keyframe. The stamp of the keyframe differs from that of its image by
    /// the offsets in the rig file. The image that is closest in time is therefore used.
    fn times(&self, change: &Change) -> Option<InputTimes> {
        let Change::Accepted(keyframe) = change else {
            return None;
        };
        let images = self
            .arrivals
            .iter()
            .filter(|(camera, ..)| *camera == keyframe.camera);
        let distance = |stamp: Stamp| self.input.join.shifted(stamp).0.abs_diff(keyframe.stamp.0);
        let &(_, stamp, arrived) = images.min_by_key(|(_, stamp, _)| distance(*stamp))?;
        let captured = self.input.stamp_clock.instant_of(stamp);
        Some(InputTimes {
            captured,
            arrived,
            queued: Instant::now(),
        })
    }

    /// Passes a camera image to the observer.
    fn publish_image(&self, posed_image: &PosedImage) {
        if !self.observer.needs_images() {
            return;
        }
        let image = &posed_image.image;
        // Only color images are posed; depth becomes a part of their keyframes. The join counts
        // images that do not decode.
        let Some(pixels) = live_pixels(image) else {
            return;
        };
        let Some(&(focal_px, principal_px)) = self.input.camera_intrinsics.get(&image.camera)
        else {
            return;
        };
        let pose = |stations: &Stations| {
            stations.corrected_pose(&image.camera, &posed_image.world_from_camera)
        };
        self.observer.observe(LiveImage {
            camera: image.camera.clone(),
            stamp: image.stamp,
            captured_at: self.input.stamp_clock.captured_at(image.stamp),
            size_px: image.size_px,
            pixels,
            world_from_camera: Some(
                self.input
                    .stations
                    .as_ref()
                    .map_or(posed_image.world_from_camera, pose),
            ),
            focal_px,
            principal_px,
        });
    }

    /// The current correction of reported base poses, by range scans or by stations.
    fn map_from_odom(&self) -> Transform {
        let stations = self.input.stations.as_ref();
        stations.map_or_else(
            || self.input.join.map_from_reported(),
            Stations::map_from_odom,
        )
    }

    /// Passes the state of the robot to the observer.
    fn publish_robot(&mut self, sample: &Sample) {
        let Some(mut state) = self
            .input
            .robot_motion
            .push(sample, &self.input.stamp_clock)
            .filter(|_| self.observer.needs_robot())
        else {
            return;
        };
        state.world_from_base = self.map_from_odom() * state.world_from_base;
        self.observer.observe_robot(state);
    }

    /// Passes a range scan to the observer.
    fn publish_range_scan(&self, scan: Arc<RangePoints>) {
        let stations = self.input.stations.as_ref();
        let map_from_odom = stations.map_or_else(Transform::identity, Stations::map_from_odom);
        self.observer.observe_range_scan(RangeScan {
            captured_at: self.input.stamp_clock.captured_at(scan.stamp),
            scan,
            map_from_odom,
        });
    }
}
