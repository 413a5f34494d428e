//! `fieldrig doctor`: checks this computer for a rig and names a remedy for each problem.

mod franka;
mod listen;

use super::number_in_range;
use crate::exit::Exit;
use crate::open_gpu::open_gpu;
use crate::{print, signals};
use capture::config::{ArmDriver, BaseDriver, Camera, CameraDriver, Rig, ScannerDriver};
use capture::open;
#[cfg(target_os = "linux")]
use drivers::v4l2;
use serde::Serialize;
use std::net::{TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use trainer::gpu::Gpu;

/// Enough for a model of a million splats with its keyframes and the optimizer state.
const SUFFICIENT_MEMORY_KIB: u64 = 4 << 20;
/// Default address of the page that `run` serves.
const DEFAULT_ADDRESS: &str = "127.0.0.1:7007";
/// Stamps are compared with the readout time of an image row, tens of microseconds.
const MAX_CLOCK_STEP: Duration = Duration::from_micros(1);

/// Flags of `doctor`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file; its devices are checked, too
    rig: Option<PathBuf>,
    /// Then read the rig's devices for S seconds and print rates, latencies and losses; nothing is moved
    #[arg(long, value_name = "S", requires = "rig", value_parser = number_in_range(1.0..=3600.0))]
    listen: Option<f64>,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Ok,
    Warn,
    Fail,
}

/// Result of one check.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct Finding {
    check: &'static str,
    verdict: Verdict,
    message: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    remedy: Option<String>,
}

impl Finding {
    fn ok(check: &'static str, message: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Ok, message: message.into(), remedy: None }
    }

    fn warn(check: &'static str, message: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Warn, message: message.into(), remedy: Some(remedy.into()) }
    }

    fn fail(check: &'static str, message: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Fail, message: message.into(), remedy: Some(remedy.into()) }
    }
}

/// Runs all checks; the exit code is 1 if one fails.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let rig = args.rig.as_ref().map(|path| Rig::load(path, &[])).transpose()?;
    let mut findings = gpu();
    findings.push(simulation());
    findings.push(clock());
    findings.push(clock_source(Path::new("/sys")));
    findings.extend(governor(Path::new("/sys")));
    findings.push(memory(Path::new("/proc")));
    findings.push(realtime(Path::new("/proc")));
    findings.push(cameras(Path::new("/dev")));
    #[cfg(target_os = "linux")]
    findings.extend(v4l2::cameras().into_iter().flatten().filter_map(|camera| usb(&camera)));
    #[cfg(target_os = "linux")]
    findings.extend(rig.iter().flat_map(missing_v4l2));
    findings.extend(realsense(rig.as_ref()));
    findings.extend(can(rig.as_ref()));
    findings.extend(franka::franka(rig.as_ref()));
    findings.push(port(DEFAULT_ADDRESS));
    findings.extend(rig.iter().filter_map(motion));
    findings.extend(rig.iter().flat_map(|rig| senders(rig).into_iter().chain(files(rig))));
    print_findings(&findings, args.json)?;
    if let (Some(rig), Some(secs)) = (&rig, args.listen) {
        let result = listen::listen(rig, secs, &signals::stop_on_signals()?)?;
        for device in &result.devices {
            if args.json {
                print::json(device)?;
            } else {
                print::line(device)?;
            }
        }
        print_findings(&result.findings, args.json)?;
        findings.extend(result.findings);
    }
    let failed = findings.iter().any(|finding| finding.verdict == Verdict::Fail);
    Ok(if failed { Exit::Failed } else { Exit::Done })
}

fn print_findings(findings: &[Finding], as_json: bool) -> anyhow::Result<()> {
    for finding in findings {
        if as_json {
            print::json(finding)?;
            continue;
        }
        let label = match finding.verdict {
            Verdict::Ok => "ok  ",
            Verdict::Warn => "warn",
            Verdict::Fail => "fail",
        };
        print::line(format_args!("{label}  {:12} {}", finding.check, finding.message))?;
        if let Some(remedy) = &finding.remedy {
            print::line(format_args!("      {:12} -> {remedy}", ""))?;
        }
    }
    Ok(())
}

