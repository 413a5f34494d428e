//! Accuracy of detected corners in rendered images, whose corners are known.

use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use targets::synthetic::{View, render, truth};
use targets::{Detection, GrayImage, NotDetected, TargetSpec};

/// Moderate perspective, with two rotations about the viewing axis.
const TILTED: [[f64; 3]; 2] = [[0.5, -0.4, 0.3], [-0.4, 0.5, 2.0]];

fn camera() -> Intrinsics {
    Intrinsics {
        size_px: [640, 480],
        focal_px: [600.0, 600.0],
        principal_px: [322.0, 238.0],
        lens: Lens::BrownConrady([-0.2, 0.05, 0.001, -0.0005, 0.0]),
        rectified: false,
    }
}

fn fisheye() -> Intrinsics {
    Intrinsics {
        size_px: [800, 800],
        focal_px: [290.0, 290.0],
        principal_px: [400.0, 400.0],
        lens: Lens::KannalaBrandt([0.02, -0.01, 0.002, 0.0]),
        rectified: false,
    }
}

/// Pose of a board whose center is at a position, rotated about its center.
fn camera_from_board(
    target: &TargetSpec,
    center_in_camera: [f64; 3],
    rotation_rad: [f64; 3],
) -> Transform {
    let [low, high] = target.bounds_m();
    let center = Vector3::new((low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, 0.0);
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(rotation_rad));
    Transform::from_parts(
        Translation3::from(Vector3::from(center_in_camera) - rotation * center),
        rotation,
    )
}

/// The whole target in view.
fn view(target: &TargetSpec, rotation_rad: [f64; 3], blur_px: f64, noise: f64) -> View {
    let [low, high] = target.bounds_m();
    let size_m = (high[0] - low[0]).max((high[1] - low[1]) * 4.0 / 3.0);
    let camera_from_board = camera_from_board(
        target,
        [0.01 * size_m, -0.02 * size_m, 1.5 * size_m],
        rotation_rad,
    );
    View {
        intrinsics: camera(),
        camera_from_board,
        blur_px,
        noise,
        seed: 7,
        is_legacy: false,
    }
}

/// Detects `target` in an image of `seen`.
fn detect(target: &TargetSpec, seen: &TargetSpec, view: &View) -> Result<Detection, NotDetected> {
    let pixels = render(seen, view);
    target.detect(GrayImage {
        size_px: view.intrinsics.size_px,
        pixels: &pixels,
    })
}

/// RMS and largest distance to the truth, pixels, and the part of the visible corners that is
/// detected.
fn errors(target: &TargetSpec, view: &View, detection: &Detection) -> [f64; 3] {
    let truth = truth(target, view);
    let off = detection.corners.iter().map(|corner| {
        let (_, pixel) = truth
            .iter()
            .find(|(id, _)| *id == corner.id)
            .expect("detected corners are visible");
        (corner.pixel[0] - pixel[0]).hypot(corner.pixel[1] - pixel[1])
    });
    let off: Vec<f64> = off.collect();
    let rms = (off.iter().map(|off| off * off).sum::<f64>() / off.len() as f64).sqrt();
    [
        rms,
        off.iter().fold(0.0, |max, off| off.max(max)),
        off.len() as f64 / truth.len() as f64,
    ]
}

struct Case {
    spec: &'static str,
    blur_px: f64,
    noise: f64,
    /// Limits for RMS and largest error in pixels, and for the detected part.
    limits: [f64; 3],
}

const fn case(spec: &'static str, blur_px: f64, noise: f64, limits: [f64; 3]) -> Case {
    Case {
        spec,
        blur_px,
        noise,
        limits,
    }
}

/// Limits are about 1.5 times the errors when the test was written.
const CASES: [Case; 12] = [
    case("chessboard:9x6:25mm", 0.7, 2.0, [0.03, 0.08, 1.0]),
    case("chessboard:9x6:25mm", 2.5, 3.0, [0.06, 0.15, 1.0]),
    case("chessboard:9x6:25mm", 0.7, 12.0, [0.08, 0.2, 0.96]),
    case("charuco:9x6:25mm:19mm:5X5_100", 0.7, 2.0, [0.03, 0.08, 1.0]),
    case("charuco:9x6:25mm:22mm:4X4_250", 1.5, 3.0, [0.06, 0.15, 1.0]),
    case("charuco:9x6:25mm:22mm:4X4_250", 0.7, 12.0, [0.08, 0.2, 1.0]),
    case("charuco:5x7:34mm:28mm:6X6_250", 0.7, 2.0, [0.03, 0.08, 1.0]),
    case("aprilgrid:5x4:40mm:0.3", 1.5, 5.0, [0.08, 0.2, 0.8]),
    case("puzzleboard:12x9:20mm", 0.7, 2.0, [0.04, 0.12, 0.95]),
    case("puzzleboard:12x9:20mm:101x250", 1.0, 5.0, [0.06, 0.2, 0.95]),
    // Corners of single tags are not saddles. Blur moves them, and only one edge per side locates
    // them.
    case("tag:36h11:7:100mm", 0.7, 2.0, [0.25, 0.4, 0.75]),
    case("tag:36h11:586:100mm", 1.5, 5.0, [0.35, 0.6, 0.75]),
];

