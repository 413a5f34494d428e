//! Hand-eye calibration of simulated robots with a known truth. The tests check accuracy, stated
//! uncertainty, ambiguities, mistakes and refusals.

use super::geometry::{Solution, stacked};
use super::*;
use crate::BoardPoint;
use kinematics::{Lens, transform};
use nalgebra::{Point3, SVector, UnitQuaternion, Vector3};
use numbers::random::Random;

/// A solution and a robot pose for tests of derivatives.
pub(super) fn example() -> (Solution, Transform) {
    let solution = Solution {
        x: Transform::new(Vector3::new(0.05, -0.02, 0.1), Vector3::new(0.3, -1.0, 2.0)),
        y: Transform::new(Vector3::new(0.6, 0.2, 0.1), Vector3::new(2.0, 0.5, -0.3)),
    };
    let base_from_flange =
        Transform::new(Vector3::new(0.4, -0.1, 0.5), Vector3::new(1.0, 2.0, -0.5));
    (solution, base_from_flange)
}

/// A step of one parameter.
pub(super) fn unit_step<const N: usize>(ix: usize, nudge: f64) -> SVector<f64, N> {
    SVector::from_fn(|row, _| if row == ix { nudge } else { 0.0 })
}

/// Derivative of a function at zero.
pub(super) fn central_difference<const ROWS: usize>(
    at: impl Fn(f64) -> SVector<f64, ROWS>,
) -> SVector<f64, ROWS> {
    const NUDGE: f64 = 1e-6;
    (at(NUDGE) - at(-NUDGE)) / (2.0 * NUDGE)
}

pub(super) const N_COLUMNS: u32 = 9;
pub(super) const N_ROWS: u32 = 6;
pub(super) const SQUARE_M: f64 = 0.025;

pub(super) fn intrinsics() -> Intrinsics {
    Intrinsics {
        size_px: [1280, 720],
        focal_px: [900.0, 905.0],
        principal_px: [643.0, 358.0],
        lens: Lens::BrownConrady([-0.12, 0.05, 0.0005, -0.0003, 0.0]),
        rectified: false,
    }
}

pub(super) fn board_points() -> Vec<Vector3<f64>> {
    let point =
        |row: u32, column: u32| Vector3::new(f64::from(column), f64::from(row), 0.0) * SQUARE_M;
    (0..N_ROWS)
        .flat_map(|row| (0..N_COLUMNS).map(move |column| point(row, column)))
        .collect()
}

/// Half turn of the board about its center.
pub(super) fn half_turn() -> Transform {
    let last = Vector3::new(f64::from(N_COLUMNS - 1), f64::from(N_ROWS - 1), 0.0) * SQUARE_M;
    Transform::new(last, Vector3::z() * std::f64::consts::PI)
}

/// Corners of the board with normal errors.
pub(super) fn view(camera_from_board: &Transform, noise_px: f64, random: &mut Random) -> BoardView {
    let intrinsics = intrinsics();
    let points = board_points()
        .into_iter()
        .filter_map(|point_in_board| {
            let pixel =
                intrinsics.project(&(camera_from_board * Point3::from(point_in_board)).coords)?;
            let pixel = [
                pixel[0] + noise_px * random.normal(),
                pixel[1] + noise_px * random.normal(),
            ];
            Some(BoardPoint {
                point_in_board,
                pixel,
            })
        })
        .collect();
    BoardView {
        name: "view".to_owned(),
        points,
    }
}

/// A simulated calibration.
#[derive(Clone, Debug)]
pub(super) struct Scene {
    pub(super) setup: Setup,
    /// Truth.
    pub(super) parent_from_camera: Transform,
    pub(super) parent_from_board: Transform,
    /// True robot poses.
    pub(super) base_from_flange: Vec<Transform>,
}

/// Errors of simulated measurements.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Errors {
    pub(super) corner_px: f64,
    pub(super) robot_rad: f64,
    pub(super) robot_m: f64,
    /// Errors of given board poses.
    pub(super) board_rad: f64,
    pub(super) board_m: f64,
}

impl Errors {
    fn corners(corner_px: f64) -> Self {
        Self {
            corner_px,
            ..Self::default()
        }
    }

    /// Errors of corners, and of the robot in radians and meters.
    fn robot(corner_px: f64, sigma: f64) -> Self {
        Self {
            corner_px,
            robot_rad: sigma,
            robot_m: sigma,
            ..Self::default()
        }
    }

