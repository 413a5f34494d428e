//! Errors: specifications, detection, printing.

use messages::Setting;
use std::fmt;

/// Forms of a target specification, for messages.
pub const FORMS: &str = "chessboard:9x6:25mm (inner corners, square), charuco:5x7:34mm:28mm:6X6_250 (squares, square, \
     marker, dictionary), aprilgrid:6x6:88mm:0.3 (tags, tag, spacing/tag), puzzleboard:12x9:20mm (squares, square) or \
     tag:36h11:5:100mm (family, id, side)";

/// A target specification that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SpecError {
    /// The part before the first colon names no kind of target.
    #[error("target {spec:?}: {kind:?} is not a kind of target; expected {FORMS}")]
    UnknownKind {
        /// The specification.
        spec: String,
        /// Its first part.
        kind: String,
    },
    /// The number of parts between colons is wrong.
    #[error("target {spec:?} has {found} parts separated by colons, expected {expected}: {form}")]
    Parts {
        /// The specification.
        spec: String,
        /// Number of parts found.
        found: usize,
        /// Number of parts expected.
        expected: String,
        /// Expected form.
        form: &'static str,
    },
    /// The counts are not two whole numbers.
    #[error(
        "target {spec:?}: {value:?} is not a count of columns and rows, expected two whole numbers such as 9x6"
    )]
    Counts {
        /// The specification.
        spec: String,
        /// The part.
        value: String,
    },
    /// A count is outside the range that can be detected.
    #[error("target {spec:?}: {found} {what}, expected {min} to {max}")]
    CountRange {
        /// The specification.
        spec: String,
        /// What is counted.
        what: &'static str,
        /// Count found.
        found: u32,
        /// Smallest count.
        min: u32,
        /// Largest count.
        max: u32,
    },
    /// A length has no unit, or its unit is unknown.
    #[error(
        "target {spec:?}: {what} {value:?} has no unit, expected a number with mm, cm or m, such as 25mm"
    )]
    Unit {
        /// The specification.
        spec: String,
        /// Which length.
        what: &'static str,
        /// The part.
        value: String,
    },
    /// A number cannot be parsed.
    #[error("target {spec:?}: {what} {value:?} is not a number")]
    Number {
        /// The specification.
        spec: String,
        /// Which number.
        what: &'static str,
        /// The part.
        value: String,
    },
    /// A length is outside the range of printed targets, usually because of a wrong unit.
    #[error(
        "target {spec:?}: {what} is {found_m} m, expected {min_m} to {max_m} m; check the unit (mm, cm or m)"
    )]
    Length {
        /// The specification.
        spec: String,
        /// Which length.
        what: &'static str,
        /// Length found, meters.
        found_m: f64,
        /// Smallest length, meters.
        min_m: f64,
        /// Largest length, meters.
        max_m: f64,
    },
    /// The marker does not fit into its square.
    #[error(
        "target {spec:?}: marker ({marker_m} m) is not smaller than the square ({square_m} m); \
         expected the square first, then the marker, as in charuco:5x7:34mm:28mm:6X6_250"
    )]
    MarkerTooLarge {
        /// The specification.
        spec: String,
        /// Side of the marker, meters.
        marker_m: f64,
        /// Side of the square, meters.
        square_m: f64,
    },
    /// The dictionary or tag family is unknown.
    #[error("target {spec:?}: unknown {what} {value:?}, expected {expected}")]
    Dictionary {
        /// The specification.
        spec: String,
        /// "ArUco dictionary" or "tag family".
        what: &'static str,
        /// The part.
        value: String,
        /// Names that are known.
        expected: String,
    },
    /// The target has more markers than the dictionary.
    #[error(
        "target {spec:?} has {needed} markers, but {dictionary} has only {available}; use {suggestion}"
    )]
    DictionaryTooSmall {
        /// The specification.
        spec: String,
        /// Name of the dictionary.
        dictionary: String,
        /// Markers on the target.
        needed: u32,
        /// Markers in the dictionary.
        available: u32,
        /// What to use instead.
        suggestion: String,
    },
    /// The spacing of an AprilGrid is not a plausible fraction.
    #[error(
        "target {spec:?}: spacing is {found}, expected a fraction of the tag's side from 0.1 to 1, such as 0.3"
    )]
    Spacing {
        /// The specification.
        spec: String,
        /// Value found.
        found: f64,
    },
}

