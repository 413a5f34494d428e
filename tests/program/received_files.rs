//! Files that a user has received from others change nothing outside their folder, and special
//! files are refused. The tests make these inputs themselves, because they depend on the version of
//! checkpoints.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use crate::photos::dataset;
use model_files::checkpoint::Checkpoint;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

fn fieldrig(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .args(args)
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

fn run(folder: &Path, args: &[&str]) -> Output {
    fieldrig(folder, args).output().unwrap()
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned()
}

/// A folder with photos in `data` and an interrupted run in `run`.
fn received() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    dataset(&folder.path().join("data"));
    let trained = run(
        folder.path(),
        &[
            "train",
            "data",
            "--steps",
            "4",
            "--max-splats",
            "200",
            "--out",
            "run",
        ],
    );
    assert!(trained.status.success(), "{}", text(&trained));
    std::fs::remove_file(folder.path().join("run/model.json")).unwrap();
    std::fs::remove_file(folder.path().join("run/splats.ply")).unwrap();
    folder
}

/// Without the corrections and the background, scores and images are worse.
#[test]
fn model_without_its_metadata_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let trained = run(
        folder,
        &[
            "train",
            "data",
            "--steps",
            "4",
            "--max-splats",
            "200",
            "--out",
            "run",
        ],
    );
    assert!(trained.status.success(), "{}", text(&trained));
    let warning = "run has no model.json: the corrections of the cameras and the background of the model are unknown";
    let complete = run(folder, &["eval", "run", "data"]);
    assert!(
        complete.status.success() && !text(&complete).contains("has no model.json"),
        "{}",
        text(&complete)
    );
    std::fs::remove_file(folder.join("run/model.json")).unwrap();
    let incomplete = run(folder, &["eval", "run", "data"]);
    assert!(
        incomplete.status.success() && text(&incomplete).contains(warning),
        "{}",
        text(&incomplete)
    );
}

#[test]
fn links_in_a_received_run_are_not_followed() {
    let received = received();
    let folder = received.path();
    let precious = folder.join("precious");
    std::fs::create_dir(folder.join("elsewhere")).unwrap();
    let names = [
        "decisions-from-4.jsonl",
        ".lock",
        ".training.ckpt.fieldrig.part",
        ".report.json.fieldrig.part",
        "report.html",
        "log.txt",
        ".keyframes.txt.fieldrig.part",
        ".cameras.json.fieldrig.part",
        ".model.fieldrig.part",
        "keyframes",
    ];
    for (ix, name) in names.into_iter().enumerate() {
        std::fs::write(&precious, "precious data").unwrap();
        let link = folder.join("run").join(name);
        let _ = std::fs::remove_file(&link); // Most are not there.
        let _ = std::fs::remove_dir_all(&link);
        let is_folder = [".model.fieldrig.part", "keyframes"].contains(&name);
        symlink(
            if is_folder {
                folder.join("elsewhere")
            } else {
                precious.clone()
            },
            &link,
        )
        .unwrap();
        let n_steps = (5 + ix).to_string();
        let resumed = run(
            folder,
            &["train", "data", "--resume", "run", "--steps", &n_steps],
        );
        let printed = text(&resumed);
        if is_folder || name == ".lock" {
            assert!(printed.contains("is a symbolic link"), "{name}: {printed}");
            std::fs::remove_file(&link).unwrap();
        } else {
            assert!(resumed.status.success(), "{name}: {printed}");
            let _ = std::fs::remove_file(folder.join("run/model.json"));
            let _ = std::fs::remove_file(folder.join("run/splats.ply"));
        }
        assert_eq!(
            std::fs::read(&precious).unwrap(),
            b"precious data",
            "{name}"
        );
        assert_eq!(
            std::fs::read_dir(folder.join("elsewhere")).unwrap().count(),
            0,
            "{name}"
        );
        assert!(!link.is_symlink(), "{name}");
    }
}

