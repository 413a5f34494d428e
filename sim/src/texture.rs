//! Procedural textures made of noise and simple shapes: walls, table, wood, fur, tags.
#![expect(
    clippy::cast_possible_truncation,
    reason = "colors are clamped before they become bytes"
)]

use crate::random::RandomStream;
use crate::tag;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelIterator, ParallelIterator, ParallelSliceMut,
};

/// Color, sRGB 0 to 1.
pub(crate) type Color = [f64; 3];

/// A square sRGB image.
pub(crate) struct Texture {
    side_px: usize,
    rgb: Vec<u8>,
}

impl Texture {
    /// Paints every pixel by its position. Both coordinates go from 0 to 1, starting at the top
    /// left.
    pub(crate) fn paint(side_px: usize, color_at: impl Fn(f64, f64) -> Color + Sync) -> Self {
        let at = |ix: usize| (ix as f64 + 0.5) / side_px as f64;
        let mut rgb = vec![0; 3 * side_px * side_px];
        rgb.par_chunks_mut(3 * side_px)
            .enumerate()
            .for_each(|(row, line)| {
                for (column, pixel) in line.chunks_exact_mut(3).enumerate() {
                    pixel.copy_from_slice(&color_at(at(column), at(row)).map(to_byte));
                }
            });
        Self { side_px, rgb }
    }

    /// Darkens a rectangle (left, top, right, bottom) by light fractions that are sampled on a grid
    /// of `n` x `n` points.
    ///
    /// `share_at` receives the position in the rectangle, 0 to 1 from its top left, and the index
    /// of the sample.
    pub(crate) fn shade(
        &mut self,
        rectangle: [f64; 4],
        n: usize,
        share_at: impl Fn(f64, f64, u64) -> f64 + Sync,
    ) {
        let step = 1.0 / (n - 1) as f64;
        // A point exactly on the edge may lie inside the adjacent object.
        let inside = |at: usize| (at as f64 * step).clamp(EDGE, 1.0 - EDGE);
        let shares: Vec<f64> = (0..n * n)
            .into_par_iter()
            .map(|ix| share_at(inside(ix % n), inside(ix / n), ix as u64))
            .collect();
        // The light samples are noisy because each uses few rays. The mean of neighbors reduces
        // this noise.
        let shares = blurred(&shares, n);
        let side_px = self.side_px;
        let [left, top, right, bottom] = rectangle;
        let first = |share: f64| (share * side_px as f64 + 0.5) as usize;
        let columns = first(left)..first(right);
        let rows = first(top)..first(bottom);
        self.rgb
            .par_chunks_mut(3 * side_px)
            .enumerate()
            .filter(|(row, _)| rows.contains(row))
            .for_each(|(row, line)| {
                let y = ((row as f64 + 0.5) / side_px as f64 - top) / (bottom - top);
                for column in columns.clone() {
                    let x = ((column as f64 + 0.5) / side_px as f64 - left) / (right - left);
                    let share = between_points(&shares, n, [x, y]);
                    for byte in &mut line[3 * column..3 * column + 3] {
                        *byte = (f64::from(*byte) * share + 0.5) as u8;
                    }
                }
            });
    }

    /// The texture as a PNG file.
    pub(crate) fn to_png(&self) -> Result<Vec<u8>, image::ImageError> {
        let mut bytes = Vec::new();
        let side = u32::try_from(self.side_px).expect("textures stay small");
        PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Up)
            .write_image(&self.rgb, side, side, ExtendedColorType::Rgb8)?;
        Ok(bytes)
    }
}

/// Side of every texture, pixels.
pub(crate) const SIDE_PX: usize = 1024;

/// Minimum distance of light samples from a rectangle's edge, as a fraction of its side.
const EDGE: f64 = 0.005;

/// Mean of each point of a square grid and its neighbors.
fn blurred(grid: &[f64], side: usize) -> Vec<f64> {
    (0..grid.len())
        .map(|ix| mean_around(grid, side, ix))
        .collect()
}

/// Mean of a point of a square grid and its neighbors. A point at the border has fewer neighbors.
fn mean_around(grid: &[f64], side: usize, ix: usize) -> f64 {
    let around = |at: usize| at.saturating_sub(1)..(at + 2).min(side);
    let rows = around(ix / side);
    let columns = around(ix % side);
    let n_points = (rows.len() * columns.len()) as f64;
    rows.flat_map(|row| grid[row * side..][columns.clone()].iter())
        .sum::<f64>()
        / n_points
}

