//! Records everything that the devices of a rig send.

use crate::config::{ArmDriver, BaseDriver, Override, Rig};
use crate::open::{self, Devices, Opened};
use crate::outputs::check_output_file;
use crate::stop::Stop;
use drivers::recording::{Recorder, Recording};
use drivers::{Image, Sample, Source};
use kinematics::Stamp;
use messages::{BadInput, InsufficientData, Setting};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Options of a recording.
#[derive(Clone, Debug)]
pub struct RecordPlan {
    /// The rig file.
    pub rig_file: PathBuf,
    /// The recording to write.
    pub out: PathBuf,
    /// Whether all devices are simulated.
    pub is_simulated: bool,
    /// Whether the simulation runs as fast as possible, without loss.
    pub is_lockstep: bool,
    /// Maximum device time, seconds.
    pub seconds: Option<f64>,
}

/// A recording that was written.
#[derive(Debug)]
pub struct WrittenRecording {
    /// Counts of its samples.
    pub recorded: Recorded,
    /// Descriptions of data that are missing.
    pub data_losses: Vec<String>,
}

/// Counts of what was recorded, serialized as the event `done`.
#[derive(Debug, Default, Serialize)]
pub struct Recorded {
    event: &'static str,
    /// Device time, seconds.
    pub seconds: f64,
    /// Color images.
    images: u64,
    depth_images: u64,
    /// Color images dropped by the devices, or because the disk was too slow. `dropped` has the
    /// counts per camera.
    images_dropped_by_devices: u64,
    dropped: BTreeMap<String, DroppedImages>,
    joint_states: u64,
    base_poses: u64,
    range_scans: u64,
    truths: u64,
    out: PathBuf,
}

/// Number of dropped images of one camera.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct DroppedImages {
    images: u64,
    depth_images: u64,
}

/// Why no more samples were recorded.
enum End {
    /// The time limit, the end of the devices, or a request to stop.
    Requested,
    /// A device failed.
    Device(drivers::Error),
    /// The file could not be written.
    Write(drivers::Error),
}

impl RecordPlan {
    /// Records until the time limit, the end of the devices, or a request to stop.
    ///
    /// * `on_sample`: receives the counts after each sample.
    ///
    /// # Errors
    ///
    /// If the rig file is invalid, the recording exists, a device fails, or no device sends
    /// anything.
    pub fn run(
        &self,
        stop: &Stop,
        on_sample: &mut dyn FnMut(&Recorded),
    ) -> anyhow::Result<WrittenRecording> {
        let mut overrides = Vec::new();
        if self.is_lockstep {
            overrides.push(Override::new("sim.lockstep", true));
        }
        let rig = Rig::load(&self.rig_file, &overrides)?;
        // These checks come before the devices are opened, because devices may take long to start.
        self.check_end(&rig)?;
        check_output_file(Setting::Out, &self.out)?;
        if self.out.exists() {
            let path = self.out.clone();
            return Err(drivers::Error::Exists { path }.into());
        }
        let devices = if self.is_simulated {
            Devices::Sim
        } else {
            Devices::Real
        };
        let meshes = open::meshes_to_record(&rig);
        let Opened {
            rig, mut source, ..
        } = open::rig(rig, devices)?;
        let mut recorder = open::recorder(&self.out, &rig, &meshes)?;
        let mut recorded = Recorded {
            event: "done",
            out: self.out.clone(),
            ..Recorded::default()
        };
        let mut data_losses = Vec::new();
        let mut input_error = None;
        let mut n_written = None;
        let end = self.take_samples(&mut *source, &mut recorder, &mut recorded, stop, on_sample);
        // After a write error, the file has ended already.
        let write_error = match end {
            End::Write(error) => Some(error),
            End::Device(error) => {
                input_error = Some(error);
                finish(recorder, &mut n_written)
            }
            End::Requested => finish(recorder, &mut n_written),
        };
        // After a write error, the file ends with its last complete chunk. The samples in the file
        // are therefore counted instead of the samples that were passed to the recorder.
        if let Some(error) = write_error {
            data_losses.push(format!("{:#}", anyhow::Error::new(error)));
            recorded = recorded.recount_from_file();
        }
        // The recording is closed before errors are returned, so that its data is complete.
        if let Some(error) = input_error {
            let finished = format!(
                "a device failed; {} contains the data up to that point",
                self.out.display()
            );
            return Err(anyhow::Error::new(error).context(finished));
        }
        // An empty file would wrongly look like a recording.
        if n_written == Some(0) {
            return Err(InsufficientData(format!(
                "no device sent any data, so {} was not written",
                self.out.display()
            ))
            .into());
        }
        data_losses.extend(recorded.data_losses());
        data_losses.extend(recorded.missing_devices(&rig));
        let n_dropped = source.n_other_samples_dropped();
        if n_dropped > 0 {
            data_losses.push(format!(
                "{n_dropped} joint states, base poses and range scans were dropped because the disk was too slow"
            ));
        }
        Ok(WrittenRecording {
            recorded,
            data_losses,
        })
    }

