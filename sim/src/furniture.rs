//! Assembles boxes into benches, shelves and clutter, and keeps the boxes for computing shadows.

use crate::lab_texture::picture;
use crate::light::Occluders;
use crate::mesh::{Mesh, TextureRect};
use crate::random::RandomStream;
use kinematics::Transform;
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};

/// Meshes by texture sheet, and the boxes they contain.
pub(crate) struct Furniture {
    /// Textured with the sheet of items.
    pub(crate) things: Mesh,
    /// Textured with the sheet of posters.
    pub(crate) posters: Mesh,
    /// Plain frames and legs.
    pub(crate) frames: Mesh,
    solids: Vec<(Transform, [f64; 3])>,
    random: RandomStream,
    n_drawn: u64,
}

/// An upright pose at a position, rotated about z.
pub(crate) fn upright(at_m: [f64; 3], yaw_degrees: f64) -> Transform {
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_degrees.to_radians());
    Transform::from_parts(Translation3::from(Vector3::from(at_m)), yaw)
}

/// Half length, half depth and height of the top of a light wooden bench, meters.
const BENCH_M: [f64; 3] = [0.9, 0.375, 0.85];
/// Half length, half depth and height of a shelf, meters.
const SHELF_M: [f64; 3] = [0.75, 0.22, 2.0];

impl Furniture {
    pub(crate) fn new(name: u64) -> Self {
        Self {
            things: Mesh::default(),
            posters: Mesh::default(),
            frames: Mesh::default(),
            solids: Vec::new(),
            random: RandomStream::new(0xf0_1a, &[name]),
            n_drawn: 0,
        }
    }

    /// The next random number.
    fn draw_uniform(&mut self, lower: f64, upper: f64) -> f64 {
        // Random numbers are drawn by index, so each draw needs its own index.
        self.n_drawn += 1;
        self.random.between(self.n_drawn, lower, upper)
    }

    fn draw_picture(&mut self, among: &[usize]) -> usize {
        self.n_drawn += 1;
        let n = among.len() as u64;
        among[usize::try_from(self.random.bits(self.n_drawn) % n)
            .expect("below the number of pictures")]
    }

    /// A box with one texture on its front (+x), back and sides, and another on its top.
    pub(crate) fn add_item(
        &mut self,
        world_from_box: &Transform,
        half_m: [f64; 3],
        front: usize,
        top: usize,
    ) {
        let around = picture(front);
        let above = picture(top);
        self.add_textured_box(
            world_from_box,
            half_m,
            &[around, around, around, around, above, above],
        );
    }

    fn add_textured_box(
        &mut self,
        world_from_box: &Transform,
        half_m: [f64; 3],
        sides: &[TextureRect; 6],
    ) {
        self.things
            .append_at(Mesh::cuboid(half_m, sides), world_from_box);
        self.solids.push((*world_from_box, half_m));
    }

    /// A plain box.
    pub(crate) fn frame(&mut self, world_from_box: &Transform, half_m: [f64; 3]) {
        self.frames.append_at(
            Mesh::cuboid(half_m, &[crate::mesh::WHOLE; 6]),
            world_from_box,
        );
        self.solids.push((*world_from_box, half_m));
    }

    /// A flat poster on a wall whose outward normal is the x axis of `world_from_wall`.
    pub(crate) fn poster(&mut self, world_from_wall: &Transform, half_m: [f64; 2], ix: usize) {
        /// Distance from the wall that avoids z-fighting, meters.
        const LIFT_M: f64 = 0.012;
        let mut mesh = Mesh::default();
        let center = Point3::new(LIFT_M, 0.0, 0.0);
        mesh.rectangle(
            center,
            Vector3::y() * half_m[0],
            Vector3::z() * half_m[1],
            picture(ix),
        );
        self.posters.append_at(mesh, world_from_wall);
    }

