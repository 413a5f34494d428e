//! Links saddles along the edges between them into lattices.
//!
//! For every saddle, the nearest saddle along each of its four edges is found. A link is kept if
//! both ends agree on it, and if the image is black on one side and white on the other along the
//! whole link. The links are then followed, which gives every saddle a column and a row. All
//! decisions are local, so the lens may bend the board. The method is similar to Geiger et al.
//! 2012, "Automatic camera and range sensor calibration using a single shot", section III.

use crate::gray::Plane;
use crate::lattice::{Cell, Lattice, STEPS, distance};
use crate::saddle::{Saddle, angle_between};
use std::collections::VecDeque;
use std::f64::consts::PI;

/// Largest angle between an edge and the line to the neighbor, radians.
///
/// The edge's direction is measured on a ring of a few pixels, and fisheye lenses bend the line
/// between two corners. In a frontal view, the next direction of a lattice is the diagonal, which
/// is 0.79 rad away. Half of that separates the two directions.
const MAX_ANGLE_RAD: f64 = 0.4;
/// Largest ratio of the lengths of neighboring links.
///
/// Foreshortening makes the two axes of a board differ by `1 / cos(tilt)`, which is 2.5 at 66
/// degrees. With a smaller value, tilted boards are rejected. With a larger value, links across a
/// missing corner are accepted more often.
const MAX_RATIO: f64 = 2.5;

/// Links saddles. Returns the lattices with at least `min` corners, the largest first.
///
/// The square between corners `(0, 0)` and `(-1, -1)` is black, and colors alternate.
pub(crate) fn link(plane: &Plane, saddles: &[Saddle], min: usize) -> Vec<Lattice> {
    let links = links(plane, saddles);
    let mut is_used = vec![false; saddles.len()];
    let mut grids = Vec::new();
    for seed in 0..saddles.len() {
        // A saddle with a single link is at the end of a line. It is not on a board of at least 3 x
        // 3 corners.
        if is_used[seed] || links[seed].iter().flatten().count() < 2 {
            continue;
        }
        let grid = walk(saddles, &links, seed, &mut is_used);
        if grid.corners.len() >= min {
            grids.push(grid);
        }
    }
    grids.sort_by_key(|grid| std::cmp::Reverse(grid.corners.len()));
    grids
}

/// Neighbor of a saddle along one of its edges, and the index of the edge of the neighbor that
/// leads back.
type Link = Option<(usize, usize)>;

fn links(plane: &Plane, saddles: &[Saddle]) -> Vec<[Link; 4]> {
    let buckets = Buckets::new(saddles);
    let nearest: Vec<[Link; 4]> = (0..saddles.len())
        .map(|from| std::array::from_fn(|edge| nearest_along(saddles, &buckets, from, edge)))
        .collect();
    // Two checks remove wrong neighbors: both ends must agree, and the image must show an edge
    // between them. Texture next to a board rarely passes both.
    let mut links = vec![[None; 4]; saddles.len()];
    for (from, edges) in links.iter_mut().enumerate() {
        for (edge, link) in edges.iter_mut().enumerate() {
            *link = nearest[from][edge].filter(|&link| {
                let (to, back) = link;
                nearest[to][back] == Some((from, edge))
                    && is_edge(plane, &saddles[from], edge, &saddles[to])
            });
        }
    }
    // Because of rounding, the check of the image is not exactly symmetric, so links are compared
    // once more.
    let checked = links.clone();
    for (from, edges) in links.iter_mut().enumerate() {
        for (edge, link) in edges.iter_mut().enumerate() {
            *link = link.filter(|&(to, back)| checked[to][back] == Some((from, edge)));
        }
    }
    drop_odd_lengths(saddles, &mut links);
    links
}

/// The nearest saddle along an edge that itself has an edge back to this saddle, with black and
/// white on the same sides.
fn nearest_along(saddles: &[Saddle], buckets: &Buckets, from: usize, edge: usize) -> Link {
    let origin = &saddles[from];
    buckets.nearest(saddles, origin.pixel, |to| {
        if to == from {
            None
        } else {
            edge_back(origin, edge, &saddles[to])
        }
    })
}

