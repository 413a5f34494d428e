//! MJCF of a robot from a URDF, with links, joints, shapes and masses.

use super::mesh_file;
use super::model::{LinkNode, TwinModel};
use crate::panda::pose_attributes;
use kinematics::inertial::Inertial;
use kinematics::shape::{Geometry, Shape};
use kinematics::{Transform, urdf};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

/// A robot in MJCF, with the files that it names.
pub(crate) struct RobotBody {
    /// Body elements.
    pub(crate) body: String,
    /// Asset elements.
    pub(crate) assets: String,
    /// Names and contents of mesh files in MuJoCo's format.
    pub(crate) files: Vec<(String, Vec<u8>)>,
}

/// What the body of a robot is made from.
pub(crate) struct BodyPlan<'a> {
    pub(crate) model: &'a TwinModel,
    /// Contents of mesh files, by their names in the URDF.
    pub(crate) meshes: &'a BTreeMap<String, Arc<[u8]>>,
    /// MJCF elements that are added to the flange.
    pub(crate) on_flange: &'a str,
    /// Pose of the base at the start.
    pub(crate) world_from_base: Transform,
    /// Whether the base is moved by setting its pose.
    pub(crate) has_moving_base: bool,
    /// Whether what is estimated or cannot be drawn is logged.
    pub(crate) is_logged: bool,
}

/// Density with which missing masses are estimated from shapes, kg/m^3. Links are partly hollow.
const DENSITY_KG_M3: f64 = 700.0;
/// Smallest and largest estimated mass of a link, kilograms.
const MASS_RANGE_KG: [f64; 2] = [0.05, 20.0];
/// A link without shapes is drawn as bars. This is the radius of a bar as a fraction of its length.
/// The next constant is the range of the radius in meters.
const BAR_RADIUS_FRAC: f64 = 0.14;
const BAR_RADIUS_RANGE_M: [f64; 2] = [0.008, 0.05];
/// Bars shorter than this are not drawn, meters.
const MIN_BAR_M: f64 = 0.01;
/// Color of shapes without one.
const DEFAULT_SRGBA: [f64; 4] = [0.85, 0.85, 0.84, 1.0];

/// Writes the robot. Logs which values are estimated and which shapes cannot be drawn.
pub(crate) fn robot_body(plan: &BodyPlan<'_>) -> RobotBody {
    let mut writer = Writer {
        plan,
        assets: String::new(),
        files: Vec::new(),
        mesh_names: BTreeMap::new(),
        unreadable: BTreeMap::new(),
        estimated_masses: Vec::new(),
        barred: Vec::new(),
    };
    let mocap = if plan.has_moving_base {
        " mocap=\"true\""
    } else {
        ""
    };
    let mut body = format!(
        "<body name=\"base\"{mocap} childclass=\"arm\" {}>\n",
        pose_attributes(&plan.world_from_base)
    );
    let links = plan.model.links();
    let mut n_open = 0;
    for (ix, node) in links.iter().enumerate() {
        // A link at the depth of an open one ends it.
        while n_open > node.depth {
            body.push_str("</body>\n");
            n_open -= 1;
        }
        writer.link(&mut body, ix, node);
        n_open += 1;
    }
    body.push_str(&"</body>\n".repeat(n_open + 1));
    if plan.is_logged {
        writer.report();
    }
    RobotBody {
        body,
        assets: writer.assets,
        files: writer.files,
    }
}

struct Writer<'a> {
    plan: &'a BodyPlan<'a>,
    assets: String,
    files: Vec<(String, Vec<u8>)>,
    /// Names of the meshes in the model, by file and scale. `None` if a mesh cannot be drawn.
    mesh_names: BTreeMap<String, Option<String>>,
    /// Files that cannot be drawn, with the reason.
    unreadable: BTreeMap<String, String>,
    estimated_masses: Vec<&'a str>,
    barred: Vec<&'a str>,
}

