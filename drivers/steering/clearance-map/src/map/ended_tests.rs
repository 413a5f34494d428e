//! A map whose thread has panicked.

use super::Posture;
use crate::tests::map_tests::{posture, started, wait_until};
use kinematics::{Stamp, Transform};
use steering::Clearance;

const AT: Stamp = Stamp(1_000_000_000);

#[test]
fn a_map_whose_thread_has_panicked_reports_it_and_returns_no_readings() {
    let map = started();
    let point = [0.0, 0.1, 0.2];
    let at_zero = posture(0.0, AT, Transform::identity());
    map.sweep(at_zero.clone(), 0.1).unwrap();
    let is_known = || matches!(map.readings(&[point], AT)[..], [Some(_)]);
    wait_until(&map, is_known);
    assert_eq!(map.failure(), None);
    // The map refuses postures without joints. In the queue of its thread, they are a bug.
    let invalid = Posture {
        position: Vec::new(),
        ..at_zero
    };
    map.shared.inbox.lock().swept.push_back((invalid, 0.1));
    map.shared.arrived.notify_one();
    wait_until(&map, || map.failure().is_some());
    let failure = map.failure().unwrap();
    assert!(failure.contains("map of free space has ended"), "{failure}");
    assert!(!is_known(), "what was free may not be free any more");
    assert!(map.readings(&[point], AT).is_empty());
}
