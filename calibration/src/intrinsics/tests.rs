//! Calibrations of simulated cameras with known truth.

use super::{
    IntrinsicsCalibration, IntrinsicsInput, LensModel, RejectionReason, calibrate_intrinsics, grid,
};
use crate::{BoardPoint, BoardView, Error};
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use numbers::random::Random;

const SQUARE_M: f64 = 0.025;

pub(super) fn brown_conrady_camera() -> Intrinsics {
    Intrinsics {
        size_px: [640, 480],
        focal_px: [536.0, 532.0],
        principal_px: [331.0, 236.0],
        lens: Lens::BrownConrady([-0.28, 0.09, 0.001, -0.0008, -0.01]),
        rectified: false,
    }
}

pub(super) fn rational_camera() -> Intrinsics {
    let lens = Lens::RationalBrownConrady([0.5, 0.02, 0.001, -0.0005, 0.0, 0.7, 0.04, 0.0]);
    Intrinsics {
        focal_px: [350.0, 352.0],
        lens,
        ..brown_conrady_camera()
    }
}

/// Field of view of 150 degrees along the diagonal.
pub(super) fn fisheye_camera() -> Intrinsics {
    let lens = Lens::KannalaBrandt([-0.03, 0.01, -0.006, 0.001]);
    Intrinsics {
        focal_px: [300.0, 301.0],
        lens,
        ..brown_conrady_camera()
    }
}

/// 9 by 6 corners.
pub(super) fn board() -> Vec<Vector3<f64>> {
    (0..6)
        .flat_map(|row| {
            (0..9)
                .map(move |column| Vector3::new(f64::from(column), f64::from(row), 0.0) * SQUARE_M)
        })
        .collect()
}

/// The points of the target that the camera images.
pub(super) fn observe(
    camera: &Intrinsics,
    camera_from_board: &Transform,
    points_in_board: &[Vector3<f64>],
) -> Vec<BoardPoint> {
    let observe = |point: &Vector3<f64>| {
        let pixel = camera.project(&(camera_from_board * Point3::from(*point)).coords)?;
        camera.contains(pixel).then_some(BoardPoint {
            point_in_board: *point,
            pixel,
        })
    };
    points_in_board.iter().filter_map(observe).collect()
}

/// Poses of the target in front of a camera with a field of view of 60 degrees, tilted by up to 45
/// degrees.
pub(super) fn poses(n: usize, seed: u64) -> Vec<Transform> {
    let mut random = Random::new(seed);
    let mut pose = |_| {
        let mut uniform = |limit: f64| random.uniform(-limit, limit);
        let tilt = Vector3::new(uniform(0.8), uniform(0.8), 0.0);
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::z() * uniform(0.5))
            * UnitQuaternion::from_scaled_axis(tilt);
        let distance_m = 0.38 + uniform(0.12);
        let center = Vector3::new(
            uniform(0.35) * distance_m,
            uniform(0.25) * distance_m,
            distance_m,
        );
        let board_center = Vector3::new(4.0, 2.5, 0.0) * SQUARE_M;
        Transform::from_parts((center - rotation * board_center).into(), rotation)
    };
    (0..n).map(&mut pose).collect()
}

/// Poses that fill the image of a fisheye camera.
fn wide_poses(n: usize, seed: u64) -> Vec<Transform> {
    let mut random = Random::new(seed);
    let mut pose = |_| {
        let mut uniform = |limit: f64| random.uniform(-limit, limit);
        let sight =
            UnitQuaternion::from_scaled_axis(Vector3::new(uniform(0.5), uniform(0.75), 0.0));
        let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(
            uniform(0.7),
            uniform(0.7),
            uniform(0.5),
        ));
        let distance_m = 0.23 + uniform(0.06);
        let rotation = sight * tilt;
        let board_center = Vector3::new(4.0, 2.5, 0.0) * SQUARE_M;
        Transform::from_parts(
            (sight * Vector3::z() * distance_m - rotation * board_center).into(),
            rotation,
        )
    };
    (0..n).map(&mut pose).collect()
}

