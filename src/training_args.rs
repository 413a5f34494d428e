//! Flags shared by all commands that train. They override the keys of the same name in a rig file.

use crate::named_args::one_of;
use capture::config::{MAX_BYTES_RANGE, MAX_SPLATS_RANGE, SEED_RANGE};
use clap::builder::TypedValueParser;
use clap::value_parser;
use session::{Refine, TrainingOptions, methods_in};
use std::sync::LazyLock;
use trainer::ModelKind;
use trainer::splat::CountPolicy;

/// Help of `--method`.
static METHOD_HELP: LazyLock<String> = LazyLock::new(|| {
    let described = ModelKind::ALL
        .iter()
        .map(|kind| format!("{} ({})", kind.name(), kind.entry().description));
    format!(
        "Scene model: {}, or several separated by commas. `train` and `run` train several at once, `bench curve` one \
         after the other [default: train.method of the rig file, else {}]",
        described.collect::<Vec<_>>().join(", "),
        ModelKind::default().name()
    )
});

/// Ids of all flags of [`TrainingArgs`]. Flags such as `--resume` exclude these flags. If they
/// excluded the id of the group instead, clap would list all flags in its message.
pub(crate) const TRAINING_ARGS: [&str; 6] = [
    "method",
    "seed",
    "max_bytes",
    "max_splats",
    "refine",
    "count",
];

/// Which models to train, and their limits.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct TrainingArgs {
    #[arg(long, value_name = "METHOD", value_parser = methods, help = METHOD_HELP.as_str())]
    pub(crate) method: Option<Methods>,
    /// Random seed, 0 to 2^63 - 1. With the same number of steps, the same seed gives the same
    /// result [default: value of the rig file, else 1]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(SEED_RANGE))]
    pub(crate) seed: Option<u64>,
    /// Maximum GPU memory of each model in bytes, at least 1000000 and enough for the smallest
    /// model of the method [default: value of the rig file, else no limit]
    #[arg(long, value_name = "BYTES", value_parser = max_bytes)]
    pub(crate) max_bytes: Option<u64>,
    /// Maximum number of splats, 1 to 100000000 [default: value of the rig file, else 400000]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(MAX_SPLATS_RANGE))]
    pub(crate) max_splats: Option<u64>,
    /// Calibration parameters to estimate: auto (the parameters that improve the prediction of
    /// validation images), none, or a list of base, extrinsics, time-offset, joints, depth-pose,
    /// lens, depth-scale, readout, image-poses and image-gains, separated by commas. Images with
    /// depth are registered while training runs. Without depth, extrinsics, time-offset and (if
    /// listed) lens are estimated from matched features, and all parameters are optimized with the
    /// scene. base estimates the pose of a mobile base at every station [default: base; on a GPU:
    /// auto, but without trials in live runs]
    #[arg(long, value_name = "PARAMS", value_delimiter = ',', hide_possible_values = true, value_parser = refine())]
    pub(crate) refine: Vec<Refine>,
    /// How the number of splats is chosen. to-cap: grow to --max-splats. tested: grow to
    /// --max-splats, or to 8000 splats per image if there are fewer than 40 images; then halve the
    /// number as long as this costs less than 0.1 dB on validation images [default: to-cap; for
    /// data on disk with a GPU: tested]
    #[arg(long, value_name = "HOW", hide_possible_values = true, value_parser = count_policy())]
    pub(crate) count: Option<CountPolicy>,
}

/// Distinct scene models, at least one.
#[derive(Clone, Debug)]
pub(crate) struct Methods(Vec<ModelKind>);

fn methods(text: &str) -> Result<Methods, String> {
    methods_in(text).map(Methods)
}

/// Parses a value of `--max-bytes`.
fn max_bytes(text: &str) -> Result<u64, String> {
    let found = text
        .parse()
        .ok()
        .filter(|bytes| MAX_BYTES_RANGE.contains(bytes));
    found.ok_or_else(|| {
        format!(
            "must be a number of bytes from {}, such as 4000000000 for 4 GB",
            MAX_BYTES_RANGE.start()
        )
    })
}

/// Parses a value of `--refine`.
fn refine() -> impl TypedValueParser<Value = Refine> {
    one_of(Refine::ALL.map(|(name, refine)| (refine, name, "")))
}

/// Parses a value of `--count`.
fn count_policy() -> impl TypedValueParser<Value = CountPolicy> {
    one_of([
        (CountPolicy::Tested, "tested", ""),
        (CountPolicy::ToCap, "to-cap", ""),
    ])
}

impl TrainingArgs {
    /// The flags as options.
    pub(crate) fn options(&self) -> TrainingOptions {
        TrainingOptions {
            methods: self.method.as_ref().map(|Methods(kinds)| kinds.clone()),
            seed: self.seed,
            max_bytes: self.max_bytes,
            max_splats: self.max_splats,
            refine: self.refine.clone(),
            count: self.count,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Args as _;

    #[test]
    fn all_training_flags_are_listed() {
        let command = TrainingArgs::augment_args(clap::Command::new("training"));
        let ids: Vec<_> = command
            .get_arguments()
            .map(|argument| argument.get_id().as_str())
            .collect();
        assert_eq!(ids, TRAINING_ARGS);
    }
}
