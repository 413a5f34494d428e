//! Specifications of targets such as `chessboard:9x6:25mm`, with their parser.

use crate::dictionary::Dictionary;
use crate::error::SpecError;
use std::fmt;
use std::str::FromStr;

/// Smallest and largest side of a square or tag, meters. For a side outside this range, the unit is
/// probably wrong.
const SIDE_M: [f64; 2] = [0.001, 2.0];
/// Largest number of columns or rows. It bounds the time and the memory of detection, and keeps
/// products of counts far below the range of `u32`.
const MAX_COUNT: u32 = 100;

/// A calibration target: its pattern and its dimensions.
///
/// Specifications are created by parsing text. Every specification describes a target that can be
/// printed and detected.
///
/// ```
/// use targets::TargetSpec;
///
/// let target: TargetSpec = "charuco:5x7:34mm:28mm:6X6_250".parse()?;
/// assert_eq!((target.n_corners(), target.to_string().as_str()), (24, "charuco:5x7:34mm:28mm:6X6_250"));
/// let error = "chessboard:9x6:25".parse::<TargetSpec>().unwrap_err();
/// assert!(error.to_string().contains("has no unit"));
/// # Ok::<(), targets::SpecError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct TargetSpec {
    pub(crate) pattern: Pattern,
}

/// The printed pattern. Lengths are in meters, and counts are columns and rows.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Pattern {
    /// Counts of inner corners.
    Chessboard { inner: [u32; 2], square_m: f64 },
    /// Counts of squares.
    Charuco {
        squares: [u32; 2],
        square_m: f64,
        marker_m: f64,
        dictionary: Dictionary,
    },
    /// Counts of tags.
    Aprilgrid {
        tags: [u32; 2],
        tag_m: f64,
        spacing_frac: f64,
    },
    /// `squares` contains the numbers of columns and rows. `origin` is the column and row of the
    /// first square in the master pattern.
    Puzzleboard {
        squares: [u32; 2],
        square_m: f64,
        origin: [u32; 2],
    },
    /// A tag of family tag36h11.
    Tag { id: u32, side_m: f64 },
}

impl TargetSpec {
    /// Name of the kind of target, for messages: "chessboard", "ChArUco board", "AprilGrid",
    /// "PuzzleBoard" or "tag".
    pub fn kind(&self) -> &'static str {
        match self.pattern {
            Pattern::Chessboard { .. } => "chessboard",
            Pattern::Charuco { .. } => "ChArUco board",
            Pattern::Aprilgrid { .. } => "AprilGrid",
            Pattern::Puzzleboard { .. } => "PuzzleBoard",
            Pattern::Tag { .. } => "tag",
        }
    }
}

impl FromStr for TargetSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let spec = text.trim();
        let parts: Vec<&str> = spec.split(':').collect();
        let reader = Reader {
            spec,
            parts: &parts,
        };
        let pattern = match parts[0].to_ascii_lowercase().as_str() {
            "chessboard" | "checkerboard" => reader.chessboard(),
            "charuco" => reader.charuco(),
            "aprilgrid" => reader.aprilgrid(),
            "puzzleboard" => reader.puzzleboard(),
            "tag" => reader.tag(),
            _ => Err(SpecError::UnknownKind {
                spec: spec.to_owned(),
                kind: parts[0].to_owned(),
            }),
        }?;
        Ok(Self { pattern })
    }
}

impl fmt::Display for TargetSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.pattern {
            Pattern::Chessboard {
                inner: [columns, rows],
                square_m,
            } => {
                write!(f, "chessboard:{columns}x{rows}:{}", Millimeters(*square_m))
            }
            Pattern::Charuco {
                squares: [columns, rows],
                square_m,
                marker_m,
                dictionary,
            } => {
                let square = Millimeters(*square_m);
                let marker = Millimeters(*marker_m);
                write!(
                    f,
                    "charuco:{columns}x{rows}:{square}:{marker}:{}",
                    dictionary.name()
                )
            }
            Pattern::Aprilgrid {
                tags: [columns, rows],
                tag_m,
                spacing_frac,
            } => {
                write!(
                    f,
                    "aprilgrid:{columns}x{rows}:{}:{spacing_frac}",
                    Millimeters(*tag_m)
                )
            }
            Pattern::Puzzleboard {
                squares: [columns, rows],
                square_m,
                origin,
            } => {
                write!(f, "puzzleboard:{columns}x{rows}:{}", Millimeters(*square_m))?;
                if *origin == [0, 0] {
                    Ok(())
                } else {
                    write!(f, ":{}x{}", origin[0], origin[1])
                }
            }
            Pattern::Tag { id, side_m } => write!(f, "tag:36h11:{id}:{}", Millimeters(*side_m)),
        }
    }
}

