//! Opens the bundled page in a real browser at the end of a run, while the server is frozen and after
//! it has stopped, and with a saved model and a file.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::downloads::served;
use crate::proxy::{Link, Proxy};
use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use nalgebra::{Translation3, Vector3};
use serde_json::{Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use trainer::{ChunkData, ChunkLayout, ModelChunk, ModelChunks, Projection, RenderRequest};
use viz::{
    Grade, Hub, ModelSource, ModelStatus, ObservationMap, ObservedCell, RunResult, SceneHint,
    Server, ServerConfig, SourceKind, Status, Verdict, publish_files,
};

const DESKTOP_PX: [u32; 2] = [1100, 700];
const PHONE_PX: [u32; 2] = [390, 844];
/// Fast and without losses: only its interruption matters.
const LINK: Link = Link {
    bytes_per_sec: 1e8,
    delay: Duration::from_millis(1),
    slow_period: usize::MAX,
    slow_delay: Duration::ZERO,
};
const VERDICT: &str = "Fair: 26.6 dB on 12 test images; 87 % of the images were lost";
const FOLDER: &str = "runs/20261124-071645";
/// Maximum mean difference of two shots of the same view, of 255 levels.
const MAX_SAME: f64 = 2.0;

/// A hub whose requests for pictures are answered and recorded, and its server.
struct Served {
    hub: Hub,
    server: Server,
    requests: Arc<Mutex<Vec<RenderRequest>>>,
    _renderer: RequestThread,
}

impl Served {
    fn start(status: Status) -> Self {
        let hub = Hub::new();
        hub.set_scene_hint(SceneHint {
            center_m: [0.0, 0.0, 0.2],
            radius_m: 0.8,
            world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
        });
        hub.set_status(status);
        let config = ServerConfig {
            listen: ([127, 0, 0, 1], 0).into(),
        };
        let server = Server::start(config, hub.clone()).expect("a free port");
        let requests: Arc<Mutex<Vec<RenderRequest>>> = Arc::default();
        let received = Arc::clone(&requests);
        let renderer = RequestThread::start(hub.clone(), move |pending| {
            // Panoramas are requested for the surroundings of the view.
            if pending.request.projection != Projection::Equirectangular {
                let mut received = received.lock().expect("no panic");
                received.push(pending.request.clone());
            }
            let picture = draw(&pending.request);
            pending.deliver(picture);
        });
        Self {
            hub,
            server,
            requests,
            _renderer: renderer,
        }
    }

    fn last_request(&self) -> Option<RenderRequest> {
        self.requests.lock().expect("no panic").last().cloned()
    }
}

fn save_screenshot(browser: &mut Browser, name: &str) {
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    std::fs::write(
        scratch.join(format!("page-{name}.png")),
        browser.screenshot(),
    )
    .expect("written");
}

/// Waits until an expression is true.
fn wait_until(browser: &mut Browser, what: &str, expression: &str) {
    wait_for(browser, what, |browser| {
        browser.evaluate(&format!("Boolean({expression})")) == json!(true)
    });
}

/// Status code, file name and length of what the link with this text leads to.
fn download(browser: &mut Browser, label: &str) -> Value {
    let expression = format!(
        "(async () => {{
            const links = [...document.querySelectorAll('.files a')];
            const link = links.find((link) => link.textContent === '{label}');
            const response = await fetch(link.href);
            const name = response.headers.get('content-disposition');
            return [response.status, name, (await response.text()).length, link.target];
        }})()"
    );
    let result = browser.call(
        "Runtime.evaluate",
        json!({"expression": expression, "awaitPromise": true, "returnByValue": true}),
    );
    result["result"]["value"].clone()
}

/// Every value on the page that is followed by dB, rounded to tenths.
fn shown_db(browser: &mut Browser) -> Vec<f64> {
    let expression = "[...document.body.innerText.matchAll(/([0-9]+[.][0-9]+)\\s*dB/g)]
        .map((match) => Math.round(10 * Number(match[1])) / 10)";
    serde_json::from_value(browser.evaluate(expression)).expect("numbers")
}

