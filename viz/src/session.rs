//! The session of one client, from hello to goodbye: a reader and a writer that never wait for each other.

use crate::Hub;
use crate::admission::Connection;
use crate::broadcast::{LatestMessages, Received};
use crate::clock::ServerClock;
use crate::picture::{PackError, pack_picture};
use crate::protocol::{ClientMessage, PROTOCOL_VERSION, ServerMessage};
use crate::queue::Outgoing;
use crate::view_request::{DEFAULT_STAGES, InvalidRequest, MAX_SIZE_PX, ViewRequest};
use axum::extract::ws::{Message, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde::Deserialize;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::MissedTickBehavior;

/// Period of heartbeats; short enough for pages to detect silence quickly.
const HEARTBEAT_PERIOD: Duration = Duration::from_millis(250);
/// Period of WebSocket pings. The next one is sent only if the last one was answered.
const PING_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of unread replies. A client with more unread replies is disconnected.
const MAX_REPLIES: usize = 64;
/// Pictures take precedence over live images and keyframe lists, but delay them by at most this time.
const MAX_UPDATE_DELAY: Duration = Duration::from_millis(500);

/// Shared by all sessions.
#[derive(Clone)]
pub(crate) struct ServerContext {
    /// Takes requests and returns pictures.
    pub(crate) hub: Hub,
    /// The server's clock.
    pub(crate) clock: ServerClock,
    /// The latest encoded messages.
    pub(crate) latest_messages: watch::Receiver<LatestMessages>,
    /// Becomes true when the server stops.
    pub(crate) stopped: watch::Receiver<bool>,
}

/// Serves one client until either side disconnects.
pub(crate) async fn serve(socket: WebSocket, connection: Arc<Connection>, server_context: ServerContext) {
    let (client, wake) = server_context.hub.join();
    let client_guard = ClientGuard { hub: &server_context.hub, client };
    log::info!("client {client} connected");
    let (sink, stream) = socket.split();
    let (replies, waiting_replies) = mpsc::channel(MAX_REPLIES);
    let reader = Reader { stream, hub: &server_context.hub, client, connection: &connection, replies };
    let writer = Writer { sink, server_context: &server_context, client, connection: &connection };
    tokio::select! {
        () = reader.run() => {}
        _ = writer.run(&wake, waiting_replies) => {}
    }
    drop(client_guard);
    log::info!("client {client} disconnected");
}

/// Removes a client from the hub when its session ends, for whatever reason.
struct ClientGuard<'a> {
    hub: &'a Hub,
    client: u64,
}

impl Drop for ClientGuard<'_> {
    fn drop(&mut self) {
        self.hub.leave(self.client);
    }
}

/// A message that the reader asks the writer to send.
enum Reply {
    Error { id: Option<u64>, message: String },
    Pong { t: f64 },
    Goodbye { reason: String },
}

struct Reader<'a> {
    stream: SplitStream<WebSocket>,
    hub: &'a Hub,
    client: u64,
    connection: &'a Connection,
    replies: mpsc::Sender<Reply>,
}

impl Reader<'_> {
    /// Reads until the client disconnects or violates the protocol.
    async fn run(mut self) {
        while let Some(Ok(message)) = self.stream.next().await {
            let reply = match message {
                Message::Pong(_) => {
                    self.connection.record_pong();
                    continue;
                }
                Message::Ping(_) => continue,
                Message::Close(_) => return,
                Message::Text(text) => self.answer(&text),
                Message::Binary(_) => Some(Reply::Error {
                    id: None,
                    message: "binary messages are not supported, send JSON as text".to_owned(),
                }),
            };
            self.connection.last_message();
            let Some(reply) = reply else { continue };
            let is_last = matches!(reply, Reply::Goodbye { .. });
            if self.replies.try_send(reply).is_err() {
                log::info!("client {} disconnected: it left {MAX_REPLIES} replies unread", self.client);
                return;
            }
            if is_last {
                // The writer ends the session.
                std::future::pending::<()>().await;
            }
        }
    }

    fn answer(&self, text: &str) -> Option<Reply> {
        match parse_message(text) {
            Ok(ParsedMessage::Order(view_request)) => {
                self.hub.view_request(self.client, *view_request);
                None
            }
            Ok(ParsedMessage::SameVersion) => None,
            Ok(ParsedMessage::OtherVersion(client_version)) => Some(Reply::Goodbye {
                reason: format!(
                    "the client uses protocol version {client_version}, this server version {PROTOCOL_VERSION}"
                ),
            }),
            Ok(ParsedMessage::Ping { t }) => Some(Reply::Pong { t }),
            Ok(ParsedMessage::Goodbye) => Some(Reply::Goodbye { reason: "the client disconnected".to_owned() }),
            Err(error) => Some(Reply::Error { id: id_of(text), message: error.to_string() }),
        }
    }
}

