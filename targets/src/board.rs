//! Board geometry: frame, positions of corners, symmetry.
//!
//! # Board frame
//! The board frame is the frame that OpenCV uses. For a viewer of the printed target, x points
//! right, y points down, and z points into the board, away from the viewer. All corners have z = 0.
//!
//! | target | origin | corner ids |
//! |---|---|---|
//! | chessboard | top left inner corner | row by row, from the top left |
//! | ChArUco | top left corner of the pattern | inner corners row by row, from the top left; as in OpenCV |
//! | AprilGrid | top left corner of the tag at the top left | 4 per tag: `4 * tag + k`, k counting lower left, lower right, upper right, upper left; tags are numbered row by row from the **lower** left, as in Kalibr |
//! | PuzzleBoard | top left inner corner | inner corners row by row, from the top left |
//! | tag | center of the tag | lower left, lower right, upper right, upper left, as in AprilTag |
//!
//! The square at the top left of a chessboard and of a new-style ChArUco board is black.

use crate::spec::{Pattern, TargetSpec};
use kinematics::Transform;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::f64::consts::PI;

impl TargetSpec {
    /// Number of corners. Ids are below this number.
    pub fn n_corners(&self) -> u32 {
        match self.pattern {
            Pattern::Chessboard { inner, .. } => inner[0] * inner[1],
            Pattern::Charuco { squares, .. } | Pattern::Puzzleboard { squares, .. } => {
                (squares[0] - 1) * (squares[1] - 1)
            }
            Pattern::Aprilgrid { tags, .. } => 4 * tags[0] * tags[1],
            Pattern::Tag { .. } => 4,
        }
    }

    /// Position of a corner in the board frame, meters. `None` if no corner has this id.
    pub fn corner(&self, id: u32) -> Option<Vector3<f64>> {
        if id >= self.n_corners() {
            return None;
        }
        let at = |columns: u32| [f64::from(id % columns), f64::from(id / columns)];
        let [x, y] = match self.pattern {
            Pattern::Chessboard { inner, square_m } => at(inner[0]).map(|count| count * square_m),
            Pattern::Puzzleboard {
                squares, square_m, ..
            } => at(squares[0] - 1).map(|count| count * square_m),
            Pattern::Charuco {
                squares, square_m, ..
            } => at(squares[0] - 1).map(|count| (count + 1.0) * square_m),
            Pattern::Aprilgrid {
                tags,
                tag_m,
                spacing_frac,
            } => {
                let [left, top] = tag_origin(tags, tag_m, spacing_frac, id / 4);
                let [x, y] = CORNERS_FROM_LOWER_LEFT[(id % 4) as usize];
                [left + x * tag_m, top + y * tag_m]
            }
            Pattern::Tag { side_m, .. } => {
                CORNERS_FROM_LOWER_LEFT[id as usize].map(|frac| (frac - 0.5) * side_m)
            }
        };
        Some(Vector3::new(x, y, 0.0))
    }

    /// Two opposite corners of the pattern's bounding rectangle in the board frame, meters: the
    /// smallest x and y, then the largest x and y.
    pub fn bounds_m(&self) -> [[f64; 2]; 2] {
        match self.pattern {
            // The origin is the first inner corner, one square inside.
            Pattern::Chessboard { inner, square_m } => {
                bounds_of_squares(inner.map(|count| count + 1), square_m, -square_m)
            }
            Pattern::Charuco {
                squares, square_m, ..
            } => bounds_of_squares(squares, square_m, 0.0),
            Pattern::Puzzleboard {
                squares, square_m, ..
            } => bounds_of_squares(squares, square_m, -square_m),
            Pattern::Aprilgrid {
                tags,
                tag_m,
                spacing_frac,
            } => {
                // Small squares surround the outermost tags. They are as wide as the gap between
                // tags.
                let gap = tag_m * spacing_frac;
                [
                    [-gap; 2],
                    tags.map(|count| f64::from(count) * (tag_m + gap)),
                ]
            }
            Pattern::Tag { side_m, .. } => [[-side_m / 2.0; 2], [side_m / 2.0; 2]],
        }
    }

