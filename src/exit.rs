//! Exit codes and the errors that lead to them.

use crate::print;
use capture::ConfigError;
use messages::ErrorClass;
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
        if self == Self::Done && print::has_lost_output() {
            Self::Loss
        } else {
            self
        }
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
    let has = |class| error.chain().any(|cause| class_of(cause) == Some(class));
    // A rejected argument counts more than its consequences, so the whole chain is searched for it
    // first.
    if has(ErrorClass::BadInput) {
        Exit::BadArguments
    } else if has(ErrorClass::InsufficientData) {
        Exit::InsufficientData
    } else {
        Exit::Failed
    }
}

/// The class of an error of this program or its libraries.
fn class_of(error: &(dyn std::error::Error + 'static)) -> Option<ErrorClass> {
    if error.is::<BadArgument>() || error.is::<ConfigError>() {
        return Some(ErrorClass::BadInput);
    }
    if error.is::<InsufficientData>() {
        return Some(ErrorClass::InsufficientData);
    }
    // The budget is an argument, so another one is a remedy.
    if let Some(trainer::Error::BudgetTooSmall { .. }) = error.downcast_ref() {
        return Some(ErrorClass::BadInput);
    }
    let of_session = || Some(error.downcast_ref::<session::Error>()?.class());
    let of_capture = || Some(error.downcast_ref::<capture::Error>()?.class());
    let of_keyframe = || Some(error.downcast_ref::<keyframe::Error>()?.class());
    let of_calibration = || Some(error.downcast_ref::<calibration::Error>()?.class());
    of_session()
        .or_else(of_capture)
        .or_else(of_keyframe)
        .or_else(of_calibration)
}

/// Whether a command was rejected because of bad arguments or insufficient data.
pub(crate) fn is_rejection(error: &anyhow::Error) -> bool {
    matches!(of(error), Exit::BadArguments | Exit::InsufficientData)
}

/// Logs each loss of data as a warning and returns the exit code.
pub(crate) fn from_losses(data_losses: &[String]) -> Exit {
    for loss in data_losses {
        log::warn!("data loss: {loss}");
    }
    if data_losses.is_empty() {
        Exit::Done
    } else {
        Exit::Loss
    }
}

/// Whether the reader of stdout closed the pipe, as `head` does. This ends a command whose result
/// is its output.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    // Other pipes, such as those of cameras, do not end a command in order.
    let is_pipe = |io: &std::io::Error| io.kind() == ErrorKind::BrokenPipe;
    error
        .downcast_ref::<crate::print::StdoutError>()
        .is_some_and(|error| is_pipe(&error.0))
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
        let budget = trainer::Error::BudgetTooSmall {
            model: "neural field",
            max_bytes: 1,
            min_bytes: 2,
        };
        assert_eq!(
            of(&anyhow::Error::new(budget).context("run")),
            Exit::BadArguments
        );
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
        assert!(!is_broken_pipe(
            &crate::print::StdoutError(ErrorKind::StorageFull.into()).into()
        ));
        let camera = Err::<(), _>(closed())
            .context("camera")
            .expect_err("closed");
        assert!(!is_broken_pipe(&camera));
    }
}