impl<'a> Writer<'a> {
    /// Opens the body of a link and writes its joint, mass and shapes.
    fn link(&mut self, body: &mut String, ix: usize, node: &'a LinkNode) {
        let model = self.plan.model;
        let pose = if node.depth == 0 {
            *model.base_from_root()
        } else {
            node.parent_from_link
        };
        // Writing to a string cannot fail. Names of the URDF may contain any character, so links
        // are numbered.
        let _ = writeln!(body, "<body name=\"link{ix}\" {}>", pose_attributes(&pose));
        let shapes = self.drawn_shapes(ix, node);
        let inertial = model
            .robot()
            .inertial(&node.link)
            .and_then(principal_inertia);
        if inertial.is_none() && node.motion.is_some() {
            self.estimated_masses.push(&node.link);
        }
        // MuJoCo needs the mass of moving links only.
        let inertial =
            inertial.or_else(|| node.motion.is_some().then(|| estimated_inertia(&shapes)));
        if let Some(PrincipalInertia {
            link_from_inertia,
            mass_kg,
            moments,
        }) = inertial
        {
            let [x, y, z] = moments;
            let _ = writeln!(
                body,
                "<inertial {} mass=\"{mass_kg:e}\" diaginertia=\"{x:e} {y:e} {z:e}\"/>",
                pose_attributes(&link_from_inertia)
            );
        }
        if let Some(motion) = &node.motion {
            let [x, y, z] = motion.axis.into();
            let kind = if motion.is_prismatic {
                "slide"
            } else {
                "hinge"
            };
            let _ = writeln!(
                body,
                "<joint name=\"joint{ix}\" type=\"{kind}\" axis=\"{x:e} {y:e} {z:e}\" limited=\"false\"/>"
            );
        }
        for shape in &shapes {
            self.shape(body, shape);
        }
        if node.link == model.chain().tip_link() {
            body.push_str(self.plan.on_flange);
        }
    }

    /// The shapes with which a link is drawn. These are the visual shapes, without meshes that
    /// cannot be drawn. A link without visual shapes is drawn with its collision shapes. A link
    /// without any shapes is drawn as bars to the joints below it.
    fn drawn_shapes(&mut self, ix: usize, node: &'a LinkNode) -> Vec<Shape> {
        let robot: &'a urdf::Robot = self.plan.model.robot();
        let visuals = robot.visuals(&node.link);
        let collisions = robot.collisions(&node.link);
        for candidates in [visuals, collisions] {
            let drawable: Vec<Shape> = candidates
                .iter()
                .filter(|shape| self.can_draw(&shape.geometry))
                .cloned()
                .collect();
            if !drawable.is_empty() {
                return drawable;
            }
        }
        let bars = bars(self.plan.model.links(), ix);
        let has_shapes = !visuals.is_empty() || !collisions.is_empty();
        if !bars.is_empty() && has_shapes {
            self.barred.push(&node.link);
        }
        bars
    }

    fn can_draw(&mut self, geometry: &Geometry) -> bool {
        match geometry {
            Geometry::Mesh { file, scale } => self.mesh_name(file, *scale).is_some(),
            _ => true,
        }
    }

    /// Name of a mesh in the model. Reads the mesh when it is first used.
    fn mesh_name(&mut self, file: &str, scale: [f64; 3]) -> Option<String> {
        let key = format!("{file} {scale:?}");
        if let Some(name) = self.mesh_names.get(&key) {
            return name.clone();
        }
        let mesh = match self.plan.meshes.get(file) {
            Some(bytes) => mesh_file::read(file, bytes, scale),
            None => Err("it was not found".to_owned()),
        };
        let name = match mesh {
            Ok(mesh) => {
                let name = format!("robot_mesh{}", self.files.len());
                let _ = writeln!(
                    self.assets,
                    "<mesh name=\"{name}\" file=\"{name}.msh\" inertia=\"shell\"/>"
                );
                self.files.push((format!("{name}.msh"), mesh.to_msh()));
                Some(name)
            }
            Err(why) => {
                self.unreadable.insert(file.to_owned(), why);
                None
            }
        };
        self.mesh_names.insert(key, name.clone());
        name
    }

    fn shape(&mut self, body: &mut String, shape: &Shape) {
        let half = |lengths: &[f64]| {
            let halves: Vec<_> = lengths
                .iter()
                .map(|length| format!("{:e}", 0.5 * length))
                .collect();
            halves.join(" ")
        };
        let geometry = match &shape.geometry {
            Geometry::Box { size_m } => format!("type=\"box\" size=\"{}\"", half(size_m)),
            Geometry::Cylinder { radius_m, length_m } => {
                format!(
                    "type=\"cylinder\" size=\"{radius_m:e} {}\"",
                    half(&[*length_m])
                )
            }
            Geometry::Capsule { radius_m, length_m } => {
                format!(
                    "type=\"capsule\" size=\"{radius_m:e} {}\"",
                    half(&[*length_m])
                )
            }
            Geometry::Sphere { radius_m } => format!("type=\"sphere\" size=\"{radius_m:e}\""),
            Geometry::Mesh { file, scale } => match self.mesh_name(file, *scale) {
                Some(name) => format!("type=\"mesh\" mesh=\"{name}\""),
                None => return,
            },
        };
        let [red, green, blue, alpha] = shape.color_srgba.unwrap_or(DEFAULT_SRGBA);
        let _ = writeln!(
            body,
            "<geom {geometry} rgba=\"{red} {green} {blue} {alpha}\" {}/>",
            pose_attributes(&shape.link_from_shape)
        );
    }

