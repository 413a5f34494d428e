//! Sends data to one client, the most urgent first.
//!
//! Long messages are sent in parts if the client can join them, so that urgent messages wait for at
//! most one part. The parts and the kernel's buffer are so small that their transfer takes less
//! than 100 ms. All other data waits in this process, where newer data replaces older data.

use crate::client::keyframe_image::{KeyframeImageError, KeyframeImageRequest, encode_photograph};
use crate::client::link_rate::LinkRate;
use crate::client::negotiation::{Agreement, Negotiated, capabilities};
use crate::client::protocol::{BASE_PROTOCOL_VERSION, PROTOCOL_VERSION};
use crate::client::server_message::{BinaryHeader, PartHeader, ServerMessage, frame};
use crate::demands::Demand;
use crate::pictures::compact_depth::Effort;
use crate::pictures::picture::{PackError, PackedPicture, pack_picture};
use crate::pictures::picture_requests::PictureRequests;
use crate::pictures::picture_times::SentPicture;
use crate::pictures::queue::{DrawnPicture, Outgoing};
use crate::pictures::view_request::{DEFAULT_STAGES, MAX_SIZE_PX};
use crate::server::access::Role;
use crate::server::admission::Connection;
use crate::server::server_context::ServerContext;
use crate::topics::client_updates::{ClientUpdates, NextUpdate};
use crate::topics::robot_description::RobotStateMessage;
use crate::topics::robot_state::RobotDescriptionTopic;
use crate::topics::shared_topic::SharedTopic;
use axum::body::Bytes;
use axum::extract::ws::{Message, WebSocket};
use futures_util::SinkExt;
use futures_util::stream::SplitSink;
use keyframe::RobotState;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{Notify, mpsc, watch};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::MissedTickBehavior;

/// Period of heartbeats. It is short enough for pages to detect silence quickly. The page shows a
/// problem after 0.8 s without a message, so two heartbeats may be late.
const HEARTBEAT_PERIOD: Duration = Duration::from_millis(250);
/// Period of WebSocket pings. The next one is sent only if the last one was answered.
const PING_PERIOD: Duration = Duration::from_secs(1);
/// Pictures take precedence over live images and keyframe lists, but delay them by at most this
/// time. With a longer time, camera images look stuck while the operator moves the view, which
/// requests pictures back to back.
const MAX_UPDATE_DELAY: Duration = Duration::from_millis(500);
/// A client with the capability `heartbeat` that has been silent for longer than this gets no
/// pictures, images and robot states, because they would be outdated when the connection works
/// again. The page sends a message every 500 ms, so the limit is four of its periods.
const MAX_SILENCE: Duration = Duration::from_secs(2);

/// A message that the reader asks the writer to send.
pub(crate) enum Reply {
    Welcome(Agreement),
    Error {
        id: Option<u64>,
        message: String,
    },
    Pong {
        t: f64,
    },
    /// There is no immediate reply. The photograph is sent when it is encoded.
    KeyframeImage(KeyframeImageRequest),
    Goodbye {
        reason: String,
    },
}

/// Whether to continue to serve the client.
pub(crate) type ClientFlow = ControlFlow<()>;

/// Sends to one client.
pub(crate) struct Writer<'a> {
    pub(crate) sink: SplitSink<WebSocket, Message>,
    pub(crate) server_context: &'a ServerContext,
    pub(crate) client: u64,
    pub(crate) role: Role,
    pub(crate) connection: &'a Connection,
    pub(crate) negotiated: Negotiated,
    pub(crate) link: LinkRate,
    /// When the last part was sent.
    pub(crate) part_sent: Instant,
    /// The photograph that is being encoded, or waits until it can be sent.
    pub(crate) photograph: Option<PhotographTask>,
}

/// A picture being encoded.
struct EncodingTask {
    id: u64,
    view: Arc<str>,
    task: JoinHandle<Result<PackedPicture, PackError>>,
}

/// A photograph of a keyframe that is being encoded: at most one per client.
pub(crate) struct PhotographTask {
    request: KeyframeImageRequest,
    task: JoinHandle<Result<Vec<u8>, KeyframeImageError>>,
}

