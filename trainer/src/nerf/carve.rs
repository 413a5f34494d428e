//! Derives initial occupancy hints from images and their depth, before training.

use super::extent::Extent;
use super::reference::march::March;
use keyframe::{DepthMap, Keyframe};
use kinematics::Transform;
use model_files::contraction::largest;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Kinds of hints, as in `hint_cells.wgsl`.
const UNBOUNDED: u32 = 0;
const FREE: u32 = 1 << 30;
const SURFACE: u32 = 2 << 30;
/// Maximum distance up to which cells along rays without a reading are marked, in units of the
/// scene radius. In the contracted cube, only 1 % of the radius lies beyond this distance.
const UNBOUNDED_DISTANCE: f64 = 50.0;
/// Free space is marked along one ray for this number of depth readings. Surfaces and missing
/// readings are processed at a spacing of half a cell, but free space needs fewer rays.
const READINGS_PER_FREE_RAY: u32 = 4;
/// Radius, in pixels, of the neighborhood that distinguishes a small hole in the depth image from a
/// region that the depth camera cannot measure.
const HOLE_RADIUS_PX: u32 = 2;
/// Relative error of a reading. Cells closer than this in front of a reading are not marked as
/// free.
const DEPTH_ERROR_FRAC: f64 = 0.03;

/// Cells that images observe. They are divided into cells along rays without a reading, cells in
/// free space, and cells of surfaces.
#[derive(Debug)]
struct Cells {
    unbounded: CellSet,
    free: CellSet,
    surfaces: CellSet,
}

/// A set of cells, one bit each.
#[derive(Debug)]
struct CellSet(Vec<u64>);

impl CellSet {
    fn new(n_cells: usize) -> Self {
        Self(vec![0; n_cells.div_ceil(64)])
    }

    fn insert(&mut self, cell: usize) {
        self.0[cell / 64] |= 1 << (cell % 64);
    }

    fn extend(&mut self, other: &Self) {
        self.0
            .iter_mut()
            .zip(&other.0)
            .for_each(|(own_word, other_words)| *own_word |= other_words);
    }

    /// The cells of this set that are not in `other`, in order.
    fn difference<'a>(&'a self, other: &'a Self) -> impl Iterator<Item = u32> + 'a {
        let other_words = other.0.iter().copied().chain(std::iter::repeat(0));
        let words = (0u32..)
            .zip(self.0.iter().zip(other_words))
            .map(|(ix, (own_word, other_words))| (ix, own_word & !other_words));
        words.filter(|(_, word)| *word != 0).flat_map(|(ix, word)| {
            (0..64)
                .filter(move |bit| word >> bit & 1 == 1)
                .map(move |bit| 64 * ix + bit)
        })
    }
}

/// Origin and direction of a ray, in units of the scene radius.
type UnitRay = ([f64; 3], [f64; 3]);

/// Spacing of the rays in pixels. It is half a cell at a distance of one radius.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped"
)]
fn stride_of(focal_px: [f64; 2], march: &March) -> u32 {
    (2.0 / march.n_cells as f64 * focal_px[0]).clamp(1.0, 16.0) as u32
}

/// Whether a direction, given in the axes of another camera, is in the field of view of a depth
/// image.
fn is_in_depth_image(depth: &DepthMap, depth_from_camera: &Transform, along: Vector3<f64>) -> bool {
    let along = depth_from_camera.rotation * along;
    let is_inside = |axis: usize| {
        let pixel = depth.focal_px[axis] * along[axis] / along.z + depth.principal_px[axis];
        (0.0..f64::from(depth.size_px[axis])).contains(&pixel)
    };
    along.z > 0.0 && is_inside(0) && is_inside(1)
}

fn is_reading(z_m: f64) -> bool {
    z_m.is_finite() && z_m > 0.0
}

/// Whether most pixels around a pixel without a reading have a reading. Such a small hole is not
/// evidence of a far or unmeasurable region.
fn is_small_hole(depth: &DepthMap, [x, y]: [u32; 2]) -> bool {
    let [width, height] = depth.size_px;
    let around = |coordinate: u32, size: u32| {
        coordinate.saturating_sub(HOLE_RADIUS_PX)..(coordinate + HOLE_RADIUS_PX + 1).min(size)
    };
    let pixels =
        around(y, height).flat_map(|y| around(x, width).map(move |x| (y * width + x) as usize));
    // A hole, such as a reflection, is surrounded by readings. In a window or the sky, the
    // surrounding readings are also missing.
    let (n, n_read) = pixels.fold((0, 0), |(n, n_read), pixel| {
        (
            n + 1,
            n_read + usize::from(is_reading(depth.depth_m[pixel].into())),
        )
    });
    2 * n_read > n
}

/// World width of the cell around a point. Cells in the contracted region are wider.
fn cell_width(march: &March, point: [f64; 3]) -> f64 {
    // Contraction scales lengths along a ray by 1 / |x|^2 outside the inner cube.
    4.0 / march.n_cells as f64 * largest(point).1.max(1.0).powi(2)
}

