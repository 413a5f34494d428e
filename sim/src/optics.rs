//! Converts rendered pinhole images to sensor images, with lens distortion, rolling shutter and
//! motion blur.
#![expect(
    clippy::cast_possible_truncation,
    reason = "pixel positions are clamped to the picture before the cast"
)]

use crate::Error;
use crate::config::CameraConfig;
use crate::render::{Picture, View};
use crate::robot::RobotPose;
use kinematics::{Intrinsics, Transform};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::{IndexedParallelIterator, ParallelIterator, ParallelSliceMut};

/// Precomputed optics of one camera.
#[derive(Clone, Debug)]
pub(crate) struct Optics {
    intrinsics: Intrinsics,
    supersample: u32,
    margin_px: u32,
    /// `[height, width]`: x and y of the point at z = 1 on the ray of each pixel's center.
    rays: Vec<[f32; 2]>,
    /// Size of the images to render. They are supersampled, and cover the camera image plus a
    /// margin. The next field is their pinhole.
    view_size_px: [u32; 2],
    view_focal_px: [f64; 2],
    view_principal_px: [f64; 2],
    /// Focal length and principal point of the rendered images.
    drawn_pinhole_px: [[f32; 2]; 2],
}

/// Pose of the camera at another instant, in the frame of the rendered image, in f32.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RowMotion {
    rotation_matrix: Matrix3<f32>,
    translation_m: Vector3<f32>,
}

impl RowMotion {
    pub(crate) fn new(drawn_from_camera: &Transform) -> Self {
        Self {
            rotation_matrix: drawn_from_camera
                .rotation
                .to_rotation_matrix()
                .matrix()
                .cast(),
            translation_m: drawn_from_camera.translation.vector.cast(),
        }
    }
}

/// Maximum number of iterations that correct the pixel position until its depth matches the ray. On
/// most surfaces, one iteration is enough. At depth edges, the search may never converge.
const MAX_CORRECTIONS: usize = 3;
/// Relative depth tolerance. At the speeds of the arm, a depth error of this size moves a point by
/// less than 0.02 pixels.
const SAME_DEPTH_FRAC: f32 = 0.005;

impl Optics {
    pub(crate) fn new(camera: &CameraConfig, is_motion_free: bool) -> Result<Self, Error> {
        Self::with_lens(
            camera,
            &camera.intrinsics,
            camera.sensor.supersample,
            is_motion_free,
        )
    }

    /// Optics of another sensor in the same camera.
    pub(crate) fn with_lens(
        camera: &CameraConfig,
        intrinsics: &Intrinsics,
        supersample: u32,
        is_motion_free: bool,
    ) -> Result<Self, Error> {
        let intrinsics = intrinsics.clone();
        let [width, height] = intrinsics.size_px;
        let mut rays = Vec::with_capacity(width as usize * height as usize);
        // The inverse of the lens model is computed once, because it is iterative and slow.
        for row in 0..height {
            for column in 0..width {
                let pixel = [f64::from(column) + 0.5, f64::from(row) + 0.5];
                let point = intrinsics.unproject(pixel).ok_or_else(|| Error::Lens {
                    camera: camera.name.clone(),
                    pixel,
                })?;
                rays.push([point.x as f32, point.y as f32]);
            }
        }
        // Rolling shutter and blur show content from outside the image. At the speeds of the arm,
        // this content is a few pixels wide.
        let margin_px = if is_motion_free { 0 } else { 4 + height / 60 };
        let mut optics = Self {
            view_size_px: [0; 2],
            view_focal_px: intrinsics
                .focal_px
                .map(|focal| focal * f64::from(supersample)),
            view_principal_px: [0.0; 2],
            drawn_pinhole_px: [[0.0; 2]; 2],
            intrinsics,
            supersample,
            margin_px,
            rays,
        };
        for axis in 0..2 {
            let (first, last) = optics.bounds(axis);
            let margin = f64::from(margin_px * supersample);
            optics.view_principal_px[axis] = margin - first * optics.view_focal_px[axis];
            // The subtraction prevents rounding errors from adding a pixel.
            let extent = ((last - first) * optics.view_focal_px[axis] + 2.0 * margin - 1e-2).ceil();
            optics.view_size_px[axis] = extent.clamp(1.0, f64::from(MAX_VIEW_PX)) as u32;
        }
        optics.drawn_pinhole_px = [optics.view_focal_px, optics.view_principal_px]
            .map(|pair| pair.map(|value| value as f32));
        Ok(optics)
    }

