//! The robot that the page draws, its state, and the messages with both.

use crate::clock::ServerClock;
use crate::pose::row_major;
use keyframe::RobotState;
use kinematics::shape::{Geometry, Shape};
use kinematics::urdf::{JointKind, Robot};
use serde::Serialize;
use std::sync::Arc;

/// The robot of a rig.
#[derive(Clone, Debug)]
pub struct RobotDescription {
    /// Links, joints and shapes.
    pub robot: Robot,
    /// The link whose pose is `world_from_base` in a [`RobotState`].
    pub base_link: String,
    /// Names of the joints, in the order of the positions in a [`RobotState`]. All other joints
    /// stay at 0.
    pub joint_names: Vec<String>,
    /// The mesh files that the shapes name.
    pub meshes: Vec<RobotMesh>,
}

/// A mesh file of a robot.
#[derive(Clone, Debug)]
pub struct RobotMesh {
    /// The file as named in the URDF.
    pub file: String,
    /// Type of the file.
    pub format: MeshFormat,
    /// Contents.
    pub bytes: Arc<[u8]>,
}

/// Type of a mesh file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum MeshFormat {
    /// Binary or text STL.
    Stl,
    /// COLLADA.
    Dae,
    /// Wavefront OBJ.
    Obj,
}

impl MeshFormat {
    /// The format of a file with this name; `None` if it is not supported.
    pub fn of_file(file: &str) -> Option<Self> {
        let (_, extension) = file.rsplit_once('.')?;
        [Self::Stl, Self::Dae, Self::Obj]
            .into_iter()
            .find(|format| extension.eq_ignore_ascii_case(format.extension()))
    }

    pub(crate) fn extension(self) -> &'static str {
        match self {
            Self::Stl => "stl",
            Self::Dae => "dae",
            Self::Obj => "obj",
        }
    }

    pub(crate) fn content_type(self) -> &'static str {
        match self {
            Self::Stl => "model/stl",
            Self::Dae => "model/vnd.collada+xml",
            Self::Obj => "model/obj",
        }
    }
}

/// Fields of `robot_state`.
#[derive(Debug, Serialize)]
pub(crate) struct RobotStateMessage {
    stamp_nanos: i64,
    captured_millis: f64,
    world_from_base: [f64; 16],
    positions: Vec<f64>,
}

impl RobotStateMessage {
    /// Numbers are rounded to 10 micrometers or microradians, which shortens the message to a
    /// third.
    pub(crate) fn new(state: &RobotState, clock: ServerClock) -> Self {
        // The rounding error is much less than a pixel. At a distance of 1 m and a focal length of
        // 600 pixels, a pixel covers 1.7 mm.
        let rounded = |value: f64| (value * 1e5).round() / 1e5;
        Self {
            stamp_nanos: state.stamp.0,
            captured_millis: (clock.millis(state.captured_at) * 1e2).round() / 1e2,
            world_from_base: row_major(&state.world_from_base).map(rounded),
            positions: state.positions.iter().copied().map(rounded).collect(),
        }
    }
}

/// Fields of `robot`.
#[derive(Debug, Serialize)]
pub(crate) struct RobotMessage<'a> {
    name: &'a str,
    base_link: &'a str,
    joint_names: &'a [String],
    links: Vec<LinkMessage<'a>>,
    joints: Vec<JointMessage<'a>>,
}

#[derive(Debug, Serialize)]
struct LinkMessage<'a> {
    name: &'a str,
    shapes: Vec<ShapeMessage>,
}

#[derive(Debug, Serialize)]
struct JointMessage<'a> {
    name: &'a str,
    kind: &'static str,
    parent: &'a str,
    child: &'a str,
    parent_from_joint: [f64; 16],
    axis: [f64; 3],
    mimic: Option<MimicMessage<'a>>,
}

#[derive(Debug, Serialize)]
struct MimicMessage<'a> {
    source: &'a str,
    multiplier: f64,
    offset: f64,
}

#[derive(Debug, Serialize)]
struct ShapeMessage {
    link_from_shape: [f64; 16],
    color_srgba: Option<[f64; 4]>,
    #[serde(flatten)]
    geometry: GeometryMessage,
}

#[derive(Debug, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum GeometryMessage {
    Box {
        size_m: [f64; 3],
    },
    Cylinder {
        radius_m: f64,
        length_m: f64,
    },
    Capsule {
        radius_m: f64,
        length_m: f64,
    },
    Sphere {
        radius_m: f64,
    },
    Mesh {
        url: String,
        format: MeshFormat,
        scale: [f64; 3],
    },
}