fn gpu() -> Vec<Finding> {
    let gpu = match open_gpu() {
        Ok(gpu) => gpu,
        Err(error) => {
            let adapters = Gpu::adapters();
            let remedy = if adapters.is_empty() {
                "sudo apt-get install -y libvulkan1 mesa-vulkan-drivers   (a software adapter; a GPU needs its own driver)"
                    .to_owned()
            } else {
                format!("unset FIELDRIG_GPU, or set it to one of: {}", numbered(&adapters))
            };
            return vec![Finding::fail("gpu", error.to_string(), remedy)];
        }
    };
    let adapter = if gpu.is_software() {
        let remedy = "training is slow on a software adapter: install the Vulkan driver of the GPU, if there is one";
        Finding::warn("gpu", gpu.describe(), remedy)
    } else {
        Finding::ok("gpu", gpu.describe())
    };
    let optional = gpu.optional();
    let lanes = optional.subgroup_lanes.map_or("none".to_owned(), |lanes| lanes.to_string());
    let timestamps = if optional.timestamps { "yes" } else { "no: times per pass are unavailable" };
    let mib = gpu.max_binding_bytes() >> 20;
    let message = format!("largest buffer {mib} MiB, subgroup lanes {lanes}, timestamps {timestamps}");
    let mut findings = vec![adapter, Finding::ok("gpu limits", message)];
    let adapters = Gpu::adapters();
    if adapters.len() > 1 {
        findings.push(Finding::ok("gpus", format!("{}; FIELDRIG_GPU=N selects one", numbered(&adapters))));
    }
    findings
}

fn numbered(names: &[String]) -> String {
    let names: Vec<_> = names.iter().enumerate().map(|(ix, name)| format!("{ix}: {name}")).collect();
    names.join(", ")
}

fn simulation() -> Finding {
    if cfg!(feature = "sim") {
        Finding::ok("simulation", "MuJoCo is built in")
    } else {
        let remedy = "make deps && cargo build --release --features sim";
        Finding::warn("simulation", "built without MuJoCo: `--sim` is not available", remedy)
    }
}

/// Measures the smallest step of the monotonic clock.
fn clock() -> Finding {
    let mut min_step = Duration::MAX;
    for _ in 0..1000 {
        let start = Instant::now();
        let step = loop {
            let step = start.elapsed();
            if !step.is_zero() {
                break step;
            }
        };
        min_step = min_step.min(step);
    }
    let message = format!("monotonic clock, steps of {min_step:?}");
    if min_step <= MAX_CLOCK_STEP {
        Finding::ok("clock", message)
    } else {
        Finding::warn("clock", message, "stamps are equally coarse: use another clock source, see below")
    }
}

fn clock_source(sys: &Path) -> Finding {
    let folder = sys.join("devices/system/clocksource/clocksource0");
    let Ok(current) = std::fs::read_to_string(folder.join("current_clocksource")) else {
        return Finding::ok("clock source", "not reported by the kernel");
    };
    let current = current.trim();
    if matches!(current, "hpet" | "acpi_pm" | "pit" | "jiffies") {
        let remedy = format!("echo tsc | sudo tee {}", folder.join("current_clocksource").display());
        return Finding::warn("clock source", format!("{current}: slow to read"), remedy);
    }
    Finding::ok("clock source", current)
}

/// The CPU frequency governor, if the machine has one.
fn governor(sys: &Path) -> Option<Finding> {
    let governor = std::fs::read_to_string(sys.join("devices/system/cpu/cpu0/cpufreq/scaling_governor")).ok()?;
    let governor = governor.trim();
    Some(match governor {
        "performance" => Finding::ok("governor", governor),
        _ => Finding::warn(
            "governor",
            format!("{governor}: latencies vary"),
            "sudo cpupower frequency-set -g performance",
        ),
    })
}

