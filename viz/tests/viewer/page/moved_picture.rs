//! Until the next picture arrives, the page draws the last one as a surface, which moves like the
//! scene.

use super::{
    BACKGROUND, RenderThread, drag, pixel, pixel_of, reset_view, shot_without_bottom, uncovered,
};
use analytic_scene::{draw, ray_in_world};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::Duration;
use test_support::browser::{Browser, wait_for};
use trainer::{Projection, RenderRequest};

type Color = [u8; 3];

/// Holds back pictures. Dropping it, also in a panic, unblocks the thread that draws them.
struct Paused<'a>(&'a RenderThread);

impl<'a> Paused<'a> {
    fn new(thread: &'a RenderThread) -> Self {
        thread.is_paused.store(true, Ordering::Relaxed);
        Self(thread)
    }
}

impl Drop for Paused<'_> {
    fn drop(&mut self) {
        self.0.is_paused.store(false, Ordering::Relaxed);
    }
}

/// Checks that a moved view shows everything that the last picture shows, and that little is
/// stretched over depth discontinuities.
pub(super) fn check(browser: &mut Browser, render_thread: &RenderThread, picture: &RenderRequest) {
    /// Allows for JPEG compression and for shading within a pixel.
    const MAX_COLOR_DIFFERENCE: u8 = 40;
    browser.click("toggle-grid");
    let paused = Paused::new(render_thread);
    drag(browser);
    std::thread::sleep(Duration::from_millis(800)); // The view no longer moves.
    let shot = shot_without_bottom(browser);
    shot.save(PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("page-moved-picture.png"))
        .expect("written");
    drop(paused);
    wait_for(browser, "a full picture", |_| {
        render_thread
            .requests()
            .last()
            .is_some_and(|request| request.size_px == picture.size_px)
    });
    let view = render_thread.requests().last().expect("drawn").clone();
    let expected = moved_picture(picture, &view);
    let width = i64::from(view.size_px[0]);
    // The expected colors within 2 pixels.
    let near = |x: i64, y: i64| -> Vec<Option<Color>> {
        let row = |y: i64| usize::try_from(y * width + x - 2).expect("inside");
        (y - 2..=y + 2)
            .flat_map(|y| expected[row(y)..][..5].iter().copied())
            .collect()
    };
    let (mut n_seen, mut n_missing, mut n_stretched) = (0, 0, 0);
    let [columns, mut rows] = uncovered(view.size_px);
    rows.end = i64::from(view.size_px[1]) - 4; // Nothing covers the lower part.
    for y in rows {
        for x in columns.clone() {
            let (shown, near) = (pixel(&shot, x, y), near(x, y));
            let is_equal = |expected: Color| {
                shown
                    .iter()
                    .zip(expected)
                    .all(|(a, b)| a.abs_diff(b) < MAX_COLOR_DIFFERENCE)
            };
            // A late picture loses most of its colors.
            let is_like = |expected: Color| is_equal(expected) || is_equal(faded(expected));
            let is_seen = near.iter().all(Option::is_some);
            n_seen += i32::from(is_seen);
            n_missing += i32::from(is_seen && shown == BACKGROUND);
            n_stretched +=
                i32::from(shown != BACKGROUND && !near.into_iter().flatten().any(is_like));
        }
    }
    eprintln!(
        "moved picture: of {n_seen} pixels, {n_missing} are missing; {n_stretched} are stretched"
    );
    assert!(
        n_seen > 10_000 && n_missing * 50 < n_seen,
        "{n_missing} of {n_seen} pixels are missing"
    );
    assert!(
        n_stretched * 5 < n_seen,
        "{n_stretched} pixels are stretched, {n_seen} are seen"
    );
    browser.click("toggle-grid");
    reset_view(browser, render_thread, picture);
}

/// The color in a late picture: see `FADED_SATURATION` of the page.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a mean of bytes"
)]
fn faded(color: Color) -> Color {
    const SATURATION: f64 = 0.15;
    let [red, green, blue] = color.map(f64::from);
    let gray = 0.299 * red + 0.587 * green + 0.114 * blue;
    color.map(|channel| (gray + SATURATION * (f64::from(channel) - gray)) as u8)
}

/// Projects what a picture shows into a view; `None` where there is nothing.
fn moved_picture(picture: &RenderRequest, view: &RenderRequest) -> Vec<Option<Color>> {
    /// Samples per pixel and axis, so that a closer view has no gaps.
    const N_SAMPLES: u32 = 3;
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = picture.projection
    else {
        panic!("a pinhole projection")
    };
    let fine = |px: [f64; 2]| px.map(|px| px * f64::from(N_SAMPLES));
    let projection = Projection::Pinhole {
        focal_px: fine(focal_px),
        principal_px: fine(principal_px),
    };
    let samples = RenderRequest {
        size_px: picture.size_px.map(|n| n * N_SAMPLES),
        projection,
        ..picture.clone()
    };
    let drawn = draw(&samples);
    let [width, height] = view.size_px.map(i64::from);
    let mut nearest =
        vec![(f64::INFINITY, None); usize::try_from(width * height).expect("positive")];
    for (ix, depth) in drawn
        .depth_m
        .iter()
        .enumerate()
        .filter(|(_, depth)| **depth > 0.0)
    {
        let n_columns = samples.size_px[0] as usize;
        let (eye, ray) = ray_in_world(
            &samples,
            (ix % n_columns) as f64 + 0.5,
            (ix / n_columns) as f64 + 0.5,
        );
        let point = eye + ray * f64::from(*depth);
        let (x, y) = pixel_of(view, point);
        if !(0..width).contains(&x) || !(0..height).contains(&y) {
            continue;
        }
        let z = view.world_from_camera.inverse_transform_point(&point).z;
        let slot = &mut nearest[usize::try_from(y * width + x).expect("inside")];
        if z < slot.0 {
            *slot = (z, drawn.rgba_srgb[4 * ix..].first_chunk().copied());
        }
    }
    nearest.into_iter().map(|(_, color)| color).collect()
}
