//! Opens the page in a real browser as an operator who edits the model: the box with its handles and
//! numbers, keys and results of edits, and measurements.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use nalgebra::{Point3, Translation3};
use parking_lot::Mutex;
use serde_json::json;
use std::path::PathBuf;
use std::sync::Arc;
use test_support::browser::{Browser, browser_for_page, canvas_bounds, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{
    Control, EditAction, EditRequest, Hub, LastEdit, ModelStatus, SavedEdits, SceneHint, Server,
    ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Center of the scene, and of the box before it is changed, meters.
const CENTER_M: [f64; 3] = [0.0, 0.0, 0.2];
/// Half a side of that box, meters: 0.6 times the radius of the scene.
const HALF_M: f64 = 0.6;
/// Tolerance of positions after a drag, which ends at a whole pixel, meters.
const DRAG_M: f64 = 0.02;

/// The page, its server, and the last request of the main view at full size.
struct Page {
    browser: Browser,
    hub: Hub,
    last: Arc<Mutex<Option<RenderRequest>>>,
}

impl Page {
    /// Waits until the page requests a picture of this kind.
    fn request(
        &mut self,
        what: &str,
        is_expected: impl Fn(&RenderRequest) -> bool,
    ) -> RenderRequest {
        let mut found = None;
        let last = Arc::clone(&self.last);
        wait_for(&mut self.browser, what, |_| {
            found = last.lock().clone().filter(&is_expected);
            found.is_some()
        });
        found.expect("the condition holds")
    }

    /// Waits until the page shows the view that it requested last. The first pictures have other
    /// sizes, because panels appear.
    fn shown_view(&mut self) -> RenderRequest {
        let last = Arc::clone(&self.last);
        let mut shown = None;
        wait_for(&mut self.browser, "the full picture", |browser| {
            let [.., width, height] = canvas_bounds(browser);
            let text = browser.text("picture-text");
            let is_shown = text.starts_with(&format!("{width} × {height} (100 %)"));
            shown = last
                .lock()
                .clone()
                .filter(|request| is_shown && request.size_px == [width, height]);
            shown.is_some()
        });
        shown.expect("the condition holds")
    }

    fn is_hidden(&mut self, id: &str) -> bool {
        self.browser
            .evaluate(&format!("document.getElementById('{id}')?.hidden ?? true"))
            == json!(true)
    }

    fn wait_for_text(&mut self, id: &str, text: &str) {
        wait_for(&mut self.browser, text, |browser| browser.text(id) == text);
    }

    /// Presses a key; `modifiers` are fields of a `KeyboardEvent`.
    fn press(&mut self, key: &str, modifiers: &str) {
        self.browser.evaluate(&format!(
            "window.dispatchEvent(new KeyboardEvent('keydown', \
             {{ key: '{key}', cancelable: true, {modifiers} }}))"
        ));
    }

    fn field(&mut self, id: &str) -> f64 {
        let value = self
            .browser
            .evaluate(&format!("document.getElementById('{id}').valueAsNumber"));
        value.as_f64().unwrap_or(f64::NAN)
    }

    fn wait_for_field(&mut self, id: &str, expected: f64, tolerance: f64) {
        let number = format!("document.getElementById('{id}').valueAsNumber");
        wait_for(
            &mut self.browser,
            &format!("{id} of {expected}"),
            |browser| {
                let value = browser.evaluate(&number).as_f64();
                value.is_some_and(|value| (value - expected).abs() <= tolerance)
            },
        );
    }

    /// Types a number.
    fn set_field(&mut self, id: &str, value: f64) {
        self.browser.evaluate(&format!(
            "(() => {{ const field = document.getElementById('{id}'); field.value = '{value}'; \
             field.dispatchEvent(new Event('change')); }})()"
        ));
    }

    /// Presses the mouse at a point of the canvas, moves it by `by` in steps, and releases it.
    fn drag(&mut self, [x, y]: [f64; 2], by: [i32; 2]) {
        let from = self.in_window([x, y]);
        self.browser.mouse("mouseMoved", from);
        self.browser.mouse("mousePressed", from);
        for step in 1..=5 {
            let at = [from[0] + by[0] * step / 5, from[1] + by[1] * step / 5];
            self.browser.mouse("mouseMoved", at);
        }
        self.browser
            .mouse("mouseReleased", [from[0] + by[0], from[1] + by[1]]);
    }

    fn click_on(&mut self, request: &RenderRequest, point: Point3<f64>) {
        let at = self.in_window(pixel_of(request, point));
        self.browser.mouse("mouseMoved", at);
        self.browser.mouse("mousePressed", at);
        self.browser.mouse("mouseReleased", at);
    }

    /// Moves the pointer without pressing it, and waits until the page shows whether there is a
    /// surface.
    fn hover(&mut self, request: &RenderRequest, point: Point3<f64>, has_surface: bool) {
        let [x, y] = self.in_window(pixel_of(request, point));
        self.browser.evaluate(&format!(
            "void document.getElementById('canvas')?.dispatchEvent(new PointerEvent('pointermove', \
             {{ clientX: {x}, clientY: {y}, pointerType: 'mouse', bubbles: true }}))"
        ));
        wait_for(&mut self.browser, "the point at the pointer", |browser| {
            browser.evaluate("document.getElementById('canvas')?.dataset.surface ?? ''")
                == json!(has_surface.to_string())
        });
    }

    /// A point of the canvas in pixels of the window.
    fn in_window(&mut self, [x, y]: [f64; 2]) -> [i32; 2] {
        let [left, top, ..] = canvas_bounds(&mut self.browser);
        #[expect(clippy::cast_possible_truncation, reason = "pixels of a window")]
        let at = [x as i32, y as i32];
        [at[0] + left.cast_signed(), at[1] + top.cast_signed()]
    }
}

fn pinhole(request: &RenderRequest) -> ([f64; 2], [f64; 2]) {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        panic!("the page requests a pinhole projection")
    };
    (focal_px, principal_px)
}

fn pixel_of(request: &RenderRequest, point: Point3<f64>) -> [f64; 2] {
    let (focal_px, principal_px) = pinhole(request);
    let in_camera = request.world_from_camera.inverse_transform_point(&point);
    [0, 1].map(|axis| focal_px[axis] * in_camera[axis] / in_camera.z + principal_px[axis])
}

fn depth_of(request: &RenderRequest, point: Point3<f64>) -> f64 {
    request.world_from_camera.inverse_transform_point(&point).z
}

#[test]
fn operators_crop_edit_and_measure() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_scene_hint(SceneHint {
        center_m: CENTER_M,
        radius_m: 1.0,
        world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
    });
    hub.set_status(Status {
        state: "viewing".to_owned(),
        model: ModelStatus {
            method: "splat".to_owned(),
            primitives: 1000,
            primitives_label: "Splats".to_owned(),
            ..ModelStatus::default()
        },
        ..Status::default()
    });
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub.clone()).expect("a free port");
    let last: Arc<Mutex<Option<RenderRequest>>> = Arc::default();
    let seen = Arc::clone(&last);
    let thread = RequestThread::start(hub.clone(), move |pending| {
        let is_main_view = matches!(pending.request.projection, Projection::Pinhole { .. });
        if is_main_view && pending.request.size_px[0] > WINDOW_PX[0] / 2 {
            *seen.lock() = Some(pending.request.clone());
        }
        let picture = draw(&pending.request);
        pending.deliver(picture);
    });
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let mut page = Page {
        browser: Browser::open(&program, &server.url(), WINDOW_PX),
        hub,
        last,
    };
    let view = page.shown_view();
    check_measurements(&mut page, &view);
    check_numbers_of_box(&mut page);
    check_handles(&mut page);
    std::fs::write(scratch.join("edits-box.png"), page.browser.screenshot()).expect("written");
    check_edits(&mut page);
    std::fs::write(scratch.join("edits-panel.png"), page.browser.screenshot()).expect("written");
    check_saving(&mut page);
    page.press("Escape", "");
    assert!(
        page.is_hidden("edit") && page.is_hidden("box-panel"),
        "Escape closes the panel, so that Delete erases nothing"
    );

    drop(page);
    drop(thread);
}

