//! Positions of markers on a board, and the choice of the arrangement that fits the markers in an
//! image.

use crate::board::tag_origin;
use crate::homography::Homography;
use crate::lattice::distance;
use crate::marker::{Marker, UNIT_SQUARE};
use crate::quad::Quad;
use crate::spec::Pattern;

/// One arrangement of the markers of a board.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// Corners of every marker in the board frame by marker id, meters. The corners of a marker are
    /// in the order of [`Marker::corners_px`].
    pub(crate) corners_m: Vec<Quad>,
    /// Whether the layout is the arrangement of ChArUco boards before OpenCV 4.6.
    pub(crate) is_legacy: bool,
}

/// Largest deviation of a marker from the position that its neighbor predicts, relative to its
/// side. Lenses and blur cause smaller deviations. In another arrangement, markers are a whole
/// square away.
const MAX_DEVIATION: f64 = 0.35;

/// The arrangements in which a board may be printed, the standard one first.
pub(crate) fn layouts(pattern: &Pattern) -> Vec<Layout> {
    match *pattern {
        Pattern::Charuco {
            squares,
            square_m,
            marker_m,
            ..
        } => {
            let layout = |is_legacy| charuco(squares, square_m, marker_m, is_legacy);
            // For odd numbers of rows, both arrangements are the same.
            if squares[1].is_multiple_of(2) {
                vec![layout(false), layout(true)]
            } else {
                vec![layout(false)]
            }
        }
        Pattern::Aprilgrid {
            tags,
            tag_m,
            spacing_frac,
        } => {
            // Programs differ in the rotation of the tags, but not in their positions.
            let upright: Vec<Quad> = (0..tags[0] * tags[1])
                .map(|id| square_at(tag_origin(tags, tag_m, spacing_frac, id), tag_m))
                .collect();
            let rotated = |quarter_turns: usize| Layout {
                corners_m: upright
                    .iter()
                    .map(|quad| std::array::from_fn(|at| quad[(at + quarter_turns) % 4]))
                    .collect(),
                is_legacy: false,
            };
            (0..4).map(rotated).collect()
        }
        Pattern::Chessboard { .. } | Pattern::Puzzleboard { .. } | Pattern::Tag { .. } => {
            Vec::new()
        }
    }
}

/// Corners of a square with this upper left corner.
fn square_at([x, y]: [f64; 2], side_m: f64) -> Quad {
    UNIT_SQUARE.map(|[column, row]| [x + column * side_m, y + row * side_m])
}

/// Whether a square of a ChArUco board is black. In the legacy pattern with an even number of rows,
/// the colors are swapped.
pub(crate) fn is_black_square(column: u32, row: u32, n_rows: u32, is_legacy: bool) -> bool {
    let is_swapped = is_legacy && n_rows.is_multiple_of(2);
    (column + row).is_multiple_of(2) != is_swapped
}

fn charuco(squares: [u32; 2], square_m: f64, marker_m: f64, is_legacy: bool) -> Layout {
    let margin_m = (square_m - marker_m) / 2.0;
    let cells = (0..squares[1]).flat_map(|row| (0..squares[0]).map(move |column| [column, row]));
    let white = cells.filter(|&[column, row]| !is_black_square(column, row, squares[1], is_legacy));
    // Markers are in the middle of white squares, and numbered in this order.
    let corners_m = white
        .map(|cell| cell.map(|count| f64::from(count) * square_m + margin_m))
        .map(|corner| square_at(corner, marker_m))
        .collect();
    Layout {
        corners_m,
        is_legacy,
    }
}

/// Markers that agree with a layout.
#[derive(Clone, Debug)]
pub(crate) struct Fit {
    pub(crate) layout: Layout,
    pub(crate) markers: Vec<Marker>,
    /// Number of markers that another marker confirms.
    pub(crate) n_confirmed: usize,
}

