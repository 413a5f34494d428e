//! Capsules that enclose the shapes of a URDF.

use crate::capsule::Capsule;
use kinematics::Transform;
use kinematics::shape::{Geometry, Shape};
use nalgebra::{Matrix3, Vector3};

/// Maximum number of capsules for a flat box. More capsules follow the box more closely, but take
/// more time in every cycle.
const MAX_STRIPS: u32 = 6;

/// Capsules that enclose a shape, in the frame of its link. Empty if the vertices of a mesh are not
/// known.
///
/// * `vertices_of`: vertices of a mesh file in the frame of the mesh, without scale, meters.
pub(crate) fn enclosing_capsules(
    shape: &Shape,
    vertices_of: &dyn Fn(&str) -> Option<Vec<[f64; 3]>>,
) -> Vec<Capsule> {
    let in_shape = match &shape.geometry {
        Geometry::Sphere { radius_m } => vec![along_z(0.0, *radius_m)],
        // The half spheres at the ends of a cylinder extend beyond it, but its sides are exact.
        Geometry::Capsule { radius_m, length_m } | Geometry::Cylinder { radius_m, length_m } => {
            vec![along_z(*length_m, *radius_m)]
        }
        Geometry::Box { size_m } => strips(*size_m),
        Geometry::Mesh { file, scale } => {
            let vertices = vertices_of(file).unwrap_or_default();
            let scaled: Vec<Vector3<f64>> = vertices
                .iter()
                .map(|vertex| Vector3::from(*vertex).component_mul(&Vector3::from(*scale)))
                .filter(|vertex| vertex.iter().all(|coordinate| coordinate.is_finite()))
                .collect();
            around_points(&scaled).into_iter().collect()
        }
    };
    in_link(&in_shape, &shape.link_from_shape)
}

fn in_link(in_shape: &[Capsule], link_from_shape: &Transform) -> Vec<Capsule> {
    in_shape
        .iter()
        .map(|capsule| capsule.transformed(link_from_shape))
        .collect()
}

fn along_z(length_m: f64, radius_m: f64) -> Capsule {
    let end = Vector3::z() * (0.5 * length_m);
    Capsule {
        ends: [-end, end],
        radius_m,
    }
}

/// Parallel capsules along the longest side of a box. One capsule around a plate would be as thick
/// as the plate is wide.
fn strips(size_m: [f64; 3]) -> Vec<Capsule> {
    let mut axes = [0, 1, 2];
    axes.sort_by(|a, b| size_m[*b].total_cmp(&size_m[*a]));
    let [long, wide, thin] = axes;
    let half_m = size_m.map(|size| 0.5 * size);
    // With strips as wide as the box is thick, the capsules extend beyond a face by 0.2 times this
    // thickness.
    let n_strips = (1..MAX_STRIPS)
        .find(|n| size_m[wide] <= f64::from(*n) * size_m[thin])
        .unwrap_or(MAX_STRIPS);
    let half_strip_m = half_m[wide] / f64::from(n_strips);
    let strip = |ix: u32| {
        let mut center = Vector3::zeros();
        center[wide] = half_strip_m * f64::from(2 * ix + 1) - half_m[wide];
        let mut end = Vector3::zeros();
        end[long] = half_m[long];
        Capsule {
            ends: [center - end, center + end],
            radius_m: half_strip_m.hypot(half_m[thin]),
        }
    };
    (0..n_strips).map(strip).collect()
}