impl Drop for PhotographTask {
    /// Removes the photograph request of a disconnected client from the queue. Otherwise, a client
    /// that connects again and again could fill the queue.
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// A binary message that is being sent in parts.
struct Transfer {
    number: u64,
    bytes: Bytes,
    n_sent: usize,
    is_picture: bool,
}

/// The binary message that is being sent, and how many there were.
#[derive(Default)]
struct Transfers {
    current: Option<Transfer>,
    n_started: u64,
}

impl Transfers {
    /// Begins to send a message.
    fn start(&mut self, bytes: Bytes, is_picture: bool) {
        // Parts carry the number, so that a client does not join parts of different messages.
        self.n_started += 1;
        self.current = Some(Transfer {
            number: self.n_started,
            bytes,
            n_sent: 0,
            is_picture,
        });
    }
}

/// The binary message with a photograph, or the reason why there is none.
type PhotographResult = Result<Result<Vec<u8>, KeyframeImageError>, JoinError>;

/// An encoded picture, or the reason why there is none.
type EncodingResult = Result<Result<PackedPicture, PackError>, JoinError>;

impl Writer<'_> {
    /// Sends until the connection fails or a goodbye is sent.
    ///
    /// Order: replies, robot states, heartbeats, short updates, pictures, live images and keyframes
    /// in turn.
    pub(crate) async fn run(
        mut self,
        wake: &Notify,
        mut replies: mpsc::Receiver<Reply>,
        mut demand: watch::Receiver<Demand>,
    ) -> ClientFlow {
        let mut stopped = self.server_context.stopped.clone();
        let mut published = self.server_context.publisher.changed();
        let mut robot_state = self
            .server_context
            .hub
            .latest::<Option<Arc<RobotState>>>()
            .subscribe();
        // A robot state from before the connection is sent like a new one.
        robot_state.mark_changed();
        let mut robot_state_sent: Option<Instant> = None;
        let mut updates = ClientUpdates::new(&self.server_context.topics);
        let mut long_update_sent = Instant::now();
        // The next message of the topics, and whether it is long.
        let mut waiting_update: Option<(Message, bool)> = None;
        let mut encoding: Option<EncodingTask> = None;
        let mut transfers = Transfers::default();
        let mut heartbeat = tokio::time::interval(HEARTBEAT_PERIOD);
        let mut ping = tokio::time::interval(PING_PERIOD);
        // If the client reads slowly, ticks are missed. Sending the missed heartbeats all at once
        // would be useless.
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
        self.send_hello().await?;
        loop {
            // A client without heartbeats may be silent for any time.
            let is_heard =
                !self.negotiated.has_heartbeat || self.connection.silence() <= MAX_SILENCE;
            // One picture is encoded while the one before it is sent. If more pictures were encoded
            // in advance, they would be outdated when they are sent.
            if encoding.is_none()
                && is_heard
                && let Some(outgoing) = self.pictures().collect(self.client)
            {
                encoding = self.begin(outgoing).await?;
                if encoding.is_none() {
                    // The result was an error, which has been sent. There may be more results.
                    continue;
                }
            }
            // The client may have subscribed, or moved its view, since the last round.
            let (subscriptions, settles_at) = {
                let demand = demand.borrow_and_update();
                updates.viewpoint = demand.viewpoint;
                (
                    Arc::clone(&demand.subscriptions),
                    demand.settles_at(Instant::now()),
                )
            };
            let mut update_due = settles_at;
            // Long messages wait until the client has said which ones it wants, and until nothing
            // else is being sent. A picture that is being encoded comes first, but only for a
            // limited time, because on a slow machine there is always such a picture.
            let allows_long = is_heard
                && settles_at.is_none()
                && transfers.current.is_none()
                && (encoding.is_none() || long_update_sent.elapsed() > MAX_UPDATE_DELAY);
            if waiting_update.is_none() {
                // The mark is cleared before the topics are checked, so that a message that is
                // published in between wakes up the loop again.
                published.mark_unchanged();
                let has_changes = self.negotiated.has_keyframe_changes;
                match updates.next(&subscriptions, has_changes, Instant::now(), allows_long) {
                    NextUpdate::Short(message) => waiting_update = Some((message, false)),
                    NextUpdate::Long(message) => waiting_update = Some((message, true)),
                    NextUpdate::WaitUntil(time) => {
                        update_due = Some(update_due.map_or(time, |due| due.min(time)))
                    }
                    NextUpdate::Wait => {}
                }
            }
            let is_waiting_long = waiting_update.as_ref().map(|(_, is_long)| *is_long);
            // States need the description of the robot, and a waiting short message may be a new
            // one.
            let state_period = subscriptions.period(RobotDescriptionTopic::NAME);
            let state_due = state_period
                .filter(|_| {
                    is_heard
                        && updates.has_sent(RobotDescriptionTopic::NAME)
                        && is_waiting_long != Some(false)
                })
                .map(|period| {
                    robot_state_sent
                        .and_then(|sent| sent.checked_add(period))
                        .unwrap_or_else(Instant::now)
                });
            let is_sending = transfers.current.is_some();
            tokio::select! {
                // The branches are checked in this order, because each branch is more urgent than
                // the next. All of them can be dropped while they wait, so nothing is lost if
                // another branch is chosen.
                biased;
                _ = stopped.changed() => return self.send_goodbye_when_stopped().await,
                Some(reply) = replies.recv() => self.reply(reply).await?,
                () = changed_after(&mut robot_state, state_due) => {
                    robot_state_sent = state_due.zip(state_period).map(on_schedule);
                    let state = robot_state.borrow_and_update().clone();
                    if let Some(state) = state {
                        let message = RobotStateMessage::new(&state, self.server_context.clock);
                        self.send_message(&ServerMessage::RobotState(message)).await?;
                    }
                }
                _ = heartbeat.tick() => {
                    let clock_millis = self.server_context.clock.now_millis();
                    self.send_message(&ServerMessage::Heartbeat { clock_millis }).await?;
                }
                _ = ping.tick() => if self.connection.start_ping() {
                    self.send(Message::Ping(Default::default())).await?;
                },
                () = std::future::ready(()), if is_waiting_long == Some(false) => {
                    if let Some((message, _)) = waiting_update.take() {
                        self.send(message).await?;
                    }
                }
                () = std::future::ready(()), if is_sending && is_heard => {
                    if let Some(mut current) = transfers.current.take() {
                        // One part is sent. Then all branches above are checked again.
                        let sent = self.send_part(&mut current).await;
                        let is_complete = current.n_sent == current.bytes.len();
                        // The run may now render the next picture for this client.
                        if current.is_picture && (is_complete || sent.is_break()) {
                            self.pictures().release(self.client);
                        }
                        sent?;
                        transfers.current = (!is_complete).then_some(current);
                    }
                }
                () = std::future::ready(()), if is_waiting_long == Some(true) && !is_sending => {
                    long_update_sent = Instant::now();
                    match waiting_update.take() {
                        Some((Message::Binary(bytes), _)) => transfers.start(bytes, false),
                        // Texts have no parts. Long lists come in several messages instead.
                        Some((message, _)) => self.send(message).await?,
                        None => {}
                    }
                }
                // A photograph comes before pictures, because the client waits for it and pictures
                // follow each other without a pause.
                encoded = encoded_photograph(&mut self.photograph), if !is_sending && is_heard => {
                    self.send_photograph(encoded, &mut transfers).await?;
                }
                // The encoded picture waits in its task until the last message is complete.
                encoded = finished(&mut encoding), if !is_sending => {
                    let Some(EncodingTask { id, view, .. }) = encoding.take() else { continue };
                    let reason = match encoded {
                        Ok(Ok(packed)) => {
                            transfers.start(self.message_of(packed).into(), true);
                            continue;
                        }
                        Ok(Err(error)) => error.to_string(),
                        // The task panicked. The client must not wait for the picture forever.
                        Err(error) => error.to_string(),
                    };
                    let sent = self.send_error(Some(id), &view, &reason).await;
                    self.pictures().release(self.client);
                    sent?;
                }
                // The branches below only begin the next round.
                () = wake.notified(), if encoding.is_none() => {}
                _ = published.changed(), if waiting_update.is_none() => {}
                _ = demand.changed() => {}
                () = sleep_until(update_due) => {}
            }
        }
    }