impl<'a> From<&'a RobotDescription> for RobotMessage<'a> {
    fn from(description: &'a RobotDescription) -> Self {
        let robot = &description.robot;
        let joints = robot.joints().iter().map(|joint| JointMessage {
            name: &joint.name,
            kind: match joint.kind {
                // The page draws links behind an unsupported joint as if its position were 0.
                // Kinematic chains from the base to a camera are refused if they contain such a
                // joint, so only the drawing can be wrong.
                JointKind::Fixed | JointKind::Unsupported(_) => "fixed",
                JointKind::Revolute => "revolute",
                JointKind::Prismatic => "prismatic",
            },
            parent: &joint.parent,
            child: &joint.child,
            parent_from_joint: row_major(&joint.parent_from_joint),
            axis: joint.axis.into_inner().into(),
            mimic: joint.mimic.as_ref().map(|mimic| MimicMessage {
                source: &mimic.source,
                multiplier: mimic.multiplier,
                offset: mimic.offset,
            }),
        });
        let links = robot.links().iter().map(|name| LinkMessage {
            name,
            shapes: robot
                .visuals(name)
                .iter()
                .filter_map(|shape| description.shape_message(shape))
                .collect(),
        });
        Self {
            name: robot.name(),
            base_link: &description.base_link,
            joint_names: &description.joint_names,
            links: links.collect(),
            joints: joints.collect(),
        }
    }
}

impl RobotDescription {
    /// The mesh with this file name in its URL, such as `0.stl`.
    pub(crate) fn mesh_at(&self, name: &str) -> Option<&RobotMesh> {
        let (number, extension) = name.split_once('.')?;
        // The name comes from a client. It is only compared and used as an index, never as a path,
        // so that it cannot name another file.
        let mesh = self.meshes.get(number.parse::<usize>().ok()?)?;
        (mesh.format.extension() == extension).then_some(mesh)
    }

    /// `None` for meshes that could not be read.
    fn shape_message(&self, shape: &Shape) -> Option<ShapeMessage> {
        let geometry = match &shape.geometry {
            Geometry::Box { size_m } => GeometryMessage::Box { size_m: *size_m },
            Geometry::Cylinder { radius_m, length_m } => GeometryMessage::Cylinder {
                radius_m: *radius_m,
                length_m: *length_m,
            },
            Geometry::Capsule { radius_m, length_m } => GeometryMessage::Capsule {
                radius_m: *radius_m,
                length_m: *length_m,
            },
            Geometry::Sphere { radius_m } => GeometryMessage::Sphere {
                radius_m: *radius_m,
            },
            Geometry::Mesh { file, scale } => {
                // A robot with a missing shape is more useful than no robot.
                let ix = self.meshes.iter().position(|mesh| mesh.file == *file)?;
                let format = self.meshes[ix].format;
                GeometryMessage::Mesh {
                    url: format!("robot/{ix}.{}", format.extension()),
                    format,
                    scale: *scale,
                }
            }
        };
        let link_from_shape = row_major(&shape.link_from_shape);
        Some(ShapeMessage {
            link_from_shape,
            color_srgba: shape.color_srgba,
            geometry,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{MeshFormat, RobotDescription, RobotMesh, RobotMessage};
    use kinematics::urdf::Robot;

    fn description() -> RobotDescription {
        let urdf = r#"<robot name="r">
            <link name="a"><visual><geometry><mesh filename="package://r/a.STL" scale="2 2 2"/></geometry></visual>
              <visual><geometry><mesh filename="missing.stl"/></geometry></visual></link>
            <link name="b"/>
            <joint name="j" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 2 0"/></joint></robot>"#;
        RobotDescription {
            robot: Robot::parse(urdf).expect("a robot"),
            base_link: "a".to_owned(),
            joint_names: vec!["j".to_owned()],
            meshes: vec![RobotMesh {
                file: "package://r/a.STL".to_owned(),
                format: MeshFormat::of_file("package://r/a.STL").expect("a known format"),
                bytes: [1, 2].into(),
            }],
        }
    }

    #[test]
    fn meshes_have_addresses_and_unread_ones_are_left_out() {
        let description = description();
        let message = serde_json::to_value(RobotMessage::from(&description)).expect("JSON");
        let shapes = message["links"][0]["shapes"].as_array().expect("a list");
        assert_eq!(shapes.len(), 1, "the missing mesh is left out");
        assert_eq!(
            (&shapes[0]["url"], &shapes[0]["scale"][0]),
            (&"robot/0.stl".into(), &2.0.into())
        );
        assert_eq!(
            message["joints"][0]["axis"],
            serde_json::json!([0.0, 1.0, 0.0])
        );
    }

    #[test]
    fn only_meshes_of_the_robot_are_found() {
        let description = description();
        assert_eq!(
            description.mesh_at("0.stl").map(|mesh| mesh.bytes.len()),
            Some(2)
        );
        for name in [
            "0.dae",
            "1.stl",
            "stl",
            "0",
            "",
            "..",
            "../0.stl",
            "+0.stl.stl",
            "-1.stl",
            "a.stl",
        ] {
            assert!(description.mesh_at(name).is_none(), "{name}");
        }
    }
}
