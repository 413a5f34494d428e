//! What the photographs for a lens cover, in the words of the page.

use calibration::{CoverageGoal, ImagePart, LensCoverage, NextPhotograph, Side};
use viz::{CoverageItem, ImagePartCoverage, PhotographCoverage};

/// The coverage as clients draw it.
pub(crate) fn published(camera: &str, coverage: &LensCoverage) -> PhotographCoverage {
    let cells = coverage.cells();
    let goals = coverage.goals();
    let next = match coverage.next() {
        NextPhotograph::Toward(progress) => Some(progress.goal),
        NextPhotograph::ShowTarget | NextPhotograph::Enough => None,
    };
    let part = |part: ImagePart| {
        let goal = CoverageGoal::Part(part);
        let progress = goals.iter().find(|progress| progress.goal == goal);
        ImagePartCoverage {
            is_covered: progress.is_some_and(|progress| progress.is_reached()),
            is_next: next == Some(goal),
        }
    };
    let items = goals.iter().filter_map(|progress| {
        Some(CoverageItem {
            label: label(progress.goal)?.to_owned(),
            n_done: progress.n_done,
            n_needed: progress.n_needed,
            is_next: next == Some(progress.goal),
        })
    });
    PhotographCoverage {
        camera: camera.to_owned(),
        size_px: coverage.size_px(),
        cells: [cells.n_columns, cells.n_rows],
        is_covered: cells.values.iter().map(|n| *n > 0).collect(),
        parts: ImagePart::ALL.map(part).to_vec(),
        items: items.collect(),
    }
}

/// A short name of a goal; `None` for parts of the image, which are drawn.
fn label(goal: CoverageGoal) -> Option<&'static str> {
    Some(match goal {
        CoverageGoal::Part(_) => return None,
        CoverageGoal::Tilt(Side::Left) => "left side away",
        CoverageGoal::Tilt(Side::Right) => "right side away",
        CoverageGoal::Tilt(Side::Upper) => "upper side away",
        CoverageGoal::Tilt(Side::Lower) => "lower side away",
        CoverageGoal::Near => "near",
        CoverageGoal::Far => "far",
        CoverageGoal::Number => "photographs",
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::{BoardPoint, BoardView};
    use kinematics::{Intrinsics, Lens};
    use nalgebra::Vector3;

    #[test]
    fn cells_parts_and_items_are_those_of_the_rule() {
        let mut coverage = LensCoverage::new(&Intrinsics {
            size_px: [640, 480],
            focal_px: [500.0; 2],
            principal_px: [320.0, 240.0],
            lens: Lens::Pinhole,
            rectified: false,
        });
        let before = published("front", &coverage);
        assert_eq!(
            (&*before.camera, before.size_px, before.cells),
            ("front", [640, 480], [16, 9])
        );
        assert!(!before.is_covered.contains(&true) && before.parts.len() == 9);
        assert!(
            before
                .items
                .iter()
                .all(|item| item.n_done == 0 && !item.is_next)
        );
        // A frontal target in the upper left of the image.
        let points = (0..35).map(|ix| {
            let (x, y) = (f64::from(ix % 7), f64::from(ix / 7));
            BoardPoint {
                point_in_board: Vector3::new(0.03 * x, 0.03 * y, 0.0),
                pixel: [20.0 + 30.0 * x, 20.0 + 30.0 * y],
            }
        });
        coverage.add(&BoardView {
            name: String::new(),
            points: points.collect(),
        });
        let after = published("front", &coverage);
        assert!(after.is_covered[0] && !after.is_covered[143]);
        assert!(after.parts[0].is_covered && !after.parts[8].is_covered);
        let next: Vec<&str> = after
            .items
            .iter()
            .filter(|item| item.is_next)
            .map(|item| &*item.label)
            .collect();
        assert_eq!(next, ["left side away"]);
        let photographs = after.items.last().expect("the number is the last one");
        assert_eq!(
            (&*photographs.label, photographs.n_done),
            ("photographs", 1)
        );
    }
}
