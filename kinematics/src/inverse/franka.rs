//! Closed form for arms with the geometry of a Franka arm (Panda, FR3).
//!
//! If the last joint is given, a pose has at most eight solutions, from three choices of two. Two
//! circles about the shoulder and the wrist intersect in two positions of the elbow. The wrist can
//! be bent to either side. The shoulder joints can reach each direction of the upper arm in two
//! ways.
//!
//! Source: He and Liu 2021, "Analytical inverse kinematics for Franka Emika Panda - a geometrical
//! solver for 7-DOF manipulators with unconventional design", section III. There are three
//! differences. Both elbows are computed, whereas the paper omits the elbow that is rarely within
//! the ranges. Angles are computed with `atan2` instead of arc sines. The lengths are measured in
//! the chain.

use crate::{Chain, Transform};
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Largest distance between the axes of a chain and the axes of a Franka arm, meters and radians.
/// Calibrated arms deviate by about a millimeter. Least squares correct the remaining error of the
/// pose.
const MAX_DEVIATION: f64 = 3e-3;
/// Shortest lengths of the parts of an arm for which the closed form is accurate, meters.
const MIN_LENGTH_M: f64 = 0.01;
/// Sine of the angle between forearm and shoulder-wrist line below which the plane of the arm is
/// undetermined.
const MIN_SINE: f64 = 1e-6;

/// The geometry of an arm whose axes are arranged like the axes of a Franka arm.
///
/// All computations use the frame of the shoulder. Its origin is the point where the axes of joints
/// 1 and 2 meet. Its z axis is the axis of joint 1, and its y axis is the axis of joint 2 if joint
/// 1 is at 0. With all joints at 0, each axis is parallel to y or z and passes through the plane of
/// x and z.
#[derive(Clone, Debug)]
pub struct FrankaArm {
    shoulder_from_base: Transform,
    /// Pose of the frame of joint 7 in the frame of the tip. The origin of this frame is the point
    /// on the axis of joint 7 that is closest to the axis of joint 6. If joint 7 is at 0, its x
    /// axis points away from the axis of joint 6.
    tip_from_seven: Transform,
    lengths: Lengths,
    /// Lengths of upper arm and forearm. This field and the next two follow from `lengths`. They are
    /// stored, because each test of the search needs them.
    segments_m: [f64; 2],
    /// Value of joint 4 at which the forearm lies along the upper arm, and its sine and cosine.
    folded_q4: f64,
    folded_sin_cos: [f64; 2],
}

/// Lengths in meters, in the posture with all joints at 0.
#[derive(Clone, Copy, Debug)]
struct Lengths {
    /// Position of the elbow (the axis of joint 4) relative to the shoulder, x and z.
    elbow: [f64; 2],
    /// Position of the wrist (where the axes of joints 5 and 6 meet) relative to the elbow.
    wrist_from_elbow: [f64; 2],
    /// Distance between the axes of joints 6 and 7.
    flange_offset: f64,
}

/// Identifies one of the eight solutions for a given last joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Branch {
    /// Whether joint 4 is below -0.47 rad, the angle at which the arm is longest. Most values
    /// within the range of joint 4 are below this angle.
    pub is_elbow_bent: bool,
    /// Whether the wrist is bent to the side of larger angles of joint 6.
    pub is_wrist_outward: bool,
    /// Joint 2 is positive.
    pub is_shoulder_forward: bool,
}

impl Branch {
    /// All branches. Neighbors share as much as possible.
    pub const ALL: [Self; 8] = {
        let mut branches = [Self {
            is_elbow_bent: true,
            is_wrist_outward: true,
            is_shoulder_forward: true,
        }; 8];
        let mut ix = 0;
        while ix < 8 {
            branches[ix] = Self {
                is_elbow_bent: ix & 4 == 0,
                is_wrist_outward: ix & 2 == 0,
                is_shoulder_forward: ix & 1 == 0,
            };
            ix += 1;
        }
        branches
    };

    fn ix(self) -> usize {
        4 * usize::from(!self.is_elbow_bent)
            + 2 * usize::from(!self.is_wrist_outward)
            + usize::from(!self.is_shoulder_forward)
    }
}

