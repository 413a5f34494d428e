//! The steering log of a run: requests of operators, inputs of the chain of decisions, and its
//! decisions, with stamps. Its replay repeats all decisions.
//!
//! The log is a gzip file of JSON lines (`docs/reference/files.md`). `loop_log.rs` and `writer.rs`
//! write it, `reader.rs` reads it, `replay.rs` repeats it, and `incidents.rs` extracts the
//! incidents for viewers.

mod incidents;
mod line;
#[cfg(test)]
mod log_tests;
mod loop_log;
mod place;
mod reader;
mod replay;
mod writer;

pub use incidents::{Incident, IncidentKind, Incidents, Sample, incidents};
pub(super) use loop_log::{About, LoopLog};
pub use place::files_of;
pub(crate) use place::{FILE, OLDER_FILE};
pub use replay::{Replayed, replay};