    /// Minimum and maximum coordinate at z = 1 that the image's pixels cover along an axis.
    fn bounds(&self, axis: usize) -> (f64, f64) {
        // A pinhole maps the borders of the image directly. With distortion, the extremes lie on
        // the border pixels, half a pixel inside.
        let half_pixel = 0.5 / self.intrinsics.focal_px[axis];
        if self.intrinsics.is_pinhole() {
            let [principal, focal] = [
                self.intrinsics.principal_px[axis],
                self.intrinsics.focal_px[axis],
            ];
            return (
                -principal / focal,
                (f64::from(self.intrinsics.size_px[axis]) - principal) / focal,
            );
        }
        let values = self.rays.iter().map(|ray| f64::from(ray[axis]));
        let (first, last) = values.fold((f64::MAX, f64::MIN), |(first, last), x| {
            (first.min(x), last.max(x))
        });
        (first - half_pixel, last + half_pixel)
    }

    /// Size of the images to render.
    pub(crate) fn view_size_px(&self) -> [u32; 2] {
        self.view_size_px
    }

    /// The view to render for a pose. The robot is not drawn.
    pub(crate) fn view(
        &self,
        world_from_camera: Transform,
        robot: Option<RobotPose>,
        light_frac: f64,
    ) -> View {
        View {
            size_px: self.view_size_px,
            focal_px: self.view_focal_px,
            principal_px: self.view_principal_px,
            world_from_camera,
            robot,
            is_robot_visible: false,
            light_frac,
            world_from_boards: Vec::new(),
        }
    }

    /// Color of each pixel at the instant of the rendered image, as `[height, width, 3]` with
    /// values from 0 to 255.
    pub(crate) fn motion_free(&self, picture: &Picture) -> Vec<f32> {
        if self.intrinsics.is_pinhole() {
            return self.expose(|row, colors| self.average_blocks(picture, row, colors));
        }
        self.expose(|row, colors| {
            for (color, ray) in colors.iter_mut().zip(self.row_of_rays(row)) {
                *color = self.color_at(picture, self.drawn_from_ray(ray));
            }
        })
    }

    /// Colors of one row of a pinhole camera. Each pixel covers a whole number of rendered pixels.
    fn average_blocks(&self, picture: &Picture, row: usize, colors: &mut [[f32; 3]]) {
        let side = self.supersample as usize;
        let stride = 3 * picture.size_px[0] as usize;
        let margin = (self.margin_px * self.supersample) as usize;
        let area = (side * side) as f32;
        let top = (margin + row * side) * stride + 3 * margin;
        for (column, color) in colors.iter_mut().enumerate() {
            // There are at most 16 samples of 255, so the sum fits into u16.
            let mut sum = [0u16; 3];
            for y in 0..side {
                let start = top + y * stride + 3 * column * side;
                for pixel in picture.rgb[start..start + 3 * side].chunks_exact(3) {
                    for channel in 0..3 {
                        sum[channel] += u16::from(pixel[channel]);
                    }
                }
            }
            *color = sum.map(|channel| f32::from(channel) / area);
        }
    }

