//! Renders targets as seen by a camera, with blur and noise, for tests.
//!
//! The image of a corner is known exactly, so that detection can be compared with the truth.

use crate::spec::TargetSpec;
use crate::surface::{Surface, pixel_mean};
use kinematics::{Intrinsics, Transform};
use nalgebra::Vector3;
use numbers::random::Random;

/// A camera in front of a target.
#[derive(Clone, Debug)]
pub struct View {
    /// The camera.
    pub intrinsics: Intrinsics,
    /// Pose of the board. See [`crate::board`] for its frame.
    pub camera_from_board: Transform,
    /// Standard deviation of the Gaussian blur, pixels.
    pub blur_px: f64,
    /// Standard deviation of the noise, gray values.
    pub noise: f64,
    /// Seed of the noise.
    pub seed: u64,
    /// Whether a ChArUco board is printed in the arrangement used before OpenCV 4.6.
    pub is_legacy: bool,
}

/// White margin around the pattern relative to its longer side.
const MARGIN_FRAC: f64 = 0.06;
/// Gray values of ink, paper and background.
const INK: f64 = 30.0;
const PAPER: f64 = 205.0;
const BACKGROUND: f64 = 105.0;

/// A target on its sheet of paper.
struct Sheet<'a> {
    surface: Surface<'a>,
    /// Smallest and largest x and y of the paper, meters.
    bounds_m: [[f64; 2]; 2],
}

impl Sheet<'_> {
    /// Gray value of a point of the board frame, meters.
    fn gray(&self, point: [f64; 2]) -> f64 {
        let [low, high] = self.bounds_m;
        let is_on_paper = (0..2).all(|axis| point[axis] >= low[axis] && point[axis] <= high[axis]);
        if !is_on_paper {
            BACKGROUND
        } else if self.surface.is_black(point) {
            INK
        } else {
            PAPER
        }
    }

    /// Mean gray value of a pixel, from the board positions of its corners: upper left, upper
    /// right, lower left, lower right.
    fn pixel(&self, corners: [Option<[f64; 2]>; 4]) -> f64 {
        // The ray of a corner may not meet the board, for example at the horizon.
        let [Some(a), Some(b), Some(c), Some(d)] = corners else {
            return BACKGROUND;
        };
        pixel_mean(|x, y| {
            self.gray([0, 1].map(|axis| {
                (a[axis] * (1.0 - x) + b[axis] * x) * (1.0 - y)
                    + (c[axis] * (1.0 - x) + d[axis] * x) * y
            }))
        })
    }
}

/// Renders a target. Returns one byte per pixel, row by row.
///
/// Every pixel is the mean of a grid of samples. Between the corners of a pixel, board positions
/// are interpolated, which is accurate to 1e-3 px for lenses in use. The light falls off across the
/// image.
pub fn render(target: &TargetSpec, view: &View) -> Vec<u8> {
    let [width, height] = view.intrinsics.size_px.map(|side| side as usize);
    let surface = Surface {
        pattern: &target.pattern,
        is_legacy: view.is_legacy,
    };
    let points: Vec<Option<[f64; 2]>> = (0..(width + 1) * (height + 1))
        .map(|at| point_on_board(view, [(at % (width + 1)) as f64, (at / (width + 1)) as f64]))
        .collect();
    let [low, high] = target.bounds_m();
    let margin_m = MARGIN_FRAC * (high[0] - low[0]).max(high[1] - low[1]);
    let sheet = Sheet {
        surface,
        bounds_m: [
            low.map(|value| value - margin_m),
            high.map(|value| value + margin_m),
        ],
    };
    let sharp: Vec<f64> = (0..width * height)
        .map(|at| {
            // Rows of corners are one longer than rows of pixels.
            let corner = (at / width) * (width + 1) + at % width;
            let corners = [corner, corner + 1, corner + width + 1, corner + width + 2];
            sheet.pixel(corners.map(|at| points[at]))
        })
        .collect();
    let blurred = blur(
        &blur(&sharp, [width, height], 1, view.blur_px),
        [width, height],
        width,
        view.blur_px,
    );
    let mut random = Random::new(view.seed);
    blurred
        .into_iter()
        .enumerate()
        .map(|(at, value)| {
            // The image is a quarter darker at the right border, because detection must not rely on
            // uniform lighting.
            let fall_off = 1.0 - 0.25 * (at % width) as f64 / width as f64;
            quantized(value * fall_off + view.noise * random.normal())
        })
        .collect()
}

/// Ids and exact pixels of the corners that are inside the image and in front of the camera.
pub fn truth(target: &TargetSpec, view: &View) -> Vec<(u32, [f64; 2])> {
    (0..target.n_corners())
        .filter_map(|id| {
            let point_in_board = nalgebra::Point3::from(target.corner(id)?);
            let point_in_camera = view.camera_from_board * point_in_board;
            let pixel = view.intrinsics.project(&point_in_camera.coords)?;
            view.intrinsics.contains(pixel).then_some((id, pixel))
        })
        .collect()
}

/// The point at which the ray of a pixel position meets the board.
fn point_on_board(view: &View, pixel: [f64; 2]) -> Option<[f64; 2]> {
    let ray_in_camera = view.intrinsics.unproject(pixel)?;
    let board_from_camera = view.camera_from_board.inverse();
    let origin: Vector3<f64> = board_from_camera.translation.vector;
    let ray = board_from_camera.rotation * ray_in_camera;
    // The board is the plane z = 0 of its frame.
    let distance = -origin.z / ray.z;
    (distance > 0.0 && distance.is_finite())
        .then(|| [origin.x + distance * ray.x, origin.y + distance * ray.y])
}

/// Blurs along one axis. `stride` is the distance of neighbors in the array.
fn blur(values: &[f64], [width, height]: [usize; 2], stride: usize, sigma_px: f64) -> Vec<f64> {
    if sigma_px <= 0.0 {
        return values.to_vec();
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a few pixels"
    )]
    let reach = (3.0 * sigma_px).ceil() as usize;
    let weight = |offset: usize| {
        (-0.5 * (offset as f64 - reach as f64).powi(2) / (sigma_px * sigma_px)).exp()
    };
    let weights: Vec<f64> = (0..=2 * reach).map(weight).collect();
    let sum: f64 = weights.iter().sum();
    let n = if stride == 1 { width } else { height };
    let mut blurred = Vec::with_capacity(values.len());
    for at in 0..values.len() {
        // The position along the axis of the blur, and the index at which its row or column starts.
        let here = if stride == 1 { at % width } else { at / width };
        let start = at - here * stride;
        // Values beyond the border are equal to the outermost value.
        let neighbor = |offset: usize| {
            values[start + (here + offset).saturating_sub(reach).min(n - 1) * stride]
        };
        let weighted = weights
            .iter()
            .enumerate()
            .map(|(offset, weight)| weight * neighbor(offset));
        blurred.push(weighted.sum::<f64>() / sum);
    }
    blurred
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "rounded and clamped"
)]
fn quantized(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}