pub(super) fn observed_images(
    camera: &Intrinsics,
    poses: &[Transform],
    noise_px: f64,
    seed: u64,
) -> Vec<BoardView> {
    let mut random = Random::new(seed);
    let mut view = |(ix, pose): (usize, &Transform)| {
        let mut points = observe(camera, pose, &board());
        points
            .iter_mut()
            .flat_map(|point| &mut point.pixel)
            .for_each(|value| *value += noise_px * random.normal());
        BoardView {
            name: format!("image {ix}"),
            points,
        }
    };
    poses.iter().enumerate().map(&mut view).collect()
}

fn calibrate(
    camera: &Intrinsics,
    views: &[BoardView],
    model: LensModel,
) -> Result<IntrinsicsCalibration, Error> {
    calibrate_intrinsics(&IntrinsicsInput {
        views,
        sizes_px: &vec![camera.size_px; views.len()],
        model,
    })
}

/// Largest and root mean square displacement over the image after the best rotation.
fn displacement_px(truth: &Intrinsics, estimate: &Intrinsics) -> (f64, f64) {
    let norms: Vec<f64> = grid::displacements_px(truth, estimate)
        .iter()
        .flatten()
        .map(|d| d.norm())
        .collect();
    assert!(
        norms.len() > 100,
        "only {} cells are within the lens",
        norms.len()
    );
    let squares: f64 = norms.iter().map(|norm| norm * norm).sum();
    (
        norms.iter().copied().fold(0.0, f64::max),
        (squares / norms.len() as f64).sqrt(),
    )
}

