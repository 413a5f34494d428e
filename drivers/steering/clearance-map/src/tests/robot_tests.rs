//! The robot is not in the map, and its volume is free.

use super::scene::{
    STEREO, Solid, Tested, at, config, distance_m, looking, photograph, random_point,
};
use crate::capsules::in_grid;
use crate::image::Posture;
use crate::rows::{BUNDLE, Obstacles, Rows};
use kinematics::Transform;
use nalgebra::Vector3;
use numbers::random::Random;
use steering::Capsule;

fn arm(x: f64) -> Capsule {
    Capsule {
        ends: [Vector3::new(x, 0.0, 0.12), Vector3::new(x, 0.0, 0.5)],
        radius_m: 0.06,
    }
}

fn pose() -> Transform {
    looking([1.3, 0.0, 0.6], [0.0, 0.0, 0.2])
}

/// A part that is a little larger than its capsule, as parts with cables are.
fn with_cables(capsule: Capsule) -> Solid {
    Solid::Capsule(Capsule {
        radius_m: capsule.radius_m + 0.01,
        ..capsule
    })
}

#[test]
fn robot_is_not_in_the_map() {
    let mut random = Random::new(21);
    let mut tested = Tested::new(&config());
    let table = Solid::Below(0.0);
    for (ix, x) in [0.0, -0.3, 0.3].into_iter().enumerate() {
        let image = photograph(
            &[table, with_cables(arm(x))],
            pose(),
            at(ix as f64),
            &STEREO,
            &mut random,
        );
        tested.see_robot(&image, &[arm(x)]);
    }
    // The arm is at 0.3 now. Where it was before is free, up to the table.
    tested.set_robot(&[arm(0.3)], at(2.0));
    // Above, the camera sees nothing within its range, so readings are missing.
    for z in [0.15, 0.2, 0.3] {
        let distance_m = tested.distance([0.0, 0.12, z]).unwrap();
        assert!(distance_m > 0.05, "{z}: {distance_m}");
    }
    // No surface of the robot was recorded: between the camera and the robot, the distance is that
    // to the unseen space behind its sides, or larger.
    let before_m = tested.distance([0.45, 0.0, 0.3]).unwrap();
    assert!(before_m > 0.08, "{before_m}");
    let inside = tested.reading([0.3, 0.0, 0.3], at(2.0)).unwrap();
    assert!(inside.distance_m >= 0.06 - 1e-4, "{inside:?}");
}

#[test]
fn robot_does_not_hide_what_was_seen_before() {
    let mut random = Random::new(22);
    let mut tested = Tested::new(&config());
    let box_beside = Solid::Cuboid {
        center: [0.0, 0.2, 0.2],
        size_m: [0.1, 0.1, 0.4],
    };
    let scene = [Solid::Below(0.0), box_beside];
    tested.see(&photograph(&scene, pose(), at(0.0), &STEREO, &mut random));
    let with_arm = [scene[0], scene[1], Solid::Capsule(arm(0.2))];
    for ix in 1..4 {
        let image = photograph(&with_arm, pose(), at(f64::from(ix)), &STEREO, &mut random);
        tested.see_robot(&image, &[arm(0.2)]);
        tested.set_robot(&[arm(0.2)], at(f64::from(ix)));
        for _ in 0..5000 {
            let point = random_point(&mut random, 0.6);
            let answer_m = tested.distance(point.into()).unwrap_or(0.0);
            assert!(
                answer_m <= distance_m(&scene, &point).max(0.0) + 1e-5,
                "{point} {answer_m}"
            );
        }
    }
}

/// Invariant: in a region that was never seen, the reading on the axis of a part is its radius, or
/// less than half a voxel more. The arm therefore stays below its stop distance.
#[test]
fn volume_of_the_robot_is_free_without_a_margin() {
    let mut tested = Tested::new(&config());
    tested.set_robot(&[arm(0.0)], at(0.0));
    for z in 0..=40 {
        let z = 0.12 + 0.38 * f64::from(z) / 40.0;
        let seen = tested.reading([0.0, 0.0, z], at(1.5)).unwrap();
        assert!(
            seen.distance_m > 0.06 - 1e-4 && seen.distance_m < 0.07 + 1e-4,
            "{seen:?}"
        );
        assert_eq!(seen.age_secs, 1.5, "as old as the posture");
    }
    assert_eq!(
        tested.distance([0.1, 0.0, 0.3]),
        None,
        "outside of the robot"
    );
    // Away from the axis, the distance to the unseen space is smaller.
    let off_axis_m = tested.distance([0.03, 0.0, 0.3]).unwrap();
    assert!(off_axis_m < 0.045, "{off_axis_m}");
    // The volume moves with the robot. What it left is not known.
    tested.set_robot(&[arm(0.2)], at(1.0));
    assert_eq!(tested.distance([0.0, 0.0, 0.3]), None);
    assert!(tested.distance([0.2, 0.0, 0.3]).is_some());
}

