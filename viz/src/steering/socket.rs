//! Serves one client of `/steer`: a reader and a writer that never wait for each other.

use crate::server::access::Role;
use crate::server::admission::Connection;
use crate::server::server_context::ServerContext;
use crate::steering::client_message::{ClientRequest, MessageContext, Refusal, read_message};
use crate::steering::message_rate::{Counted, MessageRate, flood_text};
use crate::steering::outbox::Reply;
use crate::steering::request::{RefusedRequest, SteeringRequest};
use crate::steering::server_message::SteeringMessage;
use crate::steering::steering_server::{Published, SteeringServer, steering_ended};
use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Notify;
use tokio::time::MissedTickBehavior;

/// Minimum time between two states, unless the lease, the stop or a limit has changed. Screens do not
/// show more, and slow connections do not carry more.
const STATE_PERIOD: Duration = Duration::from_nanos(33_333_333);
/// Period of WebSocket pings.
const PING_PERIOD: Duration = Duration::from_secs(1);
/// Size of the kernel's send buffer, bytes: a few states. More of them would be outdated when they
/// arrive.
const SEND_BUFFER_BYTES: usize = 8 * 1024;
/// Number of messages after which other clients get their turn. A client that floods must not keep
/// the thread.
const MESSAGES_PER_TURN: u32 = 16;
/// Time for the client to close the connection after the server has given its reason.
const LINGER: Duration = Duration::from_millis(300);
/// Range of the silence after which a client releases the lease.
const MIN_SILENCE_SECS: f64 = 0.05;
const MAX_SILENCE_SECS: f64 = 3600.0;

/// A connected client.
pub(crate) struct SteeringSocket {
    pub(crate) socket: WebSocket,
    pub(crate) connection: Arc<Connection>,
    pub(crate) role: Role,
    pub(crate) server: Arc<SteeringServer>,
    pub(crate) context: ServerContext,
}

impl SteeringSocket {
    /// Serves the client until either side disconnects.
    pub(crate) async fn serve(self) {
        let Self {
            socket,
            connection,
            role,
            server,
            context,
        } = self;
        // From here on, this thread receives the bytes, without the thread of the server.
        connection.change_thread();
        connection.set_send_buffer(SEND_BUFFER_BYTES);
        let client = context.hub.pictures().reserve_number();
        let wake = server.join(client, role);
        // From here on, the guard removes the client even if this task is dropped.
        let guard = ClientGuard {
            server: &server,
            client,
        };
        context.log.line(format_args!(
            "client {client} connected to the arm as {}",
            role.name()
        ));
        let (sink, stream) = socket.split();
        let reader = Reader {
            stream,
            server: &server,
            client,
            connection: &connection,
            context: &context,
            message_context: MessageContext {
                role,
                clock: context.clock,
                n_joints: server.description().joints.len(),
            },
            rate: MessageRate::new(Instant::now()),
        };
        let writer = Writer {
            sink,
            server: &server,
            client,
            role,
            connection: &connection,
            context: &context,
            sent: None,
        };
        let mut reading = std::pin::pin!(reader.run());
        tokio::select! {
            () = &mut reading => {}
            _ = writer.run(&wake) => {
                // The client has the reason, or cannot be reached.
                let _ = tokio::time::timeout(LINGER, reading).await;
            }
            () = connection.closed() => {}
        }
        drop(guard);
        context
            .log
            .line(format_args!("client {client} disconnected from the arm"));
    }
}

/// Removes a client when it is no longer served, for whatever reason.
struct ClientGuard<'a> {
    server: &'a SteeringServer,
    client: u64,
}

impl Drop for ClientGuard<'_> {
    fn drop(&mut self) {
        self.server.leave(self.client);
    }
}

struct Reader<'a> {
    stream: SplitStream<WebSocket>,
    server: &'a SteeringServer,
    client: u64,
    connection: &'a Connection,
    context: &'a ServerContext,
    message_context: MessageContext,
    rate: MessageRate,
}

