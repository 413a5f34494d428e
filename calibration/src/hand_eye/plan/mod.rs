//! Plans where an arm moves to calibrate its camera. The plan starts with small rotations about the
//! target. Poses with the largest information gain follow until the result is accurate.

mod next_poses;

pub use next_poses::{NextPose, NextPoseOptions, Reach, suggest_next_poses};

use super::samples::board_poses;
use super::{HandEyeCalibration, HandEyeInput, HandEyeOptions, Setup};
use crate::{BoardView, Error};
use kinematics::{Intrinsics, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use std::collections::VecDeque;

/// When a plan is finished.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmPlanOptions {
    /// Maximum number of poses at which the target is seen.
    pub max_poses: usize,
    /// Standard deviation of the position along each axis at which the result is accurate,
    /// millimeters.
    pub goal_mm: f64,
    /// Standard deviation of the rotation about each axis at which the result is accurate, degrees.
    pub goal_deg: f64,
}

/// Minimum number of poses. Standard deviations from fewer poses are not reliable.
pub const MIN_POSES: usize = 10;
/// Number of poses in a row without the target after which the plan ends. It is larger than the
/// number of rotations about the target (six), because all of them fail if the given camera pose is
/// wrong.
const MAX_UNSEEN: usize = 8;

/// Maximum standard deviation of the position, millimeters, at which an estimate selects the next
/// pose. With a larger standard deviation, the plan continues with the small rotations as long as
/// some remain. If the error of the camera pose is larger than this value, the target may not be
/// visible at suggested poses. With a smaller limit, the arm makes more small rotations, which add
/// little information.
const MAX_EARLY_SIGMA_MM: f64 = 20.0;

/// What an arm does next.
#[derive(Clone, Debug, PartialEq)]
pub enum ArmStep {
    /// Move to these joint values, in the order of the chain.
    Move {
        /// The joints.
        joints: Vec<f64>,
        /// The purpose of the pose, for people.
        purpose: String,
    },
    /// The plan is finished, for this reason.
    Finished(String),
}

/// The target at the start, where the plan begins.
#[derive(Clone, Copy, Debug)]
pub struct FirstView<'a> {
    /// Where the camera is mounted.
    pub setup: Setup,
    /// The target in the image.
    pub view: &'a BoardView,
    /// An approximate lens.
    pub intrinsics: &'a Intrinsics,
    /// An approximate pose of the camera on the flange or in the base.
    pub parent_from_camera: &'a Transform,
}

impl FirstView<'_> {
    /// Distance of a point of the board from the camera, meters. `None` if the view does not
    /// determine it.
    pub fn distance_m(&self, point_in_board: &Vector3<f64>) -> Option<f64> {
        let poses = board_poses(self.view, self.intrinsics);
        let in_camera = poses.first()?.camera_from_board * Point3::from(*point_in_board);
        Some(in_camera.coords.norm())
    }
}

/// A plan for one calibration.
#[derive(Debug)]
pub struct ArmPlan<'a> {
    reach: Reach<'a>,
    poses: NextPoseOptions<'a>,
    options: ArmPlanOptions,
    /// Flange poses that are tried before an estimate is available, with their purpose.
    first: VecDeque<(Transform, String)>,
    n_unseen: usize,
    n_refined: usize,
}

impl<'a> ArmPlan<'a> {
    /// Plans motions around the configuration at which the target is seen.
    ///
    /// * `poses`: the board's size and the visibility limits for [`suggest_next_poses`]. `n_poses`,
    ///   `reach` and `seed` are ignored.
    pub fn new(
        reach: &Reach<'a>,
        poses: &NextPoseOptions<'a>,
        options: &ArmPlanOptions,
        first: &FirstView<'_>,
    ) -> Self {
        Self {
            reach: *reach,
            poses: NextPoseOptions {
                n_poses: 1,
                ..*poses
            },
            options: *options,
            first: first_poses(reach, first, &poses.center_in_board),
            n_unseen: 0,
            n_refined: 0,
        }
    }

    /// Options of the calibrations during the plan. Uncertain results are accepted, and joint
    /// offsets are not estimated, because they need more poses.
    pub fn estimate_options(options: &HandEyeOptions) -> HandEyeOptions {
        HandEyeOptions {
            estimate_joint_offsets: false,
            max_sigma_m: 0.1,
            max_sigma_rad: 0.1,
            ..*options
        }
    }

