//! Objects of the static-arm scene, with their meshes, textures with baked lighting, and poses.

use crate::light::Occluders;
use crate::mesh::{BOX_FACES, Mesh, WHOLE};
use crate::texture::{self, Texture};
use crate::toy;
use kinematics::Transform;
use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Height of the table top above the robot's base, meters.
pub const TABLE_Z_M: f64 = 0.12;
/// Height of the floor, meters.
pub(crate) const FLOOR_Z_M: f64 = -0.75;
/// Center of the target area on the table, meters.
pub const TARGET_XY_M: [f64; 2] = [0.74, 0.0];
/// Half the side of the tag cube, meters.
pub const CUBE_HALF_M: f64 = 0.03;
/// Half sizes of the wooden block, meters.
pub const BLOCK_HALF_M: [f64; 3] = [0.045, 0.02, 0.025];

/// Half sizes of the table top along x and y, meters. The next constant is the x coordinate of its
/// near edge.
const TABLE_HALF_XY_M: [f64; 2] = [0.40, 0.50];
const TABLE_FRONT_X_M: f64 = TARGET_XY_M[0] - 0.34;
const TABLE_HALF_THICKNESS_M: f64 = 0.02;
/// Half width and half height of a wall, meters.
const WALL_HALF_M: [f64; 2] = [0.50, 0.50];
/// The corner where the walls meet, meters.
const CORNER_XY_M: [f64; 2] = [TARGET_XY_M[0] + 0.42, 0.0];

fn on_table(x_m: f64, y_m: f64, above_m: f64, yaw_degrees: f64) -> Transform {
    Transform::from_parts(
        Translation3::new(
            TARGET_XY_M[0] + x_m,
            TARGET_XY_M[1] + y_m,
            TABLE_Z_M + above_m,
        ),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_degrees.to_radians()),
    )
}

/// Pose of the tag cube's center. Its sides +x, -x, +y, -y, +z, -z have the tags 0 to 5.
pub fn world_from_cube() -> Transform {
    on_table(-0.035, 0.062, CUBE_HALF_M, 28.0)
}

/// Pose of a tag on the cube by its id, 0 to 5. On the printed tag, x points right, y points down,
/// and z points into the cube.
pub fn world_from_tag(id: usize) -> Transform {
    let (outward, right, up) = BOX_FACES[id];
    let [outward, right, up] = [outward, right, up].map(Vector3::from);
    // The x axis of a tag points right, y down, and z into the cube.
    let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, -up, -outward]));
    let cube_from_tag = Transform::from_parts(
        Translation3::from(outward * CUBE_HALF_M),
        UnitQuaternion::from_rotation_matrix(&axes),
    );
    world_from_cube() * cube_from_tag
}

/// Pose of the wooden block's center.
pub fn world_from_block() -> Transform {
    on_table(-0.045, -0.058, BLOCK_HALF_M[2], -35.0)
}

fn world_from_toy() -> Transform {
    on_table(0.045, -0.005, 0.0, 205.0)
}

fn table_center() -> Point3<f64> {
    Point3::new(TABLE_FRONT_X_M + TABLE_HALF_XY_M[0], 0.0, TABLE_Z_M)
}

/// Pose of the wall on the +y side (1) or -y side (-1). The x axis points into the room, and z
/// points up. From the corner behind the table, both walls run toward the robot at 45 degrees.
fn world_from_wall(side: f64) -> Transform {
    let half = WALL_HALF_M[0] * std::f64::consts::FRAC_1_SQRT_2;
    let center = Translation3::new(
        CORNER_XY_M[0] - half,
        CORNER_XY_M[1] + side * half,
        TABLE_Z_M + WALL_HALF_M[1],
    );
    Transform::from_parts(
        center,
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -side * 135f64.to_radians()),
    )
}

/// A mesh with the name of its texture or plain material.
pub(crate) struct Object {
    pub(crate) name: &'static str,
    pub(crate) material: &'static str,
    pub(crate) mesh: Mesh,
    pub(crate) world_from_mesh: Transform,
}

impl Object {
    pub(crate) fn new(
        name: &'static str,
        material: &'static str,
        mesh: Mesh,
        world_from_mesh: Transform,
    ) -> Self {
        Self {
            name,
            material,
            mesh,
            world_from_mesh,
        }
    }

