//! Host side: boots a machine in QEMU with two Kvaser PCI cards on one CAN bus, and injects faults
//! into their chips.
//!
//! QEMU's chip (SJA1000, `hw/net/can/can_sja1000.c`) produces no errors: it never sets the status
//! bits for errors and bus-off or their interrupts, and its error counters always read 0. The tests
//! therefore set these bits from outside in the memory of QEMU, as a debugger would. Everything
//! else runs in the kernel's driver for real chips and the layers above it.

use super::{run, write_script};
use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use std::fs;
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Paths of QEMU: the path of its installed package, and the path to which `scripts/fetch-qemu.sh`
/// unpacks QEMU otherwise.
const PROGRAMS: [&str; 2] = [
    "/usr/bin/qemu-system-x86_64",
    concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/.deps/qemu/usr/bin/qemu-system-x86_64"
    ),
];
/// The `ip` of busybox does not support bit rates.
pub(crate) const IP: &str = "/usr/sbin/ip";

/// First process in the root folder. It ends QEMU by restarting the machine, because of the option
/// `-no-reboot`.
const INIT: &str = r#"#!/bin/busybox sh
bb=/bin/busybox
$bb mount -t proc proc /proc
$bb mount -t sysfs sysfs /sys
$bb mount -t devtmpfs dev /dev
$bb mount -t tmpfs tmp /tmp
$bb stty -echo
export LD_LIBRARY_PATH=/lib PATH=/bin
/bin/hil --ignored --test-threads=1 --nocapture kvaser::
echo "hil: exit $?"
$bb reboot -f
"#;

/// Stands in for `sudo`, which the printed commands use; all processes here run as root. The
/// explicit path bypasses the commands of busybox.
const SUDO: &str = "#!/bin/busybox sh\nexec /bin/\"$@\"\n";

/// Request for fault injection from a test inside: interface, status bits and interrupt bits, both
/// hexadecimal.
pub(crate) const INJECT: &str = "hil: inject ";
/// Answer to a successful request.
pub(crate) const INJECTED: &str = "injected";
/// With these values in the last half of its acceptance registers, a chip accepts all frames. The
/// first half is then available for the interface name.
pub(crate) const ACCEPT_ALL: [u8; 4] = [0xFF; 4];
/// Bits of the status register for errors and bus-off.
const STATUS_ERRORS: u8 = 0xC0;

/// The path of QEMU; if it is missing, the path of the installed package.
pub(crate) fn program() -> &'static str {
    PROGRAMS
        .into_iter()
        .find(|path| Path::new(path).exists())
        .unwrap_or(PROGRAMS[0])
}

pub(crate) fn install_root(root: &Path) {
    super::install_root(root, INIT, &[(PathBuf::from(IP), "ip")]);
    write_script(&root.join("bin/sudo"), SUDO);
}

/// Boots the machine, waits until it ends, and returns the console output. `kernel` is the folder
/// of `debian-kernel.sh`.
pub(crate) fn boot(kernel: &Path, root: &Path) -> String {
    let mut command = Command::new(program());
    command
        .args([
            "-machine", "pc", "-accel", "tcg", "-cpu", "max", "-smp", "1", "-m", "768",
        ])
        .args([
            "-nodefaults",
            "-no-user-config",
            "-display",
            "none",
            "-no-reboot",
            "-serial",
            "stdio",
        ])
        .args([
            "-object",
            "can-bus,id=bus",
            "-device",
            "kvaser_pci,canbus=bus",
            "-device",
            "kvaser_pci,canbus=bus",
        ])
        .arg("-fsdev")
        .arg(format!(
            "local,id=root,path={},security_model=none,readonly=on",
            root.display()
        ))
        .args(["-device", "virtio-9p-pci,fsdev=root,mount_tag=root"])
        .arg("-kernel")
        .arg(kernel.join("vmlinuz"))
        .arg("-initrd")
        .arg(kernel.join("initrd"))
        .args(["-append", "console=ttyS0 quiet panic=-1 no_timer_check"])
        .stdin(Stdio::piped());
    run(&mut command, |machine, line| {
        if let Some((_, request)) = line.split_once(INJECT) {
            let answer = match inject_fault(machine, request.trim()) {
                Ok(()) => INJECTED.to_owned(),
                Err(error) => format!("not injected: {error}"),
            };
            // If writing fails, the machine has ended; its console shows why.
            let _ = writeln!(machine.stdin.as_mut().expect("piped"), "{answer}");
        }
    })
}

