//! Range scans correct the drift of a walking base. Every scan of a simulated walk is compared with
//! the true poses.

use capture::config::{Override, Rig};
use capture::{Join, open};
use drivers::Sample;
use std::path::Path;

/// The longest allowed error after the correction: position in meters, orientation in radians.
const MAX_ERROR: [f64; 2] = [0.008, 0.0026];

#[test]
fn range_scans_correct_a_walking_base() {
    let overrides = [
        Override::new("sim.lockstep", true),
        Override::new("sim.duration_secs", 16.0),
        Override::new("base.sim.drift_m", 0.06),
        Override::new("base.sim.drift_rad", 0.05),
        // Images are not needed.
        Override::new("camera.front.rate_hz", 1.0),
        Override::new("camera.rear.rate_hz", 1.0),
    ];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/mobile-base-small.toml");
    let rig = Rig::load(&path, &overrides).expect("a bundled rig file");
    let opened = open::rig(rig, open::Devices::Sim).expect("the simulator");
    let mut source = opened.source;
    let mut join = Join::new(&opened.rig).expect("a rig");
    while let Some(sample) = source.next_sample().expect("the rig works") {
        if !matches!(sample, Sample::Image(_) | Sample::Truth(_)) {
            join.push(sample);
        }
    }
    join.finish();
    let drift = join.drift().expect("the rig has a scanner");
    let [before, after] = drift
        .base_error()
        .expect("the simulator knows the true poses");
    assert!(before.m > 0.015 && before.rad > 0.01, "{drift}");
    assert!(
        after.m < MAX_ERROR[0] && after.rad < MAX_ERROR[1],
        "{drift}"
    );
    assert!(
        drift.n_matched() > 140 && drift.n_unmatched() == 1,
        "{drift}"
    );
}
