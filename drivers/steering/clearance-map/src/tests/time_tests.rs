//! Ages, and scenes that change.

use super::scene::{PERFECT, STEREO, Solid, Tested, at, config, looking, photograph, random_point};
use crate::image::DepthOrigin;
use kinematics::Transform;
use numbers::random::Random;

fn pose() -> Transform {
    looking([1.2, 0.0, 0.6], [0.0, 0.0, 0.1])
}

fn table() -> Solid {
    Solid::Below(0.0)
}

fn ball(x: f64) -> Solid {
    Solid::Sphere {
        center: [x, 0.0, 0.15],
        radius_m: 0.1,
    }
}

const ABOVE: [f64; 3] = [0.1, 0.0, 0.25];

#[test]
fn ages_grow_until_the_region_is_seen_again() {
    let mut random = Random::new(11);
    let mut tested = Tested::new(&config());
    tested.see(&photograph(
        &[table()],
        pose(),
        at(0.0),
        &STEREO,
        &mut random,
    ));
    let age_secs = |tested: &mut Tested, now: f64| tested.reading(ABOVE, at(now)).unwrap().age_secs;
    for now in [0.0, 1.0, 60.0, 1e5] {
        let age_secs = age_secs(&mut tested, now);
        // Times are in whole milliseconds, and ages are never too small.
        assert!(
            age_secs >= now && age_secs < now + 0.002,
            "{age_secs} {now}"
        );
    }
    let elsewhere = looking([1.2, 0.0, 0.6], [2.0, 0.0, 0.6]);
    tested.see(&photograph(
        &[table()],
        elsewhere,
        at(5.0),
        &STEREO,
        &mut random,
    ));
    assert!(age_secs(&mut tested, 6.0) >= 6.0, "another region was seen");
    tested.see(&photograph(
        &[table()],
        pose(),
        at(8.0),
        &STEREO,
        &mut random,
    ));
    let age_secs = age_secs(&mut tested, 9.0);
    assert!((1.0..1.01).contains(&age_secs), "{age_secs}");
    // A clock that lags behind the images has seen them just now.
    assert_eq!(tested.reading(ABOVE, at(-3.0)).unwrap().age_secs, 0.0);
}

#[test]
fn age_is_that_of_the_oldest_part_within_the_distance() {
    let mut random = Random::new(12);
    let mut tested = Tested::new(&config());
    tested.see(&photograph(
        &[table()],
        pose(),
        at(0.0),
        &PERFECT,
        &mut random,
    ));
    // The second image shows only the half with y < 0.
    let mut image = photograph(&[table()], pose(), at(10.0), &PERFECT, &mut random);
    let mut depth_m = image.depth_m.to_vec();
    let is_left = |column: usize| column < 160;
    let left = depth_m
        .iter()
        .enumerate()
        .map(|(ix, z)| if is_left(ix % 320) { 0.0 } else { *z });
    depth_m = left.collect();
    image.depth_m = depth_m.into();
    tested.see(&image);
    let age_secs = |tested: &mut Tested, y: f64| {
        let seen = tested.reading([0.0, y, 0.2], at(10.0)).unwrap();
        assert!(seen.distance_m > 0.1, "{seen:?}");
        seen.age_secs
    };
    let ages = [-0.35, 0.0, 0.35].map(|y| age_secs(&mut tested, y));
    let (newest, oldest) = (ages[0].min(ages[2]), ages[0].max(ages[2]));
    assert!(
        newest < 0.01 && oldest >= 10.0 && ages[1] >= 10.0,
        "{ages:?}"
    );
}

