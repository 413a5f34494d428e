//! Temporary folders for fuzz targets that read files.

use std::path::{Path, PathBuf};

/// A folder used by one thread, in memory if possible. It is deleted on drop.
pub(super) struct Scratch(pub(super) PathBuf);

impl Scratch {
    pub(super) fn new(name: &str) -> Self {
        let memory = Path::new("/dev/shm");
        let root = if memory.is_dir() {
            memory.to_owned()
        } else {
            std::env::temp_dir()
        };
        let thread = std::thread::current().id();
        let folder = root.join(format!("fieldrig-{name}-{}-{thread:?}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("creating a temporary folder");
        Self(folder)
    }

    pub(super) fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
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