/// Several distances are shown, without covering their points, until they are removed. They are
/// hidden while the tool is off.
fn check_measurements(page: &mut Page, view: &RenderRequest) {
    const N_LABELS: &str = "document.querySelectorAll('.distance').length";
    let points = [
        [-0.45, 0.2],
        [0.25, 0.1],
        [-0.6, 0.6],
        [-0.4, 0.6],
        [-0.3, 0.8],
    ]
    .map(|[x, y]| Point3::new(x, y, 0.0));
    let n_labels = |page: &mut Page, n: u64| {
        wait_for(&mut page.browser, "the labels", |browser| {
            browser.evaluate(N_LABELS).as_u64() == Some(n)
        });
    };
    assert!(page.is_hidden("measure-hint"));
    page.browser.click("toggle-measure");
    assert!(!page.is_hidden("measure-hint"));
    assert!(page.browser.text("measure-hint").contains("two points"));
    let cursor = "getComputedStyle(document.getElementById('canvas')).cursor";
    assert_eq!(page.browser.evaluate(cursor), json!("crosshair"));
    page.hover(view, points[0], true);
    page.hover(view, Point3::new(0.0, 50.0, 12.0), false);

    page.click_on(view, points[0]);
    page.click_on(view, points[1]);
    n_labels(page, 1);
    // Esc cancels the one that has begun.
    page.click_on(view, points[4]);
    wait_for(&mut page.browser, "the next instruction", |browser| {
        browser.text("measure-hint").contains("second point")
    });
    page.press("Escape", "");
    assert!(page.browser.text("measure-hint").contains("next distance"));
    page.click_on(view, points[2]);
    page.click_on(view, points[3]);
    n_labels(page, 2);
    page.browser.next_frame();
    for point in &points[..4] {
        let [x, y] = page.in_window(pixel_of(view, *point));
        let covering = page.browser.evaluate(&format!(
            "[...document.querySelectorAll('.distance')].filter((label) => {{ \
             const box = label.getBoundingClientRect(); return box.left <= {x} && {x} <= box.right \
             && box.top <= {y} && {y} <= box.bottom; }}).length"
        ));
        assert_eq!(covering, json!(0), "a label covers {point}");
    }
    page.press("Escape", "");
    assert!(page.is_hidden("measure-hint") && page.is_hidden("distances"));
    page.browser.click("toggle-measure");
    assert!(!page.is_hidden("distances"));
    n_labels(page, 2);
    page.press("Delete", "");
    n_labels(page, 1);
    page.browser
        .evaluate("document.querySelector('.distance button').click()");
    n_labels(page, 0);
    page.browser.click("toggle-measure");
    assert!(page.is_hidden("measure-hint"));
}

