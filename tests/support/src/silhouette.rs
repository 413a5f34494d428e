//! Comparison of silhouettes of a robot in screenshots of the view.

/// Distance from the top and bottom edges of the view, pixels. Nothing else covers the part of the
/// view between these margins.
const MARGIN_PX: u32 = 60;
/// Smaller silhouettes show too little of the robot.
const MIN_PIXELS: usize = 5000;

/// Intersection over union of two silhouettes, by pixel, without the margins of the view.
#[expect(clippy::cast_precision_loss, reason = "numbers of pixels")]
pub fn iou([width, height]: [u32; 2], a: &[bool], b: &[bool]) -> f64 {
    assert_eq!([a.len(), b.len()], [(width * height) as usize; 2]);
    let rows = (MARGIN_PX * width) as usize..((height - MARGIN_PX) * width) as usize;
    let pairs = || a[rows.clone()].iter().zip(&b[rows.clone()]);
    let n_both = pairs().filter(|(a, b)| **a && **b).count();
    let n_any = pairs().filter(|(a, b)| **a || **b).count();
    assert!(n_any > MIN_PIXELS, "the robot covers only {n_any} pixels");
    n_both as f64 / n_any as f64
}
