//! Fuzz targets: each function here feeds arbitrary bytes to a reader and panics if the result is
//! inconsistent.
//!
//! Long fuzzing runs use the targets in the folder `fuzz`. The tests here replay its seeds, both
//! unchanged and corrupted at random. A seed is exactly the input of its function.
//!
//! The target of a device family is in the folder of that family. `input` reads values from the
//! bytes, and `scratch` provides folders for targets that read files.

mod dataset;
pub(crate) mod input;
mod messages;
mod pixels;
mod recording;
mod scratch;
mod seeds;
#[cfg(test)]
mod tests;

pub use self::messages::messages;
#[cfg(target_os = "linux")]
pub use crate::can::fuzz::frames;
#[cfg(target_os = "linux")]
pub use crate::franka::{emulated::fuzz::client, fuzz::states};
pub use crate::udp::fuzz::datagrams;
pub use dataset::{nerfstudio, tum};
pub use pixels::pixels;
pub use recording::recording;
pub use seeds::{Seed, generated_seeds};
