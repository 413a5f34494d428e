//! A box in space.

use kinematics::Transform;
use nalgebra::{Point3, Vector3};

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
        // In its own frame, the box is aligned with the axes, so the test is one comparison per
        // axis.
        let in_box = self
            .world_from_box
            .inverse_transform_point(&Point3::from(point_m));
        (0..3).all(|axis| (self.min_m[axis]..=self.max_m[axis]).contains(&in_box[axis]))
    }

    /// Whether the box certainly contains a whole ellipsoid. The result is also false for some
    /// ellipsoids that the box contains.
    ///
    /// * `half_axes_m`: half axes in world, in any order.
    #[must_use]
    pub fn contains_ellipsoid(&self, center_m: [f64; 3], half_axes_m: [[f64; 3]; 3]) -> bool {
        let box_from_world = self.world_from_box.inverse();
        let center = box_from_world * Point3::from(center_m);
        let half_axes = half_axes_m.map(|half_axis| box_from_world * Vector3::from(half_axis));
        (0..3).all(|axis| {
            // The ellipsoid extends this far in both directions of the axis.
            let extents = half_axes.map(|half_axis| half_axis[axis]);
            let extent = extents
                .iter()
                .map(|along| along * along)
                .sum::<f64>()
                .sqrt();
            center[axis] - extent >= self.min_m[axis] && center[axis] + extent <= self.max_m[axis]
        })
    }
}
