//! Initial splats. With depth, they are flat discs at depth readings. Without depth, they are balls
//! at given points and a random cloud in the cameras' common field of view.
#![expect(
    clippy::cast_possible_truncation,
    reason = "pixels, cells and random draws are rounded down on purpose, within ranges that are checked"
)]

use super::nearest::mean_spacings_m;
use super::views::FAR_M;
use keyframe::{DepthMap, Keyframe};
use model_files::InitialPoints;
use model_files::splat::arrays::SplatArrays;
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use numbers::quantile::{Rank, quantile};
use numbers::random::Random;
use numbers::{f32_of, f32s_of};
use rayon::prelude::*;
use std::collections::HashSet;
use std::sync::Arc;

/// Neighboring depths that differ by more than this fraction belong to different surfaces.
///
/// A smaller value would also reject oblique surfaces, because their depth changes quickly. With a
/// larger value, discs would bridge the gap between an object and its background.
const EDGE_FRAC: f64 = 0.04;
/// Standard deviation of a disc, in grid spacings. With this value, neighbors overlap without
/// blurring. Smaller discs leave gaps, and larger discs blend the colors of several neighbors.
const SPREAD: f64 = 0.6;
/// Thickness of a disc, in grid spacings. It is a quarter of [`SPREAD`]. The disc is flat, because
/// it lies on a surface, but thick enough to be seen from the side.
const THICKNESS: f64 = 0.15;
/// A disc is known to lie on a surface, so it is mostly opaque. The opacity is below 1, because the
/// gradient of the logit vanishes at 1.
const SEED_OPACITY: f64 = 0.7;
/// Maximum number of splats in a random cloud per image. The first images of a live scan do not tell
/// how far the scene is away, so they get only some of them.
const RANDOM_PER_IMAGE: usize = 10_000;
/// Most positions of a random cloud are wrong. Low opacity lets the gradients reach splats behind
/// them.
const RANDOM_OPACITY: f64 = 0.1;
/// This is the value of Kerbl et al. 2023.
const POINT_OPACITY: f64 = 0.1;
/// Value of the constant spherical harmonic: `1 / (2 sqrt(pi))`.
const SH_0: f64 = 0.282_094_791_773_878_14;
/// Smallest weight of the slant of a surface, reached at 73 degrees. More oblique surfaces would
/// get discs that extend far beyond their neighbors, and their normals are uncertain.
const MIN_SLANT: f64 = 0.3;

/// Creates discs and stores the positions that already have splats.
#[derive(Clone, Debug, Default)]
pub(crate) struct Seeder {
    /// Occupied cells, each with the octave of its size.
    occupied_cells: HashSet<(i32, [i32; 3])>,
    /// Positions of the discs, in the world.
    positions: Vec<Point3<f64>>,
}

/// A disc proposed for a depth image.
struct Disc {
    position: Point3<f64>,
    spacing_m: f64,
    normal: Vector3<f64>,
    size_m: [f64; 3],
    color: [f64; 3],
}

/// Density of discs in an image that no disc covers yet.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Density {
    /// Maximum number of discs.
    pub(crate) max_discs: f64,
    /// Minimum number of pixels per disc, unless this minimum results in fewer than [`MIN_DISCS`]
    /// discs.
    pub(crate) px_per_disc: f64,
}

/// Number of discs that an image may get even if it has few pixels.
///
/// At the density of a large image, a depth image of 160 x 120 pixels would get too few discs to
/// show the shape of a scene.
const MIN_DISCS: f64 = 4000.0;

impl Density {
    /// Distance between discs in pixels, a whole number.
    fn stride_px(self, size_px: [u32; 2]) -> f64 {
        let n_pixels = f64::from(size_px[0]) * f64::from(size_px[1]);
        // The maximum is applied last, because it also holds for small images.
        let n = self
            .max_discs
            .min((n_pixels / self.px_per_disc).max(MIN_DISCS));
        (n_pixels / n).sqrt().round().max(1.0)
    }
}

