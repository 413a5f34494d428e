//! Sets exposure, gain, white balance and brightness from the rig file in the right order, and
//! reads them back.
//!
//! Source: Linux `v4l2-controls.h` and its documentation of user and camera controls. The ids are
//! defined by the kernel.

use super::Problem;
use super::abi::{self, QueryControl};
use super::device::Device;
use rustix::io::Errno;
use std::io;

/// Exposure is in units of 100 us.
const MICROS_PER_COUNT: f64 = 100.0;
/// Maximum relative difference between the exposure that was set and the exposure that is read
/// back. Cameras round the exposure to rows of their sensor.
const EXPOSURE_TOLERANCE_FRAC: f64 = 0.1;

/// Kernel id of a control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Id {
    Brightness = 0x0098_0900,
    AutoWhiteBalance = 0x0098_090c,
    AutoGain = 0x0098_0912,
    Gain = 0x0098_0913,
    WhiteBalanceTemperature = 0x0098_091a,
    ExposureAuto = 0x009a_0901,
    ExposureAbsolute = 0x009a_0902,
    /// `exposure_dynamic_framerate`, with which automatic exposure may lower the rate.
    ExposureAutoPriority = 0x009a_0903,
    AnalogueGain = 0x009e_0903,
}

/// Entries of the menu [`Id::ExposureAuto`].
const EXPOSURE_FULLY_AUTOMATIC: i32 = 0;
const EXPOSURE_MANUAL: i32 = 1;
const EXPOSURE_SHUTTER_PRIORITY: i32 = 2;
const EXPOSURE_APERTURE_PRIORITY: i32 = 3;

/// Image settings of the rig file. A missing setting is set to automatic if the camera supports it.
/// Otherwise, the setting is left unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Settings {
    /// Exposure time, microseconds. `None` selects automatic exposure that does not lower the rate.
    pub exposure_micros: Option<f64>,
    /// Gain, in units of the camera.
    pub gain: Option<i32>,
    /// White balance, kelvin.
    pub white_balance_kelvin: Option<i32>,
    /// Brightness, in units of the camera.
    pub brightness: Option<i32>,
}

/// One control to set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Step {
    control: &'static str,
    id: Id,
    value: i32,
    /// Maximum difference when read back.
    tolerance: i32,
    /// Whether the rig file requires this control. If not, a failure is only logged.
    is_required: bool,
}

/// Settings as read back from the camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct AppliedSettings {
    /// Exposure time in seconds, if it is fixed and known.
    pub(super) exposure_secs: Option<f64>,
    /// Whether the exposure is automatic and can be read.
    pub(super) reports_exposure: bool,
    /// Names and values for the log.
    pub(super) read_back: Vec<(&'static str, i32)>,
}

/// Access to the controls of a camera. It is implemented by a [`Device`], and by a table in tests.
pub(super) trait Controls {
    fn find(&self, id: Id) -> Option<QueryControl>;
    fn menu(&self, id: Id) -> Vec<i32>;
    fn set(&self, id: Id, value: i32) -> Result<(), Errno>;
    fn get(&self, id: Id) -> Result<i32, Errno>;
}

impl Controls for Device {
    fn find(&self, id: Id) -> Option<QueryControl> {
        self.control(id as u32)
    }

    fn menu(&self, id: Id) -> Vec<i32> {
        let Some(control) = self.control(id as u32) else {
            return Vec::new();
        };
        match control.kind {
            abi::CONTROL_MENU => {
                Self::menu(self, id as u32, control.minimum..=control.maximum.min(64))
            }
            _ => (control.minimum..=control.maximum.min(64)).collect(),
        }
    }

    fn set(&self, id: Id, value: i32) -> Result<(), Errno> {
        self.set_control(id as u32, value)
    }

    fn get(&self, id: Id) -> Result<i32, Errno> {
        self.control_value(id as u32)
    }
}

/// Applies the settings, reads them back, and checks them.
pub(super) fn apply(
    settings: &Settings,
    camera: &impl Controls,
) -> Result<AppliedSettings, Problem> {
    let steps = plan(settings, camera)?;
    for step in &steps {
        match camera.set(step.id, step.value) {
            // If the device is missing, the camera counts as disconnected even if the control is
            // optional. The driver then reconnects.
            Err(error) if step.is_required || error == Errno::NODEV => {
                return Err(refused(step.control, error));
            }
            Err(error) => log::debug!("{}: {error}", step.control),
            Ok(()) => {}
        }
    }
    check(settings, camera, &steps)
}