#[test]
fn corners_of_every_target_are_accurate() {
    let mut failures = Vec::new();
    for (ix, case) in CASES.iter().enumerate() {
        let target: TargetSpec = case.spec.parse().unwrap();
        let rotation_rad = TILTED[ix % 2];
        let view = view(&target, rotation_rad, case.blur_px, case.noise);
        let name = format!(
            "{} blur {} noise {} {rotation_rad:?}",
            case.spec, case.blur_px, case.noise
        );
        match detect(&target, &target, &view) {
            Ok(detection) => {
                let [rms, max, part] = errors(&target, &view, &detection);
                let [rms_limit, max_limit, min_part] = case.limits;
                let line = format!(
                    "{name}: rms {rms:.3} px, max {max:.2} px, {:.0} % of the corners",
                    part * 100.0
                );
                eprintln!("{line}");
                if rms > rms_limit || max > max_limit || part < min_part {
                    failures.push(line);
                }
            }
            Err(error) => failures.push(format!("{name}: {error}")),
        }
    }
    assert_eq!(failures, Vec::<String>::new());
}

#[test]
fn boards_are_detected_through_a_fisheye_lens() {
    // Each case has the field of view that the board's width covers, and limits as above.
    let cases = [
        ("chessboard:9x6:25mm", 150.0_f64, [0.08, 0.2, 0.95]),
        ("chessboard:13x12:25mm", 140.0, [0.08, 0.6, 0.95]),
        ("charuco:12x11:25mm:19mm:5X5_100", 120.0, [0.05, 0.15, 1.0]),
        ("charuco:12x11:25mm:19mm:5X5_100", 150.0, [0.2, 0.6, 0.35]),
        ("puzzleboard:14x13:20mm", 120.0, [0.08, 0.4, 0.8]),
        ("aprilgrid:6x6:88mm:0.3", 120.0, [0.05, 0.15, 0.6]),
    ];
    let mut failures = Vec::new();
    for (spec, field_deg, [rms_limit, max_limit, min_part]) in cases {
        let target: TargetSpec = spec.parse().unwrap();
        let [low, high] = target.bounds_m();
        let distance_m = (high[0] - low[0]) / 2.0 / (field_deg / 2.0).to_radians().tan();
        let camera_from_board =
            camera_from_board(&target, [0.0, 0.0, distance_m], [0.03, -0.03, 0.2]);
        let view = View {
            intrinsics: fisheye(),
            camera_from_board,
            blur_px: 0.7,
            noise: 2.0,
            seed: 3,
            is_legacy: false,
        };
        match detect(&target, &target, &view) {
            Ok(detection) => {
                let [rms, max, part] = errors(&target, &view, &detection);
                let line = format!(
                    "{spec} {field_deg}: rms {rms:.3} px, max {max:.2} px, {:.0} %",
                    part * 100.0
                );
                eprintln!("{line}");
                if rms > rms_limit || max > max_limit || part < min_part {
                    failures.push(line);
                }
            }
            Err(error) => failures.push(format!("{spec} {field_deg}: {error}")),
        }
    }
    assert_eq!(failures, Vec::<String>::new());
}

