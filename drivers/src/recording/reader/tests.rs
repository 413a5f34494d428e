//! Recordings as other programs write or change them. The files are built byte by byte, because the
//! library that writes recordings does not write invalid files.

use super::{MAX_MESH_NAME_BYTES, Notes, Recording};
use crate::recording::{MAX_MESH_BYTES, RIG_FILE, URDF_FILE};
use crate::wire::protobuf::Message;
use crate::wire::{descriptor, foxglove, joint_state, point_cloud};
use crate::{
    Image, PixelFormat, RangePoint, RangeScan, Sample, Source, YuvColors, YuvLayout, YuvMatrix,
    YuvRange,
};
use kinematics::{Intrinsics, JointState, Lens, Stamp, Transform};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::sync::Arc;

const STAMP: Stamp = Stamp(1_500_000_000);
const JOINTS: &str = "/joints";
const COLOR: &str = "/camera/wrist/color";
const DEPTH: &str = "/camera/wrist/depth";
const COMPRESSED: &str = "/camera/left/color";
const YUV: &str = "/camera/top/color";
const CALIBRATION: &str = "/camera/wrist/calibration";
const BASE: &str = "/base";
const SCAN: &str = "/range/lidar/points";
const TRUE_COLOR: &str = "/camera/wrist/truth/color";
const TRUE_DEPTH: &str = "/camera/wrist/truth/depth";
const TRUE_POSE: &str = "/camera/wrist/truth/pose";

#[test]
fn name_in_the_topic_counts() {
    let mut notes = Notes::default();
    for in_message in ["wrist", "left", ""] {
        let mut name: Arc<str> = in_message.into();
        notes.agree("/camera/left/color", "left", &mut name);
        assert_eq!(&*name, "left");
    }
    assert_eq!(notes.0.len(), 1, "each topic is reported once");
}

/// A channel with one message.
#[derive(Clone)]
struct Part {
    topic: &'static str,
    schema: &'static str,
    encoding: &'static str,
    metadata: Vec<(&'static str, &'static str)>,
    message: Vec<u8>,
}

/// A chunk around the channels and messages.
#[derive(Clone)]
struct Chunk {
    compression: &'static str,
    /// The checksum to write. If it is `None`, the correct checksum is written.
    checksum: Option<u32>,
}

/// Contents of a file.
#[derive(Clone)]
struct Contents {
    profile: &'static str,
    attachments: Vec<(&'static str, &'static str)>,
    /// Replaces the checksums of the attachments.
    attachment_checksum: Option<u32>,
    schema_encoding: &'static str,
    schema_text: &'static str,
    parts: Vec<Part>,
    /// `log_time` of all messages. The next field is the `sequence` of the first message.
    log_time: u64,
    chunk: Option<Chunk>,
    /// Records after the messages.
    more: Vec<u8>,
}

fn image(camera: &str, format: PixelFormat, data: &[u8]) -> Image {
    let (camera, data) = (camera.into(), data.into());
    Image {
        camera,
        stamp: STAMP,
        size_px: [2, 2],
        format,
        data,
        exposure_secs: None,
        n_skipped: 0,
    }
}

