//! `fieldrig doctor`: what this machine lacks for a rig, each with the line that mends it.

mod franka;
mod listen;

use super::within;
use crate::config::{ArmDriver, BaseDriver, Camera, CameraDriver, Rig, ScannerDriver};
use crate::exit::Exit;
use crate::open;
use crate::print;
use crate::stop::Stop;
#[cfg(target_os = "linux")]
use drivers::v4l2;
use serde::Serialize;
use std::net::{TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use trainer::gpu::Gpu;

/// A model of a million splats with its keyframes and the optimiser's state fits into this.
const ENOUGH_MEMORY_KIB: u64 = 4 << 20;
/// Where `run` serves unless told otherwise.
const USUAL_ADDRESS: &str = "127.0.0.1:7007";
/// Stamps are compared with the time an image row takes, tens of microseconds.
const FINE_CLOCK: Duration = Duration::from_micros(1);

/// Flags of `doctor`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: what it names is checked against what it wants
    rig: Option<PathBuf>,
    /// Then read the rig's devices for S seconds and tell rates, latencies and losses; nothing is moved
    #[arg(long, value_name = "S", requires = "rig", value_parser = within(1.0..=3600.0))]
    listen: Option<f64>,
    /// Print one JSON object a line
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

/// One thing looked at.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct Finding {
    what: &'static str,
    verdict: Verdict,
    says: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    mend: Option<String>,
}

impl Finding {
    fn ok(what: &'static str, says: impl Into<String>) -> Self {
        Self { what, verdict: Verdict::Ok, says: says.into(), mend: None }
    }

    fn warn(what: &'static str, says: impl Into<String>, mend: impl Into<String>) -> Self {
        Self { what, verdict: Verdict::Warn, says: says.into(), mend: Some(mend.into()) }
    }

    fn fail(what: &'static str, says: impl Into<String>, mend: impl Into<String>) -> Self {
        Self { what, verdict: Verdict::Fail, says: says.into(), mend: Some(mend.into()) }
    }
}

/// Checks everything; fails when a finding does.
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
    findings.push(port(USUAL_ADDRESS));
    findings.extend(rig.iter().filter_map(motion));
    findings.extend(rig.iter().flat_map(|rig| senders(rig).into_iter().chain(files(rig))));
    tell(&findings, args.json)?;
    if let (Some(rig), Some(secs)) = (&rig, args.listen) {
        let heard = listen::listen(rig, secs, &Stop::on_ctrl_c()?)?;
        for device in &heard.devices {
            if args.json {
                print::json(device)?;
            } else {
                print::line(device)?;
            }
        }
        tell(&heard.findings, args.json)?;
        findings.extend(heard.findings);
    }
    let failed = findings.iter().any(|finding| finding.verdict == Verdict::Fail);
    Ok(if failed { Exit::Failed } else { Exit::Done })
}

fn tell(findings: &[Finding], as_json: bool) -> anyhow::Result<()> {
    for finding in findings {
        if as_json {
            print::json(finding)?;
            continue;
        }
        let mark = match finding.verdict {
            Verdict::Ok => "ok  ",
            Verdict::Warn => "warn",
            Verdict::Fail => "fail",
        };
        print::line(format_args!("{mark}  {:12} {}", finding.what, finding.says))?;
        if let Some(mend) = &finding.mend {
            print::line(format_args!("      {:12} -> {mend}", ""))?;
        }
    }
    Ok(())
}

