//! One connected client, from hello to goodbye.

use crate::Hub;
use crate::hub::LiveImages;
use crate::news::{KeyframePose, LiveSlot, SceneHint, Status};
use crate::picture::{live_jpeg, pack_live_image, pack_picture};
use crate::protocol::{ClientMessage, KeyframeMessage, PROTOCOL_VERSION, ServerMessage};
use crate::queue::Outgoing;
use crate::render_order::{DEFAULT_STAGES, MAX_SIZE_PX, Malformed, RenderOrder};
use axum::extract::ws::{Message, WebSocket};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// Status, live images and keyframe poses go out at most this often.
const NEWS_PERIOD: Duration = Duration::from_millis(200);

/// Talks with one client until either side leaves.
pub(crate) async fn serve(socket: WebSocket, hub: Hub, mut stopped: watch::Receiver<bool>) {
    let (client, wake) = hub.join();
    let membership = Membership { hub: &hub, client };
    let mut session = Session { socket, hub: &hub, client, news: News::subscribe(&hub) };
    log::info!("client {client} connected");
    let mut news_due = tokio::time::interval(NEWS_PERIOD);
    news_due.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut going = session.greet().await;
    while going.is_continue() {
        going = tokio::select! {
            received = session.socket.recv() => match received {
                Some(Ok(message)) => session.answer(message).await,
                Some(Err(_)) | None => ControlFlow::Break(()),
            },
            () = wake.notified() => session.send_pictures().await,
            _ = news_due.tick() => session.send_news().await,
            _ = stopped.changed() => session.part("the server has stopped").await,
        };
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

/// Whether the session goes on.
type Going = ControlFlow<()>;

struct Session<'a> {
    socket: WebSocket,
    hub: &'a Hub,
    client: u64,
    news: News,
}

impl Session<'_> {
    async fn greet(&mut self) -> Going {
        let hello = ServerMessage::Hello {
            protocol: PROTOCOL_VERSION,
            server: concat!("fieldrig ", env!("CARGO_PKG_VERSION")),
            client: self.client,
            max_size_px: [MAX_SIZE_PX; 2],
            default_stages: &DEFAULT_STAGES,
        };
        self.say(&hello).await
    }

    async fn answer(&mut self, message: Message) -> Going {
        match message {
            Message::Text(text) => match understand(&text) {
                Ok(Understood::Order(order)) => {
                    self.hub.order(self.client, *order);
                    ControlFlow::Continue(())
                }
                Ok(Understood::SameVersion) => ControlFlow::Continue(()),
                Ok(Understood::OtherVersion(theirs)) => {
                    let reason = format!("this server speaks protocol {PROTOCOL_VERSION}, the client {theirs}");
                    self.part(&reason).await
                }
                Ok(Understood::Goodbye) => self.part("the client leaves").await,
                Err(error) => self.complain(id_of(&text), &error.to_string()).await,
            },
            Message::Binary(_) => self.complain(None, "binary messages are not understood, send JSON as text").await,
            Message::Ping(_) | Message::Pong(_) => ControlFlow::Continue(()),
            Message::Close(_) => ControlFlow::Break(()),
        }
    }

    async fn send_pictures(&mut self) -> Going {
        while let Some(outgoing) = self.hub.collect(self.client) {
            let sent = match outgoing {
                Outgoing::Failed { id, reason } => self.complain(Some(id), &reason).await,
                Outgoing::Picture(drawn) => {
                    let id = drawn.0.order.id;
                    let packed = tokio::task::spawn_blocking(move || {
                        let (ticket, header, picture) = *drawn;
                        pack_picture(&ticket.order, header, &picture)
                    });
                    match packed.await {
                        Ok(Ok(bytes)) => self.send(Message::binary(bytes)).await,
                        Ok(Err(error)) => self.complain(Some(id), &error.to_string()).await,
                        Err(error) => self.complain(Some(id), &error.to_string()).await,
                    }
                }
            };
            self.hub.settle(self.client);
            sent?;
        }
        ControlFlow::Continue(())
    }

    async fn send_news(&mut self) -> Going {
        if let Some(hint) = self.news.scene() {
            self.say(&ServerMessage::from(&*hint)).await?;
        }
        if let Some(status) = self.news.status() {
            self.say(&ServerMessage::Status(&status)).await?;
        }
        if let Some(keyframes) = self.news.keyframes() {
            let keyframes = keyframes.iter().map(KeyframeMessage::from).collect();
            self.say(&ServerMessage::Keyframes { keyframes }).await?;
        }
        for slot in self.news.live_images() {
            let packed = tokio::task::spawn_blocking(move || pack_live(&slot));
            match packed.await {
                Ok(Ok(bytes)) => self.send(Message::binary(bytes)).await?,
                Ok(Err(error)) => self.complain(None, &error).await?,
                Err(error) => self.complain(None, &error.to_string()).await?,
            }
        }
        ControlFlow::Continue(())
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
        match self.socket.send(message).await {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                log::debug!("client {}: {error}", self.client);
                ControlFlow::Break(())
            }
        }
    }
}

