//! Computes how much light reaches each point of a scene, and bakes it into the textures.
//!
//! Nothing in front of a wrist camera moves, so shadows can be computed once instead of for every
//! image. This halves the rendering time and allows soft shadows from an extended lamp and ambient
//! occlusion in corners.

use crate::random::RandomStream;
use kinematics::Transform;
use nalgebra::{Matrix3, Point3, Vector3};
use std::fmt::Write as _;

/// A lamp at infinity.
pub(crate) struct Lamp {
    /// Direction from the lamp to the scene.
    direction: [f64; 3],
    diffuse: [f64; 3],
    specular: f64,
}

/// The lamp that casts shadows.
const KEY: Lamp = Lamp {
    direction: [0.42, 0.30, -0.86],
    diffuse: [0.86, 0.84, 0.78],
    specular: 0.3,
};
/// Fill lamps, which cast no shadows.
const FILLS: [Lamp; 2] = [
    Lamp {
        direction: [0.55, -0.6, -0.45],
        diffuse: [0.20, 0.21, 0.24],
        specular: 0.0,
    },
    Lamp {
        direction: [-0.4, 0.1, -0.5],
        diffuse: [0.10, 0.10, 0.10],
        specular: 0.0,
    },
];
/// Ambient light, sRGB 0 to 1.
const AMBIENT: [f64; 3] = [0.37, 0.37, 0.39];

/// Tangent of half the angle that the key lamp covers. A larger lamp gives softer shadows, which
/// need more rays.
const KEY_SIZE: f64 = 0.06;
/// Number of rays to the key lamp and of ambient rays. With fewer rays, the noise would be visible,
/// although [`Texture::shade`](crate::texture::Texture::shade) blurs it. With more rays, building a
/// scene would take longer.
const N_KEY_RAYS: u64 = 12;
const N_AMBIENT_RAYS: u64 = 20;

/// The golden angle, radians. On a spiral, points at its multiples never line up.
const GOLDEN_ANGLE_RAD: f64 = 2.399_963;

impl Lamp {
    fn to_lamp(&self) -> Vector3<f64> {
        -Vector3::from(self.direction).normalize()
    }

    fn brightness(&self, normal: &Vector3<f64>) -> f64 {
        self.diffuse[1] * normal.dot(&self.to_lamp()).max(0.0)
    }
}

/// MJCF of the lamps (elements of the world body) and of the ambient light (a visual setting), both
/// scaled by `gain`.
pub(crate) fn mjcf(gain: f64) -> (String, String) {
    let list = |numbers: [f64; 3]| numbers.map(|number| (gain * number).to_string()).join(" ");
    let mut lamps = String::new();
    for lamp in [&KEY].into_iter().chain(&FILLS) {
        let _ = writeln!(
            lamps,
            "<light directional=\"true\" pos=\"0.7 0 2\" dir=\"{}\" diffuse=\"{}\" specular=\"{}\" castshadow=\"false\"/>",
            lamp.direction.map(|number| number.to_string()).join(" "),
            list(lamp.diffuse),
            list([lamp.specular; 3])
        );
    }
    let ambient = format!(
        "<headlight ambient=\"{}\" diffuse=\"0 0 0\" specular=\"0 0 0\"/>",
        list(AMBIENT)
    );
    (lamps, ambient)
}

/// Geometry that blocks light.
pub(crate) struct Occluders {
    boxes: Vec<SolidBox>,
    ellipsoids: Vec<Ellipsoid>,
    /// Sphere around all ellipsoids.
    bounds: (Point3<f64>, f64),
    /// Maximum distance at which an object blocks ambient light, meters.
    ambient_reach_m: f64,
}

struct SolidBox {
    box_from_world: Transform,
    half_m: Vector3<f64>,
    center: Point3<f64>,
    /// Distance of the corners from the center.
    radius_m: f64,
}

