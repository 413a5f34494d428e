//! The triangles of a surface that crosses a cube, for each of the 256 combinations of inside and
//! outside corners.
//!
//! The method is marching cubes (Lorensen and Cline 1987), but the table is computed. On each face,
//! one segment separates each run of inside corners from the rest. Two cubes therefore agree on a
//! shared face, and segments join into loops.

use std::sync::LazyLock;

/// An edge of a cube, given by the corner where it begins, as bits x, y, z, and by its axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::tsdf) struct Edge {
    pub(in crate::tsdf) corner: usize,
    pub(in crate::tsdf) axis: usize,
}

/// Triangles of each case, as edges. Bit c of the number of a case is set if corner c is inside.
pub(in crate::tsdf) static CASES: LazyLock<[Vec<[Edge; 3]>; 256]> =
    LazyLock::new(|| std::array::from_fn(triangles));

/// Corners of the six faces, counterclockwise when viewed from outside.
const FACES: [[usize; 4]; 6] = [
    [0, 4, 6, 2],
    [1, 3, 7, 5],
    [0, 1, 5, 4],
    [2, 6, 7, 3],
    [0, 2, 3, 1],
    [4, 5, 7, 6],
];

fn edge_between(a: usize, b: usize) -> Edge {
    Edge {
        corner: a & b,
        axis: (a ^ b).trailing_zeros() as usize,
    }
}

fn triangles(case: usize) -> Vec<[Edge; 3]> {
    let mut segments = segments(case);
    let mut triangles = Vec::new();
    // Every edge that the surface cuts belongs to two faces, so the segments form closed loops. A
    // case may have several loops.
    while let Some((first, mut end)) = segments.pop() {
        let mut corners = vec![first];
        while end != first {
            corners.push(end);
            let next = segments
                .iter()
                .position(|(begin, _)| *begin == end)
                .expect("each edge ends one segment and begins one");
            end = segments.swap_remove(next).1;
        }
        // The loop is divided into a fan of triangles from its first corner. The kernel has room
        // for five triangles per case.
        triangles
            .extend((1..corners.len() - 1).map(|ix| [corners[0], corners[ix], corners[ix + 1]]));
    }
    triangles
}

/// Segments where the surface crosses the faces. The inside is on the right of each segment when
/// viewed from outside the cube.
fn segments(case: usize) -> Vec<(Edge, Edge)> {
    let is_inside = |corner: usize| case >> corner & 1 == 1;
    let mut segments = Vec::new();
    for face in FACES {
        for at in 0..4 {
            // A run of inside corners begins where the corner before it is outside.
            let before = face[at];
            let current = face[(at + 1) % 4];
            if is_inside(before) || !is_inside(current) {
                continue;
            }
            let mut along = at + 1;
            while is_inside(face[(along + 1) % 4]) {
                along += 1;
            }
            segments.push((
                edge_between(before, current),
                edge_between(face[along % 4], face[(along + 1) % 4]),
            ));
        }
    }
    segments
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cases_use_exactly_the_crossed_edges() {
        for (case, triangles) in CASES.iter().enumerate() {
            for corner in 0..8usize {
                for axis in (0..3).filter(|axis| corner >> axis & 1 == 0) {
                    let crossed = (case >> corner ^ case >> (corner | 1 << axis)) & 1 == 1;
                    let used = triangles
                        .iter()
                        .flatten()
                        .any(|edge| *edge == Edge { corner, axis });
                    assert_eq!(used, crossed, "case {case}, corner {corner}, axis {axis}");
                }
            }
        }
        let max_triangles = CASES.iter().map(Vec::len).max().unwrap();
        assert!(max_triangles <= 5, "{max_triangles} triangles");
    }

    #[test]
    fn triangles_face_away_from_the_inside() {
        // Only corner 0 is inside, so the normal points toward increasing coordinates.
        let edge_center = |edge: Edge| -> [f64; 3] {
            std::array::from_fn(|axis| {
                if axis == edge.axis {
                    0.5
                } else {
                    (edge.corner >> axis & 1) as f64
                }
            })
        };
        let [a, b, c] = CASES[1][0].map(|edge| nalgebra::Vector3::from(edge_center(edge)));
        assert!((b - a).cross(&(c - a)).dot(&nalgebra::Vector3::repeat(1.0)) > 0.0);
    }

    #[test]
    fn loops_are_closed_within_the_cube() {
        // An edge of a triangle that is not on a face of the cube belongs to two triangles.
        for triangles in CASES.iter() {
            for triangle in triangles {
                for side in 0..3 {
                    let from = triangle[side];
                    let to = triangle[(side + 1) % 3];
                    let back = triangles
                        .iter()
                        .any(|other| (0..3).any(|k| (other[k], other[(k + 1) % 3]) == (to, from)));
                    assert!(back || on_one_face(from, to), "{from:?} {to:?}");
                }
            }
        }
    }

    fn on_one_face(a: Edge, b: Edge) -> bool {
        FACES.iter().any(|face| {
            [a, b].iter().all(|edge| {
                face.contains(&edge.corner) && face.contains(&(edge.corner | 1 << edge.axis))
            })
        })
    }
}
