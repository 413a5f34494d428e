//! Reads and writes the files of users. All readers and writers have the same protections.
//!
//! - Only regular files are read, within a [`Budget`]. Opening a pipe may block forever, and a
//!   device may have no end.
//! - Whole files and folders are written under a [temporary name](partial::path_of) that no user
//!   would choose, and are then renamed. They are therefore complete or absent. Only [`begin`]
//!   starts a file, which is a growing log, under its final name.
//! - Symbolic links are followed when reading. When writing, a link that has the temporary or the
//!   final name of an output is not followed.
//! - A file or folder that stays in use for a whole run can be [`Kept`] open. [`Kept::place`] then
//!   reports whether it was removed or renamed, and [`Kept::restore`] restores a removed file.
//! - If two programs write the same file at the same time, the second program gets an error. This
//!   requires a file system that supports locks.

mod budget;
pub mod destination;
mod kept;
pub mod partial;
mod reading;
mod writing;

pub use budget::{Budget, OverBudget};
pub use kept::{Kept, Place};
pub use reading::{open, read, read_text};
pub use writing::{
    append, begin, check_no_link, create, create_folder, create_from, lock, replace, write,
};
