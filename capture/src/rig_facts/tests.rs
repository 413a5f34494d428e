use super::*;
use crate::config::{Override, Parent};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use std::path::Path;

fn rigs() -> Vec<(String, Rig)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
    let mut rigs: Vec<_> = std::fs::read_dir(folder)
        .expect("the folder rigs")
        .map(|entry| entry.expect("a file").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "toml"))
        .map(|path| {
            let rig = Rig::load(&path, &[]).expect("a bundled rig file");
            (path.display().to_string(), rig)
        })
        .collect();
    rigs.sort_by(|one, other| one.0.cmp(&other.0));
    rigs
}

fn bundled(name: &str, overrides: &[Override]) -> Rig {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../rigs")
        .join(name);
    Rig::load(&path, overrides).expect("a bundled rig file")
}

fn texts(rig: &Rig) -> Vec<String> {
    let facts = RigFacts::of(rig).expect("a checked rig");
    let all = sentences(&facts).into_iter();
    all.map(|sentence| sentence.text).collect()
}

fn mistakes(rig: &Rig) -> Vec<Sentence> {
    let facts = RigFacts::of(rig).expect("a checked rig");
    let all = sentences(&facts).into_iter();
    all.filter(|sentence| sentence.remedy.is_some()).collect()
}

#[test]
fn bundled_rigs_are_described_without_mistakes() {
    let rigs = rigs();
    assert!(rigs.len() >= 5, "{} rigs", rigs.len());
    for (name, rig) in rigs {
        assert_eq!(mistakes(&rig), [], "{name}");
        let texts = texts(&rig);
        for camera in &rig.cameras {
            let about = |words: &str| {
                texts.iter().any(|text| {
                    text.contains(&format!("{:?}", camera.name)) && text.contains(words)
                })
            };
            assert!(
                about("field of view") && about("looks"),
                "{name}: {texts:?}"
            );
        }
    }
}

#[test]
fn numbers_of_a_known_arm_are_right() {
    let rig = bundled("static-arm.toml", &[]);
    let facts = RigFacts::of(&rig).expect("a checked rig");
    let arm = facts.arm.as_ref().expect("it has an arm");
    assert_eq!(arm.n_joints, 7);
    // The first joint of a Panda is at a height of 0.333 m. From its shoulder at the same place, the
    // flange is 0.316 + 0.384 m up the straight arm and 0.088 m to the side, and 0.107 m below. The
    // farthest posture is a little longer, because the elbow is offset.
    assert!((arm.first_joint_in_base - Point3::new(0.0, 0.0, 0.333)).norm() < 1e-9);
    assert!((0.80..0.90).contains(&arm.reach_m), "{}", arm.reach_m);
    let within = arm
        .reached_in_base
        .iter()
        .all(|point| (point - arm.first_joint_in_base).norm() <= arm.reach_m + 1e-9);
    assert!(within, "no sample is beyond the reach");
    let camera = &facts.cameras[0];
    let view = camera.field_of_view.expect("a pinhole");
    let [width, _] = camera.size_px.map(f64::from);
    let focal_px = rig.cameras[0].intrinsics.focal_px[0];
    let expected = 2.0 * (0.5 * width / focal_px).atan();
    // The principal point is a few pixels off the center.
    assert!((view.horizontal_rad - expected).abs() < 1e-3);
    let texts = texts(&rig);
    let has = |words: &str| texts.iter().any(|text| text.contains(words));
    // (0.06, 0, 0.045) m is 75 mm from the flange.
    assert!(
        has("75 mm from the origin of this frame (60 mm along x, 45 mm along z)"),
        "{texts:?}"
    );
    assert!(
        has("moves with the flange") && has("away from the arm"),
        "{texts:?}"
    );
}

#[test]
fn cameras_of_a_base_look_forward_and_back() {
    let texts = texts(&bundled("mobile-base-small.toml", &[]));
    let has = |words: &str| texts.iter().any(|text| text.contains(words));
    assert!(has("No joint moves the flange"), "{texts:?}");
    assert!(
        has("460 mm forward, 60 mm up), and looks forward."),
        "{texts:?}"
    );
    assert!(has("420 mm back, 50 mm up), and looks back."), "{texts:?}");
    assert!(has("Range scanner \"lidar\""), "{texts:?}");
    assert!(has("moves in the world"), "{texts:?}");
}

