//! Terminal output: results on stdout, log and progress on stderr.
//!
//! A command whose result is its output (`devices`, `metrics`) prints with [`line()`] and [`json`],
//! which fail if stdout fails. A command whose result is a file (`train`, `run`, `record`) prints
//! with [`report()`] and [`report_json`], which never fail: if the terminal is closed or the disk
//! is full, lines are lost, but the model is not. Each stream has a thread that writes its lines. A
//! terminal or a program that accepts no output therefore blocks neither this program nor the other
//! stream. [`has_lost_output`] returns whether any lines of stdout were lost.
//!
//! Text may come from files and other programs. A terminal may interpret control characters in this
//! text, so they are escaped.

use anyhow::Context;
use background::output_thread::OutputQueue;
use console::Term;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle, TermLike};
use messages::printable;
use parking_lot::Mutex;
use serde::Serialize;
use session::run_log;
use std::fmt::Display;
use std::io::Write;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Writing to stdout failed.
#[derive(Debug, thiserror::Error)]
#[error("cannot write to stdout")]
pub(crate) struct StdoutError(#[source] pub(crate) std::io::Error);

/// The progress bars on stderr; log lines are printed above them.
static BARS: LazyLock<MultiProgress> = LazyLock::new(|| MultiProgress::with_draw_target(target()));
/// Whether any line of [`report()`] could not be written.
static LOST_OUTPUT: AtomicBool = AtomicBool::new(false);

/// Maximum number of output chunks that wait to be written. With a queue, a terminal that accepts
/// no output, for example after a broken connection, does not block the program.
const MAX_WAITING: usize = 4096;
/// At exit, the program waits at most this long for its output to be written. A slow connection
/// needs seconds for a full queue. A broken connection never accepts the output.
const MAX_FLUSH: Duration = Duration::from_secs(5);

/// A command waits at most this long for the log before it prints a line of its result. Lines of
/// both streams then appear in the order in which they were written, unless stderr is blocked.
const MAX_ORDERING: Duration = Duration::from_millis(200);

/// Queue of the thread that writes to stdout.
static STDOUT: LazyLock<Option<OutputQueue>> = LazyLock::new(|| {
    start_stream(|bytes| {
        let mut stdout = std::io::stdout().lock();
        if let Err(error) = stdout.write_all(bytes).and_then(|()| stdout.flush()) {
            log_lost(&error.to_string());
        }
    })
});
/// Queue of the thread that writes to stderr.
static STDERR: LazyLock<Option<OutputQueue>> = LazyLock::new(|| {
    // The output is lost if the terminal is closed or the disk is full.
    start_stream(|bytes| drop(std::io::stderr().write_all(bytes)))
});

/// Starts the thread of a stream. If it cannot be started, the output is lost.
fn start_stream(write: fn(&[u8])) -> Option<OutputQueue> {
    let queue = OutputQueue::start(MAX_WAITING, write).ok();
    if queue.is_none() {
        LOST_OUTPUT.store(true, Ordering::Relaxed);
    }
    queue
}

/// Queues text for a stream, and returns false if the queue is full. The progress bars are hidden
/// during this call.
fn send(stream: &Option<OutputQueue>, text: String) -> bool {
    BARS.suspend(|| (stream.as_ref()).is_some_and(|queue| queue.push(text.into_bytes())))
}

fn log_lost(reason: &str) {
    if !LOST_OUTPUT.swap(true, Ordering::Relaxed) {
        log::warn!("cannot write to stdout ({reason}): output is lost, but the command continues");
    }
}

/// Waits until all output is written, at most [`MAX_FLUSH`].
pub(crate) fn flush() {
    flush_for(MAX_FLUSH, MAX_FLUSH);
}

/// Waits until all output is written, at most [`MAX_ORDERING`], because the program must end soon.
pub(crate) fn flush_briefly() {
    flush_for(MAX_ORDERING, MAX_ORDERING);
}

/// Waits until stdout is written, for at most `max_stdout`. Also waits until stderr is written, for
/// at most `max_stderr` after the call.
fn flush_for(max_stdout: Duration, max_stderr: Duration) {
    let began = Instant::now();
    // Both streams get the request before either is waited for, so that they are written in
    // parallel.
    let [out, err] =
        [&STDOUT, &STDERR].map(|stream| stream.as_ref().and_then(OutputQueue::request_flush));
    if !out.is_some_and(|flush| flush.wait(max_stdout)) {
        LOST_OUTPUT.store(true, Ordering::Relaxed);
    }
    if let Some(flush) = err {
        let _ = flush.wait(max_stderr.saturating_sub(began.elapsed())); // After a timeout, stderr accepts no output.
    }
}

/// The place where progress bars are drawn: stderr, if it is a terminal.
fn target() -> ProgressDrawTarget {
    let term = Term::stderr();
    if term.is_term() {
        ProgressDrawTarget::term_like(Box::new(BarTerm {
            term,
            buffered: Mutex::default(),
        }))
    } else {
        ProgressDrawTarget::hidden()
    }
}

/// A terminal that may disappear or stop accepting output at any time: output goes through the
/// writer thread.
///
/// The target of indicatif blocks on the terminal. It also panics if drawing fails
/// (`MultiProgress::suspend`), for example with EIO after a terminal is closed.
#[derive(Debug)]
struct BarTerm {
    term: Term,
    /// Text drawn since the last flush.
    buffered: Mutex<String>,
}

impl BarTerm {
    fn draw(&self, text: &str) -> std::io::Result<()> {
        self.buffered.lock().push_str(text);
        Ok(())
    }

    fn move_cursor(&self, n: usize, direction: char) -> std::io::Result<()> {
        if n > 0 {
            self.draw(&format!("\x1b[{n}{direction}"))
        } else {
            Ok(())
        }
    }
}

impl TermLike for BarTerm {
    fn width(&self) -> u16 {
        self.term.size().1
    }

    fn height(&self) -> u16 {
        self.term.size().0
    }

    fn move_cursor_up(&self, n: usize) -> std::io::Result<()> {
        self.move_cursor(n, 'A')
    }

    fn move_cursor_down(&self, n: usize) -> std::io::Result<()> {
        self.move_cursor(n, 'B')
    }

    fn move_cursor_right(&self, n: usize) -> std::io::Result<()> {
        self.move_cursor(n, 'C')
    }

    fn move_cursor_left(&self, n: usize) -> std::io::Result<()> {
        self.move_cursor(n, 'D')
    }

    fn write_line(&self, text: &str) -> std::io::Result<()> {
        self.draw(&format!("{text}\n"))
    }

    fn write_str(&self, text: &str) -> std::io::Result<()> {
        self.draw(text)
    }

    fn clear_line(&self) -> std::io::Result<()> {
        self.draw("\r\x1b[2K")
    }

    fn flush(&self) -> std::io::Result<()> {
        let buffered = std::mem::take(&mut *self.buffered.lock());
        if !buffered.is_empty() {
            // The bars are not hidden for their own output. A lost bar is drawn again later.
            let _ = (STDERR.as_ref()).is_some_and(|queue| queue.push(buffered.into_bytes()));
        }
        Ok(())
    }
}

/// Prints one line of the result.
pub(crate) fn line(text: impl Display) -> Result<(), StdoutError> {
    // The line is written here and not by the thread, because its errors must be returned.
    flush_for(MAX_FLUSH, MAX_ORDERING);
    let text = text.to_string();
    BARS.suspend(|| {
        let mut stdout = std::io::stdout().lock();
        writeln!(stdout, "{}", printable(&text))
            .and_then(|()| stdout.flush())
            .map_err(StdoutError)
    })
}

/// Prints several lines of the result.
pub(crate) fn lines(texts: impl IntoIterator<Item = impl Display>) -> Result<(), StdoutError> {
    texts.into_iter().try_for_each(line)
}

/// Prints one line about a result in a file. If stdout fails or accepts no output, the line is
/// lost, which is logged once.
pub(crate) fn report(text: impl Display) {
    report_styled(printable(&text.to_string()));
}

/// Prints text of this program as [`report()`] does, but keeps the colors of the text.
pub(crate) fn report_styled(text: impl Display) {
    if !send(&STDOUT, format!("{text}\n")) {
        log_lost("it accepts no more output");
    }
}

/// Prints one line for the user to stderr. Unlike the log, it may contain a token.
pub(crate) fn notice(text: impl Display) {
    send(&STDERR, format!("{text}\n"));
}

/// Prints the error that ends the program to stderr. Like the log, it goes through the writer
/// thread, so a terminal that accepts no output does not prevent the program from exiting with the
/// right code.
pub(crate) fn error(error: &anyhow::Error) {
    let line = format!("error: {}\n", printable(&format!("{error:#}")));
    run_log::record(&line);
    send(&STDERR, line);
}

/// Whether any line of [`report()`] was lost.
pub(crate) fn has_lost_output() -> bool {
    LOST_OUTPUT.load(Ordering::Relaxed)
}

/// Prints one JSON object on its own line.
pub(crate) fn json(value: &impl Serialize) -> anyhow::Result<()> {
    Ok(line(json_text(value)?)?)
}

/// Prints a value as JSON, or its lines of text.
pub(crate) fn json_or_lines<T: Display>(
    is_json: bool,
    value: &impl Serialize,
    texts: impl IntoIterator<Item = T>,
) -> anyhow::Result<()> {
    if is_json {
        return json(value);
    }
    Ok(lines(texts)?)
}

/// Prints one JSON object on its own line, as [`report()`] does.
///
/// # Errors
///
/// If the value cannot be serialized as JSON.
pub(crate) fn report_json(value: &impl Serialize) -> anyhow::Result<()> {
    report(json_text(value)?);
    Ok(())
}

fn json_text(value: &impl Serialize) -> anyhow::Result<String> {
    serde_json::to_string(value).context("cannot write the result as JSON")
}

/// Returns a progress bar on stderr. The bar is not drawn if `hidden` is set or if stderr is not a
/// terminal.
///
/// `template` is an indicatif template.
pub(crate) fn bar(length: Option<u64>, template: &'static str, hidden: bool) -> ProgressBar {
    let bar = length.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    bar.set_style(
        ProgressStyle::with_template(template).expect("templates are constants of this program"),
    );
    if hidden {
        bar.set_draw_target(ProgressDrawTarget::hidden());
        return bar;
    }
    BARS.add(bar)
}

/// The crates that log progress.
const WORKSPACE_CRATES: [&str; 12] = [
    "fieldrig",
    "bench",
    "calibrate",
    "calibration",
    "capture",
    "drivers",
    "gpu",
    "report",
    "session",
    "sim",
    "trainer",
    "viz",
];

/// Filter rules that set the level of the crates of this workspace.
fn of_workspace(level: &str) -> String {
    WORKSPACE_CRATES
        .map(|name| format!(",{name}={level}"))
        .concat()
}

/// Sends log records to stderr and to the log in the run folder. `RUST_LOG` takes precedence; `verbose` counts the `-v` flags.
pub(crate) fn start_log(verbose: u8) {
    // Other crates log many messages that concern only their developers, so they start one level
    // later.
    let filter = match verbose {
        0 => format!("warn{}", of_workspace("info")),
        1 => format!("info{}", of_workspace("debug")),
        _ => "trace".to_owned(),
    };
    env_logger::Builder::from_env(env_logger::Env::default().default_filter_or(filter))
        .target(env_logger::Target::Pipe(Box::new(LogTarget)))
        .format_target(false)
        .init();
}

/// Writes to stderr above the progress bars, and to the log in the run folder. Records that cannot be written are dropped without an
/// error.
struct LogTarget;

impl Write for LogTarget {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let text = printable(&String::from_utf8_lossy(bytes)).into_owned();
        run_log::record(&text);
        send(&STDERR, text);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
