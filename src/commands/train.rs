//! `fieldrig train`: a model of a dataset folder or a recording.

use crate::checkpoints::{self, CheckpointArgs, Checkpoints, OfData};
use crate::clock::Clock;
use crate::config::{Override, Rig};
use crate::corrected_rig;
use crate::data::{Data, DataArgs, Purpose};
use crate::decisions::{About, DecisionLog, Settings};
use crate::depth_from::{self, DepthSource, DrawnDepth};
use crate::evaluate::Evaluator;
use crate::exit::{self, BadArgument, Exit};
use crate::method::{self, Kind, Recipe, Resumed};
use crate::print;
use crate::replay::Replay;
use crate::run_folder::{self, MadeFolders};
use crate::session::{self, Ending, Evaluators, Limits, Session, Tell};
use crate::stands::StandReport;
use crate::stop::Stop;
use crate::training;
use crate::training_args::{REALIGN, TrainingArgs};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::align::Alignment;
use trainer::checkpoint::Checkpoint;
use trainer::gpu::Gpu;
use trainer::{Keyframe, Split};

/// Length of a training where no flag says.
const USUAL_SECONDS: f64 = 120.0;

/// Flags of `train`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    #[command(flatten)]
    training: TrainingArgs,
    /// Go on from the checkpoint that an earlier run left in this folder, with the same data, its settings, and its --scale, --holdout,
    /// --keyframes and --rig where they are not given
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["method", "seed", "max_bytes", "max_splats", "refine", "count", "plan_steps"])]
    resume: Option<PathBuf>,
    /// Repeat what the clock decided in an earlier run, and get the same model: with the settings of the log that it left
    /// (decisions.jsonl) and on the recording or data it had
    #[arg(long, value_name = "FILE", conflicts_with_all = ["method", "seed", "max_bytes", "max_splats", "refine", "count", "plan_steps", "seconds", "steps", "holdout", "keyframes", "scale"])]
    replay_decisions: Option<PathBuf>,
    /// Stop after S seconds of training, those before --resume included; loading and scoring do not count [default: 120, unless --steps is given]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Stop after N optimiser steps, those before --resume included; no decision reads the clock then, and one seed gives one result
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Steps over which learning slows down and the model grows [default: --steps, else 7000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    plan_steps: Option<u64>,
    #[command(flatten)]
    images: DataArgs,
    /// Where images have no depth, or on less than half of them, draw it from this saved model (a folder, or a file of splats)
    /// of the same place in the same world frame: all methods take it for measured. What --refine finds is learned with the scene then
    #[arg(long, value_name = "MODEL")]
    depth_from: Option<PathBuf>,
    /// Weights of LPIPS for `SqueezeNet` (safetensors) [default: what `FIELDRIG_LPIPS_WEIGHTS` names; none: no LPIPS]
    #[arg(long, value_name = "FILE")]
    lpips_weights: Option<PathBuf>,
    /// Where the results go, of several methods in a folder each inside; a folder that holds a model is refused [default: the folder of --resume if it holds none, else a new one in runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Write the recording's rig file here with what was found about its cameras, and the robot's description (robot.urdf) beside it
    #[arg(long, value_name = "FILE")]
    write_rig: Option<PathBuf>,
    #[command(flatten)]
    checkpoints: CheckpointArgs,
    /// Tell at the end what each kernel of a step takes on the GPU
    #[arg(long)]
    profile: bool,
    /// Print one JSON object a line
    #[arg(long)]
    json: bool,
}

/// What the report says beside scores.
#[derive(Debug, Serialize)]
struct Particulars<'a> {
    method: &'static str,
    data: &'a Path,
    seed: u64,
    startup_secs: f64,
    n_train: usize,
    n_selection: usize,
    n_test: usize,
    losses: &'a [String],
    /// What was found of the base's pose at each stand after the first.
    stands: &'a [StandReport],
    /// How much depth came from a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    drawn_depth: Option<&'a DrawnDepth>,
    /// What was found about cameras by laying images over each other.
    alignment: Option<Alignment>,
}

/// Loads, trains until a limit or Ctrl-C, scores at the marks, saves.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let mut made = MadeFolders::default();
    let ended = train(args, &mut made);
    made.after(ended)
}

