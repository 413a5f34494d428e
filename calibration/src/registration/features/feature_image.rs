//! Corners of an image and the brightness around them.
#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "coordinates in images are rounded down on purpose, after a check that they are inside"
)]

use crate::registration::prepared_image::brightness;
use keyframe::Keyframe;
use nalgebra::Vector2;
use std::ops::Range;
use std::sync::Arc;

/// Maximum width of the finest level, pixels. It bounds the time for large images.
const MAX_COLUMNS: u32 = 800;
/// Narrower images are enlarged to about this width, because corners of small images are only a few
/// pixels apart.
const MIN_COLUMNS: u32 = 320;
const MAX_ENLARGEMENT: u32 = 3;
/// Ratio of the sizes of neighboring levels.
const LEVEL_RATIO: f64 = 1.5;
const MAX_LEVELS: usize = 4;
/// Minimum side of a level, texels.
const MIN_SIDE: usize = 40;
/// Approximate maximum number of corners of the finest level.
const MAX_CORNERS: usize = 700;
/// Minimum side of a cell of the grid that spreads corners over the image, texels. The next
/// constant is the maximum number of corners of a cell.
const MIN_CELL: usize = 16;
const CORNERS_PER_CELL: usize = 3;
/// Minimum brightness gradient of a corner in every direction, as root mean square per texel. With
/// a lower value, noise is detected as corners.
const MIN_GRADIENT: f32 = 1.5;
/// Half the side of the window of a corner, texels.
const WINDOW_RADIUS: usize = 2;
/// Number of samples along each side of a descriptor. The next constant is the distance between
/// them in texels. A larger window is more distinctive, but less often lies on a single flat
/// surface.
const SIDE: usize = 8;
const SPACING: f64 = 2.5;
/// Number of samples of a descriptor.
pub(super) const DESCRIPTOR_LEN: usize = SIDE * SIDE;
/// Minimum standard deviation of the samples of a descriptor. Below this value, normalization would
/// amplify noise.
const MIN_CONTRAST: f32 = 4.0;

/// Brightness around a corner with zero mean and unit norm, so that the dot product of two
/// descriptors is their normalized cross-correlation.
pub(super) type Descriptor = [f32; DESCRIPTOR_LEN];

/// A corner of an image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Corner {
    /// Position in the keyframe, pixels.
    pub(super) px: [f64; 2],
    /// Ray through the corner with the keyframe's lens, given by x and y at a depth of 1.
    pub(super) ray: Vector2<f64>,
    /// Time at which the corner's row was read out, as a share of the readout time. It is -0.5 for
    /// the first row and 0.5 for the last row.
    pub(super) row_share: f64,
    /// Position in texels of the level, where the center of the first texel is 0.
    texel: [f64; 2],
    pub(super) level: usize,
}

impl Corner {
    /// A corner without an image.
    #[cfg(test)]
    pub(super) fn at(px: [f64; 2], row_share: f64) -> Self {
        Self {
            px,
            ray: Vector2::zeros(),
            row_share,
            texel: [0.0; 2],
            level: 0,
        }
    }
}

/// An image with its corners.
#[derive(Debug)]
pub(super) struct FeatureImage {
    pub(super) keyframe: Arc<Keyframe>,
    /// Index of the camera, in the order of names.
    pub(super) camera: usize,
    levels: Vec<Level>,
    /// Corners, the finest level first.
    pub(super) corners: Vec<Corner>,
    /// Descriptors of the corners along the axes of the image.
    pub(super) descriptors: Vec<Descriptor>,
}

/// Side of the window of a corner, texels.
const DIAMETER: usize = 2 * WINDOW_RADIUS + 1;

/// Whether a response is larger than the responses of its eight neighbors. If responses are equal,
/// the first response counts as larger.
fn is_maximum(response: &[f32], width: usize, ix: usize) -> bool {
    let own = response[ix];
    let earlier = [ix - width - 1, ix - width, ix - width + 1, ix - 1];
    let later = [ix + 1, ix + width - 1, ix + width, ix + width + 1];
    earlier.iter().all(|other| own > response[*other])
        && later.iter().all(|other| own >= response[*other])
}

