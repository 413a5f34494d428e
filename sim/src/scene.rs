//! The static-arm scene as a MuJoCo model: table, two walls, target objects, light, and the arm.

use crate::config::{Config, Parent};
use crate::mesh::{Mesh, WHOLE};
use crate::texture::{self, Texture};
use crate::{Error, panda, toy};
use kinematics::Transform;
use mujoco_rs::prelude::MjModel;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use std::fmt::Write as _;

/// Height of the table top above the robot's base, metres.
pub(crate) const TABLE_Z_M: f64 = 0.12;
/// Middle of the target area on the table, metres.
pub(crate) const TARGET_XY_M: [f64; 2] = [0.70, 0.0];
/// Half the side of the tag cube, metres.
pub(crate) const CUBE_HALF_M: f64 = 0.03;
/// Half sizes of the wooden block, metres.
pub(crate) const BLOCK_HALF_M: [f64; 3] = [0.045, 0.02, 0.025];
/// Group of the arm's geometry, so that it can be hidden.
pub(crate) const ARM_GROUP: usize = 1;
/// Nearest and furthest drawn distance, metres.
pub(crate) const NEAR_FAR_M: [f64; 2] = [0.02, 12.0];

const WALL_HALF_WIDTH_M: f64 = 0.50;
const WALL_HALF_HEIGHT_M: f64 = 0.50;
/// The corner where the walls meet, metres.
const CORNER_XY_M: [f64; 2] = [1.12, 0.0];

fn on_table(x_m: f64, y_m: f64, above_m: f64, yaw_degrees: f64) -> Transform {
    Transform::from_parts(
        Translation3::new(TARGET_XY_M[0] + x_m, TARGET_XY_M[1] + y_m, TABLE_Z_M + above_m),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_degrees.to_radians()),
    )
}

/// Pose of the tag cube's centre.
pub(crate) fn world_from_cube() -> Transform {
    on_table(-0.035, 0.062, CUBE_HALF_M, 28.0)
}

/// Pose of the wooden block's centre.
pub(crate) fn world_from_block() -> Transform {
    on_table(-0.045, -0.058, BLOCK_HALF_M[2], -35.0)
}

fn world_from_toy() -> Transform {
    on_table(0.045, -0.005, 0.0, 205.0)
}

/// Builds the model; `scale` of every camera's images decides how large pictures can be drawn.
pub(crate) fn build(config: &Config, largest_px: [u32; 2]) -> Result<MjModel, Error> {
    let mut files = MjVfs::new();
    let mut assets = String::new();
    let mut bodies = String::new();
    for (name, texture) in textures() {
        let png = texture.to_png().map_err(|source| Error::Texture { name, source })?;
        add_file(&mut files, &format!("{name}.png"), &png)?;
        let _ = writeln!(
            assets,
            "<texture name=\"{name}\" type=\"2d\" file=\"{name}.png\"/>\n\
             <material name=\"{name}\" texture=\"{name}\" specular=\"{}\" shininess=\"0.4\"/>",
            if name == "metal" { 0.25 } else { 0.03 }
        );
    }
    for Object { name, material, mesh, world_from_mesh } in objects() {
        add_file(&mut files, &format!("{name}.msh"), &mesh.to_msh())?;
        let _ = writeln!(assets, "<mesh name=\"{name}\" file=\"{name}.msh\" inertia=\"shell\"/>");
        let pose = panda::pose_attributes(&world_from_mesh);
        let _ = writeln!(bodies, "<geom type=\"mesh\" mesh=\"{name}\" material=\"{material}\" {pose}/>");
    }
    let [near, far] = NEAR_FAR_M;
    let [width, height] = largest_px;
    let arm = panda::mjcf(&brackets(config));
    let xml = format!(
        "<mujoco model=\"static-arm\">\n\
         <compiler angle=\"radian\" autolimits=\"true\"/>\n\
         <option timestep=\"0.001\" integrator=\"implicitfast\"><flag contact=\"disable\"/></option>\n\
         <statistic extent=\"1\" center=\"0.7 0 0.2\"/>\n\
         <visual>\n\
         <global offwidth=\"{width}\" offheight=\"{height}\"/>\n\
         <quality shadowsize=\"2048\" offsamples=\"0\" numslices=\"24\" numstacks=\"12\"/>\n\
         <headlight ambient=\"0.34 0.34 0.36\" diffuse=\"0 0 0\" specular=\"0 0 0\"/>\n\
         <map znear=\"{near}\" zfar=\"{far}\" shadowclip=\"0.8\"/>\n\
         </visual>\n\
         <default><geom contype=\"0\" conaffinity=\"0\" group=\"0\"/>\n\
         <default class=\"arm\"><geom contype=\"0\" conaffinity=\"0\" group=\"{ARM_GROUP}\" mass=\"0\"/></default></default>\n\
         <asset>\n{assets}{ARM_MATERIALS}</asset>\n\
         <worldbody>\n{LIGHTS}{bodies}{arm}</worldbody>\n</mujoco>\n"
    );
    add_file(&mut files, "scene.xml", xml.as_bytes())?;
    MjModel::from_xml_vfs("scene.xml", &files).map_err(|error| Error::Scene { reason: error.to_string() })
}

