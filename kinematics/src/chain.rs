//! Forward kinematics and Jacobian from a base link to a tip link.

use crate::urdf::{Joint, JointKind, JointLimits, Mimic, Robot};
use crate::{Error, Transform, Twist};
use nalgebra::{Matrix6xX, Quaternion, Translation3, Unit, UnitQuaternion, Vector3, Vector6};
use std::collections::HashMap;

/// The joints between two links of a robot, ready to compute poses.
///
/// A configuration is a slice with one value per joint, in the order of [`Chain::joint_names`].
/// Values are radians for revolute joints and meters for prismatic joints. Mimic joints are not
/// part of a configuration. Their positions are computed from the joints that they follow.
#[derive(Clone, Debug)]
pub struct Chain {
    base_link: String,
    tip_link: String,
    joint_names: Vec<String>,
    limits: Vec<JointLimits>,
    segments: Vec<Segment>,
    /// Pose of the tip link in the frame of the last joint, whose axis is z.
    last_from_tip: RigidMotion,
}

/// A constant transform, followed by the motion of one joint along or about the z axis.
///
/// Fixed joints are merged into the constant, and frames are rotated so that every joint moves
/// along or about z. Both happen once, when the chain is built.
#[derive(Clone, Debug)]
struct Segment {
    before: RigidMotion,
    is_prismatic: bool,
    joint_ix: usize,
    multiplier: f64,
    offset: f64,
}

#[derive(Clone, Copy, Debug)]
struct RigidMotion {
    rotation: Quaternion<f64>,
    translation: Vector3<f64>,
}

impl Chain {
    /// Parses a URDF and selects the joints from `base_link` down to `tip_link`.
    pub fn from_urdf(xml: &str, base_link: &str, tip_link: &str) -> Result<Self, Error> {
        Self::new(&Robot::parse(xml)?, base_link, tip_link)
    }

    /// Selects the joints of `robot` from `base_link` down to `tip_link`.
    pub fn new(robot: &Robot, base_link: &str, tip_link: &str) -> Result<Self, Error> {
        let mut chain = Self {
            base_link: base_link.into(),
            tip_link: tip_link.into(),
            joint_names: Vec::new(),
            limits: Vec::new(),
            segments: Vec::new(),
            last_from_tip: RigidMotion::new(&Transform::identity()),
        };
        // The product of the fixed transforms since the last moving joint. It becomes part of the
        // next segment, so that a pose takes one product per moving joint.
        let mut constant = Transform::identity();
        let mut rules = MimicRules::new();
        let mut indices = HashMap::new();
        for joint in robot.path(base_link, tip_link)? {
            // A file may contain invalid joints, because only chains through such joints need their
            // poses. This chain leads through the joint, so the problem of the joint is an error
            // here.
            if let Some(problem) = &joint.problem {
                return Err(problem.clone());
            }
            constant *= joint.parent_from_joint;
            let is_prismatic = match joint.kind {
                JointKind::Fixed => continue,
                JointKind::Revolute => false,
                JointKind::Prismatic => true,
                JointKind::Unsupported(kind) => {
                    return Err(Error::JointType {
                        joint: joint.name.clone(),
                        kind,
                    });
                }
            };
            // Rotates the frame so that the joint's axis is z. A motion along or about z has a
            // closed form that is cheaper than a product. The rotation is undone after the joint,
            // so that later frames are the frames of the URDF.
            let joint_from_aligned = rotation_from_z_to(&joint.axis);
            let rule = follow_mimics(robot, joint, &mut rules)?;
            // Two mimic joints may follow the same joint, which has one value in a configuration.
            let joint_ix = *indices
                .entry(&rule.source.name)
                .or_insert_with(|| chain.add(rule.source));
            chain.segments.push(Segment {
                before: RigidMotion::new(&(constant * joint_from_aligned)),
                is_prismatic,
                joint_ix,
                multiplier: rule.multiplier,
                offset: rule.offset,
            });
            constant =
                Transform::from_parts(Translation3::identity(), joint_from_aligned.inverse());
        }
        chain.last_from_tip = RigidMotion::new(&constant);
        Ok(chain)
    }

