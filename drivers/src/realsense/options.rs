//! Sets exposure, gain, white balance, presets and laser of a RealSense camera from the rig file,
//! and reads them back.

use super::sdk::{Device, Sensor};
use super::{Problem, Settings};
use realsense_rust::kind::{Rs2CameraInfo, Rs2Option};
use realsense_sys as sys;

/// Maximum relative difference between the exposure that was set and the exposure that is read
/// back. Cameras round the exposure to rows of their sensor.
const EXPOSURE_TOLERANCE_FRAC: f32 = 0.1;
/// Name of the RGB module of a depth camera. The module counts exposure like a webcam, whereas
/// depth sensors count microseconds.
const RGB_MODULE: &str = "RGB Camera";
const RGB_MICROS_PER_COUNT: f64 = 100.0;

/// Microseconds per count of the exposure of a sensor.
pub(super) fn exposure_micros_per_count(sensor: &Sensor) -> f64 {
    let name = sensor
        .options
        .info(Rs2CameraInfo::Name)
        .map(|name| name.to_string_lossy().into_owned());
    if name.as_deref() == Some(RGB_MODULE) {
        RGB_MICROS_PER_COUNT
    } else {
        1.0
    }
}

/// Applies the settings and reads them back. `image_sensor` is the sensor of the images that are
/// not depth. Returns a description of each setting.
pub(super) fn apply(
    settings: &Settings,
    device: &mut Device,
    image_sensor: usize,
) -> Result<Vec<String>, Problem> {
    let mut applied = Vec::new();
    for sensor in &mut device.sensors {
        // The camera clock is mapped in `stamps.rs`. The library's own mapping is biased by late
        // arrivals.
        set_if_supported(sensor, Rs2Option::GlobalTimeEnabled, 0.0);
    }
    if let Some(sensor) = device
        .sensors
        .iter_mut()
        .find(|sensor| is_supported(sensor, Rs2Option::DepthUnits))
    {
        // A preset changes other options, so it is set first.
        if let Some(name) = &settings.preset {
            let value = preset(sensor, name)?;
            set(
                sensor,
                "realsense.preset",
                Rs2Option::VisualPreset,
                value,
                0.0,
            )?;
            applied.push(format!("preset {name:?}"));
        }
        if let Some(power) = settings.laser_power {
            laser(sensor, power)?;
            applied.push(format!("laser power {power}"));
        }
    } else if settings.preset.is_some() || settings.laser_power.is_some() {
        return Err(Problem::NoSetting {
            setting: "realsense.preset or laser_power because it has no depth sensor",
        });
    }
    applied.extend(apply_image_settings(
        settings,
        &mut device.sensors[image_sensor],
    )?);
    Ok(applied)
}

/// Settings of the images that are not depth.
fn apply_image_settings(settings: &Settings, sensor: &mut Sensor) -> Result<Vec<String>, Problem> {
    let mut applied = Vec::new();
    // Automatic exposure must not lower the rate.
    set_if_supported(sensor, Rs2Option::AutoExposurePriority, 0.0);
    exposure_and_gain(settings, sensor, &mut applied)?;
    white_balance(settings.white_balance_kelvin, sensor, &mut applied)?;
    if let Some(brightness) = settings.brightness {
        set(
            sensor,
            "realsense.brightness",
            Rs2Option::Brightness,
            narrow(brightness.into()),
            0.0,
        )?;
        applied.push(format!("brightness {brightness}"));
    }
    Ok(applied)
}

/// Exposure and gain, which share one automatic mode.
fn exposure_and_gain(
    settings: &Settings,
    sensor: &mut Sensor,
    applied: &mut Vec<String>,
) -> Result<(), Problem> {
    match (settings.exposure_micros, settings.gain) {
        (None, None) => set_if_supported(sensor, Rs2Option::EnableAutoExposure, 1.0),
        (None, Some(gain)) => {
            return Err(Problem::SettingRange {
                setting: "realsense.gain",
                requested: gain.to_string(),
                allowed: "a gain only with exposure_micros, because automatic exposure sets both"
                    .into(),
            });
        }
        (Some(micros), gain) => {
            // The automatic mode is switched off first, because it overwrites values.
            set_if_supported(sensor, Rs2Option::EnableAutoExposure, 0.0);
            let counts = narrow(micros / exposure_micros_per_count(sensor));
            set(
                sensor,
                "exposure_micros",
                Rs2Option::Exposure,
                counts,
                counts * EXPOSURE_TOLERANCE_FRAC,
            )?;
            applied.push(format!("exposure {micros} us"));
            if let Some(gain) = gain {
                set(
                    sensor,
                    "realsense.gain",
                    Rs2Option::Gain,
                    narrow(gain.into()),
                    0.0,
                )?;
                applied.push(format!("gain {gain}"));
            }
        }
    }
    Ok(())
}

