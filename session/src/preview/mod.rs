//! A preview of a rig: live images, the moving robot and the state of each device, for viewers.
//! Nothing is trained, and nothing is written.

mod camera_poses;
mod device_table;
mod extent;

use crate::robot_meshes;
use camera_poses::CameraPoses;
use capture::config::{BaseDriver, Override, Rig};
use capture::open::{self, Devices};
use capture::{
    DeviceEvent, DeviceGroup, RobotMotion, SeparateDevices, StampClock, Stop, live_pixels,
};
use device_table::DeviceTable;
use drivers::{Image, Sample};
use keyframe::{LiveImage, RobotState};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use viz::{Advice, Hub, Identity, OperatorStatus, PreviewStatus, Status};

/// Period of status messages. People cannot read rates and ages that change more often.
const PUBLISH_PERIOD: Duration = Duration::from_millis(250);
/// Maximum time until requests of clients are answered while no samples arrive.
const POLL_PERIOD: Duration = Duration::from_millis(50);
/// State of a preview, for display.
const STATE: &str = "preview";
/// What a preview does not do, in words of the page.
const NOTHING_IS_TRAINED: &str = "Preview: nothing is trained, and nothing is written.";
/// Note on a rig without cameras.
const NO_CAMERAS: &str = "The rig file has no camera, so there are no images: connect a camera, find its name with \
    `fieldrig devices`, add a table [camera.NAME] to the rig file, and start the preview again.";
/// Answer to clients that request pictures or edits of a model.
const NO_MODEL: &str = "this is a preview: it has no model";

/// A preview whose rig file is read, and whose devices are not open yet.
pub struct Preview {
    rig_file: PathBuf,
    rig: Rig,
    groups: Vec<DeviceGroup>,
    hub: Hub,
}

impl Preview {
    /// Reads the rig file.
    ///
    /// # Errors
    ///
    /// If the rig file is invalid.
    pub fn of_rig_file(rig_file: &Path, is_simulated: bool) -> anyhow::Result<Self> {
        // A simulation that waits for a trainer, or that computes ground truth, would be slower
        // than real time.
        let overrides = [
            Override::new("sim.lockstep", false),
            Override::new("sim.truth", false),
        ];
        let rig = Rig::load(rig_file, &overrides)?;
        let devices = if is_simulated {
            Devices::Sim
        } else {
            Devices::Real
        };
        Ok(Self {
            rig_file: rig_file.to_owned(),
            groups: DeviceGroup::list(&rig, devices),
            rig,
            hub: Hub::new(),
        })
    }

    /// The hub of the clients that view the preview.
    #[must_use]
    pub fn hub(&self) -> &Hub {
        &self.hub
    }

    /// Opens the devices, and shows them until a stop is requested. Real devices that cannot be
    /// opened, or that fail, are listed and opened again after a while.
    ///
    /// # Errors
    ///
    /// If a thread cannot be started, or the simulation cannot be opened.
    pub fn serve(self, stop: &Stop) -> anyhow::Result<()> {
        let mut shown = Shown::new(&self)?;
        for note in &shown.notes {
            log::warn!("{note}");
        }
        shown.publish_status();
        let devices = SeparateDevices::start(self.groups)?;
        while !stop.requested() {
            if let Some((group_ix, event)) = devices.next(POLL_PERIOD) {
                shown.receive(group_ix, event)?;
            }
            shown.answer_requests();
            shown.publish_status_if_due();
        }
        Ok(())
    }
}

/// What the clients of a preview see.
struct Shown {
    hub: Hub,
    identity: Identity,
    notes: Vec<String>,
    devices: DeviceTable,
    /// Whether each group is simulated, so that its failure ends the preview.
    is_simulated: Vec<bool>,
    /// Clock of the stamps of each group.
    clocks: Vec<StampClock>,
    robot_motion: RobotMotion,
    robot: Option<RobotState>,
    cameras: CameraPoses,
    began: Instant,
    /// `None` before the first time.
    published: Option<Instant>,
}

impl Shown {
    fn new(preview: &Preview) -> anyhow::Result<Self> {
        let Preview {
            rig_file,
            rig,
            groups,
            hub,
        } = preview;
        let is_simulated: Vec<bool> = groups.iter().map(|group| group.is_simulated).collect();
        let mut notes = Vec::new();
        let mut rig = rig.clone();
        if rig.base.driver == BaseDriver::Tags && !is_simulated.contains(&true) {
            // The base stays at its pose in the rig file, because nothing searches the tags.
            rig.base.driver = BaseDriver::Fixed;
            notes.push(
                "The base is shown at base.world_from_base, because a preview does not search tags."
                    .to_owned(),
            );
        }
        if rig.cameras.is_empty() {
            notes.push(NO_CAMERAS.to_owned());
        }
        let rig_name = rig_file.file_stem();
        let identity = Identity {
            rig: rig_name.map(|name| name.to_string_lossy().into_owned()),
            ..Identity::default()
        };
        let cameras = CameraPoses::new(&rig);
        extent::publish(hub, &rig, &cameras);
        let mut shown = Self {
            hub: hub.clone(),
            identity,
            notes,
            devices: DeviceTable::new(&rig, groups),
            clocks: vec![StampClock::Computer; groups.len()],
            is_simulated,
            robot_motion: RobotMotion::new(&rig),
            robot: None,
            cameras,
            began: Instant::now(),
            published: None,
        };
        shown.publish_robot(&rig)?;
        Ok(shown)
    }

