//! Aligns depth images to the pixels of a color camera next to the depth camera.
//!
//! Source: the processing block `align` of librealsense (`src/proc/align.cpp`). A depth pixel is a
//! square. Two opposite corners are projected to the color image at the depth of the pixel, and
//! each color pixel keeps the nearest square that covers it. This module clips squares at the edge
//! of the image, whereas librealsense drops them. The SSE path of librealsense
//! (`src/proc/sse/sse-align.cpp`) rounds half a pixel further to the right and down. It also uses
//! only the upper left corner if the color image has fewer pixels per angle than the depth image.
//! This module follows the scalar path of librealsense, which has neither of these two deviations.

mod cover;

use crate::{Error, Image, PixelFormat};
use cover::{MAX_COLUMNS, NearestDepth, PixelBounds};
use kinematics::{Intrinsics, Lens, Transform};
use std::sync::Arc;

/// Aligns depth images of one camera to the pixels of another. Precomputes everything that does not
/// depend on the image.
#[derive(Clone, Debug)]
pub struct DepthAlignment {
    depth_px: [u32; 2],
    color: ColorCamera,
    /// Rays of the pixel corners, `[height + 1, width + 1]`. They have `z` = 1 in the depth camera,
    /// and are rotated to the axes of the color camera.
    corners: [Vec<f32>; 3],
    /// Position of the depth camera in the frame of the color camera, meters.
    depth_in_color: [f64; 3],
}

/// [`Intrinsics`] in f32.
#[derive(Clone, Debug)]
struct ColorCamera {
    size_px: [u32; 2],
    focal_px: [f32; 2],
    principal_px: [f32; 2],
    lens: ColorLens,
    /// Square of the largest valid radius on the plane `z` = 1. Beyond this radius, distortion
    /// polynomials may not be monotonic.
    max_radius_squared: f32,
}

#[derive(Clone, Copy, Debug)]
enum ColorLens {
    Pinhole,
    BrownConrady([f32; 5]),
    KannalaBrandt([f32; 4]),
    RationalBrownConrady([f32; 8]),
}

/// A corner of the pixels of one row of depth.
#[derive(Clone, Copy)]
enum Corner {
    /// Upper left corner. The column of a hidden corner is set beyond the right edge of the image.
    First,
    /// Lower right corner. The column of a hidden corner is set beyond the left edge of the image.
    Last,
}

/// Maps a ray to a position in the color image.
struct View {
    /// Position of the depth camera in the frame of the color camera, in units of one count.
    depth_in_color: [f32; 3],
    focal_px: [f32; 2],
    principal_px: [f32; 2],
    /// Position used for points that the color camera cannot see.
    hidden_px: f32,
}

/// Buffers for one row of depth.
struct Row {
    /// Depth along z.
    counts: Vec<u16>,
    /// The counts as floats.
    numbers: Vec<f32>,
    /// Columns and rows in the color image, pixels.
    positions_px: [Vec<f32>; 2],
    bounds: PixelBounds,
}

/// Work that runs with vector instructions.
struct Task<'a> {
    alignment: &'a DepthAlignment,
    /// The counts of the depth image. Each count has two bytes, little endian.
    counts: &'a [u8],
    meters_per_count: f64,
}

impl pulp::NullaryFnOnce for Task<'_> {
    type Output = Arc<[u8]>;

    #[inline(always)]
    fn call(self) -> Arc<[u8]> {
        let aligned = self
            .alignment
            .align_counts(self.counts.as_chunks().0, self.meters_per_count);
        let mut data: Arc<[u8]> = std::iter::repeat_n(0, 2 * aligned.len()).collect();
        let bytes = Arc::get_mut(&mut data).expect("the buffer was just created and is not shared");
        for (bytes, count_minus_one) in bytes.as_chunks_mut::<2>().0.iter_mut().zip(aligned) {
            // The images store counts minus one. The count 0 ("no depth") thus becomes the largest
            // number, which loses every comparison.
            let count = count_minus_one.wrapping_add(1);
            // The largest count is invalid, too.
            *bytes = if count == u16::MAX {
                [0; 2]
            } else {
                count.to_le_bytes()
            };
        }
        data
    }
}

