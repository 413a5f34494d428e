//! Masks compared with the simulator's exact segmentation, and masks in the keyframes of a join.

use super::*;
use crate::config::{Override, UrdfFolder};
use crate::join::{Join, JoinEvent};
use drivers::{Image, PixelFormat, Sample};
use keyframe::masked_robot::ConvexPiece;
#[cfg(feature = "sim")]
use keyframe::masked_robot::{Pinhole, Silhouette};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use std::path::{Path, PathBuf};
use toml::Value;

const SIZE_PX: [u32; 2] = [320, 240];
const FOCAL_PX: f64 = 300.0;
const JOINTS_RAD: [f64; 7] = [0.1, -0.3, 0.2, -2.0, 0.1, 1.8, 0.6];

/// A camera in the room that looks at a point in front of the robot.
fn world_from_camera(eye: [f64; 3]) -> Transform {
    let eye = Point3::from(eye);
    let toward = Point3::new(0.2, 0.0, 0.4) - eye;
    let rotation = UnitQuaternion::face_towards(&toward, &-Vector3::z());
    Transform::from_parts(eye.into(), rotation)
}

fn bundled(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../rigs")
        .join(name)
}

/// A static arm, seen by a camera in the room with depth.
pub(super) fn rig(changes: &[Override]) -> Rig {
    let pose = world_from_camera([1.3, 0.4, 0.8]);
    let list = |key, numbers: &[f64]| Override::new(key, Value::from(numbers.to_vec()));
    let size = SIZE_PX.map(i64::from).to_vec();
    let mut all = vec![
        Override::new("camera.wrist.size_px", Value::from(size)),
        list("camera.wrist.intrinsics.focal_px", &[FOCAL_PX; 2]),
        list("camera.wrist.intrinsics.principal_px", &[160.0, 120.0]),
        Override::new("camera.wrist.rate_hz", 10),
        Override::new("camera.wrist.parent", "world"),
        list(
            "camera.wrist.parent_from_camera.xyz_m",
            pose.translation.vector.as_slice(),
        ),
        list(
            "camera.wrist.parent_from_camera.quat_xyzw",
            pose.rotation.coords.as_slice(),
        ),
        Override::new("sim.truth", false),
    ];
    all.extend(changes.iter().cloned());
    Rig::load(&bundled("static-arm.toml"), &all).expect("a bundled rig file")
}

/// Joint states at 100 Hz in which the first joint rotates, and an image with depth every 0.1 s.
pub(super) fn samples(speed_rad_s: f64) -> Vec<Sample> {
    let n_pixels = (SIZE_PX[0] * SIZE_PX[1]) as usize;
    let mut samples = Vec::new();
    for tick in 0..60_i64 {
        let stamp = Stamp(tick * 10_000_000);
        let mut position = JOINTS_RAD.to_vec();
        position[0] += speed_rad_s * stamp.secs();
        let mut velocity = vec![0.0; 7];
        velocity[0] = speed_rad_s;
        samples.push(Sample::Joints(JointState {
            stamp,
            position,
            velocity,
            effort: Vec::new(),
        }));
        if tick % 10 == 5 {
            let checkerboard = (0..n_pixels).flat_map(|ix| {
                let is_light = (ix / 5 + ix / 320 / 5) % 2 == 0;
                [if is_light { 190 } else { 60 }; 3]
            });
            let color = Image {
                camera: "wrist".into(),
                stamp,
                size_px: SIZE_PX,
                format: PixelFormat::Rgb8,
                data: checkerboard.collect::<Vec<u8>>().into(),
                exposure_secs: Some(1e-3),
                n_skipped: 0,
            };
            let depth = Image {
                format: PixelFormat::DepthU16 {
                    meters_per_count: 1e-4,
                },
                data: 10_000_u16.to_le_bytes().repeat(n_pixels).into(),
                ..color.clone()
            };
            samples.extend([Sample::Image(color), Sample::Image(depth)]);
        }
    }
    samples
}