    /// A bench against a wall, facing along +x, with instruments, screens and cartons.
    pub(crate) fn bench(&mut self, world_from_bench: &Transform) {
        let [half_length, half_depth, top_m] = BENCH_M;
        let at = |x: f64, y: f64, z: f64| world_from_bench * Translation3::new(x, y, z);
        self.add_item(
            &at(0.0, 0.0, top_m),
            [half_depth, half_length, 0.025],
            12,
            2,
        );
        for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let leg = at(
                x * (half_depth - 0.05),
                y * (half_length - 0.05),
                0.5 * top_m,
            );
            self.frame(&leg, [0.025, 0.025, 0.5 * top_m - 0.025]);
        }
        let drawer_y = self.draw_uniform(-0.5, 0.5);
        self.add_item(&at(-0.05, drawer_y, 0.36), [0.26, 0.22, 0.36], 11, 12);
        let mut y = -half_length + 0.05;
        loop {
            let half = [
                self.draw_uniform(0.06, 0.2),
                self.draw_uniform(0.08, 0.2),
                self.draw_uniform(0.07, 0.24),
            ];
            y += half[1];
            // Items are placed from one end to the other until the next item does not fit.
            if y + half[1] > half_length {
                break;
            }
            let front = self.draw_picture(&[0, 1, 7, 8, 9, 9, 11, 13, 14, 15]);
            // The order of the draws determines which random numbers each item gets.
            let x = self.draw_uniform(-0.15, 0.12);
            let yaw = self.draw_uniform(-14.0, 14.0);
            let pose = at(x, y, top_m + 0.025 + half[2]) * upright([0.0; 3], yaw);
            self.add_item(&pose, half, front, 12);
            y += half[1] + self.draw_uniform(0.03, 0.16);
        }
    }

    /// A shelf of five boards, facing along +x, full of books and cartons.
    pub(crate) fn shelf(&mut self, world_from_shelf: &Transform) {
        let [half_length, half_depth, height_m] = SHELF_M;
        let at = |x: f64, y: f64, z: f64| world_from_shelf * Translation3::new(x, y, z);
        for side in [-1.0, 1.0] {
            self.add_item(
                &at(0.0, side * half_length, 0.5 * height_m),
                [half_depth, 0.015, 0.5 * height_m],
                3,
                3,
            );
        }
        self.frame(
            &at(-half_depth, 0.0, 0.5 * height_m),
            [0.006, half_length, 0.5 * height_m],
        );
        for board in 0..5 {
            let z = 0.08 + 0.42 * f64::from(board);
            self.add_item(&at(0.0, 0.0, z), [half_depth, half_length, 0.013], 2, 2);
            // The top board only closes the shelf.
            if board == 4 {
                break;
            }
            let mut y = -half_length + 0.03;
            loop {
                // The random numbers are drawn in this order. Another order would change the scene.
                let half = [
                    self.draw_uniform(0.10, 0.19),
                    self.draw_uniform(0.08, 0.26),
                    self.draw_uniform(0.09, 0.185),
                ];
                y += half[1];
                if y + half[1] > half_length - 0.02 {
                    break;
                }
                let front = self.draw_picture(&[0, 1, 4, 5, 6, 4, 5, 6, 10, 13, 14, 15]);
                let x = half_depth - half[0] - self.draw_uniform(0.0, 0.05);
                self.add_item(&at(x, y, z + 0.013 + half[2]), half, front, 12);
                y += half[1] + self.draw_uniform(0.005, 0.05);
            }
        }
    }

    /// A pile of crates and cartons.
    pub(crate) fn add_boxes(&mut self, world_from_boxes: &Transform, n_boxes: usize) {
        let mut z = 0.0;
        for _ in 0..n_boxes {
            let half = [
                self.draw_uniform(0.2, 0.32),
                self.draw_uniform(0.22, 0.36),
                self.draw_uniform(0.14, 0.26),
            ];
            let x = self.draw_uniform(-0.06, 0.06);
            let y = self.draw_uniform(-0.06, 0.06);
            // The boxes are slightly rotated, like boxes that were stacked by hand.
            let yaw = self.draw_uniform(-20.0, 20.0);
            let front = self.draw_picture(&[0, 1, 2, 3, 10, 11]);
            let pose = world_from_boxes * upright([x, y, z + half[2]], yaw);
            self.add_item(&pose, half, front, front);
            z += 2.0 * half[2];
        }
    }

    /// Adds all larger boxes as occluders. Shadows of small items on shelves would not be visible
    /// on the floor.
    pub(crate) fn add_occluders(&self, occluders: &mut Occluders) {
        /// Boxes count as large if half their side is at least this value, meters. With more boxes,
        /// computing the shadows takes longer.
        const MIN_HALF_M: f64 = 0.22;
        let large = |half_m: &[f64; 3]| half_m.iter().any(|half_m| *half_m >= MIN_HALF_M);
        for (world_from_box, half_m) in self.solids.iter().filter(|(_, half_m)| large(half_m)) {
            occluders.add_box(*world_from_box, *half_m);
        }
    }
}
