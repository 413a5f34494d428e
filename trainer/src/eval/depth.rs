//! Error of rendered depth.

use crate::Error;
use keyframe::DepthMap;

/// Root mean squared difference of two depth images in meters, over pixels where both have a depth
/// above 0.
///
/// Returns `None` if there is no such pixel. Fails if the images differ in size.
pub fn depth_rmse_m(rendered_m: &[f32], truth_m: &[f32]) -> Result<Option<f64>, Error> {
    if rendered_m.len() != truth_m.len() {
        return Err(Error::DepthSizeMismatch {
            rendered: rendered_m.len(),
            truth: truth_m.len(),
        });
    }
    let mut squares = 0.0_f64;
    let mut n_known = 0_u32;
    for (&rendered, &truth) in rendered_m.iter().zip(truth_m) {
        if rendered > 0.0 && truth > 0.0 {
            squares += (f64::from(rendered) - f64::from(truth)).powi(2);
            n_known += 1;
        }
    }
    Ok((n_known > 0).then(|| (squares / f64::from(n_known)).sqrt()))
}

/// Distance of a rendered surface from a measured surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceError {
    /// Mean distance along the normal of the measured surface, meters, over measured pixels with a
    /// rendered depth. `None` if there are none.
    pub mean_m: Option<f64>,
    /// Fraction of the measured pixels whose rendered surface is within [`SurfaceError::NEAR_M`].
    pub near_frac: f64,
}

impl SurfaceError {
    /// Distance that counts as near, meters.
    pub const NEAR_M: f64 = 0.005;
}