    /// Color of each pixel, averaged over the instants at which its row is exposed.
    ///
    /// `row_motions` holds all motions of the first row, then all motions of the second row, and so
    /// on. Each pixel's ray is traced into the rendered image with the rendered depth, so surfaces
    /// have the correct positions. The exception is a strip next to each depth edge, which repeats
    /// the adjacent content. The strip is as wide as the parallax during the readout.
    pub(crate) fn motion_blurred(&self, picture: &Picture, row_motions: &[RowMotion]) -> Vec<f32> {
        let n_samples = row_motions.len() / self.intrinsics.size_px[1] as usize;
        let share = 1.0 / n_samples as f32;
        self.expose(|row, colors| {
            for row_motion in &row_motions[row * n_samples..(row + 1) * n_samples] {
                // The search starts at the offset of the previous pixel, because neighboring
                // offsets are almost equal.
                let mut offset_px = [0.0; 2];
                for (color, ray) in colors.iter_mut().zip(self.row_of_rays(row)) {
                    let static_px = self.drawn_from_ray(ray);
                    let drawn = self.trace_pixel(
                        picture,
                        row_motion,
                        ray,
                        [static_px[0] + offset_px[0], static_px[1] + offset_px[1]],
                    );
                    offset_px = [drawn[0] - static_px[0], drawn[1] - static_px[1]];
                    let sampled = self.color_at(picture, drawn);
                    for channel in 0..3 {
                        color[channel] += share * sampled[channel];
                    }
                }
            }
        })
    }

    /// Depth along z at the center of each pixel, `[height, width]`, meters.
    pub(crate) fn depth_m(&self, picture: &Picture) -> Vec<f32> {
        let [width, height] = self.intrinsics.size_px.map(|side| side as usize);
        let mut depth_m = vec![0.0; width * height];
        depth_m
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(row, line)| {
                for (depth, ray) in line.iter_mut().zip(self.row_of_rays(row)) {
                    *depth = self.depth_at(picture, self.drawn_from_ray(ray));
                }
            });
        depth_m
    }

    fn row_of_rays(&self, row: usize) -> &[[f32; 2]] {
        let width = self.intrinsics.size_px[0] as usize;
        &self.rays[row * width..(row + 1) * width]
    }

    fn expose(&self, paint: impl Fn(usize, &mut [[f32; 3]]) + Sync) -> Vec<f32> {
        let [width, height] = self.intrinsics.size_px.map(|side| side as usize);
        let mut colors = vec![[0.0; 3]; width * height];
        colors
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(row, line)| paint(row, line));
        colors.into_flattened()
    }

    /// Position of the point `(x, y, 1)` in the rendered image.
    fn drawn_from_ray(&self, ray: &[f32; 2]) -> [f32; 2] {
        let [[focal_x, focal_y], [center_x, center_y]] = self.drawn_pinhole_px;
        [ray[0] * focal_x + center_x, ray[1] * focal_y + center_y]
    }

    /// Intersects a ray of the moved camera with the rendered surface, starting from an initial
    /// guess.
    fn trace_pixel(
        &self,
        picture: &Picture,
        row_motion: &RowMotion,
        ray: &[f32; 2],
        guess: [f32; 2],
    ) -> [f32; 2] {
        let direction = row_motion.rotation_matrix * Vector3::new(ray[0], ray[1], 1.0);
        let mut depth = nearest_depth(picture, guess);
        let mut drawn = guess;
        for _ in 0..MAX_CORRECTIONS {
            // This is the point on the moved ray that has this depth in the rendered image. If the
            // surface at this point has another depth, the search repeats with the other depth.
            let along = (depth - row_motion.translation_m.z) / direction.z;
            let at =
                |axis: usize| (direction[axis] * along + row_motion.translation_m[axis]) / depth;
            drawn = self.drawn_from_ray(&[at(0), at(1)]);
            let found = nearest_depth(picture, drawn);
            let is_same = (found - depth).abs() < SAME_DEPTH_FRAC * depth;
            depth = found;
            if is_same {
                break;
            }
        }
        drawn
    }

    /// Mean color of one image pixel's square around a position in the rendered image.
    fn color_at(&self, picture: &Picture, at: [f32; 2]) -> [f32; 3] {
        let side = self.supersample as usize;
        if side == 1 {
            return between_pixels(picture, at);
        }
        let [width, height] = picture.size_px.map(|side| side as usize);
        let start = |axis: usize, size: usize| {
            // The position is clamped, so that the square stays inside the picture and its first
            // and last columns exist.
            let first = (at[axis] - 0.5 * side as f32).clamp(0.0, (size - side) as f32 - 1e-3);
            (first as usize, first.fract())
        };
        let (column, share_x) = start(0, width);
        let (row, share_y) = start(1, height);
        // The square covers `side` pixels, but starts at a fraction of a pixel, so the outer pixels
        // count partly.
        let weight = |ix: usize, share: f32| match ix {
            0 => 1.0 - share,
            ix if ix == side => share,
            _ => 1.0,
        };
        let mut sum = [0.0; 3];
        for y in 0..=side {
            let weight_y = weight(y, share_y);
            let line = &picture.rgb[3 * ((row + y) * width + column)..][..3 * (side + 1)];
            for (x, color) in line.chunks_exact(3).enumerate() {
                let weight = weight(x, share_x) * weight_y;
                for (sum, channel) in sum.iter_mut().zip(color) {
                    *sum += weight * f32::from(*channel);
                }
            }
        }
        let area = (side * side) as f32;
        sum.map(|channel| channel / area)
    }

    /// Depth at a position in the rendered image. If the four surrounding pixels lie on one
    /// surface, it is their mean depth. Otherwise, it is the smallest of the four depths. With odd
    /// supersampling, it is the depth of the pixel at this position.
    fn depth_at(&self, picture: &Picture, at: [f32; 2]) -> f32 {
        /// Neighbors whose depths differ by more than this fraction belong to different surfaces.
        const SAME_SURFACE_FRAC: f32 = 0.01;
        if self.supersample % 2 == 1 {
            return nearest_depth(picture, at);
        }
        let around = [[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]];
        let depths =
            around.map(|[dx, dy]: [f32; 2]| nearest_depth(picture, [at[0] + dx, at[1] + dy]));
        let nearest = depths.into_iter().fold(f32::MAX, f32::min);
        let furthest = depths.into_iter().fold(0.0, f32::max);
        // A mean across a depth edge would lie on no surface.
        if furthest - nearest < SAME_SURFACE_FRAC * nearest {
            depths.iter().sum::<f32>() / 4.0
        } else {
            nearest
        }
    }
}

