//! A list of runs as a table of text.

use super::list::{self, KeptModel, KeptRun};
use crate::run_folder::utc_time;
use anyhow::Context;
use messages::counted;
use serde::Serialize;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The runs in a folder, to print them.
#[derive(Clone, Debug)]
pub struct RunList {
    folder: PathBuf,
    runs: Vec<KeptRun>,
}

/// A part of a list as JSON.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum RunListEvent<'a> {
    /// A run.
    Run(&'a KeptRun),
    /// All runs together.
    Total {
        /// Number of runs.
        runs: usize,
        /// Size of all files, bytes.
        bytes: u64,
    },
}

impl RunList {
    /// Reads the runs in a folder. A folder that does not exist has no runs, because the first run
    /// creates it.
    ///
    /// # Errors
    ///
    /// Fails if the folder cannot be read.
    pub fn read(folder: &Path) -> anyhow::Result<Self> {
        let runs = match list::list(folder) {
            Ok(runs) => runs,
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            Err(error) => {
                return Err(error).with_context(|| format!("cannot read {}", folder.display()));
            }
        };
        Ok(Self {
            folder: folder.to_owned(),
            runs,
        })
    }

    /// The runs from old to new, then their total.
    #[must_use]
    pub fn events(&self) -> Vec<RunListEvent<'_>> {
        let total = RunListEvent::Total {
            runs: self.runs.len(),
            bytes: self.bytes(),
        };
        let runs = self.runs.iter().map(RunListEvent::Run);
        runs.chain([total]).collect()
    }

    /// A table of the runs, then a line with their total.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let mut lines = table(&self.runs);
        lines.push(format!(
            "{} in {}, {}",
            counted(self.runs.len() as u64, "run"),
            self.folder.display(),
            size(self.bytes())
        ));
        lines
    }

    fn bytes(&self) -> u64 {
        self.runs.iter().map(|run| run.bytes).sum()
    }
}

/// The runs in columns, with a header if there are any.
fn table(runs: &[KeptRun]) -> Vec<String> {
    if runs.is_empty() {
        return Vec::new();
    }
    let header = [
        "NAME",
        "CHANGED (UTC)",
        "RIG OR DATA",
        "MODELS",
        "SIZE",
        "STATE",
    ];
    let mut rows = vec![header.map(str::to_owned)];
    rows.extend(runs.iter().map(row));
    let width = |column: usize| {
        let cells = rows.iter().map(|row| row[column].chars().count());
        cells.max().unwrap_or_default()
    };
    let widths: [usize; 6] = std::array::from_fn(width);
    rows.iter()
        .map(|row| {
            let cells = row.iter().zip(widths);
            let cells = cells.map(|(cell, width)| format!("{cell:width$}"));
            let line = cells.collect::<Vec<_>>().join("  ");
            line.trim_end().to_owned()
        })
        .collect()
}

fn row(run: &KeptRun) -> [String; 6] {
    let models: Vec<String> = run.models.iter().map(model).collect();
    [
        run.name.clone(),
        utc_time(Duration::from_secs(run.changed_unix_secs)),
        run.rig.clone().unwrap_or_else(|| "unknown".to_owned()),
        if models.is_empty() {
            "none".to_owned()
        } else {
            models.join(", ")
        },
        size(run.bytes),
        run.state.words().to_owned(),
    ]
}

fn model(model: &KeptModel) -> String {
    match model.psnr {
        Some(psnr) => format!("{} {psnr:.2} dB", model.method),
        None => format!("{} not scored", model.method),
    }
}

/// A size in units of 1000 bytes, as `ls` and disk vendors use them.
#[must_use]
pub fn size(bytes: u64) -> String {
    let mega = bytes as f64 / 1e6;
    if mega < 1000.0 {
        format!("{mega:.1} MB")
    } else {
        format!("{:.2} GB", mega / 1e3)
    }
}

#[cfg(test)]
mod tests {
    use super::super::list::RunState;
    use super::*;

    #[test]
    fn runs_are_shown_in_columns() {
        let run = |name: &str, models: Vec<KeptModel>, bytes| KeptRun {
            name: name.to_owned(),
            folder: name.into(),
            changed_unix_secs: 1_795_000_000,
            rig: None,
            models,
            bytes,
            state: RunState::Done,
        };
        let scored = KeptModel {
            method: "splat".to_owned(),
            psnr: Some(25.254),
        };
        let unscored = KeptModel {
            method: "tsdf".to_owned(),
            psnr: None,
        };
        let lines = table(&[
            run("a", vec![scored, unscored], 467_000_000),
            run("20261129-181500", vec![], 1_500_000_000),
        ]);
        assert_eq!(
            lines[1],
            "a                2026-11-18 11:06  unknown      splat 25.25 dB, tsdf not scored  467.0 MB  done"
        );
        assert!(
            lines[2].ends_with("unknown      none                             1.50 GB   done"),
            "{}",
            lines[2]
        );
        assert!(lines[0].starts_with("NAME             CHANGED (UTC)     RIG OR DATA  MODELS"));
        assert!(table(&[]).is_empty());
    }
}
