//! A viewer for benches. It is a WebSocket client that requests images back to back and discards
//! them.
//!
//! The viewer uses the capabilities that the web page uses for pictures, and runs in the measured
//! process. To affect the measurement little, it decodes only the first picture with each new
//! keyframe. It then reports that it has shown this picture.

use crate::websocket::{self, BINARY, CLOSE, PING, PONG, TEXT};
use anyhow::{Context, Result, anyhow, ensure};
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use parking_lot::Mutex;
use serde_json::{Value, json};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Angle between two views on the circle around the scene, radians. The view changes with every
/// request, as when an operator moves it, so that no picture can be reused.
const STEP_RAD: f64 = 0.05;
/// Read timeout of the connection. The server sends its status several times per second, but on a
/// CPU, a training step or a picture may take many seconds.
const MAX_SILENCE: Duration = Duration::from_secs(120);
/// Time after the connection during which the server may have no picture yet.
const MAX_START: Duration = Duration::from_secs(2);
/// Maximum length of a text message. The longest text message is the list of keyframes.
const MAX_TEXT_BYTES: u64 = 16 << 20;
/// Maximum length of a binary message. The longest binary message is a panorama.
const MAX_BINARY_BYTES: u64 = 256 << 20;

/// Protocol version of this client.
const PROTOCOL_VERSION: u32 = 4;

/// What a viewer requests.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewerOptions {
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Whether the viewer requests panoramas instead of pinhole views from outside. A panorama
    /// shows all directions around a point in the scene (equirectangular).
    pub is_panorama: bool,
    /// Minimum time between two requests. If it is zero, each request follows the previous picture
    /// at once.
    pub period: Duration,
}

impl Default for ViewerOptions {
    fn default() -> Self {
        Self {
            size_px: [960, 720],
            is_panorama: false,
            period: Duration::ZERO,
        }
    }
}

/// Times of a complete picture, as measured by its viewer and the server.
#[derive(Clone, Copy, Debug)]
pub struct ReceivedPicture {
    /// Time of the request.
    pub requested: Instant,
    /// Time at which the first stage was received.
    pub first_stage: Instant,
    /// Time at which the last stage was received.
    pub complete: Instant,
    /// Time from the arrival of the request at the server to the start of rendering the last stage,
    /// milliseconds.
    pub waited_millis: f64,
    /// Time for rendering the last stage, milliseconds.
    pub render_millis: f64,
    /// Time for encoding the last stage, milliseconds.
    pub encode_millis: f64,
    /// Number of keyframes, since the start of the run, that the model had been trained on.
    pub n_keyframes: u64,
}

/// A connected viewer. It disconnects when dropped.
#[derive(Debug)]
pub struct Viewer {
    stream: TcpStream,
    pictures: Arc<Mutex<Vec<ReceivedPicture>>>,
    thread: Option<JoinHandle<Result<()>>>,
}

impl Viewer {
    /// Connects to a server on this machine and starts to request images.
    ///
    /// # Errors
    ///
    /// Fails if the server does not accept the connection.
    pub fn connect(address: SocketAddr, options: ViewerOptions) -> Result<Self> {
        let stream =
            TcpStream::connect(address).with_context(|| format!("cannot connect to {address}"))?;
        stream
            .set_read_timeout(Some(MAX_SILENCE))
            .context("cannot set a timeout")?;
        let (receiver, sender) = websocket::open(&stream, address, "/ws")?;
        let pictures = Arc::default();
        let client = Client {
            receiver,
            sender,
            options,
            pictures: Arc::clone(&pictures),
            started: Instant::now(),
            n_requested: 0,
            requested: Instant::now(),
            first_stage: None,
            center_m: Point3::origin(),
            radius_m: 1.0,
            parts: Vec::new(),
            server_started: None,
            n_keyframes: 0,
        };
        let thread = std::thread::Builder::new()
            .name("viewer".into())
            .spawn(move || client.run());
        Ok(Self {
            stream,
            pictures,
            thread: Some(thread.context("cannot start a thread")?),
        })
    }

    /// Number of complete pictures received so far.
    #[must_use]
    pub fn n_pictures(&self) -> u64 {
        self.pictures.lock().len() as u64
    }

