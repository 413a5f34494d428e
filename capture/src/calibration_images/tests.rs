//! Images that are kept for calibration, of a simulated sequence of samples.

use super::*;
use drivers::{PixelFormat, Source};
use std::sync::Arc;

const URDF: &str = r#"<robot name="one"><link name="base"/><link name="tool"/>
    <joint name="turn" type="revolute"><parent link="base"/><child link="tool"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint></robot>"#;
const SIZE_PX: [u32; 2] = [16, 8];
const FOCAL_PX: f64 = 500.0;

struct Samples(std::vec::IntoIter<Sample>);

impl Source for Samples {
    fn next_sample(&mut self) -> Result<Option<Sample>, drivers::Error> {
        Ok(self.0.next())
    }
}

fn rig(arm: &str, camera: &str) -> Rig {
    let text = format!(
        "{arm}\n[camera.wrist]\ndriver = \"v4l2\"\nsize_px = [16, 8]\nrate_hz = 10\n{camera}\n\
         intrinsics = {{ focal_px = [{FOCAL_PX}, {FOCAL_PX}], principal_px = [8, 4] }}\n"
    );
    Rig::parse("rig.toml", &text, URDF, &[]).expect("a rig file")
}

fn arm_rig() -> Rig {
    rig(
        "[arm]\ndriver = \"udp\"\nurdf = \"one.urdf\"\nflange_link = \"tool\"\njoint_offsets = [0.25]",
        "parent = \"flange\"\nexposure_micros = 10000\nreadout_micros = 10000\n\
         parent_from_camera = { xyz_m = [0, 0, 0], quat_xyzw = [0, 0, 0, 1] }",
    )
}

fn stamp(secs: f64) -> Stamp {
    Stamp(0).plus_secs(secs)
}

fn image(secs: f64) -> Image {
    Image {
        camera: "wrist".into(),
        stamp: stamp(secs),
        size_px: SIZE_PX,
        format: PixelFormat::Gray8,
        data: [7; 128].into(),
        exposure_secs: None,
        n_skipped: 0,
    }
}

/// The joint moves from 0 to 0.4 rad between 1 and 1.4 s, and stands still before and after.
fn joint_at(secs: f64) -> f64 {
    (secs - 1.0).clamp(0.0, 0.4)
}

fn reading(secs: f64) -> Sample {
    Sample::Joints(JointState {
        stamp: stamp(secs),
        position: vec![joint_at(secs)],
        velocity: vec![],
        effort: vec![],
    })
}

/// Readings at 100 Hz from 0 to 2 s and the given images, in the order of their arrival.
fn with_readings(images: impl IntoIterator<Item = Image>) -> Vec<Sample> {
    let mut samples: Vec<Sample> = (0..=200).map(|ix| reading(f64::from(ix) * 0.01)).collect();
    samples.extend(images.into_iter().map(Sample::Image));
    samples.sort_by_key(Sample::stamp);
    samples
}

fn read(rig: Rig, samples: Vec<Sample>) -> anyhow::Result<CalibrationImages> {
    let source = Box::new(Samples(samples.into_iter()));
    let opened = Opened {
        rig,
        source,
        damage: Arc::default(),
        stamp_clock: StampClock::Unrelated,
    };
    calibration_images(opened, "wrist", 3.0, |_, _| ControlFlow::Continue(()))
}

#[test]
fn images_at_different_poses_are_kept_while_the_arm_is_slow() {
    let found = read(
        arm_rig(),
        with_readings([0.5, 0.6, 1.2, 1.7, 1.8].map(image)),
    )
    .unwrap();
    // The second and the last image show the poses of the images before.
    let secs: Vec<f64> = found.images.iter().map(|image| image.secs).collect();
    assert_eq!(
        (secs, found.n_read, found.n_fast, found.n_unusable),
        (vec![0.5, 1.7], 5, 1, 0)
    );
    for (image, joint) in found.images.iter().zip([0.25, 0.65]) {
        let arm = image.arm.as_ref().expect("the rig has an arm");
        assert!(
            (arm.joints[0] - joint).abs() < 1e-9,
            "the joint offset is included: {}",
            arm.joints[0]
        );
        assert!((arm.base_from_flange.rotation.angle() - joint).abs() < 1e-9);
        assert_eq!((image.size_px, image.gray.len()), (SIZE_PX, 128));
    }
}

#[test]
fn rows_have_the_poses_of_their_exposures() {
    // Fast images are kept with a large limit.
    let source = Box::new(Samples(with_readings([image(1.2)]).into_iter()));
    let opened = Opened {
        rig: arm_rig(),
        source,
        damage: Arc::default(),
        stamp_clock: StampClock::Unrelated,
    };
    let found = calibration_images(opened, "wrist", 1e3, |_, _| ControlFlow::Continue(())).unwrap();
    let arm = found.images[0].arm.as_ref().unwrap();
    // The joint rotates at 1 rad/s over the readout time of 10 ms.
    let angles = [0.0, 0.5, 1.0].map(|row_frac| arm.base_from_flange_at(row_frac).rotation.angle());
    for (angle, expected) in angles.into_iter().zip([0.445, 0.45, 0.455]) {
        assert!((angle - expected).abs() < 1e-6, "{angles:?}");
    }
}