    /// Name of the link in whose frame poses are given.
    pub fn base_link(&self) -> &str {
        &self.base_link
    }

    /// Name of the link whose pose is computed.
    pub fn tip_link(&self) -> &str {
        &self.tip_link
    }

    /// Names of the independent moving joints, from base to tip. A joint that a mimic joint follows
    /// is listed at the first position where it affects the chain, even if it is not on the path
    /// from base to tip.
    pub fn joint_names(&self) -> &[String] {
        &self.joint_names
    }

    /// Number of values in a configuration.
    pub fn n_joints(&self) -> usize {
        self.joint_names.len()
    }

    /// Limits of the moving joints, in the order of [`Chain::joint_names`].
    pub fn limits(&self) -> &[JointLimits] {
        &self.limits
    }

    /// Index in `names` of each joint of the chain, for devices and files with a different joint
    /// order.
    pub fn order_in(&self, names: &[String]) -> Result<Vec<usize>, Error> {
        self.joint_names
            .iter()
            .map(|joint| self.position_in(names, joint))
            .collect()
    }

    /// Index in `names` of one joint of the chain.
    fn position_in(&self, names: &[String], joint: &str) -> Result<usize, Error> {
        names
            .iter()
            .position(|name| name == joint)
            .ok_or_else(|| Error::MissingJoint {
                joint: joint.to_owned(),
                tip: self.tip_link.clone(),
                given: names.to_vec(),
            })
    }

    /// Pose of the tip in the base, `base_from_tip`.
    pub fn forward(&self, q: &[f64]) -> Result<Transform, Error> {
        let mut base_from_tip = Transform::identity();
        self.forward_into(q, &mut base_from_tip)?;
        Ok(base_from_tip)
    }

    /// Like [`Chain::forward`], but writes the pose into `base_from_tip`, which is unchanged on
    /// error. Neither function allocates memory.
    pub fn forward_into(&self, q: &[f64], base_from_tip: &mut Transform) -> Result<(), Error> {
        self.check(q)?;
        // Computes on a copy, so that `base_from_tip` is written only once the pose is complete.
        let mut pose = RigidMotion::IDENTITY;
        for segment in &self.segments {
            pose.compose(&segment.before);
            pose.move_joint(segment, q);
        }
        pose.compose(&self.last_from_tip);
        *base_from_tip = pose.transform();
        Ok(())
    }

    /// Geometric Jacobian at `q`. Multiplied by the joint velocities, it gives the velocity of the
    /// tip's origin (rows 0 to 2) and the angular velocity of the tip (rows 3 to 5), both in the
    /// base frame.
    pub fn jacobian(&self, q: &[f64]) -> Result<Matrix6xX<f64>, Error> {
        self.check(q)?;
        let mut columns = vec![Vector6::zeros(); self.n_joints()];
        self.forward_with_columns(q, &mut columns);
        Ok(Matrix6xX::from_fn(self.n_joints(), |row, column| {
            columns[column][row]
        }))
    }

    /// The pose of [`Chain::forward`], and the columns of [`Chain::jacobian`] in one pass without
    /// allocation. `q` must be finite, and both slices must have one element per joint.
    pub(crate) fn forward_with_columns(
        &self,
        q: &[f64],
        columns: &mut [Vector6<f64>],
    ) -> Transform {
        columns.fill(Vector6::zeros());
        let mut pose = RigidMotion::IDENTITY;
        for segment in &self.segments {
            pose.compose(&segment.before);
            let axis_in_base = rotate(&pose.rotation, &Vector3::z()) * segment.multiplier;
            // This is the velocity of the point that coincides with the base's origin, because the
            // position of the tip is not known yet. The velocity of the tip is computed from it
            // later, with the lever arm between the two points.
            let (linear, angular) = if segment.is_prismatic {
                (axis_in_base, Vector3::zeros())
            } else {
                (pose.translation.cross(&axis_in_base), axis_in_base)
            };
            // A joint and its mimic joints share one column, so their motions add up. A mimic joint
            // moves `multiplier` times as fast as the joint that it follows.
            let column = &mut columns[segment.joint_ix];
            for axis in 0..3 {
                column[axis] += linear[axis];
                column[3 + axis] += angular[axis];
            }
            // The axis was computed before the joint motion, which is correct because the motion
            // does not change it.
            pose.move_joint(segment, q);
        }
        pose.compose(&self.last_from_tip);
        for column in columns {
            let angular = Vector3::new(column[3], column[4], column[5]);
            let lever = angular.cross(&pose.translation);
            for axis in 0..3 {
                column[axis] += lever[axis];
            }
        }
        pose.transform()
    }

