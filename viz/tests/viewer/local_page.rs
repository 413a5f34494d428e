//! Opens the bundled page in a real browser, lets it draw models itself, and compares them with the
//! server's pictures.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::client::TIMEOUT;
use crate::local_server::serve;
use crate::models;
use crate::models::{ModelThread, splat_model, tsdf_model, wall};
use crate::page::Camera;
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use std::path::PathBuf;
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use trainer::eval::{PixelPair, psnr};
use trainer::{Method, Projection, RenderRequest};
use viz::{
    Hub, LiveImage, LivePixels, ModelStatus, ObservationMap, ObservedCell, SceneHint, Server,
    ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [720, 480];
/// Required PSNR of the page's own drawing against the server's picture, dB.
const MIN_DB: f64 = 30.0;
/// Part of the view that nothing else covers: distance from its top and bottom edges, pixels.
const MARGIN_PX: usize = 90;
/// PSNR of the middle rows of a screenshot.
fn shot_psnr(request: &RenderRequest, shot: &image::RgbImage, rgba: &[u8]) -> f64 {
    let [width, height] = request.size_px;
    assert_eq!([shot.width(), shot.height()], request.size_px);
    let rows = MARGIN_PX..height as usize - MARGIN_PX;
    let pixels = rows.start * width as usize..rows.end * width as usize;
    let shown: Vec<u8> = shot
        .pixels()
        .flat_map(|pixel| [pixel.0[0], pixel.0[1], pixel.0[2], 255])
        .collect();
    let middle = |all: &[u8]| all[4 * pixels.start..4 * pixels.end].to_vec();
    let mut expected = middle(rgba);
    expected
        .chunks_exact_mut(4)
        .for_each(|pixel| pixel[3] = 255);
    let size_px = [width, u32::try_from(rows.len()).expect("small")];
    psnr(&PixelPair::new(size_px, &middle(&shown), &expected).expect("sizes")).expect("a score")
}

fn has_all_parts(browser: &mut Browser) -> bool {
    let text = browser.text("picture-text");
    text.contains("drawn here") && !text.contains(" of ")
}

/// Waits until the page shows the model as the server does.
fn check_local(
    browser: &mut Browser,
    thread: &ModelThread,
    model: &mut dyn Method,
    (name, min_db): (&str, f64),
) {
    wait_for(browser, "all parts of the model", has_all_parts);
    let began = Instant::now();
    loop {
        let request = thread.last_request();
        let picture = model.render(&request).expect("drawn");
        let shot = canvas_shot(browser);
        // The last picture may have been a smaller one.
        let is_full = [shot.width(), shot.height()] == request.size_px;
        let db = if is_full {
            shot_psnr(&request, &shot, &picture.rgba_srgb)
        } else {
            0.0
        };
        if db >= min_db || began.elapsed() > TIMEOUT {
            let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
            shot.save(scratch.join(format!("page-local-{name}.png")))
                .expect("written");
            let [width, height] = request.size_px;
            let expected =
                image::RgbaImage::from_raw(width, height, picture.rgba_srgb).expect("the size");
            let expected = image::DynamicImage::from(expected).to_rgb8();
            expected
                .save(scratch.join(format!("page-server-{name}.png")))
                .expect("written");
            eprintln!("{name}: {db:.1} dB");
            assert!(db >= min_db, "{name}: {db} dB");
            return;
        }
        std::thread::sleep(Duration::from_millis(300));
    }
}

/// Loses and restores the WebGL context of the page, as mobile browsers do with background pages.
/// In between, the page receives the model again.
fn lose_context(browser: &mut Browser) {
    const GET: &str = "window.context ??= document.getElementById('canvas').getContext('webgl2').getExtension(\
                       'WEBGL_lose_context')";
    browser.evaluate(&format!("({GET}).loseContext()"));
    wait_for(browser, "the loss", |browser| {
        browser
            .text("banner")
            .starts_with("The WebGL context of this page was lost")
    });
    browser.click("toggle-local");
    browser.click("toggle-local");
    wait_for(browser, "all parts of the model", has_all_parts);
    browser.evaluate("context.restoreContext()");
    wait_for(browser, "the return", |browser| {
        browser.text("banner").is_empty()
    });
}

/// Checks that the model is tinted by its observations, no matter where it is drawn. The left half
/// was just observed, the right half long ago.
fn check_tint(browser: &mut Browser, hub: &Hub, name: &str) {
    browser.click("toggle-age");
    wait_for(browser, "a subscription", |_| hub.needs_observations());
    let cell = |ix, age_secs| ObservedCell {
        ix,
        age_secs,
        sigma_m: 0.001,
    };
    hub.set_observations(&ObservationMap {
        min_m: [-10.0; 3],
        cell_m: 10.0,
        n_cells: [2; 3],
        observed: (0..8)
            .map(|ix| cell(ix, if ix % 2 == 0 { 0.0 } else { 1e6 }))
            .collect(),
        n_keyframes: 2,
        newest_at: None,
    });
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    for is_local in [true, false] {
        if !is_local {
            browser.click("toggle-local");
            wait_for(browser, "a full picture", |browser| {
                browser.text("picture-text").contains("100 %")
            });
        }
        let began = Instant::now();
        loop {
            let shot = canvas_shot(browser);
            // Yellow on the left, purple on the right.
            let [left, right] = [1, 4].map(|part| mean_color(&shot, part * shot.width() / 6));
            let is_tinted =
                left[0] > left[2] + 40.0 && left[1] > left[2] + 40.0 && right[2] > right[1] + 20.0;
            if is_tinted {
                break;
            }
            if began.elapsed() > TIMEOUT {
                shot.save(scratch.join(format!("page-tint-{name}.png")))
                    .expect("written");
                panic!(
                    "{name}, drawn locally: {is_local}: {left:?} on the left, {right:?} on the right"
                );
            }
        }
    }
    browser.click("toggle-local");
    browser.click("toggle-age");
    wait_for(browser, "no subscription", |_| !hub.needs_observations());
}

/// Mean color of a sixth of the middle rows, from column `begin` on.
fn mean_color(shot: &image::RgbImage, begin: u32) -> [f64; 3] {
    let columns = begin..begin + shot.width() / 6;
    let rows = 2 * shot.height() / 5..3 * shot.height() / 5;
    let pixels: Vec<_> = rows
        .flat_map(|y| columns.clone().map(move |x| shot.get_pixel(x, y).0))
        .collect();
    #[expect(clippy::cast_precision_loss, reason = "a small number")]
    let n = pixels.len() as f64;
    [0, 1, 2].map(|channel| {
        pixels
            .iter()
            .map(|pixel| f64::from(pixel[channel]))
            .sum::<f64>()
            / n
    })
}

#[test]
fn local_drawing_equals_the_pictures_of_the_server() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    let nerf = ModelStatus {
        method: "nerf".to_owned(),
        ..ModelStatus::default()
    };
    models::publish_wall(&hub, vec![nerf]);
    // More than the page reserves memory for at first.
    let splats = wall(80_000);
    let models: models::Models = vec![
        ("splat", Box::new(splat_model(&splats))),
        ("tsdf", Box::new(tsdf_model(18))),
    ];
    let (mut reference_splats, mut reference_tsdf) = (splat_model(&splats), tsdf_model(18));
    let thread = ModelThread::start(hub.clone(), models);
    let server = serve(&hub);
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    browser.click("toggle-grid");
    browser.click("toggle-local");
    check_local(
        &mut browser,
        &thread,
        &mut reference_splats,
        ("splat", MIN_DB),
    );
    lose_context(&mut browser);
    check_local(
        &mut browser,
        &thread,
        &mut reference_splats,
        ("splat-after-loss", MIN_DB),
    );

    // The view moves without pictures from the server, which is asked only for depth when the view
    // rests.
    let (before, n_color_requests) = (thread.last_request(), thread.n_color_requests());
    let [x, y] = [300, 240];
    browser.mouse("mousePressed", [x, y]);
    for step in 1..=4 {
        browser.mouse("mouseMoved", [x + 10 * step, y]);
        browser.next_frame();
    }
    browser.mouse("mouseReleased", [x + 40, y]);
    wait_for(&mut browser, "the depth of the new view", |_| {
        thread.last_request().world_from_camera != before.world_from_camera
    });
    check_local(
        &mut browser,
        &thread,
        &mut reference_splats,
        ("splat-moved", MIN_DB),
    );
    assert_eq!(thread.n_color_requests(), n_color_requests);
    check_tint(&mut browser, &hub, "splat");

    browser.evaluate("document.querySelector('[data-method=tsdf]').click()");
    wait_for(&mut browser, "the other model", |_| {
        hub.model_chunks().period("tsdf").is_some()
    });
    assert!(
        hub.model_chunks().period("splat").is_none() && !hub.model_chunks().contains("splat"),
        "its memory is free"
    );
    check_local(&mut browser, &thread, &mut reference_tsdf, ("tsdf", MIN_DB));
    lose_context(&mut browser);
    check_local(
        &mut browser,
        &thread,
        &mut reference_tsdf,
        ("tsdf-after-loss", MIN_DB),
    );
    check_tint(&mut browser, &hub, "tsdf");
    browser.click("toggle-crop");
    wait_for(&mut browser, "the crop", |_| {
        thread.last_request().crop.is_some()
    });
    // The edges and handles of the box are drawn, too.
    check_local(
        &mut browser,
        &thread,
        &mut reference_tsdf,
        ("tsdf-cropped", 20.0),
    );
    browser.click("toggle-crop");

    // Models that the page cannot draw come from the server.
    browser.evaluate("document.querySelector('[data-method=nerf]').click()");
    wait_for(&mut browser, "no local model", |browser| {
        browser.evaluate("document.getElementById('toggle-local').hidden") == true
    });
    drop(browser);
    drop(thread.finish());
}