#[test]
fn partly_visible_boards_are_detected_if_they_can_be_identified() {
    for spec in [
        "charuco:9x6:25mm:19mm:5X5_100",
        "aprilgrid:5x4:40mm:0.3",
        "puzzleboard:16x12:20mm",
    ] {
        let target: TargetSpec = spec.parse().unwrap();
        let mut view = view(&target, TILTED[0], 0.7, 2.0);
        view.camera_from_board.translation.vector.x +=
            0.45 * view.camera_from_board.translation.vector.z;
        let detection =
            detect(&target, &target, &view).unwrap_or_else(|error| panic!("{spec}: {error}"));
        let [rms, max, part] = errors(&target, &view, &detection);
        assert!(
            rms < 0.08 && max < 0.4 && part > 0.5,
            "{spec}: rms {rms}, max {max}, part {part}"
        );
        assert!(
            detection.corners.len() < detection.n_in_target,
            "{spec}: all of the board is in view"
        );
    }
    let target: TargetSpec = "chessboard:9x6:25mm".parse().unwrap();
    let mut view = view(&target, TILTED[0], 0.7, 2.0);
    view.camera_from_board.translation.vector.x +=
        0.6 * view.camera_from_board.translation.vector.z;
    let error = detect(&target, &target, &view).unwrap_err();
    assert!(matches!(error, NotDetected::Partial { .. }), "{error}");
}

#[test]
fn both_arrangements_of_charuco_boards_are_recognized() {
    for spec in [
        "charuco:9x6:25mm:19mm:5X5_100",
        "charuco:8x6:25mm:19mm:5X5_100",
        "charuco:5x7:34mm:28mm:6X6_250",
    ] {
        let target: TargetSpec = spec.parse().unwrap();
        let has_even_rows = !spec.contains("x7");
        for is_legacy in [false, true] {
            let view = View {
                is_legacy,
                ..view(&target, TILTED[1], 0.7, 2.0)
            };
            let detection =
                detect(&target, &target, &view).unwrap_or_else(|error| panic!("{spec}: {error}"));
            assert_eq!(detection.is_legacy, is_legacy && has_even_rows, "{spec}");
            let [_, max, part] = errors(&target, &view, &detection);
            assert!(max < 0.15 && part == 1.0, "{spec}: max {max}, part {part}");
        }
    }
}

#[test]
fn first_corner_is_next_to_a_black_square_in_every_rotation() {
    let target: TargetSpec = "chessboard:6x5:25mm".parse().unwrap();
    for quarter in 0..4 {
        let view = view(
            &target,
            [
                0.1,
                0.2,
                f64::from(quarter) * std::f64::consts::FRAC_PI_2 + 0.1,
            ],
            0.7,
            1.0,
        );
        let detection = detect(&target, &target, &view).unwrap();
        let [_, max, _] = errors(&target, &view, &detection);
        assert!(max < 0.2, "quarter turn {quarter}: off by {max} px");
    }
}

#[test]
fn square_boards_are_numbered_up_to_their_symmetry() {
    let target: TargetSpec = "chessboard:7x7:25mm".parse().unwrap();
    assert_eq!(target.symmetry().len(), 2);
    for quarter in 0..4 {
        let view = view(
            &target,
            [
                0.1,
                0.2,
                f64::from(quarter) * std::f64::consts::FRAC_PI_2 + 0.1,
            ],
            0.7,
            1.0,
        );
        let detection = detect(&target, &target, &view).unwrap();
        let truth = truth(&target, &view);
        let n = target.n_corners();
        let max_error = |id_of: &dyn Fn(u32) -> u32| {
            let of_corner = |corner: &targets::DetectedCorner| {
                let (_, pixel) = truth
                    .iter()
                    .find(|(id, _)| *id == id_of(corner.id))
                    .expect("all corners are visible");
                (corner.pixel[0] - pixel[0]).hypot(corner.pixel[1] - pixel[1])
            };
            detection.corners.iter().map(of_corner).fold(0.0, f64::max)
        };
        let max = max_error(&|id| id).min(max_error(&|id| n - 1 - id));
        assert!(max < 0.2, "quarter turn {quarter}: off by {max} px");
    }
}