#[test]
fn images_without_readings_or_pixels_are_unusable() {
    let mut broken = image(0.5);
    broken.data = [7; 3].into();
    // The images are before the first reading, broken, and after the last reading.
    let found = read(
        arm_rig(),
        with_readings([image(-0.5), broken, image(1.8), image(2.5)]),
    )
    .unwrap();
    assert_eq!(
        (found.images.len(), found.n_read, found.n_unusable),
        (1, 4, 3)
    );
}

#[test]
fn depth_and_other_cameras_are_ignored_and_the_end_is_respected() {
    let mut depth = image(0.5);
    depth.format = PixelFormat::DepthU16 {
        meters_per_count: 1e-3,
    };
    let other = Image {
        camera: "other".into(),
        ..image(0.6)
    };
    let found = read(arm_rig(), with_readings([depth, other])).unwrap();
    assert_eq!((found.images.len(), found.n_read), (0, 0));
    let source = Box::new(Samples(with_readings([image(0.5), image(1.7)]).into_iter()));
    let opened = Opened {
        rig: arm_rig(),
        source,
        damage: Arc::default(),
        stamp_clock: StampClock::Unrelated,
    };
    let until_one_second =
        |sample: &Sample, _: &[CalibrationImage]| match sample.stamp() > stamp(1.0) {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        };
    let found = calibration_images(opened, "wrist", 3.0, until_one_second).unwrap();
    assert_eq!(found.images.len(), 1);
}

#[test]
fn images_of_a_robot_without_an_arm_have_an_interval() {
    let rig = rig(
        "[arm]\ndriver = \"none\"\nurdf = \"one.urdf\"\nflange_link = \"tool\"",
        "parent = \"base\"",
    );
    let images = (0..20).map(|ix| Sample::Image(image(f64::from(ix) * 0.1)));
    let found = read(rig, images.collect()).unwrap();
    let secs: Vec<f64> = found
        .images
        .iter()
        .map(|image| (image.secs * 10.0).round())
        .collect();
    assert_eq!(secs, [0.0, 5.0, 10.0, 15.0]);
    assert!(found.images.iter().all(|image| image.arm.is_none()));
}

#[test]
fn unknown_cameras_and_moving_bases_are_rejected() {
    let source = || Box::new(Samples(Vec::new().into_iter()));
    let open = |rig| Opened {
        rig,
        source: source(),
        damage: Arc::default(),
        stamp_clock: StampClock::Unrelated,
    };
    let error = calibration_images(open(arm_rig()), "front", 3.0, |_, _| {
        ControlFlow::Continue(())
    })
    .unwrap_err()
    .to_string();
    assert!(
        error.contains("no camera \"front\"; it has wrist"),
        "{error}"
    );
    let mut moving = arm_rig();
    moving.base.driver = crate::config::BaseDriver::Udp;
    let error = calibration_images(open(moving), "wrist", 3.0, |_, _| ControlFlow::Continue(()))
        .unwrap_err()
        .to_string();
    assert!(error.contains("base.driver"), "{error}");
}

#[test]
fn summary_names_only_reasons_that_occurred() {
    let image = CalibrationImage {
        secs: 0.0,
        size_px: [1, 1],
        gray: vec![0],
        arm: None,
    };
    let found = |n_used: usize, n_read, n_fast, n_unusable| CalibrationImages {
        images: vec![image.clone(); n_used],
        n_read,
        n_fast,
        n_unusable,
        damage: None,
    };
    assert_eq!(found(12, 12, 0, 0).summary(), "12 of 12 images used");
    assert_eq!(
        found(12, 20, 0, 3).summary(),
        "12 of 20 images used; not used: 5 similar to a used image, 3 without joint readings or damaged"
    );
    assert_eq!(
        found(1, 3, 2, 0).summary(),
        "1 of 3 images used; not used: 2 during a fast motion of the arm"
    );
    assert!(
        found(MAX_IMAGES, MAX_IMAGES + 1, 0, 0)
            .summary()
            .ends_with("1 similar to a used image or beyond the maximum of 300")
    );
}

#[test]
fn the_caller_chooses_among_all_images_of_an_arm_that_is_slow() {
    let images = (0..20).map(|ix| image(0.05 + 0.1 * f64::from(ix)));
    let opened = Opened {
        rig: arm_rig(),
        source: Box::new(Samples(with_readings(images).into_iter())),
        damage: Default::default(),
        stamp_clock: StampClock::Unrelated,
    };
    let mut offered = Vec::new();
    let mut choose = |image: &CalibrationImage| {
        offered.push(image.secs);
        offered.len().is_multiple_of(2)
    };
    let found = chosen_calibration_images(
        opened,
        "wrist",
        3.0,
        |_, _| ControlFlow::Continue(()),
        &mut choose,
    )
    .expect("a rig with an arm");
    assert_eq!(found.n_read, 20);
    // Without a choice, only the first image of a pose is kept.
    assert_eq!(offered.len() + found.n_fast + found.n_unusable, 20);
    assert!(offered.len() > 10 && found.n_fast > 0, "{offered:?}");
    assert_eq!(found.images.len(), offered.len() / 2);
}
