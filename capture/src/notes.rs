//! Notes about the devices of a run, for the people who watch it.

use parking_lot::Mutex;
use std::sync::Arc;

/// Notes that are added while a run is in progress. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct Notes(Arc<Mutex<Vec<String>>>);

impl Notes {
    /// Adds a note.
    pub fn add(&self, note: String) {
        self.0.lock().push(note);
    }

    /// All notes so far.
    #[must_use]
    pub fn list(&self) -> Vec<String> {
        self.0.lock().clone()
    }
}