/// A length that is printed in millimeters. The text has no rounding errors of the conversion.
pub(crate) struct Millimeters(pub(crate) f64);

impl fmt::Display for Millimeters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The resolution is a picometer. A picometer is far above the rounding errors of the
        // conversion, and far below any length in use.
        const DIGITS: f64 = 1e9;
        write!(f, "{}mm", (self.0 * 1e3 * DIGITS).round() / DIGITS)
    }
}

struct Reader<'a> {
    spec: &'a str,
    parts: &'a [&'a str],
}

impl Reader<'_> {
    fn chessboard(&self) -> Result<Pattern, SpecError> {
        self.expect_parts(
            &[3],
            "chessboard:COLUMNSxROWS:SQUARE, such as chessboard:9x6:25mm (counts of inner corners)",
        )?;
        let inner = self.counts(
            1,
            ["columns of inner corners", "rows of inner corners"],
            [3, MAX_COUNT],
        )?;
        Ok(Pattern::Chessboard {
            inner,
            square_m: self.length(2, "square")?,
        })
    }

    fn charuco(&self) -> Result<Pattern, SpecError> {
        let form = "charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY, such as charuco:5x7:34mm:28mm:6X6_250 (counts of \
                    squares)";
        self.expect_parts(&[5], form)?;
        let squares = self.counts(1, ["columns of squares", "rows of squares"], [3, MAX_COUNT])?;
        let square_m = self.length(2, "square")?;
        let marker_m = self.length(3, "marker")?;
        if marker_m >= square_m {
            return Err(SpecError::MarkerTooLarge {
                spec: self.spec.to_owned(),
                marker_m,
                square_m,
            });
        }
        let dictionary = Dictionary::aruco(self.parts[4]).ok_or_else(|| SpecError::Dictionary {
            spec: self.spec.to_owned(),
            what: "ArUco dictionary",
            value: self.parts[4].to_owned(),
            expected: "4X4_50, 4X4_100, 4X4_250, 4X4_1000, or the same with 5X5, 6X6 or 7X7"
                .to_owned(),
        })?;
        // Every second square has a marker. If the number of squares is odd, there is one more
        // black square.
        let needed = squares[0] * squares[1] / 2;
        if needed > dictionary.n_markers() {
            return Err(self.too_small(
                needed,
                &dictionary,
                "a larger dictionary or fewer squares",
            ));
        }
        Ok(Pattern::Charuco {
            squares,
            square_m,
            marker_m,
            dictionary,
        })
    }

    fn aprilgrid(&self) -> Result<Pattern, SpecError> {
        let form = "aprilgrid:COLUMNSxROWS:TAG:SPACING, such as aprilgrid:6x6:88mm:0.3 (counts of tags, spacing as \
                    fraction of the tag's side)";
        self.expect_parts(&[4], form)?;
        let tags = self.counts(1, ["columns of tags", "rows of tags"], [1, MAX_COUNT])?;
        let tag_m = self.length(2, "tag")?;
        let spacing_frac: f64 = self.number(3, "spacing")?;
        if !(0.1..=1.0).contains(&spacing_frac) {
            return Err(SpecError::Spacing {
                spec: self.spec.to_owned(),
                found: spacing_frac,
            });
        }
        let dictionary = Dictionary::tag36h11();
        if tags[0] * tags[1] > dictionary.n_markers() {
            return Err(self.too_small(tags[0] * tags[1], &dictionary, "fewer tags"));
        }
        Ok(Pattern::Aprilgrid {
            tags,
            tag_m,
            spacing_frac,
        })
    }

    fn puzzleboard(&self) -> Result<Pattern, SpecError> {
        let form = "puzzleboard:COLUMNSxROWS:SQUARE, such as puzzleboard:12x9:20mm (counts of squares), optionally \
                    with the first COLUMNxROW in the master pattern, such as puzzleboard:12x9:20mm:100x50";
        self.expect_parts(&[3, 4], form)?;
        let squares = self.counts(1, ["columns of squares", "rows of squares"], [6, MAX_COUNT])?;
        let square_m = self.length(2, "square")?;
        // The origin is limited, so that the largest board lies within one period of the pattern.
        let origin = match self.parts.len() {
            3 => [0, 0],
            _ => self.counts(
                3,
                ["as first column", "as first row"],
                [0, crate::puzzle_code::PERIOD - MAX_COUNT],
            )?,
        };
        Ok(Pattern::Puzzleboard {
            squares,
            square_m,
            origin,
        })
    }

    fn tag(&self) -> Result<Pattern, SpecError> {
        self.expect_parts(
            &[4],
            "tag:FAMILY:ID:SIDE, such as tag:36h11:5:100mm (side of the black square)",
        )?;
        if !matches!(
            self.parts[1].to_ascii_lowercase().as_str(),
            "36h11" | "tag36h11"
        ) {
            return Err(SpecError::Dictionary {
                spec: self.spec.to_owned(),
                what: "tag family",
                value: self.parts[1].to_owned(),
                expected: "36h11".to_owned(),
            });
        }
        let id: u32 = self.number(2, "tag id")?;
        let max = Dictionary::tag36h11().n_markers() - 1;
        if id > max {
            return Err(SpecError::CountRange {
                spec: self.spec.to_owned(),
                what: "as tag id",
                found: id,
                min: 0,
                max,
            });
        }
        Ok(Pattern::Tag {
            id,
            side_m: self.length(3, "side")?,
        })
    }

    fn expect_parts(&self, expected: &[usize], form: &'static str) -> Result<(), SpecError> {
        if expected.contains(&self.parts.len()) {
            return Ok(());
        }
        let expected: Vec<String> = expected.iter().map(usize::to_string).collect();
        Err(SpecError::Parts {
            spec: self.spec.to_owned(),
            found: self.parts.len(),
            expected: expected.join(" or "),
            form,
        })
    }

    fn counts(
        &self,
        part: usize,
        what: [&'static str; 2],
        [min, max]: [u32; 2],
    ) -> Result<[u32; 2], SpecError> {
        let value = self.parts[part];
        let spec = || self.spec.to_owned();
        let counts = parse_counts(value).ok_or_else(|| SpecError::Counts {
            spec: spec(),
            value: value.to_owned(),
        })?;
        for (axis, what) in what.into_iter().enumerate() {
            let found = counts[axis];
            if !(min..=max).contains(&found) {
                return Err(SpecError::CountRange {
                    spec: spec(),
                    what,
                    found,
                    min,
                    max,
                });
            }
        }
        Ok(counts)
    }

    fn length(&self, part: usize, what: &'static str) -> Result<f64, SpecError> {
        let value = self.parts[part].trim();
        let lower = value.to_ascii_lowercase();
        let with_unit = |unit: &str, per_meter: f64| {
            Some((lower.strip_suffix(unit)?.trim().to_owned(), per_meter))
        };
        // Meters are tried last, because the other units also end with "m".
        let split = with_unit("mm", 1000.0)
            .or_else(|| with_unit("cm", 100.0))
            .or_else(|| with_unit("m", 1.0));
        let spec = || self.spec.to_owned();
        let (number, per_meter) = split.ok_or_else(|| SpecError::Unit {
            spec: spec(),
            what,
            value: value.to_owned(),
        })?;
        let number: f64 = number.parse().map_err(|_| SpecError::Number {
            spec: spec(),
            what,
            value: value.to_owned(),
        })?;
        let found_m = number / per_meter;
        let [min_m, max_m] = SIDE_M;
        if !(min_m..=max_m).contains(&found_m) {
            return Err(SpecError::Length {
                spec: spec(),
                what,
                found_m,
                min_m,
                max_m,
            });
        }
        Ok(found_m)
    }

    fn number<T: FromStr>(&self, part: usize, what: &'static str) -> Result<T, SpecError> {
        let value = self.parts[part].trim();
        let error = || SpecError::Number {
            spec: self.spec.to_owned(),
            what,
            value: value.to_owned(),
        };
        value.parse().map_err(|_| error())
    }

    fn too_small(&self, needed: u32, dictionary: &Dictionary, suggestion: &str) -> SpecError {
        SpecError::DictionaryTooSmall {
            spec: self.spec.to_owned(),
            dictionary: dictionary.name().to_owned(),
            needed,
            available: dictionary.n_markers(),
            suggestion: suggestion.to_owned(),
        }
    }
}