/// The edge of a saddle that leads back to `origin`, if the saddle lies along an edge of `origin`.
fn edge_back(origin: &Saddle, edge: usize, saddle: &Saddle) -> Option<usize> {
    let dx = saddle.pixel[0] - origin.pixel[0];
    let dy = saddle.pixel[1] - origin.pixel[1];
    let toward_rad = dy.atan2(dx);
    if angle_between(toward_rad, origin.edges_rad[edge]).abs() > MAX_ANGLE_RAD {
        return None;
    }
    let back_rad = |back: usize| angle_between(toward_rad + PI, saddle.edges_rad[back]).abs();
    // If an edge has black after it, in ascending angles, it has black before it when seen from its
    // other end. Only two of the four edges are therefore possible.
    let back = [1 - edge % 2, 3 - edge % 2]
        .into_iter()
        .min_by(|&a, &b| back_rad(a).total_cmp(&back_rad(b)))?;
    (back_rad(back) <= MAX_ANGLE_RAD).then_some(back)
}

/// Whether the image is black on one side of the line between two saddles and white on the other.
fn is_edge(plane: &Plane, from: &Saddle, edge: usize, to: &Saddle) -> bool {
    // Puzzleboards have a dot in the middle third of every edge, so only the outer thirds are
    // examined.
    const ALONG: [f64; 4] = [0.2, 0.3, 0.7, 0.8];
    // Distance of the samples from the line, relative to its length. It must exceed the deviation
    // of a bent line, and stay inside the square.
    const ACROSS: f64 = 0.12;
    // Blur reduces the contrast of small squares near their edges, so a part of the contrast is
    // enough.
    const MIN_CONTRAST_FRAC: f32 = 0.25;
    let dx = to.pixel[0] - from.pixel[0];
    let dy = to.pixel[1] - from.pixel[1];
    // Below one pixel, interpolation would mix both sides.
    let across_px = (ACROSS * dx.hypot(dy)).max(1.0) / dx.hypot(dy);
    // Black is at ascending angles of even edges.
    let black_sign = if edge.is_multiple_of(2) { 1.0 } else { -1.0 };
    let contrast = from.contrast.min(to.contrast) * MIN_CONTRAST_FRAC;
    ALONG.into_iter().all(|along| {
        let center = [from.pixel[0] + along * dx, from.pixel[1] + along * dy];
        let white = plane.sample(beside(center, -black_sign, across_px, [dx, dy]));
        let black = plane.sample(beside(center, black_sign, across_px, [dx, dy]));
        white - black > contrast
    })
}

/// The position next to a point of a line with direction `[dx, dy]`. If `sign` is positive, the
/// position is on the side of ascending angles.
fn beside(point: [f64; 2], sign: f64, across_px: f64, [dx, dy]: [f64; 2]) -> [f64; 2] {
    [
        point[0] - sign * across_px * dy,
        point[1] + sign * across_px * dx,
    ]
}

/// Removes links that are much longer than the other links of a saddle, because they skip a missing
/// corner or leave the board.
fn drop_odd_lengths(saddles: &[Saddle], links: &mut [[Link; 4]]) {
    // The shortest lengths are computed before any link is removed, so that the result does not
    // depend on the order of the saddles.
    let shortest: Vec<f64> = links
        .iter()
        .enumerate()
        .map(|(from, edges)| shortest_link_px(saddles, from, edges))
        .collect();
    for (from, edges) in links.iter_mut().enumerate() {
        for link in edges {
            let is_odd = |(to, _): (usize, usize)| {
                let length = distance(saddles[from].pixel, saddles[to].pixel);
                length > MAX_RATIO * shortest[from].min(shortest[to])
            };
            *link = link.filter(|&link| !is_odd(link));
        }
    }
}

/// Length of the shortest link of a saddle, pixels. It is infinite if the saddle has no link.
fn shortest_link_px(saddles: &[Saddle], from: usize, edges: &[Link; 4]) -> f64 {
    edges
        .iter()
        .flatten()
        .map(|&(to, _)| distance(saddles[from].pixel, saddles[to].pixel))
        .min_by(f64::total_cmp)
        .unwrap_or(f64::INFINITY)
}