    /// Errors of given board poses, whose positions are half as uncertain.
    fn boards(rad: f64) -> Self {
        Self {
            board_rad: rad,
            board_m: 0.5 * rad,
            ..Self::default()
        }
    }
}

impl Scene {
    /// Poses around a board at 0.5 m, rotated about random axes by normal angles with a deviation
    /// of `spread_rad`.
    pub(super) fn new(setup: Setup, n: usize, spread_rad: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let pose = |at: [f64; 3], rotation: [f64; 3]| Transform::new(at.into(), rotation.into());
        let (parent_from_camera, parent_from_board) = match setup {
            Setup::EyeInHand => (
                pose([0.05, -0.03, 0.08], [0.1, -0.2, 1.6]),
                pose([0.6, 0.1, 0.02], [3.0, 0.1, -0.2]),
            ),
            Setup::EyeToHand => (
                pose([1.0, 0.2, 0.5], [-1.2, 1.2, 1.2]),
                pose([0.02, -0.04, 0.1], [0.2, 0.3, -0.4]),
            ),
        };
        let center = board_points().iter().sum::<Vector3<f64>>() / f64::from(N_COLUMNS * N_ROWS);
        let base_from_flange = (0..n)
            .map(|_| {
                let mut vector = |scale: f64| {
                    Vector3::new(random.normal(), random.normal(), random.normal()) * scale
                };
                // The center of the board stays near the optical axis, and the tilt stays below 60
                // degrees.
                let mut turn = vector(spread_rad);
                turn.x = turn.x.clamp(-1.0, 1.0);
                turn.y = turn.y.clamp(-1.0, 1.0);
                let rotation = UnitQuaternion::from_scaled_axis(turn);
                let at = Vector3::new(0.0, 0.0, 0.5) + vector(0.03);
                let camera_from_board =
                    Transform::from_parts((at - rotation * center).into(), rotation);
                match setup {
                    Setup::EyeInHand => {
                        parent_from_board
                            * camera_from_board.inverse()
                            * parent_from_camera.inverse()
                    }
                    Setup::EyeToHand => {
                        parent_from_camera * camera_from_board * parent_from_board.inverse()
                    }
                }
            })
            .collect();
        Self {
            setup,
            parent_from_camera,
            parent_from_board,
            base_from_flange,
        }
    }

    pub(super) fn camera_from_board(&self, base_from_flange: &Transform) -> Transform {
        let camera_parent_from_board_parent = match self.setup {
            Setup::EyeInHand => base_from_flange.inverse(),
            Setup::EyeToHand => *base_from_flange,
        };
        self.parent_from_camera.inverse() * camera_parent_from_board_parent * self.parent_from_board
    }

    fn samples(
        &self,
        errors: &Errors,
        seed: u64,
        board: impl Fn(&Transform, &mut Random) -> BoardObservation,
    ) -> Vec<HandEyeSample> {
        let mut random = Random::new(seed);
        self.base_from_flange
            .iter()
            .enumerate()
            .map(|(ix, pose)| {
                let error = small(&mut random, errors.robot_rad, errors.robot_m);
                let board = board(&self.camera_from_board(pose), &mut random);
                HandEyeSample {
                    name: format!("{ix:02}"),
                    base_from_flange: pose * error,
                    board,
                    joints: None,
                }
            })
            .collect()
    }

    /// Samples with corners.
    pub(super) fn views(&self, errors: &Errors, seed: u64) -> Vec<HandEyeSample> {
        self.samples(errors, seed, |pose, random| {
            BoardObservation::View(view(pose, errors.corner_px, random))
        })
    }

    /// Samples with board poses.
    pub(super) fn poses(&self, errors: &Errors, seed: u64) -> Vec<HandEyeSample> {
        self.samples(errors, seed, |pose, random| {
            let error = small(random, errors.board_rad, errors.board_m);
            let rotation = error.rotation * pose.rotation;
            BoardObservation::Pose(Transform::from_parts(
                (pose.translation.vector + error.translation.vector).into(),
                rotation,
            ))
        })
    }

    pub(super) fn input(&self, samples: Vec<HandEyeSample>) -> HandEyeInput<'static> {
        let has_views = samples
            .iter()
            .any(|sample| matches!(sample.board, BoardObservation::View(_)));
        HandEyeInput {
            setup: self.setup,
            samples,
            intrinsics: has_views.then(intrinsics),
            intrinsics_covariance: None,
            board_symmetries: &[],
            chain: None,
            options: HandEyeOptions::default(),
        }
    }
}

