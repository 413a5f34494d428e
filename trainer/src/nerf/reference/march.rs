//! Walks a ray through the occupied parts of the scene.
//!
//! The source of the occupancy is Mueller et al. 2022, appendix C. Steps outside the inner cube
//! grow to match the contraction.

use model_files::contraction::contract;

/// Parameters for walking rays. Lengths are in units of the scene radius.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct March {
    /// Length of a step inside the inner cube.
    pub step: f64,
    /// Maximum number of samples per ray.
    pub max_samples: usize,
    /// Cells of the occupancy along an axis.
    pub n_cells: usize,
}

/// A segment of a ray in an occupied cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RaySegment {
    /// Begin along the ray.
    pub begin: f64,
    /// Length along the ray.
    pub length: f64,
}

impl RaySegment {
    /// Middle of the segment on a ray.
    fn middle(&self, origin: [f64; 3], direction: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| {
            origin[axis] + (self.begin + 0.5 * self.length) * direction[axis]
        })
    }

    /// Begin and end of a span around the middle of the segment. The span is `stride` times as long
    /// as the segment.
    fn widened(&self, stride: usize) -> [f64; 2] {
        let middle = self.begin + 0.5 * self.length;
        let reach = 0.5 * self.length * stride as f64;
        [middle - reach, middle + reach]
    }
}

/// Components of a direction that are smaller than this value are replaced by it, so that divisions
/// by the components stay finite.
const MIN_DIRECTION: f64 = 1e-9;

/// The part of a ray inside the inner cube, and its number of steps.
#[derive(Clone, Copy, Debug)]
struct Path {
    enter: f64,
    leave: f64,
    n_before: f64,
    n_inside: f64,
    n_steps: f64,
}

impl Path {
    /// Distance along the ray after `n` steps.
    fn distance_at(&self, step: f64, n: f64) -> f64 {
        let distance_at_share = |share: f64| 1.0 / (1.0 - share) - 1.0;
        let inside = n - self.n_before;
        if inside < 0.0 {
            self.enter - distance_at_share(-inside * step)
        } else if inside < self.n_inside {
            self.enter + inside * step
        } else {
            self.leave + distance_at_share((inside - self.n_inside) * step)
        }
    }
}

impl March {
    /// Index of the cell around a point, and the distance to the cell's nearest side, in cells.
    pub fn cell(&self, at: [f64; 3]) -> (usize, f64) {
        let scaled = contract(at).map(|x| x * self.n_cells as f64);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "within the cube"
        )]
        let cell = scaled.map(|x| (x as usize).min(self.n_cells - 1));
        let margin = scaled
            .iter()
            .map(|x| (x - x.round()).abs())
            .fold(1.0, f64::min);
        (
            cell[0] + self.n_cells * (cell[1] + self.n_cells * cell[2]),
            margin,
        )
    }

    /// All segments of a ray that are within a range of distances and in occupied cells. The first
    /// step starts `jitter` steps after `range[0]`. Also returns a margin, which is the smallest of
    /// two kinds of distances. The first is the distance from the middle of a segment to a side of
    /// its cell, in cells. The second is the distance from a number of steps to the nearest
    /// integer.
    ///
    /// Steps have constant length inside the inner cube. Outside, the step at a distance u from the
    /// cube is longer by the factor (1 + u)^2, so that each step changes 1 / (1 + u) by the same
    /// amount.
    pub fn segments(
        &self,
        (origin, direction): ([f64; 3], [f64; 3]),
        range: [f64; 2],
        jitter: f64,
        is_occupied: impl Fn(usize) -> bool,
    ) -> (Vec<RaySegment>, f64) {
        let path = self.path((origin, direction), range);
        let n_segments = (path.n_steps - jitter).ceil().max(0.0);
        let to_nearest_count = path.n_steps - jitter - (path.n_steps - jitter).round();
        // The kernel computes in f32. Rays whose decisions depend on rounding have a small margin,
        // and tests leave them out.
        let mut found = Vec::new();
        let mut min_margin = to_nearest_count.abs();
        let mut ix = 0.0;
        while ix < n_segments {
            let [begin, end] = [ix, ix + 1.0].map(|ix| path.distance_at(self.step, ix + jitter));
            let segment = RaySegment {
                begin,
                length: end - begin,
            };
            let (cell, margin) = self.cell(segment.middle(origin, direction));
            min_margin = min_margin.min(margin);
            if is_occupied(cell) {
                found.push(segment);
            }
            ix += 1.0;
        }
        (found, min_margin)
    }

    fn path(&self, (origin, direction): ([f64; 3], [f64; 3]), [begin, end]: [f64; 2]) -> Path {
        // The ray is intersected with the inner cube by the slab method. Only the part after the
        // beginning of the ray is used.
        let [mut enter, mut leave] = [begin, f64::INFINITY];
        for axis in 0..3 {
            let along = if direction[axis].abs() < MIN_DIRECTION {
                MIN_DIRECTION
            } else {
                direction[axis]
            };
            let [low, high] = [-1.0, 1.0].map(|side| (side - origin[axis]) / along);
            enter = enter.max(low.min(high));
            leave = leave.min(low.max(high));
        }
        // Outside, the share 1 - 1 / (1 + u) of a distance u grows by the same amount with each
        // step, and stays below 1. A ray without end therefore has a finite number of steps.
        let contracted_share = |distance: f64| 1.0 - 1.0 / (1.0 + distance);
        let mut path = Path {
            enter: begin,
            leave: begin,
            n_before: 0.0,
            n_inside: 0.0,
            n_steps: 0.0,
        };
        if leave > enter {
            let n_before = contracted_share(enter - begin) / self.step;
            path = Path {
                enter,
                leave,
                n_before,
                n_inside: (leave - enter) / self.step,
                n_steps: 0.0,
            };
        }
        path.n_steps = if end < path.enter {
            path.n_before - contracted_share(path.enter - end) / self.step
        } else if end < path.leave {
            path.n_before + (end - path.enter) / self.step
        } else {
            let n_after =
                (contracted_share(end - path.leave) / self.step).min(1.0 / self.step - 1.0);
            path.n_before + path.n_inside + n_after
        };
        path
    }

    /// The spans of at most `max_samples` samples that are selected from the segments. Each sample
    /// represents the same number of segments.
    pub fn spans(&self, segments: &[RaySegment], jitter: f64) -> Vec<[f64; 2]> {
        let stride = segments.len().div_ceil(self.max_samples).max(1);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a fraction of the stride"
        )]
        let phase = ((jitter * stride as f64) as usize).min(stride - 1);
        // The phase is random, so that all segments are sampled in the course of several steps.
        segments
            .iter()
            .skip(phase)
            .step_by(stride)
            .map(|segment| segment.widened(stride))
            .collect()
    }
}
