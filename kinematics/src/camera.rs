//! Camera models: pixel `(0, 0)` covers `[0,1) x [0,1)`; x right, y down, z forward.

/// Lens parameters of one camera at one image size.
#[derive(Clone, Debug, PartialEq)]
pub struct Intrinsics {
    /// Width and height in pixels.
    pub size_px: [u32; 2],
    /// Focal length along x and y, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels; the centre of pixel `(0, 0)` is `(0.5, 0.5)`.
    pub principal_px: [f64; 2],
    /// Distortion of the lens.
    pub lens: Lens,
    /// The image is undistorted already: the lens's coefficients are ignored.
    pub rectified: bool,
}

/// Lens distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// No distortion.
    Pinhole,
    /// Radial k1 k2 k3 and tangential p1 p2, in the order of OpenCV: k1, k2, p1, p2, k3.
    BrownConrady([f64; 5]),
    /// Fisheye, equidistant polynomial k1 k2 k3 k4 (Kannala and Brandt 2006, as in OpenCV's fisheye model).
    KannalaBrandt([f64; 4]),
}
