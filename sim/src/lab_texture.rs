//! Procedural textures for floors and walls of rooms, and sheets of 16 small pictures for posters
//! and for items on shelves.
#![expect(
    clippy::cast_possible_truncation,
    reason = "picture indices on a sheet are small integers"
)]

use crate::mesh::TextureRect;
use crate::random::RandomStream;
use crate::texture::{self, Color, Noise, SIDE_PX, Texture, mix, scale, step};

/// Number of pictures along a side of a sheet.
const N_ACROSS: usize = 4;

/// Rectangle of a picture on a sheet. Indices past the last picture wrap around.
pub(crate) fn picture(ix: usize) -> TextureRect {
    /// The inset keeps mip levels from mixing neighboring pictures.
    const INSET: f64 = 0.004;
    let side = 1.0 / N_ACROSS as f64;
    let x = (ix % N_ACROSS) as f64 * side;
    let y = (ix / N_ACROSS % N_ACROSS) as f64 * side;
    [x + INSET, y + INSET, x + side - INSET, y + side - INSET]
}

/// Paints a sheet. `paint` receives the picture's index and the position in it.
fn sheet(paint: impl Fn(usize, f64, f64) -> Color + Sync) -> Texture {
    Texture::paint(3 * SIDE_PX / 2, |x, y| {
        let across = x * N_ACROSS as f64;
        let down = y * N_ACROSS as f64;
        paint(
            down as usize * N_ACROSS + across as usize,
            across.fract(),
            down.fract(),
        )
    })
}

/// A color from a hue of 0 to 1.
fn hue(at: f64, dark: f64, light: f64) -> Color {
    let channel = |shift: f64| {
        dark + (light - dark) * (0.5 + 0.5 * ((at + shift) * std::f64::consts::TAU).cos())
    };
    [channel(0.0), channel(-1.0 / 3.0), channel(1.0 / 3.0)]
}

/// Sixteen posters, boards and windows.
pub(crate) fn posters() -> Texture {
    let noise = Noise::new(101);
    let each = RandomStream::new(0x7e37, &[102]);
    sheet(|ix, u, v| {
        let edge = u.min(1.0 - u).min(v.min(1.0 - v));
        let own = each.unit(ix as u64);
        let inside = match ix {
            0 | 9 => texture::sunrise(u, v),
            1 | 6 => texture::squares((u + own) / 1.6, (v + own) / 1.6),
            2 | 11 => texture::map(&noise, u + 3.0 * own, v),
            3 | 13 => texture::stripes(u + own, v),
            4 | 12 => window(&noise, u, v),
            5 => whiteboard(&noise, u, v),
            7 | 15 => curves(own, u, v),
            8 => rings(own, u, v),
            10 => letters(each, u, v),
            _ => spots(each, ix as u64, u, v),
        };
        let frame = if ix % 3 == 0 {
            [0.16, 0.15, 0.15]
        } else {
            [0.92, 0.91, 0.88]
        };
        mix(frame, inside, step(0.025, 0.03, edge))
    })
}

fn window(noise: &Noise, u: f64, v: f64) -> Color {
    let pane = ((u * 2.0).fract() - 0.5)
        .abs()
        .max(((v * 2.0).fract() - 0.5).abs());
    let cloud = noise.rough(u * 3.0, v * 5.0 + 9.0, 5);
    let sky = mix(
        [0.45, 0.66, 0.92],
        [0.95, 0.96, 0.98],
        step(0.45, 0.65, cloud),
    );
    let roofs = 0.66 + 0.07 * ((u * 7.0).floor() * 2.7).sin();
    let lit = ((u * 21.0).fract() > 0.4 && (v * 30.0).fract() > 0.5) as u8 as f64;
    let outside = if v > roofs {
        mix([0.30, 0.24, 0.22], [0.75, 0.70, 0.55], 0.7 * lit)
    } else {
        sky
    };
    if pane > 0.46 {
        [0.82, 0.81, 0.78]
    } else {
        outside
    }
}

