//! Error of rendered depth.

use crate::Error;
use nalgebra::Vector3;

/// Root of the mean squared difference of two depth images in metres, over pixels where both know the depth (above 0).
///
/// `None` when there is no such pixel; fails when the images differ in size.
pub fn depth_rmse_m(rendered_m: &[f32], truth_m: &[f32]) -> Result<Option<f64>, Error> {
    if rendered_m.len() != truth_m.len() {
        return Err(Error::DepthSize { rendered: rendered_m.len(), truth: truth_m.len() });
    }
    let (mut squares, mut n_known) = (0.0_f64, 0_u32);
    for (&rendered, &truth) in rendered_m.iter().zip(truth_m) {
        if rendered > 0.0 && truth > 0.0 {
            squares += (f64::from(rendered) - f64::from(truth)).powi(2);
            n_known += 1;
        }
    }
    Ok((n_known > 0).then(|| (squares / f64::from(n_known)).sqrt()))
}

/// How near a drawn surface comes to a measured one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceError {
    /// Mean distance along the measured surface's normal, over pixels where both know the depth, metres.
    pub mean_m: f64,
    /// Share of the measured pixels where the drawn surface is no further off than [`SurfaceError::NEAR_M`].
    pub near_frac: f64,
}

impl SurfaceError {
    /// What counts as near, metres.
    pub const NEAR_M: f64 = 0.005;
}

