//! Detection of targets in gray images.

mod charuco;
mod chessboard;
mod diagnosis;
mod markers;
mod puzzleboard;

use crate::error::NotDetected;
use crate::gray::{GrayImage, Plane};
use crate::spec::{Pattern, TargetSpec};
use nalgebra::Vector3;

/// Corners of a target detected in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// Detected corners in ascending order of ids.
    pub corners: Vec<DetectedCorner>,
    /// Number of corners of the whole target.
    pub n_in_target: usize,
    /// Whether a ChArUco board is printed in the arrangement used before OpenCV 4.6 ("legacy
    /// pattern"), which differs for even numbers of rows. Ids and positions of corners are the
    /// same.
    pub is_legacy: bool,
}

/// A corner of a target in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectedCorner {
    /// Id on the target. See [`crate::board`].
    pub id: u32,
    /// Position in the board frame, meters.
    pub point_in_board: Vector3<f64>,
    /// Position in the image. The center of the first pixel is (0.5, 0.5).
    pub pixel: [f64; 2],
}

/// Minimum number of corners of a board. A pose needs at least four.
const MIN_CORNERS: usize = 4;

impl TargetSpec {
    /// Finds this target in an image.
    ///
    /// ChArUco boards, AprilGrids and PuzzleBoards may be partly visible. Some inner corners of a
    /// chessboard may be missing. Its outermost rows and columns must be visible, because they
    /// identify the board. A symmetric board ([`TargetSpec::symmetry`]) has several possible
    /// rotations. In that case, the rotation is chosen for which the x axis of the board points
    /// most to the right in the image.
    ///
    /// Lines may be bent by any lens, including fisheye lenses, because only neighboring corners
    /// are compared. The result depends only on the image. The function can be called from several
    /// threads at the same time.
    ///
    /// # Errors
    /// [`NotDetected`] describes what was found instead.
    pub fn detect(&self, image: GrayImage<'_>) -> Result<Detection, NotDetected> {
        let plane = Plane::new(image)?;
        match &self.pattern {
            Pattern::Chessboard { inner, square_m } => {
                chessboard::detect(self, *inner, *square_m, &plane)
            }
            Pattern::Puzzleboard {
                squares,
                square_m,
                origin,
            } => {
                let board = puzzleboard::Board {
                    target: self,
                    squares: *squares,
                    origin: *origin,
                    square_m: *square_m,
                };
                board.detect(&plane)
            }
            // These three patterns have markers, from which the search starts.
            Pattern::Charuco { .. } | Pattern::Aprilgrid { .. } | Pattern::Tag { .. } => {
                markers::detect(self, &plane)
            }
        }
    }

    /// Collects corners. Corners whose ids are not on the target are left out.
    fn detection(
        &self,
        pixels: impl IntoIterator<Item = (u32, [f64; 2])>,
        is_legacy: bool,
    ) -> Detection {
        let mut corners = Vec::new();
        for (id, pixel) in pixels {
            if let Some(point_in_board) = self.corner(id) {
                corners.push(DetectedCorner {
                    id,
                    point_in_board,
                    pixel,
                });
            }
        }
        // Detectors return corners in the order of markers or of the lattice. Callers compare
        // detections of several images, so they need one order.
        corners.sort_by_key(|corner| corner.id);
        Detection {
            corners,
            n_in_target: self.n_corners() as usize,
            is_legacy,
        }
    }
}
