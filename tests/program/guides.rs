//! Runs the commands of README and guides that need no device, in short forms. Of the other
//! commands, only the flags are checked, by `src/guide_tests.rs`.

use crate::command::{fieldrig, stderr};
use crate::small_rig;
use std::path::Path;
use test_support::{DocumentedCommand, documented_commands};

/// A documented command that is run, in the order of this list.
struct Run {
    command: &'static str,
    /// Words that are left out, because they would take minutes.
    without: &'static str,
    /// Words that are added at the end.
    with: &'static str,
}

const RUN: [Run; 11] = [
    Run {
        command: "record rigs/static-arm.toml --sim --lockstep --seconds 20 --out scan.mcap",
        without: "--seconds 20",
        with: "",
    },
    Run {
        command: "train scan.mcap --seconds 60",
        without: "--seconds 60",
        with: "--steps 5 --count to-cap --refine none --out model",
    },
    Run {
        command: "eval MODEL scan.mcap",
        without: "",
        with: "",
    },
    Run {
        command: "export MODEL --to ply --out scene.ply",
        without: "",
        with: "",
    },
    Run {
        command: "export MODEL --to spz --out scene.spz",
        without: "",
        with: "",
    },
    Run {
        command: "export scan.mcap --to nerfstudio --out scan",
        without: "",
        with: "",
    },
    Run {
        command: "render MODEL --camera-path camera_path.json --out frames",
        without: "",
        with: "--size 64x48",
    },
    Run {
        command: "run rigs/static-arm.toml --sim --method tsdf,splat",
        without: "",
        with: "--lockstep --steps 40 --out both --listen 127.0.0.1:0",
    },
    Run {
        command: "export MODEL/tsdf --to glb --out scene.glb",
        without: "",
        with: "",
    },
    Run {
        command: "calibrate target --out board.pdf",
        without: "",
        with: "",
    },
    Run {
        command: "devices",
        without: "",
        with: "",
    },
];

/// Beginnings of commands that are not run here, and the reason.
const ONLY_PARSED: [(&str, &[&str]); 10] = [
    (
        "they open the devices of a robot",
        &[
            "calibrate hand-eye my-robot.toml",
            "calibrate intrinsics my-robot.toml",
            "calibrate intrinsics rig.toml",
            "devices --watch",
            "doctor RIG.toml",
            "doctor my-robot.toml",
            "record RIG.toml",
            "record rig.toml",
            "run RIG.toml --foxglove",
            "run RIG.toml --record",
            "run RIG.toml --share",
            "run calibrated/rig.toml",
            "run my-robot.toml --record",
            "run sim-static-arm/rig.toml",
        ],
    ),
    (
        "they move an arm",
        &["move", "calibrate hand-eye rig.toml --move"],
    ),
    (
        "they serve until Ctrl-C: view.rs, preview.rs and wire.rs run them",
        &["preview", "sim", "view"],
    ),
    (
        "it takes a minute: calibrate_guided.rs runs it",
        &["calibrate intrinsics rigs/webcam-lens.toml"],
    ),
    (
        "they calibrate from long scans: calibrate.rs and calibrate_scan.rs run them",
        &[
            "calibrate hand-eye rigs/calibration-board.toml",
            "calibrate hand-eye samples.json",
            "calibrate hand-eye scan.mcap",
            "calibrate intrinsics photos/",
            "calibrate intrinsics scan.mcap",
            "calibrate scene",
            "record rigs/calibration-board.toml",
            "train scan.mcap --refine auto",
        ],
    ),
    (
        "they differ from a command that is run only in the rig file or in the limit",
        &[
            "run RIG.toml --sim",
            "run board.toml --sim",
            "run calibrated.toml --sim",
            "run my-robot.toml --sim",
            "run rigs/mobile-arm.toml --sim --enable-motion",
            "run rigs/mobile-base.toml --sim --enable-motion",
            "run rigs/static-arm.toml --sim",
            "train scan.mcap",
            "train scene.mcap",
            "render MODEL --camera-path camera_path.json --out renders",
        ],
    ),
    (
        "they resume or replay: end_to_end.rs and resume.rs run them",
        &[
            "run --from scan.mcap",
            "run rigs/static-arm.toml --resume",
            "train scan.mcap --resume",
        ],
    ),
    (
        "their data comes from other programs: drivers/tests/converters.rs reads it",
        &["train .", "train scan"],
    ),
    (
        "their results depend on the computer or its files, and have tests of their own",
        &["doctor", "fk", "runs"],
    ),
    ("it asks about devices, and has tests of its own", &["init"]),
];