fn gpu() -> Vec<Finding> {
    let gpu = match super::open_gpu() {
        Ok(gpu) => gpu,
        Err(error) => {
            let adapters = Gpu::adapters();
            let mend = if adapters.is_empty() {
                "sudo apt-get install -y libvulkan1 mesa-vulkan-drivers   (in software; a GPU needs its own driver)"
                    .to_owned()
            } else {
                format!("unset FIELDRIG_GPU, or let it name one of: {}", numbered(&adapters))
            };
            return vec![Finding::fail("gpu", error.to_string(), mend)];
        }
    };
    let adapter = if gpu.is_software() {
        let mend = "install the Vulkan driver of the GPU, if there is one: training is slow in software";
        Finding::warn("gpu", gpu.describe(), mend)
    } else {
        Finding::ok("gpu", gpu.describe())
    };
    let optional = gpu.optional();
    let lanes = optional.subgroup_lanes.map_or("none".to_owned(), |lanes| lanes.to_string());
    let timestamps = if optional.timestamps { "yes" } else { "no: times per pass are not known" };
    let mib = gpu.max_binding_bytes() >> 20;
    let says = format!("largest buffer {mib} MiB, subgroup lanes {lanes}, timestamps {timestamps}");
    let mut findings = vec![adapter, Finding::ok("gpu limits", says)];
    let adapters = Gpu::adapters();
    if adapters.len() > 1 {
        findings.push(Finding::ok("gpus", format!("{}; FIELDRIG_GPU=N picks one", numbered(&adapters))));
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
        let mend = "make deps && cargo build --release --features sim";
        Finding::warn("simulation", "built without MuJoCo: `--sim` is not there", mend)
    }
}

/// The smallest step the monotonic clock shows.
fn clock() -> Finding {
    let mut finest = Duration::MAX;
    for _ in 0..1000 {
        let start = Instant::now();
        let step = loop {
            let step = start.elapsed();
            if !step.is_zero() {
                break step;
            }
        };
        finest = finest.min(step);
    }
    let says = format!("monotonic clock, steps of {finest:?}");
    if finest <= FINE_CLOCK {
        Finding::ok("clock", says)
    } else {
        Finding::warn("clock", says, "stamps are this coarse: look for another clock source below")
    }
}

fn clock_source(sys: &Path) -> Finding {
    let folder = sys.join("devices/system/clocksource/clocksource0");
    let Ok(current) = std::fs::read_to_string(folder.join("current_clocksource")) else {
        return Finding::ok("clock source", "the kernel does not tell");
    };
    let current = current.trim();
    if matches!(current, "hpet" | "acpi_pm" | "pit" | "jiffies") {
        let mend = format!("echo tsc | sudo tee {}", folder.join("current_clocksource").display());
        return Finding::warn("clock source", format!("{current}: slow to read"), mend);
    }
    Finding::ok("clock source", current)
}

/// The frequency governor, where the machine has one.
fn governor(sys: &Path) -> Option<Finding> {
    let governor = std::fs::read_to_string(sys.join("devices/system/cpu/cpu0/cpufreq/scaling_governor")).ok()?;
    let governor = governor.trim();
    Some(match governor {
        "performance" => Finding::ok("governor", governor),
        _ => {
            Finding::warn("governor", format!("{governor}: delays vary"), "sudo cpupower frequency-set -g performance")
        }
    })
}

fn memory(proc: &Path) -> Finding {
    let Some(available_kib) = field(&proc.join("meminfo"), "MemAvailable:").and_then(|kib| kib.parse::<u64>().ok())
    else {
        return Finding::ok("memory", "the kernel does not tell");
    };
    let says = format!("{} MiB available", available_kib >> 10);
    if available_kib >= ENOUGH_MEMORY_KIB {
        Finding::ok("memory", says)
    } else {
        Finding::warn("memory", says, "close other programs, or lower max_keyframes and max_splats in the rig file")
    }
}

