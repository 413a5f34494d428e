//! Hardware in the loop without hardware: the production drivers against the kernel's own test devices (vivid, vcan), in a
//! User-Mode Linux kernel that is built once.
//!
//! The test below runs on the host: it lays out a root folder with this very program in it, boots the kernel on it and reads its
//! console. Inside, the same program runs the tests of `cameras.rs`, `can.rs` and `can_motion.rs`, which are ignored outside.

#![expect(clippy::print_stdout, reason = "the report of what was seen in the virtual kernel")]

mod cameras;
mod can;
mod can_motion;

use std::collections::BTreeSet;
use std::fs;
use std::io::{Read, Write};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// What the kernel runs first. Its exit code is told on the console, for a kernel has none.
const INIT: &str = r#"#!/bin/busybox sh
bb=/bin/busybox
$bb mount -t proc proc /proc
$bb mount -t sysfs sysfs /sys
$bb mount -t tmpfs tmp /tmp
$bb ip link set lo up
$bb ip link add dev vcan0 type vcan
$bb ip link set vcan0 up
export LD_LIBRARY_PATH=/lib
/bin/hil --ignored --test-threads=1 --nocapture
echo "hil: exit $?"
$bb poweroff -f
"#;

/// All tests inside take about 90 s on an idle machine.
const MAX_RUN: Duration = Duration::from_secs(420);

/// Set to `demand`, a machine that cannot run these tests fails them; `.ci/run` does.
const DEMAND: &str = "FIELDRIG_HIL";

#[test]
fn cameras_and_buses_in_a_kernel_of_their_own() {
    let is_demanded = std::env::var(DEMAND).is_ok_and(|value| value == "demand");
    if let Some(why) = missing() {
        assert!(!is_demanded, "{DEMAND}=demand, but {why}");
        eprintln!("skipped: {why}");
        return;
    }
    let folder = cache_folder();
    let kernel = build_kernel(&folder);
    let root = folder.join("root");
    lay_out(&root);
    let console = boot(&kernel, &root, &folder);
    // Past what the test harness holds back: the report is to be seen when all is well, too.
    std::io::stderr().write_all(console.as_bytes()).expect("stderr is open");
    assert!(console.contains("hil: exit 0"), "the tests in the virtual kernel failed; its console is above");
}

/// Why the tests cannot run here.
fn missing() -> Option<String> {
    let release = fs::read_to_string("/etc/os-release").unwrap_or_default();
    let is_bookworm = release.lines().any(|line| line == "VERSION_CODENAME=bookworm");
    if !is_bookworm || !cfg!(target_arch = "x86_64") {
        return Some("the virtual kernel is built of Debian 12's source, on x86-64 only".into());
    }
    for needed in ["/usr/src/linux-source-6.1.tar.xz", "/usr/bin/busybox", "/usr/bin/flex", "/usr/bin/bison"] {
        if !Path::new(needed).exists() {
            return Some(format!("{needed} is missing: scripts/install-packages.sh hil"));
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

fn build_kernel(folder: &Path) -> PathBuf {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hil/build-kernel.sh");
    let output = Command::new(script).arg(folder).stderr(Stdio::inherit()).output().expect("the script starts");
    assert!(output.status.success(), "the kernel was not built");
    PathBuf::from(String::from_utf8_lossy(&output.stdout).trim())
}

/// A root folder: busybox, this program, `fieldrig`, and the libraries that these need.
fn lay_out(root: &Path) {
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
    for (program, name) in programs {
        fs::copy(&program, root.join("bin").join(name)).expect("room on the disk");
        libraries.extend(libraries_of(&program));
    }
    for library in libraries {
        let name = library.file_name().expect("a file");
        fs::copy(&library, root.join("lib").join(name)).expect("ldd found it");
        // The dynamic linker is looked for where the programs say, the rest by LD_LIBRARY_PATH.
        if name.to_string_lossy().starts_with("ld-") {
            let place = root.join(library.strip_prefix("/").expect("ldd prints whole paths"));
            fs::create_dir_all(place.parent().expect("inside the root")).expect("room on the disk");
            fs::copy(&library, place).expect("ldd found it");
        }
    }
    for file in ["vivid.toml", "vivid-can.toml", "two.urdf"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hil").join(file);
        fs::copy(from, root.join("rigs").join(file)).expect("room on the disk");
    }
    let init = root.join("init");
    fs::write(&init, INIT).expect("room on the disk");
    fs::set_permissions(&init, fs::Permissions::from_mode(0o755)).expect("our own file");
}

/// The libraries that the dynamic linker would load, itself among them.
fn libraries_of(program: &Path) -> BTreeSet<PathBuf> {
    let output = Command::new("ldd").arg(program).output().expect("ldd comes with the C library");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    text.split_whitespace().filter(|word| word.starts_with('/')).map(PathBuf::from).collect()
}

/// Boots and waits for the end; returns what came on the console.
fn boot(kernel: &Path, root: &Path, folder: &Path) -> String {
    let mut child = Command::new(kernel)
        .args(["mem=768M", "rootfstype=hostfs", "ro", "init=/init", "quiet", "panic=1"])
        .arg(format!("rootflags={}", root.display()))
        .args(["con=null", "con0=null,fd:1", "ssl=null"])
        .args(["vivid.n_devs=2", "vivid.node_types=0x1,0x1", "vivid.num_inputs=1,1", "vivid.input_types=0x0,0x1"])
        // The memory of the kernel is a file: /dev/shm is often too small for it.
        .env("TMPDIR", folder)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::inherit())
        .process_group(0)
        .spawn()
        .expect("the kernel is a program");
    let mut console = child.stdout.take().expect("piped");
    let reader = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = console.read_to_end(&mut bytes); // What came before an error is what there is.
        String::from_utf8_lossy(&bytes).replace('\r', "")
    });
    let began = Instant::now();
    while child.try_wait().expect("our own child").is_none() {
        if began.elapsed() > MAX_RUN {
            // The kernel's processes are one group: none of them is left.
            let _ = Command::new("kill").args(["-KILL", "--", &format!("-{}", child.id())]).status();
            let _ = child.wait();
            break;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    reader.join().expect("the reader only reads")
}
