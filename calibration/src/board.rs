//! Points of a calibration target that were detected in an image.

use nalgebra::Vector3;

/// Points of a calibration target detected in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct BoardView {
    /// File name or stamp of the image, for messages.
    pub name: String,
    /// The detected points, in any order. A partly visible target has fewer points.
    pub points: Vec<BoardPoint>,
}

/// A point of a calibration target and its position in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardPoint {
    /// Position in the frame of the target, meters.
    pub point_in_board: Vector3<f64>,
    /// Position in the image, pixels. The center of pixel `(0, 0)` is `(0.5, 0.5)`.
    pub pixel: [f64; 2],
}