/// Mean difference of a part of two shots of the view that shows the model, and that nothing covers.
fn difference(a: &image::RgbImage, b: &image::RgbImage) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let columns = 2 * a.width() / 5..3 * a.width() / 5;
    let rows = 3 * a.height() / 5..4 * a.height() / 5; // Above are the background and buttons.
    let (mut sum, mut n) = (0.0, 0.0);
    for (x, y) in rows.flat_map(|y| columns.clone().map(move |x| (x, y))) {
        for (a, b) in a.get_pixel(x, y).0.iter().zip(b.get_pixel(x, y).0) {
            sum += f64::from(a.abs_diff(b));
            n += 1.0;
        }
    }
    sum / n
}

/// Color of [`square`], which nothing else in the scene has.
const SQUARE_RGB: [u8; 3] = [200, 60, 160];

/// The view once its picture is complete and does not change any more.
fn settled_shot(browser: &mut Browser) -> image::RgbImage {
    let mut last = canvas_shot(browser);
    wait_for(browser, "a view that does not change", |browser| {
        std::thread::sleep(Duration::from_millis(500));
        let shot = canvas_shot(browser);
        let is_same = shot.dimensions() == last.dimensions() && difference(&shot, &last) < 0.1;
        last = shot;
        is_same && browser.text("picture-text").contains("100 %")
    });
    last
}

/// A square of 2 m in the plane y = 0.5 that faces -y, for pages that draw the model themselves; see
/// `model_chunk` in the protocol.
fn square() -> ModelChunk {
    let counts: [[u16; 3]; 4] = [[0, 0, 0], [20, 0, 0], [20, 0, 20], [0, 0, 20]];
    let indices: [u16; 6] = [0, 1, 2, 0, 2, 3];
    let mut bytes = Vec::new();
    let mut previous = [0; 3];
    for position in counts {
        for axis in 0..3 {
            bytes.extend(position[axis].wrapping_sub(previous[axis]).to_le_bytes());
        }
        previous = position;
    }
    bytes.extend(SQUARE_RGB);
    bytes.extend([0; 9]); // The other vertices have the same color.
    let mut previous = 0;
    for ix in indices {
        bytes.extend(ix.wrapping_sub(previous).to_le_bytes());
        previous = ix;
    }
    let mut zlib = ZlibEncoder::new(Vec::new(), Compression::fast());
    zlib.write_all(&bytes).expect("memory");
    let layout = ChunkLayout::Mesh {
        origin_m: [-1.0, 0.5, -1.0],
        meters_per_count: 0.1,
        n_vertices: 4,
        n_triangles: 2,
    };
    ModelChunk {
        id: 1,
        change: 1.0,
        coarse: None,
        fine: ChunkData {
            layout,
            bytes: zlib.finish().expect("memory"),
        },
    }
}

/// Whether the middle of the view has the color of [`square`].
fn shows_square(browser: &mut Browser) -> bool {
    let shot = canvas_shot(browser);
    let middle = shot.get_pixel(shot.width() / 2, shot.height() / 2).0;
    (0..3).all(|ix| middle[ix].abs_diff(SQUARE_RGB[ix]) < 25)
}

