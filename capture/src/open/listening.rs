//! Opens the devices of a rig for measurements: devices that cannot be opened are left out.

use super::tags::TagBaseSource;
use super::{
    assume_calibration_of_simulated, check_arm, is_any_simulated, real, simulate,
    unsupported_device, without_readout_if_ideal,
};
use crate::config::{BaseDriver, Rig};
use drivers::udp::DatagramMonitor;
use drivers::{FlangeDifference, LiveDevices, Source, device_names};

/// A device that could not be opened.
#[derive(Debug)]
pub(crate) struct DeviceFailure {
    /// Name of the device, as in [`drivers::device_names`].
    pub(crate) device: String,
    /// Why it could not be opened.
    pub(crate) error: anyhow::Error,
}

/// The open devices of a rig.
pub(crate) struct Listening {
    /// The rig with calibration that the cameras reported.
    pub(crate) rig: Rig,
    /// The samples of all open devices. A device that fails does not end the source.
    pub(crate) source: Box<dyn Source>,
    /// Monitors of the devices that receive datagrams.
    pub(crate) monitors: Vec<DatagramMonitor>,
    /// The other devices.
    pub(crate) failures: Vec<DeviceFailure>,
    /// Difference between the flange poses of the robot description and of the controller. `None`
    /// if the device reports only joints. An arm with a large difference is not opened.
    pub(crate) flange_difference: Option<FlangeDifference>,
}

/// Opens each device that can be opened.
///
/// # Errors
///
/// If the simulation of a simulated device cannot be started.
pub(crate) fn for_listening(mut rig: Rig) -> anyhow::Result<Listening> {
    assume_calibration_of_simulated(&mut rig);
    without_readout_if_ideal(&mut rig);
    let mut failures = Vec::new();
    let mut note = |device: &str, error| {
        let device = device.to_owned();
        failures.push(DeviceFailure { device, error });
    };
    if let Some(device) = unsupported_device(&rig) {
        let error = anyhow::anyhow!("{device} cannot be opened by this version");
        note(device_names::BASE, error);
    }
    // Cameras on the flange of no arm can be read, but have no pose.
    if let Err(error) = check_arm(&rig) {
        note(device_names::ARM, error);
    }
    let mut leave_out = |device: String, error| {
        note(&device, error);
        Ok(())
    };
    let (real, monitors) = real::open(&mut rig, &mut leave_out)?;
    let flange_difference = real.arm.as_ref().and_then(|arm| arm.flange_difference());
    let source: Box<dyn Source> = if is_any_simulated(&rig) {
        simulate(&rig, real)?.0
    } else {
        Box::new(LiveDevices::continuing_after_errors(real)?)
    };
    let source: Box<dyn Source> = if rig.base.driver != BaseDriver::Tags {
        source
    } else if let Err(error) = TagBaseSource::check(&rig) {
        note(device_names::BASE, error);
        source
    } else {
        Box::new(TagBaseSource::new(&rig, source)?)
    };
    Ok(Listening {
        rig,
        source,
        monitors,
        failures,
        flange_difference,
    })
}