/// Control flow of a session: continue or end.
type SessionFlow = ControlFlow<()>;

struct Writer<'a> {
    sink: SplitSink<WebSocket, Message>,
    server_context: &'a ServerContext,
    client: u64,
    connection: &'a Connection,
}

/// A picture being encoded.
struct EncodingTask {
    id: u64,
    task: JoinHandle<Result<Vec<u8>, PackError>>,
}

impl Writer<'_> {
    /// Sends until the connection fails or a goodbye is sent. Pictures take precedence over other messages.
    async fn run(mut self, wake: &tokio::sync::Notify, mut replies: mpsc::Receiver<Reply>) -> SessionFlow {
        let mut stopped = self.server_context.stopped.clone();
        let mut latest_messages = self.server_context.latest_messages.clone();
        let mut received = Received::default();
        let mut long_update_sent = Instant::now();
        let mut encoding: Option<EncodingTask> = None;
        let mut heartbeat = tokio::time::interval(HEARTBEAT_PERIOD);
        let mut ping = tokio::time::interval(PING_PERIOD);
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
        self.send_hello().await?;
        loop {
            if encoding.is_none()
                && let Some(outgoing) = self.server_context.hub.collect(self.client)
            {
                match outgoing {
                    Outgoing::Picture(rendered) => encoding = Some(pack(rendered)),
                    Outgoing::Failed { id, reason } => {
                        let sent = self.send_error(Some(id), &reason).await;
                        self.server_context.hub.release(self.client);
                        sent?;
                        continue;
                    }
                }
            }
            let allows_long_updates = encoding.is_none() || long_update_sent.elapsed() > MAX_UPDATE_DELAY;
            tokio::select! {
                biased;
                _ = stopped.changed() => return self.send_goodbye_when_stopped().await,
                Some(reply) = replies.recv() => self.reply(reply).await?,
                packed = finished(&mut encoding) => {
                    let id = encoding.take().map(|encoding| encoding.id);
                    let sent = self.send_picture(id, packed).await;
                    self.server_context.hub.release(self.client);
                    sent?;
                }
                () = wake.notified(), if encoding.is_none() => {}
                _ = heartbeat.tick() => {
                    let clock_millis = self.server_context.clock.now_millis();
                    self.send_message(&ServerMessage::Heartbeat { clock_millis }).await?;
                }
                _ = ping.tick() => if self.connection.start_ping() {
                    self.send(Message::Ping(Default::default())).await?;
                },
                message = next_update(&mut latest_messages, &mut received, allows_long_updates) => {
                    if allows_long_updates {
                        long_update_sent = Instant::now();
                    }
                    self.send(message).await?;
                }
            }
        }
    }

    async fn send_hello(&mut self) -> SessionFlow {
        let hello = ServerMessage::Hello {
            protocol: PROTOCOL_VERSION,
            server: concat!("fieldrig ", env!("CARGO_PKG_VERSION")),
            client: self.client,
            max_size_px: [MAX_SIZE_PX; 2],
            default_stages: &DEFAULT_STAGES,
            clock_millis: self.server_context.clock.now_millis(),
        };
        self.send_message(&hello).await
    }

    async fn reply(&mut self, reply: Reply) -> SessionFlow {
        match reply {
            Reply::Error { id, message } => self.send_error(id, &message).await,
            Reply::Pong { t } => {
                let clock_millis = self.server_context.clock.now_millis();
                self.send_message(&ServerMessage::Pong { t, clock_millis }).await
            }
            Reply::Goodbye { reason } => self.send_goodbye(&reason).await,
        }
    }

    async fn send_picture(&mut self, id: Option<u64>, packed: EncodingResult) -> SessionFlow {
        match packed {
            Ok(Ok(bytes)) => self.send(Message::binary(bytes)).await,
            Ok(Err(error)) => self.send_error(id, &error.to_string()).await,
            Err(error) => self.send_error(id, &error.to_string()).await,
        }
    }

    /// Sends the last status, which contains the result of the run, then a goodbye.
    async fn send_goodbye_when_stopped(&mut self) -> SessionFlow {
        let latest = self.server_context.hub.status().borrow().clone();
        if let Some(status) = latest {
            self.send_message(&ServerMessage::Status(&status)).await?;
        }
        self.send_goodbye("the server has stopped").await
    }

    async fn send_error(&mut self, id: Option<u64>, message: &str) -> SessionFlow {
        self.send_message(&ServerMessage::Error { id, message }).await
    }

    async fn send_goodbye(&mut self, reason: &str) -> SessionFlow {
        self.send_message(&ServerMessage::Goodbye { reason }).await?;
        self.send(Message::Close(None)).await?;
        ControlFlow::Break(())
    }

    async fn send_message(&mut self, message: &ServerMessage<'_>) -> SessionFlow {
        self.send(Message::text(message.to_json())).await
    }

    async fn send(&mut self, message: Message) -> SessionFlow {
        match self.sink.send(message).await {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                log::debug!("client {}: {error}", self.client);
                ControlFlow::Break(())
            }
        }
    }
}

