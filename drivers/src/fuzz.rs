//! Fuzz targets: each function here feeds arbitrary bytes to a reader and panics if the result is inconsistent.
//!
//! Long fuzzing runs use the targets in the folder `fuzz`. The tests here replay its seeds, both unchanged and
//! corrupted at random. A seed is exactly the input of its function.

mod dataset;
mod messages;
mod pixels;
mod recording;
#[cfg(test)]
mod tests;

#[cfg(target_os = "linux")]
pub use crate::can::fuzz::frames;
#[cfg(target_os = "linux")]
pub use crate::franka::{emulated::fuzz::client, fuzz::states};
pub use crate::udp::fuzz::datagrams;
pub use dataset::{nerfstudio, tum};
pub use messages::messages;
pub use pixels::pixels;
pub use recording::recording;

use std::path::{Path, PathBuf};

/// Removes the first bytes and returns them, padded with zeros if there are fewer.
pub(crate) fn take<const N: usize>(bytes: &mut &[u8]) -> [u8; N] {
    let (first, rest) = bytes.split_at(bytes.len().min(N));
    *bytes = rest;
    std::array::from_fn(|ix| first.get(ix).copied().unwrap_or(0))
}

/// A folder used by one thread, in memory if possible. It is deleted on drop.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let memory = Path::new("/dev/shm");
        let root = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        let thread = std::thread::current().id();
        let folder = root.join(format!("fieldrig-{name}-{}-{thread:?}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("creating a temporary folder");
        Self(folder)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, bytes).expect("writing a small temporary file");
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // Files that cannot be deleted are small.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Pseudorandom numbers: the upper half of Knuth's linear congruential generator.
#[cfg(test)]
pub(crate) struct Random(pub(crate) u64);

#[cfg(test)]
impl Random {
    /// A number in `0..bound`.
    pub(crate) fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(self.0 >> 32).expect("32 bits") % bound
    }

    /// A random byte.
    pub(crate) fn byte(&mut self) -> u8 {
        u8::try_from(self.below(256)).expect("below 256")
    }

    /// Shuffles the items.
    pub(crate) fn shuffle<T>(&mut self, items: &mut [T]) {
        for ix in (1..items.len()).rev() {
            items.swap(ix, self.below(ix + 1));
        }
    }
}
