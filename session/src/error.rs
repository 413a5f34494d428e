//! Classes and causes of errors. Errors of this crate have context from `anyhow`, so their causes
//! are in the error chain.

use capture::ConfigError;
use messages::{BadInput, ErrorClass, InsufficientData};
use std::error::Error;

/// The GPU failed and the run could not continue on another device. The message describes how to
/// continue.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct GpuUnrecoverable(pub(crate) String);

/// Whether the input is invalid, the data are insufficient, or an operation failed.
#[must_use]
pub fn class(error: &anyhow::Error) -> ErrorClass {
    // Invalid input has priority over its consequences, so the whole chain is searched for it
    // first.
    [ErrorClass::BadInput, ErrorClass::InsufficientData]
        .into_iter()
        .find(|class| error.chain().any(|cause| class_of(cause) == Some(*class)))
        .unwrap_or(ErrorClass::Failed)
}

/// Whether a run was rejected because of bad input or insufficient data.
pub(crate) fn is_rejection(error: &anyhow::Error) -> bool {
    matches!(
        class(error),
        ErrorClass::BadInput | ErrorClass::InsufficientData
    )
}

/// The class of one error of a chain; `None` if errors of its type have no class.
fn class_of(error: &(dyn Error + 'static)) -> Option<ErrorClass> {
    if error.is::<BadInput>() || error.is::<ConfigError>() {
        return Some(ErrorClass::BadInput);
    }
    if error.is::<InsufficientData>() {
        return Some(ErrorClass::InsufficientData);
    }
    // The user sets the budget as an argument, so a larger budget solves the problem.
    if let Some(trainer::Error::BudgetTooSmall { .. }) = error.downcast_ref() {
        return Some(ErrorClass::BadInput);
    }
    let of_keyframe = || Some(error.downcast_ref::<keyframe::Error>()?.class());
    let of_calibration = || Some(error.downcast_ref::<calibration::Error>()?.class());
    of_keyframe().or_else(of_calibration)
}

/// Whether the GPU caused the error: it was lost or out of memory.
#[must_use]
pub fn is_gpu_error(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        let of_trainer = || Some(cause.downcast_ref::<trainer::Error>()?.is_gpu_error());
        let of_gpu = || Some(cause.downcast_ref::<gpu::Error>()?.is_gpu_error());
        of_trainer().or_else(of_gpu).unwrap_or(false)
    })
}

/// Whether the GPU failed and could not be reopened.
#[must_use]
pub fn is_gpu_unrecoverable(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.is::<GpuUnrecoverable>())
}

/// Whether reading or writing a file failed, for example on a full disk.
pub(crate) fn is_io(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.is::<std::io::Error>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;

    #[test]
    fn context_keeps_the_class_and_the_causes() {
        let error = Err::<(), _>(BadInput("scale is 2".into()))
            .context("rig.toml")
            .expect_err("an error");
        assert_eq!(class(&error), ErrorClass::BadInput);
        assert_eq!(format!("{error:#}"), "rig.toml: scale is 2");
        let missing = std::fs::read("no/such/file")
            .with_context(|| "the list")
            .expect_err("no file");
        assert_eq!(class(&missing), ErrorClass::Failed);
        assert!(is_io(&missing) && !is_io(&error));
        let refused = anyhow::Error::new(InsufficientData("too few images".into()));
        assert_eq!(
            class(&refused.context("camera")),
            ErrorClass::InsufficientData
        );
        assert!(format!("{missing:#}").starts_with("the list: "));
    }

    #[test]
    fn too_small_a_budget_is_invalid_input() {
        let budget = trainer::Error::BudgetTooSmall {
            model: "neural field",
            max_bytes: 1,
            min_bytes: 2,
        };
        let error = anyhow::Error::new(budget).context("run");
        assert_eq!(class(&error), ErrorClass::BadInput);
        assert!(!is_gpu_error(&error));
    }

    #[test]
    fn gpu_errors_are_found_under_context() {
        let of_trainer = anyhow::Error::new(trainer::Error::Gpu(gpu::Error::DeviceLost));
        let of_gpu = anyhow::Error::new(gpu::Error::DeviceLost);
        for lost in [of_trainer, of_gpu] {
            let lost = lost.context("run");
            assert!(is_gpu_error(&lost) && !is_gpu_unrecoverable(&lost));
        }
        let ended = anyhow::Error::new(GpuUnrecoverable("resume it".into())).context("run");
        assert!(is_gpu_unrecoverable(&ended) && !is_gpu_error(&ended));
        assert_eq!(ended.root_cause().to_string(), "resume it");
    }
}