/// Checks the settings again after the stream has started, and reapplies them if necessary. Some
/// cameras reset their settings at the start of the stream.
pub(super) fn confirm(
    settings: &Settings,
    camera: &impl Controls,
) -> Result<AppliedSettings, Problem> {
    match check(settings, camera, &plan(settings, camera)?) {
        Err(Problem::ReadBack { .. }) => apply(settings, camera),
        other => other,
    }
}

/// Reads the settings back and checks them.
fn check(
    settings: &Settings,
    camera: &impl Controls,
    steps: &[Step],
) -> Result<AppliedSettings, Problem> {
    let mut applied = AppliedSettings::default();
    for step in steps {
        let got = match camera.get(step.id) {
            Ok(got) => got,
            Err(error) if step.is_required || error == Errno::NODEV => {
                return Err(refused(step.control, error));
            }
            Err(_) => continue,
        };
        if step.is_required && got.abs_diff(step.value) > step.tolerance.unsigned_abs() {
            return Err(Problem::ReadBack {
                control: step.control,
                requested: step.value,
                got,
            });
        }
        if step.id == Id::ExposureAbsolute {
            applied.exposure_secs = Some(secs_of_counts(got));
        }
        // Settings that are not required are included even if they differ.
        applied.read_back.push((step.control, got));
    }
    if settings.exposure_micros.is_none() {
        applied.reports_exposure = exposure_secs(camera).is_some();
    } else if applied.exposure_secs.is_none() {
        // The exposure of this camera cannot be set, so the exposure time of the rig file is used
        // as the known value.
        applied.exposure_secs = settings.exposure_micros.map(|micros| micros * 1e-6);
    }
    Ok(applied)
}

/// Exposure time that a camera reports, seconds.
pub(super) fn exposure_secs(camera: &impl Controls) -> Option<f64> {
    let counts = camera.get(Id::ExposureAbsolute).ok()?;
    (counts > 0).then(|| secs_of_counts(counts))
}

fn secs_of_counts(counts: i32) -> f64 {
    f64::from(counts) * MICROS_PER_COUNT * 1e-6
}

fn refused(control: &'static str, error: Errno) -> Problem {
    match error {
        Errno::NODEV => Problem::Unplugged {
            source: error.into(),
        },
        _ => Problem::Refused {
            what: control,
            source: io::Error::from(error),
        },
    }
}

/// Controls to set, in order. Automatic modes come first, because a value cannot be set while its
/// control is automatic.
fn plan(settings: &Settings, camera: &impl Controls) -> Result<Vec<Step>, Problem> {
    let mut steps = Vec::new();
    exposure(settings.exposure_micros, camera, &mut steps)?;
    let gain_id = [Id::Gain, Id::AnalogueGain]
        .into_iter()
        .find(|id| camera.find(*id).is_some());
    let gain = AutoControl {
        auto: ("automatic gain", Id::AutoGain),
        fixed: ("v4l2.gain", gain_id.unwrap_or(Id::Gain)),
    };
    gain.plan(settings.gain, camera, &mut steps)?;
    let balance = AutoControl {
        auto: ("automatic white balance", Id::AutoWhiteBalance),
        fixed: ("v4l2.white_balance_kelvin", Id::WhiteBalanceTemperature),
    };
    balance.plan(settings.white_balance_kelvin, camera, &mut steps)?;
    if let Some(value) = settings.brightness {
        steps.push(fixed("v4l2.brightness", Id::Brightness, value, camera)?);
    }
    Ok(steps)
}

