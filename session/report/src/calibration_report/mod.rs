//! Reports of calibrations. Each report is one page that works offline, with the result, its
//! uncertainty and the errors of all samples. If the calibration was refused, the page shows the
//! reason, and the data on which the refusal is based.

mod bars;
mod hand_eye;
mod image_map;
mod intrinsics;
pub mod page;
mod photo;
mod scatter;
mod time_offset;

pub use hand_eye::HandEyeReport;
pub use intrinsics::IntrinsicsReport;
pub use photo::{Photo, Photos};
pub use time_offset::TimeOffsetReport;

/// Heading of every report.
#[derive(Clone, Debug)]
pub struct Heading {
    /// The input, which is a folder or file.
    pub input: String,
    /// Date and time in UTC, for readers.
    pub utc: String,
    /// The command line, which is shown at the end.
    pub command: String,
    /// Why there is no result. `None` if there is one.
    pub refused: Option<String>,
    /// Problems that do not invalidate the result.
    pub warnings: Vec<String>,
}

/// A measurement that was not used.
#[derive(Clone, Debug, PartialEq)]
pub struct Unused {
    /// Name of the image or sample.
    pub name: String,
    /// Why it was not used.
    pub reason: String,
    /// Whether the file of the image could not be read. In that case, it is unknown whether the
    /// image shows the target.
    pub is_unreadable: bool,
}

/// Whether a text is a report.
pub fn is_report(text: &str) -> bool {
    text.contains(page::SUBTITLE)
}

/// A number with a fixed number of decimals. An unknown number is shown as a dash.
fn number(value: Option<f64>, digits: usize) -> String {
    match value.filter(|value| value.is_finite()) {
        Some(value) => format!("{value:.digits$}"),
        None => "–".to_owned(),
    }
}

/// A value with its standard deviation.
pub fn with_sigma(value: f64, sigma: f64, digits: usize) -> String {
    format!("{value:.digits$} ± {sigma:.digits$}")
}
