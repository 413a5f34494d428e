//! Exit codes and the errors that lead to them.

use crate::print;
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
    /// Turns success into a loss if a part of the output could not be printed.
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

/// The exit code of an error.
pub(crate) fn of(error: &anyhow::Error) -> Exit {
    match session::class(error) {
        ErrorClass::BadInput => Exit::BadArguments,
        ErrorClass::InsufficientData => Exit::InsufficientData,
        ErrorClass::Failed => Exit::Failed,
    }
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

/// Whether the reader of stdout closed the pipe, as `head` does. A command whose result is its
/// output then ends.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    // A broken pipe other than stdout, such as the pipe of a camera, is an error.
    let is_pipe = |io: &std::io::Error| io.kind() == ErrorKind::BrokenPipe;
    error
        .downcast_ref::<crate::print::StdoutError>()
        .is_some_and(|error| is_pipe(&error.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;
    use messages::BadInput;

    #[test]
    fn bad_input_keeps_its_code_under_context() {
        let error = anyhow::Error::new(BadInput("unknown key".into())).context("rig file");
        assert_eq!(of(&error), Exit::BadArguments);
        assert_eq!(of(&anyhow::anyhow!("disk full")), Exit::Failed);
    }

    #[test]
    fn every_exit_code_is_documented() {
        let page = include_str!("cli_page/end.md");
        let program = <crate::cli::Cli as clap::CommandFactory>::command();
        let help = program.get_after_help().expect("a text").to_string();
        let exits = [
            Exit::Done,
            Exit::Failed,
            Exit::BadArguments,
            Exit::Loss,
            Exit::InsufficientData,
        ];
        // A panic has the code 101, and a second Ctrl-C the code 130.
        let codes = exits.map(|exit| (exit as u8).to_string());
        for code in codes.iter().map(String::as_str).chain(["101", "130"]) {
            assert!(page.contains(&format!("\n| {code} | ")), "{code}");
            assert!(help.contains(&format!(" {code} ")), "{code}: {help}");
        }
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
