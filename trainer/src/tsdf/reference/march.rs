//! Twin of `march_cubes`, which extracts the triangles of one block.

use crate::tsdf::block::{BLOCK_EDGE, Block, Blocks, GridCoord, voxel_ix};
use crate::tsdf::mesh::CASES;
use nalgebra::Vector3;
use std::collections::HashMap;

/// Color of voxels without a color.
const GRAY: f64 = 0.5;

/// A vertex of a block's triangles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vertex {
    /// The edge of the vertex. It is given by its first voxel, relative to the block's first voxel,
    /// and by its axis.
    pub between: (GridCoord, usize),
    /// Position relative to the field's anchor, along the world's axes, meters.
    pub position_m: [f64; 3],
    /// Outward normal of length 1.
    pub normal: [f64; 3],
    /// Red, green, blue, 0 to 1.
    pub color_srgb: [f64; 3],
}

/// The triangles of the cubes whose lowest corner is in one block.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BlockTriangles {
    /// Vertices in the order in which triangles first use them.
    pub vertices: Vec<Vertex>,
    /// Vertex indices, counterclockwise when viewed from outside. Triangles are in the order of the
    /// cubes, x fastest.
    pub triangles: Vec<[usize; 3]>,
}

/// A block and its neighbors.
struct BlockNeighborhood<'a> {
    block_coord: GridCoord,
    blocks: [Option<&'a Block>; 27],
}

impl<'a> BlockNeighborhood<'a> {
    fn new(blocks: &'a Blocks, block_coord: GridCoord) -> Self {
        let offset = |ix: i32| [ix % 3 - 1, ix / 3 % 3 - 1, ix / 9 - 1];
        let mut found = [None; 27];
        for (ix, found) in (0..).zip(&mut found) {
            let [x, y, z] = offset(ix);
            *found = blocks.get(&[block_coord[0] + x, block_coord[1] + y, block_coord[2] + z]);
        }
        Self {
            block_coord,
            blocks: found,
        }
    }

    /// The block that contains a voxel, and the voxel's index in that block. `voxel` is relative to
    /// the block of this view, from -8 to 15.
    fn at(&self, voxel: GridCoord) -> Option<(&'a Block, usize)> {
        let [x, y, z] = voxel.map(|along| along.div_euclid(BLOCK_EDGE) + 1);
        let block = self.blocks[usize::try_from(9 * z + 3 * y + x).ok()?]?;
        Some((block, voxel_ix(voxel)))
    }

    fn distance(&self, voxel: GridCoord) -> Option<f64> {
        self.at(voxel).and_then(|(block, ix)| block.distance(ix))
    }

    /// Derivative of the distance along the axes, two-sided if both neighbors were observed.
    fn gradient(&self, voxel: GridCoord) -> Vector3<f64> {
        let here = self.distance(voxel);
        Vector3::from_fn(|axis, _| {
            let low = self.distance(stepped(voxel, axis, -1));
            let high = self.distance(stepped(voxel, axis, 1));
            match (low, here, high) {
                (Some(low), _, Some(high)) => 0.5 * (high - low),
                (Some(low), Some(here), None) => here - low,
                (None, Some(here), Some(high)) => high - here,
                _ => 0.0,
            }
        })
    }

    fn color(&self, voxel: GridCoord) -> Option<[f64; 3]> {
        self.at(voxel).and_then(|(block, ix)| block.color_srgb(ix))
    }

    /// Case of the cube that begins at `voxel`. Bit c is set if corner c is inside. `None` if any
    /// corner was not observed.
    fn case_of(&self, voxel: GridCoord) -> Option<usize> {
        (0..8).try_fold(0, |case, corner| {
            let is_inside = self.distance(moved(voxel, corner))? < 0.0;
            Some(case | usize::from(is_inside) << corner)
        })
    }

    fn vertex(&self, between: (GridCoord, usize), voxel_m: f64) -> Vertex {
        let (from, axis) = between;
        let to = moved(from, 1 << axis);
        let [here, there] = [from, to].map(|voxel| self.distance(voxel).unwrap_or(0.0));
        // The edge is cut, so the distances differ in sign, and the linear interpolation has one
        // zero.
        let share = here / (here - there);
        let position_m = std::array::from_fn(|along| {
            let voxel = f64::from(self.block_coord[along] * BLOCK_EDGE + from[along]);
            (voxel + 0.5 + if along == axis { share } else { 0.0 }) * voxel_m
        });
        let normal = self.gradient(from).lerp(&self.gradient(to), share);
        // The gradients of the two sides of a thin sheet may cancel out. In that case, the normal
        // points along the edge toward its outer end.
        let normal = normal.try_normalize(1e-12).unwrap_or_else(|| {
            let mut along = Vector3::zeros();
            along[axis] = (there - here).signum();
            along
        });
        let color_srgb = mixed(self.color(from), self.color(to), share);
        Vertex {
            between,
            position_m,
            normal: normal.into(),
            color_srgb,
        }
    }
}

/// A voxel, `step` voxels further along an axis.
fn stepped(mut voxel: GridCoord, axis: usize, step: i32) -> GridCoord {
    voxel[axis] += step;
    voxel
}

/// The voxel at a corner of the cube that begins at `voxel`.
fn moved(voxel: GridCoord, corner: usize) -> GridCoord {
    std::array::from_fn(|axis| voxel[axis] + i32::from(corner >> axis & 1 == 1))
}

/// Extracts the triangles of a block. Cubes with an unobserved corner have no triangles.
pub fn march(blocks: &Blocks, block_coord: GridCoord, voxel_m: f64) -> BlockTriangles {
    let around = BlockNeighborhood::new(blocks, block_coord);
    let mut triangles_of_block = BlockTriangles::default();
    let mut known: HashMap<(GridCoord, usize), usize> = HashMap::new();
    for z in 0..BLOCK_EDGE {
        for y in 0..BLOCK_EDGE {
            for x in 0..BLOCK_EDGE {
                let cube = [x, y, z];
                for triangle in around.case_of(cube).map_or(&[][..], |case| &CASES[case]) {
                    triangles_of_block.triangles.push(triangle.map(|edge| {
                        let between = (moved(cube, edge.corner), edge.axis);
                        *known.entry(between).or_insert_with(|| {
                            triangles_of_block
                                .vertices
                                .push(around.vertex(between, voxel_m));
                            triangles_of_block.vertices.len() - 1
                        })
                    }));
                }
            }
        }
    }
    triangles_of_block
}

fn mixed(from: Option<[f64; 3]>, to: Option<[f64; 3]>, share: f64) -> [f64; 3] {
    match (from, to) {
        (Some(from), Some(to)) => {
            std::array::from_fn(|part| from[part] + (to[part] - from[part]) * share)
        }
        (Some(only), None) | (None, Some(only)) => only,
        (None, None) => [GRAY; 3],
    }
}