pub(super) fn keyframes(join: &mut Join, samples: Vec<Sample>) -> Vec<Arc<Keyframe>> {
    let mut events: Vec<JoinEvent> = samples
        .into_iter()
        .flat_map(|sample| join.push(sample))
        .collect();
    events.extend(join.finish());
    let accepted = events.into_iter().filter_map(|event| match event {
        JoinEvent::Accepted(keyframe) => Some(keyframe),
        _ => None,
    });
    accepted.collect()
}

/// Index of the pixel at which a point of the world appears.
fn pixel_ix(point_in_world: Point3<f64>, camera: &Transform) -> usize {
    let point = camera.inverse_transform_point(&point_in_world);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a pixel of the image"
    )]
    let [x, y] = [(point.x, 160.0), (point.y, 120.0)]
        .map(|(across, center)| (FOCAL_PX * across / point.z + center) as usize);
    y * SIZE_PX[0] as usize + x
}

/// Number of masked pixels of color.
pub(super) fn n_masked(keyframe: &Keyframe) -> usize {
    let (rgba, _) = keyframe.rgba_srgb.as_chunks::<4>();
    rgba.iter().filter(|pixel| pixel[3] == 0).count()
}

#[test]
fn masked_pixels_reach_the_keyframe() {
    let rig = rig(&[]);
    let notes = crate::notes::Notes::default();
    let mut join = Join::new(&rig).expect("a good rig").with_notes(notes);
    let keyframes = keyframes(&mut join, samples(0.0));
    let keyframe = keyframes.first().expect("a keyframe");
    let chain = Chain::from_urdf(&rig.arm.urdf_text, "panda_link0", "panda_link8").expect("an arm");
    let base_from_flange = chain.forward(&JOINTS_RAD).expect("seven joints");
    let inside = base_from_flange * Point3::new(0.0, 0.0, -0.03);
    let ix = pixel_ix(inside, &keyframe.world_from_camera);
    assert_eq!(keyframe.rgba_srgb[4 * ix + 3], 0, "the flange is masked");
    let depth = keyframe.depth.as_ref().expect("depth");
    assert_eq!(depth.depth_m[ix], 0.0, "its depth is masked");
    assert_eq!(keyframe.rgba_srgb[3], 255, "the corner shows the scene");
    assert!((depth.depth_m[0] - 1.0).abs() < 1e-6);
    // The front of the base, which no moving link hides.
    let base = pixel_ix(Point3::new(0.05, 0.0, 0.03), &keyframe.world_from_camera);
    assert_eq!(
        keyframe.rgba_srgb[4 * base + 3],
        255,
        "the base does not move"
    );
    let note = join.counts().to_string();
    assert!(
        note.contains("camera \"wrist\": the robot covers ") && note.ends_with(" and is masked"),
        "{note}"
    );
}

#[test]
fn the_mask_grows_with_the_speed_and_the_margin() {
    let count = |speed_rad_s: f64, changes: &[Override]| {
        let mut join = Join::new(&rig(changes)).expect("a good rig");
        n_masked(
            keyframes(&mut join, samples(speed_rad_s))
                .first()
                .expect("a keyframe"),
        )
    };
    let at_rest = count(0.0, &[]);
    assert!((500..60_000).contains(&at_rest), "{at_rest}");
    assert!(count(1.0, &[]) > at_rest + 50);
    let wide = [Override::new("camera.wrist.mask_margin_m", 0.05)];
    assert!(count(0.0, &wide) > at_rest + 500);
    let off = [Override::new("camera.wrist.mask_robot", false)];
    assert_eq!(count(0.0, &off), 0);
    // By default, cameras on the flange are not masked.
    let on_flange = Override::new("camera.wrist.parent", "flange");
    assert_eq!(count(0.0, &[on_flange]), 0);
}

