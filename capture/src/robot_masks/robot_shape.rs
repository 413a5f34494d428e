//! The shape of a robot, in convex pieces that move with its measured joints.

use super::convex_pieces::cover;
use crate::config::UrdfFolder;
use crate::mesh_triangles::{Triangle, mesh_triangles};
use files::Budget;
use keyframe::masked_robot::{ConvexPiece, Sweep};
use kinematics::shape::{Geometry, Shape};
use kinematics::urdf::{JointKind, JointLimits, Robot};
use kinematics::{Chain, Transform};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Largest rotation of a joint between two poses at which a link is drawn if the joint is not
/// measured, radians. The next constant is the largest number of poses.
const MAX_STEP_RAD: f64 = 0.35;
const MAX_POSES: u32 = 16;

/// The links of a robot with their shapes.
pub(super) struct RobotShape {
    root_from_base: JointedPose,
    links: Vec<Link>,
    /// The pieces of each link. Empty for a link without a shape, or with an unknown shape.
    pieces: Arc<[Vec<ConvexPiece>]>,
    /// Names of links whose shapes are not known, with the reason.
    unknown: BTreeMap<String, String>,
}

/// A link.
struct Link {
    root_from_link: JointedPose,
    /// Whether it moves relative to the base.
    moves: bool,
}

/// The pose of a link as a function of the measured joints.
struct JointedPose {
    chain: Chain,
    sources: Vec<Source>,
    /// Number of poses that are drawn. It is 1 if all joints are measured.
    n_poses: u32,
}

/// Where the position of a joint comes from.
enum Source {
    /// The joint state, at this index.
    Measured(usize),
    /// The joint is not measured, so that it may be anywhere between its limits.
    Anywhere(JointLimits),
}

/// Which part of a robot is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extent {
    /// The links that move relative to the base.
    MovingLinks,
    /// All links.
    WholeRobot,
}

impl Extent {
    fn contains(self, moves: bool) -> bool {
        moves || self == Self::WholeRobot
    }
}

impl RobotShape {
    /// Reads the shapes of the links in an extent. A link has its visual shapes. If a visual shape
    /// cannot be read, or there is none, it has its collision shapes.
    ///
    /// * `joints`: names of the measured joints.
    /// * `mesh_folder`: where the mesh files are.
    ///
    /// # Errors
    ///
    /// If there is no chain to the base link.
    pub(super) fn new(
        robot: &Robot,
        base_link: &str,
        joints: &[String],
        extent: Extent,
        mesh_folder: &UrdfFolder,
    ) -> Result<Self, kinematics::Error> {
        // Links beside the base or above it, such as a platform, are drawn as well.
        let root = robot.root().unwrap_or(base_link);
        let root_from_base = JointedPose::new(robot, [root, base_link], joints)?;
        let mut meshes = Meshes {
            folder: mesh_folder,
            read: BTreeMap::new(),
            left: Budget::MESHES,
        };
        let mut links = Vec::new();
        let mut all_pieces = Vec::new();
        let mut unknown = BTreeMap::new();
        let has_shapes =
            |link: &str| !robot.visuals(link).is_empty() || !robot.collisions(link).is_empty();
        for name in robot.links() {
            let root_from_link = match JointedPose::new(robot, [root, name.as_str()], joints) {
                Ok(pose) => pose,
                Err(error) => {
                    if has_shapes(name) {
                        unknown.insert(name.clone(), error.to_string());
                    }
                    continue;
                }
            };
            let moves = root_from_link.moves_on(&root_from_base);
            if !extent.contains(moves) {
                continue;
            }
            let (mut pieces, mut problem) = meshes.pieces_of(robot, name);
            if let Some(reason) = root_from_link.problem().filter(|_| !pieces.is_empty()) {
                pieces.clear();
                problem = Some(reason);
            }
            if let Some(reason) = problem {
                unknown.insert(name.clone(), reason);
            }
            links.push(Link {
                root_from_link,
                moves,
            });
            all_pieces.push(pieces);
        }
        Ok(Self {
            root_from_base,
            links,
            pieces: all_pieces.into(),
            unknown,
        })
    }