fn memory(proc: &Path) -> Finding {
    let Some(available_kib) = field(&proc.join("meminfo"), "MemAvailable:").and_then(|kib| kib.parse::<u64>().ok())
    else {
        return Finding::ok("memory", "not reported by the kernel");
    };
    let message = format!("{} MiB available", available_kib >> 10);
    if available_kib >= SUFFICIENT_MEMORY_KIB {
        Finding::ok("memory", message)
    } else {
        Finding::warn("memory", message, "close other programs, or lower max_keyframes and max_splats in the rig file")
    }
}

/// The real-time priority that this user may request; arms at 1 kHz need it.
fn realtime(proc: &Path) -> Finding {
    let limit = field(&proc.join("self/limits"), "Max realtime priority");
    match limit.as_deref() {
        None => Finding::ok("real time", "not reported by the kernel"),
        Some("0") => {
            let message = "real-time priority is not allowed; only arms controlled at 1 kHz need it";
            let remedy = r#"echo "$USER - rtprio 99" | sudo tee -a /etc/security/limits.conf, then log in again"#;
            Finding::warn("real time", message, remedy)
        }
        Some(limit) => Finding::ok("real time", format!("priority up to {limit}")),
    }
}

/// The first word after `key` at the start of a line.
fn field(file: &Path, key: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let rest = text.lines().find_map(|line| line.strip_prefix(key))?;
    rest.split_whitespace().next().map(str::to_owned)
}

/// Whether the video devices can be opened.
fn cameras(dev: &Path) -> Finding {
    let mut nodes: Vec<PathBuf> = std::fs::read_dir(dev)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("video")))
        .collect();
    nodes.sort_unstable();
    let denied: Vec<String> = nodes
        .iter()
        .filter(|node| {
            let opened = std::fs::File::options().read(true).write(true).open(node);
            opened.is_err_and(|error| error.kind() == std::io::ErrorKind::PermissionDenied)
        })
        .map(|node| node.display().to_string())
        .collect();
    if denied.is_empty() {
        return Finding::ok("cameras", format!("{} video devices, all accessible", nodes.len()));
    }
    let message = format!("no permission to open {}", denied.join(", "));
    Finding::warn("cameras", message, "sudo usermod -aG video $USER, then log in again")
}

/// Whether the USB port has enough bandwidth for all modes of a camera.
#[cfg(target_os = "linux")]
fn usb(camera: &v4l2::FoundCamera) -> Option<Finding> {
    let bandwidth = format!("{:.1} MB/s", camera.usb_bytes_per_sec()? * 1e-6);
    let name = format!("{} ({})", camera.name, camera.node.display());
    let unsupported = camera.modes_exceeding_usb();
    if unsupported.is_empty() {
        return Some(Finding::ok("usb", format!("{name}: its port carries {bandwidth}, enough for all modes")));
    }
    let message = format!("{name}: its port carries at most {bandwidth}, too little for {}", unsupported.join(", "));
    let remedy = "use v4l2.format = \"mjpeg\", a smaller size, a lower rate, or a USB 3 port; `lsusb -t` shows which devices share a port";
    Some(Finding::warn("usb", message, remedy))
}

/// V4L2 cameras of a rig that are not connected.
#[cfg(target_os = "linux")]
fn missing_v4l2(rig: &Rig) -> Vec<Finding> {
    let cameras = rig.cameras.iter().filter(|camera| camera.driver == CameraDriver::V4l2);
    let devices = cameras.flat_map(|camera| {
        let depth = camera.depth.as_ref().map(|depth| &depth.device);
        std::iter::once(&camera.device).chain(depth).map(move |device| (&camera.name, device))
    });
    let missing = devices.filter_map(|(name, device)| {
        let problem = v4l2::check_connected(device).err()?;
        Some(Finding::fail(
            "cameras",
            format!("camera {name:?}: {problem}"),
            "connect it, or change the device in the rig file",
        ))
    });
    missing.collect()
}

