//! A base in the map: its footprint, the heights of its obstacles, and scans.

use super::scene::{Solid, at, at_origin, config, distance_m};
use crate::config::MapConfig;
use crate::query::{Query, Robot};
use crate::rows::Obstacles;
use crate::scan::images_of_scan;
use crate::voxel_map::VoxelMap;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use std::f64::consts::FRAC_PI_2;
use std::sync::Arc;
use steering::{Footprint, Seen};

/// Height of the scanner above the base link, meters.
const SCANNER_Z_M: f64 = 0.1;
const FLOOR_Z_M: f64 = -0.3;
/// Distance of a wall in front of the base.
const WALL_M: f64 = 0.8;
/// How much smaller than the distance a reading may be: between two rings, at the edge of what they
/// show, only the space close to a ring is free.
const SLACK_M: f64 = 0.12;

/// A floor and four walls. Space from which no echo returns would count as unseen.
fn scene() -> Vec<Solid> {
    let wall = |center, size_m| Solid::Cuboid { center, size_m };
    vec![
        Solid::Below(FLOOR_Z_M),
        wall([WALL_M + 0.5, 0.0, 0.0], [1.0, 6.0, 6.0]),
        wall([-2.5, 0.0, 0.0], [1.0, 6.0, 6.0]),
        wall([0.0, 2.5, 0.0], [6.0, 1.0, 6.0]),
        wall([0.0, -2.5, 0.0], [6.0, 1.0, 6.0]),
    ]
}

/// The points of a scanner with 48 rings over 90 degrees.
fn scan() -> Vec<[f64; 3]> {
    const N_RINGS: u32 = 48;
    const N_COLUMNS: u32 = 720;
    let mut points = Vec::new();
    let solids = scene();
    for ring in 0..N_RINGS {
        let elevation = (f64::from(ring) / f64::from(N_RINGS - 1) - 0.5) * FRAC_PI_2;
        for column in 0..N_COLUMNS {
            let azimuth = f64::from(column) / f64::from(N_COLUMNS) * std::f64::consts::TAU;
            let direction = Vector3::new(
                elevation.cos() * azimuth.cos(),
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
            );
            let mut along_m = 0.0;
            let at = |along_m: f64| Point3::new(0.0, 0.0, SCANNER_Z_M) + direction * along_m;
            for _ in 0..200 {
                along_m += distance_m(&solids, &at(along_m).coords);
            }
            if along_m < 6.0 {
                points.push(at(along_m).into());
            }
        }
    }
    points
}

struct Tested {
    map: VoxelMap,
    query: Query,
}

impl Tested {
    fn new(obstacles: Obstacles) -> Self {
        let config = MapConfig {
            has_surfaces: obstacles == Obstacles::Surfaces,
            ..config()
        };
        let map = VoxelMap::new(&config).unwrap();
        let mut query = Query::new(&config, Arc::new(map.snapshot()), obstacles);
        query.set_robot(Robot {
            stamp: at(0.0),
            capsules: footprint().capsules(),
            world_from_base: Transform::identity(),
            heights_m: Some(footprint().height_m()),
        });
        Self { map, query }
    }

    fn see_scan(&mut self) {
        let scanner = Transform::translation(0.0, 0.0, SCANNER_Z_M);
        for image in images_of_scan("lidar", &scanner, &scan(), &at_origin(at(0.0))) {
            self.map.integrate(&image, &[]);
        }
        self.query.set_snapshot(Arc::new(self.map.snapshot()));
    }

    fn reading(&mut self, point: [f64; 3]) -> Option<Seen> {
        self.query.readings(&[point], at(1.0))[0]
    }
}

fn footprint() -> Footprint {
    let (x, y) = (0.2, 0.15);
    Footprint::of_points(&[[-x, -y], [x, -y], [x, y], [-x, y]], [-0.15, 0.15]).unwrap()
}

#[test]
fn scans_show_free_space_and_surfaces_and_the_floor_is_no_obstacle() {
    let mut tested = Tested::new(Obstacles::NotFree);
    assert_eq!(tested.reading([0.5, 0.0, 0.0]), None, "never seen");
    let own = tested.reading([0.0, 0.0, 0.0]).unwrap();
    assert!(own.distance_m > 0.03, "the base itself is there");
    tested.see_scan();
    for point in [[0.4, 0.3, 0.0], [-0.4, 0.3, 0.1], [0.5, -0.2, -0.05]] {
        let exact_m = (WALL_M - point[0]).min(0.25);
        let seen = tested.reading(point).unwrap_or_else(|| panic!("{point:?}"));
        assert!(seen.distance_m <= exact_m + 1e-3, "{point:?}: {seen:?}");
        assert!(seen.distance_m >= exact_m - SLACK_M, "{point:?}: {seen:?}");
    }
    assert_eq!(
        tested.reading([WALL_M + 0.05, 0.0, 0.0]),
        None,
        "in the wall"
    );
    // Close to the floor, only what is between the heights of the base counts.
    let low = tested.reading([0.4, 0.0, -0.14]).unwrap();
    assert!(low.distance_m > 0.1, "{low:?}");
}

#[test]
fn with_surfaces_alone_unseen_space_is_free_but_walls_are_not() {
    let mut tested = Tested::new(Obstacles::Surfaces);
    let unseen = tested.reading([0.5, 0.0, 0.0]).unwrap();
    assert!(unseen.distance_m > 0.2, "{unseen:?}");
    tested.see_scan();
    let near = tested.reading([WALL_M - 0.1, 0.0, 0.0]).unwrap();
    assert!((near.distance_m - 0.1).abs() < 0.05, "{near:?}");
}