    /// Records that the target was not seen at the last pose.
    pub fn unseen(&mut self) {
        self.n_unseen += 1;
    }

    /// Records that the target was seen at the last pose.
    pub fn seen(&mut self) {
        self.n_unseen = 0;
    }

    /// The next step.
    ///
    /// * `input`: the samples so far.
    /// * `estimate`: the calibration from these samples, or the reason why there is no calibration.
    /// * `current`: the current joint values, in the order of the chain.
    pub fn next(
        &mut self,
        input: &HandEyeInput<'_>,
        estimate: Result<&HandEyeCalibration, &Error>,
        current: &[f64],
    ) -> ArmStep {
        // A plan ends in three ways. The end by an accurate result has priority.
        let n = input.samples.len();
        if let Ok(calibration) = estimate {
            let sigma_mm = calibration.sigma_mm.into_iter().fold(0.0, f64::max);
            let sigma_deg = calibration.sigma_deg.into_iter().fold(0.0, f64::max);
            if n >= MIN_POSES
                && sigma_mm <= self.options.goal_mm
                && sigma_deg <= self.options.goal_deg
            {
                return ArmStep::Finished(format!(
                    "the standard deviations are at most {sigma_mm:.2} mm and {sigma_deg:.3} degrees"
                ));
            }
        }
        if n >= self.options.max_poses {
            return ArmStep::Finished(format!("the target was seen at {n} poses, the maximum"));
        }
        if self.n_unseen >= MAX_UNSEEN {
            return ArmStep::Finished(format!(
                "the target was not seen at the last {MAX_UNSEEN} poses"
            ));
        }
        // The plan starts with a few small rotations, because with few samples or a large
        // uncertainty, an estimate may have large errors.
        if n < 5 || estimate.as_ref().map_or(true, |found| is_uncertain(found)) {
            // Poses that the arm does not reach are skipped and not tried again.
            while let Some((pose, purpose)) = self.first.pop_front() {
                if let Some(joints) = self.reach.joints_for(&pose, current) {
                    return ArmStep::Move { joints, purpose };
                }
            }
        }
        let calibration = match estimate {
            Ok(calibration) => calibration,
            Err(error) => {
                return ArmStep::Finished(format!(
                    "small rotations of the flange give no estimate: {error}"
                ));
            }
        };
        // The seed changes with each suggestion, so that a pose at which the target was not seen is
        // not suggested again.
        self.n_refined += 1;
        let options = NextPoseOptions {
            reach: Some((self.reach, current)),
            seed: self.n_refined as u64,
            ..self.poses
        };
        // Only one pose is suggested at a time, because the next estimate may change which poses
        // are most informative.
        match suggest_next_poses(input, calibration, &options).pop() {
            Some(next) => match next.joints {
                Some(joints) => ArmStep::Move { joints, purpose: next.relation },
                None => ArmStep::Finished("the arm reaches no other pose that shows the target".to_owned()),
            },
            None => ArmStep::Finished(
                "the arm reaches no other pose near its start that shows the target and improves the result".to_owned(),
            ),
        }
    }
}

/// Whether an estimate is too uncertain to select poses.
fn is_uncertain(found: &HandEyeCalibration) -> bool {
    found
        .sigma_mm
        .iter()
        .any(|sigma| *sigma > MAX_EARLY_SIGMA_MM)
}

/// Purpose of a rotation about an axis of a body, for people.
fn purpose(verb: &str, (sign, axis): (f64, usize), degrees: f64, body: &str) -> String {
    format!(
        "{verb} by {:.0} degrees about the {body}'s {} axis",
        sign * degrees,
        ["x", "y", "z"][axis]
    )
}

