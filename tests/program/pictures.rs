//! Compares pictures.

/// Mean difference of two pictures of the same size, on a scale of 0 to 255.
pub(crate) fn difference(a: &image::RgbImage, b: &image::RgbImage) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let values = a.as_raw().iter().zip(b.as_raw());
    let sum: f64 = values.map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    sum / a.as_raw().len() as f64
}
