//! Emulates the devices of a rig file on the wire, for the drivers of this or of other programs.

#[cfg(feature = "realsense")]
mod camera_files;
#[cfg(not(feature = "realsense"))]
mod without_realsense;

use crate::config::{ArmDriver, BaseDriver, Camera, CameraDriver, Rig, ScannerDriver};
use crate::open::{self, Devices, FCI_PORT, Opened};
use crate::stop::Stop;
use anyhow::{Context, anyhow, bail};
#[cfg(feature = "realsense")]
use camera_files::CameraFiles;
use drivers::franka::FciVersion;
use drivers::franka::emulated::{EmulatedRobot, Limits, RobotConfig};
use drivers::servos::emulated::{EmulatedServoBus, ServoKind};
use drivers::ur::RTDE_PORT;
use drivers::ur::emulated::{ControllerConfig, EmulatedController};
use drivers::{Sample, Source, can, clock};
use kinematics::{Stamp, Transform};
use messages::{BadInput, Setting};
use serde::Serialize;
use sim::wire::{
    DatagramTargets, DeviceScript, EmulatedMotors, EmulatedSenders, JointTrack, PlaybackClock,
    emulate_fci, emulate_servos, emulate_ur,
};
use std::net::{SocketAddr, TcpListener, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::time::Duration;
#[cfg(not(feature = "realsense"))]
use without_realsense::CameraFiles;

/// Recording of the simulation, next to the rig file.
const SIMULATION_FILE: &str = "script.mcap";
/// Serial port of emulated servos, next to the rig file.
const SERIAL_PORT: &str = "servos";

/// Scenes with a bundled rig file for emulated devices.
const SCENES: [(&str, &str, &str); 2] = [
    (
        "static-arm",
        include_str!("../../../rigs/wire/static-arm.toml"),
        include_str!("../../../rigs/robots/panda.urdf"),
    ),
    (
        "mobile-arm",
        include_str!("../../../rigs/wire/mobile-arm.toml"),
        include_str!("../../../rigs/robots/mobile-arm.urdf"),
    ),
];

/// What is emulated, and when.
#[derive(Clone, Debug)]
pub struct EmulationPlan {
    /// A rig file, or the name of a scene.
    pub rig_or_scene: String,
    /// Folder for the rig file to run against the emulated devices. The folder is `sim-NAME` if
    /// this is `None`.
    pub out: Option<PathBuf>,
    /// Recording of the rig that is played back. If this is `None`, a simulation is played back.
    pub recording: Option<PathBuf>,
    /// Length of the playback, seconds.
    pub seconds: f64,
    /// Time until the playback begins, seconds.
    pub start_in_secs: f64,
    /// Version of FCI that an emulated Franka controller uses: 5 or 10.
    pub fci: String,
    /// Time for which an emulated Franka controller waits for each command during a motion.
    pub answer_wait: Duration,
}

/// Work before the playback. Each stage reports the seconds of the playback that are done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The rig is simulated into a recording.
    Simulating,
    /// The samples are encoded.
    Preparing,
}

/// Emulated devices, which reply until they are dropped.
pub struct Emulation {
    /// The rig file to run against the devices.
    pub rig_file: PathBuf,
    /// One description per device.
    pub descriptions: Vec<String>,
    /// Time at which the playback begins.
    pub starts_at: Stamp,
    /// Description of the damage of the recording, if the playback ends early because of it.
    pub damage: Option<String>,
    _devices: EmulatedDevices,
}

/// All devices are ready. This is printed as JSON.
#[derive(Clone, Debug, Serialize)]
pub struct ReadyEvent<'a> {
    event: &'static str,
    /// The rig file to run against the emulated devices.
    pub rig: &'a Path,
    /// Seconds until the playback begins.
    pub starts_in_secs: f64,
    /// Length of the playback, seconds.
    pub seconds: f64,
    /// One description per device.
    pub devices: &'a [String],
}

impl Emulation {
    /// The event of a plan whose devices are ready.
    #[must_use]
    pub fn ready_event(&self, plan: &EmulationPlan) -> ReadyEvent<'_> {
        ReadyEvent {
            event: "ready",
            rig: &self.rig_file,
            starts_in_secs: plan.start_in_secs,
            seconds: plan.seconds,
            devices: &self.descriptions,
        }
    }
}