/// All solutions for a pose and a given last joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrankaSolutions {
    joints_by_branch: [Option<[f64; 7]>; 8],
}

impl FrankaSolutions {
    /// The joints of a branch, radians. The last joint has the given value, and the others are
    /// between -pi and pi. `None` if the branch does not reach the pose.
    pub fn on_branch(&self, branch: Branch) -> Option<[f64; 7]> {
        self.joints_by_branch[branch.ix()]
    }

    /// The branches that reach the pose, with their joints.
    pub fn iter(&self) -> impl Iterator<Item = (Branch, [f64; 7])> {
        let branches = Branch::ALL.iter().zip(self.joints_by_branch);
        branches.filter_map(|(branch, joints)| Some((*branch, joints?)))
    }
}

impl FrankaArm {
    /// Measures the geometry of a chain. `None` if its axes are not arranged like the axes of a
    /// Franka arm, with the same directions and zeros. Base and tip may be any links.
    pub fn of(chain: &Chain) -> Option<Self> {
        let axes = axes_at_zero(chain)?;
        let base_from_shoulder = shoulder_frame(&axes)?;
        let shoulder_from_base = base_from_shoulder.inverse();
        let in_shoulder: [Axis; 7] = axes.map(|axis| axis.moved_by(&shoulder_from_base));
        let lengths = Lengths::measure(&in_shoulder)?;
        let base_from_tip = chain.forward(&[0.0; 7]).ok()?;
        let shoulder_from_seven = lengths.shoulder_from_seven();
        let base_from_seven = base_from_shoulder * shoulder_from_seven;
        let folded_q4 = lengths.folded_q4();
        let arm = Self {
            shoulder_from_base,
            tip_from_seven: base_from_tip.inverse() * base_from_seven,
            lengths,
            segments_m: lengths.segments(),
            folded_q4,
            folded_sin_cos: folded_q4.sin_cos().into(),
        };
        let deviates = in_shoulder
            .iter()
            .zip(lengths.axes())
            .any(|(actual, model)| actual.deviation(&model) > MAX_DEVIATION);
        (!deviates).then_some(arm)
    }

    /// All solutions for a pose of the tip and a value of the last joint. Ranges are not
    /// considered.
    ///
    /// If joint 2 is at 0, joints 1 and 3 have the same axis, and only their sum is determined. In
    /// this case, joint 1 is set to 0 or half a turn.
    pub fn solutions(&self, base_from_tip: &Transform, last_rad: f64) -> FrankaSolutions {
        let mut joints_by_branch = [None; 8];
        let Some(wrist) = self.wrist(&self.frame_of_seven(base_from_tip), last_rad) else {
            return FrankaSolutions { joints_by_branch };
        };
        for is_elbow_bent in [true, false] {
            let elbow = self.elbow(&wrist, is_elbow_bent);
            let Some(bend) = elbow.bend(&wrist) else {
                continue;
            };
            for is_wrist_outward in [true, false] {
                let q6 = bend.q6(is_wrist_outward);
                let forearm = elbow.forearm(&wrist, &bend, is_wrist_outward);
                let q2 = forearm.q2();
                let [q1, q3] = forearm.q1_and_q3();
                let other = [opposite(q1), -q2, opposite(q3)];
                for (is_shoulder_forward, [q1, q2, q3]) in [(true, [q1, q2, q3]), (false, other)] {
                    let branch = Branch {
                        is_elbow_bent,
                        is_wrist_outward,
                        is_shoulder_forward,
                    };
                    let joints = [q1, q2, q3, elbow.q4, forearm.q5, q6, last_rad];
                    joints_by_branch[branch.ix()] = Some(joints);
                }
            }
        }
        FrankaSolutions { joints_by_branch }
    }

