//! `fieldrig runs replay`: repeats the decisions of a steered run.

use crate::exit::Exit;
use crate::print;
use messages::counted;
use serde::Serialize;
use session::run_folder::RUNS;
use session::steering_log::{self, Replayed};
use std::path::PathBuf;

/// Flags of `runs replay`.
#[derive(Debug, clap::Args)]
pub(super) struct ReplayArgs {
    /// Name in the folder of the runs, path of a run, or file of a steering log
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Folder of the runs
    #[arg(long = "in", value_name = "FOLDER", default_value = RUNS)]
    folder: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The result as JSON.
#[derive(Debug, Serialize)]
struct ReplayEvent<'a> {
    event: &'static str,
    identical: bool,
    #[serde(flatten)]
    result: &'a Replayed,
}

/// Replays the log. Exit code 1 means that a decision differs, and 3 that a part of the log is
/// missing.
pub(super) fn run(args: &ReplayArgs) -> anyhow::Result<Exit> {
    let named = args.folder.join(&args.run);
    let run = if args.run.exists() { &args.run } else { &named };
    let files = steering_log::files_of(run)?;
    let result = steering_log::replay(&files)?;
    if args.json {
        print::json(&ReplayEvent {
            event: "replay",
            identical: result.is_identical(),
            result: &result,
        })?;
    } else {
        print::line(result.sentence())?;
    }
    if !result.is_identical() {
        anyhow::bail!("the replay differs from the log");
    }
    if let Some(damage) = &result.damage {
        log::warn!("the log is read up to a damaged part: {damage}");
    }
    if result.missing > 0 {
        let missing = counted(result.missing, "decision");
        log::warn!("the log lacks {missing}, because the disk was too slow");
    }
    let is_complete = result.damage.is_none() && result.missing == 0;
    Ok(if is_complete { Exit::Done } else { Exit::Loss })
}
