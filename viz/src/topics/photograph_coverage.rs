//! What the photographs of a calibration target cover, for clients that draw it over the image.

use serde::Serialize;

/// The coverage of the photographs so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PhotographCoverage {
    /// Name of the camera.
    pub camera: String,
    /// Width and height of its images, pixels.
    pub size_px: [u32; 2],
    /// Number of columns and rows of equal cells of the image.
    pub cells: [usize; 2],
    /// Whether each cell contains corners of the target, row by row from the upper left.
    pub is_covered: Vec<bool>,
    /// Parts of the image that need corners, 3 rows of 3, from the upper left.
    pub parts: Vec<ImagePartCoverage>,
    /// Everything else that photographs must show.
    pub items: Vec<CoverageItem>,
}

/// A part of the image.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ImagePartCoverage {
    /// Whether enough of its cells are covered.
    pub is_covered: bool,
    /// Whether the target should be moved there next.
    pub is_next: bool,
}

/// Something that photographs must show, such as a tilt.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CoverageItem {
    /// One or two words for display, such as `left side away` or `near`.
    pub label: String,
    /// Number of photographs that show it; it may exceed the required number.
    pub n_done: usize,
    /// Required number.
    pub n_needed: usize,
    /// Whether it should be shown next.
    pub is_next: bool,
}
