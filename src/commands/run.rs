//! `fieldrig run`: devices, join, trainer, picture.

use crate::checkpoints::{CheckpointArgs, Checkpoints};
use crate::clock::Clock;
use crate::config::{ArmDriver, Override, Rig};
use crate::decisions::{About, DecisionLog, Settings};
use crate::evaluate::Evaluator;
use crate::exit::{self, BadArgument, Exit, LackOfEvidence};
use crate::feed::{Feed, Input};
use crate::join::{Counts, Join, Refusal, Use};
use crate::live::{Live, LiveOptions, Pace};
use crate::method::{self, Kind, Recipe};
use crate::open::{self, Devices, Opened};
use crate::print;
use crate::run_folder::{self, MadeFolders};
use crate::session::{self, Ending, Evaluators, Limits, Session, Tell};
use crate::stands::{StandReport, Stands};
use crate::stop::Stop;
use crate::training_args::{Evidence, HowMany, Refine, TrainingArgs};
use drivers::Source;
use serde::Serialize;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};
use trainer::gpu::Gpu;
use trainer::splat::SplatOptions;
use trainer::{Keyframe, Method, Split};
use viz::{Hub, Server, ServerConfig};

/// Flags of `run`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Cameras, arm and training settings (TOML)
    rig_file: PathBuf,
    /// Put a simulated twin in the place of every device of the rig file
    #[arg(long, conflicts_with = "from")]
    sim: bool,
    /// Wait with the simulation for the trainer, so that a seed gives one result; else it runs in real time
    #[arg(long, requires = "sim", conflicts_with = "from")]
    lockstep: bool,
    /// Replay a recording instead of live devices
    #[arg(long, value_name = "RECORDING")]
    from: Option<PathBuf>,
    /// Write everything that comes in to an MCAP file; what devices lose then is a loss (exit code 3), else the next image does
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Stop after S seconds, counted from the first image [default: run until Ctrl-C]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Stop after N optimiser steps, or when the devices ended and there is nothing left to fuse; in lockstep one seed gives one
    /// result then
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// With a lockstep simulation or a recording only: steps between two keyframes [default: 10]
    #[arg(long, value_name = "N")]
    steps_per_keyframe: Option<u64>,
    #[command(flatten)]
    training: TrainingArgs,
    /// Address of the page, as numbers
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:7007", value_parser = address)]
    listen: SocketAddr,
    /// Where the results and the settled rig file go, of several methods in a folder each inside; a folder that holds a model is
    /// refused [default: a new folder in runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    #[command(flatten)]
    checkpoints: CheckpointArgs,
    /// Print one JSON object a line
    #[arg(long)]
    json: bool,
}

fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "expected an address and a port, such as 127.0.0.1:7007".to_owned())
}

/// Steps between two keyframes where no flag says.
const USUAL_STEPS_PER_KEYFRAME: u64 = 10;
/// People look on while a mark is scored: it must not take long.
const MOST_SCORED_AT_MARKS: usize = 12;

/// What the report says beside scores.
#[derive(Debug, Serialize)]
struct Particulars {
    method: &'static str,
    seed: u64,
    keyframes: usize,
    evicted: u64,
    refused: BTreeMap<&'static str, u64>,
    device_skipped: u64,
    /// Turns of range scanners in the list beside the keyframes, and their points.
    range_scans: usize,
    range_points: usize,
    losses: Vec<String>,
    /// What was found of the base's pose at each stand after the first.
    stands: Vec<StandReport>,
    /// Largest distance of a keyframe's camera from its true place, metres; in simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    worst_position_error_m: Option<f64>,
}

/// Runs until a limit, the end of the devices, or Ctrl-C; saves the model, its keyframes and the settled rig file.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let mut made = MadeFolders::default();
    let ended = drive(args, &mut made);
    made.after(ended)
}

