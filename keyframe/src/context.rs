//! Context of errors: the operation that failed. Macros for the error types of other crates.

use std::error::Error;
use std::fmt::Formatter;

/// Writes the message of an error. The alternate form `{:#}` appends the messages of its causes.
///
/// # Errors
///
/// If the formatter fails.
pub fn write_chain(f: &mut Formatter<'_>, error: &(dyn Error + 'static)) -> std::fmt::Result {
    write!(f, "{error}")?;
    let mut cause = error.source().filter(|_| f.alternate());
    while let Some(error) = cause {
        write!(f, ": {error}")?;
        cause = error.source();
    }
    Ok(())
}

/// Implements conversions from errors of other types to the variants that hold them.
#[macro_export]
macro_rules! impl_from {
    ($error:ident: $($variant:ident($source:ty)),* $(,)?) => { $(
        impl From<$source> for $error {
            fn from(error: $source) -> Self {
                Self::$variant(error.into())
            }
        }
    )* };
}

/// Defines the trait `Context`, which adds the failed operation to an error. The error type of the
/// calling crate needs the variants `Context { context: String, source: Box<Self> }` and
/// `Failed(String)`.
#[macro_export]
macro_rules! define_context {
    ($error:ident) => {
        /// Adds the failed operation to an error.
        pub trait Context<T>: Sized {
            /// Adds a context that is computed only after a failure.
            ///
            /// # Errors
            ///
            /// The error with its context; a missing value is a failure with the context as its
            /// message.
            fn with_context<C: Into<String>>(
                self,
                context: impl FnOnce() -> C,
            ) -> std::result::Result<T, $error>;

            /// Adds a context.
            ///
            /// # Errors
            ///
            /// As for [`Self::with_context`].
            fn context(self, context: impl Into<String>) -> std::result::Result<T, $error> {
                self.with_context(|| context)
            }
        }

        impl<T, E: Into<$error>> Context<T> for std::result::Result<T, E> {
            fn with_context<C: Into<String>>(
                self,
                context: impl FnOnce() -> C,
            ) -> std::result::Result<T, $error> {
                self.map_err(|error| $error::Context {
                    context: context().into(),
                    source: Box::new(error.into()),
                })
            }
        }

        impl<T> Context<T> for Option<T> {
            fn with_context<C: Into<String>>(
                self,
                context: impl FnOnce() -> C,
            ) -> std::result::Result<T, $error> {
                self.ok_or_else(|| $error::Failed(context().into()))
            }
        }
    };
}

/// Creates the error `Failed` of the calling crate, with a formatted message.
#[macro_export]
#[expect(
    clippy::crate_in_macro_def,
    reason = "the error type is that of the calling crate"
)]
macro_rules! failed {
    ($($message:tt)*) => { crate::Error::Failed(format!($($message)*)) };
}

/// Returns the error `Failed` of the calling crate, with a formatted message.
#[macro_export]
macro_rules! bail {
    ($($message:tt)*) => { return Err($crate::failed!($($message)*)) };
}

/// Returns the error `Failed` of the calling crate unless the condition holds.
#[macro_export]
macro_rules! ensure {
    ($condition:expr, $($message:tt)*) => {
        if $condition {
        } else {
            $crate::bail!($($message)*)
        }
    };
}
