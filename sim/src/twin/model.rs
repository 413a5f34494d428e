//! Kinematics of a robot from a URDF, with its arm, its joint ranges, and the tree of all its
//! links.

use super::description::RobotConfig;
use crate::Error;
use crate::joints::Joints;
use kinematics::urdf::{Joint, JointKind, JointLimits, Robot};
use kinematics::{Chain, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::collections::HashMap;
use std::f64::consts::PI;

/// Range of a joint with estimates for limits that the URDF does not state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct JointRange {
    /// Smallest position, radians or meters.
    pub(crate) lower: f64,
    /// Largest position, radians or meters.
    pub(crate) upper: f64,
    /// Largest speed of a scan, radians or meters per second.
    pub(crate) max_speed: f64,
}

/// Half the range of a prismatic joint without limits, meters.
const ESTIMATED_HALF_STROKE_M: f64 = 0.25;
/// Speed of a joint without a speed limit, rad/s. It is also the largest speed of a scan, because
/// many URDFs state the speed of the motor without its gear.
const MAX_SPEED_RAD_S: f64 = 1.5;
/// Speed of a prismatic joint without a speed limit, and largest speed of a scan, m/s.
const MAX_SPEED_M_S: f64 = 0.3;

/// A link with the joint above it.
#[derive(Clone, Debug)]
pub(crate) struct LinkNode {
    /// Name in the URDF.
    pub(crate) link: String,
    /// Number of links above it.
    pub(crate) depth: usize,
    /// Pose in the link above at joint position 0. It is the identity for the root.
    pub(crate) parent_from_link: Transform,
    /// Motion of the joint. `None` if the joint is fixed.
    pub(crate) motion: Option<LinkMotion>,
}

/// Motion of a link relative to the link above it.
#[derive(Clone, Debug)]
pub(crate) struct LinkMotion {
    /// Axis in the frame of the link.
    pub(crate) axis: Vector3<f64>,
    /// Whether the link slides along the axis. If not, the link rotates about the axis.
    pub(crate) is_prismatic: bool,
    source: MotionSource,
}

/// What determines the position of a joint.
#[derive(Clone, Copy, Debug)]
enum MotionSource {
    /// A joint of the arm, given by its index. The position is `multiplier * position + offset`.
    Arm {
        joint_ix: usize,
        multiplier: f64,
        offset: f64,
    },
    /// The joint stays at this position, because the rig does not read it.
    Rest(f64),
}

/// A robot from a URDF.
#[derive(Debug)]
pub(crate) struct TwinModel {
    robot: Robot,
    chain: Chain,
    ranges: Vec<JointRange>,
    /// All links of the tree that contains the base, depth first.
    links: Vec<LinkNode>,
    /// Pose of the root link in the base link, with the joints between them at rest.
    base_from_root: Transform,
}

impl TwinModel {
    /// Reads the URDF. Logs which limits are estimated.
    pub(crate) fn new(config: &RobotConfig) -> Result<Self, Error> {
        let robot = Robot::parse(&config.urdf).map_err(Error::Robot)?;
        let chain =
            Chain::new(&robot, &config.base_link, &config.flange_link).map_err(Error::Robot)?;
        let ranges = ranges(&robot, &chain);
        let above: HashMap<&str, &Joint> = robot
            .joints()
            .iter()
            .map(|joint| (joint.child.as_str(), joint))
            .collect();
        // The URDF has no cycles, so the walk ends at a root.
        let mut root = config.base_link.as_str();
        while let Some(joint) = above.get(root) {
            root = &joint.parent;
        }
        let base_from_root = root_from_link(&robot, &chain, root, &config.base_link)?.inverse();
        let links = links_below(&robot, &chain, root);
        Ok(Self {
            robot,
            chain,
            ranges,
            links,
            base_from_root,
        })
    }

    pub(crate) fn robot(&self) -> &Robot {
        &self.robot
    }

    pub(crate) fn chain(&self) -> &Chain {
        &self.chain
    }

    /// Ranges of the joints of the arm.
    pub(crate) fn ranges(&self) -> &[JointRange] {
        &self.ranges
    }

    /// All links, depth first.
    pub(crate) fn links(&self) -> &[LinkNode] {
        &self.links
    }

    pub(crate) fn base_from_root(&self) -> &Transform {
        &self.base_from_root
    }