impl EmulationPlan {
    /// Prepares the samples, and starts the devices. Returns `None` if `stop` is requested.
    ///
    /// * `on_progress`: called after each sample.
    ///
    /// # Errors
    ///
    /// If the rig cannot be emulated, or a device or a file cannot be created.
    pub fn start(
        &self,
        stop: &Stop,
        on_progress: &mut dyn FnMut(Stage, f64),
    ) -> anyhow::Result<Option<Emulation>> {
        let (name, mut rig) = load(&self.rig_or_scene)?;
        check(&rig)?;
        // Addresses and buses are checked before the simulation, which takes a minute.
        check_arm_connection(&rig)?;
        // The files of cameras and the simulation need the same lenses.
        open::assume_calibration(&mut rig);
        let folder = self
            .out
            .clone()
            .unwrap_or_else(|| PathBuf::from(format!("sim-{name}")));
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create the folder {}", folder.display()))?;
        if matches!(rig.arm.driver, ArmDriver::Feetech | ArmDriver::Dynamixel) {
            // The port of the rig file belongs to a real adapter.
            let port = std::path::absolute(folder.join(SERIAL_PORT))?;
            rig.arm.serial.device = port.display().to_string();
        }
        // All samples are prepared before the playback, because simulating and encoding are slower
        // than real time.
        let recording = match &self.recording {
            Some(path) => path.clone(),
            None => match self.simulate(&rig, &folder, stop, on_progress)? {
                Some(path) => path,
                None => return Ok(None),
            },
        };
        let mut camera_files = CameraFiles::new(&rig, &folder)?;
        let Some((script, damage)) = self.read(&recording, &mut camera_files, stop, on_progress)?
        else {
            return Ok(None);
        };
        let mut descriptions = camera_files.finish(&mut rig)?;
        descriptions.extend(real_cameras(&rig).map(|camera| {
            format!(
                "camera {:?}: stays real, because cameras with this driver are not emulated; connect it, or remove it \
                 from the rig file",
                camera.name
            )
        }));
        let first = script.joints.first().map(|state| state.stamp);
        let first = first
            .or(script.poses.first().map(|pose| pose.stamp))
            .unwrap_or_default();
        let playback_clock = PlaybackClock {
            scripted: first,
            emulated: clock::now().plus_secs(self.start_in_secs),
        };
        // The start time of the playback is known only now. An offset in the rig file therefore
        // shifts the stamps of the camera files.
        for camera in &mut rig.cameras {
            camera.realsense.clock_offset_nanos = playback_clock
                .emulated
                .0
                .saturating_sub(playback_clock.scripted.0);
        }
        let rig_file = write_rig(&folder, &rig)?;
        // The devices are started last, because the playback time is already running.
        let devices = EmulatedDevices::start(&rig, &script, playback_clock, self)?;
        descriptions.extend(devices.descriptions.iter().cloned());
        Ok(Some(Emulation {
            rig_file,
            descriptions,
            starts_at: playback_clock.emulated,
            damage,
            _devices: devices,
        }))
    }

    /// Simulates the rig into a recording; `None` if interrupted.
    fn simulate(
        &self,
        rig: &Rig,
        folder: &Path,
        stop: &Stop,
        on_progress: &mut dyn FnMut(Stage, f64),
    ) -> anyhow::Result<Option<PathBuf>> {
        let mut simulated = rig.clone();
        // The simulation is recorded, not watched, so it need not run in real time.
        simulated.sim.lockstep = true;
        let Opened {
            rig, mut source, ..
        } = open::rig(simulated, Devices::Sim)?;
        let path = folder.join(SIMULATION_FILE);
        // The file may remain from an earlier or interrupted simulation.
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(error).with_context(|| format!("cannot replace {}", path.display()));
            }
            _ => {}
        }
        let mut recorder = open::recorder(&path, &rig, &open::meshes_to_record(&rig))?;
        let is_complete = self.for_each_sample(source.as_mut(), stop, |sample, secs| {
            on_progress(Stage::Simulating, secs);
            Ok(recorder.write(&sample)?)
        })?;
        if !is_complete {
            return Ok(None);
        }
        // The recording of an interrupted simulation is left unfinished. The next simulation
        // removes it.
        recorder.finish()?;
        Ok(Some(path))
    }

    /// Passes on the samples of the first `seconds`. Each sample is passed with its time since the
    /// first sample, in seconds. Returns false if interrupted.
    fn for_each_sample(
        &self,
        source: &mut dyn Source,
        stop: &Stop,
        mut take: impl FnMut(Sample, f64) -> anyhow::Result<()>,
    ) -> anyhow::Result<bool> {
        let mut first: Option<Stamp> = None;
        while let Some(sample) = source.next_sample()? {
            let secs = sample
                .stamp()
                .secs_since(*first.get_or_insert(sample.stamp()));
            if secs > self.seconds {
                break;
            }
            if stop.requested() {
                return Ok(false);
            }
            take(sample, secs)?;
        }
        Ok(true)
    }

    /// Reads the samples of the first `seconds` of a recording, and describes its damage. Images are
    /// written to the camera files. `None` if interrupted.
    fn read(
        &self,
        recording: &Path,
        camera_files: &mut CameraFiles,
        stop: &Stop,
        on_progress: &mut dyn FnMut(Stage, f64),
    ) -> anyhow::Result<Option<(DeviceScript, Option<String>)>> {
        let Opened {
            mut source, damage, ..
        } = open::recording(recording, None, &[])?;
        let mut script = DeviceScript::default();
        let is_complete = self.for_each_sample(source.as_mut(), stop, |sample, secs| {
            on_progress(Stage::Preparing, secs);
            match sample {
                Sample::Image(image) => camera_files.take(image)?,
                other => script.take(other),
            }
            Ok(())
        })?;
        if !is_complete {
            return Ok(None);
        }
        // A damaged recording still has data to play back.
        let damage = damage.get().cloned();
        if let Some(damage) = &damage {
            log::warn!("{damage}; the data before that is played back");
        }
        Ok(Some((script, damage)))
    }
}