/// Rotations about the center of the target, followed by small rotations about the flange. The
/// center follows from the approximate pose of the camera, so that the rotations about it keep the
/// target in view. If the approximate pose has a large error, these rotations move the target out
/// of view. The rotations about the flange are for this case.
fn first_poses(
    reach: &Reach<'_>,
    first: &FirstView<'_>,
    center_in_board: &Vector3<f64>,
) -> VecDeque<(Transform, String)> {
    /// Rotation about the target, degrees. It is large enough for a first estimate, and small
    /// enough to be reached almost everywhere.
    const ABOUT_TARGET_DEG: f64 = 15.0;
    /// Rotations about the flange, degrees. They move the target in the image by the same angle.
    /// The target therefore stays in view only if they are much smaller than half the field of
    /// view.
    const ABOUT_FLANGE_DEG: [f64; 2] = [6.0, 10.0];
    const DIRECTIONS: [(f64, usize); 6] = [
        (1.0, 0),
        (1.0, 1),
        (1.0, 2),
        (-1.0, 0),
        (-1.0, 1),
        (-1.0, 2),
    ];
    let Ok(start) = reach.chain.forward(reach.start) else {
        return VecDeque::new();
    };
    let unit = |(sign, axis): (f64, usize)| {
        Vector3::from_fn(|row, _| if row == axis { sign } else { 0.0 })
    };
    let mut poses = VecDeque::new();
    if let Some(board) = board_poses(first.view, first.intrinsics).first() {
        let base_from_camera = match first.setup {
            Setup::EyeInHand => start * first.parent_from_camera,
            Setup::EyeToHand => *first.parent_from_camera,
        };
        let center =
            (base_from_camera * board.camera_from_board * Point3::from(*center_in_board)).coords;
        poses.extend(DIRECTIONS.map(|direction| {
            let axis = base_from_camera.rotation * unit(direction);
            let rotation = UnitQuaternion::from_scaled_axis(axis * ABOUT_TARGET_DEG.to_radians());
            // This motion maps the center to itself. With the eye to hand, the same motion of the
            // flange rotates the target about its own center.
            let about_center = Transform::from_parts((center - rotation * center).into(), rotation);
            (
                about_center * start,
                purpose("orbit the target", direction, ABOUT_TARGET_DEG, "camera"),
            )
        }));
    }
    for degrees in ABOUT_FLANGE_DEG {
        poses.extend(DIRECTIONS.map(|direction| {
            let rotation = Transform::new(Vector3::zeros(), unit(direction) * degrees.to_radians());
            (
                start * rotation,
                purpose("rotate the flange", direction, degrees, "flange"),
            )
        }));
    }
    poses
}

#[cfg(test)]
mod tests {
    use super::super::tests::{self as scene, N_COLUMNS, N_ROWS, SQUARE_M};
    use super::super::{BoardObservation, HandEyeSample, calibrate_hand_eye};
    use super::*;
    use kinematics::Chain;
    use numbers::random::Random;

