//! A client of `/ws` that asks for pictures and photographs, as an open page does.

use crate::viewer::split;
use crate::websocket::{self, BINARY, CLOSE, PING, PONG, TEXT};
use anyhow::{Context, Result, anyhow, bail, ensure};
use image::RgbImage;
use kinematics::{Transform, transform};
use parking_lot::{Condvar, Mutex};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum time until an answer. Without a GPU, a picture may take many seconds.
const MAX_ANSWER: Duration = Duration::from_secs(120);
const PROTOCOL_VERSION: u32 = 4;
/// Maximum length of a message: a list of keyframes, or a picture.
const MAX_BYTES: u64 = 64 << 20;

/// A keyframe in the list of the run.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ListedKeyframe {
    pub(super) id: u64,
    pub(super) world_from_camera: Transform,
    pub(super) lens: Lens,
}

/// Size and lens of a picture, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lens {
    pub(super) size_px: [u32; 2],
    pub(super) focal_px: [f64; 2],
    pub(super) principal_px: [f64; 2],
}

/// Messages from the server.
#[derive(Debug, Default)]
struct Received {
    keyframes: BTreeMap<u64, ListedKeyframe>,
    /// The newest complete picture or photograph, by the number of its request.
    images: BTreeMap<u64, RgbImage>,
    /// Requests that failed.
    failures: BTreeMap<u64, String>,
    n_keyframes_trained: u64,
    state: String,
    is_closed: bool,
}

#[derive(Debug, Default)]
struct Shared {
    received: Mutex<Received>,
    changed: Condvar,
}

/// A connected page. It disconnects when dropped.
pub(super) struct PageClient {
    stream: TcpStream,
    sender: Arc<Mutex<websocket::Sender>>,
    shared: Arc<Shared>,
    n_requests: u64,
}

impl Drop for PageClient {
    fn drop(&mut self) {
        // Fails if the server has closed the connection already.
        let _ = self.stream.shutdown(Shutdown::Both);
    }
}

impl PageClient {
    /// Connects to a run on this computer.
    ///
    /// # Errors
    ///
    /// If the server does not accept the connection.
    pub(super) fn connect(server: SocketAddr) -> Result<Self> {
        let stream =
            TcpStream::connect(server).with_context(|| format!("cannot connect to {server}"))?;
        let (receiver, mut sender) = websocket::open(&stream, server, "/ws")?;
        let hello = json!({
            "type": "hello",
            "protocols": [PROTOCOL_VERSION, PROTOCOL_VERSION],
            "capabilities": ["subscribe", "keyframe_changes", "keyframe_images", "parts"],
        });
        sender.send(TEXT, hello.to_string().as_bytes())?;
        for topic in ["live_images", "observations", "range_scans"] {
            let none = json!({ "type": "subscribe", "topic": topic, "rate_hz": 0 });
            sender.send(TEXT, none.to_string().as_bytes())?;
        }
        let sender = Arc::new(Mutex::new(sender));
        let shared = Arc::<Shared>::default();
        let reader = Reader {
            receiver,
            sender: Arc::clone(&sender),
            shared: Arc::clone(&shared),
            parts: Vec::new(),
        };
        std::thread::Builder::new()
            .name("page client".to_owned())
            .spawn(move || reader.run())
            .context("cannot start a thread")?;
        Ok(Self {
            stream,
            sender,
            shared,
            n_requests: 0,
        })
    }

    /// All keyframes of the run.
    pub(super) fn keyframes(&self) -> Vec<ListedKeyframe> {
        let received = self.shared.received.lock();
        received.keyframes.values().cloned().collect()
    }

