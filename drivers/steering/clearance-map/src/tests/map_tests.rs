//! The map with its thread, a robot from a URDF, and moving bases.

use super::scene::{STEREO, Solid, at, config, looking, photograph, random_point};
use crate::{ClearanceMap, DepthImage, MapConfig, Posture, reach_m};
use kinematics::urdf::Robot;
use kinematics::{Chain, Stamp, Transform};
use nalgebra::Vector3;
use numbers::random::Random;
use std::sync::Arc;
use std::time::{Duration, Instant};
use steering::{Body, Clearance, Seen};

const SLIDE: &str = r#"<robot name="slide">
    <link name="base"/>
    <joint name="x" type="prismatic"><parent link="base"/><child link="post"/>
        <origin xyz="0 0 0.2"/><axis xyz="1 0 0"/>
        <limit lower="-0.4" upper="0.5" velocity="1" effort="1"/></joint>
    <link name="post"><collision><geometry><sphere radius="0.08"/></geometry></collision></link>
</robot>"#;

fn slide() -> (Body, Chain) {
    let robot = Robot::parse(SLIDE).unwrap();
    let chain = Chain::new(&robot, "base", "post").unwrap();
    (Body::new(&robot, &chain, &|_| None).unwrap(), chain)
}

pub(crate) fn started() -> ClearanceMap {
    ClearanceMap::start(&config(), slide().0).unwrap()
}

pub(crate) fn posture(x: f64, stamp: Stamp, world_from_base: Transform) -> Posture {
    Posture {
        stamp,
        position: vec![x],
        world_from_base,
    }
}

/// An image of a table, from above, in the frame of the base.
fn image(secs: f64, world_from_base: Transform, random: &mut Random) -> DepthImage {
    let base_from_camera = looking([0.1, 0.0, 1.2], [0.0, 0.0, 0.0]);
    let mut image = photograph(
        &[Solid::Below(0.0)],
        base_from_camera,
        at(secs),
        &STEREO,
        random,
    );
    image.world_from_camera = world_from_base * base_from_camera;
    image.posture = posture(0.4, at(secs), world_from_base);
    image
}