/// A recording as this program writes it, with one message on each kind of topic.
fn contents() -> Contents {
    let protobuf = |topic, schema: descriptor::Schema, message| Part {
        topic,
        schema: schema.name,
        encoding: "protobuf",
        metadata: Vec::new(),
        message,
    };
    let of_image = |topic, image: &Image| {
        protobuf(
            topic,
            foxglove::schema_of(image.format),
            foxglove::encode_image(image),
        )
    };
    let state = JointState {
        stamp: STAMP,
        position: vec![0.5, -2.0],
        velocity: vec![0.25, 0.0],
        effort: vec![1.0, 2.0],
    };
    let joints = Part {
        topic: JOINTS,
        schema: joint_state::SCHEMA_NAME,
        encoding: "json",
        metadata: vec![("joint_names", "a,b")],
        message: joint_state::encode(&state),
    };
    let depth = image(
        "wrist",
        PixelFormat::DepthU16 {
            meters_per_count: 0.001,
        },
        &[7; 8],
    );
    let depth = Part {
        metadata: vec![("meters_per_count", "0.001")],
        ..of_image(DEPTH, &depth)
    };
    let rgb: Vec<u8> = (0..12).collect();
    let colors = YuvColors {
        matrix: YuvMatrix::Bt601,
        range: YuvRange::Full,
    };
    let yuv = PixelFormat::Yuv {
        layout: YuvLayout::Yuyv,
        colors,
    };
    let intrinsics = Intrinsics {
        size_px: [2, 2],
        focal_px: [2.0, 2.0],
        principal_px: [1.0, 1.0],
        lens: Lens::Pinhole,
        rectified: false,
    };
    let pose = Transform::translation(1.0, 2.0, 3.0);
    let point = RangePoint {
        position_m: [1.0, -0.5, 2.0],
        ring: 3,
        offset_micros: 70,
    };
    let scan = RangeScan {
        scanner: "lidar".into(),
        stamp: STAMP,
        points: [point].into(),
    };
    let transform = |parent, child| foxglove::encode_transform(parent, child, STAMP, &pose);
    Contents {
        profile: "fieldrig",
        attachments: vec![(RIG_FILE, "[arm]\n"), (URDF_FILE, "<robot/>")],
        attachment_checksum: None,
        schema_encoding: "protobuf",
        schema_text: "",
        parts: vec![
            joints,
            of_image(COLOR, &image("wrist", PixelFormat::Rgb8, &rgb)),
            depth,
            of_image(COMPRESSED, &image("left", PixelFormat::Png, &[1, 2, 3])),
            of_image(YUV, &image("top", yuv, &[90; 8])),
            protobuf(
                CALIBRATION,
                descriptor::CAMERA_CALIBRATION,
                foxglove::encode_calibration("wrist", STAMP, &intrinsics),
            ),
            protobuf(
                BASE,
                descriptor::FRAME_TRANSFORM,
                transform("world", "base"),
            ),
            protobuf(
                "/base/truth",
                descriptor::FRAME_TRANSFORM,
                transform("world", "base_truth"),
            ),
            protobuf(SCAN, descriptor::POINT_CLOUD, point_cloud::encode(&scan)),
            of_image(TRUE_COLOR, &image("wrist", PixelFormat::Rgb8, &rgb)),
            protobuf(
                TRUE_DEPTH,
                descriptor::RAW_IMAGE,
                foxglove::encode_depth_m("wrist", STAMP, [2, 2], &[0.5, 1.0, 1.5, 0.0]),
            ),
            protobuf(
                TRUE_POSE,
                descriptor::FRAME_TRANSFORM,
                foxglove::encode_true_pose("wrist", STAMP, &pose, None),
            ),
        ],
        log_time: 5,
        chunk: None,
        more: Vec::new(),
    }
}

fn record(opcode: u8, bytes: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(bytes.len() as u64).to_le_bytes(), bytes].concat()
}

fn text(text: &str) -> Vec<u8> {
    [
        &u32::try_from(text.len()).expect("short").to_le_bytes()[..],
        text.as_bytes(),
    ]
    .concat()
}

fn channel(id: u16, part: &Part) -> Vec<u8> {
    let entries: Vec<u8> = part
        .metadata
        .iter()
        .flat_map(|(key, value)| [text(key), text(value)].concat())
        .collect();
    let n_entries = u32::try_from(entries.len()).expect("short").to_le_bytes();
    let ids = [id.to_le_bytes(), id.to_le_bytes()].concat();
    record(
        4,
        &[
            &ids[..],
            &text(part.topic),
            &text(part.encoding),
            &n_entries,
            &entries,
        ]
        .concat(),
    )
}

fn message(channel_id: u16, log_time: u64, data: &[u8]) -> Vec<u8> {
    let number = u32::try_from(log_time).expect("small").to_le_bytes();
    record(
        5,
        &[
            &channel_id.to_le_bytes()[..],
            &number,
            &log_time.to_le_bytes(),
            &log_time.to_le_bytes(),
            data,
        ]
        .concat(),
    )
}

impl Chunk {
    fn around(&self, records: &[u8]) -> Vec<u8> {
        let stored = match self.compression {
            "zstd" => ruzstd::encoding::compress_to_vec(
                records,
                ruzstd::encoding::CompressionLevel::Fastest,
            ),
            "lz4" => {
                let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
                encoder.write_all(records).expect("memory");
                encoder.finish().expect("memory")
            }
            _ => records.to_vec(),
        };
        let checksum = self.checksum.unwrap_or_else(|| crc32fast::hash(records));
        let length = |n_bytes: usize| (n_bytes as u64).to_le_bytes();
        let [n_records, n_stored] = [records.len(), stored.len()].map(length);
        let compression = text(self.compression);
        record(
            6,
            &[
                &[0; 16][..],
                &n_records,
                &checksum.to_le_bytes(),
                &compression,
                &n_stored,
                &stored,
            ]
            .concat(),
        )
    }
}

