//! Opens the page of a shared server in a real browser: tokens, roles, and a page of another site.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use kinematics::Transform;
use serde_json::json;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, wait_for};
use viz::{
    Certificate, Control, EditAction, EditRequest, Hub, SceneHint, Server, ServerConfig, Sharing,
    Status, Tokens,
};

const WINDOW_PX: [u32; 2] = [1280, 760];
const PHONE_PX: [u32; 2] = [390, 844];
/// Center of the scene, meters.
const CENTER_M: [f64; 3] = [0.5, 0.0, 0.1];
/// A page that is not blocked connects much faster, even on two busy cores.
const BLOCKED_AFTER: Duration = Duration::from_secs(5);

#[test]
fn page_uses_its_token_and_shows_its_role() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let folder = tempfile::tempdir().expect("a folder");
    let certificate = Certificate::kept_in(folder.path()).expect("a certificate");
    let tokens = Tokens::random().expect("random numbers");
    let (operator, viewer) = (
        tokens.operator.text().to_owned(),
        tokens.viewer.text().to_owned(),
    );
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let hub = Hub::new();
    hub.set_status(Status {
        state: "training".to_owned(),
        ..Status::default()
    });
    let world_from_camera = Transform::translation(0.5, 0.0, -3.0);
    hub.set_scene_hint(SceneHint {
        center_m: CENTER_M,
        radius_m: 2.0,
        world_from_camera,
    });
    let server = Server::start_shared(
        config,
        Sharing {
            certificate,
            tokens,
        },
        hub.clone(),
    )
    .expect("a free port");

    // The sentence of the server is shown although browsers hide why a WebSocket was refused.
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);
    let has_banner =
        |text: &'static str| move |browser: &mut Browser| browser.text("banner").contains(text);
    wait_for(
        &mut browser,
        "the reason",
        has_banner("This server requires a token"),
    );
    std::fs::write(scratch.join("shared-no-token.png"), browser.screenshot()).expect("written");
    let open = |browser: &mut Browser, token: &str| {
        browser.load_by(&format!("location.hash = '#token={token}'"))
    };
    open(&mut browser, "0123");
    wait_for(&mut browser, "the reason", has_banner("Invalid token"));
    browser.resize(PHONE_PX);
    std::fs::write(
        scratch.join("shared-wrong-token-phone.png"),
        browser.screenshot(),
    )
    .expect("written");
    browser.resize(WINDOW_PX);

    open(&mut browser, &viewer);
    let connected = |browser: &mut Browser| browser.text("connection").starts_with("connected");
    wait_for(&mut browser, "a connection", connected);
    assert_eq!(
        browser.evaluate("location.hash"),
        json!(""),
        "the token is not left in the address"
    );
    assert_eq!(browser.text("banner"), "");
    assert_eq!(browser.text("role"), "viewer");
    let pause = "document.getElementById('pause')";
    let is_shown = "document.getElementById('controls').hidden === false";
    wait_for(&mut browser, "the button", |browser| {
        browser.evaluate(is_shown) == json!(true)
    });
    assert_eq!(browser.evaluate(&format!("{pause}.disabled")), json!(true));
    let edit = "document.getElementById('toggle-edit')";
    wait_for(&mut browser, "the button", |browser| {
        browser.evaluate(&format!("{edit}.hidden")) == json!(false)
    });
    assert_eq!(browser.evaluate(&format!("{edit}.disabled")), json!(true));
    press(&mut browser, "q");
    assert_eq!(
        browser.evaluate("document.getElementById('edit').hidden"),
        json!(true),
        "viewers cannot edit"
    );
    let reason = browser.evaluate(&format!("{pause}.title"));
    assert!(
        reason
            .as_str()
            .is_some_and(|reason| reason.contains("connected as viewer")),
        "{reason}"
    );
    std::fs::write(scratch.join("shared-viewer.png"), browser.screenshot()).expect("written");
    browser.resize(PHONE_PX);
    std::fs::write(
        scratch.join("shared-viewer-phone.png"),
        browser.screenshot(),
    )
    .expect("written");
    browser.resize(WINDOW_PX);

    // The token stays after a reload, and another one replaces it.
    browser.call("Page.reload", json!({}));
    wait_for(&mut browser, "a connection", connected);
    open(&mut browser, &operator);
    browser.call("Page.reload", json!({}));
    wait_for(&mut browser, "a connection", connected);
    wait_for(&mut browser, "the role", |browser| {
        browser.text("role").is_empty()
    });
    wait_for(&mut browser, "the button", |browser| {
        browser.evaluate(is_shown) == json!(true)
    });
    for (action, state, next) in [
        (Control::Pause, "paused", "Continue"),
        (Control::Resume, "training", "Pause"),
    ] {
        browser.click("pause");
        wait_for(&mut browser, "the action", |_| {
            hub.operator_requests().take_controls() == [action]
        });
        hub.set_state(state); // As the run does.
        wait_for(&mut browser, "the state", |browser| {
            browser.text("pause") == next
        });
    }
    std::fs::write(scratch.join("shared-operator.png"), browser.screenshot()).expect("written");
    edit_model(&mut browser, &hub);
    std::fs::write(scratch.join("shared-edit.png"), browser.screenshot()).expect("written");
    browser.resize(PHONE_PX);
    std::fs::write(scratch.join("shared-edit-phone.png"), browser.screenshot()).expect("written");
    // A link may contain a view besides the token. Only the token is removed.
    browser.load_by(&format!(
        "location.hash = '#token={operator}&view=1~p1_2_3~t0_0_0~f50'"
    ));
    wait_for(&mut browser, "an address without token", |browser| {
        browser.evaluate("location.hash") == json!("#view=1~p1_2_3~t0_0_0~f50")
    });
    wait_for(&mut browser, "a connection", connected);
    drop(browser);
}