    /// An object whose mesh is in world coordinates.
    pub(crate) fn in_world(name: &'static str, material: &'static str, mesh: Mesh) -> Self {
        Self::new(name, material, mesh, Transform::identity())
    }
}

/// All objects except the arm.
pub(crate) fn objects() -> Vec<Object> {
    let occluders = occluders();
    let toy_light = |point: &Point3<f64>, normal: &Vector3<f64>, name: u64| {
        toy_light_frac(&occluders, point, normal, name)
    };
    let sides: [_; 6] = std::array::from_fn(texture::side_rectangle);
    let here = Transform::identity();
    vec![
        Object::new(
            "cube",
            "tags",
            Mesh::cuboid([CUBE_HALF_M; 3], &sides),
            world_from_cube(),
        ),
        Object::new(
            "block",
            "wood",
            Mesh::cuboid(BLOCK_HALF_M, &sides),
            world_from_block(),
        ),
        Object::new("toy_body", "fur", toy::body(&toy_light), world_from_toy()),
        Object::new("toy_fur", "fur", toy::fur(&toy_light), world_from_toy()),
        Object::new("table_top", "metal", table_top(), here),
        Object::new("brick_wall", "brick", wall(), world_from_wall(1.0)),
        Object::new("plaster_wall", "plaster", wall(), world_from_wall(-1.0)),
        Object::new("floor", "concrete", floor(), here),
        Object::new("frame", "frame", frame(), here),
    ]
}

/// Fraction of light at a point of the toy, given in the toy's frame.
fn toy_light_frac(
    occluders: &Occluders,
    point: &Point3<f64>,
    normal: &Vector3<f64>,
    name: u64,
) -> f64 {
    occluders.light_frac(
        &(world_from_toy() * point),
        &(world_from_toy() * normal),
        name,
    )
}

/// The textures by name, with baked lighting.
pub(crate) fn textures() -> Vec<(&'static str, Texture)> {
    let occluders = occluders();
    let [mut brick, mut plaster] = [texture::brick_wall(), texture::plaster_wall()];
    for (wall, side) in [(&mut brick, 1.0), (&mut plaster, -1.0)] {
        let world_from_wall = world_from_wall(side);
        wall.shade(WHOLE, 160, |u, v, name| {
            let point = Point3::new(
                0.0,
                (2.0 * u - 1.0) * WALL_HALF_M[0],
                (1.0 - 2.0 * v) * WALL_HALF_M[1],
            );
            occluders.light_frac(
                &(world_from_wall * point),
                &(world_from_wall * Vector3::x()),
                name,
            )
        });
    }
    let mut metal = texture::metal_table([2.0 * TABLE_HALF_XY_M[1], 2.0 * TABLE_HALF_XY_M[0]]);
    metal.shade(WHOLE, 400, |u, v, name| {
        let right_up = Vector3::new(
            (1.0 - 2.0 * v) * TABLE_HALF_XY_M[0],
            (1.0 - 2.0 * u) * TABLE_HALF_XY_M[1],
            0.0,
        );
        occluders.light_frac(&(table_center() + right_up), &Vector3::z(), name)
    });
    let [mut wood, mut tags] = [texture::wood(), texture::tags()];
    shade_box(&mut wood, &occluders, BLOCK_HALF_M, &world_from_block());
    shade_box(&mut tags, &occluders, [CUBE_HALF_M; 3], &world_from_cube());
    vec![
        ("brick", brick),
        ("plaster", plaster),
        ("metal", metal),
        ("wood", wood),
        ("fur", texture::fur()),
        ("tags", tags),
        ("concrete", texture::concrete()),
    ]
}

pub(crate) fn shade_box(
    texture: &mut Texture,
    occluders: &Occluders,
    half_m: [f64; 3],
    world_from_box: &Transform,
) {
    for side in 0..6 {
        texture.shade(texture::side_rectangle(side), 40, |u, v, name| {
            let (point, normal) = Mesh::on_cuboid(half_m, side, u, v);
            occluders.light_frac(&(world_from_box * point), &(world_from_box * normal), name)
        });
    }
}