    /// Rejects a lockstep simulation without an end, because it would fill the disk.
    fn check_end(&self, rig: &Rig) -> Result<(), BadInput> {
        let is_endless =
            self.seconds.is_none() && rig.sim.duration_secs.is_none() && rig.sim.n_images.is_none();
        let is_simulated = self.is_simulated || rig.arm.driver == ArmDriver::Sim;
        if is_simulated && rig.sim.lockstep && is_endless {
            return Err(BadInput(format!(
                "a lockstep simulation without an end would fill the disk: limit it with {}",
                Setting::Seconds
            )));
        }
        Ok(())
    }

    /// Records samples until the end.
    fn take_samples(
        &self,
        source: &mut dyn Source,
        recorder: &mut Recorder,
        recorded: &mut Recorded,
        stop: &Stop,
        on_sample: &mut dyn FnMut(&Recorded),
    ) -> End {
        let mut first: Option<Stamp> = None;
        while !stop.requested() {
            let sample = match source.next_sample() {
                Ok(Some(sample)) => sample,
                Ok(None) => break,
                Err(error) => return End::Device(error),
            };
            // The limit counts device time, so that a slow simulation records as much as a fast
            // one.
            let since_first = sample.stamp().0 - first.get_or_insert(sample.stamp()).0;
            recorded.seconds = recorded.seconds.max(since_first as f64 * 1e-9);
            if self
                .seconds
                .is_some_and(|seconds| recorded.seconds > seconds)
            {
                break;
            }
            if let Err(error) = recorder.write(&sample) {
                return End::Write(error);
            }
            recorded.count(&sample);
            on_sample(recorded);
        }
        End::Requested
    }
}

/// Completes a recording. Sets the number of its samples, or returns the error.
fn finish(recorder: Recorder, n_written: &mut Option<u64>) -> Option<drivers::Error> {
    match recorder.finish() {
        Ok(span) => {
            *n_written = Some(span.n_samples);
            None
        }
        Err(error) => Some(error),
    }
}

impl Recorded {
    fn count(&mut self, sample: &Sample) {
        match sample {
            Sample::Image(image) => {
                self.depth_images += u64::from(image.is_depth());
                self.images += u64::from(!image.is_depth());
                self.count_dropped(image);
            }
            Sample::Joints(_) => self.joint_states += 1,
            Sample::Base(_) => self.base_poses += 1,
            Sample::Range(_) => self.range_scans += 1,
            Sample::Truth(_) => self.truths += 1,
            // Ground truth of the base is not counted, because it arrives with every base pose.
            Sample::BaseTruth(_) => {}
        }
    }

    fn count_dropped(&mut self, next: &Image) {
        if next.n_skipped == 0 {
            return;
        }
        let dropped = self.dropped.entry(next.camera.to_string()).or_default();
        if next.is_depth() {
            dropped.depth_images += next.n_skipped;
        } else {
            dropped.images += next.n_skipped;
            self.images_dropped_by_devices += next.n_skipped;
        }
    }

    /// Recounts from the file after a write error. The counts of dropped images are kept.
    fn recount_from_file(self) -> Self {
        let mut found = Self {
            event: self.event,
            out: self.out,
            ..Self::default()
        };
        let mut first: Option<Stamp> = None;
        if let Ok(mut recording) = Recording::open(&found.out) {
            while let Ok(Some(sample)) = recording.next_sample() {
                let since_first = sample.stamp().0 - first.get_or_insert(sample.stamp()).0;
                found.seconds = found.seconds.max(since_first as f64 * 1e-9);
                found.count(&sample);
            }
        }
        Self {
            dropped: self.dropped,
            images_dropped_by_devices: self.images_dropped_by_devices,
            ..found
        }
    }

    /// The counts in one line.
    #[must_use]
    pub fn summary(&self) -> String {
        let Self {
            images,
            depth_images,
            joint_states,
            base_poses,
            range_scans,
            ..
        } = self;
        let mut message = format!(
            "{images} color images, {depth_images} depth images, {joint_states} joint states"
        );
        for (n, what) in [(base_poses, "base poses"), (range_scans, "range scans")] {
            if *n > 0 {
                message.push_str(&format!(", {n} {what}"));
            }
        }
        message
    }

    /// Devices of the rig without recorded data.
    fn missing_devices(&self, rig: &Rig) -> Vec<String> {
        // A robot without joints, such as a base, sends no joint states.
        let has_arm = rig.arm.driver != ArmDriver::None && !rig.arm.joints.is_empty();
        let arm = (has_arm && self.joint_states == 0).then_some("joint state of the arm");
        let base = (rig.base.driver != BaseDriver::Fixed && self.base_poses == 0)
            .then_some("pose of the base");
        let images = (self.images == 0).then_some("image");
        [arm, base, images]
            .into_iter()
            .flatten()
            .map(|what| format!("no {what} was recorded"))
            .collect()
    }

    /// Dropped images, one message per camera.
    fn data_losses(&self) -> Vec<String> {
        self.dropped
            .iter()
            .map(|(camera, dropped)| {
                format!(
                    "camera {camera:?} dropped {} color and {} depth images",
                    dropped.images, dropped.depth_images
                )
            })
            .collect()
    }
}
