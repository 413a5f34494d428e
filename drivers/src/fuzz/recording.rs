//! Fuzz target for recordings.

use super::scratch::Scratch;
use crate::Source;
use crate::recording::{Recording, decompress_mesh};
use files::Budget;

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
        let budget = Budget {
            max_bytes: 1 << 20,
            ..Budget::MESH
        };
        for (_, compressed) in recording.mesh_files() {
            let n_bytes = decompress_mesh(compressed, budget).map_or(0, |mesh| mesh.len());
            assert!(n_bytes as u64 <= budget.max_bytes);
        }
        // After a message that cannot be read, the next one may be requested.
        for _ in 0..bytes.len() {
            if let Ok(None) = recording.next_sample() {
                return;
            }
        }
        panic!("more samples than bytes");
    });
}
