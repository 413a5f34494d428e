//! `fieldrig calibrate intrinsics` and `hand-eye` from a simulated scan of a printed target,
//! against the truth.
#![cfg(feature = "sim")]

use crate::command::{fieldrig, json_of, stderr};
use kinematics::{Transform, transform};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde_json::Value;
use std::path::Path;

const TARGET: &str = "charuco:5x7:24mm:18mm:5X5_100";

/// Limit of the position error, millimeters.
const MAX_MM: f64 = 0.2;
/// Limit of the rotation error, degrees.
const MAX_DEG: f64 = 0.03;
/// The same with a lens from the same few images, whose principal point is less certain.
const MAX_DEG_WITH_LENS: f64 = 0.06;

fn numbers(value: &Value) -> Vec<f64> {
    let inner = |values: &Vec<Value>| values.iter().flat_map(numbers).collect();
    value
        .as_array()
        .map_or_else(|| value.as_f64().into_iter().collect(), inner)
}

/// `rigs/calibration-board.toml` with changed tables `[sim]` and `[camera.wrist]`.
fn write_rig(folder: &Path, file: &str, change: impl FnOnce(&mut toml::Table)) {
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let text =
        std::fs::read_to_string(rigs.join("calibration-board.toml")).expect("a bundled rig file");
    let mut rig: toml::Table = text.parse().expect("TOML");
    rig["arm"]["urdf"] = rigs.join("robots/panda.urdf").display().to_string().into();
    change(&mut rig);
    std::fs::write(folder.join(file), rig.to_string()).expect("the disk has space");
}

fn true_pose() -> Transform {
    let rotation = Quaternion::new(
        0.6408563820557885,
        0.29883623873011983,
        0.29883623873011983,
        0.6408563820557885,
    );
    Transform::from_parts(
        Vector3::new(0.06, 0.0, 0.045).into(),
        UnitQuaternion::from_quaternion(rotation),
    )
}