/// Waits until the thread has done its work. The limit only ends a test that would hang.
pub(crate) fn wait_until(map: &ClearanceMap, is_done: impl Fn() -> bool) {
    const LIMIT: Duration = Duration::from_secs(120);
    let started = Instant::now();
    while !is_done() {
        assert!(started.elapsed() < LIMIT, "{:?}", map.state());
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn wait_for(map: &ClearanceMap, is_done: impl Fn(crate::MapState) -> bool) {
    wait_until(map, || is_done(map.state()));
}

fn one(map: &ClearanceMap, point: [f64; 3], now: Stamp) -> Option<Seen> {
    map.readings(&[point], now)[0]
}

#[test]
fn images_of_the_thread_reach_the_answers() {
    let mut random = Random::new(41);
    let map = started();
    let point = [0.0, 0.0, 0.2];
    assert_eq!(one(&map, point, at(0.0)), None);
    map.push(image(0.0, Transform::identity(), &mut random))
        .unwrap();
    wait_for(&map, |state| state.n_integrated == 1);
    let seen = one(&map, point, at(3.0)).unwrap();
    assert!(seen.distance_m > 0.1 && seen.distance_m <= 0.2, "{seen:?}");
    assert!(seen.age_secs >= 3.0);
    assert_eq!(map.state().newest, Some(at(0.0)));
    map.forget();
    wait_until(&map, || one(&map, point, at(3.0)).is_none());
    // The robot is free, wherever it is.
    map.set_posture(&posture(-0.1, at(3.0), Transform::identity()))
        .unwrap();
    assert!(one(&map, [-0.1, 0.0, 0.2], at(3.0)).is_some());
    map.sweep(posture(0.3, at(4.0), Transform::identity()), 0.05)
        .unwrap();
    wait_until(&map, || one(&map, [0.3, 0.1, 0.2], at(4.0)).is_some());
}

#[test]
fn invalid_input_is_refused_by_name() {
    let mut random = Random::new(42);
    let map = started();
    let valid = image(0.0, Transform::identity(), &mut random);
    let nowhere = Transform::translation(f64::NAN, 0.0, 0.0);
    type Spoil = fn(&mut DepthImage, Transform);
    let spoiled: [(&str, Spoil); 6] = [
        ("76800", |image, _| image.depth_m = Arc::from([1.0; 3])),
        ("focal", |image, _| image.focal_px[1] = 0.0),
        ("principal", |image, _| image.principal_px[0] = f64::NAN),
        ("pose of camera", |image, nowhere| {
            image.world_from_camera = nowhere
        }),
        ("1", |image, _| image.posture.position.clear()),
        ("joint position", |image, _| {
            image.posture.position[0] = f64::INFINITY
        }),
    ];
    for (name, spoil) in spoiled {
        let mut image = valid.clone();
        spoil(&mut image, nowhere);
        let error = map.push(image).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
    }
    let error = map
        .set_posture(&posture(0.0, at(0.0), nowhere))
        .unwrap_err();
    assert!(error.to_string().contains("base"), "{error}");
    let error = map
        .sweep(posture(0.0, at(0.0), Transform::identity()), f64::NAN)
        .unwrap_err();
    assert!(error.to_string().contains("margin"), "{error}");
    assert_eq!(map.state().n_integrated, 0);
    type SpoilConfig = fn(&mut MapConfig);
    let spoiled: [(&str, SpoilConfig); 6] = [
        ("voxel_m", |config| config.voxel_m = 0.0),
        ("max_distance_m", |config| config.max_distance_m = 1.0),
        ("radius_m", |config| config.radius_m = 30.0),
        ("min_depth_m", |config| config.min_depth_m = f64::NAN),
        ("max_depth_m", |config| config.max_depth_m = 0.0),
        ("robot_margin_m", |config| config.robot_margin_m = -1.0),
    ];
    for (name, spoil) in spoiled {
        let mut config = config();
        spoil(&mut config);
        let error = ClearanceMap::start(&config, slide().0).unwrap_err();
        assert!(error.to_string().contains(name), "{error}");
    }
}

#[test]
fn answers_come_while_images_are_integrated() {
    let mut random = Random::new(43);
    let map = Arc::new(started());
    let images: Vec<DepthImage> = (0..5)
        .map(|ix| image(f64::from(ix), Transform::identity(), &mut random))
        .collect();
    let points: Vec<[f64; 3]> = (0..300)
        .map(|_| random_point(&mut random, 0.8).into())
        .collect();
    std::thread::scope(|scope| {
        let reader = Arc::clone(&map);
        let answers = scope.spawn(move || {
            let mut n_answers = 0;
            for ix in 0..500 {
                let x = f64::from(ix) * 1e-3;
                reader
                    .set_posture(&posture(x, at(5.0), Transform::identity()))
                    .unwrap();
                let readings = reader.readings(&points, at(5.0));
                assert_eq!(readings.len(), points.len());
                for (point, seen) in points.iter().zip(readings) {
                    let Some(seen) = seen else { continue };
                    n_answers += 1;
                    let truth_m = point[2];
                    let in_robot_m =
                        0.08 - (Vector3::from(*point) - Vector3::new(x, 0.0, 0.2)).norm();
                    assert!(
                        seen.distance_m <= truth_m.max(in_robot_m) + 1e-4,
                        "{point:?} {seen:?}"
                    );
                }
            }
            n_answers
        });
        for round in 0..20 {
            for image in &images {
                let mut image = image.clone();
                image.camera = format!("camera {}", round % 3).into();
                map.push(image).unwrap();
            }
        }
        assert!(answers.join().unwrap() > 0);
    });
    wait_for(&map, |state| {
        state.n_integrated + state.n_replaced + state.n_unused == 100
    });
}

/// Invariant: voxels are bounded by the region, however far the base travels.
#[test]
fn map_follows_a_moving_base_with_bounded_memory() {
    let mut random = Random::new(44);
    let mut tested = super::scene::Tested::new(&config());
    let (body, _) = slide();
    let mut max_bytes = 0;
    for step in 0..60 {
        let x = 0.5 * f64::from(step);
        let world_from_base =
            Transform::new(Vector3::new(x, -0.3 * x, 0.0), Vector3::z() * (0.1 * x));
        let image = image(f64::from(step), world_from_base, &mut random);
        let capsules = body.capsules(&image.posture.position);
        tested.see_robot(&image, &capsules);
        max_bytes = max_bytes.max(tested.map.bytes());
        tested.query.set_robot(crate::query::Robot {
            stamp: image.stamp,
            capsules,
            world_from_base,
            heights_m: None,
        });
        // The table is below the base, wherever it is and however it is turned.
        let seen = tested.reading([0.0, 0.0, 0.2], image.stamp).unwrap();
        assert!(
            seen.distance_m > 0.1 && seen.distance_m <= 0.2 + 1e-4,
            "{step}: {seen:?}"
        );
    }
    let config = config();
    let n_voxels = (config.n_blocks() * 8).pow(3);
    assert!(max_bytes < 2 * n_voxels, "{max_bytes} {n_voxels}");
    // A part of the scene that was seen before a short motion is still known.
    let before = Transform::translation(100.0, 0.0, 0.0);
    tested.see_robot(&image(100.0, before, &mut random), &[]);
    let after = Transform::translation(100.3, 0.0, 0.0);
    let mut blind = image(101.0, after, &mut random);
    blind.depth_m = vec![0.0; blind.depth_m.len()].into();
    tested.see_robot(&blind, &[]);
    tested.query.set_robot(crate::query::Robot {
        stamp: at(101.0),
        capsules: Vec::new(),
        world_from_base: after,
        heights_m: None,
    });
    let seen = tested.reading([-0.3, 0.0, 0.2], at(101.0)).unwrap();
    assert!(seen.distance_m > 0.1 && seen.age_secs >= 1.0, "{seen:?}");
}

#[test]
fn reach_is_found_over_all_joints() {
    let (body, chain) = slide();
    let expected_m = 0.5_f64.hypot(0.2) + 0.08;
    assert!((reach_m(&body, &chain) - expected_m).abs() < 1e-9);
    let panda = Robot::parse(include_str!("../../../../../rigs/robots/panda.urdf")).unwrap();
    let chain = Chain::new(&panda, "panda_link0", "panda_link8").unwrap();
    let body = Body::new(&panda, &chain, &|_| None).unwrap();
    let reach_m = reach_m(&body, &chain);
    // Flange 0.855 m from the shoulder, which is 0.333 m above the base; hand and its capsules.
    assert!((0.9..1.6).contains(&reach_m), "{reach_m}");
    MapConfig::for_reach(reach_m).check().unwrap();
}
