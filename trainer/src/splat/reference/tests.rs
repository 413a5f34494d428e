//! Tests of the gradients of a whole render, and of invariants of rendering.

use super::project::{MIN_ALPHA, project_at, row_share};
use super::rasterize::{MAX_ALPHA, MIN_TRANSMITTANCE, threshold_margins};
use super::scene::{F32Random, rolling_view, small_scene, some_upstream, tilted_view};
use super::*;
use crate::mismatches::Mismatches;

const NUDGE: f64 = 1e-5;
/// Rounding error of the loss (a few tens), divided by the nudge.
const ABS: f64 = 2e-8;
/// Truncation error, which is the nudge squared times third derivatives. These are large for small
/// sharp splats.
const REL: f64 = 1e-6;

/// Compares every gradient of a render with central differences at fixed decisions.
fn check_gradients(view: &View, splats: &[Splat], mismatches: &mut Mismatches) {
    let upstream = some_upstream(7, view);
    let decisions = decide(view, splats);
    let grad = render_backward(view, splats, &upstream);
    let loss =
        |view: &View, splats: &[Splat]| upstream.dot(&render_decided(view, splats, &decisions));

    for (splat_ix, splat) in splats.iter().enumerate() {
        for param in splat.params() {
            let nudged = |nudge| {
                let mut splats = splats.to_vec();
                splats[splat_ix] = splat.nudged(param, nudge);
                loss(view, &splats)
            };
            let numeric = (nudged(NUDGE) - nudged(-NUDGE)) / (2.0 * NUDGE);
            mismatches.check(
                format!("splat {splat_ix} {param:?}"),
                grad.splats[splat_ix].get(param),
                numeric,
                ABS,
                REL,
            );
        }
    }
    for ix in 0..6 {
        let moved = |nudge| {
            loss(
                &view.moved(&std::array::from_fn(|i| if i == ix { nudge } else { 0.0 })),
                splats,
            )
        };
        mismatches.check(
            format!("pose {ix}"),
            grad.view.pose[ix],
            (moved(NUDGE) - moved(-NUDGE)) / (2.0 * NUDGE),
            ABS,
            REL,
        );
    }
    for axis in 0..3 {
        let moved = |nudge: f64| {
            let mut view = view.clone();
            view.linear_m[axis] += nudge;
            loss(&view, splats)
        };
        let rotated = |nudge: f64| {
            let mut view = view.clone();
            view.angular_rad[axis] += nudge;
            loss(&view, splats)
        };
        let by_linear = (moved(NUDGE) - moved(-NUDGE)) / (2.0 * NUDGE);
        let by_angular = (rotated(NUDGE) - rotated(-NUDGE)) / (2.0 * NUDGE);
        mismatches.check(
            format!("linear {axis}"),
            grad.view.linear_m[axis],
            by_linear,
            ABS,
            REL,
        );
        mismatches.check(
            format!("angular {axis}"),
            grad.view.angular_rad[axis],
            by_angular,
            ABS,
            REL,
        );
    }
}

#[test]
fn gradients_match_central_differences() {
    let mut mismatches = Mismatches::default();
    for seed in 1..=3 {
        check_gradients(&tilted_view(), &small_scene(seed, 12), &mut mismatches);
    }
    mismatches.assert_none();
}

#[test]
fn gradients_match_central_differences_with_a_rolling_shutter() {
    let mut mismatches = Mismatches::default();
    for seed in 4..=5 {
        check_gradients(&rolling_view(), &small_scene(seed, 12), &mut mismatches);
    }
    mismatches.assert_none();
}

