//! Encodes new data once for all clients, outside the client sessions.

use crate::Hub;
use crate::clock::ServerClock;
use crate::hub::{Demand, LiveImages, ModelLists, RangeScans};
use crate::pictures::picture::pack_live_image;
use crate::session::server_message::{KeyframeMessage, ServerMessage};
use crate::topics::keyframe_log::KeyframeLog;
use crate::topics::keyframe_points::pack_points;
use crate::topics::range_scan::pack_range_scan;
use crate::topics::robot::RobotMessage;
use crate::topics::subscriptions::fitted;
use crate::topics::updates::LiveImage;
use axum::extract::ws::Message;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio::task::JoinSet;

/// Period of checking the hub for new data.
const CHECK_PERIOD: Duration = Duration::from_millis(20);
/// Minimum period between status messages.
const STATUS_PERIOD: Duration = Duration::from_millis(100);
/// Minimum period between versions of the base path.
const BASE_PATH_PERIOD: Duration = Duration::from_millis(500);
/// Minimum period between versions of the keyframe list.
const KEYFRAMES_PERIOD: Duration = Duration::from_millis(200);
/// Maximum number of images of a camera that are encoded at the same time. Clients may want many different sizes.
const MAX_IMAGE_ENCODINGS: usize = 4;
/// Minimum period between complete keyframe lists, which are long.
const KEYFRAME_LIST_PERIOD: Duration = Duration::from_millis(950);

/// The latest encoded message of each kind.
#[derive(Clone, Debug, Default)]
pub(crate) struct LatestMessages {
    pub(crate) scene: Option<Item>,
    pub(crate) status: Option<Item>,
    pub(crate) robot: Option<Item>,
    /// The complete list, if a client needs it.
    pub(crate) keyframe_list: Option<Item>,
    /// The source of changes of the list; `None` before the first list.
    pub(crate) keyframe_log: Option<Arc<KeyframeLog>>,
    pub(crate) live_images: BTreeMap<ImageKey, Item>,
    pub(crate) base_path: Option<Item>,
    /// Scans by scanner, if a client shows them.
    pub(crate) range_scans: BTreeMap<Arc<str>, Item>,
    /// The map of observations, if a client shows it.
    pub(crate) observations: Option<Item>,
    /// Points of keyframes by number, if a client draws them; `None` for keyframes without points.
    pub(crate) keyframe_points: BTreeMap<u64, Option<Message>>,
    /// Chunks of the models that clients draw.
    pub(crate) model_chunks: ModelLists,
}

/// Camera and maximum size of a live image.
pub(crate) type ImageKey = (Arc<str>, [u32; 2]);

/// An encoded message; clones share the bytes.
#[derive(Clone, Debug)]
pub(crate) struct Item {
    pub(crate) number: u64,
    pub(crate) message: Message,
}

impl LatestMessages {
    fn is_empty(&self) -> bool {
        self.scene.is_none()
            && self.status.is_none()
            && self.robot.is_none()
            && self.keyframe_list.is_none()
            && self.keyframe_log.is_none()
            && self.live_images.is_empty()
            && self.base_path.is_none()
            && self.range_scans.is_empty()
            && self.observations.is_none()
            && self.keyframe_points.is_empty()
            && self.model_chunks.is_empty()
    }
}

/// The result of a finished encoding task.
enum Encoded {
    KeyframeList(Message),
    LiveImage(ImageKey, Message),
    Points(u64, Option<Message>),
}

/// The image of a camera that is being encoded or was encoded last.
struct ImageEncoding {
    image: Arc<LiveImage>,
    at: Instant,
    is_running: bool,
}

