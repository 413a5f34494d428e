//! Capsules, which enclose the parts of a robot, and the distance between two of them.
//!
//! Capsules instead of meshes or convex hulls: the distance of two capsules is that of two
//! segments, in closed form, without iterations that could fail, and bit-identical on every
//! machine. A library such as `parry3d-f64` would add hulls and meshes (and seven crates), but arms
//! are round and long. Capsules follow their parts closely, except at flat ends.

use kinematics::Transform;
use nalgebra::{Point3, Vector3};

/// All points within a radius of a segment. A segment of length zero is a sphere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Capsule {
    /// Ends of the segment, meters.
    pub ends: [Vector3<f64>; 2],
    /// Radius, meters.
    pub radius_m: f64,
}

/// Distance between two capsules.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// Distance of the surfaces, meters; negative if they overlap.
    pub distance_m: f64,
    /// Point between both, on the line between the closest points of the segments.
    pub place: Vector3<f64>,
}

impl Capsule {
    /// The capsule in another frame.
    pub fn transformed(&self, to_from_frame: &Transform) -> Self {
        Self {
            ends: self
                .ends
                .map(|end| (to_from_frame * Point3::from(end)).coords),
            radius_m: self.radius_m,
        }
    }

    /// Distance to another capsule.
    pub fn gap(&self, other: &Self) -> Gap {
        let [own, others] = closest_points(&self.ends, &other.ends);
        let between = others - own;
        let centers_m = between.norm();
        // The middle of the gap between the surfaces. Concentric segments have no direction.
        let frac = if centers_m > 0.0 {
            0.5 + 0.5 * (self.radius_m - other.radius_m) / centers_m
        } else {
            0.5
        };
        Gap {
            distance_m: centers_m - self.radius_m - other.radius_m,
            place: own + between * frac.clamp(0.0, 1.0),
        }
    }

    /// Whether another capsule is inside this one.
    pub(crate) fn contains(&self, other: &Self) -> bool {
        /// Rounding of coordinates of up to some meters.
        const ROUNDING_M: f64 = 1e-9;
        // The distance to a segment is a convex function, so it is largest at an end.
        other.ends.iter().all(|end| {
            let [own, _] = closest_points(&self.ends, &[*end, *end]);
            (end - own).norm() + other.radius_m <= self.radius_m + ROUNDING_M
        })
    }

    /// Points on the segment, and the radius of spheres around them that together cover the
    /// capsule.
    pub(crate) fn spheres(&self, max_spacing_m: f64) -> (Vec<Vector3<f64>>, f64) {
        /// Bounds the number of points of a thin and long part.
        const MAX_SPANS: u32 = 64;
        let [start, end] = self.ends;
        let length_m = (end - start).norm();
        let n_spans = (1..MAX_SPANS)
            .find(|n| length_m / f64::from(*n) <= max_spacing_m)
            .unwrap_or(MAX_SPANS);
        let point = |ix: u32| start + (end - start) * (f64::from(ix) / f64::from(n_spans));
        let half_spacing_m = 0.5 * length_m / f64::from(n_spans);
        let points = if length_m > 0.0 {
            (0..=n_spans).map(point).collect()
        } else {
            vec![start]
        };
        // Half-way between two centers, the spheres must still reach the surface of the cylinder.
        (points, self.radius_m.hypot(half_spacing_m))
    }
}

