//! Convex pieces of the objects of a scene, which MuJoCo can test for contacts.

use crate::mesh::Mesh;
use crate::objects::Object;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;

/// Maximum number of pieces of an object. Finer objects, such as fur, are enclosed as a whole.
const MAX_PIECES: usize = 64;
/// Thickness that flat pieces get behind their surface, meters. It is above the motion of a robot
/// between two checks at the speeds at which operators move it.
const FLAT_THICKNESS_M: f64 = 0.005;
/// Extent below which a piece is flat, meters.
const MAX_FLATNESS_M: f64 = 1e-4;
/// Smallest area that a piece spans, square meters. MuJoCo cannot enclose points on a line.
const MIN_AREA_M2: f64 = 1e-6;

/// Convex pieces that together enclose an object: the points of each, in the frame of the object.
///
/// Smooth parts are replaced by their convex hulls. Flat parts are extended behind their surface.
pub(crate) fn convex_pieces(object: &Object) -> Vec<Vec<[f64; 3]>> {
    let by_normal = pieces(&object.mesh, true);
    let parts = if by_normal.len() <= MAX_PIECES {
        by_normal
    } else {
        // Closed parts, such as the boards of a cabinet.
        pieces(&object.mesh, false)
    };
    let parts = if parts.len() <= MAX_PIECES {
        parts
    } else {
        vec![whole(&object.mesh)]
    };
    parts.iter().filter_map(Piece::solid_points).collect()
}

/// Points of a part, and the mean of their normals.
#[derive(Clone, Debug, Default)]
struct Piece {
    points: Vec<Point3<f64>>,
    normal: Vector3<f64>,
}

impl Piece {
    /// The points, and those behind them if the piece is flat. `None` for a piece without an
    /// extent.
    fn solid_points(&self) -> Option<Vec<[f64; 3]>> {
        let first = self.points.first()?;
        if spanned_area_m2(first, &self.points) < MIN_AREA_M2 {
            return None;
        }
        let mut points = self.points.clone();
        if let Some(normal) = self.normal.try_normalize(1e-9) {
            let depths = self.points.iter().map(|point| normal.dot(&(point - first)));
            let [low, high] = depths.fold([0.0, 0.0], |[low, high]: [f64; 2], depth| {
                [low.min(depth), high.max(depth)]
            });
            if high - low < MAX_FLATNESS_M {
                let behind = normal * FLAT_THICKNESS_M;
                points.extend(self.points.iter().map(|point| point - behind));
            }
        }
        Some(points.into_iter().map(|point| point.into()).collect())
    }
}

/// About the area that points span: zero for points on a line.
fn spanned_area_m2(first: &Point3<f64>, points: &[Point3<f64>]) -> f64 {
    let edges = points.iter().map(|point| point - first);
    let longest = edges
        .clone()
        .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))
        .unwrap_or_default();
    edges.fold(0.0, |area, edge| {
        f64::max(area, edge.cross(&longest).norm())
    })
}

/// Parts of a mesh that share points. If `by_normal`, points with different normals are different,
/// so that a box has six parts.
fn pieces(mesh: &Mesh, by_normal: bool) -> Vec<Piece> {
    /// Points closer than this are the same, in units per meter.
    const GRID_PER_M: f64 = 1e5;
    const NORMAL_GRID: f64 = 1e3;
    let mut ids: BTreeMap<[i64; 6], usize> = BTreeMap::new();
    let mut points = Vec::new();
    let corner_ids: Vec<usize> = mesh
        .corners()
        .map(|(point, normal)| {
            let normal_key = if by_normal { NORMAL_GRID } else { 0.0 };
            #[expect(
                clippy::cast_possible_truncation,
                reason = "scenes are some meters large"
            )]
            let key = [
                point.x * GRID_PER_M,
                point.y * GRID_PER_M,
                point.z * GRID_PER_M,
                normal.x * normal_key,
                normal.y * normal_key,
                normal.z * normal_key,
            ]
            .map(|value| value.round() as i64);
            *ids.entry(key).or_insert_with(|| {
                points.push((point, normal));
                points.len() - 1
            })
        })
        .collect();
    let mut parents: Vec<usize> = (0..points.len()).collect();
    for [a, b, c] in mesh.faces() {
        let [a, b, c] = [a, b, c].map(|corner| root(&mut parents, corner_ids[corner]));
        parents[b] = a;
        let c = root(&mut parents, c);
        parents[c] = a;
    }
    let mut pieces: BTreeMap<usize, Piece> = BTreeMap::new();
    for (ix, (point, normal)) in points.iter().enumerate() {
        let piece = pieces.entry(root(&mut parents, ix)).or_default();
        piece.points.push(*point);
        piece.normal += normal;
    }
    pieces.into_values().collect()
}

/// The whole mesh as one part.
fn whole(mesh: &Mesh) -> Piece {
    let mut piece = Piece::default();
    for (point, normal) in mesh.corners() {
        piece.points.push(point);
        piece.normal += normal;
    }
    piece
}

/// The representative of a point's part, by union-find with path halving.
fn root(parents: &mut [usize], mut ix: usize) -> usize {
    while parents[ix] != ix {
        parents[ix] = parents[parents[ix]];
        ix = parents[ix];
    }
    ix
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::WHOLE;

    #[test]
    fn a_box_has_six_flat_pieces_with_a_thickness() {
        let mesh = Mesh::cuboid([0.1, 0.2, 0.3], &[WHOLE; 6]);
        let pieces = convex_pieces(&Object::in_world("box", "frame", mesh));
        assert_eq!(pieces.len(), 6);
        for points in pieces {
            assert_eq!(points.len(), 8, "four corners, and four behind them");
            let is_inside = |[x, y, z]: &[f64; 3]| {
                x.abs() < 0.1 + 1e-6 && y.abs() < 0.2 + 1e-6 && z.abs() < 0.3 + 1e-6
            };
            assert!(points.iter().all(is_inside), "{points:?}");
        }
    }
}