/// Checks connected RealSense cameras, and whether those of the rig are connected.
#[cfg(feature = "realsense")]
fn realsense(rig: Option<&Rig>) -> Vec<Finding> {
    const CHECK: &str = "realsense";
    let found = match drivers::realsense::cameras() {
        Ok(found) => found,
        Err(problem) => {
            return vec![Finding::fail(CHECK, problem.to_string(), "install the udev rules of the RealSense SDK")];
        }
    };
    let mut findings = Vec::new();
    for camera in &found {
        let name = format!("{} {}", camera.name, camera.serial);
        if camera.is_on_usb2() {
            let remedy = "use a USB 3 port and the original cable; turn the plug over";
            findings.push(Finding::warn(
                CHECK,
                format!("{name}: runs at USB 2, which carries few of its modes"),
                remedy,
            ));
        }
        if camera.has_old_firmware() {
            let recommended = camera.recommended_firmware.as_deref().unwrap_or_default();
            let message =
                format!("{name}: firmware {} is older than the library recommends ({recommended})", camera.firmware);
            findings.push(Finding::warn(CHECK, message, "update it with rs-fw-update of the RealSense SDK"));
        }
        if !camera.is_on_usb2() && !camera.has_old_firmware() {
            findings.push(Finding::ok(CHECK, format!("{name}, firmware {}", camera.firmware)));
        }
    }
    for camera in realsense_of(rig) {
        let is_connected = found.iter().any(|device| camera.device.is_empty() || device.serial == camera.device);
        if !is_connected {
            let message = format!("camera {:?}: no RealSense camera {:?} is connected", camera.name, camera.device);
            findings.push(Finding::fail(CHECK, message, "list the connected cameras with fieldrig devices"));
        }
    }
    findings
}

#[cfg(not(feature = "realsense"))]
fn realsense(rig: Option<&Rig>) -> Vec<Finding> {
    let missing = realsense_of(rig).map(|camera| {
        let message = format!("camera {:?}: this program was built without RealSense support", camera.name);
        let remedy = "install the RealSense SDK (librealsense2), then cargo build --release --features realsense";
        Finding::fail("realsense", message, remedy)
    });
    missing.collect()
}

/// RealSense cameras of a rig, without those that play back a file.
fn realsense_of(rig: Option<&Rig>) -> impl Iterator<Item = &Camera> {
    let cameras = rig.map_or(&[][..], |rig| &rig.cameras).iter();
    cameras.filter(|camera| camera.driver == CameraDriver::Realsense && camera.realsense.file.as_os_str().is_empty())
}

/// Checks the settings of CAN interfaces: those in the rig against the rig file, the others in general.
#[cfg(target_os = "linux")]
fn can(rig: Option<&Rig>) -> Vec<Finding> {
    use drivers::can::{BusConfig, Link, interfaces};
    let named = rig.map_or(&[][..], |rig| &rig.arm.buses);
    let others =
        interfaces(Path::new("/sys")).into_iter().filter(|name| !named.iter().any(|bus| bus.interface == *name));
    let mut findings = Vec::new();
    for (interface, bus) in
        named.iter().map(|bus| (bus.interface.clone(), Some(bus))).chain(others.map(|name| (name, None)))
    {
        let link = match Link::read(&interface) {
            Ok(link) => link,
            Err(error) => {
                findings.push(Finding::fail("can", error.to_string(), "list the CAN interfaces with fieldrig devices"));
                continue;
            }
        };
        let default_config = BusConfig {
            interface,
            bitrate_hz: link.bitrate_hz.unwrap_or(1_000_000),
            data_bitrate_hz: link.data_bitrate_hz,
            accept_no_restart: false,
        };
        let problems = link.problems(bus.unwrap_or(&default_config));
        if problems.is_empty() {
            findings.push(Finding::ok("can", link.to_string()));
        }
        findings.extend(problems.into_iter().map(|link_problem| {
            let message = format!("{}: {}", link.interface, link_problem.problem);
            match bus {
                Some(_) => Finding::fail("can", message, link_problem.command),
                None => Finding::warn("can", message, link_problem.command),
            }
        }));
    }
    findings
}

#[cfg(not(target_os = "linux"))]
fn can(_rig: Option<&Rig>) -> Vec<Finding> {
    Vec::new()
}

