//! Distances are never larger than the truth, and not much smaller where cameras looked.

use super::scene::{
    Flaws, PERFECT, STEREO, Solid, Tested, at, config, distance_m, looking, photograph,
    random_point,
};
use crate::config::MapConfig;
use kinematics::Transform;
use nalgebra::Vector3;
use numbers::random::Random;

/// Cameras around the region, which look at its middle from all sides.
fn around() -> Vec<Transform> {
    [
        [1.3, 0.0, 0.7],
        [-0.7, 1.1, 0.8],
        [-0.7, -1.1, 0.5],
        [0.1, 0.0, 1.6],
        [0.6, 0.6, 1.2],
    ]
    .map(|from| looking(from, [0.0, 0.0, 0.1]))
    .to_vec()
}

/// A map of a scene, from two images of each pose, because their noise differs.
fn seen_from(solids: &[Solid], poses: &[Transform], flaws: &Flaws, random: &mut Random) -> Tested {
    let mut tested = Tested::new(&config());
    for round in 0..2 {
        for (ix, pose) in poses.iter().enumerate() {
            let stamp = at(f64::from(round) + 0.1 * ix as f64);
            tested.see(&photograph(solids, *pose, stamp, flaws, random));
        }
    }
    tested
}

fn table() -> Vec<Solid> {
    vec![Solid::Below(0.0)]
}

fn corner() -> Vec<Solid> {
    vec![
        Solid::Below(-0.2),
        Solid::Cuboid {
            center: [0.0, -0.9, 0.0],
            size_m: [4.0, 0.8, 4.0],
        },
        Solid::Cuboid {
            center: [-0.9, 0.0, 0.0],
            size_m: [0.8, 4.0, 4.0],
        },
    ]
}

fn ball_on_table() -> Vec<Solid> {
    let ball = Solid::Sphere {
        center: [0.15, -0.1, 0.2],
        radius_m: 0.2,
    };
    vec![Solid::Below(0.0), ball]
}

/// A plate of 2 mm in the air, a rod of 6 mm and a wall that is seen at a grazing angle.
fn thin_things() -> Vec<Solid> {
    let plate = Solid::Cuboid {
        center: [0.2, 0.2, 0.3],
        size_m: [0.4, 0.3, 0.002],
    };
    let rod = Solid::Cuboid {
        center: [-0.2, -0.2, 0.3],
        size_m: [0.006, 0.006, 0.6],
    };
    let sheet = Solid::Cuboid {
        center: [0.3, -0.3, 0.15],
        size_m: [0.003, 0.3, 0.3],
    };
    vec![Solid::Below(-0.1), plate, rod, sheet]
}

#[test]
fn distances_are_never_larger_than_the_truth() {
    let mut random = Random::new(1);
    for (name, solids) in [
        ("table", table()),
        ("corner", corner()),
        ("ball", ball_on_table()),
        ("thin", thin_things()),
    ] {
        for flaws in [PERFECT, STEREO] {
            let mut tested = seen_from(&solids, &around(), &flaws, &mut random);
            let mut n_answers = 0;
            for _ in 0..20_000 {
                let point = random_point(&mut random, 0.9);
                let truth_m = distance_m(&solids, &point);
                let Some(answer_m) = tested.distance(point.into()) else {
                    continue;
                };
                n_answers += 1;
                // Positions are in f32 voxels.
                assert!(
                    answer_m <= truth_m + 1e-5,
                    "{name} {flaws:?}: {answer_m} instead of {truth_m} at {point}"
                );
            }
            assert!(n_answers > 3000, "{name} {flaws:?}: {n_answers}");
        }
    }
}