impl SolidBox {
    fn blocks(&self, from: &Point3<f64>, direction: &Vector3<f64>, max_distance_m: f64) -> bool {
        hits_box(
            &(self.box_from_world * from).coords,
            &(self.box_from_world * direction),
            &self.half_m,
            max_distance_m,
        )
    }

    /// Whether a box can block a ray of a cone: rays from a point within a tangent of `spread`
    /// around a unit vector.
    fn is_in_cone(&self, from: &Point3<f64>, axis: &Vector3<f64>, spread: f64) -> bool {
        let offset = self.center - from;
        let along_m = offset.dot(axis);
        let across_m = (offset - axis * along_m).norm();
        along_m > -self.radius_m && across_m <= self.radius_m + spread * (along_m + self.radius_m)
    }

    fn is_within(&self, from: &Point3<f64>, reach_m: f64) -> bool {
        (self.center - from).norm() <= reach_m + self.radius_m
    }
}

struct Ellipsoid {
    center: Point3<f64>,
    /// Maps the ellipsoid to a unit sphere.
    sphere_from_offset: Matrix3<f64>,
}

impl Occluders {
    /// Creates an empty set. Objects farther away than `ambient_reach_m` do not block ambient
    /// light.
    pub(crate) fn new(ambient_reach_m: f64) -> Self {
        Self {
            boxes: Vec::new(),
            ellipsoids: Vec::new(),
            bounds: (Point3::origin(), 0.0),
            ambient_reach_m,
        }
    }

    pub(crate) fn add_box(&mut self, world_from_box: Transform, half_m: [f64; 3]) {
        let half_m = Vector3::from(half_m);
        self.boxes.push(SolidBox {
            box_from_world: world_from_box.inverse(),
            half_m,
            center: world_from_box.translation.vector.into(),
            radius_m: half_m.norm(),
        });
    }

    /// Adds ellipsoids, given by center and half axes, that lie inside a bounding sphere.
    pub(crate) fn add_ellipsoids(
        &mut self,
        ellipsoids: impl Iterator<Item = (Point3<f64>, [Vector3<f64>; 3])>,
        bounds: (Point3<f64>, f64),
    ) {
        self.ellipsoids
            .extend(ellipsoids.map(|(center, half_axes)| {
                let rows = half_axes.map(|axis| (axis / axis.norm_squared()).transpose());
                Ellipsoid {
                    center,
                    sphere_from_offset: Matrix3::from_rows(&rows),
                }
            }));
        self.bounds = bounds;
    }

    /// Whether anything blocks a ray.
    ///
    /// * `boxes`: those that can block it. They are chosen once for all rays of a point, because
    ///   most boxes are far away from most points.
    fn is_occluded(
        &self,
        boxes: &[&SolidBox],
        from: &Point3<f64>,
        direction: &Vector3<f64>,
        max_distance_m: f64,
    ) -> bool {
        if boxes
            .iter()
            .any(|solid| solid.blocks(from, direction, max_distance_m))
        {
            return true;
        }
        // Most rays miss the sphere around all ellipsoids. For these rays, the single ellipsoids
        // need not be tested.
        let (center, radius_m) = self.bounds;
        hits_sphere(
            &((from - center) / radius_m),
            &(direction / radius_m),
            max_distance_m,
        ) && self.ellipsoids.iter().any(|ellipsoid| {
            let offset = ellipsoid.sphere_from_offset * (from - ellipsoid.center);
            hits_sphere(
                &offset,
                &(ellipsoid.sphere_from_offset * direction),
                max_distance_m,
            )
        })
    }

