//! Geometry of calibration targets, detection of targets in gray images, and printing to scale.
//!
//! A [`TargetSpec`] is parsed from text such as `chessboard:9x6:25mm`,
//! `charuco:5x7:34mm:28mm:6X6_250`, `aprilgrid:6x6:88mm:0.3`, `puzzleboard:12x9:20mm` or
//! `tag:36h11:5:100mm`. A specification returns the positions of all corners in the [board
//! frame](board), detects the corners in images, and draws the target.
//!
//! ```
//! use targets::{GrayImage, Paper, TargetSpec};
//!
//! let target: TargetSpec = "charuco:5x7:34mm:28mm:6X6_250".parse()?;
//! let pdf = target.pdf(Paper::A4)?;
//! assert!(pdf.starts_with(b"%PDF"));
//!
//! let picture = target.raster(2000.0)?;
//! let image = GrayImage { size_px: picture.size_px, pixels: &picture.pixels };
//! let detection = target.detect(image)?;
//! assert_eq!(detection.corners.len(), 24);
//! for corner in &detection.corners {
//!     for axis in 0..2 {
//!         let pixel = (corner.point_in_board[axis] - picture.origin_m[axis]) * picture.px_per_m;
//!         assert!((corner.pixel[axis] - pixel).abs() < 0.05);
//!     }
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Detection
//! - Chessboards and PuzzleBoards: saddle points of the image (`saddle`) are linked along the edges
//!   between them (`grid`).
//! - ChArUco boards, AprilGrids and tags: dark quadrilaterals (`quad`) are decoded (`marker`), and
//!   arrangements that contradict the target are rejected (`layout`).
//! - Finally, every corner is aligned with the printed pattern around it (`template`).
//!
//! Only neighboring corners are compared, so the lens may distort the board, and parts of it may be
//! hidden. Markers are decoded through a homography, so strong fisheye distortion reduces the
//! number of detected markers.

mod alignment;
pub mod board;
mod detect;
mod dictionary;
mod error;
mod gray;
mod grid;
mod homography;
mod lattice;
mod layout;
mod marker;
mod print;
mod puzzle_code;
mod quad;
mod raster;
mod saddle;
mod spec;
mod surface;
#[cfg(any(test, feature = "scenes"))]
pub mod synthetic;
mod template;

pub use detect::{DetectedCorner, Detection};
pub use error::{Counts, FORMS, Ids, NotDetected, PrintError, SpecError};
pub use gray::GrayImage;
pub use print::Paper;
pub use raster::Raster;
pub use spec::TargetSpec;
