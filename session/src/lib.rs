//! Training sessions.

mod dataset_export;
mod error;
pub mod partial;

pub use dataset_export::{Written, write_nerfstudio};
pub use error::{Error, Result};