    const PANDA: &str = include_str!("../../../../rigs/robots/panda.urdf");
    const START: [f64; 7] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];

    /// Runs a plan with simulated corners. Returns the samples, how the plan ended, and whether
    /// each configuration was allowed.
    fn run(
        setup: Setup,
        options: &ArmPlanOptions,
        given: &Transform,
        is_hidden: impl Fn(usize) -> bool,
    ) -> (Vec<HandEyeSample>, String) {
        let chain = Chain::from_urdf(PANDA, "panda_link0", "panda_link8").expect("a robot");
        let scene = scene::Scene::new(setup, 1, 0.0, 3);
        // The board is placed where the camera sees it from the start configuration.
        let start = chain.forward(&START).expect("a configuration");
        let (x, y) = (scene.parent_from_camera, scene.parent_from_board);
        let camera_from_board = scene.camera_from_board(&scene.base_from_flange[0]);
        let camera_from_board_at = |base_from_flange: &Transform| match setup {
            Setup::EyeInHand => {
                x.inverse() * base_from_flange.inverse() * (start * x * camera_from_board)
            }
            Setup::EyeToHand => {
                camera_from_board * y.inverse() * start.inverse() * base_from_flange * y
            }
        };
        let intrinsics = scene::intrinsics();
        let reach = Reach {
            chain: &chain,
            start: &START,
            max_joint_change: 0.8,
            max_distance_m: 0.3,
        };
        let half = |n: u32| 0.5 * f64::from(n - 1) * SQUARE_M;
        let poses = NextPoseOptions {
            n_poses: 1,
            center_in_board: Vector3::new(half(N_COLUMNS), half(N_ROWS), 0.0),
            radius_m: half(N_COLUMNS).hypot(half(N_ROWS)),
            max_tilt_rad: 0.7,
            reach: None,
            seed: 1,
        };
        let mut random = Random::new(5);
        let mut joints = START.to_vec();
        let mut samples: Vec<HandEyeSample> = Vec::new();
        let mut plan: Option<ArmPlan<'_>> = None;
        for step_ix in 0..60 {
            let base_from_flange = chain.forward(&joints).expect("a configuration");
            let view = scene::view(&camera_from_board_at(&base_from_flange), 0.1, &mut random);
            let is_inside = |point: &crate::BoardPoint| {
                (0..2).all(|axis| {
                    (0.0..f64::from(intrinsics.size_px[axis])).contains(&point.pixel[axis])
                })
            };
            let is_seen = view.points.iter().all(is_inside) && !is_hidden(step_ix);
            let plan = plan.get_or_insert_with(|| {
                let parent_from_camera = &(x * given);
                let first = FirstView {
                    setup,
                    view: &view,
                    intrinsics: &intrinsics,
                    parent_from_camera,
                };
                ArmPlan::new(&reach, &poses, options, &first)
            });
            let board = BoardObservation::View(view);
            if is_seen {
                let name = step_ix.to_string();
                samples.push(HandEyeSample {
                    name,
                    base_from_flange,
                    board,
                    joints: Some(joints.clone()),
                });
                plan.seen();
            } else {
                plan.unseen();
            }
            let wide = ArmPlan::estimate_options(&HandEyeOptions::default());
            let mut input = scene.input(samples.clone());
            (input.intrinsics, input.chain, input.options) =
                (Some(intrinsics.clone()), Some(&chain), wide);
            let estimate = calibrate_hand_eye(&input);
            match plan.next(&input, estimate.as_ref(), &joints) {
                ArmStep::Move { joints: next, .. } => {
                    let limits = chain.limits().iter().zip(&next).zip(&START);
                    for ((limit, joint), start) in limits {
                        assert!(
                            (limit.lower..=limit.upper).contains(joint)
                                && (joint - start).abs() <= 0.8
                        );
                    }
                    joints = next;
                }
                ArmStep::Finished(why) => return (samples, why),
            }
        }
        panic!("the plan does not end");
    }

    #[test]
    fn plan_reaches_the_goal_from_a_single_view() {
        let options = ArmPlanOptions {
            max_poses: 30,
            goal_mm: 0.3,
            goal_deg: 0.05,
        };
        // One given pose is wrong by 4 degrees and 30 mm, and another given pose is useless.
        let wrong = Transform::new(
            Vector3::new(0.02, -0.02, 0.01),
            Vector3::new(0.04, 0.05, -0.03),
        );
        let useless = Transform::new(Vector3::new(0.1, 0.0, -0.1), Vector3::new(1.0, 1.5, 0.5));
        for (setup, given) in [
            (Setup::EyeInHand, wrong),
            (Setup::EyeToHand, wrong),
            (Setup::EyeInHand, useless),
            (Setup::EyeToHand, useless),
        ] {
            let (samples, why) = run(setup, &options, &given, |_| false);
            assert!(
                why.starts_with("the standard deviations are at most"),
                "{setup:?}: {why}"
            );
            assert!(
                (MIN_POSES..30).contains(&samples.len()),
                "{setup:?}: {} poses",
                samples.len()
            );
        }
    }

    #[test]
    fn plan_ends_at_the_maximum_and_without_the_target() {
        let strict = ArmPlanOptions {
            max_poses: 8,
            goal_mm: 1e-6,
            goal_deg: 1e-6,
        };
        let run = |is_hidden: &dyn Fn(usize) -> bool| {
            run(Setup::EyeInHand, &strict, &Transform::identity(), is_hidden)
        };
        let (samples, why) = run(&|_| false);
        assert_eq!(
            (samples.len(), why.as_str()),
            (8, "the target was seen at 8 poses, the maximum")
        );
        // Single poses without the target are skipped.
        let (samples, why) = run(&|step_ix| step_ix % 3 == 1);
        assert_eq!(samples.len(), 8, "{why}");
        let (samples, why) = run(&|step_ix| step_ix > 0);
        assert!(
            samples.len() == 1 && why == "the target was not seen at the last 8 poses",
            "{why}"
        );
    }
}