/// Waits for a full picture.
fn wait_for_full_picture(browser: &mut Browser) {
    wait_for(browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
}

fn training() -> Status {
    Status {
        state: "training".to_owned(),
        seconds: 61.0,
        keyframes: 400,
        model: ModelStatus {
            method: "tsdf".to_owned(),
            step: 400,
            primitives_label: "Voxel blocks".to_owned(),
            has_chunks: true,
            psnr: Some(25.6),
            psnr_history: vec![(30.0, 24.0), (60.0, 25.6)],
            ..ModelStatus::default()
        },
        ..Status::default()
    }
}

/// Publishes what a run publishes at its end.
fn finish(hub: &Hub, folder: &Path) {
    let write = |name: &str, content: &str| {
        let path = folder.join(name);
        std::fs::write(&path, content).expect("written");
        path
    };
    let glb = write("mesh.glb", &"x".repeat(300_000));
    let report = write("report.html", "<!doctype html><p>scores");
    publish_files(
        hub,
        vec![
            served("tsdf.glb", Some("20261124-071645.glb"), glb),
            served("tsdf-report.html", None, report),
        ],
    );
    hub.change_status(|status| status.model.psnr = Some(26.6));
    hub.set_run_result(RunResult {
        folder: Some(FOLDER.to_owned()),
        scores: "PSNR 26.60 dB".to_owned(),
        seconds: 61.2,
        verdict: Some(Verdict {
            grade: Grade::Fair,
            text: VERDICT.to_owned(),
        }),
        problems: vec!["18343 images dropped by the devices".to_owned()],
    });
}

#[test]
fn end_of_a_run_is_a_state_of_the_page() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let served = Served::start(training());
    let proxy = Proxy::start(served.server.address(), LINK);
    let url = format!("http://{}/", proxy.address());
    let mut browser = Browser::open(&program, &url, DESKTOP_PX);
    wait_for_full_picture(&mut browser);
    wait_until(
        &mut browser,
        "no result yet",
        "document.getElementById('run-end')?.hidden",
    );
    finish(&served.hub, folder.path());
    check_result(&mut browser);
    check_view_goes_on(&mut browser, &served);
    check_closing(&mut browser);
    check_phone(&mut browser);
    check_frozen_server(&mut browser, &proxy);
    check_local_drawing_after_the_end(&mut browser, served);
    drop(browser);
}

/// The panel has the verdict, the folder, the problems and working links; the page shows one PSNR.
fn check_result(browser: &mut Browser) {
    wait_for(browser, "the verdict", |browser| {
        browser.text("run-verdict") == VERDICT
    });
    save_screenshot(browser, "result");
    let text = browser.text("run-end");
    assert!(
        text.contains(FOLDER) && text.contains("18343 images dropped"),
        "{text}"
    );
    assert_eq!(browser.text("banner"), "", "the result has a panel");
    wait_until(
        browser,
        "the open panel",
        "document.querySelector('#run-end details')?.open",
    );
    wait_for(browser, "the final score", |browser| {
        let shown = shown_db(browser);
        !shown.is_empty() && shown.iter().all(|db| (db - 26.6).abs() < 1e-9)
    });
    assert_eq!(
        download(browser, "File tsdf.glb"),
        json!([
            200,
            "attachment; filename=\"20261124-071645.glb\"",
            300_000,
            ""
        ])
    );
    assert_eq!(
        download(browser, "File tsdf-report.html"),
        json!([200, null, 24, "_blank"])
    );
}

/// Pictures of other views are requested and shown as before.
fn check_view_goes_on(browser: &mut Browser, served: &Served) {
    for button in ["look-top", "reset-view"] {
        let before = served.last_request().expect("a picture was requested");
        browser.click(button);
        wait_for(browser, button, |_| {
            served
                .last_request()
                .is_some_and(|request| request.world_from_camera != before.world_from_camera)
        });
        wait_for_full_picture(browser);
    }
}

/// The panel can be closed, and opened again from the header.
fn check_closing(browser: &mut Browser) {
    let is_shown = "document.getElementById('run-end')?.hidden === false";
    browser.click("close-result");
    wait_until(browser, "the closed panel", &format!("!({is_shown})"));
    assert_eq!(
        browser.evaluate("document.getElementById('show-result').getAttribute('aria-expanded')"),
        "false"
    );
    browser.click("show-result");
    wait_until(browser, "the open panel", is_shown);
}

/// On a phone, the panel is one line at first.
fn check_phone(browser: &mut Browser) {
    browser.resize(PHONE_PX);
    browser.call("Page.reload", json!({}));
    wait_for(browser, "the verdict", |browser| {
        browser.text("run-verdict") == VERDICT
    });
    wait_until(
        browser,
        "a compact panel",
        "document.querySelector('#run-end details')?.open === false \
         && document.getElementById('run-end').getBoundingClientRect().height < 70",
    );
    save_screenshot(browser, "result-phone");
    browser.resize(DESKTOP_PX);
    wait_for_full_picture(browser);
}