    /// The branch of a configuration. `None` if the pose does not belong to the configuration.
    ///
    /// * `base_from_tip`: pose of the tip for these joints.
    pub fn branch(&self, joints: &[f64; 7], base_from_tip: &Transform) -> Option<Branch> {
        let wrist = self.wrist(&self.frame_of_seven(base_from_tip), joints[6])?;
        Some(Branch {
            is_elbow_bent: wrap(joints[3] - self.folded_q4) > 0.0,
            is_wrist_outward: wrap(joints[5] - wrist.middle_q6()) > 0.0,
            is_shoulder_forward: wrap(joints[1]) >= 0.0,
        })
    }

    /// The angle of joint 4 at which the arm is longest.
    pub(super) fn stretched_q4(&self) -> f64 {
        wrap(self.folded_q4 + std::f64::consts::PI)
    }

    /// The frame of joint 7 of a pose.
    pub(super) fn frame_of_seven(&self, base_from_tip: &Transform) -> SevenFrame {
        let pose = self.shoulder_from_base * base_from_tip * self.tip_from_seven;
        let shoulder_from_seven = pose.rotation.to_rotation_matrix().into_inner();
        SevenFrame {
            origin_in_seven: shoulder_from_seven.tr_mul(&pose.translation.vector),
            shoulder_from_seven,
        }
    }

    /// The wrist for a given last joint. `None` if it is farther from the shoulder than the arm is
    /// long, or too close.
    pub(super) fn wrist(&self, seven: &SevenFrame, last_rad: f64) -> Option<Wrist> {
        let (sin, cos) = last_rad.sin_cos();
        // The axes of the frame of joint 6 are (cos, -sin, 0), (0, 0, -1) and (sin, cos, 0) in the
        // frame of joint 7.
        let origin = seven.origin_in_seven;
        let wrist_in_six = Vector3::new(
            cos * origin.x - sin * origin.y - self.lengths.flange_offset,
            -origin.z,
            sin * origin.x + cos * origin.y,
        );
        let distance_m = wrist_in_six.norm();
        // Law of cosines for the angle at the elbow.
        let [upper_m, fore_m] = self.segments_m;
        let cosine = (upper_m * upper_m + fore_m * fore_m - distance_m * distance_m)
            / (2.0 * upper_m * fore_m);
        let is_reachable = cosine.abs() <= 1.0 && distance_m > MIN_LENGTH_M;
        is_reachable.then(|| Wrist {
            shoulder_from_seven: seven.shoulder_from_seven,
            sin_last: sin,
            cos_last: cos,
            toward_shoulder: -wrist_in_six / distance_m,
            distance_m,
            elbow_cosine: cosine,
        })
    }

    /// The elbow of a wrist.
    pub(super) fn elbow(&self, wrist: &Wrist, is_bent: bool) -> Elbow {
        let sign = if is_bent { 1.0 } else { -1.0 };
        let cosine = wrist.elbow_cosine;
        let sine = sign * (1.0 - cosine * cosine).sqrt();
        let [folded_sin, folded_cos] = self.folded_sin_cos;
        let sin_q4 = folded_sin * cosine + folded_cos * sine;
        let cos_q4 = folded_cos * cosine - folded_sin * sine;
        // This is the position of the wrist in the plane of the arm, in the axes of the upper arm.
        // Joint 4 rotates about -y.
        let [x, z] = self.lengths.wrist_from_elbow;
        let wrist_x = self.lengths.elbow[0] + x * cos_q4 - z * sin_q4;
        let wrist_z = self.lengths.elbow[1] + z * cos_q4 + x * sin_q4;
        let toward_shoulder = [-wrist_x / wrist.distance_m, -wrist_z / wrist.distance_m];
        Elbow {
            q4: wrap(self.folded_q4 + sign * cosine.acos()),
            sin_q4,
            cos_q4,
            // The axis of joint 5 has the direction (-sin, cos) in these axes.
            cosine: cos_q4 * toward_shoulder[1] - sin_q4 * toward_shoulder[0],
            sine: cos_q4 * toward_shoulder[0] + sin_q4 * toward_shoulder[1],
        }
    }
}

/// The frame of joint 7 of a pose. Its z axis is the axis of joint 7.
#[derive(Clone, Copy, Debug)]
pub(super) struct SevenFrame {
    shoulder_from_seven: Matrix3<f64>,
    /// From the shoulder to the origin of the frame, in the axes of the frame.
    origin_in_seven: Vector3<f64>,
}

