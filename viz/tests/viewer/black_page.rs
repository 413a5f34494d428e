//! Opens the bundled page in a real browser, and checks that its view is never black: before the
//! first picture, while pictures are missing, and while it loads a model to draw it itself.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::models::{self, ModelThread, splat_model, tsdf_model, wall};
use crate::proxy::{Link, Proxy};
use crate::request_thread::RequestThread;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use trainer::{Method, Picture, RenderRequest};
use viz::{Hub, ModelStatus, Server, ServerConfig, StateProgress, Status};

const WINDOW_PX: [u32; 2] = [1100, 720];
/// Pixels whose channels are at most this value count as black. The background of the view has
/// 19 in its brightest channel.
const MAX_BLACK: u8 = 24;
/// Minimum fraction of the middle of the view that is not black.
const MIN_VISIBLE_FRAC: f64 = 0.05;
/// A link on which the chunks of the models take some seconds.
const SLOW_LINK: Link = Link {
    bytes_per_sec: 3e5,
    delay: Duration::from_millis(20),
    slow_period: 1_000_000,
    slow_delay: Duration::ZERO,
};

fn start_server(listen: SocketAddr, hub: &Hub) -> Server {
    Server::start(ServerConfig { listen }, hub.clone()).expect("the port is free")
}

fn any_port() -> SocketAddr {
    ([127, 0, 0, 1], 0).into()
}

/// Checks that the middle of the view shows something. Tools and texts are outside the middle.
fn assert_not_black(browser: &mut Browser, when: &str) {
    let shot = canvas_shot(browser);
    let [width, height] = [shot.width(), shot.height()];
    let columns = width / 4..3 * width / 4;
    let rows = 2 * height / 5..7 * height / 10;
    let n_all = columns.len() * rows.len();
    let n_visible = rows
        .flat_map(|y| columns.clone().map(move |x| (x, y)))
        .filter(|(x, y)| {
            shot.get_pixel(*x, *y)
                .0
                .iter()
                .any(|value| *value > MAX_BLACK)
        })
        .count();
    let visible_frac = n_visible as f64 / n_all as f64;
    if visible_frac < MIN_VISIBLE_FRAC {
        let file = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("page-black.png");
        shot.save(&file).expect("written");
        panic!(
            "{when}: {visible_frac} of the view is visible, see {}",
            file.display()
        );
    }
}

/// Whether the skeleton covers the view; `None` while the page is loading.
fn is_covered(browser: &mut Browser) -> Option<bool> {
    let hidden = browser.evaluate("document.getElementById('skeleton')?.hidden ?? null");
    hidden.as_bool().map(|is_hidden| !is_hidden)
}

fn wait_for_skeleton(browser: &mut Browser, words: &[&str]) {
    wait_for(browser, words[0], |browser| {
        let text = browser.text("skeleton");
        is_covered(browser) == Some(true) && words.iter().all(|word| text.contains(word))
    });
}

fn wait_for_uncovered(browser: &mut Browser, when: &str) {
    wait_for(browser, when, |browser| is_covered(browser) == Some(false));
    assert_not_black(browser, when);
}

/// Whether the last picture is gray, because a newer one is awaited.
fn is_gray(browser: &mut Browser) -> bool {
    browser.evaluate("document.getElementById('view')?.classList.contains('awaiting') ?? false")
        == true
}

/// A model whose pictures are held back, and that is empty at first.
#[derive(Clone, Default)]
struct Pictures {
    are_held: Arc<AtomicBool>,
    have_content: Arc<AtomicBool>,
}

impl Pictures {
    fn hold(&self, are_held: bool) {
        self.are_held.store(are_held, Ordering::Relaxed);
    }

    fn draw(&self, request: &RenderRequest) -> Picture {
        while self.are_held.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(10));
        }
        let has_content = self.have_content.load(Ordering::Relaxed);
        let n = request.size_px[0] as usize * request.size_px[1] as usize;
        let (rgba, depth_m) = if has_content {
            ([120, 160, 90, 255], 2.0)
        } else {
            ([11, 14, 19, 0], 0.0)
        };
        Picture {
            size_px: request.size_px,
            rgba_srgb: rgba.repeat(n),
            depth_m: vec![depth_m; n],
        }
    }
}