/// The box has the numbers that are typed, and can be rotated and reset.
fn check_numbers_of_box(page: &mut Page) {
    assert!(page.is_hidden("box-panel"));
    page.browser.click("toggle-crop");
    page.request("a cropped picture", |request| request.crop.is_some());
    assert!(!page.is_hidden("box-panel"));
    let ids = ["box-center-x", "box-center-y", "box-center-z", "box-size-x"];
    let numbers = ids.map(|id| page.field(id));
    assert_eq!(
        numbers,
        [CENTER_M[0], CENTER_M[1], CENTER_M[2], 2.0 * HALF_M]
    );
    page.set_field("box-size-x", 0.4);
    page.set_field("box-yaw", 90.0);
    let rotated = page.request("a rotated box", |request| {
        // The short side lies along y of the world.
        request.crop.is_some_and(|crop| {
            crop.contains([0.59, 0.0, 0.2])
                && crop.contains([0.0, 0.19, 0.2])
                && !crop.contains([0.0, 0.21, 0.2])
                && !crop.contains([0.61, 0.0, 0.2])
        })
    });
    assert!(rotated.crop.is_some());
    page.browser.click("box-reset");
    page.request("the first box", |request| {
        request.crop.is_some_and(|crop| {
            crop.contains([0.59, 0.59, 0.79]) && !crop.contains([0.0, 0.61, 0.2])
        })
    });
    assert_eq!(page.field("box-yaw"), 0.0);
}

/// Handles move and rotate the box, also those whose places on the box are out of view.
fn check_handles(page: &mut Page) {
    const BY_PX: i32 = 60;
    let view = page.request("a cropped picture", |request| request.crop.is_some());
    let (focal_px, _) = pinhole(&view);
    let center = Point3::from(CENTER_M);
    page.drag(pixel_of(&view, center), [BY_PX, 0]);
    let moved_m = f64::from(BY_PX) * depth_of(&view, center) / focal_px[0];
    page.wait_for_field("box-center-x", moved_m, DRAG_M);
    page.browser.click("box-reset");
    page.wait_for_field("box-center-x", 0.0, 0.0);

    let edge = Point3::new(HALF_M, HALF_M, CENTER_M[2]);
    page.drag(pixel_of(&view, edge), [BY_PX, 0]);
    // From the viewer's place at negative y, a drag to the right rotates clockwise.
    let dragged_m = f64::from(BY_PX) * depth_of(&view, edge) / focal_px[0];
    let expected_deg = (HALF_M.atan2(HALF_M + dragged_m) - HALF_M.atan2(HALF_M)).to_degrees();
    page.wait_for_field("box-yaw", expected_deg, 1.0);

    // In a box that contains the viewer, all sides are out of view. The handle of the left side is
    // at the left edge.
    page.browser.click("box-reset");
    for id in ["box-size-x", "box-size-y", "box-size-z"] {
        page.set_field(id, 40.0);
    }
    page.request("a large box", |request| {
        request
            .crop
            .is_some_and(|crop| crop.contains([19.0, 19.0, 19.0]))
    });
    page.browser.next_frame();
    let left_side = Point3::new(-20.0, 0.0, CENTER_M[2]);
    let [_, y] = pixel_of(&view, left_side);
    page.drag([18.0, y], [BY_PX, 0]);
    wait_for(&mut page.browser, "a smaller box", |browser| {
        let size = browser.evaluate("document.getElementById('box-size-x').valueAsNumber");
        size.as_f64().is_some_and(|size_m| size_m < 39.9)
    });
    page.browser.click("box-reset");
    page.browser.click("toggle-crop");
    page.request("the whole scene", |request| request.crop.is_none());
    assert!(page.is_hidden("box-panel"));
}

