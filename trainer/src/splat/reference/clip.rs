//! Clipping of splats at the crop box and in erased space, pixel by pixel.
//!
//! A splat is drawn at a pixel only if the point with the largest density along the pixel's ray is
//! shown. In the linear approximation of the projection (Zwicker et al. 2001), this point is the
//! conditional mean of the Gaussian given the pixel. The center of the splat is not sufficient,
//! because a long splat with its center inside a box can reach far beyond the box.

use super::project::{mean_given_pixel, row_share};
use super::{Splat, View};
use model_files::edits::Edit;
use model_files::{Aabb, Edits};
use nalgebra::{Matrix3x2, Vector2, Vector3};

/// The space that is shown.
#[derive(Clone, Debug, Default)]
pub struct Clipping {
    /// Only the inside of this box is shown.
    pub crop: Option<Aabb>,
    /// The space that is erased from pictures. Boxes are cut out of splats. Cells remove splats
    /// whose centers they contain.
    pub edits: Edits,
}

impl Clipping {
    /// Whether everything is shown.
    pub(super) fn is_empty(&self) -> bool {
        self.crop.is_none() && self.edits.is_empty()
    }

    /// Whether a splat is drawn at `offset_px` from its center.
    pub(super) fn shows(&self, points: &RayPoints, offset_px: [f64; 2]) -> bool {
        let point_m = points.at(offset_px);
        let is_erased = self.edits.as_slice().iter().any(|edit| match edit {
            Edit::Box(erased) => erased.contains(point_m),
            Edit::Cells(cells) => cells.contains(points.mean.into()),
        });
        !is_erased && self.crop.is_none_or(|crop| crop.contains(point_m))
    }

    /// Smallest distance of the point at `offset_px` from a side of a box, meters. It is infinite
    /// without boxes.
    #[cfg(test)]
    pub(super) fn margin_m(&self, points: &RayPoints, offset_px: [f64; 2]) -> f64 {
        let point_m = points.at(offset_px);
        let erased = self.edits.as_slice().iter().filter_map(|edit| match edit {
            Edit::Box(erased) => Some(erased),
            Edit::Cells(_) => None,
        });
        erased
            .chain(&self.crop)
            .map(|aabb| distance_from_sides_m(aabb, point_m))
            .fold(f64::INFINITY, f64::min)
    }
}

/// Smallest distance of a point from the planes of a box, meters.
#[cfg(test)]
fn distance_from_sides_m(aabb: &Aabb, point_m: [f64; 3]) -> f64 {
    let in_box = aabb
        .world_from_box
        .inverse_transform_point(&nalgebra::Point3::from(point_m));
    (0..3)
        .flat_map(|axis| [aabb.min_m[axis], aabb.max_m[axis]].map(|side| in_box[axis] - side))
        .map(f64::abs)
        .fold(f64::INFINITY, f64::min)
}

/// The points at which the density of a splat is largest along the rays of the pixels.
#[derive(Clone, Debug)]
pub(super) struct RayPoints {
    /// Center of the splat in world, meters.
    mean: Vector3<f64>,
    /// Change of the point per pixel, meters.
    point_per_px: Matrix3x2<f64>,
}

impl RayPoints {
    pub(super) fn new(view: &View, splat: &Splat) -> Self {
        Self {
            mean: Vector3::from(splat.mean),
            point_per_px: mean_given_pixel(view, splat, row_share(view, splat)),
        }
    }

    /// The point for the pixel at `offset_px` from the center of the splat, in world coordinates,
    /// meters.
    fn at(&self, offset_px: [f64; 2]) -> [f64; 3] {
        (self.mean + self.point_per_px * Vector2::from(offset_px)).into()
    }
}
