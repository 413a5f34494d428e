//! Suggests the next robot poses by information gain, within the space in which an arm may move.
//!
//! At each candidate pose, the board is in view, at a distance and tilt at which it is detected
//! well. Poses are selected greedily such that the volume of the hand-eye uncertainty shrinks most
//! (D-optimality; Fedorov 1972, section 2.2).

use super::super::checks::axis_name;
use super::super::geometry::{self, Matrix6x12};
use super::super::report::HandEyeCalibration;
use super::super::samples::used;
use super::super::solve::{self, Measurement};
use super::super::{HandEyeInput, Setup};
use kinematics::inverse::{InverseSolver, Target};
use kinematics::{Chain, Intrinsics, Transform};
use nalgebra::{DMatrix, Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6};
use numbers::random::Random;

/// Distance that configurations keep from the limits of the joints, radians or meters. Some
/// controllers stop an arm shortly before its limits.
const LIMIT_MARGIN: f64 = 0.05;
/// The distance from the start is checked at configurations along a path. This value is the largest
/// change of a joint between two such configurations, radians or meters. With an arm of 1 m, one
/// joint moves the flange by 5 cm between two configurations.
const PATH_STEP: f64 = 0.05;

/// The space around a start configuration in which an arm moves.
#[derive(Clone, Copy, Debug)]
pub struct Reach<'a> {
    /// The arm.
    pub chain: &'a Chain,
    /// The joints at the start, in the order of the chain.
    pub start: &'a [f64],
    /// Largest change of a joint from the start, radians or meters.
    pub max_joint_change: f64,
    /// Largest distance of the flange from its position at the start, meters.
    pub max_distance_m: f64,
}

impl Reach<'_> {
    /// Joint values for a flange pose. Two straight paths in joint space must stay near the start:
    /// from `current` to the pose, and from the pose back to the start. Otherwise, the function
    /// returns `None`.
    pub fn joints_for(&self, base_from_flange: &Transform, current: &[f64]) -> Option<Vec<f64>> {
        let start = self.chain.forward(self.start).ok()?;
        // The distance is checked before inverse kinematics, which takes long.
        if distance_m(base_from_flange, &start) > self.max_distance_m {
            return None;
        }
        let bounds: Vec<[f64; 2]> = self
            .chain
            .limits()
            .iter()
            .zip(self.start)
            .map(|(limit, start)| {
                // A joint that starts close to its limit may stay there.
                let lower = (limit.lower + LIMIT_MARGIN).min(*start);
                let upper = (limit.upper - LIMIT_MARGIN).max(*start);
                [
                    lower.max(start - self.max_joint_change),
                    upper.min(start + self.max_joint_change),
                ]
            })
            .collect();
        let mut solver = InverseSolver::within(self.chain.clone(), bounds).ok()?;
        let target = Target::pose(*base_from_flange);
        let joints = solver.solve_near(&target, self.start).ok()?;
        // The way back is also checked. An arm that cannot return to its start would have to be
        // moved by hand.
        let is_allowed = current.len() == joints.len()
            && self.path_is_near(current, &joints, &start)
            && self.path_is_near(self.start, &joints, &start);
        is_allowed.then_some(joints)
    }

    /// Whether the flange stays near its pose at the start on the straight path in joint space
    /// between two configurations. The ends are not checked.
    fn path_is_near(&self, from: &[f64], to: &[f64], start: &Transform) -> bool {
        let largest = from
            .iter()
            .zip(to)
            .map(|(from, to)| (to - from).abs())
            .fold(0.0, f64::max);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "joints move by a few radians"
        )]
        let n_steps = (largest / PATH_STEP).ceil().clamp(1.0, 10_000.0) as u32;
        (1..n_steps).all(|step| {
            let share = f64::from(step) / f64::from(n_steps);
            let between: Vec<f64> = from
                .iter()
                .zip(to)
                .map(|(from, to)| from + share * (to - from))
                .collect();
            self.chain
                .forward(&between)
                .is_ok_and(|pose| distance_m(&pose, start) <= self.max_distance_m)
        })
    }
}

/// Distance between the positions of two poses, meters.
fn distance_m(a: &Transform, b: &Transform) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

