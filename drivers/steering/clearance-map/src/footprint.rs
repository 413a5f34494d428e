//! Nearest and farthest readings in any rectangle of a depth image, from a pyramid of texels.
//!
//! A pyramid of minima is known from occlusion culling as a hierarchical z buffer (Greene, Kass and
//! Miller 1993). Here, it shows that a whole cube of voxels is in front of all surfaces.

use crate::grid::floor;
use crate::samples::{Sample, sample_px};
use crate::view::Projected;

/// Images with more columns than this have texels of four samples. More texels would take longer;
/// fewer would blur the edges of objects over more voxels.
const MAX_COLUMNS: usize = 160;

/// Texels per side that a query reads, minus one. A query of more texels uses a coarser level.
const MAX_SPAN: usize = 3;

/// Up to this level, the fraction of valid pixels is judged per texel; above, by the worst of these
/// texels. A texel of the level is about as large as a voxel at a distance of one meter.
const VALIDITY_LEVEL: usize = 2;

/// Readings of a rectangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Footprint {
    /// Minima of all values that are joined by a minimum, in one array, so that they are joined
    /// together: most of the time of an image is spent here.
    minima: [f32; 4],
    /// Fraction of pixels with a reading.
    valid_frac: f32,
}

const NEAR_SCENE: usize = 0;
const NEAR_ROBOT: usize = 1;
const MINUS_FAR: usize = 2;
const MIN_VALID: usize = 3;

impl Footprint {
    const EMPTY: Self = Self {
        minima: [f32::INFINITY, f32::INFINITY, 0.0, 1.0],
        valid_frac: 0.0,
    };

    /// Smallest reading that is not the robot, meters; infinite if there is none.
    pub(crate) fn near_scene_m(&self) -> f32 {
        self.minima[NEAR_SCENE]
    }

    /// Smallest reading that is the robot, meters; infinite if there is none.
    pub(crate) fn near_robot_m(&self) -> f32 {
        self.minima[NEAR_ROBOT]
    }

    /// Largest reading, meters; 0 if there is none.
    pub(crate) fn far_m(&self) -> f32 {
        -self.minima[MINUS_FAR]
    }

    /// Fraction of pixels with a reading.
    pub(crate) fn valid_frac(&self) -> f32 {
        self.valid_frac
    }

    /// Smallest fraction of pixels with a reading in any part of the size of a voxel.
    pub(crate) fn min_valid_frac(&self) -> f32 {
        self.minima[MIN_VALID]
    }

    /// Adds a sample to a texel whose fraction is still a count.
    pub(crate) fn add(&mut self, sample: &Sample, is_robot: bool) {
        let near = if is_robot { NEAR_ROBOT } else { NEAR_SCENE };
        self.minima[near] = smaller(self.minima[near], sample.near_m);
        self.minima[MINUS_FAR] = smaller(self.minima[MINUS_FAR], -sample.far_m);
        self.valid_frac += sample.n_valid;
    }

    /// Joins two rectangles, except for their fractions of pixels, which are summed.
    fn joined(&self, other: &Self) -> Self {
        let mut minima = self.minima;
        for (own, others) in minima.iter_mut().zip(&other.minima) {
            *own = smaller(*own, *others);
        }
        Self {
            minima,
            valid_frac: self.valid_frac + other.valid_frac,
        }
    }
}

/// The smaller one of two numbers. Unlike [`f32::min`], it is one instruction, as no value is NaN.
fn smaller(a: f32, b: f32) -> f32 {
    if b < a { b } else { a }
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
        let sample_px = sample_px(size_px[0]);
        self.stride_px = if size_px[0] > MAX_COLUMNS {
            2 * sample_px
        } else {
            sample_px
        };
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

    /// A row of texels of the finest level.
    pub(crate) fn texels_of_row(&mut self, row: usize) -> &mut [Footprint] {
        let finest = &mut self.levels[0];
        let first = row * finest.size[0];
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
                texel.minima[MIN_VALID] = texel.valid_frac;
            }
        }
        while self.levels[self.levels.len() - 1].size != [1, 1] {
            let mut coarser = self.levels[self.levels.len() - 1].coarser();
            if self.levels.len() <= VALIDITY_LEVEL {
                for texel in &mut coarser.texels {
                    texel.minima[MIN_VALID] = texel.valid_frac;
                }
            }
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
