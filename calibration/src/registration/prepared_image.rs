//! Prepares a keyframe for alignment, with a brightness pyramid and with depth samples on surfaces.
#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "coordinates in images are rounded down on purpose, after a check that they are inside"
)]

use crate::shares_lens;
use keyframe::{DepthMap, Keyframe};
use nalgebra::Vector3;
use std::sync::Arc;

/// Maximum width of the finest level, pixels. At this width, errors of a hundredth of a pixel are
/// far below the accuracy that calibration needs.
const MAX_COLUMNS: u32 = 400;
/// Minimum side of the coarsest level. Smaller levels have too few texels inside their borders.
const MIN_SIDE: usize = 40;
/// Each further level doubles the largest initial error from which the estimate converges.
const MAX_LEVELS: usize = 4;
/// Columns and rows of the grid of an image. Each cell contributes its most informative sample.
const GRID_CELLS: [usize; 2] = [20, 15];
/// Maximum relative difference between the depth of a sample and the depths of its neighbors. The
/// same limit applies to readings between which depth is interpolated.
const SMOOTH_FRAC: f64 = 0.03;

/// A keyframe prepared for alignment.
#[derive(Debug)]
pub(super) struct PreparedImage {
    pub(super) keyframe: Arc<Keyframe>,
    /// Index of the camera, in the order of names.
    pub(super) camera: usize,
    pub(super) levels: Vec<GrayImage>,
    /// Samples with the largest brightness gradients.
    pub(super) samples: Vec<DepthSample>,
    /// Samples spread evenly over the image.
    pub(super) uniform_samples: Vec<DepthSample>,
    /// Whether lens errors affect depth, too.
    pub(super) shares_lens: bool,
}

/// A depth reading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DepthSample {
    /// Pixel in the depth image.
    pub(super) pixel: [f64; 2],
    pub(super) z_m: f64,
}

/// A gray image (0 to 255) with its gradient.
#[derive(Debug)]
pub(super) struct GrayImage {
    size: [usize; 2],
    /// Pixels of the keyframe per texel, along each side.
    pixels: f64,
    /// Brightness and its gradient per pixel of the keyframe. They are NaN in masked areas.
    texels: Vec<[f32; 3]>,
}

/// An interpolated value with its gradient along x and y.
#[derive(Clone, Copy, Debug)]
pub(super) struct SampledValue {
    pub(super) value: f64,
    pub(super) gradient: [f64; 2],
}

impl PreparedImage {
    pub(super) fn new(keyframe: &Arc<Keyframe>, camera: usize) -> Option<Self> {
        let depth = keyframe.depth.as_ref()?;
        let levels = levels(keyframe);
        let shares_lens = shares_lens(keyframe, depth);
        let mut image = Self {
            keyframe: keyframe.clone(),
            camera,
            levels,
            samples: Vec::new(),
            uniform_samples: Vec::new(),
            shares_lens,
        };
        let finest = image.levels.first()?;
        let brightness_at = |sample: &DepthSample| {
            color_pixel(keyframe, depth, sample).and_then(|at| finest.at(at))
        };
        let gradient_norm = |sample: &DepthSample| {
            brightness_at(sample).map(|at| at.gradient[0].hypot(at.gradient[1]))
        };
        let (samples, uniform_samples) = select_samples(depth, gradient_norm);
        image.samples = samples;
        image.uniform_samples = uniform_samples;
        Some(image)
    }

    /// The gray image at a level, or at the coarsest level if there are fewer levels.
    pub(super) fn level(&self, level: usize) -> &GrayImage {
        &self.levels[level.min(self.levels.len() - 1)]
    }
}

