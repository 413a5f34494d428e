//! Opens the bundled page in a real browser, saves a workspace, changes the view, and finds it again
//! by dropping the file. Then opens a page of a server that has a workspace.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use nalgebra::Translation3;
use serde_json::{Value, json};
use std::sync::{Arc, Mutex};
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use trainer::RenderRequest;
use viz::{Hub, SceneHint, Server, ServerConfig, Workspace};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Files contain positions in micrometers.
const MAX_ERROR_M: f64 = 1e-4;
/// Where the eye of the file is that the server has.
const EYE_M: [f64; 3] = [0.5, -1.5, 0.75];

/// Keeps files that the page saves in `window.saved`, by name.
const KEEP_FILES: &str = "
    window.saved = {};
    const files = new Map();
    URL.createObjectURL = (file) => { const url = `blob:${files.size}`; files.set(url, file); return url; };
    URL.revokeObjectURL = () => undefined;
    HTMLAnchorElement.prototype.click = function () {
        const name = this.download;
        void files.get(this.href).text().then((text) => (window.saved[name] = text));
    };
";

type Requests = Arc<Mutex<Vec<RenderRequest>>>;

/// A page whose pictures are drawn, and whose requests are recorded.
struct Page {
    browser: Browser,
    requests: Requests,
    url: String,
    /// Stops when it is dropped, before the server.
    _renderer: RequestThread,
    _server: Server,
}

impl Page {
    fn open(program: &std::path::Path, hub: &Hub) -> Self {
        hub.set_scene_hint(SceneHint {
            center_m: [0.0, 0.0, 0.2],
            radius_m: 0.8,
            world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
        });
        let config = ServerConfig {
            listen: ([127, 0, 0, 1], 0).into(),
        };
        let server = Server::start(config, hub.clone()).expect("a free port");
        let requests = Requests::default();
        let received = Arc::clone(&requests);
        let renderer = RequestThread::start(hub.clone(), move |pending| {
            let request = pending.request.clone();
            let picture = draw(&request);
            received.lock().expect("no panic").push(request);
            pending.deliver(picture);
        });
        let url = server.url();
        let script = format!("{NO_DRAWING}\n{KEEP_FILES}");
        let mut browser = Browser::open_with(program, &url, WINDOW_PX, &script);
        wait_for(&mut browser, "a full picture", |browser| {
            browser.text("picture-text").contains("100 %")
        });
        Self {
            browser,
            requests,
            url,
            _renderer: renderer,
            _server: server,
        }
    }

    fn newest_request(&self) -> Option<RenderRequest> {
        self.requests.lock().expect("no panic").last().cloned()
    }

    /// Waits for a picture from this place.
    fn wait_for_eye(&mut self, eye_m: [f64; 3]) {
        let requests = Arc::clone(&self.requests);
        wait_for(&mut self.browser, "the eye of the workspace", |_| {
            let newest = requests.lock().expect("no panic").last().cloned();
            newest.is_some_and(|request| {
                let eye = request.world_from_camera.translation.vector;
                (0..3).all(|axis| (eye[axis] - eye_m[axis]).abs() < MAX_ERROR_M)
            })
        });
    }

    fn pressed(&mut self, id: &str) -> Value {
        self.browser
            .evaluate(&format!("document.getElementById('{id}').ariaPressed"))
    }

    /// The text of a saved file.
    fn saved(&mut self, name: &str) -> String {
        let read = format!("window.saved['{name}'] ?? null");
        wait_for(&mut self.browser, "a saved file", |browser| {
            !browser.evaluate(&read).is_null()
        });
        let text = self.browser.evaluate(&read);
        text.as_str().expect("a text").to_owned()
    }

    /// Drops a file on the page.
    fn drop_file(&mut self, name: &str, text: &str) {
        let [name, text] = [name, text].map(|value| json!(value));
        self.browser.evaluate(&format!(
            "(() => {{ const dataTransfer = new DataTransfer(); \
             dataTransfer.items.add(new File([{text}], {name}, {{type: 'application/json'}})); \
             document.body.dispatchEvent(new DragEvent('drop', {{dataTransfer, bubbles: true, cancelable: true}})); }})()"
        ));
    }

    fn wait_for_message(&mut self, part: &str) {
        wait_for(&mut self.browser, part, |browser| {
            browser.text("toast").contains(part)
        });
    }
}