impl Seeder {
    /// Creates discs at depth readings that no disc of similar spacing covers yet. Ignores
    /// keyframes without depth.
    ///
    /// Keyframes are processed in batches. The keyframes of a batch propose discs in parallel,
    /// given the discs of all earlier batches. Positions are then claimed sequentially, so the
    /// result does not depend on thread scheduling.
    pub(crate) fn discs(&mut self, keyframes: &[Arc<Keyframe>], density: Density) -> SplatArrays {
        // Within a batch, several keyframes may propose discs at the same position. All but one of
        // these discs are discarded. A larger batch wastes more of this work, and a smaller batch
        // keeps fewer cores busy.
        const BATCH: usize = 32;
        let mut seeds = Seeds::new();
        for batch in keyframes.chunks(BATCH) {
            let candidate_discs: Vec<Vec<Disc>> = batch
                .par_iter()
                .map(|keyframe| self.candidate_discs(keyframe, density))
                .collect();
            for disc in candidate_discs.into_iter().flatten() {
                if self.claim(&disc.position, disc.spacing_m) {
                    seeds.push(
                        &disc.position,
                        &disc.normal,
                        disc.size_m,
                        SEED_OPACITY,
                        disc.color,
                    );
                }
            }
        }
        seeds.arrays
    }

    /// Proposes discs at the unoccupied positions of a keyframe.
    fn candidate_discs(&self, keyframe: &Keyframe, density: Density) -> Vec<Disc> {
        let Some(depth) = &keyframe.depth else {
            return Vec::new();
        };
        let [width, height] = depth.size_px;
        let stride = density.stride_px(depth.size_px) as u32;
        let mut discs = Vec::new();
        for y in (stride / 2..height).step_by(stride as usize) {
            for x in (stride / 2..width).step_by(stride as usize) {
                discs.extend(self.candidate_disc(keyframe, depth, stride, [x, y]));
            }
        }
        discs
    }

    /// Proposes a disc at one depth reading. Returns `None` if the reading is unusable, at an edge,
    /// at an occupied position or outside the color image.
    fn candidate_disc(
        &self,
        keyframe: &Keyframe,
        depth: &DepthMap,
        stride: u32,
        [x, y]: [u32; 2],
    ) -> Option<Disc> {
        let [width, height] = depth.size_px;
        let at = |x: u32, y: u32| f64::from(depth.depth_m[(y * width + x) as usize]);
        let z = at(x, y);
        // The comparisons are written so that NaN is rejected. At the border, neighbors are
        // missing.
        if !(z > 0.0 && z <= FAR_M)
            || x < stride
            || y < stride
            || x + stride >= width
            || y + stride >= height
        {
            return None;
        }
        let neighbors = [
            at(x - stride, y),
            at(x + stride, y),
            at(x, y - stride),
            at(x, y + stride),
        ];
        // At depth edges, readings mix both surfaces, and the normal would be wrong. Missing
        // neighbors do not count as an edge, because sensors have many holes.
        if neighbors
            .iter()
            .any(|near| (near - z).abs() > EDGE_FRAC * z && *near > 0.0)
        {
            return None;
        }
        let here = depth.point(x, y, z);
        let spacing_m = f64::from(stride) * z / depth.focal_px[0];
        let position = depth.world_from_camera * Point3::from(here);
        if self.is_occupied(&position, spacing_m) {
            return None;
        }
        let color = color_at(keyframe, &position)?;
        // A missing neighbor is assumed to be at the depth of the center, which rotates the normal
        // toward the camera.
        let filled = |near: f64| if near > 0.0 { near } else { z };
        let across = depth.point(x + stride, y, filled(neighbors[1]))
            - depth.point(x - stride, y, filled(neighbors[0]));
        let down = depth.point(x, y + stride, filled(neighbors[3]))
            - depth.point(x, y - stride, filled(neighbors[2]));
        let normal = across
            .cross(&down)
            .try_normalize(1e-12)
            .unwrap_or_else(Vector3::z);
        // On an oblique surface, the grid points are farther apart, but only along one axis. The
        // square root distributes the larger area evenly over both axes of the disc.
        let slant = (normal.dot(&here.normalize()).abs()).max(MIN_SLANT);
        let size_m = [
            SPREAD * spacing_m / slant.sqrt(),
            SPREAD * spacing_m / slant.sqrt(),
            THICKNESS * spacing_m,
        ];
        Some(Disc {
            position,
            spacing_m,
            normal: depth.world_from_camera * normal,
            size_m,
            color,
        })
    }

