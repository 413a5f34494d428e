//! `fieldrig record`: writes everything that the devices send to a recording.

use super::number_in_range;
use crate::exit::{self, Exit};
use crate::permission_args::PermissionArgs;
use crate::{print, signals};
use capture::config::{ArmDriver, BaseDriver, Override, Rig};
use capture::open::{self, Devices, Opened};
use drivers::recording::Recording;
use drivers::{Image, Sample, Source};
use kinematics::Stamp;
use messages::{BadInput, InsufficientData};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Flags of `record`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: cameras and arm (TOML)
    rig_file: PathBuf,
    /// MCAP file to write; Foxglove and Lichtblick can open it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Simulate all devices of the rig file
    #[arg(long)]
    sim: bool,
    /// Simulate as fast as possible, without loss [default: real time]
    #[arg(long, requires = "sim")]
    lockstep: bool,
    /// Stop after S seconds of device time [default: until Ctrl-C or until the devices end;
    /// required with --lockstep, unless the rig file ends the simulation]
    #[arg(long, value_name = "S", value_parser = number_in_range(0.1..=1e7))]
    seconds: Option<f64>,
    #[command(flatten)]
    pub(crate) permissions: PermissionArgs,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Counts of what was recorded.
#[derive(Debug, Default, Serialize)]
struct Recorded {
    event: &'static str,
    seconds: f64,
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
            // Not counted, because one arrives with every base pose.
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

    fn summary(&self) -> String {
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
        let arm = (rig.arm.driver != ArmDriver::None && self.joint_states == 0)
            .then_some("joint state of the arm");
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

/// Rejects a lockstep simulation without an end, because it would fill the disk.
fn check_end(args: &Args, rig: &Rig) -> Result<(), BadInput> {
    let is_endless =
        args.seconds.is_none() && rig.sim.duration_secs.is_none() && rig.sim.n_images.is_none();
    let is_simulated = args.sim || rig.arm.driver == ArmDriver::Sim;
    if is_simulated && rig.sim.lockstep && is_endless {
        return Err(BadInput(
            "a lockstep simulation without an end would fill the disk: limit it with --seconds"
                .into(),
        ));
    }
    Ok(())
}

/// Records until the time limit, the end of the devices, or Ctrl-C.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let stop = signals::stop_on_signals()?;
    let overrides = if args.lockstep {
        vec![Override::new("sim.lockstep", true)]
    } else {
        Vec::new()
    };
    let rig = Rig::load(&args.rig_file, &overrides)?;
    // Before the devices are opened, as they may take long to start.
    check_end(args, &rig)?;
    if args.out.exists() {
        return Err(drivers::Error::Exists {
            path: args.out.clone(),
        }
        .into()); // Checked before the devices are opened.
    }
    let Opened {
        rig, mut source, ..
    } = open::rig(
        rig,
        if args.sim {
            Devices::Sim
        } else {
            Devices::Real
        },
    )?;
    let mut recorder = open::recorder(&args.out, &rig)?;
    let mut recorded = Recorded {
        event: "done",
        out: args.out.clone(),
        ..Recorded::default()
    };
    let bar = print::bar(None, "{spinner} {elapsed} {msg}", args.json);
    let mut first: Option<Stamp> = None;
    let mut input_error = None;
    let mut data_losses = Vec::new();
    while !stop.requested() {
        let sample = match source.next_sample() {
            Ok(Some(sample)) => sample,
            Ok(None) => break,
            Err(error) => {
                input_error = Some(error);
                break;
            }
        };
        // The limit counts device time, so that a slow simulation records as much as a fast one.
        let since_first = sample.stamp().0 - first.get_or_insert(sample.stamp()).0;
        recorded.seconds = recorded.seconds.max(since_first as f64 * 1e-9);
        if args
            .seconds
            .is_some_and(|seconds| recorded.seconds > seconds)
        {
            break;
        }
        // The file ends with its last complete chunk, so its contents are counted instead of what
        // was written.
        if let Err(error) = recorder.write(&sample) {
            data_losses.push(format!("{:#}", anyhow::Error::new(error)));
            recorded = recorded.recount_from_file();
            break;
        }
        recorded.count(&sample);
        bar.set_message(recorded.summary());
    }
    bar.finish_and_clear();
    // After a write error, the file has ended already.
    let finished = data_losses.is_empty().then(|| recorder.finish());
    let n_written = match finished {
        Some(Ok(finished)) => Some(finished.n_samples),
        Some(Err(error)) => {
            data_losses.push(format!("{:#}", anyhow::Error::new(error)));
            recorded = recorded.recount_from_file();
            None
        }
        None => None,
    };
    // The recording is closed before errors are returned, so that its data is complete.
    if let Some(error) = input_error {
        let finished = format!(
            "a device failed; {} contains the data up to that point",
            args.out.display()
        );
        return Err(anyhow::Error::new(error).context(finished));
    }
    // An empty file would only look like a recording.
    if n_written == Some(0) {
        return Err(InsufficientData(format!(
            "no device sent any data, so {} was not written",
            args.out.display()
        ))
        .into());
    }
    if args.json {
        print::report_json(&recorded)?;
    } else {
        print::report(format_args!(
            "{:.1} s, {} in {}",
            recorded.seconds,
            recorded.summary(),
            args.out.display()
        ));
    }
    data_losses.extend(recorded.data_losses());
    data_losses.extend(recorded.missing_devices(&rig));
    let n_dropped = source.n_other_samples_dropped();
    if n_dropped > 0 {
        data_losses.push(format!(
            "{n_dropped} joint states, base poses and range scans were dropped because the disk was too slow"
        ));
    }
    Ok(exit::from_losses(&data_losses))
}
