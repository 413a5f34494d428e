//! A client of `/steer`, as an open page is.
//!
//! `docs/reference/protocol.md` describes the messages.

use super::link::{Link, LinkFault};
use crate::websocket::{self, CLOSE, PING, PONG, TEXT};
use anyhow::{Context, Result, bail};
use parking_lot::{Condvar, Mutex};
use serde_json::{Value, json};
use std::net::{Shutdown, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum time until an answer of the server, on a computer that is busy with other work.
const MAX_ANSWER: Duration = Duration::from_secs(60);
/// Number of pings from which the server's clock is estimated. The fastest one counts.
const N_PINGS: u64 = 10;

/// Messages from the server.
#[derive(Debug, Default)]
struct Received {
    /// The description of the arm.
    arm: Option<Value>,
    /// The newest state.
    state: Option<Value>,
    /// The newest answer to a ping.
    pong: Option<Value>,
    /// The newest preview.
    preview: Option<Value>,
    /// Why requests were refused.
    refusals: Vec<String>,
    /// Times from the sample of a device to the setpoint, milliseconds, by number of the sample.
    applied_millis: Vec<(u64, f64)>,
    is_closed: bool,
}

/// Data that the receiving thread shares with the client.
#[derive(Debug, Default)]
struct Shared {
    received: Mutex<Received>,
    changed: Condvar,
}

/// A connected client. It disconnects when dropped.
pub(super) struct SteeringClient {
    link: Link,
    sender: Arc<Mutex<websocket::Sender>>,
    shared: Arc<Shared>,
    number: u64,
    sequence: u64,
    /// The server's clock minus the time since `started`.
    clock_offset_micros: f64,
    /// Error of the stamps of the device.
    pub(super) clock_error: ClockError,
    started: Instant,
}

/// Error of the stamps of a device, microseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ClockError(pub(super) f64);

/// The state of the arm, as a client needs it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ClientState {
    /// The client that may move the arm.
    pub(super) holder: Option<u64>,
    /// Whom the holder has offered the lease.
    pub(super) offered_to: Option<u64>,
    /// Number of the newest stop, while the arm is stopped.
    pub(super) stop_number: Option<u64>,
    /// Position of the tip, meters.
    pub(super) tip_m: [f64; 3],
}

impl SteeringClient {
    /// Connects to a server.
    ///
    /// # Errors
    ///
    /// If the server does not accept the client, or the client may not steer.
    pub(super) fn connect(server: SocketAddr, seed: u64) -> Result<Self> {
        let link = Link::open(server, seed)?;
        let (receiver, sender) = websocket::open(link.stream(), server, "/steer")?;
        let sender = Arc::new(Mutex::new(sender));
        let shared = Arc::<Shared>::default();
        let started = Instant::now();
        let reader = Reader {
            receiver,
            sender: Arc::clone(&sender),
            shared: Arc::clone(&shared),
        };
        std::thread::Builder::new()
            .name("steering client".to_owned())
            .spawn(move || reader.run())
            .context("cannot start a thread")?;
        let mut client = Self {
            link,
            sender,
            shared,
            number: 0,
            sequence: 0,
            clock_offset_micros: 0.0,
            clock_error: ClockError::default(),
            started,
        };
        let arm = client.wait("the description of the arm", |received| {
            received.arm.clone()
        })?;
        client.number = arm["client"]
            .as_u64()
            .context("a client of /steer gets no number")?;
        client.synchronize()?;
        Ok(client)
    }

    /// The number that the server gave this client.
    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Sets the fault of the connection.
    pub(super) fn set_link(&self, fault: LinkFault) {
        self.link.set(fault);
    }

    /// Ends the connection, with or without the farewell of a page that is closed.
    pub(super) fn disconnect(&self, has_farewell: bool) {
        if has_farewell {
            // 1001: the page is left (RFC 6455, section 7.4.1). Fails if the server has left.
            let _ = self.sender.lock().send(CLOSE, &1001_u16.to_be_bytes());
        }
        // Fails if the connection has ended already.
        let _ = self.link.stream().shutdown(Shutdown::Both);
        // The receiving thread learns of it only later.
        self.shared.received.lock().is_closed = true;
    }