/// Bilinear interpolation in a grid of `n` x `n` points that cover the square from 0 to 1.
fn between_points(grid: &[f64], n: usize, [x, y]: [f64; 2]) -> f64 {
    let step = 1.0 / (n - 1) as f64;
    let column = x.clamp(0.0, 1.0) / step;
    let row = y.clamp(0.0, 1.0) / step;
    // The last point has no neighbor to the right, so the last cell begins at the point before it.
    let left = (column as usize).min(n - 2);
    let top = (row as usize).min(n - 2);
    let fx = column - left as f64;
    let fy = row - top as f64;
    let line = |at: usize| grid[at * n + left] * (1.0 - fx) + grid[at * n + left + 1] * fx;
    line(top) * (1.0 - fy) + line(top + 1) * fy
}

fn to_byte(value: f64) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

pub(crate) fn mix(a: Color, b: Color, share: f64) -> Color {
    let share = share.clamp(0.0, 1.0);
    std::array::from_fn(|ix| a[ix] + (b[ix] - a[ix]) * share)
}

pub(crate) fn scale(color: Color, factor: f64) -> Color {
    color.map(|channel| channel * factor)
}

/// A smooth step from 0 below `lower` to 1 above `upper`.
pub(crate) fn step(lower: f64, upper: f64, value: f64) -> f64 {
    let share = ((value - lower) / (upper - lower)).clamp(0.0, 1.0);
    share * share * (3.0 - 2.0 * share)
}

/// Smooth noise, 0 to 1, with features of size 1.
pub(crate) struct Noise(RandomStream);

impl Noise {
    pub(crate) fn new(name: u64) -> Self {
        Self(RandomStream::new(0x7e37, &[name]))
    }

    fn lattice(&self, x: i64, y: i64) -> f64 {
        self.0.unit((x as u64) << 32 ^ (y as u64 & 0xffff_ffff))
    }

    pub(crate) fn at(&self, x: f64, y: f64) -> f64 {
        let column = x.floor();
        let row = y.floor();
        // The smooth step hides the lattice, because bilinear noise would have visible creases.
        let fx = step(0.0, 1.0, x - column);
        let fy = step(0.0, 1.0, y - row);
        let column = column as i64;
        let row = row as i64;
        let top = self.lattice(column, row) * (1.0 - fx) + self.lattice(column + 1, row) * fx;
        let bottom =
            self.lattice(column, row + 1) * (1.0 - fx) + self.lattice(column + 1, row + 1) * fx;
        top * (1.0 - fy) + bottom * fy
    }

    /// Sum of octaves of noise, 0 to 1. Each octave has half the size and half the amplitude of the
    /// previous octave.
    pub(crate) fn rough(&self, x: f64, y: f64, n_octaves: i32) -> f64 {
        // Octaves are shifted against each other. Otherwise, all octaves would have a lattice point
        // at the origin.
        let octaves = (0..n_octaves).map(|octave| (f64::from(octave) * 17.3, 2f64.powi(octave)));
        let sum: f64 = octaves
            .map(|(shift, finer)| self.at(x * finer + shift, y * finer + shift) / finer)
            .sum();
        // The sum of the amplitudes 1 + 1/2 + 1/4 + ... scales the result to 0 to 1.
        sum / (2.0 - 2f64.powi(1 - n_octaves))
    }
}

/// A brick wall with two posters.
pub(crate) fn brick_wall() -> Texture {
    const N_COURSES: f64 = 26.0;
    const N_BRICKS: f64 = 10.0;
    let rough = Noise::new(1);
    let blotch = Noise::new(2);
    let each = RandomStream::new(0x7e37, &[3]);
    Texture::paint(SIDE_PX, |x, y| {
        let course = (y * N_COURSES).floor();
        let along = x * N_BRICKS + if course as i64 % 2 == 0 { 0.0 } else { 0.5 };
        let in_x = along.fract();
        let in_y = (y * N_COURSES).fract();
        let wobble = 0.02 * (rough.rough(x * 60.0, y * 60.0, 2) - 0.5);
        let edge = (in_x.min(1.0 - in_x) * 2.3).min(in_y.min(1.0 - in_y)) + wobble;
        let brick = each.unit(course as u64 * 64 + along.floor() as u64 % 64);
        let clay = mix([0.44, 0.19, 0.13], [0.74, 0.42, 0.29], brick);
        let clay = scale(clay, 0.72 + 0.5 * rough.rough(x * 40.0, y * 40.0, 4));
        let mortar = scale(
            [0.74, 0.71, 0.66],
            0.8 + 0.3 * rough.rough(x * 90.0, y * 90.0, 3),
        );
        let wall = scale(
            mix(mortar, clay, step(0.05, 0.10, edge)),
            0.85 + 0.25 * blotch.rough(x * 4.0, y * 4.0, 3),
        );
        let wall = poster(x, y, [0.52, 0.60, 0.78, 0.90], wall, sunrise);
        poster(x, y, [0.12, 0.68, 0.42, 0.92], wall, squares)
    })
}