/// Derives occupancy hints from images, at most one per cell. Cells that no image observes get no
/// hint.
pub(crate) fn hints(keyframes: &[&Keyframe], extent: &Extent, march: &March) -> Vec<u32> {
    let empty = || Cells::new(march.n_cells.pow(3));
    let Cells {
        unbounded,
        free,
        surfaces,
    } = keyframes
        .par_iter()
        // Each thread collects its own sets. Their union does not depend on the order in which they
        // are joined.
        .fold(empty, |mut cells, keyframe| {
            if let Some(depth) = &keyframe.depth {
                cells.add_depth_image(depth, extent, march);
            }
            cells.add_color_only_rays(keyframe, extent, march);
            cells
        })
        .reduce(empty, Cells::and);
    // Surfaces have priority over free space, because rays of other images may graze a surface.
    // Free space has priority over missing readings, which are no evidence.
    let unbounded = unbounded.difference(&free).map(|cell| cell | UNBOUNDED);
    let free = free.difference(&surfaces).map(|cell| cell | FREE);
    let nothing = CellSet::new(0);
    unbounded
        .chain(free)
        .chain(surfaces.difference(&nothing).map(|cell| cell | SURFACE))
        .collect()
}

impl Cells {
    fn new(n_cells: usize) -> Self {
        let [unbounded, free, surfaces] = [(); 3].map(|()| CellSet::new(n_cells));
        Self {
            unbounded,
            free,
            surfaces,
        }
    }

    fn and(mut self, other: Self) -> Self {
        self.unbounded.extend(&other.unbounded);
        self.free.extend(&other.free);
        self.surfaces.extend(&other.surfaces);
        self
    }

    /// Adds the hints of a depth image.
    fn add_depth_image(&mut self, depth: &DepthMap, extent: &Extent, march: &March) {
        let stride = stride_of(depth.focal_px, march);
        let origin = extent
            .in_scene_units(&depth.world_from_camera)
            .translation
            .vector
            .into();
        let [width, height] = depth.size_px;
        for y in (0..height).step_by(stride as usize) {
            for x in (0..width).step_by(stride as usize) {
                let along = depth.point(x, y, 1.0);
                let z_m = f64::from(depth.depth_m[(y * width + x) as usize]);
                let reading_m = if is_reading(z_m) {
                    z_m * along.norm()
                } else {
                    0.0
                };
                let ray = (
                    origin,
                    (depth.world_from_camera.rotation * along.normalize()).into(),
                );
                let is_unbounded = reading_m == 0.0;
                // The readings around a small hole mark the same cells better.
                if is_unbounded && is_small_hole(depth, [x, y]) {
                    continue;
                }
                if is_unbounded
                    || [x, y].into_iter().all(|coordinate| {
                        (coordinate / stride).is_multiple_of(READINGS_PER_FREE_RAY)
                    })
                {
                    self.mark_along_ray(march, ray, reading_m / extent.radius_m);
                }
                if !is_unbounded {
                    self.mark_surface(march, ray, reading_m / extent.radius_m);
                }
            }
        }
    }

    /// Adds the rays of a color image that are outside the field of view of its depth image, as
    /// rays without a reading.
    fn add_color_only_rays(&mut self, keyframe: &Keyframe, extent: &Extent, march: &March) {
        let Keyframe {
            size_px: [width, height],
            focal_px,
            principal_px,
            world_from_camera,
            depth,
            ..
        } = keyframe;
        let depth = depth
            .as_ref()
            .map(|depth| (depth, depth.world_from_camera.inverse() * world_from_camera));
        let stride = stride_of(*focal_px, march) as usize;
        let origin = extent
            .in_scene_units(world_from_camera)
            .translation
            .vector
            .into();
        for y in (0..*height).step_by(stride) {
            for x in (0..*width).step_by(stride) {
                let coordinate = [x, y].map(|pixel| f64::from(pixel) + 0.5);
                let [right, down] =
                    [0, 1].map(|axis| (coordinate[axis] - principal_px[axis]) / focal_px[axis]);
                let along = Vector3::new(right, down, 1.0).normalize();
                // If the depth image covers the same direction, its hints are better.
                let is_in_depth = depth
                    .as_ref()
                    .is_some_and(|(depth, pose)| is_in_depth_image(depth, pose, along));
                if !is_in_depth {
                    self.mark_along_ray(
                        march,
                        (origin, (world_from_camera.rotation * along).into()),
                        0.0,
                    );
                }
            }
        }
    }

    /// Marks the cells along a ray up to its reading, or up to [`UNBOUNDED_DISTANCE`] if `distance`
    /// is 0.
    fn mark_along_ray(&mut self, march: &March, (origin, direction): UnitRay, distance: f64) {
        let point = |t: f64| std::array::from_fn(|axis| origin[axis] + t * direction[axis]);
        let cell = |t: f64| march.cell(point(t)).0;
        let width = |t: f64| cell_width(march, point(t));
        let is_unbounded = distance == 0.0;
        // Free space ends before the reading, at a distance of its error plus the width of a cell,
        // so that the cell of the surface is not carved.
        let end = if is_unbounded {
            UNBOUNDED_DISTANCE
        } else {
            distance * (1.0 - DEPTH_ERROR_FRAC) - width(distance)
        };
        let passed = if is_unbounded {
            &mut self.unbounded
        } else {
            &mut self.free
        };
        // The step is half a cell, so that few of the crossed cells are missed.
        let mut t = 0.0;
        while t < end {
            passed.insert(cell(t));
            t += 0.5 * width(t);
        }
    }

    /// Marks the cells around a reading, up to one cell width in front of it and behind it.
    fn mark_surface(&mut self, march: &March, (origin, direction): UnitRay, distance: f64) {
        let point = |t: f64| std::array::from_fn(|axis| origin[axis] + t * direction[axis]);
        let width = cell_width(march, point(distance));
        for part in [-1.0, -0.5, 0.0, 0.5, 1.0] {
            self.surfaces
                .insert(march.cell(point((distance + part * width).max(0.0))).0);
        }
    }
}
