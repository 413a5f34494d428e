//! The page of `fieldrig calibrate` while simulated devices are read, as a client receives it.
#![cfg(feature = "sim")]

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};
use tungstenite::Message;

const TARGET: &str = "charuco:5x7:24mm:18mm:5X5_100";

/// What a client has received.
#[derive(Default)]
struct Received {
    texts: Vec<String>,
    /// Size of each image, pixels.
    images_px: Vec<Value>,
    /// What the photographs for a lens cover; null for other calibrations.
    coverage: Value,
    is_finished: bool,
}

/// Receives guidance and images until the server says goodbye.
fn receive(url: &str) -> Received {
    let address = url
        .strip_prefix("http://")
        .expect("a URL")
        .trim_end_matches('/');
    let stream = std::net::TcpStream::connect(address).expect("the server listens");
    let (mut socket, _) =
        tungstenite::client(format!("ws://{address}/ws"), stream).expect("a WebSocket");
    let hello = json!({"type": "hello", "protocols": [3, 4], "capabilities": []});
    socket
        .send(Message::text(hello.to_string()))
        .expect("the server reads");
    let mut received = Received::default();
    loop {
        match socket.read().expect("a goodbye comes before the end") {
            Message::Text(text) => {
                let message: Value = serde_json::from_str(&text).expect("JSON");
                match message["type"].as_str().expect("a type") {
                    "status" => {
                        let guidance = &message["guidance"];
                        received
                            .texts
                            .push(guidance["text"].as_str().expect("guidance").to_owned());
                        received.coverage = guidance["coverage"].clone();
                        received.is_finished =
                            guidance["is_finished"].as_bool().expect("a boolean");
                    }
                    "goodbye" => return received,
                    _ => (),
                }
            }
            Message::Binary(bytes) => {
                let n_header =
                    u32::from_le_bytes(bytes[..4].try_into().expect("four bytes")) as usize;
                let header: Value = serde_json::from_slice(&bytes[4..4 + n_header]).expect("JSON");
                assert_eq!(
                    (&header["type"], &header["camera"]),
                    (&json!("live_image"), &json!("wrist"))
                );
                assert!(
                    bytes[4 + n_header..].starts_with(&[0xFF, 0xD8]),
                    "a JPEG file"
                );
                received.images_px.push(header["size_px"].clone());
            }
            _ => (),
        }
    }
}

/// Runs `calibrate` with these arguments, and returns what a client of its page received and what
/// was logged.
fn calibrate(args: &[&str]) -> (Received, String) {
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/calibration-board.toml");
    let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["calibrate", args[0]])
        .arg(rig)
        .args([
            "--sim",
            "--listen",
            "127.0.0.1:0",
            "--target",
            TARGET,
            "--json",
        ])
        .args(&args[1..])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("it is built");
    let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
    let mut log = String::new();
    let url = loop {
        assert!(
            stderr.read_line(&mut log).expect("text") > 0,
            "it ended early: {log}"
        );
        if let Some(url) = log
            .split_whitespace()
            .find(|word| word.starts_with("http://"))
        {
            break url.to_owned();
        }
    };
    let client = std::thread::spawn(move || receive(&url));
    stderr.read_to_string(&mut log).expect("text");
    let status = child.wait().expect("our own child");
    assert!(status.success(), "{log}");
    (
        client
            .join()
            .unwrap_or_else(|_| panic!("the client failed: {log}")),
        log,
    )
}

#[test]
fn images_and_instructions_of_a_scan_reach_a_client() {
    let (received, log) = calibrate(&["intrinsics", "--seconds", "12"]);
    let has = |words: &str| received.texts.iter().any(|text| text.contains(words));
    assert!(
        has("% of the image; next: ") && has("images of the target cover"),
        "{:?}",
        received.texts
    );
    assert!(
        received.is_finished && has("the result is in the terminal"),
        "{:?}",
        received.texts
    );
    assert!(!received.images_px.is_empty(), "{log}");
    let Value::Array(is_covered) = &received.coverage["is_covered"] else {
        panic!("no coverage: {}", received.coverage);
    };
    assert_eq!(received.coverage["camera"], "wrist");
    assert!(is_covered.len() == 144 && is_covered.contains(&json!(true)));
    // The page shows the same text as the terminal.
    let shown = received
        .texts
        .iter()
        .find(|text| text.contains("next: "))
        .expect("checked above");
    assert!(log.contains(shown.as_str()), "{shown} is not in {log}");
}

#[test]
fn poses_of_a_moving_arm_reach_a_client() {
    let (received, _) = calibrate(&[
        "hand-eye",
        "--move",
        "--max-poses",
        "10",
        "--with-intrinsics",
    ]);
    let n_motions = received
        .texts
        .iter()
        .filter(|text| text.starts_with("moving to pose "))
        .count();
    assert!(
        n_motions > 0 && received.is_finished,
        "{:?}",
        received.texts
    );
    assert!(!received.images_px.is_empty());
    assert_eq!(received.coverage, Value::Null, "it is not about the lens");
}