fn white_balance(
    kelvin: Option<i32>,
    sensor: &mut Sensor,
    applied: &mut Vec<String>,
) -> Result<(), Problem> {
    match kelvin {
        None => set_if_supported(sensor, Rs2Option::EnableAutoWhiteBalance, 1.0),
        Some(kelvin) => {
            set_if_supported(sensor, Rs2Option::EnableAutoWhiteBalance, 0.0);
            set(
                sensor,
                "realsense.white_balance_kelvin",
                Rs2Option::WhiteBalance,
                narrow(kelvin.into()),
                50.0,
            )?;
            applied.push(format!("white balance {kelvin} K"));
        }
    }
    Ok(())
}

fn laser(sensor: &mut Sensor, power: f64) -> Result<(), Problem> {
    const KEY: &str = "realsense.laser_power";
    // The range of the power may not include 0, so the emitter is switched off with a separate
    // option.
    if power == 0.0 && is_supported(sensor, Rs2Option::EmitterEnabled) {
        return set(sensor, KEY, Rs2Option::EmitterEnabled, 0.0, 0.0);
    }
    set_if_supported(sensor, Rs2Option::EmitterEnabled, 1.0);
    let step = sensor
        .options
        .get_option_range(Rs2Option::LaserPower)
        .map_or(0.0, |range| range.step);
    set(sensor, KEY, Rs2Option::LaserPower, narrow(power), step)
}

/// Value of the preset with this name. Case is ignored. Underscores and hyphens match spaces.
fn preset(sensor: &Sensor, name: &str) -> Result<f32, Problem> {
    const KEY: &str = "realsense.preset";
    // Case and separators have no meaning in names of presets.
    let normalized = |name: &str| name.to_lowercase().replace(['_', '-'], " ");
    let range = sensor
        .options
        .get_option_range(Rs2Option::VisualPreset)
        .ok_or(Problem::NoSetting { setting: KEY })?;
    let mut names = Vec::new();
    let mut value = range.min;
    while value <= range.max {
        if let Some(known) = sensor.value_name(sys::rs2_option_RS2_OPTION_VISUAL_PRESET, value) {
            if normalized(&known) == normalized(name) {
                return Ok(value);
            }
            names.push(format!("{known:?}"));
        }
        value += range.step.max(1.0);
    }
    Err(Problem::SettingRange {
        setting: KEY,
        requested: format!("{name:?}"),
        allowed: names.join(", "),
    })
}

fn is_supported(sensor: &Sensor, option: Rs2Option) -> bool {
    sensor.options.supports_option(option)
}

/// Sets an option that the rig file does not require. Failures are only logged.
fn set_if_supported(sensor: &mut Sensor, option: Rs2Option, value: f32) {
    if is_supported(sensor, option)
        && let Err(error) = sensor.options.set_option(option, value)
    {
        log::debug!("{option:?}: {error}");
    }
}

/// Sets an option that the rig file requires, and checks the value read back. `tolerance` is the
/// maximum difference.
fn set(
    sensor: &mut Sensor,
    setting: &'static str,
    option: Rs2Option,
    value: f32,
    tolerance: f32,
) -> Result<(), Problem> {
    let Some(range) = sensor.options.get_option_range(option) else {
        return Err(Problem::NoSetting { setting });
    };
    if !(range.min..=range.max).contains(&value) {
        let allowed = format!("{} to {} in the camera's units", range.min, range.max);
        return Err(Problem::SettingRange {
            setting,
            requested: value.to_string(),
            allowed,
        });
    }
    sensor
        .options
        .set_option(option, value)
        .map_err(|error| Problem::Library {
            what: setting,
            reason: error.to_string(),
        })?;
    match sensor.options.get_option(option) {
        // The library reports success even if the camera rounds or ignores a value.
        Some(got) if (got - value).abs() > tolerance => Err(Problem::ReadBack {
            setting,
            requested: value,
            got,
        }),
        _ => Ok(()),
    }
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "the library uses single precision"
)]
fn narrow(number: f64) -> f32 {
    number as f32
}
