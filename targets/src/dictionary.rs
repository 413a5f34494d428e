//! Dictionaries of square markers: ArUco with the ids of OpenCV, and AprilTag's tag36h11.

use calib_targets_aruco::builtins::builtin_dictionary;
use std::sync::LazyLock;

/// Markers with their ids.
///
/// The codes come from the crate `calib-targets-aruco`. They equal the codes of OpenCV's
/// `DICT_4X4_50` to `DICT_7X7_1000` and `DICT_APRILTAG_36h11`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Dictionary {
    name: &'static str,
    /// Cells per side, without the border.
    n_bits: usize,
    /// One code per id. Its bits are the cells row by row, and the least significant bit is the top
    /// left cell. A bit of 1 is black.
    codes: &'static [u64],
    /// Wrong cells that are corrected.
    n_corrected: u32,
}

impl PartialEq for Dictionary {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

/// A decoded marker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Match {
    pub(crate) id: u32,
    /// Number of clockwise quarter turns, as seen in the image, that map the upright marker to the
    /// given cells.
    pub(crate) quarter_turns: usize,
    pub(crate) n_wrong: u32,
}

/// Names in OpenCV's order, without its prefix `DICT_`. Smaller dictionaries are the beginnings of
/// larger dictionaries.
const ARUCO: [&str; 16] = [
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
];
/// Maximum numbers of wrong cells that are corrected. The first number is for 4X4 markers, whose
/// codes are similar. The second number is for larger markers. With more corrections, more markers
/// are found in bad images, but also more false markers.
const CORRECTED: [u32; 2] = [0, 2];

impl Dictionary {
    /// Returns the dictionary with a name such as `6X6_250`. Upper and lower case are equivalent,
    /// and OpenCV's prefix `DICT_` is optional.
    pub(crate) fn aruco(name: &str) -> Option<Self> {
        let upper = name.trim().to_ascii_uppercase();
        let short = upper.strip_prefix("DICT_").unwrap_or(&upper);
        let known = ARUCO.into_iter().find(|known| *known == short)?;
        Self::builtin(known, &format!("DICT_{known}"))
    }

    /// The tags of family tag36h11.
    pub(crate) fn tag36h11() -> Self {
        static TAGS: LazyLock<Option<Dictionary>> =
            LazyLock::new(|| Dictionary::builtin("tag36h11", "DICT_APRILTAG_36h11"));
        TAGS.expect("the crate contains this dictionary")
    }