/// A plaster wall with stains, a map and a striped poster.
pub(crate) fn plaster_wall() -> Texture {
    let rough = Noise::new(11);
    let stain = Noise::new(12);
    Texture::paint(SIDE_PX, |x, y| {
        let grain = rough.rough(x * 70.0, y * 70.0, 4);
        let stained = step(0.42, 0.75, stain.rough(x * 5.0, y * 5.0, 5));
        let wall = scale(
            mix([0.47, 0.60, 0.62], [0.78, 0.73, 0.58], stained),
            0.78 + 0.4 * grain,
        );
        let crack = (stain.rough(x * 7.0 + 3.0, y * 7.0, 4) - 0.5).abs();
        let wall = scale(wall, 0.6 + 0.4 * step(0.0, 0.012, crack));
        let wall = poster(x, y, [0.14, 0.64, 0.50, 0.91], wall, |u, v| {
            map(&stain, u, v)
        });
        poster(x, y, [0.60, 0.58, 0.84, 0.90], wall, stripes)
    })
}

/// Paints a poster with a white margin into the rectangle left, top, right, bottom.
fn poster(
    x: f64,
    y: f64,
    rectangle: [f64; 4],
    wall: Color,
    picture: impl Fn(f64, f64) -> Color,
) -> Color {
    const MARGIN: f64 = 0.05;
    let [left, top, right, bottom] = rectangle;
    let u = (x - left) / (right - left);
    let v = (y - top) / (bottom - top);
    let inside = |lower: f64, upper: f64| u > lower && u < upper && v > lower && v < upper;
    if inside(MARGIN, 1.0 - MARGIN) {
        picture(
            (u - MARGIN) / (1.0 - 2.0 * MARGIN),
            (v - MARGIN) / (1.0 - 2.0 * MARGIN),
        )
    } else if inside(0.0, 1.0) {
        [0.93, 0.92, 0.88]
    } else {
        // The wall is darker under the paper's lower right edge.
        let shadow =
            step(-0.06, 0.0, u) * step(1.06, 1.0, u) * step(-0.04, 0.0, v) * step(1.06, 1.0, v);
        scale(wall, 1.0 - 0.35 * shadow)
    }
}

pub(crate) fn sunrise(u: f64, v: f64) -> Color {
    let dx = u - 0.5;
    let dy = v - 0.42;
    let distance = dx.hypot(dy);
    let ray = ((dy.atan2(dx) * 16.0 / std::f64::consts::TAU).rem_euclid(1.0) - 0.5).abs();
    let sky = mix(
        [0.98, 0.78, 0.30],
        [0.90, 0.33, 0.20],
        step(0.22, 0.28, ray),
    );
    let color = mix([0.99, 0.95, 0.80], sky, step(0.16, 0.17, distance));
    let hill = 0.70 + 0.07 * (u * 9.0).sin() + 0.03 * (u * 23.0).cos();
    let front = 0.83 + 0.05 * (u * 6.0 + 2.0).sin();
    let color = if v > hill { [0.16, 0.38, 0.42] } else { color };
    if v > front { [0.07, 0.16, 0.24] } else { color }
}

pub(crate) fn squares(u: f64, v: f64) -> Color {
    const COLORS: [Color; 6] = [
        [0.85, 0.15, 0.15],
        [0.10, 0.30, 0.70],
        [0.95, 0.80, 0.15],
        [0.12, 0.12, 0.12],
        [0.95, 0.95, 0.92],
        [0.10, 0.55, 0.35],
    ];
    let column = (u * 8.0).floor();
    let row = (v * 6.0).floor();
    let random = RandomStream::new(0x7e37, &[21]);
    let pick = |counter: u64| COLORS[(random.bits(counter) % 6) as usize];
    let cell = (row * 8.0 + column) as u64;
    let from_center = ((u * 8.0).fract() - 0.5).hypot((v * 6.0).fract() - 0.5);
    if from_center < 0.36 {
        pick(cell + 100)
    } else {
        pick(cell)
    }
}

