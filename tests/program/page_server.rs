//! Serves the bundled page, and lets a test answer its WebSocket.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use test_support::browser::bundle;
use tungstenite::WebSocket;

/// A server whose threads end with the process or with their connections.
pub(crate) struct PageServer {
    address: SocketAddr,
}

impl PageServer {
    /// Serves the page. `talk` gets the WebSocket of each page.
    pub(crate) fn start(talk: impl Fn(WebSocket<TcpStream>) + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
        let address = listener.local_addr().expect("bound");
        let talk = Arc::new(talk);
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                let talk = Arc::clone(&talk);
                std::thread::spawn(move || match head_of(&stream) {
                    Some(head) if head.starts_with("GET /ws ") => {
                        talk(tungstenite::accept(stream).expect("a handshake"));
                    }
                    Some(head) => send_file(stream, &head),
                    None => {}
                });
            }
        });
        Self { address }
    }

    /// URL of the page.
    pub(crate) fn url(&self) -> String {
        format!("http://{}/", self.address)
    }
}

/// The head of a request, which remains to be read. `None` if the browser closes the connection
/// before it sends one.
fn head_of(stream: &TcpStream) -> Option<String> {
    let mut bytes = [0; 8192];
    loop {
        let n = stream.peek(&mut bytes).ok().filter(|n| *n > 0)?;
        let text = String::from_utf8_lossy(&bytes[..n]);
        if let Some((head, _)) = text.split_once("\r\n\r\n") {
            return Some(head.to_owned());
        }
    }
}

/// Answers a request with a file of the page. Only files of the bundle are known.
fn send_file(mut stream: TcpStream, head: &str) {
    let mut request = vec![0; head.len() + 4];
    stream.read_exact(&mut request).expect("it was peeked at");
    let path = head.split(' ').nth(1).unwrap_or_default();
    let (name, kind) = match path {
        "/" => ("index.html", "text/html"),
        "/app.js" => ("app.js", "text/javascript"),
        "/splat_worker.js" => ("splat_worker.js", "text/javascript"),
        "/mesh_loaders.js" => ("mesh_loaders.js", "text/javascript"),
        "/coverage.js" => ("coverage.js", "text/javascript"),
        "/study_page.js" => ("study_page.js", "text/javascript"),
        "/workspace_page.js" => ("workspace_page.js", "text/javascript"),
        "/steering.js" => ("steering.js", "text/javascript"),
        "/headset.js" => ("headset.js", "text/javascript"),
        "/app.css" => ("app.css", "text/css"),
        _ => ("", "text/plain"),
    };
    let (status, body) = match std::fs::read(bundle().join(name)) {
        Ok(body) => ("200 OK", body),
        Err(_) => ("404 Not Found", Vec::new()),
    };
    let n_bytes = body.len();
    let answer = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {n_bytes}\r\nConnection: close\r\n\r\n"
    );
    // Fails if the browser no longer wants the file.
    let _ = stream.write_all(&[answer.into_bytes(), body].concat());
}
