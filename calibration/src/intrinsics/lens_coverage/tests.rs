//! The rule with simulated views of a target.

use super::*;
use crate::{BoardPoint, IntrinsicsInput, LensModel, calibrate_intrinsics};
use kinematics::{Lens, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use numbers::random::Random;

/// More photographs than a person would take.
const MAX_PHOTOGRAPHS: usize = 80;

pub(super) fn camera() -> Intrinsics {
    Intrinsics {
        size_px: [640, 480],
        focal_px: [500.0; 2],
        principal_px: [320.0, 240.0],
        lens: Lens::Pinhole,
        rectified: false,
    }
}

/// A board of 0.2 x 0.15 m with its center at a point, rotated about the axes of the camera.
pub(super) fn view(center: [f64; 3], rotation_deg: [f64; 3]) -> BoardView {
    view_of(&camera(), center, rotation_deg)
}

/// The view of such a board by a camera with any lens. Corners outside of the image are missing.
fn view_of(camera: &Intrinsics, center: [f64; 3], rotation_deg: [f64; 3]) -> BoardView {
    let rotation =
        UnitQuaternion::from_scaled_axis(Vector3::from(rotation_deg).map(f64::to_radians));
    let pose = Transform::from_parts(Vector3::from(center).into(), rotation);
    let points = (0..63)
        .map(|ix| Vector3::new(f64::from(ix % 9) - 4.0, f64::from(ix / 9) - 3.0, 0.0) * 0.025)
        .filter_map(|point_in_board| {
            let pixel = camera.project(&(pose * Point3::from(point_in_board)).coords)?;
            camera.contains(pixel).then_some(BoardPoint {
                point_in_board,
                pixel,
            })
        });
    BoardView {
        name: String::new(),
        points: points.collect(),
    }
}

/// A pose of the target with which a person follows an instruction.
fn follow(next: NextPhotograph, random: &mut Random) -> ([f64; 3], [f64; 3]) {
    let mut about = |value: f64, spread: f64| value + random.uniform(-spread, spread);
    let rotation_z = about(0.0, 12.0);
    let NextPhotograph::Toward(GoalProgress { goal, .. }) = next else {
        return (
            [0.0, 0.0, about(0.45, 0.03)],
            [about(0.0, 3.0), about(0.0, 3.0), rotation_z],
        );
    };
    match goal {
        CoverageGoal::Tilt(side) => {
            let angle = about(30.0, 8.0);
            let [x, y] = match side {
                Side::Left => [0.0, angle],
                Side::Right => [0.0, -angle],
                Side::Upper => [-angle, 0.0],
                Side::Lower => [angle, 0.0],
            };
            (
                [about(0.0, 0.02), about(0.0, 0.02), about(0.4, 0.03)],
                [x, y, rotation_z],
            )
        }
        CoverageGoal::Near => (
            [0.0, 0.0, about(0.26, 0.02)],
            [about(0.0, 9.0), about(0.0, 9.0), rotation_z],
        ),
        CoverageGoal::Far => (
            [about(0.0, 0.1), about(0.0, 0.1), about(0.8, 0.08)],
            [about(0.0, 9.0), 0.0, rotation_z],
        ),
        CoverageGoal::Part(part) => {
            let ix = ImagePart::ALL.iter().position(|other| *other == part);
            let ix = u32::try_from(ix.expect("one of them")).expect("small");
            let third = |third: u32| f64::from(third) - 1.0;
            let center = [
                about(0.16 * third(ix % 3), 0.02),
                about(0.11 * third(ix / 3), 0.02),
                about(0.42, 0.02),
            ];
            (center, [about(0.0, 10.0), about(0.0, 10.0), rotation_z])
        }
        CoverageGoal::Number => (
            [about(0.0, 0.1), about(0.0, 0.08), about(0.5, 0.1)],
            [about(0.0, 25.0), about(0.0, 25.0), rotation_z],
        ),
    }
}

/// The photographs that are accepted while a person follows the instructions. Each corner has an
/// error.
fn guided(camera: &Intrinsics, noise_px: f64, seed: u64) -> (LensCoverage, Vec<BoardView>) {
    let mut random = Random::new(seed);
    // Only an approximate lens is known.
    let mut coverage = LensCoverage::new(&Intrinsics {
        focal_px: camera.focal_px.map(|focal| 1.15 * focal),
        principal_px: [320.0, 240.0],
        lens: Lens::Pinhole,
        ..camera.clone()
    });
    let mut accepted = Vec::new();
    for _ in 0..4 * MAX_PHOTOGRAPHS {
        if coverage.is_enough() {
            break;
        }
        let (center, rotation_deg) = follow(coverage.next(), &mut random);
        let mut view = view_of(camera, center, rotation_deg);
        for value in view.points.iter_mut().flat_map(|point| &mut point.pixel) {
            *value += noise_px * random.normal();
        }
        if coverage.value_of(&view).is_some() {
            coverage.add(&view);
            accepted.push(view);
        }
    }
    (coverage, accepted)
}

#[test]
fn following_the_instructions_covers_everything() {
    for seed in 0..5 {
        let (coverage, accepted) = guided(&camera(), 0.0, seed);
        assert!(coverage.is_enough(), "{:?}", coverage.goals());
        assert!(
            (RECOMMENDED_IMAGES..MAX_PHOTOGRAPHS).contains(&accepted.len()),
            "{}",
            accepted.len()
        );
        assert!(coverage.covered_frac() > 0.5, "{}", coverage.covered_frac());
    }
}

#[test]
fn what_is_covered_determines_the_lens_in_the_whole_image() {
    /// Errors of detected corners, pixels.
    const NOISE_PX: f64 = 0.1;
    /// Largest allowed standard deviation of the projection anywhere in the image, pixels. The next
    /// constant is the largest allowed error of the focal length, pixels. With the same number of
    /// frontal images, the calibration is refused.
    const MAX_SIGMA_PX: f64 = 1.0;
    const MAX_FOCAL_ERROR_PX: f64 = 2.0;
    let camera = Intrinsics {
        focal_px: [520.0, 518.0],
        principal_px: [327.0, 234.0],
        lens: Lens::BrownConrady([-0.12, 0.05, 0.0, 0.0, 0.0]),
        ..camera()
    };
    let (coverage, views) = guided(&camera, NOISE_PX, 3);
    assert!(coverage.is_enough(), "{:?}", coverage.goals());
    let calibrated = calibrate_intrinsics(&IntrinsicsInput {
        sizes_px: &vec![camera.size_px; views.len()],
        views: &views,
        model: LensModel::Auto,
    })
    .expect("enough images");
    let worst = calibrated
        .uncertainty_px
        .values
        .iter()
        .map(|sigma| sigma.expect("the lens images the whole grid"))
        .fold(0.0, f64::max);
    assert!(worst < MAX_SIGMA_PX, "{worst} px");
    for (found, truth) in calibrated.intrinsics.focal_px.iter().zip(camera.focal_px) {
        assert!(
            (found - truth).abs() < MAX_FOCAL_ERROR_PX,
            "{found} {truth}"
        );
    }
}

/// The coverage of all views. It is not checked whether a view adds anything.
fn coverage_of(views: impl IntoIterator<Item = BoardView>) -> LensCoverage {
    let mut coverage = LensCoverage::new(&camera());
    views.into_iter().for_each(|view| coverage.add(&view));
    coverage
}

fn is_reached(coverage: &LensCoverage, goal: CoverageGoal) -> bool {
    let goals = coverage.goals();
    let progress = goals.iter().find(|progress| progress.goal == goal);
    progress.expect("every goal is listed").is_reached()
}

#[test]
fn each_goal_needs_its_own_photographs() {
    let many = |rotation_deg: [f64; 3], z_m: f64| {
        (0..30).map(move |ix| {
            let (x, y) = (f64::from(ix % 6) - 2.5, f64::from(ix / 6) - 2.0);
            view(
                [0.06 * x * z_m / 0.4, 0.05 * y * z_m / 0.4, z_m],
                rotation_deg,
            )
        })
    };
    // Frontal images, wherever they are, have no tilts.
    let frontal = coverage_of(many([0.0; 3], 0.4));
    assert!(
        ImagePart::ALL
            .iter()
            .all(|part| is_reached(&frontal, CoverageGoal::Part(*part)))
    );
    assert!(
        Side::ALL
            .iter()
            .all(|side| !is_reached(&frontal, CoverageGoal::Tilt(*side)))
    );
    let advice = frontal.next().to_string();
    assert!(
        advice.starts_with("tilt the target by 20 to 45 degrees, with its left side"),
        "{advice}"
    );
    // All at one distance.
    assert!(!is_reached(&frontal, CoverageGoal::Far));
    assert!(!is_reached(
        &coverage_of(many([0.0; 3], 0.7)),
        CoverageGoal::Near
    ));
    // All targets are in the center, tilted to all sides and at all distances.
    let tilts = [
        [0.0, 30.0, 0.0],
        [0.0, -30.0, 0.0],
        [30.0, 0.0, 0.0],
        [-30.0, 0.0, 0.0],
    ];
    let central = tilts
        .iter()
        .flat_map(|tilt| [0.3, 0.35, 0.6, 0.7].map(|z_m| view([0.0, 0.0, z_m], *tilt)));
    let central = coverage_of(central);
    assert!(
        Side::ALL
            .iter()
            .all(|side| is_reached(&central, CoverageGoal::Tilt(*side)))
    );
    assert!(is_reached(&central, CoverageGoal::Near) && is_reached(&central, CoverageGoal::Far));
    assert_eq!(
        central.next().to_string(),
        "move the target to the upper left of the image"
    );
}

#[test]
fn a_photograph_counts_only_if_it_adds_something() {
    let mut coverage = LensCoverage::new(&camera());
    let first = view([0.0, 0.0, 0.4], [0.0; 3]);
    assert_eq!(coverage.next(), NextPhotograph::ShowTarget);
    assert!(
        coverage.value_of(&first).is_some(),
        "any first image is welcome"
    );
    coverage.add(&first);
    assert_eq!(coverage.value_of(&first), None, "it is the same image");
    let tilted = view([0.0, 0.0, 0.4], [0.0, 28.0, 0.0]);
    assert_eq!(
        coverage.value_of(&tilted),
        Some(CoverageGoal::Tilt(Side::Left))
    );
    coverage.add(&tilted);
    let again = view([0.0, 0.0, 0.4], [0.0, 37.0, 0.0]);
    assert_eq!(
        coverage.value_of(&again),
        Some(CoverageGoal::Tilt(Side::Left))
    );
    coverage.add(&again);
    let third = view([0.0, 0.0, 0.4], [0.0, 20.0, 0.0]);
    assert_eq!(coverage.value_of(&third), None, "there are two such tilts");
    let corner = view([-0.15, -0.1, 0.4], [0.0; 3]);
    assert_eq!(
        coverage.value_of(&corner),
        Some(CoverageGoal::Part(ImagePart::UpperLeft))
    );
}

#[test]
fn the_parts_of_the_image_share_its_cells() {
    let coverage = LensCoverage::new(&camera());
    let mut all: Vec<usize> = ImagePart::ALL
        .iter()
        .flat_map(|part| coverage.cells_in(*part))
        .collect();
    all.sort_unstable();
    let n = coverage.cells.values.len();
    assert_eq!(all, (0..n).collect::<Vec<_>>());
    let corner: Vec<usize> = coverage.cells_in(ImagePart::UpperLeft).collect();
    assert_eq!(
        corner,
        [0, 1, 2, 3, 4, 16, 17, 18, 19, 20, 32, 33, 34, 35, 36]
    );
}

#[test]
fn a_view_without_corners_adds_nothing_and_does_not_panic() {
    let empty = BoardView {
        name: String::new(),
        points: Vec::new(),
    };
    let mut coverage = coverage_of([view([0.0, 0.0, 0.4], [0.0; 3])]);
    let _ = coverage.value_of(&empty);
    coverage.add(&empty);
    assert!(!coverage.is_enough());
}