fn small(random: &mut Random, rad: f64, m: f64) -> Transform {
    let mut vector =
        |scale: f64| Vector3::new(random.normal(), random.normal(), random.normal()) * scale;
    Transform::new(vector(m), vector(rad))
}

/// Squared distance of a calibration from the truth, relative to its own uncertainty. It is below
/// 12.59 for 95 % of the results.
fn squared_error(calibration: &HandEyeCalibration, truth: &Transform) -> f64 {
    let difference = calibration.parent_from_camera.inverse() * truth;
    let translation = difference.translation.vector;
    // The covariance has the position first.
    let error = stacked(&translation, &difference.rotation.scaled_axis());
    calibration
        .covariance
        .cholesky()
        .map_or(f64::INFINITY, |factor| error.dot(&factor.solve(&error)))
}

/// Names of the samples with a status.
fn with_status(calibration: &HandEyeCalibration, status: SampleStatus) -> Vec<&str> {
    let samples = calibration.samples.iter();
    let samples = samples.filter(|sample| sample.status == status);
    samples.map(|sample| sample.name.as_str()).collect()
}

fn robot_poses(samples: &[HandEyeSample]) -> Vec<Transform> {
    let poses = samples.iter().map(|sample| sample.base_from_flange);
    poses.collect()
}

/// Options for the board of the scenes.
fn next_poses(n_poses: usize) -> NextPoseOptions<'static> {
    NextPoseOptions {
        n_poses,
        center_in_board: Vector3::new(0.1, 0.0625, 0.0),
        radius_m: 0.12,
        max_tilt_rad: 0.9,
        reach: None,
        seed: 1,
    }
}

fn errors_of(calibration: &HandEyeCalibration, truth: &Transform) -> (f64, f64) {
    let difference = truth.inverse() * calibration.parent_from_camera;
    (
        1e3 * difference.translation.vector.norm(),
        difference.rotation.angle().to_degrees(),
    )
}

fn refusal(input: &HandEyeInput<'_>) -> Refusal {
    match calibrate_hand_eye(input) {
        Err(Error::Refused(refusal)) => *refusal,
        other => panic!(
            "not refused: {:?}",
            other.map(|found| (found.sigma_mm, found.sigma_deg))
        ),
    }
}

#[test]
fn fifteen_views_give_a_tenth_of_a_millimeter() {
    for setup in [Setup::EyeInHand, Setup::EyeToHand] {
        let scene = Scene::new(setup, 15, 0.4, 1);
        let input = scene.input(scene.views(&Errors::corners(0.1), 2));
        let found = calibrate_hand_eye(&input).unwrap();
        let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
        assert!(
            mm < 0.1 && deg < 0.02,
            "{setup:?}: {mm} mm, {deg} degrees; stated {:?} {:?}",
            found.sigma_mm,
            found.sigma_deg
        );
        let board = scene.parent_from_board.inverse() * found.parent_from_board;
        assert!(
            board.translation.vector.norm() < 2e-4,
            "{setup:?}: board off by {board}"
        );
        assert!(
            found.rms_px.unwrap() < 0.2 && found.held_out_rms_px.unwrap() < 0.25,
            "{:?}",
            found.rms_px
        );
        let n_used = with_status(&found, SampleStatus::Used).len();
        assert_eq!(n_used, 15, "{:#?}", found.samples);
    }
}

#[test]
fn exact_poses_give_exact_result() {
    for setup in [Setup::EyeInHand, Setup::EyeToHand] {
        let scene = Scene::new(setup, 3, 0.4, 4);
        let found = calibrate_hand_eye(&scene.input(scene.poses(&Errors::default(), 1))).unwrap();
        let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
        assert!(mm < 1e-4 && deg < 1e-5, "{setup:?}: {mm} mm, {deg} degrees");
    }
}

const N_RUNS: u64 = 30;

/// Number of simulated calibrations out of `n` whose 95 % ellipsoid contains the truth.
fn n_covered(n: u64, samples: impl Fn(&Scene, u64) -> Vec<HandEyeSample>) -> u64 {
    let covers = |seed: u64| {
        let scene = Scene::new(Setup::EyeInHand, 15, 0.4, 100 + seed);
        let found = calibrate_hand_eye(&scene.input(samples(&scene, seed))).unwrap();
        squared_error(&found, &scene.parent_from_camera) < 12.59
    };
    (0..n).filter(|seed| covers(*seed)).count() as u64
}

