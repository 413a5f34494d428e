//! Triangle meshes with normals and texture coordinates, in MuJoCo's binary format.

use kinematics::Transform;
use nalgebra::{Point3, Vector3};

/// Triangles whose vertices have a normal and a texture coordinate.
#[derive(Clone, Debug, Default)]
pub(crate) struct Mesh {
    points_m: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    texcoords: Vec<[f32; 2]>,
    faces: Vec<[i32; 3]>,
}

/// One vertex. `texcoord` is `(0, 0)` at the texture's top left.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Corner {
    pub(crate) point_m: Point3<f64>,
    pub(crate) normal: Vector3<f64>,
    pub(crate) texcoord: [f64; 2],
}

/// Texture rectangle: left, top, right, bottom.
pub(crate) type TextureRect = [f64; 4];

/// The whole texture.
pub(crate) const WHOLE: TextureRect = [0.0, 0.0, 1.0, 1.0];

impl Mesh {
    /// Position and normal of each vertex.
    pub(crate) fn corners(&self) -> impl Iterator<Item = (Point3<f64>, Vector3<f64>)> {
        let wide = |values: &[f32; 3]| values.map(f64::from);
        let both = self.points_m.iter().zip(&self.normals);
        both.map(move |(point, normal)| (wide(point).into(), wide(normal).into()))
    }

    /// Indices of the vertices of each triangle.
    pub(crate) fn faces(&self) -> impl Iterator<Item = [usize; 3]> {
        // Vertices are numbered from 0 when they are added.
        let ix = |ix: i32| usize::try_from(ix).expect("an index is not negative");
        self.faces.iter().map(move |face| face.map(ix))
    }