/// Browsers and editors use such names for their own files, too.
#[test]
fn files_of_users_that_end_in_part_are_kept() {
    let received = received();
    let folder = received.path();
    let names = [
        "run/training.ckpt.part",
        "run/report.json.part",
        "run/keyframes.txt.part",
        "run/model.part/notes.txt",
        "scene.spz.part",
        ".scene.spz.part",
    ];
    for name in names {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "of the user").unwrap();
    }
    // Files that killed programs have left behind are removed.
    let leftovers = [
        "run/.model.fieldrig.part/splats.ply",
        ".scene.spz.fieldrig.part/scene.spz",
    ];
    for name in leftovers {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "half a model").unwrap();
    }
    let resumed = run(
        folder,
        &["train", "data", "--resume", "run", "--steps", "6"],
    );
    assert!(
        resumed.status.success() && folder.join("run/splats.ply").exists(),
        "{}",
        text(&resumed)
    );
    let exported = run(
        folder,
        &["export", "run", "--to", "spz", "--out", "scene.spz"],
    );
    assert!(exported.status.success(), "{}", text(&exported));
    for name in names {
        assert_eq!(
            std::fs::read_to_string(folder.join(name)).unwrap(),
            "of the user",
            "{name}"
        );
    }
    for name in leftovers {
        assert!(!folder.join(name).parent().unwrap().exists(), "{name}");
    }
}

#[test]
fn checkpoint_cannot_name_an_output() {
    let received = received();
    let folder = received.path();
    let (checkpoint, target) = (
        folder.join("run/training.ckpt"),
        folder.join("home/.bashrc"),
    );
    std::fs::create_dir(folder.join("home")).unwrap();
    std::fs::write(&target, "original").unwrap();
    let mut evil = Checkpoint::read(&checkpoint).unwrap();
    evil.flags.insert(
        "write-rig".to_owned(),
        target.to_string_lossy().into_owned(),
    );
    evil.flags.insert("steps".to_owned(), "5".to_owned());
    evil.is_finished = false;
    evil.write(&checkpoint).unwrap();
    let resumed = run(folder, &["train", "data", "--resume", "run"]);
    let printed = text(&resumed);
    assert!(
        resumed.status.success() && printed.contains("no rig file is written"),
        "{printed}"
    );
    assert_eq!(std::fs::read(&target).unwrap(), b"original");
    assert_eq!(std::fs::read_dir(folder.join("home")).unwrap().count(), 1);
}

#[test]
fn one_of_two_exports_to_one_path_wins() {
    const N_PAIRS: usize = 12;
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let trained = run(
        folder,
        &[
            "train",
            "data",
            "--steps",
            "2",
            "--max-splats",
            "2000",
            "--out",
            "run",
        ],
    );
    assert!(trained.status.success(), "{}", text(&trained));
    for pair in 0..N_PAIRS {
        let out = format!("scene{pair}.spz");
        let export = || -> Child {
            fieldrig(folder, &["export", "run", "--to", "spz", "--out", &out])
                .spawn()
                .unwrap()
        };
        let outputs = [export(), export()].map(|child| child.wait_with_output().unwrap());
        let won = outputs
            .iter()
            .filter(|output| output.status.success())
            .count();
        let printed = outputs.each_ref().map(text);
        assert_eq!(won, 1, "{printed:?}");
        assert!(
            std::fs::metadata(folder.join(&out)).unwrap().len() > 1000,
            "{printed:?}"
        );
        let reasons = [
            "it exists already",
            "another program is writing it",
            "the file exists",
        ];
        let is_refused = |printed: &String| reasons.iter().any(|reason| printed.contains(reason));
        assert_eq!(
            printed.iter().filter(|printed| is_refused(printed)).count(),
            1,
            "{printed:?}"
        );
    }
    let parts = std::fs::read_dir(folder).unwrap().filter(|entry| {
        entry
            .as_ref()
            .unwrap()
            .file_name()
            .to_string_lossy()
            .ends_with(".part")
    });
    assert_eq!(parts.count(), 0);
}

