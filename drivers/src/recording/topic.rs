//! Topics of a recording and their contents.

use crate::wire::descriptor::{
    CAMERA_CALIBRATION, COMPRESSED_IMAGE, FRAME_TRANSFORM, POINT_CLOUD, RAW_IMAGE, Schema,
};
use crate::wire::joint_state;

/// Metadata key of the joint names, separated by commas, in the channel of the joints.
pub(super) const JOINT_NAMES: &str = "joint_names";
/// Metadata key of the scale of depth counts, in the channel of the depth images.
pub(super) const METERS_PER_COUNT: &str = "meters_per_count";

/// Names of message encodings in MCAP.
const PROTOBUF: &str = "protobuf";
const JSON: &str = "json";

/// Contents of a topic.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Topic {
    /// Color images of a camera.
    Color(String),
    /// Depth images of a camera.
    Depth(String),
    /// Lens parameters of a camera, for viewers. The rig file also contains them.
    Calibration(String),
    /// Noise-free color image of a simulated camera. It precedes depth and pose of the same image.
    TrueColor(String),
    /// Noise-free depth image of a simulated camera, if requested.
    TrueDepth(String),
    /// True pose of a simulated camera. It completes a ground-truth sample.
    TruePose(String),
    /// Joint states.
    Joints,
    /// Poses of the base.
    Base,
    /// True poses of a simulated base.
    TrueBase,
    /// Scans of a range scanner.
    Range(String),
}

impl Topic {
    /// Name of the topic in the file.
    pub(super) fn name(&self) -> String {
        match self {
            Self::Color(camera) => format!("/camera/{camera}/color"),
            Self::Depth(camera) => format!("/camera/{camera}/depth"),
            Self::Calibration(camera) => format!("/camera/{camera}/calibration"),
            Self::TrueColor(camera) => format!("/camera/{camera}/truth/color"),
            Self::TrueDepth(camera) => format!("/camera/{camera}/truth/depth"),
            Self::TruePose(camera) => format!("/camera/{camera}/truth/pose"),
            Self::Joints => "/joints".into(),
            Self::Base => "/base".into(),
            Self::TrueBase => "/base/truth".into(),
            Self::Range(scanner) => format!("/range/{scanner}/points"),
        }
    }

    /// Message types of the topic in protobuf. Joint states have none, because they are JSON.
    pub(super) fn schemas(&self) -> &'static [Schema] {
        match self {
            Self::Color(_) | Self::TrueColor(_) => &[COMPRESSED_IMAGE, RAW_IMAGE],
            Self::Depth(_) | Self::TrueDepth(_) => &[RAW_IMAGE],
            Self::Calibration(_) => &[CAMERA_CALIBRATION],
            Self::TruePose(_) | Self::Base | Self::TrueBase => &[FRAME_TRANSFORM],
            Self::Range(_) => &[POINT_CLOUD],
            Self::Joints => &[],
        }
    }

    /// Names of the message types that can be read, and their encoding.
    pub(super) fn readable(&self) -> (Vec<&'static str>, &'static str) {
        match self {
            Self::Joints => (vec![joint_state::SCHEMA_NAME], JSON),
            _ => (
                self.schemas().iter().map(|schema| schema.name).collect(),
                PROTOBUF,
            ),
        }
    }

    /// The only key that is read from the metadata of the channel. `None` if no key is read.
    pub(super) fn metadata_key(&self) -> Option<&'static str> {
        match self {
            Self::Joints => Some(JOINT_NAMES),
            Self::Depth(_) => Some(METERS_PER_COUNT),
            _ => None,
        }
    }

    /// Parses a topic name. Returns `None` for topics of other programs.
    pub(super) fn from_name(name: &str) -> Option<Self> {
        match name {
            "/joints" => return Some(Self::Joints),
            "/base" => return Some(Self::Base),
            "/base/truth" => return Some(Self::TrueBase),
            _ => {}
        }
        if let Some(scanner) = name
            .strip_prefix("/range/")
            .and_then(|rest| rest.strip_suffix("/points"))
        {
            return Some(Self::Range(scanner.to_owned()));
        }
        // Names of cameras contain no slash, so the first slash ends the name. Kinds such as
        // `truth/color` may contain further slashes.
        let (camera, kind) = name.strip_prefix("/camera/")?.split_once('/')?;
        let camera = camera.to_owned();
        Some(match kind {
            "color" => Self::Color(camera),
            "depth" => Self::Depth(camera),
            "calibration" => Self::Calibration(camera),
            "truth/color" => Self::TrueColor(camera),
            "truth/depth" => Self::TrueDepth(camera),
            "truth/pose" => Self::TruePose(camera),
            _ => return None,
        })
    }
}

/// Name, encoding and contents of the schema of a channel, and the encoding of its messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Encoding {
    pub(super) schema_name: &'static str,
    pub(super) schema_encoding: &'static str,
    pub(super) schema: Vec<u8>,
    pub(super) message_encoding: &'static str,
}

impl Encoding {
    /// A Foxglove message in protobuf.
    pub(super) fn protobuf(schema: Schema) -> Self {
        Self {
            schema_name: schema.name,
            schema_encoding: PROTOBUF,
            schema: schema.file_descriptor_set(),
            message_encoding: PROTOBUF,
        }
    }

    /// Joint states in JSON with the schema of fieldrig.
    pub(super) fn joint_state() -> Self {
        Self {
            schema_name: joint_state::SCHEMA_NAME,
            schema_encoding: "jsonschema",
            schema: joint_state::SCHEMA.into(),
            message_encoding: JSON,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_round_trip_through_names() {
        let camera = || "wrist".to_owned();
        for topic in [
            Topic::Color(camera()),
            Topic::Depth(camera()),
            Topic::Calibration(camera()),
            Topic::TrueColor(camera()),
            Topic::TrueDepth(camera()),
            Topic::TruePose(camera()),
            Topic::Joints,
            Topic::Base,
            Topic::TrueBase,
            Topic::Range("lidar".to_owned()),
        ] {
            assert_eq!(Topic::from_name(&topic.name()), Some(topic));
        }
        for strange in [
            "/camera/wrist",
            "/camera/wrist/infrared",
            "/range/lidar",
            "/tf",
            "",
        ] {
            assert_eq!(Topic::from_name(strange), None, "{strange}");
        }
    }
}
