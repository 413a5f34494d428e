//! Counts how often the robot touches the scene, in a model of its own.
//!
//! The model of the images has no contacts: its meshes are not convex, and an arm that could be
//! blocked would not follow its tour. In this model, the scene consists of convex pieces. The robot
//! passes through them, and MuJoCo reports where it does.

use crate::mesh::Mesh;
use crate::objects::Object;
use crate::render::set_base_pose;
use crate::robot::RobotPose;
use mujoco_rs::prelude::{MjData, MjModel};
use nalgebra::{Point3, Vector3};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Maximum number of pieces of an object. Finer objects, such as fur, are enclosed as a whole.
const MAX_PIECES: usize = 64;
/// Thickness that flat pieces get behind their surface, meters. It is above the motion of a robot
/// between two checks at the speeds at which operators move it.
const FLAT_THICKNESS_M: f64 = 0.005;
/// Extent below which a piece is flat, meters.
const MAX_FLATNESS_M: f64 = 1e-4;
/// Smallest area that a piece spans, square meters. MuJoCo cannot enclose points on a line.
const MIN_AREA_M2: f64 = 1e-6;

/// Counts the contacts of a robot with its scene.
pub(crate) struct ContactCounter {
    data: MjData<Arc<MjModel>>,
    /// Pairs of bodies that touch at the first check, such as a robot and its pedestal. They are
    /// not counted. `None` before the first check.
    always: Option<BTreeSet<[i32; 2]>>,
    /// Pairs that touched at the last check.
    touching: BTreeSet<[i32; 2]>,
    n_contacts: Arc<AtomicU64>,
}

impl ContactCounter {
    /// * `model`: built by [`crate::scene::build_contacts`].
    pub(crate) fn new(model: MjModel) -> Self {
        Self {
            data: MjData::new(Arc::new(model)),
            always: None,
            touching: BTreeSet::new(),
            n_contacts: Arc::default(),
        }
    }

    /// How often a part of the robot has begun to touch an object.
    pub(crate) fn n_contacts(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.n_contacts)
    }

    /// Checks where the robot touches the scene now.
    pub(crate) fn check(&mut self, robot: &RobotPose) {
        let touching = self.touching(robot);
        let Some(always) = &self.always else {
            self.always = Some(touching);
            return;
        };
        let is_new = |pair: &&[i32; 2]| !self.touching.contains(*pair) && !always.contains(*pair);
        let n_new = touching.iter().filter(is_new).count() as u64;
        self.n_contacts.fetch_add(n_new, Ordering::Relaxed);
        self.touching = touching;
    }

    /// The pairs of bodies that touch.
    fn touching(&mut self, robot: &RobotPose) -> BTreeSet<[i32; 2]> {
        set_base_pose(&mut self.data, &robot.world_from_base);
        if !robot.model_positions.is_empty() {
            self.data.qpos_mut().copy_from_slice(&robot.model_positions);
        }
        self.data.forward_kinematics();
        self.data.collision();
        let bodies = self.data.model().geom_bodyid();
        let contacts = self.data.contact().iter();
        contacts
            .filter(|contact| contact.dist < 0.0)
            .filter_map(|contact| {
                let body = |geom: i32| bodies.get(usize::try_from(geom).ok()?).copied();
                let [a, b] = contact.geom;
                Some([body(a)?, body(b)?])
            })
            .collect()
    }
}

/// Convex pieces that together enclose an object: the points of each, in the frame of the object.
///
/// Smooth parts are replaced by their convex hulls. Flat parts are extended behind their surface.
pub(crate) fn convex_pieces(object: &Object) -> Vec<Vec<[f64; 3]>> {
    let by_normal = pieces(&object.mesh, true);
    let parts = if by_normal.len() <= MAX_PIECES {
        by_normal
    } else {
        // Closed parts, such as the boards of a cabinet.
        pieces(&object.mesh, false)
    };
    let parts = if parts.len() <= MAX_PIECES {
        parts
    } else {
        vec![whole(&object.mesh)]
    };
    parts.iter().filter_map(Piece::solid_points).collect()
}

/// Points of a part, and the mean of their normals.
#[derive(Clone, Debug, Default)]
struct Piece {
    points: Vec<Point3<f64>>,
    normal: Vector3<f64>,
}

impl Piece {
    /// The points, and those behind them if the piece is flat. `None` for a piece without an
    /// extent.
    fn solid_points(&self) -> Option<Vec<[f64; 3]>> {
        let first = self.points.first()?;
        if spanned_area_m2(first, &self.points) < MIN_AREA_M2 {
            return None;
        }
        let mut points = self.points.clone();
        if let Some(normal) = self.normal.try_normalize(1e-9) {
            let depths = self.points.iter().map(|point| normal.dot(&(point - first)));
            let [low, high] = depths.fold([0.0, 0.0], |[low, high]: [f64; 2], depth| {
                [low.min(depth), high.max(depth)]
            });
            if high - low < MAX_FLATNESS_M {
                let behind = normal * FLAT_THICKNESS_M;
                points.extend(self.points.iter().map(|point| point - behind));
            }
        }
        Some(points.into_iter().map(|point| point.into()).collect())
    }
}

