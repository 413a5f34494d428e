//! The shape of a robot: capsules that move with its joints.

use crate::capsule::Capsule;
use crate::error::Error;
use crate::fit::enclosing_capsules;
use kinematics::urdf::{Joint, JointKind, Robot};
use kinematics::{Chain, Transform};
use nalgebra::{Translation3, Unit, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Positions, as fractions of the range, at which parts are enclosed that move with joints outside
/// the chain, such as fingers. Their joints are not measured, so these parts are wherever they can
/// be.
const OTHER_JOINT_FRACS: [f64; 3] = [0.0, 0.5, 1.0];

/// Maximum number of capsules of a record. Each pair of them is compared.
const MAX_SHAPES: usize = 4096;

/// Capsules around all links that are rigidly joined to the base of a chain or move with its
/// joints.
#[derive(Clone, Debug)]
pub struct Body {
    frames: Vec<Frame>,
    parts: Vec<Part>,
    notes: Vec<String>,
    n_joints: usize,
}

/// A frame that moves relative to its parent with at most one joint.
#[derive(Clone, Debug)]
struct Frame {
    /// Index of the parent, which comes earlier; `None` for the base.
    parent: Option<usize>,
    parent_from_joint: Transform,
    motion: Option<JointMotion>,
}

impl Frame {
    fn base() -> Self {
        Self {
            parent: None,
            parent_from_joint: Transform::identity(),
            motion: None,
        }
    }
}

#[derive(Clone, Debug)]
struct JointMotion {
    joint_ix: usize,
    is_prismatic: bool,
    axis: Unit<Vector3<f64>>,
    multiplier: f64,
    offset: f64,
}

/// A capsule of the body.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    /// Name of the link.
    pub(crate) link: String,
    /// Index of the frame.
    pub(crate) frame_ix: usize,
    capsule_in_frame: Capsule,
}

/// A capsule of a record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Shape {
    link: String,
    frame_ix: usize,
    /// Ends of the capsule in the frame, meters.
    ends_m: [[f64; 3]; 2],
    radius_m: f64,
}

/// Where to go on in the tree of links.
struct Branch<'a> {
    link: &'a str,
    frame_ix: usize,
    frame_from_link: Transform,
    /// Position of the joints outside the chain, as an index of [`OTHER_JOINT_FRACS`].
    variant: Option<usize>,
    /// The joint through which the link was reached.
    reached_by: Option<&'a str>,
}

impl Body {
    /// Encloses the collision shapes of each link, or the visual shapes if a link has no collision
    /// shapes.
    ///
    /// * `vertices_of`: vertices of a mesh file in the frame of the mesh, meters; `None` if it
    ///   cannot be read. Meshes of unknown size are not part of the body; see [`Body::notes`].
    ///
    /// # Errors
    /// If no link has a shape, because the arm would then not be protected.
    pub fn new(
        robot: &Robot,
        chain: &Chain,
        vertices_of: &dyn Fn(&str) -> Option<Vec<[f64; 3]>>,
    ) -> Result<Self, Error> {
        let mut body = Self::without_parts(chain);
        body.visit(robot, chain, vertices_of);
        body.drop_contained();
        if body.parts.is_empty() {
            return Err(Error::NoShapes {
                robot: robot.name().to_owned(),
            });
        }
        Ok(body)
    }

    /// The body of a base without a robot description: rigid capsules in the frame of the base link.
    pub fn of_base(base_link: &str, capsules: &[Capsule]) -> Self {
        let part = |capsule: &Capsule| Part {
            link: base_link.to_owned(),
            frame_ix: 0,
            capsule_in_frame: *capsule,
        };
        Self {
            frames: vec![Frame::base()],
            parts: capsules.iter().map(part).collect(),
            notes: Vec::new(),
            n_joints: 0,
        }
    }

    fn without_parts(chain: &Chain) -> Self {
        Self {
            frames: vec![Frame::base()],
            parts: Vec::new(),
            notes: Vec::new(),
            n_joints: chain.n_joints(),
        }
    }

    /// Adds the frames and parts of all links.
    fn visit(
        &mut self,
        robot: &Robot,
        chain: &Chain,
        vertices_of: &dyn Fn(&str) -> Option<Vec<[f64; 3]>>,
    ) {
        let mut branches = vec![Branch {
            link: chain.base_link(),
            frame_ix: 0,
            frame_from_link: Transform::identity(),
            variant: None,
            reached_by: None,
        }];
        // Every joint is crossed once per variant, so the walk ends.
        while let Some(branch) = branches.pop() {
            self.add_shapes(robot, &branch, vertices_of);
            self.add_children(robot, chain, &branch, &mut branches);
            self.add_parent(robot, &branch, &mut branches);
        }
    }