impl Reader<'_> {
    /// Reads until the client disconnects or violates the WebSocket protocol.
    async fn run(mut self) {
        let lease_secs = self.server.description().lease_secs;
        let silence_secs = if lease_secs.is_nan() {
            MIN_SILENCE_SECS
        } else {
            lease_secs.clamp(MIN_SILENCE_SECS, MAX_SILENCE_SECS)
        };
        let silence = Duration::from_secs_f64(silence_secs);
        let mut heard_at = Instant::now();
        let mut is_silent = false;
        let mut n_read: u32 = 0;
        loop {
            let message = if is_silent {
                self.stream.next().await
            } else {
                let next = tokio::time::timeout_at((heard_at + silence).into(), self.stream.next());
                let Ok(message) = next.await else {
                    // The client may still watch, so its connection stays open.
                    is_silent = true;
                    self.server.silence(self.client);
                    continue;
                };
                message
            };
            let Some(Ok(message)) = message else { return };
            match message {
                Message::Close(_) => return,
                // Browsers answer pings even if the page hangs, so a pong does not end a silence.
                Message::Pong(_) => self.connection.record_pong(),
                Message::Ping(_) => {}
                Message::Text(text) => {
                    (heard_at, is_silent) = (Instant::now(), false);
                    self.connection.record_message();
                    self.handle(&text, heard_at);
                }
                Message::Binary(_) => {
                    if self.rate.count(Instant::now()) == Counted::Within {
                        let text = "binary messages are not supported, send JSON as text";
                        self.refuse(RefusedRequest::Message, text.to_owned());
                    }
                }
            }
            n_read = n_read.wrapping_add(1);
            if n_read.is_multiple_of(MESSAGES_PER_TURN) {
                tokio::task::yield_now().await;
            }
        }
    }

    fn handle(&mut self, text: &str, received_at: Instant) {
        let counted = self.rate.count(received_at);
        let read = read_message(text, received_at, self.message_context);
        if counted != Counted::Within && !read.as_ref().is_ok_and(ends_motion) {
            if counted == Counted::FirstBeyond {
                self.refuse(RefusedRequest::Message, flood_text());
            }
            return;
        }
        match read {
            Ok(ClientRequest::Steering(request)) => self.request(received_at, request),
            Ok(ClientRequest::Ping { id }) => {
                self.server.reply(self.client, Reply::Pong { id });
            }
            Err(Refusal { request, text }) => self.refuse(request, text),
        }
    }

    fn request(&self, received_at: Instant, request: SteeringRequest) {
        let kind = kind_of(&request);
        if let Some(action) = logged_action(&request) {
            self.context
                .log
                .line(format_args!("client {} {action}", self.client));
        }
        if let Err(error) = self.server.request(self.client, received_at, request) {
            self.refuse(kind, error.to_string());
        }
    }

    fn refuse(&self, request: RefusedRequest, text: String) {
        self.server.refuse(self.client, request, text);
    }
}

/// Whether a request is obeyed also during a flood, because it can only end motion.
fn ends_motion(request: &ClientRequest) -> bool {
    match request {
        ClientRequest::Steering(SteeringRequest::Stop | SteeringRequest::ReleaseLease) => true,
        ClientRequest::Steering(SteeringRequest::Command(command)) => command.grip.is_none(),
        _ => false,
    }
}

fn kind_of(request: &SteeringRequest) -> RefusedRequest {
    match request {
        SteeringRequest::TakeLease
        | SteeringRequest::RenewLease
        | SteeringRequest::ReleaseLease
        | SteeringRequest::OfferLease { .. }
        | SteeringRequest::Disconnected => RefusedRequest::Lease,
        SteeringRequest::Stop => RefusedRequest::Stop,
        SteeringRequest::Rearm { .. } => RefusedRequest::Rearm,
        SteeringRequest::Command(_) => RefusedRequest::Command,
        SteeringRequest::Preview(_) => RefusedRequest::Preview,
        SteeringRequest::View { .. } => RefusedRequest::Message,
    }
}

/// What the log says about a request that a person made.
fn logged_action(request: &SteeringRequest) -> Option<&'static str> {
    match request {
        SteeringRequest::TakeLease => Some("asks for control of the arm"),
        SteeringRequest::ReleaseLease => Some("gives control of the arm back"),
        SteeringRequest::OfferLease { .. } => Some("offers control of the arm"),
        SteeringRequest::Stop => Some("stops the arm"),
        SteeringRequest::Rearm { .. } => Some("permits the arm to move"),
        SteeringRequest::RenewLease
        | SteeringRequest::Command(_)
        | SteeringRequest::Preview(_)
        | SteeringRequest::View { .. }
        | SteeringRequest::Disconnected => None,
    }
}

