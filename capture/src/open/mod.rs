//! Opens the devices of a rig file, or a recording, as one source of samples.

mod arm_config;
mod assumed_lens;
#[cfg(feature = "sim")]
mod counted;
#[cfg(all(test, feature = "sim"))]
mod documented_rigs_tests;
#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated;
mod listening;
mod meshes_to_record;
mod movable;
mod real;
mod realsense;
mod robot_tap;
mod servos;
#[cfg(feature = "sim")]
mod simulated;
#[cfg(all(test, feature = "sim"))]
mod simulated_tests;
mod steered;
mod steered_base;
mod steered_robot;
#[cfg(all(test, feature = "sim"))]
mod steered_tests;
mod tag_check;
mod tags;
#[cfg(feature = "sim")]
mod twin;
#[cfg(all(test, feature = "sim"))]
mod twin_tests;
mod ur;

#[cfg(target_os = "linux")]
pub use arm_config::controller_chain;
#[cfg(feature = "sim")]
pub use counted::{CountedArm, counted};
pub(crate) use listening::{DeviceFailure, Listening, for_listening};
pub use meshes_to_record::meshes_to_record;
pub use movable::{Movable, movable};
pub use real::{check_motion, motion_of, movable_arm, udp_arm_address};
#[cfg(target_os = "linux")]
pub(crate) use servos::servo_config;
pub use steered::SteeredArm;
pub use steered_base::SteeredBase;
pub use steered_robot::{SteeredRobot, check_steered, with_steered_robot};
#[cfg(target_os = "linux")]
pub use ur::arm_config as ur_config;

use crate::config::{ArmDriver, BaseDriver, CameraDriver, Override, Parent, Rig, ScannerDriver};
use crate::notes::Notes;
use crate::recorded_meshes::RecordedMeshes;
use crate::stamp_clock::StampClock;
use anyhow::{Context, anyhow, bail};
use assumed_lens::assume_calibration_of_simulated;
use drivers::recording::{
    RIG_FILE, Recorder, Recording, RecordingMetadata, URDF_FILE, mesh_attachment,
};
use drivers::{LiveDevices, Playback, Repeating, Sample, Source};
use kinematics::Chain;
use messages::Setting;
use std::path::Path;
use std::sync::{Arc, OnceLock};
use tags::TagBaseSource;

pub use assumed_lens::approximate_intrinsics;
pub(crate) use assumed_lens::assume_calibration;

/// End of the hint that devices can be simulated.
const SIM_HINT_END: &str = " replaces every device by its simulated twin";

/// Hint in error messages about devices of a rig that cannot be opened.
fn sim_hint(rig: &Rig) -> String {
    format!(
        "`fieldrig run {} {}`{SIM_HINT_END}",
        rig.path.argument(),
        Setting::Sim
    )
}

/// The text of an error of [`rig()`], without the hint that devices can be simulated. It is for
/// lists of devices, where the hint would be repeated.
#[must_use]
pub fn without_sim_hint(error: &anyhow::Error) -> String {
    let text = format!("{error:#}");
    let before_hint = text
        .strip_suffix(SIM_HINT_END)
        .and_then(|rest| rest.rsplit_once("; `"));
    before_hint.map_or(text.clone(), |(before, _)| before.to_owned())
}

/// The port of a Franka controller.
pub const FCI_PORT: u16 = 1337;

/// Which devices to open for a rig file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Devices {
    /// The devices in the rig file.
    Real,
    /// Simulated devices with the same names, sizes, rates, intrinsics and robot.
    Sim,
}

/// An open rig or recording.
pub struct Opened {
    /// The rig with all settings resolved.
    pub rig: Rig,
    /// The samples of all devices, or of the recording.
    pub source: Box<dyn Source>,
    /// Description of the damage of a recording. It is set if the samples end early because of the
    /// damage.
    pub damage: Arc<OnceLock<String>>,
    /// The clock of the stamps.
    pub stamp_clock: StampClock,
}

impl Opened {
    /// Plays a recording at the speed of its devices. If the caller is too slow, images are
    /// dropped.
    #[must_use]
    pub fn in_real_time(self) -> Self {
        let playback = Playback::new(self.source);
        Self {
            stamp_clock: StampClock::Playback(playback.clock()),
            source: Box::new(playback),
            ..self
        }
    }

