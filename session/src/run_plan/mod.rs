//! A live run: checks its input, opens the devices and the run folder, trains all models, and saves
//! them.
//!
//! [`RunPlan::prepare`] checks the plan and makes the models, [`PreparedRun::open_devices`] and
//! [`OpenedRun::start`] start the run, [`RunInProgress::run_to_end`] trains and saves, and
//! [`SavedRun::end`] returns the errors of the input.

mod in_progress;
mod no_model;
mod opening;
mod prepared;
mod previous;
mod saving;
mod startup;

pub use in_progress::{DiscardedRun, RunInProgress};
pub use prepared::{OpenedRun, PreparedRun};
pub use previous::PreviousLiveRun;
pub(crate) use saving::CORRECTED_RIG;
pub use saving::{EndedRun, SavedRun};

use crate::checkpoints::CheckpointOptions;
use crate::data::DataOptions;
use crate::live_loop::Pace;
use crate::method_options;
use crate::methods::methods_of;
use crate::next_commands::DataSource;
use crate::previous_run::{FinishedRun, PreviousRun, limit_flags, out_folder};
use crate::resume_command::{FROM, REAL_TIME, REPEAT, ResumeCommand};
use crate::run_folder;
use crate::session::Limits;
use crate::session_setup::Services;
use crate::training_options::{AvailableData, REALIGN, RefineSettings, TrainingOptions};
use capture::RecordedMeshes;
use capture::check_output_file;
use capture::config::{ArmDriver, Need, Override, Rig};
use capture::open::{self, Devices, Opened, SteeredRobot};
use gpu::Gpu;
use messages::{BadInput, Setting};
use model_files::Edits;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::splat::CountPolicy;
use trainer::{CommonOptions, ModelKind, Resumed};

/// Names of the flags in checkpoints.
const STEPS_PER_KEYFRAME: &str = "steps-per-keyframe";
const SIM: &str = "sim";
const LOCKSTEP: &str = "lockstep";
const RECORD: &str = "record";

/// Steps between two keyframes if the plan does not set them. With more steps, a model learns more
/// from each keyframe before the next one arrives, but the run takes longer.
const DEFAULT_STEPS_PER_KEYFRAME: u64 = 10;

/// Options of a live run.
#[derive(Clone, Debug)]
pub struct RunPlan {
    /// The rig file. `None` uses the rig that is stored in the recording.
    pub rig_file: Option<PathBuf>,
    /// The devices, or a recording of them.
    pub input: RunInput,
    /// File to which everything is recorded that the devices send.
    pub record: Option<PathBuf>,
    /// Whether operators may steer the robot. It is not stored with the run: whoever resumes a run
    /// decides again.
    pub is_steered: bool,
    /// Folder of a run to continue, with its flags.
    pub resume: Option<PathBuf>,
    /// When the run stops. Time and steps of the resumed run count, too.
    pub limits: Limits,
    /// Optimizer steps between two keyframes, in a run that waits for the trainer.
    pub steps_per_keyframe: Option<u64>,
    /// Which models are trained.
    pub training: TrainingOptions,
    /// Folder of the results; a new folder in `runs` if `None`.
    pub out: Option<PathBuf>,
    /// How often checkpoints are written.
    pub checkpoints: CheckpointOptions,
}

/// The input of a live run.
#[derive(Clone, Debug)]
pub enum RunInput {
    /// The devices of the rig file.
    Devices {
        /// Whether all devices are simulated.
        is_simulated: bool,
        /// Whether the simulation waits for the trainer.
        is_lockstep: bool,
    },
    /// A recording.
    Recording {
        /// The file.
        path: PathBuf,
        /// Whether it is played at the speed of its devices instead of waiting for the trainer.
        is_real_time: bool,
        /// Whether it is played again whenever it ends.
        is_repeated: bool,
    },
}

impl RunPlan {
    /// Reads the run to continue, if there is one.
    pub fn previous(&self) -> anyhow::Result<Option<PreviousLiveRun>> {
        self.resume
            .as_deref()
            .map(PreviousLiveRun::read)
            .transpose()
    }

    /// The description of the previous run if it has reached its limits, and no other limits are
    /// given.
    pub fn finished(&self, previous: &PreviousLiveRun) -> Option<FinishedRun> {
        let asks_for_more = self.limits.seconds.is_some() || self.limits.steps.is_some();
        let is_finished = previous.run.is_finished() && !asks_for_more;
        is_finished.then(|| FinishedRun {
            limits: Limits::default(),
            ..previous.run.finished()
        })
    }