/// A view of the scene in the format of nerfstudio.
const CAMERA_PATH: &str = r#"{"render_width": 64, "render_height": 48, "camera_path": [{"camera_to_world":
    [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 1.2, 0, 0, 0, 1], "fov": 60}]}"#;

/// The files that a page names by placeholders, or that would take minutes.
fn replaced(word: &str) -> &str {
    match word {
        "rigs/static-arm.toml" => "rig.toml",
        "MODEL" => "model",
        "MODEL/tsdf" => "both/tsdf",
        _ => word,
    }
}

/// Whether the words of a command begin with those of `beginning`.
fn begins_with(command: &DocumentedCommand, beginning: &str) -> bool {
    let beginning: Vec<&str> = beginning.split(' ').collect();
    command.words.len() >= beginning.len()
        && command.words.iter().zip(beginning).all(|(a, b)| a == b)
}

fn documented() -> Vec<DocumentedCommand> {
    documented_commands(Path::new(env!("CARGO_MANIFEST_DIR")))
}

#[test]
fn every_command_of_the_guides_is_run_or_has_a_reason() {
    let commands = documented();
    let beginnings: Vec<&str> = ONLY_PARSED
        .iter()
        .flat_map(|(_, beginnings)| beginnings.iter().copied())
        .collect();
    let unknown: Vec<String> = commands
        .iter()
        .filter(|command| {
            let is_run = RUN.iter().any(|run| command.words.join(" ") == run.command);
            !is_run && !beginnings.iter().any(|text| begins_with(command, text))
        })
        .map(|command| format!("{}: {}", command.page, command.words.join(" ")))
        .collect();
    assert_eq!(unknown, Vec::<String>::new());
    let is_documented = |text: &&str| commands.iter().any(|command| begins_with(command, text));
    let stale: Vec<&str> = beginnings
        .into_iter()
        .chain(RUN.iter().map(|run| run.command))
        .filter(|text| !is_documented(text))
        .collect();
    assert_eq!(stale, Vec::<&str>::new());
}

#[test]
fn commands_of_the_guides_run_without_devices() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    small_rig::write_with(folder, |sim| {
        // The scan ends early, so `record` needs no limit.
        sim.insert("lockstep".into(), true.into());
        sim.insert("n_images".into(), 20.into());
    });
    std::fs::write(folder.join("camera_path.json"), CAMERA_PATH).expect("written");
    for run in &RUN {
        let without: Vec<&str> = run.without.split(' ').collect();
        let mut args: Vec<&str> = run
            .command
            .split(' ')
            .filter(|word| !without.contains(word))
            .map(replaced)
            .collect();
        args.extend(run.with.split(' ').filter(|word| !word.is_empty()));
        let output = fieldrig(folder, &args);
        assert!(
            output.status.success(),
            "fieldrig {}: {}",
            args.join(" "),
            stderr(&output)
        );
    }
    for file in [
        "scene.ply",
        "scene.spz",
        "scene.glb",
        "board.pdf",
        "scan/transforms.json",
        "frames/00000.png",
        "both/splat/model.json",
    ] {
        assert!(folder.join(file).exists(), "{file} is missing");
    }
}
