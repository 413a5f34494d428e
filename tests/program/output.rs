//! Tests that a closed terminal, a closed pipe or a full disk never loses the result.
#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

#[cfg(feature = "sim")]
use crate::small_rig;
use crate::wall;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::ffi::OsStr;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Read};
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

const EXE: &str = env!("CARGO_BIN_EXE_fieldrig");
/// This is longer than any of these commands takes on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(240);
/// Exit code for losses, which include lost lines of output.
const LOSS: i32 = 3;

/// A program on a pseudoterminal that can be closed.
pub(crate) struct OnTerminal {
    pub(crate) child: Child,
    terminal: File,
    printed: Vec<u8>,
}

impl OnTerminal {
    /// Starts `fieldrig`. With `controlled`, the terminal is its controlling terminal, as in a
    /// shell, and closing it sends SIGHUP.
    pub(crate) fn start(folder: &Path, args: &[&str], controlled: bool) -> Self {
        let master =
            openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        let open = || {
            OpenOptions::new()
                .read(true)
                .write(true)
                .open(OsStr::from_bytes(name.to_bytes()))
                .unwrap()
        };
        let mut command = Command::new(if controlled { "env" } else { EXE });
        if controlled {
            // SIGHUP may be ignored, for example if the tests run under `nohup`.
            command.args(["--default-signal=HUP", "setsid", "--ctty", EXE]);
        }
        let child = command
            .args(args)
            .current_dir(folder)
            .stdin(open())
            .stdout(open())
            .stderr(open())
            .spawn()
            .unwrap();
        Self {
            child,
            terminal: File::from(master),
            printed: Vec::new(),
        }
    }

    /// Reads until the program has printed this text.
    pub(crate) fn wait_for(&mut self, text: &str) {
        let mut bytes = [0; 4096];
        while !self
            .printed
            .windows(text.len())
            .any(|window| window == text.as_bytes())
        {
            let n = self.terminal.read(&mut bytes).unwrap_or(0);
            assert!(
                n > 0,
                "no {text:?} in {}",
                String::from_utf8_lossy(&self.printed)
            );
            self.printed.extend(&bytes[..n]);
        }
    }

    /// Closes the terminal; returns the program's exit status.
    pub(crate) fn close(self) -> ExitStatus {
        drop(self.terminal);
        wait_for_exit(self.child)
    }
}

fn wait_for_exit(mut child: Child) -> ExitStatus {
    let started = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        if started.elapsed() > TIMEOUT {
            child.kill().unwrap();
            panic!("the program did not end");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Fails unless the model in a folder can be read.
fn expect_model(folder: &Path, model: &str) {
    let to = format!("{model}-exported.ply");
    let output = wall::fieldrig(folder, &["export", model, "--to", "ply", "--out", &to]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

/// Fails unless the recording can be read to its end.
#[cfg(feature = "sim")]
fn expect_recording(folder: &Path, recording: &str) {
    let to = format!("{recording}-exported");
    let output = wall::fieldrig(
        folder,
        &["export", recording, "--to", "nerfstudio", "--out", &to],
    );
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn training_survives_a_closed_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    for (n, millis) in [0_u64, 300, 900].into_iter().enumerate() {
        let out = format!("out{n}");
        let args = [
            "train",
            "data",
            "--seconds",
            "60",
            "--max-splats",
            "600",
            "--out",
            &out,
        ];
        let mut run = OnTerminal::start(folder, &args, true);
        run.wait_for("step");
        std::thread::sleep(Duration::from_millis(millis));
        assert_eq!(run.close().code(), Some(LOSS), "closed after {millis} ms");
        expect_model(folder, &out);
    }
}

#[test]
fn training_survives_a_closed_terminal_without_sighup() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let args = [
        "train",
        "data",
        "--steps",
        "300",
        "--max-splats",
        "600",
        "--out",
        "out",
    ];
    let mut run = OnTerminal::start(folder, &args, false);
    run.wait_for("step");
    assert_eq!(run.close().code(), Some(LOSS));
    let report = std::fs::read_to_string(folder.join("out/report.json")).unwrap();
    assert!(
        report.contains("\"steps\": 300"),
        "training did not reach its end"
    );
    expect_model(folder, "out");
}

#[test]
fn training_saves_at_the_limit_of_processor_time() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let args = [
        "train",
        "data",
        "--seconds",
        "60",
        "--max-splats",
        "600",
        "--out",
        "out",
    ];
    let mut run = OnTerminal::start(folder, &args, false);
    run.wait_for("step");
    // The kernel sends this signal every second after the soft limit.
    for _ in 0..2 {
        let limit = Command::new("kill")
            .args(["-XCPU", &run.child.id().to_string()])
            .status();
        assert!(limit.unwrap().success());
    }
    run.wait_for("stopping and saving");
    assert!(run.close().code().is_some(), "it is not ended by a signal");
    expect_model(folder, "out");
}

#[test]
fn writes_beyond_the_limit_of_the_file_size_fail_as_on_a_full_disk() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    // A file can have at most 100 kB, which is enough for the lists, but not for the model.
    let limited = "ulimit -f 100; exec \"$0\" \"$@\"";
    let mut train = Command::new("sh");
    train.args(["-c", limited, EXE]).args([
        "train",
        "data",
        "--steps",
        "120",
        "--max-splats",
        "60000",
        "--checkpoint-secs",
        "0",
        "--out",
        "out",
    ]);
    let output = train
        .env("TMPDIR", folder)
        .current_dir(folder)
        .output()
        .unwrap();
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{printed}");
    assert!(
        printed.contains("cannot save the model in out") && printed.contains("too large"),
        "{printed}"
    );
}

#[test]
fn training_is_not_blocked_by_a_full_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    // The terminal exists, but nothing reads it, as after a broken connection. 8 kB fill the
    // terminal.
    let args = [
        "train",
        "data",
        "--steps",
        "300",
        "--max-splats",
        "600",
        "--out",
        "out",
        "-vv",
    ];
    let mut run = OnTerminal::start(folder, &args, true);
    run.wait_for("of 10 images");
    let OnTerminal {
        child, terminal, ..
    } = run;
    assert_eq!(wait_for_exit(child).code(), Some(LOSS));
    drop(terminal);
    expect_model(folder, "out");
}