#[test]
fn swept_space_is_free_unless_a_surface_was_seen_there() {
    let mut random = Random::new(23);
    let mut tested = Tested::new(&config());
    let wall = Solid::Cuboid {
        center: [-0.2, 0.0, 0.0],
        size_m: [0.1, 4.0, 4.0],
    };
    let posture = Posture {
        stamp: at(0.0),
        position: Vec::new(),
        world_from_base: Transform::identity(),
    };
    tested.map.sweep(&[arm(-0.1)], &posture, 0.05);
    tested.publish();
    // Between the capsule and its margin.
    assert!(tested.distance([-0.1, 0.08, 0.3]).is_some());
    assert_eq!(tested.distance([-0.1, 0.14, 0.3]), None);
    tested.see(&photograph(&[wall], pose(), at(1.0), &STEREO, &mut random));
    tested.map.sweep(
        &[arm(-0.1)],
        &Posture {
            stamp: at(2.0),
            ..posture
        },
        0.05,
    );
    tested.publish();
    assert_eq!(tested.distance([-0.155, 0.0, 0.3]), None, "the wall stays");
}

#[test]
fn volume_of_a_resting_robot_does_not_age() {
    let mut random = Random::new(24);
    let mut tested = Tested::new(&config());
    let table = Solid::Below(0.0);
    // A cell of 8 cm around this axis is inside as a whole.
    let axis = [0.12, 0.04];
    let arm = Capsule {
        ends: [0.25, 0.5].map(|z| Vector3::new(axis[0], axis[1], z)),
        radius_m: 0.15,
    };
    tested.see(&photograph(&[table], pose(), at(0.0), &STEREO, &mut random));
    let with_arm = [table, Solid::Capsule(arm)];
    for secs in [10.0, 20.0] {
        let image = photograph(&with_arm, pose(), at(secs), &STEREO, &mut random);
        tested.see_robot(&image, &[arm]);
    }
    let snapshot = tested.map.snapshot();
    let age_secs = |x: f64, z: f64| {
        let in_grid = snapshot.grid.in_voxels(&Vector3::new(x, axis[1], z));
        let [x, y, z] = [in_grid.x, in_grid.y, in_grid.z].map(|voxel| voxel as usize / 4);
        snapshot
            .clock
            .age_secs(snapshot.oldest[snapshot.cell(x, y, z)], at(20.0))
    };
    assert!(age_secs(axis[0], 0.36) < 0.01, "inside");
    // Hidden by the robot since it came, and in view all the time.
    assert!(age_secs(-0.3, 0.2) >= 19.9, "behind");
    assert!(age_secs(0.5, 0.36) < 0.01, "in front");
}

#[test]
fn moving_robot_leaves_no_trace_in_the_rows() {
    let mut random = Random::new(25);
    let mut tested = Tested::new(&config());
    tested.see(&photograph(
        &[Solid::Below(0.0)],
        pose(),
        at(0.0),
        &STEREO,
        &mut random,
    ));
    let snapshot = tested.map.snapshot();
    let mut moved = Rows::new(&snapshot, Obstacles::NotFree);
    for _ in 0..20 {
        let capsules: Vec<Capsule> = (0..5)
            .map(|_| Capsule {
                ends: [
                    random_point(&mut random, 0.9),
                    random_point(&mut random, 0.9),
                ],
                radius_m: random.uniform(0.02, 0.2),
            })
            .collect();
        let robot = in_grid(&capsules, &Transform::identity(), &snapshot.grid, 0.0);
        moved.set_robot(&robot);
        let mut fresh = Rows::new(&snapshot, Obstacles::NotFree);
        fresh.set_robot(&robot);
        assert!(moved.blocked() == fresh.blocked() && moved.bundles() == fresh.bundles());
        // Bundles are the union of their rows, also where the robot has cleared some.
        let mut n_free = 0;
        for z in 0..snapshot.grid.side() {
            for y in 0..snapshot.grid.side() {
                let row = snapshot.grid.row(y, z);
                let bundle = moved.bundle_row(y / BUNDLE, z / BUNDLE);
                for byte in 0..snapshot.grid.n_blocks {
                    let of_row = moved.blocked()[row + byte];
                    n_free += of_row.count_zeros();
                    assert_eq!(of_row & !moved.bundles()[bundle + byte], 0);
                }
            }
        }
        assert!(n_free > 0);
    }
    moved.set_robot(&[]);
    assert!(moved.blocked() == snapshot.blocked, "the map itself");
}