    /// Whether the connection has ended.
    pub(super) fn is_closed(&self) -> bool {
        self.shared.received.lock().is_closed
    }

    /// Asks for the lease, for example with `take`.
    pub(super) fn lease(&self, action: &str) -> Result<()> {
        self.send(&json!({ "type": "lease", "action": action }))
    }

    /// Offers the lease to another client.
    pub(super) fn offer_lease(&self, to: u64) -> Result<()> {
        self.send(&json!({ "type": "lease", "action": "offer", "to": to }))
    }

    /// Stops the arm.
    pub(super) fn stop(&self) -> Result<()> {
        self.send(&json!({ "type": "stop" }))
    }

    /// Permits motion again after a stop, see [`ClientState::stop_number`].
    pub(super) fn rearm(&self, stop_number: u64) -> Result<()> {
        self.send(&json!({ "type": "rearm", "stop": stop_number }))
    }

    /// A command with the next number and the current time.
    ///
    /// * `grip`: number of the grip; `None` while the dead-man switch is open.
    pub(super) fn command(&mut self, grip: Option<u64>, intent: &Value) -> Value {
        self.sequence += 1;
        json!({
            "type": "command",
            "device": 1,
            "sequence": self.sequence,
            "captured_micros": self.now_micros() + self.clock_error.0,
            "grip": grip,
            "intent": intent,
        })
    }

    /// Sends a message.
    ///
    /// # Errors
    ///
    /// If the connection has ended.
    pub(super) fn send(&self, message: &Value) -> Result<()> {
        self.send_text(&message.to_string())
    }

    /// Sends a text that need not be JSON.
    pub(super) fn send_text(&self, text: &str) -> Result<()> {
        self.sender.lock().send(TEXT, text.as_bytes())
    }

    /// The newest state; `None` before the first one.
    pub(super) fn state(&self) -> Option<ClientState> {
        client_state(self.shared.received.lock().state.as_ref()?)
    }

    /// The newest state with all its fields; `None` before the first one.
    pub(super) fn raw_state(&self) -> Option<Value> {
        self.shared.received.lock().state.clone()
    }

    /// Greatest round trip at which the arm follows without a preview.
    pub(super) fn servo_round_trip(&self) -> Duration {
        let received = self.shared.received.lock();
        let arm = received.arm.as_ref();
        let millis = arm.and_then(|arm| arm["servo_round_trip_millis"].as_f64());
        Duration::from_secs_f64(1e-3 * millis.unwrap_or_default().max(0.0))
    }

    /// Waits for the answer to a preview.
    ///
    /// # Errors
    ///
    /// If there is none within a minute.
    pub(super) fn wait_for_preview(&self, id: u64) -> Result<Value> {
        self.wait("an answer to a preview", |received| {
            received
                .preview
                .clone()
                .filter(|preview| preview["id"] == id)
        })
    }

    /// Waits for a state.
    ///
    /// # Errors
    ///
    /// If there is none within a minute.
    pub(super) fn wait_for_state(
        &self,
        what: &str,
        is_awaited: impl Fn(&ClientState) -> bool,
    ) -> Result<ClientState> {
        self.wait(what, |received| {
            client_state(received.state.as_ref()?).filter(&is_awaited)
        })
    }

    /// Forgets earlier refusals and times.
    pub(super) fn forget(&self) {
        let mut received = self.shared.received.lock();
        received.refusals.clear();
        received.applied_millis.clear();
    }

    /// Why requests were refused since the last call of [`Self::forget`].
    pub(super) fn refusals(&self) -> Vec<String> {
        self.shared.received.lock().refusals.clone()
    }

    /// Times from the sample of a device to the setpoint, milliseconds, since the last call of
    /// [`Self::forget`].
    pub(super) fn applied_millis(&self) -> Vec<f64> {
        let received = self.shared.received.lock();
        let applied = received.applied_millis.iter();
        applied.map(|(_, millis)| *millis).collect()
    }

