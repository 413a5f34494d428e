//! Serves one connected client, from hello to goodbye: a reader and a writer that never wait for
//! each other.

pub(crate) mod keyframe_image;
pub(crate) mod link_rate;
#[cfg(any(test, fuzzing))]
pub(crate) mod message_checks;
pub(crate) mod negotiation;
pub(crate) mod protocol;
pub(crate) mod server_message;
mod writer;

use crate::Hub;
use crate::client::keyframe_image::KeyframeImageRequest;
use crate::client::link_rate::LinkRate;
use crate::client::negotiation::{Negotiated, negotiate};
use crate::client::protocol::{
    ClientHello, ClientMessage, ControlMessage, EditMessage, RenderMessage, ShownMessage,
    SubscribeMessage,
};
use crate::client::writer::{Reply, Writer};
use crate::clock::ServerClock;
use crate::demands::Demand;
use crate::edit::EditRequest;
use crate::operator_requests::{ControlRequest, MAX_WAITING_EDITS};
use crate::pictures::queue::MAX_VIEWS;
use crate::pictures::view_request::{InvalidRequest, ViewRequest};
use crate::pictures::viewpoint::Viewpoint;
use crate::server::access::Role;
use crate::server::admission::Connection;
use crate::server::client_log::ClientLog;
use crate::server::server_context::ServerContext;
use crate::topics::status::refresh_clients;
use axum::extract::ws::{Message, WebSocket};
use futures_util::StreamExt;
use futures_util::stream::SplitStream;
use serde::Deserialize;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};

/// Maximum number of replies that wait to be sent. Further messages of the client are read only
/// when there is room, so that a client that sends without reading cannot fill the memory.
const MAX_REPLIES: usize = 64;
/// A client that leaves [`MAX_REPLIES`] replies unread for this long is disconnected. With less
/// time, a client with a slow link that is busy with a picture would also be disconnected.
const MAX_REPLY_WAIT: Duration = Duration::from_secs(2);
/// After a goodbye, the connection stays open until the client closes it, but at most for this
/// time. If it were closed while data from the client is unread, the kernel would reset the
/// connection and discard all unsent data, including the goodbye.
const LINGER: Duration = Duration::from_millis(300);

/// Serves one client until either side disconnects.
pub(crate) async fn serve(
    socket: WebSocket,
    connection: Arc<Connection>,
    role: Role,
    server_context: ServerContext,
) {
    // From here on, the guard removes the client even if this task is dropped, as when the server
    // stops.
    let (client, wake) = server_context.hub.join(role);
    let client_guard = ClientGuard {
        hub: &server_context.hub,
        client,
    };
    refresh_clients(&server_context.hub);
    let log = &server_context.log;
    log.line(format_args!("client {client} connected as {}", role.name()));
    let (sink, stream) = socket.split();
    let (replies, waiting_replies) = mpsc::channel(MAX_REPLIES);
    let (demand_sender, demand) = watch::channel(Demand::new(Instant::now()));
    let reader = Reader {
        stream,
        hub: &server_context.hub,
        clock: server_context.clock,
        client,
        role,
        connection: &connection,
        replies,
        demand: demand_sender,
        log,
    };
    let link = LinkRate::default();
    connection.set_send_buffer(link.buffer_bytes());
    let writer = Writer {
        sink,
        server_context: &server_context,
        client,
        role,
        connection: &connection,
        negotiated: Negotiated::default(),
        link,
        part_sent: Instant::now(),
        photograph: None,
    };
    // The reader and the writer run in one task, and neither waits for the other. A client can
    // therefore request another view while a picture is being sent.
    let mut reading = std::pin::pin!(reader.run());
    tokio::select! {
        () = &mut reading => {}
        _ = writer.run(&wake, waiting_replies, demand) => {
            // If the reader takes longer, the client does not get a reply to its last messages.
            let _ = tokio::time::timeout(LINGER, reading).await;
        }
        () = connection.closed() => {}
    }
    // The client is removed before the log entry is written, so that it is no longer connected when
    // somebody reads the entry.
    drop(client_guard);
    log.line(format_args!("client {client} disconnected"));
}

/// Removes a client from the hub when it is no longer served, for whatever reason.
struct ClientGuard<'a> {
    hub: &'a Hub,
    client: u64,
}

impl Drop for ClientGuard<'_> {
    fn drop(&mut self) {
        self.hub.leave(self.client);
        refresh_clients(self.hub);
    }
}

struct Reader<'a> {
    stream: SplitStream<WebSocket>,
    hub: &'a Hub,
    clock: ServerClock,
    client: u64,
    role: Role,
    connection: &'a Connection,
    replies: mpsc::Sender<Reply>,
    demand: watch::Sender<Demand>,
    log: &'a ClientLog,
}

