//! What readers do with bytes from anyone: each function here lets them read, and panics where what they say cannot be.
//!
//! Long runs with bytes that a fuzzer finds are in the folder `fuzz`; its seeds, cut, doubled, reordered and at random, are
//! replayed by the tests here. A seed is what its function takes, nothing around it.

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

/// Takes the first bytes away; zeros stand for those that are not there.
pub(crate) fn take<const N: usize>(bytes: &mut &[u8]) -> [u8; N] {
    let (first, rest) = bytes.split_at(bytes.len().min(N));
    *bytes = rest;
    std::array::from_fn(|ix| first.get(ix).copied().unwrap_or(0))
}

/// A folder of this thread alone, in memory where there is such a place; it goes with the thread.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let memory = Path::new("/dev/shm");
        let root = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
        let thread = std::thread::current().id();
        let folder = root.join(format!("fieldrig-{name}-{}-{thread:?}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("room for small files");
        Self(folder)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, bytes).expect("room for small files");
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // What is left behind is small.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Random numbers from a seed: Knuth's linear congruence, upper half.
#[cfg(test)]
pub(crate) struct Random(pub(crate) u64);

#[cfg(test)]
impl Random {
    /// A number below another one.
    pub(crate) fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(self.0 >> 32).expect("32 bits") % bound
    }

    /// Any byte.
    pub(crate) fn byte(&mut self) -> u8 {
        u8::try_from(self.below(256)).expect("below 256")
    }

    /// Any order.
    pub(crate) fn shuffle<T>(&mut self, items: &mut [T]) {
        for ix in (1..items.len()).rev() {
            items.swap(ix, self.below(ix + 1));
        }
    }
}