#[test]
fn gradients_match_central_differences_at_clamps() {
    let view = rolling_view();
    let splats = clamped_scene(&view);
    let mut mismatches = Mismatches::default();
    check_gradients(&view, &splats, &mut mismatches);
    mismatches.assert_none();

    let grad = render_backward(&view, &splats, &some_upstream(7, &view));
    assert!(
        grad.splats[1]
            .sh
            .iter()
            .all(|coeff| coeff[1] == 0.0 && coeff[0] != 0.0),
        "a color below 0 has no gradient"
    );
    let center_of_3 = project(&view, &splats[3]).expect("the splat is visible");
    let clamped = view
        .pixel_centers()
        .zip(decide(&view, &splats).contributors)
        .filter(|(center_px, contributors)| {
            contributors.contains(&3)
                && center_of_3.opacity * (-sigma(&center_of_3, center_px)).exp() > MAX_ALPHA
        });
    assert!(clamped.count() > 0, "no pixel reaches the maximum alpha");
    for outside in [0, 2] {
        assert!(
            grad.splats[outside].mean.iter().all(|v| v.abs() > 1e-6),
            "a splat outside the image has a gradient"
        );
    }
}

/// Splats that exercise all clamps. Splats 0 and 2 are outside the image, where the Jacobian is
/// clamped along x or y. Splat 1 has a channel far below 0. Splat 3 has a clamped alpha at some
/// pixels. Splats 4 and 5 have equal positions.
fn clamped_scene(view: &View) -> Vec<Splat> {
    let world_from_camera = view.camera_from_world.inverse();
    let in_world = |x, y, z| {
        (world_from_camera * nalgebra::Point3::new(x, y, z))
            .coords
            .into()
    };
    let mut splats = small_scene(6, 10);
    let z = 1.6;
    splats[0].mean = in_world(0.95 * z, 0.1 * z, z); // The image ends at x/z = 0.47, the clamp at 0.61.
    splats[0].log_scale = [-0.4, -0.6, -0.5];
    splats[1].sh[0][1] = -3.0;
    splats[2].mean = in_world(-0.02 * z, -0.75 * z, z); // The image ends at y/z = -0.37, the clamp at -0.48.
    splats[2].log_scale = [-0.5, -0.7, -0.6];
    splats[3].opacity_logit = 20.0;
    splats[3].log_scale = [0.0; 3]; // Wide enough to exceed the maximum alpha at a pixel.
    splats[3].mean = in_world(0.02, 0.03, 2.4); // Behind the others.
    splats[5].mean = splats[4].mean;
    splats
}

/// Half the squared distance of a pixel from a projected splat, in standard deviations.
fn sigma(projected: &Projected, center_px: &[f64; 2]) -> f64 {
    let [dx, dy] = [
        center_px[0] - projected.mean_px[0],
        center_px[1] - projected.mean_px[1],
    ];
    0.5 * (projected.conic[0] * dx * dx + projected.conic[2] * dy * dy)
        + projected.conic[1] * dx * dy
}

#[test]
fn wrong_gradient_is_detected() {
    let (view, splats) = (tilted_view(), small_scene(1, 4));
    let upstream = some_upstream(7, &view);
    let grad = render_backward(&view, &splats, &upstream);
    let decisions = decide(&view, &splats);
    let mut mismatches = Mismatches::default();
    let params = splats[0].params();
    for &param in &params {
        let loss = |nudge| {
            let mut splats = splats.clone();
            splats[0] = splats[0].nudged(param, nudge);
            upstream.dot(&render_decided(&view, &splats, &decisions))
        };
        let numeric = (loss(NUDGE) - loss(-NUDGE)) / (2.0 * NUDGE);
        mismatches.check(
            format!("{param:?} off by 0.01 %"),
            grad.splats[0].get(param) * 1.0001,
            numeric,
            ABS,
            REL,
        );
    }
    assert_eq!(mismatches.n_mismatches(), params.len());
}