    /// Whether a joint gives the same pose after a full turn.
    pub(crate) fn is_periodic(&self, joint_ix: usize) -> bool {
        self.segments
            .iter()
            .filter(|segment| segment.joint_ix == joint_ix)
            .all(|segment| !segment.is_prismatic && segment.multiplier.fract() == 0.0)
    }

    /// Whether each joint moves exactly one segment, at the rate of its value. The result is false
    /// if several segments follow one joint, or if a mimic joint scales or shifts the value that it
    /// follows.
    pub(crate) fn has_one_segment_per_joint(&self) -> bool {
        let mut segments = self.segments.iter().enumerate();
        segments.all(|(ix, segment)| {
            segment.joint_ix == ix && segment.multiplier == 1.0 && segment.offset == 0.0
        })
    }

    /// Sum of the distances between neighboring joints, meters. For a chain without prismatic
    /// joints, the tip's distance from the base never exceeds this sum.
    pub(crate) fn length_m(&self) -> f64 {
        let before_each = self.segments.iter().map(|segment| &segment.before);
        before_each
            .chain([&self.last_from_tip])
            .map(|motion| motion.translation.norm())
            .sum()
    }

    /// Velocity of the tip relative to the base, in the tip frame, when the joints are at `q` and
    /// move with the velocities `qd` (rad/s or m/s).
    pub fn tip_twist(&self, q: &[f64], qd: &[f64]) -> Result<Twist, Error> {
        self.check(qd)?;
        let mut tip = Twist::zero();
        for (twist, rate) in self.tip_twists_by_joint(q)?.iter().zip(qd) {
            tip.linear_m_s += twist.linear_m_s * *rate;
            tip.angular_rad_s += twist.angular_rad_s * *rate;
        }
        Ok(tip)
    }

    /// For each joint, the velocity of the tip relative to the base, in the tip frame, when only
    /// that joint moves from `q` at unit speed (1 rad/s or 1 m/s).
    pub fn tip_twists_by_joint(&self, q: &[f64]) -> Result<Vec<Twist>, Error> {
        // The two frames have the same origin, so only the axes of the velocity change.
        let tip_from_base = self.forward(q)?.rotation.inverse();
        let jacobian = self.jacobian(q)?;
        let columns = jacobian.column_iter();
        Ok(columns
            .map(|column| {
                let linear_in_base: Vector3<f64> = column.fixed_rows::<3>(0).into();
                let angular_in_base: Vector3<f64> = column.fixed_rows::<3>(3).into();
                Twist {
                    linear_m_s: tip_from_base * linear_in_base,
                    angular_rad_s: tip_from_base * angular_in_base,
                }
            })
            .collect())
    }

    pub(crate) fn check(&self, values: &[f64]) -> Result<(), Error> {
        if values.len() != self.n_joints() {
            return Err(Error::JointCount {
                got: values.len(),
                expected: self.n_joints(),
                joints: self.joint_names.clone(),
            });
        }
        // A single NaN from a device would make the whole pose NaN, and later errors could not name
        // the joint.
        match values.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(at) => Err(Error::JointNotFinite {
                joint: self.joint_names[at].clone(),
                value: values[at],
            }),
        }
    }

    fn add(&mut self, source: &Joint) -> usize {
        self.joint_names.push(source.name.clone());
        self.limits.push(source.limits);
        self.joint_names.len() - 1
    }
}