/// Number of pixels in the color of live cameras, which the model does not have.
fn n_accent_pixels(browser: &mut Browser, name: &str) -> usize {
    let shot = canvas_shot(browser);
    shot.save(PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("page-behind-{name}.png")))
        .expect("written");
    let is_accent = |[red, green, blue]: [u8; 3]| {
        green >= red.saturating_add(60) && blue >= red.saturating_add(40)
    };
    // Between the toolbar and the texts at the bottom.
    let rows = 60..shot.height() / 2;
    shot.enumerate_pixels()
        .filter(|(_, y, pixel)| rows.contains(y) && is_accent(pixel.0))
        .count()
}

/// A camera whose frustum is parallel to the wall, at this position along y.
fn live_image(y: f64) -> LiveImage {
    LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(1),
        captured_at: Instant::now(),
        size_px: [32, 32],
        pixels: LivePixels::Rgba(vec![90; 32 * 32 * 4].into()),
        world_from_camera: Some(Transform::translation(-0.3, y, 0.2)),
        focal_px: [32.0; 2],
        principal_px: [16.0; 2],
    }
}

/// The depth of local splats hides objects behind them, without any depth from the server.
#[test]
fn local_splats_hide_what_lies_behind_them() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    // Away from the wall, so that the first picture does not show it.
    let rotation = UnitQuaternion::face_towards(&-Vector3::y(), &-Vector3::z());
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.1],
        radius_m: 1.0,
        world_from_camera: Transform::from_parts(Point3::new(0.0, -1.0, 0.3).into(), rotation),
    });
    let status = ModelStatus {
        method: "splat".to_owned(),
        has_chunks: true,
        ..ModelStatus::default()
    };
    hub.set_status(Status {
        model: status,
        ..Status::default()
    });
    let mut splats = wall(20_000);
    splats.opacity_logits.fill(3.0);
    splats.sh.fill([0.0; 3]); // Gray.
    let models: models::Models = vec![("splat", Box::new(splat_model(&splats)))];
    let thread = ModelThread::start(hub.clone(), models);
    let server = serve(&hub);
    let mut browser = Browser::open(&program, &server.url(), [800, 500]);
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    thread.refuse_depth();
    browser.click("toggle-local");
    wait_for(&mut browser, "all parts of the model", has_all_parts);
    browser.click("look-front");
    for (y, name) in [(0.4, "hidden"), (-0.4, "in-front")] {
        // The frustum of a camera that sends nothing fades.
        let camera = Camera::sending(hub.clone(), move || live_image(y));
        wait_for(&mut browser, "the live camera", |browser| {
            browser.evaluate("document.querySelectorAll('#live canvas').length") == 1
        });
        // On a busy computer, images are late, and the frustum is drawn faintly for a while.
        let wait_for_pixels = |browser: &mut Browser, name: &str, n_min: usize| {
            let mut n = 0;
            wait_for(browser, name, |browser| {
                n = n_accent_pixels(browser, name);
                n > n_min
            });
            n
        };
        browser.click("toggle-occlude");
        let n_all = wait_for_pixels(&mut browser, &format!("{name}-without-occlusion"), 60);
        browser.click("toggle-occlude");
        let n_shown = if y > 0.0 {
            n_accent_pixels(&mut browser, name)
        } else {
            wait_for_pixels(&mut browser, name, n_all * 9 / 10)
        };
        camera.stop();
        eprintln!("{name}: {n_shown} of {n_all} pixels");
        let is_right = if y > 0.0 {
            n_shown * 20 < n_all
        } else {
            n_shown * 10 > n_all * 9
        };
        assert!(is_right, "{name}: {n_shown} of {n_all} pixels");
    }
    drop(browser);
    drop(thread.finish());
}