/// Assigns columns and rows, starting at a saddle, which gets the cell (0, 0). Its edge 0 leads to
/// column 1. The sector between its edges 2 and 3 is therefore at the upper left, and this sector
/// is black.
fn walk(saddles: &[Saddle], links: &[[Link; 4]], seed: usize, is_used: &mut [bool]) -> Lattice {
    let mut lattice = Lattice::default();
    // Each entry is a saddle, its cell, and the direction of its edge 0 as an index in `STEPS`.
    let mut queue = VecDeque::from([(seed, [0, 0], 0_usize)]);
    is_used[seed] = true;
    lattice.corners.insert([0, 0], saddles[seed].pixel);
    // The search is breadth first, because cells near the seed are certain. If a wrong link leads
    // to a cell that is already taken, the earlier assignment is kept, because it needed fewer
    // links.
    while let Some((from, cell, first_step)) = queue.pop_front() {
        for (edge, link) in links[from].iter().enumerate() {
            let Some((to, back)) = *link else { continue };
            let step = (edge + first_step) % 4;
            let neighbor: Cell = [cell[0] + STEPS[step][0], cell[1] + STEPS[step][1]];
            if is_used[to] || lattice.corners.contains_key(&neighbor) {
                continue;
            }
            is_used[to] = true;
            lattice.corners.insert(neighbor, saddles[to].pixel);
            // Edge `back` of the neighbor points in the direction opposite to `step`, which is
            // `step + 2`. Edge 0 of the neighbor is `back` quarter turns before this opposite
            // direction. Adding 4 keeps the difference positive.
            queue.push_back((to, neighbor, (step + 2 + 4 - back) % 4));
        }
    }
    lattice
}

/// Saddles sorted into square buckets, for searches in growing rings.
struct Buckets {
    side_px: f64,
    counts: [usize; 2],
    buckets: Vec<Vec<usize>>,
}

impl Buckets {
    fn new(saddles: &[Saddle]) -> Self {
        // The buckets are about as large as a square in a common image, so that the nearest
        // neighbor is found in the first rings.
        const SIDE_PX: f64 = 24.0;
        let bucket = |pixel: [f64; 2]| pixel.map(|value| index(value, SIDE_PX));
        let mut counts = [1, 1];
        for saddle in saddles {
            let [column, row] = bucket(saddle.pixel);
            counts = [counts[0].max(column + 1), counts[1].max(row + 1)];
        }
        let mut buckets = vec![Vec::new(); counts[0] * counts[1]];
        for (ix, saddle) in saddles.iter().enumerate() {
            let [column, row] = bucket(saddle.pixel);
            buckets[row * counts[0] + column].push(ix);
        }
        Self {
            side_px: SIDE_PX,
            counts,
            buckets,
        }
    }

    /// The nearest saddle for which `accept` returns a value, with this value.
    fn nearest<T>(
        &self,
        saddles: &[Saddle],
        pixel: [f64; 2],
        accept: impl Fn(usize) -> Option<T>,
    ) -> Option<(usize, T)> {
        // The search covers squares of up to about 260 pixels. Larger squares are found at a lower
        // resolution.
        const MAX_RINGS: usize = 12;
        let center = pixel.map(|value| index(value, self.side_px));
        let mut best: Option<(f64, usize, T)> = None;
        for ring in 0..=MAX_RINGS.min(self.counts[0].max(self.counts[1])) {
            // Everything outside the rings searched so far is farther away than this distance.
            let searched_px = (ring as f64 - 1.0) * self.side_px;
            if best.as_ref().is_some_and(|best| best.0 < searched_px) {
                break;
            }
            let range = |axis: usize| {
                center[axis].saturating_sub(ring)..=(center[axis] + ring).min(self.counts[axis] - 1)
            };
            for row in range(1) {
                for column in range(0) {
                    // Buckets inside the ring were searched before.
                    if row.abs_diff(center[1]).max(column.abs_diff(center[0])) != ring {
                        continue;
                    }
                    for &ix in &self.buckets[row * self.counts[0] + column] {
                        let away = distance(saddles[ix].pixel, pixel);
                        if best.as_ref().is_some_and(|best| best.0 <= away) {
                            continue;
                        }
                        if let Some(value) = accept(ix) {
                            best = Some((away, ix, value));
                        }
                    }
                }
            }
        }
        best.map(|(_, ix, value)| (ix, value))
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "positions are within the image"
)]
fn index(value: f64, side_px: f64) -> usize {
    (value.max(0.0) / side_px) as usize
}