    /// Whether the robot stands on its base link. If not, the base link is part of a body, such as
    /// a torso.
    pub(crate) fn stands_on_base(&self) -> bool {
        self.links
            .first()
            .is_some_and(|root| root.link == self.chain.base_link())
    }

    /// Number of joints of the arm.
    pub(crate) fn n_joints(&self) -> usize {
        self.ranges.len()
    }

    /// Pose of the flange for the positions of the arm's joints.
    pub(crate) fn base_from_flange(&self, position: &Joints) -> Transform {
        self.chain
            .forward(position.as_slice())
            .expect("simulated joints are finite, and as many as the chain has")
    }

    /// Positions of all moving joints in the order of [`Self::links`].
    pub(crate) fn model_positions(&self, position: &Joints) -> Vec<f64> {
        self.motions()
            .map(|motion| match motion.source {
                MotionSource::Arm {
                    joint_ix,
                    multiplier,
                    offset,
                } => multiplier * position[joint_ix] + offset,
                MotionSource::Rest(rest) => rest,
            })
            .collect()
    }

    /// Velocities of all moving joints for velocities of the arm's joints, in the order of
    /// [`Self::links`]. Accelerations map in the same way.
    pub(crate) fn model_velocities(&self, velocity: &Joints) -> Vec<f64> {
        self.motions()
            .map(|motion| match motion.source {
                MotionSource::Arm {
                    joint_ix,
                    multiplier,
                    ..
                } => multiplier * velocity[joint_ix],
                MotionSource::Rest(_) => 0.0,
            })
            .collect()
    }

    /// Efforts of the arm's joints for efforts of all moving joints. Mimic joints act on the joint
    /// that they follow.
    pub(crate) fn arm_efforts(&self, model_efforts: &[f64]) -> Joints {
        let mut efforts = Joints::zeros(self.n_joints());
        for (motion, effort) in self.motions().zip(model_efforts) {
            if let MotionSource::Arm {
                joint_ix,
                multiplier,
                ..
            } = motion.source
            {
                efforts[joint_ix] += multiplier * effort;
            }
        }
        efforts
    }

    /// Positions of the joints that are closest to 0.
    pub(crate) fn rest(&self) -> Joints {
        Joints::from_iterator(
            self.n_joints(),
            self.ranges
                .iter()
                .map(|range| 0.0_f64.clamp(range.lower, range.upper)),
        )
    }

    /// Poses of all links in the base, in the order of [`Self::links`].
    pub(crate) fn base_from_links(&self, position: &Joints) -> Vec<Transform> {
        let positions = self.model_positions(position);
        let mut positions = positions.iter();
        let mut poses: Vec<Transform> = Vec::with_capacity(self.links.len());
        let mut ancestors: Vec<usize> = Vec::new();
        for (ix, node) in self.links.iter().enumerate() {
            ancestors.truncate(node.depth);
            let above = ancestors
                .last()
                .map_or(self.base_from_root, |parent| poses[*parent]);
            let mut pose = above * node.parent_from_link;
            if let Some(motion) = &node.motion {
                pose *= moved(motion, positions.next().copied().unwrap_or_default());
            }
            poses.push(pose);
            ancestors.push(ix);
        }
        poses
    }

    fn motions(&self) -> impl Iterator<Item = &LinkMotion> {
        self.links.iter().filter_map(|node| node.motion.as_ref())
    }
}

/// Motion of a link when its joint moves from 0 to `position`.
fn moved(motion: &LinkMotion, position: f64) -> Transform {
    if motion.is_prismatic {
        return Translation3::from(motion.axis * position).into();
    }
    Transform::from_parts(
        Translation3::identity(),
        UnitQuaternion::from_scaled_axis(motion.axis * position),
    )
}

/// Ranges of the arm's joints. Logs the ranges that are estimated.
fn ranges(robot: &Robot, chain: &Chain) -> Vec<JointRange> {
    let mut estimated = Vec::new();
    let ranges = chain
        .joint_names()
        .iter()
        .zip(chain.limits())
        .map(|(name, limits)| {
            let is_prismatic = robot
                .joint(name)
                .is_some_and(|joint| joint.kind == JointKind::Prismatic);
            let (range, notes) = range(limits, is_prismatic);
            estimated.extend(notes.map(|note| format!("{name}: {note}")));
            range
        })
        .collect();
    if !estimated.is_empty() {
        log::info!(
            "limits that the URDF does not state are estimated for the simulation: {}",
            estimated.join("; ")
        );
    }
    ranges
}

