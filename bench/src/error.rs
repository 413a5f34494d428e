//! Shorthands for errors, which are those of `session`.

use crate::{Error, Result};

/// Adds the operation that failed to an error.
pub(crate) trait Context<T> {
    fn context(self, context: impl Into<String>) -> Result<T>;
    fn with_context<C: Into<String>>(self, context: impl FnOnce() -> C) -> Result<T>;
}

impl<T, E: Into<Error>> Context<T> for std::result::Result<T, E> {
    fn context(self, context: impl Into<String>) -> Result<T> {
        self.with_context(|| context)
    }

    fn with_context<C: Into<String>>(self, context: impl FnOnce() -> C) -> Result<T> {
        self.map_err(|error| error.into().with_context(context()))
    }
}

/// An [`Error::Failed`] with a formatted message.
macro_rules! failed {
    ($($message:tt)*) => { $crate::Error::Failed(format!($($message)*)) };
}
pub(crate) use failed;

/// Returns an [`Error::Failed`] with a formatted message unless the condition holds.
macro_rules! ensure {
    ($condition:expr, $($message:tt)*) => { if !$condition { return Err($crate::error::failed!($($message)*)) } };
}
pub(crate) use ensure;