/// Parses counts such as `9x6`.
fn parse_counts(value: &str) -> Option<[u32; 2]> {
    let (columns, rows) = value.split_once(['x', 'X'])?;
    Some([
        columns.trim().parse::<u32>().ok()?,
        rows.trim().parse::<u32>().ok()?,
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn specifications_survive_a_round_trip() {
        for text in [
            "chessboard:9x6:25mm",
            "chessboard:11x9:20.2mm",
            "charuco:5x7:34mm:28mm:6X6_250",
            "charuco:9x6:40mm:35mm:4X4_1000",
            "aprilgrid:6x6:88mm:0.3",
            "puzzleboard:12x9:20mm",
            "puzzleboard:12x9:20mm:100x50",
            "tag:36h11:586:100mm",
        ] {
            let target: TargetSpec = text.parse().unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(target.to_string(), text);
        }
    }

    #[test]
    fn units_and_spellings_are_equivalent() {
        let target: TargetSpec = "chessboard:9x6:25mm".parse().unwrap();
        for same in [
            "chessboard:9x6:2.5cm",
            "Chessboard:9X6:0.025m",
            " checkerboard:9x6:25 mm ",
        ] {
            assert_eq!(same.parse::<TargetSpec>().unwrap(), target, "{same}");
        }
        let charuco: TargetSpec = "charuco:5x7:34mm:28mm:DICT_6X6_250".parse().unwrap();
        assert_eq!(charuco.to_string(), "charuco:5x7:34mm:28mm:6X6_250");
    }

    #[test]
    fn every_mistake_is_named() {
        for (text, expected) in [
            ("", "is not a kind of target"),
            ("circles:9x6:25mm", "is not a kind of target"),
            (
                "chessboard:9x6",
                "has 2 parts separated by colons, expected 3",
            ),
            ("chessboard:9x6:25", "square \"25\" has no unit"),
            ("chessboard:9x6:mm", "square \"mm\" is not a number"),
            ("chessboard:9x6:NaNmm", "square is NaN m"),
            (
                "chessboard:9x6:25m",
                "square is 25 m, expected 0.001 to 2 m; check the unit",
            ),
            ("chessboard:9x6:-25mm", "square is -0.025 m"),
            ("chessboard:9:25mm", "is not a count of columns and rows"),
            ("chessboard:9x-6:25mm", "is not a count of columns and rows"),
            (
                "chessboard:2x6:25mm",
                "2 columns of inner corners, expected 3 to 100",
            ),
            (
                "chessboard:9x4000000000:25mm",
                "4000000000 rows of inner corners",
            ),
            (
                "charuco:5x7:28mm:34mm:6X6_250",
                "is not smaller than the square",
            ),
            (
                "charuco:5x7:34mm:28mm:8X8_250",
                "unknown ArUco dictionary \"8X8_250\"",
            ),
            (
                "charuco:20x20:34mm:28mm:6X6_50",
                "has 200 markers, but 6X6_50 has only 50",
            ),
            ("aprilgrid:6x6:88mm:30", "spacing is 30"),
            ("aprilgrid:6x6:88mm:NaN", "spacing is NaN"),
            (
                "aprilgrid:6x6:88mm:26.4mm",
                "spacing \"26.4mm\" is not a number",
            ),
            (
                "aprilgrid:30x30:88mm:0.3",
                "has 900 markers, but tag36h11 has only 587",
            ),
            ("puzzleboard:3x9:20mm", "3 columns of squares, expected 6"),
            ("tag:16h5:5:100mm", "unknown tag family"),
            ("tag:36h11:587:100mm", "587 as tag id, expected 0 to 586"),
        ] {
            let message = text.parse::<TargetSpec>().expect_err(text).to_string();
            assert!(message.contains(expected), "{text}: {message}");
        }
    }
}
