//! The start of a live run: its devices, its folders and its sessions.

use super::in_progress::RunInProgress;
use super::previous::PreviousLiveRun;
use super::{RunPlan, available_data, startup};
use crate::checkpoints::RunFlags;
use crate::evaluate::Evaluator;
use crate::live_loop::{LiveLoop, LiveOptions, Pace};
use crate::robot_meshes;
use crate::run_folder::CreatedFolders;
use crate::session::{Evaluators, Session};
use crate::session_setup::{Services, SessionSetup};
use crate::steering::PreparedSteering;
use crate::training_clock::Clock;
use crate::viewers::{Viewers, gpu_notes};
use capture::config::Rig;
use capture::open::{self, Opened, SteeredRobot};
use capture::{
    Feed, Input, InputObserver, Join, Notes, RecordedMeshes, RobotMotion, StampClock, Stations,
    doctor,
};
use drivers::Source;
use gpu::Gpu;
use keyframe::Keyframe;
use kinematics::Stamp;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::{ModelKind, Resumed};
use viz::{Hub, Identity};

/// Maximum time of the scheduled evaluations, as a fraction of the training time. With a larger
/// fraction, there are more scores, but the model has had fewer training steps at any given time.
const MAX_EVALUATION_FRAC: f64 = 0.1;
/// Keyframes wait during an evaluation, so it must be short, especially on a software adapter.
const MAX_IMAGES_SCORED_LIVE: usize = 12;
const MAX_IMAGES_SCORED_LIVE_ON_CPU: usize = 4;

/// A run whose models are made.
pub struct PreparedRun<'a> {
    rig: Rig,
    parts: Parts<'a>,
    hub: Hub,
}

/// A run whose devices are open.
pub struct OpenedRun<'a> {
    opened: Opened,
    /// The parts of the robot that operators may steer, if they may.
    steered: Option<SteeredRobot>,
    /// Mesh files of the robot; `None` if the run is not recorded.
    meshes: Option<RecordedMeshes>,
    device_notes: Notes,
    parts: Parts<'a>,
    hub: Hub,
}

/// The parts of a run besides its input.
pub(super) struct Parts<'a> {
    pub(super) plan: RunPlan,
    pub(super) previous: Option<PreviousLiveRun>,
    pub(super) services: Services<'a>,
    pub(super) kinds: Vec<ModelKind>,
    /// Whether any camera measures depth.
    pub(super) has_depth: bool,
    pub(super) pace: Pace,
    pub(super) gpu: Arc<Gpu>,
    pub(super) models: Vec<Resumed>,
}

/// Camera and stamp of a keyframe that was evicted for lack of memory.
type Evicted = (Arc<str>, Stamp);

impl<'a> PreparedRun<'a> {
    pub(super) fn new(rig: Rig, parts: Parts<'a>) -> Self {
        let hub = Hub::new();
        startup::publish(&hub, &parts.kinds);
        Self { rig, parts, hub }
    }

    /// The hub of the clients that view the run.
    #[must_use]
    pub fn hub(&self) -> &Hub {
        &self.hub
    }

    /// Compiles kernels and opens the devices.
    pub fn open_devices(mut self) -> anyhow::Result<OpenedRun<'a>> {
        for finding in doctor::suspicious_values(&self.rig) {
            log::warn!("{finding}");
        }
        // A resumed run continues with the parameters of the first run.
        if self.parts.previous.is_none() {
            let training = &self.parts.plan.training;
            training.log_unestimated(available_data(&self.rig), self.parts.gpu.is_software());
        }
        // Kernels are compiled before the first image, so that keyframes do not wait.
        log::info!("compiling kernels for {}", self.parts.gpu.describe());
        for (model, kind) in self.parts.models.iter_mut().zip(&self.parts.kinds) {
            let text = format!("for the model {}", kind.name());
            startup::show(&self.hub, "compiling kernels", text);
            model.method.model_mut().prepare()?;
        }
        // The devices are opened last, because their data is used from the first sample on.
        startup::show(&self.hub, "opening devices", startup::devices(&self.rig));
        let device_notes = Notes::default();
        log::info!(
            "opening the {}",
            self.parts
                .plan
                .recording()
                .map_or("devices", |_| "recording")
        );
        let plan = &self.parts.plan;
        // Devices do not wait, so meshes are compressed before they are opened. A recording waits,
        // and may contain the meshes.
        let of_devices = plan.recording().is_none().then(|| plan.meshes(&self.rig));
        let (opened, steered) = plan.open(self.rig)?;
        let meshes = of_devices.unwrap_or_else(|| plan.meshes(&opened.rig));
        Ok(OpenedRun {
            steered,
            meshes,
            opened: opened.with_tag_check(&device_notes)?,
            device_notes,
            parts: self.parts,
            hub: self.hub,
        })
    }
}

