//! Checks whether photographs of a target determine a lens, and suggests which photograph to take
//! next. This works before a calibration exists.
//!
//! # The rule
//!
//! - **Parts of the image.** The image has 16 x 9 cells and is divided into 3 x 3 parts. In each
//!   part, half of the cells need a corner of the target. Between target corners, a lens model
//!   interpolates. Beyond them, it extrapolates, and its error grows with a power of the distance.
//!   The distortion is largest in the corners of the image, so these parts need target corners as
//!   well as the center does. Not every cell needs a target corner, because the distortion is
//!   smooth over several cells. The corners of a whole chessboard cannot reach the outermost cells
//!   anyway, because the detector needs the margin of the board.
//! - **Tilts.** Each of the left, right, upper and lower side of the target must be tilted away
//!   from the camera in two photographs. If all photographs face the target, a longer focal length
//!   looks the same as a larger distance (Zhang 2000, section 3.3: parallel planes add no
//!   constraints). Opposite tilts separate the focal length from the principal point, because they
//!   move the principal point in opposite directions. Two photographs per side are requested,
//!   because one of them may be rejected later.
//! - **Distances.** In two photographs, the target must be large in the image. In two others, it
//!   must be clearly smaller. The large targets determine the focal length from the perspective of
//!   a tilted target. The sizes of its near and far sides differ by a fraction that is the size of
//!   the target divided by its distance. This fraction must be large compared with the errors of
//!   corners. The smaller targets cover the same part of the image from another distance, so that
//!   the unevenness of a target is not mistaken for distortion. A whole target also fits into the
//!   corners of the image only if it is small.
//! - **Number.** There must be at least [`RECOMMENDED_IMAGES`] different photographs, so that lens
//!   models can be compared on held-out photographs.
//!
//! The calibrator of ROS (`camera_calibration`) uses similar rules, which are ranges of position,
//! size and skew. The documentation of mrcal recommends similar rules in its section on
//! choreography.

mod goals;
mod shape;
#[cfg(test)]
mod tests;
mod words;

pub use goals::{CoverageGoal, GoalProgress, ImagePart, NextPhotograph, Side};

use super::grid::ImageGrid;
use crate::BoardView;
use kinematics::Intrinsics;
use shape::ViewShape;

/// Number of photographs that are sufficient, if they cover everything.
pub const RECOMMENDED_IMAGES: usize = 15;
/// A part of the image is covered if this fraction of its cells has corners.
const MIN_COVERED_FRAC: f64 = 0.5;
/// A tilt counts if the angle between the target and the image is at least this value. The value is
/// below the requested 20 degrees, because people estimate tilts by eye.
const MIN_TILT_DEG: f64 = 15.0;
/// Number of photographs with each tilt, with a near target, and with a far target.
const MIN_EACH: usize = 2;
/// The span of a target is the square root of the fraction of the image that its corners cover. A
/// target is near if its span is at least this value. It is far if its span is at most
/// [`FAR_RATIO`] times the largest span so far.
const NEAR_SPAN_FRAC: f64 = 0.4;
const FAR_RATIO: f64 = 0.6;
/// A photograph covers more of a part of the image if it has corners in this many new cells. One
/// cell could be due to the trembling of a hand.
const MIN_NEW_CELLS: usize = 2;

/// What the photographs so far cover.
#[derive(Clone, Debug)]
pub struct LensCoverage {
    intrinsics: Intrinsics,
    shapes: Vec<ViewShape>,
    cells: ImageGrid<usize>,
}

