//! Encodes new data once for all clients, outside the client sessions.

use crate::Hub;
use crate::clock::ServerClock;
use crate::picture::pack_live_image;
use crate::protocol::{KeyframeMessage, ServerMessage};
use crate::updates::LiveImage;
use axum::extract::ws::Message;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio::task::JoinSet;

/// Period of checking the hub for new data.
const CHECK_PERIOD: Duration = Duration::from_millis(20);
/// Minimum period between status messages, and between images of one camera.
const UPDATE_PERIOD: Duration = Duration::from_millis(190);
/// Minimum period between keyframe lists, which are long and always sent in full.
const KEYFRAMES_PERIOD: Duration = Duration::from_secs(1);

/// The latest encoded message of each kind.
#[derive(Clone, Debug, Default)]
pub(crate) struct LatestMessages {
    scene: Option<Item>,
    status: Option<Item>,
    keyframes: Option<Item>,
    live_images: BTreeMap<Arc<str>, Item>,
}

/// An encoded message; clones share the bytes.
#[derive(Clone, Debug)]
struct Item {
    number: u64,
    message: Message,
}

/// Numbers of the items that a client has received.
#[derive(Debug, Default)]
pub(crate) struct Received {
    scene: u64,
    status: u64,
    keyframes: u64,
    live_images: BTreeMap<Arc<str>, u64>,
}

impl LatestMessages {
    /// The next message that a client has not received: short messages first, live images and keyframes only if
    /// `long` is set.
    pub(crate) fn next(&self, received: &mut Received, long: bool) -> Option<Message> {
        let newer = |item: &Option<Item>, number: &mut u64| {
            let item = item.as_ref().filter(|item| item.number > *number)?;
            *number = item.number;
            Some(item.message.clone())
        };
        let short = newer(&self.scene, &mut received.scene).or_else(|| newer(&self.status, &mut received.status));
        if short.is_some() || !long {
            return short;
        }
        // The camera whose last image was sent longest ago comes first.
        let number_of = |camera: &Arc<str>| received.live_images.get(camera).copied().unwrap_or(0);
        let waiting = self.live_images.iter().filter(|(camera, item)| item.number > number_of(camera));
        let image = waiting.min_by_key(|(camera, _)| number_of(camera));
        if let Some((camera, item)) = image {
            received.live_images.insert(Arc::clone(camera), item.number);
            return Some(item.message.clone());
        }
        newer(&self.keyframes, &mut received.keyframes)
    }

    fn is_empty(&self) -> bool {
        self.scene.is_none() && self.status.is_none() && self.keyframes.is_none() && self.live_images.is_empty()
    }
}

/// The result of a finished encoding task.
enum Encoded {
    Keyframes(Message),
    LiveImage(Arc<str>, Message),
}

/// The image of a camera that is being encoded or was encoded last.
struct ImageEncoding {
    image: Arc<LiveImage>,
    at: Instant,
    is_running: bool,
}