#[test]
fn each_parameter_has_a_gradient() {
    // The gradients must not be zero. Otherwise, the comparisons with central differences would
    // compare zeros.
    let view = rolling_view();
    let grad = render_backward(&view, &small_scene(4, 12), &some_upstream(7, &view));
    let visible: Vec<_> = grad
        .splats
        .iter()
        .filter(|splat| splat.opacity_logit != 0.0)
        .collect();
    assert!(
        visible.len() >= 8,
        "only {} splats are visible",
        visible.len()
    );
    for splat in visible {
        assert!(
            splat
                .params()
                .iter()
                .all(|&param| splat.get(param).abs() > 1e-9),
            "{splat:?}"
        );
    }
    let twist = grad.view.linear_m.iter().chain(&grad.view.angular_rad);
    assert!(
        grad.view.pose.iter().chain(twist).all(|v| v.abs() > 1e-3),
        "{:?}",
        grad.view
    );
}

#[test]
fn rolling_shutter_leaves_the_middle_row_in_place() {
    let splats = small_scene(2, 8);
    let still = render(&tilted_view(), &splats);
    let moving = render(&rolling_view(), &splats);
    assert_ne!(still.rgb, moving.rgb);
    // At the middle row, the moving camera has the pose of the static camera.
    let view = View {
        angular_rad: [0.0; 3],
        ..rolling_view()
    };
    for splat in &splats {
        assert_eq!(
            project_at(&view, splat, 0.0).mean_px,
            project_at(&tilted_view(), splat, 0.0).mean_px
        );
    }
}

#[test]
fn rolling_shutter_matches_the_exact_pose_of_each_row() {
    // Compares the reference's first-order motion with the exact pose at the splat's own row.
    let view = View {
        linear_m: [2e-3, -1e-3, 3e-3],
        angular_rad: [1e-3, -2e-3, 2e-3],
        ..tilted_view()
    };
    const ABS_PX: f64 = 1e-3; // Second-order errors: (2e-3)^2 times 31 px, and a shift of the row by 0.1 px.
    let mut mismatches = Mismatches::default();
    for (ix, splat) in small_scene(2, 8).iter().enumerate() {
        let share = row_share(&view, splat);
        let motion: [f64; 6] = std::array::from_fn(|i| {
            -share
                * view
                    .linear_m
                    .iter()
                    .chain(&view.angular_rad)
                    .nth(i)
                    .expect("6 numbers")
        });
        let at_row = View {
            linear_m: [0.0; 3],
            angular_rad: [0.0; 3],
            ..view.moved(&motion)
        };
        let (got, expected) = (
            project_at(&view, splat, share),
            project_at(&at_row, splat, 0.0),
        );
        let still = project_at(&tilted_view(), splat, 0.0);
        assert!(
            (got.mean_px[0] - still.mean_px[0]).abs() > 5.0 * ABS_PX * share.abs(),
            "splat {ix} hardly moves"
        );
        for axis in 0..2 {
            mismatches.check(
                format!("splat {ix} axis {axis}"),
                got.mean_px[axis],
                expected.mean_px[axis],
                ABS_PX,
                0.0,
            );
        }
        for (got, expected) in got.conic.into_iter().zip(expected.conic) {
            mismatches.check(format!("splat {ix} conic"), got, expected, 1e-6, 1e-4);
        }
    }
    mismatches.assert_none();
}