impl DepthAlignment {
    /// Prepares the alignment of a depth camera to a color camera. Both lenses may be distorted.
    pub fn new(depth: &Intrinsics, color: &Intrinsics, color_from_depth: &Transform) -> Self {
        let [width, height] = depth.size_px;
        let rays = (0..=height)
            .flat_map(|row| (0..=width).map(move |column| [f64::from(column), f64::from(row)]));
        let rays: Vec<[f64; 3]> = rays
            .map(|corner| match depth.unproject(corner) {
                Some(ray) => (color_from_depth.rotation * ray).into(),
                // NaN passes through all computations and fails the comparison that decides whether
                // a pixel is visible.
                None => [f64::NAN; 3],
            })
            .collect();
        Self {
            depth_px: depth.size_px,
            color: ColorCamera::new(color),
            corners: std::array::from_fn(|axis| rays.iter().map(|ray| narrow(ray[axis])).collect()),
            depth_in_color: color_from_depth.translation.vector.into(),
        }
    }

    /// Resamples the depth image to the pixels of the color image. Counts keep their unit and
    /// measure depth along the z axis of the depth camera. A count of 0 means no depth. Input
    /// pixels with a count of 0 or with the largest count are invalid and are skipped.
    ///
    /// # Errors
    /// Fails if the image contains no depth, or if its size differs from the size of the depth
    /// camera.
    pub fn align(&self, depth: &Image) -> Result<Image, Error> {
        let PixelFormat::DepthU16 { meters_per_count } = depth.format else {
            return Err(depth.wrong_kind("depth"));
        };
        if depth.size_px != self.depth_px {
            return Err(Error::ImageSize {
                camera: depth.camera.to_string(),
                stamp: depth.stamp,
                got_px: depth.size_px,
                expected_px: self.depth_px,
            });
        }
        // Runs with the widest vector instructions of this CPU.
        let task = Task {
            alignment: self,
            counts: depth.raw_bytes()?,
            meters_per_count,
        };
        let data = pulp::Arch::new().dispatch(task);
        Ok(Image {
            size_px: self.color.size_px,
            data,
            ..depth.clone()
        })
    }

    /// Nearest count minus one of each color pixel. The invalid count 0 wraps to the largest
    /// number, so every valid count is nearer.
    #[inline(always)]
    fn align_counts(&self, counts: &[[u8; 2]], meters_per_count: f64) -> Vec<u16> {
        let depth_width = self.depth_px[0] as usize;
        let mut nearest_depth =
            NearestDepth::new(self.color.size_px.map(|side| side as usize), depth_width);
        let pixel_bounds = || [vec![0; depth_width], vec![0; depth_width]];
        let mut work = Row {
            counts: vec![0; depth_width],
            numbers: vec![0.0; depth_width],
            positions_px: [vec![0.0; depth_width], vec![0.0; depth_width]],
            bounds: PixelBounds {
                first: pixel_bounds(),
                last: pixel_bounds(),
            },
        };
        // The position is in units of one count, so that counts need no scaling.
        let depth_in_color = self
            .depth_in_color
            .map(|meters| narrow(meters / meters_per_count));
        for (row_ix, row) in counts.chunks_exact(depth_width.max(1)).enumerate() {
            work.counts
                .iter_mut()
                .zip(row)
                .for_each(|(count, bytes)| *count = u16::from_le_bytes(*bytes));
            work.numbers
                .iter_mut()
                .zip(&work.counts)
                .for_each(|(number, count)| *number = f32::from(*count));
            let first_corner = row_ix * (depth_width + 1);
            self.project(&mut work, depth_in_color, first_corner, Corner::First);
            // The opposite corners are one row and one column further.
            self.project(
                &mut work,
                depth_in_color,
                first_corner + depth_width + 2,
                Corner::Last,
            );
            nearest_depth.put(&work.counts, &work.bounds);
        }
        nearest_depth.into_nearest()
    }

