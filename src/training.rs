//! One training from keyframes on disk to a model: what `train` does once, and `bench` many times over.

use crate::config::{Rig, USUAL_SEED};
use crate::data::Data;
use crate::exit::{BadArgument, LackOfEvidence};
use crate::method::{self, Kind};
use crate::session::{Evaluators, Limits, Session, Tell};
use crate::stop::Stop;
use crate::training_args::{Evidence, HowMany, Refine, Refining, TrainingArgs};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::Keyframe;
use trainer::gpu::Gpu;
use trainer::splat::SplatOptions;

/// All that settles a training beside its keyframes.
pub(crate) struct Plan {
    pub(crate) kind: Kind,
    pub(crate) options: SplatOptions,
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
    let mut method = plan.kind.start(gpu.clone(), plan.options)?;
    method.prepare()?;
    drive(Session::new(gpu, method, plan.evaluators, plan.limits, plan.tell), keyframes, learning, stop)
}

/// Starts the clock, pushes the keyframes, and trains until a limit, or until `stop` is asked.
///
/// `learning`: time spent on learning from the keyframes before; it counts.
pub(crate) fn drive(
    mut session: Session,
    keyframes: &[Arc<Keyframe>],
    learning: Duration,
    stop: &Stop,
) -> anyhow::Result<Session> {
    let now = Instant::now();
    session.start_clock(now.checked_sub(learning).unwrap_or(now));
    for keyframe in keyframes {
        session.push(keyframe)?;
    }
    if session.is_idle() && session.progress().step == 0 {
        return Err(LackOfEvidence(
            "no image to learn from has depth, and this scene model is made of depth".to_owned(),
        )
        .into());
    }
    while !stop.asked() && !session.is_over() && !session.is_idle() {
        session.step(u64::MAX)?;
    }
    Ok(session)
}

/// The scene model: the recording's rig file says which, with the flags over it; a folder has the flags only.
pub(crate) fn model(
    args: &TrainingArgs,
    data: &Data,
    steps: Option<u64>,
    software: bool,
) -> Result<(Kind, SplatOptions), BadArgument> {
    let kind = match &data.rig {
        Some(rig) => Kind::of_rig(rig)?,
        None => args.method.unwrap_or(Kind::Splat),
    };
    args.check_for(kind)?;
    // A trial takes hundreds of steps more: on a processor that is minutes.
    let evidence = Evidence {
        joints: data.rig.is_some(),
        drifts: data.rig.as_ref().is_none_or(Rig::has_moving_base),
        depth: data.keyframes.iter().any(|keyframe| keyframe.depth.is_some()),
    };
    let Refining { align, learn: cameras } =
        args.refining(evidence, if software { Refine::None } else { Refine::Auto })?;
    args.check_learned(kind, evidence)?;
    let count = args.count(if software { HowMany::ToCap } else { HowMany::Tested });
    if let Some(rig) = &data.rig {
        let options = SplatOptions { cameras, align, count, ..method::options(&rig.train, steps)? };
        return Ok((kind, options));
    }
    let usual = SplatOptions::default();
    let options = SplatOptions {
        seed: args.seed.unwrap_or(USUAL_SEED),
        max_splats: args.max_splats.map_or(usual.max_splats, |n| n.try_into().unwrap_or(u32::MAX)),
        max_bytes: args.max_bytes,
        cameras,
        count,
        align,
        n_planned_steps: steps.unwrap_or(usual.n_planned_steps),
        ..usual
    };
    Ok((kind, options))
}

/// When to stop, from `--seconds` and `--steps`; after `usual_secs` when neither is given.
pub(crate) fn limits(seconds: Option<f64>, steps: Option<u64>, usual_secs: f64) -> Result<Limits, BadArgument> {
    if seconds.is_some_and(|seconds| seconds.is_nan() || seconds < 0.0) {
        return Err(BadArgument("--seconds: must be a number of at least 0".into()));
    }
    Ok(Limits { seconds: seconds.or(steps.is_none().then_some(usual_secs)), steps })
}