/// Reading a pipe or device could wait forever, or until the memory is full.
#[test]
fn pipes_and_devices_are_refused_as_inputs() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let trained = run(
        folder,
        &[
            "train",
            "data",
            "--steps",
            "2",
            "--max-splats",
            "200",
            "--out",
            "run",
        ],
    );
    assert!(trained.status.success(), "{}", text(&trained));
    std::fs::copy(folder.join("run/splats.ply"), folder.join("scene.ply")).unwrap();
    assert!(
        Command::new("mkfifo")
            .arg(folder.join("pipe"))
            .status()
            .unwrap()
            .success()
    );
    symlink("/dev/zero", folder.join("zero")).unwrap();
    for special in ["pipe", "zero"] {
        let link = |name: &str| {
            let _ = std::fs::remove_file(folder.join(name));
            symlink(folder.join(special), folder.join(name)).unwrap();
        };
        for name in [
            "rig.toml",
            "robot.urdf",
            "path.json",
            "list.txt",
            "scan.mcap",
            "other.ply",
            "other.spz",
            "samples.json",
            "a.png",
            "a.pem",
        ] {
            link(name);
        }
        link("run/model.json");
        for args in [
            &["doctor", "rig.toml"][..],
            &["fk", "robot.urdf", "--tip", "tool"],
            &[
                "render",
                "scene.ply",
                "--camera-path",
                "path.json",
                "--out",
                "images",
            ],
            &[
                "train",
                "data",
                "--keyframes",
                "list.txt",
                "--steps",
                "2",
                "--out",
                "new",
            ],
            &[
                "train",
                "data",
                "--holdout",
                "list.txt",
                "--steps",
                "2",
                "--out",
                "new",
            ],
            &["train", "scan.mcap", "--steps", "2", "--out", "new"],
            &["export", "scan.mcap", "--to", "nerfstudio", "--out", "new"],
            &["export", "other.ply", "--to", "spz", "--out", "new.spz"],
            &["export", "other.spz", "--to", "ply", "--out", "new.ply"],
            &["export", "run", "--to", "spz", "--out", "new.spz"],
            &["calibrate", "hand-eye", "samples.json"],
            &["metrics", "a.png", "a.png"],
            &[
                "view",
                "scene.ply",
                "--listen",
                "0.0.0.0:0",
                "--share",
                "--certificate",
                "a.pem",
            ],
        ] {
            let refused = run(folder, args);
            let printed = text(&refused);
            assert!(
                matches!(refused.status.code(), Some(1 | 2)),
                "{special}, {args:?}: {printed}"
            );
            assert!(
                !printed.contains("panicked"),
                "{special}, {args:?}: {printed}"
            );
        }
        assert!(!folder.join("new").exists());
    }
}

#[test]
fn results_are_private_unless_requested_otherwise() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let mode = |path: &str| {
        std::fs::metadata(folder.join(path))
            .unwrap()
            .permissions()
            .mode()
            & 0o777
    };
    for (out, flags, others) in [
        ("private", &[][..], 0),
        ("public", &["--public-files"][..], 0o044),
    ] {
        let run_with_flags = |args: &[&str]| {
            // The program gets the usual umask, whatever the umask of the tests is.
            let mut command = Command::new("sh");
            command.args([
                "-c",
                "umask 022; exec \"$0\" \"$@\"",
                env!("CARGO_BIN_EXE_fieldrig"),
            ]);
            let output = command
                .args(args)
                .args(flags)
                .current_dir(folder)
                .output()
                .unwrap();
            assert!(output.status.success(), "{}", text(&output));
        };
        run_with_flags(&[
            "train",
            "data",
            "--steps",
            "2",
            "--max-splats",
            "200",
            "--out",
            out,
        ]);
        assert_eq!(mode(out) & 0o044, others);
        for file in ["splats.ply", "model.json", "training.ckpt", "report.json"] {
            assert_eq!(mode(&format!("{out}/{file}")) & 0o077, others, "{file}");
        }
        let exported = format!("{out}.spz");
        run_with_flags(&["export", out, "--to", "spz", "--out", &exported]);
        assert_eq!(mode(&exported) & 0o077, others, "{exported}");
        #[cfg(feature = "sim")]
        {
            crate::small_rig::write(folder, crate::small_rig::Pace::Lockstep);
            let (recording, dataset) = (format!("{out}.mcap"), format!("{out}-dataset"));
            run_with_flags(&[
                "record",
                "rig.toml",
                "--sim",
                "--seconds",
                "6",
                "--out",
                &recording,
            ]);
            run_with_flags(&[
                "export",
                &recording,
                "--to",
                "nerfstudio",
                "--out",
                &dataset,
            ]);
            assert_eq!(
                (mode(&recording) & 0o077, mode(&dataset) & 0o044),
                (others, others)
            );
            let photo = std::fs::read_dir(folder.join(&dataset).join("images"))
                .unwrap()
                .next()
                .unwrap()
                .unwrap();
            let photo = format!("{dataset}/images/{}", photo.file_name().to_string_lossy());
            for file in [format!("{dataset}/transforms.json"), photo] {
                assert_eq!(mode(&file) & 0o077, others, "{file}");
            }
        }
    }
}

#[test]
fn flags_of_other_commands_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for command in ["view", "render", "eval", "devices", "doctor", "move"] {
        let refused = run(folder.path(), &[command, "--public-files"]);
        let printed = text(&refused);
        assert!(
            refused.status.code() == Some(2) && printed.contains("'--public-files'"),
            "{command}: {printed}"
        );
        let help = text(&run(folder.path(), &[command, "--help"]));
        assert!(
            help.contains("--json") && !help.contains("public-files"),
            "{command}: {help}"
        );
    }
}
