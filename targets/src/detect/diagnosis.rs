//! Reasons why markers of a target were not found.

use crate::dictionary::Dictionary;
use crate::error::{Counts, Ids, NotDetected};
use crate::gray::Plane;
use crate::homography::Homography;
use crate::lattice::distance;
use crate::layout::{self, Layout, layouts};
use crate::marker::{Exact, Marker, read_exactly};
use crate::quad::Quad;
use crate::spec::{Millimeters, Pattern, TargetSpec};

/// Minimum number of different markers that were read without an error. Fewer such markers may
/// occur by chance.
const MIN_MARKERS: usize = 3;
/// If markers have at least this many cells per side, a single marker without an error does not
/// occur by chance. Random cells match one of 1000 markers, in any of four rotations, with a
/// probability of `4000 / 2^36`, or 6e-8. With 4 cells, it would be 6 %.
const MIN_BITS_OF_SINGLE: usize = 6;

/// Minimum relative difference in the size of markers that may prevent the detection of corners.
pub(super) const MIN_SIZE_CHANGE: f64 = 0.1;

/// The size of ChArUco markers relative to the squares, if it differs from the size on the target.
///
/// Each marker measures the distance to its neighbors in units of its side.
///
/// * `min_change`: smaller relative differences are ignored. Blur makes small markers look up to 10
///   % smaller.
pub(super) fn marker_size(
    target: &TargetSpec,
    markers: &[Marker],
    min_change: f64,
) -> Option<NotDetected> {
    /// Minimum number of pairs. Fewer pairs could agree by chance.
    const MIN_PAIRS: usize = 4;
    /// Minimum fraction of pairs that measure the same size if the markers are in the right places.
    const MIN_SAME_FRAC: f64 = 0.8;
    /// Largest relative difference between sizes that count as the same. Lens and perspective
    /// change the scale from a marker to its neighbor.
    const SAME: f64 = 0.1;
    let Pattern::Charuco {
        square_m, marker_m, ..
    } = target.pattern
    else {
        return None;
    };
    let expected_frac = marker_m / square_m;
    // If the markers are not at the places of the layout, their distances scatter. The first layout
    // in which most pairs agree is the right layout.
    let mut measured = None;
    for layout in layouts(&target.pattern) {
        let mut fracs = neighbor_fracs(&layout, markers, square_m, marker_m);
        fracs.sort_by(f64::total_cmp);
        let Some(&median) = fracs.get(fracs.len() / 2) else {
            continue;
        };
        let n_same = fracs
            .iter()
            .filter(|frac| (*frac / median - 1.0).abs() < SAME)
            .count();
        if fracs.len() >= MIN_PAIRS && n_same as f64 >= MIN_SAME_FRAC * fracs.len() as f64 {
            measured = Some(median);
            break;
        }
    }
    let found_frac = measured?;
    // A marker that is as large as its square was misread.
    let is_possible = found_frac > 0.0 && found_frac < 1.0;
    (is_possible && (found_frac / expected_frac - 1.0).abs() > min_change).then(|| {
        NotDetected::MarkerSize {
            found_frac,
            expected_frac,
            square: Millimeters(square_m).to_string(),
            marker: format!("{:.0}mm", 1e3 * found_frac * square_m),
        }
    })
}

/// The counts of the board that the markers form, if the markers fit other counts better than the
/// counts of the target.
///
/// * `n_confirmed`: number of markers that fit the counts of the target.
pub(super) fn other_counts(
    target: &TargetSpec,
    markers: &[Marker],
    n_confirmed: usize,
) -> Option<NotDetected> {
    // Maximum number of columns. It bounds the time of a failed detection. Boards of common paper
    // sizes have fewer columns.
    const MAX_COLUMNS: u32 = 40;
    // Minimum number of confirmed markers. With fewer confirmed markers, another board may fit by
    // chance.
    const MIN_CONFIRMED: usize = 4;
    let (expected, what) = match target.pattern {
        Pattern::Charuco { squares, .. } => (squares, "squares"),
        Pattern::Aprilgrid { tags, .. } => (tags, "tags"),
        _ => return None,
    };
    let n_ids = markers.iter().map(|marker| marker.id + 1).max()?;
    // The number of columns alone determines where a marker is. The number of rows is the smallest
    // number with which the board contains all ids. If the ids also fit the target with columns and
    // rows swapped, the swapped counts are used.
    let counts = (2..=MAX_COLUMNS)
        .filter(|columns| *columns != expected[0])
        .map(|columns| {
            // Every second square of a ChArUco board has a marker.
            let per_marker = if what == "squares" { 2 } else { 1 };
            let needed = (per_marker * n_ids).div_ceil(columns).max(2);
            let is_swapped = columns == expected[1] && needed <= expected[0];
            [columns, if is_swapped { expected[0] } else { needed }]
        });
    let fits = counts.filter_map(|counts| {
        let layouts = layouts(&with_counts(&target.pattern, counts));
        Some((counts, layout::fit(layouts, markers)?.n_confirmed))
    });
    // If several counts are equally good, the swapped counts are used, because swapped sides are a
    // more common mistake than a different board.
    let (found, n_found) =
        fits.max_by_key(|(counts, n)| (*n, *counts == [expected[1], expected[0]]))?;
    let of = |[columns, rows]: [u32; 2]| Counts { columns, rows };
    (n_found >= MIN_CONFIRMED && n_found > 2 * n_confirmed).then(|| NotDetected::OtherCounts {
        found: of(found),
        expected: of(expected),
        what,
    })
}