fn port(address: &str) -> Finding {
    match TcpListener::bind(address) {
        Ok(_) => Finding::ok("network", format!("{address} is free for the page")),
        Err(error) => {
            let remedy = "choose another address: fieldrig run ... --listen 127.0.0.1:7008";
            Finding::warn("network", format!("{address}: {error}"), remedy)
        }
    }
}

/// Whether the UDP addresses of the rig are free to listen on.
fn senders(rig: &Rig) -> Vec<Finding> {
    let base = (rig.base.driver == BaseDriver::Udp).then(|| ("base".to_owned(), rig.base.address));
    let scanners = rig.scanners.iter().filter(|scanner| scanner.driver == ScannerDriver::Udp);
    let scanners = scanners.map(|scanner| (format!("range scanner {:?}", scanner.name), scanner.address));
    let arm = (rig.arm.driver == ArmDriver::Udp).then(|| open::udp_arm_address(rig));
    let (arm, invalid) = match arm {
        Some(Ok(address)) => (Some(("arm".to_owned(), address)), None),
        Some(Err(error)) => {
            (None, Some(Finding::fail("udp", format!("{error:#}"), "arm.address = \"127.0.0.1:7011\"")))
        }
        None => (None, None),
    };
    let addresses = base.into_iter().chain(arm).chain(scanners);
    let findings = addresses
        .map(|(device, address)| match UdpSocket::bind(address) {
            Ok(_) => Finding::ok("udp", format!("{device}: {address} is free to listen on")),
            Err(error) => {
                let message = format!("{device}: {address}: {error}");
                Finding::fail(
                    "udp",
                    message,
                    "another program listens there, perhaps another fieldrig: stop it, or choose another address",
                )
            }
        })
        .chain(invalid);
    findings.collect()
}

/// Whether this kind of arm supports the settings in [arm.motion], as far as can be checked without the arm.
fn motion(rig: &Rig) -> Option<Finding> {
    rig.arm.motion.as_ref().filter(|_| matches!(rig.arm.driver, ArmDriver::Can | ArmDriver::Franka))?;
    Some(match open::check_motion(rig) {
        Ok(()) => Finding::ok("motion", "the driver of the arm supports the settings in [arm.motion]"),
        Err(error) => Finding::fail(
            "motion",
            format!("{error:#}"),
            "docs/guide/moving-arms.md describes the keys of [arm.motion]",
        ),
    })
}

