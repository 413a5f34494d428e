//! The robot of a rig at rest, and the positions that its flange reaches.

use crate::config::{ArmDriver, Rig};
use crate::open::chain_of;
use anyhow::Context;
use kinematics::urdf::{Joint, JointKind, JointLimits, Robot};
use kinematics::{Chain, Transform};
use nalgebra::{Point3, Translation3, UnitQuaternion};
use std::collections::{BTreeMap, HashMap};
use std::f64::consts::PI;

/// Number of postures that are sampled. They fill the workspace of an arm with seven joints well
/// enough for its outline.
const N_POSTURES: u32 = 4000;
/// Range of a joint without limits: a full revolution. A prismatic joint without limits is an
/// incomplete description, and gets the same number in meters.
const UNLIMITED: f64 = PI;
/// Links that are closer together than this count as one place.
const SAME_PLACE_M: f64 = 0.01;

/// A straight line between the frames of a link and of its parent, in the base frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Bone {
    /// Name of the link.
    pub link: String,
    /// Origins of the frames of the parent and of the link.
    pub ends_in_base: [Point3<f64>; 2],
}

/// The robot with all joints at rest: at 0, or at the limit nearest to 0.
#[derive(Debug)]
pub(super) struct RobotAtRest {
    /// All links below the root of the URDF.
    pub(super) bones: Vec<Bone>,
    pub(super) base_from_flange: Transform,
    /// Origin of the frame of the first moving joint between base and flange. The origin of the
    /// base if there is none.
    pub(super) first_joint_in_base: Point3<f64>,
    /// Origin of the nearest frame before the flange that is at another place, in the flange frame:
    /// there the arm is. `None` if all frames are at one place.
    pub(super) arm_in_flange: Option<Point3<f64>>,
}

/// Facts about an arm.
#[derive(Clone, Debug)]
pub struct ArmFacts {
    /// Source of the joint states.
    pub driver: ArmDriver,
    /// Number of joints that move the flange.
    pub n_joints: usize,
    /// Link of the URDF to which cameras are attached.
    pub flange_link: String,
    /// Pose of the flange in the base frame with all joints at rest.
    pub base_from_flange: Transform,
    /// Origin of the first joint in the base frame.
    pub first_joint_in_base: Point3<f64>,
    /// Greatest distance of the flange from the first joint within the joint limits, meters.
    pub reach_m: f64,
    /// Positions of the flange in the base frame, for postures within the joint limits.
    pub reached_in_base: Vec<Point3<f64>>,
}

impl RobotAtRest {
    pub(super) fn of(rig: &Rig) -> anyhow::Result<Self> {
        let arm = &rig.arm;
        let robot = Robot::parse(&arm.urdf_text).context("the arm's URDF")?;
        let above: HashMap<&str, &Joint> = robot
            .joints()
            .iter()
            .map(|joint| (joint.child.as_str(), joint))
            .collect();
        let root = root_above(&above, &arm.base_link);
        let root_from_link = links_below(&robot, root);
        let base_from_root = root_from_link
            .get(&arm.base_link)
            .map_or_else(Transform::identity, Transform::inverse);
        let bones = bones(&above, &root_from_link, &base_from_root);
        let path = robot
            .path(&arm.base_link, &arm.flange_link)
            .context("the arm's URDF")?;
        let base_from_flange = root_from_link
            .get(&arm.flange_link)
            .map_or_else(Transform::identity, |pose| base_from_root * pose);
        let first_joint = path.iter().find(|joint| joint.kind != JointKind::Fixed);
        let first_joint_in_base = first_joint
            .and_then(|joint| root_from_link.get(&joint.parent).zip(Some(joint)))
            .map_or_else(Point3::origin, |(pose, joint)| {
                base_from_root * pose * joint.parent_from_joint * Point3::origin()
            });
        let in_flange = |joint: &&Joint| {
            let pose = base_from_root * root_from_link.get(&joint.parent)?;
            Some(base_from_flange.inverse() * pose * Point3::origin())
        };
        let arm_in_flange = path
            .iter()
            .rev()
            .filter_map(in_flange)
            .find(|origin| origin.coords.norm() > SAME_PLACE_M);
        Ok(Self {
            bones,
            base_from_flange,
            first_joint_in_base,
            arm_in_flange,
        })
    }
}

/// The root of the tree that contains a link. The URDF has no cycles.
fn root_above<'a>(above: &HashMap<&str, &'a Joint>, link: &'a str) -> &'a str {
    let mut root = link;
    while let Some(joint) = above.get(root) {
        root = &joint.parent;
    }
    root
}

/// Poses of all links below `root` with the joints at rest. Links below an invalid joint are left
/// out, because their poses are unknown.
fn links_below(robot: &Robot, root: &str) -> BTreeMap<String, Transform> {
    let mut below: HashMap<&str, Vec<&Joint>> = HashMap::new();
    for joint in robot.joints() {
        if joint.problem.is_none() {
            below.entry(&joint.parent).or_default().push(joint);
        }
    }
    let mut poses = BTreeMap::new();
    let mut pending = vec![(root, Transform::identity())];
    while let Some((link, pose)) = pending.pop() {
        for joint in below.get(link).into_iter().flatten() {
            pending.push((&joint.child, pose * at_rest(robot, joint)));
        }
        poses.insert(link.to_owned(), pose);
    }
    poses
}

