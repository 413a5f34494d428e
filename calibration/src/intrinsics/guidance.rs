//! Determines what images of a target cover so far and which images to take next. This needs no
//! calibration.
//!
//! Calibrating a lens requires corners in all parts of the image and tilts in all directions.
//! Without tilts, a longer focal length cannot be distinguished from a larger distance (Zhang 2000,
//! section 3.3).

use super::board_pose::board_pose;
use super::grid::ImageGrid;
use crate::BoardView;
use kinematics::Intrinsics;
use nalgebra::Vector3;
use std::fmt;

/// Number of images that are sufficient, if they cover everything.
pub const RECOMMENDED_IMAGES: usize = 15;
/// A part of the image is covered if this fraction of its cells has corners. Not all cells are
/// required, because a target rarely reaches the outermost ones.
const MIN_COVERED_FRAC: f64 = 0.5;
/// A tilt counts if the angle between the normal of the target and the line of sight is at least
/// this value. The value is below the requested 20 degrees, because people estimate tilts by eye.
const MIN_TILT_DEG: f64 = 15.0;
/// Number of images with each tilt.
const MIN_TILTED: usize = 2;

/// Coverage of the images so far.
#[derive(Clone, Debug, PartialEq)]
pub struct IntrinsicsGuidance {
    /// Number of images that show the target.
    pub n_images: usize,
    /// Fraction of the parts of the image that contain corners, 0 to 1.
    pub covered_frac: f64,
    /// What to do next.
    pub advice: IntrinsicsAdvice,
}

/// What to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IntrinsicsAdvice {
    /// Show the whole target to the camera.
    ShowTarget,
    /// Move the target to this part of the image, or rotate the camera.
    MoveTo(ImageRegion),
    /// Tilt the target so that this side is farther from the camera.
    Tilt(Side),
    /// Take this many more images from other directions.
    More(usize),
    /// The images cover everything.
    Enough,
}

/// A part of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageRegion {
    /// The middle.
    Center,
    /// The upper left.
    UpperLeft,
    /// The upper right.
    UpperRight,
    /// The lower left.
    LowerLeft,
    /// The lower right.
    LowerRight,
}

/// A side of the target as the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The left side.
    Left,
    /// The right side.
    Right,
    /// The upper side.
    Upper,
    /// The lower side.
    Lower,
}

/// Parts of the image, and their bounds as fractions of its width and height.
const REGIONS: [(ImageRegion, [[f64; 2]; 2]); 5] = [
    (ImageRegion::Center, [[0.3, 0.7], [0.3, 0.7]]),
    (ImageRegion::UpperLeft, [[0.0, 0.4], [0.0, 0.4]]),
    (ImageRegion::LowerRight, [[0.6, 1.0], [0.6, 1.0]]),
    (ImageRegion::UpperRight, [[0.6, 1.0], [0.0, 0.4]]),
    (ImageRegion::LowerLeft, [[0.0, 0.4], [0.6, 1.0]]),
];

impl IntrinsicsGuidance {
    /// Guidance for the images so far.
    ///
    /// * `intrinsics`: an approximate lens with the size of the images. It is used to estimate the
    ///   tilts.
    pub fn new(views: &[BoardView], intrinsics: &Intrinsics) -> Self {
        let points = views.iter().flat_map(|view| &view.points);
        let coverage = ImageGrid::coverage(intrinsics.size_px, points.map(|point| point.pixel));
        let n_covered = coverage.values.iter().filter(|n| **n > 0).count();
        Self {
            n_images: views.len(),
            covered_frac: n_covered as f64 / coverage.values.len() as f64,
            advice: advice(views, &coverage, intrinsics),
        }
    }
}

/// Advice about the first missing item. Missing tilts come before missing parts of the image.
fn advice(
    views: &[BoardView],
    coverage: &ImageGrid<usize>,
    intrinsics: &Intrinsics,
) -> IntrinsicsAdvice {
    if views.is_empty() {
        return IntrinsicsAdvice::ShowTarget;
    }
    let tilts: Vec<[f64; 2]> = views
        .iter()
        .filter_map(|view| tilt_deg(view, intrinsics))
        .collect();
    // Tilts come first, because they determine the focal length, and coverage is of little use
    // without it.
    let n_tilted = |side: Side| tilts.iter().filter(|tilt| is_tilted(side, **tilt)).count();
    let missing_tilt = [Side::Left, Side::Right, Side::Upper, Side::Lower]
        .into_iter()
        .find(|side| n_tilted(*side) < MIN_TILTED);
    let missing_region = REGIONS
        .into_iter()
        .find(|(_, bounds)| covered_frac(coverage, *bounds) < MIN_COVERED_FRAC);
    let missing_region = missing_region.map(|(region, _)| region);
    match (missing_tilt, missing_region) {
        (Some(side), _) => IntrinsicsAdvice::Tilt(side),
        (None, Some(region)) => IntrinsicsAdvice::MoveTo(region),
        (None, None) if views.len() < RECOMMENDED_IMAGES => {
            IntrinsicsAdvice::More(RECOMMENDED_IMAGES - views.len())
        }
        (None, None) => IntrinsicsAdvice::Enough,
    }
}