/// Bilinear color at a position in the rendered image.
fn between_pixels(picture: &Picture, at: [f32; 2]) -> [f32; 3] {
    let [width, height] = picture.size_px;
    let x = (at[0] - 0.5).clamp(0.0, width as f32 - 1.001);
    let y = (at[1] - 0.5).clamp(0.0, height as f32 - 1.001);
    let column = x as u32 as usize;
    let row = y as u32 as usize;
    let fx = x - column as f32;
    let fy = y - row as f32;
    let stride = 3 * width as usize;
    let start = row * stride + 3 * column;
    let above = &picture.rgb[start..start + 6];
    let below = &picture.rgb[start + stride..start + stride + 6];
    let weights = [
        (1.0 - fx) * (1.0 - fy),
        fx * (1.0 - fy),
        (1.0 - fx) * fy,
        fx * fy,
    ];
    std::array::from_fn(|channel| {
        weights[0] * f32::from(above[channel])
            + weights[1] * f32::from(above[channel + 3])
            + weights[2] * f32::from(below[channel])
            + weights[3] * f32::from(below[channel + 3])
    })
}

/// Maximum size of a rendered image.
const MAX_VIEW_PX: u32 = 8192;

fn nearest_depth(picture: &Picture, at: [f32; 2]) -> f32 {
    // Converting to u32 takes fewer instructions than converting to usize.
    let index = |axis: usize| (at[axis].max(0.0) as u32).min(picture.size_px[axis] - 1) as usize;
    picture.depth_m[index(1) * picture.size_px[0] as usize + index(0)]
}