    /// Estimates the clock of the server.
    fn synchronize(&mut self) -> Result<()> {
        let mut fastest = Duration::MAX;
        for id in 0..N_PINGS {
            let sent = self.started.elapsed();
            self.send(&json!({ "type": "ping", "id": id }))?;
            let pong = self.wait("an answer to a ping", |received| {
                received.pong.clone().filter(|pong| pong["id"] == id)
            })?;
            let returned = self.started.elapsed();
            let time_micros = pong["time_micros"]
                .as_f64()
                .context("an answer to a ping has no time")?;
            let round_trip = returned - sent;
            if round_trip < fastest {
                fastest = round_trip;
                let middle_micros = (sent + round_trip / 2).as_secs_f64() * 1e6;
                self.clock_offset_micros = time_micros - middle_micros;
            }
        }
        Ok(())
    }

    /// The server's clock.
    fn now_micros(&self) -> f64 {
        self.clock_offset_micros + self.started.elapsed().as_secs_f64() * 1e6
    }

    fn wait<T>(&self, what: &str, find: impl Fn(&Received) -> Option<T>) -> Result<T> {
        let until = Instant::now() + MAX_ANSWER;
        let mut received = self.shared.received.lock();
        loop {
            if let Some(found) = find(&received) {
                return Ok(found);
            }
            if received.is_closed {
                bail!("the server closed the connection before {what}");
            }
            let has_timed_out = self
                .shared
                .changed
                .wait_until(&mut received, until)
                .timed_out();
            if has_timed_out {
                let refusals = received.refusals.join("; ");
                bail!(
                    "the server did not send {what} within {} s; refused: {refusals:?}",
                    MAX_ANSWER.as_secs()
                );
            }
        }
    }
}

fn client_state(state: &Value) -> Option<ClientState> {
    let pose = state["base_from_tip"].as_array()?;
    let tip_m = [0, 1, 2].map(|ix| pose.get(ix).and_then(Value::as_f64));
    Some(ClientState {
        holder: state["holder"].as_u64(),
        offered_to: state["offered_to"].as_u64(),
        stop_number: state["stop_number"].as_u64(),
        tip_m: [tip_m[0]?, tip_m[1]?, tip_m[2]?],
    })
}

/// Receives messages until the connection ends.
struct Reader {
    receiver: websocket::Receiver,
    sender: Arc<Mutex<websocket::Sender>>,
    shared: Arc<Shared>,
}

impl Reader {
    fn run(mut self) {
        if let Err(error) = self.receive() {
            log::debug!("a steering client's connection ended: {error:#}");
        }
        self.shared.received.lock().is_closed = true;
        self.shared.changed.notify_all();
    }

    fn receive(&mut self) -> Result<()> {
        loop {
            let (opcode, n_bytes) = self.receiver.next_frame()?;
            match opcode {
                TEXT => {
                    let contents = self.receiver.contents(n_bytes)?;
                    self.take(serde_json::from_slice(&contents)?);
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

    fn take(&self, message: Value) {
        let mut received = self.shared.received.lock();
        match message["type"].as_str() {
            Some("arm") => received.arm = Some(message),
            Some("pong") => received.pong = Some(message),
            Some("preview") => received.preview = Some(message),
            Some("refused") => {
                let text = message["text"].as_str().unwrap_or_default().to_owned();
                received.refusals.push(text);
            }
            Some("state") => {
                if let Some((sequence, millis)) = applied(&message)
                    && received.applied_millis.last().map(|last| last.0) != Some(sequence)
                {
                    received.applied_millis.push((sequence, millis));
                }
                received.state = Some(message);
            }
            _ => {}
        }
        self.shared.changed.notify_all();
    }
}

/// The number of the sample that the arm follows, and the time from the sample to the setpoint,
/// milliseconds.
fn applied(state: &Value) -> Option<(u64, f64)> {
    let applied = &state["applied"];
    let time = |key: &str| applied[key].as_f64();
    let micros = time("applied_micros")? - time("captured_micros")?;
    Some((applied["sequence"].as_u64()?, micros * 1e-3))
}