/// The page distinguishes a server that does not answer from one that has stopped, also after the run.
fn check_frozen_server(browser: &mut Browser, proxy: &Proxy) {
    proxy.cut();
    wait_for(browser, "the silence", |browser| {
        browser
            .text("banner")
            .starts_with("No data from the server")
    });
    wait_for(browser, "attempts to reconnect", |browser| {
        let banner = browser.text("banner");
        banner
            .to_lowercase()
            .contains("connection lost, reconnecting")
    });
    assert!(
        !browser.text("connection").contains("has stopped"),
        "{}",
        browser.text("connection")
    );
    assert_eq!(
        browser.evaluate("document.getElementById('view')?.classList.contains('stale')"),
        true,
        "the view is not live"
    );
    proxy.restore();
    wait_for(browser, "the return", |browser| {
        browser.text("connection").contains("connected") && browser.text("banner").is_empty()
    });
}

/// When the program ends, the page says so, disables what needs it, and draws the parts of the model
/// that it has.
fn check_local_drawing_after_the_end(browser: &mut Browser, served: Served) {
    wait_until(
        browser,
        "local drawing",
        "document.getElementById('toggle-local')?.hidden === false",
    );
    // The panel could cover the middle of the view.
    browser.click("close-result");
    browser.click("toggle-grid");
    browser.click("toggle-local");
    wait_for(browser, "a subscription", |_| {
        served.hub.model_chunks().period("tsdf").is_some()
    });
    let chunks = ModelChunks {
        is_complete: true,
        chunks: vec![square()],
        removed: Vec::new(),
    };
    served.hub.model_chunks().set("tsdf", chunks);
    wait_for(browser, "the part of the model", shows_square);

    drop(served);
    wait_for(browser, "the end", |browser| {
        browser
            .text("connection")
            .contains("the server has stopped")
    });
    wait_for(browser, "the sentence", |browser| {
        browser
            .text("run-end-state")
            .starts_with("The program has ended")
    });
    assert_eq!(browser.text("banner"), "");
    let is_off = |id: &str| {
        format!(
            "document.getElementById('{id}').disabled \
             && document.getElementById('{id}').title.includes('program has ended')"
        )
    };
    for id in ["toggle-edit", "pause", "save", "toggle-local"] {
        wait_until(browser, id, &is_off(id));
    }
    wait_until(
        browser,
        "links without addresses",
        "[...document.querySelectorAll('#run-end .files a')].length === 2 \
         && [...document.querySelectorAll('#run-end .files a')].every((link) => !link.href)",
    );
    wait_until(
        browser,
        "where the files are",
        &format!(
            "[...document.querySelectorAll('#run-end .files a')].every(({{ title }}) => title.includes('{FOLDER}'))"
        ),
    );
    wait_until(
        browser,
        "nothing that only a server knows",
        "document.getElementById('clients')?.hidden",
    );
    assert_eq!(
        browser.evaluate("document.getElementById('view')?.classList.contains('stale')"),
        false
    );
    // Longer than the first attempts to reconnect, which must not drop the model.
    std::thread::sleep(Duration::from_secs(3));
    assert!(shows_square(browser), "the model stays");
    browser.click("look-top");
    wait_for(browser, "another view", |browser| !shows_square(browser));
    browser.click("reset-view");
    wait_for(browser, "the first view", shows_square);
    save_screenshot(browser, "ended");
    check_end_on_phone(browser);
}

/// On a phone, where the panel is one line, a banner says that the program has ended. The button of the
/// result stays within reach.
fn check_end_on_phone(browser: &mut Browser) {
    browser.resize(PHONE_PX);
    wait_for(browser, "the sentence on a phone", |browser| {
        browser.text("banner").starts_with("The program has ended")
    });
    wait_until(
        browser,
        "the banner below the header",
        "document.getElementById('banner')?.getBoundingClientRect().top \
         >= document.getElementById('show-result')?.getBoundingClientRect().bottom - 0.5",
    );
    save_screenshot(browser, "ended-phone");
}