    /// Creates discs for the uncovered parts of a keyframe without depth. Their depths come from
    /// the nearest discs in the image, or are `default_m` if there are none.
    pub(crate) fn discs_without_depth(
        &mut self,
        keyframe: &Keyframe,
        density: Density,
        default_m: f64,
    ) -> SplatArrays {
        let mut seeds = Seeds::new();
        let stride = density.stride_px(keyframe.size_px);
        let inverse_depths = self.inverse_depths_in(keyframe, stride);
        let n_cells = inverse_depths.n_cells;
        let filled = inverse_depths.filled(1.0 / default_m);
        for row in 0..n_cells[1] {
            for column in 0..n_cells[0] {
                // Neighbors also count as covered, because a seeded position is only a sample of a
                // surface that extends to the adjacent cells.
                if inverse_depths.is_known_nearby([column, row]) {
                    continue;
                }
                let px = [(column as f64 + 0.5) * stride, (row as f64 + 0.5) * stride];
                let z = 1.0 / filled[row * n_cells[0] + column];
                let ray = [0, 1]
                    .map(|axis| (px[axis] - keyframe.principal_px[axis]) / keyframe.focal_px[axis]);
                let position = keyframe.world_from_camera
                    * Point3::from(Vector3::new(ray[0], ray[1], 1.0) * z);
                let Some(color) = color_at(keyframe, &position) else {
                    continue;
                };
                let spacing_m = stride * z / keyframe.focal_px[0];
                if !self.claim(&position, spacing_m) {
                    continue;
                }
                // The orientation of the surface is unknown. A disc that faces the camera covers
                // its cell of the image.
                let towards = keyframe.world_from_camera.translation.vector - position.coords;
                let size = [
                    SPREAD * spacing_m,
                    SPREAD * spacing_m,
                    THICKNESS * spacing_m,
                ];
                seeds.push(&position, &towards.normalize(), size, SEED_OPACITY, color);
            }
        }
        seeds.arrays
    }

    /// Inverse depths of the seeded positions in the image of a keyframe, which is divided into
    /// cells of `stride` pixels.
    fn inverse_depths_in(&self, keyframe: &Keyframe, stride: f64) -> InverseDepths {
        let [width, height] = keyframe.size_px.map(f64::from);
        let n_cells = [width, height].map(|px| (px / stride).ceil() as usize);
        let camera_from_world = keyframe.world_from_camera.inverse();
        let mut inverse_depths = InverseDepths::new(n_cells);
        for position in &self.positions {
            let point = camera_from_world * position;
            let cell = [0, 1].map(|axis| {
                let px =
                    keyframe.focal_px[axis] * point[axis] / point.z + keyframe.principal_px[axis];
                (px / stride).floor()
            });
            if point.z > 0.0
                && (0..2).all(|axis| cell[axis] >= 0.0 && cell[axis] < n_cells[axis] as f64)
            {
                inverse_depths.set_nearest([cell[0] as usize, cell[1] as usize], 1.0 / point.z);
            }
        }
        inverse_depths
    }

    /// Bytes of one position in a checkpoint.
    pub(crate) const POSITION_BYTES: u64 = 24;
    /// Bytes of one cell in a checkpoint.
    pub(crate) const CELL_BYTES: u64 = 16;

    /// Number of seeds. Each seed has one position and one cell.
    pub(crate) fn n_seeds(&self) -> usize {
        self.positions.len()
    }

    /// Copies the state for a checkpoint.
    pub(crate) fn snapshot(&self) -> SeedSnapshot {
        SeedSnapshot {
            positions: self.positions.clone(),
            cells: self.occupied_cells.iter().copied().collect(),
        }
    }

    /// Restores the state from the output of [`SeedSnapshot::into_bytes`]. Ignores incomplete
    /// positions and cells.
    pub(crate) fn from_bytes(positions: &[u8], cells: &[u8]) -> Self {
        let positions = positions
            .as_chunks::<8>()
            .0
            .iter()
            .map(|bytes| f64::from_le_bytes(*bytes));
        let cells = cells
            .as_chunks::<4>()
            .0
            .iter()
            .map(|bytes| i32::from_le_bytes(*bytes));
        let positions = positions.collect::<Vec<_>>();
        let cells = cells.collect::<Vec<_>>();
        Self {
            occupied_cells: cells
                .as_chunks()
                .0
                .iter()
                .map(|[octave, x, y, z]| (*octave, [*x, *y, *z]))
                .collect(),
            positions: positions
                .as_chunks()
                .0
                .iter()
                .map(|[x, y, z]| Point3::new(*x, *y, *z))
                .collect(),
        }
    }