    /// Adds a vertex and returns its index.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the format holds f32 and i32"
    )]
    pub(crate) fn push(&mut self, corner: Corner) -> i32 {
        let Corner {
            point_m,
            normal,
            texcoord,
        } = corner;
        self.points_m
            .push([point_m.x as f32, point_m.y as f32, point_m.z as f32]);
        self.normals
            .push([normal.x as f32, normal.y as f32, normal.z as f32]);
        self.texcoords
            .push([texcoord[0] as f32, texcoord[1] as f32]);
        self.points_m.len() as i32 - 1
    }

    /// Adds a triangle, counterclockwise from outside.
    pub(crate) fn triangle(&mut self, corners: [i32; 3]) {
        self.faces.push(corners);
    }

    /// Adds a flat rectangle with the normal `right x up` and an upright texture.
    pub(crate) fn rectangle(
        &mut self,
        center: Point3<f64>,
        half_right: Vector3<f64>,
        half_up: Vector3<f64>,
        texture: TextureRect,
    ) {
        let normal = half_right.cross(&half_up).normalize();
        let [left, top, right, bottom] = texture;
        let corners = [
            (-1.0, -1.0, [left, bottom]),
            (1.0, -1.0, [right, bottom]),
            (1.0, 1.0, [right, top]),
            (-1.0, 1.0, [left, top]),
        ];
        let [a, b, c, d] = corners.map(|(across, up, texcoord)| {
            self.push(Corner {
                point_m: center + half_right * across + half_up * up,
                normal,
                texcoord,
            })
        });
        self.triangle([a, b, c]);
        self.triangle([a, c, d]);
    }

    /// A box around the origin. The texture rectangles are in the order +x, -x, +y, -y, +z, -z.
    pub(crate) fn cuboid(half_m: [f64; 3], textures: &[TextureRect; 6]) -> Self {
        let mut mesh = Self::default();
        for ((outward, right, up), texture) in BOX_FACES.iter().zip(textures) {
            let scale =
                |axis: &[f64; 3]| Vector3::from(*axis).component_mul(&Vector3::from(half_m));
            mesh.rectangle(
                Point3::from(scale(outward)),
                scale(right),
                scale(up),
                *texture,
            );
        }
        mesh
    }

    /// Adds an ellipsoid given by three perpendicular half axes. `texture_x` maps a point and its
    /// normal to the horizontal texture coordinate, and `texture_y` is constant.
    pub(crate) fn add_ellipsoid(
        &mut self,
        center: Point3<f64>,
        half_axes: [Vector3<f64>; 3],
        n_rings: u32,
        texture_x: impl Fn(&Point3<f64>, &Vector3<f64>) -> f64,
        texture_y: f64,
    ) {
        let n_sectors = 2 * n_rings;
        let first = i32::try_from(self.points_m.len()).expect("meshes stay small");
        for ring in 0..=n_rings {
            // The first and the last column have the same points but different texture coordinates,
            // so both are needed.
            for sector in 0..=n_sectors {
                let down = f64::from(ring) / f64::from(n_rings);
                let around = f64::from(sector) / f64::from(n_sectors);
                let direction = sphere_direction(down, around);
                let normal = ellipsoid_normal(&half_axes, &direction);
                let point_m = center
                    + half_axes[0] * direction.x
                    + half_axes[1] * direction.y
                    + half_axes[2] * direction.z;
                let texcoord = [texture_x(&point_m, &normal), texture_y];
                self.push(Corner {
                    point_m,
                    normal,
                    texcoord,
                });
            }
        }
        let row = i32::try_from(n_sectors + 1).expect("meshes stay small");
        for ring in 0..i32::try_from(n_rings).expect("meshes stay small") {
            for sector in 0..row - 1 {
                let [a, b] = [
                    first + ring * row + sector,
                    first + (ring + 1) * row + sector,
                ];
                self.triangle([a, b, b + 1]);
                self.triangle([a, b + 1, a + 1]);
            }
        }
    }

    /// Point and outward normal on a box's side at a position in its texture, 0 to 1 from the top
    /// left.
    pub(crate) fn on_cuboid(
        half_m: [f64; 3],
        side: usize,
        u: f64,
        v: f64,
    ) -> (Point3<f64>, Vector3<f64>) {
        let (outward, right, up) = BOX_FACES[side];
        let unit = Vector3::from(outward)
            + Vector3::from(right) * (2.0 * u - 1.0)
            + Vector3::from(up) * (1.0 - 2.0 * v);
        (
            Point3::from(unit.component_mul(&Vector3::from(half_m))),
            Vector3::from(outward),
        )
    }

    /// Translates every point.
    #[expect(clippy::cast_possible_truncation, reason = "the format holds f32")]
    pub(crate) fn translate(&mut self, by_m: Vector3<f64>) {
        for point in &mut self.points_m {
            *point = std::array::from_fn(|axis| (f64::from(point[axis]) + by_m[axis]) as f32);
        }
    }

    /// Adds another mesh, translated.
    pub(crate) fn append(&mut self, mut other: Self, by_m: Vector3<f64>) {
        other.translate(by_m);
        let first = i32::try_from(self.points_m.len()).expect("meshes stay small");
        self.points_m.extend(other.points_m);
        self.normals.extend(other.normals);
        self.texcoords.extend(other.texcoords);
        self.faces.extend(
            other
                .faces
                .iter()
                .map(|face| face.map(|corner| corner + first)),
        );
    }

    /// Adds another mesh, transformed.
    pub(crate) fn append_at(&mut self, mut other: Self, self_from_other: &Transform) {
        for (point, normal) in other.points_m.iter_mut().zip(&mut other.normals) {
            *point = (self_from_other.cast::<f32>() * Point3::from(*point))
                .coords
                .into();
            // A rigid motion rotates normals. A scaling would need the inverse transpose instead.
            *normal = (self_from_other.cast::<f32>() * Vector3::from(*normal)).into();
        }
        self.append(other, Vector3::zeros());
    }

    /// A surface of revolution about z. The profile is a list of `(radius, z)` in meters. The
    /// outside is on the right of an upward profile.
    ///
    /// The texture wraps around the axis once. Its top is at the first point of the profile. With
    /// `is_smooth`, normals are averaged where pieces of the profile meet.
    pub(crate) fn lathe(
        profile_m: &[[f64; 2]],
        n_sectors: u32,
        texture: TextureRect,
        is_smooth: bool,
    ) -> Self {
        let mut mesh = Self::default();
        let [left, top, right, bottom] = texture;
        let n_pieces = profile_m.len() - 1;
        // Pieces do not share vertices, because sharp edges need two normals at the same point.
        for piece in 0..n_pieces {
            let mut before: Option<[i32; 2]> = None;
            for sector in 0..=n_sectors {
                let share = f64::from(sector) / f64::from(n_sectors);
                let (sin, cos) = (share * std::f64::consts::TAU).sin_cos();
                let turned = |v: Vector3<f64>| Vector3::new(v.x * cos, v.x * sin, v.z);
                let ring = [0, 1].map(|end| {
                    let [radius, z] = profile_m[piece + end];
                    let down = (piece + end) as f64 / n_pieces as f64;
                    mesh.push(Corner {
                        point_m: Point3::new(radius * cos, radius * sin, z),
                        normal: turned(profile_normal(profile_m, piece, end, is_smooth)),
                        texcoord: [left + (right - left) * share, top + (bottom - top) * down],
                    })
                });
                if let Some([low, high]) = before {
                    mesh.triangle([low, ring[0], ring[1]]);
                    mesh.triangle([low, ring[1], high]);
                }
                before = Some(ring);
            }
        }
        mesh
    }

    /// The bytes of MuJoCo's `.msh` format. They are four counts, then points, normals, texture
    /// coordinates and faces.
    pub(crate) fn to_msh(&self) -> Vec<u8> {
        let n_points = i32::try_from(self.points_m.len()).expect("meshes stay small");
        let n_faces = i32::try_from(self.faces.len()).expect("meshes stay small");
        let mut bytes = Vec::new();
        for count in [n_points, n_points, n_points, n_faces] {
            bytes.extend(count.to_le_bytes());
        }
        for number in self
            .points_m
            .iter()
            .flatten()
            .chain(self.normals.iter().flatten())
            .chain(self.texcoords.iter().flatten())
        {
            bytes.extend(number.to_le_bytes());
        }
        for index in self.faces.iter().flatten() {
            bytes.extend(index.to_le_bytes());
        }
        bytes
    }
}

