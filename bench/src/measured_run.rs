//! Runs that a bench starts and measures.

use crate::viewer::{Viewer, ViewerOptions};
use anyhow::Result;
use session::{RunInProgress, RunInput};
use std::path::PathBuf;
use viz::ServedPage;

/// A live run that a bench needs.
#[derive(Clone, Debug)]
pub struct RequestedRun {
    /// The rig file.
    pub rig_file: PathBuf,
    /// The devices, or a recording of them.
    pub input: RunInput,
    /// Length of the run from the first image, seconds.
    pub seconds: f64,
    /// Folder of the run. The bench removes it.
    pub out: PathBuf,
}

/// A run in progress, and the page that it serves.
pub struct MeasuredRun {
    /// The run.
    pub run: RunInProgress,
    /// Its page. The server stops when the page is dropped.
    pub page: ServedPage,
}

/// Starts a run. The caller of a bench provides this function, because it may add options to the
/// run, and shows its progress. The page must be at a free port of this computer, so that a bench
/// does not collide with another run.
pub type StartRun<'a> = &'a dyn Fn(&RequestedRun) -> Result<MeasuredRun>;

impl MeasuredRun {
    /// Connects viewers to the page.
    pub(crate) fn connect(&self, n_viewers: u64, options: ViewerOptions) -> Result<Vec<Viewer>> {
        let address = self.page.address();
        (0..n_viewers)
            .map(|_| Viewer::connect(address, options))
            .collect()
    }
}