/// The closest points of two segments.
///
/// Source: Ericson 2005, "Real-Time Collision Detection", section 5.1.9.
fn closest_points(a: &[Vector3<f64>; 2], b: &[Vector3<f64>; 2]) -> [Vector3<f64>; 2] {
    /// Squared length in square meters below which a segment is a point. It is far below the
    /// accuracy of any robot, and far above rounding errors.
    const POINT: f64 = 1e-18;
    let along_a = a[1] - a[0];
    let along_b = b[1] - b[0];
    let offset = a[0] - b[0];
    let (aa, bb) = (along_a.norm_squared(), along_b.norm_squared());
    let (ao, bo) = (along_a.dot(&offset), along_b.dot(&offset));
    let (s, t) = if aa <= POINT && bb <= POINT {
        (0.0, 0.0)
    } else if aa <= POINT {
        (0.0, (bo / bb).clamp(0.0, 1.0))
    } else if bb <= POINT {
        ((-ao / aa).clamp(0.0, 1.0), 0.0)
    } else {
        let ab = along_a.dot(&along_b);
        // Zero for parallel segments. Any point of the first segment is then a valid start.
        let denominator = aa * bb - ab * ab;
        let s = if denominator > 0.0 {
            ((ab * bo - ao * bb) / denominator).clamp(0.0, 1.0)
        } else {
            0.0
        };
        let t = (ab * s + bo) / bb;
        if t < 0.0 {
            ((-ao / aa).clamp(0.0, 1.0), 0.0)
        } else if t > 1.0 {
            (((ab - ao) / aa).clamp(0.0, 1.0), 1.0)
        } else {
            (s, t)
        }
    };
    [a[0] + along_a * s, b[0] + along_b * t]
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    fn point(random: &mut Random) -> Vector3<f64> {
        Vector3::new(
            random.uniform(-1.0, 1.0),
            random.uniform(-1.0, 1.0),
            random.uniform(-1.0, 1.0),
        )
    }

    /// Distance of two segments, by a search over both.
    fn searched_distance(a: &[Vector3<f64>; 2], b: &[Vector3<f64>; 2]) -> f64 {
        const N: u32 = 200;
        let on = |ends: &[Vector3<f64>; 2], ix: u32| {
            ends[0].lerp(&ends[1], f64::from(ix) / f64::from(N))
        };
        let mut shortest = f64::INFINITY;
        for first in 0..=N {
            for second in 0..=N {
                shortest = shortest.min((on(a, first) - on(b, second)).norm());
            }
        }
        shortest
    }

    #[test]
    fn distance_of_segments_agrees_with_a_search() {
        let mut random = Random::new(1);
        for ix in 0..100 {
            let a = [point(&mut random), point(&mut random)];
            let direction = a[1] - a[0];
            let start = point(&mut random);
            let b = match ix % 4 {
                0 => [start, start],
                1 => [start, start + direction * random.uniform(-1.0, 1.0)],
                _ => [start, point(&mut random)],
            };
            let [on_a, on_b] = closest_points(&a, &b);
            let found = (on_a - on_b).norm();
            let searched = searched_distance(&a, &b);
            // The search misses the closest points by up to half a span of each segment.
            assert!(
                found <= searched + 1e-12 && found > searched - 0.02,
                "{ix}: {found} {searched}"
            );
        }
    }

    #[test]
    fn gap_is_between_surfaces_and_negative_if_they_overlap() {
        let at = |x: f64, radius_m: f64| Capsule {
            ends: [Vector3::new(x, 0.0, -1.0), Vector3::new(x, 0.0, 1.0)],
            radius_m,
        };
        let apart = at(0.0, 0.1).gap(&at(1.0, 0.3));
        assert!((apart.distance_m - 0.6).abs() < 1e-12);
        assert!((apart.place.x - 0.4).abs() < 1e-12, "{}", apart.place);
        assert!((at(0.0, 0.1).gap(&at(0.1, 0.3)).distance_m + 0.3).abs() < 1e-12);
        assert!((at(0.0, 0.1).gap(&at(0.0, 0.3)).distance_m + 0.4).abs() < 1e-12);
        assert!(at(0.0, 0.3).contains(&at(0.1, 0.1)));
        assert!(!at(0.0, 0.3).contains(&at(0.25, 0.1)));
    }

    #[test]
    fn spheres_cover_the_capsule() {
        let mut random = Random::new(2);
        for _ in 0..200 {
            let capsule = Capsule {
                ends: [point(&mut random), point(&mut random)],
                radius_m: random.uniform(0.02, 0.3),
            };
            let (centers, radius_m) = capsule.spheres(capsule.radius_m);
            let frac = random.unit();
            let center = capsule.ends[0].lerp(&capsule.ends[1], frac);
            let on_surface = center + point(&mut random).normalize() * capsule.radius_m;
            let is_covered =
                |center: &Vector3<f64>| (center - on_surface).norm() <= radius_m + 1e-9;
            let [own, _] = closest_points(&capsule.ends, &[on_surface, on_surface]);
            let is_inside = (own - on_surface).norm() <= capsule.radius_m;
            assert!(!is_inside || centers.iter().any(is_covered));
        }
    }
}
