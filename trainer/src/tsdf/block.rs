//! Blocks of 8x8x8 voxels on the host, and the format of their words.
#![expect(
    clippy::cast_possible_truncation,
    reason = "words are split on purpose"
)]

use std::collections::BTreeMap;

/// Voxels along an edge of a block, as in Niessner et al. 2013. Larger blocks store more voxels far
/// from the surface. Smaller blocks need more entries in the table.
pub const BLOCK_EDGE: i32 = 8;
/// Number of voxels in a block.
pub const N_VOXELS: usize = 512;
/// Weight of one observation of a surface that faces the camera at a distance of 1 m. Weaker
/// observations have a fraction of this weight, in integer steps. Weights have 16 bits, so the
/// maximum of the option `max_weight` is 65535 / 256 = 255.
pub const WEIGHT_ONE: f64 = 256.0;

/// Coordinates relative to the field's anchor along the world's axes. For a block, the unit is
/// blocks. For a voxel, it is voxels.
pub type GridCoord = [i32; 3];

/// Blocks ordered by their coordinates.
pub type Blocks = BTreeMap<GridCoord, Block>;

/// The voxels of one block in the format of the GPU, x fastest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// One word per voxel. The low half is the signed distance as a fraction of the field's scale,
    /// times 32767. The high half is the weight in 256ths, which is 0 if the voxel was not
    /// observed.
    pub geometry: Vec<u32>,
    /// Two words per voxel with 16 bits per value, low half first. The first word has red and
    /// green. The second word has blue and the weight in 256ths. Colors are scaled by 65535.
    pub colors: Vec<[u32; 2]>,
}

impl Block {
    /// A block of voxels that were never observed.
    pub fn unobserved() -> Self {
        Self {
            geometry: vec![0; N_VOXELS],
            colors: vec![[0; 2]; N_VOXELS],
        }
    }

    /// Distance as a fraction of the field's scale. `None` if the voxel was not observed.
    pub fn distance(&self, voxel_ix: usize) -> Option<f64> {
        let word = self.geometry[voxel_ix];
        (word >> 16 != 0).then(|| stored_distance(word))
    }

    /// Color as sRGB from 0 to 1. `None` if the voxel has no color.
    pub fn color_srgb(&self, voxel_ix: usize) -> Option<[f64; 3]> {
        let [low, high] = self.colors[voxel_ix];
        (high >> 16 != 0)
            .then(|| [low & 0xffff, low >> 16, high & 0xffff].map(|part| f64::from(part) / 65535.0))
    }
}

/// Distance stored in a voxel's word, as a fraction of the field's scale.
pub fn stored_distance(word: u32) -> f64 {
    f64::from(word as u16 as i16) / 32767.0
}

/// Index of a voxel in its block's arrays.
pub fn voxel_ix(voxel: GridCoord) -> usize {
    let [x, y, z] = voxel.map(|along| along.rem_euclid(BLOCK_EDGE) as usize);
    z * 64 + y * 8 + x
}

/// The block that contains a voxel.
pub fn block_of(voxel: GridCoord) -> GridCoord {
    voxel.map(|along| along.div_euclid(BLOCK_EDGE))
}
