//! Files that the server offers: names, headers, large files, errors, and pictures meanwhile.

use crate::client::{Client, TIMEOUT};
use crate::local_server::start;
use serde_json::json;
use std::fs::File;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use viz::{ServedFile, publish_files};

/// Many pieces, and more than the buffers of a connection hold.
const LARGE_BYTES: usize = 9_000_001;

/// A file that is opened for each request.
pub(crate) fn served(name: &str, save_as: Option<&str>, path: PathBuf) -> ServedFile {
    ServedFile {
        name: name.to_owned(),
        label: format!("File {name}"),
        save_as: save_as.map(str::to_owned),
        open: Arc::new(move || File::open(&path).map_err(|error| error.to_string())),
    }
}

fn request(address: SocketAddr, path: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    )
    .expect("sent");
    stream
}

/// Status line and headers in lower case, and the body.
fn response(mut stream: TcpStream) -> (String, Vec<u8>) {
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    let at = answer
        .windows(4)
        .position(|window| window == b"\r\n\r\n")
        .expect("a head");
    let head = String::from_utf8_lossy(&answer[..at]).to_lowercase();
    (head, answer[at + 4..].to_vec())
}

fn get(address: SocketAddr, path: &str) -> (String, Vec<u8>) {
    response(request(address, path))
}

fn write(folder: &Path, name: &str, content: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, content).expect("written");
    path
}

#[test]
fn only_published_files_are_served() {
    let folder = tempfile::tempdir().expect("a folder");
    let (hub, server) = start();
    let address = server.address();
    let large: Vec<u8> = (0..=250).cycle().take(LARGE_BYTES).collect();
    let model = write(folder.path(), "splats.ply", &large);
    let report = write(folder.path(), "report.html", b"<!doctype html><p>scores");
    write(folder.path(), "secret.txt", b"secret");
    assert!(
        get(address, "/files/splat.ply")
            .0
            .starts_with("http/1.1 404")
    );
    publish_files(
        &hub,
        vec![
            served("splat.ply", Some("kitchen.ply"), model),
            served("splat-report.html", None, report),
        ],
    );
    let mut client = Client::connect(address);
    assert_eq!(
        client.text_of("status")["files"],
        json!([
            { "path": "files/splat.ply", "label": "File splat.ply", "is_page": false },
            { "path": "files/splat-report.html", "label": "File splat-report.html", "is_page": true },
        ])
    );
    let (head, body) = get(address, "/files/splat.ply");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    for header in [
        "content-disposition: attachment; filename=\"kitchen.ply\"",
        "content-length: 9000001",
        "x-content-type-options: nosniff",
        "cache-control: no-store",
    ] {
        assert!(head.contains(header), "{header}: {head}");
    }
    assert!(body == large, "{} bytes", body.len());
    let (head, body) = get(address, "/files/splat-report.html");
    assert_eq!(body, b"<!doctype html><p>scores");
    assert!(
        !head.contains("content-disposition") && head.contains("content-type: text/html"),
        "{head}"
    );
    // Exactly one policy, which forbids scripts.
    assert_eq!(head.matches("content-security-policy").count(), 1, "{head}");
    assert!(
        head.contains("default-src 'none'") && head.contains("sandbox"),
        "{head}"
    );
    for path in [
        "/files/secret.txt",
        "/files/../secret.txt",
        "/files/..%2fsecret.txt",
        "/files/%2e%2e%2fsecret.txt",
        "/files/",
        "/files/splat.PLY",
        "/files/splats.ply",
    ] {
        let (head, body) = get(address, path);
        assert!(head.starts_with("http/1.1 404"), "{path}: {head}");
        assert_ne!(body, b"secret", "{path}");
    }
}

#[test]
fn reason_is_sent_if_a_file_cannot_be_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let (hub, server) = start();
    let path = write(folder.path(), "a", b"abc");
    publish_files(&hub, vec![served("splat.ply", Some("a.ply"), path.clone())]);
    std::fs::remove_file(path).expect("removed");
    let (head, body) = get(server.address(), "/files/splat.ply");
    assert!(head.starts_with("http/1.1 500"), "{head}");
    let reason = String::from_utf8_lossy(&body).into_owned();
    assert!(reason.contains("No such file"), "{reason}");
}

/// A file that is ready when the test says so.
fn slow_file(folder: &Path, ready: Receiver<()>) -> ServedFile {
    let path = write(folder, "slow", b"converted");
    let ready = Mutex::new(ready);
    ServedFile {
        open: Arc::new(move || {
            let ready = ready.lock().map_err(|error| error.to_string())?;
            ready.recv().map_err(|error| error.to_string())?;
            File::open(&path).map_err(|error| error.to_string())
        }),
        ..served("slow.spz", Some("slow.spz"), PathBuf::new())
    }
}

#[test]
fn clients_are_served_while_a_file_is_converted() {
    let folder = tempfile::tempdir().expect("a folder");
    let (hub, server) = start();
    let (make_ready, ready) = sync_channel(2);
    publish_files(&hub, vec![slow_file(folder.path(), ready)]);
    let address = server.address();
    let mut waiting = vec![
        request(address, "/files/slow.spz"),
        request(address, "/files/slow.spz"),
    ];
    let mut client = Client::connect(address);
    for t in 0..3 {
        client.send_json(&json!({"type": "ping", "t": t}));
        assert_eq!(client.text_of("pong")["t"], json!(f64::from(t)));
    }
    assert!(get(address, "/").0.starts_with("http/1.1 200"));
    // One conversion after the other, in any order.
    while !waiting.is_empty() {
        make_ready.send(()).expect("the server waits");
        let (head, body) = response(first_answered(&mut waiting));
        assert!(head.starts_with("http/1.1 200"), "{head}");
        assert_eq!(body, b"converted");
    }
}

/// Waits until one of the requests is answered, and removes it.
fn first_answered(requests: &mut Vec<TcpStream>) -> TcpStream {
    let started = Instant::now();
    loop {
        for ix in 0..requests.len() {
            let stream = &requests[ix];
            stream.set_nonblocking(true).expect("a socket");
            let is_answered = stream.peek(&mut [0]).is_ok_and(|n| n > 0);
            stream.set_nonblocking(false).expect("a socket");
            if is_answered {
                return requests.swap_remove(ix);
            }
        }
        assert!(started.elapsed() < TIMEOUT, "no answer");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn downloads_beyond_the_limit_are_refused_until_another_one_is_complete() {
    const LIMIT: usize = 8;
    let folder = tempfile::tempdir().expect("a folder");
    let (hub, server) = start();
    let (make_ready, ready) = sync_channel(LIMIT + 1);
    publish_files(&hub, vec![slow_file(folder.path(), ready)]);
    let mut waiting: Vec<TcpStream> = (0..=LIMIT)
        .map(|_| request(server.address(), "/files/slow.spz"))
        .collect();
    let (head, body) = response(first_answered(&mut waiting));
    assert!(head.starts_with("http/1.1 503"), "{head}");
    let reason = String::from_utf8_lossy(&body).into_owned();
    assert!(reason.contains("8 files are being downloaded"), "{reason}");
    for _ in 0..=LIMIT {
        make_ready.send(()).expect("the server waits");
    }
    for stream in waiting {
        assert_eq!(response(stream).1, b"converted");
    }
    // A place becomes free when the client has disconnected, which the server may notice later.
    let started = Instant::now();
    while !get(server.address(), "/files/slow.spz")
        .0
        .starts_with("http/1.1 200")
    {
        assert!(started.elapsed() < TIMEOUT, "no place became free");
    }
}