/// Whether a tilt that [`tilt_deg`] has returned moves a side away from the camera.
fn is_tilted(side: Side, [about_x, about_y]: [f64; 2]) -> bool {
    let angle = match side {
        Side::Left => about_y,
        Side::Right => -about_y,
        Side::Upper => -about_x,
        Side::Lower => about_x,
    };
    angle >= MIN_TILT_DEG
}

/// Fraction of the cells with corners among those whose centers are in a part of the image.
fn covered_frac(coverage: &ImageGrid<usize>, [columns, rows]: [[f64; 2]; 2]) -> f64 {
    let is_inside = |ix: usize, n: usize, [low, high]: [f64; 2]| {
        (low..high).contains(&((ix as f64 + 0.5) / n as f64))
    };
    let mut n = 0_u32;
    let mut n_covered = 0_u32;
    for (ix, value) in coverage.values.iter().enumerate() {
        let column = ix % coverage.n_columns;
        let row = ix / coverage.n_columns;
        if is_inside(column, coverage.n_columns, columns) && is_inside(row, coverage.n_rows, rows) {
            n += 1;
            n_covered += u32::from(*value > 0);
        }
    }
    f64::from(n_covered) / f64::from(n.max(1))
}

/// Rotation of the target about the x and the y axis of the camera relative to facing it, degrees.
/// With a positive angle about y, the left side is farther away. With a positive angle about x, the
/// lower side is farther away.
fn tilt_deg(view: &BoardView, intrinsics: &Intrinsics) -> Option<[f64; 2]> {
    let pose = board_pose(intrinsics, &view.points)?.camera_from_board;
    let center = view
        .points
        .iter()
        .map(|point| point.point_in_board)
        .sum::<Vector3<f64>>()
        / view.points.len() as f64;
    let sight = (pose * nalgebra::Point3::from(center))
        .coords
        .try_normalize(0.0)?;
    // A numbering of the points may be mirrored, so the normal may point to either side.
    let normal = pose.rotation * Vector3::z();
    let normal = if normal.dot(&sight) < 0.0 {
        -normal
    } else {
        normal
    };
    let tilt = sight.cross(&normal);
    let angle = tilt.norm().clamp(0.0, 1.0).asin().to_degrees();
    let axis = tilt.try_normalize(0.0).unwrap_or_default();
    Some([angle * axis.x, angle * axis.y])
}

impl fmt::Display for IntrinsicsAdvice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ShowTarget => f.write_str("show the whole target to the camera"),
            Self::MoveTo(region) => write!(f, "move the target to {region}"),
            Self::Tilt(side) => {
                write!(
                    f,
                    "tilt the target by 20 to 45 degrees, with its {side} side away from the camera"
                )
            }
            Self::More(1) => f.write_str("take one more image from another direction"),
            Self::More(n) => write!(
                f,
                "take {n} more images from other directions and distances"
            ),
            Self::Enough => f.write_str("the images cover everything"),
        }
    }
}

impl fmt::Display for ImageRegion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Center => "the center of the image",
            Self::UpperLeft => "the upper left of the image",
            Self::UpperRight => "the upper right of the image",
            Self::LowerLeft => "the lower left of the image",
            Self::LowerRight => "the lower right of the image",
        })
    }
}

impl fmt::Display for Side {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Left => "left",
            Self::Right => "right",
            Self::Upper => "upper",
            Self::Lower => "lower",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BoardPoint;
    use kinematics::{Lens, Transform};
    use nalgebra::{Point3, UnitQuaternion};

    fn camera() -> Intrinsics {
        Intrinsics {
            size_px: [640, 480],
            focal_px: [500.0; 2],
            principal_px: [320.0, 240.0],
            lens: Lens::Pinhole,
            rectified: false,
        }
    }