/// Distance of a rendered surface from a measured surface, meters. Both are depth images of the
/// same camera.
///
/// Only measured pixels with a known surface normal count: all four neighbors must have a reading,
/// and no neighbor may differ by more than 4 %, which would be an edge. Returns `None` if there is
/// no such pixel. Fails if the images differ in size.
pub fn surface_error(
    rendered_m: &[f32],
    measured: &DepthMap,
) -> Result<Option<SurfaceError>, Error> {
    // Relative difference of depth between neighbors. At an edge, the normal would not belong to
    // any surface. A smaller value also leaves out slanted surfaces. With a larger value, the edges
    // of objects would count.
    const EDGE_FRAC: f64 = 0.04;
    let [width, height] = measured.size_px;
    let n_pixels = width as usize * height as usize;
    for depth_m in [rendered_m, &measured.depth_m] {
        if depth_m.len() != n_pixels {
            return Err(Error::DepthSizeMismatch {
                rendered: depth_m.len(),
                truth: n_pixels,
            });
        }
    }
    let pixel = |x: u32, y: u32| y as usize * width as usize + x as usize;
    let z_m = |x: u32, y: u32| f64::from(measured.depth_m[pixel(x, y)]);
    let point = |x: u32, y: u32| measured.point(x, y, z_m(x, y));
    let mut sum_m = 0.0;
    let mut n_rendered = 0_u32;
    let mut n_near = 0_u32;
    let mut n_measured = 0_u32;
    // Pixels at the border lack a neighbor.
    for (y, x) in (1..height.saturating_sub(1))
        .flat_map(|y| (1..width.saturating_sub(1)).map(move |x| (y, x)))
    {
        let z = z_m(x, y);
        let is_on_surface = |neighbor: f64| neighbor > 0.0 && (neighbor - z).abs() <= EDGE_FRAC * z;
        let around = [z_m(x - 1, y), z_m(x + 1, y), z_m(x, y - 1), z_m(x, y + 1)];
        if !(z > 0.0 && z.is_finite() && around.into_iter().all(is_on_surface)) {
            continue;
        }
        // Central differences along both axes span the tangent plane.
        let normal =
            (point(x + 1, y) - point(x - 1, y)).cross(&(point(x, y + 1) - point(x, y - 1)));
        let Some(normal) = normal.try_normalize(0.0) else {
            continue;
        };
        n_measured += 1;
        let rendered = f64::from(rendered_m[pixel(x, y)]);
        if rendered > 0.0 {
            // The position of a point on a ray is proportional to its depth. The offset of the
            // rendered point from the measured point is therefore the point of the same pixel at
            // the difference of the depths.
            let distance_m = normal.dot(&measured.point(x, y, rendered - z)).abs();
            sum_m += distance_m;
            n_rendered += 1;
            n_near += u32::from(distance_m <= SurfaceError::NEAR_M);
        }
    }
    Ok((n_measured > 0).then(|| SurfaceError {
        mean_m: (n_rendered > 0).then(|| sum_m / f64::from(n_rendered)),
        near_frac: f64::from(n_near) / f64::from(n_measured),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;
    use nalgebra::Vector3;
    use numbers::f32_of;

    fn measured(depth_m: Vec<f32>) -> DepthMap {
        DepthMap {
            size_px: [40, 30],
            focal_px: [35.0, 36.0],
            principal_px: [19.0, 16.0],
            depth_m: depth_m.into(),
            world_from_camera: Transform::identity(),
        }
    }

    /// The plane `normal . point = distance`.
    fn plane(normal: Vector3<f64>, distance_m: f64) -> Vec<f32> {
        let map = measured(Vec::new());
        let z = |ix: u32| f32_of(distance_m / normal.dot(&map.point(ix % 40, ix / 40, 1.0)));
        (0..1200).map(z).collect()
    }

    #[test]
    fn distance_is_measured_along_the_normal() {
        let normal = Vector3::new(0.3, -0.2, 1.0).normalize();
        let truth = measured(plane(normal, 1.0));
        let score = |rendered: &[f32]| {
            let error = surface_error(rendered, &truth).unwrap().unwrap();
            (error.mean_m.unwrap(), error.near_frac)
        };
        let (mean_m, near_frac) = score(&plane(normal, 1.004));
        assert!(
            (mean_m - 0.004).abs() < 1e-5 && near_frac == 1.0,
            "{mean_m} {near_frac}"
        );
        let (mean_m, near_frac) = score(&plane(normal, 0.994));
        assert!(
            (mean_m - 0.006).abs() < 1e-5 && near_frac == 0.0,
            "{mean_m} {near_frac}"
        );
        // Pixels that are not rendered reduce completeness but have no error.
        let mut half = plane(normal, 1.004);
        half[..600].fill(0.0);
        let (mean_m, near_frac) = score(&half);
        assert!(
            (mean_m - 0.004).abs() < 1e-5 && (near_frac - 0.5).abs() < 0.01,
            "{mean_m} {near_frac}"
        );
        let nothing = SurfaceError {
            mean_m: None,
            near_frac: 0.0,
        };
        assert_eq!(surface_error(&[0.0; 1200], &truth).unwrap(), Some(nothing));
    }

    #[test]
    fn edges_and_holes_are_ignored() {
        let mut depth_m = vec![1.0f32; 1200];
        depth_m[..600].fill(2.0); // Rows 0 to 14.
        depth_m[20 * 40 + 7] = 0.0;
        let truth = measured(depth_m.clone());
        let near_frac =
            |rendered: &[f32]| surface_error(rendered, &truth).unwrap().unwrap().near_frac;
        // There are 28 rows of 38 pixels. Two rows at the edge and five pixels on or next to the
        // hole do not count.
        let n = 26.0 * 38.0 - 5.0;
        let mut rendered = depth_m.clone();
        rendered[10 * 40 + 10] = 3.0;
        assert!((near_frac(&rendered) - (n - 1.0) / n).abs() < 1e-12);
        rendered[10 * 40 + 10] = depth_m[10 * 40 + 10];
        rendered[14 * 40 + 10] = 3.0;
        rendered[20 * 40 + 7] = 3.0;
        assert!((near_frac(&rendered) - 1.0).abs() < 1e-12);
        assert_eq!(
            surface_error(&depth_m, &measured(vec![0.0; 1200])).unwrap(),
            None
        );
        assert!(surface_error(&[1.0], &truth).is_err());
    }

    #[test]
    fn only_pixels_with_both_depths_count() {
        let rmse = depth_rmse_m(&[1.0, 2.5, 0.0, 9.0], &[1.5, 2.0, 7.0, 0.0])
            .unwrap()
            .unwrap();
        assert!((rmse - 0.5).abs() < 1e-12);
        assert_eq!(depth_rmse_m(&[0.0, 1.0], &[1.0, 0.0]).unwrap(), None);
    }

    #[test]
    fn different_sizes_are_rejected() {
        assert!(matches!(
            depth_rmse_m(&[1.0], &[1.0, 2.0]),
            Err(Error::DepthSizeMismatch {
                rendered: 1,
                truth: 2
            })
        ));
    }
}