    /// Projects the corners of a row to columns and rows of the color image. `start` is the index
    /// of the first corner.
    #[inline(always)]
    fn project(&self, work: &mut Row, depth_in_color: [f32; 3], start: usize, corner: Corner) {
        let view = View {
            depth_in_color,
            focal_px: self.color.focal_px,
            principal_px: self.color.principal_px,
            hidden_px: match corner {
                Corner::First => f32::MAX,
                Corner::Last => -1.0,
            },
        };
        let max_radius_squared = self.color.max_radius_squared;
        let [columns, rows] = &mut work.positions_px;
        let counts = &work.numbers;
        let rays = [0, 1, 2].map(|axis| &self.corners[axis][start..]);
        match self.color.lens {
            ColorLens::Pinhole => {
                project_by(columns, rows, counts, rays, &view, |x, y| ([x, y], true))
            }
            ColorLens::BrownConrady(k) => project_by(columns, rows, counts, rays, &view, |x, y| {
                let r2 = x * x + y * y;
                (brown_conrady(k, x, y, r2), r2 <= max_radius_squared)
            }),
            ColorLens::RationalBrownConrady(k) => {
                project_by(columns, rows, counts, rays, &view, |x, y| {
                    let r2 = x * x + y * y;
                    (
                        rational_brown_conrady(k, x, y, r2),
                        r2 <= max_radius_squared,
                    )
                })
            }
            ColorLens::KannalaBrandt(k) => {
                project_by(columns, rows, counts, rays, &view, |x, y| {
                    let r2 = x * x + y * y;
                    (kannala_brandt(k, x, y, r2), r2 <= max_radius_squared)
                })
            }
        }
        let pixel_bounds = match corner {
            Corner::First => &mut work.bounds.first,
            Corner::Last => &mut work.bounds.last,
        };
        for ((pixel_bounds, positions_px), side) in pixel_bounds
            .iter_mut()
            .zip(&work.positions_px)
            .zip(self.color.size_px)
        {
            number(pixel_bounds, positions_px, side, corner);
        }
    }
}

/// Projects rays to columns and rows of the color image. `distort` maps a point of the plane `z` =
/// 1 to its distorted position and returns whether the lens model is valid there. The function has
/// no branches and takes each slice as its own argument, so that the compiler vectorizes it.
#[inline(always)]
fn project_by(
    columns: &mut [f32],
    rows: &mut [f32],
    counts: &[f32],
    [xs, ys, zs]: [&[f32]; 3],
    view: &View,
    distort: impl Fn(f32, f32) -> ([f32; 2], bool),
) {
    let n = counts.len();
    // Slices of one length need no bounds checks in the loop.
    let xs = &xs[..n];
    let ys = &ys[..n];
    let zs = &zs[..n];
    let columns = &mut columns[..n];
    let rows = &mut rows[..n];
    let View {
        depth_in_color: [tx, ty, tz],
        focal_px: [fx, fy],
        principal_px: [cx, cy],
        hidden_px,
    } = *view;
    for ix in 0..n {
        // The ray was rotated in advance, so a point in the color camera is only a scaled ray plus
        // the offset between the cameras.
        let z = counts[ix] * zs[ix] + tz;
        // One division replaces two, because a division takes several times as long as a
        // multiplication.
        let inverse = 1.0 / z;
        let x = (counts[ix] * xs[ix] + tx) * inverse;
        let y = (counts[ix] * ys[ix] + ty) * inverse;
        let ([distorted_x, distorted_y], is_valid) = distort(x, y);
        // Moving the column out of the image is sufficient to hide a pixel.
        columns[ix] = if (z > 0.0) & is_valid {
            distorted_x * fx + cx
        } else {
            hidden_px
        };
        rows[ix] = distorted_y * fy + cy;
    }
}