#[test]
fn stated_ellipsoid_covers_the_truth_with_exact_robot_and_with_inexact_robot() {
    let exact = n_covered(N_RUNS, |scene, seed| {
        scene.views(&Errors::corners(0.1), seed)
    });
    let robot = Errors::robot(0.2, 5e-4);
    let inexact = n_covered(N_RUNS, |scene, seed| scene.views(&robot, seed));
    let poses = Errors::boards(2e-3);
    let given = n_covered(N_RUNS, |scene, seed| scene.poses(&poses, seed));
    // By chance, one in 300 correct tests has fewer.
    for (name, n) in [
        ("exact robot", exact),
        ("inexact robot", inexact),
        ("given poses", given),
    ] {
        assert!(
            (25..=N_RUNS).contains(&n),
            "{name}: {n} of {N_RUNS} (exact {exact}, inexact {inexact}, poses {given})"
        );
    }
}

#[test]
fn half_turns_of_symmetric_boards_are_resolved() {
    let scene = Scene::new(Setup::EyeInHand, 12, 0.4, 5);
    let mut samples = scene.views(&Errors::corners(0.2), 2);
    for sample in samples.iter_mut().step_by(3) {
        let BoardObservation::View(view) = &mut sample.board else {
            unreachable!("the samples have corners")
        };
        let reversed: Vec<[f64; 2]> = view.points.iter().rev().map(|point| point.pixel).collect();
        view.points
            .iter_mut()
            .zip(reversed)
            .for_each(|(point, pixel)| point.pixel = pixel);
    }
    let symmetries = [half_turn()];
    let mut input = scene.input(samples);
    input.board_symmetries = &symmetries;
    let found = calibrate_hand_eye(&input).unwrap();
    let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
    assert!(mm < 0.5 && deg < 0.1, "{mm} mm, {deg} degrees");
    assert_eq!(with_status(&found, SampleStatus::Used).len(), 12);
    // Without the symmetry, the turned boards disagree.
    input.board_symmetries = &[];
    let without = calibrate_hand_eye(&input).unwrap();
    assert_eq!(with_status(&without, SampleStatus::Outlier).len(), 4);
}

#[test]
fn wrong_samples_are_named() {
    let scene = Scene::new(Setup::EyeInHand, 20, 0.4, 6);
    let mut samples = scene.views(&Errors::robot(0.2, 3e-4), 2);
    let other = Scene::new(Setup::EyeInHand, 20, 0.4, 77);
    for ix in [1, 4, 5, 11, 12, 15, 18] {
        samples[ix].base_from_flange = other.base_from_flange[ix];
    }
    let found = calibrate_hand_eye(&scene.input(samples)).unwrap();
    let outliers = with_status(&found, SampleStatus::Outlier);
    assert_eq!(outliers, ["01", "04", "05", "11", "12", "15", "18"]);
    assert!(
        found.warnings[0].contains("7 samples disagree"),
        "{:?}",
        found.warnings
    );
    let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
    assert!(mm < 1.0 && deg < 0.1, "{mm} mm, {deg} degrees");
}

#[test]
fn intrinsics_are_estimated_with_the_hand_eye_transform() {
    let scene = Scene::new(Setup::EyeInHand, 20, 0.4, 7);
    let mut input = scene.input(scene.views(&Errors::corners(0.1), 2));
    let truth = intrinsics();
    let wrong = truth
        .params()
        .into_iter()
        .enumerate()
        .map(|(ix, param)| if ix < 4 { param * 1.01 } else { param });
    input.intrinsics = Some(truth.with_params(&wrong.collect::<Vec<f64>>()));
    input.options.estimate_intrinsics = true;
    let found = calibrate_hand_eye(&input).unwrap();
    let (estimated, sigma) = found.intrinsics.as_ref().unwrap();
    for (axis, sigma_px) in sigma.iter().take(2).enumerate() {
        let off_px = estimated.focal_px[axis] - truth.focal_px[axis];
        assert!(
            off_px.abs() < 4.0 * sigma_px && *sigma_px < 1.0,
            "focal length off by {off_px} +- {sigma_px} px"
        );
    }
    let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
    assert!(mm < 0.5 && deg < 0.1, "{mm} mm, {deg} degrees");
    // With the wrong intrinsics held fixed, the report contains a warning.
    input.options.estimate_intrinsics = false;
    let fixed = calibrate_hand_eye(&input).unwrap();
    assert!(
        fixed
            .warnings
            .iter()
            .any(|warning| warning.contains("intrinsics")),
        "{:?}",
        fixed.warnings
    );
    assert!(
        squared_error(&fixed, &scene.parent_from_camera) < 12.59,
        "the uncertainty covers wrong intrinsics"
    );
}