pub(crate) fn map(noise: &Noise, u: f64, v: f64) -> Color {
    let height = noise.rough(u * 3.0 + 40.0, v * 3.0, 5);
    let contour = ((height * 24.0).fract() - 0.5).abs();
    let land = mix(
        [0.55, 0.72, 0.40],
        [0.80, 0.66, 0.42],
        step(0.5, 0.7, height),
    );
    let color = if height < 0.46 {
        mix(
            [0.16, 0.38, 0.62],
            [0.45, 0.68, 0.84],
            step(0.3, 0.46, height),
        )
    } else {
        land
    };
    let color = scale(color, 0.55 + 0.45 * step(0.0, 0.12, contour));
    let grid = ((u * 6.0).fract() - 0.5)
        .abs()
        .max(((v * 5.0).fract() - 0.5).abs());
    if grid > 0.485 {
        [0.15, 0.15, 0.20]
    } else {
        color
    }
}

pub(crate) fn stripes(u: f64, v: f64) -> Color {
    let wave = v * 9.0 + 0.5 * (u * 11.0).sin() + 0.2 * (u * 27.0).cos();
    let colors: [Color; 4] = [
        [0.12, 0.14, 0.30],
        [0.92, 0.88, 0.78],
        [0.80, 0.25, 0.30],
        [0.25, 0.55, 0.62],
    ];
    let color = colors[wave.floor().rem_euclid(4.0) as usize];
    scale(color, 0.82 + 0.18 * (wave.fract() * 3.0).fract())
}

/// A brushed metal table with threaded holes every 25 mm.
///
/// * `size_m`: size of the area that the texture covers, to the right and down.
pub(crate) fn metal_table(size_m: [f64; 2]) -> Texture {
    const HOLE_PITCH_M: f64 = 0.025;
    let brush = Noise::new(31);
    let blotch = Noise::new(32);
    let scratch = Noise::new(33);
    Texture::paint(3 * SIDE_PX / 2, |x, y| {
        // The noise parameters are chosen for a square of 0.8 m.
        let x = x * size_m[0] / 0.8;
        let y = y * size_m[1] / 0.8;
        let brushed =
            0.6 * brush.at(x * 9.0, y * 480.0) + 0.4 * brush.rough(x * 40.0, y * 260.0, 3);
        let worn = blotch.rough(x * 6.0, y * 6.0, 5);
        let metal = scale(
            mix(
                [0.28, 0.32, 0.38],
                [0.82, 0.80, 0.76],
                step(0.3, 0.68, worn),
            ),
            0.72 + 0.5 * brushed,
        );
        let line = (scratch.at(x * 12.0 + y * 3.0, y * 14.0 - x * 9.0) - 0.5).abs();
        let metal = mix([0.86, 0.87, 0.88], metal, step(0.001, 0.008, line));
        let in_pitch = |at: f64| (at * 0.8 / HOLE_PITCH_M).fract() - 0.5;
        let from_hole = in_pitch(x).hypot(in_pitch(y));
        let rim = mix([0.90, 0.91, 0.92], metal, step(0.21, 0.26, from_hole));
        mix([0.05, 0.05, 0.06], rim, step(0.165, 0.19, from_hole))
    })
}

/// Sawn wood, with six sides in the rectangles of [`side_rectangle`]. The first two sides have end
/// grain.
pub(crate) fn wood() -> Texture {
    let grain = Grain {
        bend: Noise::new(41),
        fiber: Noise::new(42),
    };
    Texture::paint(SIDE_PX, |x, y| {
        let side = (y * 3.0).floor() * 3.0 + (x * 3.0).floor();
        let u = (x * 3.0).fract();
        let v = (y * 3.0).fract();
        if side < 2.0 {
            grain.end(u, v, side)
        } else {
            grain.along(u, v, side)
        }
    })
}

struct Grain {
    bend: Noise,
    fiber: Noise,
}

impl Grain {
    const DARK: Color = [0.42, 0.24, 0.11];
    const LIGHT: Color = [0.83, 0.62, 0.38];

    fn along(&self, u: f64, v: f64, side: f64) -> Color {
        let fine = self.fiber.rough(u * 12.0, v * 90.0 + side * 31.0, 3);
        let knot_u = 0.25 + 0.5 * (side * 0.37).fract();
        let knot_v = 0.35 + 0.3 * (side * 0.61).fract();
        let knot = (-((u - knot_u) / 0.09).powi(2) - ((v - knot_v) / 0.13).powi(2)).exp();
        let ring = v * 9.0
            + side * 2.3
            + 3.2 * self.bend.rough(u * 2.2 + side * 5.0, v * 2.0, 3)
            + 2.5 * knot;
        let late = (ring.fract() * 1.25).min(1.0 - (ring.fract() - 0.8).max(0.0) * 5.0);
        let color = mix(
            Self::LIGHT,
            Self::DARK,
            0.75 * late * late + 0.25 * (1.0 - fine),
        );
        mix(color, [0.22, 0.12, 0.06], 0.8 * step(0.5, 0.95, knot))
    }