#[test]
fn ratios_beyond_the_margin_are_clamped_only_in_covariance() {
    // For a round splat 2 m in front of a camera at the world's origin, the covariance is an
    // analytic function of the ratios.
    let view = View {
        camera_from_world: Transform::identity(),
        ..tilted_view()
    };
    let scale_px: [f64; 2] = [0.1 * 31.0 / 2.0, 0.1 * 28.0 / 2.0];
    let splat = |mean| Splat {
        mean,
        log_scale: [0.1_f64.ln(); 3],
        rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        opacity_logit: 3.0,
        sh: vec![[0.0; 3]],
    };
    // The margin is 0.15 of the image size. The clamps are (28 - 13.3 + 4.2) / 31 on the right and
    // (10.4 + 3) / 28 at the top.
    let (right, up) = (18.9 / 31.0, -13.4 / 28.0);
    let mut mismatches = Mismatches::default();
    for (ratio_x, ratio_y) in [
        (right - 0.01, up + 0.01),
        (right + 0.2, up + 0.01),
        (right - 0.01, up - 0.2),
    ] {
        let projected = project(&view, &splat([2.0 * ratio_x, 2.0 * ratio_y, 2.0]))
            .expect("it is in front of the camera");
        let (clamped_x, clamped_y) = (ratio_x.min(right), ratio_y.max(up));
        let cov_xx = scale_px[0].powi(2) * (1.0 + clamped_x * clamped_x) + 0.3;
        let cov_yy = scale_px[1].powi(2) * (1.0 + clamped_y * clamped_y) + 0.3;
        let cov_xy = scale_px[0] * scale_px[1] * clamped_x * clamped_y;
        let determinant = cov_xx * cov_yy - cov_xy * cov_xy;
        for (got, expected) in projected.conic.into_iter().zip([cov_yy, -cov_xy, cov_xx]) {
            mismatches.check(
                format!("conic at {ratio_x} {ratio_y}"),
                got,
                expected / determinant,
                1e-12,
                1e-12,
            );
        }
        mismatches.check(
            "x",
            projected.mean_px[0],
            31.0 * ratio_x + 13.3,
            1e-12,
            1e-12,
        );
        mismatches.check(
            "y",
            projected.mean_px[1],
            28.0 * ratio_y + 10.4,
            1e-12,
            1e-12,
        );
    }
    mismatches.assert_none();
}

#[test]
fn points_outside_the_image_use_first_or_last_row_time() {
    let view = rolling_view();
    let share_at = |x, y, z| {
        let mean = (view.camera_from_world.inverse() * nalgebra::Point3::new(x, y, z))
            .coords
            .into();
        row_share(
            &view,
            &Splat {
                mean,
                ..Splat::default()
            },
        )
    };
    let y_at_row = |row_px: f64| (row_px - view.principal_px[1]) / view.focal_px[1];
    assert_eq!(share_at(0.2, y_at_row(-3.0), 1.0), -0.5);
    assert!((share_at(0.2, y_at_row(5.0), 1.0) + 0.25).abs() < 1e-12);
    assert_eq!(share_at(0.2, 2.0 * y_at_row(23.0), 2.0), 0.5);
    assert_eq!(share_at(0.2, y_at_row(5.0), -1.0), 0.0);
}

#[test]
fn extent_bounds_drawn_pixels_tightly() {
    let view = rolling_view();
    for splat in small_scene(3, 20) {
        let projected = project(&view, &splat).expect("all are in front of the camera");
        let [a, b, c] = projected.conic;
        // At the point of smallest sigma on each side of the box, alpha equals the drawing
        // threshold.
        let [half_x, half_y] = projected.extent_px;
        for (dx, dy) in [(half_x, -b / c * half_x), (-b / a * half_y, half_y)] {
            let alpha = projected.opacity
                * (-sigma(
                    &projected,
                    &[projected.mean_px[0] + dx, projected.mean_px[1] + dy],
                ))
                .exp();
            assert!((alpha / MIN_ALPHA - 1.0).abs() < 1e-12, "{alpha}");
        }
    }
}

#[test]
fn faint_and_near_splats_are_not_drawn() {
    let view = tilted_view();
    let mut splat = small_scene(1, 1).remove(0);
    let logit = |opacity: f64| (opacity / (1.0 - opacity)).ln();
    splat.opacity_logit = logit(MIN_ALPHA * 0.999);
    assert_eq!(project(&view, &splat), None);
    splat.opacity_logit = logit(MIN_ALPHA * 1.001);
    let depth = project(&view, &splat).expect("just opaque enough").depth;
    assert!(
        project(
            &View {
                near_m: depth * 1.001,
                ..view.clone()
            },
            &splat
        )
        .is_none()
    );
    assert!(
        project(
            &View {
                near_m: depth * 0.999,
                ..view.clone()
            },
            &splat
        )
        .is_some()
    );
    for broken in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        splat.mean[0] = broken;
        assert_eq!(project(&view, &splat), None, "center at {broken}");
    }
}

