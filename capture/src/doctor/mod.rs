//! Checks this computer and the devices of a rig, and suggests a remedy for each problem. Nothing
//! is moved.

mod calibration;
#[cfg(target_os = "linux")]
mod can;
mod clock;
mod datagrams;
mod flange;
mod franka;
mod governor;
mod guesses;
mod listen;
mod meaning;
mod memory;
mod meshes;
mod motion;
mod realsense;
mod realtime;
mod remedies;
mod robot_masks;
#[cfg(target_os = "linux")]
mod servos;
#[cfg(target_os = "linux")]
mod ur;
#[cfg(target_os = "linux")]
mod usb;
mod video_devices;

pub use guesses::guesses;
pub use listen::{DeviceStatistics, Latency, ListenResult, listen};
pub use meaning::meaning;
pub use meshes::{meshes, meshes_of};

use crate::config::Rig;
use messages::Setting;
use serde::Serialize;
use std::path::Path;

/// Verdict of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// No problem.
    Ok,
    /// A problem that degrades results.
    Warn,
    /// A problem that prevents a run.
    Fail,
}

/// Result of one check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Name of the check.
    pub check: &'static str,
    /// Verdict of the check.
    pub verdict: Verdict,
    /// Result of the check, as text.
    pub message: String,
    /// Remedy for the problem, often a command; `None` if there is no problem.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remedy: Option<String>,
}

impl Finding {
    /// Creates a finding without a problem.
    pub fn ok(check: &'static str, message: impl Into<String>) -> Self {
        Self {
            check,
            verdict: Verdict::Ok,
            message: message.into(),
            remedy: None,
        }
    }

    /// Creates a finding about a problem that degrades results.
    pub fn warn(
        check: &'static str,
        message: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self {
            check,
            verdict: Verdict::Warn,
            message: message.into(),
            remedy: Some(remedy.into()),
        }
    }

    /// Creates a finding about a problem that prevents a run.
    pub fn fail(
        check: &'static str,
        message: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self {
            check,
            verdict: Verdict::Fail,
            message: message.into(),
            remedy: Some(remedy.into()),
        }
    }

    /// The finding in columns. The remedy has its own line.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let label = match self.verdict {
            Verdict::Ok => "ok  ",
            Verdict::Warn => "warn",
            Verdict::Fail => "fail",
        };
        let mut lines = vec![format!("{label}  {:12} {}", self.check, self.message)];
        let remedy = self.remedy.as_ref();
        lines.extend(remedy.map(|remedy| format!("      {:12} -> {remedy}", "")));
        lines
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.remedy {
            Some(remedy) => write!(f, "{}; {remedy}", self.message),
            None => f.write_str(&self.message),
        }
    }
}

/// Whether this build can simulate rigs.
#[must_use]
pub fn simulation() -> Finding {
    if cfg!(feature = "sim") {
        return Finding::ok("simulation", "MuJoCo is built in");
    }
    Finding::warn(
        "simulation",
        format!(
            "built without MuJoCo: `fieldrig run {}` is not available",
            Setting::Sim
        ),
        "make deps && cargo build --release --features sim",
    )
}

/// Checks clocks, memory, priorities and permissions of this computer. Also checks the devices of
/// `rig` and all connected devices.
pub fn check(rig: Option<&Rig>) -> Vec<Finding> {
    let dev = Path::new("/dev");
    let proc = Path::new("/proc");
    let sys = Path::new("/sys");
    let mut findings = vec![clock::clock(), clock::clock_source(sys)];
    findings.extend(governor::governor(sys));
    findings.extend([
        memory::memory(proc),
        realtime::realtime(proc),
        video_devices::permissions(dev),
    ]);
    #[cfg(target_os = "linux")]
    {
        findings.extend(
            drivers::v4l2::cameras()
                .into_iter()
                .flatten()
                .filter_map(|camera| usb::usb(&camera)),
        );
        findings.extend(rig.into_iter().flat_map(video_devices::missing));
        findings.extend(rig.into_iter().flat_map(video_devices::unstable_nodes));
    }
    findings.extend(realsense::realsense(rig));
    findings.extend(franka::franka(rig));
    #[cfg(target_os = "linux")]
    findings.extend(rig.into_iter().flat_map(ur::ur));
    #[cfg(target_os = "linux")]
    findings.extend(can::can(rig));
    #[cfg(target_os = "linux")]
    findings.extend(rig.into_iter().flat_map(servos::servos));
    findings.extend(rig.and_then(flange::simulator));
    findings.extend(rig.and_then(motion::motion));
    findings.extend(rig.into_iter().flat_map(meshes));
    findings.extend(rig.and_then(robot_masks::known_shape));
    findings.extend(rig.into_iter().flat_map(calibration::missing));
    findings.extend(rig.into_iter().flat_map(calibration::calibration));
    findings.extend(rig.into_iter().flat_map(|rig| {
        datagrams::senders(rig)
            .into_iter()
            .chain(realsense::files(rig))
    }));
    findings
}

/// Warnings about values in a rig file that are probably mistakes, such as lengths in millimeters.
pub fn suspicious_values(rig: &Rig) -> Vec<Finding> {
    calibration::calibration(rig)
}

/// The first word after `key` at the start of a line.
fn field(file: &Path, key: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let rest = text.lines().find_map(|line| line.strip_prefix(key))?;
    rest.split_whitespace().next().map(str::to_owned)
}

#[cfg(test)]
mod testing {
    use crate::{Override, Rig};
    use std::path::Path;

    /// A folder with one file.
    pub(super) fn folder_with(path: &str, text: &str) -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("folder");
        let file = root.path().join(path);
        std::fs::create_dir_all(file.parent().expect("inside root")).expect("folder");
        std::fs::write(file, text).expect("file");
        root
    }

    /// A rig file of the folder `rigs`, with changed keys.
    pub(super) fn bundled_rig<V: Clone + Into<toml::Value>>(
        name: &str,
        overrides: &[(&'static str, V)],
    ) -> Rig {
        let overrides: Vec<_> = overrides
            .iter()
            .map(|(key, value)| Override::new(key, value.clone()))
            .collect();
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../rigs")
            .join(name);
        Rig::load(&path, &overrides).expect("a bundled rig file")
    }
}