/// The rig and its name.
fn load(rig_or_scene: &str) -> anyhow::Result<(String, Rig)> {
    // Names of scenes come before files, so that a folder of the same name does not hide them.
    if let Some((name, text, urdf)) = SCENES.iter().find(|(name, ..)| *name == rig_or_scene) {
        return Ok(((*name).to_owned(), Rig::parse(name, text, urdf, &[])?));
    }
    let path = Path::new(rig_or_scene);
    if !path.exists() {
        let scenes: Vec<_> = SCENES.iter().map(|(name, ..)| *name).collect();
        return Err(BadInput(format!(
            "there is no rig file {rig_or_scene:?}; scenes: {}",
            scenes.join(", ")
        ))
        .into());
    }
    let name = path.file_stem().map_or_else(
        || "rig".to_owned(),
        |stem| stem.to_string_lossy().into_owned(),
    );
    Ok((name, Rig::load(path, &[])?))
}

/// Rejects a rig that cannot be emulated, before a minute is spent on its simulation.
fn check(rig: &Rig) -> Result<(), BadInput> {
    if rig.arm.driver == ArmDriver::Sim {
        return Err(BadInput(
            "arm.driver is sim, which `fieldrig run` simulates itself; drivers that can be emulated: franka, ur, can, feetech, dynamixel, udp"
                .to_owned(),
        ));
    }
    #[cfg(not(feature = "realsense"))]
    without_realsense::check(rig)?;
    let is_any_emulated = rig.arm.driver != ArmDriver::None
        || rig.base.driver == BaseDriver::Udp
        || !rig.scanners.is_empty()
        || rig
            .cameras
            .iter()
            .any(|camera| camera.driver == CameraDriver::Realsense);
    if !is_any_emulated {
        return Err(BadInput(format!(
            "no device of this rig can be emulated: its cameras would stay real; to simulate all devices, use \
             `fieldrig run {} {}`",
            rig.path.argument(),
            Setting::Sim
        )));
    }
    Ok(())
}

/// Cameras whose driver accepts only a real device.
fn real_cameras(rig: &Rig) -> impl Iterator<Item = &Camera> {
    rig.cameras
        .iter()
        .filter(|camera| matches!(camera.driver, CameraDriver::V4l2 | CameraDriver::Nokhwa))
}

/// Checks that an emulated arm can be reached where the rig file says.
fn check_arm_connection(rig: &Rig) -> anyhow::Result<()> {
    match rig.arm.driver {
        ArmDriver::Franka => check_controller_address(&rig.arm.address, FCI_PORT),
        ArmDriver::Ur => check_controller_address(&rig.arm.address, RTDE_PORT),
        ArmDriver::Can => {
            for bus in &rig.arm.buses {
                can::Bus::open(bus).with_context(|| {
                    format!(
                        "cannot emulate the motors on {:?}; a virtual bus is created with `sudo modprobe vcan && sudo ip \
                         link add dev {} type vcan && sudo ip link set {} up`",
                        bus.interface, bus.interface, bus.interface
                    )
                })?;
            }
            Ok(())
        }
        _ => Ok(()),
    }
}

