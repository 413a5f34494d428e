//! Inputs that are like those in public bug reports, and hostile inputs, with the expected results.
//! The inputs are in `cases` and `hostile` in the folder of the test data. Without them, these
//! tests are skipped.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Split and stamp of an image, and its pose.
type NamedPose = (String, Vec<f64>);

/// A copy of a case, in which outputs may be written.
struct Case {
    folder: tempfile::TempDir,
}

impl Case {
    fn open(name: &str) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        tree_copy(&test_support::data_folder(name)?, folder.path());
        Some(Self { folder })
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Exit code and everything that is printed.
    fn run(&self, args: &[&str]) -> (Option<i32>, String) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
        let output = command
            .args(args)
            .current_dir(self.folder.path())
            .output()
            .unwrap();
        (
            output.status.code(),
            String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned(),
        )
    }

    /// Trains for three steps; returns the exit code, what is printed, and the images with their
    /// poses by name.
    fn train(&self, data: &str, out: &str) -> (Option<i32>, String, Vec<NamedPose>) {
        let (code, printed) = self.run(&[
            "train",
            data,
            "--steps",
            "3",
            "--max-splats",
            "200",
            "--out",
            out,
        ]);
        let cameras = std::fs::read_to_string(self.at(out).join("cameras.json"))
            .unwrap_or_else(|_| "{}".to_owned());
        let cameras: Value = serde_json::from_str(&cameras).unwrap();
        let pose = |camera: &Value| -> Vec<f64> {
            camera["world_from_camera"]
                .as_array()
                .unwrap()
                .iter()
                .map(|number| number.as_f64().unwrap())
                .collect()
        };
        let camera = |camera: &Value| {
            (
                format!(
                    "{} {}",
                    camera["split"].as_str().unwrap(),
                    camera["stamp_nanos"]
                ),
                pose(camera),
            )
        };
        let cameras = cameras["cameras"]
            .as_array()
            .map(|cameras| cameras.iter().map(camera).collect());
        (code, printed, cameras.unwrap_or_default())
    }
}

/// Copies a folder whose files may be read-only.
fn tree_copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        match path.is_dir() {
            true => tree_copy(&path, &target),
            false => std::fs::write(target, std::fs::read(&path).unwrap()).unwrap(),
        }
    }
}

fn max_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

