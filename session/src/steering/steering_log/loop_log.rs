//! The side of the steering log that belongs to the loop of decisions: it never waits.
//!
//! The log begins with the first request. Cycles in which the arm must rest, and which change
//! nothing in the chain of decisions, have no effect on later decisions, so most of them are left
//! out.

use super::line::{Line, Moment, View};
use super::logged_chain::LoggedChain;
use super::writer::LogWriter;
use kinematics::Stamp;
use std::path::Path;
use steering::{BaseSteering, Steering};

/// Time between two cycles without effect that are logged while the arm moves, so that its way can
/// be shown.
const MOVING_PERIOD_SECS: f64 = 0.05;
/// The same while the arm is at rest.
const REST_PERIOD_SECS: f64 = 1.0;

/// Logs the decisions of one loop. Dropping this value completes the log.
pub(in crate::steering) struct LoopLog<C: LoggedChain = Steering> {
    about: C::About,
    writer: LogWriter,
    has_begun: bool,
    /// State of the chain after the last cycle.
    before: C::State,
    /// The last verdict.
    verdict: Option<C::Verdict>,
    /// The newest cycle without effect that was left out. The time between cycles matters, so it is
    /// logged before the next entry with an effect.
    left_out: Option<C::Entry>,
    logged_at: Option<Stamp>,
    n_missing: u64,
    latest: Stamp,
}

impl LoopLog<BaseSteering> {
    /// A log of a base, see [`LoopLog::new`].
    ///
    /// # Errors
    ///
    /// If no thread can be started.
    pub(in crate::steering) fn of_base(
        folder: &Path,
        steering: &BaseSteering,
    ) -> std::io::Result<Self> {
        Self::new(folder, (), steering)
    }
}

impl<C: LoggedChain> LoopLog<C> {
    /// A log in the folder of a run. The file is created when the log begins.
    ///
    /// # Errors
    ///
    /// If no thread can be started.
    pub(in crate::steering) fn new(
        folder: &Path,
        about: C::About,
        steering: &C,
    ) -> std::io::Result<Self> {
        Ok(Self {
            about,
            writer: LogWriter::start(folder)?,
            has_begun: false,
            before: steering.state(),
            verdict: None,
            left_out: None,
            logged_at: None,
            n_missing: 0,
            latest: Stamp(0),
        })
    }

    /// Logs the decisions of the chain since the last call. Call it after each cycle.
    pub(in crate::steering) fn take(&mut self, now: Stamp, steering: &mut C) {
        let (entries, n_dropped) = steering.take_record();
        self.latest = now;
        let mut lines = Vec::new();
        let is_request = |entry: &C::Entry| C::cycle(entry).is_none();
        let state = steering.state();
        let before = std::mem::replace(&mut self.before, state);
        if !self.has_begun && entries.iter().any(is_request) {
            lines.push(steering.start_line(now, &self.about, before));
            self.has_begun = true;
            self.add(now, entries, None, &mut lines);
        } else if self.has_begun {
            self.add(now, entries, Some(&before), &mut lines);
        }
        if self.has_begun {
            self.send(lines, n_dropped);
            if self.must_restart() {
                self.restart(now, steering);
            }
        }
    }

    /// Logs the view of an operator.
    pub(in crate::steering) fn see(&mut self, at: Stamp, operator: u64, eye: [f64; 7]) {
        if self.has_begun {
            let view = View {
                at,
                operator,
                world_from_camera: eye,
            };
            self.send(vec![Line::View(view)], 0);
        }
    }

    /// Uses another writer, before the log begins.
    #[cfg(test)]
    pub(super) fn replace_writer(&mut self, writer: LogWriter) {
        self.writer = writer;
    }

    /// Number of entries that are missing since the last start.
    #[cfg(test)]
    pub(super) fn n_missing(&self) -> u64 {
        self.n_missing
    }

    /// Selects the entries to log.
    ///
    /// * `before`: the state before these entries; `None` if they all matter.
    fn add(
        &mut self,
        now: Stamp,
        entries: Vec<C::Entry>,
        before: Option<&C::State>,
        lines: &mut Vec<Line>,
    ) {
        let is_without_effect =
            before.is_some_and(|before| self.is_without_effect(&entries, before));
        if let Some(cycle) = entries.last().and_then(C::cycle) {
            self.verdict = Some(cycle.verdict.clone());
        }
        if is_without_effect && !self.is_due(now, &entries) {
            self.left_out = entries.into_iter().next_back();
            return;
        }
        if !is_without_effect {
            lines.extend(self.left_out.take().map(C::line));
        }
        self.left_out = None;
        self.logged_at = Some(now);
        lines.extend(entries.into_iter().map(C::line));
    }

    fn is_without_effect(&self, entries: &[C::Entry], before: &C::State) -> bool {
        let [entry] = entries else {
            return false;
        };
        C::cycle(entry).is_some_and(|cycle| {
            cycle.is_braking
                && self.verdict.as_ref() == Some(cycle.verdict)
                && C::are_equal_except_times(&self.before, before)
        })
    }

    fn is_due(&self, now: Stamp, entries: &[C::Entry]) -> bool {
        let is_at_rest = |entry: &C::Entry| C::cycle(entry).is_some_and(|cycle| cycle.is_at_rest);
        let period_secs = if entries.iter().all(is_at_rest) {
            REST_PERIOD_SECS
        } else {
            MOVING_PERIOD_SECS
        };
        self.logged_at
            .is_none_or(|last| now.secs_since(last) >= period_secs)
    }

    fn send(&mut self, lines: Vec<Line>, n_dropped: u64) {
        let n_entries = lines.len() as u64;
        // After a gap, further entries would be of no use before the next start.
        let is_sent = self.n_missing == 0 && self.writer.send(lines);
        self.n_missing += n_dropped + if is_sent { 0 } else { n_entries };
    }

    fn must_restart(&self) -> bool {
        self.writer.wants_start() || (self.n_missing > 0 && self.writer.has_room())
    }

    /// Logs the state of the chain, from which the rest of the log can be replayed alone.
    fn restart(&mut self, now: Stamp, steering: &C) {
        let mut lines = Vec::new();
        if self.n_missing > 0 {
            lines.push(Line::Missing(self.n_missing));
        }
        lines.push(steering.start_line(now, &self.about, steering.state()));
        if self.writer.send(lines) {
            self.n_missing = 0;
            self.left_out = None;
        } else {
            // It is sent again as soon as there is room.
            self.n_missing = self.n_missing.max(1);
        }
    }
}

impl<C: LoggedChain> Drop for LoopLog<C> {
    fn drop(&mut self) {
        if self.has_begun {
            let mut lines: Vec<Line> = self.left_out.take().map(C::line).into_iter().collect();
            lines.push(Line::End(Moment { at: self.latest }));
            self.send(lines, 0);
        }
    }
}