    /// All dictionaries. Smaller dictionaries come before larger dictionaries that contain them.
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        ARUCO
            .into_iter()
            .filter_map(Self::aruco)
            .chain([Self::tag36h11()])
    }

    fn builtin(name: &'static str, builtin: &str) -> Option<Self> {
        let dictionary = builtin_dictionary(builtin)?;
        let n_bits = dictionary.marker_size();
        Some(Self {
            name,
            n_bits,
            codes: dictionary.codes(),
            n_corrected: CORRECTED[usize::from(n_bits > 4)],
        })
    }

    /// Name without OpenCV's prefix.
    pub(crate) fn name(&self) -> &'static str {
        self.name
    }

    pub(crate) fn n_bits(&self) -> usize {
        self.n_bits
    }

    pub(crate) fn n_markers(&self) -> u32 {
        u32::try_from(self.codes.len()).unwrap_or(u32::MAX)
    }

    /// Whether a cell of a marker without its border is black.
    pub(crate) fn is_black(&self, id: u32, row: usize, column: usize) -> bool {
        // Specifications are checked to have no larger ids, so this is never reached.
        let code = self.codes.get(id as usize).copied().unwrap_or(0);
        code >> (row * self.n_bits + column) & 1 == 1
    }

    /// Finds the marker most similar to the cells (row by row, true is black). Returns `None` if
    /// more cells are wrong than can be corrected.
    pub(crate) fn decode(&self, cells: &[bool]) -> Option<Match> {
        self.decode_with(cells, self.n_corrected)
    }

    /// Like [`Dictionary::decode`] without correction.
    pub(crate) fn decode_exactly(&self, cells: &[bool]) -> Option<Match> {
        self.decode_with(cells, 0)
    }

    fn decode_with(&self, cells: &[bool], n_corrected: u32) -> Option<Match> {
        let n = self.n_bits;
        if cells.len() != n * n {
            return None;
        }
        // Cell of the upright marker, for each number of quarter turns by which the marker appears
        // rotated.
        let cell = |turns: usize, row: usize, column: usize| match turns {
            0 => cells[row * n + column],
            1 => cells[column * n + (n - 1 - row)],
            2 => cells[(n - 1 - row) * n + (n - 1 - column)],
            _ => cells[(n - 1 - column) * n + row],
        };
        let mut best: Option<Match> = None;
        for quarter_turns in 0..4 {
            let seen = (0..n * n).fold(0_u64, |code, at| {
                code | u64::from(cell(quarter_turns, at / n, at % n)) << at
            });
            for (id, code) in (0..).zip(self.codes) {
                // This is the Hamming distance. If several ids and rotations have the same
                // distance, the first of them is kept.
                let n_wrong = (seen ^ code).count_ones();
                if n_wrong <= n_corrected && best.is_none_or(|best| n_wrong < best.n_wrong) {
                    best = Some(Match {
                        id,
                        quarter_turns,
                        n_wrong,
                    });
                }
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(dictionary: &Dictionary, id: u32) -> Vec<String> {
        let n = dictionary.n_bits();
        let cell = |row, column| {
            if dictionary.is_black(id, row, column) {
                '#'
            } else {
                '.'
            }
        };
        (0..n)
            .map(|row| (0..n).map(|column| cell(row, column)).collect())
            .collect()
    }

    #[test]
    fn codes_match_opencv() {
        // The expected cells are from `cv2.aruco.generateImageMarker` in OpenCV 5.0, without the
        // border.
        assert_eq!(
            rows(&Dictionary::aruco("4X4_50").unwrap(), 1),
            ["####", "....", ".##.", ".#.#"]
        );
        assert_eq!(
            rows(&Dictionary::aruco("6X6_250").unwrap(), 0),
            ["###...", ".###..", "..#...", "#..###", "##.#.#", ".##..#"]
        );
        assert_eq!(
            rows(&Dictionary::tag36h11(), 0),
            ["##.###", "#..#.#", "###.#.", "###..#", ".#...#", ".#.#.."]
        );
    }

    #[test]
    fn names_are_accepted_in_any_case_and_others_are_not() {
        assert_eq!(Dictionary::aruco("dict_5x5_100").unwrap().name(), "5X5_100");
        for wrong in ["", "5X5", "3X3_50", "APRILTAG_36h11"] {
            assert!(Dictionary::aruco(wrong).is_none(), "{wrong}");
        }
        assert_eq!(Dictionary::all().count(), 17);
    }

    #[test]
    fn rotated_and_damaged_markers_are_decoded() {
        let dictionary = Dictionary::aruco("6X6_250").unwrap();
        let n = dictionary.n_bits();
        // The marker is rotated clockwise by a quarter turn, so its left column becomes the top
        // row.
        let mut cells: Vec<bool> = (0..n * n)
            .map(|at| dictionary.is_black(42, n - 1 - at % n, at / n))
            .collect();
        assert_eq!(
            dictionary.decode(&cells),
            Some(Match {
                id: 42,
                quarter_turns: 1,
                n_wrong: 0
            })
        );
        cells[7] = !cells[7];
        assert_eq!(
            dictionary.decode(&cells),
            Some(Match {
                id: 42,
                quarter_turns: 1,
                n_wrong: 1
            })
        );
        assert_eq!(dictionary.decode_exactly(&cells), None);
        assert_eq!(dictionary.decode(&cells[1..]), None);
        assert_eq!(dictionary.decode(&vec![true; n * n]), None);
    }
}