    /// The convex pieces of each link, in the frame of the link, meters.
    pub(super) fn pieces(&self) -> &Arc<[Vec<ConvexPiece>]> {
        &self.pieces
    }

    /// Whether there are links in an extent.
    pub(super) fn has_links(&self, extent: Extent) -> bool {
        self.links.iter().any(|link| extent.contains(link.moves))
    }

    /// Whether the shape of any link in an extent is known.
    pub(super) fn has_pieces(&self, extent: Extent) -> bool {
        let mut links = self.links.iter().zip(&*self.pieces);
        links.any(|(link, pieces)| extent.contains(link.moves) && !pieces.is_empty())
    }

    /// Names of links whose shapes are not known, with the reason.
    pub(super) fn unknown(&self) -> &BTreeMap<String, String> {
        &self.unknown
    }

    /// Where the links may be in the frame of a camera. Each sweep contains the link at all given
    /// instants, and between them if it moves along a line.
    ///
    /// * `instants`: the positions of the measured joints and `camera_from_base`.
    pub(super) fn sweeps_in_camera(
        &self,
        extent: Extent,
        instants: &[(Vec<f64>, Transform)],
    ) -> Vec<Sweep> {
        let camera_from_root: Vec<Transform> = instants
            .iter()
            .map(|(q, camera_from_base)| camera_from_base * self.root_from_base.at(q, 0).inverse())
            .collect();
        let mut sweeps = Vec::new();
        let drawn = self.links.iter().enumerate();
        for (link_ix, link) in drawn.filter(|(_, link)| extent.contains(link.moves)) {
            if self.pieces[link_ix].is_empty() {
                continue;
            }
            let poses = |pose_ix: u32| {
                let both = instants.iter().zip(&camera_from_root);
                both.map(move |((q, _), camera_from_root)| {
                    camera_from_root * link.root_from_link.at(q, pose_ix)
                })
            };
            // A sweep contains two neighboring poses, so that there is no gap between them.
            let n_steps = link.root_from_link.n_poses.saturating_sub(1).max(1);
            for step in 0..n_steps {
                let next = (step + 1).min(link.root_from_link.n_poses - 1);
                let mut camera_from_link: Vec<Transform> = poses(step).collect();
                if next != step {
                    camera_from_link.extend(poses(next));
                }
                sweeps.push(Sweep {
                    link_ix,
                    camera_from_link,
                });
            }
        }
        sweeps
    }
}

impl JointedPose {
    fn new(
        robot: &Robot,
        [root, link]: [&str; 2],
        joints: &[String],
    ) -> Result<Self, kinematics::Error> {
        let chain = Chain::new(robot, root, link)?;
        let mut n_poses = 1;
        let mut sources = Vec::new();
        for (name, limits) in chain.joint_names().iter().zip(chain.limits()) {
            if let Some(ix) = joints.iter().position(|joint| joint == name) {
                sources.push(Source::Measured(ix));
                continue;
            }
            let kind = robot.joint(name).map(|joint| joint.kind);
            n_poses = n_poses.max(n_poses_of(limits, kind == Some(JointKind::Prismatic)));
            sources.push(Source::Anywhere(*limits));
        }
        Ok(Self {
            chain,
            sources,
            n_poses,
        })
    }

    /// Whether a joint is between this link and another one.
    fn moves_on(&self, other: &Self) -> bool {
        let joints = |pose: &Self| -> BTreeSet<String> {
            pose.chain.joint_names().iter().cloned().collect()
        };
        joints(self) != joints(other)
    }

    /// Why the place of the link is unknown. One joint that is not measured, such as that of a
    /// gripper, moves a link on a known path. Several joints could move it anywhere.
    fn problem(&self) -> Option<String> {
        let joints = self.chain.joint_names().iter().zip(&self.sources);
        let free: Vec<String> = joints
            .filter(|(_, source)| matches!(source, Source::Anywhere(limits) if is_bounded(limits)))
            .map(|(name, _)| format!("{name:?}"))
            .collect();
        (free.len() > 1).then(|| format!("its joints {} are not measured", free.join(", ")))
    }