/// The edits that the page sends.
fn edits(page: &mut Page) -> Vec<EditRequest> {
    let mut edits = Vec::new();
    let hub = page.hub.clone();
    wait_for(&mut page.browser, "an edit", |_| {
        edits = hub.operator_requests().take_edits();
        !edits.is_empty()
    });
    edits
}

/// Publishes an edit, as the run does.
fn publish_edit(page: &Page, client: u64, text: &str, [n_edits, n_undone]: [usize; 2]) {
    page.hub.change_status(|status| {
        status.model.edits = n_edits;
        status.model.undone_edits = n_undone;
        status.edit_revision += 1;
        status.last_edit = Some(LastEdit {
            client,
            text: text.to_owned(),
        });
    });
}

/// Delete erases the box, Ctrl+Z undoes, and the page says who has edited.
fn check_edits(page: &mut Page) {
    wait_for(&mut page.browser, "the button", |browser| {
        browser.evaluate("document.getElementById('toggle-edit').hidden") == json!(false)
    });
    page.press("Delete", "");
    page.browser.click("toggle-edit");
    assert!(!page.is_hidden("box-panel"));
    // The keys of the fly mode do not edit.
    for key in ["w", "a"] {
        page.press(key, "");
    }
    page.press("Delete", "");
    let erased = edits(page);
    assert!(
        matches!(erased[..], [ref edit] if matches!(edit.action(), EditAction::Erase(_))),
        "{erased:?}"
    );
    publish_edit(page, erased[0].client(), "erased a box", [1, 0]);
    page.wait_for_text("undo-edit", "Undo (1)");
    assert_eq!(page.browser.text("edit-note"), "Erased a box");
    assert!(page.is_hidden("toast"), "the operator knows");
    assert_eq!(page.browser.text("primitives-label"), "Splats before edits");

    publish_edit(page, 99, "erased a box", [2, 0]);
    page.wait_for_text("toast", "client 99 erased a box");
    assert!(!page.is_hidden("toast"));

    page.press("z", "ctrlKey: true");
    assert_eq!(*edits(page)[0].action(), EditAction::Undo);
    publish_edit(page, erased[0].client(), "undid the last edit", [1, 1]);
    page.wait_for_text("redo-edit", "Redo (1)");
    page.press("Z", "ctrlKey: true, shiftKey: true");
    assert_eq!(*edits(page)[0].action(), EditAction::Redo);
    publish_edit(page, 99, "undid the last edit", [0, 2]);
    page.wait_for_text("toast", "client 99 undid the last edit");
    page.press("z", "ctrlKey: true");
    assert_eq!(
        page.hub.operator_requests().take_edits(),
        [],
        "there is nothing to undo"
    );
    page.wait_for_text("primitives-label", "Splats");
}

/// Where edits were saved, and why they were not, is shown beside both buttons.
fn check_saving(page: &mut Page) {
    const HAS_FAILED: &str = "document.getElementById('edit-note').classList.contains('failed')";
    wait_for(&mut page.browser, "the button", |browser| {
        browser.evaluate("document.getElementById('save-edits').hidden") == json!(false)
    });
    page.browser.click("save-edits");
    let hub = page.hub.clone();
    wait_for(&mut page.browser, "a request", |_| {
        hub.operator_requests().take_controls() == [Control::Save]
    });
    for (revision, text, shown, has_failed) in [
        (
            1,
            "cannot save the edits: the disk is full",
            "Cannot save the edits: the disk is full",
            true,
        ),
        (
            2,
            "edited model saved as scan-edited.ply",
            "Edited model saved as scan-edited.ply",
            false,
        ),
    ] {
        page.hub.change_status(|status| {
            status.saved_edits = Some(SavedEdits {
                revision,
                text: text.to_owned(),
                has_failed,
            });
        });
        page.wait_for_text("edit-note", shown);
        assert_eq!(page.browser.text("save-note"), shown);
        assert!(!page.is_hidden("save-note"));
        assert_eq!(page.browser.evaluate(HAS_FAILED), json!(has_failed));
    }
}