/// Checks that an emulated controller can listen at an address.
fn check_controller_address(text: &str, default_port: u16) -> anyhow::Result<()> {
    let address = controller_address(text, default_port)?;
    TcpListener::bind(address).map(drop).map_err(|error| {
        let hint = match error.kind() {
            std::io::ErrorKind::AddrNotAvailable => {
                "; it belongs to another computer: set arm.address = \"127.0.0.1\" in a copy of the rig file"
            }
            _ => "",
        };
        anyhow!("cannot emulate the controller at {address}: {error}{hint}")
    })
}

/// Writes the rig file to run against the emulated devices, and the robot description next to it.
fn write_rig(folder: &Path, rig: &Rig) -> anyhow::Result<PathBuf> {
    rig.write_resolved(folder)
        .with_context(|| format!("cannot write into {}", folder.display()))
}

/// Devices that reply until they are dropped.
struct EmulatedDevices {
    _robot: Option<EmulatedRobot>,
    _controller: Option<EmulatedController>,
    _motors: Option<EmulatedMotors>,
    _servos: Option<EmulatedServoBus>,
    _senders: EmulatedSenders,
    /// One description per device.
    descriptions: Vec<String>,
}

impl EmulatedDevices {
    fn start(
        rig: &Rig,
        script: &DeviceScript,
        playback_clock: PlaybackClock,
        plan: &EmulationPlan,
    ) -> anyhow::Result<Self> {
        let track = || {
            JointTrack::new(&script.joints, playback_clock)
                .context("cannot play back the joint states")
        };
        let mut robot = None;
        let mut controller = None;
        let mut motors = None;
        let mut servos = None;
        let mut datagram_targets = DatagramTargets::default();
        let mut descriptions = Vec::new();
        match rig.arm.driver {
            ArmDriver::Franka => {
                let config = robot_config(rig, &plan.fci)?;
                let open = emulate_fci(track()?, config, plan.answer_wait, None)?;
                descriptions.push(format!(
                    "arm: a Franka controller at {}, FCI {}",
                    open.address(),
                    plan.fci
                ));
                robot = Some(open);
            }
            ArmDriver::Ur => {
                let address = controller_address(&rig.arm.address, RTDE_PORT)?;
                let chain = open::controller_chain(rig)?;
                let config = ControllerConfig::e_series(address, chain);
                controller = Some(emulate_ur(track()?, config)?);
                descriptions.push(format!(
                    "arm: a controller of Universal Robots at {address}"
                ));
            }
            ArmDriver::Can => {
                let config = can::ArmConfig {
                    buses: rig.arm.buses.clone(),
                    motors: rig.arm.motors.clone(),
                    rate_hz: rig.arm.rate_hz,
                };
                motors = Some(EmulatedMotors::start(&track()?, &config)?);
                let buses: Vec<_> = rig.arm.buses.iter().map(|bus| &*bus.interface).collect();
                descriptions.push(format!(
                    "arm: {} motors on {}",
                    rig.arm.motors.len(),
                    buses.join(", ")
                ));
            }
            ArmDriver::Feetech | ArmDriver::Dynamixel => {
                let kind = match rig.arm.driver {
                    ArmDriver::Feetech => ServoKind::Feetech,
                    _ => ServoKind::Dynamixel,
                };
                let config = open::servo_config(rig);
                servos = Some(emulate_servos(track()?, &config, kind)?);
                descriptions.push(format!(
                    "arm: {} servos at {}",
                    config.servos.len(),
                    config.port.device.display()
                ));
            }
            ArmDriver::Udp => {
                let address = open::udp_arm_address(rig)?;
                descriptions.push(format!("arm: datagrams to {address}"));
                datagram_targets.joints = Some((address, rig.arm.joints.clone()));
            }
            ArmDriver::None | ArmDriver::Sim => {}
        }
        if rig.base.driver == BaseDriver::Udp {
            descriptions.push(format!("base: datagrams to {}", rig.base.address));
            datagram_targets.base = Some(rig.base.address);
        }
        for scanner in rig
            .scanners
            .iter()
            .filter(|scanner| scanner.driver == ScannerDriver::Udp)
        {
            descriptions.push(format!(
                "range scanner {:?}: datagrams to {}",
                scanner.name, scanner.address
            ));
            datagram_targets
                .scanners
                .push((scanner.name.to_string(), scanner.address));
        }
        let senders = EmulatedSenders::start(script, playback_clock, datagram_targets)?;
        Ok(Self {
            _robot: robot,
            _controller: controller,
            _motors: motors,
            _servos: servos,
            _senders: senders,
            descriptions,
        })
    }
}