/// Green channel of the screenshot at a point in the world; `None` until a full picture was
/// requested.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixels of a window"
)]
fn green_at(browser: &mut Browser, request: &RenderRequest, point: &Point3<f64>) -> Option<u8> {
    let shot = canvas_shot(browser);
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        return None;
    };
    if [shot.width(), shot.height()] != request.size_px {
        return None;
    }
    let in_camera = request.world_from_camera.inverse_transform_point(point);
    let [x, y] = [0, 1].map(|axis| {
        (focal_px[axis] * in_camera[axis] / in_camera.z + principal_px[axis]).floor() as u32
    });
    shot.get_pixel_checked(x, y).map(|pixel| pixel.0[1])
}

/// The page cuts a splat where it leaves the crop box, although its center is in the box.
#[test]
fn local_splats_are_cut_at_the_sides_of_the_crop_box() {
    const MIN_SPLAT: u8 = 80;
    const MAX_BACKGROUND: u8 = 40;
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    let rotation = UnitQuaternion::face_towards(&Vector3::y(), &-Vector3::z());
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.1],
        radius_m: 1.0,
        world_from_camera: Transform::from_parts(Point3::new(0.0, -3.0, 0.1).into(), rotation),
    });
    hub.set_status(Status {
        model: ModelStatus {
            method: "splat".to_owned(),
            has_chunks: true,
            ..ModelStatus::default()
        },
        ..Status::default()
    });
    // One splat whose standard deviation along x is 1 m. The crop box ends at 0.6 m.
    let mut splats = wall(20_000).filtered(|ix| ix == 0);
    splats.means.fill([0.0, 0.0, 0.1]);
    splats.rotations_wxyz.fill([1.0, 0.0, 0.0, 0.0]);
    splats.log_scales.fill([0.0, -4.0, -1.0]);
    splats.opacity_logits.fill(4.0);
    splats.sh.fill([0.0; 3]);
    splats.sh[0] = [1.5; 3]; // Nearly white.
    let models: models::Models = vec![("splat", Box::new(splat_model(&splats)))];
    let thread = ModelThread::start(hub.clone(), models);
    let server = Server::start(
        ServerConfig {
            listen: ([127, 0, 0, 1], 0).into(),
        },
        hub,
    )
    .expect("a free port");
    let mut browser = Browser::open(&program, &server.url(), [1280, 760]);
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    browser.click("toggle-grid");
    browser.click("toggle-local");
    wait_for(&mut browser, "all parts of the model", has_all_parts);

    let inside = Point3::new(0.25, 0.0, 0.3);
    let outside = Point3::new(0.9, 0.0, 0.3);
    let wait_for_green = |browser: &mut Browser, what: &str, is_right: &dyn Fn([u8; 2]) -> bool| {
        wait_for(browser, what, |browser| {
            let request = thread.last_request();
            let greens = [inside, outside].map(|point| green_at(browser, &request, &point));
            matches!(greens, [Some(inside), Some(outside)] if is_right([inside, outside]))
        });
    };
    wait_for_green(&mut browser, "the whole splat", &|greens| {
        greens.iter().all(|green| *green > MIN_SPLAT)
    });
    browser.click("toggle-crop");
    wait_for_green(&mut browser, "the splat in the box", &|greens| {
        greens[0] > MIN_SPLAT && greens[1] < MAX_BACKGROUND
    });
    assert!(has_all_parts(&mut browser), "drawn by the page");

    drop(browser);
    drop(thread.finish());
}