    fn end(&self, u: f64, v: f64, side: f64) -> Color {
        let radius = (u - 0.3).hypot(v - 1.4) * 9.0
            + 1.2 * self.bend.rough(u * 3.0 + side * 9.0, v * 3.0, 3);
        let speckle = self.fiber.rough(u * 50.0 + side * 80.0, v * 50.0, 2);
        mix(
            scale(Self::LIGHT, 0.9),
            Self::DARK,
            0.8 * radius.fract().powi(2) + 0.3 * speckle,
        )
    }
}

/// Fur colors, which are brighter to the right. Each band runs from the tip of the hair (top) to
/// its root. [`FurBand`] lists the bands.
pub(crate) fn fur() -> Texture {
    let skin = Noise::new(52);
    Texture::paint(SIDE_PX / 2, |x, y| {
        let band = (y * 4.0).floor();
        let to_root = (y * 4.0).fract();
        let (tip, root): (Color, Color) = match band as i64 {
            0 => ([0.78, 0.70, 0.60], [0.30, 0.24, 0.19]),
            1 => ([1.0, 0.96, 0.90], [0.66, 0.58, 0.50]),
            2 => ([0.27, 0.19, 0.14], [0.09, 0.07, 0.05]),
            _ => ([0.94, 0.70, 0.66], [0.72, 0.48, 0.46]),
        };
        let color = scale(
            mix(tip, root, to_root.powf(0.8)),
            FUR_DARKEST + (1.0 - FUR_DARKEST) * x,
        );
        scale(color, 0.94 + 0.12 * skin.rough(x * 60.0, y * 60.0, 3))
    })
}

/// Brightness at the left edge of the fur texture. At the right edge, it is 1.
pub(crate) const FUR_DARKEST: f64 = 0.15;

/// Bands of the fur texture from the top.
#[derive(Clone, Copy)]
pub(crate) enum FurBand {
    /// Gray-brown coat.
    Coat,
    /// Light muzzle and belly.
    Light,
    /// Dark mane, hooves and ear tips.
    Dark,
    /// Pink inside of the ears.
    Pink,
}

impl FurBand {
    /// Top and bottom in the texture, slightly inset so that mip levels do not mix bands.
    pub(crate) fn rows(self) -> [f64; 2] {
        let top = f64::from(self as u8) / 4.0;
        [top + 0.02, top + 0.23]
    }
}

/// Six tags in the rectangles of [`side_rectangle`]. The lowest third of the texture is white.
pub(crate) fn tags() -> Texture {
    let cells: Vec<_> = (0..tag::CODES.len()).map(tag::cells).collect();
    let paper = Noise::new(61);
    // This texture is larger than the others, so that edges between cells stay sharp at close
    // range.
    Texture::paint(3 * SIDE_PX / 2, |x, y| {
        let across = x * 3.0;
        let down = y * 3.0;
        let light = 0.97 + 0.03 * paper.rough(x * 200.0, y * 200.0, 2);
        let id = down.floor() as usize * 3 + across.floor() as usize;
        let Some(cells) = cells.get(id) else {
            return scale([0.93, 0.93, 0.91], light);
        };
        let cell =
            |share: f64| ((share.fract() * tag::N_CELLS as f64) as usize).min(tag::N_CELLS - 1);
        let white = cells[cell(down)][cell(across)];
        scale(
            if white {
                [0.93, 0.93, 0.91]
            } else {
                [0.06, 0.06, 0.07]
            },
            light,
        )
    })
}

/// Rectangle of a box's side in its texture, as left, top, right, bottom. The sides are in two rows
/// of three, from the top left.
pub(crate) fn side_rectangle(side: usize) -> [f64; 4] {
    let column = (side % 3) as f64;
    let row = (side / 3) as f64;
    [
        column / 3.0,
        row / 3.0,
        (column + 1.0) / 3.0,
        (row + 1.0) / 3.0,
    ]
}

/// A concrete floor.
pub(crate) fn concrete() -> Texture {
    let rough = Noise::new(71);
    let blotch = Noise::new(72);
    Texture::paint(SIDE_PX, |x, y| {
        let shade = 0.5
            + 0.35 * blotch.rough(x * 8.0, y * 8.0, 5)
            + 0.2 * rough.rough(x * 120.0, y * 120.0, 3);
        let joint = ((x * 4.0).fract() - 0.5)
            .abs()
            .max(((y * 4.0).fract() - 0.5).abs());
        scale(
            [0.52, 0.51, 0.49],
            shade * (1.0 - 0.5 * step(0.49, 0.497, joint)),
        )
    })
}
