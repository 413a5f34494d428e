//! The devices of a preview: whether they deliver samples, and their rates and ages.

use capture::DeviceGroup;
use capture::config::{ArmDriver, Rig};
use drivers::{Sample, device_names};
use std::collections::VecDeque;
use std::time::{Duration, Instant};
use viz::{DeviceState, DeviceStatus};

/// Time over which rates are measured. Over a shorter time, the rate of a slow camera would
/// fluctuate; over a longer time, a change would be seen late.
const RATE_WINDOW: Duration = Duration::from_secs(3);
/// A device counts as silent after this many periods of its rate in the rig file, but not before
/// [`MIN_SILENCE`].
const SILENT_PERIODS: f64 = 4.0;
const MIN_SILENCE: Duration = Duration::from_millis(1500);
/// Rate at which a Franka controller sends states, Hz.
const FRANKA_HZ: f64 = 1000.0;

/// The devices in the order of their groups.
pub(super) struct DeviceTable {
    devices: Vec<Device>,
}

struct Device {
    name: String,
    group_ix: usize,
    expected_hz: Option<f64>,
    has_ended: bool,
    /// Why it failed last; empty if it has not failed since it delivered a sample.
    reason: String,
    /// Arrival of the samples of the last [`RATE_WINDOW`], oldest first.
    arrivals: VecDeque<Instant>,
    /// When the newest sample arrived, and when it was captured.
    newest: Option<(Instant, Instant)>,
}

impl DeviceTable {
    pub(super) fn new(rig: &Rig, groups: &[DeviceGroup]) -> Self {
        let named = groups
            .iter()
            .enumerate()
            .flat_map(|(group_ix, group)| group.devices.iter().map(move |name| (group_ix, name)));
        let device = |(group_ix, name): (usize, &String)| {
            Device::new(name.clone(), group_ix, expected_hz(rig, name))
        };
        Self {
            devices: named.map(device).collect(),
        }
    }

    fn of_group(&mut self, group_ix: usize) -> impl Iterator<Item = &mut Device> {
        self.devices
            .iter_mut()
            .filter(move |device| device.group_ix == group_ix)
    }

    /// The devices of a group are open.
    pub(super) fn opened(&mut self, group_ix: usize) {
        for device in self.of_group(group_ix) {
            device.has_ended = false;
        }
    }

    /// The devices of a group failed. Logs this if it is news.
    pub(super) fn failed(&mut self, group_ix: usize, reason: &str) {
        for device in self.of_group(group_ix) {
            // Some reasons begin with the name of the device.
            let reason = reason
                .strip_prefix(&format!("{}: ", device.name))
                .unwrap_or(reason);
            if device.reason != reason {
                log::warn!("{}: {reason}; trying again until it works", device.name);
            }
            reason.clone_into(&mut device.reason);
        }
    }

    /// The samples of a group have ended.
    pub(super) fn ended(&mut self, group_ix: usize) {
        for device in self.of_group(group_ix) {
            device.has_ended = true;
        }
    }

    /// A sample arrived now that was captured at the given time.
    pub(super) fn received(&mut self, sample: &Sample, captured_at: Instant) {
        let Some(name) = device_names::of_sample(sample) else {
            return;
        };
        if let Some(device) = self.devices.iter_mut().find(|device| device.name == name) {
            device.received(Instant::now(), captured_at);
        }
    }

    pub(super) fn statuses(&mut self, now: Instant) -> Vec<DeviceStatus> {
        self.devices
            .iter_mut()
            .map(|device| device.status(now))
            .collect()
    }
}

impl Device {
    fn new(name: String, group_ix: usize, expected_hz: Option<f64>) -> Self {
        Self {
            name,
            group_ix,
            expected_hz,
            has_ended: false,
            reason: String::new(),
            arrivals: VecDeque::new(),
            newest: None,
        }
    }

    fn received(&mut self, now: Instant, captured_at: Instant) {
        if self.newest.is_none() || !self.reason.is_empty() {
            log::info!("{}: data arrive", self.name);
        }
        self.reason.clear();
        self.arrivals.push_back(now);
        self.forget_old(now);
        self.newest = Some((now, captured_at));
    }

    fn forget_old(&mut self, now: Instant) {
        while self
            .arrivals
            .front()
            .is_some_and(|at| now.saturating_duration_since(*at) > RATE_WINDOW)
        {
            self.arrivals.pop_front();
        }
    }

    fn status(&mut self, now: Instant) -> DeviceStatus {
        self.forget_old(now);
        let state = self.state(now);
        let reason = match state {
            DeviceState::Failed => self.reason.clone(),
            DeviceState::Silent => {
                let silence = self.silence(now).unwrap_or_default().as_secs_f64();
                format!(
                    "no data for {silence:.0} s: check its cable, or the program that sends its data"
                )
            }
            DeviceState::Ended => "its data have ended".to_owned(),
            DeviceState::Opening | DeviceState::Delivering => String::new(),
        };
        DeviceStatus {
            name: self.name.clone(),
            state,
            rate_hz: self.rate_hz().filter(|_| state == DeviceState::Delivering),
            expected_hz: self.expected_hz,
            age_millis: self
                .newest
                .map(|(_, captured)| 1e3 * now.saturating_duration_since(captured).as_secs_f64()),
            reason,
        }
    }

