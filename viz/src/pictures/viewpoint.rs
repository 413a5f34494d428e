//! The viewpoint of a client: a position and a direction. It determines which chunks of a model the
//! client gets first.

use crate::pictures::view_request::ViewRequest;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use trainer::{ChunkLayout, MAX_MESH_COUNT, Projection};

/// The camera of the newest pinhole picture of a client's main view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Viewpoint {
    camera_from_world: Transform,
    /// Angle between the axis of the camera and the corner of the picture that is farthest from it.
    half_angle_rad: f64,
}

impl Viewpoint {
    /// The viewpoint of a request; `None` if it is for a named view or shows all directions.
    pub(crate) fn of(view_request: &ViewRequest) -> Option<Self> {
        // Operators look mostly at the main view, and less at named views, such as the view in a
        // corner.
        let request = &view_request.request;
        if !view_request.view.is_empty() {
            return None;
        }
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = request.projection
        else {
            return None;
        };
        // Tangents of the angles to the farther edge along x and y. A cone through the corner
        // contains the whole picture, and is easier to test against than a pyramid.
        let tangents = [0, 1].map(|axis| {
            let side = f64::from(request.size_px[axis]);
            let principal = principal_px[axis];
            principal.abs().max((side - principal).abs()) / focal_px[axis]
        });
        Some(Self {
            camera_from_world: request.world_from_camera.inverse(),
            half_angle_rad: tangents[0].hypot(tangents[1]).atan(),
        })
    }

    /// The order in which chunks are needed. Chunks in view have the lowest ranks, and among them,
    /// nearer chunks have lower ranks.
    pub(crate) fn rank(&self, world_from_model: &Transform, layout: &ChunkLayout) -> (bool, f64) {
        let (center, radius_m) = bounds(layout);
        let in_camera = (self.camera_from_world * world_from_model * center).coords;
        let distance_m = in_camera.norm();
        // If the camera is inside the sphere, the angle to the sphere is not defined.
        let is_around = distance_m <= radius_m;
        // The sphere touches the cone if its center is outside by at most the angle of its radius.
        let is_in_view = is_around
            || in_camera.angle(&Vector3::z()) - (radius_m / distance_m).asin()
                <= self.half_angle_rad;
        (!is_in_view, distance_m)
    }
}

/// Center and radius of a sphere around a chunk, in the frame of the model.
fn bounds(layout: &ChunkLayout) -> (Point3<f64>, f64) {
    // A sphere does not depend on the direction of the camera, and chunks are about as wide as
    // high.
    let [min, max] = match layout {
        ChunkLayout::Mesh {
            origin_m,
            meters_per_count,
            ..
        } => [
            *origin_m,
            origin_m.map(|origin| origin + f64::from(MAX_MESH_COUNT) * meters_per_count),
        ],
        ChunkLayout::Splats { min_m, max_m, .. } => {
            [min_m, max_m].map(|corner| corner.map(f64::from))
        }
    }
    .map(Point3::from);
    (nalgebra::center(&min, &max), 0.5 * (max - min).norm())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::Viewpoint;
    use crate::pictures::view_request::ViewRequest;
    use kinematics::Transform;
    use serde_json::json;
    use trainer::{ChunkLayout, MAX_MESH_COUNT};

    /// A camera at the origin that looks along z, with a field of view of 90 degrees, moved and
    /// turned about y.
    pub(crate) fn viewpoint(x_m: f64, angle_rad: f64) -> Viewpoint {
        Viewpoint::of(&request("", x_m, angle_rad)).expect("a pinhole")
    }

    fn request(view: &str, x_m: f64, angle_rad: f64) -> ViewRequest {
        let (sine, cosine) = angle_rad.sin_cos();
        let message = json!({
            "id": 1, "view": view, "size_px": [100, 2], "projection": {"kind": "pinhole", "focal_px": [50, 50]},
            "world_from_camera": [cosine, 0, sine, x_m, 0, 1, 0, 0, -sine, 0, cosine, 0, 0, 0, 0, 1],
        });
        let message = serde_json::from_value(message).expect("a message");
        ViewRequest::check(&message).expect("valid")
    }

    /// Splats in a cube with sides of 0.2 m.
    pub(crate) fn cube(center: [f32; 3]) -> ChunkLayout {
        ChunkLayout::Splats {
            n_splats: 1,
            min_m: center.map(|along| along - 0.1),
            max_m: center.map(|along| along + 0.1),
            log_scale_range: [-5.0, -1.0],
            scale_factor: 1.0,
            sh_degree: 0,
            sh_ranges: [0.0; 2],
            is_antialiased: false,
        }
    }

    #[test]
    fn named_views_are_no_viewpoints() {
        assert!(
            Viewpoint::of(&request("", 0.0, 0.0)).is_some()
                && Viewpoint::of(&request("inset", 0.0, 0.0)).is_none()
        );
    }

    #[test]
    fn bounds_of_a_mesh_chunk_end_at_its_largest_count() {
        let side_m = 1.0;
        let layout = ChunkLayout::Mesh {
            origin_m: [0.0, 0.0, -1.5],
            meters_per_count: side_m / f64::from(MAX_MESH_COUNT),
            n_vertices: 3,
            n_triangles: 1,
        };
        let (is_outside, distance_m) = viewpoint(0.0, 0.0).rank(&Transform::identity(), &layout);
        assert!(
            (distance_m - 1.5_f64.sqrt()).abs() < 1e-9,
            "{distance_m} m to the center"
        );
        assert!(is_outside, "the chunk ends behind the camera");
    }

    #[test]
    fn chunks_in_view_come_first_and_the_nearest_of_them() {
        let rank =
            |viewpoint: &Viewpoint, center| viewpoint.rank(&Transform::identity(), &cube(center));
        let ahead = viewpoint(0.0, 0.0);
        let cases = [
            ([0.0, 0.0, 1.0], 1.0),
            ([4.9, 0.0, 5.0], 7.0),
            ([0.1, 0.0, 0.0], 0.1),
            ([1.05, 0.0, 1.0], 1.45),
        ];
        for (center, distance_m) in cases {
            let (is_outside, got_m) = rank(&ahead, center);
            assert!(
                !is_outside && (got_m - distance_m).abs() < 0.01,
                "{center:?}: {is_outside}, {got_m} m"
            );
        }
        for center in [[0.0, 0.0, -1.0], [1.3, 0.0, 1.0], [0.0, 2.0, 1.0]] {
            assert!(rank(&ahead, center).0, "{center:?} is not in view");
            assert!(
                rank(&ahead, center) > rank(&ahead, [0.0, 0.0, 50.0]),
                "it comes after all that are"
            );
        }
        assert!(
            !rank(&viewpoint(0.0, std::f64::consts::PI), [0.0, 0.0, -1.0]).0,
            "the view has turned"
        );
        let moved = Transform::translation(0.0, 0.0, 3.0);
        assert!(
            (ahead.rank(&moved, &cube([0.0, 0.0, 1.0])).1 - 4.0).abs() < 1e-6,
            "the model has moved"
        );
    }
}