/// Why a target was not detected in an image.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum NotDetected {
    /// The pixels do not match the size, or the image is too small.
    #[error(
        "the image has {n_bytes} bytes for {width}x{height} pixels, expected one byte per pixel and at least {min} pixels per side"
    )]
    Image {
        /// Number of bytes.
        n_bytes: usize,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Smallest side in pixels.
        min: u32,
    },
    /// Nothing like the target is in the image.
    #[error("no {target} found in the image; check that it is in view, in focus and evenly lit")]
    Nothing {
        /// What was searched for.
        target: &'static str,
    },
    /// A board of another size is in the image.
    #[error(
        "found a board with {found} inner corners, expected {expected}; check the counts of the target"
    )]
    OtherSize {
        /// Columns and rows found.
        found: Counts,
        /// Columns and rows of the target.
        expected: Counts,
    },
    /// The markers belong to a board with other counts.
    #[error(
        "the markers form a board of {found} {what} (or more rows), not {expected}; correct {}",
        Setting::Target
    )]
    OtherCounts {
        /// Columns of the board in the image, and the smallest number of rows that contains all its
        /// marker ids.
        found: Counts,
        /// Columns and rows of the target.
        expected: Counts,
        /// What is counted.
        what: &'static str,
    },
    /// The image shows a part of the board that cannot be identified.
    #[error(
        "only {found} of the {expected} inner corners found; move the camera until the whole board is in view"
    )]
    Partial {
        /// Columns and rows found.
        found: Counts,
        /// Columns and rows of the target.
        expected: Counts,
    },
    /// The markers belong to another dictionary.
    #[error(
        "found {n} markers of {found}, expected {expected}; specify {found} as the dictionary of the target"
    )]
    OtherDictionary {
        /// Dictionary of the markers in the image.
        found: String,
        /// Dictionary of the target.
        expected: String,
        /// Number of markers.
        n: usize,
    },
    /// The markers belong to the right dictionary, but their ids are not on this target.
    #[error("found markers with ids {found}, expected {expected}; this is another target")]
    OtherIds {
        /// Ids in the image.
        found: Ids,
        /// Ids on the target.
        expected: Ids,
    },
    /// The ids fit, but their arrangement does not.
    #[error(
        "the markers are arranged differently from the target; check the number of columns and rows (found ids {found})"
    )]
    OtherArrangement {
        /// Ids in the image.
        found: Ids,
    },
    /// Relative to the squares, the markers are larger or smaller than on the target.
    #[error(
        "the markers are about {:.2} times as wide as the squares, expected {:.2}; measure both on the print: if a square has {square}, a marker has about {marker}",
        found_frac,
        expected_frac
    )]
    MarkerSize {
        /// Side of a marker in the image relative to the side of a square.
        found_frac: f64,
        /// Side of a marker of the target relative to the side of a square.
        expected_frac: f64,
        /// Side of a square of the target.
        square: String,
        /// Side of a marker in the image if the squares have this size.
        marker: String,
    },
    /// The markers are mirrored.
    #[error("found {n} mirrored markers; the image is flipped or the target was printed mirrored")]
    Mirrored {
        /// Number of mirrored markers.
        n: usize,
    },
    /// Not enough corners to estimate a pose.
    #[error(
        "only {found} corners found, expected at least {min}; move closer or show more of the target"
    )]
    TooFewCorners {
        /// Corners found.
        found: usize,
        /// Smallest number.
        min: usize,
    },
    /// The code of a PuzzleBoard cannot be read.
    #[error(
        "found a board with {found} inner corners, but its code does not match the target ({wrong_percent} % of the bits differ); check the number of squares"
    )]
    Code {
        /// Columns and rows found.
        found: Counts,
        /// Wrong bits at the best position.
        wrong_percent: u32,
    },
}

/// Columns and rows, printed as `9x6`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counts {
    /// Number of columns.
    pub columns: u32,
    /// Number of rows.
    pub rows: u32,
}

impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.columns, self.rows)
    }
}

/// Marker ids in ascending order. Long lists are shortened when printed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ids(pub Vec<u32>);

impl fmt::Display for Ids {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let is_range = self.0.len() > 2 && self.0.windows(2).all(|pair| pair[1] == pair[0] + 1);
        if is_range {
            return write!(f, "{} to {}", self.0[0], self.0[self.0.len() - 1]);
        }
        const SHOWN: usize = 8;
        f.write_str(&messages::shortened(&self.0, SHOWN, ", "))
    }
}

/// A target that cannot be printed or drawn.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PrintError {
    /// The target does not fit the paper.
    #[error(
        "the target needs {need_mm:.0?} mm with margins, but {paper} has {paper_mm:.0?} mm; use {suggestion}"
    )]
    TooLarge {
        /// Width and height needed, millimeters.
        need_mm: [f64; 2],
        /// The paper.
        paper: String,
        /// Its size, millimeters.
        paper_mm: [f64; 2],
        /// A paper that fits.
        suggestion: String,
    },
    /// The paper size cannot be parsed.
    #[error(
        "unknown paper {value:?}, expected a4, a3, a2, a1, a0, letter or WIDTHxHEIGHTmm such as 600x400mm (50 to 5000 mm)"
    )]
    Paper {
        /// The value.
        value: String,
    },
    /// The resolution gives an empty or an enormous image.
    #[error("{px_per_m} px/m gives an image of {size_px:?} pixels, expected 1 to {max} per side")]
    Resolution {
        /// Resolution.
        px_per_m: f64,
        /// Size of the image.
        size_px: [f64; 2],
        /// Largest side.
        max: u32,
    },
}