/// Distance from a maximum to the vertex of the parabola through it and its neighbors along one
/// axis, texels.
fn vertex_offset(response: &[f32], ix: usize, stride: usize) -> f64 {
    let [before, own, after] = [ix - stride, ix, ix + stride].map(|ix| f64::from(response[ix]));
    let curvature = before - 2.0 * own + after;
    if curvature < 0.0 {
        (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
    } else {
        0.0
    }
}

/// Sum of structure tensors in the window around an index, along one axis.
fn window_sum(tensors: &[[f32; 3]], ix: usize, stride: usize) -> [f32; 3] {
    let mut sum = [0.0; 3];
    for step in 0..DIAMETER {
        let tensor = tensors[ix + step * stride - WINDOW_RADIUS * stride];
        sum = std::array::from_fn(|part| sum[part] + tensor[part]);
    }
    sum
}

/// A gray image with values from 0 to 255. Masked areas are NaN.
#[derive(Debug)]
struct Level {
    size: [usize; 2],
    /// Pixels of the keyframe per texel.
    texel_px: f64,
    values: Vec<f32>,
}

impl FeatureImage {
    pub(super) fn new(keyframe: &Arc<Keyframe>, camera: usize) -> Self {
        let levels = levels(keyframe);
        // The cell size is chosen such that the finest level has about the maximum number of
        // corners.
        let n_texels = levels[0].values.len();
        let side = ((n_texels * CORNERS_PER_CELL) as f64 / MAX_CORNERS as f64).sqrt() as usize;
        let cell = side.max(MIN_CELL);
        let mut corners = Vec::new();
        let mut descriptors = Vec::new();
        for (ix, level) in levels.iter().enumerate() {
            for texel in level.corners(cell) {
                let Some(descriptor) = level.descriptor(texel, [1.0, 0.0]) else {
                    continue;
                };
                let px = texel.map(|coordinate| (coordinate + 0.5) * level.texel_px);
                let axis = |axis: usize| {
                    (px[axis] - keyframe.principal_px[axis]) / keyframe.focal_px[axis]
                };
                let row_share = px[1] / f64::from(keyframe.size_px[1]) - 0.5;
                corners.push(Corner {
                    px,
                    ray: Vector2::new(axis(0), axis(1)),
                    row_share,
                    texel,
                    level: ix,
                });
                descriptors.push(descriptor);
            }
        }
        Self {
            keyframe: keyframe.clone(),
            camera,
            levels,
            corners,
            descriptors,
        }
    }

    /// Descriptor of a corner along axes that are rotated relative to the axes of the image. The
    /// angle is given as cosine and sine.
    pub(super) fn rotated_descriptor(
        &self,
        corner: &Corner,
        rotation: [f64; 2],
    ) -> Option<Descriptor> {
        self.levels[corner.level].descriptor(corner.texel, rotation)
    }

    /// Indices of the corners whose level differs by at most `max_difference` from a level.
    pub(super) fn corners_of_levels(&self, level: usize, max_difference: usize) -> Range<usize> {
        let begin = self
            .corners
            .partition_point(|corner| corner.level + max_difference < level);
        begin
            ..self
                .corners
                .partition_point(|corner| corner.level <= level + max_difference)
    }

    /// Size of a corner's texels, radians near the image center.
    pub(super) fn texel_rad(&self, corner: &Corner) -> f64 {
        self.texel_rad_of_level(corner.level)
    }

    /// Size of the texels of the finest level, radians near the image center.
    pub(super) fn finest_texel_rad(&self) -> f64 {
        self.texel_rad_of_level(0)
    }

    /// Size of the texels of a level, radians near the image center.
    fn texel_rad_of_level(&self, level: usize) -> f64 {
        2.0 * self.levels[level].texel_px / (self.keyframe.focal_px[0] + self.keyframe.focal_px[1])
    }
}

/// Levels of a keyframe, the finest first.
fn levels(keyframe: &Keyframe) -> Vec<Level> {
    let edge = keyframe.size_px[0].div_ceil(MAX_COLUMNS).max(1) as usize;
    let (size, values) = brightness(keyframe, edge);
    let base = Level {
        size,
        texel_px: edge as f64,
        values,
    };
    let base = match MIN_COLUMNS.div_ceil(keyframe.size_px[0]) {
        ..=1 => base,
        factor => base.resized(1.0 / f64::from(factor.min(MAX_ENLARGEMENT))),
    };
    let mut levels = vec![base.blurred()];
    while levels.len() < MAX_LEVELS {
        let coarser = levels[levels.len() - 1].resized(LEVEL_RATIO);
        if coarser.size[0].min(coarser.size[1]) < MIN_SIDE {
            break;
        }
        levels.push(coarser.blurred());
    }
    levels
}

impl Level {
    /// Interpolates between texels that are larger by a factor.
    fn resized(&self, factor: f64) -> Self {
        let size = self.size.map(|side| (side as f64 / factor) as usize);
        let value = |ix: usize| {
            let at = [ix % size[0], ix / size[0]].map(|texel| (texel as f64 + 0.5) * factor - 0.5);
            self.at(at).unwrap_or(f32::NAN)
        };
        Self {
            size,
            texel_px: self.texel_px * factor,
            values: (0..size[0] * size[1]).map(value).collect(),
        }
    }

    /// Blurs with a binomial filter, five texels wide.
    fn blurred(&self) -> Self {
        let [width, height] = self.size;
        let mut rows = vec![f32::NAN; self.values.len()];
        for (row, blurred) in self
            .values
            .chunks_exact(width)
            .zip(rows.chunks_exact_mut(width))
        {
            for (window, blurred) in row.windows(5).zip(&mut blurred[2..]) {
                *blurred =
                    (window[0] + window[4] + 4.0 * (window[1] + window[3]) + 6.0 * window[2])
                        / 16.0;
            }
        }
        let mut values = vec![f32::NAN; self.values.len()];
        for y in 2..height.saturating_sub(2) {
            for x in 0..width {
                let at = |row: usize| rows[(y + row - 2) * width + x];
                values[y * width + x] =
                    (at(0) + at(4) + 4.0 * (at(1) + at(3)) + 6.0 * at(2)) / 16.0;
            }
        }
        Self { values, ..*self }
    }

    /// Interpolated brightness at a position in texels, where the center of the first texel is 0.
    fn at(&self, [x, y]: [f64; 2]) -> Option<f32> {
        if !(x >= 0.0 && y >= 0.0 && x < (self.size[0] - 1) as f64 && y < (self.size[1] - 1) as f64)
        {
            return None;
        }
        let left = x as usize;
        let top = y as usize;
        let fx = (x - left as f64) as f32;
        let fy = (y - top as f64) as f32;
        let ix = top * self.size[0] + left;
        let row = |row: &[f32]| row[0] + fx * (row[1] - row[0]);
        let above = row(&self.values[ix..ix + 2]);
        let below = row(&self.values[ix + self.size[0]..][..2]);
        Some(above + fy * (below - above))
    }

    /// Corners, spread over a grid, with positions that are finer than a texel (Shi and Tomasi
    /// 1994).
    fn corners(&self, cell: usize) -> Vec<[f64; 2]> {
        let [width, height] = self.size;
        if width.min(height) < MIN_SIDE {
            return Vec::new();
        }
        let response = self.corner_response();
        // The response is a squared gradient.
        let min_response = MIN_GRADIENT * MIN_GRADIENT;
        let n_cells = [width.div_ceil(cell), height.div_ceil(cell)];
        let mut by_cell: Vec<Vec<usize>> = vec![Vec::new(); n_cells[0] * n_cells[1]];
        for y in 1..height - 1 {
            for x in 1..width - 1 {
                let ix = y * width + x;
                if response[ix] > min_response && is_maximum(&response, width, ix) {
                    by_cell[y / cell * n_cells[0] + x / cell].push(ix);
                }
            }
        }
        let mut corners = Vec::new();
        for mut found in by_cell {
            found.sort_by(|a, b| response[*b].total_cmp(&response[*a]).then(a.cmp(b)));
            found.truncate(CORNERS_PER_CELL);
            corners.extend(found.into_iter().map(|ix| {
                [
                    (ix % width) as f64 + vertex_offset(&response, ix, 1),
                    (ix / width) as f64 + vertex_offset(&response, ix, width),
                ]
            }));
        }
        corners
    }

    /// Smaller eigenvalue of the mean structure tensor in a window. It is 0 at edges and in masked
    /// areas.
    fn corner_response(&self) -> Vec<f32> {
        let [width, height] = self.size;
        let mut tensors = vec![[f32::NAN; 3]; self.values.len()];
        for y in 1..height - 1 {
            for x in 1..width - 1 {
                let ix = y * width + x;
                let gx = 0.5 * (self.values[ix + 1] - self.values[ix - 1]);
                let gy = 0.5 * (self.values[ix + width] - self.values[ix - width]);
                tensors[ix] = [gx * gx, gx * gy, gy * gy];
            }
        }
        // The tensors are summed over the window, along rows first, then along columns.
        let mut rows = vec![[f32::NAN; 3]; tensors.len()];
        for y in 0..height {
            for x in WINDOW_RADIUS..width - WINDOW_RADIUS {
                let ix = y * width + x;
                rows[ix] = window_sum(&tensors, ix, 1);
            }
        }
        let mut response = vec![0.0; tensors.len()];
        for y in WINDOW_RADIUS..height - WINDOW_RADIUS {
            for x in WINDOW_RADIUS..width - WINDOW_RADIUS {
                let ix = y * width + x;
                let [xx, xy, yy] =
                    window_sum(&rows, ix, width).map(|sum| sum / (DIAMETER * DIAMETER) as f32);
                let smaller = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
                response[ix] = if smaller.is_finite() { smaller } else { 0.0 };
            }
        }
        response
    }

    /// Descriptor at a position. `None` near the edges, in masked areas, and without contrast.
    fn descriptor(&self, center: [f64; 2], [cos, sin]: [f64; 2]) -> Option<Descriptor> {
        // Half the diagonal of the samples, so that the window fits at any rotation.
        const RADIUS: f64 = 0.5 * (SIDE - 1) as f64 * SPACING * std::f64::consts::SQRT_2 + 1.0;
        let [left, top] = center.map(|coordinate| (coordinate - RADIUS).floor());
        let size = (2.0 * RADIUS).ceil() + 2.0;
        let is_inside = |begin: f64, side: usize| begin >= 0.0 && begin + size <= side as f64;
        if !is_inside(left, self.size[0]) || !is_inside(top, self.size[1]) {
            return None;
        }
        let window = &self.values[top as usize * self.size[0] + left as usize..];
        let stride = self.size[0];
        let [x, y] = [(center[0] - left) as f32, (center[1] - top) as f32];
        let [cos, sin] = [cos as f32, sin as f32];
        let mut samples = [0.0f32; DESCRIPTOR_LEN];
        for (ix, sample) in samples.iter_mut().enumerate() {
            let offset = |step: usize| (step as f32 - 0.5 * (SIDE - 1) as f32) * SPACING as f32;
            let dx = offset(ix % SIDE);
            let dy = offset(ix / SIDE);
            let sample_x = x + cos * dx - sin * dy;
            let sample_y = y + sin * dx + cos * dy;
            // Conversions to u32 are faster than to usize.
            let column = sample_x as u32;
            let row = sample_y as u32;
            let fx = sample_x - column as f32;
            let fy = sample_y - row as f32;
            let begin = row as usize * stride + column as usize;
            let above = &window[begin..begin + 2];
            let below = &window[begin + stride..begin + stride + 2];
            let above = above[0] + fx * (above[1] - above[0]);
            *sample = above + fy * (below[0] + fx * (below[1] - below[0]) - above);
        }
        let mean = samples.iter().sum::<f32>() / DESCRIPTOR_LEN as f32;
        samples.iter_mut().for_each(|sample| *sample -= mean);
        let norm = samples
            .iter()
            .map(|sample| sample * sample)
            .sum::<f32>()
            .sqrt();
        // This comparison is also false for NaN.
        let has_contrast = norm > MIN_CONTRAST * (DESCRIPTOR_LEN as f32).sqrt();
        has_contrast.then(|| samples.map(|sample| sample / norm))
    }
}
