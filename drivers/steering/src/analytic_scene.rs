//! A scene of spheres and half spaces, for tests and for simulated rigs without a field.

use crate::clearance::{Clearance, Seen};
use kinematics::Stamp;
use nalgebra::Vector3;

/// A solid in the frame of the arm's base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Solid {
    /// A sphere.
    Sphere {
        /// Center, meters.
        center: [f64; 3],
        /// Radius, meters.
        radius_m: f64,
    },
    /// Everything below a plane, such as a table.
    HalfSpace {
        /// A point of the plane, meters.
        point: [f64; 3],
        /// Unit normal, which points out of the solid.
        normal: [f64; 3],
    },
}

/// A scene whose distances are exact.
#[derive(Clone, Debug, PartialEq)]
pub struct AnalyticScene {
    /// What is in the scene.
    pub solids: Vec<Solid>,
    /// When the scene was seen.
    pub seen_at: Stamp,
    /// Radius around the base within which the scene was seen, meters.
    pub seen_radius_m: f64,
}

impl Solid {
    fn distance_m(&self, point: Vector3<f64>) -> f64 {
        match self {
            Self::Sphere { center, radius_m } => (point - Vector3::from(*center)).norm() - radius_m,
            Self::HalfSpace {
                point: on_plane,
                normal,
            } => (point - Vector3::from(*on_plane)).dot(&Vector3::from(*normal)),
        }
    }
}

impl Clearance for AnalyticScene {
    fn readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        let reading = |point: &[f64; 3]| {
            let point = Vector3::from(*point);
            // Behind the border of the seen region, everything is possible.
            let to_border_m = self.seen_radius_m - point.norm();
            let nearest_m = self
                .solids
                .iter()
                .map(|solid| solid.distance_m(point))
                .fold(to_border_m, f64::min);
            (to_border_m >= 0.0).then(|| Seen {
                distance_m: nearest_m,
                age_secs: now.secs_since(self.seen_at).max(0.0),
            })
        };
        points_in_base.iter().map(reading).collect()
    }
}