#[test]
fn lens_and_hand_eye_of_a_moving_arm_are_found_from_a_printed_target() {
    const MAX_SIGMAS: f64 = 4.0;
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_rig(folder, "rig.toml", |rig| {
        let sim = rig["sim"].as_table_mut().expect("a table");
        sim.insert("duration_secs".into(), 24.5.into());
        sim.insert("lockstep".into(), true.into());
    });
    let output = fieldrig(
        folder,
        &["record", "rig.toml", "--sim", "--out", "scan.mcap"],
    );
    assert!(output.status.success(), "{}", stderr(&output));
    let files = ["--write-rig", "calibrated.toml", "--report", "lens.html"];
    let args = [
        "calibrate",
        "intrinsics",
        "scan.mcap",
        "--target",
        TARGET,
        "--json",
    ];
    let output = fieldrig(folder, &[&args[..], &files].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(is_report_with_photo(folder, "lens.html"));
    let lens = json_of(&output);
    for (truth, (key, axis), name) in [
        (614.6, ("focal_px", 0), "fx"),
        (614.2, ("focal_px", 1), "fy"),
        (323.7, ("principal_px", 0), "cx"),
        (236.4, ("principal_px", 1), "cy"),
    ] {
        let error = lens[key][axis].as_f64().expect("a number") - truth;
        let sigma = lens["sigma"][name].as_f64().expect("a number");
        assert!(
            error.abs() < MAX_SIGMAS * sigma && sigma < 0.5,
            "{name}: off by {error} px, stated {sigma} px"
        );
    }

    // The test calibrates from the recording and from the simulated devices. Only the second result
    // is written.
    let files = ["--report", "hand-eye.html", "--write-rig", "result.toml"];
    for input in [
        &["scan.mcap", "--rig", "calibrated.toml"][..],
        &["calibrated.toml", "--sim", "--seconds", "24.5"],
    ] {
        let args = [
            &["calibrate", "hand-eye"],
            input,
            &["--target", TARGET, "--json"],
            &files,
        ]
        .concat();
        let output = fieldrig(folder, &args);
        assert!(output.status.success(), "{input:?}: {}", stderr(&output));
        assert!(is_report_with_photo(folder, "hand-eye.html"), "{input:?}");
        check_pose(&json_of(&output), MAX_MM, MAX_DEG);
        // The program prints guidance for devices, but not for recordings.
        let log = stderr(&output);
        let is_guided = log.contains("0 poses with the target")
            && log.contains("more poses, rotated by 20 degrees");
        assert_eq!(is_guided, input.contains(&"--sim"), "{log}");
    }
    let text = std::fs::read_to_string(folder.join("result.toml")).expect("a rig file");
    let rig: toml::Table = text.parse().expect("TOML");
    let camera = &rig["camera"]["wrist"];
    let value =
        |key: &str, list: &str, ix: usize| camera[key][list][ix].as_float().expect("a number");
    let (focal_px, x_m) = (
        value("intrinsics", "focal_px", 0),
        value("parent_from_camera", "xyz_m", 0),
    );
    assert!(
        (focal_px - 614.6).abs() < 1.0 && (x_m - 0.06).abs() < 2e-4,
        "{text}"
    );
    assert!(folder.join("result.toml.old").exists());
}

/// A rig file without lens and without extrinsics becomes complete, with no key written by hand.
#[test]
fn missing_lens_and_extrinsics_are_found_one_after_the_other() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_rig(folder, "rig.toml", |rig| {
        let camera = rig["camera"]["wrist"].as_table_mut().expect("a table");
        camera.insert("driver".into(), "v4l2".into());
        camera.remove("intrinsics").expect("it was there");
        camera.remove("parent_from_camera").expect("it was there");
        let sim = rig["sim"].as_table_mut().expect("a table");
        sim.insert("duration_secs".into(), 24.5.into());
        sim.insert("lockstep".into(), true.into());
    });
    let calibrate = |what: &str, input: &str, output: &str| {
        let args = [
            "calibrate",
            what,
            input,
            "--sim",
            "--seconds",
            "24.5",
            "--target",
            TARGET,
            "--json",
            "--write-rig",
            output,
        ];
        let result = fieldrig(folder, &args);
        assert!(result.status.success(), "{what}: {}", stderr(&result));
        result
    };
    let missing = |rig: &str| {
        let run = fieldrig(folder, &["run", rig]);
        assert!(!run.status.success());
        let log = stderr(&run);
        ["intrinsics", "parent_from_camera"]
            .map(|key| log.contains(&format!("camera.wrist.{key} is missing")))
    };
    assert_eq!(missing("rig.toml"), [true, true]);
    let lens = json_of(&calibrate("intrinsics", "rig.toml", "lens.toml"));
    let error_px = lens["focal_px"][0].as_f64().expect("a number") - 614.6;
    let sigma_px = lens["sigma"]["fx"].as_f64().expect("a number");
    assert!(
        error_px.abs() < 4.0 * sigma_px && sigma_px < 1.5,
        "off by {error_px} px, stated {sigma_px} px"
    );
    assert_eq!(missing("lens.toml"), [false, true]);
    let pose = calibrate("hand-eye", "lens.toml", "rig-calibrated.toml");
    // The scan is planned with the assumed pose of the camera, so that it sees the target less well.
    check_pose(&json_of(&pose), 1.0, 0.3);
    assert_eq!(missing("rig-calibrated.toml"), [false, false]);
}

/// Whether a report contains at least one image.
fn is_report_with_photo(folder: &Path, file: &str) -> bool {
    std::fs::read_to_string(folder.join(file))
        .expect("a report")
        .contains("data:image/jpeg")
}

fn check_pose(result: &Value, max_mm: f64, max_deg: f64) {
    const MAX_SIGMAS: f64 = 4.0;
    let found = numbers(&result["flange_from_camera"])
        .try_into()
        .expect("16 numbers");
    let error = true_pose().inverse() * transform::from_rows(&found).expect("a rigid transform");
    let errors_mm = error.translation.vector * 1e3;
    let errors_deg = error.rotation.scaled_axis().map(f64::to_degrees);
    assert!(
        errors_mm.norm() < max_mm && errors_deg.norm() < max_deg,
        "{errors_mm} mm, {errors_deg} degrees"
    );
    for (errors, key) in [(errors_mm, "sigma_mm"), (errors_deg, "sigma_deg")] {
        for (axis, sigma) in numbers(&result[key]).into_iter().enumerate() {
            let error = errors[axis].abs();
            assert!(
                error < MAX_SIGMAS * sigma,
                "{key}: axis {axis} is off by {error}, stated {sigma}"
            );
        }
    }
}