#[test]
fn mistakes_are_named() {
    let scene = Scene::new(Setup::EyeInHand, 10, 0.4, 8);
    let errors = Errors::boards(1e-3);
    let with = |change: &dyn Fn(&mut HandEyeSample)| {
        let mut samples = scene.poses(&errors, 3);
        samples.iter_mut().for_each(change);
        refusal(&scene.input(samples)).to_string()
    };
    let board = |sample: &mut HandEyeSample, change: &dyn Fn(Transform) -> Transform| {
        let BoardObservation::Pose(pose) = &mut sample.board else {
            unreachable!("the samples have poses")
        };
        *pose = change(*pose);
    };
    let scaled = |scale: f64| {
        move |pose: Transform| {
            Transform::from_parts((pose.translation.vector * scale).into(), pose.rotation)
        }
    };
    let robot_mm =
        with(&|sample| sample.base_from_flange = scaled(1000.0)(sample.base_from_flange));
    assert!(
        robot_mm.contains("base_from_flange") && robot_mm.contains("millimeters"),
        "{robot_mm}"
    );
    let board_mm = with(&|sample| board(sample, &scaled(1000.0)));
    assert!(
        board_mm.contains("the board") && board_mm.contains("millimeters"),
        "{board_mm}"
    );
    let robot_inverted =
        with(&|sample| sample.base_from_flange = sample.base_from_flange.inverse());
    assert!(
        robot_inverted.contains("base_from_flange is inverted"),
        "{robot_inverted}"
    );
    let board_inverted = with(&|sample| board(sample, &|pose| pose.inverse()));
    assert!(
        board_inverted.contains("camera_from_board is inverted"),
        "{board_inverted}"
    );
    let both_inverted = with(&|sample| {
        sample.base_from_flange = sample.base_from_flange.inverse();
        board(sample, &|pose| pose.inverse());
    });
    assert!(
        both_inverted.contains("behind the camera"),
        "{both_inverted}"
    );
    // Poses of a chessboard in images that are flipped along x.
    let mirrored = with(&|sample| {
        board(sample, &|pose| {
            let [x, y, z]: [f64; 3] = pose.translation.vector.into();
            let axis = pose.rotation.scaled_axis();
            Transform::new(
                Vector3::new(-x, y, z),
                Vector3::new(axis.x, -axis.y, -axis.z),
            )
        });
    });
    assert!(mirrored.contains("mirrored"), "{mirrored}");
    let squares = with(&|sample| board(sample, &scaled(1.2)));
    assert!(squares.contains("size of the squares"), "{squares}");
}

#[test]
fn lists_that_are_off_by_one_are_named() {
    let scene = Scene::new(Setup::EyeInHand, 12, 0.4, 8);
    let errors = Errors::boards(1e-3);
    for (shift, word) in [(1, "next"), (11, "previous")] {
        let mut samples = scene.poses(&errors, 3);
        let poses = robot_poses(&samples);
        for (ix, sample) in samples.iter_mut().enumerate() {
            // The pose of sample `ix` moves to sample `ix - shift`, so its image is found `shift`
            // later.
            sample.base_from_flange = poses[(ix + 12 - shift) % 12];
        }
        let text = refusal(&scene.input(samples)).to_string();
        assert!(text.contains("off by one") && text.contains(word), "{text}");
    }
    // Neither a shift nor the size of the squares explains poses in random order.
    let mut samples = scene.poses(&errors, 3);
    let poses = robot_poses(&samples);
    for (ix, sample) in samples.iter_mut().enumerate() {
        sample.base_from_flange = poses[(5 * ix + 3) % 12];
    }
    let text = refusal(&scene.input(samples)).to_string();
    assert!(
        !text.contains("off by one") && !text.contains("size of the squares"),
        "{text}"
    );
}

#[test]
fn many_samples_are_held_out_in_groups() {
    const N: usize = 4 * MAX_FOLDS;
    let scene = Scene::new(Setup::EyeInHand, N, 0.4, 8);
    let errors = Errors::boards(1e-3);
    let calibration = calibrate_hand_eye(&scene.input(scene.poses(&errors, 3))).unwrap();
    let held_out = calibration.held_out_scatter.unwrap();
    // One sample in 60 hardly changes the result.
    assert!(
        (held_out.mm / calibration.scatter.mm - 1.0).abs() < 0.05,
        "{held_out:?} {:?}",
        calibration.scatter
    );
    assert!(
        held_out.mm > calibration.scatter.mm,
        "held-out samples fit worse"
    );
}

