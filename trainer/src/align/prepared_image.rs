//! What alignment sees of a keyframe: brightness at several sizes, and spots on surfaces.
#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "places in images are rounded down on purpose, after they were found to lie inside"
)]

use crate::splat::shares_lens;
use crate::{DepthMap, Keyframe};
use nalgebra::Vector3;
use std::sync::Arc;

/// The finest brightness is no wider than this: a hundredth of a pixel of it is far below what calibrations need.
const MOST_COLUMNS: u32 = 400;
/// The coarsest is no smaller than this.
const LEAST_SIDE: usize = 40;
const MOST_LEVELS: usize = 4;
/// Spots of an image: the most telling of each cell of a grid.
const CELLS: [usize; 2] = [20, 15];
/// Depth a spot's neighbours may differ by, and that readings which are interpolated between may differ by.
const SMOOTH_FRAC: f64 = 0.03;

/// One keyframe, prepared.
#[derive(Debug)]
pub(super) struct Frame {
    pub(super) keyframe: Arc<Keyframe>,
    /// Index of the camera, in the order of their names.
    pub(super) camera: usize,
    pub(super) levels: Vec<Grey>,
    /// Where brightness changes most.
    pub(super) spots: Vec<Spot>,
    /// Evenly over the image.
    pub(super) even_spots: Vec<Spot>,
    /// Whether an error of the lens is one of depth, too.
    pub(super) shares_lens: bool,
}

/// A reading of depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spot {
    /// In the depth image.
    pub(super) pixel: [f64; 2],
    pub(super) z_m: f64,
}

/// Brightness, 0 to 255, with its slopes.
#[derive(Debug)]
pub(super) struct Grey {
    size: [usize; 2],
    /// Pixels of the keyframe in one of these, along each side.
    pixels: f64,
    /// Value, and its slopes in pixels of the keyframe; not a number where nothing was seen.
    texels: Vec<[f32; 3]>,
}

/// Brightness somewhere: the value and its slopes along x and y.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sampled {
    pub(super) value: f64,
    pub(super) slope: [f64; 2],
}

impl Frame {
    pub(super) fn new(keyframe: &Arc<Keyframe>, camera: usize) -> Option<Self> {
        let depth = keyframe.depth.as_ref()?;
        let levels = levels(keyframe);
        let shares_lens = shares_lens(keyframe, depth);
        let mut frame =
            Self { keyframe: keyframe.clone(), camera, levels, spots: Vec::new(), even_spots: Vec::new(), shares_lens };
        let finest = frame.levels.first()?;
        let telling = |spot: &Spot| color_pixel(keyframe, depth, spot).and_then(|at| finest.at(at));
        let steepness = |spot: &Spot| telling(spot).map(|seen| seen.slope[0].hypot(seen.slope[1]));
        let (spots, even_spots) = pick(depth, steepness);
        (frame.spots, frame.even_spots) = (spots, even_spots);
        Some(frame)
    }

    /// Brightness at a level, or at the coarsest there is.
    pub(super) fn level(&self, level: usize) -> &Grey {
        &self.levels[level.min(self.levels.len() - 1)]
    }
}

/// The color pixel of a spot as the input has the cameras; the shutter's shear does not matter for choosing.
fn color_pixel(keyframe: &Keyframe, depth: &DepthMap, spot: &Spot) -> Option<[f64; 2]> {
    let in_depth = point(depth.focal_px, depth.principal_px, spot);
    let at = keyframe.world_from_camera.inverse() * depth.world_from_camera * nalgebra::Point3::from(in_depth);
    (at.z > 0.0).then(|| [0, 1].map(|axis| keyframe.focal_px[axis] * at[axis] / at.z + keyframe.principal_px[axis]))
}

/// Where a spot is in its depth camera, before any factor on depth.
pub(super) fn point(focal_px: [f64; 2], principal_px: [f64; 2], spot: &Spot) -> Vector3<f64> {
    let ray = [0, 1].map(|axis| (spot.pixel[axis] - principal_px[axis]) / focal_px[axis]);
    Vector3::new(ray[0], ray[1], 1.0) * spot.z_m
}

