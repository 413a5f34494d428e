//! The side of the steering log that belongs to the loop of decisions: it never waits.
//!
//! The log begins with the first request. Cycles in which the arm must rest, and which change
//! nothing in the chain of decisions, have no effect on later decisions, so most of them are left
//! out.

use super::line::{Line, Moment, Start, VERSION, View};
use super::writer::LogWriter;
use drivers::motion::Output;
use kinematics::{Stamp, Transform, transform};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};
use steering::{Entry, State, Steering, Verdict};

/// Time between two cycles without effect that are logged while the arm moves, so that its way can
/// be shown.
const MOVING_PERIOD_SECS: f64 = 0.05;
/// The same while the arm is at rest.
const REST_PERIOD_SECS: f64 = 1.0;

/// Content of a log besides decisions.
#[derive(Clone, Debug)]
pub(in crate::steering) struct About {
    /// The robot description.
    pub(in crate::steering) urdf: String,
    /// Pose of the base of the arm.
    pub(in crate::steering) world_from_base: Transform,
}

/// Logs the decisions of one loop. Dropping this value completes the log.
pub(in crate::steering) struct LoopLog {
    about: About,
    writer: LogWriter,
    has_begun: bool,
    /// State of the chain after the last cycle.
    before: State,
    /// The last verdict.
    verdict: Option<Verdict>,
    /// The newest cycle without effect that was left out. The time between cycles matters, so it is
    /// logged before the next entry with an effect.
    left_out: Option<Entry>,
    logged_at: Option<Stamp>,
    n_missing: u64,
    latest: Stamp,
}

impl LoopLog {
    /// A log in the folder of a run. The file is created when the log begins.
    ///
    /// # Errors
    ///
    /// If no thread can be started.
    pub(in crate::steering) fn new(
        folder: &Path,
        about: About,
        steering: &Steering,
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
    pub(in crate::steering) fn take(&mut self, now: Stamp, steering: &mut Steering) {
        let (entries, n_dropped) = steering.take_record();
        self.latest = now;
        let mut lines = Vec::new();
        if !self.has_begun && entries.iter().any(is_request) {
            let state = std::mem::take(&mut self.before);
            lines.push(self.start(now, steering, state));
            self.has_begun = true;
        }
        let state = steering.state();
        if self.has_begun {
            self.add(now, entries, &state, &mut lines);
            self.send(lines, n_dropped);
            if self.must_restart() {
                self.restart(now, steering);
            }
        }
        self.before = state;
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
    fn add(&mut self, now: Stamp, entries: Vec<Entry>, state: &State, lines: &mut Vec<Line>) {
        let is_without_effect = self.is_without_effect(&entries, state);
        if let Some(Entry::Cycle { verdict, .. }) = entries.last() {
            self.verdict = Some(verdict.clone());
        }
        if is_without_effect && !self.is_due(now, &entries) {
            self.left_out = entries.into_iter().next_back();
            return;
        }
        if !is_without_effect {
            lines.extend(self.left_out.take().map(entry));
        }
        self.left_out = None;
        self.logged_at = Some(now);
        lines.extend(entries.into_iter().map(entry));
    }

    fn is_without_effect(&self, entries: &[Entry], state: &State) -> bool {
        let [Entry::Cycle { verdict, .. }] = entries else {
            return false;
        };
        verdict.output == Output::Brake
            && self.verdict.as_ref() == Some(verdict)
            && state.is_equal_except_times(&self.before)
    }

    fn is_due(&self, now: Stamp, entries: &[Entry]) -> bool {
        let is_at_rest =
            |entry: &Entry| matches!(entry, Entry::Cycle { arm, .. } if arm.is_at_rest);
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
    fn restart(&mut self, now: Stamp, steering: &Steering) {
        let mut lines = Vec::new();
        if self.n_missing > 0 {
            lines.push(Line::Missing(self.n_missing));
        }
        lines.push(self.start(now, steering, steering.state()));
        if self.writer.send(lines) {
            self.n_missing = 0;
            self.left_out = None;
        } else {
            // It is sent again as soon as there is room.
            self.n_missing = self.n_missing.max(1);
        }
    }

    fn start(&self, at: Stamp, steering: &Steering, state: State) -> Line {
        Line::Start(Box::new(Start {
            version: VERSION,
            program: format!(
                "fieldrig {} {}",
                env!("CARGO_PKG_VERSION"),
                std::env::consts::ARCH
            ),
            at,
            unix_millis: unix_millis(),
            world_from_base: transform::to_xyz_xyzw(&self.about.world_from_base),
            setup: steering.setup(self.about.urdf.clone()).with_state(state),
        }))
    }
}

impl Drop for LoopLog {
    fn drop(&mut self) {
        if self.has_begun {
            let mut lines: Vec<Line> = self.left_out.take().map(entry).into_iter().collect();
            lines.push(Line::End(Moment { at: self.latest }));
            self.send(lines, 0);
        }
    }
}

fn entry(entry: Entry) -> Line {
    Line::Entry(Box::new(entry))
}

fn is_request(entry: &Entry) -> bool {
    matches!(entry, Entry::Request { .. })
}

fn unix_millis() -> u64 {
    #[expect(clippy::disallowed_methods, reason = "only shown; no time is measured")]
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(since_epoch.as_millis()).unwrap_or(u64::MAX)
}