/// Converts positions to pixel indices, which start at 1, and clips them. [`Corner::First`] also
/// allows the index after the last pixel of the image. [`Corner::Last`] also allows the index
/// before the first pixel.
#[expect(
    clippy::cast_possible_truncation,
    reason = "the low 16 bits are the index"
)]
#[inline(always)]
fn number(numbers: &mut [u16], positions_px: &[f32], side: u32, corner: Corner) {
    // Columns and rows beyond this limit get no depth.
    let side = (side as usize).min(MAX_COLUMNS) as f32;
    let (min, max) = match corner {
        Corner::First => (1.0, side + 1.0),
        Corner::Last => (0.0, side),
    };
    // Above 2^23, floats have no fraction and their low bits are the integer.
    const INTEGER_FLOAT: f32 = 8_388_608.0;
    let n = positions_px.len();
    let numbers = &mut numbers[..n];
    let positions_px = &positions_px[..n];
    for ix in 0..n {
        // These comparisons compile to vector instructions. `max` and `min` do not, because they
        // must handle NaN.
        let one_based = positions_px[ix] + 1.0;
        let one_based = if one_based > min { one_based } else { min };
        let one_based = if one_based < max { one_based } else { max };
        // Adding and subtracting the constant rounds to the nearest integer. If the result was
        // rounded up, one is subtracted to obtain the integer below.
        let nearest = (one_based + INTEGER_FLOAT) - INTEGER_FLOAT;
        let below = nearest - if nearest > one_based { 1.0 } else { 0.0 };
        numbers[ix] = (below + INTEGER_FLOAT).to_bits() as u16;
    }
}

impl ColorCamera {
    fn new(camera: &Intrinsics) -> Self {
        let lens = match camera.lens {
            // Lenses without distortion take the fastest of the loops.
            _ if camera.is_pinhole() => ColorLens::Pinhole,
            Lens::Pinhole => ColorLens::Pinhole,
            Lens::BrownConrady(k) => ColorLens::BrownConrady(k.map(narrow)),
            Lens::KannalaBrandt(k) => ColorLens::KannalaBrandt(k.map(narrow)),
            Lens::RationalBrownConrady(k) => ColorLens::RationalBrownConrady(k.map(narrow)),
        };
        let max_radius = if matches!(lens, ColorLens::Pinhole) {
            f64::INFINITY
        } else {
            max_radius(camera)
        };
        Self {
            size_px: camera.size_px,
            focal_px: camera.focal_px.map(narrow),
            principal_px: camera.principal_px.map(narrow),
            lens,
            max_radius_squared: narrow(max_radius * max_radius),
        }
    }
}

/// Largest radius on the plane `z` = 1 at the edge of the image, plus a margin for corners just
/// outside.
fn max_radius(camera: &Intrinsics) -> f64 {
    // Squares at the edge of the image have corners outside the image. These corners must still be
    // projected. A larger margin would reach the radii at which distortion polynomials stop
    // increasing. Depth from far outside the field of view would then be drawn into the image.
    const MARGIN: f64 = 1.02;
    let [width, height] = camera.size_px;
    // The principal point may be off center, and the tangential part of the distortion is not
    // symmetric. The largest radius is therefore not necessarily in a corner, so the whole border
    // is searched.
    let columns = (0..=width).flat_map(|column| [[column, 0], [column, height]]);
    let rows = (0..=height).flat_map(|row| [[0, row], [width, row]]);
    let radii = columns
        .chain(rows)
        .filter_map(|pixel| Some(camera.unproject(pixel.map(f64::from))?.xy().norm()));
    let largest = radii.fold(0.0, f64::max);
    largest * MARGIN
}