    /// Median distance of the discs from cameras. `None` if there are no discs or no cameras.
    pub(crate) fn median_distance_m(&self, cameras: &[Vector3<f64>]) -> Option<f64> {
        // A sample is enough for a median.
        const N_SAMPLES: usize = 2000;
        let every = self.positions.len().div_ceil(N_SAMPLES).max(1);
        let sample = self
            .positions
            .iter()
            .step_by(every)
            .zip(cameras.iter().cycle());
        let mut distances: Vec<f64> = sample
            .map(|(position, camera)| (position.coords - camera).norm())
            .collect();
        quantile(&mut distances, 0.5, Rank::Upper)
    }

    fn is_occupied(&self, position: &Point3<f64>, spacing_m: f64) -> bool {
        // Discs of half and twice the size count as similar. A keyframe from much closer adds finer
        // discs on the same surface.
        let octave = octave_of(spacing_m);
        [octave - 1, octave, octave + 1]
            .iter()
            .any(|octave| self.occupied_cells.contains(&cell_of(position, *octave)))
    }

    fn claim(&mut self, position: &Point3<f64>, spacing_m: f64) -> bool {
        if self.is_occupied(position, spacing_m) {
            return false;
        }
        self.positions.push(*position);
        self.occupied_cells
            .insert(cell_of(position, octave_of(spacing_m)))
    }
}

fn octave_of(spacing_m: f64) -> i32 {
    spacing_m.log2().round() as i32
}

fn cell_of(position: &Point3<f64>, octave: i32) -> (i32, [i32; 3]) {
    (
        octave,
        std::array::from_fn(|axis| (position[axis] / 2f64.powi(octave)).floor() as i32),
    )
}

/// The state of a [`Seeder`] for a checkpoint.
pub(crate) struct SeedSnapshot {
    positions: Vec<Point3<f64>>,
    cells: Vec<(i32, [i32; 3])>,
}

impl SeedSnapshot {
    /// Returns the positions (x, y, z as f64) in seeding order, and the cells (octave, x, y, z as
    /// i32) in ascending order.
    pub(crate) fn into_bytes(mut self) -> (Vec<u8>, Vec<u8>) {
        // A hash set has no fixed order, and equal states must have equal checkpoints.
        self.cells.sort_unstable();
        let positions = self
            .positions
            .iter()
            .flat_map(|position| [position.x, position.y, position.z])
            .flat_map(f64::to_le_bytes);
        let cells = self
            .cells
            .iter()
            .flat_map(|(octave, [x, y, z])| [*octave, *x, *y, *z])
            .flat_map(i32::to_le_bytes);
        (positions.collect(), cells.collect())
    }
}

/// Inverse depth per cell of an image, 0 if unknown.
struct InverseDepths {
    n_cells: [usize; 2],
    per_m: Vec<f64>,
}

impl InverseDepths {
    fn new(n_cells: [usize; 2]) -> Self {
        Self {
            n_cells,
            per_m: vec![0.0; n_cells[0] * n_cells[1]],
        }
    }

    /// Sets a cell's inverse depth unless the inverse depth of a nearer surface is known.
    fn set_nearest(&mut self, [column, row]: [usize; 2], per_m: f64) {
        let known = &mut self.per_m[row * self.n_cells[0] + column];
        // A nearer surface hides farther surfaces, and its inverse depth is larger.
        *known = known.max(per_m);
    }

    /// Whether the inverse depth of the cell or one of its eight neighbors is known.
    fn is_known_nearby(&self, [column, row]: [usize; 2]) -> bool {
        let rows = row.saturating_sub(1)..(row + 2).min(self.n_cells[1]);
        rows.into_iter().any(|row| {
            let columns = column.saturating_sub(1)..(column + 2).min(self.n_cells[0]);
            self.per_m[row * self.n_cells[0]..][columns]
                .iter()
                .any(|per_m| *per_m > 0.0)
        })
    }