/// Distances between the surfaces of two depth images of one pinhole camera, in metres.
///
/// Measured pixels count where they tell how their surface is turned: with a reading on each side along both axes, none of
/// which differs by more than 4 % (an edge). `None` when there is no such pixel; fails when the images differ in size.
pub fn surface_error(
    rendered_m: &[f32],
    truth_m: &[f32],
    size_px: [u32; 2],
    focal_px: [f64; 2],
    principal_px: [f64; 2],
) -> Result<Option<SurfaceError>, Error> {
    const EDGE_FRAC: f64 = 0.04;
    let [width, height] = size_px.map(|side| side as usize);
    for depth_m in [rendered_m, truth_m] {
        if depth_m.len() != width * height {
            return Err(Error::DepthSize { rendered: depth_m.len(), truth: width * height });
        }
    }
    let truth = |x: usize, y: usize| f64::from(truth_m[y * width + x]);
    let ray = |x: usize, y: usize| {
        let at = [x, y].map(|side| side as f64 + 0.5);
        let [x, y] = [0, 1].map(|axis| (at[axis] - principal_px[axis]) / focal_px[axis]);
        Vector3::new(x, y, 1.0)
    };
    let point = |x: usize, y: usize| ray(x, y) * truth(x, y);
    let (mut sum_m, mut n_both, mut n_near, mut n_truth) = (0.0, 0_u32, 0_u32, 0_u32);
    for (y, x) in (1..height.saturating_sub(1)).flat_map(|y| (1..width.saturating_sub(1)).map(move |x| (y, x))) {
        let z = truth(x, y);
        let is_beside = |near: f64| near > 0.0 && (near - z).abs() <= EDGE_FRAC * z;
        let around = [truth(x - 1, y), truth(x + 1, y), truth(x, y - 1), truth(x, y + 1)];
        if !(z > 0.0 && z.is_finite() && around.into_iter().all(is_beside)) {
            continue;
        }
        let normal = (point(x + 1, y) - point(x - 1, y)).cross(&(point(x, y + 1) - point(x, y - 1)));
        let Some(normal) = normal.try_normalize(0.0) else { continue };
        n_truth += 1;
        let rendered = f64::from(rendered_m[y * width + x]);
        if rendered > 0.0 {
            let off_m = ((rendered - z) * normal.dot(&ray(x, y))).abs();
            sum_m += off_m;
            n_both += 1;
            n_near += u32::from(off_m <= SurfaceError::NEAR_M);
        }
    }
    Ok((n_both > 0)
        .then(|| SurfaceError { mean_m: sum_m / f64::from(n_both), near_frac: f64::from(n_near) / f64::from(n_truth) }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::f32_of;

    const SIZE_PX: [u32; 2] = [40, 30];
    const FOCAL_PX: [f64; 2] = [35.0, 36.0];
    const PRINCIPAL_PX: [f64; 2] = [19.0, 16.0];

    /// The plane `normal . point = distance`.
    fn plane(normal: Vector3<f64>, distance_m: f64) -> Vec<f32> {
        let z = |ix: u32| {
            let at = [f64::from(ix % SIZE_PX[0]) + 0.5, f64::from(ix / SIZE_PX[0]) + 0.5];
            let [x, y] = [0, 1].map(|axis| (at[axis] - PRINCIPAL_PX[axis]) / FOCAL_PX[axis]);
            f32_of(distance_m / normal.dot(&Vector3::new(x, y, 1.0)))
        };
        (0..SIZE_PX[0] * SIZE_PX[1]).map(z).collect()
    }

    #[test]
    fn the_distance_of_planes_is_that_along_their_normal() {
        let normal = Vector3::new(0.3, -0.2, 1.0).normalize();
        let truth = plane(normal, 1.0);
        let score =
            |rendered: &[f32]| surface_error(rendered, &truth, SIZE_PX, FOCAL_PX, PRINCIPAL_PX).unwrap().unwrap();
        let near = score(&plane(normal, 1.004));
        assert!((near.mean_m - 0.004).abs() < 1e-5 && near.near_frac == 1.0, "{near:?}");
        let far = score(&plane(normal, 0.994));
        assert!((far.mean_m - 0.006).abs() < 1e-5 && far.near_frac == 0.0, "{far:?}");
        // What is not drawn is not complete, and has no error.
        let mut half = plane(normal, 1.004);
        half[..600].fill(0.0);
        let half = score(&half);
        assert!((half.mean_m - 0.004).abs() < 1e-5 && (half.near_frac - 0.5).abs() < 0.01, "{half:?}");
    }

    #[test]
    fn edges_and_holes_of_the_truth_say_nothing() {
        let mut truth = vec![1.0f32; 1200];
        truth[..600].fill(2.0); // Rows 0 to 14.
        truth[20 * 40 + 7] = 0.0;
        let count = |rendered: &[f32]| {
            let error = surface_error(rendered, &truth, SIZE_PX, FOCAL_PX, PRINCIPAL_PX).unwrap().unwrap();
            error.near_frac
        };
        // 28 rows less two at the edge, of 38 pixels; five lie on or beside the hole.
        let n = 26.0 * 38.0 - 5.0;
        let mut rendered = truth.clone();
        rendered[10 * 40 + 10] = 3.0;
        assert!((count(&rendered) - (n - 1.0) / n).abs() < 1e-12);
        rendered[10 * 40 + 10] = truth[10 * 40 + 10];
        rendered[14 * 40 + 10] = 3.0;
        rendered[20 * 40 + 7] = 3.0;
        assert!((count(&rendered) - 1.0).abs() < 1e-12);
        let nothing = surface_error(&truth, &vec![0.0; 1200], SIZE_PX, FOCAL_PX, PRINCIPAL_PX).unwrap();
        assert_eq!(nothing, None);
        assert!(surface_error(&[1.0], &truth, SIZE_PX, FOCAL_PX, PRINCIPAL_PX).is_err());
    }

    #[test]
    fn only_pixels_known_to_both_count() {
        let rmse = depth_rmse_m(&[1.0, 2.5, 0.0, 9.0], &[1.5, 2.0, 7.0, 0.0]).unwrap().unwrap();
        assert!((rmse - 0.5).abs() < 1e-12);
        assert_eq!(depth_rmse_m(&[0.0, 1.0], &[1.0, 0.0]).unwrap(), None);
    }

    #[test]
    fn different_sizes_are_refused() {
        assert!(matches!(depth_rmse_m(&[1.0], &[1.0, 2.0]), Err(Error::DepthSize { rendered: 1, truth: 2 })));
    }
}
