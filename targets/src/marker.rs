//! Reads the cells of square markers and decodes them.

use crate::dictionary::{Dictionary, Match};
use crate::gray::Plane;
use crate::homography::Homography;
use crate::lattice::distance;
use crate::quad::{Quad, shortest_side};

/// Smallest difference in gray value between black and white cells. With a lower value, cells are
/// read from noise. With a higher value, markers in dark images are lost.
const MIN_CONTRAST: f32 = 14.0;
/// Fraction of the border cells that may be read wrong. For a 4X4 marker, it allows 2 of the 20
/// border cells. Fingers and highlights cover single cells. In texture without a border, about half
/// of the cells are wrong.
const MAX_BORDER_ERRORS: f64 = 0.1;

/// A square of side 1 with its corners in the order of a [`Quad`].
pub(crate) const UNIT_SQUARE: Quad = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];

/// A marker found in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Marker {
    pub(crate) id: u32,
    /// Upper left, upper right, lower right, lower left corner of the upright marker, pixels.
    pub(crate) corners_px: Quad,
    n_wrong: u32,
}

/// Decodes the markers among quadrilaterals, in ascending order of ids. Markers found several times
/// are merged. If an id is at several places, all its markers are returned.
///
/// `borders` contains the possible widths of the black border, in cells.
pub(crate) fn decode(
    plane: &Plane,
    quads: &[Quad],
    dictionary: &Dictionary,
    borders: &[usize],
) -> Vec<Marker> {
    let mut markers: Vec<Marker> = Vec::new();
    for quad in quads {
        // The width of the border is not known. At a wrong width, the cells do not align, and no
        // code fits.
        let decoded = borders.iter().find_map(|&border| {
            let cells = read_cells(plane, quad, dictionary.n_bits(), border)?;
            dictionary.decode(&cells)
        });
        let Some(Match {
            id,
            quarter_turns,
            n_wrong,
        }) = decoded
        else {
            continue;
        };
        // The order starts with the upper left corner of the upright marker.
        let corners_px = std::array::from_fn(|at| quad[(at + quarter_turns) % 4]);
        let marker = Marker {
            id,
            corners_px,
            n_wrong,
        };
        let is_same = |other: &&mut Marker| {
            other.id == id
                && distance(other.corners_px[0], corners_px[0]) < shortest_side(quad) / 2.0
        };
        match markers.iter_mut().find(is_same) {
            // Outlines of larger windows are more accurate, and come later.
            Some(same) if n_wrong <= same.n_wrong => *same = marker,
            Some(_) => {}
            None => markers.push(marker),
        }
    }
    markers.sort_by(|a, b| {
        a.id.cmp(&b.id)
            .then(a.corners_px[0][0].total_cmp(&b.corners_px[0][0]))
    });
    markers
}

/// Markers of a dictionary that are read without any error.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Exact {
    /// Different ids, ascending.
    pub(crate) ids: Vec<u32>,
    /// Number of markers expected by chance among the quadrilaterals with a black border.
    pub(crate) n_by_chance: f64,
}

/// Reads the markers of a dictionary, or the mirrored markers of this dictionary.
pub(crate) fn read_exactly(
    plane: &Plane,
    quads: &[Quad],
    dictionary: &Dictionary,
    is_mirrored: bool,
) -> Exact {
    let n = dictionary.n_bits();
    let mut exact = Exact::default();
    for quad in quads {
        let Some(mut cells) = read_cells(plane, quad, n, 1) else {
            continue;
        };
        // By chance, random cells may equal one of the codes in one of four rotations.
        exact.n_by_chance += 4.0 * f64::from(dictionary.n_markers()) * 0.5_f64.powf((n * n) as f64);
        if is_mirrored {
            cells.chunks_exact_mut(n).for_each(<[bool]>::reverse);
        }
        exact
            .ids
            .extend(dictionary.decode_exactly(&cells).map(|found| found.id));
    }
    exact.ids.sort_unstable();
    exact.ids.dedup();
    exact
}

/// Reads the cells inside the border, row by row. A value of true is black. `None` if the border is
/// not black or the contrast is low.
fn read_cells(plane: &Plane, quad: &Quad, n_bits: usize, border: usize) -> Option<Vec<bool>> {
    let n = n_bits + 2 * border;
    // Cells smaller than 1.5 pixels are blurred into each other.
    if shortest_side(quad) < 1.5 * n as f64 {
        return None;
    }
    let pixel_from_unit = Homography::from_corners(&UNIT_SQUARE, quad)?;
    let mut values = Vec::with_capacity(n * n);
    for at in 0..n * n {
        // Positions of the samples in a cell. They are away from its sides, because neighboring
        // cells blur into it there.
        const OFFSETS: [[f64; 2]; 5] = [[0.5, 0.5], [0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.7, 0.7]];
        let cell = [at % n, at / n].map(|count| count as f64);
        let samples = OFFSETS.map(|[x, y]| {
            let in_marker = [(cell[0] + x) / n as f64, (cell[1] + y) / n as f64];
            plane.sample(pixel_from_unit.map(in_marker))
        });
        values.push(samples.iter().sum::<f32>() / OFFSETS.len() as f32);
    }
    // Each marker has its own threshold, so that it adapts to the lighting in the image.
    let threshold = threshold(&values)?;
    let is_black: Vec<bool> = values.iter().map(|&value| value < threshold).collect();
    let is_inside = |at: usize| {
        (border..n - border).contains(&(at % n)) && (border..n - border).contains(&(at / n))
    };
    // The border is checked first, because most dark quadrilaterals are not markers.
    let n_border = n * n - n_bits * n_bits;
    let n_wrong = (0..n * n)
        .filter(|&at| !is_inside(at) && !is_black[at])
        .count();
    if n_wrong as f64 > MAX_BORDER_ERRORS * n_border as f64 {
        return None;
    }
    Some(
        (0..n * n)
            .filter(|&at| is_inside(at))
            .map(|at| is_black[at])
            .collect(),
    )
}

/// The gray value that separates black from white cells best (Otsu 1979). `None` if the contrast is
/// low.
fn threshold(values: &[f32]) -> Option<f32> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let total: f32 = sorted.iter().sum();
    let mut sum = 0.0;
    let mut best = (0.0, 0.0, 0.0);
    for at in 1..sorted.len() {
        sum += sorted[at - 1];
        let n_low = at as f32;
        let n_high = (sorted.len() - at) as f32;
        let difference = (total - sum) / n_high - sum / n_low;
        // This is the variance between the two classes, times a constant.
        let variance = n_low * n_high * difference * difference;
        if variance > best.0 {
            best = (variance, difference, (sorted[at - 1] + sorted[at]) / 2.0);
        }
    }
    let (_, difference, threshold) = best;
    (difference >= MIN_CONTRAST).then_some(threshold)
}
