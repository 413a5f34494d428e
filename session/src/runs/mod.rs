//! The runs in a folder: lists and removes them.

mod list;
mod own_files;
mod remove;

pub use list::{KeptModel, KeptRun, RunState, list};
pub use remove::{OldRuns, Refused, RemovableRun, by_age, by_name};