impl Contents {
    fn bytes(&self) -> Vec<u8> {
        let mut file = mcap::MAGIC.to_vec();
        file.extend(record(1, &[text(self.profile), text("library")].concat()));
        for (name, data) in &self.attachments {
            let n_bytes = (data.len() as u64).to_le_bytes();
            let body = [
                &[0; 16][..],
                &text(name),
                &text("text/plain"),
                &n_bytes,
                data.as_bytes(),
            ]
            .concat();
            let checksum = self
                .attachment_checksum
                .unwrap_or_else(|| crc32fast::hash(&body));
            file.extend(record(9, &[&body[..], &checksum.to_le_bytes()].concat()));
        }
        let mut records = Vec::new();
        for (id, part) in (1_u16..).zip(&self.parts) {
            let (name, encoding, body) = (
                text(part.schema),
                text(self.schema_encoding),
                text(self.schema_text),
            );
            records.extend(record(
                3,
                &[&id.to_le_bytes()[..], &name, &encoding, &body].concat(),
            ));
            records.extend(channel(id, part));
            records.extend(message(id, self.log_time, &part.message));
        }
        file.extend(match &self.chunk {
            Some(chunk) => chunk.around(&records),
            None => records,
        });
        file.extend(&self.more);
        file.extend(record(15, &[0; 4]));
        file.extend(record(2, &[0; 20]));
        file.extend(mcap::MAGIC);
        file
    }

    fn part(&mut self, topic: &str) -> &mut Part {
        self.parts
            .iter_mut()
            .find(|part| part.topic == topic)
            .expect("a known topic")
    }

    /// Appends fields to a message. If several fields have the same number, readers use the last of
    /// them.
    fn append(&mut self, topic: &str, fields: &Message) {
        self.part(topic).message.extend(fields.clone().into_bytes());
    }

    /// Replaces text in a joint state.
    fn replace(&mut self, from: &str, to: &str) {
        let state = &mut self.part(JOINTS).message;
        let text = String::from_utf8(state.clone()).expect("text");
        assert!(text.contains(from), "{from} is not in {text}");
        *state = text.replace(from, to).into_bytes();
    }
}

/// Result of reading a file.
#[derive(Debug, PartialEq)]
struct Read {
    samples: Vec<Sample>,
    attachments: [Option<Vec<u8>>; 2],
    mesh_files: Vec<(String, Vec<u8>)>,
    joint_names: Option<Vec<String>>,
}

/// Reads a file. Also returns the notes, and the error or damage.
fn read(contents: &Contents) -> (Read, Vec<String>, Option<String>) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("it.mcap");
    std::fs::write(&path, contents.bytes()).expect("a file");
    let mut read = Read {
        samples: Vec::new(),
        attachments: [None, None],
        mesh_files: Vec::new(),
        joint_names: None,
    };
    let mut recording = match Recording::open(&path) {
        Ok(recording) => recording,
        Err(error) => return (read, Vec::new(), Some(with_source(&error))),
    };
    let refused = loop {
        match recording.next_sample() {
            Ok(Some(sample)) => read.samples.push(sample),
            Ok(None) => break recording.damage().map(str::to_owned),
            Err(error) => break Some(with_source(&error)),
        }
    };
    read.attachments =
        [RIG_FILE, URDF_FILE].map(|name| recording.attachment(name).map(<[u8]>::to_vec));
    read.mesh_files = recording
        .mesh_files()
        .map(|(file, data)| (file.to_owned(), data.to_vec()))
        .collect();
    read.joint_names = recording.joint_names().map(<[String]>::to_vec);
    let notes = recording
        .notes
        .0
        .values()
        .chain(&recording.unused)
        .cloned()
        .collect();
    (read, notes, refused)
}

fn with_source(error: &crate::Error) -> String {
    let source = std::error::Error::source(error).map(|source| format!(": {source}"));
    format!("{error}{}", source.unwrap_or_default())
}

