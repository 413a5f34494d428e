//! Seeds that are created by code.

use super::scratch::Scratch;
use crate::recording::{Recorder, RecordingMetadata};
use crate::wire::{descriptor, foxglove, joint_state, point_cloud};
use crate::{BasePose, Image, PixelFormat, RangePoint, RangeScan, Sample, udp};
#[cfg(target_os = "linux")]
use crate::{can, franka};
use kinematics::{Intrinsics, JointState, Lens, Stamp, Transform};

/// An input for a fuzz target.
#[derive(Clone, Debug)]
pub struct Seed {
    /// Name of the target, and of its folder in `fuzz/seeds`.
    pub target: &'static str,
    /// File name.
    pub name: &'static str,
    /// Contents.
    pub bytes: Vec<u8>,
}

/// Returns the seeds that are created by code. The other seeds were found by fuzzing.
pub fn generated_seeds() -> Vec<Seed> {
    let seed = |target, name, bytes| Seed {
        target,
        name,
        bytes,
    };
    let mut seeds = vec![
        seed("udp", "talk", udp::fuzz::example_traffic().join(&b'\n')),
        seed("recording", "rig.mcap", small_recording()),
    ];
    seeds.extend(
        images()
            .into_iter()
            .map(|(name, bytes)| seed("pixels", name, bytes)),
    );
    let messages = (0_u8..).zip(one_of_each_message());
    seeds.extend(
        messages
            .map(|(kind, (name, bytes))| seed("messages", name, [&[kind], &bytes[..]].concat())),
    );
    #[cfg(target_os = "linux")]
    {
        seeds.push(seed(
            "can",
            "talk",
            can::fuzz::seeds::encode_frames(&can::fuzz::seeds::example_traffic()),
        ));
        for (name, version) in ["v5", "v10"].into_iter().zip(franka::fuzz::VERSIONS) {
            let datagrams = franka::emulated::fuzz::seeds::state_datagrams(version, 1);
            seeds.push(seed(
                "fci_states",
                name,
                franka::fuzz::with_length_prefixes(&datagrams),
            ));
            seeds.push(seed(
                "fci_client",
                name,
                franka::emulated::fuzz::seeds::example_traffic(version).concat(),
            ));
        }
    }
    seeds
}

/// Small images with the header that [`super::pixels`] expects.
fn images() -> Vec<(&'static str, Vec<u8>)> {
    let rgb: Vec<u8> = (0..3 * 16 * 8)
        .map(|ix: u32| (ix * ix % 251) as u8)
        .collect();
    let file = |format| {
        let mut file = std::io::Cursor::new(Vec::new());
        image::write_buffer_with_format(
            &mut file,
            &rgb,
            16,
            8,
            image::ExtendedColorType::Rgb8,
            format,
        )
        .expect("a small image");
        file.into_inner()
    };
    let head = |format: u8, bytes_per_line: u16, data: &[u8]| {
        [
            &[format, 16, 0, 8, 0][..],
            &bytes_per_line.to_le_bytes(),
            data,
        ]
        .concat()
    };
    let jpeg = file(image::ImageFormat::Jpeg);
    // Motion JPEG omits the Huffman tables.
    let mut without_tables = Vec::new();
    let mut rest = &jpeg[..];
    while let [0xff, 0xc4, high, low, ..] | [0xff, _, high, low, ..] = *rest {
        let is_segment = !matches!(rest[1], 0xd8 | 0xda);
        let n = if is_segment {
            2 + usize::from(u16::from_be_bytes([high, low]))
        } else {
            2
        };
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
    Image {
        camera,
        stamp,
        size_px: [2, 2],
        format,
        data: data.into(),
        exposure_secs: Some(0.004),
        n_skipped: 3,
    }
}

fn joints() -> JointState {
    JointState {
        stamp: Stamp(5),
        position: vec![0.1, -2.0],
        velocity: vec![0.0, 1e-9],
        effort: Vec::new(),
    }
}

fn scan() -> RangeScan {
    let point = RangePoint {
        position_m: [1.0, -0.5, 2.0],
        ring: 3,
        offset_micros: 70,
    };
    RangeScan {
        scanner: "lidar".into(),
        stamp: Stamp(9),
        points: [point; 2].into(),
    }
}

/// One of each message, in the order of the kinds in [`super::messages`].
fn one_of_each_message() -> Vec<(&'static str, Vec<u8>)> {
    let pose = Transform::new([0.1, 0.2, -0.3].into(), [0.3, 0.0, 1.0].into());
    let depth = PixelFormat::DepthU16 {
        meters_per_count: 0.001,
    };
    let [compressed, raw] = [image(PixelFormat::Png, &[1, 2, 3]), image(depth, &[4; 8])];
    assert_eq!(
        foxglove::schema_of(raw.format).name,
        descriptor::RAW_IMAGE.name
    );
    vec![
        ("compressed", foxglove::encode_image(&compressed)),
        ("raw", foxglove::encode_image(&raw)),
        (
            "transform",
            foxglove::encode_transform("world", "base", Stamp(3), &pose),
        ),
        (
            "true-pose",
            foxglove::encode_true_pose("wrist", Stamp(3), &pose, Some(42.0)),
        ),
        (
            "depth",
            foxglove::encode_depth_m("wrist", Stamp(3), [2, 1], &[0.5, 1.5]),
        ),
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
    let mut recorder = Recorder::create(&path, &recording_metadata).expect("a new file");
    let base = BasePose {
        stamp: Stamp(6),
        world_from_base: Transform::identity(),
    };
    let samples = [
        Sample::Joints(joints()),
        Sample::Base(base),
        Sample::Image(image(PixelFormat::Rgb8, &[9; 12])),
        Sample::Range(scan()),
    ];
    for sample in &samples {
        recorder.write(sample).expect("writing a sample");
    }
    recorder.finish().expect("completing the file");
    std::fs::read(path).expect("the file was just written")
}