#[test]
fn objects_that_move_are_removed_and_added() {
    let mut random = Random::new(13);
    let mut tested = Tested::new(&config());
    let mut secs = 0.0;
    let mut see = |tested: &mut Tested, solids: &[Solid]| {
        for _ in 0..2 {
            secs += 0.1;
            tested.see(&photograph(solids, pose(), at(secs), &STEREO, &mut random));
        }
    };
    let in_ball = [0.1, 0.0, 0.15];
    see(&mut tested, &[table()]);
    let free_m = tested.distance(in_ball).unwrap();
    // The ball appears: its surface is occupied, and its inside is not known any more.
    see(&mut tested, &[table(), ball(0.1)]);
    assert_eq!(tested.distance(in_ball), None);
    assert_eq!(
        tested.distance([0.19, 0.0, 0.16]),
        None,
        "just under the surface"
    );
    let beside_m = tested.distance([0.1, 0.3, 0.15]).unwrap();
    assert!(beside_m <= 0.2 + 1e-5, "{beside_m}");
    // It moves away.
    see(&mut tested, &[table(), ball(-0.4)]);
    let again_m = tested.distance(in_ball).unwrap();
    assert!((again_m - free_m).abs() < 0.045, "{again_m} {free_m}");
    see(&mut tested, &[table()]);
    assert!(tested.distance([-0.4, 0.0, 0.2]).is_some());
}

#[test]
fn images_that_arrive_late_change_nothing_newer() {
    let mut random = Random::new(14);
    let mut tested = Tested::new(&config());
    let scene = [table(), ball(0.1)];
    tested.see(&photograph(&scene, pose(), at(5.0), &STEREO, &mut random));
    tested.see(&photograph(
        &[table()],
        pose(),
        at(1.0),
        &STEREO,
        &mut random,
    ));
    assert_eq!(
        tested.distance([0.19, 0.0, 0.16]),
        None,
        "the ball came later"
    );
    // An image from long before the first one is not used at all.
    let image = photograph(&[table()], pose(), at(-500.0), &STEREO, &mut random);
    assert!(!tested.map.integrate(&image, &[]));
}

#[test]
fn rendered_depth_keeps_a_larger_margin_and_clears_nothing_measured() {
    let mut random = Random::new(15);
    let rendered = |solids: &[Solid], secs: f64, random: &mut Random| {
        let mut image = photograph(solids, pose(), at(secs), &STEREO, random);
        image.origin = DepthOrigin::Rendered;
        image
    };
    let mut measured = Tested::new(&config());
    measured.see(&photograph(
        &[table()],
        pose(),
        at(0.0),
        &STEREO,
        &mut random,
    ));
    let mut drawn = Tested::new(&config());
    drawn.see(&rendered(&[table()], 0.0, &mut random));
    let mut mean_m = 0.0;
    for _ in 0..1000 {
        let mut point = random_point(&mut random, 0.3);
        point.z = 0.15;
        let distance_m = |tested: &mut Tested| tested.distance(point.into()).unwrap_or(0.0);
        mean_m += (distance_m(&mut measured) - distance_m(&mut drawn)) / 1000.0;
    }
    assert!(mean_m > 0.01, "{mean_m}");
    // A model that has not learned a new object does not remove it.
    measured.see(&photograph(
        &[table(), ball(0.1)],
        pose(),
        at(1.0),
        &STEREO,
        &mut random,
    ));
    measured.see(&rendered(&[table()], 2.0, &mut random));
    assert_eq!(measured.distance([0.19, 0.0, 0.16]), None);
    measured.see(&photograph(
        &[table()],
        pose(),
        at(3.0),
        &STEREO,
        &mut random,
    ));
    assert!(measured.distance([0.19, 0.0, 0.2]).is_some());
}

#[test]
fn a_sheet_between_two_cameras_does_not_flicker() {
    let mut random = Random::new(16);
    let sheet = Solid::Cuboid {
        center: [0.0, 0.0, 0.1],
        size_m: [2.0, 2.0, 0.003],
    };
    let mut tested = Tested::new(&config());
    let poses = [[0.2, 0.0, 1.1], [0.2, 0.0, -0.9]].map(|from| looking(from, [0.0, 0.0, 0.1]));
    for round in 0..10 {
        for (ix, pose) in poses.iter().enumerate() {
            let stamp = at(f64::from(round) + 0.5 * ix as f64);
            tested.see(&photograph(&[sheet], *pose, stamp, &STEREO, &mut random));
            let is_known = [0.22, -0.02].map(|z| tested.distance([0.0, 0.0, z]).is_some());
            // The other side is not seen before the second image.
            assert!(
                round == 0 && ix == 0 || is_known == [true; 2],
                "{round} {ix} {is_known:?}"
            );
            for z in [0.0985, 0.1, 0.1015] {
                assert_eq!(tested.distance([0.0, 0.0, z]), None, "{round} {ix}");
            }
        }
    }
}