/// The range of a joint, and a description of what is estimated.
fn range(limits: &JointLimits, is_prismatic: bool) -> (JointRange, Option<String>) {
    let (half_range, max_speed, unit) = if is_prismatic {
        (ESTIMATED_HALF_STROKE_M, MAX_SPEED_M_S, "m")
    } else {
        (PI, MAX_SPEED_RAD_S, "rad")
    };
    let [lower, upper] = match [limits.lower.is_finite(), limits.upper.is_finite()] {
        [true, true] => [limits.lower, limits.upper],
        [true, false] => [limits.lower, limits.lower + 2.0 * half_range],
        [false, true] => [limits.upper - 2.0 * half_range, limits.upper],
        [false, false] => [-half_range, half_range],
    };
    let range = JointRange {
        lower,
        upper,
        max_speed: limits.velocity.min(max_speed),
    };
    let mut notes = Vec::new();
    if [lower, upper] != [limits.lower, limits.upper] {
        notes.push(format!("{lower:.2} to {upper:.2} {unit}"));
    }
    if limits.velocity.is_infinite() {
        notes.push(format!("{max_speed} {unit}/s"));
    }
    (range, (!notes.is_empty()).then(|| notes.join(", ")))
}

/// Pose of a link below a root, with the joints between them at rest.
fn root_from_link(
    robot: &Robot,
    chain: &Chain,
    root: &str,
    link: &str,
) -> Result<Transform, Error> {
    let mut pose = Transform::identity();
    for joint in robot.path(root, link).map_err(Error::Robot)? {
        if let Some(problem) = &joint.problem {
            return Err(Error::Robot(problem.clone()));
        }
        pose *= joint.parent_from_joint;
        if let Some(motion) = motion(robot, chain, joint) {
            // These joints are not part of the arm, so they are at rest even if a joint of the arm
            // drives them.
            let rest = match motion.source {
                MotionSource::Rest(rest) => rest,
                MotionSource::Arm { offset, .. } => offset,
            };
            pose *= moved(&motion, rest);
        }
    }
    Ok(pose)
}

/// All links below `root`, depth first. Links below an invalid joint are left out, because their
/// poses are unknown.
fn links_below(robot: &Robot, chain: &Chain, root: &str) -> Vec<LinkNode> {
    let mut below: HashMap<&str, Vec<&Joint>> = HashMap::new();
    for joint in robot.joints() {
        if joint.problem.is_none() {
            below.entry(&joint.parent).or_default().push(joint);
        }
    }
    let mut links = Vec::new();
    let mut pending: Vec<(Option<&Joint>, usize)> = vec![(None, 0)];
    while let Some((joint, depth)) = pending.pop() {
        let link = joint.map_or(root, |joint| joint.child.as_str());
        links.push(LinkNode {
            link: link.to_owned(),
            depth,
            parent_from_link: joint
                .map_or_else(Transform::identity, |joint| joint.parent_from_joint),
            motion: joint.and_then(|joint| motion(robot, chain, joint)),
        });
        // The last entry of the stack is taken first, so the order is reversed.
        let children = below.get(link).into_iter().flatten().rev();
        pending.extend(children.map(|joint| (Some(*joint), depth + 1)));
    }
    links
}

/// The motion of a joint. `None` if the joint is fixed, or has more than one degree of freedom.
fn motion(robot: &Robot, chain: &Chain, joint: &Joint) -> Option<LinkMotion> {
    let is_prismatic = match joint.kind {
        JointKind::Revolute => false,
        JointKind::Prismatic => true,
        JointKind::Fixed | JointKind::Unsupported(_) => return None,
    };
    Some(LinkMotion {
        axis: joint.axis.into_inner(),
        is_prismatic,
        source: source(robot, chain, joint),
    })
}