/// Distortion as defined in [`kinematics::Lens`].
#[inline(always)]
fn brown_conrady([k1, k2, p1, p2, k3]: [f32; 5], x: f32, y: f32, r2: f32) -> [f32; 2] {
    let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let xy2 = 2.0 * x * y;
    [
        x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy2,
    ]
}

/// Distortion as defined in [`kinematics::Lens`].
#[inline(always)]
fn rational_brown_conrady(
    [k1, k2, p1, p2, k3, k4, k5, k6]: [f32; 8],
    x: f32,
    y: f32,
    r2: f32,
) -> [f32; 2] {
    let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    let xy2 = 2.0 * x * y;
    [
        x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy2,
    ]
}

/// Distortion as defined in [`kinematics::Lens`].
#[inline(always)]
fn kannala_brandt([k1, k2, k3, k4]: [f32; 4], x: f32, y: f32, r2: f32) -> [f32; 2] {
    let radius = r2.sqrt();
    let angle = radius.atan();
    let a2 = angle * angle;
    let distorted = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
    let scale = if radius > 0.0 {
        distorted / radius
    } else {
        1.0
    };
    [x * scale, y * scale]
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "f32 is accurate to 1e-4 pixels"
)]
fn narrow(number: f64) -> f32 {
    number as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Stamp;
    use nalgebra::{Translation3, UnitQuaternion};

    const METERS_PER_COUNT: f64 = 1e-3;

    fn camera([width, height]: [u32; 2], focal_px: f64, lens: Lens) -> Intrinsics {
        Intrinsics {
            size_px: [width, height],
            focal_px: [focal_px, focal_px * 1.003],
            principal_px: [f64::from(width) * 0.503, f64::from(height) * 0.494],
            lens,
            rectified: false,
        }
    }

    fn image(size_px: [u32; 2], counts: &[u16]) -> Image {
        Image {
            camera: "wrist".into(),
            stamp: Stamp(7),
            size_px,
            format: PixelFormat::DepthU16 {
                meters_per_count: METERS_PER_COUNT,
            },
            data: counts
                .iter()
                .flat_map(|count| count.to_le_bytes())
                .collect(),
            exposure_secs: None,
            n_skipped: 0,
        }
    }

    fn counts(image: &Image) -> Vec<u16> {
        image
            .data
            .as_chunks::<2>()
            .0
            .iter()
            .map(|&bytes| u16::from_le_bytes(bytes))
            .collect()
    }

    /// A slanted wall with a box in front of it, and holes.
    fn scene([width, height]: [u32; 2]) -> Vec<u16> {
        let count = |column: u32, row: u32| match (column * 7 + row * 13) % 41 {
            0 => 0,
            _ if column > width / 3 && column < width / 2 && row > height / 4 => {
                600 + (column % 50)
            }
            _ => 900 + 400 * column / width + 300 * row / height,
        };
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        pixels
            .map(|(column, row)| u16::try_from(count(column, row)).expect("below two meters"))
            .collect()
    }

    /// The twin of the alignment. It draws the same squares in f64 with the lenses of `kinematics`.
    fn twin(
        depth: &Intrinsics,
        color: &Intrinsics,
        color_from_depth: &Transform,
        counts: &[u16],
    ) -> Vec<u16> {
        let [width, height] = color.size_px.map(i64::from);
        let mut aligned = vec![0; color.size_px.map(|side| side as usize).iter().product()];
        for (ix, &count) in counts
            .iter()
            .enumerate()
            .filter(|(_, count)| **count > 0 && **count < u16::MAX)
        {
            let column = (ix % depth.size_px[0] as usize) as f64;
            let row = (ix / depth.size_px[0] as usize) as f64;
            let visible = |corner: [f64; 2]| {
                let point = depth.unproject(corner)? * (f64::from(count) * METERS_PER_COUNT);
                let pixel = color.project(
                    &(color_from_depth.rotation * point + color_from_depth.translation.vector),
                )?;
                #[expect(
                    clippy::cast_possible_truncation,
                    reason = "the cast saturates as intended"
                )]
                let cell = |position: f64| position.floor() as i64;
                Some(pixel.map(cell))
            };
            let (Some([left, top]), Some([right, bottom])) =
                (visible([column, row]), visible([column + 1.0, row + 1.0]))
            else {
                continue;
            };
            for y in top.max(0)..=bottom.min(height - 1) {
                for x in left.max(0)..=right.min(width - 1) {
                    let nearest: &mut u16 =
                        &mut aligned[usize::try_from(y * width + x).expect("inside the image")];
                    *nearest = if *nearest == 0 {
                        count
                    } else {
                        count.min(*nearest)
                    };
                }
            }
        }
        aligned
    }

    /// As on a D435, the color camera is 15 mm to the side of the depth camera and slightly
    /// rotated.
    fn color_from_depth_like_d435() -> Transform {
        Transform::from_parts(
            Translation3::new(0.0148, 0.0002, 0.0003),
            UnitQuaternion::from_euler_angles(0.003, -0.006, 0.002),
        )
    }

    fn equal_frac(a: &[u16], b: &[u16]) -> f64 {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).filter(|(a, b)| a == b).count() as f64 / a.len() as f64
    }

    #[test]
    fn aligned_depth_matches_twin() {
        // Because of rounding to f32, about one corner in ten thousand falls on the other side of a
        // pixel edge.
        const EQUAL_FRAC: f64 = 0.999;
        let size_px = [320, 240];
        let scene = scene(size_px);
        let fisheye = Lens::KannalaBrandt([-0.01, 0.02, -0.015, 0.003]);
        let d455 = Lens::BrownConrady([-0.0555, 0.0657, -0.0006, 0.0004, -0.0213]);
        let rational =
            Lens::RationalBrownConrady([0.4, -0.1, 0.001, -0.0005, 0.01, 0.7, -0.02, 0.03]);
        let lenses = [
            (Lens::Pinhole, Lens::Pinhole),
            (Lens::Pinhole, d455),
            (d455, fisheye),
            (Lens::Pinhole, rational),
        ];
        for (depth_lens, color_lens) in lenses {
            // Squares are at most 2, 4, 7 and 2 columns wide. In the last case, several squares
            // share a column.
            let cameras = [
                ([320, 240], 300.0),
                ([640, 360], 455.0),
                ([1280, 720], 1000.0),
                ([160, 120], 140.0),
            ];
            for (color_px, focal_px) in cameras {
                let (depth, color) = (
                    camera(size_px, 190.0, depth_lens),
                    camera(color_px, focal_px, color_lens),
                );
                let alignment = DepthAlignment::new(&depth, &color, &color_from_depth_like_d435());
                let got = counts(&alignment.align(&image(size_px, &scene)).expect("depth"));
                let expected = twin(&depth, &color, &color_from_depth_like_d435(), &scene);
                let equal = equal_frac(&got, &expected);
                assert!(equal >= EQUAL_FRAC, "{color_lens:?} {color_px:?}: {equal}");
                assert!(
                    expected.iter().filter(|count| **count > 0).count() > expected.len() / 2,
                    "the scene is not visible"
                );
                // The comparison detects an offset of the camera by one centimeter.
                let shifted = Transform::from_parts(
                    Translation3::new(0.025, 0.0, 0.0),
                    color_from_depth_like_d435().rotation,
                );
                assert!(equal_frac(&got, &twin(&depth, &color, &shifted, &scene)) < EQUAL_FRAC);
            }
        }
    }

    #[test]
    fn very_wide_images_match_twin() {
        for width in [20_000, 40_000] {
            let camera = |focal_px| camera([width, 5], focal_px, Lens::Pinhole);
            let (depth, color) = (camera(12_000.0), camera(20_000.0));
            let shifted = Transform::translation(0.0148, 0.0, 0.0);
            let scene = scene(depth.size_px);
            let alignment = DepthAlignment::new(&depth, &color, &shifted);
            let got = counts(
                &alignment
                    .align(&image(depth.size_px, &scene))
                    .expect("depth"),
            );
            let expected = twin(&depth, &color, &shifted, &scene);
            // So far from the center, f32 is accurate to a few thousandths of a pixel.
            let equal = equal_frac(&got, &expected);
            assert!(equal >= 0.99, "{width}: {equal}");
            assert!(
                expected.iter().filter(|count| **count > 0).count() > expected.len() / 2,
                "the scene is not visible"
            );
        }
    }

    #[test]
    fn disparity_is_baseline_over_depth_with_occlusion() {
        // 400 px * 51.25 mm / 1 m is 20.5 px to the right. No corner lies on the edge of a pixel
        // column.
        let camera = Intrinsics {
            focal_px: [400.0; 2],
            principal_px: [32.0, 16.25],
            ..camera([64, 32], 1.0, Lens::Pinhole)
        };
        let color = Intrinsics {
            principal_px: [32.0, 16.75],
            ..camera.clone()
        };
        let shifted = Transform::translation(0.05125, 0.0, 0.0);
        let alignment = DepthAlignment::new(&camera, &color, &shifted);
        let wall = alignment
            .align(&image([64, 32], &[1000; 64 * 32]))
            .expect("depth");
        for (ix, count) in counts(&wall).into_iter().enumerate() {
            assert_eq!(
                count,
                if ix % 64 < 20 { 0 } else { 1000 },
                "column {} row {}",
                ix % 64,
                ix / 64
            );
        }
        // At 0.5 m the disparity is 41 px: columns 10 to 13 map to 51 to 54 and touch at most 55.
        let mut with_box = [1000; 64 * 32];
        (0..64 * 32)
            .filter(|ix| (10..14).contains(&(ix % 64)))
            .for_each(|ix| with_box[ix] = 500);
        let aligned = counts(&alignment.align(&image([64, 32], &with_box)).expect("depth"));
        for row in aligned.chunks(64) {
            assert!(row[51..54].iter().all(|count| *count == 500), "{row:?}");
            assert!(
                row[56..]
                    .iter()
                    .chain(&row[20..30])
                    .all(|count| *count == 1000),
                "{row:?}"
            );
        }
    }

    #[test]
    fn invalid_and_behind_camera_depth_is_dropped() {
        let camera = camera(
            [64, 48],
            60.0,
            Lens::BrownConrady([0.1, 0.0, 0.0, 0.0, 0.0]),
        );
        // The color camera is 1 mm in front of the depth camera, so a count of 1 lies in its
        // center.
        for z in [-0.001, -0.000_999_99, -1.0, f64::NAN] {
            let alignment =
                DepthAlignment::new(&camera, &camera, &Transform::translation(0.0, 0.0, z));
            for count in [0, 1, 2, u16::MAX] {
                let aligned = alignment
                    .align(&image([64, 48], &[count; 64 * 48]))
                    .expect("depth");
                let visible = counts(&aligned);
                assert!(
                    visible
                        .iter()
                        .all(|visible| *visible == 0 || *visible == count)
                );
                assert!(
                    ![0, u16::MAX].contains(&count) || visible.iter().all(|visible| *visible == 0)
                );
            }
        }
        let alignment = DepthAlignment::new(&camera, &camera, &Transform::identity());
        assert!(matches!(
            alignment.align(&image([64, 47], &[0; 64 * 47])),
            Err(Error::ImageSize { .. })
        ));
        assert!(matches!(
            alignment.align(&image([64, 48], &[0; 64 * 47])),
            Err(Error::ImageLength { .. })
        ));
        let color = Image {
            format: PixelFormat::Gray8,
            ..image([64, 48], &[0; 32 * 48])
        };
        assert!(matches!(
            alignment.align(&color),
            Err(Error::WrongKind {
                expected: "depth",
                ..
            })
        ));
    }
}
