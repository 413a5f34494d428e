//! Convex pieces that together cover a shape of a URDF. Each piece is the convex hull of a few
//! points.

use crate::mesh_triangles::Triangle;
use keyframe::masked_robot::{ConvexPiece, DIRECTION_STEP_RAD, directions};
use kinematics::Transform;
use kinematics::shape::{Geometry, Shape};
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;

/// Angle between neighboring points around and along a round surface, radians.
const STEP_RAD: f64 = DIRECTION_STEP_RAD;
/// Number of points around an axis.
const N_AROUND: u32 = 12;
/// Side of the blocks into which a mesh is divided, meters. The hull of a block covers the concave
/// places in it, so that masks of smaller blocks are tighter. They also take more time.
const BLOCK_M: f64 = 0.08;

/// Convex pieces that cover a shape, in the frame of its link.
///
/// * `triangles`: the triangles of the shape if it is a mesh, without the scale in the URDF.
pub(super) fn cover(shape: &Shape, triangles: &[Triangle]) -> Vec<ConvexPiece> {
    let pieces = match &shape.geometry {
        Geometry::Box { size_m } => vec![box_corners(*size_m)],
        Geometry::Cylinder { radius_m, length_m } => vec![prism(*radius_m, *length_m)],
        Geometry::Sphere { radius_m } => vec![around_sphere(*radius_m, 0.0)],
        Geometry::Capsule { radius_m, length_m } => {
            let ends = [-0.5, 0.5].map(|end| around_sphere(*radius_m, end * length_m));
            vec![ends.concat()]
        }
        Geometry::Mesh { scale, .. } => blocks(triangles, *scale),
    };
    pieces
        .into_iter()
        .map(|piece| in_link(piece, &shape.link_from_shape))
        .collect()
}

fn in_link(piece: ConvexPiece, link_from_shape: &Transform) -> ConvexPiece {
    piece
        .into_iter()
        .map(|point| link_from_shape * point)
        .collect()
}

fn box_corners(size_m: [f64; 3]) -> ConvexPiece {
    (0..8)
        .map(|corner| {
            Point3::from(Vector3::from_fn(|axis, _| {
                let is_upper = corner >> axis & 1 == 1;
                if is_upper {
                    0.5 * size_m[axis]
                } else {
                    -0.5 * size_m[axis]
                }
            }))
        })
        .collect()
}

/// A prism around a cylinder along z.
fn prism(radius_m: f64, length_m: f64) -> ConvexPiece {
    // The sides of the prism touch the cylinder, so its edges are outside.
    let edge_m = radius_m / (0.5 * STEP_RAD).cos();
    let around = (0..N_AROUND).map(|ix| (f64::from(ix) * STEP_RAD).sin_cos());
    around
        .flat_map(|(sin, cos)| {
            [-0.5, 0.5].map(|end| Point3::new(edge_m * cos, edge_m * sin, end * length_m))
        })
        .collect()
}

/// A polyhedron around a sphere with its center at a height, meters.
fn around_sphere(radius_m: f64, center_z_m: f64) -> ConvexPiece {
    // A hull of points at a distance R reaches at least R cos(a) in every direction, where `a` is
    // the largest angle from any direction to the nearest point. With rings and points every
    // `STEP_RAD`, this angle is at most half the diagonal of a square with this side.
    let largest_rad = STEP_RAD * std::f64::consts::FRAC_1_SQRT_2;
    let distance_m = radius_m / largest_rad.cos();
    directions()
        .into_iter()
        .map(|direction| Point3::from(direction * distance_m) + Vector3::z() * center_z_m)
        .collect()
}

/// The corners of the triangles in each block of a grid. A triangle belongs to the block of its
/// center, and is inside the hull of its corners. The hulls therefore cover the whole surface.
fn blocks(triangles: &[Triangle], scale: [f64; 3]) -> Vec<ConvexPiece> {
    let scale = Vector3::from(scale);
    let mut by_block: BTreeMap<[i64; 3], ConvexPiece> = BTreeMap::new();
    for triangle in triangles {
        let corners =
            triangle.map(|corner| Point3::from(Vector3::from(corner).component_mul(&scale)));
        let center = (corners[0].coords + corners[1].coords + corners[2].coords) / 3.0;
        if !center.iter().all(|coordinate| coordinate.is_finite()) {
            continue;
        }
        #[expect(
            clippy::cast_possible_truncation,
            reason = "casts of large numbers saturate, which only merges blocks"
        )]
        let block = [0, 1, 2].map(|axis| (center[axis] / BLOCK_M).floor() as i64);
        by_block.entry(block).or_default().extend(corners);
    }
    by_block
        .into_values()
        .map(|piece| thinned(&piece))
        .collect()
}

