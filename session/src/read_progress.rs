//! Progress of reading and preparing images.

/// Number of images read or prepared so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadProgress {
    /// Noun for the items: `images`, `keyframes` or `depth images`.
    pub noun: &'static str,
    /// Number of finished items.
    pub n_done: usize,
    /// Total number of items; `None` if unknown.
    pub n_all: Option<usize>,
}

/// Callback for progress, possibly called from several threads.
pub type OnReadProgress<'a> = &'a (dyn Fn(ReadProgress) + Sync);

/// Ignores the progress.
pub fn ignore_progress(_progress: ReadProgress) {}