fn press(browser: &mut Browser, key: &str) {
    browser.evaluate(&format!(
        "window.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))"
    ));
}

/// The edits that the page sends.
fn wait_for_edits(browser: &mut Browser, hub: &Hub) -> Vec<EditRequest> {
    let mut edits = Vec::new();
    wait_for(browser, "an edit", |_| {
        edits = hub.operator_requests().take_edits();
        !edits.is_empty()
    });
    edits
}

/// Erases the box, removes floaters and undoes edits, with buttons.
fn edit_model(browser: &mut Browser, hub: &Hub) {
    let is_enabled = "document.getElementById('toggle-edit').disabled === false";
    wait_for(browser, "the button", |browser| {
        browser.evaluate(is_enabled) == json!(true)
    });
    press(browser, "Delete");
    browser.click("toggle-edit");
    assert_eq!(
        hub.operator_requests().take_edits(),
        [],
        "keys have no effect while the panel is closed"
    );
    browser.click("erase-box");
    let edits = wait_for_edits(browser, hub);
    let EditAction::Erase(erased) = edits[0].action() else {
        panic!("{edits:?}")
    };
    // The box is small until the user changes it: 0.3 times the radius wide, around the center.
    let sides = erased.min_m.iter().zip(&erased.max_m).zip(CENTER_M);
    let is_expected = |((min, max), center): ((&f64, &f64), f64)| {
        (min - center + 0.3).abs() < 1e-9 && (max - center - 0.3).abs() < 1e-9
    };
    assert!(sides.into_iter().all(is_expected), "{erased:?}");
    let set_edits = |n_edits| hub.change_status(|status| status.model.edits = n_edits);
    assert_eq!(browser.text("undo-edit"), "Undo");
    set_edits(3); // As the run does.
    wait_for(browser, "the number of edits", |browser| {
        browser.text("undo-edit") == "Undo (3)"
    });
    browser.click("remove-floaters");
    assert_eq!(browser.text("edit-note"), "looking for floaters …");
    let edits = wait_for_edits(browser, hub);
    assert_eq!(*edits[0].action(), EditAction::RemoveFloaters);
    hub.reject_edit(&edits[0], "no floaters found");
    wait_for(browser, "the reason", |browser| {
        browser.text("edit-note") == "no floaters found"
    });
    browser.click("undo-edit");
    assert_eq!(*wait_for_edits(browser, hub)[0].action(), EditAction::Undo);
    set_edits(2);
    wait_for(browser, "the number of edits", |browser| {
        browser.text("undo-edit") == "Undo (2)"
    });
    assert_eq!(browser.text("edit-note"), "");

    browser.click("remove-floaters");
    assert_eq!(browser.text("edit-note"), "looking for floaters …");
    wait_for_edits(browser, hub);
    // An undo and another edit: only the revision differs.
    hub.change_status(|status| status.edit_revision += 2);
    wait_for(browser, "the change", |browser| {
        browser.text("edit-note").is_empty()
    });
}

/// Serves one HTML document to every request, as another site.
fn serve_html(html: String) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
    let url = format!("http://{}/", listener.local_addr().expect("bound"));
    std::thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let _ = stream.read(&mut [0; 4096]);
            let length = html.len();
            let head = format!(
                "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {length}\r\n"
            );
            let _ = write!(stream, "{head}Connection: close\r\n\r\n{html}");
        }
    });
    url
}

#[test]
fn other_sites_can_neither_embed_nor_use_the_page() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub.clone()).expect("a free port");
    let socket = format!("ws://{}/ws", server.address());
    let html = format!(
        "<iframe src='{}'></iframe><p id=socket>waiting</p><script>
         const socket = new WebSocket('{socket}');
         const show = (text) => () => document.getElementById('socket').textContent = text;
         socket.onopen = show('open'); socket.onerror = show('refused');</script>",
        server.url()
    );
    let mut browser = Browser::open(&program, &serve_html(html), WINDOW_PX);
    wait_for(&mut browser, "the socket", |browser| {
        ["open", "refused"].contains(&&*browser.text("socket"))
    });
    assert_eq!(browser.text("socket"), "refused");
    let started = Instant::now();
    while started.elapsed() < BLOCKED_AFTER {
        assert_eq!(hub.n_clients(), 0, "the embedded page runs");
        std::thread::sleep(Duration::from_millis(50));
    }
    // The same page connects if it is opened directly.
    browser.call("Page.navigate", json!({"url": server.url()}));
    wait_for(&mut browser, "a client", |_| hub.n_clients() == 1);
    drop(browser);
}