/// How a joint follows an independent joint: `multiplier * source + offset`. A joint without
/// `<mimic>` is its own source.
#[derive(Clone, Copy)]
struct MimicRule<'a> {
    source: &'a Joint,
    multiplier: f64,
    offset: f64,
}

/// The known rules, by joint. With them, each chain of mimic joints is followed only once.
type MimicRules<'a> = HashMap<&'a str, MimicRule<'a>>;

/// The rule that expresses `joint` by an independent joint. Any number of mimic joints may be
/// between the two.
fn follow_mimics<'a>(
    robot: &'a Robot,
    joint: &'a Joint,
    rules: &mut MimicRules<'a>,
) -> Result<MimicRule<'a>, Error> {
    // Upwards: walk from the joint to a joint that is independent or whose rule is known.
    let mut followers = Vec::new();
    let mut current = joint;
    let mut rule = loop {
        if let Some(known) = rules.get(current.name.as_str()) {
            break *known;
        }
        let Some(mimic) = &current.mimic else {
            break MimicRule {
                source: current,
                multiplier: 1.0,
                offset: 0.0,
            };
        };
        let source = robot
            .joint(&mimic.source)
            .ok_or_else(|| mimic_error(joint, mimic, "is not in the URDF"))?;
        if let Some(problem) = &source.problem {
            return Err(problem.clone());
        }
        if !matches!(source.kind, JointKind::Revolute | JointKind::Prismatic) {
            let why = "is not a revolute, continuous or prismatic joint";
            return Err(mimic_error(joint, mimic, why));
        }
        // A path without a loop visits every joint at most once.
        if followers.len() >= robot.joints().len() {
            return Err(mimic_error(joint, mimic, "creates a loop of mimic joints"));
        }
        followers.push((current, mimic));
        current = source;
    };
    // Back down: substitute each rule into the rule of its follower, and remember the result. With
    // `source = a x + b`, the follower is `m (a x + b) + c = (m a) x + (m b + c)`.
    while let Some((follower, mimic)) = followers.pop() {
        let MimicRule {
            source,
            multiplier,
            offset,
        } = rule;
        rule = MimicRule {
            source,
            multiplier: mimic.multiplier * multiplier,
            offset: mimic.multiplier * offset + mimic.offset,
        };
        rules.insert(&follower.name, rule);
    }
    Ok(rule)
}

/// The error of a joint whose mimic rules cannot be followed. `mimic` is the rule that is at fault.
fn mimic_error(joint: &Joint, mimic: &Mimic, why: &'static str) -> Error {
    Error::Mimic {
        joint: joint.name.clone(),
        source_joint: mimic.source.clone(),
        why,
    }
}

/// A rotation that maps the z axis to `axis`. The angle about `axis` is arbitrary.
fn rotation_from_z_to(axis: &Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    // For opposite directions, the rotation axis is not determined. A half turn about any axis
    // perpendicular to z is correct.
    UnitQuaternion::rotation_between_axis(&Vector3::z_axis(), axis)
        .unwrap_or_else(|| UnitQuaternion::from_quaternion(Quaternion::new(0.0, 1.0, 0.0, 0.0)))
}

/// `q v q*` with two cross products, which take half the operations of two quaternion products.
fn rotate(rotation: &Quaternion<f64>, vector: &Vector3<f64>) -> Vector3<f64> {
    let twice = rotation.imag().cross(vector) * 2.0;
    vector + twice * rotation.scalar() + rotation.imag().cross(&twice)
}

impl RigidMotion {
    const IDENTITY: Self = Self {
        rotation: Quaternion::from_vector(nalgebra::Vector4::new(0.0, 0.0, 0.0, 1.0)),
        translation: Vector3::new(0.0, 0.0, 0.0),
    };

    fn new(transform: &Transform) -> Self {
        Self {
            rotation: transform.rotation.into_inner(),
            translation: transform.translation.vector,
        }
    }

    fn transform(&self) -> Transform {
        // The product of a few unit quaternions deviates from unit length only by rounding.
        Transform::from_parts(
            self.translation.into(),
            UnitQuaternion::new_unchecked(self.rotation),
        )
    }

