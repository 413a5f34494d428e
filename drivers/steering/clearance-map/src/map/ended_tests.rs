//! A map whose thread has panicked.

use super::{ClearanceMap, Posture};
use crate::config::{MapConfig, reach_m};
use kinematics::urdf::Robot;
use kinematics::{Chain, Stamp, Transform};
use std::time::{Duration, Instant};
use steering::{Body, Clearance};

const SLIDE: &str = r#"<robot name="slide">
    <link name="base"/>
    <joint name="x" type="prismatic"><parent link="base"/><child link="post"/>
        <origin xyz="0 0 0.2"/><axis xyz="1 0 0"/>
        <limit lower="-0.2" upper="0.2" velocity="1" effort="1"/></joint>
    <link name="post"><collision><geometry><sphere radius="0.08"/></geometry></collision></link>
</robot>"#;
const AT: Stamp = Stamp(1_000_000_000);

fn started() -> ClearanceMap {
    let robot = Robot::parse(SLIDE).unwrap();
    let chain = Chain::new(&robot, "base", "post").unwrap();
    let body = Body::new(&robot, &chain, &|_| None).unwrap();
    let config = MapConfig::for_reach(reach_m(&body, &chain));
    ClearanceMap::start(&config, body).unwrap()
}

fn posture(position: Vec<f64>) -> Posture {
    Posture {
        stamp: AT,
        position,
        world_from_base: Transform::identity(),
    }
}

fn wait_until(is_done: impl Fn() -> bool) {
    const LIMIT: Duration = Duration::from_secs(120);
    let started = Instant::now();
    while !is_done() {
        assert!(started.elapsed() < LIMIT, "the thread does nothing");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_map_whose_thread_has_panicked_knows_nothing_and_says_why() {
    let map = started();
    let point = [0.0, 0.1, 0.2];
    map.sweep(posture(vec![0.0]), 0.1).unwrap();
    let is_known = || matches!(map.readings(&[point], AT)[..], [Some(_)]);
    wait_until(is_known);
    assert_eq!(map.failure(), None);
    // Postures without joints are refused at the door. Behind it, they are a bug.
    let invalid = (posture(Vec::new()), 0.1);
    map.shared.inbox.lock().swept.push_back(invalid);
    map.shared.arrived.notify_one();
    wait_until(|| map.failure().is_some());
    let failure = map.failure().unwrap();
    assert!(failure.contains("map of free space has ended"), "{failure}");
    assert!(!is_known(), "what was free may not be free any more");
    assert!(map.readings(&[point], AT).is_empty());
}
