//! The rows of a version of the map, without the voxels inside of the robot.

use crate::capsules::GridCapsule;
use crate::grid::Grid;
use crate::snapshot::Snapshot;

/// Rows of voxels per side of a bundle, which is skipped as a whole if all of its voxels are free.
pub(crate) const BUNDLE: usize = 4;

/// The voxels from which distances are measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Obstacles {
    /// All that are not known to be free.
    NotFree,
    /// Those in which a surface was seen.
    Surfaces,
}

/// Rows and bundles of rows, one bit per voxel from which distances are measured. See
/// [`Grid::row`].
#[derive(Debug)]
pub(crate) struct Rows {
    obstacles: Obstacles,
    /// First layer of voxels, and the layer after the last one, outside of which nothing is an
    /// obstacle.
    layers: [usize; 2],
    grid: Grid,
    blocked: Vec<u8>,
    /// For each bundle of rows, the union of its rows.
    bundles: Vec<u8>,
    /// Bytes that the robot has changed, with their values before. Undoing them is faster than a
    /// copy of the map in each cycle of the arm.
    changed: Vec<(usize, u8)>,
    changed_bundles: Vec<(usize, u8)>,
    /// Whether the byte of a bundle is in the list of changed bytes.
    is_bundle_changed: Vec<bool>,
}

impl Rows {
    /// The rows of a version of the map.
    pub(crate) fn new(snapshot: &Snapshot, obstacles: Obstacles) -> Self {
        let mut rows = Self {
            obstacles,
            layers: [0, usize::MAX],
            grid: snapshot.grid,
            blocked: Vec::new(),
            bundles: Vec::new(),
            changed: Vec::new(),
            changed_bundles: Vec::new(),
            is_bundle_changed: Vec::new(),
        };
        rows.set_map(snapshot);
        rows
    }

    /// Takes another version of the map, without a robot.
    pub(crate) fn set_map(&mut self, snapshot: &Snapshot) {
        self.grid = snapshot.grid;
        self.blocked
            .clone_from(match (&snapshot.occupied, self.obstacles) {
                (Some(occupied), Obstacles::Surfaces) => occupied,
                _ => &snapshot.blocked,
            });
        let layer_bytes = self.grid.side() * self.grid.row_bytes();
        let n_bytes = self.blocked.len();
        let [first, end] = self
            .layers
            .map(|layer| layer.saturating_mul(layer_bytes).min(n_bytes));
        self.blocked[..first].fill(0);
        self.blocked[end..].fill(0);
        self.join_rows();
        self.changed.clear();
        self.changed_bundles.clear();
        self.is_bundle_changed.clear();
        self.is_bundle_changed.resize(self.bundles.len(), false);
    }

    /// Lets only some layers of voxels be obstacles, from the next version of the map on. Returns
    /// whether they have changed.
    pub(crate) fn set_layers(&mut self, layers: [usize; 2]) -> bool {
        std::mem::replace(&mut self.layers, layers) != layers
    }

    /// Clears the voxels inside of the robot, instead of those of the robot before.
    pub(crate) fn set_robot(&mut self, robot: &[GridCapsule]) {
        self.undo();
        for capsule in robot {
            capsule.rows(self.grid.side(), |span| {
                let row = self.grid.row(span.y, span.z);
                let bundle = self.bundle_row(span.y / BUNDLE, span.z / BUNDLE);
                for (byte, inside) in span.bytes() {
                    self.clear(row + byte, bundle + byte, inside);
                }
            });
        }
        for ix in 0..self.changed_bundles.len() {
            let (byte, _) = self.changed_bundles[ix];
            self.bundles[byte] = self.joined(byte);
        }
    }

    /// Rows; see [`Grid::row`].
    pub(crate) fn blocked(&self) -> &[u8] {
        &self.blocked
    }

    /// Bundles; see [`Self::bundle_row`].
    pub(crate) fn bundles(&self) -> &[u8] {
        &self.bundles
    }

    /// Index of the first byte of a bundle.
    pub(crate) fn bundle_row(&self, y: usize, z: usize) -> usize {
        (z * self.bundles_per_side() + y) * self.grid.row_bytes()
    }

    fn bundles_per_side(&self) -> usize {
        self.grid.side() / BUNDLE
    }

    fn clear(&mut self, byte: usize, bundle: usize, bits: u8) {
        let before = self.blocked[byte];
        if before & bits == 0 {
            return;
        }
        self.changed.push((byte, before));
        self.blocked[byte] = before & !bits;
        if !self.is_bundle_changed[bundle] {
            self.is_bundle_changed[bundle] = true;
            self.changed_bundles.push((bundle, self.bundles[bundle]));
        }
    }

    fn undo(&mut self) {
        // A byte may have changed several times; the oldest value is restored last.
        while let Some((byte, before)) = self.changed.pop() {
            self.blocked[byte] = before;
        }
        while let Some((byte, before)) = self.changed_bundles.pop() {
            self.bundles[byte] = before;
            self.is_bundle_changed[byte] = false;
        }
    }

    /// The union of the rows of one byte of a bundle.
    fn joined(&self, bundle_byte: usize) -> u8 {
        let row_bytes = self.grid.row_bytes();
        let (bundle, byte) = (bundle_byte / row_bytes, bundle_byte % row_bytes);
        let n = self.bundles_per_side();
        let (y, z) = (bundle % n * BUNDLE, bundle / n * BUNDLE);
        let rows = (z..z + BUNDLE).flat_map(|z| (y..y + BUNDLE).map(move |y| (y, z)));
        let bytes = rows.map(|(y, z)| self.blocked[self.grid.row(y, z) + byte]);
        bytes.fold(0, |joined, byte| joined | byte)
    }

    fn join_rows(&mut self) {
        let n = self.bundles_per_side();
        let row_bytes = self.grid.row_bytes();
        self.bundles.clear();
        self.bundles.resize(n * n * row_bytes, 0);
        for (ix, bundle) in self.bundles.chunks_exact_mut(row_bytes).enumerate() {
            let (y, z) = (ix % n * BUNDLE, ix / n * BUNDLE);
            for z in z..z + BUNDLE {
                let first = self.grid.row(y, z);
                let rows = &self.blocked[first..first + BUNDLE * row_bytes];
                for row in rows.chunks_exact(row_bytes) {
                    for (joined, byte) in bundle.iter_mut().zip(row) {
                        *joined |= byte;
                    }
                }
            }
        }
    }
}