    fn report(&self) {
        if !self.estimated_masses.is_empty() {
            log::info!(
                "masses that the URDF does not state, or that are impossible, are estimated from the shapes: {}. They \
                 affect only the simulated efforts",
                self.estimated_masses.join(", ")
            );
        }
        // One line for all of them, because they usually have the same cause.
        if let Some((file, why)) = self.unreadable.first_key_value() {
            let n = self.unreadable.len();
            let files = if n == 1 { "mesh file" } else { "mesh files" };
            log::info!(
                "the simulator draws simpler shapes instead of {n} {files}, the first is {file:?}: {why}"
            );
        }
        if !self.barred.is_empty() {
            log::info!("links drawn as bars: {}", self.barred.join(", "));
        }
    }
}

/// Mass and principal moments of inertia.
struct PrincipalInertia {
    link_from_inertia: Transform,
    mass_kg: f64,
    /// kg m^2.
    moments: [f64; 3],
}

/// Principal axes of an inertia. `None` if no body has this mass and inertia.
fn principal_inertia(inertial: &Inertial) -> Option<PrincipalInertia> {
    /// Smaller masses and moments cause an error in MuJoCo.
    const SMALLEST: f64 = 1e-10;
    /// Rounding in a file may violate the triangle inequality slightly.
    const TOLERANCE: f64 = 1.001;
    // The decomposition of a matrix with NaN does not end.
    if !inertial.tensor.iter().all(|moment| moment.is_finite()) {
        return None;
    }
    let eigen = inertial.tensor.symmetric_eigen();
    let moments: [f64; 3] = eigen.eigenvalues.into();
    let sum: f64 = moments.iter().sum();
    // No moment exceeds the sum of the two others. The comparisons are false for NaN.
    let is_possible = inertial.mass_kg > SMALLEST
        && moments
            .iter()
            .all(|moment| *moment > SMALLEST && *moment <= TOLERANCE * (sum - *moment));
    if !is_possible {
        return None;
    }
    let mut axes: Matrix3<f64> = eigen.eigenvectors;
    // Eigenvectors may form a left-handed frame.
    if axes.determinant() < 0.0 {
        axes.set_column(2, &(-axes.column(2)));
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Some(PrincipalInertia {
        link_from_inertia: inertial.link_from_inertia * rotation,
        mass_kg: inertial.mass_kg,
        moments,
    })
}

/// Mass and inertia of a solid ball with the volume of the shapes at their mean position.
fn estimated_inertia(shapes: &[Shape]) -> PrincipalInertia {
    let mut volume_m3 = 0.0;
    let mut center = Vector3::zeros();
    for shape in shapes {
        volume_m3 += shape_volume_m3(&shape.geometry);
        center += shape.link_from_shape.translation.vector / shapes.len() as f64;
    }
    let mass_kg = (DENSITY_KG_M3 * volume_m3).clamp(MASS_RANGE_KG[0], MASS_RANGE_KG[1]);
    let radius_m = (0.75 * mass_kg / DENSITY_KG_M3 / std::f64::consts::PI).cbrt();
    PrincipalInertia {
        link_from_inertia: Transform::translation(center.x, center.y, center.z),
        mass_kg,
        moments: [0.4 * mass_kg * radius_m * radius_m; 3],
    }
}

fn shape_volume_m3(geometry: &Geometry) -> f64 {
    use std::f64::consts::PI;
    match geometry {
        Geometry::Box { size_m } => size_m.iter().product(),
        Geometry::Cylinder { radius_m, length_m } => PI * radius_m * radius_m * length_m,
        Geometry::Capsule { radius_m, length_m } => {
            PI * radius_m * radius_m * (length_m + 4.0 / 3.0 * radius_m)
        }
        Geometry::Sphere { radius_m } => 4.0 / 3.0 * PI * radius_m.powi(3),
        // The volume of a mesh is not computed. This value is about the volume of a link of a small
        // arm.
        Geometry::Mesh { .. } => 1e-3,
    }
}

/// Height of the lowest point of the robot with its joints at rest, meters. It is at most the
/// height of the base. Of a mesh, only the origin is considered.
///
/// * `world_from_base`: pose in which z is up.
pub(crate) fn lowest_z_m(model: &TwinModel, world_from_base: &Transform) -> f64 {
    let mut lowest_m = world_from_base.translation.vector.z;
    let poses = model.base_from_links(&model.rest());
    for (node, base_from_link) in model.links().iter().zip(poses) {
        let world_from_link = world_from_base * base_from_link;
        lowest_m = lowest_m.min(world_from_link.translation.vector.z);
        let robot = model.robot();
        let shapes = [robot.visuals(&node.link), robot.collisions(&node.link)].concat();
        for shape in shapes {
            let pose = world_from_link * shape.link_from_shape;
            // The vertical extent of a box around the shape.
            let up_in_shape = pose.rotation.inverse() * Vector3::z();
            let extent_m = up_in_shape.abs().dot(&half_extents_m(&shape.geometry));
            lowest_m = lowest_m.min(pose.translation.vector.z - extent_m);
        }
    }
    lowest_m
}

/// Half sizes of a box around a shape, meters.
fn half_extents_m(geometry: &Geometry) -> Vector3<f64> {
    match geometry {
        Geometry::Box { size_m } => Vector3::from(*size_m) * 0.5,
        Geometry::Cylinder { radius_m, length_m } => {
            Vector3::new(*radius_m, *radius_m, 0.5 * length_m)
        }
        Geometry::Capsule { radius_m, length_m } => {
            Vector3::new(*radius_m, *radius_m, 0.5 * length_m + radius_m)
        }
        Geometry::Sphere { radius_m } => Vector3::from_element(*radius_m),
        Geometry::Mesh { .. } => Vector3::zeros(),
    }
}

/// Bars from a link to the joints below it.
fn bars(links: &[LinkNode], ix: usize) -> Vec<Shape> {
    let depth = links[ix].depth;
    links[ix + 1..]
        .iter()
        .take_while(|node| node.depth > depth)
        .filter(|node| node.depth == depth + 1)
        .filter_map(|node| bar(&node.parent_from_link.translation.vector))
        .collect()
}

/// A bar from the origin to a point.
fn bar(end: &Vector3<f64>) -> Option<Shape> {
    let length_m = end.norm();
    if length_m < MIN_BAR_M {
        return None;
    }
    let radius_m = (BAR_RADIUS_FRAC * length_m).clamp(BAR_RADIUS_RANGE_M[0], BAR_RADIUS_RANGE_M[1]);
    // The rotation between opposite vectors is not unique, so any rotation by 180 degrees is used.
    let rotation = UnitQuaternion::rotation_between(&Vector3::z(), end).unwrap_or_else(|| {
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
    });
    Some(Shape {
        link_from_shape: Transform::from_parts((end * 0.5).into(), rotation),
        geometry: Geometry::Capsule { radius_m, length_m },
        color_srgba: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inertial(tensor: Matrix3<f64>) -> Inertial {
        Inertial {
            link_from_inertia: Transform::translation(0.1, 0.0, 0.0),
            mass_kg: 2.0,
            tensor,
        }
    }

    #[test]
    fn principal_axes_reproduce_the_tensor() {
        const TOLERANCE: f64 = 1e-12;
        let tensor = Matrix3::new(
            0.03, 0.004, 0.001, 0.004, 0.04, -0.002, 0.001, -0.002, 0.035,
        );
        let principal = principal_inertia(&inertial(tensor)).expect("a possible inertia");
        let rotation = principal.link_from_inertia.rotation.to_rotation_matrix();
        let diagonal = Matrix3::from_diagonal(&Vector3::from(principal.moments));
        let again = rotation.matrix() * diagonal * rotation.matrix().transpose();
        assert!((again - tensor).norm() < TOLERANCE, "{again}");
    }

    #[test]
    fn impossible_inertias_are_estimated() {
        for tensor in [
            Matrix3::zeros(),
            Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 3.0)),
            Matrix3::from_diagonal(&Vector3::new(-1.0, 1.0, 1.0)),
            Matrix3::from_element(f64::NAN),
        ] {
            assert!(principal_inertia(&inertial(tensor)).is_none(), "{tensor}");
        }
        let estimated = estimated_inertia(&[]);
        assert!(estimated.mass_kg >= MASS_RANGE_KG[0] && estimated.moments[0] > 0.0);
    }

    #[test]
    fn bars_reach_their_end() {
        for end in [Vector3::new(0.1, 0.2, -0.3), Vector3::new(0.0, 0.0, -0.4)] {
            let shape = bar(&end).expect("long enough");
            let Geometry::Capsule { length_m, .. } = shape.geometry else {
                panic!("a capsule")
            };
            let tip = shape.link_from_shape * nalgebra::Point3::new(0.0, 0.0, 0.5 * length_m);
            assert!((tip.coords - end).norm() < 1e-12, "{tip}");
        }
        assert!(bar(&Vector3::zeros()).is_none());
    }
}
