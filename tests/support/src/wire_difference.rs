//! Compares the emulated samples with those that drivers received over the wire.

use drivers::recording::{RIG_FILE, Recording};
use drivers::{Image, Sample, Source};
use kinematics::{JointHistory, PoseHistory, Stamp};
use numbers::quantile::median;
use std::path::Path;
use std::time::Duration;

/// Contents of a recording.
struct RecordedSamples {
    /// Color and depth images, in order.
    images: Vec<Image>,
    joints: JointHistory,
    poses: PoseHistory,
}

/// Differences between received and emulated samples, at the stamps of the images.
#[derive(Debug)]
pub struct Difference {
    /// Number of received images. All of them are identical to emulated images.
    pub n_images: usize,
    /// Largest difference of any joint, rad, in the median image and in the worst image.
    pub joints_rad: [f64; 2],
    /// Largest difference of the base position, m.
    pub base_m: f64,
}

fn read_samples(path: &Path) -> RecordedSamples {
    let mut recording = Recording::open(path).expect("a recording");
    let gap = Duration::from_millis(100);
    let (joints, poses) = (
        JointHistory::new(gap, usize::MAX),
        PoseHistory::new(gap, usize::MAX),
    );
    let mut read_samples = RecordedSamples {
        images: Vec::new(),
        joints,
        poses,
    };
    while let Some(sample) = recording.next_sample().expect("it is whole") {
        match sample {
            Sample::Image(image) => read_samples.images.push(image),
            Sample::Joints(state) => read_samples.joints.push(state).expect("in order"),
            Sample::Base(pose) => read_samples
                .poses
                .push(pose.stamp, pose.world_from_base)
                .expect("in order"),
            _ => {}
        }
    }
    read_samples
}

/// Offset added to the script's stamps during playback, from the rig file written for it.
fn clock_offset_nanos(recording: &Path) -> i64 {
    let recording = Recording::open(recording).expect("a recording");
    let rig = std::str::from_utf8(recording.attachment(RIG_FILE).expect("its rig"))
        .expect("text")
        .to_owned();
    let line = rig
        .lines()
        .find_map(|line| line.strip_prefix("clock_offset_nanos = "))
        .expect("the key");
    line.trim().parse().expect("a number")
}

/// Compares samples at every received color image. Every image must be identical to an emulated
/// one.
pub fn difference(script: &Path, wire: &Path) -> Difference {
    let offset_nanos = clock_offset_nanos(wire);
    let (script, wire) = (read_samples(script), read_samples(wire));
    let mut joints_rad = Vec::new();
    let mut base_m: f64 = 0.0;
    let n_images = wire.images.len();
    for image in &wire.images {
        let simulated_stamp = Stamp(image.stamp.0 - offset_nanos);
        // Stamps of cameras have a resolution of microseconds.
        let is_match = |emulated: &&Image| {
            emulated.is_depth() == image.is_depth()
                && emulated.stamp.0.abs_diff(simulated_stamp.0) < 1000
        };
        let emulated = script
            .images
            .iter()
            .find(is_match)
            .unwrap_or_else(|| panic!("no image was emulated at {simulated_stamp:?}"));
        if image.is_depth() {
            assert_eq!(image.data, emulated.data, "depth at {simulated_stamp:?}");
        } else {
            assert_eq!(
                image.decode_rgb().expect("RGB"),
                emulated.decode_rgb().expect("RGB"),
                "image at {simulated_stamp:?}"
            );
        }
        if let (Ok(received), Ok(emulated)) = (
            wire.joints.at(image.stamp),
            script.joints.at(simulated_stamp),
        ) {
            let differences = received
                .position
                .iter()
                .zip(&emulated.position)
                .map(|(received, emulated)| (received - emulated).abs());
            joints_rad.push(differences.fold(0.0, f64::max));
        }
        if let (Ok(received), Ok(emulated)) =
            (wire.poses.at(image.stamp), script.poses.at(simulated_stamp))
        {
            base_m = base_m.max((received.translation.vector - emulated.translation.vector).norm());
        }
    }
    let median_rad =
        median(&joints_rad).expect("some image has joint readings before and after it");
    let max_rad = joints_rad.iter().copied().fold(0.0, f64::max);
    Difference {
        n_images,
        joints_rad: [median_rad, max_rad],
        base_m,
    }
}

/// Distance from the target, rad or m, at the time when `fieldrig move --json` reports that the arm
/// arrived.
pub fn error_of_move(received: &str) -> f64 {
    let done = received
        .lines()
        .find(|line| line.contains("\"event\":\"done\""))
        .expect("it arrives");
    let (_, rest) = done.split_once("\"error\":").expect("the key");
    rest.split([',', '}'])
        .next()
        .and_then(|error| error.parse().ok())
        .expect("a number")
}
