//! Opens the page in a real browser where it cannot work as usual: with a server of an older
//! version, without WebGL 2.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::PathBuf;
use std::time::Duration;
use test_support::browser::{Browser, browser_for_page, wait_for};
use tungstenite::Message;

const WINDOW_PX: [u32; 2] = [1280, 760];

/// A server that sends these messages to every client, like one of an older version. Returns its
/// URL.
fn serve(messages: Vec<Value>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
    let url = format!("http://{}/", listener.local_addr().expect("bound"));
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let messages = messages.clone();
            std::thread::spawn(move || answer(stream, &messages));
        }
    });
    url
}

fn answer(mut stream: TcpStream, messages: &[Value]) {
    let mut request = [0; 2048];
    let n_bytes = stream.peek(&mut request).unwrap_or(0);
    let request = String::from_utf8_lossy(&request[..n_bytes]).into_owned();
    let path = request.split(' ').nth(1).unwrap_or_default();
    if path == "/ws" {
        let Ok(mut socket) = tungstenite::accept(stream) else {
            return;
        };
        while messages
            .iter()
            .all(|message| socket.send(Message::text(message.to_string())).is_ok())
        {
            std::thread::sleep(Duration::from_millis(200));
        }
        return;
    }
    let (file, kind) = match path {
        "/" => ("index.html", "text/html"),
        "/app.js" => ("app.js", "text/javascript"),
        _ => ("app.css", "text/css"),
    };
    let bytes = std::fs::read(
        PathBuf::from(env!("CARGO_MANIFEST_DIR"))
            .join("web/dist")
            .join(file),
    )
    .expect("bundled");
    let length = bytes.len();
    let head = format!(
        "HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
    );
    // The request is read, because the browser would otherwise see a reset.
    let _ = stream.read(&mut [0; 4096]);
    let _ = stream
        .write_all(head.as_bytes())
        .and_then(|()| stream.write_all(&bytes));
}

/// The hello of a server that supports one version and negotiates nothing.
fn hello(protocol: u32) -> Value {
    json!({"type": "hello", "protocol": protocol, "server": "fieldrig 0.0.1", "client": 1, "max_size_px": [4096, 4096],
           "default_stages": [0.1, 0.5, 1.0], "clock_millis": 0.0})
}

#[test]
fn page_works_with_an_older_server_or_says_why_not() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let mut browser = Browser::open(&program, &serve(vec![hello(2)]), WINDOW_PX);
    wait_for(&mut browser, "the reason", |browser| {
        browser
            .text("banner")
            .starts_with("The server uses protocol version 2, this page 3 to 4: reload the page")
    });

    let status = json!({"type": "status", "state": "training", "seconds": 12.0, "method": "splat", "step": 70,
        "step_millis": null, "primitives": 5, "primitives_label": "Splats", "bytes": 80, "keyframes": 3, "rejected": {},
        "psnr": null, "psnr_history": [], "others": [], "notes": [], "result": null});
    let url = serve(vec![hello(3), status]);
    browser.call("Page.navigate", json!({"url": url}));
    wait_for(&mut browser, "the status", |browser| {
        browser.text("step") == "70"
    });
    assert!(browser.text("connection").starts_with("connected"));
    assert_eq!(
        (browser.text("banner"), browser.text("role")),
        (String::new(), String::new())
    );
    assert_eq!(
        browser.evaluate("document.getElementById('controls').hidden"),
        json!(true),
        "the server has no controls"
    );
    drop(browser);
}

/// Browsers without hardware acceleration, as in some remote desktops, have no WebGL 2.
#[test]
fn page_without_webgl_shows_an_error() {
    const NO_WEBGL: &str = "HTMLCanvasElement.prototype.getContext = () => null";
    let Some(program) = browser_for_page() else {
        return;
    };
    let mut browser = Browser::open_with(&program, &serve(vec![hello(3)]), WINDOW_PX, NO_WEBGL);
    wait_for(&mut browser, "the reason", |browser| {
        browser
            .text("banner")
            .starts_with("WebGL 2 is not available in this browser: turn on")
    });
    assert_eq!(browser.text("connection"), "not connected");
    drop(browser);
}
