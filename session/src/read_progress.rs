//! Progress of reading and preparing images.

/// How many images were read or prepared so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadProgress {
    /// What is counted: `images`, `keyframes` or `depth images`.
    pub noun: &'static str,
    /// Number of finished ones.
    pub n_done: usize,
    /// Number of all; `None` if unknown.
    pub n_all: Option<usize>,
}

/// Receives the progress, possibly from several threads.
pub type OnReadProgress<'a> = &'a (dyn Fn(ReadProgress) + Sync);

/// Ignores the progress.
pub fn ignore_progress(_progress: ReadProgress) {}
