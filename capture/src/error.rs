//! Errors of this crate.

use crate::config::ConfigError;
use keyframe::ErrorClass;
use std::error::Error as StdError;

/// The result of a fallible operation of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a rig cannot be opened, read or joined.
///
/// [`Error::class`] tells apart invalid input, insufficient data and failures. The message of the error is its
/// outermost context; [`chain`] gives the message with all causes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The arguments, or a file they name, are invalid.
    #[error("{0}")]
    BadInput(String),
    /// The input is not sufficient for a result.
    #[error("{0}")]
    InsufficientData(String),
    /// Something failed.
    #[error("{0}")]
    Failed(String),
    /// The rig file is invalid.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A list of keyframes, a selection of test images, or a keyframe is invalid.
    #[error(transparent)]
    Keyframe(#[from] keyframe::Error),
    /// A device, recording or dataset failed.
    #[error(transparent)]
    Driver(#[from] drivers::Error),
    /// A lens, pose or robot description is invalid.
    #[error(transparent)]
    Kinematics(#[from] kinematics::Error),
    /// A file cannot be read or written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// An error of another library.
    #[error(transparent)]
    Other(Box<dyn StdError + Send + Sync>),
    /// The operation that failed, with the cause.
    #[error("{context}")]
    Context {
        /// What was being done, or the file, device or image concerned.
        context: String,
        /// Why it failed.
        source: Box<Self>,
    },
}

impl Error {
    /// What the error means for the caller.
    #[must_use]
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::BadInput(_) | Self::Config(_) => ErrorClass::BadInput,
            Self::InsufficientData(_) => ErrorClass::InsufficientData,
            Self::Keyframe(error) => error.class(),
            Self::Context { source, .. } => source.class(),
            Self::Failed(_) | Self::Driver(_) | Self::Kinematics(_) | Self::Io(_) | Self::Other(_) => {
                ErrorClass::Failed
            }
        }
    }

    /// An error of a library that is not part of this interface.
    pub(crate) fn other(error: impl StdError + Send + Sync + 'static) -> Self {
        Self::Other(Box::new(error))
    }
}

macro_rules! from_other {
    ($($error:ty),*) => { $(impl From<$error> for Error {
        fn from(error: $error) -> Self {
            Self::other(error)
        }
    })* };
}
from_other!(image::ImageError, std::str::Utf8Error, std::net::AddrParseError);
#[cfg(feature = "sim")]
from_other!(sim::Error);

/// The message of an error followed by those of its causes, separated by colons.
#[must_use]
pub fn chain(error: &(dyn StdError + 'static)) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

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
        self.map_err(|error| Error::Context { context: context().into(), source: Box::new(error.into()) })
    }
}

impl<T> Context<T> for Option<T> {
    fn context(self, context: impl Into<String>) -> Result<T> {
        self.ok_or_else(|| Error::Failed(context.into()))
    }

    fn with_context<C: Into<String>>(self, context: impl FnOnce() -> C) -> Result<T> {
        self.ok_or_else(|| Error::Failed(context().into()))
    }
}

/// Returns an [`Error::Failed`] with a formatted message.
macro_rules! bail {
    ($($message:tt)*) => { return Err($crate::Error::Failed(format!($($message)*))) };
}
pub(crate) use bail;

/// Returns an [`Error::Failed`] with a formatted message unless the condition holds.
macro_rules! ensure {
    ($condition:expr, $($message:tt)*) => { if !$condition { $crate::error::bail!($($message)*) } };
}
pub(crate) use ensure;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn context_keeps_the_class_and_the_causes() {
        let error = Err::<(), _>(Error::BadInput("scale is 2".into())).context("rig.toml").expect_err("an error");
        assert_eq!(error.class(), ErrorClass::BadInput);
        assert_eq!(chain(&error), "rig.toml: scale is 2");
        let missing = std::fs::read("no/such/file").with_context(|| "the list").expect_err("no file");
        assert_eq!(missing.class(), ErrorClass::Failed);
        assert!(chain(&missing).starts_with("the list: "));
    }
}
