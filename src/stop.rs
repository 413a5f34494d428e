//! Ctrl-C: the first asks for an orderly end, the second ends at once.

use anyhow::Context;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit code of a process ended by an interrupt, as shells tell it: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// Whether the person at the keyboard wants an end. Clones tell the same.
#[derive(Clone, Debug, Default)]
pub(crate) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Listens to Ctrl-C and to SIGTERM; at most once a process.
    pub(crate) fn on_ctrl_c() -> anyhow::Result<Self> {
        let stop = Self::default();
        let asked = stop.clone();
        ctrlc::set_handler(move || {
            if asked.0.swap(true, Ordering::Relaxed) {
                std::process::exit(INTERRUPTED);
            }
            log::info!("stopping and saving; Ctrl-C again ends at once");
        })
        .context("cannot listen to Ctrl-C")?;
        Ok(stop)
    }

    /// Asks for the end, as Ctrl-C does.
    pub(crate) fn ask(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether the end was asked for.
    pub(crate) fn asked(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