impl LensCoverage {
    /// The coverage without photographs.
    ///
    /// * `intrinsics`: an approximate lens with the size of the images. It is used to estimate the
    ///   tilts. If its focal length is wrong by a third, the tilts change by a few degrees.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        Self {
            intrinsics: intrinsics.clone(),
            shapes: Vec::new(),
            cells: ImageGrid::coverage(intrinsics.size_px, std::iter::empty()),
        }
    }

    /// Adds a photograph.
    pub fn add(&mut self, view: &BoardView) {
        self.shapes.push(ViewShape::of(view, &self.intrinsics));
        let cells = self.cells_of(view);
        for (n, new) in self.cells.values.iter_mut().zip(&cells.values) {
            *n += new;
        }
    }

    /// The goal that a photograph would help to reach. `None` if it would add nothing. A photograph
    /// that looks like an earlier photograph adds nothing.
    pub fn value_of(&self, view: &BoardView) -> Option<CoverageGoal> {
        let shape = ViewShape::of(view, &self.intrinsics);
        if self.shapes.iter().any(|other| !shape.differs_from(other)) {
            return None;
        }
        let cells = self.cells_of(view);
        let missing = self.goals().into_iter().filter(|goal| !goal.is_reached());
        let helps = |goal: &GoalProgress| match goal.goal {
            CoverageGoal::Part(part) => self.n_new_cells(part, &cells) >= MIN_NEW_CELLS,
            CoverageGoal::Tilt(side) => shape.tilt_away_deg(side) >= MIN_TILT_DEG,
            CoverageGoal::Near => shape.span_frac >= NEAR_SPAN_FRAC,
            CoverageGoal::Far => shape.span_frac <= FAR_RATIO * self.largest_span_frac(),
            // If other goals are still open, a photograph is not accepted only to increase the
            // number, because more photographs are needed anyway.
            CoverageGoal::Number => self.reaches_all_but_number(),
        };
        let goal = missing.into_iter().find(helps).map(|goal| goal.goal);
        // The first photograph is always accepted, so that the user sees that the target is found.
        goal.or(self.shapes.is_empty().then_some(CoverageGoal::Number))
    }

    /// Number of photographs.
    pub fn n_images(&self) -> usize {
        self.shapes.len()
    }

    /// Fraction of the cells of the image that contain corners, 0 to 1.
    pub fn covered_frac(&self) -> f64 {
        let n_covered = self.cells.values.iter().filter(|n| **n > 0).count();
        n_covered as f64 / self.cells.values.len() as f64
    }

    /// Width and height of the images, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        self.intrinsics.size_px
    }

    /// Number of corners in each cell of the image.
    pub fn cells(&self) -> &ImageGrid<usize> {
        &self.cells
    }

    /// All goals in the order in which they should be reached. Tilts come first, because they
    /// determine the focal length. Without the focal length, the other goals are of little use.
    pub fn goals(&self) -> Vec<GoalProgress> {
        let n_with = |counts: &dyn Fn(&ViewShape) -> bool| {
            self.shapes.iter().filter(|shape| counts(shape)).count()
        };
        let images = |goal, n_done| GoalProgress {
            goal,
            n_done,
            n_needed: MIN_EACH,
        };
        let mut goals = Vec::new();
        for side in Side::ALL {
            let is_tilted = |shape: &ViewShape| shape.tilt_away_deg(side) >= MIN_TILT_DEG;
            goals.push(images(CoverageGoal::Tilt(side), n_with(&is_tilted)));
        }
        let n_near = n_with(&|shape| shape.span_frac >= NEAR_SPAN_FRAC);
        goals.push(images(CoverageGoal::Near, n_near));
        goals.extend(ImagePart::REQUESTED.map(|part| self.part_progress(part)));
        let far = FAR_RATIO * self.largest_span_frac();
        let n_far = n_with(&|shape| shape.span_frac <= far);
        goals.push(images(CoverageGoal::Far, n_far));
        goals.push(GoalProgress {
            goal: CoverageGoal::Number,
            n_done: self.shapes.len(),
            n_needed: RECOMMENDED_IMAGES,
        });
        goals
    }

    /// The photograph to take next.
    pub fn next(&self) -> NextPhotograph {
        if self.shapes.is_empty() {
            return NextPhotograph::ShowTarget;
        }
        let missing = self.goals().into_iter().find(|goal| !goal.is_reached());
        missing.map_or(NextPhotograph::Enough, NextPhotograph::Toward)
    }

    /// Whether everything is covered.
    pub fn is_enough(&self) -> bool {
        self.next() == NextPhotograph::Enough
    }

    fn reaches_all_but_number(&self) -> bool {
        self.goals()
            .iter()
            .all(|goal| goal.goal == CoverageGoal::Number || goal.is_reached())
    }

    fn part_progress(&self, part: ImagePart) -> GoalProgress {
        let cells: Vec<usize> = self.cells_in(part).collect();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a part of the number of cells"
        )]
        let n_needed = (MIN_COVERED_FRAC * cells.len() as f64).ceil() as usize;
        GoalProgress {
            goal: CoverageGoal::Part(part),
            n_done: cells
                .iter()
                .filter(|ix| self.cells.values[**ix] > 0)
                .count(),
            n_needed,
        }
    }

    /// Number of cells in a part of the image that only `cells` covers.
    fn n_new_cells(&self, part: ImagePart, cells: &ImageGrid<usize>) -> usize {
        self.cells_in(part)
            .filter(|ix| self.cells.values[*ix] == 0 && cells.values[*ix] > 0)
            .count()
    }

    /// Indices of the cells whose centers are in a part of the image.
    fn cells_in(&self, part: ImagePart) -> impl Iterator<Item = usize> {
        let part_ix = ImagePart::ALL
            .iter()
            .position(|other| *other == part)
            .expect("the list contains every part");
        let ImageGrid {
            n_columns, n_rows, ..
        } = self.cells;
        // The third in which the center of the cell is.
        let third = |ix: usize, n: usize| 3 * (2 * ix + 1) / (2 * n);
        (0..n_columns * n_rows).filter(move |ix| {
            let column = third(ix % n_columns, n_columns);
            let row = third(ix / n_columns, n_rows);
            3 * row + column == part_ix
        })
    }

    fn cells_of(&self, view: &BoardView) -> ImageGrid<usize> {
        let pixels = view.points.iter().map(|point| point.pixel);
        ImageGrid::coverage(self.intrinsics.size_px, pixels)
    }

    fn largest_span_frac(&self) -> f64 {
        let spans = self.shapes.iter().map(|shape| shape.span_frac);
        spans.fold(0.0, f64::max)
    }
}