    /// Compares the poses of cameras with the tags in the rig file. Warns once about each camera
    /// whose pose contradicts the tags. Nothing is compared if there are no tags, or if the tags
    /// locate the base.
    ///
    /// * `notes`: gets the warnings.
    ///
    /// # Errors
    ///
    /// If the thread for the detection cannot be started.
    pub fn with_tag_check(self, notes: &Notes) -> anyhow::Result<Self> {
        let source = tag_check::TagCheckSource::check(&self.rig, self.source, notes)?;
        Ok(Self { source, ..self })
    }

    /// Repeats the recording at `path` without end.
    #[must_use]
    pub fn repeated(self, path: &Path) -> Self {
        let path = path.to_owned();
        let damage = Arc::clone(&self.damage);
        // The recording is opened again for each round, because a source cannot be rewound.
        let reopen = move || open_recording(&path, &damage);
        Self {
            source: Box::new(Repeating::new(self.source, reopen)),
            ..self
        }
    }
}

/// Opens a recording at its first sample.
fn open_recording(
    path: &Path,
    damage: &Arc<OnceLock<String>>,
) -> Result<Box<dyn Source>, drivers::Error> {
    let recording = Recording::open(path)?;
    Ok(Box::new(RecordingSource {
        recording,
        damage: Arc::clone(damage),
    }))
}

/// Opens the devices of a rig. Calibration that the rig file omits is read from the cameras that
/// store it.
///
/// # Errors
///
/// If a device cannot be opened, a driver is not part of this build, or the rig file lacks a
/// setting that a driver needs.
pub fn rig(rig: Rig, devices: Devices) -> anyhow::Result<Opened> {
    let (opened, ()) = open_rig_with(rig, devices, |rig, _| {
        let (source, stamp_clock) = open_devices(rig)?;
        Ok((source, stamp_clock, ()))
    })?;
    Ok(opened)
}

/// Opens the devices of a rig with a function, which also returns the steered arm or base.
///
/// * `open`: gets the rig with all settings resolved, and the driver of the arm in the rig file,
///   which a simulation may have replaced.
fn open_rig_with<T>(
    mut rig: Rig,
    devices: Devices,
    open: impl FnOnce(&mut Rig, ArmDriver) -> anyhow::Result<(Box<dyn Source>, StampClock, T)>,
) -> anyhow::Result<(Opened, T)> {
    let arm_driver = rig.arm.driver;
    if devices == Devices::Sim {
        use_simulated_devices(&mut rig);
    }
    assume_calibration_of_simulated(&mut rig);
    without_readout_if_ideal(&mut rig);
    // The settings are checked before any device is opened, so that an error of the rig file does
    // not start cameras.
    if let Some(device) = unsupported_device(&rig) {
        bail!(
            "{device} cannot be opened by this version; {}",
            sim_hint(&rig)
        );
    }
    check_arm(&rig)?;
    let (source, stamp_clock, steered) = open(&mut rig, arm_driver)?;
    // This source wraps all devices, because tags are searched in the images of all cameras on the
    // robot.
    let source = match rig.base.driver {
        BaseDriver::Tags => Box::new(TagBaseSource::new(&rig, source)?),
        _ => source,
    };
    let opened = Opened {
        rig,
        source,
        damage: Arc::default(),
        stamp_clock,
    };
    Ok((opened, steered))
}

/// Opens the real and the simulated devices of a rig for reading.
fn open_devices(rig: &mut Rig) -> anyhow::Result<(Box<dyn Source>, StampClock)> {
    let opened = real::open(rig, &mut real::end_on_failure);
    let (real, _) = opened.map_err(|error| with_sim_hint(error, rig))?;
    if is_any_simulated(rig) {
        return simulate(rig, real);
    }
    Ok((Box::new(LiveDevices::new(real)?), StampClock::Computer))
}

fn with_sim_hint(error: anyhow::Error, rig: &Rig) -> anyhow::Error {
    anyhow!("{error:#}; {}", sim_hint(rig))
}

/// Replaces every device by its simulated twin. Calibration that only a real camera could report is
/// assumed.
fn use_simulated_devices(rig: &mut Rig) {
    assume_calibration(rig);
    // A rig without an arm may describe one, which then stays at rest.
    if rig.arm.driver != ArmDriver::None || rig.arm.joints.is_empty() {
        rig.arm.driver = ArmDriver::Sim;
    }
    rig.base.driver = match rig.base.driver {
        // The scene decides whether the base moves. Tags can locate a simulated base, too, because
        // the simulated cameras see the tags.
        _ if base_moves(rig) => BaseDriver::Sim,
        BaseDriver::Tags => BaseDriver::Tags,
        _ => BaseDriver::Fixed,
    };
    for scanner in &mut rig.scanners {
        scanner.driver = ScannerDriver::Sim;
    }
    for camera in &mut rig.cameras {
        camera.driver = CameraDriver::Sim;
    }
}

