//! Forward kinematics and Jacobian from a base link to a tip link.

use crate::urdf::{Joint, JointKind, JointLimits, Robot};
use crate::{Error, Transform, Twist};
use nalgebra::{Matrix6xX, Quaternion, Translation3, Unit, UnitQuaternion, Vector3};

/// The joints between two links of a robot, ready to compute poses.
///
/// Configurations are slices in the order of [`Chain::joint_names`]: radians for turning joints, metres for sliding ones.
/// Joints that mimic others are not in that order; they follow.
#[derive(Clone, Debug)]
pub struct Chain {
    base_link: String,
    tip_link: String,
    joint_names: Vec<String>,
    limits: Vec<JointLimits>,
    segments: Vec<Segment>,
    /// From the last joint's frame (axis along z) to the tip link.
    last_from_tip: Fixed,
}

/// A constant motion and then one joint along or about the z axis.
///
/// Fixed joints are merged into the constant, and the frames are turned so that every joint moves about z: both are done
/// once, when the chain is built.
#[derive(Clone, Debug)]
struct Segment {
    before: Fixed,
    slides: bool,
    joint_ix: usize,
    multiplier: f64,
    offset: f64,
}

#[derive(Clone, Copy, Debug)]
struct Fixed {
    rotation: Quaternion<f64>,
    translation: Vector3<f64>,
}

impl Chain {
    /// Reads a URDF and takes the joints from `base_link` down to `tip_link`.
    pub fn from_urdf(xml: &str, base_link: &str, tip_link: &str) -> Result<Self, Error> {
        Self::new(&Robot::parse(xml)?, base_link, tip_link)
    }

    /// The joints of `robot` from `base_link` down to `tip_link`.
    pub fn new(robot: &Robot, base_link: &str, tip_link: &str) -> Result<Self, Error> {
        let mut chain = Self {
            base_link: base_link.into(),
            tip_link: tip_link.into(),
            joint_names: Vec::new(),
            limits: Vec::new(),
            segments: Vec::new(),
            last_from_tip: Fixed::new(&Transform::identity()),
        };
        let mut constant = Transform::identity();
        for joint in robot.path(base_link, tip_link)? {
            constant *= joint.parent_from_joint;
            let slides = match joint.kind {
                JointKind::Fixed => continue,
                JointKind::Turn => false,
                JointKind::Slide => true,
                JointKind::Unsupported(kind) => {
                    return Err(Error::JointType { joint: joint.name.clone(), kind });
                }
            };
            let joint_from_aligned = turn_z_to(&joint.axis);
            let rule = follow_mimics(robot, joint)?;
            let joint_ix = chain.index_of(rule.source);
            chain.segments.push(Segment {
                before: Fixed::new(&(constant * joint_from_aligned)),
                slides,
                joint_ix,
                multiplier: rule.multiplier,
                offset: rule.offset,
            });
            constant = Transform::from_parts(Translation3::identity(), joint_from_aligned.inverse());
        }
        chain.last_from_tip = Fixed::new(&constant);
        Ok(chain)
    }

    /// Name of the link poses are told in.
    pub fn base_link(&self) -> &str {
        &self.base_link
    }

    /// Name of the link whose pose is told.
    pub fn tip_link(&self) -> &str {
        &self.tip_link
    }

    /// Names of the moving joints, from the base to the tip; a joint that others mimic stands where it first matters.
    pub fn joint_names(&self) -> &[String] {
        &self.joint_names
    }

    /// How many numbers a configuration has.
    pub fn n_joints(&self) -> usize {
        self.joint_names.len()
    }

    /// Allowed ranges of the moving joints.
    pub fn limits(&self) -> &[JointLimits] {
        &self.limits
    }

    /// Where each of the chain's joints stands in `names`, for devices and files with their own order.
    pub fn order_in(&self, names: &[String]) -> Result<Vec<usize>, Error> {
        let find = |joint: &String| {
            names.iter().position(|name| name == joint).ok_or_else(|| Error::MissingJoint {
                joint: joint.clone(),
                tip: self.tip_link.clone(),
                given: names.to_vec(),
            })
        };
        self.joint_names.iter().map(find).collect()
    }

    /// Pose of the tip in the base, `base_from_tip`.
    pub fn forward(&self, q: &[f64]) -> Result<Transform, Error> {
        let mut base_from_tip = Transform::identity();
        self.forward_into(q, &mut base_from_tip)?;
        Ok(base_from_tip)
    }

    /// Like [`Chain::forward`], into a place that exists; neither allocates. On error the place is left as it was.
    pub fn forward_into(&self, q: &[f64], base_from_tip: &mut Transform) -> Result<(), Error> {
        self.check(q)?;
        let mut pose = Fixed::IDENTITY;
        for segment in &self.segments {
            pose.then(&segment.before);
            pose.move_joint(segment, q);
        }
        pose.then(&self.last_from_tip);
        *base_from_tip = pose.transform();
        Ok(())
    }