/// A machine that does not run while this value exists.
///
/// A running chip could change its registers between the reads and the writes of [`inject_fault`],
/// above all on a busy host. An interrupt that the driver has just handled would then be pending
/// again, without a cause that the driver could remove, and the machine would hang.
struct Suspended(Pid);

impl Suspended {
    fn new(machine: &Child) -> std::io::Result<Self> {
        let pid = Pid::from_child(machine);
        kill_process(pid, Signal::STOP)?;
        let suspended = Self(pid);
        let stopped = waitpid(Some(pid), WaitOptions::UNTRACED)?;
        match stopped {
            Some((_, status)) if status.stopped() => Ok(suspended),
            _ => Err(std::io::Error::other("the machine has ended")),
        }
    }
}

impl Drop for Suspended {
    fn drop(&mut self) {
        // If this fails, the machine has ended.
        let _ = kill_process(self.0, Signal::CONT);
    }
}

/// Sets the error bits in the status of a chip and adds pending interrupts.
///
/// The chip is located by its acceptance registers, which contain the interface name. In QEMU's
/// memory, the bytes before them are mode, status, interrupts, enabled interrupts, number of
/// waiting messages, their position, and clock divider.
fn inject_fault(machine: &Child, request: &str) -> std::io::Result<()> {
    let words: Vec<&str> = request.split(' ').collect();
    let &[interface, status, interrupts] = words.as_slice() else {
        panic!("expected three words, got {request}")
    };
    let [status, interrupts] =
        [status, interrupts].map(|hex| u8::from_str_radix(hex, 16).expect("hexadecimal"));
    let _suspended = Suspended::new(machine)?;
    let id = machine.id();
    let maps = fs::read_to_string(format!("/proc/{id}/maps"))?;
    let heap = maps
        .lines()
        .find(|line| line.ends_with("[heap]"))
        .expect("QEMU has a heap");
    let (from, to) = heap
        .split_once(' ')
        .and_then(|(range, _)| range.split_once('-'))
        .expect("FROM-TO");
    let [from, to] = [from, to].map(|hex| u64::from_str_radix(hex, 16).expect("hexadecimal"));
    let memory = fs::OpenOptions::new()
        .read(true)
        .write(true)
        .open(format!("/proc/{id}/mem"))?;
    let mut bytes = vec![0; usize::try_from(to - from).expect("64 bits")];
    memory.read_exact_at(&mut bytes, from)?;
    let acceptance = [interface.as_bytes(), &ACCEPT_ALL].concat();
    // In the mode that the driver uses, the highest bit of the clock divider is set. It is not set
    // in other copies of these bytes in memory.
    let is_chip = |at: &usize| bytes[*at..].starts_with(&acceptance) && bytes[*at - 1] & 0x80 != 0;
    let found: Vec<usize> = (7..bytes.len() - acceptance.len())
        .filter(is_chip)
        .collect();
    let &[at] = found.as_slice() else {
        return Err(std::io::Error::other(format!(
            "{interface} is {} times in QEMU's memory",
            found.len()
        )));
    };
    let (status_at, interrupts_at) = (at - 6, at - 5);
    memory.write_all_at(
        &[bytes[status_at] & !STATUS_ERRORS | status],
        from + status_at as u64,
    )?;
    memory.write_all_at(
        &[bytes[interrupts_at] | interrupts],
        from + interrupts_at as u64,
    )
}