#[test]
fn a_workspace_is_saved_and_opened_again() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let mut page = Page::open(&program, &Hub::new());
    let press = |page: &mut Page, key: &str| {
        page.browser.evaluate(&format!(
            "void document.body.dispatchEvent(new KeyboardEvent('keydown', \
             {{key: '{key}', ctrlKey: true, bubbles: true, cancelable: true}}))"
        ));
    };
    for id in ["toggle-grid", "toggle-crop", "toggle-run", "toggle-layers"] {
        page.browser.click(id);
    }
    page.drop_file(
        "eye.json",
        &json!({
            "format": "fieldrig-workspace", "version": 1,
            "camera": {"mode": "orbit", "position_m": EYE_M, "target_m": [0, 0, 0.25], "fov_degrees": 40},
        })
        .to_string(),
    );
    page.wait_for_eye(EYE_M);
    press(&mut page, "s");
    let text = page.saved("fieldrig.workspace.json");
    let file: Value = serde_json::from_str(&text).expect("JSON");
    assert_eq!(file["camera"]["position_m"], json!(EYE_M));
    assert_eq!(file["camera"]["fov_degrees"], json!(40));
    assert_eq!(file["layers"]["grid"], json!(false));
    assert_eq!(file["layers"]["model"], json!(true));
    assert_eq!(file["crop"]["is_on"], json!(true));
    assert!(
        file["crop"]["box"]["size_m"][0]
            .as_f64()
            .is_some_and(|length| length > 0.1)
    );
    assert_eq!(file["panels"]["side"], json!(false));
    assert_eq!(file["panels"]["open"], json!("layers"));
    assert_eq!(file["mode"], json!("pictures"));
    // The server accepts what the page has saved.
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("saved.json");
    std::fs::write(&path, &text).expect("written");
    Workspace::read(&path).expect("a workspace");

    let crop = page.newest_request().and_then(|request| request.crop);
    for id in [
        "toggle-grid",
        "toggle-crop",
        "toggle-run",
        "toggle-layers",
        "look-top",
    ] {
        page.browser.click(id);
    }
    page.drop_file("desk.workspace.json", &text);
    page.wait_for_message("Opened desk.workspace.json");
    page.wait_for_eye(EYE_M);
    assert_eq!(page.pressed("toggle-grid"), json!("false"));
    assert_eq!(page.pressed("toggle-crop"), json!("true"));
    let is_hidden = |page: &mut Page, id: &str| {
        page.browser
            .evaluate(&format!("document.getElementById('{id}').hidden"))
    };
    assert_eq!(is_hidden(&mut page, "run"), true);
    assert_eq!(is_hidden(&mut page, "layers"), false);
    let again = page.newest_request().and_then(|request| request.crop);
    assert!(crop.is_some() && again.is_some(), "{crop:?}, {again:?}");

    // A file that is none changes nothing, and the page says why.
    let hostile = "{\"format\": \"fieldrig-workspace\", \"version\": 1, \"camera\": {\"mode\": \"<img onerror=alert(1)>\"}}";
    page.drop_file("hostile.json", hostile);
    page.wait_for_message("hostile.json cannot be opened: camera.position_m is missing");
    assert_eq!(page.pressed("toggle-crop"), json!("true"));
    page.drop_file("photo.jpg", "\u{ffd8}\u{ffe0}");
    page.wait_for_message("photo.jpg cannot be opened: it is not JSON");
}

#[test]
fn a_page_starts_with_the_workspace_of_its_server() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("start.json");
    let file = json!({
        "format": "fieldrig-workspace", "version": 1,
        "camera": {"mode": "orbit", "position_m": EYE_M, "target_m": [0, 0, 0.25]},
        "layers": {"grid": false},
    });
    std::fs::write(&path, file.to_string()).expect("written");
    let hub = Hub::new();
    hub.set_workspace(Workspace::read(&path).expect("a workspace"));
    let mut page = Page::open(&program, &hub);
    page.wait_for_eye(EYE_M);
    assert_eq!(page.pressed("toggle-grid"), json!("false"));

    // A view in the address comes first.
    let linked = [1.0, -2.0, 0.5];
    let url = format!("{}#view=1~p1_-2_0.5~t0_0_0", page.url);
    // An address that differs only behind `#` would not load the page again.
    page.browser
        .call("Page.navigate", json!({"url": "about:blank"}));
    page.browser.call("Page.navigate", json!({"url": url}));
    page.wait_for_eye(linked);
    assert_eq!(page.pressed("toggle-grid"), json!("true"));
}
