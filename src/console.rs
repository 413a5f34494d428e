//! Prints the reports of training sessions, and progress bars.

use crate::exit::Exit;
use crate::work_lines::WorkLines;
use crate::{print, version};
use indicatif::ProgressBar;
use parking_lot::Mutex;
use serde::Serialize;
use session::next_commands;
use session::{
    FinishedModel, FinishedRun, Limits, Observer, ProgressLines, ReadProgress, SessionEvent,
    end_lines, run_log,
};
use std::time::Instant;
use viz::Verdict;

/// What is printed about a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OutputMode {
    /// A line per evaluation, and a progress bar if stderr is a terminal.
    Lines,
    /// A JSON object per evaluation.
    Json,
    /// Only the progress bar; the caller reports the result.
    Bar,
    /// Nothing.
    Nothing,
}

impl OutputMode {
    /// The output mode of a command with one session.
    pub(crate) fn of_command(json: bool) -> Self {
        if json { Self::Json } else { Self::Lines }
    }
}

/// Prints the reports of a session.
pub(crate) struct Console {
    output: OutputMode,
    limits: Limits,
    is_hidden: bool,
    bar: ProgressBar,
    /// Lines about the scoring in progress.
    scoring: Option<ProgressLines>,
    /// Lines about other work in progress.
    work: Option<WorkLines>,
}

impl Console {
    /// A console for a session with these limits. If several sessions run at once, there is no
    /// progress bar, because their bars would overwrite each other.
    pub(crate) fn new(output: OutputMode, limits: Limits, n_sessions: usize) -> Self {
        // `on_event` sets the position in the same unit: steps if both limits are given.
        let length = limits.steps.or(limits.seconds.map(whole_secs));
        let template = if length.is_some() {
            "{bar:30} {elapsed} {msg}"
        } else {
            "{spinner} {elapsed} {msg}"
        };
        let is_hidden = n_sessions > 1 || matches!(output, OutputMode::Json | OutputMode::Nothing);
        Self {
            output,
            limits,
            is_hidden,
            bar: print::bar(length, template, is_hidden),
            scoring: None,
            work: None,
        }
    }

    /// Whether lines replace the bar, because stderr is not a terminal.
    fn has_lines(&self) -> bool {
        self.output == OutputMode::Lines && self.bar.is_hidden()
    }

    /// Prints how many test images are scored, if no bar shows it.
    fn print_scoring(&mut self, n_scored: usize, n_all: usize) {
        let is_shown = self.has_lines();
        let now = Instant::now();
        let lines = (self.scoring).get_or_insert_with(|| ProgressLines::new(is_shown, now));
        if lines.is_due(n_scored, n_all, now) {
            print::notice(format_args!("scored {n_scored} of {n_all} test images"));
        }
    }
}

impl Observer for Console {
    fn on_event(&mut self, event: &SessionEvent<'_>) {
        match (event, self.output) {
            (SessionEvent::Started(run), _) => {
                run.remember();
                run_log::begin(&run.run_folder, &log_header());
            }
            (SessionEvent::Working(work), _) => {
                self.work = work.filter(|_| self.has_lines()).map(WorkLines::new);
            }
            (SessionEvent::Progress(session), _) => {
                let progress = &session.progress;
                let has_steps = self.limits.steps.is_some();
                // The unit of the bar's length.
                self.bar.set_position(if has_steps {
                    progress.step
                } else {
                    whole_secs(session.seconds)
                });
                self.bar.set_message(session.summary());
            }
            (SessionEvent::TrainingEnded, _) => self.bar.finish_and_clear(),
            (SessionEvent::Scoring { n_scored, n_all }, _) => {
                // The first event of the scoring. The bar of the training has ended, so the scoring
                // gets its own.
                if self.bar.is_finished() && n_scored < n_all {
                    let template = "{bar:30} {elapsed} scored {pos} of {len} test images";
                    self.bar = print::bar(Some(*n_all as u64), template, self.is_hidden);
                }
                self.bar.set_position(*n_scored as u64);
                self.print_scoring(*n_scored, *n_all);
                if n_scored == n_all {
                    self.bar.finish_and_clear();
                    self.scoring = None;
                }
            }
            (SessionEvent::Evaluated(evaluation), OutputMode::Json) => print_json(evaluation),
            (SessionEvent::Evaluated(evaluation), OutputMode::Lines) => {
                print::report(evaluation.line());
            }
            (SessionEvent::Finished(finished), OutputMode::Json) => {
                finished.profile.iter().for_each(print_json);
                print_json(finished.done);
            }
            (SessionEvent::Finished(finished), OutputMode::Lines) => {
                finished.lines().iter().for_each(print::report);
            }
            (
                SessionEvent::Evaluated(_) | SessionEvent::Finished(_),
                OutputMode::Bar | OutputMode::Nothing,
            ) => {}
        }
    }
}