    /// A board of 0.2 x 0.15 m with its center at a point, rotated about the axes of the camera.
    fn view(center: [f64; 3], rotation_deg: [f64; 3]) -> BoardView {
        let rotation =
            UnitQuaternion::from_scaled_axis(Vector3::from(rotation_deg).map(f64::to_radians));
        let pose = Transform::from_parts(Vector3::from(center).into(), rotation);
        let points = (0..63)
            .map(|ix| Vector3::new(f64::from(ix % 9) - 4.0, f64::from(ix / 9) - 3.0, 0.0) * 0.025);
        let points = points.map(|point_in_board| {
            let pixel = camera()
                .project(&(pose * Point3::from(point_in_board)).coords)
                .expect("in front");
            BoardPoint {
                point_in_board,
                pixel,
            }
        });
        BoardView {
            name: String::new(),
            points: points.collect(),
        }
    }

    #[test]
    fn tilts_have_the_signs_of_their_sides() {
        // A positive rotation about y moves the left side (negative x) to larger z: z' = -x
        // sin(angle).
        let [about_x, about_y] =
            tilt_deg(&view([0.0, 0.0, 0.5], [0.0, 30.0, 0.0]), &camera()).unwrap();
        assert!(
            about_x.abs() < 0.1 && (about_y - 30.0).abs() < 0.1,
            "{about_x} {about_y}"
        );
        let left = view([0.0, 0.0, 0.5], [0.0, 30.0, 0.0]);
        let spread = |view: &BoardView, is_left: bool| {
            let side = view
                .points
                .iter()
                .filter(|point| (point.point_in_board.x < -0.09) == is_left);
            let ys: Vec<f64> = side
                .filter(|point| point.point_in_board.x.abs() > 0.09)
                .map(|point| point.pixel[1])
                .collect();
            ys.iter().fold(f64::MIN, |a, b| a.max(*b)) - ys.iter().fold(f64::MAX, |a, b| a.min(*b))
        };
        assert!(
            spread(&left, true) < spread(&left, false),
            "the left side looks smaller"
        );
    }

    #[test]
    fn advice_leads_to_images_that_cover_everything() {
        assert_eq!(
            IntrinsicsGuidance::new(&[], &camera()).advice,
            IntrinsicsAdvice::ShowTarget
        );
        let mut views = Vec::new();
        let mut seen = Vec::new();
        for _ in 0..40 {
            let guidance = IntrinsicsGuidance::new(&views, &camera());
            seen.push(guidance.advice);
            views.push(match guidance.advice {
                IntrinsicsAdvice::ShowTarget | IntrinsicsAdvice::More(_) => view(
                    [0.0, 0.0, 0.4 + 0.01 * views.len() as f64],
                    [1.0, 2.0, 10.0],
                ),
                IntrinsicsAdvice::MoveTo(region) => {
                    let [x, y] = match region {
                        ImageRegion::Center => [0.0, 0.0],
                        ImageRegion::UpperLeft => [-0.13, -0.1],
                        ImageRegion::UpperRight => [0.13, -0.1],
                        ImageRegion::LowerLeft => [-0.13, 0.1],
                        ImageRegion::LowerRight => [0.13, 0.1],
                    };
                    view([x, y, 0.4], [0.0, 0.0, 5.0])
                }
                IntrinsicsAdvice::Tilt(side) => {
                    let tilt = match side {
                        Side::Left => [0.0, 30.0, 0.0],
                        Side::Right => [0.0, -30.0, 0.0],
                        Side::Upper => [-30.0, 0.0, 0.0],
                        Side::Lower => [30.0, 0.0, 0.0],
                    };
                    view([0.0, 0.0, 0.45], tilt)
                }
                IntrinsicsAdvice::Enough => break,
            });
        }
        let last = IntrinsicsGuidance::new(&views, &camera());
        assert_eq!(
            (last.advice, last.n_images),
            (IntrinsicsAdvice::Enough, RECOMMENDED_IMAGES),
            "{seen:?}"
        );
        assert!(last.covered_frac > 0.6, "{}", last.covered_frac);
        for side in [Side::Left, Side::Right, Side::Upper, Side::Lower] {
            assert!(
                seen.contains(&IntrinsicsAdvice::Tilt(side)),
                "{side}: {seen:?}"
            );
        }
        assert!(
            seen.contains(&IntrinsicsAdvice::MoveTo(ImageRegion::UpperLeft)),
            "{seen:?}"
        );
    }

    #[test]
    fn frontal_images_never_suffice() {
        let views: Vec<BoardView> = (0..30)
            .map(|ix| {
                view(
                    [0.01 * f64::from(ix % 5), 0.0, 0.4],
                    [0.0, 0.0, f64::from(ix)],
                )
            })
            .collect();
        let advice = IntrinsicsGuidance::new(&views, &camera()).advice;
        assert!(matches!(advice, IntrinsicsAdvice::Tilt(_)), "{advice}");
        assert!(
            advice
                .to_string()
                .starts_with("tilt the target by 20 to 45 degrees, with its left side"),
            "{advice}"
        );
    }
}
