//! Errors of this crate.

use crate::config::ConfigError;
use keyframe::{ErrorClass, define_context, impl_from, write_chain};
use std::error::Error as StdError;
use std::fmt::{Display, Formatter};

/// The result of a fallible operation of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error of opening or reading a rig, or of joining its samples.
///
/// [`Error::class`] distinguishes invalid input, insufficient data and failures. The message of the
/// error is its outermost context; `{:#}` gives the message with all causes.
#[derive(Debug)]
#[non_exhaustive]
pub enum Error {
    /// The arguments, or a file that they name, are invalid.
    BadInput(String),
    /// The input is not sufficient for a result.
    InsufficientData(String),
    /// An operation failed.
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
    /// An error from another library.
    Other(Box<dyn StdError + Send + Sync>),
    /// The operation that failed, with the cause.
    Context {
        /// The operation, or the file, device or image concerned.
        context: String,
        /// The cause.
        source: Box<Self>,
    },
}

impl Error {
    /// Class of the error, for the exit code.
    #[must_use]
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::BadInput(_) | Self::Config(_) => ErrorClass::BadInput,
            Self::InsufficientData(_) => ErrorClass::InsufficientData,
            Self::Keyframe(error) => error.class(),
            Self::Context { source, .. } => source.class(),
            Self::Failed(_)
            | Self::Driver(_)
            | Self::Kinematics(_)
            | Self::Io(_)
            | Self::Other(_) => ErrorClass::Failed,
        }
    }

    /// Wraps an error of a library that is not part of this interface.
    pub(crate) fn other(error: impl StdError + Send + Sync + 'static) -> Self {
        Self::Other(Box::new(error))
    }
}

/// Writes the message. The alternate form `{:#}` appends the messages of all causes.
impl Display for Error {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::BadInput(text) | Self::InsufficientData(text) | Self::Failed(text) => {
                f.write_str(text)
            }
            Self::Config(error) => write_chain(f, error),
            Self::Keyframe(error) => write_chain(f, error),
            Self::Driver(error) => write_chain(f, error),
            Self::Kinematics(error) => write_chain(f, error),
            Self::Io(error) => write_chain(f, error),
            Self::Other(error) => write_chain(f, error.as_ref()),
            Self::Context { context, source } if f.alternate() => {
                write!(f, "{context}: {source:#}")
            }
            Self::Context { context, .. } => f.write_str(context),
        }
    }
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

impl_from!(
    Error: Config(ConfigError), Keyframe(keyframe::Error), Driver(drivers::Error), Kinematics(kinematics::Error), Io(std::io::Error), Other(image::ImageError), Other(std::str::Utf8Error), Other(std::net::AddrParseError),
);
#[cfg(feature = "sim")]
impl_from!(Error: Other(sim::Error));
define_context!(Error);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn context_keeps_the_class_and_the_causes() {
        let error = Err::<(), _>(Error::BadInput("scale is 2".into()))
            .context("rig.toml")
            .expect_err("an error");
        assert_eq!(error.class(), ErrorClass::BadInput);
        assert_eq!(format!("{error:#}"), "rig.toml: scale is 2");
        let missing = std::fs::read("no/such/file")
            .with_context(|| "the list")
            .expect_err("no file");
        assert_eq!(missing.class(), ErrorClass::Failed);
        assert!(format!("{missing:#}").starts_with("the list: "));
    }
}