/// Outward normal of a piece of a profile, in the plane y = 0.
fn piece_normal(profile_m: &[[f64; 2]], piece: usize) -> Vector3<f64> {
    let [a, b] = [profile_m[piece], profile_m[piece + 1]];
    Vector3::new(b[1] - a[1], 0.0, a[0] - b[0]).normalize()
}

/// Normal at an end of a piece, where 0 is its start and 1 is its end. With `is_smooth`, it is the
/// mean of the normals of the two pieces that meet there.
fn profile_normal(
    profile_m: &[[f64; 2]],
    piece: usize,
    end: usize,
    is_smooth: bool,
) -> Vector3<f64> {
    let n_pieces = profile_m.len() - 1;
    let neighbor = if end == 0 {
        piece.checked_sub(1)
    } else {
        Some(piece + 1)
    };
    let neighbor = neighbor.filter(|neighbor| *neighbor < n_pieces && is_smooth);
    let neighbor_normal =
        neighbor.map_or_else(Vector3::zeros, |neighbor| piece_normal(profile_m, neighbor));
    (piece_normal(profile_m, piece) + neighbor_normal).normalize()
}

/// Outward, right and up directions of a box's faces in the order +x, -x, +y, -y, +z, -z. On the
/// sides, up is +z.
pub(crate) const BOX_FACES: [([f64; 3], [f64; 3], [f64; 3]); 6] = [
    ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
    ([-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]),
    ([0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
    ([0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
    ([0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]),
    ([0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]),
];

/// Direction on the unit sphere. `down` goes from 0 at +z to 1 at -z, and `around` goes from 0 to 1
/// about z.
pub(crate) fn sphere_direction(down: f64, around: f64) -> Vector3<f64> {
    let (sin_down, cos_down) = (down * std::f64::consts::PI).sin_cos();
    let (sin_around, cos_around) = (around * std::f64::consts::TAU).sin_cos();
    Vector3::new(sin_down * cos_around, sin_down * sin_around, cos_down)
}

/// Outward normal of an ellipsoid at the point that corresponds to `direction` on the unit sphere.
/// The half axes are perpendicular.
pub(crate) fn ellipsoid_normal(
    half_axes: &[Vector3<f64>; 3],
    direction: &Vector3<f64>,
) -> Vector3<f64> {
    let sum = half_axes[0] * (direction.x / half_axes[0].norm_squared())
        + half_axes[1] * (direction.y / half_axes[1].norm_squared())
        + half_axes[2] * (direction.z / half_axes[2].norm_squared());
    sum.normalize()
}
