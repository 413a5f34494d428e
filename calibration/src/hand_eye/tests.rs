//! Hand-eye calibration of simulated robots: accuracy, stated uncertainty, ambiguities, mistakes
//! and refusals.

use super::report::squared_error;
use super::scene::{self, Errors, Scene};
use super::*;
use crate::Error;
use kinematics::random::Random;
use nalgebra::Vector3;

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
        let input = scene.input(scene.views(
            &Errors {
                corner_px: 0.1,
                ..Errors::default()
            },
            2,
        ));
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
        let unused = found
            .samples
            .iter()
            .filter(|sample| sample.status != SampleStatus::Used);
        assert_eq!(unused.count(), 0, "{:#?}", found.samples);
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
        scene.views(
            &Errors {
                corner_px: 0.1,
                ..Errors::default()
            },
            seed,
        )
    });
    let robot = Errors {
        corner_px: 0.2,
        robot_rad: 5e-4,
        robot_m: 5e-4,
        ..Errors::default()
    };
    let inexact = n_covered(N_RUNS, |scene, seed| scene.views(&robot, seed));
    let poses = Errors {
        board_rad: 2e-3,
        board_m: 1e-3,
        ..Errors::default()
    };
    let given = n_covered(N_RUNS, |scene, seed| scene.poses(&poses, seed));
    // One in 300 correct tests has fewer.
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
    let mut samples = scene.views(
        &Errors {
            corner_px: 0.2,
            ..Errors::default()
        },
        2,
    );
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
    let symmetries = [scene::half_turn()];
    let mut input = scene.input(samples);
    input.board_symmetries = &symmetries;
    let found = calibrate_hand_eye(&input).unwrap();
    let (mm, deg) = errors_of(&found, &scene.parent_from_camera);
    assert!(mm < 0.5 && deg < 0.1, "{mm} mm, {deg} degrees");
    assert!(
        found
            .samples
            .iter()
            .all(|sample| sample.status == SampleStatus::Used)
    );
    // Without the symmetry, the turned boards disagree.
    input.board_symmetries = &[];
    let without = calibrate_hand_eye(&input).unwrap();
    assert_eq!(
        without
            .samples
            .iter()
            .filter(|sample| sample.status == SampleStatus::Outlier)
            .count(),
        4
    );
}

#[test]
fn wrong_samples_are_named() {
    let scene = Scene::new(Setup::EyeInHand, 20, 0.4, 6);
    let mut samples = scene.views(
        &Errors {
            corner_px: 0.2,
            robot_rad: 3e-4,
            robot_m: 3e-4,
            ..Errors::default()
        },
        2,
    );
    let other = Scene::new(Setup::EyeInHand, 20, 0.4, 77);
    for ix in [1, 4, 5, 11, 12, 15, 18] {
        samples[ix].base_from_flange = other.base_from_flange[ix];
    }
    let found = calibrate_hand_eye(&scene.input(samples)).unwrap();
    let outliers: Vec<&str> = found
        .samples
        .iter()
        .filter(|sample| sample.status == SampleStatus::Outlier)
        .map(|sample| sample.name.as_str())
        .collect();
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
    let mut input = scene.input(scene.views(
        &Errors {
            corner_px: 0.1,
            ..Errors::default()
        },
        2,
    ));
    let truth = scene::intrinsics();
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
    let errors = Errors {
        board_rad: 1e-3,
        board_m: 5e-4,
        ..Errors::default()
    };
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
    let errors = Errors {
        board_rad: 1e-3,
        board_m: 5e-4,
        ..Errors::default()
    };
    for (shift, word) in [(1, "next"), (11, "previous")] {
        let mut samples = scene.poses(&errors, 3);
        let poses: Vec<Transform> = samples
            .iter()
            .map(|sample| sample.base_from_flange)
            .collect();
        for (ix, sample) in samples.iter_mut().enumerate() {
            // The pose of sample `ix` moves to sample `ix - shift`, so its image is found `shift`
            // later.
            sample.base_from_flange = poses[(ix + 12 - shift) % 12];
        }
        let text = refusal(&scene.input(samples)).to_string();
        assert!(text.contains("off by one") && text.contains(word), "{text}");
    }
    // Poses in random order are not explained by a shift, nor by the size of the squares.
    let mut samples = scene.poses(&errors, 3);
    let poses: Vec<Transform> = samples
        .iter()
        .map(|sample| sample.base_from_flange)
        .collect();
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
    let errors = Errors {
        board_rad: 1e-3,
        board_m: 5e-4,
        ..Errors::default()
    };
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
    let errors = Errors {
        corner_px: 0.1,
        ..Errors::default()
    };
    let mut input = scene.input(scene.views(&errors, 5));
    let mut wrong = scene::intrinsics();
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
    let samples = scene.poses(
        &Errors {
            board_rad: 1e-3,
            board_m: 5e-4,
            ..Errors::default()
        },
        3,
    );
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
    // Rotations about the z axis are ten times those about x and y.
    let mut scene = Scene::new(Setup::EyeInHand, 8, 0.15, 10);
    let errors = Errors {
        corner_px: 0.2,
        robot_rad: 2e-4,
        robot_m: 2e-4,
        ..Errors::default()
    };
    let input = scene.input(scene.views(&errors, 3));
    let before = calibrate_hand_eye(&input).unwrap();
    let options = NextPoseOptions {
        n_poses: 4,
        center_in_board: Vector3::new(0.1, 0.0625, 0.0),
        radius_m: 0.12,
        max_tilt_rad: 0.9,
        reach: None,
        seed: 1,
    };
    let next = suggest_next_poses(&input, &before, &options);
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

/// Every combination is accurate within its stated uncertainty, or refused.
#[test]
fn small_rotations_few_poses_and_wrong_samples_are_accurate_or_refused() {
    let errors = Errors {
        corner_px: 0.2,
        robot_rad: 3e-4,
        robot_m: 3e-4,
        ..Errors::default()
    };
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
        let view = scene::view(&camera_from_board, 0.1, &mut random);
        let is_visible = view.points.len() == scene::board_points().len()
            && view
                .points
                .iter()
                .all(|point| scene::intrinsics().contains(point.pixel));
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
    assert_eq!(
        (
            found.joint_offsets[0].estimate,
            found.joint_offsets[6].estimate
        ),
        (None, None)
    );
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
    let next = suggest_next_poses(
        &input,
        &found,
        &NextPoseOptions {
            n_poses: 2,
            center_in_board: Vector3::new(0.1, 0.0625, 0.0),
            radius_m: 0.12,
            max_tilt_rad: 0.9,
            reach: None,
            seed: 1,
        },
    );
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
        let repeated = often
            .samples
            .iter()
            .filter(|sample| sample.status == SampleStatus::Repeated);
        assert_eq!(repeated.count(), 12);
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
    let robot = Errors {
        corner_px: 0.05,
        robot_rad: 1e-3,
        robot_m: 1e-3,
        ..Errors::default()
    };
    let n_covered = (0..N_RUNS).filter(|seed| {
        let scene = Scene::new(Setup::EyeInHand, 8, 0.4, 200 + seed);
        let stops = scene.views(&robot, *seed);
        let mut random = Random::new(*seed);
        let mut samples = Vec::new();
        for stop in &stops {
            // The robot's error is that of the stop; each image has its own noise.
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
    let samples = scene.poses(
        &Errors {
            board_rad: 1e-3,
            board_m: 5e-4,
            ..Errors::default()
        },
        3,
    );
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