/// The wrist of a pose for a value of the last joint.
///
/// Directions are in the frame of joint 6, in which most of them are simple: x leads to the axis of
/// joint 7, y is opposite to this axis, and z is the axis of joint 6.
pub(super) struct Wrist {
    shoulder_from_seven: Matrix3<f64>,
    sin_last: f64,
    cos_last: f64,
    toward_shoulder: Vector3<f64>,
    /// Distance from the shoulder.
    distance_m: f64,
    /// Cosine of the angle between upper arm and forearm.
    elbow_cosine: f64,
}

impl Wrist {
    /// Angle of joint 6 at which the forearm points most toward the shoulder. It is in the middle
    /// between the two solutions.
    fn middle_q6(&self) -> f64 {
        self.toward_shoulder.x.atan2(self.toward_shoulder.y)
    }

    /// Converts a direction from the frame of joint 6 to the frame of the shoulder.
    fn to_shoulder(&self, in_six: &Vector3<f64>) -> Vector3<f64> {
        let [sin, cos] = [self.sin_last, self.cos_last];
        let in_seven = Vector3::new(
            cos * in_six.x + sin * in_six.z,
            cos * in_six.z - sin * in_six.x,
            -in_six.y,
        );
        self.shoulder_from_seven * in_seven
    }
}

/// An elbow, without its direction in space.
pub(super) struct Elbow {
    pub(super) q4: f64,
    sin_q4: f64,
    cos_q4: f64,
    /// Cosine and sine of the angle from the axis of joint 5 to the direction toward the shoulder,
    /// about the y axis of the arm's plane.
    cosine: f64,
    sine: f64,
}

/// The two values of joint 6 that give the forearm its angle to the shoulder. They are at the same
/// distance from a value in their middle.
pub(super) struct Bend {
    middle_q6: f64,
    distance_q6: f64,
    /// Sine and cosine of both.
    middle: [f64; 2],
    distance: [f64; 2],
}

impl Bend {
    pub(super) fn q6(&self, is_outward: bool) -> f64 {
        wrap(self.middle_q6 + sign_of(is_outward) * self.distance_q6)
    }

    fn sin_cos(&self, is_outward: bool) -> [f64; 2] {
        let [sin, cos] = self.middle;
        let [distance_sin, distance_cos] = self.distance;
        let distance_sin = sign_of(is_outward) * distance_sin;
        [
            sin * distance_cos + cos * distance_sin,
            cos * distance_cos - sin * distance_sin,
        ]
    }
}

fn sign_of(is_outward: bool) -> f64 {
    if is_outward { 1.0 } else { -1.0 }
}

/// A forearm and an upper arm in space.
pub(super) struct Forearm {
    pub(super) q5: f64,
    /// Axes x and z of the frame of joint 3: z leads along the upper arm, x to the elbow.
    x_of_three: Vector3<f64>,
    z_of_three: Vector3<f64>,
}

impl Elbow {
    /// The values of joint 6. `None` if it cannot give the forearm the angle to the shoulder, or
    /// if the plane of the arm is undetermined.
    pub(super) fn bend(&self, wrist: &Wrist) -> Option<Bend> {
        if self.sine.abs() <= MIN_SINE {
            return None;
        }
        // Joint 6 rotates the axis of joint 5, which is `sin(q6) x + cos(q6) y`. The dot product of
        // this axis and the direction toward the shoulder must be `cosine`.
        let [x, y] = [wrist.toward_shoulder.x, wrist.toward_shoulder.y];
        let largest_cosine = (x * x + y * y).sqrt();
        let ratio = self.cosine / largest_cosine;
        let is_possible = ratio.abs() <= 1.0;
        is_possible.then(|| Bend {
            middle_q6: wrist.middle_q6(),
            distance_q6: ratio.acos(),
            middle: [x / largest_cosine, y / largest_cosine],
            distance: [(1.0 - ratio * ratio).sqrt(), ratio],
        })
    }

