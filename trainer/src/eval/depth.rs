//! Error of rendered depth.

use crate::Error;

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

#[cfg(test)]
mod tests {
    use super::*;

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