fn drive(args: &Args, made: &mut MadeFolders) -> anyhow::Result<Exit> {
    if let Some(out) = &args.out {
        run_folder::refuse_model(out)?;
    }
    let stop = Stop::on_ctrl_c()?;
    let rig = Rig::load(&args.rig_file, &args.overrides())?;
    let kinds = rig.train.methods.clone();
    args.training.check_for(&kinds)?;
    let evidence = Evidence { joints: true, drifts: rig.has_moving_base(), depth: false }; // Depth comes, but not at the start.
    args.training.check_learned(&kinds, evidence)?;
    let cameras = args.training.refining(evidence, Refine::None)?.learn;
    let count = args.training.count(HowMany::ToCap);
    let options = SplatOptions { cameras, count, ..method::options(&rig.train, args.steps)? };
    let pace = args.pace(&rig)?;
    let gpu = super::open_gpu()?;
    let start = |kind: &Kind| Recipe { kind: *kind, options: options.clone() }.start(gpu.clone());
    let methods: Vec<Box<dyn Method>> = kinds.iter().map(start).collect::<anyhow::Result<_>>()?;
    let hub = Hub::new();
    let server = Server::start(ServerConfig { listen: args.listen }, hub.clone())?;
    args.tell_address(&server.url())?;

    let Opened { rig, source, damage } = args.open(rig)?;
    let folders = made.make_each(args.out.as_deref(), &kinds, Some(&rig))?;
    let feed = Feed::start(args.input(&rig, source)?, hub.clone(), stop.clone())?;
    let notes = notes(&gpu);
    let evaluators = Evaluators {
        at_marks: Evaluator::psnr_only(),
        most_at_marks: MOST_SCORED_AT_MARKS,
        at_end: Evaluator::thorough(None)?,
    };
    let limits = Limits { seconds: args.seconds, steps: args.steps };
    let clock = Clock::default();
    let mut sessions = Vec::new();
    for ((kind, method), folder) in kinds.iter().copied().zip(methods).zip(&folders) {
        let about = About {
            method: kind.name(),
            data: args.record.as_deref().or(args.from.as_deref()),
            adapter: gpu.describe(),
            scale: rig.train.scale,
            depth_from: None,
            from_step: None,
            options: options.clone(),
        };
        let decisions = DecisionLog::create(folder, Settings::new(about))?;
        let tell = Tell::of_command(args.json);
        let session = Session::new(gpu.clone(), (kind, method), evaluators.clone(), limits, tell)
            .with_stop(&stop)
            .with_checkpoints(Checkpoints::new(folder, args.checkpoints))
            .with_decisions(decisions);
        sessions.push(if kinds.len() == 1 { session } else { session.among_others(clock.clone()) });
    }
    let options = LiveOptions { pace, start_keyframes: rig.join.start_keyframes, notes };

    let mut live = Live::new(sessions, feed, hub, options);
    while !stop.asked() && !live.is_over() {
        live.take_keyframes()?;
        live.step()?;
        live.render();
        live.publish()?;
    }
    if live.is_through() {
        log::info!("the devices ended, and all they told is in the model: no step is left to make");
    }
    stop.ask();
    save(live, args, &rig, folders, &damage)
}

/// Saves what there is, then tells what went wrong on the way.
fn save(live: Live, args: &Args, rig: &Rig, folders: Vec<PathBuf>, damage: &OnceLock<String>) -> anyhow::Result<Exit> {
    let n_keyframes = live.keyframes().len();
    let n_train = live.keyframes().iter().filter(|keyframe| keyframe.split == Split::Train).count();
    let live_error_m = worst_position_error_m(live.keyframes());
    let (sessions, leftover) = live.finish();
    let leftover = leftover?;
    // A disk that has no room for these may have some for the models.
    let list = |(session, folder): (&Session, &PathBuf)| {
        run_folder::write_keyframe_list(&folder.join("keyframes.txt"), session.keyframes())
    };
    let listed = sessions.iter().zip(&folders).try_for_each(list);
    let counts = leftover.join.counts();
    log::info!("{counts}");
    let mut losses =
        counts.losses(if args.record.is_some() && args.from.is_none() { Use::Recorded } else { Use::Watched });
    losses.extend(leftover.recording_error.map(|error| format!("the recording is cut off: {error:#}")));
    losses.extend(damage.get().cloned());
    let stands = leftover.stands.as_ref().map_or(Vec::new(), |stands| stands.reports().to_vec());
    let ending = |(session, out): (Session, PathBuf)| Ending {
        particulars: Particulars {
            method: session.kind().name(),
            seed: rig.train.seed,
            keyframes: session.keyframes().len(),
            evicted: counts.evicted,
            refused: counts.refused.iter().map(|(why, n)| (why.name(), *n)).collect(),
            device_skipped: counts.device_skipped,
            range_scans: leftover.join.range_scans().count(),
            range_points: leftover.join.range_scans().map(|scan| scan.points_in_world_m.len()).sum(),
            losses: losses.clone(),
            stands: stands.clone(),
            worst_position_error_m: live_error_m,
        },
        session,
        out,
    };
    if n_train > 0 {
        session::finish(sessions.into_iter().zip(folders).map(ending).collect())?;
    }
    listed?;
    if let Some(error) = leftover.input_error {
        return Err(anyhow::Error::new(error).context("the devices broke off"));
    }
    if n_train == 0 {
        return Err(LackOfEvidence(nothing_to_train(n_keyframes, counts, rig)).into());
    }
    Ok(exit::after(&losses))
}

impl Args {
    fn overrides(&self) -> Vec<Override> {
        let mut overrides = self.training.overrides();
        if self.lockstep {
            overrides.push(Override::new("sim.lockstep", true));
        }
        overrides
    }