    /// Fills each unknown cell with a mean of known cells. The mean is over the smallest enclosing
    /// square (2, 4, 8, ... cells wide) that contains a known cell.
    fn filled(&self, default_per_m: f64) -> Vec<f64> {
        let [width, height] = self.n_cells;
        if width * height <= 1 {
            return self
                .per_m
                .iter()
                .map(|per_m| if *per_m > 0.0 { *per_m } else { default_per_m })
                .collect();
        }
        // This computes one level of a pyramid. Each coarse cell has the mean of its known cells.
        // Without known cells, it remains unknown (0). Recursion then fills the unknown coarse
        // cells.
        let mut coarse = Self::new([width.div_ceil(2), height.div_ceil(2)]);
        for (ix, mean) in coarse.per_m.iter_mut().enumerate() {
            let [column, row] = [2 * (ix % coarse.n_cells[0]), 2 * (ix / coarse.n_cells[0])];
            let square = (row..(row + 2).min(height)).flat_map(|row| {
                (column..(column + 2).min(width)).map(move |column| row * width + column)
            });
            let known: Vec<f64> = square
                .map(|at| self.per_m[at])
                .filter(|per_m| *per_m > 0.0)
                .collect();
            *mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
        }
        let neighbors = coarse.filled(default_per_m);
        let of_coarse = |ix: usize| neighbors[ix / width / 2 * coarse.n_cells[0] + ix % width / 2];
        self.per_m
            .iter()
            .enumerate()
            .map(|(ix, per_m)| if *per_m > 0.0 { *per_m } else { of_coarse(ix) })
            .collect()
    }
}

/// Creates balls at given points. Their standard deviation is the mean distance to the three
/// nearest points (Kerbl et al. 2023, section 5.1). If there are more than `n_max` points, points
/// at regular intervals of the list are used. Points without a color get the color of the first
/// keyframe that shows them.
pub(crate) fn balls(points: &InitialPoints, keyframes: &[&Keyframe], n_max: usize) -> SplatArrays {
    // If several points have one position, only the first is used, because a distance of zero
    // cannot be a size.
    let mut seen = HashSet::new();
    let is_first = |ix: &usize| seen.insert(points.points_in_world_m[*ix].map(f32::to_bits));
    let distinct: Vec<usize> = (0..points.points_in_world_m.len())
        .filter(is_first)
        .collect();
    let n = distinct.len().min(n_max);
    let chosen: Vec<usize> = (0..n).map(|ix| distinct[ix * distinct.len() / n]).collect();
    let positions: Vec<[f32; 3]> = chosen
        .iter()
        .map(|ix| points.points_in_world_m[*ix])
        .collect();
    let colors: Vec<[f64; 3]> = chosen
        .par_iter()
        .map(|ix| color_of_point(points, *ix, keyframes))
        .collect();
    let mut seeds = Seeds::new();
    for ((position, color), spacing_m) in positions
        .iter()
        .zip(colors)
        .zip(mean_spacings_m(&positions))
    {
        let Some(spacing_m) = spacing_m else { continue };
        let position = Point3::from(position.map(f64::from));
        seeds.push(
            &position,
            &Vector3::z(),
            [spacing_m; 3],
            POINT_OPACITY,
            color,
        );
    }
    seeds.arrays
}

fn color_of_point(points: &InitialPoints, ix: usize, keyframes: &[&Keyframe]) -> [f64; 3] {
    const GRAY: [f64; 3] = [0.5; 3];
    if let Some(color) = points.colors_srgb.get(ix) {
        return color.map(|channel| f64::from(channel) / 255.0);
    }
    let position = Point3::from(points.points_in_world_m[ix].map(f64::from));
    keyframes
        .iter()
        .find_map(|keyframe| color_at(keyframe, &position))
        .unwrap_or(GRAY)
}

/// Number of splats of a random cloud that remain after so many images. A scan has clouds only at
/// its beginning, because later images show surfaces together with earlier ones.
pub(crate) fn random_left(n_random: usize, n_images: usize) -> usize {
    n_random.saturating_sub(RANDOM_PER_IMAGE * n_images)
}