/// Pixel of a sample in the color image, with uncorrected cameras. The rolling shutter is ignored,
/// because the pixel is used only to select samples.
fn color_pixel(keyframe: &Keyframe, depth: &DepthMap, sample: &DepthSample) -> Option<[f64; 2]> {
    let in_depth = point(depth.focal_px, depth.principal_px, sample);
    let at = keyframe.world_from_camera.inverse()
        * depth.world_from_camera
        * nalgebra::Point3::from(in_depth);
    (at.z > 0.0).then(|| {
        [0, 1].map(|axis| keyframe.focal_px[axis] * at[axis] / at.z + keyframe.principal_px[axis])
    })
}

/// Position of a sample in its depth camera, before any depth scale.
pub(super) fn point(
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    sample: &DepthSample,
) -> Vector3<f64> {
    let ray = [0, 1].map(|axis| (sample.pixel[axis] - principal_px[axis]) / focal_px[axis]);
    Vector3::new(ray[0], ray[1], 1.0) * sample.z_m
}

/// Selects, in every cell, the sample with the largest gradient and the central sample.
fn select_samples(
    depth: &DepthMap,
    gradient_norm: impl Fn(&DepthSample) -> Option<f64>,
) -> (Vec<DepthSample>, Vec<DepthSample>) {
    // Number of tested pixels along each side of a cell. Testing all pixels would take most of the
    // preparation time.
    const CANDIDATES_PER_SIDE: usize = 6;
    let [width, height] = depth.size_px.map(|side| side as usize);
    let mut strongest = Vec::new();
    let mut uniform = Vec::new();
    for cell in 0..GRID_CELLS[0] * GRID_CELLS[1] {
        let cell_x = cell % GRID_CELLS[0];
        let cell_y = cell / GRID_CELLS[0];
        let mut best: Option<(f64, DepthSample)> = None;
        let mut middle = None;
        for candidate in 0..CANDIDATES_PER_SIDE * CANDIDATES_PER_SIDE {
            let coordinate = |cell: usize, part: usize, n_cells: usize, side: usize| {
                ((cell * CANDIDATES_PER_SIDE + part) * side + side / 2)
                    / (n_cells * CANDIDATES_PER_SIDE)
            };
            let x = coordinate(
                cell_x,
                candidate % CANDIDATES_PER_SIDE,
                GRID_CELLS[0],
                width,
            );
            let y = coordinate(
                cell_y,
                candidate / CANDIDATES_PER_SIDE,
                GRID_CELLS[1],
                height,
            );
            let Some(sample) = sample(depth, x, y) else {
                continue;
            };
            let Some(norm) = gradient_norm(&sample) else {
                continue;
            };
            if best.is_none_or(|(max, _)| norm > max) {
                best = Some((norm, sample));
            }
            // This is the first valid candidate in the second half of the cell.
            if candidate >= CANDIDATES_PER_SIDE * CANDIDATES_PER_SIDE / 2 + CANDIDATES_PER_SIDE / 2
                && middle.is_none()
            {
                middle = Some(sample);
            }
        }
        strongest.extend(best.map(|(_, sample)| sample));
        uniform.extend(middle);
    }
    (strongest, uniform)
}

/// The sample at a pixel. `None` at holes and edges.
fn sample(depth: &DepthMap, x: usize, y: usize) -> Option<DepthSample> {
    const RADIUS: usize = 2;
    let [width, height] = depth.size_px.map(|side| side as usize);
    if x < RADIUS || y < RADIUS || x + RADIUS >= width || y + RADIUS >= height {
        return None;
    }
    let at = |x: usize, y: usize| f64::from(depth.depth_m[y * width + x]);
    let z_m = at(x, y);
    if z_m.is_nan() || z_m <= 0.0 {
        return None;
    }
    let mut sum = 0.0;
    let mut n = 0.0;
    for (dx, dy) in (0..25).map(|ix| (ix % 5, ix / 5)) {
        let neighbor = at(x + dx - RADIUS, y + dy - RADIUS);
        if neighbor > 0.0 {
            if (neighbor - z_m).abs() > SMOOTH_FRAC * z_m {
                return None;
            }
            // Readings are used in opposite pairs, so that a slanted surface does not bias the
            // mean. Inverse depths are averaged, because they are linear on a plane.
            if at(x + RADIUS - dx, y + RADIUS - dy) > 0.0 {
                sum += 1.0 / neighbor;
                n += 1.0;
            }
        }
    }
    Some(DepthSample {
        pixel: [x as f64 + 0.5, y as f64 + 0.5],
        z_m: n / sum,
    })
}