    fn tell_address(&self, url: &str) -> anyhow::Result<()> {
        if self.json {
            return print::json(&serde_json::json!({ "event": "serving", "url": url }));
        }
        Ok(print::line(format_args!("open {url} in a browser"))?)
    }

    fn open(&self, rig: Rig) -> anyhow::Result<Opened> {
        match &self.from {
            Some(recording) => open::recording(recording, Some(rig), &[]),
            None => open::rig(rig, if self.sim { Devices::Sim } else { Devices::Real }),
        }
    }

    fn input(&self, rig: &Rig, source: Box<dyn Source>) -> anyhow::Result<Input> {
        Ok(Input {
            source,
            join: Join::new(rig)?,
            stands: Stands::new(rig),
            recorder: self.record.as_deref().map(|file| open::recorder(file, rig)).transpose()?,
            lenses: rig
                .cameras
                .iter()
                .map(|camera| (camera.name.clone(), (camera.intrinsics.focal_px, camera.intrinsics.principal_px)))
                .collect(),
        })
    }

    /// A recording has no clock of its own, a lockstep simulation waits; everything else goes on without us.
    fn pace(&self, rig: &Rig) -> Result<Pace, BadArgument> {
        let simulated = self.sim || rig.arm.driver == ArmDriver::Sim;
        if self.from.is_some() || (simulated && rig.sim.lockstep) {
            let steps_per_keyframe = self.steps_per_keyframe.unwrap_or(USUAL_STEPS_PER_KEYFRAME);
            return Ok(Pace::Lockstep { steps_per_keyframe });
        }
        match self.steps_per_keyframe {
            Some(_) => Err(BadArgument(
                "--steps-per-keyframe: this run is in real time and takes keyframes as they come, it needs --lockstep or --from"
                    .into(),
            )),
            None => Ok(Pace::RealTime),
        }
    }
}

/// Why a run ended without a model, as one sentence.
fn nothing_to_train(n_keyframes: usize, counts: &Counts, rig: &Rig) -> String {
    let quoted = |names: Vec<&str>| names.iter().map(|name| format!("{name:?}")).collect::<Vec<_>>().join(", ");
    let expected = quoted(rig.cameras.iter().map(|camera| &*camera.name).collect());
    let unknown = quoted(counts.unknown_cameras.iter().map(|name| &**name).collect());
    let n_unknown = counts.refused.get(&Refusal::UnknownCamera).copied().unwrap_or_default();
    match (n_keyframes, counts.accepted) {
        (1, _) => format!("nothing to train on: the only keyframe is held out for testing ({counts})"),
        (2.., _) => format!("nothing to train on: all {n_keyframes} keyframes are held out ({counts})"),
        (0, 1..) => format!("the run ended before the trainer took its first keyframe ({counts})"),
        (0, 0) if counts.images == 0 => format!("no image came: the rig file names the cameras {expected}"),
        (0, 0) if n_unknown == counts.images => {
            format!("no image of the cameras in the rig file ({expected}): all {n_unknown} are of {unknown}")
        }
        (0, 0) => format!("no image became a keyframe: {counts}"),
    }
}

/// How far off the worst pose is, where a simulator tells the true ones.
fn worst_position_error_m(keyframes: &[Arc<Keyframe>]) -> Option<f64> {
    let error_m = |keyframe: &Arc<Keyframe>| {
        let truth = keyframe.truth.as_ref()?.world_from_camera.translation.vector;
        Some((keyframe.world_from_camera.translation.vector - truth).norm())
    };
    keyframes.iter().filter_map(error_m).reduce(f64::max)
}

/// What people at the page should know.
fn notes(gpu: &Gpu) -> Vec<String> {
    if gpu.is_software() { vec!["no GPU: kernels run on the CPU, slowly".to_owned()] } else { Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn a_run_without_a_model_says_why() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
        let rig = Rig::load(&path, &[]).expect("a rig");
        let counts = |images, accepted, refused: &[(Refusal, u64)]| Counts {
            images,
            accepted,
            refused: refused.iter().copied().collect(),
            unknown_cameras: ["front".into()].into(),
            ..Counts::default()
        };
        for (n_keyframes, counts, expected) in [
            (1, counts(1, 1, &[]), "the only keyframe is held out for testing (1 keyframe of 1 image)"),
            (0, counts(1, 1, &[]), "ended before the trainer took its first keyframe"),
            (0, counts(0, 0, &[]), "no image came"),
            (0, counts(7, 0, &[(Refusal::UnknownCamera, 7)]), "(\"wrist\"): all 7 are of \"front\""),
            (
                0,
                counts(7, 0, &[(Refusal::NoPose, 7)]),
                "0 keyframes of 7 images; 7 no joint readings or pose of the base",
            ),
        ] {
            let told = nothing_to_train(n_keyframes, &counts, &rig);
            assert!(told.contains(expected), "{told}");
        }
    }
}
