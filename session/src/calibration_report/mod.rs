//! Reports of calibrations: one page each that works offline, with the result, its uncertainty, the
//! errors of all samples and, if the calibration was refused, the reason and the data that it is
//! based on.

mod bars;
mod hand_eye;
mod image_map;
mod intrinsics;
mod page;
mod photo;
mod scatter;
mod scene;
mod time_offset;

pub use hand_eye::HandEyeReport;
pub use intrinsics::IntrinsicsReport;
pub use photo::{Photo, Photos};
pub use scene::SceneReport;
pub use time_offset::TimeOffsetReport;

use crate::run_folder;
use messages::{BadInput, Setting};
use std::path::Path;

/// Heading of every report.
#[derive(Clone, Debug)]
pub struct Heading {
    /// The input: a folder or file.
    pub input: String,
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
    /// Whether its file could not be read, so that nothing is known about the target.
    pub is_unreadable: bool,
}

/// Checks that a report can be written to this path.
///
/// # Errors
/// [`BadInput`] if it cannot.
pub fn check_target_file(file: &Path) -> anyhow::Result<()> {
    let folder = file
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let is_page = file
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("html"));
    if !folder.is_dir() || file.is_dir() || !is_page {
        return Err(BadInput(format!(
            "{} {}: must be a file with the extension .html in an existing folder",
            Setting::Report,
            file.display()
        ))
        .into());
    }
    // Reports are replaced, so that a command can be repeated. A mistyped name must not replace
    // another page.
    if is_other_file(file) {
        return Err(BadInput(format!(
            "{} {}: the file exists and is not a report of fieldrig; choose another name",
            Setting::Report,
            file.display()
        ))
        .into());
    }
    Ok(())
}

/// Whether a file exists that is neither empty nor a report.
fn is_other_file(file: &Path) -> bool {
    match files::read(file, files::Budget::TEXT) {
        Ok(bytes) => !bytes.is_empty() && !String::from_utf8_lossy(&bytes).contains(page::SUBTITLE),
        Err(_) => false,
    }
}

/// Writes a page atomically.
///
/// # Errors
/// If the file cannot be written.
pub fn write(file: &Path, html: &str) -> anyhow::Result<()> {
    run_folder::write_atomic(file, html)
}

/// A number with a fixed number of decimals; a dash if it is unknown.
fn number(value: Option<f64>, digits: usize) -> String {
    match value.filter(|value| value.is_finite()) {
        Some(value) => format!("{value:.digits$}"),
        None => "–".to_owned(),
    }
}

/// A value with its standard deviation.
fn with_sigma(value: f64, sigma: f64, digits: usize) -> String {
    format!("{value:.digits$} ± {sigma:.digits$}")
}