/// A value with an automatic mode.
struct AutoControl {
    auto: (&'static str, Id),
    fixed: (&'static str, Id),
}

impl AutoControl {
    fn plan(
        &self,
        value: Option<i32>,
        camera: &impl Controls,
        steps: &mut Vec<Step>,
    ) -> Result<(), Problem> {
        let (control, id) = self.auto;
        if camera.find(id).is_some() {
            let is_required = value.is_some();
            steps.push(Step {
                control,
                id,
                // The automatic mode is off if the rig file sets a value. Otherwise, it is on.
                value: i32::from(!is_required),
                tolerance: 0,
                is_required,
            });
        }
        if let Some(value) = value {
            steps.push(fixed(self.fixed.0, self.fixed.1, value, camera)?);
        }
        Ok(())
    }
}

/// Checks a value against the range and step of its control, and returns it.
fn fixed(
    control: &'static str,
    id: Id,
    value: i32,
    camera: &impl Controls,
) -> Result<Step, Problem> {
    let known = camera.find(id).ok_or(Problem::NoControl { control })?;
    let step = known.step.max(1);
    let is_known = (known.minimum..=known.maximum).contains(&value)
        // The difference is computed in 64 bits, because the difference of two 32-bit numbers may
        // overflow.
        && (i64::from(value) - i64::from(known.minimum)) % i64::from(step) == 0;
    if !is_known {
        return Err(Problem::ControlRange {
            control,
            requested: value.into(),
            min: known.minimum.into(),
            max: known.maximum.into(),
            step: step.into(),
        });
    }
    Ok(Step {
        control,
        id,
        value,
        tolerance: 0,
        is_required: true,
    })
}

/// Plans the exposure mode and the option that keeps the rate under automatic exposure. Also plans
/// the exposure time if it is fixed.
fn exposure(
    micros: Option<f64>,
    camera: &impl Controls,
    steps: &mut Vec<Step>,
) -> Result<(), Problem> {
    let entries = camera.menu(Id::ExposureAuto);
    let candidates = match micros {
        // Cameras without an iris report automatic exposure as aperture priority.
        None => [EXPOSURE_APERTURE_PRIORITY, EXPOSURE_FULLY_AUTOMATIC],
        Some(_) => [EXPOSURE_MANUAL, EXPOSURE_SHUTTER_PRIORITY],
    };
    if let Some(value) = candidates.into_iter().find(|entry| entries.contains(entry)) {
        let is_required = micros.is_some();
        steps.push(Step {
            control: "exposure mode",
            id: Id::ExposureAuto,
            value,
            tolerance: 0,
            is_required,
        });
    }
    if camera.find(Id::ExposureAutoPriority).is_some() {
        let control = "exposure_dynamic_framerate";
        steps.push(Step {
            control,
            id: Id::ExposureAutoPriority,
            // With automatic exposure, cameras lower their rate in the dark. Images would then be
            // missing, and their motion blur would be longer.
            value: 0,
            tolerance: 0,
            is_required: false,
        });
    }
    if let Some(micros) = micros
        && let Some(known) = camera.find(Id::ExposureAbsolute)
    {
        steps.push(exposure_time(micros, &known)?);
    }
    Ok(())
}

/// A fixed exposure time, rounded to the steps of its control.
fn exposure_time(micros: f64, known: &QueryControl) -> Result<Step, Problem> {
    // The kernel would round silently. The nearest step of the control is therefore chosen here, so
    // that the value read back can be compared.
    let step = f64::from(known.step.max(1));
    let nearest = ((micros / MICROS_PER_COUNT - f64::from(known.minimum)) / step).round() * step
        + f64::from(known.minimum);
    // A value is rejected if rounding moves it outside the range.
    let counts = (f64::from(known.minimum)..=f64::from(known.maximum))
        .contains(&nearest)
        .then_some(nearest);
    #[expect(
        clippy::cast_possible_truncation,
        reason = "within the range of the control, which is 32 bits wide"
    )]
    let value = counts
        .map(|counts| counts as i32)
        .ok_or(Problem::ControlRange {
            control: "exposure_micros",
            requested: micros,
            min: f64::from(known.minimum) * MICROS_PER_COUNT,
            max: f64::from(known.maximum) * MICROS_PER_COUNT,
            step: step * MICROS_PER_COUNT,
        })?;
    #[expect(clippy::cast_possible_truncation, reason = "a tenth of 32 bits")]
    let tolerance = (f64::from(value) * EXPOSURE_TOLERANCE_FRAC) as i32;
    // The tolerance of a short exposure may be less than one step.
    let tolerance = tolerance.max(known.step);
    Ok(Step {
        control: "exposure_micros",
        id: Id::ExposureAbsolute,
        value,
        tolerance,
        is_required: true,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;
    use std::collections::BTreeMap;

    /// A camera that is defined by a table of controls, with id, minimum, maximum and step.
    struct FakeControls {
        controls: &'static [(Id, i32, i32, i32)],
        exposure_modes: &'static [i32],
    }

    /// A camera with current values by kernel id. Setting the ids in `rejects` fails.
    struct FakeCamera {
        controls_table: FakeControls,
        values: RefCell<BTreeMap<u32, i32>>,
        rejects: &'static [Id],
    }

    impl Controls for FakeCamera {
        fn find(&self, id: Id) -> Option<QueryControl> {
            self.controls_table.find(id)
        }

        fn menu(&self, id: Id) -> Vec<i32> {
            self.controls_table.menu(id)
        }

        fn set(&self, id: Id, value: i32) -> Result<(), Errno> {
            if self.rejects.contains(&id) {
                return Err(Errno::IO);
            }
            // Sensors expose whole rows, so they round the value.
            let taken = if id == Id::ExposureAbsolute {
                value - 1
            } else {
                value
            };
            self.values.borrow_mut().insert(id as u32, taken);
            Ok(())
        }

        fn get(&self, id: Id) -> Result<i32, Errno> {
            self.find(id).ok_or(Errno::INVAL)?;
            Ok(self.values.borrow().get(&(id as u32)).copied().unwrap_or(0))
        }
    }

    fn fake_camera(controls_table: FakeControls, rejects: &'static [Id]) -> FakeCamera {
        FakeCamera {
            controls_table,
            values: RefCell::default(),
            rejects,
        }
    }

    impl Controls for FakeControls {
        fn find(&self, id: Id) -> Option<QueryControl> {
            let (_, minimum, maximum, step) =
                *self.controls.iter().find(|control| control.0 == id)?;
            Some(QueryControl {
                id: id as u32,
                minimum,
                maximum,
                step,
                ..Default::default()
            })
        }

        fn menu(&self, _: Id) -> Vec<i32> {
            self.exposure_modes.to_vec()
        }

        fn set(&self, _: Id, _: i32) -> Result<(), Errno> {
            Err(Errno::ACCESS)
        }

        fn get(&self, _: Id) -> Result<i32, Errno> {
            Err(Errno::ACCESS)
        }
    }

    /// Logitech C920, as printed by `v4l2-ctl -L` (kernel 5.15, firmware 0.0.15).
    const C920: FakeControls = FakeControls {
        controls: &[
            (Id::Brightness, 0, 255, 1),
            (Id::AutoWhiteBalance, 0, 1, 1),
            (Id::Gain, 0, 255, 1),
            (Id::WhiteBalanceTemperature, 2000, 6500, 1),
            (Id::ExposureAuto, 0, 3, 1),
            (Id::ExposureAbsolute, 3, 2047, 1),
            (Id::ExposureAutoPriority, 0, 1, 1),
        ],
        exposure_modes: &[1, 3],
    };

    /// The test driver vivid.
    const VIVID: FakeControls = FakeControls {
        controls: &[
            (Id::Brightness, 0, 255, 1),
            (Id::AutoGain, 0, 1, 1),
            (Id::Gain, 0, 255, 1),
        ],
        exposure_modes: &[],
    };

    fn planned(settings: &Settings, camera: &FakeControls) -> Vec<(Id, i32)> {
        plan(settings, camera)
            .expect("the settings are supported")
            .iter()
            .map(|step| (step.id, step.value))
            .collect()
    }

    #[test]
    fn unset_settings_are_automatic_and_keep_rate() {
        let automatic = planned(&Settings::default(), &C920);
        let requested = [
            (Id::ExposureAuto, 3),
            (Id::ExposureAutoPriority, 0),
            (Id::AutoWhiteBalance, 1),
        ];
        assert_eq!(automatic, requested);
        assert_eq!(planned(&Settings::default(), &VIVID), [(Id::AutoGain, 1)]);
    }

    #[test]
    fn fixed_settings_follow_disabling_automation() {
        let settings = Settings {
            exposure_micros: Some(4040.0),
            gain: Some(12),
            white_balance_kelvin: Some(4600),
            brightness: Some(100),
        };
        let requested = [
            (Id::ExposureAuto, 1),
            (Id::ExposureAutoPriority, 0),
            (Id::ExposureAbsolute, 40),
            (Id::Gain, 12),
            (Id::AutoWhiteBalance, 0),
            (Id::WhiteBalanceTemperature, 4600),
            (Id::Brightness, 100),
        ];
        assert_eq!(planned(&settings, &C920), requested);
        let gain = Settings {
            gain: Some(12),
            ..Settings::default()
        };
        assert_eq!(planned(&gain, &VIVID), [(Id::AutoGain, 0), (Id::Gain, 12)]);
    }

    #[test]
    fn unsupported_settings_report_supported_range() {
        let plan_error = |settings: &Settings, camera: &FakeControls| {
            plan(settings, camera)
                .expect_err("the setting is unsupported")
                .to_string()
        };
        let too_short_exposure = Settings {
            exposure_micros: Some(100.0),
            ..Settings::default()
        };
        assert_eq!(
            plan_error(&too_short_exposure, &C920),
            "exposure_micros is 100, allowed: 300 to 204700 in steps of 100"
        );
        let too_high_gain = Settings {
            gain: Some(256),
            ..Settings::default()
        };
        assert_eq!(
            plan_error(&too_high_gain, &C920),
            "v4l2.gain is 256, allowed: 0 to 255 in steps of 1"
        );
        let unsupported_white_balance = Settings {
            white_balance_kelvin: Some(4600),
            ..Settings::default()
        };
        assert_eq!(
            plan_error(&unsupported_white_balance, &VIVID),
            "it has no control for v4l2.white_balance_kelvin: remove the key"
        );
        const COARSE: FakeControls = FakeControls {
            controls: &[(Id::Gain, 0, 100, 10)],
            exposure_modes: &[],
        };
        let misaligned_gain = Settings {
            gain: Some(15),
            ..Settings::default()
        };
        assert!(
            plan_error(&misaligned_gain, &COARSE).ends_with("allowed: 0 to 100 in steps of 10")
        );
    }

    #[test]
    fn camera_without_exposure_control_is_accepted() {
        // The key `exposure_micros` then states the known exposure time, as described in
        // docs/reference/rig.md.
        let known = Settings {
            exposure_micros: Some(4000.0),
            ..Settings::default()
        };
        assert_eq!(planned(&known, &VIVID), [(Id::AutoGain, 1)]);
    }

    #[test]
    fn settings_are_read_back_and_reapplied() {
        let settings = Settings {
            exposure_micros: Some(4000.0),
            gain: Some(12),
            ..Settings::default()
        };
        let camera = fake_camera(C920, &[]);
        let applied = apply(&settings, &camera).expect("all settings are accepted");
        assert_eq!(
            applied.exposure_secs,
            Some(secs_of_counts(39)),
            "the value read back"
        );
        assert!(applied.read_back.contains(&("v4l2.gain", 12)) && !applied.reports_exposure);
        camera.values.borrow_mut().insert(Id::Gain as u32, 64);
        assert!(
            confirm(&settings, &camera)
                .expect("the setting is reapplied")
                .read_back
                .contains(&("v4l2.gain", 12))
        );
        assert_eq!(camera.get(Id::Gain), Ok(12));
        assert!(
            (secs_of_counts(39) - 0.0039).abs() < 1e-12,
            "counts of 100 us"
        );
        // With automatic exposure, the exposure time is read with each image.
        camera
            .values
            .borrow_mut()
            .insert(Id::ExposureAbsolute as u32, 156);
        let automatic = apply(&Settings::default(), &camera).expect("all settings are accepted");
        assert!(automatic.reports_exposure && automatic.exposure_secs.is_none());
        assert_eq!(exposure_secs(&camera), Some(secs_of_counts(156)));
    }

    #[test]
    fn only_requested_settings_are_required() {
        let camera = fake_camera(
            C920,
            &[
                Id::ExposureAuto,
                Id::ExposureAutoPriority,
                Id::AutoWhiteBalance,
                Id::Gain,
            ],
        );
        assert!(
            apply(&Settings::default(), &camera).is_ok(),
            "no setting is required"
        );
        let gain = Settings {
            gain: Some(12),
            ..Settings::default()
        };
        let message = apply(&gain, &camera)
            .expect_err("the camera rejects the gain")
            .to_string();
        assert!(message.contains("v4l2.gain"), "{message}");
        // A camera that accepts a value but does not use it.
        let steps = plan(&gain, &C920).expect("the settings are supported");
        let message = check(&gain, &camera, &steps)
            .expect_err("the value read back is 0")
            .to_string();
        assert_eq!(message, "v4l2.gain was set to 12 and reads back as 0");
    }
}
