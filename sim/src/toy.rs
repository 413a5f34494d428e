//! A furry toy donkey. It has a body of ellipsoids, and thousands of hairs in one mesh.

use crate::mesh::{Corner, Mesh, ellipsoid_normal, sphere_direction};
use crate::random::RandomStream;
use crate::texture::{FUR_DARKEST, FurBand};
use nalgebra::{Point3, UnitQuaternion, Vector3};

/// One part of the body, which is an ellipsoid with or without hair.
struct Part {
    center_m: [f64; 3],
    /// Half sizes along the part's axes.
    half_m: [f64; 3],
    /// Rotation about y, radians. A positive rotation tips the part's x axis down.
    pitch_rad: f64,
    /// Rotation about x, applied before `pitch_rad`, radians.
    roll_rad: f64,
    band: FurBand,
    n_hairs: u64,
    hair_m: f64,
}

const fn part(
    center_m: [f64; 3],
    half_m: [f64; 3],
    pitch_rad: f64,
    roll_rad: f64,
    band: FurBand,
) -> Part {
    Part {
        center_m,
        half_m,
        pitch_rad,
        roll_rad,
        band,
        n_hairs: 0,
        hair_m: 0.0,
    }
}

impl Part {
    const fn with_hair(self, n_hairs: u64, hair_m: f64) -> Self {
        Self {
            n_hairs,
            hair_m,
            ..self
        }
    }

    fn half_axes(&self) -> [Vector3<f64>; 3] {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), self.pitch_rad)
            * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), self.roll_rad);
        [
            rotation * Vector3::new(self.half_m[0], 0.0, 0.0),
            rotation * Vector3::new(0.0, self.half_m[1], 0.0),
            rotation * Vector3::new(0.0, 0.0, self.half_m[2]),
        ]
    }

    fn center(&self) -> Point3<f64> {
        Point3::from(self.center_m)
    }
}

/// Twice the factor by which the hair counts below are multiplied. More hairs make the coat denser,
/// but the mesh then takes longer to draw.
const DENSITY: u64 = 3;

/// The toy stands on z = 0, looks along x, and is 0.15 m high.
const PARTS: [Part; 22] = [
    // Trunk, chest and belly.
    part(
        [0.0, 0.0, 0.062],
        [0.048, 0.027, 0.027],
        0.0,
        0.0,
        FurBand::Coat,
    )
    .with_hair(900, 0.010),
    part(
        [0.034, 0.0, 0.068],
        [0.024, 0.024, 0.027],
        -0.3,
        0.0,
        FurBand::Coat,
    )
    .with_hair(300, 0.010),
    part(
        [0.0, 0.0, 0.052],
        [0.038, 0.021, 0.020],
        0.0,
        0.0,
        FurBand::Light,
    )
    .with_hair(160, 0.009),
    // Neck, head, muzzle.
    part(
        [0.052, 0.0, 0.092],
        [0.028, 0.016, 0.019],
        -0.95,
        0.0,
        FurBand::Coat,
    )
    .with_hair(350, 0.008),
    part(
        [0.070, 0.0, 0.113],
        [0.026, 0.018, 0.020],
        0.35,
        0.0,
        FurBand::Coat,
    )
    .with_hair(400, 0.006),
    part(
        [0.090, 0.0, 0.104],
        [0.016, 0.014, 0.014],
        0.35,
        0.0,
        FurBand::Light,
    )
    .with_hair(160, 0.003),
    // Nostrils and eyes.
    part(
        [0.1045, 0.006, 0.103],
        [0.002, 0.002, 0.0028],
        0.35,
        0.0,
        FurBand::Dark,
    ),
    part(
        [0.1045, -0.006, 0.103],
        [0.002, 0.002, 0.0028],
        0.35,
        0.0,
        FurBand::Dark,
    ),
    part(
        [0.079, 0.0165, 0.119],
        [0.0042, 0.0030, 0.0048],
        0.3,
        0.0,
        FurBand::Dark,
    ),
    part(
        [0.079, -0.0165, 0.119],
        [0.0042, 0.0030, 0.0048],
        0.3,
        0.0,
        FurBand::Dark,
    ),
    // Ears and their insides.
    part(
        [0.060, 0.014, 0.143],
        [0.006, 0.009, 0.024],
        -0.25,
        -0.30,
        FurBand::Coat,
    )
    .with_hair(180, 0.005),
    part(
        [0.060, -0.014, 0.143],
        [0.006, 0.009, 0.024],
        -0.25,
        0.30,
        FurBand::Coat,
    )
    .with_hair(180, 0.005),
    part(
        [0.0635, 0.014, 0.143],
        [0.005, 0.0062, 0.019],
        -0.25,
        -0.30,
        FurBand::Pink,
    ),
    part(
        [0.0635, -0.014, 0.143],
        [0.005, 0.0062, 0.019],
        -0.25,
        0.30,
        FurBand::Pink,
    ),
    // Legs, then hooves.
    part(
        [0.034, 0.016, 0.028],
        [0.011, 0.010, 0.026],
        0.0,
        0.0,
        FurBand::Coat,
    )
    .with_hair(130, 0.006),
    part(
        [0.034, -0.016, 0.028],
        [0.011, 0.010, 0.026],
        0.0,
        0.0,
        FurBand::Coat,
    )
    .with_hair(130, 0.006),
    part(
        [-0.034, 0.016, 0.028],
        [0.012, 0.011, 0.026],
        0.1,
        0.0,
        FurBand::Coat,
    )
    .with_hair(130, 0.006),
    part(
        [-0.034, -0.016, 0.028],
        [0.012, 0.011, 0.026],
        0.1,
        0.0,
        FurBand::Coat,
    )
    .with_hair(130, 0.006),
    part(
        [0.035, 0.016, 0.006],
        [0.012, 0.011, 0.006],
        0.0,
        0.0,
        FurBand::Dark,
    ),
    part(
        [0.035, -0.016, 0.006],
        [0.012, 0.011, 0.006],
        0.0,
        0.0,
        FurBand::Dark,
    ),
    part(
        [-0.037, 0.016, 0.006],
        [0.012, 0.011, 0.006],
        0.0,
        0.0,
        FurBand::Dark,
    ),
    part(
        [-0.037, -0.016, 0.006],
        [0.012, 0.011, 0.006],
        0.0,
        0.0,
        FurBand::Dark,
    ),
];

