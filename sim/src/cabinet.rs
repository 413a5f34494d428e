//! The cabinet of the mobile-arm scene. It is a yellow switchboard of 1 x 1 m with a bar across it,
//! and contains a box with a screen and a switch.
//!
//! The world's origin lies on the floor below the initial base position. The cabinet opens toward
//! it.

use crate::furniture::{Furniture, upright};
use crate::lab_texture;
use crate::light::Occluders;
use crate::mesh::{Mesh, WHOLE};
use crate::objects::Object;
use crate::texture::{self, Texture};
use kinematics::Transform;
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};

/// x coordinate of the cabinet's opening, meters.
pub(crate) const FRONT_X_M: f64 = 2.05;
/// Height of the center of the opening, meters.
pub(crate) const CENTER_Z_M: f64 = 0.95;
/// Half the side length of the opening, meters.
pub(crate) const HALF_M: f64 = 0.5;
/// Depth of the cabinet, meters.
pub(crate) const DEPTH_M: f64 = 0.36;
/// Center of the screen on the box inside, meters.
pub(crate) const SCREEN_M: [f64; 3] = [2.20, 0.12, 0.97];

const SHEET_M: f64 = 0.012;
const BOX_HALF_M: [f64; 3] = [0.09, 0.16, 0.12];
const SWITCH_M: [f64; 3] = [2.36, -0.23, 0.98];
/// Minimum and maximum x of the room, meters. The next constants are half its width and its height.
const ROOM_X_M: [f64; 2] = [-2.2, 2.48];
const ROOM_HALF_Y_M: f64 = 2.4;
const ROOM_HEIGHT_M: f64 = 2.7;

fn furniture() -> Furniture {
    let mut furniture = Furniture::new(2);
    furniture.shelf(&upright([1.75, 2.15, 0.0], -90.0));
    furniture.bench(&upright([-0.2, 2.0, 0.0], -90.0));
    furniture.add_boxes(&upright([1.9, -1.5, 0.0], 35.0), 3);
    furniture.add_boxes(&upright([2.05, 1.05, 0.0], 12.0), 2);
    furniture.bench(&upright([0.4, -2.0, 0.0], 90.0));
    for (y, z, half, ix) in [
        (-1.15, 1.5, [0.38, 0.5], 7),
        (1.05, 1.75, [0.4, 0.45], 2),
        (-1.95, 1.6, [0.3, 0.45], 14),
    ] {
        furniture.poster(&upright([ROOM_X_M[1], y, z], 180.0), half, ix);
    }
    for (x, z, half, ix) in [(0.6, 1.7, [0.5, 0.5], 5), (-1.2, 1.6, [0.4, 0.5], 8)] {
        furniture.poster(&upright([x, ROOM_HALF_Y_M, z], -90.0), half, ix);
        furniture.poster(&upright([x, -ROOM_HALF_Y_M, z], 90.0), half, ix + 5);
    }
    equip(&mut furniture);
    furniture
}

/// Adds the equipment inside the cabinet, which is the box, breakers on a rail, and ducts.
fn equip(furniture: &mut Furniture) {
    let [x, y, z] = SCREEN_M;
    let box_pose = upright([x + BOX_HALF_M[0], y, z], 180.0);
    furniture.add_item(&box_pose, BOX_HALF_M, 12, 12);
    // The screen is slightly in front of the box, to avoid z-fighting.
    let mut screen = Mesh::default();
    let at = Point3::new(x - 0.002, y, z);
    screen.rectangle(
        at,
        Vector3::y() * -0.125,
        Vector3::z() * 0.09,
        lab_texture::picture(9),
    );
    furniture.things.append(screen, Vector3::zeros());
    let back = FRONT_X_M + DEPTH_M - 2.0 * SHEET_M;
    for breaker in 0..14 {
        let y = -0.40 + 0.058 * f64::from(breaker);
        let picture = [13, 14, 15, 10, 7][breaker as usize % 5];
        furniture.add_item(
            &upright([back - 0.05, y, 1.29], 180.0),
            [0.045, 0.025, 0.055],
            picture,
            12,
        );
    }
    furniture.frame(
        &upright([back - 0.012, 0.0, 1.29], 0.0),
        [0.010, 0.46, 0.018],
    );
    furniture.frame(
        &upright([back - 0.035, 0.0, 1.16], 0.0),
        [0.033, 0.46, 0.02],
    );
    furniture.add_item(
        &upright([back - 0.06, 0.28, 0.62], 180.0),
        [0.055, 0.13, 0.10],
        8,
        12,
    );
    furniture.add_item(
        &upright([back - 0.05, -0.12, 0.60], 180.0),
        [0.045, 0.16, 0.08],
        11,
        12,
    );
    let [x, y, z] = SWITCH_M;
    furniture.add_item(&upright([x, y, z], 180.0), [0.03, 0.08, 0.10], 10, 10);
}