    /// The forearm for one of the values of joint 6.
    pub(super) fn forearm(&self, wrist: &Wrist, bend: &Bend, is_outward: bool) -> Forearm {
        let [sin, cos] = bend.sin_cos(is_outward);
        let toward = wrist.toward_shoulder / self.sine;
        let z_of_five = Vector3::new(sin, cos, 0.0);
        // The normal of the arm's plane is the cross product of the axis of joint 5 and the
        // direction toward the shoulder.
        let normal = Vector3::new(
            cos * toward.z,
            -sin * toward.z,
            sin * toward.y - cos * toward.x,
        );
        let x_of_five = Vector3::new(-normal.z * cos, normal.z * sin, toward.z);
        let z_of_three = z_of_five * self.cos_q4 + x_of_five * self.sin_q4;
        let x_of_three = normal.cross(&z_of_three);
        Forearm {
            // Joint 5 rotates about `z_of_five`, from the axis of joint 4 (opposite to the normal
            // of the arm's plane) to the axis of joint 6.
            q5: toward.z.atan2(-normal.z),
            x_of_three: wrist.to_shoulder(&x_of_three),
            z_of_three: wrist.to_shoulder(&z_of_three),
        }
    }
}

impl Forearm {
    /// Joint 2, at least 0. On the other branch, it has the opposite sign.
    pub(super) fn q2(&self) -> f64 {
        self.sideways().atan2(self.z_of_three.z)
    }

    /// Joints 1 and 3 for joint 2 at least 0: `Rz(q1) Ry(q2) Rz(q3)` is the rotation of the upper
    /// arm.
    pub(super) fn q1_and_q3(&self) -> [f64; 2] {
        let z = self.z_of_three;
        let x = self.x_of_three;
        let sideways = self.sideways();
        if sideways == 0.0 {
            return [0.0, x.y.atan2(z.z * x.x)];
        }
        let [sin_q1, cos_q1] = [z.y / sideways, z.x / sideways];
        let q3 = (cos_q1 * x.y - sin_q1 * x.x)
            .atan2(z.z * (cos_q1 * x.x + sin_q1 * x.y) - sideways * x.z);
        [z.y.atan2(z.x), q3]
    }

    /// Sine of joint 2.
    fn sideways(&self) -> f64 {
        let z = self.z_of_three;
        (z.x * z.x + z.y * z.y).sqrt()
    }
}

/// Joints 1 and 3 on the other branch of the shoulder are half a turn away.
pub(super) fn opposite(angle_rad: f64) -> f64 {
    angle_rad - std::f64::consts::PI.copysign(angle_rad)
}

impl Lengths {
    /// Measures the lengths between axes that are arranged as in a Franka arm. `None` if a part is
    /// too short.
    fn measure(axes: &[Axis; 7]) -> Option<Self> {
        let elbow = [axes[3].point.x, axes[3].point.z];
        let wrist = [axes[4].point.x, axes[5].point.z];
        let lengths = Self {
            elbow,
            wrist_from_elbow: [wrist[0] - elbow[0], wrist[1] - elbow[1]],
            flange_offset: axes[6].point.x - wrist[0],
        };
        let are_long = lengths
            .segments()
            .iter()
            .all(|length_m| *length_m > MIN_LENGTH_M);
        are_long.then_some(lengths)
    }

    /// Distances from shoulder to elbow and from elbow to wrist.
    fn segments(&self) -> [f64; 2] {
        [self.elbow, self.wrist_from_elbow].map(|[x, z]| x.hypot(z))
    }

    /// The angle of joint 4 at which shoulder and wrist are in the same direction from the elbow.
    /// The angle between these two directions is joint 4 relative to this value.
    fn folded_q4(&self) -> f64 {
        let [elbow_x, elbow_z] = self.elbow;
        let [wrist_x, wrist_z] = self.wrist_from_elbow;
        wrist_x.atan2(wrist_z) - (-elbow_x).atan2(-elbow_z)
    }

