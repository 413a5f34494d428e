//! Errors of this crate.

use crate::config::ConfigError;
use keyframe::ErrorClass;
use std::error::Error as StdError;
use std::fmt::{Display, Formatter};

/// The result of a fallible operation of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a rig cannot be opened, read or joined.
///
/// [`Error::class`] tells apart invalid input, insufficient data and failures. The message of the error is its
/// outermost context; `{:#}` gives the message with all causes.
#[derive(Debug)]
#[non_exhaustive]
pub enum Error {
    /// The arguments, or a file they name, are invalid.
    BadInput(String),
    /// The input is not sufficient for a result.
    InsufficientData(String),
    /// Something failed.
    Failed(String),
    /// The rig file is invalid.
    Config(ConfigError),
    /// A list of keyframes, a selection of test images, or a keyframe is invalid.
    Keyframe(keyframe::Error),
    /// A device, recording or dataset failed.
    Driver(drivers::Error),
    /// A lens, pose or robot description is invalid.
    Kinematics(kinematics::Error),
    /// A file cannot be read or written.
    Io(std::io::Error),
    /// An error of another library.
    Other(Box<dyn StdError + Send + Sync>),
    /// The operation that failed, with the cause.
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

/// Writes the message; in the alternate form `{:#}`, followed by those of all causes.
impl Display for Error {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::BadInput(text) | Self::InsufficientData(text) | Self::Failed(text) => f.write_str(text),
            Self::Config(error) => write_chain(f, error),
            Self::Keyframe(error) => write_chain(f, error),
            Self::Driver(error) => write_chain(f, error),
            Self::Kinematics(error) => write_chain(f, error),
            Self::Io(error) => write_chain(f, error),
            Self::Other(error) => write_chain(f, error.as_ref()),
            Self::Context { context, source } if f.alternate() => write!(f, "{context}: {source:#}"),
            Self::Context { context, .. } => f.write_str(context),
        }
    }
}

fn write_chain(f: &mut Formatter<'_>, error: &(dyn StdError + 'static)) -> std::fmt::Result {
    write!(f, "{error}")?;
    let mut cause = error.source().filter(|_| f.alternate());
    while let Some(error) = cause {
        write!(f, ": {error}")?;
        cause = error.source();
    }
    Ok(())
}

impl StdError for Error {
    fn source(&self) -> Option<&(dyn StdError + 'static)> {
        match self {
            Self::BadInput(_) | Self::InsufficientData(_) | Self::Failed(_) => None,
            Self::Config(error) => error.source(),
            Self::Keyframe(error) => error.source(),
            Self::Driver(error) => error.source(),
            Self::Kinematics(error) => error.source(),
            Self::Io(error) => error.source(),
            Self::Other(error) => error.source(),
            Self::Context { source, .. } => Some(source.as_ref()),
        }
    }
}

impl From<ConfigError> for Error {
    fn from(error: ConfigError) -> Self {
        Self::Config(error)
    }
}

impl From<keyframe::Error> for Error {
    fn from(error: keyframe::Error) -> Self {
        Self::Keyframe(error)
    }
}

impl From<drivers::Error> for Error {
    fn from(error: drivers::Error) -> Self {
        Self::Driver(error)
    }
}

impl From<kinematics::Error> for Error {
    fn from(error: kinematics::Error) -> Self {
        Self::Kinematics(error)
    }
}

impl From<std::io::Error> for Error {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
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
        assert_eq!(format!("{error:#}"), "rig.toml: scale is 2");
        let missing = std::fs::read("no/such/file").with_context(|| "the list").expect_err("no file");
        assert_eq!(missing.class(), ErrorClass::Failed);
        assert!(format!("{missing:#}").starts_with("the list: "));
    }
}