/// What a client's text means.
enum Understood {
    SameVersion,
    OtherVersion(u32),
    Order(Box<RenderOrder>),
    Goodbye,
}

fn understand(text: &str) -> Result<Understood, Malformed> {
    Ok(match serde_json::from_str(text)? {
        ClientMessage::Hello(hello) if hello.protocol == PROTOCOL_VERSION => Understood::SameVersion,
        ClientMessage::Hello(hello) => Understood::OtherVersion(hello.protocol),
        ClientMessage::Render(message) => Understood::Order(Box::new(RenderOrder::check(&message)?)),
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

fn pack_live(slot: &LiveSlot) -> Result<Vec<u8>, String> {
    let jpeg = slot.jpeg.get_or_init(|| {
        live_jpeg(&slot.image).map_err(|error| format!("live image of camera {:?}: {error}", slot.image.camera))
    });
    jpeg.as_deref().map(|jpeg| pack_live_image(&slot.image, jpeg)).map_err(Clone::clone)
}

/// What a client has not been told yet.
struct News {
    status: watch::Receiver<Option<Arc<Status>>>,
    scene: watch::Receiver<Option<Arc<SceneHint>>>,
    keyframes: watch::Receiver<Arc<[KeyframePose]>>,
    live_images: watch::Receiver<LiveImages>,
    /// The image last sent of each camera; holding it keeps its address from being used again.
    sent_images: BTreeMap<Arc<str>, Arc<LiveSlot>>,
}

impl News {
    fn subscribe(hub: &Hub) -> Self {
        let mut news = Self {
            status: hub.status(),
            scene: hub.scene(),
            keyframes: hub.keyframes(),
            live_images: hub.live_images(),
            sent_images: BTreeMap::new(),
        };
        // What was told before this client came is new to it.
        news.status.mark_changed();
        news.scene.mark_changed();
        news.keyframes.mark_changed();
        news.live_images.mark_changed();
        news
    }

    fn status(&mut self) -> Option<Arc<Status>> {
        fresh(&mut self.status).flatten()
    }

    fn scene(&mut self) -> Option<Arc<SceneHint>> {
        fresh(&mut self.scene).flatten()
    }

    fn keyframes(&mut self) -> Option<Arc<[KeyframePose]>> {
        fresh(&mut self.keyframes)
    }

    fn live_images(&mut self) -> Vec<Arc<LiveSlot>> {
        let Some(images) = fresh(&mut self.live_images) else { return Vec::new() };
        let is_new = |slot: &&Arc<LiveSlot>| {
            self.sent_images.get(&slot.image.camera).is_none_or(|sent| !Arc::ptr_eq(sent, slot))
        };
        let new: Vec<_> = images.values().filter(is_new).cloned().collect();
        self.sent_images = images;
        new
    }
}

/// The value, if it changed since the last call. An error would mean the hub is gone, which outlives the session.
fn fresh<T: Clone>(receiver: &mut watch::Receiver<T>) -> Option<T> {
    receiver.has_changed().unwrap_or(false).then(|| receiver.borrow_and_update().clone())
}