    /// The complete pictures received so far.
    #[must_use]
    pub fn pictures(&self) -> Vec<ReceivedPicture> {
        self.pictures.lock().clone()
    }

    /// Whether the viewer is still connected.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.thread
            .as_ref()
            .is_some_and(|thread| !thread.is_finished())
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        // Fails if the server has already closed the connection.
        let _ = self.stream.shutdown(Shutdown::Both);
        if let Some(Ok(Err(error))) = self.thread.take().map(JoinHandle::join) {
            log::debug!("a viewer's connection ended: {error:#}");
        }
    }
}

struct Client {
    receiver: websocket::Receiver,
    sender: websocket::Sender,
    options: ViewerOptions,
    pictures: Arc<Mutex<Vec<ReceivedPicture>>>,
    started: Instant,
    n_requested: u64,
    /// Time at which the current picture was requested.
    requested: Instant,
    /// Time at which its first stage was received.
    first_stage: Option<Instant>,
    /// Center of the scene in world.
    center_m: Point3<f64>,
    radius_m: f64,
    /// The parts received so far of a message that the server sends in parts.
    parts: Vec<u8>,
    /// Estimated time at which the server's clock started. The estimate is too late by at most the
    /// delay of one message.
    server_started: Option<Instant>,
    /// Largest number of keyframes in a picture so far.
    n_keyframes: u64,
}

impl Client {
    fn run(mut self) -> Result<()> {
        let hello = json!({
            "type": "hello",
            "protocols": [PROTOCOL_VERSION, PROTOCOL_VERSION],
            "capabilities": ["subscribe", "compact_depth", "keyframe_changes", "parts", "shown"],
        });
        self.sender.send(TEXT, hello.to_string().as_bytes())?;
        self.request_picture()?;
        loop {
            let (opcode, n_bytes) = self.receiver.next_frame()?;
            match opcode {
                TEXT => self.handle_text(n_bytes)?,
                BINARY => self.handle_binary(n_bytes)?,
                PING => {
                    // A ping has at most 125 bytes (RFC 6455, section 5.5). Without the answer, the
                    // server closes the connection.
                    let contents = self.receiver.contents(n_bytes.min(125))?;
                    self.sender.send(PONG, &contents)?;
                }
                CLOSE => return Ok(()),
                _ => self.receiver.skip(n_bytes)?,
            }
        }
    }

    fn handle_text(&mut self, n_bytes: u64) -> Result<()> {
        ensure!(
            n_bytes <= MAX_TEXT_BYTES,
            "a text message of {n_bytes} bytes, expected at most {MAX_TEXT_BYTES}"
        );
        let message: Value = serde_json::from_slice(&self.receiver.contents(n_bytes)?)?;
        if let Some(clock) = message["clock_millis"]
            .as_f64()
            .and_then(|n| Duration::try_from_secs_f64(n * 1e-3).ok())
        {
            // The delay of a message makes its estimate too late. The earliest estimate therefore
            // has the smallest error.
            let started = Instant::now().checked_sub(clock);
            self.server_started = self.server_started.into_iter().chain(started).min();
        }
        match message["type"].as_str() {
            Some("scene") => {
                let center = &message["center_m"];
                self.center_m = Point3::new(
                    scene_number(&center[0])?,
                    scene_number(&center[1])?,
                    scene_number(&center[2])?,
                );
                self.radius_m = scene_number(&message["radius_m"])?;
            }
            // At first, the server cannot draw a picture yet.
            Some("error") => {
                let message = message["message"].as_str().unwrap_or("an unknown error");
                if !self.pictures.lock().is_empty() || self.started.elapsed() > MAX_START {
                    log::warn!("a viewer received no picture: {message}");
                }
                // An immediate request would get the same error.
                std::thread::sleep(Duration::from_millis(200));
                self.request_picture()?;
            }
            _ => {}
        }
        Ok(())
    }

