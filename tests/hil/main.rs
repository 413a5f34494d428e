//! Hardware in the loop without hardware: the production drivers against the kernel's own test devices (vivid, vcan), in a
//! User-Mode Linux kernel, and against CAN cards that QEMU plays, in a kernel with their driver; both are built once.
//!
//! The tests below run on the host: each lays out a root folder with this very program in it, boots a kernel on it and reads its
//! console. Inside, the same program runs the tests of the other files, which are ignored outside: those of `kvaser.rs` in QEMU,
//! the others in User-Mode Linux.

#![expect(clippy::print_stdout, reason = "the report of what was seen in the virtual kernel")]

mod cameras;
mod can;
mod can_motion;
mod kvaser;
#[cfg(feature = "nokhwa")]
mod nokhwa;
mod qemu;
#[cfg(all(feature = "realsense", feature = "sim"))]
mod wire;
mod wire_errors;

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

/// What the User-Mode Linux kernel runs first. Its exit code is told on the console, for a kernel has none.
const INIT: &str = r#"#!/bin/busybox sh
bb=/bin/busybox
$bb mount -t proc proc /proc
$bb mount -t sysfs sysfs /sys
$bb mount -t tmpfs tmp /tmp
$bb ip link set lo up
$bb ip link add dev vcan0 type vcan
$bb ip link set vcan0 up
export LD_LIBRARY_PATH=/lib
/bin/hil --ignored --test-threads=1 --nocapture --skip kvaser::
echo "hil: exit $?"
$bb poweroff -f
"#;

/// What came on a console when all tests inside have passed.
const PASSED: &str = "hil: exit 0";

/// All tests inside take about two minutes on an idle machine.
const MAX_RUN: Duration = Duration::from_secs(420);

/// Two machines at once would take each other's time, and what is tested has times.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// Set to `demand`, a machine that cannot run these tests fails them; `.ci/run` does.
const REQUIRE_HIL_VARIABLE: &str = "FIELDRIG_HIL";

#[test]
fn cameras_and_buses_in_virtual_kernel() {
    run_inside(&[], || {
        let folder = cache_folder();
        let kernel = build_kernel("um", &folder);
        let root = folder.join("root");
        install_root(&root, INIT, &[]);
        #[cfg(all(feature = "realsense", feature = "sim"))]
        wire::install_root(&root);
        boot(&kernel, &root, &folder)
    });
}

#[test]
fn can_cards_in_virtual_machine() {
    run_inside(&[qemu::PROGRAM, qemu::IP], || {
        let folder = cache_folder();
        let kernel = build_kernel("x86", &folder);
        let root = folder.join("root-qemu");
        qemu::install_root(&root);
        qemu::boot(&kernel, &root)
    });
}

/// Runs tests in a machine whose console `boot` returns, unless something is missing here; `extra_files` is what only this machine needs.
fn run_inside(extra_files: &[&str], boot: impl FnOnce() -> String) {
    let is_required = std::env::var(REQUIRE_HIL_VARIABLE).is_ok_and(|value| value == "demand");
    if let Some(reason) = missing_requirement(extra_files) {
        assert!(!is_required, "{REQUIRE_HIL_VARIABLE}=demand, but {reason}");
        // Bypasses the test harness, which hides the output of passing tests.
        let _ = writeln!(std::io::stderr(), "skipped: {reason}");
        return;
    }
    // A test that failed while it had the lock leaves nothing behind that another one could trip over.
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(|failed| failed.into_inner());
    let console = boot();
    // Past what the test harness holds back: the report is to be seen when all is well, too.
    std::io::stderr().write_all(console.as_bytes()).expect("stderr is open");
    assert!(console.contains(PASSED), "the tests in the virtual machine failed; its console is above");
}

/// Why the tests cannot run here.
fn missing_requirement(extra_files: &[&str]) -> Option<String> {
    let release = fs::read_to_string("/etc/os-release").unwrap_or_default();
    let is_bookworm = release.lines().any(|line| line == "VERSION_CODENAME=bookworm");
    if !is_bookworm || !cfg!(target_arch = "x86_64") {
        return Some("the virtual kernels are built of Debian 12's source, on x86-64 only".into());
    }
    // All files that only packages of the group `hil` provide: with only some of them, the kernel's build would fail.
    let required = [
        "/usr/src/linux-source-6.1.tar.xz",
        "/usr/bin/busybox",
        "/usr/bin/make",
        "/usr/bin/flex",
        "/usr/bin/bison",
        "/usr/bin/bc",
        "/usr/bin/xz",
        "/usr/include/libelf.h",
        "/usr/include/openssl/opensslv.h",
    ];
    for required in required.iter().chain(extra_files) {
        if !Path::new(required).exists() {
            return Some(format!("{required} is missing: scripts/install-packages.sh hil"));
        }
    }
    None
}