#[test]
fn training_survives_a_closed_pipe_and_full_stdout() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    wall::write(&folder.join("data"), true, 0.0);
    let train = |out: &str| {
        let mut command = Command::new(EXE);
        command.args([
            "train",
            "data",
            "--seconds",
            "2",
            "--max-splats",
            "600",
            "--json",
            "--out",
            out,
        ]);
        command.current_dir(folder);
        command
    };
    // As with `| head -1`.
    let mut head = train("head")
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(head.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    assert!(line.starts_with('{'), "{line}");
    assert_eq!(wait_for_exit(head).code(), Some(LOSS));
    expect_model(folder, "head");

    let full = || OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = train("full").stdout(full()).output().unwrap();
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(LOSS), "{printed}");
    assert!(
        printed.contains("cannot write to stdout") && printed.contains("No space left"),
        "{printed}"
    );
    expect_model(folder, "full");
    // The test is repeated without stderr.
    assert_eq!(
        train("mute")
            .stdout(full())
            .stderr(full())
            .status()
            .unwrap()
            .code(),
        Some(LOSS)
    );
    expect_model(folder, "mute");

    // A command whose result is its output fails if stdout is full.
    let mut fk = Command::new(EXE);
    fk.args(["metrics", "data/00.png", "data/00.png"])
        .current_dir(folder);
    assert_eq!(
        fk.stdout(full()).output().unwrap().status.code(),
        Some(1),
        "the result is lost"
    );
}

#[cfg(feature = "sim")]
#[test]
fn runs_and_recordings_survive_a_closed_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    small_rig::write(folder, small_rig::Pace::RealTime);
    for (n, millis) in [0_u64, 700].into_iter().enumerate() {
        let (out, recording) = (format!("out{n}"), format!("run{n}.mcap"));
        let run = [
            "run",
            "rig.toml",
            "--sim",
            "--record",
            &recording,
            "--out",
            &out,
            "--listen",
            "127.0.0.1:0",
        ];
        let mut run = OnTerminal::start(folder, &run, true);
        run.wait_for("step");
        std::thread::sleep(Duration::from_millis(millis));
        assert_eq!(run.close().code(), Some(LOSS));
        expect_model(folder, &out);
        expect_recording(folder, &recording);

        let recording = format!("record{n}.mcap");
        let mut record = OnTerminal::start(
            folder,
            &["record", "rig.toml", "--sim", "--out", &recording],
            true,
        );
        record.wait_for("color images");
        std::thread::sleep(Duration::from_millis(1000 + millis));
        assert_eq!(record.close().code(), Some(LOSS));
        expect_recording(folder, &recording);
    }
}