    /// What the model draws at a pose.
    ///
    /// # Errors
    ///
    /// If there is no picture within two minutes.
    pub(super) fn picture(
        &mut self,
        world_from_camera: &Transform,
        lens: &Lens,
    ) -> Result<RgbImage> {
        let request = json!({
            "type": "render",
            "view": "steering",
            "world_from_camera": world_from_camera.to_homogeneous().transpose().as_slice(),
            "size_px": lens.size_px,
            "projection": {
                "kind": "pinhole",
                "focal_px": lens.focal_px,
                "principal_px": lens.principal_px,
            },
            "stages": [1],
            "outputs": ["color"],
        });
        self.image(request)
    }

    /// The photograph of a keyframe.
    ///
    /// # Errors
    ///
    /// If the run does not send it.
    pub(super) fn photograph(&mut self, keyframe: u64) -> Result<RgbImage> {
        self.image(json!({ "type": "keyframe_image", "keyframe": keyframe }))
    }

    fn image(&mut self, mut request: Value) -> Result<RgbImage> {
        let id = self.n_requests;
        self.n_requests += 1;
        request["id"] = id.into();
        self.sender
            .lock()
            .send(TEXT, request.to_string().as_bytes())?;
        let until = Instant::now() + MAX_ANSWER;
        let mut received = self.shared.received.lock();
        loop {
            if let Some(image) = received.images.remove(&id) {
                return Ok(image);
            }
            if let Some(reason) = received.failures.remove(&id) {
                bail!("the run sent no picture: {reason}");
            }
            let has_timed_out = self
                .shared
                .changed
                .wait_until(&mut received, until)
                .timed_out();
            if received.is_closed || has_timed_out {
                bail!("the run sent no picture within {} s", MAX_ANSWER.as_secs());
            }
        }
    }

    /// Waits until the model has been trained on a number of keyframes.
    ///
    /// # Errors
    ///
    /// If it is not within a time.
    pub(super) fn wait_for_keyframes(&self, n_keyframes: u64, time: Duration) -> Result<()> {
        let until = Instant::now() + time;
        let mut received = self.shared.received.lock();
        while received.n_keyframes_trained < n_keyframes {
            let has_timed_out = self
                .shared
                .changed
                .wait_until(&mut received, until)
                .timed_out();
            if received.is_closed || has_timed_out {
                bail!(
                    "the run has {} keyframes after {} s, expected {n_keyframes}; its state is {:?}",
                    received.n_keyframes_trained,
                    time.as_secs(),
                    received.state
                );
            }
        }
        Ok(())
    }
}

/// Receives messages until the connection ends.
struct Reader {
    receiver: websocket::Receiver,
    sender: Arc<Mutex<websocket::Sender>>,
    shared: Arc<Shared>,
    /// The parts received so far of a message that the server sends in parts.
    parts: Vec<u8>,
}

impl Reader {
    fn run(mut self) {
        if let Err(error) = self.receive() {
            log::debug!("the connection of a page ended: {error:#}");
        }
        self.shared.received.lock().is_closed = true;
        self.shared.changed.notify_all();
    }

    fn receive(&mut self) -> Result<()> {
        loop {
            let (opcode, n_bytes) = self.receiver.next_frame()?;
            ensure!(
                n_bytes <= MAX_BYTES,
                "a message of {n_bytes} bytes, expected at most {MAX_BYTES}"
            );
            match opcode {
                TEXT => {
                    let message = serde_json::from_slice(&self.receiver.contents(n_bytes)?)?;
                    self.take_text(&message)?;
                }
                BINARY => {
                    let message = self.receiver.contents(n_bytes)?;
                    self.take_binary(&message)?;
                }
                PING => {
                    let contents = self.receiver.contents(n_bytes)?;
                    self.sender.lock().send(PONG, &contents)?;
                }
                CLOSE => return Ok(()),
                _ => self.receiver.skip(n_bytes)?,
            }
        }
    }