    /// The axes of the arm with all joints at 0.
    fn axes(&self) -> [Axis; 7] {
        let [elbow_x, elbow_z] = self.elbow;
        let wrist_x = elbow_x + self.wrist_from_elbow[0];
        let wrist_z = elbow_z + self.wrist_from_elbow[1];
        let axis = |direction: Vector3<f64>, x: f64, z: f64| Axis {
            direction,
            point: Vector3::new(x, 0.0, z),
        };
        [
            axis(Vector3::z(), 0.0, 0.0),
            axis(Vector3::y(), 0.0, 0.0),
            axis(Vector3::z(), 0.0, 0.0),
            axis(-Vector3::y(), elbow_x, elbow_z),
            axis(Vector3::z(), wrist_x, 0.0),
            axis(-Vector3::y(), wrist_x, wrist_z),
            axis(-Vector3::z(), wrist_x + self.flange_offset, 0.0),
        ]
    }

    /// The frame of joint 7 with all joints at 0.
    fn shoulder_from_seven(&self) -> Transform {
        let x = self.elbow[0] + self.wrist_from_elbow[0] + self.flange_offset;
        let z = self.elbow[1] + self.wrist_from_elbow[1];
        let half_turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        Transform::from_parts(Translation3::new(x, 0.0, z), half_turn)
    }
}

/// The axis of a joint.
#[derive(Clone, Copy, Debug)]
struct Axis {
    direction: Vector3<f64>,
    /// The point of the axis that is closest to the origin.
    point: Vector3<f64>,
}

impl Axis {
    fn moved_by(&self, motion: &Transform) -> Self {
        let direction = motion.rotation * self.direction;
        let point = motion.rotation * self.point + motion.translation.vector;
        Self {
            direction,
            point: point - direction * direction.dot(&point),
        }
    }

    /// Largest difference between two axes, meters and radians.
    fn deviation(&self, other: &Self) -> f64 {
        let directions = (self.direction - other.direction).norm();
        directions.max((self.point - other.point).norm())
    }
}

/// The axes of a chain of seven revolute joints with all joints at 0. `None` for other chains.
fn axes_at_zero(chain: &Chain) -> Option<[Axis; 7]> {
    let zeros = [0.0; 7];
    if chain.n_joints() != zeros.len() {
        return None;
    }
    let tip = chain.forward(&zeros).ok()?.translation.vector;
    let jacobian = chain.jacobian(&zeros).ok()?;
    let mut axes = [Axis {
        direction: Vector3::z(),
        point: Vector3::zeros(),
    }; 7];
    for (axis, column) in axes.iter_mut().zip(jacobian.column_iter()) {
        let linear: Vector3<f64> = column.fixed_rows::<3>(0).into();
        let direction: Vector3<f64> = column.fixed_rows::<3>(3).into();
        // A prismatic joint does not rotate. A joint that a mimic joint follows rotates the tip
        // about a moving axis or at another rate.
        let is_rotation = (direction.norm() - 1.0).abs() < 1e-9
            && direction.dot(&linear).abs() < 1e-9
            && chain.has_one_segment_per_joint();
        if !is_rotation {
            return None;
        }
        let point = tip + direction.cross(&linear);
        *axis = Axis {
            direction,
            point: point - direction * direction.dot(&point),
        };
    }
    Some(axes)
}

/// The frame of the shoulder in the base. `None` if the first two axes are nearly parallel.
fn shoulder_frame(axes: &[Axis; 7]) -> Option<Transform> {
    let z = axes[0].direction;
    let y = (axes[1].direction - z * z.dot(&axes[1].direction)).try_normalize(0.5)?;
    let rotation = Rotation3::from_basis_unchecked(&[y.cross(&z), y, z]);
    // The point of the first axis that is closest to the second.
    let between = axes[1].point - axes[0].point;
    let across = z.cross(&axes[1].direction);
    let along = between.cross(&axes[1].direction).dot(&across) / across.norm_squared();
    Some(Transform::from_parts(
        (axes[0].point + z * along).into(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

/// The angle in -pi to pi that differs by full turns.
fn wrap(angle_rad: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    if angle_rad.abs() <= PI {
        return angle_rad;
    }
    angle_rad - TAU * (angle_rad / TAU).round()
}