fn whiteboard(noise: &Noise, u: f64, v: f64) -> Color {
    let line =
        (v * 14.0).fract() - 0.5 + 0.35 * (noise.at(u * 46.0, (v * 14.0).floor() * 7.0) - 0.5);
    let written = noise.at(u * 9.0, (v * 14.0).floor() * 3.1) > 0.36 && u < 0.62;
    let ink = hue((v * 3.5).floor() * 0.31, 0.05, 0.55);
    let circle = ((u - 0.8).hypot(v - 0.45) - 0.13)
        .abs()
        .min(((u - 0.8).abs() + (v - 0.45).abs() - 0.1).abs());
    let board = scale(
        [0.94, 0.95, 0.96],
        0.93 + 0.07 * noise.rough(u * 6.0, v * 6.0, 3),
    );
    if (written && line.abs() < 0.06) || circle < 0.006 {
        ink
    } else {
        board
    }
}

fn curves(own: f64, u: f64, v: f64) -> Color {
    let grid = ((u * 10.0).fract() - 0.5)
        .abs()
        .max(((v * 8.0).fract() - 0.5).abs());
    let paper = if grid > 0.47 {
        [0.72, 0.76, 0.80]
    } else {
        [0.97, 0.97, 0.94]
    };
    let near = (0..4).map(|ix| {
        let k = f64::from(ix);
        let y =
            0.5 - 0.36 * (-(2.0 + k) * u).exp() * ((9.0 + 4.0 * k) * (u + own)).cos() - 0.05 * k;
        ((v - y).abs(), hue(0.27 * k + own, 0.05, 0.85))
    });
    // If curves overlap, the first curve is on top.
    near.filter(|(distance, _)| *distance < 0.013)
        .map(|(_, color)| color)
        .next()
        .unwrap_or(paper)
}

fn rings(own: f64, u: f64, v: f64) -> Color {
    let radius = (u - 0.5).hypot(v - 0.5) * 13.0;
    scale(
        hue(radius.floor() * 0.21 + own, 0.12, 0.92),
        0.85 + 0.15 * radius.fract(),
    )
}

fn letters(each: RandomStream, u: f64, v: f64) -> Color {
    let column = (u * 12.0).floor();
    let row = (v * 9.0).floor();
    let cell = (row * 12.0 + column) as u64;
    let x = ((u * 12.0).fract() * 5.0) as u64;
    let y = ((v * 9.0).fract() * 6.0) as u64;
    // A character is a random bitmap of 4 x 5 bits. The last column and row of its cell stay free.
    let on = x < 4 && y < 5 && each.bits(900 + cell) >> (y * 4 + x) & 1 == 1;
    let paper = hue((cell % 7) as f64 / 7.0, 0.62, 0.95);
    if on { [0.08, 0.08, 0.12] } else { paper }
}

fn spots(each: RandomStream, ix: u64, u: f64, v: f64) -> Color {
    let ground = hue(each.unit(50 + ix), 0.25, 0.8);
    // The spots are searched from the last to the first, so that later spots cover earlier spots.
    let top = (0..14).rev().find(|spot| {
        let at = |counter: u64| each.unit(ix * 100 + spot * 4 + counter);
        (u - at(0)).hypot(v - at(1)) < 0.04 + 0.13 * at(2)
    });
    top.map_or(ground, |spot| {
        hue(each.unit(ix * 100 + spot * 4 + 3), 0.1, 0.95)
    })
}

