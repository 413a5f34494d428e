//! Aligns the corners of a lattice with the printed board.

use crate::gray::Plane;
use crate::lattice::{Cell, Lattice};
use crate::surface::Surface;
use crate::template::{self, Neighborhood};
use std::collections::BTreeMap;

/// The board that a lattice is on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Printed<'a> {
    pub(crate) surface: Surface<'a>,
    pub(crate) square_m: f64,
    /// Position of the corner of cell (0, 0) in the board frame, meters.
    pub(crate) first_m: [f64; 2],
    /// See [`Neighborhood::side_m`].
    pub(crate) side_m: f64,
}

impl Printed<'_> {
    /// Aligns all corners. If the alignment of a corner fails, its position stays unchanged.
    pub(crate) fn align(&self, plane: &Plane, lattice: &mut Lattice) {
        let aligned = self.aligned(plane, lattice);
        lattice
            .corners
            .iter_mut()
            .for_each(|(cell, pixel)| *pixel = aligned[cell].unwrap_or(*pixel));
    }

    /// Aligns all corners. Corners where this fails are removed.
    pub(crate) fn align_strictly(&self, plane: &Plane, lattice: &mut Lattice) {
        let aligned = self.aligned(plane, lattice);
        lattice.corners = aligned
            .into_iter()
            .filter_map(|(cell, pixel)| Some((cell, pixel?)))
            .collect();
    }

    /// Positions of all corners after alignment. `None` for corners whose alignment fails.
    fn aligned(&self, plane: &Plane, lattice: &Lattice) -> BTreeMap<Cell, Option<[f64; 2]>> {
        // Every corner is predicted from the lattice before alignment, so that the result does not
        // depend on the order of the corners.
        lattice
            .corners
            .iter()
            .map(|(&cell, &pixel)| (cell, self.aligned_corner(plane, lattice, cell, pixel)))
            .collect()
    }

    /// Position of one corner after alignment.
    fn aligned_corner(
        &self,
        plane: &Plane,
        lattice: &Lattice,
        cell: Cell,
        pixel: [f64; 2],
    ) -> Option<[f64; 2]> {
        // Scale, shear and bend are computed only from the neighbors, so that any lens is
        // supported.
        let neighborhood = Neighborhood {
            point_m: self.point_m(cell),
            pixel,
            pixel_by_point: lattice.pixel_by_point(cell, pixel, self.square_m)?,
            bend: lattice.bend(cell, pixel, self.square_m),
            side_m: self.side_m,
            reach_px: None,
        };
        template::find(plane, &self.surface, &neighborhood)
    }

    /// Position of a corner in the board frame, meters.
    pub(crate) fn point_m(&self, cell: Cell) -> [f64; 2] {
        [0, 1].map(|axis| self.first_m[axis] + f64::from(cell[axis]) * self.square_m)
    }
}