/// About the area that points span: zero for points on a line.
fn spanned_area_m2(first: &Point3<f64>, points: &[Point3<f64>]) -> f64 {
    let edges = points.iter().map(|point| point - first);
    let longest = edges
        .clone()
        .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))
        .unwrap_or_default();
    edges.fold(0.0, |area, edge| {
        f64::max(area, edge.cross(&longest).norm())
    })
}

/// Parts of a mesh that share points. If `by_normal`, points with different normals are different,
/// so that a box has six parts.
fn pieces(mesh: &Mesh, by_normal: bool) -> Vec<Piece> {
    /// Points closer than this are the same, in units per meter.
    const GRID_PER_M: f64 = 1e5;
    const NORMAL_GRID: f64 = 1e3;
    let mut ids: BTreeMap<[i64; 6], usize> = BTreeMap::new();
    let mut points = Vec::new();
    let corner_ids: Vec<usize> = mesh
        .corners()
        .map(|(point, normal)| {
            let normal_key = if by_normal { NORMAL_GRID } else { 0.0 };
            #[expect(
                clippy::cast_possible_truncation,
                reason = "scenes are some meters large"
            )]
            let key = [
                point.x * GRID_PER_M,
                point.y * GRID_PER_M,
                point.z * GRID_PER_M,
                normal.x * normal_key,
                normal.y * normal_key,
                normal.z * normal_key,
            ]
            .map(|value| value.round() as i64);
            *ids.entry(key).or_insert_with(|| {
                points.push((point, normal));
                points.len() - 1
            })
        })
        .collect();
    let mut parents: Vec<usize> = (0..points.len()).collect();
    for [a, b, c] in mesh.faces() {
        let [a, b, c] = [a, b, c].map(|corner| root(&mut parents, corner_ids[corner]));
        parents[b] = a;
        let c = root(&mut parents, c);
        parents[c] = a;
    }
    let mut pieces: BTreeMap<usize, Piece> = BTreeMap::new();
    for (ix, (point, normal)) in points.iter().enumerate() {
        let piece = pieces.entry(root(&mut parents, ix)).or_default();
        piece.points.push(*point);
        piece.normal += normal;
    }
    pieces.into_values().collect()
}

/// The whole mesh as one part.
fn whole(mesh: &Mesh) -> Piece {
    let mut piece = Piece::default();
    for (point, normal) in mesh.corners() {
        piece.points.push(point);
        piece.normal += normal;
    }
    piece
}

/// The representative of a point's part, by union-find with path halving.
fn root(parents: &mut [usize], mut ix: usize) -> usize {
    while parents[ix] != ix {
        parents[ix] = parents[parents[ix]];
        ix = parents[ix];
    }
    ix
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::mesh::WHOLE;
    use crate::objects::{TABLE_Z_M, TARGET_XY_M};
    use crate::panda;
    use crate::scene;
    use kinematics::Transform;
    use kinematics::inverse::{InverseSolver, Target};

    #[test]
    fn a_box_has_six_flat_pieces_with_a_thickness() {
        let mesh = Mesh::cuboid([0.1, 0.2, 0.3], &[WHOLE; 6]);
        let pieces = convex_pieces(&Object::in_world("box", "frame", mesh));
        assert_eq!(pieces.len(), 6);
        for points in pieces {
            assert_eq!(points.len(), 8, "four corners, and four behind them");
            let is_inside = |[x, y, z]: &[f64; 3]| {
                x.abs() < 0.1 + 1e-6 && y.abs() < 0.2 + 1e-6 && z.abs() < 0.3 + 1e-6
            };
            assert!(points.iter().all(is_inside), "{points:?}");
        }
    }

    /// The arm with its flange above the table, pointing down.
    fn above_table(height_m: f64) -> RobotPose {
        let chain = kinematics::Chain::from_urdf(crate::PANDA_URDF, "panda_link0", "panda_link8")
            .expect("valid");
        let down =
            nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let [x, y] = [TARGET_XY_M[0] - 0.15, TARGET_XY_M[1] - 0.2];
        let place = nalgebra::Translation3::new(x, y, TABLE_Z_M + height_m);
        let target = Target::pose(Transform::from_parts(place, down));
        let mut solver = InverseSolver::new(chain).expect("a chain with joints");
        let start = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];
        let joints = solver.solve(&target, &start).expect("within reach");
        RobotPose {
            world_from_base: Transform::identity(),
            world_from_flange: panda::base_from_flange(&panda::Joints::from_column_slice(&joints)),
            model_positions: joints,
        }
    }

    #[test]
    fn a_flange_in_the_table_is_counted_once_until_it_leaves() {
        let config = Config {
            cameras: Vec::new(),
            ..Config::default()
        };
        let model = scene::build_contacts(&config, None).expect("the scene is valid");
        let mut counter = ContactCounter::new(model);
        let n_contacts = counter.n_contacts();
        let [above, inside] = [above_table(0.15), above_table(-0.002)];
        counter.check(&above);
        counter.check(&above);
        assert_eq!(n_contacts.load(Ordering::Relaxed), 0);
        counter.check(&inside);
        let first = n_contacts.load(Ordering::Relaxed);
        assert!(first > 0, "the flange is in the table");
        counter.check(&inside);
        assert_eq!(
            n_contacts.load(Ordering::Relaxed),
            first,
            "it is still there"
        );
        counter.check(&above);
        counter.check(&inside);
        assert_eq!(n_contacts.load(Ordering::Relaxed), 2 * first);
    }
}
