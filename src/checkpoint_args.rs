//! Flags for checkpoints.

use session::{CheckpointOptions, parse_period};
use std::time::Duration;

/// How often checkpoints are written.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct CheckpointArgs {
    /// Write a checkpoint for `--resume` every S seconds and at the end; 0 disables checkpoints
    /// [default: 60]
    #[arg(long, value_name = "S", value_parser = parse_period)]
    checkpoint_secs: Option<Duration>,
}

impl CheckpointArgs {
    /// The flag as an option.
    pub(crate) fn options(self) -> CheckpointOptions {
        CheckpointOptions {
            period: self.checkpoint_secs,
        }
    }
}