/// Sixteen items for shelves and benches, which are cartons, crates, books, instruments and
/// screens.
pub(crate) fn items() -> Texture {
    let noise = Noise::new(111);
    let each = RandomStream::new(0x7e37, &[112]);
    sheet(|ix, u, v| {
        // The offset gives each picture another part of the noise.
        let grain = 0.86 + 0.2 * noise.rough(u * 30.0 + ix as f64 * 40.0, v * 30.0, 3);
        let worn = 0.75 + 0.4 * noise.rough(u * 3.0 + ix as f64 * 11.0, v * 3.0, 4);
        let color = match ix {
            0 | 1 => carton(each, ix as u64, u, v),
            2 | 3 => slats(&noise, ix, u, v),
            4..=6 => books(each, ix as u64, u, v),
            7 | 8 => instrument(each, ix as u64, u, v),
            9 => screen(&noise, u, v),
            10 => warning(u, v),
            11 => drawers(u, v),
            12 => mix(
                [0.20, 0.24, 0.30],
                [0.33, 0.38, 0.46],
                noise.rough(u * 9.0, v * 50.0, 3),
            ),
            _ => tin(each, ix as u64, u, v),
        };
        scale(color, grain * worn)
    })
}

fn carton(each: RandomStream, ix: u64, u: f64, v: f64) -> Color {
    let board = [0.74, 0.57, 0.38];
    let tape = (v - 0.5).abs() < 0.06;
    let label = (0.55..0.9).contains(&u) && (0.12..0.36).contains(&v);
    // Random bits look like a bar code.
    let bars = each.bits(30 + ix) >> ((u * 120.0) as u64 % 48) & 1 == 1 && v > 0.22;
    match (label, tape) {
        (true, _) => {
            if bars {
                [0.1, 0.1, 0.1]
            } else {
                [0.95, 0.95, 0.92]
            }
        }
        (_, true) => {
            if ix == 0 {
                [0.86, 0.78, 0.55]
            } else {
                [0.80, 0.22, 0.18]
            }
        }
        _ => board,
    }
}

fn slats(noise: &Noise, ix: usize, u: f64, v: f64) -> Color {
    let (along, across) = if ix == 2 { (u, v * 5.0) } else { (v, u * 5.0) };
    let gap = (across.fract() - 0.5).abs() > 0.45;
    let nail = (along.min(1.0 - along) - 0.06).hypot((across.fract() - 0.5) * 0.2) < 0.014;
    let wood = mix(
        [0.44, 0.29, 0.16],
        [0.82, 0.64, 0.42],
        noise.rough(along * 4.0, across * 14.0 + across.floor() * 9.0, 4),
    );
    if gap {
        [0.07, 0.05, 0.04]
    } else if nail {
        [0.2, 0.2, 0.21]
    } else {
        wood
    }
}

fn books(each: RandomStream, ix: u64, u: f64, v: f64) -> Color {
    let mut left = 0.0;
    for book in 0..24 {
        // Widths are random, so the widths of the books to the left have to be added up.
        let at = |counter: u64| each.unit(ix * 1000 + book * 8 + counter);
        let width = 0.035 + 0.055 * at(0);
        if u < left + width {
            let inside = (u - left) / width;
            let top = 0.04 + 0.22 * at(1);
            // The dark shelf shows above a book and at its sides.
            if v < top || !(0.05..0.95).contains(&inside) {
                return [0.05, 0.04, 0.04];
            }
            let title = (inside - 0.5).abs() < 0.18
                && (top + 0.15..0.7).contains(&v)
                && (v * 40.0).fract() < 0.6;
            let band = (v - 0.82).abs() < 0.025;
            return if title || band {
                [0.93, 0.88, 0.70]
            } else {
                hue(at(2), 0.1, 0.35 + 0.5 * at(3))
            };
        }
        left += width;
    }
    [0.05, 0.04, 0.04]
}

fn instrument(each: RandomStream, ix: u64, u: f64, v: f64) -> Color {
    let shell = if ix == 7 {
        [0.72, 0.74, 0.72]
    } else {
        [0.22, 0.25, 0.28]
    };
    if (0.08..0.5).contains(&u) && (0.14..0.6).contains(&v) {
        let trace = 0.37 + 0.12 * (u * 60.0).sin() * (u * 17.0).cos();
        return if (v - trace).abs() < 0.018 {
            [0.4, 1.0, 0.5]
        } else {
            [0.03, 0.12, 0.08]
        };
    }
    let x = (u - 0.56) * 10.0;
    let y = (v - 0.12) * 7.0;
    if u > 0.56 && u < 0.96 && v > 0.12 && v < 0.97 {
        let knob = (x.fract() - 0.5).hypot(y.fract() - 0.5);
        let cell = (x.floor() + 10.0 * y.floor()) as u64;
        if knob < 0.33 {
            return if knob > 0.26 {
                [0.08, 0.08, 0.08]
            } else {
                hue(each.unit(ix * 90 + cell), 0.15, 0.85)
            };
        }
    }
    shell
}