type Change = fn(&mut Contents);

/// Each case has a row of the table in docs/reference/recording.md, words that the note or error
/// contains, and a change to a file.
const CASES: &[(&str, &str, Change)] = &[
    ("profile and library of the header", "", |file| {
        file.profile = "ros2"
    }),
    ("compression with zstd or lz4", "", |file| {
        file.chunk = Some(Chunk {
            compression: "zstd",
            checksum: None,
        })
    }),
    ("compression with zstd or lz4", "", |file| {
        file.chunk = Some(Chunk {
            compression: "lz4",
            checksum: None,
        })
    }),
    ("compression with zstd or lz4", "", |file| {
        file.chunk = Some(Chunk {
            compression: "",
            checksum: Some(0),
        })
    }),
    (
        "other compression",
        "compressed with \"brotli\", supported are zstd and lz4",
        |file| {
            file.chunk = Some(Chunk {
                compression: "brotli",
                checksum: None,
            });
        },
    ),
    (
        "wrong checksum of a chunk or attachment",
        "a chunk has the checksum",
        |file| {
            file.chunk = Some(Chunk {
                compression: "",
                checksum: Some(1),
            });
        },
    ),
    (
        "wrong checksum of a chunk or attachment",
        "the checksum of attachment \"rig.toml\"",
        |file| {
            file.attachment_checksum = Some(1);
        },
    ),
    ("attachments `rig.toml` and `robot.urdf`", "", |file| {
        file.attachments[0].1 = "[base]\n"
    }),
    ("attachments `rig.toml` and `robot.urdf`", "", |file| {
        file.attachments[1].1 = "<robot name=\"b\"/>"
    }),
    ("attachments `meshes/FILE.gz`", "", |file| {
        file.attachments.push(("meshes/package://a/b.stl.gz", "m"))
    }),
    (
        "another attachment of that name with other contents",
        "another one of this name",
        |file| {
            file.attachments.push((RIG_FILE, "[base]\n"));
        },
    ),
    ("other attachments", "attachment \"notes.txt\"", |file| {
        file.attachments.push(("notes.txt", "hello"))
    }),
    ("metadata records", "metadata \"site\"", |file| {
        file.more = record(12, &[&text("site")[..], &[0; 4]].concat())
    }),
    ("indices, statistics, private records", "", |file| {
        file.more = [record(11, &[0; 46]), record(200, b"x")].concat()
    }),
    ("other topics", "topic \"/tf\"", |file| {
        let part = Part {
            topic: "/tf",
            schema: "tf2_msgs/TFMessage",
            encoding: "cdr",
            ..file.parts[1].clone()
        };
        file.parts.push(part);
    }),
    (
        "encoding of messages",
        "its messages are \"foxglove.RawImage\" in \"cdr\"",
        |file| {
            file.part(COLOR).encoding = "cdr";
        },
    ),
    (
        "name of the schema",
        "expected foxglove.CompressedImage or foxglove.RawImage in \"protobuf\"",
        |file| {
            file.part(COMPRESSED).schema = "foxglove.CompressedVideo";
        },
    ),
    (
        "name of the schema",
        "expected fieldrig.JointState in \"json\"",
        |file| file.part(JOINTS).schema = "",
    ),
    ("encoding and text of the schema", "", |file| {
        (file.schema_encoding, file.schema_text) = ("omgidl", "struct A {}")
    }),
    ("`joint_names`", "", |file| {
        file.part(JOINTS).metadata = vec![("joint_names", "b,a")]
    }),
    ("no `joint_names`", "does not list joint_names", |file| {
        file.part(JOINTS).metadata.clear()
    }),
    ("no `joint_names`", "does not list joint_names", |file| {
        file.part(JOINTS).metadata[0].1 = ""
    }),
    (
        "other `joint_names` in another channel",
        "the joint_names b,a, expected those of the first one, a,b",
        |file| {
            let part = Part {
                metadata: vec![("joint_names", "b,a")],
                ..file.parts[0].clone()
            };
            file.parts.push(part);
        },
    ),
    (
        "`meters_per_count` of the channel",
        "meters_per_count is 0.0001 in the metadata of the channel",
        |file| {
            file.part(DEPTH).metadata[0].1 = "0.0001";
        },
    ),
    (
        "other metadata of a channel",
        "metadata \"serial\" of topic \"/camera/wrist/color\"",
        |file| {
            file.part(COLOR).metadata.push(("serial", "17"));
        },
    ),
    (
        "another channel with the same number",
        "the same number, 1",
        |file| {
            let part = Part {
                topic: "/tf",
                ..file.parts[1].clone()
            };
            file.more = channel(1, &part);
        },
    ),
    (
        "another channel with the same number",
        "the same number, 2",
        |file| {
            let part = Part {
                topic: COMPRESSED,
                ..file.parts[1].clone()
            };
            file.more = [
                record(
                    3,
                    &[
                        &2_u16.to_le_bytes()[..],
                        &text(part.schema),
                        &text(""),
                        &text(""),
                    ]
                    .concat(),
                ),
                channel(2, &part),
            ]
            .concat();
        },
    ),
    (
        "channel that is not announced",
        "a message on channel 99",
        |file| file.more = message(99, 5, b"x"),
    ),
    ("`log_time`, `publish_time`, `sequence`", "", |file| {
        file.log_time = 77
    }),
    ("`timestamp`", "", |file| {
        file.append(
            COLOR,
            Message::default().message(1, Message::default().varint(1, 2)),
        )
    }),
    ("`timestamp`", "", |file| {
        file.append(
            BASE,
            Message::default().message(1, Message::default().varint(1, 2)),
        )
    }),
    ("`timestamp`", "", |file| {
        file.append(
            SCAN,
            Message::default().message(1, Message::default().varint(1, 2)),
        )
    }),
    ("`timestamp`", "", |file| {
        file.replace("\"sec\":1", "\"sec\":2")
    }),
    (
        "`timestamp` with nanoseconds beyond one second",
        "field 1 is outside its range",
        |file| {
            file.append(
                COLOR,
                Message::default().message(1, Message::default().varint(2, 2_000_000_000)),
            );
        },
    ),
    (
        "`timestamp` with nanoseconds beyond one second",
        "the timestamp is out of range",
        |file| {
            file.replace("\"nsec\":500000000", "\"nsec\":1500000000");
        },
    ),
    ("missing field", "the timestamp is missing", |file| {
        file.part(COLOR).message.clear()
    }),
    ("missing field", "the data is missing", |file| {
        file.part(SCAN).message.clear()
    }),
    ("missing field", "missing field `velocity`", |file| {
        file.replace("velocity", "velocities")
    }),
    ("unknown field", "not used: 1099; a newer version", |file| {
        file.append(COLOR, Message::default().varint(1099, 1))
    }),
    ("unknown field", "not used: 1099; a newer version", |file| {
        file.append(BASE, Message::default().varint(1099, 1))
    }),
    (
        "unknown field",
        "not used: names; a newer version",
        |file| file.replace("{\"timestamp\"", "{\"names\":[],\"timestamp\""),
    ),
    ("image: `data`", "", |file| {
        file.append(COLOR, Message::default().bytes(6, &[9; 12]))
    }),
    ("image: `data`", "", |file| {
        file.append(COMPRESSED, Message::default().bytes(2, &[9; 12]))
    }),
    ("image: `encoding`, `format`", "", |file| {
        file.append(COLOR, Message::default().bytes(4, b"bgr8"))
    }),
    ("image: `encoding`, `format`", "", |file| {
        file.append(COMPRESSED, Message::default().bytes(3, b"jpeg"))
    }),
    (
        "image: unknown `encoding` or `format`",
        "the pixel format \"webp\" is unknown",
        |file| {
            file.append(COMPRESSED, Message::default().bytes(3, b"webp"));
        },
    ),
    (
        "image: unknown `encoding` or `format`",
        "the pixel format \"bayer_rggb8\" is unknown",
        |file| {
            file.append(COLOR, Message::default().bytes(4, b"bayer_rggb8"));
        },
    ),
    (
        "image: depth on a color topic, or color on a depth topic",
        "encoding is 16UC1 (depth), expected a color",
        |file| {
            file.part(COLOR).message = file.part(DEPTH).message.clone();
        },
    ),
    (
        "image: depth on a color topic, or color on a depth topic",
        "encoding is a color format, expected 16UC1",
        |file| {
            file.part(DEPTH).message = file.part(COLOR).message.clone();
        },
    ),
    (
        "image: `width`, `height`, `width_px`, `height_px`",
        "",
        |file| {
            file.append(COLOR, Message::default().fixed32(3, 1));
        },
    ),
    (
        "image: `width`, `height`, `width_px`, `height_px`",
        "",
        |file| {
            file.append(COMPRESSED, Message::default().fixed32(1003, 3));
        },
    ),
    (
        "image: size of 0",
        "the width or height is missing",
        |file| file.append(COLOR, Message::default().fixed32(3, 0)),
    ),
    (
        "image: size of 0",
        "the width_px or height_px is missing",
        |file| {
            file.append(COMPRESSED, Message::default().fixed32(1003, 0));
        },
    ),
    ("image: `step` with padding", "", |file| {
        let rgb: Vec<u8> = (0..12).collect();
        let rows = [&rgb[..6], &[77; 2], &rgb[6..], &[77; 2]].concat();
        file.append(COLOR, Message::default().fixed32(5, 8).bytes(6, &rows));
    }),
    (
        "image: `step` that does not fit the data",
        "step is 5, with 12 bytes of data",
        |file| {
            file.append(COLOR, Message::default().fixed32(5, 5));
        },
    ),
    (
        "image: `step` that does not fit the data",
        "step is 8, with 12 bytes of data",
        |file| {
            file.append(COLOR, Message::default().fixed32(5, 8));
        },
    ),
    (
        "image, scan: `frame_id`",
        "frame_id \"cam0\", expected \"wrist\"",
        |file| {
            file.append(COLOR, Message::default().bytes(7, b"cam0"));
        },
    ),
    (
        "image, scan: `frame_id`",
        "frame_id \"laser\", expected \"lidar\"",
        |file| {
            file.append(SCAN, Message::default().bytes(2, b"laser"));
        },
    ),
    ("image: `exposure_secs`, `n_skipped`", "", |file| {
        file.append(COLOR, Message::default().double(1001, 0.01))
    }),
    ("image: `exposure_secs`, `n_skipped`", "", |file| {
        file.append(DEPTH, Message::default().varint(1002, 3))
    }),
    ("image: `meters_per_count`", "", |file| {
        file.append(DEPTH, Message::default().double(1005, 0.002))
    }),
    (
        "image: `meters_per_count` that is not positive",
        "meters_per_count is -0.5, expected a positive",
        |file| {
            file.append(DEPTH, Message::default().double(1005, -0.5));
        },
    ),
    (
        "image: `meters_per_count` that is not positive",
        "meters_per_count is NaN, expected a positive",
        |file| {
            file.append(DEPTH, Message::default().double(1005, f64::NAN));
        },
    ),
    ("image: `yuv_colors`", "", |file| {
        file.append(YUV, Message::default().bytes(1007, b"bt709-full"))
    }),
    (
        "image: unknown `yuv_colors`",
        "\"bt2020\" is unknown",
        |file| {
            file.append(YUV, Message::default().bytes(1007, b"bt2020"));
        },
    ),
    ("pose: `translation`, `rotation`", "", |file| {
        file.append(
            BASE,
            Message::default().message(4, Message::default().double(1, 7.0)),
        );
    }),
    ("pose: `translation`, `rotation`", "", |file| {
        file.append(
            BASE,
            Message::default().message(5, Message::default().double(3, 0.6).double(4, 0.8)),
        );
    }),
    (
        "pose: `rotation` with a length within 1 % of 1",
        "",
        |file| {
            file.append(
                BASE,
                Message::default().message(5, Message::default().double(4, 0.995)),
            );
        },
    ),
    (
        "pose: `rotation` with another length",
        "rotation is a quaternion of length 2, expected",
        |file| {
            file.append(
                BASE,
                Message::default().message(5, Message::default().double(4, 2.0)),
            );
        },
    ),
    (
        "pose: names of the frames",
        "poses of \"base\" in \"odom\", expected \"base\" in \"world\"",
        |file| {
            file.append(BASE, Message::default().bytes(2, b"odom"));
        },
    ),
    (
        "pose: names of the frames exchanged",
        "expected \"world\": the pose is inverted",
        |file| {
            file.append(
                BASE,
                Message::default().bytes(2, b"base").bytes(3, b"world"),
            );
        },
    ),
    (
        "joint state: `position`, `velocity`, `effort`",
        "",
        |file| file.replace("[0.5,-2.0]", "[0.75,-2.0]"),
    ),
    (
        "joint state: `position`, `velocity`, `effort`",
        "",
        |file| file.replace("[0.25,0.0]", "[]"),
    ),
    (
        "joint state: `position`, `velocity`, `effort`",
        "",
        |file| file.replace("[1.0,2.0]", "[1.0,3.0]"),
    ),
    (
        "joint state: other numbers of values",
        "position has 3 numbers, expected one for each of the 2",
        |file| {
            file.replace("[0.5,-2.0]", "[0.5,-2.0,1.0]");
        },
    ),
    (
        "joint state: other numbers of values",
        "velocity has 1 numbers, expected none or 2",
        |file| {
            file.replace("[0.25,0.0]", "[0.25]");
        },
    ),
    (
        "joint state: other numbers of values",
        "effort has 1 numbers, expected none or 2",
        |file| {
            file.replace("[1.0,2.0]", "[1.0]");
        },
    ),
    ("scan: `data`", "", |file| {
        file.append(SCAN, Message::default().bytes(6, &[0; 40]))
    }),
    (
        "scan: `pose` other than the identity",
        "pose is [0.0, 0.0, 0.5] m",
        |file| {
            let mut position = Message::default();
            position.double(3, 0.5);
            file.append(
                SCAN,
                Message::default().message(3, Message::default().message(1, &position)),
            );
        },
    ),
    (
        "scan: other `point_stride` or `fields`",
        "field 4 is outside its range",
        |file| {
            file.append(SCAN, Message::default().fixed32(4, 16));
        },
    ),
    (
        "scan: other `point_stride` or `fields`",
        "intensity at 12 of type 7",
        |file| {
            let mut intensity = Message::default();
            intensity.bytes(1, b"intensity").fixed32(2, 12).varint(3, 7);
            file.append(SCAN, Message::default().message(5, &intensity));
        },
    ),
    ("calibration", "", |file| {
        let part = file.part(CALIBRATION);
        (part.schema, part.encoding, part.message) =
            ("sensor_msgs/CameraInfo", "cdr", vec![1, 2, 3]);
    }),
    ("truth: `data`, `psnr_ceiling`", "", |file| {
        file.append(TRUE_COLOR, Message::default().bytes(6, &[9; 12]))
    }),
    ("truth: `data`, `psnr_ceiling`", "", |file| {
        file.append(TRUE_DEPTH, Message::default().bytes(6, &[0; 16]))
    }),
    ("truth: `data`, `psnr_ceiling`", "", |file| {
        file.append(TRUE_POSE, Message::default().double(1006, 42.0))
    }),
    (
        "truth: pose of another time or camera than its images",
        "the true color of this pose is missing",
        |file| {
            file.append(
                TRUE_POSE,
                Message::default().message(1, Message::default().varint(1, 2)),
            );
        },
    ),
    (
        "truth: pose of another time or camera than its images",
        "the true color of this pose is missing",
        |file| {
            file.part(TRUE_POSE).topic = "/camera/left/truth/pose";
        },
    ),
    (
        "truth: depth of another size or encoding",
        "the pixel format \"16UC1\" is unknown",
        |file| {
            file.append(TRUE_DEPTH, Message::default().bytes(4, b"16UC1"));
        },
    ),
    (
        "truth: depth of another size or encoding",
        "data is 16 bytes, expected 4 bytes for each of 2 x 1",
        |file| {
            file.append(TRUE_DEPTH, Message::default().fixed32(3, 1));
        },
    ),
    (
        "truth: depth of another size or encoding",
        "the true depth of this pose is missing",
        |file| {
            file.append(
                TRUE_DEPTH,
                Message::default().fixed32(3, 1).bytes(6, &[0; 8]),
            );
        },
    ),
];

