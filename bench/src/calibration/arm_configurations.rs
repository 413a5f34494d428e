//! Measures calibration near a singular configuration of the arm, with joint offsets.

use super::method::Errors;
use super::scene::{brown_conrady, intrinsics, view};
use calibration::hand_eye::{
    BoardObservation, HandEyeInput, HandEyeOptions, HandEyeSample, JointOffset, Setup,
    calibrate_hand_eye,
};
use kinematics::{Chain, Intrinsics, Transform};
use nalgebra::Vector3;
use numbers::quantile::median;
use numbers::random::Random;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};
use serde::Serialize;

const URDF: &str = include_str!("../../../rigs/robots/panda.urdf");
/// Number of corners of the board.
const N_CORNERS: usize = 54;
/// With joint 6 at zero, the axes of joints 5 and 7 are parallel.
const HOME_RAD: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 0.0, 0.8];
const WRIST_IX: usize = 5;
/// Angles of joint 6 from the singularity, degrees.
const ANGLES_DEG: [f64; 6] = [0.0, 2.0, 5.0, 15.0, 45.0, 90.0];
/// Standard deviation of joint 6 around the arm configuration, radians. It is small, so that the
/// whole run stays near the tested distance from the singularity.
const WRIST_SPREAD_RAD: f64 = 0.01;
/// Standard deviation of the other joints, radians. The rotation is large enough for a calibration,
/// but most poses still show the whole board.
const SPREAD_RAD: f64 = 0.2;
/// Standard deviation of the joint offsets, radians. It corresponds to 3 mm at a distance of 0.8 m,
/// which is far above the noise of the corners.
const OFFSET_RAD: f64 = 0.004;
const N_POSES: usize = 25;
const CORNER_PX: f64 = 0.1;

/// Results at one distance from the singularity.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ArmConfiguration {
    /// Angle of joint 6 from the singularity, degrees.
    pub(super) angle_deg: f64,
    pub(super) estimates_joints: bool,
    pub(super) n_runs: usize,
    pub(super) n_refused: usize,
    pub(super) n_failed: usize,
    pub(super) mm: Option<f64>,
    pub(super) deg: Option<f64>,
    /// Fraction of the offsets of all joints except the first and the last that are reported as
    /// observable.
    pub(super) observable_frac: Option<f64>,
    /// Fraction of the observable offsets whose error is within three standard deviations.
    pub(super) within_3_sigma_frac: Option<f64>,
}

/// Result of a run. It has the errors of the camera pose, and the error of each observable joint
/// offset in standard deviations.
type Run = Option<(Errors, Vec<f64>)>;

/// Measures all arm configurations with and without estimated joint offsets.
pub(super) fn measure(n_seeds: u64) -> Vec<ArmConfiguration> {
    let chain = Chain::from_urdf(URDF, "panda_link0", "panda_link8").expect("the bundled arm");
    let all = ANGLES_DEG
        .into_iter()
        .flat_map(|angle_deg| [false, true].map(|joints| (angle_deg, joints)));
    all.map(|(angle_deg, estimates_joints)| {
        let runs = (0..n_seeds)
            .into_par_iter()
            .map(|seed| run(&chain, angle_deg, estimates_joints, seed));
        ArmConfiguration::of(angle_deg, estimates_joints, &runs.collect::<Vec<Run>>())
    })
    .collect()
}

impl ArmConfiguration {
    fn of(angle_deg: f64, estimates_joints: bool, runs: &[Run]) -> Self {
        const N_ESTIMATED_OFFSETS: usize = 5;
        let solved: Vec<&(Errors, Vec<f64>)> = runs.iter().flatten().collect();
        let deviations: Vec<f64> = solved
            .iter()
            .flat_map(|(_, deviations)| deviations.iter().copied())
            .collect();
        let n_within = deviations
            .iter()
            .filter(|deviation| **deviation < 3.0)
            .count();
        let of_joints = |frac: f64| (estimates_joints && !solved.is_empty()).then_some(frac);
        Self {
            angle_deg,
            estimates_joints,
            n_runs: runs.len(),
            n_refused: runs.len() - solved.len(),
            n_failed: solved
                .iter()
                .filter(|(errors, _)| errors.has_failed())
                .count(),
            mm: median_of(&solved, |errors| errors.mm),
            deg: median_of(&solved, |errors| errors.deg),
            observable_frac: of_joints(
                deviations.len() as f64 / (N_ESTIMATED_OFFSETS * solved.len().max(1)) as f64,
            ),
            within_3_sigma_frac: of_joints(n_within as f64 / deviations.len().max(1) as f64),
        }
    }
}

