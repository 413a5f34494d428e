//! Reads and writes the files of users, with the same guards everywhere.
//!
//! - Only regular files are read, of at most a given size. A pipe would wait forever, and a device has no end.
//! - Files are written under a temporary name and then renamed, so that they are complete or absent. Links are never
//!   followed: neither the temporary name nor the final one can lead to another place.
//! - If two programs write the same file, one of them gets an error, and the file of the other is kept.

pub mod partial;
mod reading;
mod writing;

pub use reading::{MAX_TEXT_BYTES, NO_LIMIT, open, read, read_text};
pub use writing::{begin, check_no_link, create, create_from, lock, replace, write};