/// Changes one part of a file at a time, and compares the effect with the table in
/// docs/reference/recording.md.
#[test]
fn parts_of_recordings_are_used_refused_or_named_as_documented() {
    let page = include_str!("../../../../docs/reference/recording.md");
    let section = page
        .split("## Files of other programs")
        .nth(1)
        .and_then(|rest| rest.split("\n## ").next());
    let rows = section.expect("a section").lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| ")?.split(" | ");
        Some((cells.next()?, cells.next()?))
    });
    let documented: BTreeMap<&str, &str> = rows.filter(|(part, _)| *part != "part").collect();
    let tested: BTreeSet<&str> = CASES.iter().map(|(part, ..)| *part).collect();
    assert_eq!(documented.keys().copied().collect::<BTreeSet<_>>(), tested);
    let (unchanged, notes, refused) = read(&contents());
    assert_eq!(
        (unchanged.samples.len(), notes.len(), refused),
        (9, 0, None),
        "{notes:?}"
    );
    for (part, words, change) in CASES {
        let mut file = contents();
        change(&mut file);
        let (changed, notes, refused) = read(&file);
        let context = format!("{part}: {words}: {notes:?}, {refused:?}");
        let is_noted = notes.iter().any(|note| note.contains(words));
        match documented[part] {
            "yes" => assert!(refused.is_none() && changed != unchanged, "{context}"),
            "yes, note" => assert!(
                refused.is_none() && changed != unchanged && is_noted,
                "{context}"
            ),
            "no" => assert!(
                refused.is_none() && changed == unchanged && notes.is_empty(),
                "{context}"
            ),
            "note" => assert!(
                refused.is_none() && changed == unchanged && is_noted,
                "{context}"
            ),
            "refused" => assert!(
                refused.is_some_and(|reason| reason.contains(words)),
                "{context}"
            ),
            other => panic!("{part}: unknown use {other:?}"),
        }
    }
}