/// Creates a random cloud of at most `n_max` splats along the rays of keyframes, densest around a
/// point that they are expected to show.
pub(crate) fn random_cloud(
    keyframes: &[&Keyframe],
    focus: Vector3<f64>,
    seed: u64,
    n_max: usize,
) -> SplatArrays {
    let mut seeds = Seeds::new();
    if keyframes.is_empty() {
        return seeds.arrays;
    }
    // The constant separates these random numbers from others that are drawn with the same seed.
    let mut random = Random::new(seed ^ 0x5eed_5eed);
    let n = n_max.min(RANDOM_PER_IMAGE * keyframes.len());
    for _ in 0..n {
        // A random pixel of a random image gives a color, and a ray that is certainly in view. The
        // minimum is needed because the product may round up to the number of images.
        let keyframe =
            keyframes[((random.unit() * keyframes.len() as f64) as usize).min(keyframes.len() - 1)];
        let [width, height] = keyframe.size_px;
        let x = ((random.unit() * f64::from(width)) as u32).min(width - 1);
        let y = ((random.unit() * f64::from(height)) as u32).min(height - 1);
        let camera = keyframe.world_from_camera.translation.vector;
        let distance_m = (focus - camera).norm().max(1e-3);
        // Depths range from a third to three times the distance, because the scene is expected
        // around the focus. Up to the focus, they are uniform. Beyond it, they are uniform in
        // inverse depth, which suits backgrounds at unknown distances.
        let share = random.unit();
        let z = distance_m
            * if share < 0.5 {
                0.35 + 1.3 * share
            } else {
                1.0 / (1.0 - 0.66 * (2.0 * share - 1.0))
            };
        let ray = Vector3::new(
            (f64::from(x) + 0.5 - keyframe.principal_px[0]) / keyframe.focal_px[0],
            (f64::from(y) + 0.5 - keyframe.principal_px[1]) / keyframe.focal_px[1],
            1.0,
        );
        let pixel = ((y * width + x) * 4) as usize;
        let rgb = &keyframe.rgba_srgb[pixel..pixel + 4];
        // Masked pixels show no part of the scene.
        if rgb[3] == 0 {
            continue;
        }
        let position = keyframe.world_from_camera * Point3::from(ray * z);
        // This is the mean distance of the splats in one image. Each image has about `n /
        // keyframes.len()` splats. The size follows the depth, so near and far splats look equally
        // large.
        let spacing_px =
            (f64::from(width) * f64::from(height) * keyframes.len() as f64 / n as f64).sqrt();
        let size = 0.3 * spacing_px * z / keyframe.focal_px[0];
        let color = [0, 1, 2].map(|channel| f64::from(rgb[channel]) / 255.0);
        seeds.push(&position, &Vector3::z(), [size; 3], RANDOM_OPACITY, color);
    }
    seeds.arrays
}

/// Point with the smallest sum of squared distances to all optical axes.
pub(crate) fn common_focus(keyframes: &[&Keyframe]) -> Vector3<f64> {
    // The small diagonal keeps the matrix invertible if all axes are parallel, as with a single
    // image. The focus then tends to the point nearest to the origin.
    let mut normal_matrix = Matrix3::identity() * 1e-6;
    let mut rhs = Vector3::zeros();
    for keyframe in keyframes {
        let axis = keyframe.world_from_camera * Vector3::z();
        let camera = keyframe.world_from_camera.translation.vector;
        // Projects onto the plane across the axis. Its product with `point - camera` is the offset
        // of the point from the axis.
        let across = Matrix3::identity() - axis * axis.transpose();
        normal_matrix += across;
        rhs += across * camera;
    }
    normal_matrix
        .lu()
        .solve(&rhs)
        .unwrap_or_else(Vector3::zeros)
}

