//! Scans of range scanners, for viewers.

use crate::Hub;
use crate::client::server_message::{BinaryHeader, RangeScanHeader, frame};
use crate::clock::ServerClock;
use crate::topics::positions::pack_positions;
use crate::topics::shared_topic::SharedTopic;
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use keyframe::RangeScan;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum number of points that are sent per scan. They take 36 kB. Scans of 3D scanners have many
/// more points. With a larger maximum, their surfaces would look denser on the page, but other data
/// would wait longer on slow links.
const MAX_POINTS: usize = 6000;

/// Latest scans by scanner name.
type RangeScans = BTreeMap<Arc<str>, Arc<RangeScan>>;

/// The topic, with the scans that were encoded.
#[derive(Default)]
pub(crate) struct RangeScanTopic {
    encoded: RangeScans,
}

impl SharedTopic for RangeScanTopic {
    const NAME: &'static str = "range_scans";
    const DEFAULT: DefaultRate = DefaultRate::Off;
    const PRIORITY: Priority = Priority::Live;
    type Source = RangeScans;

    fn encode(&mut self, scans: &RangeScans, clock: ServerClock) -> Vec<(Arc<str>, Message)> {
        let mut messages = Vec::new();
        for (scanner, scan) in scans {
            // The map has the scans of all scanners, but usually only one of them is new.
            let known = self.encoded.insert(Arc::clone(scanner), Arc::clone(scan));
            if known.is_some_and(|known| Arc::ptr_eq(&known, scan)) {
                continue;
            }
            if let Some(packed) = pack_range_scan(scan, clock) {
                messages.push((Arc::clone(scanner), Message::binary(packed)));
            }
        }
        messages
    }
}

impl Hub {
    /// Sets the latest scan of a range scanner. It is encoded later, on another thread, and only
    /// for clients that show it.
    pub fn set_range_scan(&self, range_scan: RangeScan) {
        self.latest::<RangeScans>().send_modify(|scans| {
            scans.insert(Arc::clone(&range_scan.scan.scanner), Arc::new(range_scan));
        });
    }
}

/// The binary message with a scan; `None` without points.
fn pack_range_scan(range_scan: &RangeScan, clock: ServerClock) -> Option<Vec<u8>> {
    let RangeScan {
        scan,
        map_from_odom,
        captured_at,
    } = range_scan;
    // The points are relative to the scanner, so that counts of 16 bits have the smallest step.
    // Relative to the world, the counts would have to cover the distance to the world's origin,
    // too.
    let origin = map_from_odom * Point3::from(scan.world_from_scanner.translation.vector);
    // Only every n-th point is sent. Points are in the order of measurement, so all directions stay
    // covered.
    let stride = scan.points_in_world_m.len().div_ceil(MAX_POINTS).max(1);
    let from_origin =
        |point: &[f32; 3]| map_from_odom * Point3::from(*point).cast::<f64>() - origin;
    let points: Vec<Vector3<f64>> = scan
        .points_in_world_m
        .iter()
        .step_by(stride)
        .map(from_origin)
        .collect();
    let (positions, meters_per_count) = pack_positions(&points)?;
    let header = RangeScanHeader {
        scanner: &scan.scanner,
        stamp_nanos: scan.stamp.0,
        captured_millis: clock.millis(*captured_at),
        origin_m: origin.into(),
        n_points: points.len(),
        meters_per_count,
    };
    Some(frame(&BinaryHeader::RangeScan(header), &[&positions]))
}

#[cfg(test)]
mod tests {
    use super::{MAX_POINTS, ServerClock, pack_range_scan};
    use keyframe::{RangePoints, RangeScan};
    use kinematics::{Stamp, Transform};
    use nalgebra::Vector3;
    use std::time::Instant;

    fn scan(n: usize) -> RangeScan {
        let point = |ix: usize| {
            #[expect(clippy::cast_precision_loss, reason = "a small number")]
            let angle = ix as f32;
            [2.0 + angle.cos(), 3.0 * angle.sin(), 0.5]
        };
        RangeScan {
            scan: RangePoints {
                scanner: "lidar".into(),
                stamp: Stamp(5),
                world_from_scanner: Transform::translation(2.0, 0.0, 0.4),
                points_in_world_m: (0..n).map(point).collect(),
            }
            .into(),
            map_from_odom: Transform::rotation(Vector3::new(0.0, 0.0, 0.3)),
            captured_at: Instant::now(),
        }
    }

    #[test]
    fn points_are_corrected_and_relative_to_the_scanner() {
        let range_scan = scan(20_000);
        let message = pack_range_scan(&range_scan, ServerClock::start()).expect("points");
        let n_header = u32::from_le_bytes(message[..4].try_into().expect("4 bytes")) as usize;
        let header: serde_json::Value =
            serde_json::from_slice(&message[4..4 + n_header]).expect("JSON");
        let n = usize::try_from(header["n_points"].as_u64().expect("a number")).expect("small");
        assert!(n <= MAX_POINTS && n > MAX_POINTS / 2, "{header}");
        let numbers = |name: &str| header[name].as_f64().expect("a number");
        let origin = [0, 1, 2].map(|axis| header["origin_m"][axis].as_f64().expect("a number"));
        let payload = &message[4 + n_header..];
        assert_eq!(payload.len(), 6 * n);
        let stride = range_scan.scan.points_in_world_m.len().div_ceil(n);
        for (ix, bytes) in payload.chunks_exact(6).enumerate() {
            let count = |axis: usize| i16::from_le_bytes([bytes[2 * axis], bytes[2 * axis + 1]]);
            let got =
                Vector3::from([0, 1, 2].map(|axis| {
                    origin[axis] + f64::from(count(axis)) * numbers("meters_per_count")
                }));
            let point = nalgebra::Point3::from(range_scan.scan.points_in_world_m[ix * stride])
                .cast::<f64>();
            assert!(
                (got - (range_scan.map_from_odom * point).coords).norm() < 2e-4,
                "{ix}: {got}"
            );
        }
    }

    #[test]
    fn empty_scans_are_not_sent() {
        assert_eq!(pack_range_scan(&scan(0), ServerClock::start()), None);
    }
}