#[test]
fn files_without_samples_name_their_contents() {
    let mut other = contents();
    other.parts.truncate(2);
    for (part, topic) in other.parts.iter_mut().zip(["/tf", "/scan"]) {
        part.topic = topic;
    }
    let (_, _, refused) = read(&other);
    let refused = refused.expect("no samples");
    assert!(
        refused.contains("recorded by this program; it contains topic \"/scan\", topic \"/tf\" (see docs/guide/data"),
        "{refused}"
    );
}

#[test]
fn mesh_files_are_kept_up_to_a_limit() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("it.mcap");
    let mut file = contents();
    file.attachments.push(("meshes/a.stl.gz", "first"));
    file.attachments.push(("meshes/a.stl.gz", "second"));
    std::fs::write(&path, file.bytes()).expect("a file");
    let mut recording = Recording::open(&path).expect("a recording");
    let names = |recording: &Recording| -> Vec<String> {
        let files = recording.mesh_files();
        files.map(|(file, _)| file.to_owned()).collect()
    };
    assert_eq!(
        recording.mesh_files().next(),
        Some(("a.stl", &b"first"[..]))
    );
    assert_eq!(recording.notes.0.len(), 1, "the second one is named");
    recording.mesh_bytes = MAX_MESH_BYTES + MAX_MESH_NAME_BYTES - 20;
    recording.attach("meshes/b.stl.gz", b"12345");
    assert_eq!(names(&recording), ["a.stl", "b.stl"]);
    recording.attach("meshes/c.stl.gz", b"1");
    assert_eq!(names(&recording), ["a.stl", "b.stl"]);
    assert!(recording.unused.contains("attachment \"meshes/c.stl.gz\""));
}