    /// Checks the plan, opens the GPU, and makes the models. All checks that can reject the plan
    /// come before devices are started or folders are created.
    pub fn prepare(
        self,
        previous: Option<PreviousLiveRun>,
        services: Services<'_>,
    ) -> anyhow::Result<PreparedRun<'_>> {
        run_folder::check_out(
            self.out.as_deref(),
            self.resume.as_deref(),
            None,
            &self.resume_command(),
        )?;
        self.check_resumable()?;
        if let Some(file) = &self.record {
            self.check_record(file)?;
        }
        let plan = match &previous {
            Some(previous) => {
                previous.run.check_not_passed(self.limits)?;
                self.with_flags_of(&previous.run)
            }
            None => self,
        };
        let mut overrides = plan.overrides();
        overrides.extend(previous.iter().flat_map(PreviousLiveRun::overrides));
        let rig = plan.read_rig(&overrides)?;
        plan.require_calibration(&rig)?;
        if plan.is_steered {
            open::check_steered(&rig, plan.devices()?)?;
        }
        log::info!("{}", opening::describe(&plan.rig_name(), &rig, &plan.input));
        let kinds = methods_of(&rig)?;
        let available = available_data(&rig);
        plan.check_training(&kinds, available)?;
        let pace = plan.pace(&rig)?;
        // The GPU is opened before the devices. Otherwise, the queues of the devices would fill
        // while the GPU starts, and images would be lost.
        log::info!("opening the GPU");
        let gpu = (services.open_gpu)()?;
        let models = match &previous {
            Some(previous) => vec![previous.resume(&gpu)?],
            None => plan.new_models(&gpu, &rig, &kinds, pace)?,
        };
        let parts = prepared::Parts {
            plan,
            previous,
            services,
            kinds,
            has_depth: available.depth,
            pace,
            gpu,
            models,
        };
        Ok(PreparedRun::new(rig, parts))
    }

    /// Reads the rig file, or the rig of the recording.
    fn read_rig(&self, overrides: &[Override]) -> anyhow::Result<Rig> {
        match (&self.rig_file, self.recording()) {
            (Some(file), _) => Ok(Rig::load(file, overrides)?),
            (None, Some(recording)) => open::recorded_rig(recording, overrides),
            (None, None) => {
                Err(BadInput("a run on devices needs the path of a rig file".to_owned()).into())
            }
        }
    }

    /// Rejects a recording as the input of a continued run if `train` continues such runs with the
    /// same keyframes.
    fn check_resumable(&self) -> Result<(), BadInput> {
        match (&self.input, &self.resume) {
            (
                RunInput::Recording {
                    is_real_time: false,
                    ..
                },
                Some(folder),
            ) => Err(BadInput(format!(
                "{}: a run that waits for the trainer continues with `{}`; {} with {} continues only runs in real time",
                Setting::Resume,
                self.resume_command().line(folder),
                Setting::From,
                Setting::RealTime
            ))),
            _ => Ok(()),
        }
    }

    /// Checks that a recording can be written. It may be in the folder of the results, which the
    /// run makes.
    fn check_record(&self, file: &Path) -> Result<(), BadInput> {
        let is_in_out = self.out.as_deref().is_some_and(|out| file.starts_with(out));
        if is_in_out {
            Ok(())
        } else {
            check_output_file(Setting::Record, file)
        }
    }

    /// Checks that the rig file has what keyframes need. Simulated devices assume what is missing.
    fn require_calibration(&self, rig: &Rig) -> Result<(), BadInput> {
        match self.input {
            RunInput::Devices {
                is_simulated: true, ..
            } if !rig.cameras.is_empty() => Ok(()),
            RunInput::Devices { .. } => rig.require_before_opening(Need::PosedImages),
            RunInput::Recording { .. } => rig.require(Need::PosedImages),
        }
    }

    /// Rejects options for training that are invalid for this rig.
    fn check_training(&self, kinds: &[ModelKind], available: AvailableData) -> anyhow::Result<()> {
        self.training.check_for(kinds)?;
        self.training.check_learned(kinds, available)?;
        self.training.refining_live(available, true).map(drop)
    }

    /// The models of a run that continues no other one.
    fn new_models(
        &self,
        gpu: &Arc<Gpu>,
        rig: &Rig,
        kinds: &[ModelKind],
        pace: Pace,
    ) -> anyhow::Result<Vec<Resumed>> {
        let train = Some(&rig.train);
        let settings = method_options::settings(&self.training, train, CountPolicy::ToCap);
        let available = available_data(rig);
        let RefineSettings {
            align,
            with_scene: cameras,
        } = self.training.refining_live(available, gpu.is_software())?;
        let common = CommonOptions {
            cameras,
            align,
            align_timing: pace.align_timing(),
            detects_movements: !rig.has_moving_base(),
            ..method_options::common(&self.training, train, self.limits.steps)
        };
        let mut models = Vec::new();
        for model_spec in method_options::specs(kinds, &common, &settings)? {
            models.push(Resumed {
                method: model_spec.start(gpu.clone())?,
                model_spec,
                untrained: Vec::new(),
                edits: Edits::default(),
            });
        }
        Ok(models)
    }

    /// Changes of the rig file.
    fn overrides(&self) -> Vec<Override> {
        let mut overrides = self.training.overrides();
        if let RunInput::Devices {
            is_lockstep: true, ..
        } = self.input
        {
            overrides.push(Override::new("sim.lockstep", true));
        }
        overrides
    }

    /// The flags to store in checkpoints, by name.
    fn flags(&self) -> BTreeMap<String, String> {
        let (is_simulated, is_lockstep) = match self.input {
            RunInput::Devices {
                is_simulated,
                is_lockstep,
            } => (is_simulated, is_lockstep),
            RunInput::Recording { .. } => (false, false),
        };
        let (from, is_real_time, is_repeated) = match &self.input {
            RunInput::Devices { .. } => (None, false, false),
            RunInput::Recording {
                path,
                is_real_time,
                is_repeated,
            } => (Some(path), *is_real_time, *is_repeated),
        };
        let from = from.map(|path| std::path::absolute(path).unwrap_or(path.clone()));
        let record = self.record.as_ref().map(|file| file.display().to_string());
        let given = [
            (
                STEPS_PER_KEYFRAME,
                self.steps_per_keyframe.map(|n| n.to_string()),
            ),
            (SIM, is_simulated.then(|| true.to_string())),
            (LOCKSTEP, is_lockstep.then(|| true.to_string())),
            (RECORD, record),
            (FROM, from.map(|path| path.display().to_string())),
            (REAL_TIME, is_real_time.then(|| true.to_string())),
            (REPEAT, is_repeated.then(|| true.to_string())),
            (
                REALIGN,
                self.training.realign().map(|is_on| is_on.to_string()),
            ),
        ];
        let flags = limit_flags(self.limits)
            .into_iter()
            .chain(given)
            .filter_map(|(name, value)| Some((name.to_owned(), value?)));
        flags.chain(self.checkpoints.flag()).collect()
    }

    /// Returns this plan; missing options are taken from the previous run.
    fn with_flags_of(&self, previous: &PreviousRun) -> Self {
        if let (Some(file), None) = (previous.flag(RECORD), &self.record) {
            log::warn!(
                "the first part was recorded to {file}; this part is not recorded unless {} names another file",
                Setting::Record
            );
        }
        if let (Some(file), RunInput::Devices { .. }) = (previous.flag(FROM), &self.input) {
            log::warn!(
                "the first part was played from {file}; this part uses the devices of the rig file, because {} is not given",
                Setting::From
            );
        }
        let input = match &self.input {
            RunInput::Devices {
                is_simulated,
                is_lockstep,
            } => RunInput::Devices {
                is_simulated: *is_simulated || previous.flag(SIM).is_some(),
                is_lockstep: *is_lockstep || previous.flag(LOCKSTEP).is_some(),
            },
            recording @ RunInput::Recording { .. } => recording.clone(),
        };
        Self {
            input,
            limits: previous.limits_or_previous(self.limits),
            steps_per_keyframe: self
                .steps_per_keyframe
                .or_else(|| previous.flag(STEPS_PER_KEYFRAME)?.parse().ok()),
            checkpoints: self.checkpoints.or_previous(&previous.checkpoint.flags),
            ..self.clone()
        }
    }

    /// The command that continues this run.
    fn resume_command(&self) -> ResumeCommand {
        let rig_file = self.rig_file.as_deref();
        match &self.input {
            // In real time, the run did not use all images of the recording, so `train` would not
            // find the same keyframes. The run therefore plays the recording again.
            RunInput::Recording {
                path,
                is_real_time: true,
                is_repeated,
            } => ResumeCommand::of_playback(path, rig_file, *is_repeated),
            RunInput::Recording { path, .. } => ResumeCommand::of_recording(path, rig_file),
            RunInput::Devices { .. } => {
                ResumeCommand::of_devices(rig_file.unwrap_or(Path::new("RIG")))
            }
        }
    }

    /// Name of the rig file without its extension. Without a rig file, name of the recording
    /// without its extension.
    fn rig_name(&self) -> String {
        let file = self.rig_file.as_deref().or_else(|| self.recording());
        let name = file.map(|file| file.file_stem().unwrap_or(file.as_os_str()));
        name.unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Mesh files of the robot to record; `None` if the run is not recorded.
    fn meshes(&self, rig: &Rig) -> Option<RecordedMeshes> {
        self.record.as_ref().map(|_| open::meshes_to_record(rig))
    }

    /// The folder of the results, if it is not a new one in `runs`.
    fn out(&self) -> Option<&Path> {
        out_folder(self.out.as_deref(), self.resume.as_deref())
    }

    /// The recording that is played, if there is one.
    fn recording(&self) -> Option<&Path> {
        match &self.input {
            RunInput::Recording { path, .. } => Some(path.as_path()),
            RunInput::Devices { .. } => None,
        }
    }

    /// The recording with the images of this run, if there is one.
    fn recorded_data(&self) -> Option<&Path> {
        self.record.as_deref().or_else(|| self.recording())
    }

    /// The data and flags with which the model in `folder` is scored on the images of this run.
    fn data_source(&self, folder: &Path) -> DataSource {
        let images = DataOptions {
            rig: Some(folder.join(drivers::recording::RIG_FILE)),
            ..DataOptions::default()
        };
        // A recording that was started with a resumed run lacks the earlier images.
        let path = self.recorded_data().filter(|_| self.resume.is_none());
        DataSource {
            path: path.map(Path::to_owned),
            flags: images.flags_of_images(),
            ..DataSource::default()
        }
    }

    /// Which devices are opened.
    fn devices(&self) -> Result<Devices, BadInput> {
        match self.input {
            RunInput::Devices {
                is_simulated: true, ..
            } => Ok(Devices::Sim),
            RunInput::Devices { .. } => Ok(Devices::Real),
            RunInput::Recording { .. } => Err(BadInput(format!(
                "{}: a recording has no arm that could move: remove {} or {}",
                Setting::EnableMotion,
                Setting::EnableMotion,
                Setting::From
            ))),
        }
    }

    /// Opens the devices or the recording. Also returns the parts of the robot that are steered.
    fn open(&self, rig: Rig) -> anyhow::Result<(Opened, Option<SteeredRobot>)> {
        let RunInput::Recording {
            path,
            is_real_time,
            is_repeated,
        } = &self.input
        else {
            let devices = self.devices()?;
            if self.is_steered {
                let (opened, robot) = open::with_steered_robot(rig, devices)?;
                return Ok((opened, Some(robot)));
            }
            return Ok((open::rig(rig, devices)?, None));
        };
        let mut opened = open::recording(path, Some(rig), &[])?;
        if *is_repeated {
            opened = opened.repeated(path);
        }
        if *is_real_time {
            opened = opened.in_real_time();
        }
        Ok((opened, None))
    }

    /// Recordings and lockstep simulations wait for the trainer; everything else runs in real time.
    fn pace(&self, rig: &Rig) -> Result<Pace, BadInput> {
        let is_lockstep = match self.input {
            // A recording waits for the trainer, unless the plan sets real time.
            RunInput::Recording { is_real_time, .. } => !is_real_time,
            RunInput::Devices { is_simulated, .. } => {
                (is_simulated || rig.arm.driver == ArmDriver::Sim) && rig.sim.lockstep
            }
        };
        if is_lockstep {
            let steps_per_keyframe = self
                .steps_per_keyframe
                .unwrap_or(DEFAULT_STEPS_PER_KEYFRAME);
            return Ok(Pace::Lockstep { steps_per_keyframe });
        }
        match self.steps_per_keyframe {
            Some(_) => Err(BadInput(format!(
                "{}: this run uses keyframes in real time, as they arrive; the flag needs {} or {}",
                Setting::StepsPerKeyframe,
                Setting::Lockstep,
                Setting::From
            ))),
            None => Ok(Pace::RealTime),
        }
    }
}

/// Properties of the data of a rig that limit which parameters can be estimated.
fn available_data(rig: &Rig) -> AvailableData {
    let depth = rig.cameras.iter().any(|camera| camera.depth.is_some());
    AvailableData {
        joints: true,
        drifts: rig.has_moving_base(),
        depth,
        color_only: !depth && rig.scanners.is_empty(),
        many_images_per_camera: true,
    }
}