fn train(args: &Args, made: &mut MadeFolders) -> anyhow::Result<Exit> {
    let started = Instant::now();
    let replay = args.replay_decisions.as_deref().map(Replay::load).transpose()?;
    let limits = match &replay {
        Some(_) => Limits::default(),
        None => training::limits(args.seconds, args.steps, USUAL_SECONDS)?,
    };
    if let Some(out) = &args.out {
        run_folder::refuse_model(out)?;
    }
    let stop = Stop::on_ctrl_c()?;
    let checkpoint = args.resume.as_deref().map(checkpoints::read).transpose()?;
    let whose = args.resume.as_deref().map(|folder| format!("the checkpoint in {}", folder.display()));
    if let (Some(checkpoint), Some(whose)) = (&checkpoint, &whose) {
        refuse_over(limits, checkpoint, whose)?;
    }
    let depth_from = args.depth_from.as_deref().map(DepthSource::find).transpose()?;
    let depth_sum = depth_from.as_ref().map(|source| source.sha256.as_str());
    if let Some(replay) = &replay {
        replay.check_depth_from(depth_sum)?;
    }
    let (mut images, mut overrides) = (args.images.clone(), args.training.overrides());
    let mut realign = args.training.realign();
    if let Some(replay) = &replay {
        images.scale = Some(replay.decisions.settings.scale);
    }
    if let (Some(checkpoint), Some(whose)) = (&checkpoint, &whose) {
        depth_from::check_same(whose, checkpoint.depth_from.as_deref(), depth_sum)?;
        if replay.is_none() {
            images = images.after(whose, &checkpoint.data_flags)?;
        }
        realign = checkpoint.data_flags.get(REALIGN).map(|is_on| is_on == "true");
        overrides.extend(realign.map(|is_on| Override::new(REALIGN, is_on)));
    } else if replay.is_none() {
        training::check_before_data(&args.training, &args.data, &images)?;
    }
    let evaluator = Evaluator::thorough(args.lpips_weights.as_deref())?;
    let evaluators = Evaluators { at_marks: evaluator.clone(), most_at_marks: usize::MAX, at_end: evaluator };
    let mut data = match &replay {
        Some(replay) => replay.load_data(&args.data, args.images.rig.clone(), args.json)?,
        None => Data::load(&args.data, &images, Purpose::Training, &overrides, args.json)?,
    };
    if let Some(file) = &args.write_rig {
        let Some(rig) = &data.rig else {
            let data = args.data.display();
            return Err(BadArgument(format!("--write-rig: {data} holds no rig file; recordings do")).into());
        };
        corrected_rig::refuse_place(rig, file)?; // Not after all the training.
    }
    let gpu = super::open_gpu()?;
    if let Some(source) = &depth_from {
        data.draw_depth(gpu.clone(), source, args.json)?;
    }
    if let Some(replay) = &replay {
        replay.check_data(&args.data, &data)?;
    }
    let mut models = args.models(&gpu, &data, replay.as_ref(), checkpoint.as_ref())?;
    let from_step = checkpoint.is_some().then(|| models[0].method.n_taken()).transpose()?;
    if let Some(replay) = &replay {
        replay.check_start(from_step)?;
        replay.check_adapter(&gpu.describe());
    }
    models.iter_mut().try_for_each(|model| model.method.prepare())?;
    let kinds: Vec<Kind> = models.iter().map(|model| model.recipe.kind).collect();
    let folders = made.make_each(args.out(), &kinds, data.rig.as_ref())?;
    let mut flags = images.flags();
    flags.extend(realign.map(|is_on| (REALIGN.to_owned(), is_on.to_string())));
    let of_data = OfData { depth_from: depth_sum.map(str::to_owned), flags };

    let rest = models[0].rest.clone(); // All begin with the same images; only one alone goes on from a checkpoint.
    let is_rest = |keyframe: &Arc<Keyframe>| rest.iter().any(|other| Arc::ptr_eq(other, keyframe));
    let clock = Clock::default();
    let (mut sessions, mut seeds) = (Vec::new(), Vec::new());
    for (Resumed { recipe: Recipe { kind, options }, method, .. }, folder) in models.into_iter().zip(&folders) {
        run_folder::write_keyframe_list(&folder.join("keyframes.txt"), &data.keyframes)?;
        seeds.push(options.seed);
        let about = About {
            method: kind.name(),
            data: Some(&args.data),
            adapter: gpu.describe(),
            scale: data.rig.as_ref().map(|rig| rig.train.scale).or(images.scale).unwrap_or(1.0),
            depth_from: of_data.depth_from.clone(),
            from_step,
            options,
        };
        let mut decisions = DecisionLog::create(folder, Settings::new(about))?;
        for keyframe in data.keyframes.iter().filter(|keyframe| !is_rest(keyframe)) {
            decisions.had(from_step.unwrap_or_default(), keyframe);
        }
        let tell = Tell::of_command(args.json);
        let checkpoints = Checkpoints::new(folder, args.checkpoints);
        let session = Session::new(gpu.clone(), (kind, method), evaluators.clone(), limits, tell)
            .with_stop(&stop)
            .with_checkpoints(checkpoints.map(|to| to.with_data(of_data.clone())))
            .with_profile(args.profile)
            .with_decisions(decisions);
        sessions.push(match (&kinds[..], &checkpoint) {
            ([_], Some(checkpoint)) => session.going_on_after(checkpoint.seconds),
            ([_], None) => session,
            _ => session.among_others(clock.clone()),
        });
    }
    // What was found of the base's stands and drawn for depth counts once.
    let learning = if checkpoint.is_some() { Duration::ZERO } else { data.learning };
    match &replay {
        Some(replay) => replay.drive(&mut sessions[0], &rest, &stop)?,
        None => training::drive(&mut sessions, &rest, learning, &stop)?,
    }

    let alignment = sessions.iter().find_map(Session::alignment).cloned();
    let startup_secs = sessions[0].clock_started().map_or(0.0, |at| (at - started).as_secs_f64());
    let ending = |((session, out), seed): ((Session, PathBuf), u64)| Ending {
        particulars: Particulars {
            method: session.kind().name(),
            data: &args.data,
            seed,
            startup_secs,
            n_train: data.of_split(Split::Train).len(),
            n_selection: data.of_split(Split::Selection).len(),
            n_test: data.of_split(Split::Test).len(),
            losses: &data.losses,
            stands: &data.stands,
            drawn_depth: data.drawn_depth.as_ref(),
            alignment: session.alignment().cloned(),
        },
        session,
        out,
    };
    session::finish(sessions.into_iter().zip(folders).zip(seeds).map(ending).collect())?;
    if let Some(file) = &args.write_rig {
        write_rig(&Data::rig_as_given(&args.data, &images)?, alignment.as_ref(), file)?;
    }
    Ok(exit::after(&data.losses))
}