/// Depth interpolated between pixels, and its gradient along x and y. `None` at holes and edges.
/// Inverse depths are interpolated, because they are linear on a plane.
pub(super) fn depth_at(depth: &DepthMap, pixel: [f64; 2]) -> Option<SampledValue> {
    let [width, height] = depth.size_px.map(|side| side as usize);
    let [x, y] = pixel.map(|coordinate| coordinate - 0.5);
    if !(x >= 0.0 && y >= 0.0 && x < (width - 1) as f64 && y < (height - 1) as f64) {
        return None;
    }
    let left = x as usize;
    let top = y as usize;
    let fx = x - left as f64;
    let fy = y - top as f64;
    let corner = |dx: usize, dy: usize| f64::from(depth.depth_m[(top + dy) * width + left + dx]);
    let corners = [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)];
    let (min, max) = corners.iter().fold((f64::MAX, 0.0f64), |(min, max), z| {
        (min.min(*z), max.max(*z))
    });
    // Holes are zeros. The comparison is written so that NaN also counts as a hole.
    if !(min > 0.0 && max - min <= SMOOTH_FRAC * min) {
        return None;
    }
    let [a, b, c, d] = corners.map(|z| 1.0 / z);
    let z = 1.0
        / (a * (1.0 - fx) * (1.0 - fy) + b * fx * (1.0 - fy) + c * (1.0 - fx) * fy + d * fx * fy);
    let gradient = [
        (b - a) * (1.0 - fy) + (d - c) * fy,
        (c - a) * (1.0 - fx) + (d - b) * fx,
    ];
    Some(SampledValue {
        value: z,
        // The gradient of z = 1 / inverse is -z² times the gradient of the inverse.
        gradient: gradient.map(|gradient| -gradient * z * z),
    })
}

/// Size of the image in squares of `edge` pixels, and the mean brightness (0 to 255) of each
/// square. The brightness is NaN in masked areas.
pub(super) fn brightness(keyframe: &Keyframe, edge: usize) -> ([usize; 2], Vec<f32>) {
    let [width, height] = keyframe.size_px.map(|side| side as usize);
    let size = [width / edge, height / edge];
    let values = (0..size[0] * size[1])
        .map(|ix| mean_brightness(keyframe, [ix % size[0], ix / size[0]], edge))
        .collect();
    (size, values)
}

/// Mean brightness of one square, which is given by its column and row.
fn mean_brightness(keyframe: &Keyframe, [x, y]: [usize; 2], edge: usize) -> f32 {
    let width = keyframe.size_px[0] as usize;
    let mut sum = 0u32;
    let mut is_valid = true;
    for row in y * edge..(y + 1) * edge {
        for pixel in keyframe.rgba_srgb[4 * (row * width + x * edge)..]
            .chunks_exact(4)
            .take(edge)
        {
            is_valid &= pixel[3] > 0;
            // The weights of BT.601 times 256.
            sum += 77 * u32::from(pixel[0]) + 150 * u32::from(pixel[1]) + 29 * u32::from(pixel[2]);
        }
    }
    if is_valid {
        sum as f32 / (256 * edge * edge) as f32
    } else {
        f32::NAN
    }
}

