//! Flags of all benches that train, and their output.

use crate::console::{Console, OutputMode, ReadBar, print_json};
use crate::data_args::DataArgs;
use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::training_args::TrainingArgs;
use crate::{print, signals};
use bench::{BenchObserver, BenchResult, Host, RunReport, RunsOptions};
use session::{Limits, Observer, ReadProgress};
use std::path::PathBuf;

/// Flags shared by all benches that train.
#[derive(Debug, clap::Args)]
pub(crate) struct RunsArgs {
    #[command(flatten)]
    training: TrainingArgs,
    #[command(flatten)]
    images: DataArgs,
    /// Folder for runs, charts and the page. Finished runs of an earlier bench in this folder are
    /// not repeated [default: a new folder in runs]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Print JSON, one object per line: each run when it ends, then the findings
    #[arg(long)]
    json: bool,
}

impl RunsArgs {
    /// The flags as options.
    pub(super) fn options(&self) -> RunsOptions {
        RunsOptions {
            training: self.training.options(),
            images: self.images.options(),
            out: self.out.clone(),
        }
    }

    /// Runs a bench and prints its result.
    pub(super) fn run(
        &self,
        bench: impl FnOnce(&Host<'_>) -> anyhow::Result<BenchResult>,
    ) -> anyhow::Result<Exit> {
        let observer = Printer { json: self.json };
        let result = bench(&Host {
            open_gpu,
            stop: signals::stop_on_signals()?,
            observer: &observer,
        })?;
        print_result(&result, self.json)?;
        Ok(exit::from_losses(&result.data_losses))
    }
}

/// Prints the tables of a bench, or one JSON object.
pub(super) fn print_result(result: &BenchResult, json: bool) -> anyhow::Result<()> {
    let BenchResult { findings, page, .. } = result;
    if json {
        return print::report_json(
            &serde_json::json!({ "event": "done", "page": page, "findings": findings.numbers }),
        );
    }
    for table in &findings.tables {
        print::report(table.text());
    }
    print::report(format_args!("see {}", page.display()));
    Ok(())
}

/// Prints the runs of a bench.
struct Printer {
    json: bool,
}

impl BenchObserver for Printer {
    fn reading(&self) -> Box<dyn Fn(ReadProgress) + Sync> {
        let bar = ReadBar::new(self.json);
        Box::new(move |progress| bar.show(progress))
    }

    fn training(&self, limits: Limits) -> Box<dyn Observer> {
        // The console prints only the progress bar. `on_run` prints the result of the run, in the
        // same format for all runs.
        let output = if self.json {
            OutputMode::Nothing
        } else {
            OutputMode::Bar
        };
        Box::new(Console::new(output, limits, 1))
    }

    fn on_run(&self, report: &RunReport<'_>) {
        if self.json {
            print_json(report);
            return;
        }
        print::report(report.summary());
    }
}
