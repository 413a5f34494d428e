//! Errors of calibrations that users can remedy, and the class of an error.

use capture::ConfigError;
use keyframe::ErrorClass;

/// The arguments, or a file that they name, are invalid.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct BadInput(pub String);

/// The input is not sufficient for a result.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct InsufficientData(pub String);

/// Whether a calibration was refused: the input is valid, but not sufficient for a result.
pub(crate) fn is_refusal(error: &anyhow::Error) -> bool {
    let has = |class| error.chain().any(|cause| class_of(cause) == Some(class));
    // A rejected argument counts more than its consequences.
    has(ErrorClass::InsufficientData) && !has(ErrorClass::BadInput)
}

/// The class of an error of this crate or of the crates that it calls.
fn class_of(error: &(dyn std::error::Error + 'static)) -> Option<ErrorClass> {
    if error.is::<BadInput>() || error.is::<ConfigError>() {
        return Some(ErrorClass::BadInput);
    }
    if error.is::<InsufficientData>() {
        return Some(ErrorClass::InsufficientData);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_found_below_contexts() {
        let refused = anyhow::Error::new(InsufficientData("too few images".into()));
        assert!(is_refusal(&refused.context("camera")));
        let rejected = anyhow::Error::new(BadInput("no such camera".into()));
        assert!(!is_refusal(&rejected));
        assert!(!is_refusal(&anyhow::anyhow!("disk full")));
        let session = session::Error::InsufficientData("too few images".into());
        assert!(is_refusal(&session.into()));
    }
}