/// Encodes new data while clients are connected. Runs until the server stops.
pub(crate) async fn broadcast(hub: Hub, clock: ServerClock, latest_messages_sender: watch::Sender<LatestMessages>) {
    let (mut scene, mut status, mut robot, mut keyframes, live_images) =
        (hub.scene(), hub.status(), hub.robot(), hub.keyframes(), hub.live_images());
    let (mut base_path, mut range_scans) = (hub.base_path(), hub.range_scans());
    let (mut observations, mut model_chunks) = (hub.observations(), hub.model_chunks());
    // A client may connect before the first check, and it has not received what was set earlier.
    scene.mark_changed();
    status.mark_changed();
    robot.mark_changed();
    base_path.mark_changed();
    range_scans.mark_changed();
    observations.mark_changed();
    keyframes.mark_changed();
    let mut status_sent = Throttle::new(STATUS_PERIOD);
    let mut base_path_sent = Throttle::new(BASE_PATH_PERIOD);
    let mut keyframes_sent = Throttle::new(KEYFRAMES_PERIOD);
    let mut list_sent = Throttle::new(KEYFRAME_LIST_PERIOD);
    let mut keyframe_log = KeyframeLog::default();
    let mut is_list_outdated = true;
    let mut is_encoding_list = false;
    // Task and keyframe of the points that are being packed.
    let mut points_encoding: Option<(tokio::task::Id, u64)> = None;
    let mut image_encodings: BTreeMap<ImageKey, ImageEncoding> = BTreeMap::new();
    let mut encodings: JoinSet<Encoded> = JoinSet::new();
    let mut packed_scans = RangeScans::new();
    let mut n_items = 0;
    let mut publish_item = |change: &dyn Fn(&mut LatestMessages, u64)| {
        n_items += 1;
        latest_messages_sender.send_modify(|latest_messages| change(latest_messages, n_items));
    };
    let mut check = tokio::time::interval(CHECK_PERIOD);
    check.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = check.tick() => {}
            Some(encoded) = encodings.join_next() => match encoded {
                Ok(Encoded::KeyframeList(message)) => {
                    is_encoding_list = false;
                    publish_item(&|latest_messages, number| {
                        latest_messages.keyframe_list = Some(Item { number, message: message.clone() });
                    });
                }
                Ok(Encoded::LiveImage(key, message)) => {
                    if let Some(image_encoding) = image_encodings.get_mut(&key) {
                        image_encoding.is_running = false;
                    }
                    publish_item(&|latest_messages, number| {
                        latest_messages.live_images.insert(key.clone(), Item { number, message: message.clone() });
                    });
                }
                Ok(Encoded::Points(number, message)) => {
                    points_encoding = None;
                    publish_item(&|latest_messages, _| {
                        latest_messages.keyframe_points.insert(number, message.clone());
                    });
                }
                Err(error) => {
                    log::error!("cannot encode a message for clients: {error}");
                    if let Some((_, number)) = points_encoding.take_if(|(task, _)| *task == error.id()) {
                        // Another attempt would fail, too.
                        publish_item(&|latest_messages, _| {
                            latest_messages.keyframe_points.insert(number, None);
                        });
                        continue;
                    }
                    // It is not known which message failed, so both kinds may be encoded again when they change.
                    is_encoding_list = false;
                    image_encodings.values_mut().for_each(|image_encoding| image_encoding.is_running = false);
                }
            },
        }
        if hub.n_clients() == 0 {
            if !latest_messages_sender.borrow().is_empty() {
                latest_messages_sender.send_replace(LatestMessages::default());
            }
            // The next client receives everything.
            scene.mark_changed();
            status.mark_changed();
            robot.mark_changed();
            base_path.mark_changed();
            range_scans.mark_changed();
            observations.mark_changed();
            keyframes.mark_changed();
            is_list_outdated = true;
            image_encodings.retain(|_, image_encoding| image_encoding.is_running);
            packed_scans.clear();
            status_sent.reset();
            base_path_sent.reset();
            keyframes_sent.reset();
            list_sent.reset();
            continue;
        }
        let now = Instant::now();
        let demands: Vec<_> = hub.demands().into_iter().filter(|demand| demand.settles_at(now).is_none()).collect();
        if let Some(hint) = take_if_changed(&mut scene).flatten() {
            let message = text(&ServerMessage::from(&*hint));
            publish_item(&|latest_messages, number| {
                latest_messages.scene = Some(Item { number, message: message.clone() });
            });
        }
        if let Some(robot) = take_if_changed(&mut robot).flatten() {
            let message = text(&ServerMessage::Robot(&RobotMessage::from(&*robot)));
            publish_item(&|latest_messages, number| {
                latest_messages.robot = Some(Item { number, message: message.clone() });
            });
        }
        if let Some(lists) = take_if_changed(&mut model_chunks) {
            publish_item(&|latest_messages, _| latest_messages.model_chunks = lists.clone());
        }
        if status_sent.is_due()
            && let Some(latest) = take_if_changed(&mut status).flatten()
        {
            status_sent.begin();
            let message = text(&ServerMessage::Status(&latest));
            publish_item(&|latest_messages, number| {
                latest_messages.status = Some(Item { number, message: message.clone() });
            });
        }
        if base_path_sent.is_due()
            && let Some(path) = take_if_changed(&mut base_path)
        {
            base_path_sent.begin();
            let message = text(&ServerMessage::BasePath { points_m: path.rounded() });
            publish_item(&|latest_messages, number| {
                latest_messages.base_path = Some(Item { number, message: message.clone() });
            });
        }
        let needs_scans = demands.iter().any(|demand| demand.subscriptions.range_scans.is_some());
        if needs_scans && let Some(scans) = take_if_changed(&mut range_scans) {
            for (scanner, scan) in scans {
                let known = packed_scans.insert(Arc::clone(&scanner), Arc::clone(&scan));
                let is_new = known.is_none_or(|known| !Arc::ptr_eq(&known, &scan));
                let Some(message) = is_new.then(|| pack_range_scan(&scan)).flatten().map(Message::binary) else {
                    continue;
                };
                publish_item(&|latest_messages, number| {
                    latest_messages.range_scans.insert(Arc::clone(&scanner), Item { number, message: message.clone() });
                });
            }
        }
        let needs_observations = demands.iter().any(|demand| demand.subscriptions.observations.is_some());
        if needs_observations && let Some(packed) = take_if_changed(&mut observations).flatten() {
            let message = Message::binary(packed.message(clock));
            publish_item(&|latest_messages, number| {
                latest_messages.observations = Some(Item { number, message: message.clone() });
            });
        }
        if keyframes_sent.is_due()
            && let Some(list) = take_if_changed(&mut keyframes)
        {
            keyframes_sent.begin();
            keyframe_log.set(&list);
            is_list_outdated = true;
            let log = Arc::new(keyframe_log.clone());
            publish_item(&|latest_messages, _| {
                latest_messages.keyframe_points.retain(|number, _| log.contains(*number));
                latest_messages.keyframe_log = Some(Arc::clone(&log));
            });
        }
        let needs_list = demands.iter().any(|demand| !demand.has_keyframe_changes);
        if needs_list && is_list_outdated && !is_encoding_list && list_sent.is_due() {
            list_sent.begin();
            (is_list_outdated, is_encoding_list) = (false, true);
            let list = keyframes.borrow().clone();
            encodings.spawn_blocking(move || {
                let keyframes = list.iter().map(KeyframeMessage::from).collect();
                Encoded::KeyframeList(text(&ServerMessage::Keyframes { keyframes }))
            });
        }
        let needs_points = demands.iter().any(|demand| demand.subscriptions.keyframe_points.is_some());
        if needs_points && points_encoding.is_none() {
            let latest = latest_messages_sender.borrow();
            let next = keyframe_log.newest_first().find(|(number, _)| !latest.keyframe_points.contains_key(number));
            if let Some((number, pose)) = next {
                let source = hub.keyframe_source(&pose.camera, pose.stamp);
                let task = encodings.spawn_blocking(move || {
                    let packed = source.and_then(|keyframe| pack_points(number, &keyframe));
                    Encoded::Points(number, packed.map(Message::binary))
                });
                points_encoding = Some((task.id(), number));
            }
        }
        let wanted = wanted_images(&demands, live_images.borrow().keys());
        // Sizes that no client wants any longer.
        image_encodings.retain(|key, image_encoding| image_encoding.is_running || wanted.contains_key(key));
        let is_unwanted = |key: &ImageKey| !wanted.contains_key(key);
        if latest_messages_sender.borrow().live_images.keys().any(is_unwanted) {
            latest_messages_sender.send_modify(|latest| latest.live_images.retain(|key, _| wanted.contains_key(key)));
        }
        let images = images_to_encode(wanted, &image_encodings, &live_images.borrow());
        for (key, image) in images {
            let entry = ImageEncoding { image: Arc::clone(&image), at: Instant::now(), is_running: true };
            image_encodings.insert(key.clone(), entry);
            encodings.spawn_blocking(move || {
                let message = live_message(&image, key.1, clock);
                Encoded::LiveImage(key, message)
            });
        }
    }
}