    /// The capsules that move with each frame, for records: mesh files may have changed since.
    pub(crate) fn shapes(&self) -> Vec<Shape> {
        let shape = |part: &Part| Shape {
            link: part.link.clone(),
            frame_ix: part.frame_ix,
            ends_m: part.capsule_in_frame.ends.map(Into::into),
            radius_m: part.capsule_in_frame.radius_m,
        };
        self.parts.iter().map(shape).collect()
    }

    /// The body of a record.
    ///
    /// # Errors
    /// If there are no shapes, or one of them belongs to no frame of the robot or has no size.
    pub(crate) fn from_shapes(
        robot: &Robot,
        chain: &Chain,
        shapes: &[Shape],
    ) -> Result<Self, Error> {
        if shapes.len() > MAX_SHAPES {
            return Err(Error::Shapes);
        }
        let mut body = Self::without_parts(chain);
        body.visit(robot, chain, &|_| None);
        let n_frames = body.frames.len();
        let part = |shape: &Shape| {
            let mut numbers = shape.ends_m.iter().flatten().chain([&shape.radius_m]);
            let is_valid = shape.frame_ix < n_frames && numbers.all(|x| x.is_finite());
            is_valid.then(|| Part {
                link: shape.link.clone(),
                frame_ix: shape.frame_ix,
                capsule_in_frame: Capsule {
                    ends: shape.ends_m.map(Into::into),
                    radius_m: shape.radius_m,
                },
            })
        };
        let parts: Option<Vec<Part>> = shapes.iter().map(part).collect();
        body.parts = parts
            .filter(|parts| !parts.is_empty())
            .ok_or(Error::Shapes)?;
        Ok(body)
    }

    /// One sentence for each shape that is not enclosed.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Number of capsules.
    pub fn n_parts(&self) -> usize {
        self.parts.len()
    }

    /// Link of a capsule.
    pub(crate) fn part(&self, ix: usize) -> &Part {
        &self.parts[ix]
    }

    /// Number of joint values that the body needs.
    pub fn n_joints(&self) -> usize {
        self.n_joints
    }

    /// Whether a frame moves directly on another one. Such parts touch at their joint.
    pub(crate) fn are_adjacent(&self, a: usize, b: usize) -> bool {
        self.frames[a].parent == Some(b) || self.frames[b].parent == Some(a)
    }

    /// The capsules in the frame of the chain's base.
    ///
    /// * `q`: finite joint values in the order of the chain.
    pub fn capsules(&self, q: &[f64]) -> Vec<Capsule> {
        let mut base_from_frames: Vec<Transform> = Vec::with_capacity(self.frames.len());
        for frame in &self.frames {
            let parent = frame
                .parent
                .map_or_else(Transform::identity, |ix| base_from_frames[ix]);
            let motion = frame
                .motion
                .as_ref()
                .map_or_else(Transform::identity, |motion| motion.at(q));
            base_from_frames.push(parent * frame.parent_from_joint * motion);
        }
        self.parts
            .iter()
            .map(|part| {
                part.capsule_in_frame
                    .transformed(&base_from_frames[part.frame_ix])
            })
            .collect()
    }

    fn add_shapes(
        &mut self,
        robot: &Robot,
        branch: &Branch<'_>,
        vertices_of: &dyn Fn(&str) -> Option<Vec<[f64; 3]>>,
    ) {
        let collisions = robot.collisions(branch.link);
        let shapes = if collisions.is_empty() {
            robot.visuals(branch.link)
        } else {
            collisions
        };
        for shape in shapes {
            let capsules = enclosing_capsules(shape, vertices_of);
            if capsules.is_empty() {
                self.notes.push(format!(
                    "a mesh of link {:?} cannot be read, so collisions of this part are not detected",
                    branch.link
                ));
            }
            self.parts.extend(capsules.iter().map(|capsule| Part {
                link: branch.link.to_owned(),
                frame_ix: branch.frame_ix,
                capsule_in_frame: capsule.transformed(&branch.frame_from_link),
            }));
        }
    }