/// The first line of the log in a run folder: the version and the command.
fn log_header() -> String {
    format!(
        "fieldrig {}: {}",
        version::LONG,
        next_commands::this_command()
    )
}

/// Prints a JSON object as [`print::report_json`] does; an error is logged.
pub(crate) fn print_json(value: &impl Serialize) {
    if let Err(error) = print::report_json(value) {
        log::error!("{error:#}");
    }
}

/// Prints commands to run next on these models, and the likely cause of a poor result. The last line
/// is the verdict on the models, with the first of these commands.
pub(crate) fn print_end(models: &[FinishedModel], likely_cause: Option<&str>, verdict: &Verdict) {
    end_lines(models, likely_cause, verdict)
        .iter()
        .for_each(print::report);
}

/// Prints that the run to be continued has already reached its limits.
pub(crate) fn print_finished_run(run: &FinishedRun, json: bool) -> anyhow::Result<Exit> {
    if json {
        print::report_json(
            &serde_json::json!({ "event": "finished", "seconds": run.seconds, "out": run.folder }),
        )?;
        return Ok(Exit::Done);
    }
    print::report(run.describe());
    Ok(Exit::Done)
}

/// Whole seconds for the progress bar.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "float casts saturate"
)]
fn whole_secs(secs: f64) -> u64 {
    secs as u64
}

/// A progress bar for work that is counted. It is cleared when the value is dropped.
pub(crate) struct CountedWork {
    template: &'static str,
    is_hidden: bool,
    shown: Option<(ProgressBar, ProgressLines)>,
}

impl CountedWork {
    /// A bar that appears when there is progress for the first time, unless it is hidden.
    pub(crate) fn new(template: &'static str, is_hidden: bool) -> Self {
        Self {
            template,
            is_hidden,
            shown: None,
        }
    }

    /// Shows the progress. Returns whether a line about it is due, because stderr is not a terminal.
    pub(crate) fn show(&mut self, n_done: usize, n_all: usize) -> bool {
        let (bar, lines) = self.shown.get_or_insert_with(|| {
            let bar = print::bar(Some(n_all as u64), self.template, self.is_hidden);
            let lines = ProgressLines::new(bar.is_hidden() && !self.is_hidden, Instant::now());
            (bar, lines)
        });
        bar.set_position(n_done as u64);
        lines.is_due(n_done, n_all, Instant::now())
    }
}

impl Drop for CountedWork {
    fn drop(&mut self) {
        if let Some((bar, _)) = &self.shown {
            bar.finish_and_clear();
        }
    }
}

/// A progress bar for reading images. It is cleared when the value is dropped.
pub(crate) struct ReadBar {
    is_hidden: bool,
    /// The name of the counted items, the bar, and the lines that replace it if stderr is not a
    /// terminal.
    bar: Mutex<Option<(&'static str, ProgressBar, ProgressLines)>>,
}

impl ReadBar {
    /// A bar that appears when there is progress for the first time, unless it is hidden.
    pub(crate) fn new(is_hidden: bool) -> Self {
        Self {
            is_hidden,
            bar: Mutex::default(),
        }
    }

    /// Shows the progress.
    pub(crate) fn show(&self, progress: ReadProgress) {
        let mut current = self.bar.lock();
        // Another kind of items has begun, for example depth images after the images.
        if current
            .as_ref()
            .is_none_or(|(noun, ..)| *noun != progress.noun)
        {
            clear(&mut current);
            // A recording has no known number of images and keyframes, so there is no bar to fill.
            let template = match (progress.noun, progress.n_all) {
                ("images", Some(_)) => "{bar:30} {pos} of {len} images",
                ("images", None) => "{spinner} {pos} images",
                ("depth images", _) => "{bar:30} {pos} of {len} depth images",
                _ => "{spinner} {pos} keyframes",
            };
            let bar = print::bar(progress.n_all.map(|n| n as u64), template, self.is_hidden);
            let lines = ProgressLines::new(bar.is_hidden() && !self.is_hidden, Instant::now());
            *current = Some((progress.noun, bar, lines));
        }
        if let Some((noun, bar, lines)) = &mut *current {
            bar.set_position(progress.n_done as u64);
            let n_done = progress.n_done;
            // Without a number of all items, lines depend only on the time.
            let n_all = progress.n_all.unwrap_or(usize::MAX);
            if lines.is_due(n_done, n_all, Instant::now()) {
                let of_all = (progress.n_all).map_or(String::new(), |n_all| format!(" of {n_all}"));
                print::notice(format_args!("read {n_done}{of_all} {noun}"));
            }
        }
    }

    /// Removes the bar until there is further progress.
    pub(crate) fn end(&self) {
        clear(&mut self.bar.lock());
    }
}

fn clear(bar: &mut Option<(&'static str, ProgressBar, ProgressLines)>) {
    if let Some((_, bar, _)) = bar.take() {
        bar.finish_and_clear();
    }
}

impl Drop for ReadBar {
    fn drop(&mut self) {
        self.end();
    }
}
