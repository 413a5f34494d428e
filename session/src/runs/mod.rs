//! The runs in a folder: lists, shows and removes them.

mod list;
mod own_files;
mod remove;
mod table;

pub use list::{KeptModel, KeptRun, RunState, list};
pub use remove::{OldRuns, Refused, RemovableRun, by_age, by_name};
pub use table::{RunList, RunListEvent, size};