    /// The pose with joints that are not measured at a fraction of their range.
    fn at(&self, positions: &[f64], pose_ix: u32) -> Transform {
        let frac = f64::from(pose_ix) / f64::from(self.n_poses.saturating_sub(1).max(1));
        let q: Vec<f64> = self
            .sources
            .iter()
            .map(|source| match source {
                Source::Measured(ix) => positions.get(*ix).copied().unwrap_or_default(),
                Source::Anywhere(limits) if is_bounded(limits) => {
                    limits.lower + frac * (limits.upper - limits.lower)
                }
                // A joint without limits is usually that of a wheel, which looks the same at all
                // angles.
                Source::Anywhere(_) => 0.0,
            })
            .collect();
        self.chain
            .forward(&q)
            .expect("one position for each joint of the chain")
    }
}

fn is_bounded(limits: &JointLimits) -> bool {
    limits.lower.is_finite() && limits.upper.is_finite()
}

/// Number of poses at which a link is drawn if a joint is not measured.
fn n_poses_of(limits: &JointLimits, is_prismatic: bool) -> u32 {
    if !is_bounded(limits) {
        return 1;
    }
    if is_prismatic {
        // The hull of both ends contains all positions between them.
        return 2;
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a small positive number, and casts saturate"
    )]
    let n_steps = ((limits.upper - limits.lower).abs() / MAX_STEP_RAD).ceil() as u32;
    (n_steps + 1).clamp(2, MAX_POSES)
}

/// The mesh files that were read.
struct Meshes<'a> {
    folder: &'a UrdfFolder,
    read: BTreeMap<String, Result<Vec<Triangle>, String>>,
    /// Maximum size of all further files together. After decompression, the files of a small
    /// recording could have any size.
    left: Budget,
}

impl Meshes<'_> {
    /// The pieces of a link, and the reason why a part of its shape is unknown.
    fn pieces_of(&mut self, robot: &Robot, link: &str) -> (Vec<ConvexPiece>, Option<String>) {
        let [visuals, collisions] = [robot.visuals(link), robot.collisions(link)];
        let (pieces, problem) = self.cover_all(visuals);
        let is_complete = problem.is_none() && !visuals.is_empty();
        if is_complete || collisions.is_empty() {
            return (pieces, problem);
        }
        let (of_collisions, problem_of_collisions) = self.cover_all(collisions);
        if problem_of_collisions.is_none() {
            return (of_collisions, None);
        }
        // The parts that can be read are better than none.
        let all = pieces.into_iter().chain(of_collisions).collect();
        (all, problem.or(problem_of_collisions))
    }

    fn cover_all(&mut self, shapes: &[Shape]) -> (Vec<ConvexPiece>, Option<String>) {
        let mut pieces = Vec::new();
        let mut problem = None;
        for shape in shapes {
            match self.triangles_of(&shape.geometry) {
                Ok(triangles) => pieces.extend(cover(shape, triangles)),
                Err(why) => problem = problem.or(Some(why)),
            }
        }
        (pieces, problem)
    }

    /// The triangles of a mesh; none for other shapes.
    fn triangles_of(&mut self, geometry: &Geometry) -> Result<&[Triangle], String> {
        let Geometry::Mesh { file, .. } = geometry else {
            return Ok(&[]);
        };
        let Self { folder, read, left } = self;
        let read = read.entry(file.clone()).or_insert_with(|| {
            let budget = Budget {
                max_bytes: Budget::MESH.max_bytes.min(left.max_bytes),
                ..Budget::MESH
            };
            let triangles = mesh_triangles(file, folder, budget)?;
            *left = left.after(size_of_val(&*triangles) as u64);
            Ok(triangles)
        });
        read.as_deref()
            .map_err(|why| format!("mesh {file:?}: {why}"))
    }
}