/// The images that clients are subscribed to, with the shortest period of all clients.
fn wanted_images<'a>(
    demands: &[Demand],
    cameras: impl Iterator<Item = &'a Arc<str>> + Clone,
) -> BTreeMap<ImageKey, Duration> {
    let mut wanted: BTreeMap<ImageKey, Duration> = BTreeMap::new();
    for demand in demands {
        for camera in cameras.clone() {
            let subscription = demand.subscriptions.images_of(camera);
            let Some(period) = subscription.period else { continue };
            let shortest = wanted.entry((Arc::clone(camera), subscription.max_px)).or_insert(period);
            *shortest = period.min(*shortest);
        }
    }
    wanted
}

/// The new images whose encoding can begin now. If a camera's images are wanted in many sizes, those come first that were
/// encoded longest ago.
fn images_to_encode(
    wanted: BTreeMap<ImageKey, Duration>,
    image_encodings: &BTreeMap<ImageKey, ImageEncoding>,
    live_images: &LiveImages,
) -> Vec<(ImageKey, Arc<LiveImage>)> {
    let mut n_running: BTreeMap<Arc<str>, usize> = BTreeMap::new();
    for ((camera, _), _) in image_encodings.iter().filter(|(_, encoding)| encoding.is_running) {
        *n_running.entry(Arc::clone(camera)).or_default() += 1;
    }
    let mut wanted: Vec<_> = wanted.into_iter().collect();
    wanted.sort_by_key(|(key, _)| image_encodings.get(key).map(|encoding| encoding.at));
    let to_encode = wanted.into_iter().filter_map(|(key, period)| {
        let image = live_images.get(&key.0)?;
        let is_new = image_encodings.get(&key).is_none_or(|encoding| {
            !encoding.is_running && encoding.at.elapsed() >= period && !Arc::ptr_eq(&encoding.image, image)
        });
        let n_running = n_running.entry(Arc::clone(&key.0)).or_default();
        if !is_new || *n_running >= MAX_IMAGE_ENCODINGS {
            return None;
        }
        *n_running += 1;
        Some((key, Arc::clone(image)))
    });
    to_encode.collect()
}

