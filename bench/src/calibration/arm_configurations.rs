//! Calibration near a singular configuration of the arm, with joint offsets.

use super::method::Errors;
use super::scene::{brown_conrady, intrinsics, view};
use calibration::hand_eye::{
    BoardObservation, HandEyeInput, HandEyeOptions, HandEyeSample, Setup, calibrate_hand_eye,
};
use kinematics::quantile::median;
use kinematics::random::Random;
use kinematics::{Chain, Transform};
use nalgebra::Vector3;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};
use serde::Serialize;

const URDF: &str = include_str!("../../../rigs/robots/panda.urdf");
/// With joint 6 at zero, the axes of joints 5 and 7 are parallel.
const HOME_RAD: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 0.0, 0.8];
const WRIST_IX: usize = 5;
/// Angles of joint 6 from the singularity, degrees.
const ANGLES_DEG: [f64; 6] = [0.0, 2.0, 5.0, 15.0, 45.0, 90.0];
/// Standard deviation of joint 6 and of the other joints around the arm configuration, radians.
const WRIST_SPREAD_RAD: f64 = 0.01;
const SPREAD_RAD: f64 = 0.2;
/// Standard deviation of the joint offsets, radians.
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
    /// Fraction of these within three standard deviations.
    pub(super) within_3_sigma_frac: Option<f64>,
}

/// Result of a run: errors, and the error of each observable joint offset in standard deviations.
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
        let column = |value: fn(&Errors) -> f64| {
            median(
                &solved
                    .iter()
                    .map(|(errors, _)| value(errors))
                    .collect::<Vec<_>>(),
            )
        };
        Self {
            angle_deg,
            estimates_joints,
            n_runs: runs.len(),
            n_refused: runs.len() - solved.len(),
            n_failed: solved
                .iter()
                .filter(|(errors, _)| errors.has_failed())
                .count(),
            mm: column(|errors| errors.mm),
            deg: column(|errors| errors.deg),
            observable_frac: of_joints(
                deviations.len() as f64 / (N_ESTIMATED_OFFSETS * solved.len().max(1)) as f64,
            ),
            within_3_sigma_frac: of_joints(n_within as f64 / deviations.len().max(1) as f64),
        }
    }
}

fn run(chain: &Chain, angle_deg: f64, estimates_joints: bool, seed: u64) -> Run {
    const MAX_ATTEMPTS: usize = 20_000;
    let mut random = Random::new(7000 + seed);
    let lens = intrinsics(brown_conrady());
    let flange_from_camera = Transform::new(
        Vector3::new(0.05, -0.03, 0.08),
        Vector3::new(0.1, -0.2, 1.6),
    );
    let mut home = HOME_RAD;
    home[WRIST_IX] += angle_deg.to_radians();
    let offsets: Vec<f64> = home.iter().map(|_| OFFSET_RAD * random.normal()).collect();
    let forward = |joints: &[f64]| chain.forward(joints).expect("seven joints");
    // In front of the camera at the mean arm configuration.
    let base_from_board = forward(&home)
        * flange_from_camera
        * Transform::new(Vector3::new(-0.1, -0.06, 0.5), Vector3::new(0.2, 0.1, 0.0));
    let mut samples = Vec::new();
    for _ in 0..MAX_ATTEMPTS {
        let spread_rad = |ix: usize| {
            if ix == WRIST_IX {
                WRIST_SPREAD_RAD
            } else {
                SPREAD_RAD
            }
        };
        let joints: Vec<f64> = home
            .iter()
            .enumerate()
            .map(|(ix, joint)| joint + spread_rad(ix) * random.normal())
            .collect();
        let moved: Vec<f64> = joints
            .iter()
            .zip(&offsets)
            .map(|(joint, offset)| joint + offset)
            .collect();
        let pose = (forward(&moved) * flange_from_camera).inverse() * base_from_board;
        let board = view(&lens, &pose, CORNER_PX, &mut random);
        const N_CORNERS: usize = 54;
        if board.points.len() == N_CORNERS {
            samples.push(HandEyeSample {
                name: format!("{}", samples.len()),
                base_from_flange: forward(&joints),
                board: BoardObservation::View(board),
                joints: Some(joints),
            });
        }
        if samples.len() == N_POSES {
            break;
        }
    }
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
    // The offset of the last joint is equivalent to a rotation of the camera; it is not estimated
    // separately.
    let mut last = vec![0.0; home.len()];
    last[home.len() - 1] = offsets[home.len() - 1];
    let truth = forward(&vec![0.0; home.len()]).inverse() * forward(&last) * flange_from_camera;
    let deviation = |(offset, truth): (&calibration::hand_eye::JointOffset, &f64)| {
        let [value, sigma] = offset.estimate?;
        Some((value - truth).abs() / sigma)
    };
    let deviations = found
        .joint_offsets
        .iter()
        .zip(&offsets)
        .filter_map(deviation)
        .collect();
    Some((
        Errors::of(&found.parent_from_camera, &truth, None),
        deviations,
    ))
}
