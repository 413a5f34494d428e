//! Reads and writes the files of users, with the same guards everywhere.
//!
//! - Only regular files are read, of at most a given size. Opening a pipe may block forever, and a device may have no end.
//! - Whole files are written under a temporary name and then renamed, so that they are complete or absent. [`begin`] is the
//!   exception: it starts a growing log under its final name.
//! - Symbolic links are followed when reading, but neither the temporary nor the final name of an output is followed.
//! - A file or folder that stays in use for a whole run can be [`Kept`] open. [`Kept::place`] then reports whether it was
//!   removed or renamed, and [`Kept::restore`] restores a removed file.
//! - Of two programs that write the same file at the same time, the second gets an error, if the file system supports
//!   locks.

mod kept;
pub mod partial;
mod reading;
mod writing;

pub use kept::{Kept, Place};
pub use reading::{MAX_TEXT_BYTES, NO_LIMIT, open, read, read_text};
pub use writing::{begin, check_no_link, create, create_from, lock, replace, write};