fn live_message(image: &LiveImage, max_px: [u32; 2], clock: ServerClock) -> Message {
    match pack_live_image(image, fitted(image.size_px, max_px), clock) {
        Ok(bytes) => Message::binary(bytes),
        Err(error) => {
            let message = format!("live image of camera {:?}: {error}", image.camera);
            text(&ServerMessage::Error { id: None, view: None, message: &message })
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
    use super::{ImageEncoding, ImageKey, MAX_IMAGE_ENCODINGS, images_to_encode};
    use crate::topics::updates::{LiveImage, LivePixels};
    use kinematics::Stamp;
    use std::collections::{BTreeMap, BTreeSet};
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    fn image(camera: &str) -> (Arc<str>, Arc<LiveImage>) {
        let image = LiveImage {
            camera: camera.into(),
            stamp: Stamp(1),
            captured_at: Instant::now(),
            size_px: [8, 8],
            pixels: LivePixels::Rgb(vec![0; 192].into()),
            world_from_camera: None,
            focal_px: [8.0; 2],
            principal_px: [4.0; 2],
        };
        (Arc::clone(&image.camera), Arc::new(image))
    }

    #[test]
    fn many_sizes_are_encoded_in_turn() {
        let sizes = (1..=10).map(|n| [16 * n; 2]);
        let wanted: BTreeMap<ImageKey, Duration> = sizes
            .map(|size_px| (("left".into(), size_px), Duration::ZERO))
            .chain([(("right".into(), [16; 2]), Duration::ZERO)])
            .collect();
        let mut encodings: BTreeMap<ImageKey, ImageEncoding> = BTreeMap::new();
        let mut encoded = BTreeSet::new();
        for round in 0..3 {
            // The cameras have new images.
            let images = [image("left"), image("right")].into();
            let started = images_to_encode(wanted.clone(), &encodings, &images);
            let n_left = started.iter().filter(|((camera, _), _)| &**camera == "left").count();
            assert_eq!((n_left, started.len()), (MAX_IMAGE_ENCODINGS, MAX_IMAGE_ENCODINGS + 1), "round {round}");
            for (key, image) in started {
                encoded.insert(key.clone());
                encodings.insert(key, ImageEncoding { image, at: Instant::now(), is_running: true });
            }
            let images = [image("left"), image("right")].into();
            assert!(images_to_encode(wanted.clone(), &encodings, &images).is_empty(), "all slots are in use");
            encodings.values_mut().for_each(|encoding| encoding.is_running = false);
        }
        assert_eq!(encoded.len(), wanted.len(), "no size has to wait longer");
    }
}