    fn add_children<'a>(
        &mut self,
        robot: &'a Robot,
        chain: &Chain,
        branch: &Branch<'a>,
        branches: &mut Vec<Branch<'a>>,
    ) {
        for joint in robot.joints() {
            if joint.parent != branch.link
                || Some(joint.name.as_str()) == branch.reached_by
                || joint.problem.is_some()
            {
                continue;
            }
            let rule = Rule::of(robot, joint);
            let link_from_joint = branch.frame_from_link * joint.parent_from_joint;
            let in_chain = chain
                .joint_names()
                .iter()
                .position(|name| *name == rule.source.name);
            let next = |frame_ix, frame_from_link, variant| Branch {
                link: joint.child.as_str(),
                frame_ix,
                frame_from_link,
                variant,
                reached_by: Some(joint.name.as_str()),
            };
            let is_moving = matches!(joint.kind, JointKind::Revolute | JointKind::Prismatic);
            if let (true, Some(joint_ix)) = (is_moving, in_chain) {
                self.frames.push(Frame {
                    parent: Some(branch.frame_ix),
                    parent_from_joint: link_from_joint,
                    motion: Some(rule.motion(joint, joint_ix)),
                });
                let frame_ix = self.frames.len() - 1;
                branches.push(next(frame_ix, Transform::identity(), branch.variant));
            } else if is_moving {
                let all: Vec<usize> = (0..OTHER_JOINT_FRACS.len()).collect();
                let one = branch.variant.map(|variant| vec![variant]);
                for variant in one.unwrap_or(all) {
                    let moved = rule.motion(joint, 0).at(&[rule.source_position(variant)]);
                    let pose = link_from_joint * moved;
                    branches.push(next(branch.frame_ix, pose, Some(variant)));
                }
            } else {
                branches.push(next(branch.frame_ix, link_from_joint, branch.variant));
            }
        }
    }

    /// Adds what is rigidly joined to the base on its other side, such as a table or a platform.
    fn add_parent<'a>(
        &self,
        robot: &'a Robot,
        branch: &Branch<'a>,
        branches: &mut Vec<Branch<'a>>,
    ) {
        // Only the base and links above it have parents that were not visited.
        let above = robot.joints().iter().find(|joint| {
            joint.child == branch.link
                && joint.kind == JointKind::Fixed
                && joint.problem.is_none()
                && Some(joint.name.as_str()) != branch.reached_by
        });
        if let (0, Some(joint)) = (branch.frame_ix, above) {
            branches.push(Branch {
                link: joint.parent.as_str(),
                frame_ix: 0,
                frame_from_link: branch.frame_from_link * joint.parent_from_joint.inverse(),
                variant: branch.variant,
                reached_by: Some(joint.name.as_str()),
            });
        }
    }

    /// Drops capsules inside other capsules of the same frame.
    fn drop_contained(&mut self) {
        let mut kept: Vec<Part> = Vec::new();
        for part in std::mem::take(&mut self.parts) {
            let inside = |a: &Part, b: &Part| {
                a.frame_ix == b.frame_ix && b.capsule_in_frame.contains(&a.capsule_in_frame)
            };
            if kept.iter().any(|other| inside(&part, other)) {
                continue;
            }
            kept.retain(|other| !inside(other, &part));
            kept.push(part);
        }
        self.parts = kept;
    }
}

impl JointMotion {
    fn at(&self, q: &[f64]) -> Transform {
        let position = self.multiplier * q[self.joint_ix] + self.offset;
        if self.is_prismatic {
            Transform::from_parts(
                Translation3::from(self.axis.into_inner() * position),
                UnitQuaternion::identity(),
            )
        } else {
            Transform::from_parts(
                Translation3::identity(),
                UnitQuaternion::from_axis_angle(&self.axis, position),
            )
        }
    }
}

/// How a joint follows an independent joint, possibly through other mimic joints.
struct Rule<'a> {
    source: &'a Joint,
    multiplier: f64,
    offset: f64,
}

impl<'a> Rule<'a> {
    fn of(robot: &'a Robot, joint: &'a Joint) -> Self {
        let mut rule = Self {
            source: joint,
            multiplier: 1.0,
            offset: 0.0,
        };
        // Mimic joints may form a loop. A chain through one is an error; elsewhere, the joint is
        // treated as independent.
        for _ in robot.joints() {
            let Some(mimic) = &rule.source.mimic else {
                break;
            };
            let Some(source) = robot.joint(&mimic.source) else {
                break;
            };
            rule.offset += rule.multiplier * mimic.offset;
            rule.multiplier *= mimic.multiplier;
            rule.source = source;
        }
        rule
    }

    fn motion(&self, joint: &Joint, joint_ix: usize) -> JointMotion {
        JointMotion {
            joint_ix,
            is_prismatic: joint.kind == JointKind::Prismatic,
            axis: joint.axis,
            multiplier: self.multiplier,
            offset: self.offset,
        }
    }