    fn state(&self, now: Instant) -> DeviceState {
        if self.has_ended {
            DeviceState::Ended
        } else if !self.reason.is_empty() {
            // A device that fails again and again, such as a silent sender, is open in between.
            DeviceState::Failed
        } else if self.newest.is_none() {
            DeviceState::Opening
        } else if self.silence(now) > Some(self.max_silence()) {
            DeviceState::Silent
        } else {
            DeviceState::Delivering
        }
    }

    /// Time since the newest sample arrived.
    fn silence(&self, now: Instant) -> Option<Duration> {
        let (arrived, _) = self.newest?;
        Some(now.saturating_duration_since(arrived))
    }

    fn max_silence(&self) -> Duration {
        let periods = self.expected_hz.map_or(Duration::ZERO, |hz| {
            Duration::from_secs_f64(SILENT_PERIODS / hz)
        });
        periods.max(MIN_SILENCE)
    }

    /// Samples per second between the first and the last sample of the window.
    fn rate_hz(&self) -> Option<f64> {
        let span = *self.arrivals.back()? - *self.arrivals.front()?;
        let n_periods = self.arrivals.len() - 1;
        (span > Duration::ZERO).then(|| n_periods as f64 / span.as_secs_f64())
    }
}

/// What is wrong with the devices, for the header; `None` if nothing is.
pub(super) fn summary(devices: &[DeviceStatus]) -> Option<String> {
    let bad: Vec<&DeviceStatus> = devices
        .iter()
        .filter(|device| matches!(device.state, DeviceState::Failed | DeviceState::Silent))
        .collect();
    match bad[..] {
        [] => None,
        [only] => Some(format!("No data from {}: {}.", only.name, only.reason)),
        [first, ..] => Some(format!(
            "{} of {} devices send no data, such as {}: {}.",
            bad.len(),
            devices.len(),
            first.name,
            first.reason
        )),
    }
}

/// Rate of a device according to the rig file, Hz.
fn expected_hz(rig: &Rig, name: &str) -> Option<f64> {
    let is_arm_of_franka = name == device_names::ARM && rig.arm.driver == ArmDriver::Franka;
    let cameras = rig.cameras.iter().filter(|camera| {
        [
            device_names::camera(&camera.name),
            device_names::camera_depth(&camera.name),
        ]
        .iter()
        .any(|known| known == name)
    });
    let scanners = rig
        .scanners
        .iter()
        .filter(|scanner| device_names::range_scanner(&scanner.name) == name);
    let rates = cameras
        .map(|camera| camera.rate_hz)
        .chain(scanners.map(|scanner| scanner.rate_hz));
    rates.last().or(is_arm_of_franka.then_some(FRANKA_HZ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device() -> Device {
        Device::new("camera \"front\"".to_owned(), 0, Some(10.0))
    }

    #[test]
    fn rate_and_age_are_those_of_the_last_seconds() {
        let mut device = device();
        let began = Instant::now();
        let at = |millis: u64| began + Duration::from_millis(millis);
        assert_eq!(device.status(began).state, DeviceState::Opening);
        // Ten images per second, then twenty, each captured 30 ms before it arrives.
        let slow = (0..50).map(|ix| 100 * ix);
        let fast = (0..100).map(|ix| 5000 + 50 * ix);
        for millis in slow.chain(fast) {
            device.received(at(millis + 30), at(millis));
        }
        let status = device.status(at(9980));
        assert_eq!(status.state, DeviceState::Delivering);
        assert!(
            (status.rate_hz.expect("many samples") - 20.0).abs() < 0.01,
            "{status:?}"
        );
        assert!(
            (status.age_millis.expect("a sample") - 30.0).abs() < 1e-6,
            "{status:?}"
        );
        // The newest image was captured at 9950 ms and has arrived at 9980 ms.
        assert_eq!(device.status(at(11_470)).state, DeviceState::Delivering);
        let silent = device.status(at(13_000));
        assert_eq!(silent.state, DeviceState::Silent);
        assert_eq!(silent.rate_hz, None);
        assert!(
            silent.reason.contains("no data for 3 s"),
            "{}",
            silent.reason
        );
    }

    #[test]
    fn a_failed_device_stays_failed_until_its_next_sample() {
        let mut table = DeviceTable {
            devices: vec![device()],
        };
        table.failed(0, "camera \"front\": not connected");
        table.opened(0);
        let now = Instant::now();
        let statuses = table.statuses(now);
        assert_eq!(
            (statuses[0].state, &*statuses[0].reason),
            (DeviceState::Failed, "not connected")
        );
        assert_eq!(
            summary(&statuses).as_deref(),
            Some("No data from camera \"front\": not connected.")
        );
        table.devices[0].received(now, now);
        assert_eq!(table.statuses(now)[0].state, DeviceState::Delivering);
        assert_eq!(summary(&table.statuses(now)), None);
        table.ended(0);
        assert_eq!(table.statuses(now)[0].state, DeviceState::Ended);
    }

    #[test]
    fn slow_devices_may_be_silent_for_longer() {
        let mut slow = Device::new("camera \"slow\"".to_owned(), 0, Some(0.2));
        let began = Instant::now();
        slow.received(began, began);
        let after = |secs| began + Duration::from_secs(secs);
        assert_eq!(slow.status(after(15)).state, DeviceState::Delivering);
        assert_eq!(slow.status(after(21)).state, DeviceState::Silent);
    }
}