/// Invariant: no voxel is free in which there is a surface that was seen.
#[test]
fn random_scenes_have_no_free_voxel_with_a_surface() {
    let mut random = Random::new(2);
    for scene_ix in 0..10 {
        let mut solids = vec![Solid::Below(random.uniform(-0.3, 0.0))];
        for _ in 0..6 {
            let center = random_point(&mut random, 0.6).into();
            let size_m = [0; 3].map(|_| random.uniform(0.015, 0.3));
            solids.push(if random.unit() < 0.4 {
                let radius_m = random.uniform(0.02, 0.15);
                Solid::Sphere { center, radius_m }
            } else {
                Solid::Cuboid { center, size_m }
            });
        }
        let mut poses = Vec::new();
        while poses.len() < 4 {
            let from = random_point(&mut random, 1.5);
            if distance_m(&solids, &from) > 0.3 {
                let to = random_point(&mut random, 0.4);
                poses.push(looking(from.into(), to.into()));
            }
        }
        let mut tested = seen_from(&solids, &poses, &STEREO, &mut random);
        for _ in 0..20_000 {
            let point = random_point(&mut random, 0.9);
            if distance_m(&solids, &point) <= 0.0 {
                let answer = tested.distance(point.into());
                assert_eq!(answer, None, "scene {scene_ix} at {point}");
            }
        }
    }
}

/// The loss of distance: voxel, margin and footprint.
#[test]
fn distances_are_close_to_the_truth_where_cameras_looked() {
    /// Two voxels, the margin at a distance of 1.3 m, and the noise of the closest reading.
    const MAX_MEAN_LOSS_M: f64 = 0.07;
    let mut random = Random::new(3);
    for (name, solids) in [("table", table()), ("ball", ball_on_table())] {
        let mut tested = seen_from(&solids, &around(), &STEREO, &mut random);
        let (mut n, mut n_unanswered, mut sum_m) = (0, 0, 0.0);
        for _ in 0..20_000 {
            let mut point = random_point(&mut random, 0.4);
            point.z = point.z.abs();
            let truth_m = distance_m(&solids, &point);
            if !(0.08..0.25).contains(&truth_m) || distance_m(&solids[1..], &point) < 0.08 {
                continue;
            }
            n += 1;
            match tested.distance(point.into()) {
                Some(answer_m) => sum_m += truth_m - answer_m,
                None => n_unanswered += 1,
            }
        }
        let mean_m = sum_m / f64::from(n - n_unanswered);
        assert!(mean_m < MAX_MEAN_LOSS_M, "{name}: {mean_m}");
        let unanswered_frac = f64::from(n_unanswered) / f64::from(n);
        assert!(unanswered_frac < 0.1, "{name}: {unanswered_frac}");
    }
}

#[test]
fn answers_equal_a_search_over_all_voxels() {
    let mut random = Random::new(4);
    let config = config();
    let mut tested = seen_from(&thin_things(), &around()[..2], &STEREO, &mut random);
    let grid = tested.map.snapshot().grid;
    let snapshot = tested.map.snapshot();
    let side = grid.side();
    let mut blocked = Vec::new();
    for z in 0..side {
        for y in 0..side {
            for x in 0..side {
                if snapshot.blocked[grid.row(y, z) + x / 8] >> (x % 8) & 1 == 1 {
                    blocked.push(Vector3::new(x as f64, y as f64, z as f64));
                }
            }
        }
    }
    let mut n_answers = 0;
    for _ in 0..25 {
        let point = random_point(&mut random, 0.6);
        let in_grid = grid.in_voxels(&point);
        let to_voxel = |low: &Vector3<f64>| {
            let outside = (in_grid - low - Vector3::repeat(0.5)).abs() - Vector3::repeat(0.5);
            outside.sup(&Vector3::zeros()).norm()
        };
        let nearest = blocked.iter().map(to_voxel).fold(f64::INFINITY, f64::min);
        let expected_m = (nearest * config.voxel_m).min(config.max_distance_m);
        let answer_m = tested.distance(point.into()).unwrap_or(0.0);
        n_answers += i32::from(answer_m > 0.0);
        assert!(
            (answer_m - expected_m).abs() < 1e-5,
            "{point}: {answer_m} {expected_m}"
        );
    }
    assert!(n_answers > 5, "{n_answers}");
}