/// The rig that is stored in a recording, with its mesh files.
///
/// # Errors
///
/// If the file is not a recording, or contains no valid rig.
pub fn recorded_rig(path: &Path, overrides: &[Override]) -> anyhow::Result<Rig> {
    stored_rig(path, &Recording::open(path)?, overrides)
}

/// Opens a recording with the stored rig or with the given rig. The joints have the order that is
/// stored in the recording. Mesh files that are missing on this computer are read from the
/// recording.
///
/// # Errors
///
/// If the file is not a recording, contains no valid rig, or does not match the given rig.
pub fn recording(path: &Path, rig: Option<Rig>, overrides: &[Override]) -> anyhow::Result<Opened> {
    let recording = Recording::open(path)?;
    let mut rig = match rig {
        Some(mut rig) => {
            let meshes = RecordedMeshes::of(&recording);
            rig.arm.urdf_folder = rig.arm.urdf_folder.with_recorded(meshes);
            rig
        }
        None => stored_rig(path, &recording, overrides)?,
    };
    if let Some(recorded) = recording.joint_names() {
        // A rig from the user may have another joint order, or may even belong to another robot.
        // Joint readings keep the order of the recording, so the offsets must have the same order.
        chain_of(&rig)?
            .order_in(recorded)
            .with_context(|| format!("the recording {path:?} does not match the robot"))?;
        let offsets = [&rig.arm.joint_offsets, &rig.arm.sim.true_joint_offsets]
            .map(|offsets| in_recorded_order(offsets, &rig.arm.joints, recorded));
        [rig.arm.joint_offsets, rig.arm.sim.true_joint_offsets] = offsets;
        rig.arm.joints = recorded.to_vec();
    }
    without_readout_if_ideal(&mut rig);
    let damage = Arc::default();
    let source = Box::new(RecordingSource {
        recording,
        damage: Arc::clone(&damage),
    });
    Ok(Opened {
        rig,
        source,
        damage,
        stamp_clock: StampClock::Unrelated,
    })
}

/// Offsets of `joints`, in the order of the recorded joints. The list is empty if there are no
/// offsets.
fn in_recorded_order(offsets: &[f64], joints: &[String], recorded: &[String]) -> Vec<f64> {
    if offsets.is_empty() {
        return Vec::new();
    }
    let ix_of = |name: &String| joints.iter().position(|known| known == name);
    recorded
        .iter()
        .map(|name| {
            ix_of(name)
                .and_then(|ix| offsets.get(ix))
                .copied()
                .unwrap_or(0.0)
        })
        .collect()
}

/// Creates a recording of a rig, with the rig file, the URDF and its mesh files attached.
///
/// * `meshes`: the result of [`meshes_to_record`].
///
/// # Errors
///
/// If the file cannot be written.
pub fn recorder(path: &Path, rig: &Rig, meshes: &RecordedMeshes) -> anyhow::Result<Recorder> {
    let cameras: Vec<_> = rig
        .cameras
        .iter()
        .filter(|camera| !camera.unknown.intrinsics)
        .map(|camera| (&*camera.name, &camera.intrinsics))
        .collect();
    // All settings of the rig are stored, including the calibration that cameras report. The
    // recording can then be used without the original files and devices.
    let resolved = rig.to_toml();
    let mesh_files: Vec<(String, &[u8])> = meshes
        .compressed()
        .map(|(file, compressed)| (mesh_attachment(file), compressed))
        .collect();
    let mut files = vec![
        (RIG_FILE, resolved.as_bytes()),
        (URDF_FILE, rig.arm.urdf_text.as_bytes()),
    ];
    files.extend(mesh_files.iter().map(|(name, data)| (name.as_str(), *data)));
    let description = RecordingMetadata {
        files: &files,
        cameras: &cameras,
        joint_names: &rig.arm.joints,
    };
    Ok(Recorder::create(path, &description)?)
}

/// The kinematic chain from the robot's base to its flange.
///
/// # Errors
///
/// If the URDF of the rig has no such chain.
pub fn chain_of(rig: &Rig) -> anyhow::Result<Chain> {
    let arm = &rig.arm;
    Chain::from_urdf(&arm.urdf_text, &arm.base_link, &arm.flange_link).context("the arm's URDF")
}