impl Reader<'_> {
    /// Reads until the client disconnects or violates the protocol.
    async fn run(mut self) {
        while let Some(Ok(message)) = self.stream.next().await {
            let reply = match message {
                Message::Close(_) => return,
                // The writer has said goodbye.
                _ if self.replies.is_closed() => return self.discard().await,
                Message::Pong(_) => {
                    self.connection.record_pong();
                    continue;
                }
                // The WebSocket library answers pings.
                Message::Ping(_) => continue,
                Message::Text(text) => self.answer(&text).unwrap_or_else(|error| {
                    Some(Reply::Error {
                        id: id_of(&text),
                        message: error.to_string(),
                    })
                }),
                Message::Binary(_) => Some(Reply::Error {
                    id: None,
                    message: "binary messages are not supported, send JSON as text".to_owned(),
                }),
            };
            // Even an invalid message shows that the client is alive.
            self.connection.record_message();
            let Some(reply) = reply else { continue };
            let is_last = matches!(reply, Reply::Goodbye { .. });
            // The writer may not have had time to send the replies to a burst of messages.
            match tokio::time::timeout(MAX_REPLY_WAIT, self.replies.send(reply)).await {
                Ok(Ok(())) if is_last => return self.discard().await,
                Ok(Ok(())) => {}
                Err(_) => {
                    self.log.line(format_args!(
                        "client {}: disconnecting, because it left {MAX_REPLIES} replies unread for {MAX_REPLY_WAIT:?}",
                        self.client
                    ));
                    return;
                }
                // The writer has ended in the meantime.
                Ok(Err(_)) => return self.discard().await,
            }
        }
    }

    /// Reads and discards messages until the client disconnects. The writer closes the connection.
    async fn discard(&mut self) {
        while let Some(Ok(message)) = self.stream.next().await {
            if matches!(message, Message::Close(_)) {
                return;
            }
        }
    }

    /// Handles a message. Returns the reply, if there is one.
    fn answer(&self, text: &str) -> Result<Option<Reply>, InvalidRequest> {
        let message: ClientMessage = serde_json::from_str(text)?;
        // The role is checked here and not in the handlers, so that the check covers every message.
        if self.role < message.required_role() {
            return Err(InvalidRequest::NotOperator);
        }
        match message {
            ClientMessage::Hello(hello) => return Ok(Some(self.hello(&hello))),
            ClientMessage::Render(message) => self.render(&message)?,
            ClientMessage::Subscribe(message) => self.subscribe(message)?,
            ClientMessage::Control(ControlMessage { action }) => {
                self.log
                    .line(format_args!("client {}: {action:?}", self.client));
                self.hub.operator_requests().control(ControlRequest {
                    action,
                    client: self.client,
                });
            }
            ClientMessage::Shown(message) => self.shown(&message)?,
            ClientMessage::KeyframeImage(message) => {
                let request = KeyframeImageRequest::check(&message)?;
                return Ok(Some(Reply::KeyframeImage(request)));
            }
            ClientMessage::Edit(message) => self.edit(&message)?,
            ClientMessage::Ping(ping) => return Ok(Some(Reply::Pong { t: ping.t })),
            ClientMessage::Goodbye(_) => {
                let reason = "the client disconnected".to_owned();
                return Ok(Some(Reply::Goodbye { reason }));
            }
        }
        Ok(None)
    }

    fn hello(&self, hello: &ClientHello) -> Reply {
        match negotiate(hello) {
            Ok(agreement) => {
                let has_keyframe_changes = agreement.negotiated.has_keyframe_changes;
                self.change_demand(|demand| {
                    demand.has_hello = true;
                    demand.has_keyframe_changes = has_keyframe_changes;
                });
                Reply::Welcome(agreement)
            }
            Err(reason) => Reply::Goodbye { reason },
        }
    }

    fn render(&self, message: &RenderMessage) -> Result<(), InvalidRequest> {
        let view_request = ViewRequest::check(message)?;
        if let Some(viewpoint) = Viewpoint::of(&view_request) {
            // Only the writer of this client needs the viewpoint. The hub is not informed, because
            // views change many times per second.
            self.demand
                .send_modify(|demand| demand.viewpoint = Some(viewpoint));
        }
        if !self.hub.pictures().request(self.client, view_request) {
            return Err(InvalidRequest::Views { max: MAX_VIEWS });
        }
        Ok(())
    }

    fn shown(&self, message: &ShownMessage) -> Result<(), InvalidRequest> {
        let ShownMessage {
            id,
            view,
            shown_millis,
        } = message;
        let shown_at = self
            .clock
            .instant(*shown_millis)
            .ok_or(InvalidRequest::ShownTime { got: *shown_millis })?;
        let view = view.as_deref().unwrap_or_default();
        self.hub
            .pictures()
            .record_shown(self.client, *id, view, shown_at);
        Ok(())
    }

    fn edit(&self, message: &EditMessage) -> Result<(), InvalidRequest> {
        let request = EditRequest::check(self.client, message)?;
        // Edits change the model for all clients, so the log names the client.
        self.log.line(format_args!(
            "client {}: edit: {}",
            self.client,
            request.action()
        ));
        if !self.hub.operator_requests().edit(request) {
            return Err(InvalidRequest::Edits {
                max: MAX_WAITING_EDITS,
            });
        }
        Ok(())
    }

    fn subscribe(&self, message: SubscribeMessage) -> Result<(), InvalidRequest> {
        // A copy is changed, because other threads may be reading the present subscriptions.
        let mut subscriptions = (*self.demand.borrow().subscriptions).clone();
        subscriptions.apply(message)?;
        self.change_demand(|demand| demand.subscriptions = Arc::new(subscriptions));
        Ok(())
    }

    /// Changes what the client receives, for its writer and for the hub.
    fn change_demand(&self, change: impl FnOnce(&mut Demand)) {
        self.demand.send_modify(change);
        self.hub
            .set_demand(self.client, self.demand.borrow().clone());
    }
}

/// The id in a message that is otherwise invalid, so that the sender can identify it.
fn id_of(text: &str) -> Option<u64> {
    // Unlike the messages, this type ignores all other fields.
    #[derive(Deserialize)]
    struct Numbered {
        id: u64,
    }
    serde_json::from_str::<Numbered>(text)
        .ok()
        .map(|message| message.id)
}