    /// Rotations `board_from_rotated_board` of the board that give the same picture. The first
    /// rotation is the identity.
    ///
    /// A pose of such a board is ambiguous: `camera_from_board * rotation` fits the image equally
    /// well for every rotation of this list. A chessboard whose numbers of inner corners are both
    /// even or both odd looks the same after a rotation by 180 degrees. If the numbers are also
    /// equal and even, it looks the same after a rotation by 90 degrees. All other targets are
    /// unambiguous.
    pub fn symmetry(&self) -> Vec<Transform> {
        let Pattern::Chessboard {
            inner: [columns, rows],
            square_m,
        } = self.pattern
        else {
            return vec![Transform::identity()];
        };
        // The numbers of squares are larger by one. Opposite squares at the corners of the board
        // have the same color if both numbers are even or both are odd. All four squares have the
        // same color if both numbers are odd.
        let quarters: &[f64] = if columns == rows && columns % 2 == 0 {
            &[0.0, 1.0, 2.0, 3.0]
        } else if (columns + rows) % 2 == 0 {
            &[0.0, 2.0]
        } else {
            &[0.0]
        };
        let center =
            Vector3::new(f64::from(columns - 1), f64::from(rows - 1), 0.0) * (square_m / 2.0);
        let about_center = |quarter: &f64| {
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), quarter * PI / 2.0);
            Transform::from_parts(Translation3::from(center - rotation * center), rotation)
        };
        quarters.iter().map(about_center).collect()
    }
}

/// The smallest x and y, then the largest x and y, of a board of squares whose upper left corner is
/// at `(first_m, first_m)`.
fn bounds_of_squares(squares: [u32; 2], square_m: f64, first_m: f64) -> [[f64; 2]; 2] {
    [
        [first_m; 2],
        squares.map(|count| f64::from(count) * square_m + first_m),
    ]
}

/// Lower left, lower right, upper right and upper left corner of a square of side 1 whose top left
/// corner is the origin.
pub(crate) const CORNERS_FROM_LOWER_LEFT: [[f64; 2]; 4] =
    [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];

/// Top left corner of a tag of an AprilGrid.
pub(crate) fn tag_origin(tags: [u32; 2], tag_m: f64, spacing_frac: f64, tag: u32) -> [f64; 2] {
    let column = tag % tags[0];
    // Kalibr numbers the rows from the bottom, but y points down.
    let row_from_bottom = tag / tags[0];
    let row = tags[1] - 1 - row_from_bottom;
    [column, row].map(|count| f64::from(count) * tag_m * (1.0 + spacing_frac))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(text: &str) -> TargetSpec {
        text.parse().unwrap()
    }

    fn corner(text: &str, id: u32) -> [f64; 3] {
        spec(text)
            .corner(id)
            .unwrap()
            .map(|value| (value * 1e9).round() / 1e9)
            .into()
    }

    #[test]
    fn corners_follow_opencv_and_kalibr() {
        assert_eq!(corner("chessboard:9x6:25mm", 0), [0.0, 0.0, 0.0]);
        assert_eq!(corner("chessboard:9x6:25mm", 10), [0.025, 0.025, 0.0]);
        assert_eq!(
            corner("charuco:5x7:34mm:28mm:6X6_250", 0),
            [0.034, 0.034, 0.0]
        );
        assert_eq!(
            corner("charuco:5x7:34mm:28mm:6X6_250", 23),
            [0.136, 0.204, 0.0]
        );
        // Tag 0 is at the lower left, tag 30 at the upper left.
        assert_eq!(corner("aprilgrid:6x6:88mm:0.3", 0), [0.0, 0.66, 0.0]);
        assert_eq!(corner("aprilgrid:6x6:88mm:0.3", 123), [0.0, 0.0, 0.0]);
        assert_eq!(corner("aprilgrid:6x6:88mm:0.3", 5), [0.2024, 0.66, 0.0]);
        assert_eq!(corner("tag:36h11:3:100mm", 0), [-0.05, 0.05, 0.0]);
        for text in [
            "chessboard:9x6:25mm",
            "tag:36h11:3:100mm",
            "aprilgrid:2x3:88mm:0.3",
        ] {
            assert_eq!(spec(text).corner(spec(text).n_corners()), None);
        }
    }

    #[test]
    fn symmetric_boards_map_onto_themselves() {
        for (text, n_rotations) in [
            ("chessboard:9x6:25mm", 1),
            ("chessboard:11x9:20mm", 2),
            ("chessboard:8x6:25mm", 2),
            ("chessboard:7x7:25mm", 2),
            ("chessboard:6x6:25mm", 4),
            ("charuco:5x7:34mm:28mm:6X6_250", 1),
        ] {
            let target = spec(text);
            let rotations = target.symmetry();
            assert_eq!(
                (rotations.len(), rotations[0]),
                (n_rotations, Transform::identity()),
                "{text}"
            );
            let corners: Vec<_> = (0..target.n_corners())
                .filter_map(|id| target.corner(id))
                .collect();
            for rotation in rotations {
                for corner in &corners {
                    let rotated = rotation.rotation * corner + rotation.translation.vector;
                    assert!(
                        corners.iter().any(|other| (other - rotated).norm() < 1e-12),
                        "{text} {rotated}"
                    );
                }
            }
        }
    }
}
