//! Hardware in the loop without hardware. The production drivers run against test devices of the
//! kernel (vivid, vcan) in a User-Mode Linux kernel, which is built once, and against CAN cards
//! emulated by QEMU in Debian's own kernel.
//!
//! The tests in this file run on the host. Each creates a root folder with this program, boots a
//! kernel on it, and reads its console. Inside, the same program runs the tests of the other files,
//! which are ignored on the host: `kvaser.rs` in QEMU, the others in User-Mode Linux.
//!
//! User-Mode Linux uses a simulated clock (`time-travel=inf-cpu`): it advances only while all
//! processes sleep, and then jumps to the next timer. Simulated time is therefore independent of
//! the speed of the host. QEMU runs in real time.

#![expect(
    clippy::print_stdout,
    reason = "tests report results from the virtual kernel"
)]

mod arm_capture;
mod cameras;
mod can;
mod can_motion;
mod guards;
mod kvaser;
#[cfg(feature = "nokhwa")]
mod nokhwa;
mod qemu;
#[cfg(all(feature = "realsense", feature = "sim"))]
mod wire;
mod wire_errors;

use parking_lot::Mutex;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

/// First process in User-Mode Linux. It prints the exit code of the tests to the console, because a
/// kernel has no exit code.
const INIT: &str = r#"#!/bin/busybox sh
bb=/bin/busybox
$bb mount -t proc proc /proc
$bb mount -t sysfs sysfs /sys
$bb mount -t tmpfs tmp /tmp
$bb ip link set lo up
$bb ip link add dev vcan0 type vcan
$bb ip link set vcan0 up
export LD_LIBRARY_PATH=/lib TRIALS
/bin/hil --ignored --test-threads=1 --nocapture --skip kvaser:: FILTER
echo "hil: exit $?"
$bb poweroff -f
"#;

/// Files of the packages in the group `hil` without which User-Mode Linux cannot be built.
const BUILD_FILES: [&str; 6] = [
    "/usr/src/linux-source-6.1.tar.xz",
    "/usr/bin/make",
    "/usr/bin/flex",
    "/usr/bin/bison",
    "/usr/bin/bc",
    "/usr/bin/xz",
];

/// Printed on the console if all tests inside have passed.
const PASSED: &str = "hil: exit 0";

/// Time limit for a virtual machine that hangs. All tests inside take about a minute on an idle
/// host.
const MAX_RUN: Duration = Duration::from_secs(420);

/// The machines must not compete for a processor.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

#[test]
fn cameras_and_buses_in_virtual_kernel() {
    run_inside(&BUILD_FILES, || {
        let folder = root_folder();
        let kernel = kernel("build-kernel.sh");
        let root = folder.join("root");
        let variable =
            |name, default: &str| std::env::var(name).unwrap_or_else(|_| default.to_owned());
        let trials = format!("FIELDRIG_TRIALS={}", variable("FIELDRIG_TRIALS", "3"));
        let init = INIT.replace("TRIALS", &trials);
        // FILTER is empty or the name of a test inside.
        let init = init.replace("FILTER", &variable("FIELDRIG_HIL_FILTER", ""));
        install_root(&root, &init, &[]);
        #[cfg(all(feature = "realsense", feature = "sim"))]
        wire::install_root(&root);
        boot(&kernel, &root, &folder)
    });
}

#[test]
fn can_cards_in_virtual_machine() {
    run_inside(&[qemu::program(), qemu::IP, "/usr/bin/apt-get"], || {
        let folder = root_folder();
        let kernel = kernel("debian-kernel.sh");
        let root = folder.join("root-qemu");
        qemu::install_root(&root);
        qemu::boot(&kernel, &root)
    });
}

/// Runs the tests inside a machine, unless a requirement is missing. `boot` returns the console
/// output. `extra_files` are files that only this machine requires.
fn run_inside(extra_files: &[&str], boot: impl FnOnce() -> String) {
    if let Some(reason) = missing_requirement(extra_files) {
        assert!(!test_support::is_demanded(), "{reason}");
        test_support::skip(reason);
        return;
    }
    let _alone = ONE_AT_A_TIME.lock();
    let console = boot();
    // This output bypasses the test harness, so that the report is also visible if all tests pass.
    std::io::stderr()
        .write_all(console.as_bytes())
        .expect("stderr is open");
    assert!(
        console.contains(PASSED),
        "the tests in the virtual machine failed; its console is above"
    );
}

/// Returns the reason if the tests cannot run here.
fn missing_requirement(extra_files: &[&str]) -> Option<String> {
    let release = fs::read_to_string("/etc/os-release").unwrap_or_default();
    let is_bookworm = release
        .lines()
        .any(|line| line == "VERSION_CODENAME=bookworm");
    if !is_bookworm || !cfg!(target_arch = "x86_64") {
        return Some("the virtual kernels require Debian 12 on x86-64".into());
    }
    for required in ["/usr/bin/busybox"].iter().chain(extra_files) {
        if !Path::new(required).exists() {
            return Some(format!(
                "{required} is missing; run scripts/install-packages.sh hil"
            ));
        }
    }
    None
}

/// Folder for the root folders of the kernels, in the target folder of this program.
fn root_folder() -> PathBuf {
    let program = std::env::current_exe().expect("the path of this program");
    let target = program.ancestors().nth(3).expect("target/debug/deps/hil");
    let folder = target.join("hil");
    fs::create_dir_all(&folder).expect("creating a folder");
    folder
}

/// Path of a kernel, which a script prints. The script builds or downloads the kernel first if
/// necessary.
fn kernel(script: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/hil")
        .join(script);
    let output = Command::new(path)
        .stderr(Stdio::inherit())
        .output()
        .expect("the script starts");
    assert!(output.status.success(), "{script} failed");
    PathBuf::from(String::from_utf8_lossy(&output.stdout).trim())
}

