//! Turns of range scanners: each point is put into the world where the scanner was at that point's own instant.

use super::motion::Motion;
use crate::config::{Rig, Scanner};
use drivers::RangeScan;
use kinematics::{HistoryError, Stamp};
use nalgebra::Point3;
use std::collections::VecDeque;
use std::sync::Arc;
use trainer::RangePoints;

/// Turns that may wait for poses of the base; older ones go.
const MAX_WAITING: usize = 64;

/// The turns that wait for poses, and the newest of those that have them.
pub(super) struct Ranges {
    scanners: Vec<Scanner>,
    waiting: VecDeque<RangeScan>,
    kept: VecDeque<Arc<RangePoints>>,
    max_kept: usize,
}

/// What became of turns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Settled {
    pub(super) n_placed: u64,
    pub(super) n_refused: u64,
}

impl Ranges {
    pub(super) fn new(rig: &Rig) -> Self {
        let max_kept = rig.join.max_range_scans;
        Self { scanners: rig.scanners.clone(), waiting: VecDeque::new(), kept: VecDeque::new(), max_kept }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Arc<RangePoints>> {
        self.kept.iter()
    }

    /// Queues a turn; false where it, or an older one, is lost.
    pub(super) fn push(&mut self, scan: RangeScan) -> bool {
        let is_known = self.scanners.iter().any(|scanner| scanner.name == scan.scanner);
        if !is_known {
            return false;
        }
        self.waiting.push_back(scan);
        let fits = self.waiting.len() <= MAX_WAITING;
        if !fits {
            self.waiting.pop_front();
        }
        fits
    }

    /// Places every turn whose poses are known, in order; gives up one that waited longer than `max_wait_secs`.
    pub(super) fn settle(&mut self, motion: &Motion, newest: Stamp, at_end: bool, max_wait_secs: f64) -> Settled {
        let mut settled = Settled::default();
        while let Some(scan) = self.waiting.front() {
            match self.placed(scan, motion) {
                Ok(placed) => {
                    settled.n_placed += 1;
                    self.kept.push_back(Arc::new(placed));
                    while self.kept.len() > self.max_kept {
                        self.kept.pop_front();
                    }
                }
                Err(HistoryError::NotYet { .. }) if !at_end && newest.secs_since(scan.stamp) <= max_wait_secs => break,
                Err(_) => settled.n_refused += 1,
            }
            self.waiting.pop_front();
        }
        settled
    }

    fn placed(&self, scan: &RangeScan, motion: &Motion) -> Result<RangePoints, HistoryError> {
        let scanner = self.scanners.iter().find(|scanner| scanner.name == scan.scanner);
        let scanner = scanner.expect("only turns of known scanners wait");
        let world_from_scanner = |stamp: Stamp| Ok(motion.world_from_base(stamp)? * scanner.base_from_scanner);
        let mut points = Vec::with_capacity(scan.points.len());
        // Points of one column share their instant.
        let mut column = (u32::MAX, world_from_scanner(scan.stamp)?);
        let first = column.1;
        for point in scan.points.iter() {
            if column.0 != point.offset_micros {
                let stamp = Stamp(scan.stamp.0.saturating_add(i64::from(point.offset_micros) * 1000));
                column = (point.offset_micros, world_from_scanner(stamp)?);
            }
            let in_scanner = Point3::from(point.position_m).cast::<f64>();
            let range_m = in_scanner.coords.norm();
            // A range that is no number is not inside.
            if range_m >= scanner.min_m && range_m <= scanner.max_m {
                points.push((column.1 * in_scanner).cast::<f32>().coords.into());
            }
        }
        Ok(RangePoints {
            scanner: Arc::clone(&scan.scanner),
            stamp: scan.stamp,
            world_from_scanner: first,
            points_in_world_m: points.into(),
        })
    }
}
