//! The result of the estimation of a time offset as JSON and as text.

use crate::matrix::{Matrix, matrix_lines, matrix_of};
use calibration::hand_eye::Refusal;
use calibration::time_offset::TimeOffset;
use messages::ErrorClass;
use serde::Serialize;

/// The result of the estimation of a time offset. It serializes as JSON.
#[derive(Debug, Default, Serialize)]
pub struct TimeOffsetDocument {
    /// Seconds to add to the clock of B to get the clock of A.
    offset_secs: Option<f64>,
    sigma_secs: Option<f64>,
    /// RMS difference of the orientations after alignment, degrees.
    residual_deg: Option<f64>,
    /// Rate of the clock of A relative to the clock of B, minus 1, in parts per million; null if it
    /// is not significant.
    drift_ppm: Option<f64>,
    drift_sigma_ppm: Option<f64>,
    /// Time on the clock of B at which `offset_secs` holds, if there is a drift.
    mid_secs: Option<f64>,
    /// Pose of the second body in the frame of the first, row by row.
    #[serde(skip_serializing_if = "Option::is_none")]
    a_from_b: Option<Matrix>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_mm: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_deg: Option<[f64; 3]>,
    /// Why the transform between the bodies was refused, if it was requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    hand_eye_refused: Option<String>,
    /// Why there is no result.
    refused: Option<String>,
}

impl TimeOffsetDocument {
    /// The result, or a refusal if the motion does not determine the offset.
    ///
    /// # Errors
    /// Returns all other errors of the estimation.
    pub fn of(result: anyhow::Result<TimeOffset>) -> anyhow::Result<Self> {
        match result {
            Ok(offset) => Ok(Self::of_offset(&offset)),
            Err(error) if session::class(&error) == ErrorClass::InsufficientData => Ok(Self {
                refused: Some(error.to_string()),
                ..Self::default()
            }),
            Err(error) => Err(error),
        }
    }

    fn of_offset(offset: &TimeOffset) -> Self {
        let bodies = offset
            .hand_eye
            .as_ref()
            .and_then(|bodies| bodies.as_ref().ok());
        let refusal = offset
            .hand_eye
            .as_ref()
            .and_then(|bodies| bodies.as_ref().err());
        Self {
            offset_secs: Some(offset.offset_secs),
            sigma_secs: Some(offset.sigma_secs),
            residual_deg: Some(offset.rms_deg),
            drift_ppm: offset.drift_ppm.map(|[drift, _]| drift),
            drift_sigma_ppm: offset.drift_ppm.map(|[_, sigma]| sigma),
            mid_secs: Some(offset.mid_secs),
            a_from_b: bodies.map(|bodies| matrix_of(&bodies.a_body_from_b_body)),
            sigma_mm: bodies.map(|bodies| bodies.sigma_mm),
            sigma_deg: bodies.map(|bodies| bodies.sigma_deg),
            hand_eye_refused: refusal.map(Refusal::to_string),
            refused: None,
        }
    }

    /// Why the offset or the requested transform was refused.
    pub fn refusal(&self) -> Option<&str> {
        self.refused.as_deref().or(self.hand_eye_refused.as_deref())
    }

    /// The result as text.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = Vec::new();
        let (Some(offset), Some(sigma)) = (self.offset_secs, self.sigma_secs) else {
            return lines;
        };
        lines.push(format!(
            "add {offset:.6} +- {sigma:.6} s to the clock of B to get that of A"
        ));
        if let Some(residual) = self.residual_deg {
            lines.push(format!(
                "residual: {residual:.3} degrees (RMS difference of the orientations after alignment)"
            ));
        }
        if let (Some(drift), Some(sigma)) = (self.drift_ppm, self.drift_sigma_ppm) {
            lines.push(format!("drift: {drift:.1} +- {sigma:.1} ppm"));
        }
        if let Some(matrix) = self.a_from_b {
            lines.push("a_from_b, row by row (meters):".to_owned());
            lines.extend(matrix_lines(&matrix));
        }
        lines
    }
}