fn source(kind: SourceKind) -> ModelSource {
    let is_file = kind == SourceKind::File;
    let name = if is_file {
        "guitar.compressed.ply"
    } else {
        "kitchen"
    };
    ModelSource {
        kind,
        name: name.to_owned(),
        path: format!("scans/{name}"),
        format: is_file.then(|| "PLY".to_owned()),
        bytes: 11_534_336,
        modified_unix_secs: Some(1_795_253_400),
        data: (!is_file).then(|| "scan.mcap".to_owned()),
        adapter: None,
        verdict: (!is_file).then(|| Verdict {
            grade: Grade::Good,
            text: "Good: 31.2 dB on 12 test images".to_owned(),
        }),
        up_axis: "z",
    }
}

/// The status of `view`.
fn viewing(kind: SourceKind) -> Status {
    let is_file = kind == SourceKind::File;
    Status {
        state: "viewing".to_owned(),
        seconds: if is_file { 0.0 } else { 61.2 },
        keyframes: if is_file { 0 } else { 400 },
        model: ModelStatus {
            method: "splat".to_owned(),
            step: if is_file { 0 } else { 1520 },
            primitives: 84_512,
            primitives_label: "Splats".to_owned(),
            psnr: (!is_file).then_some(31.24),
            ..ModelStatus::default()
        },
        source: Some(source(kind)),
        ..Status::default()
    }
}

/// Publishes what `view` publishes.
fn publish_view(hub: &Hub, kind: SourceKind, file: &Path) {
    hub.set_status(viewing(kind));
    publish_files(
        hub,
        vec![served("splat.spz", Some("guitar.spz"), file.to_owned())],
    );
}

#[test]
fn saved_models_and_files_have_a_panel_of_their_own() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let served = Served::start(viewing(SourceKind::File));
    let path = folder.path().join("guitar.spz");
    std::fs::write(&path, "spz").expect("written");
    publish_view(&served.hub, SourceKind::File, &path);
    let mut browser = Browser::open(&program, &served.server.url(), DESKTOP_PX);
    wait_for_full_picture(&mut browser);
    check_file(&mut browser);
    check_up_axis(&mut browser, &served);
    check_saved(&mut browser, &served.hub, &path);
    check_incomplete_map(&mut browser, &served.hub);
    check_end_of_view(&mut browser, served);
    drop(browser);
}

/// Whether the element with this id is shown, also if its panel is closed or missing.
fn is_shown(id: &str) -> String {
    format!("(document.getElementById('{id}')?.offsetParent ?? null) !== null")
}

/// A file has its facts and downloads, and no values of a training.
fn check_file(browser: &mut Browser) {
    wait_for(browser, "the facts", |browser| {
        let text = browser.text("source-card");
        ["guitar.compressed.ply", "PLY", "84,512", "11.5 MB"]
            .iter()
            .all(|fact| text.contains(fact))
    });
    for id in ["psnr", "seconds", "keyframes"] {
        wait_until(browser, id, &format!("!({})", is_shown(id)));
    }
    assert_eq!(
        download(browser, "File splat.spz"),
        json!([200, "attachment; filename=\"guitar.spz\"", 3, ""])
    );
    assert_eq!(browser.text("run-verdict"), "", "no run has ended");
    save_screenshot(browser, "file");
}

