//! Opens the devices of a rig that are not simulated.

#[cfg(target_os = "linux")]
use super::arm_config::{controller_chain, motion_config};
use super::servos;
#[cfg(target_os = "linux")]
use crate::config::Depth;
use crate::config::{
    ArmDriver, ArmMotion, BaseDriver, Camera, CameraDriver, Rig, Scanner, ScannerDriver,
};
use anyhow::{Context, bail};
#[cfg(target_os = "linux")]
use drivers::can::odrive::{self, Endpoints};
#[cfg(target_os = "linux")]
use drivers::can::{self, CanArm, MovableArmConfig, MovableCanArm};
#[cfg(target_os = "linux")]
use drivers::franka::{self, FrankaArm, MovableFrankaArm};
use drivers::motion::MovableArm;
use drivers::udp::{DatagramMonitor, UdpArm, UdpBase, UdpScanner};
#[cfg(target_os = "linux")]
use drivers::ur::MovableUrArm;
#[cfg(target_os = "linux")]
use drivers::v4l2::{Config, Settings, V4l2Camera, V4l2Format};
use drivers::{Arm, Base, Devices, RangeScanner, device_names};
use messages::BadInput;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

/// Default address for receiving joint states. It accepts data from this computer only.
const DEFAULT_ARM_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7011);

/// Error for an arm that this program cannot move.
const READ_ONLY: &str = "arms with this driver can only be read; to move the arm, set arm.driver = \"franka\", \"ur\", \"can\", \"feetech\" or \"dynamixel\"";

/// Decides what happens after a device could not be opened: an error ends the opening, `Ok` leaves
/// the device out. It gets the name of the device, as in [`drivers::device_names`].
pub(super) type OnFailure<'a> = &'a mut dyn FnMut(String, anyhow::Error) -> anyhow::Result<()>;

/// The first device that cannot be opened ends the opening.
pub(super) fn end_on_failure(_device: String, error: anyhow::Error) -> anyhow::Result<()> {
    Err(error)
}

/// Opens all real devices of a rig. There may be none. Also returns monitors of the devices that
/// receive datagrams. Fills in calibration that is stored in a camera.
pub(super) fn open(
    rig: &mut Rig,
    on_failure: OnFailure<'_>,
) -> anyhow::Result<(Devices, Vec<DatagramMonitor>)> {
    let mut devices = Devices::default();
    let mut monitors = Vec::new();
    // Cameras are opened first. Some of them store intrinsics, which are copied to the rig before
    // anything uses them.
    for camera in &mut rig.cameras {
        match cameras_of(camera) {
            Ok(opened) => devices.cameras.extend(opened),
            Err(error) => on_failure(device_names::camera(&camera.name), error)?,
        }
    }
    match arm(rig, &mut monitors) {
        Ok(arm) => devices.arm = arm,
        Err(error) => on_failure(device_names::ARM.to_owned(), error)?,
    }
    if rig.base.driver == BaseDriver::Udp {
        match udp_base(rig, &mut monitors) {
            Ok(base) => devices.base = Some(base),
            Err(error) => on_failure(device_names::BASE.to_owned(), error)?,
        }
    }
    for scanner in rig
        .scanners
        .iter()
        .filter(|scanner| scanner.driver == ScannerDriver::Udp)
    {
        match udp_scanner(scanner, &mut monitors) {
            Ok(open) => devices.scanners.push(open),
            Err(error) => on_failure(device_names::range_scanner(&scanner.name), error)?,
        }
    }
    Ok((devices, monitors))
}

/// Opens a camera. The depth images of a V4L2 camera come from a second device. A simulated camera
/// has no device.
fn cameras_of(camera: &mut Camera) -> anyhow::Result<Vec<Box<dyn drivers::Camera>>> {
    camera.require_devices()?;
    match camera.driver {
        CameraDriver::V4l2 => v4l2_cameras(camera),
        CameraDriver::Nokhwa => Ok(vec![nokhwa_camera(camera)?]),
        CameraDriver::Realsense => Ok(vec![super::realsense::open(camera)?]),
        CameraDriver::Sim => Ok(Vec::new()),
    }
}

