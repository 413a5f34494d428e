//! Feeds the seeds of the folder `fuzz`, unchanged and corrupted, to every reader.

use super::random::Random;
use super::scratch::Scratch;
use super::*;
use crate::recording::{Recorder, RecordingMetadata};
use crate::wire::{descriptor, foxglove, joint_state, point_cloud};
use crate::{BasePose, Image, PixelFormat, RangePoint, RangeScan, Sample};
use crate::{can, franka, udp};
use kinematics::{Intrinsics, JointState, Lens, Stamp, Transform};
use mcap::Compression;
use recompress::recompress;
use std::path::{Path, PathBuf};

#[path = "../../tests/recompress/mod.rs"]
mod recompress;

type Reader = fn(&[u8]);

/// Reader for each seed folder.
const READERS: [(&str, Reader); 9] = [
    ("can", frames),
    ("udp", datagrams),
    ("fci_states", states),
    ("fci_client", client),
    ("pixels", pixels),
    ("messages", messages),
    ("recording", recording),
    ("nerfstudio", nerfstudio),
    ("tum", tum),
];

fn seed_folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/seeds").join(name)
}

fn load_seeds(name: &str) -> Vec<Vec<u8>> {
    let folder = seed_folder(name);
    let mut paths: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    assert!(!paths.is_empty(), "{folder:?} has no seeds");
    paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

/// Corrupts the bytes: truncates, deletes or repeats a section, swaps two sections, or changes bytes or bits at random.
fn corrupt(bytes: &mut Vec<u8>, random: &mut Random) {
    if bytes.is_empty() {
        return bytes.push(7);
    }
    let mut positions = [(); 3].map(|()| random.below(bytes.len() + 1));
    positions.sort_unstable();
    let [a, b, c] = positions;
    match random.below(6) {
        0 => bytes.truncate(b),
        1 => drop(bytes.drain(a..b)),
        2 => drop(bytes.splice(b..b, bytes[a..b].to_vec())),
        3 => bytes[a..c].rotate_left(b - a),
        4 => bytes[b.min(c.saturating_sub(1))..c].iter_mut().take(4).for_each(|byte| *byte = random.byte()),
        _ => bytes[a.min(positions[2].saturating_sub(1))] ^= 1 << random.below(8),
    }
}

#[test]
fn corrupted_seeds_never_panic() {
    /// Each is corrupted a few times. File readers take 50 us per input.
    const N_CORRUPTED: usize = 400;
    for (name, read) in READERS {
        let mut random = Random(5);
        for seed in load_seeds(name) {
            read(&seed);
            for _ in 0..N_CORRUPTED {
                let mut bytes = seed.clone();
                (0..=random.below(4)).for_each(|_| corrupt(&mut bytes, &mut random));
                read(&bytes);
            }
        }
        for _ in 0..N_CORRUPTED {
            let bytes: Vec<u8> = (0..random.below(300)).map(|_| random.byte()).collect();
            read(&bytes);
        }
    }
}

/// Run this manually after a format change. Seeds found by fuzzing have other names and are kept.
#[test]
#[ignore = "rewrites the generated seeds"]
fn write_seeds() {
    let write = |name: &str, seed: &str, bytes: &[u8]| {
        std::fs::create_dir_all(seed_folder(name)).unwrap();
        std::fs::write(seed_folder(name).join(seed), bytes).unwrap();
    };
    write("can", "talk", &can::fuzz::encode_frames(&can::fuzz::tests::example_traffic()));
    write("udp", "talk", &udp::fuzz::tests::example_traffic().join(&b'\n'));
    for (name, version) in ["v5", "v10"].into_iter().zip(franka::fuzz::tests::VERSIONS) {
        let datagrams = franka::emulated::fuzz::tests::state_datagrams(version, 1);
        write("fci_states", name, &franka::fuzz::tests::with_length_prefixes(&datagrams));
        write("fci_client", name, &franka::emulated::fuzz::tests::example_traffic(version).concat());
    }
    for (name, bytes) in images() {
        write("pixels", name, &bytes);
    }
    for (kind, (name, bytes)) in (0_u8..).zip(one_of_each_message()) {
        write("messages", name, &[&[kind], &bytes[..]].concat());
    }
    let recording = small_recording();
    write("recording", "rig.mcap", &recording);
    for (name, compression) in [("rig-zstd.mcap", Compression::Zstd), ("rig-lz4.mcap", Compression::Lz4)] {
        write("recording", name, &recompress(&recording, compression, 1000));
    }
}

/// Small images with the header that [`pixels`] expects.
fn images() -> Vec<(&'static str, Vec<u8>)> {
    let rgb: Vec<u8> = (0..3 * 16 * 8).map(|ix: u32| (ix * ix % 251) as u8).collect();
    let file = |format| {
        let mut file = std::io::Cursor::new(Vec::new());
        image::write_buffer_with_format(&mut file, &rgb, 16, 8, image::ExtendedColorType::Rgb8, format).unwrap();
        file.into_inner()
    };
    let head = |format: u8, bytes_per_line: u16, data: &[u8]| {
        [&[format, 16, 0, 8, 0][..], &bytes_per_line.to_le_bytes(), data].concat()
    };
    let jpeg = file(image::ImageFormat::Jpeg);
    // Motion JPEG omits the Huffman tables.
    let mut without_tables = Vec::new();
    let mut rest = &jpeg[..];
    while let [0xff, 0xc4, high, low, ..] | [0xff, _, high, low, ..] = *rest {
        let is_segment = !matches!(rest[1], 0xd8 | 0xda);
        let n = if is_segment { 2 + usize::from(u16::from_be_bytes([high, low])) } else { 2 };
        if rest[1] != 0xc4 {
            without_tables.extend(&rest[..n]);
        }
        let is_scan = rest[1] == 0xda;
        rest = &rest[n..];
        if is_scan {
            break;
        }
    }
    without_tables.extend(rest);
    vec![
        ("jpeg", head(0, 0, &jpeg)),
        ("jpeg-without-tables", head(0, 0, &without_tables)),
        ("png", head(1, 0, &file(image::ImageFormat::Png))),
        ("rgb", head(2, 48, &rgb)),
        ("yuyv-padded", head(5, 40, &[90; 40 * 8])),
        ("nv12", head(7, 16, &[90; 16 * 12])),
        ("depth", head(8, 32, &[3; 32 * 8])),
    ]
}

fn image(format: PixelFormat, data: &[u8]) -> Image {
    let (camera, stamp) = ("wrist".into(), Stamp(1_234_567_890));
    Image { camera, stamp, size_px: [2, 2], format, data: data.into(), exposure_secs: Some(0.004), n_skipped: 3 }
}

fn joints() -> JointState {
    JointState { stamp: Stamp(5), position: vec![0.1, -2.0], velocity: vec![0.0, 1e-9], effort: Vec::new() }
}

fn scan() -> RangeScan {
    let point = RangePoint { position_m: [1.0, -0.5, 2.0], ring: 3, offset_micros: 70 };
    RangeScan { scanner: "lidar".into(), stamp: Stamp(9), points: [point; 2].into() }
}

/// One of each message, in the order of the kinds in [`messages`].
fn one_of_each_message() -> Vec<(&'static str, Vec<u8>)> {
    let pose = Transform::new([0.1, 0.2, -0.3].into(), [0.3, 0.0, 1.0].into());
    let depth = PixelFormat::DepthU16 { meters_per_count: 0.001 };
    let [compressed, raw] = [image(PixelFormat::Png, &[1, 2, 3]), image(depth, &[4; 8])];
    assert_eq!(foxglove::schema_of(raw.format).name, descriptor::RAW_IMAGE.name);
    vec![
        ("compressed", foxglove::encode_image(&compressed)),
        ("raw", foxglove::encode_image(&raw)),
        ("transform", foxglove::encode_transform("world", "base", Stamp(3), &pose)),
        ("true-pose", foxglove::encode_true_pose("wrist", Stamp(3), &pose, Some(42.0))),
        ("depth", foxglove::encode_depth_m("wrist", Stamp(3), [2, 1], &[0.5, 1.5])),
        ("joints", joint_state::encode(&joints())),
        ("scan", point_cloud::encode(&scan())),
    ]
}

fn small_recording() -> Vec<u8> {
    let folder = Scratch::new("seed");
    let path = folder.0.join("it.mcap");
    let intrinsics = Intrinsics {
        size_px: [2, 2],
        focal_px: [2.0, 2.0],
        principal_px: [1.0, 1.0],
        lens: Lens::Pinhole,
        rectified: false,
    };
    let names = ["a".to_owned(), "b".to_owned()];
    let recording_metadata = RecordingMetadata {
        files: &[("rig.toml", b"[arm]\n")],
        cameras: &[("wrist", &intrinsics)],
        joint_names: &names,
    };
    let mut recorder = Recorder::create(&path, &recording_metadata).unwrap();
    let base = BasePose { stamp: Stamp(6), world_from_base: Transform::identity() };
    let samples = [
        Sample::Joints(joints()),
        Sample::Base(base),
        Sample::Image(image(PixelFormat::Rgb8, &[9; 12])),
        Sample::Range(scan()),
    ];
    for sample in &samples {
        recorder.write(sample).unwrap();
    }
    recorder.finish().unwrap();
    std::fs::read(path).unwrap()
}