impl OpenedRun<'_> {
    /// Creates the folders, makes the sessions, and starts to read the devices. Removes the folders
    /// if this fails.
    pub fn start(self) -> anyhow::Result<RunInProgress> {
        let mut created = CreatedFolders::default();
        match self.start_in(&mut created) {
            Ok(run) => Ok(RunInProgress { created, ..run }),
            Err(error) => {
                created.remove_created();
                Err(error)
            }
        }
    }

    fn start_in(self, created: &mut CreatedFolders) -> anyhow::Result<RunInProgress> {
        let Self {
            opened,
            steered,
            meshes,
            device_notes,
            parts,
            hub,
        } = self;
        let Opened {
            rig,
            source,
            damage,
            stamp_clock,
        } = opened;
        let Parts {
            plan,
            previous,
            services,
            kinds,
            has_depth,
            pace,
            gpu,
            models,
        } = parts;
        startup::show(&hub, "starting", "making the models".to_owned());
        // Folders are created after the devices are open. The rig that is written there contains
        // the calibration that the cameras report.
        let folders = created.make_each(plan.out(), &kinds, Some(&rig))?;
        let held = previous
            .as_ref()
            .map_or(&[][..], |previous| &previous.keyframes);
        let devices = (source, stamp_clock);
        let stations = stations(&rig, pace, &kinds, held);
        let (mut input, evicted) = input(&plan, &rig, meshes.as_ref(), stations, devices, held)?;
        input.join = input.join.with_notes(device_notes.clone());
        let robot = publish_robot(&hub, &rig)?;
        let steering = steered
            .map(|robot| PreparedSteering::new(robot, &rig))
            .transpose()?;
        let identity = identity(&plan, &folders, robot);
        let stop = services.stop.clone();
        let clearance = steering.as_ref().and_then(PreparedSteering::clearance_feed);
        let feed = Feed::start(input, observer(&hub, steering.as_ref()), stop.clone())?;
        let steering = steering
            .map(|steering| steering.start(&hub, Some(run_folder_of(&folders))))
            .transpose()?;
        let setup = SessionSetup {
            services,
            gpu: &gpu,
            evaluators: evaluators(&gpu)?,
            limits: plan.limits,
            clock: Clock::default(),
            n_models: kinds.len(),
            previous: previous.as_ref().map(|previous| &previous.run),
            keyframes: held,
            data: plan.recorded_data(),
            scale: rig.train.scale,
            initial_points: None,
            points_sha256: None,
            checkpoints: plan.checkpoints,
            profiles: false,
            run_flags: RunFlags {
                depth_from: None,
                flags: plan.flags(),
            },
            is_live: true,
            can_recover: true,
        };
        let sessions = models
            .into_iter()
            .zip(&folders)
            .map(|(resumed, folder)| session(&setup, &plan, resumed, folder, &evicted))
            .collect::<anyhow::Result<Vec<Session>>>()?;
        let options = LiveOptions {
            pace,
            start_keyframes: rig
                .join
                .start_keyframes_or_default(pace == Pace::RealTime, has_depth),
            identity,
            earlier_rejected: previous.as_ref().map_or(BTreeMap::new(), |previous| {
                previous.run.checkpoint.history.rejected().clone()
            }),
            notes: gpu_notes(&gpu),
            device_notes,
            open_gpu: services.open_gpu,
        };
        let held = sessions
            .first()
            .map_or(Vec::new(), |session| session.keyframes().to_vec());
        let mut live = LiveLoop::new(sessions, feed, hub, options).resume_from(held);
        if let Some(clearance) = clearance {
            live.draw_clearance_for(clearance);
        }
        Ok(RunInProgress {
            live,
            gpu,
            plan,
            stop,
            rig,
            folders,
            damage,
            created: CreatedFolders::default(),
            steering,
        })
    }
}

/// What receives the data of the devices besides the trainer.
fn observer(hub: &Hub, steering: Option<&PreparedSteering>) -> Box<dyn InputObserver> {
    let viewers = Viewers(hub.clone());
    match steering {
        Some(steering) => Box::new(steering.observer(viewers)),
        None => Box::new(viewers),
    }
}

