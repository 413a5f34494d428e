//! The triangles of one block.

use super::cases::{CASES, Edge};
use crate::gpu::{f32_of, f32s_of};
use crate::tsdf::block::{BLOCK_EDGE, Block, Blocks, Place, voxel_ix};
use nalgebra::Vector3;

/// Color where none was seen.
const GREY: f64 = 0.5;

/// Where a vertex lies: between this voxel and the next one along the axis.
pub(super) type Key = (Place, usize);

/// The triangles of the cubes whose lowest corner lies in one block; positions from the field's anchor, metres.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct BlockMesh {
    pub(super) keys: Vec<Key>,
    pub(super) positions_m: Vec<[f32; 3]>,
    pub(super) normals: Vec<[f32; 3]>,
    pub(super) colors_srgb: Vec<[u8; 3]>,
    pub(super) triangles: Vec<[u32; 3]>,
}

/// A block with those around it.
struct Surrounded<'a> {
    place: Place,
    blocks: [Option<&'a Block>; 27],
}

impl<'a> Surrounded<'a> {
    fn new(blocks: &'a Blocks, place: Place) -> Self {
        let offset = |ix: i32| [ix % 3 - 1, ix / 3 % 3 - 1, ix / 9 - 1];
        let mut found = [None; 27];
        for (ix, found) in (0..).zip(&mut found) {
            let [x, y, z] = offset(ix);
            *found = blocks.get(&[place[0] + x, place[1] + y, place[2] + z]);
        }
        Self { place, blocks: found }
    }

    /// The block of a voxel given from this block's first one, -8 to 15, and its place in it.
    fn at(&self, voxel: Place) -> Option<(&'a Block, usize)> {
        let [x, y, z] = voxel.map(|along| along.div_euclid(BLOCK_EDGE) + 1);
        let block = self.blocks[usize::try_from(9 * z + 3 * y + x).ok()?]?;
        Some((block, voxel_ix(voxel)))
    }

    fn distance(&self, voxel: Place) -> Option<f64> {
        self.at(voxel).and_then(|(block, ix)| block.distance(ix))
    }

    /// Change of the distance along the axes, from both sides where both were seen.
    fn slope(&self, voxel: Place) -> Vector3<f64> {
        let here = self.distance(voxel);
        Vector3::from_fn(|axis, _| {
            let beside = |step: i32| {
                let mut other = voxel;
                other[axis] += step;
                self.distance(other)
            };
            match (beside(-1), here, beside(1)) {
                (Some(low), _, Some(high)) => 0.5 * (high - low),
                (Some(low), Some(here), None) => here - low,
                (None, Some(here), Some(high)) => high - here,
                _ => 0.0,
            }
        })
    }

    fn color(&self, voxel: Place) -> Option<[f64; 3]> {
        self.at(voxel).and_then(|(block, ix)| block.color_srgb(ix))
    }
}

fn moved(voxel: Place, corner: usize) -> Place {
    std::array::from_fn(|axis| voxel[axis] + i32::from(corner >> axis & 1 == 1))
}

/// Places of a block's vertices by the voxel they begin at, 9 along each axis, and their axis; `u32::MAX`: none yet.
struct Found(Vec<u32>);

impl Found {
    fn slot(&mut self, voxel: Place, axis: usize) -> &mut u32 {
        let [x, y, z] = voxel.map(|along| usize::try_from(along).expect("cubes begin in the block"));
        &mut self.0[((z * 9 + y) * 9 + x) * 3 + axis]
    }
}

/// Makes the triangles of a block; cubes with a corner that nobody saw have none.
pub(super) fn march(blocks: &Blocks, place: Place, voxel_m: f64) -> BlockMesh {
    let around = Surrounded::new(blocks, place);
    let mut mesh = BlockMesh::default();
    let Some(corners) = Corners::of(&around) else { return mesh };
    let mut found = Found(vec![u32::MAX; 9 * 9 * 9 * 3]);
    for z in 0..BLOCK_EDGE {
        for y in 0..BLOCK_EDGE {
            for x in 0..BLOCK_EDGE {
                let Some(case) = corners.case_of([x, y, z]) else { continue };
                for triangle in &CASES[case] {
                    let corners = triangle.map(|edge| vertex(&mut mesh, &mut found, &around, [x, y, z], edge, voxel_m));
                    mesh.triangles.push(corners);
                }
            }
        }
    }
    mesh
}

/// Whether the corners of a block's cubes lie inside, 9 along each axis, x fastest; `None`: not seen.
struct Corners(Vec<Option<bool>>);

impl Corners {
    /// `None` where no surface passes between them.
    fn of(around: &Surrounded<'_>) -> Option<Self> {
        let places = (0..9 * 9 * 9).map(|ix| [ix % 9, ix / 9 % 9, ix / 81]);
        let is_inside: Vec<_> = places.map(|voxel| Some(around.distance(voxel)? < 0.0)).collect();
        (is_inside.contains(&Some(true)) && is_inside.contains(&Some(false))).then_some(Self(is_inside))
    }

    /// Which corners of the cube that begins at `voxel` lie inside; `None` where one was not seen.
    fn case_of(&self, voxel: Place) -> Option<usize> {
        let [x, y, z] = voxel.map(|along| usize::try_from(along).expect("cubes begin in the block"));
        let first = 81 * z + 9 * y + x;
        (0..8).try_fold(0, |case, corner| {
            let is_inside = self.0[first + (corner & 1) + 9 * (corner >> 1 & 1) + 81 * (corner >> 2)]?;
            Some(case | usize::from(is_inside) << corner)
        })
    }
}

/// The vertex on an edge of the cube that begins at `voxel`, made at its first use.
fn vertex(
    mesh: &mut BlockMesh,
    found: &mut Found,
    around: &Surrounded<'_>,
    voxel: Place,
    edge: Edge,
    voxel_m: f64,
) -> u32 {
    let from = moved(voxel, edge.corner);
    let slot = found.slot(from, edge.axis);
    if *slot != u32::MAX {
        return *slot;
    }
    *slot = u32::try_from(mesh.keys.len()).expect("a block has few vertices");
    let to = moved(from, 1 << edge.axis);
    let [here, there] = [from, to].map(|voxel| around.distance(voxel).unwrap_or(0.0));
    let share = here / (here - there);
    let global: Place = std::array::from_fn(|axis| around.place[axis] * BLOCK_EDGE + from[axis]);
    let position = std::array::from_fn(|axis| {
        (f64::from(global[axis]) + 0.5 + if axis == edge.axis { share } else { 0.0 }) * voxel_m
    });
    let normal = around.slope(from).lerp(&around.slope(to), share);
    let normal = normal.try_normalize(1e-12).unwrap_or_else(|| {
        let mut along = Vector3::zeros();
        along[edge.axis] = (there - here).signum();
        along
    });
    mesh.keys.push((global, edge.axis));
    mesh.positions_m.push(f32s_of(position));
    mesh.normals.push(f32s_of::<3>(normal.into()));
    mesh.colors_srgb.push(color(around.color(from), around.color(to), share));
    *found.slot(from, edge.axis)
}

fn color(from: Option<[f64; 3]>, to: Option<[f64; 3]>, share: f64) -> [u8; 3] {
    let mixed = match (from, to) {
        (Some(from), Some(to)) => std::array::from_fn(|part| from[part] + (to[part] - from[part]) * share),
        (Some(only), None) | (None, Some(only)) => only,
        (None, None) => [GREY; 3],
    };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to 0 to 255")]
    mixed.map(|part| (f32_of(part).clamp(0.0, 1.0) * 255.0).round() as u8)
}