/// A capsule around points, along their longest principal axis. It encloses their convex hull.
fn around_points(points: &[Vector3<f64>]) -> Option<Capsule> {
    let mean = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let first = points.first()?;
    let mut covariance = Matrix3::zeros();
    for point in points {
        covariance += (point - mean) * (point - mean).transpose();
    }
    let axes = covariance.symmetric_eigen().eigenvectors;
    // The axis is in the center of the extent, because a mean is drawn to where vertices are dense.
    let mut low = axes.transpose() * first;
    let mut high = low;
    for point in points {
        let in_axes = axes.transpose() * point;
        low = low.inf(&in_axes);
        high = high.sup(&in_axes);
    }
    let center = axes * ((low + high) * 0.5);
    let extent = high - low;
    let direction = axes.column(extent.imax()).into_owned();
    let split = |point: &Vector3<f64>| {
        let from_center = point - center;
        let along_m = from_center.dot(&direction);
        (along_m, (from_center - direction * along_m).norm())
    };
    let radius_m = points
        .iter()
        .map(|point| split(point).1)
        .fold(0.0, f64::max);
    // A point at `along` and `across` is inside if the segment comes within `reach` of it along the
    // axis. The segment must therefore start at or before the smallest `along + reach`, and end at
    // or after the largest `along - reach`.
    let mut start_m = f64::INFINITY;
    let mut end_m = f64::NEG_INFINITY;
    for point in points {
        let (along_m, across_m) = split(point);
        let reach_m = (radius_m * radius_m - across_m * across_m).max(0.0).sqrt();
        start_m = start_m.min(along_m + reach_m);
        end_m = end_m.max(along_m - reach_m);
    }
    // If the bounds are in the wrong order, every point between them is the center of a sphere.
    if start_m > end_m {
        let middle_m = 0.5 * (start_m + end_m);
        (start_m, end_m) = (middle_m, middle_m);
    }
    Some(Capsule {
        ends: [center + direction * start_m, center + direction * end_m],
        radius_m,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    fn encloses(capsules: &[Capsule], point: Vector3<f64>) -> bool {
        let sphere = Capsule {
            ends: [point, point],
            radius_m: 0.0,
        };
        capsules.iter().any(|capsule| capsule.contains(&sphere))
    }

    fn shape(geometry: Geometry) -> Shape {
        Shape {
            link_from_shape: Transform::translation(0.1, -0.2, 0.3),
            geometry,
            color_srgba: None,
        }
    }

    #[test]
    fn every_point_of_a_box_is_enclosed_and_plates_stay_thin() {
        let mut random = Random::new(3);
        for size_m in [[0.2, 0.3, 0.1], [1.0, 0.8, 0.02], [0.05, 0.05, 0.9]] {
            let shape = shape(Geometry::Box { size_m });
            let capsules = enclosing_capsules(&shape, &|_| None);
            for _ in 0..2000 {
                let in_box = Vector3::from(size_m.map(|size| random.uniform(-0.5, 0.5) * size));
                let point = shape.link_from_shape.translation.vector + in_box;
                assert!(encloses(&capsules, point), "{size_m:?}");
            }
            let thickest = capsules
                .iter()
                .map(|capsule| capsule.radius_m)
                .fold(0.0, f64::max);
            assert!(thickest < 0.2, "{size_m:?}: {thickest}");
        }
    }

    #[test]
    fn every_vertex_of_a_mesh_is_enclosed_tightly() {
        let mut random = Random::new(4);
        let mut vertices: Vec<[f64; 3]> = Vec::new();
        for _ in 0..500 {
            let angle = random.uniform(0.0, 6.3);
            vertices.push([
                0.05 * angle.cos(),
                random.uniform(-0.3, 0.5),
                0.05 * angle.sin(),
            ]);
        }
        let mesh = shape(Geometry::Mesh {
            file: "arm.stl".to_owned(),
            scale: [2.0, 2.0, -2.0],
        });
        let capsules = enclosing_capsules(&mesh, &|_| Some(vertices.clone()));
        let [capsule] = capsules[..] else {
            panic!("{capsules:?}");
        };
        for vertex in &vertices {
            let scaled = Vector3::new(2.0 * vertex[0], 2.0 * vertex[1], -2.0 * vertex[2]);
            let in_link = scaled + mesh.link_from_shape.translation.vector;
            assert!(encloses(&capsules, in_link));
        }
        // The cylinder has a radius of 0.1 and a length of 1.6. The principal axis of random
        // vertices is not exactly its axis.
        assert!(capsule.radius_m < 0.12, "{capsule:?}");
        assert!(enclosing_capsules(&mesh, &|_| None).is_empty());
        let broken = enclosing_capsules(&mesh, &|_| Some(vec![[f64::NAN; 3]]));
        assert!(broken.is_empty());
    }
}
