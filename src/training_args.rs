//! Flags that every training command has; they override keys of the same name in a rig file.

use crate::config::{MAX_BYTES, MAX_SPLATS, Override, SEED};
use crate::exit::BadArgument;
use crate::method::Kind;
use clap::value_parser;
use trainer::splat::{CameraChoice, CountChoice, TermSet};

/// What to train, and how large it may become.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct TrainingArgs {
    /// Scene model: splat [default: the rig file's, else splat]
    #[arg(long, value_name = "METHOD", hide_possible_values = true)]
    pub(crate) method: Option<Kind>,
    /// Seed of everything random, 0 to 2^63 - 1; with --steps, one seed gives one result [default: the rig file's, else 1]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(SEED))]
    pub(crate) seed: Option<u64>,
    /// Most GPU bytes the model may take, at least 1000000 [default: the rig file's, else no bound but memory]
    #[arg(long, value_name = "BYTES", value_parser = value_parser!(u64).range(MAX_BYTES))]
    pub(crate) max_bytes: Option<u64>,
    /// Most splats, 1 to 100000000 [default: the rig file's, else 400000]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(MAX_SPLATS))]
    pub(crate) max_splats: Option<u64>,
    /// What is learned about cameras along with the scene: auto (what pays on held-back images), none, or a list of mount,
    /// delay, lens, image-poses and image-gains, separated by commas [default: none; for data on disk auto on a GPU]
    #[arg(long, value_name = "TERMS", value_delimiter = ',', hide_possible_values = true)]
    pub(crate) refine: Vec<Refine>,
    /// How many splats there are in the end: tested (grown up to --max-splats, then halved as long as that costs less than
    /// 0.1 dB on held-back images) or to-cap (--max-splats) [default: to-cap; for data on disk tested on a GPU]
    #[arg(long, value_name = "HOW", hide_possible_values = true)]
    pub(crate) count: Option<HowMany>,
}

/// What `--count` takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum HowMany {
    Tested,
    ToCap,
}

/// What `--refine` takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Refine {
    Auto,
    None,
    Mount,
    Delay,
    Lens,
    ImagePoses,
    ImageGains,
}

impl TrainingArgs {
    /// What is learned about cameras; `usual` where no flag says.
    ///
    /// Poses that come from joints are wrong in what all images share, those of a SLAM system drift from image to image.
    pub(crate) fn cameras(&self, poses_from_joints: bool, usual: Refine) -> Result<CameraChoice, BadArgument> {
        let asked = if self.refine.is_empty() { std::slice::from_ref(&usual) } else { &self.refine };
        let has = |term| asked.contains(&term);
        if (has(Refine::Auto) || has(Refine::None)) && asked.len() > 1 {
            return Err(BadArgument("--refine: auto and none stand alone".into()));
        }
        if has(Refine::Auto) {
            let first = if poses_from_joints {
                TermSet { mount: true, delay: true, ..TermSet::default() }
            } else {
                TermSet { image_poses: true, ..TermSet::default() }
            };
            return Ok(CameraChoice::Try(vec![first]));
        }
        Ok(CameraChoice::Given(TermSet {
            mount: has(Refine::Mount),
            delay: has(Refine::Delay),
            lens: has(Refine::Lens),
            image_poses: has(Refine::ImagePoses),
            image_gains: has(Refine::ImageGains),
        }))
    }

    /// How the number of splats is found; `usual` where no flag says.
    pub(crate) fn count(&self, usual: HowMany) -> CountChoice {
        match self.count.unwrap_or(usual) {
            HowMany::Tested => CountChoice::Tested,
            HowMany::ToCap => CountChoice::ToCap,
        }
    }

    /// The keys of the rig file that the flags stand for.
    pub(crate) fn overrides(&self) -> Vec<Override> {
        let mut overrides = Vec::new();
        if let Some(method) = self.method {
            overrides.push(Override::new("train.method", method.name()));
        }
        if let Some(seed) = self.seed {
            overrides.push(Override::new("train.seed", seed.cast_signed()));
        }
        if let Some(bytes) = self.max_bytes {
            overrides.push(Override::new("train.max_bytes", bytes.cast_signed()));
        }
        if let Some(n) = self.max_splats {
            overrides.push(Override::new("train.max_splats", n.cast_signed()));
        }
        overrides
    }
}
