//! Mesh simplification. Vertices in the same cell of a coarse grid are merged.

use super::Mesh;
use nalgebra::Vector3;
use std::collections::{BTreeSet, HashMap};

/// Sums over the vertices of a cell.
#[derive(Default)]
struct CellSum {
    n: f64,
    position_m: Vector3<f64>,
    normal: Vector3<f64>,
    color: Vector3<f64>,
}

impl Mesh {
    /// Returns the mesh with one vertex per cell of a grid of this width, at the mean of the merged
    /// vertices. Triangles that become degenerate are removed. A width that is not a positive
    /// number leaves the mesh unchanged.
    ///
    /// Source: Rossignac and Borrel 1993, with means instead of representatives.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        reason = "cells are rounded down on purpose, and sums are f64"
    )]
    pub fn clustered(&self, cell_m: f64) -> Self {
        if !(cell_m > 0.0 && cell_m.is_finite()) {
            return self.clone();
        }
        let mut cells: HashMap<[i64; 3], u32> = HashMap::new();
        let mut sums: Vec<CellSum> = Vec::new();
        let mut cell_of_vertex = Vec::with_capacity(self.positions_m.len());
        for (ix, position) in self.positions_m.iter().enumerate() {
            let cell = position.map(|along| (f64::from(along) / cell_m).floor() as i64);
            // Cells are numbered in the order of their first vertices, so the result does not
            // depend on the order of the hash table.
            let next = u32::try_from(sums.len()).unwrap_or(u32::MAX);
            let at = *cells.entry(cell).or_insert(next);
            if at == next {
                sums.push(CellSum::default());
            }
            let sum = &mut sums[at as usize];
            sum.n += 1.0;
            sum.position_m += Vector3::from(position.map(f64::from));
            sum.normal += Vector3::from(self.normals[ix].map(f64::from));
            sum.color += Vector3::from(self.colors_srgb[ix].map(f64::from));
            cell_of_vertex.push(at);
        }
        Self {
            origin_m: self.origin_m,
            positions_m: sums
                .iter()
                .map(|sum| (sum.position_m / sum.n).map(|along| along as f32).into())
                .collect(),
            normals: sums.iter().map(normal_of).collect(),
            #[expect(clippy::cast_sign_loss, reason = "a mean of bytes")]
            colors_srgb: sums
                .iter()
                .map(|sum| (sum.color / sum.n).map(|part| part.round() as u8).into())
                .collect(),
            triangles: merged(&self.triangles, &cell_of_vertex),
        }
    }
}

#[expect(clippy::cast_possible_truncation, reason = "sums are f64, normals f32")]
fn normal_of(sum: &CellSum) -> [f32; 3] {
    // The normals of a thin sheet cancel out. In this case, any direction is equally good.
    sum.normal
        .try_normalize(1e-9)
        .unwrap_or_else(Vector3::z)
        .map(|along| along as f32)
        .into()
}

/// The remaining triangles, each once, regardless of which corner it starts with.
fn merged(triangles: &[[u32; 3]], cell_of_vertex: &[u32]) -> Vec<[u32; 3]> {
    let mut seen = BTreeSet::new();
    let mut kept = Vec::new();
    for triangle in triangles {
        let [a, b, c] = triangle.map(|ix| cell_of_vertex[ix as usize]);
        // A rotation of the corners does not change the side from which the triangle is visible.
        // The two sides of a sheet are different triangles.
        let smallest = a.min(b).min(c);
        let rotated = if a == smallest {
            [a, b, c]
        } else if b == smallest {
            [b, c, a]
        } else {
            [c, a, b]
        };
        if a != b && b != c && c != a && seen.insert(rotated) {
            kept.push(rotated);
        }
    }
    kept
}
