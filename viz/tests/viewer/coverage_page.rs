//! Opens the bundled page in a real browser while photographs of a target are taken: what they cover
//! is drawn over the live image, and listed.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use kinematics::Stamp;
use std::time::Instant;
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use viz::{
    CoverageItem, Guidance, Hub, ImagePartCoverage, LiveImage, LivePixels, PhotographCoverage,
    Server, ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [1100, 760];
const IMAGE_PX: [u32; 2] = [64, 48];
/// Maximum difference between a cell on the screen and its place in the image, CSS pixels.
const MAX_OFFSET_PX: f64 = 2.0;

fn set_image(hub: &Hub, camera: &str) {
    let n = IMAGE_PX[0] as usize * IMAGE_PX[1] as usize;
    hub.set_live_image(LiveImage {
        camera: camera.into(),
        stamp: Stamp(1),
        captured_at: Instant::now(),
        size_px: IMAGE_PX,
        pixels: LivePixels::Rgb(vec![150; 3 * n].into()),
        world_from_camera: None,
        focal_px: [64.0; 2],
        principal_px: [32.0, 24.0],
    });
}

fn guided(coverage: Option<PhotographCoverage>) -> Status {
    Status {
        state: "calibrating".to_owned(),
        guidance: Some(Guidance {
            text: "4 photographs; next: move the target to the right edge".to_owned(),
            is_finished: false,
            coverage,
        }),
        ..Status::default()
    }
}

/// The last cell is covered, and so are the first four parts. The sixth part is next.
fn coverage() -> PhotographCoverage {
    let item = |label: &str, n_done| CoverageItem {
        label: label.to_owned(),
        n_done,
        n_needed: 2,
        is_next: false,
    };
    PhotographCoverage {
        camera: "front".to_owned(),
        size_px: IMAGE_PX,
        cells: [16, 9],
        is_covered: (0..144).map(|ix| ix == 0 || ix == 143).collect(),
        parts: (0..9)
            .map(|ix| ImagePartCoverage {
                is_covered: ix < 4,
                is_next: ix == 5,
            })
            .collect(),
        items: vec![item("left side away", 2), item("near", 0)],
    }
}

fn count(browser: &mut Browser, selector: &str) -> u64 {
    browser
        .evaluate(&format!("document.querySelectorAll('{selector}').length"))
        .as_u64()
        .unwrap_or_default()
}

/// Distance between the lower right corners of the last cell and of the image on the screen, CSS
/// pixels. The image is centered in its canvas element, as large as it fits.
fn corner_offset_px(browser: &mut Browser) -> Option<f64> {
    let script = "(() => {
        const canvas = document.querySelector('#live figure[data-camera=\"front\"] canvas');
        const cells = document.querySelectorAll('.coverage-overlay .cell');
        if (!canvas || cells.length !== 2) return null;
        const box = canvas.getBoundingClientRect();
        const scale = Math.min(box.width / canvas.width, box.height / canvas.height);
        const right = box.left + box.width / 2 + scale * canvas.width / 2;
        const bottom = box.top + box.height / 2 + scale * canvas.height / 2;
        const cell = cells[1].getBoundingClientRect();
        return Math.hypot(cell.right - right, cell.bottom - bottom);
    })()";
    browser.evaluate(script).as_f64()
}

#[test]
fn coverage_is_drawn_over_the_live_image_and_listed() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_status(guided(Some(coverage())));
    let listen = ([127, 0, 0, 1], 0).into();
    let server = Server::start(ServerConfig { listen }, hub.clone()).expect("a free port");
    let mut browser = Browser::open_with(&program, &server.url(), WINDOW_PX, NO_DRAWING);

    // The list needs no image.
    wait_for(&mut browser, "the list", |browser| {
        let text = browser.text("photograph-coverage");
        ["left side away 2/2", "near 0/2", "parts of the image 4/9"]
            .iter()
            .all(|words| text.contains(words))
    });
    assert_eq!(
        count(&mut browser, "#photograph-coverage [data-state=next]"),
        1
    );
    set_image(&hub, "front");
    set_image(&hub, "side");
    wait_for(&mut browser, "the image", |browser| {
        count(
            browser,
            "#live figure[data-camera=front] canvas[width=\"64\"]",
        ) == 1
    });
    // A status is sent several times per second; the next one finds the image.
    wait_for(&mut browser, "the overlay on the image", |browser| {
        hub.set_status(guided(Some(coverage())));
        corner_offset_px(browser).is_some_and(|offset_px| offset_px < MAX_OFFSET_PX)
    });
    for (selector, expected) in [
        (".coverage-overlay", 1),
        ("figure[data-camera=side] .coverage-overlay", 0),
        (".coverage-overlay .cell", 2),
        (".coverage-overlay .part", 5),
        (".coverage-overlay .part.next", 1),
    ] {
        assert_eq!(count(&mut browser, selector), expected, "{selector}");
    }
    // It stays in place in a window of another shape.
    browser.resize([620, 900]);
    wait_for(&mut browser, "the overlay in another window", |browser| {
        corner_offset_px(browser).is_some_and(|offset_px| offset_px < MAX_OFFSET_PX)
    });

    // Another calibration has no coverage.
    hub.set_status(guided(None));
    wait_for(&mut browser, "no coverage", |browser| {
        count(browser, ".coverage-overlay") == 0
            && browser.evaluate("document.getElementById('photograph-coverage')?.hidden") == true
    });
    drop(browser);
}