fn occluders() -> Occluders {
    const WALL_HALF_THICKNESS_M: f64 = 0.005;
    /// The distance is similar to the size of the objects.
    const AMBIENT_REACH_M: f64 = 0.25;
    let mut occluders = Occluders::new(AMBIENT_REACH_M);
    occluders.add_box(world_from_cube(), [CUBE_HALF_M; 3]);
    occluders.add_box(world_from_block(), BLOCK_HALF_M);
    // The box is centered in the slab, whose top is at the height of the table.
    let table = table_center() - Vector3::new(0.0, 0.0, TABLE_HALF_THICKNESS_M);
    let [half_x, half_y] = TABLE_HALF_XY_M;
    occluders.add_box(
        Translation3::from(table.coords).into(),
        [half_x, half_y, TABLE_HALF_THICKNESS_M],
    );
    for side in [1.0, -1.0] {
        // The box lies behind the surface of the wall.
        let world_from_box =
            world_from_wall(side) * Translation3::new(-WALL_HALF_THICKNESS_M, 0.0, 0.0);
        occluders.add_box(
            world_from_box,
            [WALL_HALF_THICKNESS_M, WALL_HALF_M[0], WALL_HALF_M[1]],
        );
    }
    let world_from_toy = world_from_toy();
    let (center, radius_m) = toy::bounds();
    let ellipsoids = toy::ellipsoids().map(|(center, half_axes)| {
        (
            world_from_toy * center,
            half_axes.map(|axis| world_from_toy * axis),
        )
    });
    occluders.add_ellipsoids(ellipsoids, (world_from_toy * center, radius_m));
    occluders
}

fn table_top() -> Mesh {
    let mut mesh = Mesh::default();
    mesh.rectangle(
        table_center(),
        Vector3::y() * -TABLE_HALF_XY_M[1],
        Vector3::x() * TABLE_HALF_XY_M[0],
        WHOLE,
    );
    mesh
}

fn wall() -> Mesh {
    let right = Vector3::y() * WALL_HALF_M[0];
    let up = Vector3::z() * WALL_HALF_M[1];
    let mut mesh = Mesh::default();
    mesh.rectangle(Point3::origin(), right, up, WHOLE);
    // The wall also has a back, because faces are drawn only from their front.
    mesh.rectangle(Point3::new(-0.01, 0.0, 0.0), -right, up, WHOLE);
    mesh
}

fn floor() -> Mesh {
    let mut mesh = Mesh::default();
    mesh.rectangle(
        Point3::new(0.5, 0.0, FLOOR_Z_M),
        Vector3::x() * 3.0,
        Vector3::y() * 3.0,
        // The texture is repeated, because it would be coarse if it were stretched over the floor.
        [0.0, 0.0, 4.0, 4.0],
    );
    mesh
}

/// Whether a point is above or below the top of the table.
pub(crate) fn is_over_table(point: &Point3<f64>) -> bool {
    let from_center = point - table_center();
    from_center.x.abs() < TABLE_HALF_XY_M[0] && from_center.y.abs() < TABLE_HALF_XY_M[1]
}

/// The robot's pedestal, and the table's edge and legs.
fn frame() -> Mesh {
    let mut mesh = Mesh::default();
    mesh.append(
        Mesh::cuboid([0.15, 0.15, 0.36], &[WHOLE; 6]),
        Vector3::new(-0.02, 0.0, -0.365),
    );
    mesh.append(table_frame(), Vector3::zeros());
    mesh
}

/// The table's edge and legs.
pub(crate) fn table_frame() -> Mesh {
    let mut mesh = Mesh::default();
    let slab = Mesh::cuboid(
        [
            TABLE_HALF_XY_M[0],
            TABLE_HALF_XY_M[1],
            TABLE_HALF_THICKNESS_M,
        ],
        &[WHOLE; 6],
    );
    // The frame is slightly below the table top, to avoid z-fighting.
    mesh.append(
        slab,
        table_center().coords - Vector3::new(0.0, 0.0, TABLE_HALF_THICKNESS_M + 1e-4),
    );
    for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let corner = table_center() + Vector3::new(x * 0.36, y * 0.42, -0.45);
        mesh.append(Mesh::cuboid([0.02, 0.02, 0.41], &[WHOLE; 6]), corner.coords);
    }
    mesh
}
