//! Range scans: transforms each point to the world frame with the scanner pose at the time of that
//! point, and matches scans with earlier ones to correct the drift of the base.

use super::camera_motion::{Motion, corrects_base};
use super::drift::{DriftReport, ScanCorrection};
use crate::config::{Rig, Scanner};
use drivers::RangeScan;
use keyframe::{DepthMap, Keyframe, RangePoints};
use kinematics::{HistoryError, Stamp};
use nalgebra::Point3;
use std::collections::VecDeque;
use std::sync::Arc;

/// Maximum number of scans that wait for base poses. If there are more, the oldest scans are
/// dropped. At 10 Hz, 64 scans cover more than six seconds.
const MAX_WAITING: usize = 64;

/// Side of a depth cell in pixels. The rings of a scanner are about ten pixels apart.
const CELL_PX: u32 = 8;
/// Maximum time between an image and the scans used for its depth. The scanner was at another
/// position during older and newer scans, and saw other occlusions.
const MAX_TIME_DIFFERENCE_SECS: f64 = 1.0;
/// Minimum number of filled cells for a depth map. A map with fewer cells contains little
/// information about the image, but would count as depth in registration.
const MIN_CELLS: usize = 16;

/// The scans that wait for base poses, and the newest transformed ones.
pub(super) struct RangeScans {
    scanners: Vec<Scanner>,
    waiting: VecDeque<RangeScan>,
    kept: VecDeque<Arc<RangePoints>>,
    max_kept: usize,
    /// `None` if base poses are used as reported.
    correction: Option<ScanCorrection>,
}

/// Counts of processed scans.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct PlacementCounts {
    pub(super) n_placed: u64,
    pub(super) n_rejected: u64,
}

impl RangeScans {
    pub(super) fn new(rig: &Rig) -> Self {
        let max_kept = rig.join.max_range_scans;
        Self {
            scanners: rig.scanners.clone(),
            waiting: VecDeque::new(),
            kept: VecDeque::new(),
            max_kept,
            correction: corrects_base(rig).then(ScanCorrection::default),
        }
    }

    /// Forgets the surfaces, because the source has restarted.
    pub(super) fn restart(&mut self) {
        if let Some(correction) = &mut self.correction {
            correction.restart();
        }
    }