/// Whether the files that RealSense cameras play back exist.
fn files(rig: &Rig) -> Vec<Finding> {
    let missing = |camera: &&Camera| {
        let file = &camera.realsense.file;
        camera.driver == CameraDriver::Realsense && !file.as_os_str().is_empty() && !file.is_file()
    };
    let missing_file = |camera: &Camera| {
        let message = format!("camera {:?}: the file {} does not exist", camera.name, camera.realsense.file.display());
        Finding::fail("realsense", message, "camera.NAME.realsense.file is relative to the folder of the rig file")
    };
    rig.cameras.iter().filter(missing).map(missing_file).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder_with(path: &str, text: &str) -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("folder");
        let file = root.path().join(path);
        std::fs::create_dir_all(file.parent().expect("inside root")).expect("folder");
        std::fs::write(file, text).expect("file");
        root
    }

    #[test]
    fn low_memory_is_reported() {
        let low = folder_with("meminfo", "MemTotal:  8000000 kB\nMemAvailable:  1048576 kB\n");
        assert_eq!(memory(low.path()).verdict, Verdict::Warn);
        assert!(memory(low.path()).message.contains("1024 MiB"));
        let plenty = folder_with("meminfo", "MemTotal:  8000000 kB\nMemAvailable:  7000000 kB\n");
        assert_eq!(memory(plenty.path()).verdict, Verdict::Ok);
    }

    #[test]
    fn missing_real_time_priority_is_reported_with_remedy() {
        let denied =
            folder_with("self/limits", "Max nice priority         0          0\nMax realtime priority     0       0\n");
        let finding = realtime(denied.path());
        assert_eq!(finding.verdict, Verdict::Warn);
        assert!(finding.remedy.expect("a remedy").contains("rtprio"));
        let allowed = folder_with("self/limits", "Max realtime priority     99      99\n");
        assert_eq!(realtime(allowed.path()).verdict, Verdict::Ok);
    }

    #[test]
    fn slow_clock_source_is_reported() {
        let path = "devices/system/clocksource/clocksource0/current_clocksource";
        assert_eq!(clock_source(folder_with(path, "hpet\n").path()).verdict, Verdict::Warn);
        assert_eq!(clock_source(folder_with(path, "tsc\n").path()).verdict, Verdict::Ok);
    }

    #[test]
    fn insufficient_usb_bandwidth_is_reported() {
        let mut camera = v4l2::FoundCamera {
            node: "/dev/video0".into(),
            name: "1440p".into(),
            bus: "usb-1".into(),
            serial: None,
            links: Vec::new(),
            usb_mbits: Some(480.0),
            modes: vec![v4l2::Mode::new(v4l2::V4l2Format::Yuyv, [2560, 1440], &[30.0])],
        };
        let finding = usb(&camera).expect("a camera on USB");
        assert_eq!(finding.verdict, Verdict::Warn);
        assert!(finding.message.contains("24.6 MB/s") && finding.message.contains("221 MB/s"), "{}", finding.message);
        camera.usb_mbits = Some(5000.0);
        assert_eq!(usb(&camera).expect("a camera on USB").verdict, Verdict::Ok);
        camera.usb_mbits = None;
        assert_eq!(usb(&camera), None);
    }

    #[test]
    fn occupied_port_is_reported() {
        let occupied = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = occupied.local_addr().expect("bound").to_string();
        assert_eq!(port(&address).verdict, Verdict::Warn);
        drop(occupied);
        assert_eq!(port(&address).verdict, Verdict::Ok);
    }

    #[test]
    fn occupied_udp_ports_and_missing_files_are_reported() {
        let occupied = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let overrides = [
            capture::Override::new("base.driver", "udp"),
            capture::Override::new("base.address", occupied.local_addr().expect("bound").to_string()),
            capture::Override::new("camera.wrist.driver", "realsense"),
            capture::Override::new("camera.wrist.realsense.file", "nowhere.bag"),
        ];
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
        let rig = Rig::load(&path, &overrides).expect("a bundled rig file");
        assert_eq!(senders(&rig).iter().map(|finding| finding.verdict).collect::<Vec<_>>(), [Verdict::Fail]);
        drop(occupied);
        assert_eq!(senders(&rig).iter().map(|finding| finding.verdict).collect::<Vec<_>>(), [Verdict::Ok]);
        let findings = files(&rig);
        assert!(findings.len() == 1 && findings[0].message.contains("nowhere.bag"), "{findings:?}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn invalid_rig_is_reported_without_opening_devices() {
        let rig = |name: &str, overrides: &[(&'static str, &'static str)]| {
            let overrides: Vec<_> = overrides.iter().map(|(key, value)| capture::Override::new(key, *value)).collect();
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs").join(name);
            Rig::load(&path, &overrides).expect("a bundled rig file")
        };
        let absent =
            rig("static-arm.toml", &[("camera.wrist.driver", "v4l2"), ("camera.wrist.device", "no such serial")]);
        let findings = missing_v4l2(&absent);
        assert!(findings.iter().any(|finding| finding.message.contains("\"no such serial\"")), "{findings:?}");
        let findings = senders(&rig("static-arm.toml", &[("arm.driver", "udp"), ("arm.address", "localhost")]));
        assert!(findings.len() == 1 && findings[0].message.contains("arm.address is \"localhost\""), "{findings:?}");
        assert_eq!(motion(&rig("static-arm.toml", &[])), None, "the arm is only read");
        for (on_loss, verdict) in [("hold", Verdict::Ok), ("release", Verdict::Fail)] {
            let findings =
                motion(&rig("wire/static-arm.toml", &[("arm.motion.on_loss", on_loss)])).expect("the arm can be moved");
            assert_eq!(findings.verdict, verdict, "{findings:?}");
        }
    }
}