    fn compose(&mut self, next: &Self) {
        self.translation += rotate(&self.rotation, &next.translation);
        self.rotation *= next.rotation;
    }

    fn move_joint(&mut self, segment: &Segment, q: &[f64]) {
        let value = segment.multiplier * q[segment.joint_ix] + segment.offset;
        if segment.is_prismatic {
            self.translation += rotate(&self.rotation, &Vector3::new(0.0, 0.0, value));
            return;
        }
        // This multiplies by the quaternion (cos, 0, 0, sin) of half the angle. Terms that are zero
        // are left out.
        let (sin, cos) = (0.5 * value).sin_cos();
        let r = &self.rotation;
        self.rotation = Quaternion::new(
            r.w * cos - r.k * sin,
            r.i * cos + r.j * sin,
            r.j * cos - r.i * sin,
            r.k * cos + r.w * sin,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix4;
    use std::f64::consts::FRAC_PI_2;

    const PANDA: &str = include_str!("../tests/data/panda.urdf");
    const CLOSE: f64 = 1e-12; // Bounds the rounding error of a dozen products of numbers near 1.

    /// Modified Denavit-Hartenberg rows (a, d, alpha) of the Panda.
    const PANDA_DH: [[f64; 3]; 7] = [
        [0.0, 0.333, 0.0],
        [0.0, 0.0, -FRAC_PI_2],
        [0.0, 0.316, FRAC_PI_2],
        [0.0825, 0.0, FRAC_PI_2],
        [-0.0825, 0.384, -FRAC_PI_2],
        [0.0, 0.0, FRAC_PI_2],
        [0.088, 0.0, FRAC_PI_2],
    ];

    fn panda_by_dh(q: &[f64]) -> Matrix4<f64> {
        let mut base_from_link = Matrix4::<f64>::identity();
        for (&[a, d, alpha], theta) in PANDA_DH.iter().zip(q) {
            let ((sa, ca), (st, ct)) = (alpha.sin_cos(), theta.sin_cos());
            #[rustfmt::skip]
            let step = Matrix4::new(
                ct, -st, 0.0, a,
                st * ca, ct * ca, -sa, -d * sa,
                st * sa, ct * sa, ca, d * ca,
                0.0, 0.0, 0.0, 1.0,
            );
            base_from_link *= step;
        }
        let flange = Matrix4::new_translation(&Vector3::new(0.0, 0.0, 0.107));
        base_from_link * flange
    }

    fn configurations(n_joints: usize) -> Vec<Vec<f64>> {
        let value = |at: usize, joint: usize| ((at * 7 + joint * 13 + 3) as f64 * 1.7).sin() * 2.5;
        (0..50)
            .map(|at| (0..n_joints).map(|joint| value(at, joint)).collect())
            .collect()
    }

    fn distance(a: &Matrix4<f64>, b: &Matrix4<f64>) -> f64 {
        (a - b).abs().max()
    }

    /// A robot with every joint type, non-standard axes, and mimic joints with offsets. One of the
    /// mimic joints follows a joint outside the path.
    const ODD: &str = r#"<robot name="odd">
        <link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="f"/><link name="g"/>
        <link name="off"/><link name="soft"/>
        <joint name="down" type="continuous"><parent link="a"/><child link="b"/>
            <origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/><axis xyz="0 0 -2"/></joint>
        <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/>
            <origin rpy="1 0 0"/><axis xyz="1 1 -1"/><limit lower="-1" upper="1" velocity="1"/></joint>
        <joint name="rigid" type="fixed"><parent link="c"/><child link="d"/><origin xyz="0 0.3 0" rpy="0 0 2"/></joint>
        <joint name="copy" type="revolute"><parent link="d"/><child link="e"/>
            <axis xyz="0 1 0"/><mimic joint="down" multiplier="-2" offset="0.3"/></joint>
        <joint name="far" type="revolute"><parent link="a"/><child link="off"/></joint>
        <joint name="copy_far" type="prismatic"><parent link="e"/><child link="f"/>
            <axis xyz="1 0 0"/><mimic joint="copy_copy" multiplier="0.5"/></joint>
        <joint name="copy_copy" type="revolute"><parent link="f"/><child link="g"/>
            <mimic joint="far" multiplier="3" offset="-1"/></joint>
        <joint name="float" type="floating"><parent link="g"/><child link="soft"/></joint>
    </robot>"#;

    fn odd_by_hand(q: &[f64]) -> Matrix4<f64> {
        let rotate_by = |axis: Vector3<f64>, angle: f64| {
            Matrix4::from_axis_angle(&Unit::new_normalize(axis), angle)
        };
        let translate_by = |vector: Vector3<f64>| Matrix4::new_translation(&vector);
        let rpy = |r: f64, p: f64, y: f64| {
            rotate_by(Vector3::z(), y) * rotate_by(Vector3::y(), p) * rotate_by(Vector3::x(), r)
        };
        let third = 3.0 * q[2] - 1.0;
        translate_by(Vector3::new(0.1, 0.2, 0.3))
            * rpy(0.4, -0.5, 0.6)
            * rotate_by(-Vector3::z(), q[0])
            * rpy(1.0, 0.0, 0.0)
            * translate_by(Vector3::new(1.0, 1.0, -1.0).normalize() * q[1])
            * translate_by(Vector3::new(0.0, 0.3, 0.0))
            * rpy(0.0, 0.0, 2.0)
            * rotate_by(Vector3::y(), -2.0 * q[0] + 0.3)
            * translate_by(Vector3::x() * 0.5 * third)
            * rotate_by(Vector3::x(), third)
    }

    #[test]
    fn panda_matches_published_dh_table() {
        let chain = Chain::from_urdf(PANDA, "link0", "link8").unwrap();
        for q in configurations(7) {
            assert!(
                distance(
                    &chain.forward(&q).unwrap().to_homogeneous(),
                    &panda_by_dh(&q)
                ) < CLOSE
            );
        }
        let off = distance(
            &chain.forward(&[0.001; 7]).unwrap().to_homogeneous(),
            &panda_by_dh(&[0.0; 7]),
        );
        assert!(off > 1e-4, "the comparison must distinguish poses");
    }

    #[test]
    fn all_joint_types_match_manual_product() {
        let chain = Chain::from_urdf(ODD, "a", "g").unwrap();
        assert_eq!(chain.joint_names(), ["down", "slide", "far"]);
        assert_eq!(chain.n_joints(), 3);
        assert_eq!(
            (chain.limits()[1].lower, chain.limits()[0].upper),
            (-1.0, f64::INFINITY)
        );
        for q in configurations(3) {
            assert!(
                distance(
                    &chain.forward(&q).unwrap().to_homogeneous(),
                    &odd_by_hand(&q)
                ) < CLOSE
            );
        }
    }

    #[test]
    fn chain_without_joints_is_constant() {
        let chain = Chain::from_urdf(PANDA, "link7", "tcp").unwrap();
        assert_eq!(chain.n_joints(), 0);
        assert!((chain.forward(&[]).unwrap().translation.z - 0.2104).abs() < CLOSE);
        assert_eq!(
            Chain::from_urdf(PANDA, "tcp", "tcp")
                .unwrap()
                .forward(&[])
                .unwrap(),
            Transform::identity()
        );
    }

    #[test]
    fn jacobian_matches_central_differences() {
        const NUDGE: f64 = 1e-6;
        const ABS: f64 = 1e-8; // Truncation NUDGE², rounding 1e-16 / NUDGE, each times sizes near 10.
        for (urdf, base, tip) in [
            (PANDA, "link0", "tcp"),
            (PANDA, "link0", "finger_right"),
            (ODD, "a", "g"),
        ] {
            let chain = Chain::from_urdf(urdf, base, tip).unwrap();
            for q in configurations(chain.n_joints()) {
                let jacobian = chain.jacobian(&q).unwrap();
                let pose = chain.forward(&q).unwrap();
                for joint in 0..chain.n_joints() {
                    let nudged = |by: f64| {
                        let mut q = q.clone();
                        q[joint] += by;
                        chain.forward(&q).unwrap()
                    };
                    let (ahead, behind) = (nudged(NUDGE), nudged(-NUDGE));
                    let linear =
                        (ahead.translation.vector - behind.translation.vector) / (2.0 * NUDGE);
                    let angular =
                        (ahead.rotation * behind.rotation.inverse()).scaled_axis() / (2.0 * NUDGE);
                    assert!(
                        (jacobian.fixed_view::<3, 1>(0, joint) - linear).norm() < ABS,
                        "{tip} joint {joint}"
                    );
                    assert!(
                        (jacobian.fixed_view::<3, 1>(3, joint) - angular).norm() < ABS,
                        "{tip} joint {joint}"
                    );
                    // Compares the same motion as a twist in the tip frame.
                    let mut qd = vec![0.0; chain.n_joints()];
                    qd[joint] = 1.0;
                    let twist = chain.tip_twist(&q, &qd).unwrap();
                    let moved = crate::transform::log(&(pose.inverse() * ahead), NUDGE);
                    assert!(
                        (twist.linear_m_s - moved.linear_m_s).norm() < 1e-4,
                        "{tip} joint {joint}"
                    );
                    assert!(
                        (twist.angular_rad_s - moved.angular_rad_s).norm() < 1e-4,
                        "{tip} joint {joint}"
                    );
                }
            }
        }
    }

    #[test]
    fn forward_into_matches_forward_and_keeps_output_on_error() {
        let chain = Chain::from_urdf(PANDA, "link0", "link8").unwrap();
        let mut pose = Transform::identity();
        chain.forward_into(&[0.3; 7], &mut pose).unwrap();
        assert_eq!(pose, chain.forward(&[0.3; 7]).unwrap());
        let kept = pose;
        assert!(chain.forward_into(&[f64::NAN; 7], &mut pose).is_err());
        assert_eq!(pose, kept);
    }

    #[test]
    fn invalid_configurations_are_rejected() {
        let chain = Chain::from_urdf(PANDA, "link0", "link3").unwrap();
        let error_of = |q: &[f64]| chain.forward(q).unwrap_err().to_string();
        assert_eq!(
            error_of(&[0.0, 1.0]),
            "2 joint values given, the chain has 3: joint1, joint2, joint3"
        );
        assert_eq!(
            error_of(&[0.0, f64::NAN, 0.0]),
            r#"joint "joint2": NaN is not a finite number"#
        );
        assert!(
            chain.jacobian(&[0.0; 4]).is_err()
                && chain.tip_twist(&[0.0; 3], &[f64::INFINITY; 3]).is_err()
        );
        let names = ["joint3", "x", "joint1", "joint2"].map(String::from);
        assert_eq!(chain.order_in(&names), Ok(vec![2, 3, 0]));
        assert_eq!(
            chain.order_in(&names[..3]).unwrap_err().to_string(),
            r#"joint "joint2" moves "link3" but is not among the joints given: joint3, x, joint1"#
        );
    }

    #[test]
    fn unsupported_joints_are_rejected() {
        let error_of = |urdf: &str, base: &str, tip: &str| {
            Chain::from_urdf(urdf, base, tip).unwrap_err().to_string()
        };
        assert_eq!(
            error_of(ODD, "a", "soft"),
            r#"joint "float" has the type floating; only fixed, revolute, continuous and prismatic joints are supported"#
        );
        let mimic =
            |from: &str, to: &str| error_of(&PANDA.replace(from, to), "link0", "finger_right");
        let source = r#"mimic joint="finger_joint_left""#;
        assert_eq!(
            mimic(source, r#"mimic joint="thumb""#),
            r#"joint "finger_joint_right" mimics "thumb", which is not in the URDF"#
        );
        assert_eq!(
            mimic(source, r#"mimic joint="hand_tcp""#),
            r#"joint "finger_joint_right" mimics "hand_tcp", which is not a revolute, continuous or prismatic joint"#
        );
        assert_eq!(
            mimic(source, r#"mimic joint="finger_joint_right""#),
            r#"joint "finger_joint_right" mimics "finger_joint_right", which creates a loop of mimic joints"#
        );
    }
}