/// Creates a root folder with busybox, this program, `fieldrig`, additional programs, and all
/// required libraries.
fn install_root(root: &Path, init_script: &str, extra_files: &[(PathBuf, &str)]) {
    let _ = fs::remove_dir_all(root); // The folder is missing at the first run.
    for folder in ["bin", "dev", "lib", "proc", "rigs", "sys", "tmp"] {
        fs::create_dir_all(root.join(folder)).expect("creating a folder");
    }
    fs::copy("/usr/bin/busybox", root.join("bin/busybox")).expect("busybox-static");
    symlink("busybox", root.join("bin/sh")).expect("creating a link");
    let programs = [
        (
            std::env::current_exe().expect("the path of this program"),
            "hil",
        ),
        (PathBuf::from(env!("CARGO_BIN_EXE_fieldrig")), "fieldrig"),
    ];
    let mut libraries = BTreeSet::new();
    for (program, name) in programs.iter().chain(extra_files) {
        fs::copy(program, root.join("bin").join(name)).expect("copying a program");
        libraries.extend(libraries_of(program));
    }
    for library in libraries {
        let name = library.file_name().expect("a file");
        fs::copy(&library, root.join("lib").join(name)).expect("ldd found it");
        // Programs contain the absolute path of the dynamic linker. Other libraries are found
        // through LD_LIBRARY_PATH.
        if name.to_string_lossy().starts_with("ld-") {
            let path_in_root = root.join(
                library
                    .strip_prefix("/")
                    .expect("ldd prints absolute paths"),
            );
            fs::create_dir_all(path_in_root.parent().expect("inside the root"))
                .expect("creating a folder");
            fs::copy(&library, path_in_root).expect("ldd found it");
        }
    }
    for file in ["vivid.toml", "vivid-can.toml", "kvaser.toml", "two.urdf"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/hil")
            .join(file);
        fs::copy(from, root.join("rigs").join(file)).expect("copying a file");
    }
    write_script(&root.join("init"), init_script);
}

fn write_script(path: &Path, script: &str) {
    fs::write(path, script).expect("writing a script");
    fs::set_permissions(path, fs::Permissions::from_mode(0o755))
        .expect("changing permissions of the script");
}

/// Libraries loaded by the dynamic linker, including the linker itself.
fn libraries_of(program: &Path) -> BTreeSet<PathBuf> {
    let output = Command::new("ldd")
        .arg(program)
        .output()
        .expect("ldd starts");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.split_whitespace()
        .filter(|word| word.starts_with('/'))
        .map(PathBuf::from)
        .collect()
}

/// Calls `run` on one processor, on which all programs that it starts also run. User-Mode Linux is
/// faster on one processor, because it traces its processes and only one of them runs at a time. On
/// two processors, each system call would wake an idle processor.
fn on_one_processor<T>(run: impl FnOnce() -> T) -> T {
    let allowed = sched_getaffinity(None).expect("the processors of this thread");
    let last = (0..CpuSet::MAX_CPU)
        .rev()
        .find(|&processor| allowed.is_set(processor))
        .expect("one is allowed");
    let mut one = CpuSet::new();
    one.set(last);
    sched_setaffinity(None, &one).expect("an allowed processor");
    let result = run();
    sched_setaffinity(None, &allowed).expect("the same processors as before");
    result
}

/// Boots User-Mode Linux, waits until it ends, and returns the console output.
fn boot(kernel: &Path, root: &Path, folder: &Path) -> String {
    let mut command = Command::new(kernel);
    command
        .args([
            "mem=768M",
            "root=root",
            "rootfstype=hostfs",
            "ro",
            "init=/init",
            "quiet",
            "panic=1",
        ])
        .arg("time-travel=inf-cpu")
        .arg(format!("rootflags={}", root.display()))
        .args(["con=null", "con0=null,fd:1", "ssl=null"])
        .args([
            "vivid.n_devs=2",
            "vivid.node_types=0x1,0x1",
            "vivid.num_inputs=1,1",
            "vivid.input_types=0x0,0x1",
        ])
        // The kernel's memory is a file in this folder, because /dev/shm is often too small.
        .env("TMPDIR", folder)
        .stdin(Stdio::null());
    on_one_processor(|| run(&mut command, |_, _| {}))
}

/// Runs a machine to its end, or kills it after a time limit. Returns the console output. `on_line`
/// is called with each line.
fn run(command: &mut Command, mut on_line: impl FnMut(&mut Child, &str)) -> String {
    let mut child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::inherit())
        .process_group(0)
        .spawn()
        .expect("the machine starts");
    let group = format!("-{}", child.id());
    let mut lines = BufReader::new(child.stdout.take().expect("piped"));
    let (done, done_receiver) = std::sync::mpsc::sync_channel::<()>(0);
    let guard = std::thread::spawn(move || {
        if done_receiver.recv_timeout(MAX_RUN) == Err(RecvTimeoutError::Timeout) {
            // All processes of the machine are in one process group.
            let _ = Command::new("sh")
                .args(["-c", &format!("kill -KILL {group}")])
                .status();
        }
    });
    let mut console = String::new();
    let mut line = Vec::new();
    while lines.read_until(b'\n', &mut line).is_ok_and(|n| n > 0) {
        let text = String::from_utf8_lossy(&line).replace('\r', "");
        on_line(&mut child, &text);
        console += &text;
        line.clear();
    }
    let _ = child.wait(); // The console contains the exit code.
    drop(done);
    guard.join().expect("the guard does not panic");
    console
}