/// Another axis can be turned up, and the page names the flag.
fn check_up_axis(browser: &mut Browser, served: &Served) {
    for (axis, up) in [
        ("-y", -Vector3::y()),
        ("x", Vector3::x()),
        ("z", Vector3::z()),
    ] {
        browser.evaluate(&format!(
            "(() => {{ const choice = document.getElementById('up-axis'); choice.value = '{axis}'; \
             choice.dispatchEvent(new Event('change')); }})()"
        ));
        wait_for(browser, axis, |_| {
            served.last_request().is_some_and(|request| {
                let axis = |vector: Vector3<f64>| request.world_from_camera.rotation * vector;
                // Level, upright, and from above.
                axis(Vector3::x()).dot(&up).abs() < 1e-6
                    && axis(-Vector3::y()).dot(&up) > 0.5
                    && axis(Vector3::z()).dot(&up) < -0.1
            })
        });
        let hint = browser.text("up-hint");
        let command = format!("fieldrig view scans/guitar.compressed.ply --up {axis}");
        assert_eq!(hint.contains(&command), axis != "z", "{axis}: {hint}");
    }
}

/// A saved model has its score and the facts of its training.
fn check_saved(browser: &mut Browser, hub: &Hub, file: &Path) {
    // A run at the same address shows its training again.
    hub.set_status(training());
    wait_until(
        browser,
        "the training",
        "document.getElementById('seconds')?.closest('[hidden]') === null",
    );
    wait_until(
        browser,
        "no source",
        "document.getElementById('source-card')?.hidden",
    );
    publish_view(hub, SourceKind::Saved, file);
    wait_for(browser, "the facts", |browser| {
        let text = browser.text("source-card");
        ["kitchen", "Good: 31.2 dB", "scan.mcap", "1,520", "61 s"]
            .iter()
            .all(|fact| text.contains(fact))
    });
    assert!(shown_db(browser).iter().all(|db| (db - 31.2).abs() < 1e-9));
    wait_until(
        browser,
        "no choice of the up axis",
        "document.getElementById('up-axis') === null",
    );
    save_screenshot(browser, "saved");
}

/// A map of few keyframes is drawn faintly, and its progress is shown.
fn check_incomplete_map(browser: &mut Browser, hub: &Hub) {
    browser.click("toggle-grid");
    browser.click("reset-view");
    let without = settled_shot(browser);
    wait_until(
        browser,
        "the button",
        "document.getElementById('toggle-age')?.hidden === false",
    );
    browser.click("toggle-age");
    wait_for(browser, "a subscription", |_| hub.needs_observations());
    wait_for(browser, "the progress", |browser| {
        browser.text("legend-title").contains("0 of 400")
    });
    let mut tints = Vec::new();
    for n_keyframes in [6, 400] {
        hub.set_observations(&ObservationMap {
            min_m: [-10.0; 3],
            cell_m: 10.0,
            n_cells: [2; 3],
            observed: (0..8)
                .map(|ix| ObservedCell {
                    ix,
                    age_secs: 1e6,
                    sigma_m: 0.001,
                })
                .collect(),
            n_keyframes,
            newest_at: None,
        });
        wait_for(browser, "the map", |browser| {
            let title = browser.text("legend-title");
            title.starts_with("Time since") && title.contains("6 of 400") == (n_keyframes == 6)
        });
        // Drawn with the next frame.
        wait_for(browser, "the tint", |browser| {
            let shot = canvas_shot(browser);
            let difference = difference(&without, &shot);
            difference > MAX_SAME && tints.last().is_none_or(|last| difference > 1.5 * last)
        });
        tints.push(difference(&without, &canvas_shot(browser)));
    }
    assert!(tints[0] < 0.6 * tints[1], "{tints:?}");
    browser.click("toggle-age");
    wait_for(browser, "no tint", |browser| {
        difference(&without, &canvas_shot(browser)) < MAX_SAME
    });
}

/// When `view` ends, the page says so and keeps the last picture.
fn check_end_of_view(browser: &mut Browser, served: Served) {
    let before = settled_shot(browser);
    drop(served);
    wait_for(browser, "the end", |browser| {
        browser.text("banner").starts_with("The program has ended")
    });
    wait_until(
        browser,
        "a link without address",
        "document.querySelector('#source-card .files a') !== null \
         && !document.querySelector('#source-card .files a').href",
    );
    let change = difference(&before, &canvas_shot(browser));
    assert!(change < MAX_SAME, "the last picture stays: {change}");
    save_screenshot(browser, "view-ended");
}