/// Fraction of light at a point of the toy, given the normal there and the sample's index.
pub(crate) type Light<'a> = &'a dyn Fn(&Point3<f64>, &Vector3<f64>, u64) -> f64;

/// The parts that block light: centers and half axes.
pub(crate) fn ellipsoids() -> impl Iterator<Item = (Point3<f64>, [Vector3<f64>; 3])> {
    PARTS.iter().map(|part| (part.center(), part.half_axes()))
}

/// A sphere around the toy: center and radius, meters.
pub(crate) fn bounds() -> (Point3<f64>, f64) {
    (Point3::new(0.02, 0.0, 0.085), 0.115)
}

/// The smooth body under the fur.
pub(crate) fn body(light: Light<'_>) -> Mesh {
    let mut mesh = Mesh::default();
    for part in &PARTS {
        let [tip, root] = part.band.rows();
        // Skin under hair has a color close to the color of the roots. Bare skin has the middle
        // color of the band.
        let texture_y = if part.n_hairs > 0 {
            0.3 * tip + 0.7 * root
        } else {
            0.5 * (tip + root)
        };
        let texture_x =
            |point: &Point3<f64>, normal: &Vector3<f64>| skin_texture_x(light, point, normal);
        mesh.add_ellipsoid(part.center(), part.half_axes(), 10, texture_x, texture_y);
    }
    mesh
}

/// Horizontal position in the fur texture of a point of the skin.
fn skin_texture_x(light: Light<'_>, point: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
    // Brightness varies at the scale of tufts, so that skin between hairs does not look bare.
    let tuft =
        RandomStream::new(0x70f7, &[point.x.to_bits(), point.z.to_bits()]).between(0, 0.45, 0.9);
    texture_x(tuft * light(point, normal, 0))
}

/// Horizontal position in the fur texture for a brightness.
fn texture_x(brightness: f64) -> f64 {
    ((brightness - FUR_DARKEST) / (1.0 - FUR_DARKEST)).clamp(0.0, 1.0)
}

/// All hairs: coat, mane, forelock and tail.
pub(crate) fn fur(light: Light<'_>) -> Mesh {
    let mut mesh = Mesh::default();
    for (ix, part) in PARTS.iter().enumerate() {
        let random = RandomStream::new(0xf0_44, &[ix as u64]);
        let half_axes = part.half_axes();
        for hair in 0..DENSITY * part.n_hairs / 2 {
            // The directions are evenly distributed over a sphere, because the cosine of the polar
            // angle is uniform.
            let down = (1.0 - 2.0 * random.unit(8 * hair)).acos() / std::f64::consts::PI;
            let direction = sphere_direction(down, random.unit(8 * hair + 1));
            let root = part.center()
                + half_axes[0] * direction.x
                + half_axes[1] * direction.y
                + half_axes[2] * direction.z;
            // Hairs that start inside another part would stick out of its surface.
            if is_inside_another(&root, ix) {
                continue;
            }
            let normal = ellipsoid_normal(&half_axes, &direction);
            let length_m = part.hair_m * random.between(8 * hair + 2, 0.8, 1.5);
            let hair_at = Hair {
                root,
                normal,
                length_m,
                width_m: 0.0011,
                band: part.band,
            };
            grow_hair(&mut mesh, light, random, 8 * hair + 3, &hair_at);
        }
    }
    add_mane(&mut mesh, light);
    add_tail(&mut mesh, light);
    mesh
}