/// Options of [`suggest_next_poses`].
#[derive(Clone, Copy, Debug)]
pub struct NextPoseOptions<'a> {
    /// Number of poses.
    pub n_poses: usize,
    /// Center of the board, meters in the board frame.
    pub center_in_board: Vector3<f64>,
    /// Radius of a circle around the center that contains all corners, meters.
    pub radius_m: f64,
    /// Largest angle between the normal of the board and the viewing direction, radians.
    pub max_tilt_rad: f64,
    /// The space in which the arm moves, and its current joint values. `None` if a person moves the
    /// arm.
    pub reach: Option<(Reach<'a>, &'a [f64])>,
    /// Seed of the random candidates.
    pub seed: u64,
}

/// A suggested pose.
#[derive(Clone, Debug, PartialEq)]
pub struct NextPose {
    /// Pose of the flange.
    pub base_from_flange: Transform,
    /// Joint values within the limits. `None` without a chain.
    pub joints: Option<Vec<f64>>,
    /// The motion from the closest sample, as a sentence.
    pub motion: String,
    /// The rotation of the pose relative to this sample, for example `rotated by 20 degrees about
    /// the camera's x axis relative to pose 3`.
    pub relation: String,
    /// Factor by which the standard deviations of the hand-eye transform shrink on average, 0 to 1.
    pub sigma_frac: f64,
}

/// Suggests poses for a finished calibration. `input` must be the input of the calibration.
///
/// With a [`Reach`], the candidates are poses around the board that the arm reaches without leaving
/// this space. With a chain and joint values, the candidates are configurations near the
/// configurations of the samples, within the joint limits. Otherwise, the candidates are flange
/// poses that rotate the camera around the board or about its own axes. In this last case, the
/// caller must check that the arm reaches the poses.
pub fn suggest_next_poses(
    input: &HandEyeInput<'_>,
    calibration: &HandEyeCalibration,
    options: &NextPoseOptions<'_>,
) -> Vec<NextPose> {
    let scene = Scene {
        input,
        calibration,
        options,
    };
    let Some(mut information) = calibration.refined.covariance.clone().try_inverse() else {
        return Vec::new();
    };
    let candidates = scene.candidates();
    let mut suggested: Vec<NextPose> = Vec::new();
    // Poses are selected greedily. The best pose comes first, then the pose that is best together
    // with the first pose, and so on. Comparing all sets of poses would take far longer.
    for _ in 0..options.n_poses {
        let Some(before) = log_volume(&information) else {
            break;
        };
        let gain = |candidate: &Candidate| {
            let with = &information + &candidate.information;
            log_volume(&with).map_or(0.0, |after| before - after)
        };
        let is_new = |candidate: &&Candidate| {
            let mut earlier = suggested.iter();
            earlier.all(|earlier| earlier.base_from_flange != candidate.base_from_flange)
        };
        let best = candidates
            .iter()
            .filter(is_new)
            .map(|candidate| (gain(candidate), candidate))
            .max_by(|a, b| a.0.total_cmp(&b.0));
        let Some((gain, best)) = best.filter(|(gain, _)| *gain > 0.0) else {
            break;
        };
        information += &best.information;
        let [motion, relation] = scene.motion(best);
        suggested.push(NextPose {
            base_from_flange: best.base_from_flange,
            joints: best.joints.clone(),
            motion,
            relation,
            // The volume is computed from variances of six parameters. The mean logarithm of the
            // standard deviations is thus one twelfth of the gain.
            sigma_frac: (-gain / 12.0).exp(),
        });
    }
    suggested
}

/// Logarithm of the determinant of the covariance of the hand-eye transform.
fn log_volume(information: &DMatrix<f64>) -> Option<f64> {
    // Only the hand-eye transform counts. The pose of the board is also estimated, but its accuracy
    // is not a goal.
    let covariance = information.clone().cholesky()?.inverse();
    let hand_eye: Matrix6<f64> = covariance.fixed_view::<6, 6>(0, 0).into_owned();
    Some(2.0 * hand_eye.cholesky()?.l().diagonal().map(f64::ln).sum())
}

/// Whether a point in the camera frame is imaged inside a margin, which is a fraction of the size.
fn is_in_image(intrinsics: &Intrinsics, point: &Vector3<f64>, margin_frac: f64) -> bool {
    intrinsics.project(point).is_some_and(|pixel| {
        (0..2).all(|axis| {
            let size = f64::from(intrinsics.size_px[axis]);
            pixel[axis] > margin_frac * size && pixel[axis] < (1.0 - margin_frac) * size
        })
    })
}