#[test]
fn saturated_pixels_stop_compositing() {
    let view = tilted_view();
    let mut random = F32Random::new(3);
    // Ten wide, almost opaque splats one behind another, listed back to front.
    let splats: Vec<_> = (0..10)
        .map(|ix| {
            let point_in_camera = nalgebra::Point3::new(0.0, 0.0, 2.0 - 0.1 * f64::from(ix));
            Splat {
                mean: (view.camera_from_world.inverse() * point_in_camera)
                    .coords
                    .into(),
                log_scale: [0.5; 3],
                rotation_wxyz: random.array(-1.0, 1.0),
                opacity_logit: 2.0,
                sh: vec![random.array(0.0, 1.0)],
            }
        })
        .collect();
    let decisions = decide(&view, &splats);
    let image = render(&view, &splats);
    let center = 10 * 28 + 13; // The principal point's pixel.
    assert_eq!(decisions.contributors[center], [9, 8, 7, 6]);
    assert_eq!(image.last_contributor[center], Some(6));
    assert!(
        image
            .transmittance
            .iter()
            .all(|&left| left > MIN_TRANSMITTANCE)
    );
    let left = (1.0 - 0.880_797_f64).powi(4); // sigmoid(2)
    assert!(
        (image.transmittance[center] / left - 1.0).abs() < 0.05,
        "{}",
        image.transmittance[center]
    );
}

#[test]
fn equal_depths_are_drawn_in_index_order() {
    let view = tilted_view();
    let mut splats = small_scene(4, 2);
    splats[1].mean = splats[0].mean;
    let center = decide(&view, &splats)
        .contributors
        .into_iter()
        .max_by_key(Vec::len)
        .expect("the image has pixels");
    assert_eq!(center, [0, 1]);

    let empty = render(&view, &[]);
    assert_eq!(empty.rgb, vec![[0.0; 3]; view.n_pixels()]);
    assert_eq!(empty.transmittance, vec![1.0; view.n_pixels()]);
    assert_eq!(empty.last_contributor, vec![None; view.n_pixels()]);
}

#[test]
fn margins_identify_ambiguous_pixels() {
    let (view, splats) = (tilted_view(), small_scene(1, 12));
    let margins = threshold_margins(&view, &splats);
    let before = decide(&view, &splats);
    // Adding 0.1 to every logit changes alphas by up to a tenth. Only the contributors of pixels
    // with a smaller margin may change.
    let brighter: Vec<_> = splats
        .iter()
        .map(|splat| splat.nudged(scene::SplatParam::OpacityLogit, 0.1))
        .collect();
    let after = decide(&view, &brighter);
    let changed: Vec<_> = (0..view.n_pixels())
        .filter(|&ix| before.contributors[ix] != after.contributors[ix])
        .collect();
    assert!(!changed.is_empty(), "the nudge changes no decision");
    assert!(
        changed.iter().all(|&ix| margins[ix] < 0.11),
        "{:?}",
        changed.iter().map(|&ix| margins[ix]).collect::<Vec<_>>()
    );
    let n_safe_in_f32 = margins.iter().filter(|&&margin| margin > 1e-4).count();
    assert!(
        n_safe_in_f32 > view.n_pixels() * 9 / 10,
        "{n_safe_in_f32} of {} pixels",
        view.n_pixels()
    );

    // The order of two splats at almost the same depth is ambiguous wherever both are drawn.
    let mut pair = splats[..2].to_vec();
    pair[1].mean = pair[0].mean.map(|along| along + 1e-6);
    let margins = threshold_margins(&view, &pair);
    let both = decide(&view, &pair)
        .contributors
        .into_iter()
        .enumerate()
        .filter(|(_, added)| added.len() == 2);
    assert!(both.clone().count() > 0 && both.into_iter().all(|(ix, _)| margins[ix] < 1e-5));
}