/// Whether to continue to serve the client.
type ClientFlow = ControlFlow<()>;

struct Writer<'a> {
    sink: SplitSink<WebSocket, Message>,
    server: &'a Arc<SteeringServer>,
    client: u64,
    role: Role,
    connection: &'a Connection,
    context: &'a ServerContext,
    /// The last state.
    sent: Option<SentState>,
}

#[derive(Clone, Copy)]
struct SentState {
    at: Instant,
    n_urgent: u64,
}

impl Writer<'_> {
    /// Sends until the connection fails, the server stops or the arm is no longer steered.
    async fn run(mut self, wake: &Notify) -> ClientFlow {
        let mut stopped = self.context.stopped.clone();
        let mut ended = std::pin::pin!(steering_ended(&self.context.hub, self.server));
        let mut published = self.server.published();
        // A state from before the connection is sent like a new one.
        published.mark_changed();
        let mut unsent: Option<Published> = None;
        let mut reply = None;
        let mut ping = tokio::time::interval(PING_PERIOD);
        // Sending missed pings all at once would be useless.
        ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
        self.send_arm().await?;
        loop {
            let due = unsent.as_ref().and_then(|unsent| self.state_due(unsent));
            reply = reply.or_else(|| self.server.take_reply(self.client));
            tokio::select! {
                // The branches are checked in this order. All of them can be dropped while they
                // wait, so nothing is lost if another branch is chosen.
                biased;
                _ = stopped.changed() => {
                    return self.close(close_code::AWAY, "the server stops").await;
                }
                () = &mut ended => {
                    return self.close(close_code::NORMAL, "the arm is no longer steered").await;
                }
                _ = published.changed() => {
                    // A newer state replaces one that has not been sent.
                    unsent = Some(published.borrow_and_update().clone());
                }
                () = sleep_until(due) => if let Some(newest) = unsent.take() {
                    self.send_state(&newest).await?;
                },
                () = std::future::ready(()), if reply.is_some() => {
                    if let Some(reply) = reply.take() {
                        self.send_reply(&reply).await?;
                    }
                }
                _ = ping.tick() => if self.connection.start_ping() {
                    self.send(Message::Ping(Default::default())).await?;
                },
                () = wake.notified(), if reply.is_none() => {}
            }
        }
    }

    /// When to send a state; `None` if there is none yet.
    fn state_due(&self, unsent: &Published) -> Option<Instant> {
        unsent.state.as_ref()?;
        Some(match self.sent {
            Some(sent) if sent.n_urgent == unsent.n_urgent => sent.at + STATE_PERIOD,
            _ => Instant::now(),
        })
    }

    async fn send_arm(&mut self) -> ClientFlow {
        let arm = SteeringMessage::Arm {
            client: self.client,
            may_steer: self.role == Role::Operator,
            description: self.server.description(),
        };
        self.send(arm.to_message()).await
    }

    async fn send_state(&mut self, published: &Published) -> ClientFlow {
        let Some(state) = &published.state else {
            return ControlFlow::Continue(());
        };
        self.sent = Some(SentState {
            at: Instant::now(),
            n_urgent: published.n_urgent,
        });
        let message = SteeringMessage::state(state, &published.clients, self.context.clock);
        self.send(message.to_message()).await
    }

    async fn send_reply(&mut self, reply: &Reply) -> ClientFlow {
        let message = match reply {
            Reply::Refused { request, text } => SteeringMessage::Refused {
                request: *request,
                text,
            },
            Reply::Preview { id, preview } => SteeringMessage::Preview { id: *id, preview },
            // The clock is read when the reply is sent, which may have waited.
            Reply::Pong { id } => SteeringMessage::pong(*id, self.context.clock),
        };
        self.send(message.to_message()).await
    }

    async fn close(&mut self, code: u16, reason: &'static str) -> ClientFlow {
        let frame = CloseFrame {
            code,
            reason: reason.into(),
        };
        self.send(Message::Close(Some(frame))).await
    }

    async fn send(&mut self, message: Message) -> ClientFlow {
        match self.sink.send(message).await {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        }
    }
}

/// Waits until a time; forever if there is none.
async fn sleep_until(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time.into()).await,
        None => std::future::pending().await,
    }
}