fn screen(noise: &Noise, u: f64, v: f64) -> Color {
    if u.min(1.0 - u).min(v.min(1.0 - v)) < 0.05 {
        return [0.05, 0.05, 0.06];
    }
    if v < 0.14 {
        return [0.16, 0.32, 0.62];
    }
    let line = (v * 26.0).floor();
    let text = u < 0.15 + 0.4 * noise.at(line * 3.7, 1.0)
        && (v * 26.0).fract() < 0.55
        && noise.at(u * 90.0, line) > 0.4;
    let plot = 0.6 + 0.2 * (u * 22.0).sin() * noise.at(u * 7.0, 4.0);
    if u > 0.55 && v > plot {
        [0.95, 0.55, 0.15]
    } else if text {
        [0.7, 0.95, 0.8]
    } else {
        [0.06, 0.09, 0.13]
    }
}

fn warning(u: f64, v: f64) -> Color {
    if ((u + v) * 6.0).fract() < 0.5 {
        [0.95, 0.78, 0.08]
    } else {
        [0.08, 0.08, 0.08]
    }
}

fn drawers(u: f64, v: f64) -> Color {
    let x = (u * 3.0).fract();
    let y = (v * 5.0).fract();
    let gap = (x - 0.5).abs().max((y - 0.5).abs()) > 0.47;
    let label = (x - 0.5).abs() < 0.2 && (y - 0.35).abs() < 0.12;
    let handle = (x - 0.5).abs() < 0.14 && (y - 0.72).abs() < 0.07;
    let body = hue(
        ((u * 3.0).floor() + (v * 5.0).floor() * 2.0) * 0.13,
        0.28,
        0.72,
    );
    if gap {
        [0.1, 0.1, 0.11]
    } else if label {
        [0.95, 0.95, 0.9]
    } else if handle {
        [0.12, 0.12, 0.13]
    } else {
        body
    }
}

fn tin(each: RandomStream, ix: u64, u: f64, v: f64) -> Color {
    let band = (v * 5.0).floor() as u64;
    let emblem = (u - 0.5).hypot((v - 0.5) * 1.2) < 0.24;
    if emblem {
        hue(each.unit(ix * 9 + 70), 0.5, 0.98)
    } else {
        hue(each.unit(ix * 9 + band), 0.08, 0.75)
    }
}

/// Worn floor tiles with a marked lane around the middle. Covers a whole room of `size_m` with
/// tiles of 0.5 m.
pub(crate) fn floor_tiles(size_m: [f64; 2], lane_m: f64) -> Texture {
    let rough = Noise::new(121);
    let blotch = Noise::new(122);
    let each = RandomStream::new(0x7e37, &[123]);
    Texture::paint(2 * SIDE_PX, |u, v| {
        // Coordinates are in meters, so that tiles are square in a room of any shape.
        let x = (u - 0.5) * size_m[0];
        let y = (v - 0.5) * size_m[1];
        let column = (x * 2.0).floor();
        let row = (y * 2.0).floor();
        let joint = ((x * 2.0).fract().abs() - 0.5)
            .abs()
            .max(((y * 2.0).fract().abs() - 0.5).abs());
        // The offsets make the indices positive, because the origin is in the middle of the floor.
        let own = each.unit((column + 64.0) as u64 * 128 + (row + 64.0) as u64);
        let tile = mix(
            [0.15, 0.17, 0.20],
            [0.80, 0.77, 0.70],
            0.1 * own + 0.9 * step(0.45, 0.55, own),
        );
        let speckled = 0.62
            + 0.5 * rough.rough(x * 22.0, y * 22.0, 3)
            + 0.3 * blotch.rough(x * 1.3, y * 1.3, 4);
        let floor = mix(
            [0.16, 0.16, 0.17],
            scale(tile, speckled),
            step(0.496, 0.484, joint),
        );
        let lane = (x.abs().max(y.abs() * 1.25) - lane_m).abs();
        let dashed = lane < 0.05 && ((x + y) * 3.0).fract().abs() < 0.6;
        if dashed {
            scale([0.92, 0.76, 0.12], speckled)
        } else {
            floor
        }
    })
}