fn is_inside_another(point: &Point3<f64>, own_ix: usize) -> bool {
    PARTS.iter().enumerate().any(|(ix, part)| {
        // The axes are perpendicular, so projections on the axes give the coordinates in the unit
        // sphere.
        let offset = point - part.center();
        let share: f64 = part
            .half_axes()
            .iter()
            .map(|axis| (axis.dot(&offset) / axis.norm_squared()).powi(2))
            .sum();
        ix != own_ix && share < 0.9
    })
}

struct Hair {
    root: Point3<f64>,
    normal: Vector3<f64>,
    length_m: f64,
    width_m: f64,
    band: FurBand,
}

/// Adds a tapered hair of two segments that leans back and droops. Uses five random counters.
fn grow_hair(mesh: &mut Mesh, light: Light<'_>, random: RandomStream, counter: u64, hair: &Hair) {
    let jitter = Vector3::new(
        random.between(counter, -0.45, 0.45),
        random.between(counter + 1, -0.45, 0.45),
        random.between(counter + 2, -0.45, 0.45),
    );
    // The coat lies back and down, with the variation of real hair.
    let combed = Vector3::new(-0.55, 0.0, -0.25);
    let start = (hair.normal * 0.9 + combed * 0.8 + jitter).normalize();
    let end = (start + combed * 0.9 + Vector3::new(0.0, 0.0, -0.35)).normalize();
    let middle = hair.root + start * (0.55 * hair.length_m);
    let tip = middle + end * (0.45 * hair.length_m);
    let side = start.cross(&Vector3::new(0.3, 0.2, 0.9)).normalize();
    let across = start.cross(&side);
    // Light is sampled above the skin, where the hair is. At its root, the hair would shade itself.
    let share = light(
        &(hair.root + hair.normal * (0.6 * hair.length_m)),
        &hair.normal,
        counter,
    );
    let tone = texture_x(share * random.between(counter + 3, 0.45, 1.0));
    let [band_tip, band_root] = hair.band.rows();
    let corners = [0.0, 1.0, 2.0].map(|third: f64| {
        let (sin, cos) = (third / 3.0 * std::f64::consts::TAU).sin_cos();
        side * cos + across * sin
    });
    let row = |share: f64| band_root + (band_tip - band_root) * share;
    // Blending in the skin's normal shades the coat as one surface.
    let shade = |outward: &Vector3<f64>| (outward * 0.5 + hair.normal).normalize();
    let mut ring = |center: Point3<f64>, radius: f64, share: f64| {
        corners.map(|outward| {
            mesh.push(Corner {
                point_m: center + outward * radius,
                normal: shade(&outward),
                texcoord: [tone, row(share)],
            })
        })
    };
    let below = ring(hair.root, 0.5 * hair.width_m, 0.0);
    let above = ring(middle, 0.36 * hair.width_m, 0.6);
    let top = mesh.push(Corner {
        point_m: tip,
        normal: shade(&end),
        texcoord: [tone, row(1.0)],
    });
    for ix in 0..3 {
        let next = (ix + 1) % 3;
        mesh.triangle([below[ix], below[next], above[next]]);
        mesh.triangle([below[ix], above[next], above[ix]]);
        mesh.triangle([above[ix], above[next], top]);
    }
}

fn add_mane(mesh: &mut Mesh, light: Light<'_>) {
    let random = RandomStream::new(0xf0_44, &[100]);
    let line = [
        Point3::new(0.020, 0.0, 0.093),
        Point3::new(0.036, 0.0, 0.110),
        Point3::new(0.052, 0.0, 0.132),
        Point3::new(0.078, 0.0, 0.132),
    ];
    for hair in 0..420 {
        let piece = usize::try_from(random.bits(9 * hair) % 3).expect("below 3");
        let along = random.unit(9 * hair + 8);
        let root = line[piece] + (line[piece + 1] - line[piece]) * along;
        let aside = random.between(9 * hair + 1, -0.005, 0.005);
        let normal = Vector3::new(-0.35, 60.0 * aside, 0.9).normalize();
        let length_m = random.between(9 * hair + 2, 0.012, 0.022);
        let root = root + Vector3::new(0.0, aside, -0.004);
        grow_hair(
            mesh,
            light,
            random,
            9 * hair + 3,
            &Hair {
                root,
                normal,
                length_m,
                width_m: 0.0013,
                band: FurBand::Dark,
            },
        );
    }
}

fn add_tail(mesh: &mut Mesh, light: Light<'_>) {
    let random = RandomStream::new(0xf0_44, &[101]);
    for hair in 0..160 {
        let along = random.unit(9 * hair);
        let root = Point3::new(
            -0.046 - 0.020 * along,
            random.between(9 * hair + 1, -0.003, 0.003),
            0.075 - 0.030 * along,
        );
        let normal = Vector3::new(-0.5, 0.0, -0.8).normalize();
        let length_m = 0.012 + 0.016 * along;
        grow_hair(
            mesh,
            light,
            random,
            9 * hair + 3,
            &Hair {
                root,
                normal,
                length_m,
                width_m: 0.0013,
                band: FurBand::Dark,
            },
        );
    }
}