/// Chooses the layout in which most markers predict the positions of their neighbors. Returns
/// `None` if there is no marker.
///
/// A single marker cannot be confirmed, but is kept.
pub(crate) fn fit(layouts: Vec<Layout>, markers: &[Marker]) -> Option<Fit> {
    let fits = layouts.into_iter().map(|layout| {
        let (markers, n_confirmed) = confirmed(&layout, markers);
        Fit {
            layout,
            markers,
            n_confirmed,
        }
    });
    // If several arrangements are equally good, the first arrangement is kept, which is the
    // standard arrangement.
    let best = fits.reduce(|best, next| {
        if next.n_confirmed > best.n_confirmed {
            next
        } else {
            best
        }
    });
    best.filter(|fit| !fit.markers.is_empty())
}

/// The markers that a majority of their neighbors confirm, or a single marker. Also returns the
/// number of confirmed markers.
fn confirmed(layout: &Layout, markers: &[Marker]) -> (Vec<Marker>, usize) {
    let known: Vec<&Marker> = markers
        .iter()
        .filter(|marker| (marker.id as usize) < layout.corners_m.len())
        .collect();
    let center_m = |marker: &Marker| center(&layout.corners_m[marker.id as usize]);
    let mut votes: Vec<(i32, &Marker)> = Vec::new();
    for marker in &known {
        // Only the nearest markers on the board are used, because they are near enough for a
        // prediction through any lens.
        let mut others: Vec<(f64, &Marker)> = known
            .iter()
            .filter(|other| other.id != marker.id)
            .map(|other| (distance(center_m(marker), center_m(other)), *other))
            .collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0));
        // This is the number of neighbors that a marker inside the board has at the same distance.
        const N_NEIGHBORS: usize = 4;
        let nearest = others.first().map_or(0.0, |other| other.0);
        let close = others
            .iter()
            .take(N_NEIGHBORS)
            .filter(|other| other.0 <= 1.5 * nearest);
        let vote = |other: &Marker| if agrees(layout, marker, other) { 1 } else { -1 };
        votes.push((close.map(|(_, other)| vote(other)).sum(), *marker));
    }
    let n_confirmed = votes.iter().filter(|(votes, _)| *votes > 0).count();
    // A single marker has no neighbor to confirm it. Several markers that do not confirm each other
    // are misread or belong to another board.
    let is_kept = |(votes, _): &&(i32, &Marker)| {
        *votes > 0 || (*votes == 0 && n_confirmed == 0 && known.len() == 1)
    };
    let mut kept: Vec<Marker> = votes
        .iter()
        .filter(is_kept)
        .map(|(_, marker)| **marker)
        .collect();
    // If an id occurs at several positions, none of them is trusted.
    let ids: Vec<u32> = kept.iter().map(|marker| marker.id).collect();
    kept.retain(|marker| ids.iter().filter(|id| **id == marker.id).count() == 1);
    (kept, n_confirmed)
}

/// Whether one of two markers predicts the corners of the other. One direction is enough, because
/// the homography of the smaller image is less accurate.
fn agrees(layout: &Layout, a: &Marker, b: &Marker) -> bool {
    predicts(layout, a, b) || predicts(layout, b, a)
}

/// Whether the homography of a marker predicts the corners of another marker.
fn predicts(layout: &Layout, from: &Marker, to: &Marker) -> bool {
    let corners_m = &layout.corners_m[from.id as usize];
    let origin = center(corners_m);
    let centered = |corners_m: &Quad| corners_m.map(|[x, y]| [x - origin[0], y - origin[1]]);
    let Some(pixel_from_board) = Homography::from_corners(&centered(corners_m), &from.corners_px)
    else {
        return false;
    };
    let to_m = centered(&layout.corners_m[to.id as usize]);
    // The side is the diagonal divided by the square root of 2.
    let side_px = distance(to.corners_px[0], to.corners_px[2]) / 2_f64.sqrt();
    // Farther markers are predicted less accurately, in particular through a fisheye lens.
    let steps =
        (center(&to_m)[0].hypot(center(&to_m)[1]) / distance(corners_m[0], corners_m[1])).max(1.0);
    let off = |at: usize| distance(pixel_from_board.map(to_m[at]), to.corners_px[at]);
    (0..4).all(|at| off(at) <= MAX_DEVIATION * steps * side_px)
}

pub(crate) fn center(quad: &Quad) -> [f64; 2] {
    [0, 1].map(|axis| quad.iter().map(|corner| corner[axis]).sum::<f64>() / 4.0)
}
