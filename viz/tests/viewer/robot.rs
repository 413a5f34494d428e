//! A robot of simple shapes whose silhouette can be computed exactly.

use kinematics::shape::Geometry;
use kinematics::urdf::Robot;
use kinematics::{Chain, Stamp, Transform};
use nalgebra::{Point3, Vector3};
use std::time::Instant;
use viz::{MeshFormat, RobotDescription, RobotMesh, RobotState};

/// A pedestal, an arm that rotates about z, and a ball that slides along the arm; a mesh that only
/// some tests load.
pub(crate) const URDF: &str = r#"<robot name="crane">
    <material name="yellow"><color rgba="0.9 0.8 0.1 1"/></material>
    <link name="world_link"/>
    <link name="pedestal">
      <visual><origin xyz="0 0 0.15"/><geometry><box size="0.3 0.2 0.3"/></geometry><material name="yellow"/></visual>
    </link>
    <link name="arm">
      <visual><origin xyz="0.25 0 0" rpy="0 1.5707963267948966 0"/><geometry><cylinder radius="0.05" length="0.5"/></geometry>
        <material name="yellow"/></visual>
    </link>
    <link name="tip">
      <visual><geometry><sphere radius="0.1"/></geometry><material name="yellow"/></visual>
    </link>
    <joint name="mount" type="fixed"><parent link="world_link"/><child link="pedestal"/><origin xyz="0 0 0"/></joint>
    <joint name="rotate" type="revolute"><parent link="pedestal"/><child link="arm"/><origin xyz="0 0 0.4"/>
      <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
    <joint name="slide" type="prismatic"><parent link="arm"/><child link="tip"/><origin xyz="0.3 0 0"/>
      <axis xyz="1 0 0"/><limit lower="0" upper="0.3" velocity="1" effort="1"/></joint>
  </robot>"#;

/// The robot, with a mesh that no shape uses.
pub(crate) fn description() -> RobotDescription {
    RobotDescription {
        robot: Robot::parse(URDF).expect("a robot"),
        base_link: "pedestal".to_owned(),
        joint_names: vec!["slide".to_owned(), "rotate".to_owned()],
        meshes: vec![RobotMesh {
            file: "a.stl".to_owned(),
            format: MeshFormat::Stl,
            bytes: (*b"solid a").into(),
        }],
    }
}

/// The robot beside the scene's center, with its arm rotated by `rotation_rad`.
pub(crate) fn state(rotation_rad: f64) -> RobotState {
    RobotState {
        stamp: Stamp(1_000_000),
        captured_at: Instant::now(),
        world_from_base: Transform::translation(-0.4, 0.3, 0.0)
            * Transform::rotation(Vector3::new(0.0, 0.0, 0.2)),
        positions: vec![0.2, rotation_rad],
    }
}

/// The shapes of the robot in one state, for ray casting.
pub(crate) struct PosedShapes(Vec<(Transform, Geometry)>);

impl PosedShapes {
    pub(crate) fn new(state: &RobotState) -> Self {
        let robot = Robot::parse(URDF).expect("a robot");
        let [slide, rotate] = state.positions[..] else {
            panic!("two joints")
        };
        let mut shapes = Vec::new();
        for link in robot.links().iter().filter(|link| *link != "world_link") {
            let chain = Chain::new(&robot, "pedestal", link).expect("a chain");
            let positions: Vec<f64> = chain
                .joint_names()
                .iter()
                .map(|name| if name == "slide" { slide } else { rotate })
                .collect();
            let world_from_link =
                state.world_from_base * chain.forward(&positions).expect("a pose");
            for shape in robot.visuals(link) {
                shapes.push((
                    (world_from_link * shape.link_from_shape).inverse(),
                    shape.geometry.clone(),
                ));
            }
        }
        Self(shapes)
    }

    /// Distance along `direction` at which a ray from `eye` first hits the robot, in lengths of
    /// `direction`.
    pub(crate) fn nearest_hit(&self, eye: Point3<f64>, direction: Vector3<f64>) -> Option<f64> {
        let distances = self.0.iter().filter_map(|(shape_from_world, geometry)| {
            hit(
                geometry,
                shape_from_world * eye,
                shape_from_world * direction,
            )
        });
        distances.min_by(f64::total_cmp)
    }
}

/// The same for a shape at the origin.
fn hit(geometry: &Geometry, eye: Point3<f64>, direction: Vector3<f64>) -> Option<f64> {
    match *geometry {
        Geometry::Box { size_m } => {
            let (mut near, mut far) = (0.0_f64, f64::INFINITY);
            for axis in 0..3 {
                let at = |side: f64| (0.5 * side * size_m[axis] - eye[axis]) / direction[axis];
                (near, far) = (
                    near.max(at(-1.0).min(at(1.0))),
                    far.min(at(-1.0).max(at(1.0))),
                );
            }
            (near < far).then_some(near)
        }
        Geometry::Sphere { radius_m } => {
            let (a, b) = (direction.norm_squared(), direction.dot(&eye.coords));
            let discriminant = b * b - a * (eye.coords.norm_squared() - radius_m * radius_m);
            (discriminant >= 0.0).then(|| (-b - discriminant.sqrt()) / a)
        }
        Geometry::Cylinder { radius_m, length_m } => {
            let (eye_xy, direction_xy) = (eye.coords.xy(), direction.xy());
            let (a, b) = (direction_xy.norm_squared(), direction_xy.dot(&eye_xy));
            let discriminant = b * b - a * (eye_xy.norm_squared() - radius_m * radius_m);
            if discriminant < 0.0 {
                return None;
            }
            let at_cap = |side: f64| (0.5 * side * length_m - eye.z) / direction.z;
            let near = ((-b - discriminant.sqrt()) / a).max(at_cap(-1.0).min(at_cap(1.0)));
            let far = ((-b + discriminant.sqrt()) / a).min(at_cap(-1.0).max(at_cap(1.0)));
            (near < far).then_some(near)
        }
        Geometry::Capsule { .. } | Geometry::Mesh { .. } => panic!("this robot has none"),
    }
}
