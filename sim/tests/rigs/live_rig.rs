//! Tests of the simulated rig as live devices.

use drivers::PixelFormat;
use kinematics::Stamp;
use sim::Config;
use std::time::Duration;

#[test]
fn live_devices_deliver_until_the_rig_ends() {
    const TIMEOUT: Duration = Duration::from_secs(60);
    const START: Stamp = Stamp(5_000_000_000_000);
    let mut config = Config {
        duration_secs: Some(1.0),
        ..Config::default()
    };
    config.cameras[0].intrinsics = config.cameras[0].intrinsics.resized([160, 120]);
    let mut rig = sim::open(&config)
        .expect("the rig opens")
        .into_live(START)
        .expect("the rig starts");

    let mut newest = START;
    let mut n_readings = 0;
    let arm = rig.devices.arm.as_mut().expect("the rig has an arm");
    while let Ok(state) = arm.read(TIMEOUT) {
        assert!(n_readings == 0 || state.stamp > newest);
        assert_eq!((state.position.len(), state.velocity.len()), (7, 7));
        newest = state.stamp;
        n_readings += 1;
    }
    // The run takes one second at 1 kHz. Readings are dropped only if the machine stalls for a
    // second.
    assert!((500..=1001).contains(&n_readings), "{n_readings} readings");
    assert!(newest > START && newest <= START.plus_secs(1.001));

    let camera = &mut rig.devices.cameras[0];
    assert_eq!(camera.name(), "wrist");
    let (mut n_color, mut n_depth, mut n_dropped) = (0, 0, 0);
    let end = loop {
        match camera.next_image(TIMEOUT) {
            Ok(image) if image.format == PixelFormat::Rgb8 => {
                n_color += 1;
                n_dropped += image.n_skipped;
            }
            Ok(_) => n_depth += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(end, drivers::Error::Simulation { .. }), "{end}");
    assert!(
        n_color >= 1 && n_depth >= 1,
        "{n_color} color, {n_depth} depth"
    );
    // No images were taken while the joints were read. Images that did not fit in the queue were
    // dropped and counted.
    assert!(
        n_color + n_dropped <= 15 && n_color + n_depth <= 8,
        "{n_color} color, {n_depth} depth, {n_dropped} dropped"
    );
    let truth = rig.truth.take().expect("ground truth");
    assert!(matches!(truth, drivers::Sample::Truth(truth) if truth.psnr_ceiling.is_some()));
}