/// Encodes new data while clients are connected. Runs until the server stops.
pub(crate) async fn broadcast(hub: Hub, clock: ServerClock, latest_messages: watch::Sender<LatestMessages>) {
    let (mut scene, mut status, mut keyframes, live_images) =
        (hub.scene(), hub.status(), hub.keyframes(), hub.live_images());
    // A client may connect before the first check, and it has not received what was set earlier.
    scene.mark_changed();
    status.mark_changed();
    keyframes.mark_changed();
    let mut status_sent = Throttle::new(UPDATE_PERIOD);
    let mut keyframes_sent = Throttle::new(KEYFRAMES_PERIOD);
    let mut image_encodings: BTreeMap<Arc<str>, ImageEncoding> = BTreeMap::new();
    let mut encodings: JoinSet<Encoded> = JoinSet::new();
    let mut is_encoding_keyframes = false;
    let mut n_items = 0;
    let mut publish_item = |change: &dyn Fn(&mut LatestMessages, u64)| {
        n_items += 1;
        latest_messages.send_modify(|latest_messages| change(latest_messages, n_items));
    };
    let mut check = tokio::time::interval(CHECK_PERIOD);
    check.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = check.tick() => {}
            Some(encoded) = encodings.join_next() => match encoded {
                Ok(Encoded::Keyframes(message)) => {
                    is_encoding_keyframes = false;
                    publish_item(&|latest_messages, number| latest_messages.keyframes = Some(Item { number, message: message.clone() }));
                }
                Ok(Encoded::LiveImage(camera, message)) => {
                    if let Some(image_encodings) = image_encodings.get_mut(&camera) {
                        image_encodings.is_running = false;
                    }
                    publish_item(&|latest_messages, number| {
                        latest_messages.live_images.insert(Arc::clone(&camera), Item { number, message: message.clone() });
                    });
                }
                Err(error) => {
                    log::error!("cannot encode a message for clients: {error}");
                    // It is not known which message failed, so all kinds may be encoded again when they change.
                    is_encoding_keyframes = false;
                    image_encodings.values_mut().for_each(|image_encodings| image_encodings.is_running = false);
                }
            },
        }
        if hub.n_clients() == 0 {
            if !latest_messages.borrow().is_empty() {
                latest_messages.send_replace(LatestMessages::default());
            }
            // The next client receives everything.
            scene.mark_changed();
            status.mark_changed();
            keyframes.mark_changed();
            image_encodings.retain(|_, image_encodings| image_encodings.is_running);
            status_sent.reset();
            keyframes_sent.reset();
            continue;
        }
        if let Some(hint) = take_if_changed(&mut scene).flatten() {
            let message = text(&ServerMessage::from(&*hint));
            publish_item(&|latest_messages, number| {
                latest_messages.scene = Some(Item { number, message: message.clone() })
            });
        }
        if status_sent.is_due()
            && let Some(latest) = take_if_changed(&mut status).flatten()
        {
            status_sent.begin();
            let message = text(&ServerMessage::Status(&latest));
            publish_item(&|latest_messages, number| {
                latest_messages.status = Some(Item { number, message: message.clone() })
            });
        }
        if keyframes_sent.is_due()
            && !is_encoding_keyframes
            && let Some(list) = take_if_changed(&mut keyframes)
        {
            keyframes_sent.begin();
            is_encoding_keyframes = true;
            encodings.spawn_blocking(move || {
                let keyframes = list.iter().map(KeyframeMessage::from).collect();
                Encoded::Keyframes(text(&ServerMessage::Keyframes { keyframes }))
            });
        }
        for (camera, image) in &*live_images.borrow() {
            let is_new = image_encodings.get(camera).is_none_or(|image_encodings| {
                !image_encodings.is_running
                    && image_encodings.at.elapsed() >= UPDATE_PERIOD
                    && !Arc::ptr_eq(&image_encodings.image, image)
            });
            if is_new {
                let (camera, image) = (Arc::clone(camera), Arc::clone(image));
                let entry = ImageEncoding { image: Arc::clone(&image), at: Instant::now(), is_running: true };
                image_encodings.insert(Arc::clone(&camera), entry);
                encodings.spawn_blocking(move || {
                    let message = live_message(&image, clock);
                    Encoded::LiveImage(camera, message)
                });
            }
        }
    }
}

fn live_message(image: &LiveImage, clock: ServerClock) -> Message {
    match pack_live_image(image, clock) {
        Ok(bytes) => Message::binary(bytes),
        Err(error) => {
            let message = format!("live image of camera {:?}: {error}", image.camera);
            text(&ServerMessage::Error { id: None, message: &message })
        }
    }
}

fn text(message: &ServerMessage<'_>) -> Message {
    Message::text(message.to_json())
}

/// Returns the value if it changed since the last call. An error would mean that the hub was dropped, but the hub
/// outlives the server.
fn take_if_changed<T: Clone>(receiver: &mut watch::Receiver<T>) -> Option<T> {
    receiver.has_changed().unwrap_or(false).then(|| receiver.borrow_and_update().clone())
}

/// Allows an event at most once per period.
struct Throttle {
    period: Duration,
    last: Option<Instant>,
}

impl Throttle {
    fn new(period: Duration) -> Self {
        Self { period, last: None }
    }

    fn is_due(&self) -> bool {
        self.last.is_none_or(|last| last.elapsed() >= self.period)
    }

    fn begin(&mut self) {
        self.last = Some(Instant::now());
    }

    fn reset(&mut self) {
        self.last = None;
    }
}

#[cfg(test)]
mod tests {
    use super::{Item, LatestMessages, Received};
    use axum::extract::ws::Message;

    fn item(number: u64) -> Item {
        Item { number, message: Message::text(number.to_string()) }
    }

    fn next(latest_messages: &LatestMessages, received: &mut Received, long: bool) -> Option<String> {
        latest_messages.next(received, long).map(|message| message.into_text().expect("text").to_string())
    }

    #[test]
    fn short_messages_first_then_cameras_round_robin() {
        let mut latest_messages =
            LatestMessages { scene: Some(item(1)), status: Some(item(4)), ..LatestMessages::default() };
        latest_messages.keyframes = Some(item(2));
        latest_messages.live_images = [("left".into(), item(3)), ("right".into(), item(5))].into();
        let mut received = Received::default();
        assert_eq!(next(&latest_messages, &mut received, false).as_deref(), Some("1"));
        assert_eq!(next(&latest_messages, &mut received, false).as_deref(), Some("4"));
        assert_eq!(next(&latest_messages, &mut received, false), None, "only long messages are left");
        assert_eq!(next(&latest_messages, &mut received, true).as_deref(), Some("3"));
        latest_messages.live_images.insert("left".into(), item(6));
        assert_eq!(next(&latest_messages, &mut received, true).as_deref(), Some("5"), "the other camera comes next");
        assert_eq!(next(&latest_messages, &mut received, true).as_deref(), Some("6"));
        assert_eq!(next(&latest_messages, &mut received, true).as_deref(), Some("2"));
        assert_eq!(next(&latest_messages, &mut received, true), None);
    }
}