#[test]
fn half_written_urdf() {
    let Some(case) = Case::open("cases/urdf_half_written") else {
        return;
    };
    let fk = |file: &str| case.run(&["fk", file, "--tip", "c", "--joints", "q.json"]);
    let poses = |printed: &str| {
        printed
            .lines()
            .find(|line| line.starts_with('{'))
            .map(str::to_owned)
    };
    let expected = poses(&fk("base.urdf").1).unwrap();
    for (file, warning) in [
        ("inertia_garbage.urdf", r#"line 1: the inertia of link "b""#),
        (
            "inertial_no_mass.urdf",
            r#"line 1: the inertia of link "b""#,
        ),
        ("limit_no_velocity.urdf", ""),
        (
            "limit_swapped.urdf",
            r#"joint "j1": lower of <limit> is 1, above upper, which is -1"#,
        ),
        ("material_no_name.urdf", ""),
        ("texture_no_filename.urdf", r#"a texture of link "b""#),
    ] {
        let (code, printed) = fk(file);
        assert_eq!(
            (code, poses(&printed).as_ref()),
            (Some(0), Some(&expected)),
            "{file}: {printed}"
        );
        assert!(printed.contains(warning), "{file}: {printed}");
    }
    for file in ["xacro_left.urdf", "comma_xyz.urdf"] {
        let (code, printed) = fk(file);
        assert!(
            code == Some(1) && printed.contains(r#"urdf: line 1: joint "j2": xyz of <origin> is"#),
            "{printed}"
        );
    }
}

#[test]
fn hostile_urdf() {
    let Some(case) = Case::open("hostile/urdf-mimic-5000") else {
        return;
    };
    std::fs::write(
        case.at("jm.json"),
        r#"{"joint_names": ["j0"], "configurations": [[0.25]]}"#,
    )
    .unwrap();
    let (code, printed) = case.run(&["fk", "--tip", "l5000", "--joints", "jm.json", "u.urdf"]);
    assert!(
        code == Some(0) && printed.contains("\"poses\""),
        "{printed}"
    );
    let deep = format!(
        "<robot name=\"r\">{}{}<link name=\"l0\"/></robot>",
        "<a>".repeat(20_000),
        "</a>".repeat(20_000)
    );
    std::fs::write(case.at("deep.urdf"), deep).unwrap();
    std::fs::write(
        case.at("j.json"),
        r#"{"joint_names": [], "configurations": [[]]}"#,
    )
    .unwrap();
    let (code, printed) = case.run(&["fk", "--tip", "l0", "--joints", "j.json", "deep.urdf"]);
    assert_eq!(code, Some(0), "{printed}");
}

#[test]
fn camera_paths_of_the_viewer() {
    let Some(case) = Case::open("cases") else {
        return;
    };
    let render = |path: &str, extra: &[&str], out: &str| {
        let path = format!("camera_path_float_size/{path}");
        let words = [
            "render",
            "splats_headers/plain.ply",
            "--camera-path",
            &path,
            "--out",
            out,
        ];
        case.run(&[&words, extra].concat())
    };
    let picture = |out: &str| std::fs::read(case.at(out).join("00000.png")).unwrap();
    for (file, out) in [
        ("int.json", "int"),
        ("float.json", "float"),
        ("crop.json", "crop"),
    ] {
        let (code, printed) = render(file, &[], out);
        assert_eq!(code, Some(0), "{printed}");
        assert_eq!(
            printed.contains("for \"crop\", use --crop"),
            file == "crop.json",
            "{printed}"
        );
        assert_eq!(picture(out), picture("int"));
    }
    let (code, printed) = render("equirect.json", &[], "none");
    assert!(
        code == Some(2) && printed.contains("add --equirect"),
        "{printed}"
    );
    let (code, printed) = render("equirect.json", &["--equirect"], "panorama");
    assert_eq!(code, Some(0), "{printed}");
    assert!(picture("panorama") != picture("int"));
}

#[test]
fn splat_files_of_other_programs() {
    let Some(case) = Case::open("cases") else {
        return;
    };
    let render = |file: &str, out: &str| {
        let words = [
            "render",
            file,
            "--camera-path",
            "camera_path_float_size/int.json",
            "--out",
            out,
        ];
        case.run(&words)
    };
    let picture = |out: &str| {
        image::open(case.at(out).join("00000.png"))
            .unwrap()
            .into_rgb8()
    };
    let names = [
        "plain",
        "crlf",
        "faces_after",
        "ascii",
        "big_endian",
        "rgb_mode",
        "2dgs",
    ];
    for name in names {
        let (code, printed) = render(&format!("splats_headers/{name}.ply"), name);
        assert_eq!(code, Some(0), "{name}: {printed}");
    }
    for name in &names[1..5] {
        assert!(picture(name) == picture("plain"), "{name}");
    }
    let covered = |out: &str| {
        let picture = picture(out);
        let background = *picture.get_pixel(0, 0);
        picture
            .pixels()
            .filter(|pixel| **pixel != background)
            .count()
    };
    assert!(covered("rgb_mode") > 10 && covered("2dgs") > 10);
    let (code, printed) = render("splats_headers/points3D.ply", "points");
    assert!(
        code == Some(1) && printed.contains("it is a point cloud or a mesh"),
        "{printed}"
    );
    let truth = image::open(case.at("splats_antialiased/reference_mip.png"))
        .unwrap()
        .into_rgb8();
    let render_mip = |file: &str, out: &str| {
        let (code, printed) = render(file, out);
        assert_eq!(code, Some(0), "{printed}");
        psnr(&picture(out), &truth)
    };
    for file in ["mip.ply", "mip.spz"] {
        let quality = render_mip(&format!("splats_antialiased/{file}"), file);
        assert!(quality > 35.0, "{file}: {quality} dB");
        // The flag is kept in both formats.
        for format in ["ply", "spz"] {
            let exported = format!("{file}.{format}");
            let (code, printed) = case.run(&[
                "export",
                &format!("splats_antialiased/{file}"),
                "--to",
                format,
                "--out",
                &exported,
            ]);
            assert_eq!(code, Some(0), "{printed}");
            let quality = render_mip(&exported, &format!("from-{exported}"));
            assert!(quality > 35.0, "{exported}: {quality} dB");
        }
    }
}

fn psnr(one: &image::RgbImage, other: &image::RgbImage) -> f64 {
    assert_eq!(one.dimensions(), other.dimensions());
    let squares = one
        .iter()
        .zip(other.iter())
        .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
    -10.0 * (squares.sum::<f64>() / one.len() as f64 / 255_f64.powi(2)).log10()
}

#[test]
fn masks_that_leave_nothing() {
    let Some(case) = Case::open("cases/everything_masked") else {
        return;
    };
    for (data, hint) in [
        (".", "in the alpha channel"),
        ("transparent.json", "black in a mask means"),
    ] {
        let (code, printed, _) = case.train(data, "r");
        assert_eq!(code, Some(4), "{printed}");
        assert!(
            printed.contains("no pixel of any image can be used") && printed.contains(hint),
            "{printed}"
        );
    }
    let Some(hostile) = Case::open("hostile/all-masked") else {
        return;
    };
    assert_eq!(hostile.train(".", "r").0, Some(4));
}

#[test]
fn image_formats() {
    let Some(case) = Case::open("cases/image_formats") else {
        return;
    };
    for (data, n_images) in [("webp", 8), ("noext_upper", 8)] {
        let (code, printed, cameras) = case.train(data, &format!("r-{data}"));
        assert_eq!((code, cameras.len()), (Some(0), n_images), "{printed}");
    }
    let (code, printed, _) = case.train("heic", "r-heic");
    assert!(
        code == Some(1) && printed.contains("is a HEIC file") && printed.contains("convert it"),
        "{printed}"
    );
    let (code, printed, cameras) = case.train("depth_npy", "r-npy");
    assert_eq!((code, cameras.len()), (Some(3), 8), "{printed}");
    assert!(
        printed.contains("depth 16-bit PNG") && !printed.contains("007.npy"),
        "{printed}"
    );
}

#[test]
fn training_starts_at_initial_points() {
    let Some(case) = Case::open("cases/initial_points") else {
        return;
    };
    let train = |out: &str| {
        let (code, printed, cameras) = case.train(".", out);
        assert_eq!((code, cameras.is_empty()), (Some(0), false), "{printed}");
        (
            std::fs::read(case.at(out).join("splats.ply")).unwrap(),
            printed,
        )
    };
    let (with_points, printed) = train("with");
    assert!(
        printed.contains("sparse_pc.ply: splats start at 736 points"),
        "{printed}"
    );
    assert_eq!(train("again").0, with_points, "the result is reproducible");
    std::fs::write(
        case.at("sparse_pc.ply"),
        "ply\nformat ascii 1.0\nend_header\n",
    )
    .unwrap();
    let (without_points, printed) = train("damaged");
    assert!(
        printed.contains("starts without the points of the dataset: cannot parse"),
        "{printed}"
    );
    assert!(
        printed.contains("element \"vertex\" is missing") && without_points != with_points,
        "{printed}"
    );
}

#[test]
fn split_lists_of_nerfstudio() {
    let Some(case) = Case::open("cases/nerfstudio_split_lists") else {
        return;
    };
    let (code, printed, cameras) = case.train(".", "r");
    assert_eq!(code, Some(0), "{printed}");
    let tests: Vec<&str> = cameras
        .iter()
        .map(|(name, _)| name.as_str())
        .filter(|name| name.starts_with("test"))
        .collect();
    assert_eq!(tests, ["test 6000000", "test 7000000"]);
}

#[test]
fn poses_with_three_decimals() {
    let Some(case) = Case::open("cases/poses_with_three_decimals") else {
        return;
    };
    let (code, printed, cameras) = case.train(".", "r");
    assert_eq!((code, cameras.len()), (Some(0), 8), "{printed}");
    assert!(
        printed.contains("are rounded to about three decimals"),
        "{printed}"
    );
}

#[test]
fn tum_times_and_poses() {
    let Some(case) = Case::open("cases/tum_scientific_notation") else {
        return;
    };
    let (_, _, plain) = case.train("plain", "p");
    assert_eq!(plain.len(), 16);
    for data in ["relative", "epoch"] {
        let (code, printed, cameras) = case.train(data, &format!("r-{data}"));
        assert_eq!((code, cameras.len()), (Some(0), 16), "{data}: {printed}");
        for (a, b) in cameras.iter().zip(&plain) {
            assert!(
                max_difference(&a.1, &b.1) < 1e-6,
                "{data}: {} at another pose than {}",
                a.0,
                b.0
            );
        }
    }
    let Some(case) = Case::open("cases/tum_poses_at_20_hz") else {
        return;
    };
    let (code, printed, cameras) = case.train(".", "r");
    assert!(code == Some(0) && cameras.len() == 8, "{printed}");
}

#[test]
fn paths_of_windows() {
    let Some(case) = Case::open("cases/windows_paths") else {
        return;
    };
    for data in [".", "bom.json"] {
        let (code, printed, cameras) = case.train(data, &format!("r{}", data.len()));
        assert_eq!((code, cameras.len()), (Some(0), 8), "{printed}");
    }
}

/// The error message names the size, and memory use stays small.
#[test]
fn huge_depth() {
    let Some(hostile) = test_support::data_folder("hostile/depth-16384") else {
        return;
    };
    let Some(case) = Case::open("cases/nerfstudio_split_lists") else {
        return;
    };
    let transforms = std::fs::read_to_string(case.at("transforms.json")).unwrap();
    let mut transforms: Value = serde_json::from_str(&transforms).unwrap();
    std::fs::copy(hostile.join("depth.png"), case.at("huge.png")).unwrap();
    transforms["frames"][0]["depth_file_path"] = "huge.png".into();
    std::fs::write(case.at("transforms.json"), transforms.to_string()).unwrap();
    let (code, printed, cameras) = case.train(".", "r");
    assert_eq!((code, cameras.len()), (Some(3), 8), "{printed}");
    assert!(
        printed.contains("has 16384x16384 pixels, which exceeds the maximum"),
        "{printed}"
    );
}

#[test]
fn attachments_at_the_end_of_a_recording() {
    let Some(case) = Case::open("cases/mcap_attachments_last") else {
        return;
    };
    let (code, printed) = case.run(&["export", "last.mcap", "--to", "nerfstudio", "--out", "x"]);
    assert!(code == Some(0) && printed.contains("photos"), "{printed}");
    let transforms = std::fs::read_to_string(case.at("x/transforms.json")).unwrap();
    let transforms: Value = serde_json::from_str(&transforms).unwrap();
    assert!(
        transforms["frames"].as_array().unwrap().len() >= 15,
        "{printed}"
    );
}

#[test]
fn calibrations_of_ros() {
    let Some(case) = Case::open("cases/ros_calibration_yaml") else {
        return;
    };
    let (code, printed) = case.run(&["calibrate", "hand-eye", "easy_handeye_samples.yaml"]);
    assert!(
        code == Some(2) && printed.contains("this is YAML, expected JSON"),
        "{printed}"
    );
    // The case has no images, so the error shows that reading goes on after the intrinsics.
    let (code, printed) = case.run(&["calibrate", "hand-eye", "samples_with_camera_info.json"]);
    assert!(
        code == Some(2) && printed.contains("00.png") && !printed.contains("camera_matrix"),
        "{printed}"
    );
    // The same parameters are also tested in a separate file.
    let samples = std::fs::read_to_string(case.at("samples_with_camera_info.json")).unwrap();
    let mut samples: Value = serde_json::from_str(&samples).unwrap();
    samples["intrinsics"] = "ost.yaml".into();
    std::fs::write(case.at("samples.json"), samples.to_string()).unwrap();
    let calibrate_with = |model: &str, rotation: &str| {
        let info = format!(
            "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
             data: [610., 0., 322.4, 0., 608., 241.1, 0., 0., 1.]\ndistortion_model: {model}\n\
             distortion_coefficients: {{rows: 1, cols: 4, data: [0.1, 0., 0., 0.]}}\n\
             rectification_matrix: {{rows: 3, cols: 3, data: {rotation}}}\n"
        );
        std::fs::write(case.at("ost.yaml"), info).unwrap();
        case.run(&["calibrate", "hand-eye", "samples.json"])
    };
    let (code, printed) = calibrate_with("equidistant", "[0, 1, 0, -1, 0, 0, 0, 0, 1]");
    assert!(code == Some(2) && printed.contains("00.png"), "{printed}");
    assert!(
        printed.contains("ost.yaml: not used") && printed.contains("rectification_matrix"),
        "{printed}"
    );
    let (code, printed) = calibrate_with("omni", "[1, 0, 0, 0, 1, 0, 0, 0, 1]");
    assert!(
        code == Some(2) && printed.contains("intrinsics: ost.yaml: distortion_model \"omni\""),
        "{printed}"
    );
}

#[test]
fn sides_of_a_board_swapped() {
    let Some(case) = Case::open("cases/charuco_sides_swapped") else {
        return;
    };
    let calibrate =
        |target: &str| case.run(&["calibrate", "intrinsics", "photos", "--target", target]);
    let (code, printed) = calibrate("charuco:6x5:30mm:22mm:5X5_100");
    assert_eq!(code, Some(4), "{printed}");
    assert!(
        printed.contains("the markers form a board of 5x6 squares (or more rows), not 6x5"),
        "{printed}"
    );
    let (code, printed) = calibrate("charuco:5x6:30mm:22mm:5X5_100");
    assert_eq!(code, Some(0), "{printed}");
}

/// Joint states as ROS publishes them. The sender uses the clock of this computer.
#[cfg(feature = "sim")]
#[test]
fn joint_states_of_ros() {
    use std::process::Stdio;
    /// Where the arm of the rig listens.
    const RIG_ADDRESS: &str = "127.0.0.1:7011";
    let Some(case) = Case::open("cases/udp_joint_states_of_ros") else {
        return;
    };
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/robots");
    tree_copy(&robots, &case.at("robots"));
    for (mode, other) in [
        ("order", 0),
        ("extra", 0),
        ("nan", 0),
        ("nanvel", 0),
        ("emptyvel", 0),
        ("partial", 1),
    ] {
        let sender = Command::new("python3")
            .args(["send.py", mode, "30"])
            .current_dir(case.folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        let Ok(mut sender) = sender else {
            test_support::skip("python3 is not installed");
            return;
        };
        if !has_datagram(RIG_ADDRESS) {
            sender.kill().unwrap();
            panic!("{mode}: the sender sends nothing");
        }
        let (_, printed) = case.run(&["doctor", "rig.toml", "--listen", "2"]);
        sender.kill().unwrap();
        sender.wait().unwrap();
        assert!(
            !printed.contains("rejected a datagram") && !printed.contains("did not arrive"),
            "{mode}: {printed}"
        );
        assert!(n_samples(&printed, "arm") > 0, "{mode}: {printed}");
        assert_eq!(
            printed.contains("ignoring states that name none of the arm's joints"),
            other == 1,
            "{mode}: {printed}"
        );
    }
}

/// Whether a program sends to this address within a minute. Nobody listens there yet.
#[cfg(feature = "sim")]
fn has_datagram(address: &str) -> bool {
    let socket = std::net::UdpSocket::bind(address).expect("the address is free");
    let timeout = Some(std::time::Duration::from_secs(60));
    socket.set_read_timeout(timeout).expect("a valid timeout");
    socket.recv(&mut [0; 4096]).is_ok()
}

/// Number of samples of a device, as printed by `doctor --listen`.
#[cfg(feature = "sim")]
fn n_samples(printed: &str, device: &str) -> usize {
    let counts = printed
        .lines()
        .filter_map(|line| line.strip_prefix(device)?.strip_prefix(": "));
    let mut counts = counts.filter_map(|line| line.split_once(" samples")?.0.parse().ok());
    counts.next().unwrap_or(0)
}