/// Color of the keyframe at the projection of `position`. `None` outside the image and in masked
/// areas.
fn color_at(keyframe: &Keyframe, position: &Point3<f64>) -> Option<[f64; 3]> {
    let point = keyframe.world_from_camera.inverse() * position;
    if point.z <= 0.0 {
        return None;
    }
    let pixel = [0, 1].map(|axis| {
        (keyframe.focal_px[axis] * point[axis] / point.z + keyframe.principal_px[axis]).floor()
    });
    let inside =
        (0..2).all(|axis| pixel[axis] >= 0.0 && pixel[axis] < f64::from(keyframe.size_px[axis]));
    let at = inside
        .then(|| 4 * (pixel[1] as usize * keyframe.size_px[0] as usize + pixel[0] as usize))?;
    let rgba = &keyframe.rgba_srgb[at..at + 4];
    (rgba[3] > 0).then(|| [0, 1, 2].map(|channel| f64::from(rgba[channel]) / 255.0))
}

struct Seeds {
    arrays: SplatArrays,
}

impl Seeds {
    /// Creates an empty list of splats with view-independent colors.
    fn new() -> Self {
        Self {
            arrays: SplatArrays {
                sh_degree: 0,
                ..SplatArrays::default()
            },
        }
    }

    fn push(
        &mut self,
        position: &Point3<f64>,
        normal: &Vector3<f64>,
        size_m: [f64; 3],
        opacity: f64,
        color: [f64; 3],
    ) {
        // The thin axis is z. For a normal of -z, the axis of the rotation is not unique, so x is
        // used.
        let rotation_matrix =
            Rotation3::rotation_between(&Vector3::z(), normal).unwrap_or_else(|| {
                Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
            });
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation_matrix);
        // These are the inverses of the maps from the optimized values. The maps are `exp`, the
        // logistic function, and `color = 0.5 + SH_0 * coefficient` (Kerbl et al. 2023).
        let arrays = &mut self.arrays;
        arrays.means.push(f32s_of(position.coords.into()));
        arrays
            .log_scales
            .push(f32s_of(size_m.map(|size| size.max(1e-7).ln())));
        arrays
            .rotations_wxyz
            .push(f32s_of([rotation.w, rotation.i, rotation.j, rotation.k]));
        arrays
            .opacity_logits
            .push(f32_of((opacity / (1.0 - opacity)).ln()));
        arrays
            .sh
            .push(f32s_of(color.map(|value| (value - 0.5) / SH_0)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::DepthMap;
    use kinematics::{Stamp, Transform};

    const WALL_M: f64 = 2.0;
    const DENSE: Density = Density {
        max_discs: 2000.0,
        px_per_disc: 1.0,
    };

    /// A keyframe that shows a white wall. The principal point is at the center of the image.
    fn wall_keyframe(size_px: [u32; 2], with_depth: bool) -> Keyframe {
        let principal_px = size_px.map(|px| f64::from(px) / 2.0);
        let n = (size_px[0] * size_px[1]) as usize;
        let world_from_camera = Transform::identity();
        let depth_m = vec![f32_of(WALL_M); n].into();
        let depth = DepthMap {
            size_px,
            focal_px: [100.0; 2],
            principal_px,
            depth_m,
            world_from_camera,
        };
        Keyframe {
            camera: "test".into(),
            stamp: Stamp(0),
            size_px,
            focal_px: [100.0; 2],
            principal_px,
            rgba_srgb: vec![255; 4 * n].into(),
            depth: with_depth.then_some(depth),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: keyframe::Split::Train,
            truth: None,
            robot: None,
        }
    }

    #[test]
    fn balls_have_the_positions_and_colors_of_their_points() {
        let points = InitialPoints {
            points_in_world_m: vec![
                [0.0; 3],
                [3.0, 0.0, 0.0],
                [0.0, 4.0, 0.0],
                [3.0, 4.0, 0.0],
                [0.0; 3],
            ],
            colors_srgb: vec![[255, 0, 51], [0; 3], [1; 3], [2; 3], [3; 3]],
        };
        let seeds = balls(&points, &[], 10);
        assert_eq!(
            seeds.means,
            points.points_in_world_m[..4],
            "a repeated position is used once"
        );
        let color = seeds.sh[0].map(|coefficient| SH_0 * f64::from(coefficient) + 0.5);
        assert!(
            (0..3).all(|ix| (color[ix] - [1.0, 0.0, 0.2][ix]).abs() < 1e-6),
            "{color:?}"
        );
        let size_m = (3.0 + 4.0 + 5.0) / 3.0;
        assert!(
            seeds
                .log_scales
                .as_flattened()
                .iter()
                .all(|log_scale| (log_scale.exp() - size_m).abs() < 1e-5)
        );
        assert!((0..4).all(|ix| (seeds.opacity(ix) - POINT_OPACITY).abs() < 1e-6));
        assert_eq!(
            balls(&points, &[], 2).means,
            [[0.0; 3], [0.0, 4.0, 0.0]],
            "every second one"
        );
        assert_eq!(
            balls(&points, &[], 1).n_splats(),
            0,
            "a single point has no size"
        );
        assert_eq!(balls(&InitialPoints::default(), &[], 10).n_splats(), 0);
        seeds.checked().unwrap();
    }

    #[test]
    fn points_without_colors_get_those_of_keyframes() {
        let mut keyframe = wall_keyframe([100, 80], false);
        let half_red = |ix: usize| {
            if ix % 100 < 50 {
                [255, 0, 0, 255]
            } else {
                [0, 0, 255, 255]
            }
        };
        keyframe.rgba_srgb = (0..8000).flat_map(half_red).collect();
        let points = InitialPoints {
            points_in_world_m: vec![[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0], [0.0, 0.0, -2.0]],
            colors_srgb: Vec::new(),
        };
        let seeds = balls(&points, &[&keyframe], 10);
        for (ix, expected) in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.5; 3]]
            .into_iter()
            .enumerate()
        {
            let color = seeds.sh[ix].map(|coefficient| SH_0 * f64::from(coefficient) + 0.5);
            assert!(
                (0..3).all(|channel| (color[channel] - expected[channel]).abs() < 1e-6),
                "{ix}: {color:?}"
            );
        }
    }