/// Refuses limits in seconds that are over before training goes on.
fn refuse_over(limits: Limits, checkpoint: &Checkpoint, whose: &str) -> Result<(), BadArgument> {
    match limits.seconds.filter(|seconds| *seconds <= checkpoint.seconds) {
        Some(seconds) => Err(BadArgument(format!(
            "--seconds {seconds}: {whose} has been trained for {:.1} s, which count too; name more than that",
            checkpoint.seconds
        ))),
        None => Ok(()),
    }
}

/// Writes the rig file, and says where nothing changed in it.
fn write_rig(rig: &Rig, alignment: Option<&Alignment>, file: &Path) -> anyhow::Result<()> {
    match alignment {
        None => log::warn!("images were not laid over each other: the rig file is written as it was"),
        Some(alignment) if !alignment.is_judged() => {
            log::warn!("too few images to judge by were held back: the rig file is written as it was");
        }
        Some(alignment) if !alignment.is_any() => log::info!("the rig file needs no correction"),
        Some(_) => {}
    }
    let rig = alignment.map_or_else(|| Ok(rig.clone()), |alignment| corrected_rig::corrected(rig, alignment))?;
    corrected_rig::write(&rig, file)?;
    log::info!("rig file written to {}", file.display());
    Ok(())
}

impl Args {
    /// The models that learn, fresh or out of a checkpoint.
    fn models(
        &self,
        gpu: &Arc<Gpu>,
        data: &Data,
        replay: Option<&Replay>,
        checkpoint: Option<&Checkpoint>,
    ) -> anyhow::Result<Vec<Resumed>> {
        if let Some(checkpoint) = checkpoint {
            return Ok(vec![self.resumed(method::resume(gpu.clone(), checkpoint, &data.keyframes)?)]);
        }
        let recipes = match replay {
            Some(replay) => vec![replay.recipe()],
            None => training::recipes(&self.training, data, self.plan_steps.or(self.steps), gpu.is_software())?,
        };
        let begin = |recipe: Recipe| {
            let method = recipe.clone().start(gpu.clone())?;
            Ok(Resumed { recipe, method, rest: data.keyframes.clone() })
        };
        recipes.into_iter().map(begin).collect()
    }

    /// The folder asked for; a run that was cut off goes on in its own.
    fn out(&self) -> Option<&Path> {
        let unfinished = || self.resume.as_deref().filter(|folder| run_folder::refuse_model(folder).is_ok());
        self.out.as_deref().or_else(unfinished)
    }

    /// Says what is not as the caller may expect.
    fn resumed(&self, resumed: Resumed) -> Resumed {
        let (planned, step) = (resumed.recipe.options.n_planned_steps, resumed.method.progress().step);
        log::info!("going on from step {step} of {planned} planned ones");
        if self.steps.is_some_and(|steps| steps > planned) {
            log::warn!("learning was planned to slow down over {planned} steps: those past them change little");
        }
        let n_new = resumed.rest.iter().filter(|keyframe| keyframe.split != Split::Test).count();
        if n_new > 0 {
            log::warn!("{} that the checkpoint does not know", print::counted(n_new as u64, "new image"));
        }
        resumed
    }
}