#[test]
fn wrong_principal_point_is_named_in_the_refusal() {
    let scene = Scene::new(Setup::EyeInHand, 15, 0.4, 2);
    let errors = Errors::corners(0.1);
    let mut input = scene.input(scene.views(&errors, 5));
    let mut wrong = intrinsics();
    wrong.principal_px[0] += 60.0;
    input.intrinsics = Some(wrong);
    let text = refusal(&input).to_string();
    assert!(
        text.contains("the principal point moves by (-6")
            || text.contains("the principal point moves by (-5"),
        "{text}"
    );
}

#[test]
fn degenerate_samples_are_refused() {
    let scene = Scene::new(Setup::EyeInHand, 10, 0.4, 9);
    let samples = scene.poses(&Errors::boards(1e-3), 3);
    let two = refusal(&scene.input(samples[..2].to_vec()));
    assert!(
        two.why.contains("2 samples were given; at least 3"),
        "{two}"
    );
    let identical = refusal(&scene.input(vec![samples[0].clone(); 5]));
    assert!(identical.why.contains("hardly rotates"), "{identical}");
    // Rotations about the z axis of the flange only.
    let mut about_z = scene.clone();
    let first = scene.base_from_flange[0];
    about_z.base_from_flange = (0..10)
        .map(|ix| {
            first
                * Transform::new(
                    Vector3::new(0.01 * f64::from(ix % 3), 0.0, 0.0),
                    Vector3::z() * 0.15 * f64::from(ix),
                )
        })
        .collect();
    let z = refusal(&about_z.input(about_z.poses(&Errors::default(), 1)));
    assert!(
        z.why.contains("around the flange's z axis") && z.axis.unwrap()[2].abs() > 0.99,
        "{z}"
    );
    let mut invalid = scene.input(samples);
    invalid.samples[3].base_from_flange.translation.x = f64::NAN;
    assert!(
        matches!(calibrate_hand_eye(&invalid), Err(Error::HandEyeInput { why }) if why.contains("\"03\""))
    );
}

#[test]
fn next_poses_shrink_the_uncertainty() {
    // Rotations about the z axis are ten times as large as rotations about x and y.
    let mut scene = Scene::new(Setup::EyeInHand, 8, 0.15, 10);
    let errors = Errors::robot(0.2, 2e-4);
    let input = scene.input(scene.views(&errors, 3));
    let before = calibrate_hand_eye(&input).unwrap();
    let next = suggest_next_poses(&input, &before, &next_poses(4));
    assert_eq!(next.len(), 4);
    assert!(
        next[0].sigma_frac < 0.9 && next[0].motion.contains("degrees around"),
        "{:?}",
        next[0]
    );
    scene
        .base_from_flange
        .extend(next.iter().map(|pose| pose.base_from_flange));
    let after = calibrate_hand_eye(&scene.input(scene.views(&errors, 3))).unwrap();
    for axis in 0..3 {
        assert!(
            after.sigma_mm[axis] < 0.8 * before.sigma_mm[axis],
            "{:?}, before {:?}",
            after.sigma_mm,
            before.sigma_mm
        );
    }
}

/// Every combination is either accurate within its stated uncertainty, or refused.
#[test]
fn small_rotations_few_poses_and_wrong_samples_are_accurate_or_refused() {
    let errors = Errors::robot(0.2, 3e-4);
    let (mut n_solved, mut n_refused, mut broken) = (0, 0, Vec::new());
    for (case, spread_deg) in [2.0, 5.0, 15.0, 40.0, 90.0_f64].into_iter().enumerate() {
        for n in [3, 6, 10, 24] {
            for wrong_percent in [0, 20, 40] {
                let seed = 1000 * case as u64 + n as u64;
                let scene = Scene::new(Setup::EyeInHand, n, spread_deg.to_radians(), seed);
                let mut samples = scene.views(&errors, seed);
                let mut random = Random::new(seed);
                for sample in samples.iter_mut().take(n * wrong_percent / 100) {
                    let wrong = Vector3::new(random.normal(), random.normal(), random.normal());
                    sample.base_from_flange *= Transform::new(wrong * 0.1, wrong * 0.3);
                }
                match calibrate_hand_eye(&scene.input(samples)) {
                    Ok(found) => {
                        n_solved += 1;
                        let squared = squared_error(&found, &scene.parent_from_camera);
                        // One in 10 000 correct results exceeds it.
                        if squared > 28.0 {
                            let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
                            broken.push(format!("{spread_deg} degrees, {n} poses, {wrong_percent} % wrong: {mm:.1} mm, {deg:.2} degrees, {squared:.0}"));
                        }
                    }
                    Err(Error::Refused(_)) => n_refused += 1,
                    Err(error) => panic!("{error}"),
                }
            }
        }
    }
    assert!(
        broken.is_empty(),
        "{n_solved} solved, {n_refused} refused, wrong:\n{}",
        broken.join("\n")
    );
    assert!(n_solved > 30, "{n_solved} solved, {n_refused} refused");
}

