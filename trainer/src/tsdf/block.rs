//! Blocks of 8x8x8 voxels on the host, and what their words mean.
#![expect(clippy::cast_possible_truncation, reason = "words are taken apart on purpose")]

use std::collections::BTreeMap;

/// Voxels along an edge of a block.
pub const BLOCK_EDGE: i32 = 8;
/// Voxels of a block.
pub const N_VOXELS: usize = 512;
/// Weight of one look from 1 m at a surface that faces the camera.
pub const WEIGHT_ONE: f64 = 256.0;

/// Place of a block in blocks, or of a voxel in voxels, from the field's anchor along the world's axes.
pub type GridCoord = [i32; 3];

/// Blocks in order of their places.
pub type Blocks = BTreeMap<GridCoord, Block>;

/// The voxels of one block as the GPU has them, x fastest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// Low half: distance as a share of the field's scale, signed, of 32767; high half: weight in 256ths, 0 where unseen.
    pub geometry: Vec<u32>,
    /// Red, green; blue and weight: 16 bits each, of 65535.
    pub colors: Vec<[u32; 2]>,
}

impl Block {
    /// Voxels that nobody has seen.
    pub fn unobserved() -> Self {
        Self { geometry: vec![0; N_VOXELS], colors: vec![[0; 2]; N_VOXELS] }
    }

    /// Whether anything was seen of it.
    pub fn is_observed(&self) -> bool {
        self.geometry.iter().any(|word| word >> 16 != 0)
    }

    /// Distance as a share of the field's scale; `None` where the voxel was not seen.
    pub fn distance(&self, voxel_ix: usize) -> Option<f64> {
        let word = self.geometry[voxel_ix];
        (word >> 16 != 0).then(|| stored_distance(word))
    }

    /// Color, sRGB 0 to 1; `None` where the voxel has none.
    pub fn color_srgb(&self, voxel_ix: usize) -> Option<[f64; 3]> {
        let [low, high] = self.colors[voxel_ix];
        (high >> 16 != 0).then(|| [low & 0xffff, low >> 16, high & 0xffff].map(|part| f64::from(part) / 65535.0))
    }
}

/// Distance that a voxel's word stands for, as a share of the field's scale.
pub fn stored_distance(word: u32) -> f64 {
    f64::from(word as u16 as i16) / 32767.0
}

/// Place of a voxel within its block's arrays.
pub fn voxel_ix(voxel: GridCoord) -> usize {
    let [x, y, z] = voxel.map(|along| along.rem_euclid(BLOCK_EDGE) as usize);
    z * 64 + y * 8 + x
}

/// The block of a voxel.
pub fn block_of(voxel: GridCoord) -> GridCoord {
    voxel.map(|along| along.div_euclid(BLOCK_EDGE))
}
