//! Code that the tests of several crates share. Only tests depend on this crate.
//!
//! - [`data_folder`] finds real data, [`skip`] reports a test that cannot run on this machine.
//! - [`Stalls`] measures when the machine could not run a test, so that deadlines of real protocols
//!   can exclude this time.
//! - `wire_difference` compares emulated samples with those that drivers received (feature
//!   `recordings`).
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
mod data;
#[cfg(feature = "browser")]
pub mod silhouette;
mod skip;
mod stalls;
#[cfg(feature = "recordings")]
pub mod wire_difference;

pub use data::data_folder;
pub use skip::{is_demanded, skip};
pub use stalls::{StalledTimes, Stalls};