#[test]
fn offsets_of_inner_joints_are_found_and_those_of_outer_joints_are_not_observable() {
    const TRUE_OFFSETS_RAD: [f64; 7] = [0.0, 0.004, -0.003, 0.005, 0.002, -0.006, 0.0];
    let chain = Chain::from_urdf(
        include_str!("../../../kinematics/tests/data/panda.urdf"),
        "link0",
        "link8",
    )
    .unwrap();
    let scene = Scene::new(Setup::EyeInHand, 1, 0.3, 1);
    let mut random = Random::new(4);
    let home = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
    let mut samples = Vec::new();
    // The board is in front of the camera at the home configuration.
    let base_from_camera = chain.forward(&home).unwrap() * scene.parent_from_camera;
    let base_from_board = base_from_camera
        * Transform::new(Vector3::new(-0.1, -0.06, 0.5), Vector3::new(0.2, 0.1, 0.0));
    while samples.len() < 25 {
        let joints: Vec<f64> = home
            .iter()
            .map(|joint| joint + 0.35 * random.normal())
            .collect();
        let moved: Vec<f64> = joints
            .iter()
            .zip(TRUE_OFFSETS_RAD)
            .map(|(joint, offset)| joint + offset)
            .collect();
        let camera_from_board =
            (chain.forward(&moved).unwrap() * scene.parent_from_camera).inverse() * base_from_board;
        let view = view(&camera_from_board, 0.1, &mut random);
        let is_visible = view.points.len() == board_points().len()
            && view
                .points
                .iter()
                .all(|point| intrinsics().contains(point.pixel));
        if is_visible {
            let board = BoardObservation::View(view);
            let base_from_flange = chain.forward(&joints).unwrap();
            samples.push(HandEyeSample {
                name: format!("{}", samples.len()),
                base_from_flange,
                board,
                joints: Some(joints),
            });
        }
    }
    let mut input = scene.input(samples);
    input.chain = Some(&chain);
    input.options.estimate_joint_offsets = true;
    let found = calibrate_hand_eye(&input).unwrap();
    let outer = [0, 6].map(|ix| found.joint_offsets[ix].estimate);
    assert_eq!(outer, [None, None]);
    for (ix, truth) in TRUE_OFFSETS_RAD.iter().enumerate().take(6).skip(1) {
        let [offset, sigma] = found.joint_offsets[ix].estimate.unwrap();
        let off_deg = (offset - truth).to_degrees();
        assert!(
            off_deg.abs() < 0.02 && off_deg.to_radians().abs() < 4.0 * sigma,
            "joint {ix}: off by {off_deg} degrees, sigma {sigma}"
        );
    }
    let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
    assert!(mm < 0.3, "{mm} mm, {deg} degrees");
    let next = suggest_next_poses(&input, &found, &next_poses(2));
    assert!(next.iter().all(|pose| pose.joints.is_some()) && next.len() == 2);
}

/// Poses of the test data. `None` if they are absent.
fn recorded() -> Option<Vec<HandEyeSample>> {
    let folder = test_support::data_folder("handeye/franka_9c23a7d/data/captured-data")?;
    let entries = folder.read_dir().unwrap();
    let mut folders: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    folders.sort();
    fn numbers(value: &serde_json::Value) -> Vec<f64> {
        value.as_array().map_or_else(
            || vec![value.as_f64().unwrap()],
            |values| values.iter().flat_map(numbers).collect(),
        )
    }
    let sample = |folder: &std::path::PathBuf| {
        let text = std::fs::read_to_string(folder.join("data.json")).unwrap();
        let value: serde_json::Value = serde_json::from_str(&text).unwrap();
        let [rotation, translation] = ["T_cam_target_rvec", "T_cam_target_tvec"]
            .map(|key| Vector3::from_vec(numbers(&value[key])));
        HandEyeSample {
            name: folder.file_name().unwrap().to_string_lossy().into_owned(),
            base_from_flange: transform::from_rows(&numbers(&value["O_T_EE"]).try_into().unwrap())
                .unwrap(),
            board: BoardObservation::Pose(Transform::new(translation, rotation)),
            joints: None,
        }
    };
    Some(folders.iter().map(sample).collect())
}