    fn pictures(&self) -> &PictureRequests {
        self.server_context.hub.pictures()
    }

    /// Begins to encode a picture, or sends the reason why there is none.
    async fn begin(&mut self, outgoing: Outgoing) -> ControlFlow<(), Option<EncodingTask>> {
        match outgoing {
            Outgoing::Picture(drawn) => {
                let effort = self.link.effort(self.connection.is_loopback());
                ControlFlow::Continue(Some(encode(drawn, effort)))
            }
            Outgoing::Failed { id, view, reason } => {
                let sent = self.send_error(Some(id), &view, &reason).await;
                // The place of the picture must become free even if the connection is broken.
                self.pictures().release(self.client);
                sent?;
                ControlFlow::Continue(None)
            }
            Outgoing::Rejected { id, reason } => {
                self.send_error(id, "", &reason).await?;
                ControlFlow::Continue(None)
            }
        }
    }

    /// The message of a picture that is about to be sent.
    fn message_of(&self, mut packed: PackedPicture) -> Vec<u8> {
        let sent_at = Instant::now();
        let message = packed.message(sent_at, self.server_context.clock);
        let request = &packed.job.view_request;
        // Only complete pictures count as shown. Depth alone shows no keyframes.
        if let Some(trained_on) = packed
            .trained_on
            .filter(|_| packed.header.last && request.color)
        {
            let picture = SentPicture {
                id: request.id,
                view: Arc::clone(&request.view),
                method: request.method.clone(),
                n_keyframes: trained_on.n,
                sent_at,
            };
            self.pictures().record_sent(self.client, picture);
        }
        message
    }