/// Opens the arm for reading, if there is a real one.
fn arm(rig: &Rig, monitors: &mut Vec<DatagramMonitor>) -> anyhow::Result<Option<Box<dyn Arm>>> {
    Ok(match rig.arm.driver {
        ArmDriver::None | ArmDriver::Sim => None,
        ArmDriver::Can => Some(can_arm(rig)?),
        ArmDriver::Feetech | ArmDriver::Dynamixel => Some(servos::servo_arm(rig)?),
        ArmDriver::Franka => Some(franka_arm(rig)?),
        ArmDriver::Ur => Some(super::ur::arm(rig)?),
        ArmDriver::Udp => {
            let arm = udp_arm(rig)?;
            monitors.push(arm.monitor());
            Some(Box::new(arm) as Box<dyn Arm>)
        }
    })
}

/// Opens a base whose poses are sent by another program.
fn udp_base(rig: &Rig, monitors: &mut Vec<DatagramMonitor>) -> anyhow::Result<Box<dyn Base>> {
    let base = UdpBase::open(
        rig.base.address,
        [rig.base.max_sigma_m, rig.base.max_sigma_rad],
    )?;
    log::info!("base: listening on {}", base.address());
    monitors.push(base.monitor());
    Ok(Box::new(base))
}

/// Opens a range scanner whose scans are sent by another program.
fn udp_scanner(
    scanner: &Scanner,
    monitors: &mut Vec<DatagramMonitor>,
) -> anyhow::Result<Box<dyn RangeScanner>> {
    let open = UdpScanner::open(&scanner.name, scanner.address)?;
    log::info!(
        "range scanner {:?}: listening on {}",
        scanner.name,
        open.address()
    );
    monitors.push(open.monitor());
    Ok(Box::new(open))
}

/// Opens the arm for motion: enables it and holds its position. Positions of the returned arm do
/// not include `arm.joint_offsets`.
///
/// # Errors
///
/// If the rig file has no table `[arm.motion]`, the driver cannot move arms or does not support the
/// settings, or the arm cannot be reached.
pub fn movable_arm(rig: &Rig) -> anyhow::Result<Box<dyn MovableArm>> {
    let motion = motion_of(rig)?;
    match rig.arm.driver {
        ArmDriver::Can => movable_can_arm(rig, motion),
        #[cfg(target_os = "linux")]
        ArmDriver::Feetech | ArmDriver::Dynamixel => {
            servos::movable_servo_arm(rig, motion_config(rig, motion)?)
        }
        ArmDriver::Franka => movable_franka_arm(rig, motion),
        ArmDriver::Ur => super::ur::movable_arm(rig, motion),
        _ => bail!("{READ_ONLY}"),
    }
}

/// The settings with which the arm of a rig may be moved.
///
/// # Errors
///
/// If the rig file does not say so.
pub fn motion_of(rig: &Rig) -> Result<&ArmMotion, BadInput> {
    rig.arm.motion.as_ref().ok_or_else(|| {
        BadInput(
            "the rig file has no table [arm.motion], so its arm is only read: see docs/guide/moving-arms.md".to_owned(),
        )
    })
}

/// Checks the motion settings as far as possible without the arm.
///
/// # Errors
///
/// If the driver cannot move arms or does not support the settings.
pub fn check_motion(rig: &Rig) -> anyhow::Result<()> {
    let Some(motion) = &rig.arm.motion else {
        return Ok(());
    };
    match rig.arm.driver {
        #[cfg(target_os = "linux")]
        ArmDriver::Can => Ok(MovableCanArm::check(&movable_config(rig, motion)?)?),
        #[cfg(target_os = "linux")]
        ArmDriver::Feetech | ArmDriver::Dynamixel => {
            servos::check_motion(rig, motion_config(rig, motion)?)
        }
        #[cfg(target_os = "linux")]
        ArmDriver::Franka => {
            MovableFrankaArm::check(&motion_config(rig, motion)?).map_err(anyhow::Error::msg)
        }
        #[cfg(target_os = "linux")]
        ArmDriver::Ur => {
            MovableUrArm::check(&motion_config(rig, motion)?).map_err(anyhow::Error::msg)
        }
        _ => bail!("{READ_ONLY}"),
    }
}

#[cfg(target_os = "linux")]
fn movable_can_arm(rig: &Rig, motion: &ArmMotion) -> anyhow::Result<Box<dyn MovableArm>> {
    Ok(Box::new(MovableCanArm::open(&movable_config(
        rig, motion,
    )?)?))
}