/// Root mean square of the projection uncertainty over the image.
fn uncertainty_px(found: &IntrinsicsCalibration) -> f64 {
    let squares: Vec<f64> = found
        .uncertainty_px
        .values
        .iter()
        .flatten()
        .map(|sigma| sigma * sigma)
        .collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

#[test]
fn every_model_recovers_its_camera_without_noise() {
    for (camera, model, poses) in [
        (
            Intrinsics {
                lens: Lens::Pinhole,
                ..brown_conrady_camera()
            },
            LensModel::Pinhole,
            poses(8, 2),
        ),
        (
            brown_conrady_camera(),
            LensModel::BrownConrady5,
            poses(12, 2),
        ),
        (
            rational_camera(),
            LensModel::BrownConrady8,
            wide_poses(15, 2),
        ),
        (
            fisheye_camera(),
            LensModel::KannalaBrandt,
            wide_poses(15, 2),
        ),
    ] {
        let found = calibrate(&camera, &observed_images(&camera, &poses, 0.0, 1), model).unwrap();
        let (largest_px, _) = displacement_px(&camera, &found.intrinsics);
        assert!(
            found.rms_px < 1e-4 && largest_px < 2e-3,
            "{model:?}: rms {} px, off by {largest_px} px",
            found.rms_px
        );
        assert!(found.rejected.is_empty(), "{:?}", found.rejected);
        assert!(
            model == LensModel::BrownConrady8
                || (found.intrinsics.focal_px[0] - camera.focal_px[0]).abs() < 0.01
        );
    }
}

/// Images whose corners share smooth errors, as from a bent board, blur, or a lens that no model
/// describes. A pose of the board cannot explain them. Each corner also has an error of its own.
fn images_with_shared_errors(
    camera: &Intrinsics,
    poses: &[Transform],
    seed: u64,
) -> Vec<BoardView> {
    const SHARED_PX: f64 = 0.1;
    const OWN_PX: f64 = 0.05;
    let mut random = Random::new(seed);
    let mut view = |(ix, pose): (usize, &Transform)| {
        let mut points = observe(camera, pose, &board());
        // The shared error of each axis of the image is a random quadratic function of the position
        // on the board.
        let [horizontal, vertical] = [0, 1].map(|_| [0, 1, 2].map(|_| SHARED_PX * random.normal()));
        for point in &mut points {
            let x = point.point_in_board.x / (4.0 * SQUARE_M) - 1.0;
            let y = point.point_in_board.y / (2.5 * SQUARE_M) - 1.0;
            for (value, [xx, xy, yy]) in point.pixel.iter_mut().zip([horizontal, vertical]) {
                *value += xx * x * x + xy * x * y + yy * y * y + OWN_PX * random.normal();
            }
        }
        BoardView {
            name: format!("image {ix}"),
            points,
        }
    };
    poses.iter().enumerate().map(&mut view).collect()
}

/// Squared errors of focal lengths and principal points, in units of their stated variances.
fn squared_errors(camera: &Intrinsics, views: &[BoardView]) -> [f64; 4] {
    let found = calibrate(camera, views, LensModel::BrownConrady5).unwrap();
    let truth = camera.params();
    std::array::from_fn(|ix| {
        ((found.params[ix].value - truth[ix]) / found.params[ix].sigma).powi(2)
    })
}

/// Mean of squared errors per parameter over many calibrations, each with other board poses. It is
/// 1 if the stated standard deviations are right.
fn chi_squares(n_runs: u64, errors: impl Fn(u64) -> [f64; 4]) -> [f64; 4] {
    let mut sums = [0.0; 4];
    for seed in 0..n_runs {
        for (sum, square) in sums.iter_mut().zip(errors(seed)) {
            *sum += square / n_runs as f64;
        }
    }
    sums
}

#[test]
fn squared_errors_match_stated_variances_with_own_and_with_shared_errors() {
    const N_RUNS: u64 = 100;
    // The mean of 100 squares of normal numbers has a standard deviation of 0.14. Variances of
    // shared errors are estimated from 15 images, which makes the mean larger than 1 by about 0.1.
    // With one factor for all parameters, the means of shared errors are up to 1.9.
    const RANGE: std::ops::Range<f64> = 0.55..1.7;
    let camera = brown_conrady_camera();
    let own = chi_squares(N_RUNS, |seed| {
        let poses = poses(15, 1000 + seed);
        squared_errors(&camera, &observed_images(&camera, &poses, 0.1, seed))
    });
    let shared = chi_squares(N_RUNS, |seed| {
        let poses = poses(15, 1000 + seed);
        squared_errors(&camera, &images_with_shared_errors(&camera, &poses, seed))
    });
    for (kind, chi_squares) in [("own", own), ("shared", shared)] {
        assert!(
            chi_squares.iter().all(|value| RANGE.contains(value)),
            "own {own:.2?}, shared {shared:.2?}: {kind}"
        );
    }
}

#[test]
fn stated_uncertainty_covers_the_truth() {
    // The expected fraction is 95 %. Three binomial standard deviations are 4.6 % for 200 runs and
    // 6.5 % for 100 runs.
    for (camera, model, poses, n_runs) in [
        (
            brown_conrady_camera(),
            LensModel::BrownConrady5,
            poses(10, 4),
            200,
        ),
        (
            fisheye_camera(),
            LensModel::KannalaBrandt,
            wide_poses(10, 4),
            100,
        ),
    ] {
        let truth = camera.params();
        let mut n_covered = vec![0; truth.len()];
        let (mut squares, mut variances) = (0.0, 0.0);
        for seed in 0..n_runs {
            let found = calibrate(
                &camera,
                &observed_images(&camera, &poses, 0.2, 100 + seed),
                model,
            )
            .unwrap();
            for (n_covered, (param, truth)) in
                n_covered.iter_mut().zip(found.params.iter().zip(&truth))
            {
                *n_covered += u32::from((param.value - truth).abs() < 1.96 * param.sigma);
            }
            let displacements = grid::displacements_px(&camera, &found.intrinsics);
            for (displacement, sigma_px) in displacements.iter().zip(&found.uncertainty_px.values) {
                if let (Some(displacement), Some(sigma_px)) = (displacement, sigma_px) {
                    squares += displacement.norm_squared();
                    variances += sigma_px * sigma_px;
                }
            }
        }
        let fracs: Vec<f64> = n_covered
            .iter()
            .map(|n| f64::from(*n) / n_runs as f64)
            .collect();
        assert!(
            fracs.iter().all(|frac| (0.90..=1.0).contains(frac)),
            "{model:?}: {fracs:?}"
        );
        let mean = fracs.iter().sum::<f64>() / fracs.len() as f64;
        assert!((0.92..=0.98).contains(&mean), "{model:?}: {mean} {fracs:?}");
        // The variance in the worst direction is at least half of the sum over both directions.
        let ratio = (squares / variances).sqrt();
        assert!(
            (0.85..=1.5).contains(&ratio),
            "{model:?}: displacements are {ratio} of the projection uncertainty"
        );
    }
}

#[test]
fn simplest_sufficient_model_is_selected() {
    let lens = |lens| Intrinsics {
        lens,
        ..brown_conrady_camera()
    };
    let radial = Lens::BrownConrady([-0.2, 0.0, 0.0, 0.0, 0.0]);
    let tangential = Lens::BrownConrady([-0.2, 0.0, 0.004, -0.003, 0.0]);
    for (camera, poses, allowed) in [
        (lens(Lens::Pinhole), poses(14, 5), &["pinhole"][..]),
        (lens(radial), poses(14, 5), &["brown_conrady k1"]),
        (lens(tangential), poses(14, 5), &["brown_conrady k1 p1 p2"]),
        (
            fisheye_camera(),
            wide_poses(14, 5),
            &["kannala_brandt k1 k2 k3 k4"],
        ),
    ] {
        let found = calibrate(
            &camera,
            &observed_images(&camera, &poses, 0.1, 6),
            LensModel::Auto,
        )
        .unwrap();
        assert!(
            allowed.contains(&&found.model[..]),
            "{:?}: {} after {:#?}",
            camera.lens,
            found.model,
            found.trials
        );
        let (_, rms_px) = displacement_px(&camera, &found.intrinsics);
        let expected_px = uncertainty_px(&found);
        assert!(
            rms_px < 2.0 * expected_px,
            "{:?}: off by {rms_px} px, expected {expected_px} px",
            camera.lens
        );
    }
}

#[test]
fn wrong_images_and_corners_are_rejected_and_named() {
    let camera = brown_conrady_camera();
    let mut views = observed_images(&camera, &poses(12, 7), 0.1, 8);
    // If columns and rows are exchanged, the positions belong to another layout.
    let transposed: Vec<_> = (0..9)
        .flat_map(|row| (0..6).map(move |column| [column, row]))
        .collect();
    views[2].points.truncate(54);
    for (point, [column, row]) in views[2].points.iter_mut().zip(transposed) {
        point.point_in_board = Vector3::new(f64::from(column), f64::from(row), 0.0) * SQUARE_M;
    }
    let mut random = Random::new(3);
    views[5]
        .points
        .iter_mut()
        .for_each(|point| point.pixel = [random.uniform(0.0, 640.0), random.uniform(0.0, 480.0)]);
    views[8].points[10].pixel[0] += 9.0;
    views[8].points[11].pixel[1] -= 4.0;
    views[9].points.truncate(5);
    for model in [LensModel::BrownConrady5, LensModel::Auto] {
        let found = calibrate(&camera, &views, model).unwrap();
        let named: Vec<&str> = found
            .rejected
            .iter()
            .map(|rejected| &rejected.image[..])
            .collect();
        assert_eq!(
            named,
            ["image 9", "image 2", "image 5", "image 8"],
            "{:?}",
            found.rejected
        );
        assert!(matches!(
            found.rejected[0].reason,
            RejectionReason::TooFewPoints { n_points: 5, .. }
        ));
        assert!(matches!(
            found.rejected[1].reason,
            RejectionReason::Inconsistent { .. }
        ));
        assert!(
            matches!(
                found.rejected[3].reason,
                RejectionReason::Corners { n_corners: 2, .. }
            ),
            "{}",
            found.rejected[3]
        );
        let (_, off_px) = displacement_px(&camera, &found.intrinsics);
        assert!(off_px < 0.3, "off by {off_px} px");
    }
}

#[test]
fn partial_and_mirrored_targets_are_used() {
    let camera = brown_conrady_camera();
    let mut views = observed_images(&camera, &poses(14, 9), 0.1, 10);
    for (ix, view) in views.iter_mut().enumerate() {
        match ix % 3 {
            0 => view
                .points
                .retain(|point| point.point_in_board.x < 5.5 * SQUARE_M),
            1 => view
                .points
                .iter_mut()
                .for_each(|point| point.point_in_board.x = 0.3 - point.point_in_board.x),
            _ => view.points.reverse(),
        }
    }
    let found = calibrate(&camera, &views, LensModel::BrownConrady5).unwrap();
    assert!(found.rejected.is_empty(), "{:?}", found.rejected);
    let focal = &found.params[0];
    assert!(
        (focal.value - 536.0).abs() < 3.0 * focal.sigma && focal.sigma < 1.0,
        "{focal:?}"
    );
    let n_points: usize = views.iter().map(|view| view.points.len()).sum();
    assert_eq!(found.coverage.values.iter().sum::<usize>(), n_points);
    assert!((found.noise_px - 0.1).abs() < 0.01, "{}", found.noise_px);
    assert!(
        (found.rms_px - 0.1 * 2.0_f64.sqrt()).abs() < 0.015,
        "{}",
        found.rms_px
    );
}

#[test]
fn many_wrong_corners_are_tolerated() {
    let camera = brown_conrady_camera();
    let mut views = observed_images(&camera, &poses(12, 15), 0.1, 19);
    let mut random = Random::new(120);
    for point in views.iter_mut().flat_map(|view| &mut view.points) {
        if random.unit() < 0.3 {
            point
                .pixel
                .iter_mut()
                .for_each(|value| *value += random.uniform(-30.0, 30.0));
        }
    }
    let found = calibrate(&camera, &views, LensModel::BrownConrady5).unwrap();
    let ((_, off_px), expected_px) = (
        displacement_px(&camera, &found.intrinsics),
        uncertainty_px(&found),
    );
    assert!(
        off_px < 2.0 * expected_px,
        "off by {off_px} px, expected {expected_px} px"
    );
    assert!(
        (found.noise_px - 0.1).abs() < 0.01,
        "noise {} px",
        found.noise_px
    );
}

#[test]
fn few_images_give_a_complete_model() {
    let camera = brown_conrady_camera();
    let found = calibrate(
        &camera,
        &observed_images(&camera, &poses(3, 19), 0.1, 20),
        LensModel::Auto,
    )
    .unwrap();
    assert_eq!(
        (&found.model[..], found.trials.len()),
        ("brown_conrady k1 k2 p1 p2 k3", 0)
    );
    let focal = &found.params[0];
    assert!((focal.value - 536.0).abs() < 4.0 * focal.sigma, "{focal:?}");
}

#[test]
fn images_without_tilt_are_refused_with_the_remedy() {
    let camera = brown_conrady_camera();
    let flat: Vec<Transform> = (0..8)
        .map(|ix| {
            Transform::translation(
                -0.1 + 0.01 * f64::from(ix),
                -0.08,
                0.3 + 0.02 * f64::from(ix),
            )
        })
        .collect();
    for (noise_px, model) in [
        (0.0, LensModel::Pinhole),
        (0.1, LensModel::BrownConrady5),
        (0.1, LensModel::Auto),
    ] {
        let error = calibrate(
            &camera,
            &observed_images(&camera, &flat, noise_px, 1),
            model,
        )
        .unwrap_err();
        assert!(
            error.to_string().contains("tilted by 20 to 45 degrees"),
            "{model:?}: {error}"
        );
    }
    // Many images with the same tilt do not determine the principal point.
    let same_tilt = |ix: u32| {
        Transform::new(
            Vector3::new(-0.12 + 0.005 * f64::from(ix), -0.05, 0.4),
            Vector3::new(0.6, 0.0, 0.0),
        )
    };
    let same: Vec<Transform> = (0..9).map(same_tilt).collect();
    let error = calibrate(
        &camera,
        &observed_images(&camera, &same, 0.1, 2),
        LensModel::Pinhole,
    )
    .unwrap_err();
    assert!(error.to_string().contains("do not determine"), "{error}");
}

#[test]
fn repeated_images_count_once() {
    let camera = brown_conrady_camera();
    let once = poses(8, 3);
    let often: Vec<Transform> = once.iter().chain(&[once[0]; 5]).copied().collect();
    let found = calibrate(
        &camera,
        &observed_images(&camera, &often, 0.1, 20),
        LensModel::BrownConrady5,
    )
    .unwrap();
    let n_repeated = found
        .rejected
        .iter()
        .filter(|rejected| matches!(rejected.reason, RejectionReason::Repeated { .. }))
        .count();
    assert_eq!(
        (found.images.len(), n_repeated),
        (8, 5),
        "{:?}",
        found.rejected
    );
    let error = calibrate(
        &camera,
        &observed_images(&camera, &[once[0]; 6], 0.1, 20),
        LensModel::Auto,
    )
    .unwrap_err();
    assert!(
        matches!(error, Error::TooFewImages { n_images: 1, .. }),
        "{error}"
    );
}

#[test]
fn malformed_input_is_refused_with_the_remedy() {
    let camera = brown_conrady_camera();
    let views = observed_images(&camera, &poses(5, 1), 0.1, 1);
    let refusal = |views: &[BoardView], sizes_px: &[[u32; 2]]| {
        let result = calibrate_intrinsics(&IntrinsicsInput {
            views,
            sizes_px,
            model: LensModel::Auto,
        });
        result.unwrap_err().to_string()
    };
    let sizes_px = [[640, 480]; 5];
    assert!(refusal(&[], &[]).contains("0 images"));
    assert!(refusal(&views[..2], &sizes_px[..2]).contains("expected at least 3"));
    assert!(refusal(&views, &sizes_px[..2]).contains("2 image sizes"));
    let message = refusal(
        &views,
        &[[640, 480], [640, 480], [320, 240], [640, 480], [640, 480]],
    );
    assert!(
        message.contains("image 0 is 640x480, image 2 is 320x240"),
        "{message}"
    );
    assert!(refusal(&views, &[[0, 480]; 5]).contains("size is zero"));
    let change = |change: &dyn Fn(&mut BoardPoint)| {
        let mut views = views.clone();
        views
            .iter_mut()
            .flat_map(|view| &mut view.points)
            .for_each(change);
        refusal(&views, &sizes_px)
    };
    assert!(change(&|point| point.pixel[0] = f64::NAN).contains("not finite"));
    assert!(change(&|point| point.point_in_board *= 1000.0).contains("must be in meters"));
    assert!(change(&|point| point.point_in_board.z = point.point_in_board.x).contains("not flat"));
    assert!(!change(&|point| point.pixel = [3.0, 4.0]).is_empty());
    let mut random = Random::new(1);
    let mut views = views;
    views
        .iter_mut()
        .flat_map(|view| &mut view.points)
        .for_each(|point| {
            point.pixel = [random.uniform(0.0, 640.0), random.uniform(0.0, 480.0)];
        });
    assert!(!refusal(&views, &sizes_px).is_empty());
}

#[test]
fn suggested_images_lower_the_uncertainty_as_predicted() {
    // The prediction is linear, and the noise of the residuals is estimated.
    const REL: f64 = 0.25;
    let camera = brown_conrady_camera();
    let mut poses = poses(6, 11);
    let found = calibrate(
        &camera,
        &observed_images(&camera, &poses, 0.1, 12),
        LensModel::BrownConrady5,
    )
    .unwrap();
    let next = found.next_view.unwrap();
    assert!(next.predicted_sigma_px < 0.9 * next.sigma_px, "{next:?}");
    assert!(next.instruction.contains("m away"), "{}", next.instruction);
    poses.push(next.camera_from_board);
    let views = observed_images(&camera, &poses, 0.1, 13);
    assert_eq!(
        views[6].points.len(),
        board().len(),
        "the suggested image shows the whole target"
    );
    let better = calibrate(&camera, &views, LensModel::BrownConrady5)
        .unwrap()
        .next_view
        .unwrap();
    let ratio = better.sigma_px / next.predicted_sigma_px;
    assert!((ratio - 1.0).abs() < REL, "{ratio}");
    // Another image like the first image helps less.
    poses[6] = poses[0];
    let other = calibrate(
        &camera,
        &observed_images(&camera, &poses, 0.1, 13),
        LensModel::BrownConrady5,
    )
    .unwrap();
    assert!(other.next_view.unwrap().sigma_px > better.sigma_px);
}

#[test]
fn uncertainty_is_larger_where_no_corners_are() {
    let camera = brown_conrady_camera();
    let mut views = observed_images(&camera, &poses(14, 13), 0.1, 14);
    views
        .iter_mut()
        .for_each(|view| view.points.retain(|point| point.pixel[0] < 380.0));
    views.retain(|view| view.points.len() >= 12);
    let found = calibrate(&camera, &views, LensModel::BrownConrady5).unwrap();
    let sigma_px = |column: usize| found.uncertainty_px.values[4 * 16 + column].unwrap();
    assert_eq!(found.coverage.values[4 * 16 + 15], 0);
    assert!(
        sigma_px(15) > 3.0 * sigma_px(5),
        "{} {}",
        sigma_px(15),
        sigma_px(5)
    );
}