    async fn send_hello(&mut self) -> ClientFlow {
        let capabilities: Vec<_> = capabilities().collect();
        let hello = ServerMessage::Hello {
            protocol: BASE_PROTOCOL_VERSION,
            protocols: [BASE_PROTOCOL_VERSION, PROTOCOL_VERSION],
            capabilities: &capabilities,
            server: concat!("fieldrig ", env!("CARGO_PKG_VERSION")),
            client: self.client,
            role: self.role,
            max_size_px: [MAX_SIZE_PX; 2],
            default_stages: &DEFAULT_STAGES,
            clock_millis: self.server_context.clock.now_millis(),
            has_workspace: self.server_context.hub.workspace().is_some(),
        };
        self.send_message(&hello).await
    }

    async fn reply(&mut self, reply: Reply) -> ClientFlow {
        match reply {
            Reply::Welcome(Agreement {
                protocol,
                names,
                negotiated,
            }) => {
                // The capabilities are set before the reply, because the client may rely on them as
                // soon as it has received the reply.
                self.negotiated = negotiated;
                self.send_message(&ServerMessage::Welcome {
                    protocol,
                    capabilities: names,
                })
                .await
            }
            Reply::Error { id, message } => self.send_error(id, "", &message).await,
            Reply::Pong { t } => {
                // The clock is read when the reply is sent, which may have waited. Clients use the
                // reply with the smallest difference to their own clock.
                let clock_millis = self.server_context.clock.now_millis();
                self.send_message(&ServerMessage::Pong { t, clock_millis })
                    .await
            }
            Reply::KeyframeImage(request) if self.photograph.is_some() => {
                let reason = KeyframeImageError::Busy.to_string();
                self.send_image_error(request, &reason).await
            }
            Reply::KeyframeImage(request) => {
                let context = self.server_context;
                let photographs = Arc::clone(&context.photographs);
                let task =
                    tokio::spawn(encode_photograph(photographs, context.hub.clone(), request));
                self.photograph = Some(PhotographTask { request, task });
                ControlFlow::Continue(())
            }
            Reply::Goodbye { reason } => self.send_goodbye(&reason).await,
        }
    }

    /// Begins to send a photograph, or sends the reason why there is none.
    async fn send_photograph(
        &mut self,
        encoded: PhotographResult,
        transfers: &mut Transfers,
    ) -> ClientFlow {
        let Some(request) = self.photograph.take().map(|photograph| photograph.request) else {
            return ControlFlow::Continue(());
        };
        let reason = match encoded {
            Ok(Ok(bytes)) => {
                transfers.start(bytes.into(), false);
                return ControlFlow::Continue(());
            }
            Ok(Err(error)) => error.to_string(),
            // The task panicked. The client must not wait forever.
            Err(error) => error.to_string(),
        };
        self.send_image_error(request, &reason).await
    }

    /// Sends the reason why there is no photograph.
    async fn send_image_error(
        &mut self,
        request: KeyframeImageRequest,
        reason: &str,
    ) -> ClientFlow {
        self.send_message(&ServerMessage::Error {
            id: Some(request.id),
            view: None,
            keyframe: Some(request.keyframe),
            message: reason,
        })
        .await
    }