/// The test kills exports while they write. The folder is then complete or absent, and the next
/// export replaces the leftovers.
#[cfg(feature = "sim")]
#[test]
fn killed_export_is_complete_or_absent() {
    const N_KILLS: u64 = 3;
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    small_rig::write(folder, small_rig::Pace::Lockstep);
    let record = [
        "record",
        "rig.toml",
        "--sim",
        "--seconds",
        "6",
        "--out",
        "scan.mcap",
    ];
    let recorded = wall::fieldrig(folder, &record);
    assert!(
        recorded.status.success(),
        "{}",
        String::from_utf8_lossy(&recorded.stderr)
    );
    let images = |out: &str| {
        std::fs::read_dir(folder.join(out).join("images"))
            .unwrap()
            .count()
    };
    let expect_complete = |out: &str| {
        let n_expected = images("scan.mcap-exported");
        assert!(
            folder.join(out).join("transforms.json").exists() && images(out) == n_expected,
            "{out}"
        );
    };
    expect_recording(folder, "scan.mcap");
    expect_complete("scan.mcap-exported");
    for kill in 0..N_KILLS {
        let out = format!("killed{kill}");
        let unfinished = folder.join(format!(".{out}.fieldrig.part"));
        let export = ["export", "scan.mcap", "--to", "nerfstudio", "--out", &out];
        let mut command = Command::new(EXE);
        command
            .args(export)
            .current_dir(folder)
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let mut running = command.spawn().unwrap();
        let started = Instant::now();
        while !unfinished.exists() && running.try_wait().unwrap().is_none() {
            assert!(started.elapsed() < TIMEOUT, "it does not write");
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(5 * kill));
        running.kill().unwrap();
        running.wait().unwrap();
        if !folder.join(&out).exists() {
            let again = wall::fieldrig(folder, &export);
            assert!(
                again.status.success(),
                "{}",
                String::from_utf8_lossy(&again.stderr)
            );
            assert!(!unfinished.exists(), "what is left is removed");
        }
        // An export that was faster than the kill is complete, too.
        expect_complete(&out);
    }
}

/// A small disk, unmounted on drop.
#[cfg(feature = "sim")]
struct SmallDisk<'a>(&'a Path);

#[cfg(feature = "sim")]
impl<'a> SmallDisk<'a> {
    /// Returns `None` if this user may not mount a file system.
    fn mount(at: &'a Path, size: &str) -> Option<Self> {
        std::fs::create_dir(at).unwrap();
        let option = format!("size={size}");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &option, "tmpfs"])
            .arg(at)
            .output()
            .unwrap();
        if !mounted.status.success() {
            test_support::skip("mounting a tmpfs requires root");
        }
        mounted.status.success().then_some(Self(at))
    }
}

#[cfg(feature = "sim")]
impl Drop for SmallDisk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0).status();
    }
}

#[cfg(feature = "sim")]
#[test]
fn full_disk_keeps_recording_readable_and_saves_model_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    small_rig::write(folder, small_rig::Pace::Lockstep);
    let disk = folder.join("disk");
    let Some(_disk) = SmallDisk::mount(&disk, "1m") else {
        return;
    };
    let record = [
        "record",
        "rig.toml",
        "--sim",
        "--seconds",
        "30",
        "--json",
        "--out",
        "disk/run.mcap",
    ];
    let output = wall::fieldrig(folder, &record);
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(LOSS), "{printed}");
    let reported: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let count = |key: &str| reported[key].as_u64().unwrap();
    let n_samples = ["images", "depth_images", "joint_states", "truths"]
        .map(count)
        .iter()
        .sum::<u64>();
    assert!(
        printed.contains(&format!("({n_samples} samples)")),
        "{n_samples}: {printed}"
    );
    // Reading the file must give the same number of samples.
    let read = wall::fieldrig(
        folder,
        &[
            "export",
            "disk/run.mcap",
            "--to",
            "nerfstudio",
            "--out",
            "read",
        ],
    );
    let export_stderr = String::from_utf8_lossy(&read.stderr);
    assert!(
        export_stderr.contains(&format!("after {n_samples} readable samples")),
        "{n_samples}: {export_stderr}"
    );

    // The disk has enough space for the lists, but not for the model.
    std::fs::remove_file(disk.join("run.mcap")).unwrap();
    std::fs::write(disk.join("filler"), vec![1; 900 << 10]).unwrap();
    wall::write(&folder.join("data"), true, 0.0);
    let temporary = folder.join("temporary");
    std::fs::create_dir(&temporary).unwrap();
    let train = |temporary: &Path| {
        let mut train = Command::new(EXE);
        train.args([
            "train",
            "data",
            "--steps",
            "120",
            "--max-splats",
            "60000",
            "--out",
            "disk/out",
        ]);
        train
            .args(["--checkpoint-secs", "0"])
            .env("TMPDIR", temporary)
            .current_dir(folder);
        train.output().unwrap()
    };
    let output = train(&temporary);
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{printed}");
    assert!(
        printed.contains("cannot save the model in disk/out; it was saved in "),
        "{printed}"
    );
    let saved = std::fs::read_dir(&temporary)
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    expect_model(
        folder,
        saved.strip_prefix(folder).unwrap().to_str().unwrap(),
    );
    assert!(
        !disk.join("out/.model.fieldrig.part").exists(),
        "the incomplete file is removed"
    );

    std::fs::remove_dir_all(disk.join("out")).unwrap();
    let output = train(&disk);
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{printed}");
    assert!(
        printed.contains("cannot save the model in disk/out; no checkpoint was written yet"),
        "{printed}"
    );
}