fn stored_rig(path: &Path, recording: &Recording, overrides: &[Override]) -> anyhow::Result<Rig> {
    let mut rig = Rig::parse(
        RIG_FILE,
        stored_text(path, recording, RIG_FILE)?,
        stored_text(path, recording, URDF_FILE)?,
        overrides,
    )?;
    let meshes = RecordedMeshes::of(recording).before_files();
    rig.arm.urdf_folder = rig.arm.urdf_folder.with_recorded(meshes);
    Ok(rig)
}

/// The text of a file that is stored in a recording.
fn stored_text<'a>(path: &Path, recording: &'a Recording, name: &str) -> anyhow::Result<&'a str> {
    let bytes = recording.attachment(name).with_context(|| {
        format!(
            "the recording {path:?} contains no {name}, which fieldrig stores in it; if another program removed it, give the rig file with {} to `fieldrig train`, `eval`, `export` or `calibrate`",
            Setting::Rig
        )
    })?;
    std::str::from_utf8(bytes)
        .with_context(|| format!("the recording {path:?}: {name} is not text"))
}

/// Sets the readout time of simulated cameras without imperfections to 0, because they expose all
/// rows at once.
fn without_readout_if_ideal(rig: &mut Rig) {
    let is_ideal = rig.sim.ideal;
    for camera in rig
        .cameras
        .iter_mut()
        .filter(|camera| is_ideal && camera.driver == CameraDriver::Sim)
    {
        camera.readout_micros = Some(0.0);
    }
}

/// Checks that the rig has an arm if a camera is on the flange.
fn check_arm(rig: &Rig) -> anyhow::Result<()> {
    let on_flange = rig
        .cameras
        .iter()
        .find(|camera| camera.parent == Parent::Flange);
    if let (ArmDriver::None, Some(camera)) = (rig.arm.driver, on_flange) {
        bail!(
            "camera {:?} has the parent flange, but arm.driver is none: the parent must be base or world",
            camera.name
        );
    }
    Ok(())
}

/// Whether any device of a rig is simulated.
#[must_use]
pub fn is_any_simulated(rig: &Rig) -> bool {
    rig.arm.driver == ArmDriver::Sim
        || rig.base.driver == BaseDriver::Sim
        || rig
            .cameras
            .iter()
            .any(|camera| camera.driver == CameraDriver::Sim)
        || rig
            .scanners
            .iter()
            .any(|scanner| scanner.driver == ScannerDriver::Sim)
}

/// The first device of a rig that has no driver yet.
fn unsupported_device(rig: &Rig) -> Option<String> {
    let has_none = rig.base.driver == BaseDriver::Rgbd;
    has_none.then(|| {
        format!(
            "base driver {:?}",
            format!("{:?}", rig.base.driver).to_lowercase()
        )
    })
}

#[cfg(feature = "sim")]
fn simulate(rig: &Rig, real: drivers::Devices) -> anyhow::Result<(Box<dyn Source>, StampClock)> {
    simulated::open(rig, real)
}

#[cfg(feature = "sim")]
fn base_moves(rig: &Rig) -> bool {
    twin::base_moves(rig)
}

#[cfg(not(feature = "sim"))]
fn base_moves(_rig: &Rig) -> bool {
    false
}

#[cfg(not(feature = "sim"))]
fn simulate(_rig: &Rig, _real: drivers::Devices) -> anyhow::Result<(Box<dyn Source>, StampClock)> {
    bail!(
        "this program was built without the simulator: build it with `cargo build --release --features sim`"
    )
}

/// A recording that reports damage when it ends.
struct RecordingSource {
    recording: Recording,
    damage: Arc<OnceLock<String>>,
}

