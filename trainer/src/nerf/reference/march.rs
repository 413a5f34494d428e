//! How a ray is walked through the parts of the scene that hold something.
//!
//! Source: occupancy of Mueller et al. 2022, appendix C; steps grow outside the inner cube as contraction shrinks them.

use super::space::{contract, largest};

/// How rays are walked; lengths in units of the scene's radius.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct March {
    /// Length of a step inside the inner cube.
    pub step: f64,
    /// Most samples of a ray.
    pub most_samples: usize,
    /// Cells of the occupancy along an axis.
    pub n_cells: usize,
}

/// A piece of a ray in a cell that holds something.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// Where it begins.
    pub begin: f64,
    /// How long it is.
    pub length: f64,
}

impl March {
    /// Length of the step that begins at a point.
    pub fn step_at(&self, at: [f64; 3]) -> f64 {
        self.step * largest(at).1.max(1.0).powi(2)
    }

    /// Number of the cell around a point, and how far the point is from the cell's nearest side, in cells.
    pub fn cell(&self, at: [f64; 3]) -> (usize, f64) {
        let scaled = contract(at).map(|x| x * self.n_cells as f64);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the cube")]
        let cell = scaled.map(|x| (x as usize).min(self.n_cells - 1));
        let margin = scaled.iter().map(|x| (x - x.round()).abs()).fold(1.0, f64::min);
        (cell[0] + self.n_cells * (cell[1] + self.n_cells * cell[2]), margin)
    }

    /// All pieces of a ray between two distances, the first of them `shift` of a step behind `range[0]`; and the least margin
    /// of any cell that was asked about.
    pub fn pieces(
        &self,
        (origin, direction): ([f64; 3], [f64; 3]),
        range: [f64; 2],
        shift: f64,
        is_occupied: impl Fn(usize) -> bool,
    ) -> (Vec<Piece>, f64) {
        let point = |t: f64| std::array::from_fn(|axis| origin[axis] + t * direction[axis]);
        let mut t = range[0] + shift * self.step_at(point(range[0]));
        let (mut found, mut least_margin) = (Vec::new(), 1.0f64);
        while t < range[1] {
            let length = self.step_at(point(t));
            let (cell, margin) = self.cell(point(t + 0.5 * length));
            least_margin = least_margin.min(margin);
            if is_occupied(cell) {
                found.push(Piece { begin: t, length });
            }
            t += length;
        }
        (found, least_margin)
    }

    /// The spans of the samples that are kept of the pieces: no more than `most_samples`, each standing for as many.
    pub fn spans(&self, pieces: &[Piece], shift: f64) -> Vec<[f64; 2]> {
        let stride = pieces.len().div_ceil(self.most_samples).max(1);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share of the stride")]
        let phase = ((shift * stride as f64) as usize).min(stride - 1);
        let span = |piece: &Piece| {
            let (middle, reach) = (piece.begin + 0.5 * piece.length, 0.5 * piece.length * stride as f64);
            [middle - reach, middle + reach]
        };
        pieces.iter().skip(phase).step_by(stride).map(span).collect()
    }
}