/// The steepest and the middle spot of every cell.
fn pick(depth: &DepthMap, steepness: impl Fn(&Spot) -> Option<f64>) -> (Vec<Spot>, Vec<Spot>) {
    const SPREAD: usize = 6; // Candidates along each side of a cell.
    let [width, height] = depth.size_px.map(|side| side as usize);
    let (mut steepest, mut even) = (Vec::new(), Vec::new());
    for cell in 0..CELLS[0] * CELLS[1] {
        let (cell_x, cell_y) = (cell % CELLS[0], cell / CELLS[0]);
        let mut best: Option<(f64, Spot)> = None;
        let mut middle = None;
        for candidate in 0..SPREAD * SPREAD {
            let place = |cell: usize, part: usize, n_cells: usize, side: usize| {
                ((cell * SPREAD + part) * side + side / 2) / (n_cells * SPREAD)
            };
            let x = place(cell_x, candidate % SPREAD, CELLS[0], width);
            let y = place(cell_y, candidate / SPREAD, CELLS[1], height);
            let Some(spot) = spot(depth, x, y) else { continue };
            let Some(steep) = steepness(&spot) else { continue };
            if best.is_none_or(|(most, _)| steep > most) {
                best = Some((steep, spot));
            }
            if candidate >= SPREAD * SPREAD / 2 + SPREAD / 2 && middle.is_none() {
                middle = Some(spot);
            }
        }
        steepest.extend(best.map(|(_, spot)| spot));
        even.extend(middle);
    }
    (steepest, even)
}

/// The spot at a pixel; none at holes and edges.
fn spot(depth: &DepthMap, x: usize, y: usize) -> Option<Spot> {
    const REACH: usize = 2;
    let [width, height] = depth.size_px.map(|side| side as usize);
    if x < REACH || y < REACH || x + REACH >= width || y + REACH >= height {
        return None;
    }
    let at = |x: usize, y: usize| f64::from(depth.depth_m[y * width + x]);
    let z_m = at(x, y);
    if z_m.is_nan() || z_m <= 0.0 {
        return None;
    }
    let (mut sum, mut n) = (0.0, 0.0);
    for (dx, dy) in (0..25).map(|ix| (ix % 5, ix / 5)) {
        let near = at(x + dx - REACH, y + dy - REACH);
        if near > 0.0 {
            if (near - z_m).abs() > SMOOTH_FRAC * z_m {
                return None;
            }
            // Opposite readings in pairs, so that a slope does not shift the mean; of inverses, which are straight on a plane.
            if at(x + REACH - dx, y + REACH - dy) > 0.0 {
                sum += 1.0 / near;
                n += 1.0;
            }
        }
    }
    Some(Spot { pixel: [x as f64 + 0.5, y as f64 + 0.5], z_m: n / sum })
}

/// A reading between pixels, whose inverses are straight on a plane, and its slopes along x and y; none at holes and edges.
pub(super) fn depth_at(depth: &DepthMap, pixel: [f64; 2]) -> Option<Sampled> {
    let [width, height] = depth.size_px.map(|side| side as usize);
    let [x, y] = pixel.map(|place| place - 0.5);
    if !(x >= 0.0 && y >= 0.0 && x < (width - 1) as f64 && y < (height - 1) as f64) {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let (fx, fy) = (x - left as f64, y - top as f64);
    let corner = |dx: usize, dy: usize| f64::from(depth.depth_m[(top + dy) * width + left + dx]);
    let corners = [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)];
    let (least, most) = corners.iter().fold((f64::MAX, 0.0f64), |(least, most), z| (least.min(*z), most.max(*z)));
    if !(least > 0.0 && most - least <= SMOOTH_FRAC * least) {
        return None;
    }
    let [a, b, c, d] = corners.map(|z| 1.0 / z);
    let z = 1.0 / (a * (1.0 - fx) * (1.0 - fy) + b * fx * (1.0 - fy) + c * (1.0 - fx) * fy + d * fx * fy);
    let slope = [(b - a) * (1.0 - fy) + (d - c) * fy, (c - a) * (1.0 - fx) + (d - b) * fx];
    Some(Sampled { value: z, slope: slope.map(|slope| -slope * z * z) })
}

