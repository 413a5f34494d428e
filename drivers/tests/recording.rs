//! Tests of writing and reading recordings: samples and their order are preserved, and damaged
//! files are read as far as possible.

mod recompress;

use drivers::recording::{RIG_FILE, Recorder, Recording, RecordingMetadata};
use drivers::{
    BasePose, Error, Image, PixelFormat, RangePoint, RangeScan, Sample, Source, TruthImage,
};
use kinematics::{Intrinsics, JointState, Lens, Stamp, Transform};
use mcap::Compression;
use nalgebra::{Translation3, UnitQuaternion};
use numbers::random::Random;
use recompress::recompress;
use std::path::Path;

const RIG: &str = "[arm]\ndriver = \"sim\"\n";

/// Two seconds of a rig: joints at 100 Hz, color and depth at 10 Hz with ground truth, some base
/// poses.
fn samples() -> Vec<Sample> {
    let mut samples = Vec::new();
    for tick in 0..200_i32 {
        let stamp = Stamp(1_000_000_007 + i64::from(tick) * 10_000_000);
        let angle = f64::from(tick) * 0.013;
        samples.push(Sample::Joints(JointState {
            stamp,
            position: (1..8)
                .map(|joint| (angle * f64::from(joint)).sin())
                .collect(),
            velocity: vec![angle.cos(); 7],
            effort: vec![],
        }));
        if tick % 10 == 5 {
            let stamp = Stamp(stamp.0 - 3_333_333);
            let world_from_camera = Transform::from_parts(
                Translation3::new(angle, 0.1, -0.7),
                UnitQuaternion::from_euler_angles(angle, 0.2, 0.3),
            );
            let color = Image {
                camera: "wrist".into(),
                stamp,
                size_px: [16, 12],
                format: if tick % 20 == 5 {
                    PixelFormat::Rgb8
                } else {
                    PixelFormat::Png
                },
                data: noise(tick, 16 * 12 * 3).into(),
                exposure_secs: (tick % 30 == 5).then_some(1e-3),
                n_skipped: u64::from(tick == 55),
            };
            let format = PixelFormat::DepthU16 {
                meters_per_count: 1e-4,
            };
            let depth = Image {
                stamp: Stamp(stamp.0 + 777),
                format,
                data: noise(tick, 16 * 12 * 2).into(),
                ..color.clone()
            };
            let depth_m = if tick < 100 {
                (0..16 * 12_u16)
                    .map(|count| f32::from(count) * 0.37)
                    .collect()
            } else {
                vec![]
            };
            let image = Image {
                exposure_secs: None,
                ..color.clone()
            };
            let psnr_ceiling = (tick < 50).then_some(42.0 + angle);
            let truth = TruthImage {
                image,
                depth_m: depth_m.into(),
                world_from_camera,
                psnr_ceiling,
            };
            samples.extend([
                Sample::Image(color),
                Sample::Truth(truth),
                Sample::Image(depth),
            ]);
            samples.push(Sample::Base(BasePose {
                stamp,
                world_from_base: world_from_camera.inverse(),
            }));
            samples.push(Sample::BaseTruth(BasePose {
                stamp,
                world_from_base: world_from_camera,
            }));
            let point = |ring: u16| RangePoint {
                position_m: [0.1, -f32::from(ring), 3.7],
                ring,
                offset_micros: 55 * u32::from(ring),
            };
            samples.push(Sample::Range(RangeScan {
                scanner: "lidar".into(),
                stamp,
                points: (0..16).map(point).collect(),
            }));
        }
    }
    samples
}

fn noise(seed: i32, n_bytes: usize) -> Vec<u8> {
    Random::new(u64::try_from(seed).expect("not negative")).bytes(n_bytes)
}

fn record(path: &Path, samples: &[Sample]) {
    let intrinsics = Intrinsics {
        size_px: [16, 12],
        focal_px: [20.0, 21.0],
        principal_px: [8.0, 6.5],
        lens: Lens::BrownConrady([0.1, 0.2, 0.3, 0.4, 0.5]),
        rectified: false,
    };
    let recording_metadata = RecordingMetadata {
        files: &[(RIG_FILE, RIG.as_bytes())],
        cameras: &[("wrist", &intrinsics)],
        joint_names: &["a".into(), "b".into()],
    };
    let mut recorder = Recorder::create(path, &recording_metadata).expect("a new file");
    for sample in samples {
        recorder.write(sample).expect("writing a sample");
    }
    recorder.finish().expect("finishing the recording");
}

fn replay(path: &Path) -> (Vec<Sample>, Recording) {
    let mut recording = Recording::open(path).expect("a recording");
    let mut samples = Vec::new();
    while let Some(sample) = recording.next_sample().expect("readable") {
        samples.push(sample);
    }
    (samples, recording)
}

#[test]
fn replay_equals_recorded_samples_in_order() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let sent = samples();
    record(&path, &sent);
    let (read, recording) = replay(&path);
    assert_eq!(read.len(), sent.len());
    for (ix, (read, sent)) in read.iter().zip(&sent).enumerate() {
        assert_eq!(read, sent, "sample {ix}");
    }
    assert_eq!(recording.damage(), None);
    assert_eq!(recording.attachment(RIG_FILE), Some(RIG.as_bytes()));
    assert_eq!(
        recording.joint_names(),
        Some(&["a".to_owned(), "b".to_owned()][..])
    );
    let second_path = folder.path().join("again.mcap");
    record(&second_path, &read);
    assert!(
        std::fs::read(&path).expect("first") == std::fs::read(&second_path).expect("second"),
        "a replay records to the same bytes"
    );
}

