//! Fiducial tags of the family tag36h11.

/// Codes of the first tags of the family. The index is the tag's id.
///
/// Source: Olson 2011. The codes are from the table `codedata` in `tag36h11.c` of
/// AprilRobotics/apriltag.
pub(crate) const CODES: [u64; 6] = [
    0xd_7e00_984b,
    0xd_da66_4ca7,
    0xd_c4a1_c821,
    0xe_17b4_70e9,
    0xe_f91d_01b1,
    0xf_429c_dd73,
];

/// Cells along a side, including the black border and the white margin around it.
pub const N_CELLS: usize = 10;

/// Column and row of each bit, most significant first, counted in the 8x8 cells inside the margin
/// (same source).
const BIT_X: [usize; 36] = [
    1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4, 6, 5, 4, 3, 2, 5, 4, 3, 4, 1, 1, 1, 1, 1,
    2, 2, 2, 3,
];
const BIT_Y: [usize; 36] = [
    1, 1, 1, 1, 1, 2, 2, 2, 3, 1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4, 6, 5, 4, 3, 2,
    5, 4, 3, 4,
];

/// Cells of the tag with an id below 6, as `[row][column]` from the top left. A value of true is
/// white.
///
/// # Panics
/// Panics if the id is 6 or more.
pub fn cells(id: usize) -> [[bool; N_CELLS]; N_CELLS] {
    let last = N_CELLS - 1;
    let mut cells = [[false; N_CELLS]; N_CELLS];
    for (row, line) in cells.iter_mut().enumerate() {
        for (column, cell) in line.iter_mut().enumerate() {
            *cell = row == 0 || column == 0 || row == last || column == last;
        }
    }
    for (bit, (x, y)) in BIT_X.into_iter().zip(BIT_Y).enumerate() {
        cells[y + 1][x + 1] = CODES[id] >> (35 - bit) & 1 == 1;
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tags_have_margin_border_and_hamming_distance_11() {
        for id in 0..CODES.len() {
            let cells = cells(id);
            assert!(cells[0].iter().all(|white| *white) && cells[9].iter().all(|white| *white));
            assert!(
                cells[1][1..9].iter().all(|white| !white)
                    && cells[8][1..9].iter().all(|white| !white)
            );
        }
        for (id, code) in CODES.iter().enumerate() {
            for other in &CODES[..id] {
                assert!((code ^ other).count_ones() >= 11);
            }
        }
    }
}