/// Lets pictures pass even if a test fails, so that their thread can end.
impl Drop for Pictures {
    fn drop(&mut self) {
        self.hold(false);
    }
}

fn progress(text: &str, n_done: usize, n_all: usize) -> StateProgress {
    StateProgress::of_parts(text.to_owned(), n_done, n_all)
}

fn trained() -> Status {
    Status {
        state: "training".to_owned(),
        keyframes: 5,
        model: ModelStatus {
            method: "splat".to_owned(),
            step: 100,
            ..ModelStatus::default()
        },
        ..Status::default()
    }
}

#[test]
fn the_page_says_what_happens_until_there_is_a_picture() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    let server = start_server(any_port(), &hub);
    let pictures = Pictures::default();
    pictures.hold(true);
    let drawn = pictures.clone();
    let thread = RequestThread::start(hub.clone(), move |pending| {
        let picture = drawn.draw(&pending.request);
        pending.deliver(picture);
    });
    // Dropped before the thread, which waits as long as pictures are held back.
    let _release = pictures.clone();
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);

    check_startup(&mut browser, &hub, &pictures);
    check_reload_while_scoring(&mut browser, &hub, &pictures);
    let server = check_reconnection(&mut browser, server, &hub, &pictures);
    check_lost_context(&mut browser);

    drop(browser);
    drop(thread);
    drop(server);
}

