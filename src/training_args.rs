//! Flags that every training command has; they override keys of the same name in a rig file.

use crate::config::Override;
use crate::method::Kind;

/// What to train, and how large it may become.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct TrainingArgs {
    /// Scene model [default: the rig file's, else splat]
    #[arg(long, value_name = "METHOD", hide_possible_values = true)]
    pub(crate) method: Option<Kind>,
    /// Seed of everything random; with --steps, one seed gives one result
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u32>,
    /// Most GPU bytes the model may take
    #[arg(long, value_name = "BYTES")]
    pub(crate) max_bytes: Option<u64>,
    /// Most splats
    #[arg(long, value_name = "N")]
    pub(crate) max_splats: Option<u32>,
}

impl TrainingArgs {
    /// The keys of the rig file that the flags stand for.
    pub(crate) fn overrides(&self) -> Vec<Override> {
        let mut overrides = Vec::new();
        if let Some(method) = self.method {
            overrides.push(Override::new("train.method", method.name()));
        }
        if let Some(seed) = self.seed {
            overrides.push(Override::new("train.seed", i64::from(seed)));
        }
        if let Some(bytes) = self.max_bytes {
            // TOML has no larger integers, and no GPU that many bytes.
            overrides.push(Override::new("train.max_bytes", i64::try_from(bytes).unwrap_or(i64::MAX)));
        }
        if let Some(n) = self.max_splats {
            overrides.push(Override::new("train.max_splats", i64::from(n)));
        }
        overrides
    }
}