fn levels(keyframe: &Keyframe) -> Vec<Grey> {
    let [width, height] = keyframe.size_px.map(|side| side as usize);
    let shift = keyframe.size_px[0].div_ceil(MOST_COLUMNS).next_power_of_two().ilog2();
    let edge = 1usize << shift;
    let size = [width / edge, height / edge];
    let mut values = vec![0.0f32; size[0] * size[1]];
    for (ix, value) in values.iter_mut().enumerate() {
        let (x, y) = (ix % size[0], ix / size[0]);
        let (mut sum, mut seen) = (0u32, true);
        for row in y * edge..(y + 1) * edge {
            for pixel in keyframe.rgba_srgb[4 * (row * width + x * edge)..].chunks_exact(4).take(edge) {
                seen &= pixel[3] > 0;
                sum += 77 * u32::from(pixel[0]) + 150 * u32::from(pixel[1]) + 29 * u32::from(pixel[2]); // Of 256.
            }
        }
        *value = if seen { sum as f32 / (256 * edge * edge) as f32 } else { f32::NAN };
    }
    let mut levels = vec![Grey::new(size, edge as f64, &values)];
    let mut size = size;
    while levels.len() < MOST_LEVELS && size[0].min(size[1]) / 2 >= LEAST_SIDE {
        let half = [size[0] / 2, size[1] / 2];
        let finer = |x: usize, y: usize| values[y * size[0] + x];
        values = (0..half[0] * half[1])
            .map(|ix| {
                let (x, y) = (2 * (ix % half[0]), 2 * (ix / half[0]));
                0.25 * (finer(x, y) + finer(x + 1, y) + finer(x, y + 1) + finer(x + 1, y + 1))
            })
            .collect();
        size = half;
        levels.push(Grey::new(size, (edge << levels.len()) as f64, &values));
    }
    levels
}

/// Binomial, five pixels wide: means between pixels have less noise than pixels have, and without a blur that would draw
/// images half a pixel apart.
fn blurred([width, height]: [usize; 2], sharp: &[f32]) -> Vec<f32> {
    const WEIGHTS: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
    let along = |values: &[f32], n: usize, stride: usize, place: &dyn Fn(usize) -> usize| -> Vec<f32> {
        let at = |ix: usize, offset: usize| {
            let moved = (place(ix) + offset).clamp(2, n + 1) - 2;
            values[ix - place(ix) * stride + moved * stride]
        };
        (0..values.len()).map(|ix| (0..5).map(|offset| WEIGHTS[offset] * at(ix, offset)).sum()).collect()
    };
    let rows = along(sharp, width, 1, &|ix| ix % width);
    along(&rows, height, width, &|ix| ix / width)
}

impl Grey {
    pub(super) fn new(size: [usize; 2], pixels: f64, sharp: &[f32]) -> Self {
        let [width, height] = size;
        let values = blurred(size, sharp);
        let nothing = [f32::NAN; 3];
        let texel = |ix: usize| {
            let (x, y) = (ix % width, ix / width);
            if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
                return nothing;
            }
            let scale = 0.5 / pixels as f32;
            [values[ix], scale * (values[ix + 1] - values[ix - 1]), scale * (values[ix + width] - values[ix - width])]
        };
        Self { size, pixels, texels: (0..width * height).map(texel).collect() }
    }

    /// Pixels of the keyframe along each side of one of these.
    pub(super) fn texel_px(&self) -> f64 {
        self.pixels
    }

    /// Brightness at a place of the keyframe, in its pixels.
    pub(super) fn at(&self, pixel: [f64; 2]) -> Option<Sampled> {
        let [x, y] = pixel.map(|place| place / self.pixels - 0.5);
        if !(x >= 1.0 && y >= 1.0 && x < (self.size[0] - 2) as f64 && y < (self.size[1] - 2) as f64) {
            return None;
        }
        let (left, top) = (x as usize, y as usize);
        let (fx, fy) = (x - left as f64, y - top as f64);
        let corner = |dx: usize, dy: usize| self.texels[(top + dy) * self.size[0] + left + dx];
        let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)];
        let mix = |part: usize| {
            let [a, b, c, d] = [a, b, c, d].map(|texel| f64::from(texel[part]));
            (a * (1.0 - fx) + b * fx) * (1.0 - fy) + (c * (1.0 - fx) + d * fx) * fy
        };
        let sampled = Sampled { value: mix(0), slope: [mix(1), mix(2)] };
        (sampled.value + sampled.slope[0] + sampled.slope[1]).is_finite().then_some(sampled)
    }
}