/// Publishes the robot, and returns its name; `None` if there is no robot.
fn publish_robot(hub: &Hub, rig: &Rig) -> anyhow::Result<Option<String>> {
    let Some(robot) = robot_meshes::description(rig)? else {
        return Ok(None);
    };
    let name = robot.robot.name().to_owned();
    hub.set_robot(robot);
    Ok(Some(name))
}

/// Name of the robot and of the run. If there are several models, each has a subfolder in the
/// folder of the run.
fn identity(plan: &RunPlan, folders: &[PathBuf], robot: Option<String>) -> Identity {
    let name = |name: Option<&OsStr>| name.map(|name| name.to_string_lossy().into_owned());
    Identity {
        rig: Some(plan.rig_name()),
        robot,
        run: name(run_folder_of(folders).file_name()),
    }
}

/// The folder of the run.
///
/// * `folders`: the folders of its models.
fn run_folder_of(folders: &[PathBuf]) -> &Path {
    let run = match folders {
        [first, _, ..] => first.parent(),
        _ => folders.first().map(PathBuf::as_path),
    };
    run.unwrap_or(Path::new(""))
}

/// The corrections of a moving base. In lockstep, their order must not depend on the computer, and
/// some models cannot revise keyframes.
fn stations(
    rig: &Rig,
    pace: Pace,
    kinds: &[ModelKind],
    previous: &[Arc<Keyframe>],
) -> Option<Stations> {
    let stations = Stations::new(rig)?.resume_from(previous);
    let can_revise = kinds.iter().all(|kind| kind.entry().can_revise);
    Some(if pace == Pace::RealTime && can_revise {
        stations
    } else {
        stations.final_only()
    })
}

/// The input, with the keyframes of the previous run restored. Also returns keyframes that exceed
/// the memory limit.
fn input(
    plan: &RunPlan,
    rig: &Rig,
    meshes: Option<&RecordedMeshes>,
    stations: Option<Stations>,
    (source, stamp_clock): (Box<dyn Source>, StampClock),
    previous: &[Arc<Keyframe>],
) -> anyhow::Result<(Input, Vec<Evicted>)> {
    let (join, evicted) = Join::new(rig)?.resume_from(previous);
    let recorder = meshes
        .zip(plan.record.as_deref())
        .map(|(meshes, file)| open::recorder(file, rig, meshes))
        .transpose()?;
    let camera_intrinsics = rig.cameras.iter().map(|camera| {
        let intrinsics = &camera.intrinsics;
        (
            camera.name.clone(),
            (intrinsics.focal_px, intrinsics.principal_px),
        )
    });
    let input = Input {
        source,
        join,
        stations,
        recorder,
        robot_motion: RobotMotion::new(rig),
        stamp_clock,
        camera_intrinsics: camera_intrinsics.collect(),
    };
    Ok((input, evicted))
}

/// How the models of a live run are scored.
fn evaluators(gpu: &Gpu) -> anyhow::Result<Evaluators> {
    Ok(Evaluators {
        during_training: Evaluator::psnr_only(),
        max_images_during_training: if gpu.is_software() {
            MAX_IMAGES_SCORED_LIVE_ON_CPU
        } else {
            MAX_IMAGES_SCORED_LIVE
        },
        max_frac_during_training: Some(MAX_EVALUATION_FRAC),
        at_end: Evaluator::thorough(None)?,
    })
}

/// The session of one model, with the keyframes of the previous run.
///
/// * `evicted`: the keyframes of the previous run that exceed the memory limit of this run.
fn session(
    setup: &SessionSetup<'_>,
    plan: &RunPlan,
    resumed: Resumed,
    folder: &Path,
    evicted: &[Evicted],
) -> anyhow::Result<Session> {
    let untrained = resumed.untrained.clone();
    let mut session = setup.session(
        resumed,
        folder,
        plan.data_source(folder),
        plan.resume_command(),
    )?;
    // The model of the checkpoint was already trained on its keyframes, so only other keyframes are
    // pushed.
    for keyframe in setup.keyframes {
        if untrained.iter().any(|other| Arc::ptr_eq(other, keyframe)) {
            session.push(keyframe)?;
        } else {
            session.hold(keyframe);
        }
    }
    for (camera, stamp) in evicted {
        session.remove(camera, *stamp)?;
    }
    Ok(session)
}
