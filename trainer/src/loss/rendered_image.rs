//! A rendered image and its gradient, on the CPU in f64.

/// Output of a render, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedImage {
    /// Color of the splats without background, premultiplied.
    pub rgb: Vec<[f64; 3]>,
    /// Fraction of the background that is visible, 0 to 1.
    pub transmittance: Vec<f64>,
    /// Depth along z, weighted like the colors, meters. Divided by `1 - transmittance`, it is the
    /// mean depth.
    pub depth: Vec<f64>,
    /// Index of the last splat that contributed to the pixel.
    pub last_contributor: Vec<Option<usize>>,
}

/// Gradient of a loss with respect to a [`RenderedImage`], row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Upstream {
    /// Gradient with respect to the color.
    pub rgb: Vec<[f64; 3]>,
    /// Gradient with respect to the transmittance.
    pub transmittance: Vec<f64>,
    /// Gradient with respect to the depth.
    pub depth: Vec<f64>,
}