#[test]
fn a_camera_that_looks_into_the_flange_is_reported() {
    let mut rig = bundled("static-arm.toml", &[]);
    assert_eq!(mistakes(&rig), []);
    // The usual mistake is the inverse pose.
    let turned = |angle_rad: f64| {
        Transform::from_parts(
            Vector3::new(0.08, 0.0, 0.05).into(),
            UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle_rad),
        )
    };
    // It looks along -x, at the arm below the flange.
    rig.cameras[0].parent_from_camera = turned(-2.2);
    let found = mistakes(&rig);
    assert!(
        found.len() == 1 && found[0].text.contains("looks into the flange"),
        "{found:?}"
    );
    let svg = svg(&RigFacts::of(&rig).expect("a checked rig"));
    assert!(svg.contains("#d00000"), "the camera is red");
    // The same camera that looks away from the arm.
    rig.cameras[0].parent_from_camera = turned(0.3);
    assert_eq!(mistakes(&rig), []);
    // A camera inside the flange that looks along the arm.
    rig.cameras[0].parent_from_camera = Transform::rotation(Vector3::x() * std::f64::consts::PI);
    assert_eq!(mistakes(&rig).len(), 1);
}

#[test]
fn fixed_cameras_say_what_they_see_of_the_workspace() {
    let mut rig = bundled("static-arm.toml", &[]);
    let camera = &mut rig.cameras[0];
    camera.parent = Parent::World;
    // 2 m in front of the robot and 1 m up, looking back at it and 20 degrees down.
    let looking = |back_rad: f64| {
        UnitQuaternion::from_euler_angles(0.0, 0.0, back_rad)
            * UnitQuaternion::from_euler_angles(
                -110.0_f64.to_radians(),
                0.0,
                -0.5 * std::f64::consts::PI,
            )
    };
    let at = Vector3::new(2.0, 0.0, 1.0);
    camera.parent_from_camera = Transform::from_parts(at.into(), looking(std::f64::consts::PI));
    let facts = RigFacts::of(&rig).expect("a checked rig");
    let camera = &facts.cameras[0];
    let axis = camera.axis_in_parent().expect("a known pose");
    assert!(axis.x < -0.9 && axis.z < -0.3, "{axis}");
    let ground_m = camera.ground_at_m.expect("it looks down");
    assert!(
        (ground_m - 1.0 / 20.0_f64.to_radians().sin()).abs() < 1e-6,
        "{ground_m}"
    );
    assert!(camera.seen_reach_frac.is_some_and(|frac| frac > 0.5));
    assert!(camera.looks_into_flange_at_m.is_none());
    let texts = texts(&rig);
    assert!(
        texts
            .iter()
            .any(|text| text.contains("does not move in the world")
                && text.contains("looks back, 20 degrees down.")),
        "{texts:?}"
    );
    rig.cameras[0].parent_from_camera = Transform::from_parts(at.into(), looking(0.0));
    let away = RigFacts::of(&rig).expect("a checked rig");
    assert_eq!(away.cameras[0].seen_reach_frac, Some(0.0));
}

#[test]
fn unknown_calibration_is_said() {
    let mut rig = bundled(
        "static-arm.toml",
        &[Override::new("camera.wrist.driver", "v4l2")],
    );
    rig.cameras[0].unknown.intrinsics = true;
    rig.cameras[0].unknown.parent_from_camera = true;
    let texts = texts(&rig);
    let has = |words: &str| texts.iter().any(|text| text.contains(words));
    assert!(
        has("its pose is unknown") && has("an unknown field of view"),
        "{texts:?}"
    );
    let facts = RigFacts::of(&rig).expect("a checked rig");
    assert!(
        !svg(&facts).contains(">wrist<"),
        "it has no place in the picture"
    );
}

#[test]
fn pictures_show_both_views_to_the_same_scale() {
    for (name, rig) in rigs() {
        let facts = RigFacts::of(&rig).expect("a checked rig");
        let picture = svg(&facts);
        assert_eq!(
            picture,
            svg(&facts),
            "{name}: the picture is always the same"
        );
        for words in ["side view", "top view", ">base<", "</svg>"] {
            assert!(picture.contains(words), "{name}: {words}");
        }
        for camera in &facts.cameras {
            let label = format!(">{}<", camera.name);
            assert_eq!(
                picture.matches(&label).count(),
                2,
                "{name}: one label per view"
            );
        }
        assert!(
            !picture.contains("NaN") && !picture.contains("inf\""),
            "{name}"
        );
        let n_open = picture.matches("<text").count();
        assert_eq!(n_open, picture.matches("</text>").count(), "{name}");
    }
}

#[test]
fn names_are_escaped_in_the_picture() {
    let mut rig = bundled("static-arm.toml", &[]);
    rig.cameras[0].name = "a<b&c".into();
    let facts = RigFacts::of(&rig).expect("a checked rig");
    assert!(svg(&facts).contains("a&lt;b&amp;c"));
}
