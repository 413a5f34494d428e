//! The side of the steering log that belongs to the loop of decisions: it never waits.
//!
//! The log begins with the first request. Cycles in which the arm must rest, and which change
//! nothing in the chain of decisions, have no effect on later decisions, so most of them are left
//! out.

use super::line::{Line, Moment, Start, VERSION, View};
use super::writer::LogWriter;
use drivers::base_motion::BaseOutput;
use drivers::motion::Output;
use kinematics::{Stamp, Transform, transform};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};
use steering::{Decision, Entry, State, Steering};

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
    /// Pose of the base of the arm, unless the base is steered.
    pub(in crate::steering) world_from_base: Transform,
}

/// Logs the decisions of one loop. Dropping this value completes the log.
pub(in crate::steering) struct LoopLog {
    about: About,
    writer: LogWriter,
    has_begun: bool,
    /// State of the chain after the last cycle.
    before: State,
    /// The last decision.
    decision: Option<Decision>,
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
            decision: None,
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
        let is_request = |entry: &Entry| matches!(entry, Entry::Request { .. });
        let state = steering.state();
        let before = std::mem::replace(&mut self.before, state);
        if !self.has_begun && entries.iter().any(is_request) {
            lines.push(self.start_line(now, steering, before));
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
        entries: Vec<Entry>,
        before: Option<&State>,
        lines: &mut Vec<Line>,
    ) {
        let is_without_effect =
            before.is_some_and(|before| self.is_without_effect(&entries, before));
        if let Some(decision) = entries.last().and_then(decision_of) {
            self.decision = Some(decision);
        }
        if is_without_effect && !self.is_due(now, &entries) {
            self.left_out = entries.into_iter().next_back();
            return;
        }
        if !is_without_effect {
            lines.extend(self.left_out.take().map(line));
        }
        self.left_out = None;
        self.logged_at = Some(now);
        lines.extend(entries.into_iter().map(line));
    }

    fn is_without_effect(&self, entries: &[Entry], before: &State) -> bool {
        let [entry] = entries else {
            return false;
        };
        decision_of(entry).is_some_and(|decision| {
            is_braking(&decision)
                && self.decision.as_ref() == Some(&decision)
                && self.before.is_equal_except_times(before)
        })
    }

    fn is_due(&self, now: Stamp, entries: &[Entry]) -> bool {
        let period_secs = if entries.iter().all(is_at_rest) {
            REST_PERIOD_SECS
        } else {
            MOVING_PERIOD_SECS
        };
        self.logged_at
            .is_none_or(|last| now.secs_since(last) >= period_secs)
    }

    /// The line with which a log can begin.
    ///
    /// * `state`: the state before the first entry.
    fn start_line(&self, at: Stamp, steering: &Steering, state: State) -> Line {
        Line::Start(Box::new(Start {
            version: VERSION,
            program: program(),
            at,
            unix_millis: unix_millis(),
            world_from_base: transform::to_xyz_xyzw(&self.about.world_from_base),
            setup: steering.setup(self.about.urdf.clone()).with_state(state),
        }))
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
        lines.push(self.start_line(now, steering, steering.state()));
        if self.writer.send(lines) {
            self.n_missing = 0;
            self.left_out = None;
        } else {
            // It is sent again as soon as there is room.
            self.n_missing = self.n_missing.max(1);
        }
    }
}

impl Drop for LoopLog {
    fn drop(&mut self) {
        if self.has_begun {
            let mut lines: Vec<Line> = self.left_out.take().map(line).into_iter().collect();
            lines.push(Line::End(Moment { at: self.latest }));
            self.send(lines, 0);
        }
    }
}

fn line(entry: Entry) -> Line {
    Line::Entry(Box::new(entry))
}

/// The decision of a cycle; `None` for a request.
fn decision_of(entry: &Entry) -> Option<Decision> {
    match entry {
        Entry::Request { .. } => None,
        Entry::Cycle { arm, base, .. } => Some(Decision {
            arm: arm.as_ref().map(|arm| arm.verdict.clone()),
            base: base.as_ref().map(|base| base.verdict.clone()),
        }),
    }
}

/// Whether the robot must be at rest.
fn is_braking(decision: &Decision) -> bool {
    let arm = decision.arm.as_ref();
    let base = decision.base.as_ref();
    arm.is_none_or(|it| it.output == Output::Brake)
        && base.is_none_or(|it| it.output == BaseOutput::Brake)
}

/// Whether the robot is at rest in a cycle.
fn is_at_rest(entry: &Entry) -> bool {
    match entry {
        Entry::Request { .. } => false,
        Entry::Cycle { arm, base, .. } => {
            let arm = arm.as_ref();
            let base = base.as_ref();
            arm.is_none_or(|it| it.state.is_at_rest)
                && base.is_none_or(|it| it.situation.base.is_at_rest)
        }
    }
}

/// Version and processor of the program.
fn program() -> String {
    format!(
        "fieldrig {} {}",
        env!("CARGO_PKG_VERSION"),
        std::env::consts::ARCH
    )
}

fn unix_millis() -> u64 {
    #[expect(clippy::disallowed_methods, reason = "only shown; no time is measured")]
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(since_epoch.as_millis()).unwrap_or(u64::MAX)
}