    /// Fraction of the unoccluded light that reaches a surface, 0 to 1.
    ///
    /// `name` identifies the point and selects its random rays.
    pub(crate) fn light_frac(&self, point: &Point3<f64>, normal: &Vector3<f64>, name: u64) -> f64 {
        /// Rays start at this distance above the surface, meters, so that rounding does not cause
        /// them to hit the surface.
        const LIFT_M: f64 = 5e-4;
        let random = RandomStream::new(0x11_6874, &[name]);
        let from = point + normal * LIFT_M;
        let key = KEY.brightness(normal);
        let others = AMBIENT[1]
            + FILLS
                .iter()
                .map(|lamp| lamp.brightness(normal))
                .sum::<f64>();
        let key_frac = if key > 0.0 {
            self.key_frac(&from, random)
        } else {
            0.0
        };
        let other_frac = self.ambient_frac(&from, normal, random);
        // OpenGL draws the unoccluded light, so the texture contains the fraction of the light that
        // arrives.
        (key * key_frac + others * other_frac) / (key + others)
    }

    fn key_frac(&self, from: &Point3<f64>, random: RandomStream) -> f64 {
        let to_lamp = KEY.to_lamp();
        let side = to_lamp.cross(&Vector3::x()).normalize();
        let across = to_lamp.cross(&side);
        let can_block = |solid: &&SolidBox| solid.is_in_cone(from, &to_lamp, KEY_SIZE);
        let boxes: Vec<&SolidBox> = self.boxes.iter().filter(can_block).collect();
        let rotation_rad = random.between(0, 0.0, std::f64::consts::TAU);
        let n_free = (0..N_KEY_RAYS).filter(|ray| {
            // The rays are spread evenly over the lamp's disc, with a random rotation (Vogel 1979).
            let radius = KEY_SIZE * ((*ray as f64 + 0.5) / N_KEY_RAYS as f64).sqrt();
            let (sin, cos) = (*ray as f64 * GOLDEN_ANGLE_RAD + rotation_rad).sin_cos();
            let direction = (to_lamp + side * (radius * cos) + across * (radius * sin)).normalize();
            !self.is_occluded(&boxes, from, &direction, 10.0)
        });
        n_free.count() as f64 / N_KEY_RAYS as f64
    }

    fn ambient_frac(&self, from: &Point3<f64>, normal: &Vector3<f64>, random: RandomStream) -> f64 {
        // The axis must not be parallel to the normal, because the cross product would vanish.
        let side = if normal.x.abs() < 0.7 {
            normal.cross(&Vector3::x())
        } else {
            normal.cross(&Vector3::y())
        }
        .normalize();
        let across = normal.cross(&side);
        let can_block = |solid: &&SolidBox| solid.is_within(from, self.ambient_reach_m);
        let boxes: Vec<&SolidBox> = self.boxes.iter().filter(can_block).collect();
        let rotation_rad = random.between(1, 0.0, std::f64::consts::TAU);
        let n_free = (0..N_AMBIENT_RAYS).filter(|ray| {
            // The directions around the normal are cosine-weighted by Malley's method. Points are
            // spread evenly over a disc and projected up to the hemisphere. Each ray then carries
            // the same light.
            let square = (*ray as f64 + random.unit(2 + ray)) / N_AMBIENT_RAYS as f64;
            let (sin, cos) = (*ray as f64 * GOLDEN_ANGLE_RAD + rotation_rad).sin_cos();
            let direction =
                normal * (1.0 - square).sqrt() + (side * cos + across * sin) * square.sqrt();
            !self.is_occluded(&boxes, from, &direction, self.ambient_reach_m)
        });
        n_free.count() as f64 / N_AMBIENT_RAYS as f64
    }
}

/// Whether a ray hits the unit sphere before `reach`, or starts inside the sphere.
fn hits_sphere(from: &Vector3<f64>, direction: &Vector3<f64>, reach: f64) -> bool {
    // The ray meets the sphere at the distances t for which a t^2 + 2 b t + c = 0.
    let a = direction.norm_squared();
    let b = from.dot(direction);
    let c = from.norm_squared() - 1.0;
    let inside = b * b - a * c;
    if inside < 0.0 {
        return false;
    }
    let root = inside.sqrt();
    // The ray leaves the sphere after its start and enters it before `reach`.
    -b + root > 0.0 && -b - root < reach * a
}