/// The sheets of the cabinet and its open door.
fn shell() -> (Mesh, Mesh) {
    let mut yellow = Mesh::default();
    let mut plate = Mesh::default();
    let middle_x = FRONT_X_M + 0.5 * DEPTH_M;
    let mut put =
        |pose: Transform, half: [f64; 3]| yellow.append_at(Mesh::cuboid(half, &[WHOLE; 6]), &pose);
    for side in [-1.0, 1.0] {
        let half = [0.5 * DEPTH_M, SHEET_M, HALF_M];
        put(
            upright([middle_x, side * (HALF_M - SHEET_M), CENTER_Z_M], 0.0),
            half,
        );
        let half = [0.5 * DEPTH_M, HALF_M, SHEET_M];
        put(
            upright([middle_x, 0.0, CENTER_Z_M + side * (HALF_M - SHEET_M)], 0.0),
            half,
        );
    }
    // The door hangs open on the left as viewed from the base.
    let hinge = upright([FRONT_X_M, HALF_M, CENTER_Z_M], 24.0);
    put(
        hinge * upright([-0.02, HALF_M, 0.0], 0.0),
        [SHEET_M, HALF_M, HALF_M],
    );
    // Feet.
    for y in [-0.42, 0.42] {
        let half = 0.5 * (CENTER_Z_M - HALF_M);
        put(upright([middle_x, y, half], 0.0), [0.14, 0.04, half]);
    }
    let back = upright([FRONT_X_M + DEPTH_M - SHEET_M, 0.0, CENTER_Z_M], 180.0);
    plate.append_at(
        Mesh::cuboid(
            [SHEET_M, HALF_M - 2.0 * SHEET_M, HALF_M - 2.0 * SHEET_M],
            &[WHOLE; 6],
        ),
        &back,
    );
    (yellow, plate)
}

/// A round bar between two points.
fn bar(from: [f64; 3], to: [f64; 3], radius_m: f64) -> Mesh {
    let from = Vector3::from(from);
    let to = Vector3::from(to);
    let rotation =
        UnitQuaternion::rotation_between(&Vector3::z(), &(to - from)).unwrap_or_default();
    let length_m = (to - from).norm();
    // The ends start at a small radius instead of 0, where normals would be undefined.
    let profile = [
        [0.0005, 0.0],
        [radius_m, 0.0],
        [radius_m, length_m],
        [0.0005, length_m],
    ];
    let mut mesh = Mesh::default();
    mesh.append_at(
        Mesh::lathe(&profile, 20, WHOLE, false),
        &Transform::from_parts(Translation3::from(from), rotation),
    );
    mesh
}

fn bars() -> Mesh {
    let x = FRONT_X_M - 0.035;
    let z = 0.66;
    let mut mesh = bar([x, -0.49, z], [x, 0.49, z], 0.016);
    for y in [-0.47, 0.47] {
        mesh.append(
            bar([x, y, z], [FRONT_X_M + 0.01, y, z], 0.012),
            Vector3::zeros(),
        );
    }
    mesh
}

/// The switch's lever, and cables as chains of bars.
fn lever_and_cables() -> (Mesh, Mesh) {
    let [x, y, z] = SWITCH_M;
    let mut lever = bar([x - 0.03, y, z - 0.02], [x - 0.095, y, z + 0.045], 0.013);
    lever.append(
        bar([x - 0.028, y, z - 0.055], [x - 0.036, y, z - 0.055], 0.018),
        Vector3::zeros(),
    );
    let mut cables = Mesh::default();
    for (ix, (from_y, to_y)) in [(-0.30, -0.22), (-0.18, 0.05), (0.0, 0.10), (0.14, 0.33)]
        .into_iter()
        .enumerate()
    {
        let depth = 2.325 - 0.02 * ix as f64;
        let point_at = |step| cable_point(depth, [from_y, to_y], step);
        for step in 0..8 {
            cables.append(
                bar(point_at(step), point_at(step + 1), 0.0075),
                Vector3::zeros(),
            );
        }
    }
    (lever, cables)
}

/// Point on a cable that hangs between two y coordinates at a depth, `step` of 8 along it.
fn cable_point(depth: f64, [from_y, to_y]: [f64; 2], step: i32) -> [f64; 3] {
    let share = f64::from(step) / 8.0;
    // A half sine is close enough to a catenary for a picture.
    let sag = 0.05 * (share * std::f64::consts::PI).sin();
    [
        depth - 0.5 * sag,
        from_y + (to_y - from_y) * share + sag,
        1.17 - share * 0.36 - sag,
    ]
}

fn flat(center: [f64; 3], right: Vector3<f64>, up: Vector3<f64>, texture: [f64; 4]) -> Mesh {
    let mut mesh = Mesh::default();
    mesh.rectangle(Point3::from(center), right, up, texture);
    mesh
}

