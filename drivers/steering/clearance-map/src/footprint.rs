//! Nearest and farthest readings in any rectangle of a depth image, from a pyramid of texels.
//!
//! A pyramid of minima is known from occlusion culling as a hierarchical z buffer (Greene, Kass and
//! Miller 1993). Here, it shows that a whole cube of voxels is in front of all surfaces.

use crate::grid::floor;
use crate::view::Projected;

/// The finest level has about as many columns as this. More would take longer; fewer would blur
/// the edges of objects over more voxels.
const MAX_COLUMNS: usize = 160;

/// Maximum number of texels per side that a query reads, minus one. A query of more texels uses a
/// coarser level.
const MAX_SPAN: usize = 3;

/// Readings of a rectangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Footprint {
    /// Smallest reading that is not the robot, meters; infinite if there is none.
    pub(crate) near_scene_m: f32,
    /// Smallest reading that is the robot, meters; infinite if there is none.
    pub(crate) near_robot_m: f32,
    /// Largest reading, meters; 0 if there is none.
    pub(crate) far_m: f32,
    /// Fraction of pixels with a reading.
    pub(crate) valid_frac: f32,
    /// Smallest such fraction of a texel of the finest level.
    pub(crate) min_valid_frac: f32,
}

impl Footprint {
    const EMPTY: Self = Self {
        near_scene_m: f32::INFINITY,
        near_robot_m: f32::INFINITY,
        far_m: 0.0,
        valid_frac: 0.0,
        min_valid_frac: 1.0,
    };

    /// Joins two rectangles, except for their fractions of pixels, which are summed.
    fn joined(self, other: &Self) -> Self {
        Self {
            near_scene_m: self.near_scene_m.min(other.near_scene_m),
            near_robot_m: self.near_robot_m.min(other.near_robot_m),
            far_m: self.far_m.max(other.far_m),
            valid_frac: self.valid_frac + other.valid_frac,
            min_valid_frac: self.min_valid_frac.min(other.min_valid_frac),
        }
    }
}

/// A pyramid over one image.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pyramid {
    /// Pixels per side of a texel of the finest level.
    stride_px: usize,
    levels: Vec<Level>,
}

#[derive(Clone, Debug, Default)]
struct Level {
    size: [usize; 2],
    texels: Vec<Footprint>,
}

impl Pyramid {
    /// An empty finest level for an image, to which [`Self::add`] adds readings.
    pub(crate) fn start(&mut self, size_px: [usize; 2]) {
        self.stride_px = size_px[0].div_ceil(MAX_COLUMNS);
        let size = size_px.map(|size| size.div_ceil(self.stride_px));
        self.levels.truncate(1);
        if self.levels.is_empty() {
            self.levels.push(Level::default());
        }
        let finest = &mut self.levels[0];
        finest.size = size;
        finest.texels.clear();
        finest.texels.resize(size[0] * size[1], Footprint::EMPTY);
    }

    /// Pixels per side of a texel of the finest level.
    pub(crate) fn stride_px(&self) -> usize {
        self.stride_px
    }

    /// The texels of the finest level over a row of pixels.
    pub(crate) fn texels_of_row(&mut self, row_px: usize) -> &mut [Footprint] {
        let finest = &mut self.levels[0];
        let first = row_px / self.stride_px * finest.size[0];
        &mut finest.texels[first..first + finest.size[0]]
    }

    /// Makes fractions from counts, and the coarser levels.
    pub(crate) fn finish(&mut self, size_px: [usize; 2]) {
        let stride = self.stride_px;
        let finest = &mut self.levels[0];
        let [columns, rows] = finest.size;
        let pixels_in = |texel: usize, axis: usize| stride.min(size_px[axis] - texel * stride);
        for row in 0..rows {
            for column in 0..columns {
                let n_pixels = (pixels_in(column, 0) * pixels_in(row, 1)) as f32;
                let texel = &mut finest.texels[row * columns + column];
                texel.valid_frac /= n_pixels;
                texel.min_valid_frac = texel.valid_frac;
            }
        }
        while self.levels[self.levels.len() - 1].size != [1, 1] {
            let coarser = self.levels[self.levels.len() - 1].coarser();
            self.levels.push(coarser);
        }
    }

    /// The readings over all points of a cube, and around them.
    pub(crate) fn over(&self, cube: &Projected) -> Footprint {
        let stride = self.stride_px as f32;
        let low = cube.low_px.map(|px| floor(px / stride));
        let high = cube.high_px.map(|px| floor(px / stride));
        let mut level_ix = 0;
        let span =
            |level_ix: usize, axis: usize| (high[axis] >> level_ix) - (low[axis] >> level_ix);
        while span(level_ix, 0) > MAX_SPAN || span(level_ix, 1) > MAX_SPAN {
            level_ix += 1;
        }
        let level = &self.levels[level_ix];
        let [low, high] = [low, high].map(|at| at.map(|texel| texel >> level_ix));
        let mut sum = Footprint::EMPTY;
        for row in low[1]..=high[1] {
            let first = row * level.size[0];
            for texel in &level.texels[first + low[0]..=first + high[0]] {
                sum = sum.joined(texel);
            }
        }
        let n_texels = (high[0] - low[0] + 1) * (high[1] - low[1] + 1);
        sum.valid_frac /= n_texels as f32;
        sum
    }
}

impl Level {
    fn coarser(&self) -> Self {
        let size = self.size.map(|size| size.div_ceil(2));
        let mut texels = Vec::with_capacity(size[0] * size[1]);
        for row in 0..size[1] {
            for column in 0..size[0] {
                texels.push(self.square(column, row));
            }
        }
        Self { size, texels }
    }

    /// A square of 2 by 2 texels; less at the right and lower edges.
    fn square(&self, column: usize, row: usize) -> Footprint {
        let mut sum = Footprint::EMPTY;
        let mut n_texels = 0;
        for row in 2 * row..(2 * row + 2).min(self.size[1]) {
            for column in 2 * column..(2 * column + 2).min(self.size[0]) {
                sum = sum.joined(&self.texels[row * self.size[0] + column]);
                n_texels += 1;
            }
        }
        sum.valid_frac /= n_texels as f32;
        sum
    }
}
