//! Errors of this crate.

use keyframe::{ErrorClass, define_context, impl_from, write_chain};
use std::error::Error as StdError;
use std::fmt::{Display, Formatter};

/// The result of a fallible operation of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Reason why a session cannot train, evaluate, save or resume.
///
/// [`Error::class`] distinguishes invalid input, insufficient data and failures. `{}` prints the
/// outermost context; `{:#}` also prints all causes.
#[derive(Debug)]
#[non_exhaustive]
pub enum Error {
    /// The arguments, or a file they name, are invalid.
    BadInput(String),
    /// There is not enough data for a result.
    InsufficientData(String),
    /// Something failed.
    Failed(String),
    /// The rig file is invalid, or a device or recording failed.
    Capture(capture::Error),
    /// A model cannot be created, trained, saved or loaded.
    Trainer(trainer::Error),
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
    /// The GPU failed and the run could not continue on another device. The message describes how
    /// to continue.
    GpuUnrecoverable(String),
    /// The operation that failed, with the cause.
    Context {
        /// The operation, or the file, device or image on which it failed.
        context: String,
        /// Why it failed.
        source: Box<Self>,
    },
}

impl Error {
    /// Whether the input is invalid, the data are insufficient, or the operation failed.
    #[must_use]
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::BadInput(_) | Self::Trainer(trainer::Error::BudgetTooSmall { .. }) => {
                ErrorClass::BadInput
            }
            Self::InsufficientData(_) => ErrorClass::InsufficientData,
            Self::Capture(error) => error.class(),
            Self::Keyframe(error) => error.class(),
            Self::Context { source, .. } => source.class(),
            Self::Failed(_)
            | Self::GpuUnrecoverable(_)
            | Self::Trainer(_)
            | Self::Driver(_)
            | Self::Kinematics(_)
            | Self::Io(_)
            | Self::Other(_) => ErrorClass::Failed,
        }
    }

    /// The error without its contexts.
    fn root(&self) -> &Self {
        match self {
            Self::Context { source, .. } => source.root(),
            _ => self,
        }
    }

    /// Whether the GPU caused the error: it was lost or out of memory.
    #[must_use]
    pub fn is_gpu_error(&self) -> bool {
        matches!(self.root(), Self::Trainer(error) if error.is_gpu_error())
    }

    /// Whether the GPU failed and could not be reopened.
    #[must_use]
    pub fn is_gpu_unrecoverable(&self) -> bool {
        matches!(self.root(), Self::GpuUnrecoverable(_))
    }

    /// Whether reading or writing a file failed, for example on a full disk.
    #[must_use]
    pub fn is_io(&self) -> bool {
        let mut cause: Option<&(dyn StdError + 'static)> = Some(self.root());
        while let Some(error) = cause {
            // `source` of a variant skips the wrapped error itself, so the variants that hold an
            // error of the system are matched here.
            let is_io = match error.downcast_ref() {
                Some(Self::Io(_)) => true,
                Some(Self::Trainer(error)) => error
                    .source()
                    .is_some_and(|source| source.is::<std::io::Error>()),
                _ => error.is::<std::io::Error>(),
            };
            if is_io {
                return true;
            }
            cause = error.source();
        }
        false
    }

    /// Adds the operation that failed.
    #[must_use]
    pub fn with_context(self, context: impl Into<String>) -> Self {
        Self::Context {
            context: context.into(),
            source: Box::new(self),
        }
    }
}

/// Writes the message. The alternate form `{:#}` appends the messages of all causes.
impl Display for Error {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::BadInput(text)
            | Self::InsufficientData(text)
            | Self::Failed(text)
            | Self::GpuUnrecoverable(text) => f.write_str(text),
            Self::Capture(error) => write_chain(f, error),
            Self::Trainer(error) => write_chain(f, error),
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
            Self::BadInput(_)
            | Self::InsufficientData(_)
            | Self::Failed(_)
            | Self::GpuUnrecoverable(_) => None,
            Self::Capture(error) => error.source(),
            Self::Trainer(error) => error.source(),
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
    Error: Capture(capture::Error), Capture(capture::ConfigError), Trainer(trainer::Error), Trainer(gpu::Error), Trainer(model_files::Error), Keyframe(keyframe::Error), Driver(drivers::Error), Kinematics(kinematics::Error), Io(std::io::Error), Other(image::ImageError), Other(anyhow::Error), Other(serde_json::Error),
);
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