    fn handle_binary(&mut self, n_bytes: u64) -> Result<()> {
        ensure!(
            n_bytes <= MAX_BINARY_BYTES,
            "a binary message of {n_bytes} bytes, expected at most {MAX_BINARY_BYTES}"
        );
        let message = self.receiver.contents(n_bytes)?;
        let (header, payload) = split(&message)?;
        if header["type"] != "part" {
            return self.handle_picture(&header, payload);
        }
        // The server sends large messages in parts, so that other messages do not wait for them.
        // The parts of one message arrive in order.
        if header["offset"] == 0 {
            self.parts.clear();
        }
        self.parts.extend_from_slice(payload);
        if header["bytes"] == self.parts.len() {
            let joined = std::mem::take(&mut self.parts);
            let (header, payload) = split(&joined)?;
            self.handle_picture(&header, payload)?;
        }
        Ok(())
    }

    fn handle_picture(&mut self, header: &Value, payload: &[u8]) -> Result<()> {
        // A picture of an earlier request may still arrive after an error.
        if header["type"] != "picture" || header["id"] != self.n_requested.saturating_sub(1) {
            return Ok(());
        }
        let now = Instant::now();
        let first_stage = *self.first_stage.get_or_insert(now);
        if header["last"] == true {
            let millis = |name: &str| header[name].as_f64().unwrap_or_default();
            let n_keyframes = header["keyframes"].as_u64().unwrap_or_default();
            self.pictures.lock().push(ReceivedPicture {
                requested: self.requested,
                first_stage,
                complete: now,
                waited_millis: millis("waited_millis"),
                render_millis: millis("render_millis"),
                encode_millis: millis("encode_millis"),
                n_keyframes,
            });
            // Only the first picture with a new keyframe is decoded, so that decoding takes little
            // time from the measured run.
            if n_keyframes > self.n_keyframes {
                self.n_keyframes = n_keyframes;
                self.show(header, payload)?;
            }
            std::thread::sleep(self.options.period.saturating_sub(self.requested.elapsed()));
            self.request_picture()?;
        }
        Ok(())
    }

    /// Decodes a picture and reports that it is shown.
    fn show(&mut self, header: &Value, payload: &[u8]) -> Result<()> {
        let color = &header["color"];
        let jpeg = index(&color["offset"])
            .zip(index(&color["bytes"]))
            .and_then(|(offset, n)| payload.get(offset..)?.get(..n));
        let jpeg = jpeg.ok_or_else(|| anyhow!("a picture without color: {header}"))?;
        image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg)
            .map_err(|error| anyhow!("cannot decode a picture: {error}"))?;
        let Some(started) = self.server_started else {
            return Ok(());
        };
        let shown_millis = started.elapsed().as_secs_f64() * 1e3;
        let shown = json!({ "type": "shown", "id": header["id"], "shown_millis": shown_millis });
        self.sender.send(TEXT, shown.to_string().as_bytes())
    }

    /// Requests the next image on a circle around the scene.
    fn request_picture(&mut self) -> Result<()> {
        let angle = self.n_requested as f64 * STEP_RAD;
        let is_panorama = self.options.is_panorama;
        // A panorama is taken near the center, and a pinhole view is taken from outside and above.
        let distance_m = if is_panorama { 0.2 } else { 1.5 } * self.radius_m;
        let offset = Vector3::new(angle.cos(), angle.sin(), 0.7) * distance_m;
        // The y axis of `face_towards` points up, but the y axis of a camera points down.
        let world_from_camera =
            Transform::face_towards(&(self.center_m + offset), &self.center_m, &-Vector3::z());
        let projection = if is_panorama {
            json!({ "kind": "equirectangular" })
        } else {
            json!({ "kind": "pinhole", "vertical_fov_rad": 0.9 })
        };
        let request = json!({
            "type": "render",
            "id": self.n_requested,
            "world_from_camera": world_from_camera.to_homogeneous().transpose().as_slice(),
            "size_px": self.options.size_px,
            "projection": projection,
            "outputs": ["color", "depth"],
            "depth_format": "compact_half",
        });
        self.n_requested += 1;
        self.requested = Instant::now();
        self.first_stage = None;
        self.sender.send(TEXT, request.to_string().as_bytes())
    }
}

/// A number of a message about the scene.
fn scene_number(value: &Value) -> Result<f64> {
    value
        .as_f64()
        .ok_or_else(|| anyhow!("a scene message lacks a number"))
}

/// An index or a length. `None` if it is not a whole number that this computer can address.
fn index(value: &Value) -> Option<usize> {
    usize::try_from(value.as_u64()?).ok()
}