/// The real-time priority this user may ask for, which arms at 1 kHz need.
fn realtime(proc: &Path) -> Finding {
    let limit = field(&proc.join("self/limits"), "Max realtime priority");
    match limit.as_deref() {
        None => Finding::ok("real time", "the kernel does not tell"),
        Some("0") => {
            let says = "real-time priority is not allowed; only arms controlled at 1 kHz need it";
            let mend = r#"echo "$USER - rtprio 99" | sudo tee -a /etc/security/limits.conf, then log in again"#;
            Finding::warn("real time", says, mend)
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

/// Whether the video devices may be opened.
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
        return Finding::ok("cameras", format!("{} video devices, none refused", nodes.len()));
    }
    let says = format!("no permission to open {}", denied.join(", "));
    Finding::warn("cameras", says, "sudo usermod -aG video $USER, then log in again")
}

/// What a camera on USB offers and its port cannot carry.
#[cfg(target_os = "linux")]
fn usb(camera: &v4l2::Found) -> Option<Finding> {
    let carries = format!("{:.1} MB/s", camera.usb_bytes_per_sec()? * 1e-6);
    let name = format!("{} ({})", camera.name, camera.node.display());
    let beyond = camera.beyond_usb();
    if beyond.is_empty() {
        return Some(Finding::ok("usb", format!("{name}: its port carries {carries}, enough for all that it offers")));
    }
    let says = format!("{name}: its port carries {carries} at most, too little for {}", beyond.join(", "));
    let mend = "choose v4l2.format = \"mjpeg\", a smaller size or a lower rate, or a USB 3 port; `lsusb -t` shows who shares one";
    Some(Finding::warn("usb", says, mend))
}

/// V4L2 cameras of a rig that are not plugged in.
#[cfg(target_os = "linux")]
fn missing_v4l2(rig: &Rig) -> Vec<Finding> {
    let cameras = rig.cameras.iter().filter(|camera| camera.driver == CameraDriver::V4l2);
    let devices = cameras.flat_map(|camera| {
        let depth = camera.depth.as_ref().map(|depth| &depth.device);
        std::iter::once(&camera.device).chain(depth).map(move |device| (&camera.name, device))
    });
    let missing = devices.filter_map(|(name, device)| {
        let problem = v4l2::look_for(device).err()?;
        Some(Finding::fail("cameras", format!("camera {name:?}: {problem}"), "plug it in, or name another one"))
    });
    missing.collect()
}

/// RealSense cameras that are plugged in, and whether those of the rig are.
#[cfg(feature = "realsense")]
fn realsense(rig: Option<&Rig>) -> Vec<Finding> {
    const WHAT: &str = "realsense";
    let found = match drivers::realsense::cameras() {
        Ok(found) => found,
        Err(problem) => {
            return vec![Finding::fail(WHAT, problem.to_string(), "install the udev rules of the RealSense SDK")];
        }
    };
    let mut findings = Vec::new();
    for camera in &found {
        let name = format!("{} {}", camera.name, camera.serial);
        if camera.is_on_usb2() {
            let mend = "a USB 3 port and the cable that came with it; turn the plug over once";
            findings.push(Finding::warn(WHAT, format!("{name}: runs at USB 2, which carries few of its modes"), mend));
        }
        if camera.has_old_firmware() {
            let wanted = camera.recommended_firmware.as_deref().unwrap_or_default();
            let says = format!("{name}: firmware {} is older than the library wants ({wanted})", camera.firmware);
            findings.push(Finding::warn(WHAT, says, "rs-fw-update of the RealSense SDK"));
        }
        if !camera.is_on_usb2() && !camera.has_old_firmware() {
            findings.push(Finding::ok(WHAT, format!("{name}, firmware {}", camera.firmware)));
        }
    }
    for camera in realsense_of(rig) {
        let is_there = found.iter().any(|there| camera.device.is_empty() || there.serial == camera.device);
        if !is_there {
            let says = format!("camera {:?}: no RealSense camera {:?} is plugged in", camera.name, camera.device);
            findings.push(Finding::fail(WHAT, says, "fieldrig devices lists those that there are"));
        }
    }
    findings
}

#[cfg(not(feature = "realsense"))]
fn realsense(rig: Option<&Rig>) -> Vec<Finding> {
    let missing = realsense_of(rig).map(|camera| {
        let says = format!("camera {:?}: this program was built without RealSense cameras", camera.name);
        let mend = "install the RealSense SDK (librealsense2), then cargo build --release --features realsense";
        Finding::fail("realsense", says, mend)
    });
    missing.collect()
}

/// RealSense cameras of a rig that are no files.
fn realsense_of(rig: Option<&Rig>) -> impl Iterator<Item = &Camera> {
    let cameras = rig.map_or(&[][..], |rig| &rig.cameras).iter();
    cameras.filter(|camera| camera.driver == CameraDriver::Realsense && camera.realsense.file.as_os_str().is_empty())
}

/// How CAN interfaces are set up: those that the rig names as it wants them, the others in themselves.
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
                findings.push(Finding::fail("can", error.to_string(), "fieldrig devices lists those that there are"));
                continue;
            }
        };
        let own = BusConfig {
            interface,
            bitrate_hz: link.bitrate_hz.unwrap_or(1_000_000),
            data_bitrate_hz: link.data_bitrate_hz,
            accept_no_restart: false,
        };
        let complaints = link.complaints(bus.unwrap_or(&own));
        if complaints.is_empty() {
            findings.push(Finding::ok("can", link.to_string()));
        }
        findings.extend(complaints.into_iter().map(|complaint| {
            let says = format!("{}: {}", link.interface, complaint.what);
            match bus {
                Some(_) => Finding::fail("can", says, complaint.command),
                None => Finding::warn("can", says, complaint.command),
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
            let mend = "name another address: fieldrig run ... --listen 127.0.0.1:7008";
            Finding::warn("network", format!("{address}: {error}"), mend)
        }
    }
}

/// Whether what sends datagrams can be listened to.
fn senders(rig: &Rig) -> Vec<Finding> {
    let base = (rig.base.driver == BaseDriver::Udp).then(|| ("base".to_owned(), rig.base.address));
    let scanners = rig.scanners.iter().filter(|scanner| scanner.driver == ScannerDriver::Udp);
    let scanners = scanners.map(|scanner| (format!("range scanner {:?}", scanner.name), scanner.address));
    let arm = (rig.arm.driver == ArmDriver::Udp).then(|| open::udp_arm_address(rig));
    let (arm, wrong) = match arm {
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
                let says = format!("{device}: {address}: {error}");
                Finding::fail(
                    "udp",
                    says,
                    "another program listens there, a fieldrig perhaps: end it, or name another address",
                )
            }
        })
        .chain(wrong);
    findings.collect()
}