#[test]
fn what_was_not_seen_has_no_distance() {
    let mut random = Random::new(5);
    let wall = Solid::Cuboid {
        center: [0.0, 0.0, 0.0],
        size_m: [0.05, 4.0, 4.0],
    };
    let mut tested = Tested::new(&config());
    assert_eq!(
        tested.distance([0.3, 0.0, 0.0]),
        None,
        "before the first image"
    );
    let pose = looking([1.2, 0.0, 0.0], [0.0, 0.0, 0.0]);
    tested.see(&photograph(&[wall], pose, at(0.0), &STEREO, &mut random));
    assert!(tested.distance([0.3, 0.0, 0.0]).is_some());
    assert_eq!(tested.distance([-0.3, 0.0, 0.0]), None, "behind the wall");
    assert_eq!(tested.distance([0.0, 0.0, 0.0]), None, "inside the wall");
    assert_eq!(tested.distance([0.3, 0.8, 0.0]), None, "beside the image");
    assert_eq!(
        tested.distance([1.19, 0.0, 0.0]),
        None,
        "outside of the region"
    );
    for strange in [
        [f64::NAN, 0.0, 0.0],
        [0.0, f64::INFINITY, 0.0],
        [1e30, 0.0, 0.0],
        [-1e30; 3],
    ] {
        assert_eq!(tested.distance(strange), None, "{strange:?}");
    }
    // The end of the region is a limit, too. It is less than 0.2 m after the radius of 0.9 m.
    let near_border_m = tested.distance([0.85, 0.0, 0.0]);
    assert!(
        near_border_m.is_none_or(|distance_m| distance_m < 0.25),
        "{near_border_m:?}"
    );
}

#[test]
fn pixels_without_readings_show_nothing() {
    let mut random = Random::new(6);
    let pose = looking([1.0, 0.0, 0.5], [0.0, 0.0, 0.0]);
    for invalid in [0.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.05] {
        let mut image = photograph(&table(), pose, at(0.0), &STEREO, &mut random);
        image.depth_m = vec![invalid; image.depth_m.len()].into();
        let mut tested = Tested::new(&config());
        tested.see(&image);
        for _ in 0..500 {
            let point = random_point(&mut random, 0.9);
            assert_eq!(tested.distance(point.into()), None, "{invalid}");
        }
    }
    // With 60 % of the pixels missing, no voxel counts as seen.
    let sparse = Flaws {
        hole_frac: 0.6,
        ..PERFECT
    };
    let mut tested = Tested::new(&config());
    tested.see(&photograph(&table(), pose, at(0.0), &sparse, &mut random));
    assert_eq!(tested.distance([0.3, 0.0, 0.2]), None);
}

#[test]
fn voxels_of_other_sizes_keep_the_bound() {
    let mut random = Random::new(7);
    for voxel_m in [0.01, 0.035] {
        let config = MapConfig {
            voxel_m,
            max_distance_m: 10.0 * voxel_m,
            radius_m: 0.5,
            ..config()
        };
        let mut tested = Tested::new(&config);
        for pose in around() {
            tested.see(&photograph(
                &ball_on_table(),
                pose,
                at(0.0),
                &STEREO,
                &mut random,
            ));
        }
        let mut n_answers = 0;
        for _ in 0..10_000 {
            let point = random_point(&mut random, 0.5);
            if let Some(answer_m) = tested.distance(point.into()) {
                n_answers += 1;
                assert!(
                    answer_m <= distance_m(&ball_on_table(), &point) + 1e-5,
                    "{point}"
                );
                assert!(answer_m <= 10.0 * voxel_m + 1e-6);
            }
        }
        assert!(n_answers > 1000, "{voxel_m}: {n_answers}");
    }
}