/// Whether a ray hits a box between its start and `reach`.
fn hits_box(
    from: &Vector3<f64>,
    direction: &Vector3<f64>,
    half_m: &Vector3<f64>,
    reach: f64,
) -> bool {
    // This is the slab method (Kay and Kajiya 1986). The ray is in the box while it is between all
    // three pairs of planes. A component of 0 gives infinities, which `min` and `max` handle.
    let mut enter = 0.0_f64;
    let mut leave = reach;
    for axis in 0..3 {
        let inverse = 1.0 / direction[axis];
        let a = (-half_m[axis] - from[axis]) * inverse;
        let b = (half_m[axis] - from[axis]) * inverse;
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    enter < leave
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn box_shades_far_side_and_contact_corner() {
        let mut occluders = Occluders::new(0.25);
        occluders.add_box(Transform::translation(0.0, 0.0, 0.05), [0.05; 3]);
        let up = Vector3::z();
        let share = |x: f64, y: f64| occluders.light_frac(&Point3::new(x, y, 0.0), &up, 1);
        assert!(share(0.5, 0.5) > 0.99, "far away: {}", share(0.5, 0.5));
        assert!(
            share(0.055, 0.0) < 0.5,
            "in the shadow: {}",
            share(0.055, 0.0)
        );
        let before = share(-0.055, 0.0);
        assert!(before > 0.6 && before < 0.95, "in the lit corner: {before}");
    }

    #[test]
    fn rays_hit_ellipsoids() {
        let mut occluders = Occluders::new(0.25);
        let axes = [Vector3::x() * 0.2, Vector3::y() * 0.1, Vector3::z() * 0.1];
        occluders.add_ellipsoids(
            [(Point3::new(1.0, 0.0, 0.0), axes)].into_iter(),
            (Point3::new(1.0, 0.0, 0.0), 0.2),
        );
        let hits = |y: f64, reach: f64| {
            occluders.is_occluded(&[], &Point3::new(0.0, y, 0.0), &Vector3::x(), reach)
        };
        assert!(hits(0.09, 2.0) && !hits(0.11, 2.0) && !hits(0.0, 0.79) && hits(0.0, 0.81));
        assert!(!occluders.is_occluded(&[], &Point3::origin(), &-Vector3::x(), 2.0));
    }

    #[test]
    fn boxes_that_are_left_out_block_no_ray() {
        const REACH_M: f64 = 0.3;
        let mut occluders = Occluders::new(REACH_M);
        let random = RandomStream::new(1, &[]);
        let position = |ix: u64| {
            let at = [0, 1, 2].map(|axis| random.between(3 * ix + axis, -0.5, 0.5));
            Vector3::from(at)
        };
        for ix in 0..12 {
            let rotation_rad = Vector3::new(0.3, 0.1, 0.2) * ix as f64;
            occluders.add_box(
                Transform::new(position(ix), rotation_rad),
                [0.1, 0.05, 0.02],
            );
        }
        let all: Vec<&SolidBox> = occluders.boxes.iter().collect();
        let to_lamp = KEY.to_lamp();
        let side = to_lamp.cross(&Vector3::x()).normalize();
        let mut n_blocked = [0; 2];
        for ix in 100..2000 {
            let from = Point3::from(position(ix));
            let around = position(ix + 10_000).normalize();
            let to_edge = (to_lamp + side * KEY_SIZE).normalize();
            let is_hit = |solid: &&SolidBox| {
                [
                    solid.blocks(&from, &to_edge, 10.0),
                    solid.blocks(&from, &around, REACH_M),
                ]
            };
            for solid in all.iter().filter(|solid| is_hit(solid)[0]) {
                assert!(solid.is_in_cone(&from, &to_lamp, KEY_SIZE));
                n_blocked[0] += 1;
            }
            for solid in all.iter().filter(|solid| is_hit(solid)[1]) {
                assert!(solid.is_within(&from, REACH_M));
                n_blocked[1] += 1;
            }
        }
        assert!(n_blocked.iter().all(|n| *n > 50), "{n_blocked:?}");
    }
}