#[cfg(target_os = "linux")]
fn movable_config(rig: &Rig, motion: &ArmMotion) -> anyhow::Result<MovableArmConfig> {
    let path = &motion.odrive_endpoints;
    let read_endpoints =
        || Endpoints::parse(&files::read_text(path.as_ref())?).map_err(anyhow::Error::new);
    // Only ODrive axes with firmware 0.6 need this file, so an empty path is no error.
    let endpoints = match path.as_str() {
        "" => None,
        _ => Some(
            read_endpoints().with_context(|| format!("arm.motion.odrive_endpoints {path:?}"))?,
        ),
    };
    let mut arm = can_config(rig);
    limit_efforts(&mut arm, &super::chain_of(rig)?);
    for motor in &mut arm.motors {
        odrive::set_endpoints(&mut motor.protocol, endpoints.as_ref());
    }
    Ok(MovableArmConfig {
        arm,
        motion: motion_config(rig, motion)?,
    })
}

/// For each effort that the rig file does not limit, uses the limit of the robot description.
#[cfg(target_os = "linux")]
fn limit_efforts(arm: &mut can::ArmConfig, chain: &kinematics::Chain) {
    for motor in &mut arm.motors {
        let joint_ix = chain
            .joint_names()
            .iter()
            .position(|joint| *joint == motor.joint);
        let effort = joint_ix
            .map(|joint_ix| chain.limits()[joint_ix].effort)
            .filter(|effort| effort.is_finite());
        motor.following.max_effort_nm = motor.following.max_effort_nm.or(effort);
    }
}

#[cfg(not(target_os = "linux"))]
fn movable_can_arm(_rig: &Rig, _motion: &ArmMotion) -> anyhow::Result<Box<dyn MovableArm>> {
    bail!("arms on CAN buses can only be moved on Linux")
}

#[cfg(target_os = "linux")]
fn can_config(rig: &Rig) -> can::ArmConfig {
    let Rig { arm, .. } = rig;
    can::ArmConfig {
        buses: arm.buses.clone(),
        motors: arm.motors.clone(),
        rate_hz: arm.rate_hz,
    }
}

/// Opens an arm with motors on CAN buses.
#[cfg(target_os = "linux")]
fn can_arm(rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    Ok(Box::new(CanArm::open(&can_config(rig))?))
}

#[cfg(not(target_os = "linux"))]
fn can_arm(_rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    bail!("arms on CAN buses can only be read on Linux")
}

/// Opens a Franka arm for reading over FCI.
#[cfg(target_os = "linux")]
fn franka_arm(rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    Ok(Box::new(FrankaArm::open(&franka_config(rig)?)?))
}

/// Opens a Franka arm for motion over FCI.
#[cfg(target_os = "linux")]
fn movable_franka_arm(rig: &Rig, motion: &ArmMotion) -> anyhow::Result<Box<dyn MovableArm>> {
    let defaults = franka::ContactConfig::default();
    let contact = franka::ContactConfig {
        torque_nm: motion.contact_torque_nm.unwrap_or(defaults.torque_nm),
        force_n: motion.contact_force_n.unwrap_or(defaults.force_n),
        moment_nm: motion.contact_moment_nm.unwrap_or(defaults.moment_nm),
        stiffness_nm_rad: motion.stiffness_nm_rad,
    };
    let arm = MovableFrankaArm::open(&franka_config(rig)?, &motion_config(rig, motion)?, &contact)?;
    Ok(Box::new(arm))
}

#[cfg(not(target_os = "linux"))]
fn movable_franka_arm(_rig: &Rig, _motion: &ArmMotion) -> anyhow::Result<Box<dyn MovableArm>> {
    bail!("Franka arms can only be moved on Linux")
}

#[cfg(target_os = "linux")]
fn franka_config(rig: &Rig) -> anyhow::Result<franka::ArmConfig> {
    let Rig { arm, .. } = rig;
    if arm.address.is_empty() {
        bail!(
            "arm.address is missing: set it to the address of the robot's controller, such as \"172.16.0.2\""
        );
    }
    Ok(franka::ArmConfig {
        address: arm.address.clone(),
        joint_names: arm.joints.clone(),
        chain: controller_chain(rig)?,
    })
}

#[cfg(not(target_os = "linux"))]
fn franka_arm(_rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    bail!("Franka arms can only be read on Linux")
}

/// Opens an arm whose joint states are sent by another program.
fn udp_arm(rig: &Rig) -> anyhow::Result<UdpArm> {
    let arm = UdpArm::open(&rig.arm.joints, udp_arm_address(rig)?)?;
    log::info!("arm: listening on {}", arm.address());
    Ok(arm)
}

