//! Reads each device of a rig separately, so that a device that cannot be opened does not keep the
//! others from being read. Devices that fail are opened again and again.

use crate::config::{ArmDriver, BaseDriver, Parent, Rig};
use crate::open::{self, Devices, Opened};
use crate::stamp_clock::StampClock;
use crate::stop::Stop;
use anyhow::Context;
use drivers::{Sample, device_names};
use std::ops::ControlFlow;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Time between a failure and the next attempt to open a device. A shorter time would fill the log
/// of the kernel with attempts; with a longer one, a device that was just connected seems dead.
const RETRY_PERIOD: Duration = Duration::from_secs(2);
/// Maximum time for closing the devices. Nobody waits longer for a program that saves nothing.
const MAX_CLOSING: Duration = Duration::from_secs(3);
/// Interval at which a waiting thread checks whether it has to stop.
const POLL: Duration = Duration::from_millis(50);
/// Number of events that wait for the caller. If the queue is full, the drivers drop samples.
const MAX_WAITING: usize = 64;

/// Devices that are opened together.
#[derive(Clone, Debug)]
pub struct DeviceGroup {
    /// The devices, by their names in [`drivers::device_names`].
    pub devices: Vec<String>,
    /// Whether a failure ends the attempts, because it would occur again. This holds for simulated
    /// devices.
    pub is_simulated: bool,
    rig: Rig,
    opened_as: Devices,
}

/// What happens in a group of devices.
pub enum DeviceEvent {
    /// The devices are open.
    Opened {
        /// The rig of the group, with the calibration that the devices report.
        rig: Box<Rig>,
        /// The clock of the stamps.
        stamp_clock: StampClock,
    },
    /// A sample.
    Sample(Sample),
    /// The devices could not be opened, or failed. Real devices are opened again after a while.
    Failed(anyhow::Error),
    /// The simulation or the files of the cameras have ended.
    Ended,
}

impl DeviceGroup {
    /// The devices of a rig, in groups that are opened together. Each real device is a group. All
    /// devices of a rig with simulated devices are one group, because one simulation moves them.
    #[must_use]
    pub fn list(rig: &Rig, devices: Devices) -> Vec<Self> {
        if devices == Devices::Sim || open::is_any_simulated(rig) {
            return vec![Self {
                devices: names(rig),
                is_simulated: true,
                rig: rig.clone(),
                opened_as: devices,
            }];
        }
        parts(rig).into_iter().map(Self::of_real).collect()
    }

    fn of_real(rig: Rig) -> Self {
        Self {
            devices: names(&rig),
            is_simulated: false,
            rig,
            opened_as: Devices::Real,
        }
    }

    fn open(&self) -> anyhow::Result<Opened> {
        open::rig(self.rig.clone(), self.opened_as)
    }
}

/// The rig, split into rigs of one device each.
fn parts(rig: &Rig) -> Vec<Rig> {
    let empty = {
        let mut empty = rig.clone();
        empty.cameras.clear();
        empty.scanners.clear();
        empty.arm.driver = ArmDriver::None;
        empty.base.driver = BaseDriver::Fixed;
        empty
    };
    let mut parts = Vec::new();
    for camera in &rig.cameras {
        let mut camera = camera.clone();
        // A camera on the flange cannot be opened without the arm, but its images do not depend on
        // the arm.
        camera.parent = Parent::World;
        let mut part = empty.clone();
        part.cameras.push(camera);
        parts.push(part);
    }
    if rig.arm.driver != ArmDriver::None {
        let mut part = empty.clone();
        part.arm.driver = rig.arm.driver;
        parts.push(part);
    }
    // The other drivers of bases are not devices: tags are searched in the images of cameras.
    if rig.base.driver == BaseDriver::Udp {
        let mut part = empty.clone();
        part.base.driver = rig.base.driver;
        parts.push(part);
    }
    for scanner in &rig.scanners {
        let mut part = empty.clone();
        part.scanners.push(scanner.clone());
        parts.push(part);
    }
    parts
}

/// Names of the devices of a rig.
fn names(rig: &Rig) -> Vec<String> {
    let mut names = Vec::new();
    for camera in &rig.cameras {
        names.push(device_names::camera(&camera.name));
        if camera.depth.is_some() {
            names.push(device_names::camera_depth(&camera.name));
        }
    }
    if rig.arm.driver != ArmDriver::None {
        names.push(device_names::ARM.to_owned());
    }
    if matches!(rig.base.driver, BaseDriver::Udp | BaseDriver::Sim) {
        names.push(device_names::BASE.to_owned());
    }
    let scanners = rig.scanners.iter();
    names.extend(scanners.map(|scanner| device_names::range_scanner(&scanner.name)));
    names
}

/// The devices of a rig while they are read.
pub struct SeparateDevices {
    events: Option<Receiver<(usize, DeviceEvent)>>,
    stop: Stop,
    threads: Vec<JoinHandle<()>>,
}

impl SeparateDevices {
    /// Starts to open and to read the groups, each on a thread.
    ///
    /// # Errors
    ///
    /// If a thread cannot be started.
    pub fn start(groups: Vec<DeviceGroup>) -> anyhow::Result<Self> {
        let (sender, events) = sync_channel(MAX_WAITING);
        let mut devices = Self {
            events: Some(events),
            stop: Stop::default(),
            threads: Vec::new(),
        };
        for (group_ix, group) in groups.into_iter().enumerate() {
            let reader = Reader {
                group_ix,
                group,
                sender: sender.clone(),
                stop: devices.stop.clone(),
            };
            let thread = std::thread::Builder::new()
                .name(format!("devices {group_ix}"))
                .spawn(move || reader.run())
                .context("cannot start a thread")?;
            devices.threads.push(thread);
        }
        Ok(devices)
    }