/// Configuration of the emulated controller of a rig's arm.
fn robot_config(rig: &Rig, fci: &str) -> anyhow::Result<RobotConfig> {
    let (version, limits) = match fci {
        "5" => (FciVersion::V5, Limits::panda()),
        _ => (FciVersion::V10, Limits::fr3()),
    };
    let address = controller_address(&rig.arm.address, FCI_PORT)?;
    let chain = open::controller_chain(rig)?;
    Ok(RobotConfig {
        address,
        version,
        chain,
        flange_from_tool: Transform::identity(),
        limits,
    })
}

/// Address at which the emulated controller listens. It must belong to this computer.
fn controller_address(text: &str, default_port: u16) -> anyhow::Result<SocketAddr> {
    let found = match text.parse() {
        Ok(address) => Some(address),
        Err(_) => (text, default_port)
            .to_socket_addrs()
            .ok()
            .and_then(|mut all| all.next()),
    };
    match found {
        Some(address) => Ok(address),
        None => bail!(
            "arm.address is {text:?}, expected an address of this computer, such as 127.0.0.1"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wire_scenes_match_the_simulated_scenes() {
        let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
        for (name, ..) in SCENES {
            let (_, wire) = load(name).expect("the scene is bundled");
            let mut plain = Rig::load(&rigs.join(format!("{name}.toml")), &[])
                .expect("the rig file is bundled");
            plain.arm = wire.arm.clone();
            plain.base.driver = wire.base.driver;
            // Poses of the base come from another program, which moves it.
            plain.base.motion = wire.base.motion.clone();
            for (camera, on_wire) in plain.cameras.iter_mut().zip(&wire.cameras) {
                camera.driver = on_wire.driver;
                camera.stamp_to_mid_exposure = on_wire.stamp_to_mid_exposure.clone();
                // Rig files for emulated devices omit values that a RealSense camera reports.
                camera.realsense = on_wire.realsense.clone();
                camera.unknown = on_wire.unknown;
            }
            assert!(plain == wire, "{name}");
            assert!(
                Rig::load(&rigs.join(format!("wire/{name}.toml")), &[]).expect("the same file")
                    == wire
            );
        }
    }

    #[test]
    fn unsupported_rigs_are_rejected_before_simulating() {
        let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
        let plain = Rig::load(&rigs.join("static-arm.toml"), &[]).expect("the rig file is bundled");
        assert!(check(&plain).is_err_and(|error| error.to_string().contains("arm.driver is sim")));
        assert!(
            load("no-such-rig")
                .is_err_and(|error| error.to_string().contains("scenes: static-arm, mobile-arm"))
        );
        assert_eq!(
            controller_address("127.0.0.1", FCI_PORT)
                .expect("an address")
                .port(),
            FCI_PORT
        );
        assert_eq!(
            controller_address("127.0.0.1:5", FCI_PORT)
                .expect("an address")
                .port(),
            5
        );
        assert!(controller_address("", FCI_PORT).is_err());
    }

    fn with_cameras(driver: &str, arm: &str) -> Rig {
        let text = format!(
            "[arm]\n{arm}\n[camera.front]\ndriver = \"{driver}\"\nsize_px = [640, 480]\nrate_hz = 15\n\
             parent = \"base\"\nintrinsics = {{ focal_px = [600, 600], principal_px = [320, 240] }}\n"
        );
        let urdf = r#"<robot name="none"><link name="base"/></robot>"#;
        Rig::parse("rig.toml", &text, urdf, &[]).expect("a rig")
    }

    #[test]
    fn address_of_another_computer_has_a_hint() {
        // This address is reserved for documentation (RFC 5737).
        let mut rig = with_cameras("v4l2", "driver = \"none\"");
        rig.arm.address = "192.0.2.7".to_owned();
        for driver in [ArmDriver::Franka, ArmDriver::Ur] {
            rig.arm.driver = driver;
            let message = format!("{:#}", check_arm_connection(&rig).expect_err("not ours"));
            assert!(message.contains("127.0.0.1"), "{message}");
        }
    }

    #[test]
    fn cameras_that_stay_real_are_named() {
        let rig = with_cameras("v4l2", "driver = \"none\"");
        let names: Vec<_> = real_cameras(&rig).map(|camera| &*camera.name).collect();
        assert_eq!(names, ["front"]);
        let message = check(&rig).expect_err("nothing to emulate").to_string();
        assert!(message.contains("no device of this rig"), "{message}");
        let emulated = check(&with_cameras("realsense", "driver = \"none\""));
        assert_eq!(emulated.is_ok(), cfg!(feature = "realsense"));
    }
}