#[test]
fn corrected_masks_are_those_of_a_rig_with_the_right_pose() {
    let right = rig(&[]);
    // 3 degrees and 30 mm, which is beyond the margin.
    let right_from_wrong = Transform::from_parts(
        Vector3::new(0.03, 0.0, 0.0).into(),
        UnitQuaternion::from_euler_angles(0.0, 0.052, 0.0),
    );
    let mut wrong = right.clone();
    wrong.cameras[0].parent_from_camera = right.cameras[0].parent_from_camera * right_from_wrong;
    let first = |rig: &Rig| {
        let mut join = Join::new(rig).expect("a good rig");
        keyframes(&mut join, samples(0.5)).remove(0)
    };
    let [expected, uncorrected] = [first(&right), first(&wrong)];
    let correction = calibration::CameraCorrection {
        rotation_rad: right_from_wrong.rotation.scaled_axis().into(),
        translation_m: right_from_wrong.translation.vector.into(),
        ..calibration::CameraCorrection::default()
    };
    let corrected = correction.corrected(&uncorrected);
    let n_different = |keyframe: &Keyframe| {
        let color = expected.rgba_srgb.iter().zip(&*keyframe.rgba_srgb);
        let [of_expected, of_keyframe] = [&expected, keyframe].map(|keyframe| {
            let depth = keyframe.depth.as_ref().expect("depth");
            depth.depth_m.clone()
        });
        let depth = of_expected.iter().zip(&*of_keyframe);
        color.filter(|(one, other)| one != other).count()
            + depth.filter(|(one, other)| one != other).count()
    };
    assert!(n_different(&uncorrected) > 2000);
    // Rounding may change a cell at the edge.
    assert!(n_different(&corrected) < 20, "{}", n_different(&corrected));
}

#[test]
fn images_wait_for_the_state_of_a_robot_that_is_masked() {
    let images = || {
        samples(0.0)
            .into_iter()
            .filter(|sample| matches!(sample, Sample::Image(_)))
            .collect::<Vec<_>>()
    };
    let mut join = Join::new(&rig(&[])).expect("a good rig");
    assert!(keyframes(&mut join, images()).is_empty());
    let off = Override::new("camera.wrist.mask_robot", false);
    let mut unmasked = Join::new(&rig(&[off])).expect("a good rig");
    assert!(!keyframes(&mut unmasked, images()).is_empty());
}

#[test]
fn unknown_shapes_are_named() {
    let mut rig = rig(&[]);
    let described = RobotMasks::new(&rig).expect("a good rig");
    assert_eq!(described.expect("a fixed camera").warning(), None);
    rig.arm.urdf_text = rig.arm.urdf_text.replacen(
        "</robot>",
        r#"<link name="tool"><visual><geometry><mesh filename="tool.dae"/></geometry></visual></link>
           <joint name="mount" type="fixed"><parent link="panda_link8"/><child link="tool"/></joint></robot>"#,
        1,
    );
    let masks = RobotMasks::new(&rig)
        .expect("a good rig")
        .expect("a fixed camera");
    let warning = masks.warning().expect("a missing mesh");
    assert!(
        warning.contains("camera \"wrist\"")
            && warning.contains("1 link")
            && warning.contains("tool.dae"),
        "{warning}"
    );
    assert!(masks.masks("wrist"), "the other links are masked");
}

/// The points of the pieces of a robot at all of their poses, in the frame of a camera.
fn pieces_in_camera(
    shape: &RobotShape,
    extent: Extent,
    instants: &[(Vec<f64>, Transform)],
) -> Vec<ConvexPiece> {
    let mut swept = Vec::new();
    for sweep in shape.sweeps_in_camera(extent, instants) {
        for piece in &shape.pieces()[sweep.link_ix] {
            let poses = sweep.camera_from_link.iter();
            let points = poses.flat_map(|pose| piece.iter().map(move |point| pose * point));
            swept.push(points.collect());
        }
    }
    swept
}

