//! Lines about work whose end cannot be foreseen, for outputs without a progress bar.

use crate::print;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

/// Time between two lines.
const PERIOD: Duration = Duration::from_secs(10);

/// Prints a line every 10 s as long as it exists.
pub(crate) struct WorkLines {
    /// Dropping it ends the thread that prints.
    _work: SyncSender<()>,
}

impl WorkLines {
    /// Lines such as `saving the model: 10 s so far`.
    ///
    /// * `text`: the work that begins now.
    pub(crate) fn new(text: &'static str) -> Self {
        let print = move |secs| print::notice(format_args!("{text}: {secs} s so far"));
        Self::with_period(PERIOD, print)
    }

    fn with_period(period: Duration, mut print: impl FnMut(u64) + Send + 'static) -> Self {
        let (work, has_ended) = sync_channel(0);
        // Without a thread, there are no lines, and the work is the same.
        let _ = std::thread::Builder::new()
            .name("progress".to_owned())
            .spawn(move || print_until_ended(period, &has_ended, &mut print));
        Self { _work: work }
    }
}

fn print_until_ended(period: Duration, has_ended: &Receiver<()>, print: &mut impl FnMut(u64)) {
    let mut elapsed = Duration::ZERO;
    while has_ended.recv_timeout(period) == Err(RecvTimeoutError::Timeout) {
        elapsed += period;
        print(elapsed.as_secs());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_printed_until_the_work_ends() {
        let (printed, lines) = sync_channel(64);
        let work = WorkLines::with_period(Duration::from_millis(1), move |_| {
            printed.send(()).expect("the test waits for the end");
        });
        for _ in 0..3 {
            lines.recv().expect("another line");
        }
        drop(work);
        // The thread ends, and drops its sender. Lines that were printed before are still read.
        while lines.recv().is_ok() {}
    }
}