impl Source for RecordingSource {
    fn next_sample(&mut self) -> Result<Option<Sample>, drivers::Error> {
        let sample = self.recording.next_sample()?;
        if sample.is_none()
            && let Some(damage) = self.recording.damage()
        {
            // The damage is reported once, at the end, together with other losses of data.
            let _ = self.damage.set(damage.to_owned());
        }
        Ok(sample)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(name: &str, overrides: &[Override]) -> Rig {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../rigs")
            .join(name);
        Rig::load(&path, overrides).expect("a bundled rig file")
    }

    #[test]
    fn unsupported_driver_error_suggests_sim() {
        let rig = load("static-arm.toml", &[Override::new("base.driver", "rgbd")]);
        let message = format!(
            "{:#}",
            super::rig(rig, Devices::Real)
                .err()
                .expect("no such driver")
        );
        assert!(
            message.contains("rgbd") && message.contains("static-arm.toml sim`"),
            "{message}"
        );
    }

    #[test]
    fn missing_or_unattached_v4l2_camera_is_an_error() {
        let absent = [
            Override::new("arm.driver", "none"),
            Override::new("camera.wrist.driver", "v4l2"),
            Override::new("camera.wrist.device", "no such serial"),
            Override::new("camera.wrist.depth.device", "no such serial"),
            Override::new("camera.wrist.depth.meters_per_count", 0.001),
        ];
        let error_of = |overrides: &[Override]| {
            let opened = super::rig(load("static-arm.toml", overrides), Devices::Real);
            format!("{:#}", opened.err().expect("nothing is connected"))
        };
        let message = error_of(&absent);
        assert!(
            message.contains("\"wrist\" has the parent flange"),
            "{message}"
        );
        let on_base = [&absent[..], &[Override::new("camera.wrist.parent", "base")]].concat();
        let message = error_of(&on_base);
        assert!(
            message.contains("no V4L2 camera named \"no such serial\"")
                && message.contains("static-arm.toml sim`"),
            "{message}"
        );
        let without_scale = [&on_base[..3], &on_base[5..]].concat();
        let message = error_of(&without_scale);
        assert!(message.contains("camera.wrist.depth.device"), "{message}");
    }

    #[cfg(feature = "nokhwa")]
    #[test]
    fn unsupported_nokhwa_settings_are_rejected() {
        let of = |more: &[Override]| {
            let driver = [
                ("arm.driver", "none"),
                ("camera.wrist.driver", "nokhwa"),
                ("camera.wrist.device", "no such camera"),
                ("camera.wrist.parent", "base"),
            ];
            let overrides = driver
                .map(|(key, value)| Override::new(key, value))
                .into_iter()
                .chain(more.iter().cloned());
            let opened = super::rig(
                load("static-arm.toml", &overrides.collect::<Vec<_>>()),
                Devices::Real,
            );
            format!("{:#}", opened.err().expect("nothing is connected"))
        };
        assert!(
            of(&[]).contains("nokhwa does not support depth"),
            "{}",
            of(&[])
        );
        let gain = of(&[Override::new("camera.wrist.v4l2.gain", 7_i64)]);
        assert!(gain.contains("nokhwa does not support gain"), "{gain}");
    }

    #[test]
    fn missing_realsense_camera_error_suggests_a_remedy() {
        let overrides = [
            Override::new("arm.driver", "none"),
            Override::new("camera.wrist.parent", "base"),
            Override::new("camera.wrist.driver", "realsense"),
            Override::new("camera.wrist.device", "no such serial"),
        ];
        let opened = super::rig(load("static-arm.toml", &overrides), Devices::Real);
        let message = format!("{:#}", opened.err().expect("nothing is connected"));
        let expected = if cfg!(feature = "realsense") {
            "\"no such serial\""
        } else {
            "--features realsense"
        };
        assert!(
            message.contains(expected) && message.contains("static-arm.toml sim`"),
            "{message}"
        );
    }

    #[test]
    fn unreachable_network_arm_error_suggests_a_remedy() {
        let error_of = |driver: &str, address: &str| {
            let overrides = [
                Override::new("arm.driver", driver),
                Override::new("arm.address", address),
            ];
            let opened = super::rig(load("static-arm.toml", &overrides), Devices::Real);
            format!("{:#}", opened.err().expect("no such arm"))
        };
        for (driver, address, expected) in [
            ("franka", "", "arm.address"),
            ("franka", "127.0.0.1:1", "FCI"),
            ("ur", "", "arm.address"),
            ("ur", "127.0.0.1:1", "the arm has 6"),
            ("udp", "172.16.0.2", "arm.address"),
        ] {
            let message = error_of(driver, address);
            assert!(message.contains(expected), "{driver} {address}: {message}");
        }
        let occupied = std::net::UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let address = occupied.local_addr().expect("bound").to_string();
        assert!(error_of("udp", &address).contains(&address));
    }

    #[cfg(all(feature = "sim", target_os = "linux"))]
    #[test]
    fn franka_arm_is_read_with_simulated_cameras() {
        use drivers::franka::FciVersion;
        use drivers::franka::emulated::{EmulatedRobot, Joints, Limits, RobotConfig};
        const REST_RAD: [f64; 7] = [0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7];
        // A Franka reports poses relative to its own base link, also on a mobile base.
        for name in ["static-arm.toml", "mobile-arm.toml"] {
            let plain = load(name, &[]);
            let chain = Chain::from_urdf(&plain.arm.urdf_text, "panda_link0", "panda_link8")
                .expect("a Panda");
            let config = RobotConfig {
                address: "127.0.0.1:0".parse().expect("an address"),
                version: FciVersion::V5,
                chain,
                flange_from_tool: kinematics::Transform::identity(),
                limits: Limits::panda(),
            };
            let rest = Joints {
                position_rad: REST_RAD,
                ..Joints::default()
            };
            let emulated =
                EmulatedRobot::start(config, Box::new(move |_, _| rest)).expect("a free port");
            let address = emulated.address().to_string();
            let overrides = [
                Override::new("arm.driver", "franka"),
                Override::new("arm.address", &*address),
            ];
            let mut opened = super::rig(load(name, &overrides), Devices::Real)
                .unwrap_or_else(|e| panic!("{}", format!("{e:#}")));
            let joints = loop {
                match opened
                    .source
                    .next_sample()
                    .expect("the rig works")
                    .expect("it does not end")
                {
                    Sample::Joints(joints) => break joints,
                    _ => continue,
                }
            };
            assert_eq!(joints.position, REST_RAD, "{name}");
        }
    }

    #[test]
    fn missing_recording_is_an_error() {
        let missing = recording(Path::new("no/such.mcap"), None, &[])
            .err()
            .expect("no file");
        assert!(format!("{missing:#}").contains("no/such.mcap"));
    }

    #[test]
    fn recording_without_its_rig_file_needs_another_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let rig = load("two-cameras.toml", &[]);
        let metadata = RecordingMetadata {
            joint_names: &rig.arm.joints,
            ..RecordingMetadata::default()
        };
        let mut recorder = Recorder::create(&path, &metadata).expect("a new file");
        let joints = kinematics::JointState {
            stamp: kinematics::Stamp(5),
            position: vec![0.0; 7],
            velocity: vec![],
            effort: vec![],
        };
        recorder.write(&Sample::Joints(joints)).expect("disk space");
        recorder.finish().expect("disk space");
        let error = recording(&path, None, &[]).err().expect("no rig file");
        let message = format!("{error:#}");
        assert!(
            message.contains("contains no rig.toml") && message.contains("the rig file with rig"),
            "{message}"
        );
        assert!(recording(&path, Some(rig), &[]).is_ok());
    }

