//! The current images of the cameras, in the sizes that clients request.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::demands::Demand;
use crate::pictures::picture::pack_live_image;
use crate::topics::subscriptions::{LIVE_IMAGES, Subscriptions, fitted};
use crate::topics::{
    ClientState, DefaultRate, EncodeContext, EncodedMessage, Feed, LastSent, Priority, Publisher,
    Timer, Topic, TopicEntry, receiver,
};
use axum::extract::ws::Message;
use keyframe::LiveImage;
use kinematics::Transform;
use parking_lot::Mutex;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// Maximum number of images of a camera that are encoded at the same time. Clients may want many
/// different sizes. With a larger maximum, clients with unusual sizes would wait less, but encoding
/// would take more processors away from training.
const MAX_IMAGE_ENCODINGS: usize = 4;

/// Minimum time between two images for clients that have not subscribed. It is slightly shorter
/// than 200 ms, the period of the documented rate. Otherwise, a camera with 5 images per second
/// could deliver an image slightly early, and this image would have to wait.
const DEFAULT_PERIOD: Duration = Duration::from_millis(190);

/// The topic in the table.
pub(crate) const ENTRY: TopicEntry = TopicEntry {
    name: LIVE_IMAGES,
    default: DefaultRate::Period(DEFAULT_PERIOD),
    priority: Priority::Live,
    capability: None,
    start: |hub| Arc::new(LiveImageTopic::new(hub)),
};

/// Latest images by camera name.
pub(crate) type LiveImages = BTreeMap<Arc<str>, Arc<LiveImage>>;

/// The transform `reported_from_corrected` of each camera.
type CameraCorrections = BTreeMap<Arc<str>, Transform>;

/// Camera and maximum size of a live image.
type ImageKey = (Arc<str>, [u32; 2]);

/// The topic.
pub(crate) struct LiveImageTopic {
    source: Mutex<watch::Receiver<LiveImages>>,
    images: Arc<Mutex<EncodedImages>>,
}

/// The encoded images, and those that are being encoded.
#[derive(Default)]
struct EncodedImages {
    encodings: BTreeMap<ImageKey, ImageEncoding>,
    messages: BTreeMap<ImageKey, EncodedMessage>,
}

/// The image of a camera that is being encoded or was encoded last.
struct ImageEncoding {
    image: Arc<LiveImage>,
    at: Instant,
    is_running: bool,
}

impl LiveImageTopic {
    /// A topic for the images of a hub.
    pub(crate) fn new(hub: &Hub) -> Self {
        Self {
            source: Mutex::new(receiver(hub)),
            images: Arc::default(),
        }
    }

    /// Sets an image without encoding.
    #[cfg(test)]
    pub(crate) fn set(&self, camera: &str, max_px: [u32; 2], item: EncodedMessage) {
        self.images
            .lock()
            .messages
            .insert((camera.into(), max_px), item);
    }
}

impl Topic for LiveImageTopic {
    fn encode(&self, context: &EncodeContext<'_>) {
        let source = self.source.lock();
        let live_images = source.borrow();
        let wanted = wanted_images(context.settled(), live_images.keys());
        let mut images = self.images.lock();
        let EncodedImages {
            encodings,
            messages,
        } = &mut *images;
        // Sizes that no client requests any longer are forgotten, for example the previous size of
        // a resized window. The entry of a running task is kept, because it records that the task
        // is running.
        encodings.retain(|key, encoding| encoding.is_running || wanted.contains_key(key));
        messages.retain(|key, _| wanted.contains_key(key));
        for (key, image) in images_to_encode(wanted, encodings, &live_images, context.now) {
            let encoding = ImageEncoding {
                image: Arc::clone(&image),
                at: context.now,
                is_running: true,
            };
            // The period begins when encoding begins. If it began at the end of encoding, the rate
            // would be lower than requested.
            encodings.insert(key.clone(), encoding);
            let task = EncodingTask {
                key,
                images: Arc::clone(&self.images),
                publisher: context.publisher.clone(),
            };
            let clock = context.clock;
            tokio::task::spawn_blocking(move || task.run(&image, clock));
        }
    }