#[test]
fn attachments_behind_the_samples_are_read_and_damaged_ones_named() {
    let whole = contents();
    let attachment = |name: &str, checksum: u32| {
        let body = [
            &[0; 16][..],
            &text(name),
            &text(""),
            &3_u64.to_le_bytes(),
            b"abc",
        ]
        .concat();
        let checksum = if checksum == 0 {
            crc32fast::hash(&body)
        } else {
            checksum
        };
        record(9, &[&body[..], &checksum.to_le_bytes()].concat())
    };
    let attached = |urdf_checksum: u32| {
        let mut file = whole.clone();
        file.attachments.truncate(1);
        file.more = attachment(URDF_FILE, urdf_checksum);
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("it.mcap");
        std::fs::write(&path, file.bytes()).expect("a file");
        let recording = Recording::open(&path).expect("a recording");
        let notes: Vec<String> = recording.notes.0.values().cloned().collect();
        (recording.attachment(URDF_FILE).map(<[u8]>::to_vec), notes)
    };
    assert_eq!(attached(0), (Some(b"abc".to_vec()), Vec::new()));
    let (urdf, notes) = attached(7);
    assert!(
        urdf.is_none()
            && notes[0].contains("the checksum of attachment \"robot.urdf\" does not match"),
        "{notes:?}"
    );
}