    /// Position of an independent joint outside the chain. A joint without limits, such as a wheel,
    /// is at zero.
    fn source_position(&self, variant: usize) -> f64 {
        let limits = &self.source.limits;
        if !limits.lower.is_finite() || !limits.upper.is_finite() {
            return 0.0;
        }
        limits.lower + (limits.upper - limits.lower) * OTHER_JOINT_FRACS[variant]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PANDA: &str = include_str!("../../../rigs/robots/panda.urdf");
    const JAW: &str = r#"<robot name="jaw">
        <link name="table"><visual><geometry><sphere radius="0.5"/></geometry></visual></link>
        <joint name="stand" type="fixed"><parent link="table"/><child link="base"/>
            <origin xyz="0 0 2"/></joint>
        <link name="base"/>
        <joint name="lift" type="prismatic"><parent link="base"/><child link="hand"/>
            <axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
        <link name="hand"><collision><geometry><mesh filename="hand.stl"/></geometry></collision>
            <visual><geometry><sphere radius="9"/></geometry></visual></link>
        <joint name="left" type="prismatic"><parent link="hand"/><child link="finger"/>
            <axis xyz="1 0 0"/><limit lower="0.1" upper="0.5" velocity="1" effort="1"/></joint>
        <link name="finger"><collision><geometry><sphere radius="0.01"/></geometry></collision>
            </link>
        <joint name="right" type="prismatic"><parent link="hand"/><child link="thumb"/>
            <axis xyz="1 0 0"/><mimic joint="left" multiplier="-2"/></joint>
        <link name="thumb"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
    </robot>"#;

    #[test]
    fn capsules_of_the_last_link_move_with_the_chain() {
        let robot = Robot::parse(PANDA).unwrap();
        let last = robot.joints().last().unwrap().child.clone();
        let chain = Chain::new(&robot, "panda_link0", "panda_link8")
            .unwrap_or_else(|_| Chain::new(&robot, "panda_link0", &last).expect("the last link"));
        let body = Body::new(&robot, &chain, &|_| None).unwrap();
        assert!(body.notes().is_empty());
        let (home, moved) = (
            [0.1, -0.3, 0.2, -2.0, 0.1, 1.7, 0.8],
            [0.7, 0.2, -0.3, -1.2, 0.4, 2.0, 0.1],
        );
        let tip_of = |q: &[f64]| chain.forward(q).unwrap();
        let ix = (0..body.n_parts())
            .max_by_key(|ix| body.part(*ix).frame_ix)
            .unwrap();
        let in_tip = |q: &[f64; 7]| body.capsules(q)[ix].transformed(&tip_of(q).inverse());
        let (a, b) = (in_tip(&home), in_tip(&moved));
        for end in 0..2 {
            assert!(
                (a.ends[end] - b.ends[end]).norm() < 1e-12,
                "rigidly joined to the tip"
            );
        }
    }

    #[test]
    fn table_fingers_and_meshes_are_enclosed() {
        let robot = Robot::parse(JAW).unwrap();
        let chain = Chain::new(&robot, "base", "hand").unwrap();
        let corners = vec![[0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.02, 0.0, 0.0]];
        let body = Body::new(&robot, &chain, &|_| Some(corners.clone())).unwrap();
        let capsules = body.capsules(&[0.25]);
        let of = |link: &str| -> Vec<Capsule> {
            (0..body.n_parts())
                .filter(|ix| body.part(*ix).link == link)
                .map(|ix| capsules[ix])
                .collect()
        };
        assert_eq!(of("table")[0].ends[0], Vector3::new(0.0, 0.0, -2.0));
        let xs = |link: &str| {
            let mut xs: Vec<f64> = of(link).iter().map(|capsule| capsule.ends[0].x).collect();
            xs.sort_by(f64::total_cmp);
            xs
        };
        let close = |a: &[f64], b: &[f64]| {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
        };
        assert!(close(&xs("finger"), &[0.1, 0.3, 0.5]), "{:?}", xs("finger"));
        assert!(
            close(&xs("thumb"), &[-1.0, -0.6, -0.2]),
            "{:?}",
            xs("thumb")
        );
        assert_eq!(of("finger")[0].ends[0].z, 0.25);
        assert_eq!(
            of("hand").len(),
            1,
            "the collision shape hides the visual shape"
        );
        let unread = Body::new(&robot, &chain, &|_| None).unwrap();
        assert!(unread.notes()[0].contains("hand"), "{:?}", unread.notes());
    }

    #[test]
    fn robots_without_shapes_are_refused() {
        let robot = Robot::parse(
            r#"<robot name="bare"><link name="a"/><link name="b"/>
            <joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>"#,
        )
        .unwrap();
        let chain = Chain::new(&robot, "a", "b").unwrap();
        let error = Body::new(&robot, &chain, &|_| None)
            .unwrap_err()
            .to_string();
        assert!(error.contains("bare"), "{error}");
    }
}