/// All objects except the robot.
pub(crate) fn objects() -> Vec<Object> {
    let Furniture {
        things,
        posters,
        frames,
        ..
    } = furniture();
    let (yellow, plate) = shell();
    let (lever, cables) = lever_and_cables();
    let [near, far] = ROOM_X_M;
    let middle_x = 0.5 * (near + far);
    let half_x = 0.5 * (far - near);
    let half_z = 0.5 * ROOM_HEIGHT_M;
    let mut sides = Mesh::default();
    for side in [-1.0, 1.0] {
        let right = Vector3::x() * (half_x * side);
        // The texture of a wall is a square of the room's height, and repeats along the wall.
        let texture = [0.0, 0.0, 2.0 * half_x / ROOM_HEIGHT_M, 1.0];
        let wall = flat(
            [middle_x, side * ROOM_HALF_Y_M, half_z],
            right,
            Vector3::z() * half_z,
            texture,
        );
        sides.append(wall, Vector3::zeros());
    }
    let right = Vector3::y() * -ROOM_HALF_Y_M;
    let up = Vector3::z() * half_z;
    let back = flat([far, 0.0, half_z], right, up, [0.0, 0.0, 2.0, 1.2]);
    let behind = flat([near, 0.0, half_z], -right, up, [0.0, 0.0, 1.8, 1.0]);
    sides.append(behind, Vector3::zeros());
    let floor = flat(
        [middle_x, 0.0, 0.0],
        Vector3::x() * half_x,
        Vector3::y() * ROOM_HALF_Y_M,
        WHOLE,
    );
    let ceiling = flat(
        [middle_x, 0.0, ROOM_HEIGHT_M],
        Vector3::x() * half_x,
        Vector3::y() * -ROOM_HALF_Y_M,
        WHOLE,
    );
    vec![
        Object::in_world("things", "items", things),
        Object::in_world("posters", "posters", posters),
        Object::in_world("frames", "frame", frames),
        Object::in_world("shell", "enamel", yellow),
        Object::in_world("plate", "plate", plate),
        Object::in_world("bars", "chrome", bars()),
        Object::in_world("lever", "red", lever),
        Object::in_world("cables", "cable", cables),
        Object::in_world("sides", "painted", sides),
        Object::in_world("back", "brick", back),
        Object::in_world("floor", "tiles", floor),
        Object::in_world("ceiling", "ceiling", ceiling),
    ]
}

/// The textures by name, with baked lighting.
pub(crate) fn textures() -> Vec<(&'static str, Texture)> {
    /// Distance up to which objects darken a surface, meters. It is about the size of the cabinet's
    /// parts.
    const AMBIENT_REACH_M: f64 = 0.3;
    let mut occluders = Occluders::new(AMBIENT_REACH_M);
    furniture().add_occluders(&mut occluders);
    // The sheets of the cabinet darken its inside.
    let middle_x = FRONT_X_M + 0.5 * DEPTH_M;
    for side in [-1.0, 1.0] {
        let wall = upright([middle_x, side * (HALF_M - SHEET_M), CENTER_Z_M], 0.0);
        occluders.add_box(wall, [0.5 * DEPTH_M, SHEET_M, HALF_M]);
        let lid = upright([middle_x, 0.0, CENTER_Z_M + side * (HALF_M - SHEET_M)], 0.0);
        occluders.add_box(lid, [0.5 * DEPTH_M, HALF_M, SHEET_M]);
    }
    let [near, far] = ROOM_X_M;
    let mut tiles = lab_texture::floor_tiles([far - near, 2.0 * ROOM_HALF_Y_M], 1.1);
    tiles.shade(WHOLE, 100, |u, v, name| {
        // In a texture, v points down, but on the floor, y points up.
        let point = Point3::new(
            near + (far - near) * u,
            (1.0 - 2.0 * v) * ROOM_HALF_Y_M,
            0.0,
        );
        occluders.light_frac(&point, &Vector3::z(), name)
    });
    let mut plate = lab_texture::mounting_plate();
    plate.shade(WHOLE, 80, |u, v, name| {
        let point = Point3::new(
            FRONT_X_M + DEPTH_M - 2.0 * SHEET_M,
            (0.5 - u) * 2.0 * HALF_M,
            CENTER_Z_M + (1.0 - 2.0 * v) * HALF_M,
        );
        occluders.light_frac(&point, &-Vector3::x(), name)
    });
    vec![
        ("items", lab_texture::items()),
        ("posters", lab_texture::posters()),
        ("tiles", tiles),
        ("painted", lab_texture::painted_wall()),
        ("enamel", lab_texture::enamel()),
        ("plate", plate),
        ("brick", texture::brick_wall()),
    ]
}

/// Materials without a texture.
pub(crate) const MATERIALS: &str = "<material name=\"ceiling\" rgba=\"0.74 0.73 0.70 1\" specular=\"0\"/>\n\
     <material name=\"chrome\" rgba=\"0.72 0.74 0.77 1\" specular=\"0.6\" shininess=\"0.8\"/>\n\
     <material name=\"red\" rgba=\"0.80 0.09 0.07 1\" specular=\"0.4\" shininess=\"0.6\"/>\n\
     <material name=\"cable\" rgba=\"0.10 0.16 0.36 1\" specular=\"0.2\" shininess=\"0.5\"/>\n";