    #[test]
    fn recording_stores_its_rig() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let rig = load("two-cameras.toml", &[Override::new("sim.seed", 77)]);
        let mut recorder = recorder(&path, &rig, &meshes_to_record(&rig)).expect("a new file");
        let joints = kinematics::JointState {
            stamp: kinematics::Stamp(5),
            position: vec![0.0; 7],
            velocity: vec![],
            effort: vec![],
        };
        recorder
            .write(&Sample::Joints(joints.clone()))
            .expect("disk space");
        recorder.finish().expect("disk space");
        let mut opened = recording(&path, None, &[]).expect("a recording");
        assert_eq!(opened.rig, rig);
        assert_eq!(
            opened.source.next_sample().expect("readable"),
            Some(Sample::Joints(joints))
        );
        assert_eq!(opened.source.next_sample().expect("readable"), None);
        assert_eq!(opened.damage.get(), None);
        // A different joint order in the rig file has no effect; a different joint name is an
        // error.
        let mut reversed = rig.clone();
        reversed.arm.joints.reverse();
        assert_eq!(
            recording(&path, Some(reversed), &[])
                .expect("the same joints")
                .rig,
            rig
        );
        let mut renamed = rig;
        renamed.arm.urdf_text = renamed.arm.urdf_text.replace("panda_joint3", "elbow");
        let error_of = format!(
            "{:#}",
            recording(&path, Some(renamed), &[])
                .err()
                .expect("no joint of that name")
        );
        assert!(
            error_of.contains("run.mcap") && error_of.contains("\"elbow\""),
            "{error_of}"
        );
        let overridden =
            recording(&path, None, &[Override::new("train.seed", 9)]).expect("a recording");
        assert_eq!(overridden.rig.train.seed, 9);
    }
}