#[test]
fn mistakes_are_explained() {
    for (wanted, seen, expected) in [
        (
            "chessboard:9x6:25mm",
            "chessboard:8x6:25mm",
            "found a board with 8x6 inner corners, expected 9x6",
        ),
        (
            "chessboard:8x6:25mm",
            "chessboard:9x6:25mm",
            "found a board with 9x6 inner corners, expected 8x6",
        ),
        (
            "chessboard:9x6:25mm",
            "tag:36h11:3:25mm",
            "no chessboard found in the image",
        ),
        (
            "charuco:9x6:25mm:19mm:4X4_50",
            "charuco:9x6:25mm:19mm:6X6_250",
            "of 6X6_50, expected 4X4_50",
        ),
        (
            "charuco:9x6:25mm:19mm:5X5_50",
            "chessboard:9x6:25mm",
            "no ChArUco board found",
        ),
        (
            "charuco:5x7:25mm:19mm:5X5_50",
            "charuco:7x5:25mm:19mm:5X5_50",
            "a board of 7x5 squares (or more rows), not 5x7",
        ),
        (
            "aprilgrid:4x3:40mm:0.3",
            "tag:36h11:300:40mm",
            "found markers with ids 300, expected 0 to 11",
        ),
        (
            "tag:36h11:5:40mm",
            "tag:36h11:7:40mm",
            "found markers with ids 7, expected 5",
        ),
        (
            "puzzleboard:12x9:20mm",
            "puzzleboard:12x9:20mm:200x200",
            "its code does not match",
        ),
        (
            "puzzleboard:12x9:20mm",
            "chessboard:11x8:20mm",
            "its code does not match",
        ),
    ] {
        let [target, seen_target]: [TargetSpec; 2] =
            [wanted, seen].map(|spec| spec.parse().unwrap());
        let view = view(&seen_target, [0.2, -0.2, 0.1], 0.7, 2.0);
        let message = detect(&target, &seen_target, &view)
            .expect_err(wanted)
            .to_string();
        assert!(
            message.contains(expected),
            "{wanted} in an image of {seen}: {message}"
        );
    }
}

#[test]
fn mirrored_markers_are_reported() {
    let target: TargetSpec = "charuco:9x6:25mm:19mm:6X6_250".parse().unwrap();
    let view = view(&target, [0.2, -0.2, 0.1], 0.7, 2.0);
    let mut pixels = render(&target, &view);
    pixels
        .chunks_exact_mut(view.intrinsics.size_px[0] as usize)
        .for_each(<[u8]>::reverse);
    let error = target
        .detect(GrayImage {
            size_px: view.intrinsics.size_px,
            pixels: &pixels,
        })
        .unwrap_err();
    assert!(matches!(error, NotDetected::Mirrored { .. }), "{error}");
}

#[test]
fn pictures_of_every_target_are_detected_at_their_exact_places() {
    for (spec, px_per_m) in [
        ("chessboard:9x6:25mm", 1600.0),
        ("charuco:5x7:34mm:28mm:6X6_250", 1500.0),
        ("charuco:6x8:30mm:24mm:7X7_1000", 2000.0),
        ("aprilgrid:6x6:88mm:0.3", 800.0),
        ("puzzleboard:12x9:20mm", 2000.0),
        ("tag:36h11:42:100mm", 2000.0),
    ] {
        let target: TargetSpec = spec.parse().unwrap();
        let picture = target.raster(px_per_m).unwrap();
        let image = GrayImage {
            size_px: picture.size_px,
            pixels: &picture.pixels,
        };
        let detection = target
            .detect(image)
            .unwrap_or_else(|error| panic!("{spec}: {error}"));
        assert_eq!(detection.corners.len(), detection.n_in_target, "{spec}");
        for corner in detection.corners {
            for axis in 0..2 {
                let pixel = (corner.point_in_board[axis] - picture.origin_m[axis]) * px_per_m;
                let off = (corner.pixel[axis] - pixel).abs();
                assert!(off < 0.05, "{spec} corner {}: off by {off} px", corner.id);
            }
        }
    }
}

#[test]
fn images_without_targets_and_broken_images_are_errors() {
    let mut random = numbers::random::Random::new(5);
    let noise = random.bytes(320 * 240);
    let gradient: Vec<u8> = (0..320 * 240_u32)
        .map(|at| u8::try_from(at % 320 / 2).unwrap())
        .collect();
    for spec in [
        "chessboard:9x6:25mm",
        "charuco:9x6:25mm:19mm:4X4_1000",
        "puzzleboard:12x9:20mm",
        "tag:36h11:0:1m",
    ] {
        let target: TargetSpec = spec.parse().unwrap();
        for pixels in [
            &noise,
            &gradient,
            &vec![0; 320 * 240],
            &vec![255; 320 * 240],
        ] {
            let error = target
                .detect(GrayImage {
                    size_px: [320, 240],
                    pixels,
                })
                .unwrap_err();
            assert!(
                !matches!(error, NotDetected::Image { .. }),
                "{spec}: {error}"
            );
        }
        for size_px in [[0, 0], [320, 239], [1, 76_800], [u32::MAX, 2]] {
            let error = target
                .detect(GrayImage {
                    size_px,
                    pixels: &noise,
                })
                .unwrap_err();
            assert!(
                matches!(error, NotDetected::Image { .. }),
                "{spec} {size_px:?}: {error}"
            );
        }
    }
}