#[test]
fn joints_that_are_not_measured_may_be_anywhere() {
    // A finger of 2 cm that moves by 20 cm.
    let urdf = r#"<robot name="jaw"><link name="base"/><link name="finger">
        <visual><geometry><box size="0.02 0.02 0.02"/></geometry></visual></link>
        <joint name="slide" type="prismatic"><parent link="base"/><child link="finger"/>
        <axis xyz="1 0 0"/><limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint></robot>"#;
    let robot = Robot::parse(urdf).expect("a robot");
    let widths = |joints: &[String]| {
        let extent = Extent::MovingLinks;
        let shape = RobotShape::new(&robot, "base", joints, extent, &UrdfFolder::default())
            .expect("a robot");
        let camera_from_base = Transform::translation(0.0, 0.0, 1.0);
        let instants = [(vec![0.05], camera_from_base)];
        let pieces = pieces_in_camera(&shape, extent, &instants);
        let xs: Vec<f64> = pieces.iter().flatten().map(|point| point.x).collect();
        [
            xs.iter().copied().fold(f64::INFINITY, f64::min),
            xs.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        ]
    };
    let close = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 1e-9;
    let measured = widths(&["slide".to_owned()]);
    assert!(close(measured, [0.04, 0.06]), "{measured:?}");
    assert!(close(widths(&[]), [-0.11, 0.11]));
}

#[test]
fn links_behind_several_joints_that_are_not_measured_are_unknown() {
    let mut rig = rig(&[]);
    let joint = |name: &str, parent: &str, child: &str| {
        format!(
            r#"<link name="{child}"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>
            <joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
            <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"#
        )
    };
    let other_arm = [
        joint("one", "panda_link0", "upper"),
        joint("two", "upper", "lower"),
    ]
    .concat();
    rig.arm.urdf_text = rig
        .arm
        .urdf_text
        .replacen("</robot>", &format!("{other_arm}</robot>"), 1);
    let masks = RobotMasks::new(&rig)
        .expect("a good rig")
        .expect("a fixed camera");
    let warning = masks.warning().expect("an arm without readings");
    assert!(
        warning.contains("1 link ") && warning.contains("\"one\", \"two\" are not measured"),
        "{warning}"
    );
}

#[test]
fn cameras_on_a_base_without_moving_links_are_not_masked() {
    let rig = Rig::load(&bundled("mobile-base.toml"), &[]).expect("a bundled rig file");
    assert!(RobotMasks::new(&rig).expect("a good rig").is_none());
    let in_room = [Override::new("camera.front.parent", "world")];
    let rig = Rig::load(&bundled("mobile-base.toml"), &in_room).expect("a good rig");
    let masks = RobotMasks::new(&rig)
        .expect("a good rig")
        .expect("the base moves");
    assert!(masks.masks("front") && !masks.masks("rear"));
}

/// Minimum share of the robot's pixels that must be masked.
#[cfg(feature = "sim")]
const MIN_RECALL: f64 = 0.99;
/// Maximum number of masked pixels beside the robot, relative to those of the robot: with the
/// default margin, and without one. The default margin is about 7 pixels at each edge of limbs that
/// are about 60 pixels wide.
#[cfg(feature = "sim")]
const MAX_EXCESS_FRAC: f64 = 0.6;
#[cfg(feature = "sim")]
const MAX_EXCESS_FRAC_WITHOUT_MARGIN: f64 = 0.25;