const ARM_MATERIALS: &str = "<material name=\"arm_white\" rgba=\"0.93 0.93 0.92 1\" specular=\"0.4\" shininess=\"0.6\"/>\n\
     <material name=\"arm_gray\" rgba=\"0.28 0.29 0.31 1\" specular=\"0.3\" shininess=\"0.5\"/>\n\
     <material name=\"frame\" rgba=\"0.20 0.21 0.23 1\" specular=\"0.1\"/>\n";

/// One lamp with a shadow, and two that only fill.
const LIGHTS: &str = "<light directional=\"true\" pos=\"0.7 0 0.2\" dir=\"0.42 0.30 -0.86\" diffuse=\"0.62 0.60 0.56\" specular=\"0.3 0.3 0.3\" castshadow=\"true\"/>\n\
     <light directional=\"true\" pos=\"0.7 0 2\" dir=\"0.55 -0.6 -0.45\" diffuse=\"0.20 0.21 0.24\" specular=\"0 0 0\" castshadow=\"false\"/>\n\
     <light directional=\"true\" pos=\"0.7 0 2\" dir=\"-0.4 0.1 -0.5\" diffuse=\"0.10 0.10 0.10\" specular=\"0 0 0\" castshadow=\"false\"/>\n";

fn add_file(files: &mut MjVfs, name: &str, bytes: &[u8]) -> Result<(), Error> {
    files.add_from_buffer(name, bytes).map_err(|error| Error::Scene { reason: format!("{name}: {error}") })
}

