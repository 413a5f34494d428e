//! Parts of messages that all crates share: classes of errors, counts and lists, names of settings,
//! words of commands, and escapes for terminals.
//!
//! ```
//! use messages::{BadInput, ErrorClass, counted, listed};
//!
//! assert_eq!(counted(2, "image"), "2 images");
//! assert_eq!(listed(&["ply", "spz"], "or"), "ply or spz");
//! assert_eq!(BadInput("scale is 2".into()).to_string(), "scale is 2");
//! assert_ne!(ErrorClass::BadInput, ErrorClass::Failed);
//! ```

mod counted;
mod error_class;
mod printable;
mod setting;
mod shell;
mod shortened;

pub use counted::{counted, listed};
pub use error_class::{BadInput, ErrorClass, InsufficientData};
pub use printable::printable;
pub use setting::Setting;
pub use shell::{EXAMPLE_TARGET, quoted_for_shell};
pub use shortened::shortened;