    /// Sends the next part, or the whole message if the client cannot join parts.
    async fn send_part(&mut self, transfer: &mut Transfer) -> ClientFlow {
        let n_bytes = transfer.bytes.len();
        let n_part = if self.negotiated.has_parts {
            self.link.part_bytes()
        } else {
            usize::MAX
        };
        let begin = transfer.n_sent;
        let end = n_bytes.min(begin.saturating_add(n_part));
        // A message that fits into one part needs no header.
        let message = if begin == 0 && end == n_bytes {
            Message::Binary(transfer.bytes.clone())
        } else {
            let header = PartHeader {
                message: transfer.number,
                offset: begin,
                bytes: n_bytes,
            };
            Message::binary(frame(
                &BinaryHeader::Part(header),
                &[&transfer.bytes[begin..end]],
            ))
        };
        // Sending ends when the kernel has accepted the part. If its buffer is full, that takes as
        // long as the link needs for a part.
        let began = Instant::now();
        let pause = began - self.part_sent;
        self.send(message).await?;
        self.part_sent = Instant::now();
        self.link
            .observe(end - begin, self.part_sent - began, pause);
        // Data in the kernel's buffer can no longer be replaced by newer data, so the buffer is
        // kept small.
        self.connection.set_send_buffer(self.link.buffer_bytes());
        transfer.n_sent = end;
        ControlFlow::Continue(())
    }

    /// Sends the last status, which contains the result of the run, then a goodbye.
    async fn send_goodbye_when_stopped(&mut self) -> ClientFlow {
        let latest = self.server_context.hub.status();
        if let Some(status) = latest {
            self.send_message(&ServerMessage::Status(&status)).await?;
        }
        self.send_goodbye("the server has stopped").await
    }

    async fn send_error(&mut self, id: Option<u64>, view: &str, message: &str) -> ClientFlow {
        let view = (!view.is_empty()).then_some(view);
        self.send_message(&ServerMessage::Error {
            id,
            view,
            keyframe: None,
            message,
        })
        .await
    }

    async fn send_goodbye(&mut self, reason: &str) -> ClientFlow {
        self.send_message(&ServerMessage::Goodbye { reason })
            .await?;
        self.send(Message::Close(None)).await?;
        // The writer ends. The reader waits until the client has received the goodbye.
        ControlFlow::Break(())
    }

    async fn send_message(&mut self, message: &ServerMessage<'_>) -> ClientFlow {
        self.send(message.to_message()).await
    }

    async fn send(&mut self, message: Message) -> ClientFlow {
        match self.sink.send(message).await {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                // This error is usual when a page is closed, so it is not logged as a warning.
                log::debug!("client {}: {error}", self.client);
                ControlFlow::Break(())
            }
        }
    }
}

/// Encodes a picture on another thread. Encoding takes milliseconds, during which no writer could
/// send on this thread.
fn encode(drawn: Box<DrawnPicture>, effort: Option<Effort>) -> EncodingTask {
    let view_request = &drawn.job.view_request;
    let id = view_request.id;
    let view = Arc::clone(&view_request.view);
    let task = tokio::task::spawn_blocking(move || pack_picture(*drawn, effort));
    EncodingTask { id, view, task }
}

/// Waits until the current picture is encoded. Without one, waits forever.
async fn finished(encoding: &mut Option<EncodingTask>) -> EncodingResult {
    match encoding {
        Some(encoding) => (&mut encoding.task).await,
        None => std::future::pending().await,
    }
}

/// Waits until the photograph is encoded. Without one, waits forever.
async fn encoded_photograph(photograph: &mut Option<PhotographTask>) -> PhotographResult {
    match photograph {
        Some(photograph) => (&mut photograph.task).await,
        None => std::future::pending().await,
    }
}

/// The time at which a message counts as sent. This is the time at which it was due, so that
/// inaccurate timers do not lower the rate. If that time is more than a period ago, it is the
/// present time.
fn on_schedule((due, period): (Instant, Duration)) -> Instant {
    let now = Instant::now();
    if now.saturating_duration_since(due) < period {
        due
    } else {
        now
    }
}

/// Waits until this time; forever without one.
async fn sleep_until(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time.into()).await,
        None => std::future::pending().await,
    }
}

/// Waits until this time, then for a value that has not been read; forever without a time.
async fn changed_after<T>(receiver: &mut watch::Receiver<T>, time: Option<Instant>) {
    sleep_until(time).await;
    if receiver.changed().await.is_err() {
        // The server is about to stop.
        std::future::pending::<()>().await;
    }
}
