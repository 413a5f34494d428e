//! Code that the tests of several crates share. Only tests depend on this crate.
//!
//! - [`data_folder`] finds real data, [`skip`] reports a test that cannot run on this machine.
//! - [`documented_commands`] lists the commands in README and guides.
//! - [`Stalls`] measures when the machine could not run a test, so that deadlines of real protocols
//!   can exclude this time.
//! - `wire_difference` compares emulated samples with those that drivers received (feature
//!   `recordings`).
//! - `command_page` renders a reference page from a parser of command lines (feature
//!   `command-page`).
//! - `browser` drives headless Chromium, and `silhouette` compares robots in its screenshots
//!   (feature `browser`).
//!
//! ```
//! # fn test() {
//! let Some(folder) = test_support::data_folder("fox") else { return };
//! assert!(folder.is_dir());
//! # }
//! # test();
//! ```

#[cfg(feature = "browser")]
pub mod browser;
#[cfg(feature = "command-page")]
pub mod command_page;
mod data;
mod documented_commands;
#[cfg(feature = "browser")]
pub mod silhouette;
mod skip;
mod stalls;
#[cfg(feature = "recordings")]
pub mod wire_difference;

pub use data::data_folder;
pub use documented_commands::{DocumentedCommand, documented_commands};
pub use skip::{is_demanded, skip};
pub use stalls::{StalledTimes, Stalls};
