//! `fieldrig runs`: lists and removes the folders of runs, and replays steered runs.

mod replay;

use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use anyhow::Context;
use messages::{BadInput, counted};
use session::run_folder::RUNS;
use session::runs::{self, OldRuns, RemovableRun, RunList, size};
use std::io::{BufRead, IsTerminal};
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

/// Flags of `runs`.
#[derive(Debug, clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_long_help = "Without a subcommand, the runs are listed. States: `running`: a process writes into the folder. \
                       `done`: all models were saved and scored. `not scored`: the run ended before its scores. \
                       `unfinished`: there is no model, but a checkpoint, from which `fieldrig run RIG.toml --resume RUN` or `fieldrig train DATA --resume RUN` continues. `no model`: there is neither.\n\n\
                       The name of the rig or data is in the report, which is written with the scores, and is `unknown` before. \
                       The models of a run come with their PSNR on the test images."
)]
pub(crate) struct Args {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    list: ListArgs,
}

/// What to do with the runs.
#[derive(Debug, clap::Subcommand)]
enum Action {
    /// List the runs with their time, rig, scores, size and state, the newest last
    List(ListArgs),
    /// Remove runs with all their files, after a question
    #[command(
        after_long_help = "A folder is refused if it is in use, if it is not the folder of a run, or if it contains other \
                           files than those of a run, such as a recording. Then nothing is removed. With --older-than or \
                           --keep, such folders are kept and named."
    )]
    Remove(RemoveArgs),
    /// Repeat the decisions of a steered run, and compare its targets bit for bit
    #[command(
        after_long_help = "The steering log of the run contains all requests of operators, what was known about the arm and \
                           the scene, and all decisions. The replay repeats the decisions and compares them in every bit. It \
                           prints whether they are the same, or the first one that differs, with its time; the exit code is \
                           then 1. A log whose program was killed is replayed up to its last complete line."
    )]
    Replay(replay::ReplayArgs),
}

/// The folder of the runs.
#[derive(Debug, clap::Args)]
struct FolderArg {
    /// Folder of the runs
    #[arg(long = "in", value_name = "FOLDER", default_value = RUNS)]
    folder: PathBuf,
}

#[derive(Debug, clap::Args)]
struct ListArgs {
    #[command(flatten)]
    folder: FolderArg,
    /// Print JSON, one object per run, then one with the total
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("which").required(true).multiple(true)))]
struct RemoveArgs {
    /// Names in the folder of the runs, or paths of runs
    #[arg(value_name = "NAME", group = "which", conflicts_with_all = ["older_than", "keep"])]
    names: Vec<PathBuf>,
    #[command(flatten)]
    folder: FolderArg,
    /// Remove the runs that have not changed for more than DAYS
    #[arg(long, value_name = "DAYS", group = "which", value_parser = number_in_range(0.0..=36_500.0))]
    older_than: Option<f64>,
    /// Keep the N newest runs, and remove the others. With --older-than, a run must meet both
    /// conditions
    #[arg(long, value_name = "N", group = "which")]
    keep: Option<usize>,
    /// Do not ask
    #[arg(long)]
    yes: bool,
}

/// Lists or removes runs.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    match &args.action {
        None => list(&args.list),
        Some(Action::List(args)) => list(args),
        Some(Action::Remove(args)) => remove(args),
        Some(Action::Replay(args)) => replay::run(args),
    }
}

fn list(args: &ListArgs) -> anyhow::Result<Exit> {
    let folder = &args.folder.folder;
    let runs = RunList::read(folder)?;
    if args.json {
        runs.events().iter().try_for_each(print::json)?;
    } else {
        print::lines(runs.lines())?;
    }
    Ok(Exit::Done)
}

fn remove(args: &RemoveArgs) -> anyhow::Result<Exit> {
    let folder = &args.folder.folder;
    let runs = if args.names.is_empty() {
        old_runs(args)?
    } else {
        runs::by_name(folder, &args.names)
            .map_err(|refused| BadInput(format!("{refused}; nothing was removed")))?
    };
    if runs.is_empty() {
        print::line(format_args!("no run in {} to remove", folder.display()))?;
        return Ok(Exit::Done);
    }
    let bytes = runs.iter().map(|run| run.run.bytes).sum();
    let what = format!("{} ({})", counted(runs.len() as u64, "run"), size(bytes));
    if !args.yes {
        for run in &runs {
            print::line(format_args!("{}", run.run.folder.display()))?;
        }
        if !is_confirmed(&what)? {
            print::line("nothing was removed")?;
            return Ok(Exit::Done);
        }
    }
    for run in runs {
        let folder = run.run.folder.clone();
        run.remove()?;
        print::line(format_args!("removed {}", folder.display()))?;
    }
    print::line(format_args!("removed {what}"))?;
    Ok(Exit::Done)
}

fn old_runs(args: &RemoveArgs) -> anyhow::Result<Vec<RemovableRun>> {
    const SECS_PER_DAY: f64 = 86_400.0;
    let folder = &args.folder.folder;
    let old = OldRuns {
        older_than: args
            .older_than
            .map(|days| Duration::from_secs_f64(days * SECS_PER_DAY)),
        keep: args.keep,
    };
    #[expect(
        clippy::disallowed_methods,
        reason = "files have times of the wall clock; no time is measured"
    )]
    let now = SystemTime::now();
    let (runs, refused) = runs::by_age(folder, old, now)
        .with_context(|| format!("cannot read {}", folder.display()))?;
    for reason in refused {
        log::warn!("kept: {reason}");
    }
    Ok(runs)
}

/// Asks whether to remove these runs. Only `y` and `yes` confirm.
fn is_confirmed(what: &str) -> anyhow::Result<bool> {
    let stdin = std::io::stdin();
    if !stdin.is_terminal() {
        let message = "stdin is not a terminal, so the question cannot be asked: add --yes to remove the runs";
        return Err(BadInput(message.to_owned()).into());
    }
    print::notice(format_args!("Remove {what} with all files? [y/N]"));
    print::flush();
    let mut answer = String::new();
    stdin
        .lock()
        .read_line(&mut answer)
        .context("cannot read the answer")?;
    Ok(is_yes(&answer))
}

fn is_yes(answer: &str) -> bool {
    matches!(&*answer.trim().to_lowercase(), "y" | "yes")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_yes_confirms() {
        for (answer, expected) in [
            ("y\n", true),
            ("Yes\r\n", true),
            ("\n", false),
            ("", false),
            ("n\n", false),
            ("yep\n", false),
        ] {
            assert_eq!(is_yes(answer), expected, "{answer:?}");
        }
    }
}