/// The lens in the rig file is wrong by 2 %, the pose of the camera by 3 degrees and 20 mm.
#[test]
fn arm_moves_around_a_target_until_its_camera_is_calibrated() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_rig(folder, "rig.toml", |_| ());
    let moves = [
        "calibrate",
        "hand-eye",
        "rig.toml",
        "--sim",
        "--move",
        "--target",
        TARGET,
        "--with-intrinsics",
    ];
    let files = [
        "--report",
        "moved.html",
        "--write-rig",
        "moved.toml",
        "--json",
    ];
    let output = fieldrig(folder, &[&moves[..], &files].concat());
    let log = stderr(&output);
    assert!(output.status.success(), "{log}");
    let result = json_of(&output);
    check_pose(&result, MAX_MM, MAX_DEG_WITH_LENS);
    let n_samples = result["samples"].as_array().map_or(0, Vec::len);
    assert!((10..=20).contains(&n_samples), "{n_samples} poses: {log}");
    assert!(
        log.contains("finished: the standard deviations are at most"),
        "{log}"
    );
    assert!(log.contains("returning to the start"), "{log}");
    // The limit is half the distance to the target, as it was before the first motion.
    let [distance, motion] = [
        "; the flange moves at most 0.",
        "moving to pose 2: orbit the target by 15 degrees",
    ]
    .map(|text| {
        log.find(text)
            .unwrap_or_else(|| panic!("{text:?} is not in {log}"))
    });
    assert!(distance < motion, "{log}");
    assert!(log.contains("relative to pose"), "{log}");
    assert!(is_report_with_photo(folder, "moved.html"));
    let text = std::fs::read_to_string(folder.join("moved.toml")).expect("a rig file");
    assert!(
        text.contains("[camera.wrist.sim") && !text.contains("lockstep = true"),
        "{text}"
    );
}