    fn publish_robot(&mut self, rig: &Rig) -> anyhow::Result<()> {
        // The simulation of a rig without an arm reads an arm without joints.
        if rig.arm.joints.is_empty() && !rig.has_moving_base() {
            return Ok(());
        }
        if let Some(robot) = robot_meshes::description(rig)? {
            self.identity.robot = Some(robot.robot.name().to_owned());
            self.hub.set_robot(robot);
        }
        Ok(())
    }

    /// Shows an event of a group of devices.
    fn receive(&mut self, group_ix: usize, event: DeviceEvent) -> anyhow::Result<()> {
        match event {
            DeviceEvent::Opened { rig, stamp_clock } => {
                self.clocks[group_ix] = stamp_clock;
                self.cameras.adopt(&rig);
                // A simulation may move a base that is fixed in the rig file.
                if self.is_simulated[group_ix] {
                    self.robot_motion = RobotMotion::new(&rig);
                    self.publish_robot(&rig)?;
                }
                self.devices.opened(group_ix);
            }
            DeviceEvent::Sample(sample) => self.show(group_ix, &sample),
            DeviceEvent::Failed(error) if self.is_simulated[group_ix] => return Err(error),
            DeviceEvent::Failed(error) => {
                self.devices
                    .failed(group_ix, &open::without_sim_hint(&error));
            }
            DeviceEvent::Ended => self.devices.ended(group_ix),
        }
        Ok(())
    }

    fn show(&mut self, group_ix: usize, sample: &Sample) {
        let clock = self.clocks[group_ix].clone();
        self.devices
            .received(sample, clock.captured_at(sample.stamp()));
        if let Sample::Image(image) = sample {
            self.show_image(image, &clock);
        } else if let Some(state) = self.robot_motion.push(sample, &clock) {
            if self.hub.needs_robot_state() {
                self.hub.set_robot_state(state.clone());
            }
            self.robot = Some(state);
        }
    }

    fn show_image(&self, image: &Image, clock: &StampClock) {
        // Images are decoded only while a client shows them.
        if image.is_depth() || !self.hub.needs_live_images() {
            return;
        }
        let Some(pixels) = live_pixels(image) else {
            return;
        };
        let (focal_px, principal_px) = self.cameras.pinhole(&image.camera, image.size_px);
        self.hub.set_live_image(LiveImage {
            camera: image.camera.clone(),
            stamp: image.stamp,
            captured_at: clock.captured_at(image.stamp),
            size_px: image.size_px,
            pixels,
            world_from_camera: self.cameras.pose(&image.camera, self.robot.as_ref()),
            focal_px,
            principal_px,
        });
    }

    /// Tells clients that request pictures or edits that there is no model.
    fn answer_requests(&self) {
        while let Some(pending) = self.hub.pictures().next_request() {
            pending.fail(NO_MODEL);
        }
        let requests = self.hub.operator_requests();
        for edit in requests.take_edits() {
            self.hub.reject_edit(&edit, NO_MODEL);
        }
        // Nothing can be paused or saved.
        requests.take_controls();
    }

    fn publish_status_if_due(&mut self) {
        if self
            .published
            .is_none_or(|at| at.elapsed() >= PUBLISH_PERIOD)
        {
            self.publish_status();
        }
    }

    /// The notes after which nobody has to act.
    fn infos(&self) -> Vec<String> {
        let notes = self.notes.iter();
        notes.filter(|note| *note != NO_CAMERAS).cloned().collect()
    }

    fn publish_status(&mut self) {
        self.published = Some(Instant::now());
        let devices = self.devices.statuses(Instant::now());
        let problem = device_table::summary(&devices);
        let text = match &problem {
            Some(problem) => format!("{NOTHING_IS_TRAINED} {problem}"),
            None => NOTHING_IS_TRAINED.to_owned(),
        };
        self.hub.set_status(Status {
            state: STATE.to_owned(),
            seconds: self.began.elapsed().as_secs_f64(),
            notes: self.notes.clone(),
            preview: Some(PreviewStatus { devices }),
            operator: OperatorStatus {
                identity: Some(self.identity.clone()),
                advice: Some(Advice {
                    text,
                    is_warning: problem.is_some(),
                }),
                infos: self.infos(),
                ..OperatorStatus::default()
            },
            ..Status::default()
        });
    }
}