/// The points that are farthest in some direction. Between the directions, the hull of a round
/// surface shrinks by less than 7 % of its radius, which is a few millimeters for a block.
fn thinned(piece: &[Point3<f64>]) -> ConvexPiece {
    let directions = directions();
    if piece.len() <= directions.len() {
        return piece.to_vec();
    }
    let mut kept: Vec<usize> = directions
        .iter()
        .filter_map(|direction| {
            let along = |ix: &usize| piece[*ix].coords.dot(direction);
            (0..piece.len()).max_by(|one, other| along(one).total_cmp(&along(other)))
        })
        .collect();
    kept.sort_unstable();
    kept.dedup();
    kept.into_iter().map(|ix| piece[ix]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(geometry: Geometry) -> Shape {
        Shape {
            link_from_shape: Transform::translation(1.0, 2.0, 3.0),
            geometry,
            color_srgba: None,
        }
    }

    /// How far the hull of points reaches along a direction.
    fn reach_m(piece: &[Point3<f64>], direction: &Vector3<f64>) -> f64 {
        let center = Vector3::new(1.0, 2.0, 3.0);
        piece
            .iter()
            .map(|point| (point.coords - center).dot(direction))
            .fold(f64::NEG_INFINITY, f64::max)
    }

    /// A direction for each number.
    fn direction(ix: u32) -> Vector3<f64> {
        let angle = f64::from(ix);
        Vector3::new(
            (0.7 * angle).sin(),
            (1.3 * angle).cos(),
            (2.1 * angle).sin(),
        )
        .normalize()
    }

    #[test]
    fn pieces_contain_round_shapes_and_are_at_most_8_percent_larger() {
        let sphere = cover(&shape(Geometry::Sphere { radius_m: 0.1 }), &[]);
        let [radius_m, length_m] = [0.1, 0.4];
        let capsule = cover(&shape(Geometry::Capsule { radius_m, length_m }), &[]);
        let cylinder = cover(&shape(Geometry::Cylinder { radius_m, length_m }), &[]);
        for ix in 0..500 {
            let toward = direction(ix);
            let along_m = 0.5 * length_m * toward.z.abs();
            let across_m = radius_m * toward.xy().norm();
            for (pieces, exact_m) in [
                (&sphere, radius_m),
                (&capsule, along_m + radius_m),
                (&cylinder, along_m + across_m),
            ] {
                let excess = reach_m(&pieces[0], &toward) / exact_m - 1.0;
                assert!((-1e-9..0.08).contains(&excess), "{excess} toward {toward}");
            }
        }
    }

    #[test]
    fn concave_meshes_are_divided() {
        // Two plates at a right angle, of many triangles.
        let plate = |upright: bool| {
            (0..400).map(move |ix| {
                let [u, v] = [ix % 20, ix / 20].map(|step| f64::from(step) * 0.02);
                [[u, v], [u + 0.02, v], [u, v + 0.02]]
                    .map(|[u, v]| if upright { [0.0, v, u] } else { [u, v, 0.0] })
            })
        };
        let triangles: Vec<Triangle> = plate(false).chain(plate(true)).collect();
        let mesh = shape(Geometry::Mesh {
            file: "angle.stl".to_owned(),
            scale: [1.0; 3],
        });
        let pieces = cover(&mesh, &triangles);
        assert!(pieces.len() > 20, "{}", pieces.len());
        let toward = Vector3::new(1.0, 0.0, 1.0).normalize();
        let in_corner_m = pieces
            .iter()
            .filter(|piece| piece.iter().any(|point| point.x < 1.02 && point.z < 3.02))
            .map(|piece| reach_m(piece, &toward))
            .fold(0.0, f64::max);
        assert!(
            in_corner_m < 0.15,
            "the hull of all would reach 0.28 m: {in_corner_m}"
        );
        let highest = pieces.iter().flatten().map(|point| point.z);
        assert!((highest.fold(0.0, f64::max) - 3.4).abs() < 1e-9);
        assert!(cover(&mesh, &[]).is_empty());
    }
}