fn textures() -> [(&'static str, Texture); 7] {
    [
        ("brick", texture::brick_wall()),
        ("plaster", texture::plaster_wall()),
        ("metal", texture::metal_table()),
        ("wood", texture::wood()),
        ("fur", texture::fur()),
        ("tags", texture::tags()),
        ("concrete", texture::concrete()),
    ]
}

struct Object {
    name: &'static str,
    material: &'static str,
    mesh: Mesh,
    world_from_mesh: Transform,
}

fn objects() -> Vec<Object> {
    let object = |name, material, mesh, world_from_mesh| Object { name, material, mesh, world_from_mesh };
    let here = Transform::identity();
    let tags: [[f64; 4]; 6] = std::array::from_fn(texture::tag_rectangle);
    let long = [0.02, 0.02, 0.95, 0.70];
    let end = [0.05, texture::END_GRAIN_TOP + 0.01, 0.60, 0.99];
    let wood = [end, end, [0.1, 0.4, 0.9, 0.74], [0.05, 0.02, 0.85, 0.34], long, long];
    let mut floor = Mesh::default();
    floor.rectangle(Point3::new(0.5, 0.0, -0.75), Vector3::x() * 3.0, Vector3::y() * 3.0, [0.0, 0.0, 4.0, 4.0]);
    let mut legs = Mesh::cuboid([0.15, 0.15, 0.36], &[WHOLE; 6]);
    for (x, y) in [(0.42, -0.42), (0.42, 0.42), (1.15, -0.42), (1.15, 0.42)] {
        legs.append(Mesh::cuboid([0.02, 0.02, 0.41], &[WHOLE; 6]), Vector3::new(x, y, 0.05));
    }
    vec![
        object("cube", "tags", Mesh::cuboid([CUBE_HALF_M; 3], &tags), world_from_cube()),
        object("block", "wood", Mesh::cuboid(BLOCK_HALF_M, &wood), world_from_block()),
        object("toy_body", "fur", toy::body(), world_from_toy()),
        object("toy_fur", "fur", toy::fur(), world_from_toy()),
        object("table", "metal", table(), here),
        object("brick_wall", "brick", wall(), wall_pose(1.0)),
        object("plaster_wall", "plaster", wall(), wall_pose(-1.0)),
        object("floor", "concrete", floor, here),
        object("legs", "frame", legs, Transform::translation(0.0, 0.0, -0.365)),
    ]
}

/// The table top, four centimetres thick; its texture covers 0.8 m.
fn table() -> Mesh {
    const HALF_M: [f64; 3] = [0.40, 0.50, 0.02];
    let mut mesh = Mesh::cuboid(HALF_M, &[[0.0, 0.0, 1.25, 0.05]; 6]);
    mesh.translate(Vector3::new(0.36 + HALF_M[0], 0.0, TABLE_Z_M - HALF_M[2] - 1e-4));
    let mut top = Mesh::default();
    let center = Point3::new(0.36 + HALF_M[0], 0.0, TABLE_Z_M);
    top.rectangle(center, Vector3::y() * -HALF_M[1], Vector3::x() * HALF_M[0], [0.0, 0.0, 1.25, 1.0]);
    mesh.append(top, Vector3::zeros());
    mesh
}

/// A wall in its own frame: x outward to the room, z up.
fn wall() -> Mesh {
    let mut mesh = Mesh::default();
    mesh.rectangle(Point3::origin(), Vector3::y() * WALL_HALF_WIDTH_M, Vector3::z() * WALL_HALF_HEIGHT_M, WHOLE);
    mesh.rectangle(
        Point3::new(-0.01, 0.0, 0.0),
        Vector3::y() * -WALL_HALF_WIDTH_M,
        Vector3::z() * WALL_HALF_HEIGHT_M,
        [0.0, 0.0, 0.05, 0.05],
    );
    mesh
}

/// The wall on the side of +y (1) or -y (-1); both start at the corner and run back at 45 degrees.
fn wall_pose(side: f64) -> Transform {
    let half = WALL_HALF_WIDTH_M * std::f64::consts::FRAC_1_SQRT_2;
    let center = Translation3::new(CORNER_XY_M[0] - half, CORNER_XY_M[1] + side * half, TABLE_Z_M + WALL_HALF_HEIGHT_M);
    // Its outward x axis points back to the robot and away from its own side.
    let yaw_degrees = if side > 0.0 { -135.0 } else { 135.0 };
    Transform::from_parts(center, UnitQuaternion::from_axis_angle(&Vector3::z_axis(), f64::to_radians(yaw_degrees)))
}

/// Bodies of the cameras on the flange, just behind their optical centres.
fn brackets(config: &Config) -> String {
    let mut xml = String::new();
    for camera in config.cameras.iter().filter(|camera| camera.parent == Parent::Flange) {
        let pose = panda::pose_attributes(&(camera.parent_from_camera * Translation3::new(0.0, 0.0, -0.016)));
        let [x, y, z] = (camera.parent_from_camera * Point3::new(0.0, 0.0, -0.02)).coords.into();
        let _ = writeln!(
            xml,
            "<geom type=\"box\" {pose} size=\"0.045 0.0125 0.0125\" material=\"arm_gray\"/>\n\
             <geom type=\"capsule\" fromto=\"0 0 0 {x} {y} {z}\" size=\"0.008\" material=\"arm_gray\"/>"
        );
    }
    xml
}