/// Header and payload of a binary message.
pub(crate) fn split(message: &[u8]) -> Result<(Value, &[u8])> {
    let header = message.split_first_chunk().and_then(|(length, rest)| {
        rest.split_at_checked(usize::try_from(u32::from_le_bytes(*length)).ok()?)
    });
    let (header, payload) = header
        .ok_or_else(|| anyhow!("a binary message of {} bytes without header", message.len()))?;
    Ok((serde_json::from_slice(header)?, payload))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};
    use trainer::Picture;
    use viz::{Hub, NewestKeyframe, Server, ServerConfig, TrainedKeyframes};

    #[test]
    fn viewer_receives_pictures_and_disconnects() {
        let hub = Hub::new();
        let listen = "127.0.0.1:0".parse().expect("an address");
        let server = Server::start(ServerConfig { listen }, hub.clone()).expect("a free port");
        let viewer = Viewer::connect(server.address(), ViewerOptions::default()).expect("served");
        let started = Instant::now();
        let mut n_drawn = 0;
        while viewer.n_pictures() < 3 {
            assert!(
                viewer.is_connected() && started.elapsed() < Duration::from_secs(60),
                "{}",
                viewer.n_pictures()
            );
            let Some(pending) = hub.pictures().next_request() else {
                std::thread::sleep(Duration::from_millis(1));
                continue;
            };
            if n_drawn == 0 {
                // The viewer repeats the request.
                pending.fail("no image yet");
            } else {
                let size_px = pending.request.size_px;
                let n = (size_px[0] * size_px[1]) as usize;
                let now = Instant::now();
                let newest = NewestKeyframe {
                    captured_at: now,
                    added_at: now,
                };
                let pending = pending.of_keyframes(TrainedKeyframes {
                    n: n_drawn,
                    newest: Some(newest),
                });
                pending.deliver(Picture {
                    size_px,
                    rgba_srgb: vec![128; 4 * n],
                    depth_m: vec![1.0; n],
                });
            }
            n_drawn += 1;
        }
        let mut shown = Vec::new();
        while shown.len() < 3 {
            assert!(started.elapsed() < Duration::from_secs(60), "{shown:?}");
            shown.append(&mut hub.pictures().take_shown());
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(
            shown[1..]
                .iter()
                .all(|picture| !picture.new_keyframes.is_empty()),
            "{shown:?}"
        );
        // The viewer's estimate of the server's clock is wrong by less than a round trip, which is
        // long on a busy computer.
        let elapsed_secs = started.elapsed().as_secs_f64();
        let decoding_secs: Vec<f64> = shown
            .iter()
            .map(|picture| secs_between(picture.sent_at, picture.shown_at))
            .collect();
        assert!(
            decoding_secs.iter().all(|secs| secs.abs() < elapsed_secs),
            "{decoding_secs:?} of {elapsed_secs} s"
        );
        assert!(
            decoding_secs.iter().any(|secs| *secs != 0.0),
            "{decoding_secs:?}"
        );
        assert!(
            n_drawn >= 4,
            "one failed request and three images, with one stage each if the server renders fast"
        );
        drop(viewer);
        while hub.n_clients() > 0 {
            assert!(started.elapsed() < Duration::from_secs(60));
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Seconds from `from` to `to`. The result is negative if `to` is earlier.
    fn secs_between(from: Instant, to: Instant) -> f64 {
        to.duration_since(from).as_secs_f64() - from.duration_since(to).as_secs_f64()
    }

    #[test]
    fn connecting_to_a_non_websocket_server_fails() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("bound");
        let other = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().expect("a client");
            let mut request = Vec::new();
            while !request.ends_with(b"\r\n\r\n") {
                let mut part = [0; 4096];
                let n_read = stream.read(&mut part).expect("a request");
                assert!(n_read > 0);
                request.extend(&part[..n_read]);
            }
            stream
                .write_all(b"HTTP/1.1 404 Not Found\r\n\r\n")
                .expect("sent");
        });
        let error_message = Viewer::connect(address, ViewerOptions::default())
            .expect_err("no WebSocket")
            .to_string();
        assert!(error_message.contains("404"), "{error_message}");
        other.join().expect("no panic");
    }
}