    /// Waits at most `timeout` for the next event. Returns it with the index of its group.
    pub fn next(&self, timeout: Duration) -> Option<(usize, DeviceEvent)> {
        match self.events.as_ref()?.recv_timeout(timeout) {
            Ok(event) => Some(event),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                // All groups have ended. The wait keeps the caller from a busy loop.
                std::thread::sleep(timeout);
                None
            }
        }
    }
}

impl Drop for SeparateDevices {
    fn drop(&mut self) {
        self.stop.request();
        // Wakes threads that wait for space in the queue.
        self.events = None;
        let began = Instant::now();
        for thread in self.threads.drain(..) {
            while !thread.is_finished() && began.elapsed() < MAX_CLOSING {
                std::thread::sleep(POLL);
            }
            // A camera that was unplugged may block its thread while its driver searches it. Such a
            // thread ends with the process. A thread that panicked has already printed its message.
            if thread.is_finished() {
                let _ = thread.join();
            }
        }
    }
}

/// The thread of a group.
struct Reader {
    group_ix: usize,
    group: DeviceGroup,
    sender: SyncSender<(usize, DeviceEvent)>,
    stop: Stop,
}

impl Reader {
    fn run(self) {
        while !self.stop.requested() {
            let is_over = match self.read() {
                Ok(ControlFlow::Break(())) => true,
                Ok(ControlFlow::Continue(())) => self.send(DeviceEvent::Ended).is_break(),
                Err(error) => self.send(DeviceEvent::Failed(error)).is_break(),
            };
            if is_over || self.group.is_simulated {
                return;
            }
            self.wait();
        }
    }

    /// Opens the devices and reads them until they end. Breaks if the caller has gone.
    fn read(&self) -> anyhow::Result<ControlFlow<()>> {
        let Opened {
            rig,
            mut source,
            stamp_clock,
            ..
        } = self.group.open()?;
        let opened = DeviceEvent::Opened {
            rig: Box::new(rig),
            stamp_clock,
        };
        if self.send(opened).is_break() {
            return Ok(ControlFlow::Break(()));
        }
        while let Some(sample) = source.next_sample()? {
            if self.send(DeviceEvent::Sample(sample)).is_break() || self.stop.requested() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Sends an event; breaks if nobody receives it.
    fn send(&self, event: DeviceEvent) -> ControlFlow<()> {
        match self.sender.send((self.group_ix, event)) {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        }
    }

    /// Waits until the next attempt, or until a stop is requested.
    fn wait(&self) {
        let began = Instant::now();
        while began.elapsed() < RETRY_PERIOD && !self.stop.requested() {
            std::thread::sleep(POLL);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Override;
    use std::path::Path;

    /// A rig of this repository with a camera that is not connected, on the flange of an arm whose
    /// joint states anyone may send.
    fn rig() -> Rig {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        let overrides = [
            Override::new("arm.driver", "udp"),
            Override::new("arm.address", "127.0.0.1:0"),
            Override::new("camera.wrist.driver", "v4l2"),
            Override::new("camera.wrist.device", "no such serial"),
            Override::new("camera.wrist.depth.device", "no such serial"),
            Override::new("camera.wrist.depth.meters_per_count", 0.001),
        ];
        Rig::load(&path, &overrides).expect("a bundled rig file")
    }

    #[test]
    fn each_real_device_is_a_group_and_a_simulation_is_one_group() {
        let of_real: Vec<_> = DeviceGroup::list(&rig(), Devices::Real)
            .into_iter()
            .map(|group| (group.devices, group.is_simulated))
            .collect();
        let camera = vec![
            "camera \"wrist\"".to_owned(),
            "camera \"wrist\" depth".to_owned(),
        ];
        assert_eq!(
            of_real,
            [(camera.clone(), false), (vec!["arm".to_owned()], false)]
        );
        let simulated = DeviceGroup::list(&rig(), Devices::Sim);
        assert_eq!(simulated.len(), 1);
        assert!(simulated[0].is_simulated);
        assert_eq!(simulated[0].devices.len(), 3);
    }

    #[test]
    fn a_missing_camera_does_not_keep_the_arm_from_being_opened() {
        const LIMIT: Duration = Duration::from_secs(60);
        let devices = SeparateDevices::start(DeviceGroup::list(&rig(), Devices::Real))
            .expect("threads can be started");
        let mut n_failures = 0;
        let mut is_arm_open = false;
        // The second failure shows that the camera is tried again.
        while n_failures < 2 || !is_arm_open {
            match devices.next(LIMIT).expect("an event") {
                (0, DeviceEvent::Failed(error)) => {
                    // On a system without V4L2, another sentence names the camera.
                    assert!(format!("{error:#}").contains("no such serial"), "{error:#}");
                    n_failures += 1;
                }
                (1, DeviceEvent::Opened { .. }) => is_arm_open = true,
                // The arm is silent, so it fails after a while and is opened again.
                (1, DeviceEvent::Failed(_)) => (),
                (group_ix, _) => panic!("an unexpected event of group {group_ix}"),
            }
        }
    }
}