/// An encoded picture, or the reason why there is none.
type EncodingResult = Result<Result<Vec<u8>, PackError>, JoinError>;

fn pack(rendered: Box<(crate::queue::RenderJob, crate::protocol::PictureHeader, trainer::Rendered)>) -> EncodingTask {
    let id = rendered.0.view_request.id;
    let task = tokio::task::spawn_blocking(move || {
        let (job, header, picture) = *rendered;
        pack_picture(&job.view_request, header, &picture)
    });
    EncodingTask { id, task }
}

/// Waits until the current picture is encoded. Without one, waits forever.
async fn finished(encoding: &mut Option<EncodingTask>) -> EncodingResult {
    match encoding {
        Some(encoding) => (&mut encoding.task).await,
        None => std::future::pending().await,
    }
}

/// Waits for a message that the client has not received yet.
async fn next_update(
    latest_messages: &mut watch::Receiver<LatestMessages>,
    received: &mut Received,
    long: bool,
) -> Message {
    loop {
        if let Some(message) = latest_messages.borrow_and_update().next(received, long) {
            return message;
        }
        if latest_messages.changed().await.is_err() {
            // The server is about to stop.
            std::future::pending::<()>().await;
        }
    }
}

/// A parsed client message.
enum ParsedMessage {
    SameVersion,
    OtherVersion(u32),
    Order(Box<ViewRequest>),
    Ping { t: f64 },
    Goodbye,
}

fn parse_message(text: &str) -> Result<ParsedMessage, InvalidRequest> {
    Ok(match serde_json::from_str(text)? {
        ClientMessage::Hello(hello) if hello.protocol == PROTOCOL_VERSION => ParsedMessage::SameVersion,
        ClientMessage::Hello(hello) => ParsedMessage::OtherVersion(hello.protocol),
        ClientMessage::Render(message) => ParsedMessage::Order(Box::new(ViewRequest::check(&message)?)),
        ClientMessage::Ping(ping) => ParsedMessage::Ping { t: ping.t },
        ClientMessage::Goodbye(_) => ParsedMessage::Goodbye,
    })
}

/// The id in a message that is otherwise invalid, so that the sender can identify it.
fn id_of(text: &str) -> Option<u64> {
    #[derive(Deserialize)]
    struct Numbered {
        id: u64,
    }
    serde_json::from_str::<Numbered>(text).ok().map(|message| message.id)
}