    #[test]
    fn batch_and_single_seeding_agree() {
        let keyframes: Vec<Arc<Keyframe>> = (0..40)
            .map(|ix| Arc::new(wall_keyframe([100 + 8 * (ix % 7), 80 + 4 * (ix % 5)], true)))
            .collect();
        let at_once = Seeder::default().discs(&keyframes, DENSE);
        let mut seeder = Seeder::default();
        let one_by_one: Vec<[f32; 3]> = keyframes
            .iter()
            .flat_map(|keyframe| seeder.discs(std::slice::from_ref(keyframe), DENSE).means)
            .collect();
        assert!(at_once.means.len() > 1500, "{} discs", at_once.means.len());
        assert_eq!(at_once.means, one_by_one);
    }

    #[test]
    fn keyframe_without_depth_seeds_only_uncovered_areas() {
        let mut seeder = Seeder::default();
        let near = wall_keyframe([100, 80], true);
        let discs = seeder.discs(&[Arc::new(near)], DENSE);
        assert!(discs.means.len() > 1000);
        let wide = wall_keyframe([200, 80], false);
        let new_discs = seeder.discs_without_depth(
            &wide,
            Density {
                max_discs: 4000.0,
                px_per_disc: 1.0,
            },
            7.0,
        );
        // Half of the wide image is uncovered. One or two cells at the border count as covered.
        assert!(
            (1500..=2100).contains(&new_discs.means.len()),
            "{} discs",
            new_discs.means.len()
        );
        for mean in &new_discs.means {
            assert!(
                (f64::from(mean[2]) - WALL_M).abs() < 1e-3,
                "expected at the depth of the wall: {mean:?}"
            );
            assert!(
                f64::from(mean[0]).abs() > 0.9,
                "expected outside the view of the camera with depth: {mean:?}"
            );
        }
        assert!(
            seeder
                .discs_without_depth(
                    &wide,
                    Density {
                        max_discs: 4000.0,
                        px_per_disc: 1.0
                    },
                    7.0
                )
                .means
                .is_empty(),
            "a second pass finds no uncovered area"
        );
    }

    #[test]
    fn discs_without_neighbors_lie_at_the_default_depth() {
        let discs = Seeder::default().discs_without_depth(
            &wall_keyframe([40, 40], false),
            Density {
                max_discs: 100.0,
                px_per_disc: 1.0,
            },
            7.0,
        );
        assert_eq!(discs.means.len(), 100);
        assert!(discs.means.iter().all(|mean| (mean[2] - 7.0).abs() < 1e-4));
    }
}
