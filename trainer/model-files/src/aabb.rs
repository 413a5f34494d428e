//! A box in space.

use kinematics::Transform;
use nalgebra::Point3;

/// A box aligned with the axes of its frame, meters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Pose of the box's frame.
    pub world_from_box: Transform,
    /// Corner with the smallest coordinates.
    pub min_m: [f64; 3],
    /// Corner with the largest coordinates.
    pub max_m: [f64; 3],
}

impl Aabb {
    /// Whether the box contains a point in world.
    #[must_use]
    pub fn contains(&self, point_m: [f64; 3]) -> bool {
        // The box is aligned with its own axes, so the test is a comparison per axis in its frame.
        let in_box = self
            .world_from_box
            .inverse_transform_point(&Point3::from(point_m));
        (0..3).all(|axis| (self.min_m[axis]..=self.max_m[axis]).contains(&in_box[axis]))
    }
}
