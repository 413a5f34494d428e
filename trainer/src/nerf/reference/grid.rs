//! The hash grid, which has levels of cubic cells whose corners hold two numbers each.

/// Features per corner of a level.
pub const N_FEATURES: usize = 2;

/// Sizes of a grid.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GridShape {
    /// Cells along an axis, from the coarsest level to the finest.
    pub n_cells: Vec<u32>,
    /// Maximum number of entries of a level, as log2. A level with fewer corners has one entry per
    /// corner. In larger levels, corners share entries by a hash.
    pub log2_entries: u32,
}

impl GridShape {
    /// A grid whose numbers of cells per level are between two values, evenly spaced on a
    /// logarithmic scale.
    pub fn between(coarsest: u32, finest: u32, n_levels: u32, log2_entries: u32) -> Self {
        let growth =
            (f64::from(finest) / f64::from(coarsest)).ln() / f64::from(n_levels.max(2) - 1);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "rounded between two u32"
        )]
        let n_cells =
            |level: u32| (f64::from(coarsest) * (growth * f64::from(level)).exp()).round() as u32;
        Self {
            n_cells: (0..n_levels).map(n_cells).collect(),
            log2_entries,
        }
    }

    /// Number of entries of a level.
    pub fn n_entries(&self, level: usize) -> u32 {
        let max_entries = 1u64 << self.log2_entries;
        let n_corners = (u64::from(self.n_cells[level]) + 1).pow(3);
        u32::try_from(n_corners.min(max_entries)).expect("at most 2^log2_entries, which is a u32")
    }

    /// Index of the first entry of a level.
    pub fn begin(&self, level: usize) -> u32 {
        (0..level).map(|level| self.n_entries(level)).sum()
    }

    /// Number of entries of all levels.
    pub fn n_entries_total(&self) -> u32 {
        self.begin(self.n_cells.len())
    }

    /// Number of features that a lookup returns.
    pub fn n_outputs(&self) -> usize {
        self.n_cells.len() * N_FEATURES
    }

    /// Index of a corner's entry among all entries. Source of the hash: Mueller et al. 2022,
    /// equation 4.
    pub fn entry(&self, level: usize, corner: [u32; 3]) -> u32 {
        let side = self.n_cells[level] + 1;
        let [x, y, z] = corner;
        // The primes of Mueller et al. 2022, equation 4. The first factor is 1.
        let is_dense = u64::from(side).pow(3) <= 1u64 << self.log2_entries;
        let offset = if is_dense {
            x + side * (y + side * z)
        } else {
            (x ^ y.wrapping_mul(2_654_435_761) ^ z.wrapping_mul(805_459_861))
                & ((1 << self.log2_entries) - 1)
        };
        self.begin(level) + offset
    }
}

/// A corner of the cell around a point.
#[derive(Clone, Copy, Debug)]
struct Corner {
    entry: usize,
    weight: f64,
    /// Gradient of the weight with respect to the point, in units of the cube.
    weight_gradient: [f64; 3],
}

/// Linear interpolation weight along an axis of the lower corner (step 0) or the upper corner (step
/// 1).
fn part_of(share: f64, step: u32) -> f64 {
    if step == 1 { share } else { 1.0 - share }
}

/// Corners of the cell of a level around a point of the unit cube. Points outside are clamped to
/// the cube.
fn corners(shape: &GridShape, level: usize, at: [f64; 3]) -> [Corner; 8] {
    let n_cells = f64::from(shape.n_cells[level]);
    let scaled = at.map(|x| x.clamp(0.0, 1.0) * n_cells);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 0 and the number of cells"
    )]
    let first = scaled.map(|x| x.floor().min(n_cells - 1.0) as u32);
    let share: [f64; 3] = std::array::from_fn(|axis| scaled[axis] - f64::from(first[axis]));
    std::array::from_fn(|ix| {
        let step: [u32; 3] =
            std::array::from_fn(|axis| u32::try_from(ix >> axis & 1).expect("0 or 1"));
        let part = |axis: usize| part_of(share[axis], step[axis]);
        // This is the derivative of a product of three linear factors. It is zero outside the cube,
        // where points are clamped.
        let weight_gradient = std::array::from_fn(|axis| {
            let sign = if step[axis] == 1 { n_cells } else { -n_cells };
            let inside = at[axis] >= 0.0 && at[axis] <= 1.0;
            if inside {
                sign * part((axis + 1) % 3) * part((axis + 2) % 3)
            } else {
                0.0
            }
        });
        let corner = std::array::from_fn(|axis| first[axis] + step[axis]);
        Corner {
            entry: shape.entry(level, corner) as usize,
            weight: part(0) * part(1) * part(2),
            weight_gradient,
        }
    })
}

/// Interpolates the features at a point of the unit cube. There are two per level, from the eight
/// corners of the cell.
pub fn interpolate(shape: &GridShape, table: &[[f64; N_FEATURES]], at: [f64; 3]) -> Vec<f64> {
    let mut features = Vec::with_capacity(shape.n_outputs());
    for level in 0..shape.n_cells.len() {
        let corners = corners(shape, level, at);
        features.extend((0..N_FEATURES).map(|feature| -> f64 {
            corners
                .iter()
                .map(|corner| corner.weight * table[corner.entry][feature])
                .sum()
        }));
    }
    features
}

/// Backpropagates gradients of the features. Adds the entry gradients to `v_table`. Returns the
/// gradient of the point.
pub fn interpolate_backward(
    shape: &GridShape,
    table: &[[f64; N_FEATURES]],
    at: [f64; 3],
    upstream: &[f64],
    v_table: &mut [[f64; N_FEATURES]],
) -> [f64; 3] {
    let mut v_at = [0.0; 3];
    for level in 0..shape.n_cells.len() {
        for corner in corners(shape, level, at) {
            for feature in 0..N_FEATURES {
                let v = upstream[level * N_FEATURES + feature];
                v_table[corner.entry][feature] += corner.weight * v;
                for (sum, weight_gradient) in v_at.iter_mut().zip(corner.weight_gradient) {
                    *sum += weight_gradient * table[corner.entry][feature] * v;
                }
            }
        }
    }
    v_at
}
