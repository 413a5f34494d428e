//! One connected client, from hello to goodbye: a reader and a writer that never wait for each other.

use crate::Hub;
use crate::admission::Connection;
use crate::broadcast::{Bulletin, Received};
use crate::clock::ServerClock;
use crate::picture::{Unsendable, pack_picture};
use crate::protocol::{ClientMessage, PROTOCOL_VERSION, ServerMessage};
use crate::queue::Outgoing;
use crate::render_order::{DEFAULT_STAGES, MAX_SIZE_PX, Malformed, RenderOrder};
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

/// Period of heartbeats, short enough that a page notices silence soon.
const HEARTBEAT_PERIOD: Duration = Duration::from_millis(250);
/// Period of WebSocket pings; the next one is sent only if the last one was answered.
const PING_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of answers that wait for a client to read; a client that requests more is disconnected.
const MAX_REPLIES: usize = 64;
/// Pictures are sent before live images and keyframe lists, but delay them by at most this long.
const MAX_NEWS_DELAY: Duration = Duration::from_millis(500);

/// Shared by all sessions.
#[derive(Clone)]
pub(crate) struct Site {
    /// Takes requests and returns pictures.
    pub(crate) hub: Hub,
    /// The server's clock.
    pub(crate) clock: ServerClock,
    /// The latest encoded messages.
    pub(crate) bulletin: watch::Receiver<Bulletin>,
    /// Becomes true when the server stops.
    pub(crate) stopped: watch::Receiver<bool>,
}

/// Talks with one client until either side leaves.
pub(crate) async fn serve(socket: WebSocket, connection: Arc<Connection>, site: Site) {
    let (client, wake) = site.hub.join();
    let membership = Membership { hub: &site.hub, client };
    log::info!("client {client} connected");
    let (sink, stream) = socket.split();
    let (replies, waiting_replies) = mpsc::channel(MAX_REPLIES);
    let reader = Reader { stream, hub: &site.hub, client, connection: &connection, replies };
    let writer = Writer { sink, site: &site, client, connection: &connection };
    tokio::select! {
        () = reader.run() => {}
        _ = writer.run(&wake, waiting_replies) => {}
    }
    drop(membership);
    log::info!("client {client} left");
}

/// Takes a client out of the hub however its session ends.
struct Membership<'a> {
    hub: &'a Hub,
    client: u64,
}

impl Drop for Membership<'_> {
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
                    self.connection.answered_ping();
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
            self.connection.spoke();
            let Some(reply) = reply else { continue };
            let is_last = matches!(reply, Reply::Goodbye { .. });
            if self.replies.try_send(reply).is_err() {
                log::info!("client {} is disconnected: it left {MAX_REPLIES} answers unread", self.client);
                return;
            }
            if is_last {
                // The writer ends the session.
                std::future::pending::<()>().await;
            }
        }
    }

    fn answer(&self, text: &str) -> Option<Reply> {
        match understand(text) {
            Ok(Understood::Order(order)) => {
                self.hub.order(self.client, *order);
                None
            }
            Ok(Understood::SameVersion) => None,
            Ok(Understood::OtherVersion(theirs)) => Some(Reply::Goodbye {
                reason: format!("the client speaks protocol {theirs}, this server {PROTOCOL_VERSION}"),
            }),
            Ok(Understood::Ping { t }) => Some(Reply::Pong { t }),
            Ok(Understood::Goodbye) => Some(Reply::Goodbye { reason: "the client disconnected".to_owned() }),
            Err(error) => Some(Reply::Error { id: id_of(text), message: error.to_string() }),
        }
    }
}

/// Whether the session goes on.
type Going = ControlFlow<()>;

struct Writer<'a> {
    sink: SplitSink<WebSocket, Message>,
    site: &'a Site,
    client: u64,
    connection: &'a Connection,
}

/// A picture that is being encoded.
struct Packing {
    id: u64,
    task: JoinHandle<Result<Vec<u8>, Unsendable>>,
}

