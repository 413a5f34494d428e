//! Repeats the decisions of a steering log, and compares them in every bit.

use super::line::Line;
use super::reader::LogReader;
use anyhow::Context;
use kinematics::Stamp;
use messages::counted;
use serde::Serialize;
use std::path::{Path, PathBuf};
use steering::{Entry, Steering};

/// Results of a replay.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Replayed {
    /// Number of requests and cycles that were repeated.
    pub decisions: u64,
    /// Number of targets among the decisions.
    pub targets: u64,
    /// Number of entries that are missing, because the disk was too slow.
    pub missing: u64,
    /// Time from the beginning of the log to its last entry.
    pub seconds: f64,
    /// The program that wrote the log.
    pub program: String,
    /// Why the rest of the log cannot be read.
    pub damage: Option<String>,
    /// The first decision that differs.
    pub difference: Option<FirstDifference>,
}

/// A decision that differs from the log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FirstDifference {
    /// Time since the beginning of the log.
    pub seconds: f64,
    /// Decision of the replay.
    pub replayed: String,
    /// Decision in the log.
    pub recorded: String,
}

impl Replayed {
    /// Whether all decisions were the same.
    pub fn is_identical(&self) -> bool {
        self.difference.is_none()
    }

    /// The result in one sentence, without a period.
    pub fn sentence(&self) -> String {
        let decisions = counted(self.decisions, "decision");
        match &self.difference {
            None => format!(
                "replayed {decisions} of {:.1} s: all {} are the same bit for bit",
                self.seconds,
                counted(self.targets, "target")
            ),
            Some(first) => format!(
                "the replay differs {:.3} s after the beginning of the log, after {decisions}: it decided {}, \
                 but the log of {} says {}",
                first.seconds, first.replayed, self.program, first.recorded
            ),
        }
    }
}

/// Repeats all decisions of a log, up to the first one that differs.
///
/// * `files`: files of the log, the older one first.
///
/// # Errors
///
/// If a file is not a steering log, or its setup is damaged.
pub fn replay(files: &[PathBuf]) -> anyhow::Result<Replayed> {
    let mut replay = Replay::default();
    for file in files {
        replay.read(file)?;
        if replay.result.difference.is_some() {
            break;
        }
    }
    Ok(replay.result)
}

#[derive(Default)]
struct Replay {
    result: Replayed,
    began: Option<Stamp>,
    /// `None` before the first start, and after missing entries.
    chain: Option<Steering>,
}

impl Replay {
    fn read(&mut self, file: &Path) -> anyhow::Result<()> {
        let mut lines = LogReader::open(file)?;
        while let Some(line) = lines.next()? {
            self.take(line)
                .with_context(|| format!("cannot replay {}", file.display()))?;
            if self.result.difference.is_some() {
                return Ok(());
            }
        }
        self.result.damage = lines
            .damage()
            .map(|damage| format!("{}: {damage}", file.display()));
        Ok(())
    }

    fn take(&mut self, line: Line) -> anyhow::Result<()> {
        match line {
            Line::Start(start) => {
                self.began.get_or_insert(start.at);
                self.chain = Some(start.setup.build()?);
                self.result.program = start.program;
            }
            Line::Missing(n_entries) => {
                self.result.missing += n_entries;
                self.chain = None;
            }
            Line::Entry(entry) => self.repeat(&entry),
            Line::View(_) | Line::End(_) => {}
        }
        Ok(())
    }

    fn repeat(&mut self, entry: &Entry) {
        let Some(steering) = &mut self.chain else {
            return;
        };
        let began = self.began.unwrap_or_default();
        if let Err(difference) = steering.replay(entry) {
            self.result.difference = Some(FirstDifference {
                seconds: difference.at.secs_since(began),
                replayed: difference.replayed,
                recorded: difference.recorded,
            });
            return;
        }
        self.result.seconds = entry.at().secs_since(began);
        self.result.decisions += 1;
        self.result.targets += u64::from(entry.has_target());
    }
}
