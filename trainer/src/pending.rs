//! Data that is being read from the GPU or encoded.

use crate::Error;
use model_files::checkpoint::Checkpoint;
use std::fmt::{Debug, Formatter};

/// A result that another thread can wait for.
pub struct Pending<T>(Box<dyn FnOnce() -> Result<T, Error> + Send>);

/// Training state that is being read back from the GPU. Training may continue during this time.
pub type PendingCheckpoint = Pending<Checkpoint>;

impl<T> Pending<T> {
    /// Wraps a function that waits for the result.
    pub fn new(finish: impl FnOnce() -> Result<T, Error> + Send + 'static) -> Self {
        Self(Box::new(finish))
    }

    /// Waits for the result, on any thread. Encoding takes CPU time.
    ///
    /// # Errors
    ///
    /// Fails if the GPU failed.
    pub fn finish(self) -> Result<T, Error> {
        (self.0)()
    }
}

impl<T> Debug for Pending<T> {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Pending")
    }
}
