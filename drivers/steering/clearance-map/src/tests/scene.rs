//! Solids with exact distances, and depth images of them.

use crate::config::MapConfig;
use crate::image::{DepthImage, DepthOrigin, Posture};
use crate::query::{Query, Robot};
use crate::rows::Obstacles;
use crate::voxel_map::VoxelMap;
use kinematics::{Stamp, Transform};
use nalgebra::{Isometry3, Point3, Vector3};
use numbers::random::Random;
use std::sync::Arc;
use steering::{Capsule, Seen};

/// A solid in the world.
#[derive(Clone, Copy, Debug)]
pub(super) enum Solid {
    Sphere {
        center: [f64; 3],
        radius_m: f64,
    },
    /// A box with sides along the axes.
    Cuboid {
        center: [f64; 3],
        size_m: [f64; 3],
    },
    /// Everything below a height.
    Below(f64),
    Capsule(Capsule),
}

impl Solid {
    pub(super) fn distance_m(&self, point: &Vector3<f64>) -> f64 {
        match self {
            Self::Sphere { center, radius_m } => (point - Vector3::from(*center)).norm() - radius_m,
            Self::Cuboid { center, size_m } => {
                let outside = (point - Vector3::from(*center)).abs() - Vector3::from(*size_m) * 0.5;
                outside.sup(&Vector3::zeros()).norm() + outside.max().min(0.0)
            }
            Self::Below(height_m) => point.z - height_m,
            Self::Capsule(capsule) => {
                let at = Capsule {
                    ends: [*point, *point],
                    radius_m: 0.0,
                };
                capsule.gap(&at).distance_m
            }
        }
    }
}

/// Distance to the closest solid.
pub(super) fn distance_m(solids: &[Solid], point: &Vector3<f64>) -> f64 {
    let distances = solids.iter().map(|solid| solid.distance_m(point));
    distances.fold(f64::INFINITY, f64::min)
}

/// What is wrong with the readings of a camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flaws {
    /// Standard deviation at a distance of 1 m; it grows with the square of the distance.
    pub(super) sigma_m: f64,
    /// Fraction of pixels without a reading.
    pub(super) hole_frac: f64,
    /// Fraction of pixels with any reading.
    pub(super) outlier_frac: f64,
}

pub(super) const PERFECT: Flaws = Flaws {
    sigma_m: 0.0,
    hole_frac: 0.0,
    outlier_frac: 0.0,
};

/// As of a stereo camera. The margin has one of its standard deviations.
pub(super) const STEREO: Flaws = Flaws {
    sigma_m: 0.0025,
    hole_frac: 0.04,
    outlier_frac: 0.001,
};

/// A pose that looks from one point to another.
pub(super) fn looking(from: [f64; 3], to: [f64; 3]) -> Transform {
    let (from, to) = (Point3::from(from), Point3::from(to));
    // The rows of an image point down. A view straight down needs another direction for that.
    let down = if (to - from).xy().norm() < 1e-6 {
        Vector3::y()
    } else {
        -Vector3::z()
    };
    Isometry3::face_towards(&from, &to, &down)
}

/// A camera for tests, 320 x 240 pixels, 65 degrees wide.
pub(super) fn photograph(
    solids: &[Solid],
    world_from_camera: Transform,
    stamp: Stamp,
    flaws: &Flaws,
    random: &mut Random,
) -> DepthImage {
    let size_px = [320, 240];
    let focal_px = [250.0, 250.0];
    let principal_px = [161.0, 119.0];
    let mut depth_m = Vec::new();
    for row in 0..size_px[1] {
        for column in 0..size_px[0] {
            let ray = Vector3::new(
                (f64::from(column) + 0.5 - principal_px[0]) / focal_px[0],
                (f64::from(row) + 0.5 - principal_px[1]) / focal_px[1],
                1.0,
            );
            let z_m = depth_along(solids, &world_from_camera, &ray);
            let draw = random.unit();
            let reading_m = if draw < flaws.hole_frac {
                0.0
            } else if draw < flaws.hole_frac + flaws.outlier_frac {
                random.uniform(0.2, 3.0)
            } else {
                z_m + flaws.sigma_m * z_m * z_m * random.normal()
            };
            depth_m.push(reading_m as f32);
        }
    }
    DepthImage {
        camera: Arc::from("fixed"),
        stamp,
        size_px,
        focal_px,
        principal_px,
        depth_m: depth_m.into(),
        world_from_camera,
        posture: at_origin(stamp),
        origin: DepthOrigin::Measured,
    }
}

/// Depth along a ray whose z is 1; 0 if it meets nothing within 6 m.
fn depth_along(solids: &[Solid], world_from_camera: &Transform, ray: &Vector3<f64>) -> f64 {
    let length = ray.norm();
    let mut z_m = 0.0;
    for _ in 0..200 {
        let point = world_from_camera * Point3::from(ray * z_m);
        let distance_m = distance_m(solids, &point.coords);
        if distance_m < 1e-5 {
            return z_m;
        }
        z_m += distance_m / length;
        if z_m > 6.0 {
            return 0.0;
        }
    }
    z_m
}

/// A posture of a robot without joints.
pub(super) fn at_origin(stamp: Stamp) -> Posture {
    Posture {
        stamp,
        position: Vec::new(),
        world_from_base: Transform::identity(),
    }
}

/// A stamp in seconds.
pub(super) fn at(secs: f64) -> Stamp {
    Stamp::from_secs(1000.0 + secs)
}

/// Settings of a small region, so that tests are fast.
pub(super) fn config() -> MapConfig {
    MapConfig {
        radius_m: 0.9,
        ..MapConfig::for_reach(0.0)
    }
}

/// A map and its answers, without a thread.
pub(super) struct Tested {
    pub(super) map: VoxelMap,
    pub(super) query: Query,
}

impl Tested {
    pub(super) fn new(config: &MapConfig) -> Self {
        let map = VoxelMap::new(config).unwrap();
        let query = Query::new(config, Arc::new(map.snapshot()), Obstacles::NotFree);
        Self { map, query }
    }

    /// Integrates an image of a scene without a robot.
    pub(super) fn see(&mut self, image: &DepthImage) {
        self.see_robot(image, &[]);
    }

    pub(super) fn see_robot(&mut self, image: &DepthImage, capsules: &[Capsule]) {
        self.map.integrate(image, capsules);
        self.publish();
    }

    pub(super) fn publish(&mut self) {
        self.query.set_snapshot(Arc::new(self.map.snapshot()));
    }

    pub(super) fn set_robot(&mut self, capsules: &[Capsule], stamp: Stamp) {
        self.query.set_robot(Robot {
            stamp,
            capsules: capsules.to_vec(),
            world_from_base: Transform::identity(),
            heights_m: None,
        });
    }

    pub(super) fn reading(&mut self, point: [f64; 3], now: Stamp) -> Option<Seen> {
        self.query.readings(&[point], now)[0]
    }

    pub(super) fn distance(&mut self, point: [f64; 3]) -> Option<f64> {
        self.reading(point, at(1000.0)).map(|seen| seen.distance_m)
    }
}

/// A random point in a ball around the origin.
pub(super) fn random_point(random: &mut Random, radius_m: f64) -> Vector3<f64> {
    loop {
        let point = Vector3::from_fn(|_, _| random.uniform(-radius_m, radius_m));
        if point.norm() <= radius_m {
            return point;
        }
    }
}