/// Median of a kind of error.
fn median_of(solved: &[&(Errors, Vec<f64>)], value: fn(&Errors) -> f64) -> Option<f64> {
    let values: Vec<f64> = solved.iter().map(|(errors, _)| value(errors)).collect();
    median(&values)
}

/// An arm whose joints have offsets, with a camera.
struct Arm<'a> {
    chain: &'a Chain,
    /// Mean positions of the joints.
    home: [f64; 7],
    /// True positions minus reported positions, radians.
    offsets: Vec<f64>,
    flange_from_camera: Transform,
}

impl Arm<'_> {
    fn forward(&self, joints: &[f64]) -> Transform {
        self.chain.forward(joints).expect("seven joints")
    }

    /// Measurements at joint positions around the mean, from which the whole board is visible. If
    /// such positions are rare, there are fewer than [`N_POSES`].
    fn samples(&self, lens: &Intrinsics, random: &mut Random) -> Vec<HandEyeSample> {
        const MAX_ATTEMPTS: usize = 20_000;
        // The board is in front of the camera at the mean arm configuration.
        let base_from_board = self.forward(&self.home)
            * self.flange_from_camera
            * Transform::new(Vector3::new(-0.1, -0.06, 0.5), Vector3::new(0.2, 0.1, 0.0));
        let mut samples = Vec::new();
        for _ in 0..MAX_ATTEMPTS {
            let joints: Vec<f64> = self
                .home
                .iter()
                .enumerate()
                .map(|(ix, joint)| joint + spread_rad(ix) * random.normal())
                .collect();
            // The pose of the camera results from the true joint positions. The calibration gets
            // the reported positions.
            let moved: Vec<f64> = joints
                .iter()
                .zip(&self.offsets)
                .map(|(joint, offset)| joint + offset)
                .collect();
            let pose = (self.forward(&moved) * self.flange_from_camera).inverse() * base_from_board;
            let board = view(lens, &pose, CORNER_PX, random);
            if board.points.len() == N_CORNERS {
                samples.push(HandEyeSample {
                    name: format!("{}", samples.len()),
                    base_from_flange: self.forward(&joints),
                    board: BoardObservation::View(board),
                    joints: Some(joints),
                });
            }
            if samples.len() == N_POSES {
                break;
            }
        }
        samples
    }

    /// The pose of the camera that a calibration should find.
    fn truth(&self) -> Transform {
        // The offset of the last joint is equivalent to a rotation of the camera, so it is not
        // estimated separately.
        let mut last = vec![0.0; self.home.len()];
        last[self.home.len() - 1] = self.offsets[self.home.len() - 1];
        self.forward(&vec![0.0; self.home.len()]).inverse()
            * self.forward(&last)
            * self.flange_from_camera
    }
}

/// Standard deviation of a joint, radians.
fn spread_rad(joint_ix: usize) -> f64 {
    if joint_ix == WRIST_IX {
        WRIST_SPREAD_RAD
    } else {
        SPREAD_RAD
    }
}

fn run(chain: &Chain, angle_deg: f64, estimates_joints: bool, seed: u64) -> Run {
    let mut random = Random::new(7000 + seed);
    let lens = intrinsics(brown_conrady());
    let mut home = HOME_RAD;
    home[WRIST_IX] += angle_deg.to_radians();
    let arm = Arm {
        chain,
        home,
        offsets: home.iter().map(|_| OFFSET_RAD * random.normal()).collect(),
        flange_from_camera: Transform::new(
            Vector3::new(0.05, -0.03, 0.08),
            Vector3::new(0.1, -0.2, 1.6),
        ),
    };
    let samples = arm.samples(&lens, &mut random);
    let input = HandEyeInput {
        setup: Setup::EyeInHand,
        samples,
        intrinsics: Some(lens),
        intrinsics_covariance: None,
        board_symmetries: &[],
        chain: Some(chain),
        options: HandEyeOptions {
            estimate_joint_offsets: estimates_joints,
            ..HandEyeOptions::default()
        },
    };
    let found = calibrate_hand_eye(&input).ok()?;
    let deviations = found
        .joint_offsets
        .iter()
        .zip(&arm.offsets)
        .filter_map(|(offset, truth)| deviation(offset, *truth))
        .collect();
    Some((
        Errors::of(&found.parent_from_camera, &arm.truth(), None),
        deviations,
    ))
}

/// Error of an estimated offset in standard deviations. `None` if the offset is not observable.
fn deviation(offset: &JointOffset, truth: f64) -> Option<f64> {
    let [value, sigma] = offset.estimate?;
    Some((value - truth).abs() / sigma)
}
