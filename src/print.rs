//! What people and programs see: results on stdout, log and progress on stderr.

use anyhow::Context;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use std::fmt::Display;
use std::io::Write;
use std::sync::LazyLock;

/// Stdout took no more.
#[derive(Debug, thiserror::Error)]
#[error("cannot write to stdout")]
pub(crate) struct StdoutError(#[source] pub(crate) std::io::Error);

/// The bars on stderr; log lines go above them.
static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);

/// Prints one line of the result.
pub(crate) fn line(text: impl Display) -> Result<(), StdoutError> {
    BARS.suspend(|| {
        let mut stdout = std::io::stdout().lock();
        writeln!(stdout, "{text}").and_then(|()| stdout.flush()).map_err(StdoutError)
    })
}

/// A count with its word: `1 image`, `2 images`.
pub(crate) fn counted(n: u64, what: &str) -> String {
    match what.strip_suffix('y') {
        _ if n == 1 => format!("1 {what}"),
        Some(stem) => format!("{n} {stem}ies"),
        None => format!("{n} {what}s"),
    }
}

/// Prints one JSON object on a line of its own.
pub(crate) fn json(value: &impl Serialize) -> anyhow::Result<()> {
    Ok(line(serde_json::to_string(value).context("cannot write the result as JSON")?)?)
}

/// A progress bar on stderr; nothing where stderr is no terminal or `hidden` is set.
///
/// `template` is indicatif's.
pub(crate) fn bar(length: Option<u64>, template: &'static str, hidden: bool) -> ProgressBar {
    let bar = length.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    bar.set_style(ProgressStyle::with_template(template).expect("templates are constants of this program"));
    if hidden {
        bar.set_draw_target(ProgressDrawTarget::hidden());
        return bar;
    }
    BARS.add(bar)
}

/// Sends log records to stderr. `RUST_LOG` overrules; `verbose` counts the `-v` flags.
pub(crate) fn start_log(verbose: u8) {
    let level = match verbose {
        0 => "warn,fieldrig=info,drivers=info,sim=info,trainer=info,viz=info",
        1 => "info,fieldrig=debug,drivers=debug,sim=debug,trainer=debug,viz=debug",
        _ => "trace",
    };
    env_logger::Builder::from_env(env_logger::Env::default().default_filter_or(level))
        .target(env_logger::Target::Pipe(Box::new(AboveBars)))
        .format_target(false)
        .init();
}

/// Stderr, with the bars moved out of the way.
struct AboveBars;

impl Write for AboveBars {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        BARS.suspend(|| std::io::stderr().write(bytes))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}
