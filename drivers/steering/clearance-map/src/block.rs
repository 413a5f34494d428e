//! The states of the voxels of a block, and when each was seen.

use crate::config::BLOCK_VOXELS;
use crate::grid::VOXELS_PER_BLOCK;

/// No voxel of a cell is free.
pub(crate) const NEVER: u32 = u32::MAX;

/// Cells per side of a block. A cell holds the time of its oldest free voxel.
pub(crate) const BLOCK_CELLS: usize = 2;

/// Voxels per side of a cell.
pub(crate) const CELL_VOXELS: usize = BLOCK_VOXELS / BLOCK_CELLS;

/// Evidence from one image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Evidence {
    /// Time of the image in the map's milliseconds.
    pub(crate) millis: u32,
    /// Whether the depth was measured.
    pub(crate) is_measured: bool,
}

/// A cube of voxels. The bit `8 * y + x` of the word `z` belongs to a voxel.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    free: [u64; BLOCK_VOXELS],
    occupied: [u64; BLOCK_VOXELS],
    /// Occupied according to measured depth.
    measured: [u64; BLOCK_VOXELS],
    /// Time of the image that set the state, or showed it again, in the map's milliseconds.
    millis: [u32; VOXELS_PER_BLOCK],
    /// Whether the state has changed since it was published.
    pub(crate) is_changed: bool,
}

/// State of a voxel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    Unknown,
    Free,
    Occupied,
}

impl Block {
    /// A block that was never seen.
    pub(crate) fn unknown() -> Box<Self> {
        Box::new(Self {
            free: [0; BLOCK_VOXELS],
            occupied: [0; BLOCK_VOXELS],
            measured: [0; BLOCK_VOXELS],
            millis: [0; VOXELS_PER_BLOCK],
            is_changed: true,
        })
    }

    pub(crate) fn state(&self, voxel: usize) -> State {
        let (word, bit) = place(voxel);
        if self.free[word] & bit != 0 {
            State::Free
        } else if self.occupied[word] & bit != 0 {
            State::Occupied
        } else {
            State::Unknown
        }
    }

    /// When the state of a voxel was seen.
    pub(crate) fn millis(&self, voxel: usize) -> u32 {
        self.millis[voxel]
    }

    /// Sets a voxel, unless it was seen later, or depth that is not measured contradicts measured
    /// depth.
    pub(crate) fn set(&mut self, voxel: usize, state: State, evidence: Evidence) {
        if self.millis[voxel] > evidence.millis {
            return;
        }
        let (word, bit) = place(voxel);
        if !evidence.is_measured && self.measured[word] & bit != 0 {
            return;
        }
        self.free[word] &= !bit;
        self.occupied[word] &= !bit;
        self.measured[word] &= !bit;
        match state {
            State::Unknown => {}
            State::Free => self.free[word] |= bit,
            State::Occupied => {
                self.occupied[word] |= bit;
                if evidence.is_measured {
                    self.measured[word] |= bit;
                }
            }
        }
        self.millis[voxel] = evidence.millis;
        self.is_changed = true;
    }

    /// Sets all voxels of a cube free that were not seen later.
    ///
    /// * `low`, `side`: lowest voxel and side of the cube.
    pub(crate) fn set_free(&mut self, low: [usize; 3], side: usize, evidence: Evidence) {
        let [x, y, z] = low;
        for z in z..z + side {
            for y in y..y + side {
                let first = (z * BLOCK_VOXELS + y) * BLOCK_VOXELS;
                let mut older = 0_u64;
                let row = &mut self.millis[first + x..first + x + side];
                let kept = if evidence.is_measured {
                    0
                } else {
                    self.measured[z] >> (BLOCK_VOXELS * y + x) & row_bits(side)
                };
                if kept == 0 && row.iter().all(|millis| *millis <= evidence.millis) {
                    // The usual case.
                    row.fill(evidence.millis);
                    older = row_bits(side);
                } else {
                    for (ix, millis) in row.iter_mut().enumerate() {
                        if *millis <= evidence.millis && kept >> ix & 1 == 0 {
                            *millis = evidence.millis;
                            older |= 1 << ix;
                        }
                    }
                }
                let bits = older << (BLOCK_VOXELS * y + x);
                self.free[z] |= bits;
                self.occupied[z] &= !bits;
                self.measured[z] &= !bits;
            }
        }
        self.is_changed = true;
    }

    /// Sets voxels of the row at (y, z) free that have a given state.
    ///
    /// * `bits`: the voxels; the lowest bit is at x = 0.
    pub(crate) fn set_row_free(
        &mut self,
        [y, z]: [usize; 2],
        bits: u8,
        before: State,
        evidence: Evidence,
    ) {
        let row = |words: &[u64; BLOCK_VOXELS]| words[z].to_le_bytes()[y];
        let (free, occupied) = (row(&self.free), row(&self.occupied));
        let of_state = match before {
            State::Unknown => !free & !occupied,
            State::Free => free,
            State::Occupied => occupied,
        };
        let mut left = bits & of_state;
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            let voxel = (z * BLOCK_VOXELS + y) * BLOCK_VOXELS + x;
            self.set(voxel, State::Free, evidence);
            left &= left - 1;
        }
    }

    /// Whether any voxel of a cube is free.
    pub(crate) fn has_free(&self, [x, y, z]: [usize; 3], side: usize) -> bool {
        let row = row_bits(side) << x;
        let layer = (y..y + side).fold(0, |layer, y| layer | row << (BLOCK_VOXELS * y));
        self.free[z..z + side].iter().any(|word| word & layer != 0)
    }

    /// The bits of the row of voxels at (y, z) that are not free; the lowest bit is at x = 0.
    pub(crate) fn blocked_row(&self, y: usize, z: usize) -> u8 {
        !self.free[z].to_le_bytes()[y]
    }

    /// The bits of the row of voxels at (y, z) in which a surface was seen.
    pub(crate) fn occupied_row(&self, y: usize, z: usize) -> u8 {
        self.occupied[z].to_le_bytes()[y]
    }

    /// Time of the oldest free voxel of a cell, or [`NEVER`].
    pub(crate) fn oldest_free(&self, [cell_x, cell_y, cell_z]: [usize; 3]) -> u32 {
        let mut oldest = NEVER;
        let range = |cell: usize| cell * CELL_VOXELS..(cell + 1) * CELL_VOXELS;
        for z in range(cell_z) {
            for y in range(cell_y) {
                let first = (z * BLOCK_VOXELS + y) * BLOCK_VOXELS + cell_x * CELL_VOXELS;
                let row = &self.millis[first..first + CELL_VOXELS];
                let free = self.free[z] >> (BLOCK_VOXELS * y + cell_x * CELL_VOXELS);
                for (ix, millis) in row.iter().enumerate() {
                    if free >> ix & 1 != 0 {
                        oldest = oldest.min(*millis);
                    }
                }
            }
        }
        oldest
    }
}

/// The bits of the first voxels of a row.
fn row_bits(n: usize) -> u64 {
    (1 << n) - 1
}

fn place(voxel: usize) -> (usize, u64) {
    const PER_WORD: usize = BLOCK_VOXELS * BLOCK_VOXELS;
    (voxel / PER_WORD, 1 << (voxel % PER_WORD))
}
