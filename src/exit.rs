//! Exit codes and the errors that lead to them.

use capture::config::ConfigError;
use crate::print;
use std::io::ErrorKind;
use std::process::ExitCode;

/// How a command ended. The discriminant is the exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Exit {
    /// Success.
    Done = 0,
    /// Something failed.
    Failed = 1,
    /// The arguments, or the rig file they name, are invalid.
    BadArguments = 2,
    /// Done, but some data is missing from the result.
    Loss = 3,
    /// Not done: the input is not sufficient for a result.
    InsufficientData = 4,
}

impl Exit {
    /// Turns success into a loss if some of the output could not be printed.
    pub(crate) fn or_output_loss(self) -> Self {
        if self == Self::Done && print::has_lost_output() { Self::Loss } else { self }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// A user error: invalid arguments, or an invalid rig file.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadArgument(pub(crate) String);

/// The input is not sufficient for a result.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct InsufficientData(pub(crate) String);

/// The exit code of an error.
pub(crate) fn of(error: &anyhow::Error) -> Exit {
    let is_small_budget = |cause: &(dyn std::error::Error + 'static)| {
        matches!(cause.downcast_ref(), Some(trainer::Error::BudgetTooSmall { .. }))
    };
    if error.chain().any(|cause| cause.is::<BadArgument>() || cause.is::<ConfigError>() || is_small_budget(cause)) {
        Exit::BadArguments
    } else if error.chain().any(|cause| cause.is::<InsufficientData>()) {
        Exit::InsufficientData
    } else {
        Exit::Failed
    }
}

/// Logs each loss of data as a warning and returns the exit code.
pub(crate) fn from_losses(data_losses: &[String]) -> Exit {
    for loss in data_losses {
        log::warn!("data loss: {loss}");
    }
    if data_losses.is_empty() { Exit::Done } else { Exit::Loss }
}

/// Whether reading or writing a file failed, for example on a full disk.
pub(crate) fn is_io(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.is::<std::io::Error>())
}

/// Whether the reader of our output closed the pipe, as `head` does. This ends a command whose result is its output.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let is_pipe = |io: &std::io::Error| io.kind() == ErrorKind::BrokenPipe;
    error.downcast_ref::<crate::print::StdoutError>().is_some_and(|error| is_pipe(&error.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;

    #[test]
    fn bad_argument_keeps_its_code_under_context() {
        let error = anyhow::Error::new(BadArgument("unknown key".into())).context("rig file");
        assert_eq!(of(&error), Exit::BadArguments);
        assert_eq!(of(&anyhow::anyhow!("disk full")), Exit::Failed);
        let budget = trainer::Error::BudgetTooSmall { model: "neural field", max_bytes: 1, min_bytes: 2 };
        assert_eq!(of(&anyhow::Error::new(budget).context("run")), Exit::BadArguments);
    }

    #[test]
    fn loss_sets_the_exit_code() {
        assert_eq!(from_losses(&[]), Exit::Done);
        assert_eq!(from_losses(&["1 image did not decode".into()]), Exit::Loss);
    }

    #[test]
    fn only_closed_stdout_is_not_an_error() {
        let closed = || std::io::Error::from(ErrorKind::BrokenPipe);
        assert!(is_broken_pipe(&crate::print::StdoutError(closed()).into()));
        assert!(!is_broken_pipe(&crate::print::StdoutError(ErrorKind::StorageFull.into()).into()));
        let camera = Err::<(), _>(closed()).context("camera").expect_err("closed");
        assert!(!is_broken_pipe(&camera));
    }
}