#[cfg(feature = "sim")]
#[test]
fn masks_cover_the_robot_that_the_simulator_draws() {
    let view = Pinhole {
        size_px: [640, 480],
        focal_px: [600.0; 2],
        principal_px: [320.0, 240.0],
    };
    let urdf = std::fs::read_to_string(bundled("robots/panda.urdf")).expect("a bundled file");
    let robot = Robot::parse(&urdf).expect("a robot");
    let joints: Vec<String> = (1..8).map(|ix| format!("panda_joint{ix}")).collect();
    // The simulator's segmentation contains the base.
    let extent = Extent::WholeRobot;
    let shape = RobotShape::new(
        &robot,
        "panda_link0",
        &joints,
        extent,
        &UrdfFolder::default(),
    )
    .expect("an arm");
    let mut simulator =
        sim::RobotMasks::open(sim::Scene::StaticArm, view.size_px).expect("a valid scene");
    let postures = [
        JOINTS_RAD,
        [0.3, -0.5, 0.2, -2.1, 0.4, 1.7, 0.6],
        [-1.2, 0.6, -0.8, -1.4, 1.5, 2.4, -2.0],
    ];
    for (eye, q) in [[1.6, 0.0, 0.8], [0.9, -1.3, 0.9], [-1.2, 0.8, 1.1]]
        .into_iter()
        .flat_map(|eye| postures.map(|q| (eye, q)))
    {
        let world_from_camera = world_from_camera(eye);
        let exact = simulator
            .mask(
                &sim::PinholeView {
                    size_px: view.size_px,
                    focal_px: view.focal_px,
                    principal_px: view.principal_px,
                    world_from_camera,
                },
                &Transform::identity(),
                &q,
                true,
            )
            .expect("seven joints");
        let compare = |uncertainty| {
            let mut silhouette = Silhouette::new(view, uncertainty);
            let instant = (q.to_vec(), world_from_camera.inverse());
            for piece in pieces_in_camera(&shape, extent, &[instant]) {
                silhouette.add(&piece);
            }
            let [width, height] = view.size_px;
            let pixels = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
            let both = pixels.zip(&exact);
            let mut n = [0.0_f64; 3];
            for ([x, y], is_robot) in both {
                let is_masked = silhouette.covers(x, y);
                n[0] += f64::from(u8::from(*is_robot));
                n[1] += f64::from(u8::from(*is_robot && is_masked));
                n[2] += f64::from(u8::from(!is_robot && is_masked));
            }
            let [n_robot, n_found, n_excess] = n;
            assert!(n_robot > 3000.0, "the robot is in view: {n_robot}");
            [n_found / n_robot, n_excess / n_robot]
        };
        let [recall, excess] = compare(Uncertainty {
            rotation_rad: ROTATION_RAD,
            position_m: 0.01,
        });
        let [exact_recall, exact_excess] = compare(Uncertainty {
            rotation_rad: 0.0,
            position_m: 0.0,
        });
        eprintln!(
            "{eye:?}: recall {recall:.4}, excess {excess:.3}; without margin {exact_recall:.4}, {exact_excess:.3}"
        );
        assert!(
            recall >= MIN_RECALL && excess < MAX_EXCESS_FRAC,
            "{eye:?}, {q:?}: recall {recall}, excess {excess}"
        );
        assert!(
            exact_recall >= MIN_RECALL && exact_excess < MAX_EXCESS_FRAC_WITHOUT_MARGIN,
            "{eye:?}, {q:?}: recall {exact_recall}, excess {exact_excess} without a margin"
        );
    }
}

/// Prints the time of a mask: `cargo test -p capture --release -- --ignored --nocapture time_of`.
#[test]
#[ignore = "prints a measurement"]
fn time_of_a_mask() {
    let rig = rig(&[]);
    let masks = RobotMasks::new(&rig)
        .expect("a good rig")
        .expect("a fixed camera");
    let mut join = Join::new(&rig).expect("a good rig");
    let keyframe = keyframes(&mut join, samples(0.0)).remove(0);
    let robot = RobotAt {
        joints: JointState {
            stamp: Stamp(0),
            position: JOINTS_RAD.to_vec(),
            velocity: vec![0.1; 7],
            effort: Vec::new(),
        },
        world_from_base: Transform::identity(),
        base_twist: Twist::zero(),
    };
    let began = std::time::Instant::now();
    for _ in 0..100 {
        masks
            .apply(&mut (*keyframe).clone(), &robot, 0.0)
            .expect("masked");
    }
    eprintln!("{:.2} ms", began.elapsed().as_secs_f64() * 10.0);
}