/// From the connection to the first picture with content.
fn check_startup(browser: &mut Browser, hub: &Hub, pictures: &Pictures) {
    wait_for_skeleton(browser, &["Connected"]);
    assert_not_black(browser, "before the first status");
    hub.set_status(Status {
        state: "opening devices".to_owned(),
        progress: Some(progress("the arm, 1 camera", 0, 0).at_startup()),
        ..Status::default()
    });
    wait_for_skeleton(browser, &["Opening devices", "the arm, 1 camera"]);
    assert_not_black(browser, "while devices are opened");
    hub.set_state_and_progress(
        "collecting keyframes",
        Some(progress("3 of 5 keyframes", 3, 5).at_startup()),
    );
    wait_for_skeleton(browser, &["Collecting keyframes", "3 of 5 keyframes"]);
    let done = browser.evaluate("document.querySelector('#skeleton progress')?.value ?? 0");
    assert!(
        (done.as_f64().unwrap_or_default() - 0.6).abs() < 1e-6,
        "{done}"
    );
    // A picture of an empty model is as black as no picture.
    pictures.hold(false);
    wait_for(browser, "an empty picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    assert_eq!(is_covered(browser), Some(true));
    assert_not_black(browser, "while the model is empty");
    pictures.have_content.store(true, Ordering::Relaxed);
    // The page requests pictures after each change of the model.
    let mut edit_revision = 0;
    wait_for(browser, "a picture", |browser| {
        edit_revision += 1;
        hub.change_status(|status| status.edit_revision = edit_revision);
        is_covered(browser) == Some(false)
    });
    assert_not_black(browser, "with a picture");
}

/// A page that is loaded while pictures wait shows why.
fn check_reload_while_scoring(browser: &mut Browser, hub: &Hub, pictures: &Pictures) {
    pictures.hold(true);
    hub.set_status(trained());
    hub.set_state_and_progress(
        "scoring, 12 of 50 images",
        Some(progress("12 of 50 test images", 12, 50)),
    );
    browser.load_by("location.reload()");
    wait_for_skeleton(
        browser,
        &["Scoring, 12 of 50 images", "12 of 50 test images"],
    );
    assert_eq!(browser.text("state"), "scoring, 12 of 50 images");
    assert_not_black(browser, "after a reload while images are scored");
    pictures.hold(false);
    wait_for_uncovered(browser, "a picture while images are scored");
}

/// The last picture stays, gray, until there is a new one.
fn check_reconnection(
    browser: &mut Browser,
    server: Server,
    hub: &Hub,
    pictures: &Pictures,
) -> Server {
    let listen = server.address();
    pictures.hold(true);
    drop(server);
    wait_for(browser, "the loss", |browser| {
        browser
            .text("connection")
            .contains("the server has stopped")
    });
    assert_not_black(browser, "while the connection is lost");
    let server = start_server(listen, hub);
    wait_for(browser, "the return", |browser| {
        browser.text("connection").starts_with("connected")
    });
    assert!(is_gray(browser), "the picture is old");
    assert_eq!(is_covered(browser), Some(false));
    assert_not_black(browser, "after the reconnection");
    pictures.hold(false);
    wait_for(browser, "a new picture", |browser| !is_gray(browser));
    server
}

/// While the browser cannot draw, the page says so. Afterwards, the last picture is drawn again.
fn check_lost_context(browser: &mut Browser) {
    browser.evaluate(
        "window.lost = document.getElementById('canvas').getContext('webgl2')\
         .getExtension('WEBGL_lose_context'); lost.loseContext()",
    );
    wait_for_skeleton(browser, &["graphics context"]);
    assert_not_black(browser, "without a WebGL context");
    browser.evaluate("lost.restoreContext()");
    wait_for_uncovered(browser, "after the WebGL context was restored");
    wait_for(browser, "a new picture", |browser| !is_gray(browser));
}

/// Number of chunks of a model.
fn n_chunks(model: &mut dyn Method) -> usize {
    model
        .queue_chunks(false, &Arc::default())
        .expect("queued")
        .expect("not empty")
        .finish()
        .expect("encoded")
        .chunks
        .len()
}

/// Waits until the page itself draws all of a model, and checks that the view is not black until
/// then.
fn wait_until_drawn(browser: &mut Browser, (method, n_chunks): (&str, usize)) {
    let all = format!("drawn here: {n_chunks} parts");
    wait_for(browser, method, |browser| {
        assert_not_black(browser, method);
        browser.text("picture-text") == all && browser.text("local-text").is_empty()
    });
    assert_not_black(browser, method);
}

#[test]
fn local_drawing_keeps_what_is_on_screen_until_its_chunks_are_there() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    models::publish_wall(&hub, Vec::new());
    let splats = wall(40_000);
    let (mut splat, mut tsdf) = (splat_model(&splats), tsdf_model(18));
    let splat_parts = ("splat", n_chunks(&mut splat));
    let tsdf_parts = ("tsdf", n_chunks(&mut tsdf));
    let models: models::Models = vec![("splat", Box::new(splat)), ("tsdf", Box::new(tsdf))];
    let thread = ModelThread::start(hub.clone(), models);
    let server = start_server(any_port(), &hub);
    let listen = server.address();
    let proxy = Proxy::start(listen, SLOW_LINK);
    let url = format!("http://{}/", proxy.address());
    let mut browser = Browser::open(&program, &url, WINDOW_PX);
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    browser.click("toggle-grid");

    browser.click("toggle-local");
    wait_until_drawn(&mut browser, splat_parts);
    // Without local drawing, the chunks stay until there is a picture.
    browser.click("toggle-local");
    wait_for(&mut browser, "a full picture", |browser| {
        assert_not_black(browser, "without local drawing");
        browser.text("picture-text").contains("100 %")
    });
    browser.click("toggle-local");
    wait_until_drawn(&mut browser, splat_parts);

    browser.evaluate("document.querySelector('[data-method=tsdf]').click()");
    wait_for(&mut browser, "the other model", |browser| {
        assert_not_black(browser, "after the choice of another model");
        hub.model_chunks().contains("tsdf")
    });
    wait_until_drawn(&mut browser, tsdf_parts);

    // The server sends all chunks again. Until then, the old ones are drawn.
    drop(server);
    wait_for(&mut browser, "the loss", |browser| {
        assert_not_black(browser, "while the connection is lost");
        !browser.text("connection").starts_with("connected")
    });
    let server = start_server(listen, &hub);
    wait_for(&mut browser, "the return", |browser| {
        assert_not_black(browser, "before the reconnection");
        let is_connected = browser.text("connection").starts_with("connected");
        is_connected && hub.model_chunks().contains("tsdf")
    });
    wait_until_drawn(&mut browser, tsdf_parts);

    drop(browser);
    drop(thread.finish());
    drop(server);
}
