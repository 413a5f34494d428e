//! Self-description of the protobuf messages in a recording, so that any MCAP viewer can read them.
//!
//! The encoding follows `google/protobuf/descriptor.proto`. Names and numbers are from the Foxglove
//! schemas (docs.foxglove.dev/docs/sdk/schemas). Fields from number 1001 are extensions by
//! fieldrig.

use super::protobuf::{Message, fields};

/// Names and numbers of one message type.
#[derive(Clone, Copy, Debug)]
pub struct Schema {
    /// Package and name, `foxglove.RawImage`.
    pub name: &'static str,
    fields: &'static [FieldSpec],
    dependencies: &'static [&'static Self],
    enums: &'static [EnumSpec],
}

/// Names of an enum declared in a message, by number from zero.
#[derive(Clone, Copy, Debug)]
struct EnumSpec {
    name: &'static str,
    values: &'static [&'static str],
}

#[derive(Clone, Copy, Debug)]
struct FieldSpec {
    name: &'static str,
    number: u32,
    kind: Kind,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    Double,
    Doubles,
    Int64,
    Uint64,
    Int32,
    Fixed32,
    Text,
    Bytes,
    Message(&'static str),
    Messages(&'static str),
    Enum(&'static str),
}

const fn field(name: &'static str, number: u32, kind: Kind) -> FieldSpec {
    FieldSpec { name, number, kind }
}

const TIMESTAMP: Schema = Schema {
    name: "google.protobuf.Timestamp",
    fields: &[
        field("seconds", 1, Kind::Int64),
        field("nanos", 2, Kind::Int32),
    ],
    dependencies: &[],
    enums: &[],
};

const VECTOR3: Schema = Schema {
    name: "foxglove.Vector3",
    fields: &[
        field("x", 1, Kind::Double),
        field("y", 2, Kind::Double),
        field("z", 3, Kind::Double),
    ],
    dependencies: &[],
    enums: &[],
};

const QUATERNION: Schema = Schema {
    name: "foxglove.Quaternion",
    fields: &[
        field("x", 1, Kind::Double),
        field("y", 2, Kind::Double),
        field("z", 3, Kind::Double),
        field("w", 4, Kind::Double),
    ],
    dependencies: &[],
    enums: &[],
};

/// A compressed color image.
pub const COMPRESSED_IMAGE: Schema = Schema {
    name: "foxglove.CompressedImage",
    fields: &[
        field("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
        field("data", 2, Kind::Bytes),
        field("format", 3, Kind::Text),
        field("frame_id", 4, Kind::Text),
        field("exposure_secs", 1001, Kind::Double),
        field("n_skipped", 1002, Kind::Uint64),
        field("width_px", 1003, Kind::Fixed32),
        field("height_px", 1004, Kind::Fixed32),
    ],
    dependencies: &[&TIMESTAMP],
    enums: &[],
};

/// An uncompressed color or depth image.
pub const RAW_IMAGE: Schema = Schema {
    name: "foxglove.RawImage",
    fields: &[
        field("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
        field("width", 2, Kind::Fixed32),
        field("height", 3, Kind::Fixed32),
        field("encoding", 4, Kind::Text),
        field("step", 5, Kind::Fixed32),
        field("data", 6, Kind::Bytes),
        field("frame_id", 7, Kind::Text),
        field("exposure_secs", 1001, Kind::Double),
        field("n_skipped", 1002, Kind::Uint64),
        field("meters_per_count", 1005, Kind::Double),
        field("yuv_colors", 1007, Kind::Text),
    ],
    dependencies: &[&TIMESTAMP],
    enums: &[],
};

/// Intrinsics of a camera.
pub const CAMERA_CALIBRATION: Schema = Schema {
    name: "foxglove.CameraCalibration",
    fields: &[
        field("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
        field("width", 2, Kind::Fixed32),
        field("height", 3, Kind::Fixed32),
        field("distortion_model", 4, Kind::Text),
        field("D", 5, Kind::Doubles),
        field("K", 6, Kind::Doubles),
        field("R", 7, Kind::Doubles),
        field("P", 8, Kind::Doubles),
        field("frame_id", 9, Kind::Text),
    ],
    dependencies: &[&TIMESTAMP],
    enums: &[],
};

/// Pose of one frame in another.
pub const FRAME_TRANSFORM: Schema = Schema {
    name: "foxglove.FrameTransform",
    fields: &[
        field("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
        field("parent_frame_id", 2, Kind::Text),
        field("child_frame_id", 3, Kind::Text),
        field("translation", 4, Kind::Message(".foxglove.Vector3")),
        field("rotation", 5, Kind::Message(".foxglove.Quaternion")),
        field("psnr_ceiling", 1006, Kind::Double),
    ],
    dependencies: &[&TIMESTAMP, &VECTOR3, &QUATERNION],
    enums: &[],
};

const POSE: Schema = Schema {
    name: "foxglove.Pose",
    fields: &[
        field("position", 1, Kind::Message(".foxglove.Vector3")),
        field("orientation", 2, Kind::Message(".foxglove.Quaternion")),
    ],
    dependencies: &[&VECTOR3, &QUATERNION],
    enums: &[],
};

const PACKED_ELEMENT_FIELD: Schema = Schema {
    name: "foxglove.PackedElementField",
    fields: &[
        field("name", 1, Kind::Text),
        field("offset", 2, Kind::Fixed32),
        field(
            "type",
            3,
            Kind::Enum(".foxglove.PackedElementField.NumericType"),
        ),
    ],
    dependencies: &[],
    enums: &[EnumSpec {
        name: "NumericType",
        values: &[
            "UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64",
        ],
    }],
};

/// Points of a range scanner.
pub const POINT_CLOUD: Schema = Schema {
    name: "foxglove.PointCloud",
    fields: &[
        field("timestamp", 1, Kind::Message(".google.protobuf.Timestamp")),
        field("frame_id", 2, Kind::Text),
        field("pose", 3, Kind::Message(".foxglove.Pose")),
        field("point_stride", 4, Kind::Fixed32),
        field("fields", 5, Kind::Messages(".foxglove.PackedElementField")),
        field("data", 6, Kind::Bytes),
    ],
    dependencies: &[
        &TIMESTAMP,
        &VECTOR3,
        &QUATERNION,
        &POSE,
        &PACKED_ELEMENT_FIELD,
    ],
    enums: &[],
};

impl Schema {
    /// Numbers of the fields of an encoded message that are not in the schema, in the order of the
    /// message.
    pub fn unknown_fields(&self, message: &[u8]) -> Vec<u32> {
        let is_unknown = |number: &u32| self.fields.iter().all(|field| field.number != *number);
        fields(message)
            .map_while(Result::ok)
            .map(|field| field.number)
            .filter(is_unknown)
            .collect()
    }

    /// The encoded `FileDescriptorSet`. It contains the files that this message depends on,
    /// followed by its own file.
    pub fn file_descriptor_set(&self) -> Vec<u8> {
        let mut set = Message::default();
        // Readers resolve imports in order, so dependencies come before the file that uses them.
        for dependency in self.dependencies {
            set.message(1, &dependency.file());
        }
        set.message(1, &self.file());
        set.into_bytes()
    }

    /// One `FileDescriptorProto` with one message in it.
    fn file(&self) -> Message {
        let (package, name) = self.name.rsplit_once('.').unwrap_or(("", self.name));
        let mut message = Message::default();
        message.bytes(1, name.as_bytes());
        for field in self.fields {
            message.message(2, &field.encode());
        }
        for enum_spec in self.enums {
            message.message(4, &enum_spec.encode());
        }
        let mut file = Message::default();
        file.bytes(1, self.path().as_bytes())
            .bytes(2, package.as_bytes());
        for dependency in self.dependencies {
            file.bytes(3, dependency.path().as_bytes());
        }
        file.message(4, &message).bytes(12, b"proto3");
        file
    }

    /// Path of the `.proto` file, as other files import it.
    fn path(&self) -> String {
        if self.name == TIMESTAMP.name {
            "google/protobuf/timestamp.proto".into()
        } else {
            format!("{}.proto", self.name.replace('.', "/"))
        }
    }
}

impl EnumSpec {
    /// The enum as an `EnumDescriptorProto`.
    fn encode(&self) -> Message {
        let mut encoded = Message::default();
        encoded.bytes(1, self.name.as_bytes());
        for (number, name) in (0..).zip(self.values) {
            let mut value = Message::default();
            value.bytes(1, name.as_bytes()).varint(2, number);
            encoded.message(2, &value);
        }
        encoded
    }
}

impl FieldSpec {
    /// The field as a `FieldDescriptorProto`.
    fn encode(&self) -> Message {
        const OPTIONAL: u64 = 1;
        const REPEATED: u64 = 3;
        let (label, type_number, type_name) = match self.kind {
            Kind::Double => (OPTIONAL, 1, None),
            Kind::Doubles => (REPEATED, 1, None),
            Kind::Int64 => (OPTIONAL, 3, None),
            Kind::Uint64 => (OPTIONAL, 4, None),
            Kind::Int32 => (OPTIONAL, 5, None),
            Kind::Fixed32 => (OPTIONAL, 7, None),
            Kind::Text => (OPTIONAL, 9, None),
            Kind::Message(name) => (OPTIONAL, 11, Some(name)),
            Kind::Messages(name) => (REPEATED, 11, Some(name)),
            Kind::Enum(name) => (OPTIONAL, 14, Some(name)),
            Kind::Bytes => (OPTIONAL, 12, None),
        };
        let mut encoded = Message::default();
        encoded
            .bytes(1, self.name.as_bytes())
            .varint(3, u64::from(self.number))
            .varint(4, label)
            .varint(5, type_number);
        if let Some(name) = type_name {
            encoded.bytes(6, name.as_bytes());
        }
        encoded
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dependencies_precede_their_users() {
        let set = FRAME_TRANSFORM.file_descriptor_set();
        let paths: Vec<String> = fields(&set)
            .map(|file| {
                let file = file.expect("own bytes").bytes().expect("a message");
                let path = fields(file).next().expect("a name").expect("own bytes");
                path.text().expect("text").to_owned()
            })
            .collect();
        assert_eq!(
            paths,
            [
                "google/protobuf/timestamp.proto",
                "foxglove/Vector3.proto",
                "foxglove/Quaternion.proto",
                "foxglove/FrameTransform.proto"
            ]
        );
    }

    #[test]
    fn fields_of_newer_versions_are_unknown() {
        let mut message = Message::default();
        message
            .double(1006, 42.0)
            .bytes(2, b"world")
            .varint(1099, 7)
            .double(6, 1.0);
        assert_eq!(
            FRAME_TRANSFORM.unknown_fields(&message.into_bytes()),
            [1099, 6]
        );
    }

    #[test]
    fn field_numbers_are_unique() {
        for schema in [
            TIMESTAMP,
            VECTOR3,
            QUATERNION,
            POSE,
            PACKED_ELEMENT_FIELD,
            COMPRESSED_IMAGE,
            RAW_IMAGE,
            CAMERA_CALIBRATION,
            FRAME_TRANSFORM,
            POINT_CLOUD,
        ] {
            let mut numbers: Vec<_> = schema.fields.iter().map(|field| field.number).collect();
            numbers.sort_unstable();
            numbers.dedup();
            assert_eq!(numbers.len(), schema.fields.len(), "{}", schema.name);
        }
    }
}