/// A repeating texture of a painted wall, 3 m high and wide. It has a green dado, a rail, and
/// plaster above the rail.
pub(crate) fn painted_wall() -> Texture {
    let rough = Noise::new(131);
    let stain = Noise::new(132);
    Texture::paint(SIDE_PX, |u, v| {
        // The noise must match at the edges where the texture repeats.
        let grain = 0.75 + 0.4 * rough.rough((u * 2.0 - 1.0).abs() * 40.0, v * 80.0, 4);
        let stained = stain.rough((u * 2.0 - 1.0).abs() * 5.0, v * 7.0, 5);
        let seam = (u * 4.0).fract() < 0.012;
        let plaster = mix(
            [0.92, 0.88, 0.78],
            [0.56, 0.62, 0.66],
            step(0.40, 0.62, stained),
        );
        let dado = mix(
            [0.10, 0.26, 0.24],
            [0.22, 0.38, 0.30],
            step(0.35, 0.6, stained),
        );
        let wall = if v > 0.645 {
            dado
        } else if v > 0.62 {
            [0.36, 0.22, 0.14]
        } else {
            plaster
        };
        scale(wall, grain * if seam { 0.55 } else { 1.0 })
    })
}

/// Scratched yellow enamel with screws along its edge, for the sides of a cabinet.
pub(crate) fn enamel() -> Texture {
    let rough = Noise::new(141);
    let scratch = Noise::new(142);
    Texture::paint(SIDE_PX, |u, v| {
        let edge = u.min(1.0 - u).min(v.min(1.0 - v));
        let worn = step(
            0.55,
            0.72,
            rough.rough(u * 6.0, v * 6.0, 5) + 0.25 * step(0.06, 0.0, edge),
        );
        let line = (scratch.at(u * 16.0 + v * 5.0, v * 19.0 - u * 7.0) - 0.5).abs() < 0.004;
        let at = |x: f64| ((x * 6.0).fract() - 0.5).abs() / 6.0;
        let screw = (edge - 0.03).abs().hypot(at(u).min(at(v))) < 0.011;
        let paint = scale(
            [0.93, 0.71, 0.08],
            0.72 + 0.4 * rough.rough(u * 40.0, v * 40.0, 3),
        );
        let paint = mix(paint, [0.40, 0.26, 0.14], 0.75 * worn);
        if screw {
            [0.25, 0.25, 0.26]
        } else if line {
            [0.97, 0.93, 0.75]
        } else {
            paint
        }
    })
}

/// A galvanized mounting plate with rows of slots.
pub(crate) fn mounting_plate() -> Texture {
    let spangle = Noise::new(151);
    let rough = Noise::new(152);
    Texture::paint(SIDE_PX, |u, v| {
        // There are few levels, because the crystals of a zinc coating have sharp borders.
        let crystals = (spangle.rough(u * 26.0, v * 26.0, 2) * 9.0).floor() / 9.0;
        let plate = scale(
            mix([0.42, 0.45, 0.49], [0.80, 0.82, 0.84], crystals),
            0.8 + 0.3 * rough.rough(u * 70.0, v * 70.0, 2),
        );
        let x = (u * 24.0).fract() - 0.5;
        let y = (v * 16.0).fract() - 0.5;
        if x.abs() < 0.3 && y.abs() < 0.13 {
            [0.06, 0.06, 0.07]
        } else {
            plate
        }
    })
}