    fn take_text(&self, message: &Value) -> Result<()> {
        let mut received = self.shared.received.lock();
        match message["type"].as_str() {
            Some("status") => {
                received.n_keyframes_trained = message["keyframes"].as_u64().unwrap_or_default();
                received.state = message["state"].as_str().unwrap_or_default().to_owned();
            }
            Some("keyframe_changes") => {
                if message["from_version"] == 0 {
                    received.keyframes.clear();
                }
                for listed in message["keyframes"].as_array().into_iter().flatten() {
                    let keyframe = listed_keyframe(listed)
                        .with_context(|| format!("a keyframe of the run: {listed}"))?;
                    received.keyframes.insert(keyframe.id, keyframe);
                }
                let removed = message["removed"].as_array().into_iter().flatten();
                for id in removed.filter_map(Value::as_u64) {
                    received.keyframes.remove(&id);
                }
            }
            Some("error") => {
                let text = message["message"].as_str().unwrap_or("an unknown error");
                if let Some(id) = message["id"].as_u64() {
                    received.failures.insert(id, text.to_owned());
                }
            }
            _ => {}
        }
        self.shared.changed.notify_all();
        Ok(())
    }

    fn take_binary(&mut self, message: &[u8]) -> Result<()> {
        let (header, payload) = split(message)?;
        if header["type"] != "part" {
            return self.take_image(&header, payload);
        }
        if header["offset"] == 0 {
            self.parts.clear();
        }
        self.parts.extend_from_slice(payload);
        if header["bytes"] == self.parts.len() {
            let joined = std::mem::take(&mut self.parts);
            let (header, payload) = split(&joined)?;
            self.take_image(&header, payload)?;
        }
        Ok(())
    }

    fn take_image(&self, header: &Value, payload: &[u8]) -> Result<()> {
        let is_wanted = header["type"] == "keyframe_image"
            || (header["type"] == "picture" && header["last"] == true);
        let Some(id) = header["id"].as_u64().filter(|_| is_wanted) else {
            return Ok(());
        };
        let index = |value: &Value| usize::try_from(value.as_u64()?).ok();
        let color = &header["color"];
        let jpeg = index(&color["offset"])
            .zip(index(&color["bytes"]))
            .and_then(|(offset, n)| payload.get(offset..)?.get(..n))
            .ok_or_else(|| anyhow!("a picture without color: {header}"))?;
        let decoded = image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg)
            .context("cannot decode a picture")?;
        let mut received = self.shared.received.lock();
        received.images.insert(id, decoded.into_rgb8());
        self.shared.changed.notify_all();
        Ok(())
    }
}

/// A keyframe of the list; `None` if a field is missing or not a number.
fn listed_keyframe(listed: &Value) -> Option<ListedKeyframe> {
    let numbers: Vec<f64> = listed["world_from_camera"]
        .as_array()?
        .iter()
        .filter_map(Value::as_f64)
        .collect();
    let pair = |name: &str| {
        let [a, b] = [0, 1].map(|ix| listed[name][ix].as_f64());
        Some([a?, b?])
    };
    let side = |ix: usize| u32::try_from(listed["size_px"][ix].as_u64()?).ok();
    Some(ListedKeyframe {
        id: listed["id"].as_u64()?,
        world_from_camera: transform_of(&numbers)?,
        lens: Lens {
            size_px: [side(0)?, side(1)?],
            focal_px: pair("focal_px")?,
            principal_px: pair("principal_px")?,
        },
    })
}

/// A pose from the 16 numbers of a matrix, row by row.
fn transform_of(numbers: &[f64]) -> Option<Transform> {
    transform::from_rows(numbers.try_into().ok()?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};

    #[test]
    fn poses_are_read_row_by_row() {
        let pose = Transform::from_parts(
            Translation3::new(0.1, -0.2, 0.3),
            UnitQuaternion::from_euler_angles(0.4, -0.5, 0.6),
        );
        let sent = pose.to_homogeneous().transpose();
        let read = transform_of(sent.as_slice()).expect("16 numbers");
        assert!((read.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-9);
        assert_eq!(transform_of(&[0.0; 15]), None);
    }
}