/// The address on which [`ArmDriver::Udp`] receives joint states.
///
/// # Errors
///
/// If `arm.address` is not an IP address with a port.
pub fn udp_arm_address(rig: &Rig) -> anyhow::Result<SocketAddr> {
    match &*rig.arm.address {
        "" => Ok(DEFAULT_ARM_ADDRESS),
        text => text.parse().with_context(|| {
            format!("arm.address is {text:?}; the driver udp listens on an address such as {DEFAULT_ARM_ADDRESS}")
        }),
    }
}

/// Opens the color images of a V4L2 camera, and its depth images if the rig file configures depth.
#[cfg(target_os = "linux")]
fn v4l2_cameras(camera: &Camera) -> anyhow::Result<Vec<Box<dyn drivers::Camera>>> {
    // The settings of depth are checked before the color camera is opened.
    let depth = camera
        .depth
        .as_ref()
        .map(|depth| v4l2_depth(camera, depth))
        .transpose()?;
    let configs = std::iter::once(v4l2_color(camera)).chain(depth);
    configs
        .map(|config| Ok(Box::new(V4l2Camera::open(config)?) as Box<dyn drivers::Camera>))
        .collect()
}

#[cfg(not(target_os = "linux"))]
fn v4l2_cameras(camera: &Camera) -> anyhow::Result<Vec<Box<dyn drivers::Camera>>> {
    bail!(
        "camera {:?}: V4L2 is only available on Linux; use driver = \"nokhwa\" for webcams",
        camera.name
    )
}

/// Opens a camera with nokhwa, which sets only size, rate and format.
#[cfg(feature = "nokhwa")]
fn nokhwa_camera(camera: &Camera) -> anyhow::Result<Box<dyn drivers::Camera>> {
    let Camera { name, v4l2, .. } = camera;
    if v4l2.gain.is_some() || v4l2.brightness.is_some() || v4l2.white_balance_kelvin.is_some() {
        bail!(
            "camera {name:?}: the driver nokhwa does not support gain, brightness or white balance: remove them"
        );
    }
    if camera.depth.is_some() {
        bail!("camera {name:?}: the driver nokhwa does not support depth");
    }
    let config = drivers::nokhwa::Config {
        name: name.to_string(),
        device: camera.device.clone(),
        format: v4l2.format,
        intrinsics: camera.intrinsics.clone(),
        rate_hz: camera.rate_hz,
        exposure_micros: camera.exposure_micros,
        delivery: v4l2.delivery,
        reconnect_for: Duration::from_secs_f64(v4l2.reconnect_secs),
    };
    Ok(Box::new(drivers::nokhwa::NokhwaCamera::open(config)?))
}

#[cfg(not(feature = "nokhwa"))]
fn nokhwa_camera(camera: &Camera) -> anyhow::Result<Box<dyn drivers::Camera>> {
    bail!(
        "camera {:?}: this program was built without nokhwa: build it with `cargo build --release --features nokhwa`; \
         on Linux, use driver = \"v4l2\" for webcams",
        camera.name
    )
}

/// Settings of the color images of a camera.
#[cfg(target_os = "linux")]
fn v4l2_color(camera: &Camera) -> Config {
    Config {
        name: camera.name.to_string(),
        device: camera.device.clone(),
        format: camera.v4l2.format,
        intrinsics: camera.intrinsics.clone(),
        rate_hz: camera.rate_hz,
        meters_per_count: None,
        settings: Settings {
            exposure_micros: camera.exposure_micros,
            gain: camera.v4l2.gain,
            white_balance_kelvin: camera.v4l2.white_balance_kelvin,
            brightness: camera.v4l2.brightness,
        },
        delivery: camera.v4l2.delivery,
        reconnect_for: Duration::from_secs_f64(camera.v4l2.reconnect_secs),
    }
}

/// Settings of the depth images of a camera, which come from a separate device with automatic
/// exposure.
#[cfg(target_os = "linux")]
fn v4l2_depth(camera: &Camera, depth: &Depth) -> anyhow::Result<Config> {
    let Some(meters_per_count) = depth.meters_per_count else {
        let name = &camera.name;
        bail!(
            "camera.{name}.depth.meters_per_count is missing: set it to the meters per count of the depth images, 0.001 for a RealSense D4xx"
        );
    };
    Ok(Config {
        device: depth.device.clone(),
        format: Some(V4l2Format::Z16),
        intrinsics: depth.intrinsics.clone(),
        meters_per_count: Some(meters_per_count),
        settings: Settings::default(),
        ..v4l2_color(camera)
    })
}
