//! The laboratory of the mobile base. It has 15 x 10 m, with benches, shelves, crates and posters.
//! A pedestal with a glass bowl stands in the middle. The world's origin is on the floor below the
//! bowl.

use crate::furniture::{Furniture, upright};
use crate::lab_texture;
use crate::light::Occluders;
use crate::mesh::{Mesh, WHOLE};
use crate::objects::{Object, shade_box};
use crate::texture::{self, Texture};
use kinematics::Transform;
use nalgebra::{Point3, Vector3};

/// Half sizes of the room along x and y, meters. The next constant is its height.
pub const ROOM_HALF_M: [f64; 2] = [7.5, 5.0];
/// Height of the ceiling, meters.
pub const ROOM_HEIGHT_M: f64 = 3.0;
/// Half sizes of the pedestal, meters.
pub const PEDESTAL_HALF_M: [f64; 3] = [0.24, 0.24, 0.42];

/// Positions of furniture: `(x, y, heading in degrees)`.
const BENCHES: [[f64; 3]; 7] = [
    [-4.6, -4.55, 90.0],
    [-2.5, -4.55, 90.0],
    [1.2, -4.55, 90.0],
    [4.9, -4.5, 90.0],
    [-3.4, 4.55, -90.0],
    [0.4, 4.55, -90.0],
    [5.2, 4.55, -90.0],
];
const SHELVES: [[f64; 3]; 6] = [
    [-7.2, -2.6, 0.0],
    [-7.2, 0.2, 0.0],
    [-7.2, 2.9, 0.0],
    [7.2, 1.6, 180.0],
    [7.2, -1.9, 180.0],
    [2.8, 4.7, -90.0],
];
const BOX_STACKS: [([f64; 3], usize); 8] = [
    ([4.2, 2.3, 20.0], 3),
    ([4.9, 1.5, -30.0], 2),
    ([-4.4, 2.2, 40.0], 3),
    ([-4.9, -1.9, 10.0], 2),
    ([0.4, -3.5, 70.0], 1),
    ([3.9, -2.9, -15.0], 2),
    ([-1.6, 3.7, 5.0], 2),
    ([6.6, 4.2, 30.0], 4),
];
/// Posters. Each entry has the wall (east, west, north, south), the position along the wall, the
/// height, half the width, half the height of the poster, and the picture.
const POSTERS: [(usize, [f64; 4], usize); 17] = [
    (0, [-3.6, 1.6, 0.5, 0.7], 0),
    (0, [0.0, 1.7, 0.55, 0.4], 7),
    (0, [3.6, 1.5, 0.6, 0.8], 2),
    (1, [-4.1, 1.7, 0.5, 0.6], 10),
    (1, [-1.2, 1.75, 0.42, 0.6], 14),
    (1, [1.6, 1.75, 0.42, 0.55], 8),
    (1, [4.2, 1.5, 0.5, 0.7], 1),
    (2, [-5.6, 1.75, 0.8, 0.7], 4),
    (2, [-1.5, 1.8, 1.1, 0.6], 5),
    (2, [1.2, 1.9, 0.4, 0.55], 3),
    (2, [4.4, 1.8, 0.45, 0.6], 11),
    (2, [6.4, 1.85, 0.5, 0.7], 13),
    (3, [-6.3, 1.6, 0.5, 0.75], 6),
    (3, [-3.6, 1.8, 0.9, 0.65], 12),
    (3, [-0.8, 1.8, 0.6, 0.6], 15),
    (3, [2.8, 1.7, 0.9, 0.7], 5),
    (3, [6.3, 1.7, 0.5, 0.7], 9),
];

/// Pose of a wall by index. The x axis points into the room, and z points up. The origin is on the
/// floor at the middle of the wall.
fn world_from_wall(wall: usize) -> Transform {
    let [x, y] = ROOM_HALF_M;
    match wall {
        0 => upright([x, 0.0, 0.0], 180.0),
        1 => upright([-x, 0.0, 0.0], 0.0),
        2 => upright([0.0, y, 0.0], -90.0),
        _ => upright([0.0, -y, 0.0], 90.0),
    }
}