    /// Geometric Jacobian at `q`: times the joint velocities it gives the velocity of the tip's origin (rows 0 to 2) and the
    /// angular velocity of the tip (rows 3 to 5), both in the base's axes.
    pub fn jacobian(&self, q: &[f64]) -> Result<Matrix6xX<f64>, Error> {
        let tip_in_base = self.forward(q)?.translation.vector;
        let mut jacobian = Matrix6xX::zeros(self.n_joints());
        let mut pose = Fixed::IDENTITY;
        for segment in &self.segments {
            pose.then(&segment.before);
            let axis_in_base = rotate(&pose.rotation, &Vector3::z());
            let (linear, angular) = match segment.slides {
                true => (axis_in_base, Vector3::zeros()),
                false => (axis_in_base.cross(&(tip_in_base - pose.translation)), axis_in_base),
            };
            let mut column = jacobian.column_mut(segment.joint_ix);
            let mut add = |row: usize, part: Vector3<f64>| {
                for axis in 0..3 {
                    column[row + axis] += segment.multiplier * part[axis];
                }
            };
            add(0, linear);
            add(3, angular);
            pose.move_joint(segment, q);
        }
        Ok(jacobian)
    }

    /// Velocity of the tip relative to the base, in the tip's own axes, when the joints at `q` move with `qd` (per second).
    pub fn tip_twist(&self, q: &[f64], qd: &[f64]) -> Result<Twist, Error> {
        self.check(qd)?;
        let tip_from_base = self.forward(q)?.rotation.inverse();
        let jacobian = self.jacobian(q)?;
        let mut linear_in_base = Vector3::zeros();
        let mut angular_in_base = Vector3::zeros();
        for (column, rate) in jacobian.column_iter().zip(qd) {
            linear_in_base += column.fixed_rows::<3>(0) * *rate;
            angular_in_base += column.fixed_rows::<3>(3) * *rate;
        }
        Ok(Twist { linear_m_s: tip_from_base * linear_in_base, angular_rad_s: tip_from_base * angular_in_base })
    }

    fn check(&self, values: &[f64]) -> Result<(), Error> {
        if values.len() != self.n_joints() {
            return Err(Error::JointCount {
                got: values.len(),
                expected: self.n_joints(),
                joints: self.joint_names.clone(),
            });
        }
        match values.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(at) => Err(Error::JointNotFinite { joint: self.joint_names[at].clone(), value: values[at] }),
        }
    }

    fn index_of(&mut self, source: &Joint) -> usize {
        if let Some(known) = self.joint_names.iter().position(|name| *name == source.name) {
            return known;
        }
        self.joint_names.push(source.name.clone());
        self.limits.push(source.limits);
        self.joint_names.len() - 1
    }
}

/// The joint that really moves, and how `joint` follows it.
struct Rule<'a> {
    source: &'a Joint,
    multiplier: f64,
    offset: f64,
}

fn follow_mimics<'a>(robot: &'a Robot, joint: &'a Joint) -> Result<Rule<'a>, Error> {
    let mut rule = Rule { source: joint, multiplier: 1.0, offset: 0.0 };
    let mut n_followed = 0;
    while let Some(mimic) = &rule.source.mimic {
        let refused = |why| Error::Mimic { joint: joint.name.clone(), source_joint: mimic.source.clone(), why };
        let source = robot.joint(&mimic.source).ok_or_else(|| refused("is not in the URDF"))?;
        if !matches!(source.kind, JointKind::Turn | JointKind::Slide) {
            return Err(refused("is not a moving joint of one number"));
        }
        n_followed += 1;
        if n_followed > robot.joints().len() {
            return Err(refused("follows it in turn"));
        }
        rule.offset += rule.multiplier * mimic.offset;
        rule.multiplier *= mimic.multiplier;
        rule.source = source;
    }
    Ok(rule)
}

fn turn_z_to(axis: &Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    // Opposite directions leave the turning axis open: any half turn about an axis across z does it.
    UnitQuaternion::rotation_between_axis(&Vector3::z_axis(), axis)
        .unwrap_or_else(|| UnitQuaternion::from_quaternion(Quaternion::new(0.0, 1.0, 0.0, 0.0)))
}

fn rotate(rotation: &Quaternion<f64>, vector: &Vector3<f64>) -> Vector3<f64> {
    let twice = rotation.imag().cross(vector) * 2.0;
    vector + twice * rotation.scalar() + rotation.imag().cross(&twice)
}

impl Fixed {
    const IDENTITY: Self = Self {
        rotation: Quaternion::from_vector(nalgebra::Vector4::new(0.0, 0.0, 0.0, 1.0)),
        translation: Vector3::new(0.0, 0.0, 0.0),
    };

    fn new(transform: &Transform) -> Self {
        Self { rotation: transform.rotation.into_inner(), translation: transform.translation.vector }
    }

    fn transform(&self) -> Transform {
        // A product of a few unit quaternions is off unit length by rounding only.
        Transform::from_parts(self.translation.into(), UnitQuaternion::new_unchecked(self.rotation))
    }

    fn then(&mut self, next: &Self) {
        self.translation += rotate(&self.rotation, &next.translation);
        self.rotation *= next.rotation;
    }

    fn move_joint(&mut self, segment: &Segment, q: &[f64]) {
        let value = segment.multiplier * q[segment.joint_ix] + segment.offset;
        if segment.slides {
            self.translation += rotate(&self.rotation, &Vector3::new(0.0, 0.0, value));
            return;
        }
        // The product with (cos, 0, 0, sin) of half the angle, without the zeros.
        let (sin, cos) = (0.5 * value).sin_cos();
        let r = &self.rotation;
        self.rotation =
            Quaternion::new(r.w * cos - r.k * sin, r.i * cos + r.j * sin, r.j * cos - r.i * sin, r.k * cos + r.w * sin);
    }
}
