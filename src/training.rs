//! One training from keyframes on disk to a model: what `train` does once, and `bench` many times over.

use crate::config::{Rig, USUAL_SEED};
use crate::data::{self, Data, DataArgs};
use crate::exit::{BadArgument, LackOfEvidence};
use crate::method::{self, Kind, Recipe};
use crate::recovery::Recoveries;
use crate::session::{Evaluators, Limits, Session, Tell};
use crate::stop::Stop;
use crate::training_args::{Evidence, HowMany, Refine, Refining, TrainingArgs};
use crate::turns;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::Keyframe;
use trainer::gpu::Gpu;
use trainer::splat::SplatOptions;

/// All that settles a training beside its keyframes.
pub(crate) struct Plan {
    pub(crate) recipe: Recipe,
    pub(crate) evaluators: Evaluators,
    pub(crate) limits: Limits,
    pub(crate) tell: Tell,
}

/// Trains a fresh model until a limit, or until `stop` is asked.
///
/// The clock starts when everything is compiled; seeding counts.
pub(crate) fn train(
    gpu: Arc<Gpu>,
    plan: Plan,
    keyframes: &[Arc<Keyframe>],
    learning: Duration,
    stop: &Stop,
) -> anyhow::Result<Session> {
    let kind = plan.recipe.kind;
    let mut method = plan.recipe.start(gpu.clone())?;
    method.prepare()?;
    let mut session = Session::new(gpu, (kind, method), plan.evaluators, plan.limits, plan.tell).with_stop(stop);
    drive(std::slice::from_mut(&mut session), keyframes, learning, stop)?;
    Ok(session)
}

/// Starts the clock, pushes the keyframes to all models, and trains each until a limit, or until `stop` is asked.
///
/// `learning`: time spent on learning from the keyframes before; it counts.
pub(crate) fn drive(
    sessions: &mut [Session],
    keyframes: &[Arc<Keyframe>],
    learning: Duration,
    stop: &Stop,
) -> anyhow::Result<()> {
    let now = Instant::now();
    let began = now.checked_sub(learning).unwrap_or(now);
    for session in &mut *sessions {
        session.start_clock(began);
        for keyframe in keyframes {
            session.push(keyframe)?;
        }
        if session.is_idle() && session.progress().step == 0 {
            let name = session.kind().name();
            return Err(LackOfEvidence(format!(
                "no image to learn from has depth, and the scene model of the method {name} is made of depth: \
                 --depth-from gives them that of a model of the same place, and splat and nerf do without"
            ))
            .into());
        }
    }
    let is_done = |session: &Session| session.is_over() || session.is_idle();
    let mut recoveries = Recoveries::default();
    loop {
        while !stop.asked() && !sessions.iter().all(is_done) {
            if let Err(error) = turns::take(sessions, |_, _| u64::MAX, || false) {
                recoveries.recover(sessions, error)?;
            }
            sessions.iter_mut().filter(|session| session.is_idle()).for_each(Session::rest);
        }
        match sessions.iter().try_for_each(Session::wait) {
            Ok(()) => return Ok(()),
            Err(error) => recoveries.recover(sessions, error)?,
        }
    }
}

/// The scene models: the recording's rig file says which, with the flags over it; a folder has the flags only.
pub(crate) fn recipes(
    args: &TrainingArgs,
    data: &Data,
    steps: Option<u64>,
    software: bool,
) -> Result<Vec<Recipe>, BadArgument> {
    let of_rig = data.rig.as_ref().map(|rig| rig.train.methods.as_slice());
    let kinds = of_rig.or(args.methods()).unwrap_or(&[Kind::Splat]);
    args.check_for(kinds)?;
    // A trial takes hundreds of steps more: on a processor that is minutes.
    let evidence = Evidence {
        joints: data.rig.is_some(),
        drifts: data.rig.as_ref().is_none_or(Rig::has_moving_base),
        // Depth drawn from where a camera is told to be does not say where it is.
        depth: data.has_depth() && data.drawn_depth.as_ref().is_none_or(|drawn| drawn.n_images == 0),
    };
    let Refining { align, learn: cameras } =
        args.refining(evidence, if software { Refine::None } else { Refine::Auto })?;
    args.check_learned(kinds, evidence)?;
    let count = args.count(if software { HowMany::ToCap } else { HowMany::Tested });
    let options = if let Some(rig) = &data.rig {
        SplatOptions { cameras, align, count, ..method::options(&rig.train, steps)? }
    } else {
        let usual = SplatOptions::default();
        SplatOptions {
            seed: args.seed.unwrap_or(USUAL_SEED),
            max_splats: args.max_splats.map_or(usual.max_splats, |n| n.try_into().unwrap_or(u32::MAX)),
            max_bytes: args.max_bytes,
            cameras,
            count,
            align,
            n_planned_steps: steps.unwrap_or(usual.n_planned_steps),
            ..usual
        }
    };
    Ok(kinds.iter().map(|kind| Recipe { kind: *kind, options: options.clone() }).collect())
}

/// Refuses flags that make no sense whatever the data hold, before all of those are read.
pub(crate) fn check_before_data(args: &TrainingArgs, path: &Path, images: &DataArgs) -> anyhow::Result<()> {
    let usual = || Data::usual_kinds(path, images);
    let kinds = args.methods().map_or_else(usual, |kinds| Ok(kinds.to_vec()))?;
    Ok(args.check_before_data(&kinds, data::is_recording(path))?)
}

/// When to stop, from `--seconds` and `--steps`; after `usual_secs` when neither is given.
pub(crate) fn limits(seconds: Option<f64>, steps: Option<u64>, usual_secs: f64) -> Result<Limits, BadArgument> {
    if seconds.is_some_and(|seconds| seconds.is_nan() || seconds < 0.0) {
        return Err(BadArgument("--seconds: must be a number of at least 0".into()));
    }
    Ok(Limits { seconds: seconds.or(steps.is_none().then_some(usual_secs)), steps })
}