fn furniture() -> Furniture {
    let mut furniture = Furniture::new(1);
    for [x, y, degrees] in BENCHES {
        furniture.bench(&upright([x, y, 0.0], degrees));
    }
    for [x, y, degrees] in SHELVES {
        furniture.shelf(&upright([x, y, 0.0], degrees));
    }
    for ([x, y, degrees], n_boxes) in BOX_STACKS {
        furniture.add_boxes(&upright([x, y, 0.0], degrees), n_boxes);
    }
    for (wall, [along, z, half_width, half_height], ix) in POSTERS {
        let pose = world_from_wall(wall) * upright([0.0, along, z], 0.0);
        furniture.poster(&pose, [half_width, half_height], ix);
    }
    furniture
}

fn world_from_pedestal() -> Transform {
    upright([0.0, 0.0, PEDESTAL_HALF_M[2]], 25.0)
}

/// All objects except the robot.
pub(crate) fn objects() -> Vec<Object> {
    let Furniture {
        things,
        posters,
        frames,
        ..
    } = furniture();
    let sides: [_; 6] = std::array::from_fn(texture::side_rectangle);
    let mut pedestal = Mesh::default();
    pedestal.append_at(
        Mesh::cuboid(PEDESTAL_HALF_M, &sides),
        &world_from_pedestal(),
    );
    let mut plinth = Mesh::default();
    let [half_x, half_y, half_z] = PEDESTAL_HALF_M;
    let plinth_pose = world_from_pedestal() * upright([0.0, 0.0, 0.06 - half_z], 0.0);
    plinth.append_at(
        Mesh::cuboid([half_x + 0.05, half_y + 0.05, 0.06], &sides),
        &plinth_pose,
    );
    let mut objects = vec![
        Object::in_world("things", "items", things),
        Object::in_world("posters", "posters", posters),
        Object::in_world("frames", "frame", frames),
        Object::in_world("pedestal", "wood", pedestal),
        Object::in_world("plinth", "wood", plinth),
        Object::in_world("walls", "painted", walls()),
        Object::in_world("floor", "tiles", floor()),
        Object::in_world("ceiling", "ceiling", ceiling()),
        Object::in_world("tubes", "tube", tubes()),
        Object::in_world("bowl", "glass", bowl()),
    ];
    let fruits = ["orange", "apple", "lime"];
    for (material, mesh) in fruits.into_iter().zip(fruit()) {
        objects.push(Object::in_world(material, material, mesh));
    }
    objects
}

/// Height of the pedestal's top, meters.
const TOP_M: f64 = 2.0 * PEDESTAL_HALF_M[2];

fn bowl() -> Mesh {
    let outer = [
        [0.06, 0.0],
        [0.07, 0.012],
        [0.12, 0.05],
        [0.165, 0.11],
        [0.18, 0.17],
        [0.172, 0.172],
    ];
    let inner = [
        [0.172, 0.172],
        [0.155, 0.112],
        [0.11, 0.06],
        [0.05, 0.028],
        [0.001, 0.022],
    ];
    let mut mesh = Mesh::default();
    // The bowl has two surfaces, because normals must not be smoothed across the rim.
    for part in [&outer[..], &inner[..]] {
        mesh.append(
            Mesh::lathe(part, 48, WHOLE, true),
            Vector3::new(0.0, 0.0, TOP_M),
        );
    }
    mesh
}

/// Fruit in the bowl, one mesh per color.
fn fruit() -> [Mesh; 3] {
    [
        balls(&[
            [0.055, 0.01, 0.075, 0.042],
            [-0.045, 0.045, 0.075, 0.04],
            [0.0, 0.0, 0.14, 0.041],
        ]),
        balls(&[[-0.02, -0.06, 0.08, 0.044], [0.07, 0.065, 0.115, 0.04]]),
        balls(&[[-0.085, -0.02, 0.105, 0.033], [0.06, -0.065, 0.12, 0.032]]),
    ]
}

/// Slightly flattened spheres, each given by its center above the pedestal and its radius.
fn balls(spheres: &[[f64; 4]]) -> Mesh {
    let mut mesh = Mesh::default();
    for [x, y, z, radius] in spheres {
        let axes = [
            Vector3::x() * *radius,
            Vector3::y() * *radius,
            Vector3::z() * (0.93 * radius),
        ];
        mesh.add_ellipsoid(Point3::new(*x, *y, TOP_M + z), axes, 12, |_, _| 0.5, 0.5);
    }
    mesh
}