/// Whether the arm can be moved as the rig file wants it, as far as that is known without it.
fn motion(rig: &Rig) -> Option<Finding> {
    rig.arm.motion.as_ref().filter(|_| matches!(rig.arm.driver, ArmDriver::Can | ArmDriver::Franka))?;
    Some(match open::check_motion(rig) {
        Ok(()) => Finding::ok("motion", "[arm.motion] asks for what this kind of arm can do"),
        Err(error) => Finding::fail(
            "motion",
            format!("{error:#}"),
            "docs/guide/moving-arms.md describes the keys of [arm.motion]",
        ),
    })
}

/// Whether the files that cameras play are there.
fn files(rig: &Rig) -> Vec<Finding> {
    let missing = |camera: &&Camera| {
        let file = &camera.realsense.file;
        camera.driver == CameraDriver::Realsense && !file.as_os_str().is_empty() && !file.is_file()
    };
    let tell = |camera: &Camera| {
        let says = format!("camera {:?}: there is no file {}", camera.name, camera.realsense.file.display());
        Finding::fail("realsense", says, "camera.NAME.realsense.file is a path from the rig file's folder")
    };
    rig.cameras.iter().filter(missing).map(tell).collect()
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
    fn little_memory_is_told() {
        let little = folder_with("meminfo", "MemTotal:  8000000 kB\nMemAvailable:  1048576 kB\n");
        assert_eq!(memory(little.path()).verdict, Verdict::Warn);
        assert!(memory(little.path()).says.contains("1024 MiB"));
        let much = folder_with("meminfo", "MemTotal:  8000000 kB\nMemAvailable:  7000000 kB\n");
        assert_eq!(memory(much.path()).verdict, Verdict::Ok);
    }

    #[test]
    fn missing_real_time_priority_is_told_with_its_remedy() {
        let denied =
            folder_with("self/limits", "Max nice priority         0          0\nMax realtime priority     0       0\n");
        let finding = realtime(denied.path());
        assert_eq!(finding.verdict, Verdict::Warn);
        assert!(finding.mend.expect("a remedy").contains("rtprio"));
        let allowed = folder_with("self/limits", "Max realtime priority     99      99\n");
        assert_eq!(realtime(allowed.path()).verdict, Verdict::Ok);
    }

    #[test]
    fn a_slow_clock_source_is_told() {
        let path = "devices/system/clocksource/clocksource0/current_clocksource";
        assert_eq!(clock_source(folder_with(path, "hpet\n").path()).verdict, Verdict::Warn);
        assert_eq!(clock_source(folder_with(path, "tsc\n").path()).verdict, Verdict::Ok);
    }

    #[test]
    fn a_port_too_slow_for_its_camera_is_told() {
        let mut camera = v4l2::Found {
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
        assert!(finding.says.contains("24.6 MB/s") && finding.says.contains("221 MB/s"), "{}", finding.says);
        camera.usb_mbits = Some(5000.0);
        assert_eq!(usb(&camera).expect("a camera on USB").verdict, Verdict::Ok);
        camera.usb_mbits = None;
        assert_eq!(usb(&camera), None);
    }

    #[test]
    fn a_taken_port_is_told() {
        let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = taken.local_addr().expect("bound").to_string();
        assert_eq!(port(&address).verdict, Verdict::Warn);
        drop(taken);
        assert_eq!(port(&address).verdict, Verdict::Ok);
    }

    #[test]
    fn taken_ports_of_senders_and_missing_files_are_told() {
        let taken = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let overrides = [
            crate::config::Override::new("base.driver", "udp"),
            crate::config::Override::new("base.address", taken.local_addr().expect("bound").to_string()),
            crate::config::Override::new("camera.wrist.driver", "realsense"),
            crate::config::Override::new("camera.wrist.realsense.file", "nowhere.bag"),
        ];
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
        let rig = Rig::load(&path, &overrides).expect("a rig file that comes along");
        assert_eq!(senders(&rig).iter().map(|finding| finding.verdict).collect::<Vec<_>>(), [Verdict::Fail]);
        drop(taken);
        assert_eq!(senders(&rig).iter().map(|finding| finding.verdict).collect::<Vec<_>>(), [Verdict::Ok]);
        let told = files(&rig);
        assert!(told.len() == 1 && told[0].says.contains("nowhere.bag"), "{told:?}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn what_opening_would_refuse_is_told_without_opening_it() {
        let rig = |name: &str, overrides: &[(&'static str, &'static str)]| {
            let overrides: Vec<_> =
                overrides.iter().map(|(key, value)| crate::config::Override::new(key, *value)).collect();
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs").join(name);
            Rig::load(&path, &overrides).expect("a rig file that comes along")
        };
        let absent =
            rig("static-arm.toml", &[("camera.wrist.driver", "v4l2"), ("camera.wrist.device", "no such serial")]);
        let told = missing_v4l2(&absent);
        assert!(told.iter().any(|finding| finding.says.contains("\"no such serial\"")), "{told:?}");
        let told = senders(&rig("static-arm.toml", &[("arm.driver", "udp"), ("arm.address", "localhost")]));
        assert!(told.len() == 1 && told[0].says.contains("arm.address is \"localhost\""), "{told:?}");
        assert_eq!(motion(&rig("static-arm.toml", &[])), None, "nothing is moved");
        for (on_loss, verdict) in [("hold", Verdict::Ok), ("release", Verdict::Fail)] {
            let told = motion(&rig("wire/static-arm.toml", &[("arm.motion.on_loss", on_loss)])).expect("it is moved");
            assert_eq!(told.verdict, verdict, "{told:?}");
        }
    }
}