/// Pose of the child link of a joint at rest in the parent link.
fn at_rest(robot: &Robot, joint: &Joint) -> Transform {
    let source = joint
        .mimic
        .as_ref()
        .and_then(|mimic| Some((mimic, robot.joint(&mimic.source)?)));
    let position = match source {
        Some((mimic, source)) => mimic.multiplier * rest_of(&source.limits) + mimic.offset,
        None => rest_of(&joint.limits),
    };
    let motion = match joint.kind {
        JointKind::Revolute => Transform::from_parts(
            Translation3::identity(),
            UnitQuaternion::from_axis_angle(&joint.axis, position),
        ),
        JointKind::Prismatic => Transform::from_parts(
            (joint.axis.into_inner() * position).into(),
            UnitQuaternion::identity(),
        ),
        JointKind::Fixed | JointKind::Unsupported(_) => Transform::identity(),
    };
    joint.parent_from_joint * motion
}

/// The position nearest to 0.
fn rest_of(limits: &JointLimits) -> f64 {
    if limits.lower <= limits.upper {
        0.0_f64.clamp(limits.lower, limits.upper)
    } else {
        0.0
    }
}

fn bones(
    above: &HashMap<&str, &Joint>,
    root_from_link: &BTreeMap<String, Transform>,
    base_from_root: &Transform,
) -> Vec<Bone> {
    let origin = |link: &str| {
        let pose = root_from_link.get(link)?;
        Some(base_from_root * pose * Point3::origin())
    };
    root_from_link
        .keys()
        .filter_map(|link| {
            let joint = above.get(link.as_str())?;
            Some(Bone {
                link: link.clone(),
                ends_in_base: [origin(&joint.parent)?, origin(link)?],
            })
        })
        .collect()
}

impl ArmFacts {
    pub(super) fn of(rig: &Rig, robot: &RobotAtRest) -> anyhow::Result<Option<Self>> {
        let chain = chain_of(rig)?;
        if chain.n_joints() == 0 {
            return Ok(None);
        }
        let reached_in_base = reached(&chain);
        let reach_m = reach_m(&chain, &robot.first_joint_in_base);
        Ok(Some(Self {
            driver: rig.arm.driver,
            n_joints: chain.n_joints(),
            flange_link: rig.arm.flange_link.clone(),
            base_from_flange: robot.base_from_flange,
            first_joint_in_base: robot.first_joint_in_base,
            reach_m,
            reached_in_base,
        }))
    }
}

/// Ranges of the joints of a chain.
fn ranges(chain: &Chain) -> Vec<[f64; 2]> {
    let range = |limits: &JointLimits| match [limits.lower, limits.upper] {
        [lower, upper] if lower.is_finite() && upper.is_finite() => [lower, upper],
        _ => [-UNLIMITED, UNLIMITED],
    };
    chain.limits().iter().map(range).collect()
}

/// Postures that fill the ranges evenly: an additive recurrence with the powers of the root of
/// `x^(n + 1) = x + 1` (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
/// 2018).
fn postures(ranges: &[[f64; 2]]) -> impl Iterator<Item = Vec<f64>> {
    let n = f64::from(u32::try_from(ranges.len()).unwrap_or(u32::MAX));
    let root = (0..50).fold(1.5_f64, |root, _| (1.0 + root).powf(1.0 / (n + 1.0)));
    (0..N_POSTURES).map(move |posture| {
        let mut power = 1.0;
        ranges
            .iter()
            .map(|[lower, upper]| {
                power /= root;
                let frac = (0.5 + power * f64::from(posture)).fract();
                lower + frac * (upper - lower)
            })
            .collect()
    })
}

fn reached(chain: &Chain) -> Vec<Point3<f64>> {
    postures(&ranges(chain))
        .filter_map(|posture| Some(chain.forward(&posture).ok()? * Point3::origin()))
        .collect()
}

/// Greatest distance of the flange from a point, within the joint limits: the best sampled postures,
/// improved joint by joint.
fn reach_m(chain: &Chain, from_in_base: &Point3<f64>) -> f64 {
    /// The best sample may lead to a local maximum.
    const N_STARTS: usize = 8;
    const N_HALVINGS: u32 = 16;
    let distance_m = |posture: &[f64]| {
        let pose = chain.forward(posture).unwrap_or_default();
        (pose * Point3::origin() - from_in_base).norm()
    };
    let ranges = ranges(chain);
    let mut starts: Vec<(f64, Vec<f64>)> = postures(&ranges)
        .map(|posture| (distance_m(&posture), posture))
        .collect();
    starts.sort_by(|one, other| other.0.total_cmp(&one.0));
    let improved = |(mut best_m, mut posture): (f64, Vec<f64>)| {
        for halving in 0..N_HALVINGS {
            for (ix, [lower, upper]) in ranges.iter().enumerate() {
                let step = 0.25 * (upper - lower) * 0.5_f64.powf(halving.into());
                for moved in [posture[ix] - step, posture[ix] + step] {
                    let before = std::mem::replace(&mut posture[ix], moved.clamp(*lower, *upper));
                    let moved_m = distance_m(&posture);
                    if moved_m > best_m {
                        best_m = moved_m;
                    } else {
                        posture[ix] = before;
                    }
                }
            }
        }
        best_m
    };
    starts
        .into_iter()
        .take(N_STARTS)
        .map(improved)
        .fold(0.0, f64::max)
}