/// Beside this program, in the target folder.
fn cache_folder() -> PathBuf {
    let program = std::env::current_exe().expect("a program has a path");
    let target = program.ancestors().nth(3).expect("target/debug/deps/hil");
    target.join("hil")
}

/// `kind`: `um` or `x86`.
fn build_kernel(kind: &str, folder: &Path) -> PathBuf {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hil/build-kernel.sh");
    let output =
        Command::new(script).arg(kind).arg(folder).stderr(Stdio::inherit()).output().expect("the script starts");
    assert!(output.status.success(), "the kernel was not built");
    PathBuf::from(String::from_utf8_lossy(&output.stdout).trim())
}

/// A root folder: busybox, this program, `fieldrig`, more programs with their names, and the libraries that all these need.
fn install_root(root: &Path, init_script: &str, extra_files: &[(PathBuf, &str)]) {
    let _ = fs::remove_dir_all(root); // Not there the first time.
    for folder in ["bin", "dev", "lib", "proc", "rigs", "sys", "tmp"] {
        fs::create_dir_all(root.join(folder)).expect("room on the disk");
    }
    fs::copy("/usr/bin/busybox", root.join("bin/busybox")).expect("busybox-static");
    symlink("busybox", root.join("bin/sh")).expect("room on the disk");
    let programs = [
        (std::env::current_exe().expect("a program has a path"), "hil"),
        (PathBuf::from(env!("CARGO_BIN_EXE_fieldrig")), "fieldrig"),
    ];
    let mut libraries = BTreeSet::new();
    for (program, name) in programs.iter().chain(extra_files) {
        fs::copy(program, root.join("bin").join(name)).expect("room on the disk");
        libraries.extend(libraries_of(program));
    }
    for library in libraries {
        let name = library.file_name().expect("a file");
        fs::copy(&library, root.join("lib").join(name)).expect("ldd found it");
        // The dynamic linker is looked for where the programs say, the rest by LD_LIBRARY_PATH.
        if name.to_string_lossy().starts_with("ld-") {
            let path_in_root = root.join(library.strip_prefix("/").expect("ldd prints whole paths"));
            fs::create_dir_all(path_in_root.parent().expect("inside the root")).expect("room on the disk");
            fs::copy(&library, path_in_root).expect("ldd found it");
        }
    }
    for file in ["vivid.toml", "vivid-can.toml", "kvaser.toml", "two.urdf"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hil").join(file);
        fs::copy(from, root.join("rigs").join(file)).expect("room on the disk");
    }
    write_script(&root.join("init"), init_script);
}

fn write_script(path: &Path, script: &str) {
    fs::write(path, script).expect("room on the disk");
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).expect("our own file");
}

/// The libraries that the dynamic linker would load, itself among them.
fn libraries_of(program: &Path) -> BTreeSet<PathBuf> {
    let output = Command::new("ldd").arg(program).output().expect("ldd comes with the C library");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.split_whitespace().filter(|word| word.starts_with('/')).map(PathBuf::from).collect()
}

/// Boots User-Mode Linux and waits for the end; returns what came on the console.
fn boot(kernel: &Path, root: &Path, folder: &Path) -> String {
    let mut command = Command::new(kernel);
    command
        .args(["mem=768M", "rootfstype=hostfs", "ro", "init=/init", "quiet", "panic=1"])
        .arg(format!("rootflags={}", root.display()))
        .args(["con=null", "con0=null,fd:1", "ssl=null"])
        .args(["vivid.n_devs=2", "vivid.node_types=0x1,0x1", "vivid.num_inputs=1,1", "vivid.input_types=0x0,0x1"])
        // The memory of the kernel is a file: /dev/shm is often too small for it.
        .env("TMPDIR", folder)
        .stdin(Stdio::null());
    run(&mut command, |_, _| {})
}

/// Runs a machine to its end, or ends it when that takes too long; returns what came on the console. `on_line` is given each line of it.
fn run(command: &mut Command, mut on_line: impl FnMut(&mut Child, &str)) -> String {
    let mut child =
        command.stdout(Stdio::piped()).stderr(Stdio::inherit()).process_group(0).spawn().expect("it is a program");
    let group = format!("-{}", child.id());
    let mut lines = BufReader::new(child.stdout.take().expect("piped"));
    let (done, done_receiver) = std::sync::mpsc::sync_channel::<()>(0);
    let guard = std::thread::spawn(move || {
        if done_receiver.recv_timeout(MAX_RUN) == Err(RecvTimeoutError::Timeout) {
            // The machine's processes are one group: none of them is left.
            let _ = Command::new("sh").args(["-c", &format!("kill -KILL {group}")]).status();
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
    let _ = child.wait(); // How it ended is told on the console.
    drop(done);
    guard.join().expect("it only waits");
    console
}