/// A pose that may be suggested.
struct Candidate {
    base_from_flange: Transform,
    joints: Option<Vec<f64>>,
    /// Index in the input of the sample it was derived from.
    sample_ix: usize,
    information: DMatrix<f64>,
}

struct Scene<'a> {
    input: &'a HandEyeInput<'a>,
    calibration: &'a HandEyeCalibration,
    options: &'a NextPoseOptions<'a>,
}

impl Scene<'_> {
    fn candidates(&self) -> Vec<Candidate> {
        // With more trials, slightly better poses are found. The trials take longer, especially
        // with inverse kinematics.
        const TRIALS: usize = 1500;
        let refined = &self.calibration.refined;
        let used: Vec<_> = used(&refined.samples).collect();
        let boards = used.iter().map(|sample| &sample.chosen().camera_from_board);
        let Some(distance_m) = geometry::median_distance_m(boards) else {
            return Vec::new();
        };
        let unit_covariance = self.mean_unit_covariance();
        let mut random = Random::new(self.options.seed);
        (0..TRIALS)
            .filter_map(|_| {
                let sample_ix = used[random.below(used.len())].sample_ix;
                let (base_from_flange, joints) = self.moved(sample_ix, &mut random)?;
                let a = geometry::a_of(self.input.setup, &base_from_flange);
                let camera_from_board = refined.solution.camera_from_board(&a);
                self.is_well_visible(&camera_from_board, distance_m)
                    .then_some(())?;
                // Inverse kinematics comes last, because it takes longest.
                let joints = match &self.options.reach {
                    Some((reach, current)) => Some(reach.joints_for(&base_from_flange, current)?),
                    None => joints,
                };
                let information =
                    self.information(&Measurement::new(a, camera_from_board, unit_covariance))?;
                Some(Candidate {
                    base_from_flange,
                    joints,
                    sample_ix,
                    information,
                })
            })
            .collect()
    }

    /// The information of a new sample. Its board pose is assumed to be as accurate as the board
    /// poses of the previous samples.
    fn information(&self, measurement: &Measurement) -> Option<DMatrix<f64>> {
        let refined = &self.calibration.refined;
        let solution = &refined.solution;
        let predicted = solution.camera_from_board(&measurement.a);
        // A future measurement is expected to have no residual.
        let jacobian: Matrix6x12 = geometry::residual_jacobian(&predicted, &Vector6::zeros());
        let setup = self.input.setup;
        let weight = solve::covariance(setup, measurement, solution, &refined.noise)
            .cholesky()?
            .inverse();
        Some(DMatrix::from_fn(12, 12, |row, column| {
            (jacobian.column(row).transpose() * weight * jacobian.column(column))[0]
        }))
    }

    /// Mean accuracy of the board poses so far.
    fn mean_unit_covariance(&self) -> Option<Matrix6<f64>> {
        let measurements = solve::measurements(&self.calibration.refined.samples);
        let n = measurements.len() as f64;
        measurements
            .iter()
            .map(|m| m.unit_covariance)
            .sum::<Option<Matrix6<f64>>>()
            .map(|sum| sum / n)
    }

    /// A random pose near the pose of a sample.
    fn moved(
        &self,
        sample_ix: usize,
        random: &mut Random,
    ) -> Option<(Transform, Option<Vec<f64>>)> {
        // Large changes give more information, but they move the board out of the image more often.
        const MAX_JOINT_CHANGE: f64 = 0.8;
        const MAX_ROTATION_RAD: f64 = 0.9;
        let sample = &self.input.samples[sample_ix];
        if let (None, Some(chain), Some(joints)) =
            (&self.options.reach, self.input.chain, &sample.joints)
        {
            let moved: Vec<f64> = joints
                .iter()
                .map(|joint| joint + MAX_JOINT_CHANGE * random.uniform(-1.0, 1.0))
                .collect();
            let is_allowed = moved
                .iter()
                .zip(chain.limits())
                .all(|(joint, limit)| (limit.lower..=limit.upper).contains(joint));
            // The motion is applied relative to the reported pose, because a tool frame may follow
            // the chain's tip.
            let before = chain.forward(joints).ok()?;
            let pose = chain.forward(&moved).ok()? * before.inverse() * sample.base_from_flange;
            return is_allowed.then_some((pose, Some(moved)));
        }
        // Rotates the camera about the center of the board, or the board about its own center.
        let solution = &self.calibration.refined.solution;
        // A vector of normally distributed numbers has a uniformly distributed direction.
        let axis = Vector3::new(random.normal(), random.normal(), random.normal()).normalize();
        let turn = UnitQuaternion::from_scaled_axis(axis * random.uniform(0.2, MAX_ROTATION_RAD));
        let base_from_board = match self.input.setup {
            Setup::EyeInHand => solution.y,
            Setup::EyeToHand => sample.base_from_flange * solution.y,
        };
        let center = (base_from_board * Point3::from(self.options.center_in_board)).coords;
        let about_center = Transform::from_parts(Translation3::from(center - turn * center), turn);
        let turned = about_center * sample.base_from_flange;
        if self.options.reach.is_none() {
            return Some((turned, None));
        }
        // For an arm, the distance and the position of the board in the image are also changed. A
        // person changes the rotations in any case.
        let distance_m = (solution.camera_from_board(&geometry::a_of(self.input.setup, &turned)))
            .translation
            .vector
            .norm();
        let shift = Vector3::from_fn(|_, _| 0.1 * distance_m * random.uniform(-1.0, 1.0));
        Some((
            Transform::from_parts((turned.translation.vector + shift).into(), turned.rotation),
            None,
        ))
    }

    /// Whether the whole board is in view, at a distance and tilt at which the board is detected.
    fn is_well_visible(&self, camera_from_board: &Transform, distance_m: f64) -> bool {
        // Allowed distances of the board, relative to the distances in the samples so far. In these
        // samples, the board was detected.
        const DISTANCES: std::ops::RangeInclusive<f64> = 0.6..=1.6;
        const MARGIN_FRAC: f64 = 0.02;
        // The margin for an arm is larger, because it moves before anyone can check whether the
        // board is in view.
        const ARM_MARGIN_FRAC: f64 = 0.05;
        // Without intrinsics, the field of view of a narrow camera is assumed.
        const HALF_VIEW_RAD: f64 = 0.35;
        let center = (camera_from_board * Point3::from(self.options.center_in_board)).coords;
        let normal = camera_from_board.rotation * Vector3::z();
        let tilt_cosine = normal.dot(&center.normalize()).abs();
        if center.z.is_nan()
            || center.z <= 0.0
            || !DISTANCES.contains(&(camera_from_board.translation.vector.norm() / distance_m))
        {
            return false;
        }
        if tilt_cosine < self.options.max_tilt_rad.cos() {
            return false;
        }
        // Eight points of a circle around the board.
        let rim = (0..8).map(|step| {
            let (sine, cosine) = (f64::from(step) * std::f64::consts::FRAC_PI_4).sin_cos();
            let point = self.options.center_in_board
                + Vector3::new(cosine, sine, 0.0) * self.options.radius_m;
            (camera_from_board * Point3::from(point)).coords
        });
        let margin_frac = if self.options.reach.is_some() {
            ARM_MARGIN_FRAC
        } else {
            MARGIN_FRAC
        };
        match &self.calibration.refined.intrinsics {
            Some(intrinsics) => rim
                .into_iter()
                .all(|point| is_in_image(intrinsics, &point, margin_frac)),
            None => rim
                .into_iter()
                .all(|point| point.z > 0.0 && point.xy().norm() < HALF_VIEW_RAD.tan() * point.z),
        }
    }

    /// Describes the motion from the sample that the candidate was derived from. The first string
    /// is an instruction, and the second string describes the rotation.
    fn motion(&self, candidate: &Candidate) -> [String; 2] {
        let sample = &self.input.samples[candidate.sample_ix];
        let old_from_new = sample.base_from_flange.inverse() * candidate.base_from_flange;
        // This is the same rotation in camera axes (eye in hand).
        let x = &self.calibration.refined.solution.x;
        let (rotation, body) = match self.input.setup {
            Setup::EyeInHand => (x.inverse() * old_from_new * x, "camera"),
            Setup::EyeToHand => (old_from_new, "flange"),
        };
        let vector = rotation.rotation.scaled_axis();
        let angle_deg = vector.norm().to_degrees();
        let axis = if vector.norm() > 0.0 {
            vector.normalize()
        } else {
            Vector3::z()
        };
        // Axes are named by their positive direction, so the angle gets the sign.
        let signed_deg = angle_deg * axis[axis.iamax()].signum();
        let name = axis_name(&axis, body);
        let moved = match self.input.setup {
            Setup::EyeInHand => x.rotation.inverse() * old_from_new.translation.vector,
            Setup::EyeToHand => old_from_new.translation.vector,
        };
        // Adding zero changes a negative zero to a positive zero.
        let [right, down, forward]: [f64; 3] =
            moved.map(|meters| (1e3 * meters).round() + 0.0).into();
        let relation = format!(
            "rotated by {signed_deg:.0} degrees about {name} relative to {}",
            sample.name
        );
        let motion = format!(
            "from the pose of {:?}, rotate the flange by {signed_deg:.0} degrees around {name} and move it by ({right}, {down}, {forward}) mm along the {body}'s x, y and z axes",
            sample.name
        );
        [motion, relation]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PANDA: &str = include_str!("../../../../rigs/robots/panda.urdf");
    const START: [f64; 7] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];

    #[test]
    fn configurations_stay_near_the_start() {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").unwrap();
        let reach = Reach {
            chain: &chain,
            start: &START,
            max_joint_change: 0.6,
            max_distance_m: 0.15,
        };
        let start = chain.forward(&START).unwrap();
        let near =
            start * Transform::new(Vector3::new(0.05, 0.0, -0.05), Vector3::new(0.2, 0.0, 0.1));
        let joints = reach.joints_for(&near, &START).expect("the pose is near");
        assert!(
            (chain.forward(&joints).unwrap().inverse() * near)
                .translation
                .vector
                .norm()
                < 1e-6
        );
        assert!(
            joints.iter().zip(&START).all(|(a, b)| (a - b).abs() <= 0.6),
            "{joints:?}"
        );
        let far = start * Transform::translation(0.2, 0.0, 0.0);
        assert_eq!(reach.joints_for(&far, &START), None, "beyond the distance");
        let rotated = start * Transform::new(Vector3::zeros(), Vector3::z() * 0.9);
        assert_eq!(
            reach.joints_for(&rotated, &START),
            None,
            "a joint would rotate by more than 0.6"
        );
        // The first and the last configuration are near, but the flange passes far from the start.
        let mut current = START;
        current[3] += 1.2;
        assert_eq!(
            reach.joints_for(&near, &current),
            None,
            "the path is too far"
        );
    }

    #[test]
    fn path_back_to_the_start_stays_near_it() {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").unwrap();
        let wide = Reach {
            chain: &chain,
            start: &START,
            max_joint_change: 1.5,
            max_distance_m: 0.5,
        };
        let start = chain.forward(&START).unwrap();
        // The position of the flange is the same at both ends, but it moves along the path.
        let rotated = start * Transform::new(Vector3::zeros(), Vector3::y() * 0.7);
        let joints = wide.joints_for(&rotated, &START).expect("the pose is near");
        let middle: Vec<f64> = joints
            .iter()
            .zip(&START)
            .map(|(a, b)| 0.5 * (a + b))
            .collect();
        let middle = chain.forward(&middle).unwrap();
        let largest_m = (middle.translation.vector - start.translation.vector).norm();
        assert!(largest_m > 0.002, "{largest_m} m");
        let narrow = Reach {
            max_distance_m: 0.9 * largest_m,
            ..wide
        };
        assert_eq!(
            narrow.joints_for(&rotated, &joints),
            None,
            "the arm is there, but cannot return"
        );
    }

    #[test]
    fn joint_close_to_its_limit_may_stay_there() {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").unwrap();
        let mut start = START;
        start[5] = 3.74;
        let reach = Reach {
            chain: &chain,
            start: &start,
            max_joint_change: 0.6,
            max_distance_m: 0.15,
        };
        let pose = chain.forward(&start).unwrap();
        assert_eq!(reach.joints_for(&pose, &start).as_deref(), Some(&start[..]));
    }
}