impl Writer<'_> {
    /// Sends until the connection fails or a goodbye is sent; pictures go before other messages.
    async fn run(mut self, wake: &tokio::sync::Notify, mut replies: mpsc::Receiver<Reply>) -> Going {
        let mut stopped = self.site.stopped.clone();
        let mut bulletin = self.site.bulletin.clone();
        let mut received = Received::default();
        let mut long_news_sent = Instant::now();
        let mut packing: Option<Packing> = None;
        let mut heartbeat = tokio::time::interval(HEARTBEAT_PERIOD);
        let mut ping = tokio::time::interval(PING_PERIOD);
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
        self.greet().await?;
        loop {
            if packing.is_none()
                && let Some(outgoing) = self.site.hub.collect(self.client)
            {
                match outgoing {
                    Outgoing::Picture(drawn) => packing = Some(pack(drawn)),
                    Outgoing::Failed { id, reason } => {
                        let sent = self.complain(Some(id), &reason).await;
                        self.site.hub.settle(self.client);
                        sent?;
                        continue;
                    }
                }
            }
            let lets_long_news = packing.is_none() || long_news_sent.elapsed() > MAX_NEWS_DELAY;
            tokio::select! {
                biased;
                _ = stopped.changed() => return self.part_when_stopped().await,
                Some(reply) = replies.recv() => self.reply(reply).await?,
                packed = finished(&mut packing) => {
                    let id = packing.take().map(|packing| packing.id);
                    let sent = self.send_picture(id, packed).await;
                    self.site.hub.settle(self.client);
                    sent?;
                }
                () = wake.notified(), if packing.is_none() => {}
                _ = heartbeat.tick() => {
                    let clock_millis = self.site.clock.now_millis();
                    self.say(&ServerMessage::Heartbeat { clock_millis }).await?;
                }
                _ = ping.tick() => if self.connection.take_ping() {
                    self.send(Message::Ping(Default::default())).await?;
                },
                message = next_news(&mut bulletin, &mut received, lets_long_news) => {
                    if lets_long_news {
                        long_news_sent = Instant::now();
                    }
                    self.send(message).await?;
                }
            }
        }
    }

    async fn greet(&mut self) -> Going {
        let hello = ServerMessage::Hello {
            protocol: PROTOCOL_VERSION,
            server: concat!("fieldrig ", env!("CARGO_PKG_VERSION")),
            client: self.client,
            max_size_px: [MAX_SIZE_PX; 2],
            default_stages: &DEFAULT_STAGES,
            clock_millis: self.site.clock.now_millis(),
        };
        self.say(&hello).await
    }

    async fn reply(&mut self, reply: Reply) -> Going {
        match reply {
            Reply::Error { id, message } => self.complain(id, &message).await,
            Reply::Pong { t } => {
                let clock_millis = self.site.clock.now_millis();
                self.say(&ServerMessage::Pong { t, clock_millis }).await
            }
            Reply::Goodbye { reason } => self.part(&reason).await,
        }
    }

    async fn send_picture(&mut self, id: Option<u64>, packed: Packed) -> Going {
        match packed {
            Ok(Ok(bytes)) => self.send(Message::binary(bytes)).await,
            Ok(Err(error)) => self.complain(id, &error.to_string()).await,
            Err(error) => self.complain(id, &error.to_string()).await,
        }
    }

    /// Sends the last status, which holds the result of the run, then a goodbye.
    async fn part_when_stopped(&mut self) -> Going {
        let latest = self.site.hub.status().borrow().clone();
        if let Some(status) = latest {
            self.say(&ServerMessage::Status(&status)).await?;
        }
        self.part("the server has stopped").await
    }

    async fn complain(&mut self, id: Option<u64>, message: &str) -> Going {
        self.say(&ServerMessage::Error { id, message }).await
    }

    async fn part(&mut self, reason: &str) -> Going {
        self.say(&ServerMessage::Goodbye { reason }).await?;
        self.send(Message::Close(None)).await?;
        ControlFlow::Break(())
    }

    async fn say(&mut self, message: &ServerMessage<'_>) -> Going {
        self.send(Message::text(message.to_json())).await
    }

    async fn send(&mut self, message: Message) -> Going {
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
type Packed = Result<Result<Vec<u8>, Unsendable>, JoinError>;

fn pack(drawn: Box<(crate::queue::Ticket, crate::protocol::PictureHeader, trainer::Picture)>) -> Packing {
    let id = drawn.0.order.id;
    let task = tokio::task::spawn_blocking(move || {
        let (ticket, header, picture) = *drawn;
        pack_picture(&ticket.order, header, &picture)
    });
    Packing { id, task }
}

/// Waits for the picture that is being encoded; forever if there is none.
async fn finished(packing: &mut Option<Packing>) -> Packed {
    match packing {
        Some(packing) => (&mut packing.task).await,
        None => std::future::pending().await,
    }
}

/// Waits for a message that the client has not received yet.
async fn next_news(bulletin: &mut watch::Receiver<Bulletin>, received: &mut Received, long: bool) -> Message {
    loop {
        if let Some(message) = bulletin.borrow_and_update().next(received, long) {
            return message;
        }
        if bulletin.changed().await.is_err() {
            // The server is about to stop.
            std::future::pending::<()>().await;
        }
    }
}

/// What a client's text means.
enum Understood {
    SameVersion,
    OtherVersion(u32),
    Order(Box<RenderOrder>),
    Ping { t: f64 },
    Goodbye,
}

fn understand(text: &str) -> Result<Understood, Malformed> {
    Ok(match serde_json::from_str(text)? {
        ClientMessage::Hello(hello) if hello.protocol == PROTOCOL_VERSION => Understood::SameVersion,
        ClientMessage::Hello(hello) => Understood::OtherVersion(hello.protocol),
        ClientMessage::Render(message) => Understood::Order(Box::new(RenderOrder::check(&message)?)),
        ClientMessage::Ping(ping) => Understood::Ping { t: ping.t },
        ClientMessage::Goodbye(_) => Understood::Goodbye,
    })
}

/// The number of a message that is otherwise wrong, so that its sender knows which one it was.
fn id_of(text: &str) -> Option<u64> {
    #[derive(Deserialize)]
    struct Numbered {
        id: u64,
    }
    serde_json::from_str::<Numbered>(text).ok().map(|message| message.id)
}