    /// What the scans showed about the drift of the base; `None` if they are not used for this.
    pub(super) fn drift(&self) -> Option<&DriftReport> {
        self.correction.as_ref().map(ScanCorrection::report)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Arc<RangePoints>> {
        self.kept.iter()
    }

    /// The newest `n` transformed scans, oldest first; fewer if fewer are kept.
    pub(super) fn newest(&self, n: u64) -> impl Iterator<Item = &Arc<RangePoints>> {
        let n_skipped = self
            .kept
            .len()
            .saturating_sub(usize::try_from(n).unwrap_or(usize::MAX));
        self.kept.iter().skip(n_skipped)
    }

    /// Depth of a keyframe from the scans around its stamp; `None` if they cover too little of the
    /// image.
    ///
    /// A cell of [`CELL_PX`] pixels per side takes its nearest point, because points on more
    /// distant surfaces also project into the gaps between the rings.
    pub(super) fn depth_of(&self, keyframe: &Keyframe) -> Option<DepthMap> {
        let size_px = keyframe.size_px.map(|side| side.div_ceil(CELL_PX));
        let per_cell = f64::from(CELL_PX);
        // Pixel centers are at half-integers, so dividing by the cell size maps pixel coordinates
        // to cell coordinates without an offset.
        let camera_from_world = keyframe.world_from_camera.inverse();
        let [focal_px, principal_px] =
            [keyframe.focal_px, keyframe.principal_px].map(|of| of.map(|px| px / per_cell));
        let mut depth_m = vec![f32::INFINITY; (size_px[0] * size_px[1]) as usize];
        let near_in_time = |scan: &&Arc<RangePoints>| {
            keyframe.stamp.secs_since(scan.stamp).abs() <= MAX_TIME_DIFFERENCE_SECS
        };
        for point in self
            .kept
            .iter()
            .filter(near_in_time)
            .flat_map(|scan| scan.points_in_world_m.iter())
        {
            let point = camera_from_world * Point3::from(*point).cast::<f64>();
            let cell =
                [0, 1].map(|axis| focal_px[axis] * point[axis] / point.z + principal_px[axis]);
            // Points behind the camera would project into the image mirrored. A NaN fails each of
            // these comparisons.
            if point.z > 0.0
                && (0..2).all(|axis| cell[axis] >= 0.0 && cell[axis] < f64::from(size_px[axis]))
            {
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "inside the map"
                )]
                let ix = cell[1] as usize * size_px[0] as usize + cell[0] as usize;
                #[expect(
                    clippy::cast_possible_truncation,
                    reason = "f32 is precise enough for a range"
                )]
                let z = point.z as f32;
                depth_m[ix] = depth_m[ix].min(z);
            }
        }
        let mut n_filled = 0;
        for depth_m in &mut depth_m {
            n_filled += usize::from(depth_m.is_finite());
            // While the minimum is taken, infinity marks an empty cell. Afterwards, it is replaced
            // by 0, which means "no reading" in depth maps.
            *depth_m = if depth_m.is_finite() { *depth_m } else { 0.0 };
        }
        let world_from_camera = keyframe.world_from_camera;
        (n_filled >= MIN_CELLS).then(|| DepthMap {
            size_px,
            focal_px,
            principal_px,
            depth_m: depth_m.into(),
            world_from_camera,
        })
    }

    /// Queues a scan. Returns false if this scan or an older scan is dropped.
    pub(super) fn push(&mut self, scan: RangeScan) -> bool {
        let is_known_scanner = self
            .scanners
            .iter()
            .any(|scanner| scanner.name == scan.scanner);
        if !is_known_scanner {
            return false;
        }
        self.waiting.push_back(scan);
        let fits = self.waiting.len() <= MAX_WAITING;
        if !fits {
            self.waiting.pop_front();
        }
        fits
    }

    /// Transforms every scan whose base poses are known, in order. Drops scans that waited longer
    /// than `max_wait_secs`.
    pub(super) fn process_ready(
        &mut self,
        motion: &mut Motion,
        newest: Stamp,
        at_end: bool,
        max_wait_secs: f64,
    ) -> PlacementCounts {
        let mut counts_placed = PlacementCounts::default();
        // Scans are processed in order. If the poses of a scan are not known yet, those of later
        // scans are not known either.
        while let Some(scan) = self.waiting.front() {
            match self.in_world(scan, motion) {
                Ok(in_world) => {
                    counts_placed.n_placed += 1;
                    let in_world = match &mut self.correction {
                        Some(correction) => correction.correct(in_world, motion),
                        None => in_world,
                    };
                    self.kept.push_back(Arc::new(in_world));
                    while self.kept.len() > self.max_kept {
                        self.kept.pop_front();
                    }
                }
                Err(HistoryError::NotYet { .. })
                    if !at_end && newest.secs_since(scan.stamp) <= max_wait_secs =>
                {
                    break;
                }
                Err(_) => counts_placed.n_rejected += 1,
            }
            self.waiting.pop_front();
        }
        counts_placed
    }

    fn in_world(&self, scan: &RangeScan, motion: &Motion) -> Result<RangePoints, HistoryError> {
        let scanner = self
            .scanners
            .iter()
            .find(|scanner| scanner.name == scan.scanner);
        let scanner = scanner.expect("only scans of known scanners are queued");
        let world_from_scanner =
            |stamp: Stamp| Ok(motion.world_from_base(stamp)? * scanner.base_from_scanner);
        let mut points = Vec::with_capacity(scan.points.len());
        // A scanner rotates for up to 0.1 s, in which a driving base moves by centimeters. Each
        // point is therefore transformed with its own base pose.
        // Points of one column share the same time.
        let mut column = (u32::MAX, world_from_scanner(scan.stamp)?);
        let first = column.1;
        for point in scan.points.iter() {
            if column.0 != point.offset_micros {
                let stamp = Stamp(
                    scan.stamp
                        .0
                        .saturating_add(i64::from(point.offset_micros) * 1000),
                );
                column = (point.offset_micros, world_from_scanner(stamp)?);
            }
            let in_scanner = Point3::from(point.position_m).cast::<f64>();
            let range_m = in_scanner.coords.norm();
            // This comparison is false for a NaN range.
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

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::Split;
    use kinematics::Transform;

    fn keyframe(stamp: Stamp) -> Keyframe {
        Keyframe {
            camera: "front".into(),
            stamp,
            size_px: [160, 124],
            focal_px: [100.0, 100.0],
            principal_px: [80.0, 62.0],
            rgba_srgb: vec![255; 4 * 160 * 124].into(),
            depth: None,
            world_from_camera: Transform::translation(0.0, 0.0, 1.0),
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        }
    }

    fn ranges_of(scans: Vec<(Stamp, Vec<[f32; 3]>)>) -> RangeScans {
        let kept = scans.into_iter().map(|(stamp, points)| {
            Arc::new(RangePoints {
                scanner: "lidar".into(),
                stamp,
                world_from_scanner: Transform::identity(),
                points_in_world_m: points.into(),
            })
        });
        RangeScans {
            scanners: Vec::new(),
            waiting: VecDeque::new(),
            kept: kept.collect(),
            max_kept: 9,
            correction: None,
        }
    }

    /// A wall 4 m in front of the camera, one row of points every 16 pixels.
    fn wall() -> Vec<[f32; 3]> {
        (0..10)
            .flat_map(|column| [-1.0, 1.0].map(|y| [-3.0 + 0.64 * column as f32, y, 5.0]))
            .collect()
    }

    #[test]
    fn cell_depth_is_that_of_its_nearest_point() {
        let now = Stamp(10_000_000_000);
        let pole = [[0.1, 0.5, 3.0], [0.0, 0.0, -2.0]]; // One before the wall at (0.2, 1.0), one behind the camera.
        let ranges = ranges_of(vec![(Stamp(9_500_000_000), wall()), (now, pole.to_vec())]);
        let depth = ranges.depth_of(&keyframe(now)).expect("enough points");
        assert_eq!(depth.size_px, [20, 16]);
        assert_eq!(
            (depth.focal_px, depth.principal_px),
            ([12.5; 2], [10.0, 7.75])
        );
        let at = |column: usize, row: usize| depth.depth_m[row * 20 + column];
        // 12.5 * 0.2 / 4 + 10 = 12.5 * 0.1 / 2 + 10 and 12.5 * 1.0 / 4 + 7.75 = 12.5 * 0.5 / 2 +
        // 7.75: one cell.
        assert_eq!((at(10, 10), at(10, 4)), (2.0, 4.0));
        assert_eq!(depth.depth_m.iter().filter(|z| **z == 4.0).count(), 19);
        assert_eq!(depth.depth_m.iter().filter(|z| **z == 0.0).count(), 300);
    }

    #[test]
    fn newest_scans_come_in_order() {
        let ranges = ranges_of((0..3).map(|ix| (Stamp(ix), wall())).collect());
        let stamps = |n| {
            ranges
                .newest(n)
                .map(|scan| scan.stamp.0)
                .collect::<Vec<_>>()
        };
        assert_eq!(
            [stamps(0), stamps(2), stamps(7)],
            [vec![], vec![1, 2], vec![0, 1, 2]]
        );
    }

    #[test]
    fn scans_from_other_times_give_no_depth() {
        let ranges = ranges_of(vec![(Stamp(0), wall())]);
        assert!(ranges.depth_of(&keyframe(Stamp(1_000_000_000))).is_some());
        assert!(ranges.depth_of(&keyframe(Stamp(1_000_000_001))).is_none());
        assert!(
            ranges_of(vec![(Stamp(0), wall()[..15].to_vec())])
                .depth_of(&keyframe(Stamp(0)))
                .is_none()
        );
    }
}