/// The pyramid of a keyframe, the finest level first.
fn levels(keyframe: &Keyframe) -> Vec<GrayImage> {
    let level_shift = keyframe.size_px[0]
        .div_ceil(MAX_COLUMNS)
        .next_power_of_two()
        .ilog2();
    let edge = 1usize << level_shift;
    let (mut size, mut values) = brightness(keyframe, edge);
    let mut levels = vec![GrayImage::new(size, edge as f64, &values)];
    while levels.len() < MAX_LEVELS && size[0].min(size[1]) / 2 >= MIN_SIDE {
        let half = [size[0] / 2, size[1] / 2];
        let finer = |x: usize, y: usize| values[y * size[0] + x];
        values = (0..half[0] * half[1])
            .map(|ix| {
                let x = 2 * (ix % half[0]);
                let y = 2 * (ix / half[0]);
                0.25 * (finer(x, y) + finer(x + 1, y) + finer(x, y + 1) + finer(x + 1, y + 1))
            })
            .collect();
        size = half;
        levels.push(GrayImage::new(size, (edge << levels.len()) as f64, &values));
    }
    levels
}

/// Blurs with a binomial filter, five pixels wide. Interpolated values have less noise than values
/// at pixel centers. Without the blur, this difference would bias estimates towards half-pixel
/// offsets.
fn blurred([width, height]: [usize; 2], values_in: &[f32]) -> Vec<f32> {
    let rows = blurred_along(values_in, [width, 1], |ix| ix % width);
    blurred_along(&rows, [height, width], |ix| ix / width)
}

/// Blurs along one axis with `n` values that are `stride` apart. Values beyond the ends are equal
/// to the outermost value.
///
/// * `coordinate`: position along the axis of the value at an index.
fn blurred_along(
    values: &[f32],
    [n, stride]: [usize; 2],
    coordinate: impl Fn(usize) -> usize,
) -> Vec<f32> {
    const WEIGHTS: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
    let at = |ix: usize, offset: usize| {
        let neighbor_ix = (coordinate(ix) + offset).clamp(2, n + 1) - 2;
        values[ix - coordinate(ix) * stride + neighbor_ix * stride]
    };
    (0..values.len())
        .map(|ix| (0..5).map(|offset| WEIGHTS[offset] * at(ix, offset)).sum())
        .collect()
}

impl GrayImage {
    pub(super) fn new(size: [usize; 2], pixels: f64, values_in: &[f32]) -> Self {
        let [width, height] = size;
        let values = blurred(size, values_in);
        // Central differences per pixel of the keyframe, so that gradients of all levels have the
        // same unit. They need neighbors on both sides.
        let scale = 0.5 / pixels as f32;
        let mut texels = vec![[f32::NAN; 3]; width * height];
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                let ix = y * width + x;
                texels[ix] = [
                    values[ix],
                    scale * (values[ix + 1] - values[ix - 1]),
                    scale * (values[ix + width] - values[ix - width]),
                ];
            }
        }
        Self {
            size,
            pixels,
            texels,
        }
    }

    /// Pixels of the keyframe along each side of a texel.
    pub(super) fn texel_px(&self) -> f64 {
        self.pixels
    }

    /// Brightness at a pixel position of the keyframe.
    pub(super) fn at(&self, pixel: [f64; 2]) -> Option<SampledValue> {
        let [x, y] = pixel.map(|coordinate| coordinate / self.pixels - 0.5);
        if !(x >= 1.0 && y >= 1.0 && x < (self.size[0] - 2) as f64 && y < (self.size[1] - 2) as f64)
        {
            return None;
        }
        let left = x as usize;
        let top = y as usize;
        let fx = x - left as f64;
        let fy = y - top as f64;
        let corner = |dx: usize, dy: usize| self.texels[(top + dy) * self.size[0] + left + dx];
        let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)];
        let bilinear = |part: usize| {
            let [a, b, c, d] = [a, b, c, d].map(|texel| f64::from(texel[part]));
            (a * (1.0 - fx) + b * fx) * (1.0 - fy) + (c * (1.0 - fx) + d * fx) * fy
        };
        let interpolated = SampledValue {
            value: bilinear(0),
            gradient: [bilinear(1), bilinear(2)],
        };
        // One masked neighbor makes all of them NaN.
        (interpolated.value + interpolated.gradient[0] + interpolated.gradient[1])
            .is_finite()
            .then_some(interpolated)
    }
}