#[test]
fn joint_offsets_are_estimated_and_written() {
    const OFFSETS: [f64; 7] = [0.0, 0.01, -0.008, 0.006, -0.01, 0.007, 0.0];
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_rig(folder, "rig.toml", |rig| {
        let truth =
            toml::Table::from_iter([("true_joint_offsets".to_owned(), OFFSETS.to_vec().into())]);
        rig["arm"]
            .as_table_mut()
            .expect("a table")
            .insert("sim".into(), truth.into());
    });
    let args = [
        "calibrate",
        "hand-eye",
        "rig.toml",
        "--sim",
        "--move",
        "--with-intrinsics",
        "--with-joints",
    ];
    let goals = [
        "--max-poses",
        "24",
        "--target",
        TARGET,
        "--json",
        "--write-rig",
        "new.toml",
    ];
    let output = fieldrig(folder, &[&args[..], &goals].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let result = json_of(&output);
    // The motion continues even after the camera is accurate.
    assert!(
        result["samples"].as_array().map_or(0, Vec::len) > 20,
        "{}",
        stderr(&output)
    );
    let text = std::fs::read_to_string(folder.join("new.toml")).expect("a rig file");
    let rig: toml::Table = text.parse().expect("TOML");
    for ix in 1..6 {
        let sigma = result["joint_offsets"][ix]["sigma"]
            .as_f64()
            .expect("an inner joint");
        let written = rig["arm"]["joint_offsets"][ix]
            .as_float()
            .expect("a number");
        let error = (written - OFFSETS[ix]).abs();
        assert!(
            error < 4.0 * sigma && error < 2e-3,
            "joint {ix}: {written}, true {}, sigma {sigma}",
            OFFSETS[ix]
        );
    }
    assert!(
        result["joint_offsets"][0]["offset"].is_null(),
        "the first offset is equivalent to a turn of the board"
    );
    assert_eq!(rig["arm"]["joint_offsets"][0].as_float(), Some(0.0));
}

/// The production driver moves an emulated controller, whose motors move the simulated arm and
/// camera in real time. Only the images and the motors are simulated.
#[cfg(target_os = "linux")]
mod emulated_controller {
    use super::{
        MAX_DEG_WITH_LENS, MAX_MM, TARGET, check_pose, fieldrig, json_of, stderr, write_rig,
    };
    use std::io::{BufRead, BufReader, Read};
    use std::path::Path;
    use std::process::{Command, Stdio};
    use std::time::Duration;

    /// The emulated controller stops the arm if the computer is too busy to answer in time, as a
    /// real one does.
    const BUSY: &str = "communication_constraints_violation";
    const MAX_ATTEMPTS: usize = 3;
    const ARGS: [&str; 8] = [
        "calibrate",
        "hand-eye",
        "rig.toml",
        "--sim",
        "--move",
        "--target",
        TARGET,
        "--with-intrinsics",
    ];

    fn write_emulated_rig(folder: &Path, rate_hz: f64) {
        write_rig(folder, "rig.toml", |rig| {
            let motion = toml::Table::from_iter([("on_loss".to_owned(), "hold".into())]);
            let arm = rig["arm"].as_table_mut().expect("a table");
            arm.insert("motion".to_owned(), motion.into());
            arm["driver"] = "franka".into();
            rig["camera"]["wrist"]["rate_hz"] = rate_hz.into();
            rig["sim"]
                .as_table_mut()
                .expect("a table")
                .insert("emulate_arm".to_owned(), true.into());
        });
    }

    #[test]
    fn arm_moves_until_its_camera_is_calibrated() {
        let folder = tempfile::tempdir().expect("a folder");
        write_emulated_rig(folder.path(), 2.0);
        let output = (1..=MAX_ATTEMPTS).find_map(|attempt| {
            let output = fieldrig(
                folder.path(),
                &[&ARGS[..], &["--goal-mm", "0.3", "--json"]].concat(),
            );
            let is_retried = attempt < MAX_ATTEMPTS && stderr(&output).contains(BUSY);
            (!is_retried).then_some(output)
        });
        let output = output.expect("the last attempt counts");
        let log = stderr(&output);
        assert!(output.status.success(), "{log}");
        assert!(
            log.contains("an emulated Franka controller") && log.contains("returning to the start"),
            "{log}"
        );
        check_pose(&json_of(&output), MAX_MM, MAX_DEG_WITH_LENS);
    }

    #[test]
    fn ctrl_c_while_the_arm_waits_for_an_image_ends_the_motion() {
        let folder = tempfile::tempdir().expect("a folder");
        // The motion to a pose takes three seconds. The image of a pose comes eight seconds after
        // the image of the previous pose.
        write_emulated_rig(folder.path(), 0.125);
        let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .current_dir(folder.path())
            .args(ARGS)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("it is built");
        let mut log = BufReader::new(child.stderr.take().expect("piped"));
        let mut text = String::new();
        while !text.contains("moving to pose 3") {
            assert!(
                log.read_line(&mut text).expect("text") > 0,
                "it ended early: {text}"
            );
        }
        std::thread::sleep(Duration::from_secs(5));
        let interrupt = Command::new("kill")
            .args(["-INT", &child.id().to_string()])
            .status();
        assert!(interrupt.expect("kill runs").success());
        log.read_to_string(&mut text).expect("text");
        child.wait().expect("our own child");
        // Two images do not determine the pose of the camera.
        assert!(
            text.contains("bringing the arm to rest, then calibrating")
                && text.contains("at least 3 are needed"),
            "{text}"
        );
        assert!(
            !text.contains("] pose 3: ") && !text.contains("returning to the start"),
            "{text}"
        );
    }
}

/// Ctrl-C stops the arm; the images so far are used.
#[cfg(unix)]
#[test]
fn interrupted_arm_is_calibrated_with_the_images_so_far() {
    use std::io::{BufRead, BufReader, Read};
    let folder = tempfile::tempdir().expect("a folder");
    write_rig(folder.path(), "rig.toml", |_| ());
    let args = [
        "calibrate",
        "hand-eye",
        "rig.toml",
        "--sim",
        "--move",
        "--target",
        TARGET,
        "--with-intrinsics",
    ];
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .current_dir(folder.path())
        .args(args)
        .args(["--goal-mm", "0.001", "--max-poses", "200", "--json"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("it is built");
    let mut log = BufReader::new(child.stderr.take().expect("piped"));
    let mut text = String::new();
    while !text.contains("moving to pose 12") {
        assert!(
            log.read_line(&mut text).expect("text") > 0,
            "it ended early: {text}"
        );
    }
    let interrupt = std::process::Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(interrupt.expect("kill runs").success());
    log.read_to_string(&mut text).expect("text");
    let output = child.wait_with_output().expect("it ends");
    assert!(output.status.success(), "{text}");
    assert!(
        text.contains("bringing the arm to rest") && !text.contains("returning to the start"),
        "{text}"
    );
    check_pose(&json_of(&output), MAX_MM, MAX_DEG_WITH_LENS);
}

#[test]
fn unusable_scans_are_rejected_with_the_reason() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_rig(folder, "bad.toml", |rig| {
        rig["sim"]["target"]["board"]["spec"] = "charuco:5x7:24:18mm:5X5_100".into()
    });
    write_rig(folder, "rig.toml", |_| ());
    write_rig(folder, "away.toml", |rig| {
        let board = rig["sim"]["target"]["board"]
            .as_table_mut()
            .expect("a table");
        board["world_from_board"]["xyz_m"] = vec![0.709729, 5.0, 0.315054].into();
    });
    let real_arm = |rig: &mut toml::Table| {
        let arm = rig["arm"].as_table_mut().expect("a table");
        arm["driver"] = "franka".into();
        arm.insert("address".into(), "127.0.0.1:1".into());
    };
    let movable = |rig: &mut toml::Table| {
        real_arm(rig);
        let motion = toml::Table::from_iter([("on_loss".to_owned(), "hold".into())]);
        rig["arm"]
            .as_table_mut()
            .expect("a table")
            .insert("motion".into(), motion.into());
    };
    write_rig(folder, "real.toml", real_arm);
    write_rig(folder, "movable.toml", movable);
    for (args, expected) in [
        (
            &["bad.toml", "--sim", "--target", TARGET][..],
            "sim.target.board",
        ),
        (&["rig.toml", "--sim"], "--target is required"),
        (
            &["samples.json", "--with-joints"],
            "--urdf and --tip are needed",
        ),
        (
            &[
                "rig.toml", "--sim", "--target", TARGET, "--urdf", "a.urdf", "--tip", "b",
            ],
            "names the robot description",
        ),
        (
            &["rig.toml", "--sim", "--target", TARGET, "--camera", "front"],
            "it has wrist",
        ),
        (
            &["samples.json", "--sim", "--target", TARGET],
            "--sim, --seconds and the flags of the page (--listen, --share) need a rig file",
        ),
        (
            &["rig.toml", "--sim", "--target", TARGET, "--rig", "rig.toml"],
            "is a rig file, which is used; remove --rig",
        ),
        (
            &[
                "rig.toml",
                "--sim",
                "--target",
                TARGET,
                "--write-rig",
                "absent/rig.toml",
            ],
            "in an existing folder",
        ),
        (
            &["samples.json", "--write-rig", "new.toml"],
            "name the one to change with --rig",
        ),
        (&["samples.json", "--rig", "rig.toml"], "add --write-rig"),
        (
            &["rig.toml", "--sim", "--move"],
            "--target is required with --move",
        ),
        (
            &["samples.json", "--move", "--target", TARGET],
            "samples.json is not one",
        ),
        (
            &["real.toml", "--move", "--enable-motion", "--target", TARGET],
            "no table [arm.motion]",
        ),
        (
            &["movable.toml", "--move", "--target", TARGET],
            "add --enable-motion to confirm",
        ),
        (
            &[
                "movable.toml",
                "--move",
                "--enable-motion",
                "--target",
                TARGET,
            ],
            "must both be real or both be simulated",
        ),
        (
            &[
                "rig.toml",
                "--sim",
                "--move",
                "--seconds",
                "9",
                "--target",
                TARGET,
            ],
            "limit the number of poses with --max-poses",
        ),
        (
            &[
                "rig.toml", "--sim", "--move", "--target", TARGET, "--urdf", "a.urdf", "--tip", "b",
            ],
            "names the robot description",
        ),
        (
            &[
                "rig.toml",
                "--sim",
                "--move",
                "--max-poses",
                "9",
                "--target",
                TARGET,
            ],
            "10..=200",
        ),
        (
            &["rig.toml", "--sim", "--goal-mm", "1", "--target", TARGET],
            "--move",
        ),
        (
            &["away.toml", "--sim", "--move", "--target", TARGET],
            "the target is not visible at the start",
        ),
    ] {
        let output = fieldrig(folder, &[&["calibrate", "hand-eye"], args].concat());
        let printed = stderr(&output);
        let code = output.status.code();
        assert!(
            matches!(code, Some(1 | 2 | 4)) && printed.contains(expected),
            "{args:?}: {code:?} {printed}"
        );
    }
}

/// Two RGB-D cameras on the flange, both wrong by 3 degrees.
#[test]
fn scene_calibration_reports_the_pose_between_two_cameras() {
    const MAX_MM: f64 = 0.5;
    const SIDE: [f64; 3] = [-0.064, 0.037, 0.045];
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let wrong_rotation = [
        0.3221026151663075,
        0.295552456206855,
        0.6424378557492378,
        0.6294221575647319,
    ];
    let right_rotation = [
        0.29883623873011983,
        0.29883623873011983,
        0.6408563820557885,
        0.6408563820557885,
    ];
    let camera = |name: &str,
                  given_m: [f64; 3],
                  given: [f64; 4],
                  true_m: [f64; 3],
                  truth: [f64; 4]| {
        format!(
            "[camera.{name}]\ndriver = \"sim\"\nsize_px = [160, 120]\nrate_hz = 8\nexposure_micros = 1000\n\
             readout_micros = 15000\nparent = \"flange\"\n\
             parent_from_camera = {{ xyz_m = {given_m:?}, quat_xyzw = {given:?} }}\n\
             intrinsics = {{ focal_px = [153.65, 153.55], principal_px = [80.925, 59.1], lens = \"pinhole\" }}\n\
             [camera.{name}.depth]\n[camera.{name}.sim.truth]\n\
             parent_from_camera = {{ xyz_m = {true_m:?}, quat_xyzw = {truth:?} }}\n"
        )
    };
    let urdf = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/robots/panda.urdf");
    let rig = [
        format!(
            "[arm]\ndriver = \"sim\"\nurdf = {:?}\nflange_link = \"panda_link8\"\n",
            urdf.display().to_string()
        ),
        camera(
            "wrist",
            [0.064, 0.002, 0.046],
            wrong_rotation,
            [0.06, 0.0, 0.045],
            right_rotation,
        ),
        camera(
            "side",
            [-0.06, 0.04, 0.045],
            right_rotation,
            SIDE,
            wrong_rotation,
        ),
    ];
    std::fs::write(folder.join("rig.toml"), rig.concat()).expect("the disk has space");
    let args = [
        "calibrate",
        "scene",
        "rig.toml",
        "--sim",
        "--seconds",
        "10",
        "--json",
        "--report",
        "scene.html",
    ];
    let output = fieldrig(folder, &args);
    assert!(output.status.success(), "{}", stderr(&output));
    let page = std::fs::read_to_string(folder.join("scene.html")).expect("a report");
    for words in [
        "Relative camera poses",
        "wrist in side",
        "side in its parent",
    ] {
        assert!(page.contains(words), "{words} is missing");
    }
    let cameras = &json_of(&output)["cameras"];
    assert!(cameras["side"]["relative"].is_null(), "{cameras}");
    let relative = &cameras["wrist"]["relative"];
    assert_eq!(relative["camera"], "side");
    let [x, y, z, w] = wrong_rotation;
    let side = Transform::from_parts(
        Vector3::from(SIDE).into(),
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    );
    let found = numbers(&relative["camera_from_this"])
        .try_into()
        .expect("16 numbers");
    let error = (side.inverse() * true_pose()).inverse()
        * transform::from_rows(&found).expect("a rigid transform");
    let (mm, degrees) = (
        1e3 * error.translation.vector.norm(),
        error.rotation.angle().to_degrees(),
    );
    assert!(mm < MAX_MM && degrees < 0.05, "{mm} mm, {degrees} degrees");
    let errors_mm = error.translation.vector * 1e3;
    let errors_deg = error.rotation.scaled_axis().map(f64::to_degrees);
    for (errors, key) in [(errors_mm, "sigma_mm"), (errors_deg, "sigma_deg")] {
        for (axis, sigma) in numbers(&relative[key]).into_iter().enumerate() {
            assert!(
                errors[axis].abs() < 3.0 * sigma,
                "{key}: axis {axis} is off by {}, stated {sigma}",
                errors[axis]
            );
        }
    }
    for holder in [relative, &cameras["side"], &cameras["wrist"]] {
        for key in ["sigma_mm", "sigma_deg"] {
            let sigmas = numbers(&holder[key]);
            assert!(
                sigmas.len() == 3 && sigmas.iter().all(|sigma| *sigma > 0.0 && *sigma < MAX_MM),
                "{holder}"
            );
        }
    }
}