/// The source of the position of a joint, after following its mimic rules.
fn source(robot: &Robot, chain: &Chain, joint: &Joint) -> MotionSource {
    let (mut multiplier, mut offset) = (1.0, 0.0);
    let mut current = joint;
    // A rule without a loop visits each joint at most once.
    for _ in 0..=robot.joints().len() {
        let names = chain.joint_names();
        if let Some(joint_ix) = names.iter().position(|name| *name == current.name) {
            return MotionSource::Arm {
                joint_ix,
                multiplier,
                offset,
            };
        }
        let Some(mimic) = &current.mimic else {
            let limits = &current.limits;
            let rest = 0.0_f64.max(limits.lower).min(limits.upper);
            return MotionSource::Rest(multiplier * rest + offset);
        };
        let Some(followed) = robot.joint(&mimic.source) else {
            break;
        };
        offset += multiplier * mimic.offset;
        multiplier *= mimic.multiplier;
        current = followed;
    }
    MotionSource::Rest(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn config(urdf: &str, base_link: &str, flange_link: &str) -> RobotConfig {
        RobotConfig {
            urdf: urdf.to_owned(),
            base_link: base_link.to_owned(),
            flange_link: flange_link.to_owned(),
            meshes: BTreeMap::new(),
            world_from_base: Transform::identity(),
            has_moving_base: false,
            max_blur_px: 1.5,
            max_shear_px: 40.0,
        }
    }

    /// A torso with a joint that the rig does not read, and an arm with a mimic joint.
    const TORSO: &str = r#"<robot name="torso">
      <link name="root"/> <link name="torso"/> <link name="upper"/> <link name="lower"/>
      <link name="tool"/> <link name="finger"/>
      <joint name="waist" type="revolute"><parent link="root"/><child link="torso"/>
        <origin xyz="0 0 0.8"/><axis xyz="0 0 1"/><limit lower="0.2" upper="1" effort="1" velocity="1"/></joint>
      <joint name="shoulder" type="continuous"><parent link="torso"/><child link="upper"/>
        <origin xyz="0 0.2 0.3"/><axis xyz="0 1 0"/></joint>
      <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
        <origin xyz="0.3 0 0"/><axis xyz="0 1 0"/><mimic joint="shoulder" multiplier="-0.5" offset="0.1"/>
        <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
      <joint name="slide" type="prismatic"><parent link="lower"/><child link="tool"/>
        <origin xyz="0.2 0 0"/><axis xyz="1 0 0"/></joint>
      <joint name="grip" type="prismatic"><parent link="tool"/><child link="finger"/>
        <axis xyz="0 1 0"/><limit lower="0.01" upper="0.04" effort="1" velocity="1"/></joint>
    </robot>"#;

    #[test]
    fn tree_of_links_agrees_with_the_chain() {
        const TOLERANCE: f64 = 1e-12;
        let model = TwinModel::new(&config(TORSO, "torso", "tool")).expect("a robot");
        assert_eq!(model.chain().joint_names(), ["shoulder", "slide"]);
        let position = Joints::from_row_slice(&[0.7, 0.1]);
        let poses = model.base_from_links(&position);
        let ix_of = |link: &str| {
            let at = model.links().iter().position(|node| node.link == link);
            at.expect("a link")
        };
        let difference = poses[ix_of("tool")].inverse() * model.base_from_flange(&position);
        assert!(difference.translation.vector.norm() < TOLERANCE);
        assert!(difference.rotation.angle() < 1e-7);
        let base = poses[ix_of("torso")];
        assert!(base.translation.vector.norm() + base.rotation.angle() < 1e-7);
        // The waist rests at its lower limit.
        assert!((poses[0].rotation.angle() - 0.2).abs() < TOLERANCE);
        assert_eq!(
            model.model_positions(&position),
            [0.2, 0.7, -0.5 * 0.7 + 0.1, 0.1, 0.01]
        );
    }

    #[test]
    fn missing_limits_are_estimated_and_mimic_efforts_reach_their_joint() {
        let model = TwinModel::new(&config(TORSO, "torso", "tool")).expect("a robot");
        let [shoulder, slide] = [model.ranges()[0], model.ranges()[1]];
        assert_eq!(
            [shoulder.lower, shoulder.upper, shoulder.max_speed],
            [-PI, PI, MAX_SPEED_RAD_S]
        );
        assert_eq!(
            [slide.lower, slide.upper],
            [-ESTIMATED_HALF_STROKE_M, ESTIMATED_HALF_STROKE_M]
        );
        let efforts = model.arm_efforts(&[5.0, 2.0, 4.0, 3.0, 9.0]);
        assert_eq!(efforts.as_slice(), [2.0 - 0.5 * 4.0, 3.0]);
        let (_, note) = range(&JointLimits::NONE, true);
        assert_eq!(note.as_deref(), Some("-0.25 to 0.25 m, 0.3 m/s"));
    }

    #[test]
    fn unknown_flange_is_an_error() {
        let error = TwinModel::new(&config(TORSO, "torso", "hand")).expect_err("no such link");
        assert!(error.to_string().contains("hand"), "{error}");
    }
}