    fn clear(&self) {
        let mut images = self.images.lock();
        // Running tasks may still publish their images, which the next check removes.
        images.encodings.retain(|_, encoding| encoding.is_running);
        images.messages.clear();
    }

    fn feed(self: Arc<Self>) -> Box<dyn Feed> {
        Box::new(ImageFeed {
            images: Arc::clone(&self.images),
            sent: BTreeMap::new(),
        })
    }
}

/// Encodes one image. When it is dropped, the next image with the same key may be encoded, even
/// after a panic.
struct EncodingTask {
    key: ImageKey,
    images: Arc<Mutex<EncodedImages>>,
    publisher: Publisher,
}

impl EncodingTask {
    fn run(self, image: &LiveImage, clock: ServerClock) {
        let message = live_message(image, self.key.1, clock);
        self.publisher.publish(|number| {
            self.images
                .lock()
                .messages
                .insert(self.key.clone(), EncodedMessage { number, message });
        });
    }
}

impl Drop for EncodingTask {
    fn drop(&mut self) {
        if let Some(encoding) = self.images.lock().encodings.get_mut(&self.key) {
            encoding.is_running = false;
        }
    }
}

fn live_message(image: &LiveImage, max_px: [u32; 2], clock: ServerClock) -> Message {
    match pack_live_image(image, fitted(image.size_px, max_px), clock) {
        Ok(bytes) => Message::binary(bytes),
        Err(error) => {
            // Sent in place of the image, so that the operator learns why the camera shows nothing.
            let message = format!("live image of camera {:?}: {error}", image.camera);
            ServerMessage::Error {
                id: None,
                view: None,
                keyframe: None,
                message: &message,
            }
            .to_message()
        }
    }
}

/// The images that clients are subscribed to, with the shortest period of all clients.
fn wanted_images<'a>(
    demands: impl Iterator<Item = &'a Demand>,
    cameras: impl Iterator<Item = &'a Arc<str>> + Clone,
) -> BTreeMap<ImageKey, Duration> {
    let mut wanted: BTreeMap<ImageKey, Duration> = BTreeMap::new();
    for demand in demands {
        for camera in cameras.clone() {
            let subscription = demand.subscriptions.images_of(camera);
            let Some(period) = subscription.period else {
                continue;
            };
            // Each image is encoded at the highest rate that a client requests. The feeds of
            // clients with lower rates skip images.
            let shortest = wanted
                .entry((Arc::clone(camera), subscription.max_px))
                .or_insert(period);
            *shortest = period.min(*shortest);
        }
    }
    wanted
}

