//! Recordings from anyone.

use super::Scratch;
use crate::Source;
use crate::recording::Recording;

thread_local! {
    /// With one file, written anew each time.
    static FOLDER: Scratch = Scratch::new("recording");
}

/// A whole file. Reading it ends.
pub fn recording(bytes: &[u8]) {
    FOLDER.with(|folder| {
        let Ok(mut recording) = Recording::open(&folder.write("it.mcap", bytes)) else { return };
        // A message that cannot be read is told, and the next one may be asked for.
        for _ in 0..bytes.len() {
            if let Ok(None) = recording.next_sample() {
                return;
            }
        }
        panic!("more samples than bytes");
    });
}