/// The pattern with other counts of columns and rows. Patterns without counts of markers are
/// returned unchanged.
fn with_counts(pattern: &Pattern, counts: [u32; 2]) -> Pattern {
    match pattern.clone() {
        Pattern::Charuco {
            square_m,
            marker_m,
            dictionary,
            ..
        } => Pattern::Charuco {
            squares: counts,
            square_m,
            marker_m,
            dictionary,
        },
        Pattern::Aprilgrid {
            tag_m,
            spacing_frac,
            ..
        } => Pattern::Aprilgrid {
            tags: counts,
            tag_m,
            spacing_frac,
        },
        other => other,
    }
}

/// A quadrilateral relative to a point.
fn relative(quad: &Quad, [x, y]: [f64; 2]) -> Quad {
    quad.map(|corner| [corner[0] - x, corner[1] - y])
}

/// The sizes of a marker relative to a square that follow from each marker and its neighbors.
fn neighbor_fracs(layout: &Layout, markers: &[Marker], square_m: f64, marker_m: f64) -> Vec<f64> {
    const MAX_SQUARES: f64 = 1.6; // Diagonal neighbors.
    let mut fracs = Vec::new();
    for from in markers {
        let Some(corners_m) = layout.corners_m.get(from.id as usize) else {
            continue;
        };
        // `Homography` needs points near the origin.
        let center_m = layout::center(corners_m);
        let center_px = layout::center(&from.corners_px);
        let on_board = relative(corners_m, center_m);
        let in_image = relative(&from.corners_px, center_px);
        let Some(board_from_pixel) = Homography::from_corners(&in_image, &on_board) else {
            continue;
        };
        for to in markers.iter().filter(|to| to.id != from.id) {
            let Some(to_m) = layout.corners_m.get(to.id as usize) else {
                continue;
            };
            let squares = distance(layout::center(to_m), center_m) / square_m;
            let [x, y] = layout::center(&to.corners_px);
            let [across, along] = board_from_pixel.map([x - center_px[0], y - center_px[1]]);
            // The layout gives the distance of the neighbor in squares, and the homography of the
            // marker measures it in sides of the marker. The ratio of the two distances is the size
            // of the marker.
            let sides = across.hypot(along) / marker_m;
            if squares < MAX_SQUARES && sides > 0.0 && sides.is_finite() {
                fracs.push(squares / sides);
            }
        }
    }
    fracs
}

/// Whether this number of different markers without an error is too large to occur by chance.
fn is_plausible(n: usize, dictionary: &Dictionary) -> bool {
    n >= MIN_MARKERS || (n > 0 && dictionary.n_bits() >= MIN_BITS_OF_SINGLE)
}

/// Number of markers, reduced by four times the number of markers that are expected by chance.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a small positive number"
)]
fn n_certain(exact: &Exact) -> usize {
    exact
        .ids
        .len()
        .saturating_sub((4.0 * exact.n_by_chance).ceil() as usize)
}

/// Explains why the markers found in an image differ from the markers of the target.
pub(super) fn markers(
    target: &TargetSpec,
    plane: &Plane,
    quads: &[Quad],
    dictionary: &Dictionary,
    markers: &[Marker],
) -> NotDetected {
    let n_on_target = match target.pattern {
        Pattern::Tag { .. } => 1,
        _ => layouts(&target.pattern)
            .first()
            .map_or(0, |layout| layout.corners_m.len()),
    };
    let first_id = if let Pattern::Tag { id, .. } = target.pattern {
        id
    } else {
        0
    };
    let expected = first_id..first_id + u32::try_from(n_on_target).unwrap_or(0);
    let mut ids: Vec<u32> = markers.iter().map(|marker| marker.id).collect();
    ids.dedup();
    // The markers belong to the right dictionary. Either the target is a different one, or its
    // description is wrong.
    if is_plausible(ids.len(), dictionary) {
        let n_expected = ids.iter().filter(|id| expected.contains(id)).count();
        let found = Ids(ids);
        // If most ids are not on the target, the board is a different one. Otherwise, the counts or
        // sizes are wrong. The most specific reasons are tested first.
        return if 2 * n_expected < found.0.len() {
            NotDetected::OtherIds {
                found,
                expected: Ids(expected.collect()),
            }
        } else {
            let reason = other_counts(target, markers, 0)
                .or_else(|| marker_size(target, markers, MIN_SIZE_CHANGE));
            reason.unwrap_or(NotDetected::OtherArrangement { found })
        };
    }
    // Cameras that flip their images horizontally show valid cells in mirrored order.
    let mirrored = read_exactly(plane, quads, dictionary, true);
    if is_plausible(n_certain(&mirrored), dictionary) {
        return NotDetected::Mirrored {
            n: mirrored.ids.len(),
        };
    }
    // All other dictionaries are tried last, because this takes the longest.
    let others = Dictionary::all().filter(|other| other != dictionary);
    let read = others.map(|other| (read_exactly(plane, quads, &other, false), other));
    // If several dictionaries are equally good, the first dictionary is used. It is the smallest
    // dictionary that contains all markers.
    let best = read.reduce(|best, next| {
        if next.0.ids.len() > best.0.ids.len() {
            next
        } else {
            best
        }
    });
    match best {
        Some((exact, found)) if is_plausible(n_certain(&exact), &found) => {
            let n = exact.ids.len();
            NotDetected::OtherDictionary {
                found: found.name().to_owned(),
                expected: dictionary.name().to_owned(),
                n,
            }
        }
        _ => NotDetected::Nothing {
            target: target.kind(),
        },
    }
}