/// The new images whose encoding can begin now. If the images of a camera are wanted in many sizes,
/// the sizes that were encoded longest ago come first.
fn images_to_encode(
    wanted: BTreeMap<ImageKey, Duration>,
    encodings: &BTreeMap<ImageKey, ImageEncoding>,
    live_images: &LiveImages,
    now: Instant,
) -> Vec<(ImageKey, Arc<LiveImage>)> {
    let mut n_running: BTreeMap<Arc<str>, usize> = BTreeMap::new();
    for ((camera, _), _) in encodings.iter().filter(|(_, encoding)| encoding.is_running) {
        *n_running.entry(Arc::clone(camera)).or_default() += 1;
    }
    // Sizes without an encoding come first, because `None` is less than any time.
    let mut wanted: Vec<_> = wanted.into_iter().collect();
    wanted.sort_by_key(|(key, _)| encodings.get(key).map(|encoding| encoding.at));
    let to_encode = wanted.into_iter().filter_map(|(key, period)| {
        let image = live_images.get(&key.0)?;
        // Every image that is set has its own address in memory. The entry keeps its image, so the
        // address cannot be used again.
        let is_new = encodings.get(&key).is_none_or(|encoding| {
            !encoding.is_running
                && now.saturating_duration_since(encoding.at) >= period
                && !Arc::ptr_eq(&encoding.image, image)
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

/// What a client has received.
struct ImageFeed {
    images: Arc<Mutex<EncodedImages>>,
    sent: BTreeMap<Arc<str>, LastSent>,
}

impl Feed for ImageFeed {
    /// The image of the camera whose last image was sent longest ago.
    fn next(&mut self, client: &mut ClientState<'_>, timer: &mut Timer) -> Option<Message> {
        let images = self.images.lock();
        let waiting = images
            .messages
            .iter()
            .filter_map(|((camera, max_px), item)| {
                let subscription = client.subscriptions.images_of(camera);
                let sent = self.sent.get(camera).copied().unwrap_or_default();
                // Images of other sizes are for other clients.
                let is_wanted = *max_px == subscription.max_px && item.number > sent.number;
                let is_next = is_wanted && timer.is_due(sent.at, subscription.period?);
                is_next.then_some((sent.number, camera, item))
            });
        let (_, camera, item) = waiting.min_by_key(|(number, ..)| *number)?;
        self.sent.insert(
            Arc::clone(camera),
            LastSent {
                number: item.number,
                at: Some(timer.now),
            },
        );
        Some(item.message.clone())
    }
}

impl Hub {
    /// Sets the latest image of a camera. It is encoded later, on another thread, and only while
    /// clients are connected. Its pose is corrected as set by [`Self::set_camera_corrections`].
    pub fn set_live_image(&self, mut image: LiveImage) {
        let corrections = self.latest::<CameraCorrections>();
        // The pose is corrected here and not when the image is sent, so that Foxglove gets the same
        // pose.
        if let (Some(pose), Some(correction)) = (
            &mut image.world_from_camera,
            corrections.borrow().get(&image.camera),
        ) {
            *pose *= correction;
        }
        self.latest::<LiveImages>().send_modify(|images| {
            images.insert(Arc::clone(&image.camera), Arc::new(image));
        });
    }

    /// Sets `reported_from_corrected` of each camera, with which the poses of later live images are
    /// corrected.
    pub fn set_camera_corrections(&self, corrections: BTreeMap<Arc<str>, Transform>) {
        self.latest::<CameraCorrections>().send_replace(corrections);
    }

    /// Whether a client shows the images of any camera.
    pub fn needs_live_images(&self) -> bool {
        self.is_observed()
            || self
                .demands()
                .has_subscription(Subscriptions::has_live_images)
    }
}

#[cfg(test)]
mod tests {
    use super::{ImageEncoding, ImageKey, MAX_IMAGE_ENCODINGS, images_to_encode};
    use keyframe::{LiveImage, LivePixels};
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
        let mut now = Instant::now();
        for round in 0..3 {
            // The cameras have new images.
            let images = [image("left"), image("right")].into();
            now += Duration::from_millis(20);
            let started = images_to_encode(wanted.clone(), &encodings, &images, now);
            let n_left = started
                .iter()
                .filter(|((camera, _), _)| &**camera == "left")
                .count();
            assert_eq!(
                (n_left, started.len()),
                (MAX_IMAGE_ENCODINGS, MAX_IMAGE_ENCODINGS + 1),
                "round {round}"
            );
            for (key, image) in started {
                encoded.insert(key.clone());
                // The encodings begin one after another.
                now += Duration::from_micros(1);
                encodings.insert(
                    key,
                    ImageEncoding {
                        image,
                        at: now,
                        is_running: true,
                    },
                );
            }
            let images = [image("left"), image("right")].into();
            assert!(
                images_to_encode(wanted.clone(), &encodings, &images, now).is_empty(),
                "all slots are in use"
            );
            encodings
                .values_mut()
                .for_each(|encoding| encoding.is_running = false);
        }
        assert_eq!(encoded.len(), wanted.len(), "no size has to wait longer");
    }
}