fn walls() -> Mesh {
    let mut mesh = Mesh::default();
    for wall in 0..4 {
        let half_width = ROOM_HALF_M[usize::from(wall < 2)];
        let mut flat = Mesh::default();
        let right = Vector3::y() * half_width;
        let up = Vector3::z() * (0.5 * ROOM_HEIGHT_M);
        let texture = [0.0, 0.0, 2.0 * half_width / ROOM_HEIGHT_M, 1.0];
        flat.rectangle(
            Point3::new(0.0, 0.0, 0.5 * ROOM_HEIGHT_M),
            right,
            up,
            texture,
        );
        mesh.append_at(flat, &world_from_wall(wall));
    }
    mesh
}

fn floor() -> Mesh {
    let mut mesh = Mesh::default();
    mesh.rectangle(
        Point3::origin(),
        Vector3::x() * ROOM_HALF_M[0],
        Vector3::y() * ROOM_HALF_M[1],
        WHOLE,
    );
    mesh
}

fn ceiling() -> Mesh {
    let mut mesh = Mesh::default();
    let center = Point3::new(0.0, 0.0, ROOM_HEIGHT_M);
    mesh.rectangle(
        center,
        Vector3::x() * ROOM_HALF_M[0],
        Vector3::y() * -ROOM_HALF_M[1],
        WHOLE,
    );
    // The beams ensure that the ceiling is not of a single color.
    for x in [-5.0, -2.5, 0.0, 2.5, 5.0] {
        mesh.append(
            Mesh::cuboid([0.08, ROOM_HALF_M[1], 0.1], &[WHOLE; 6]),
            Vector3::new(x, 0.0, ROOM_HEIGHT_M - 0.1),
        );
    }
    mesh
}

fn tubes() -> Mesh {
    let mut mesh = Mesh::default();
    for x in [-6.2, -3.7, -1.2, 1.2, 3.7, 6.2] {
        for y in [-2.4, 2.4] {
            mesh.append(
                Mesh::cuboid([0.1, 0.7, 0.03], &[WHOLE; 6]),
                Vector3::new(x, y, ROOM_HEIGHT_M - 0.25),
            );
        }
    }
    mesh
}

/// The textures by name, with baked lighting.
pub(crate) fn textures() -> Vec<(&'static str, Texture)> {
    /// Distance up to which furniture darkens the floor, meters.
    const AMBIENT_REACH_M: f64 = 1.2;
    let mut occluders = Occluders::new(AMBIENT_REACH_M);
    furniture().add_occluders(&mut occluders);
    occluders.add_box(world_from_pedestal(), PEDESTAL_HALF_M);
    let size_m = ROOM_HALF_M.map(|half| 2.0 * half);
    let mut tiles = lab_texture::floor_tiles(size_m, 3.2);
    tiles.shade(WHOLE, 150, |u, v, name| {
        let point = Point3::new(
            (2.0 * u - 1.0) * ROOM_HALF_M[0],
            (1.0 - 2.0 * v) * ROOM_HALF_M[1],
            0.0,
        );
        occluders.light_frac(&point, &Vector3::z(), name)
    });
    let mut wood = texture::wood();
    shade_box(
        &mut wood,
        &occluders,
        PEDESTAL_HALF_M,
        &world_from_pedestal(),
    );
    vec![
        ("items", lab_texture::items()),
        ("posters", lab_texture::posters()),
        ("tiles", tiles),
        ("painted", lab_texture::painted_wall()),
        ("wood", wood),
    ]
}

/// Materials without a texture.
pub(crate) const MATERIALS: &str = "<material name=\"ceiling\" rgba=\"0.78 0.77 0.73 1\" specular=\"0\"/>\n\
     <material name=\"tube\" rgba=\"1 1 0.96 1\" emission=\"0.9\"/>\n\
     <material name=\"glass\" rgba=\"0.72 0.88 0.92 0.28\" specular=\"1\" shininess=\"0.9\"/>\n\
     <material name=\"orange\" rgba=\"0.96 0.50 0.08 1\" specular=\"0.2\" shininess=\"0.5\"/>\n\
     <material name=\"apple\" rgba=\"0.78 0.10 0.12 1\" specular=\"0.4\" shininess=\"0.7\"/>\n\
     <material name=\"lime\" rgba=\"0.36 0.62 0.14 1\" specular=\"0.3\" shininess=\"0.6\"/>\n";