#[test]
fn truncated_recording_yields_samples_before_the_cut() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let sent = samples();
    record(&path, &sent);
    let whole = std::fs::read(&path).expect("the file");
    let cut_path = folder.path().join("cut.mcap");
    let mut n_before = 0;
    for eighths in 1..8 {
        std::fs::write(&cut_path, &whole[..whole.len() * eighths / 8]).expect("a shorter file");
        let (read, recording) = replay(&cut_path);
        assert!(
            read.len() >= n_before && read.len() < sent.len(),
            "{} of {} samples",
            read.len(),
            sent.len()
        );
        assert!(
            read[..] == sent[..read.len()],
            "the remaining samples are unchanged"
        );
        let damage = recording.damage().expect("the truncation is reported");
        assert!(
            damage.contains("truncated") && damage.contains(&read.len().to_string()),
            "{damage}"
        );
        n_before = read.len();
    }
    assert!(
        n_before > sent.len() / 2,
        "a cut near the end loses few samples: {n_before} of {}",
        sent.len()
    );
}

/// Compressions that other programs use, with the sizes of their chunks.
const COMPRESSIONS: [(Compression, u64); 4] = [
    (Compression::Zstd, 2000),
    (Compression::Zstd, 4 << 20),
    (Compression::Lz4, 2000),
    (Compression::Lz4, 4 << 20),
];

#[test]
fn recordings_compressed_by_other_programs_are_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let sent = samples();
    record(&path, &sent);
    let uncompressed = std::fs::read(&path).expect("the file");
    for (compression, chunk_bytes) in COMPRESSIONS {
        let compressed = recompress(&uncompressed, compression, chunk_bytes);
        std::fs::write(&path, &compressed).expect("the file");
        let (read, recording) = replay(&path);
        assert!(
            read == sent,
            "{compression:?}, chunks of {chunk_bytes} bytes: {} samples",
            read.len()
        );
        assert_eq!(recording.damage(), None);
        assert_eq!(recording.attachment(RIG_FILE), Some(RIG.as_bytes()));
        assert_eq!(
            recording.joint_names(),
            Some(&["a".to_owned(), "b".to_owned()][..])
        );
    }
}

#[test]
fn truncated_compressed_recording_yields_samples_of_complete_chunks() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let sent = samples();
    record(&path, &sent);
    let uncompressed = std::fs::read(&path).expect("the file");
    for compression in [Compression::Zstd, Compression::Lz4] {
        let compressed = recompress(&uncompressed, compression, 20_000);
        std::fs::write(&path, &compressed[..compressed.len() / 2]).expect("a shorter file");
        let (read, recording) = replay(&path);
        assert!(
            read.len() > sent.len() / 8 && read[..] == sent[..read.len()],
            "{} samples",
            read.len()
        );
        let damage = recording.damage().expect("the truncation is reported");
        assert!(damage.contains("is truncated after"), "{damage}");
    }
}

#[test]
fn flipped_bit_is_detected() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    record(&path, &samples());
    let mut bytes = std::fs::read(&path).expect("the file");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&path, bytes).expect("the file");
    let mut recording = Recording::open(&path).expect("the start is intact");
    let mut n_samples = 0;
    let damage_or_error = loop {
        match recording.next_sample() {
            Ok(Some(_)) => n_samples += 1,
            Ok(None) => break recording.damage().map(str::to_owned),
            Err(e) => break Some(e.to_string()),
        }
    };
    assert!(
        n_samples > 10 && damage_or_error.is_some(),
        "{n_samples} samples, {damage_or_error:?}"
    );
}

#[test]
fn an_unfinished_recording_is_readable() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let sent = samples();
    let mut recorder = Recorder::create(&path, &RecordingMetadata::default()).expect("a new file");
    for sample in &sent {
        recorder.write(sample).expect("writing a sample");
    }
    std::mem::forget(recorder); // The recording ends as if the program had been killed.
    let (read, recording) = replay(&path);
    assert!(read[..] == sent[..read.len()]);
    let last = read.last().expect("some").stamp();
    assert!(
        sent[sent.len() - 1].stamp().0 - last.0 < 1_100_000_000,
        "at most about a second is lost"
    );
    assert!(recording.damage().is_some());
}

#[test]
fn non_recordings_are_rejected() {
    let folder = tempfile::tempdir().expect("a folder");
    let missing =
        Recording::open(&folder.path().join("missing.mcap")).expect_err("the file does not exist");
    assert!(matches!(missing, Error::Open { .. }) && missing.to_string().contains("missing.mcap"));
    for content in [&b""[..], b"short", b"a longer text that is not a recording"] {
        let path = folder.path().join("text.mcap");
        std::fs::write(&path, content).expect("a file");
        let error = Recording::open(&path).expect_err("not a recording");
        assert!(matches!(error, Error::NotARecording { .. }), "{error}");
    }
    let empty = folder.path().join("empty.mcap");
    record(&empty, &samples());
    let bytes = std::fs::read(&empty).expect("the file");
    std::fs::write(&empty, &bytes[..100]).expect("a shorter file");
    assert!(matches!(
        Recording::open(&empty),
        Err(Error::EmptyRecording { .. })
    ));
}

#[test]
fn existing_file_is_rejected_and_unchanged() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    record(&path, &samples());
    let before = std::fs::read(&path).expect("the file");
    let error =
        Recorder::create(&path, &RecordingMetadata::default()).expect_err("the file exists");
    assert!(
        matches!(error, Error::Exists { .. }) && error.to_string().contains("run.mcap"),
        "{error}"
    );
    assert!(std::fs::read(&path).expect("the file") == before);
}
