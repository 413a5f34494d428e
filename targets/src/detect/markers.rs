//! Detection of ChArUco boards, AprilGrids and single tags, starting from their markers.

use super::{Detection, MIN_CORNERS, charuco, diagnosis};
use crate::dictionary::Dictionary;
use crate::error::NotDetected;
use crate::gray::Plane;
use crate::homography::Homography;
use crate::lattice::distance;
use crate::layout::{self, Fit, layouts};
use crate::marker::{self, Marker, UNIT_SQUARE};
use crate::quad::{self, Quad, shortest_side};
use crate::spec::{Pattern, TargetSpec};
use crate::template::{self, Neighborhood};

/// Widths of the black border of tags, in cells. Kalibr prints a border of 2 cells, and AprilTag
/// prints a border of 1 cell.
const TAG_BORDERS: [usize; 2] = [1, 2];
/// Largest relative difference between the size of the ChArUco markers in the image and the size on
/// the target. Blur makes small markers look up to 10 % smaller, so a found board needs a clearer
/// contradiction than [`diagnosis::MIN_SIZE_CHANGE`].
const MAX_SIZE_CHANGE: f64 = 0.2;
/// Largest distance of a corner from the intersection of the tag's sides, relative to the length of
/// a side. The distance is not zero, because lenses bend the sides.
const MAX_MOVE_FRAC: f64 = 0.04;

/// Finds a ChArUco board, an AprilGrid or a tag.
pub(super) fn detect(target: &TargetSpec, plane: &Plane) -> Result<Detection, NotDetected> {
    // Only on AprilGrids do other black squares touch the corners of tags.
    let quads = quad::find(plane, matches!(target.pattern, Pattern::Aprilgrid { .. }));
    let (dictionary, borders): (Dictionary, &[usize]) = match target.pattern {
        Pattern::Charuco { dictionary, .. } => (dictionary, &[1]),
        _ => (Dictionary::tag36h11(), &TAG_BORDERS),
    };
    let markers = marker::decode(plane, &quads, &dictionary, borders);
    if let Pattern::Tag { id, side_m } = target.pattern {
        return tag(target, id, side_m, plane, &markers)
            .ok_or_else(|| diagnosis::markers(target, plane, &quads, &dictionary, &markers));
    }
    let fit = layout::fit(layouts(&target.pattern), &markers)
        .ok_or_else(|| diagnosis::markers(target, plane, &quads, &dictionary, &markers))?;
    let pixels = match target.pattern {
        Pattern::Charuco { .. } => charuco::corners(target, plane, &fit),
        Pattern::Aprilgrid { tag_m, .. } => aprilgrid(target, tag_m, plane, &fit),
        _ => Vec::new(),
    };
    if pixels.len() < MIN_CORNERS {
        let too_few = NotDetected::TooFewCorners {
            found: pixels.len(),
            min: MIN_CORNERS,
        };
        let reason = diagnosis::other_counts(target, &markers, fit.n_confirmed)
            .or_else(|| diagnosis::marker_size(target, &markers, diagnosis::MIN_SIZE_CHANGE));
        return Err(reason.unwrap_or(too_few));
    }
    // The corners do not depend on the markers. However, if the size of the markers is wrong, the
    // size of the squares may also be wrong.
    match diagnosis::marker_size(target, &fit.markers, MAX_SIZE_CHANGE) {
        Some(other) => Err(other),
        None => Ok(target.detection(pixels, fit.layout.is_legacy)),
    }
}

/// Corners of the largest tag with an id.
fn tag(
    target: &TargetSpec,
    id: u32,
    side_m: f64,
    plane: &Plane,
    markers: &[Marker],
) -> Option<Detection> {
    let of_id = markers.iter().filter(|marker| marker.id == id);
    let largest = of_id
        .max_by(|a, b| shortest_side(&a.corners_px).total_cmp(&shortest_side(&b.corners_px)))?;
    let corners_m = UNIT_SQUARE.map(|corner| corner.map(|frac| (frac - 0.5) * side_m));
    Some(target.detection(
        corners(target, plane, largest, &corners_m, [0, 1, 2, 3], side_m),
        false,
    ))
}

/// Corners of all tags of an AprilGrid.
fn aprilgrid(target: &TargetSpec, tag_m: f64, plane: &Plane, fit: &Fit) -> Vec<(u32, [f64; 2])> {
    let mut pixels = Vec::new();
    for marker in &fit.markers {
        let ids = [0, 1, 2, 3].map(|corner| 4 * marker.id + corner);
        let corners_m = &fit.layout.corners_m[marker.id as usize];
        pixels.extend(corners(target, plane, marker, corners_m, ids, tag_m));
    }
    pixels
}

/// Refines the corners of a marker. `corners_m` contains their positions on the board, in the order
/// of the marker.
fn corners(
    target: &TargetSpec,
    plane: &Plane,
    marker: &Marker,
    corners_m: &Quad,
    ids: [u32; 4],
    side_m: f64,
) -> Vec<(u32, [f64; 2])> {
    // Up to this fraction of the side from a corner, only the border of the tag and the squares
    // between tags are visible. They are the same for all tags.
    const CLEAR_FRAC: f64 = 0.28;
    let center_m = layout::center(corners_m);
    let centered = corners_m.map(|corner| [corner[0] - center_m[0], corner[1] - center_m[1]]);
    let mut corners_px = marker.corners_px;
    let mut is_found = [false; 4];
    // The lens bends the sides, so the first positions of the corners are displaced. In the second
    // round, scale and rotation are more accurate.
    for reach_frac in [MAX_MOVE_FRAC, MAX_MOVE_FRAC / 4.0] {
        let Some(pixel_from_board) = Homography::from_corners(&centered, &corners_px) else {
            return Vec::new();
        };
        for at in 0..4 {
            let neighborhood = Neighborhood {
                point_m: corners_m[at],
                pixel: corners_px[at],
                pixel_by_point: pixel_from_board.jacobian(centered[at]),
                bend: [[0.0; 2]; 3],
                side_m: CLEAR_FRAC * side_m,
                // The reach is far less than a cell, so that no edge inside the tag is mistaken for
                // the corner. The lower limit leaves room for the error of the outline.
                reach_px: Some((reach_frac * shortest_side(&marker.corners_px)).clamp(1.5, 4.0)),
            };
            let found = template::find(plane, &target.surface(), &neighborhood);
            is_found[at] = found.is_some();
            corners_px[at] = found.unwrap_or(corners_px[at]);
        }
    }
    // Ids are assigned by position, because the order of the corners depends on the rotation of the
    // tags in the layout.
    (0..4)
        .filter(|&at| is_found[at])
        .filter_map(|at| {
            let id = id_at(target, ids, corners_m[at], 1e-6 * side_m)?;
            Some((id, corners_px[at]))
        })
        .collect()
}

/// The id of the target's corner at a position on the board. Only the given `ids` are considered.
fn id_at(target: &TargetSpec, ids: [u32; 4], point_m: [f64; 2], tolerance_m: f64) -> Option<u32> {
    ids.into_iter().find(|&id| {
        target
            .corner(id)
            .is_some_and(|corner| distance([corner.x, corner.y], point_m) < tolerance_m)
    })
}
