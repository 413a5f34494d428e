//! Fuzz target for recordings.

use super::scratch::Scratch;
use crate::Source;
use crate::recording::Recording;

thread_local! {
    /// Folder with one file, which is rewritten for each input.
    static FOLDER: Scratch = Scratch::new("recording");
}

/// Reads a complete file. Checks that reading terminates.
pub fn recording(bytes: &[u8]) {
    FOLDER.with(|folder| {
        let Ok(mut recording) = Recording::open(&folder.write("it.mcap", bytes)) else {
            return;
        };
        // After a message that cannot be read, the next one may be requested.
        for _ in 0..bytes.len() {
            if let Ok(None) = recording.next_sample() {
                return;
            }
        }
        panic!("more samples than bytes");
    });
}