#[test]
fn recorded_board_scatters_less_than_with_closed_forms() {
    // Leave-one-out scatter of the seven solvers of OpenCV 4: 3.59 to 6.36 mm, 0.604 to 0.622
    // degrees.
    const OPENCV: Scatter = Scatter {
        mm: 3.59,
        deg: 0.604,
    };
    let Some(samples) = recorded() else { return };
    let scene = Scene::new(Setup::EyeInHand, 1, 0.3, 1);
    let found = calibrate_hand_eye(&scene.input(samples)).unwrap();
    let held_out = found.held_out_scatter.unwrap();
    assert!(
        held_out.mm < OPENCV.mm && held_out.deg < OPENCV.deg,
        "{held_out:?}"
    );
}

#[test]
fn identical_samples_count_once() {
    let scene = Scene::new(Setup::EyeInHand, 6, 0.4, 8);
    let robot = Errors {
        corner_px: 0.2,
        board_rad: 2e-3,
        board_m: 1e-3,
        robot_rad: 5e-4,
        robot_m: 5e-4,
    };
    for samples in [scene.views(&robot, 3), scene.poses(&robot, 3)] {
        let once = calibrate_hand_eye(&scene.input(samples.clone())).unwrap();
        let often =
            calibrate_hand_eye(&scene.input([samples.clone(), samples.clone(), samples].concat()))
                .unwrap();
        assert_eq!(once.sigma_mm, often.sigma_mm);
        assert_eq!(once.parent_from_camera, often.parent_from_camera);
        assert_eq!(once.held_out_scatter, often.held_out_scatter);
        assert_eq!(with_status(&often, SampleStatus::Repeated).len(), 12);
        assert!(
            often
                .warnings
                .iter()
                .any(|warning| warning.starts_with("12 samples are identical")),
            "{often:?}"
        );
    }
}

#[test]
fn several_images_at_one_stop_do_not_count_as_independent() {
    let robot = Errors::robot(0.05, 1e-3);
    let n_covered = (0..N_RUNS).filter(|seed| {
        let scene = Scene::new(Setup::EyeInHand, 8, 0.4, 200 + seed);
        let stops = scene.views(&robot, *seed);
        let mut random = Random::new(*seed);
        let mut samples = Vec::new();
        for stop in &stops {
            // The robot's error is the same for all images of the stop. Each image has its own
            // noise.
            for ix in 0..5 {
                let mut sample = HandEyeSample {
                    name: format!("{} {ix}", stop.name),
                    ..stop.clone()
                };
                if let BoardObservation::View(view) = &mut sample.board {
                    let pixels = view.points.iter_mut().flat_map(|point| &mut point.pixel);
                    pixels.for_each(|value| *value += 0.1 * random.normal());
                }
                samples.push(sample);
            }
        }
        let found = calibrate_hand_eye(&scene.input(samples)).unwrap();
        assert!(
            found
                .warnings
                .iter()
                .any(|warning| warning.starts_with("40 samples were taken at 8 different"))
        );
        squared_error(&found, &scene.parent_from_camera) < 12.59
    });
    let n_covered = n_covered.count() as u64;
    assert!(
        (24..=N_RUNS).contains(&n_covered),
        "{n_covered} of {N_RUNS}"
    );
}

#[test]
fn reversed_lists_and_units_are_named() {
    let scene = Scene::new(Setup::EyeInHand, 12, 0.4, 9);
    let samples = scene.poses(&Errors::boards(1e-3), 3);
    let mut reversed = samples.clone();
    for (sample, other) in reversed.iter_mut().zip(samples.iter().rev()) {
        sample.board = other.board.clone();
    }
    let refused = refusal(&scene.input(reversed));
    assert!(!refused.motion.starts_with("add poses"), "{refused}");
    for (unit, per_m) in [
        ("millimeters", 1000.0),
        ("centimeters", 100.0),
        ("inches", 39.37),
    ] {
        let mut scaled = samples.clone();
        for sample in &mut scaled {
            sample.base_from_flange.translation.vector *= per_m;
        }
        let refused = refusal(&scene.input(scaled));
        assert!(refused.why.contains(unit), "{refused}");
    }
}
