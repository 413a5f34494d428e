//! How often and at which size a client receives each kind of data.

use crate::client::protocol::{MAX_RATE_HZ, SubscribeMessage};
use crate::pictures::view_request::InvalidRequest;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Topic whose subscriptions can choose a camera and a size.
pub(crate) const LIVE_IMAGES: &str = "live_images";
/// Topic whose subscriptions choose a model and a budget.
pub(crate) const MODEL_CHUNKS: &str = "model_chunks";
/// Maximum number of cameras with a separate subscription. A client can name cameras that do not
/// exist, so the list needs a limit.
const MAX_CAMERAS: usize = 64;
/// Maximum length of a camera name, bytes.
const MAX_NAME_BYTES: usize = 256;
/// Maximum size of live images unless a client subscribes to another one: 640 pixels wide, any
/// height.
const DEFAULT_IMAGE_PX: [u32; 2] = [640, u32::MAX];
/// Minimum size of live images, pixels. Larger sizes are rounded down to multiples of it, so that
/// clients of similar sizes share images. With larger steps, more clients share an image, but its
/// size fits their windows less well.
const MIN_IMAGE_PX: u32 = 16;
/// Default rate at which changed chunks are sent: 4.8 Mbit/s leaves room on ordinary wireless
/// links.
const DEFAULT_CHUNK_BYTES_PER_SEC: f64 = 6e5;
/// Limits of that rate. Dividing by it gives the time until a chunk is due, so it must not be close
/// to zero.
const CHUNK_BYTES_PER_SEC: std::ops::RangeInclusive<f64> = 1e4..=1e9;
/// Longest period. Subscriptions with longer periods get one message a day.
const MAX_PERIOD: Duration = Duration::from_secs(86_400);

/// The subscriptions of one client.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Subscriptions {
    /// Subscriptions by name of the topic.
    topics: BTreeMap<&'static str, Subscription>,
    /// Chunks of a model; `None` if not sent.
    pub(crate) model_chunks: Option<ChunkSubscription>,
    /// Images of cameras without a separate subscription.
    live_images: ImageSubscription,
    /// Images of single cameras.
    cameras: BTreeMap<Arc<str>, ImageSubscription>,
}

/// Subscription to a topic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Subscription {
    /// Minimum time between two messages; `None` if the topic is not sent.
    period: Option<Duration>,
    /// Number of subscriptions so far.
    number: u64,
}

/// Subscription to the images of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ImageSubscription {
    /// Minimum time between two images; `None` if none are sent.
    pub(crate) period: Option<Duration>,
    /// Maximum width and height. Larger images are downscaled.
    pub(crate) max_px: [u32; 2],
}

/// Subscription to the chunks of a model.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ChunkSubscription {
    /// Counts the subscriptions of the client. Each of them begins with all chunks.
    pub(crate) number: u64,
    /// The model.
    pub(crate) method: Arc<str>,
    /// Minimum time between two versions of a chunk.
    pub(crate) period: Duration,
    /// Budget for chunks that the client already has in an older version.
    pub(crate) max_bytes_per_sec: f64,
}

impl Subscriptions {
    /// The subscriptions of a client that has sent none, from the names of the topics and their
    /// default periods.
    pub(crate) fn new(
        default_periods: impl IntoIterator<Item = (&'static str, Option<Duration>)>,
    ) -> Self {
        let topics: BTreeMap<&'static str, Subscription> = default_periods
            .into_iter()
            .map(|(name, period)| (name, Subscription { period, number: 0 }))
            .collect();
        // Images have two entries. The entry in `topics` only counts the subscriptions. This entry
        // decides what is sent.
        let live_images = ImageSubscription {
            period: topics.get(LIVE_IMAGES).and_then(|topic| topic.period),
            max_px: DEFAULT_IMAGE_PX,
        };
        Self {
            topics,
            model_chunks: None,
            live_images,
            cameras: BTreeMap::new(),
        }
    }

    /// Applies a client's message.
    pub(crate) fn apply(&mut self, message: SubscribeMessage) -> Result<(), InvalidRequest> {
        // Everything is checked before the first change, so that a rejected message changes
        // nothing.
        let topic = self.checked_topic(&message)?;
        let SubscribeMessage {
            rate_hz,
            camera,
            size_px,
            method,
            max_bytes_per_sec,
            ..
        } = message;
        // A rate close to 0 has a period that is too long for a `Duration`, or even infinite.
        let period = Duration::try_from_secs_f64(1.0 / rate_hz)
            .unwrap_or(MAX_PERIOD)
            .min(MAX_PERIOD);
        let period = (rate_hz > 0.0).then_some(period);
        if topic == MODEL_CHUNKS {
            self.model_chunks = self.chunk_subscription(period, method, max_bytes_per_sec)?;
        }
        if topic == LIVE_IMAGES {
            let rounded =
                |size_px: [u32; 2]| size_px.map(|side| side / MIN_IMAGE_PX * MIN_IMAGE_PX);
            let images = ImageSubscription {
                period,
                max_px: size_px.map_or(DEFAULT_IMAGE_PX, rounded),
            };
            match camera {
                None => self.live_images = images,
                Some(camera) => self.set_camera(camera, images)?,
            }
        }
        // The number grows with every message, even if the rate stays the same. Some topics send
        // all data again after a new subscription, so a client can request all data by subscribing
        // again.
        let number = 1 + self.number(topic);
        self.topics.insert(topic, Subscription { period, number });
        Ok(())
    }

    /// The topic of a message. It is an error if fields of the message do not apply to the topic.
    fn checked_topic(&self, message: &SubscribeMessage) -> Result<&'static str, InvalidRequest> {
        let Some((&topic, _)) = self.topics.get_key_value(&*message.topic) else {
            let known = self.topics.keys().copied().collect();
            let got = message.topic.clone();
            return Err(InvalidRequest::Topic { got, known });
        };
        // The comparison is written so that a NaN is rejected.
        if !(0.0..=MAX_RATE_HZ).contains(&message.rate_hz) {
            return Err(InvalidRequest::Rate {
                got: message.rate_hz,
            });
        }
        // Fields of other topics are refused: a client that sends them expects an effect.
        if topic != LIVE_IMAGES && (message.camera.is_some() || message.size_px.is_some()) {
            return Err(InvalidRequest::NotImages);
        }
        if topic != MODEL_CHUNKS
            && (message.method.is_some() || message.max_bytes_per_sec.is_some())
        {
            return Err(InvalidRequest::NotChunks);
        }
        // Smaller sizes would be rounded down to 0.
        let is_too_small = |size_px: &[u32; 2]| size_px.iter().any(|side| *side < MIN_IMAGE_PX);
        if let Some(got) = message.size_px.filter(is_too_small) {
            return Err(InvalidRequest::ImageSize {
                got,
                min: MIN_IMAGE_PX,
            });
        }
        Ok(topic)
    }

    /// Minimum time between two messages of a topic; `None` if it is not sent.
    pub(crate) fn period(&self, topic: &str) -> Option<Duration> {
        self.topics.get(topic)?.period
    }

    /// Number of subscriptions to a topic so far.
    pub(crate) fn number(&self, topic: &str) -> u64 {
        self.topics
            .get(topic)
            .map_or(0, |subscription| subscription.number)
    }

    /// The subscription to chunks that a message describes; `None` if it ends the subscription.
    fn chunk_subscription(
        &self,
        period: Option<Duration>,
        method: Option<String>,
        max_bytes_per_sec: Option<f64>,
    ) -> Result<Option<ChunkSubscription>, InvalidRequest> {
        let Some(period) = period else {
            return Ok(None);
        };
        let method = method
            .filter(|name| name.len() <= MAX_NAME_BYTES)
            .ok_or(InvalidRequest::NoMethod)?;
        let max_bytes_per_sec = max_bytes_per_sec.unwrap_or(DEFAULT_CHUNK_BYTES_PER_SEC);
        if !CHUNK_BYTES_PER_SEC.contains(&max_bytes_per_sec) {
            return Err(InvalidRequest::ByteRate {
                got: max_bytes_per_sec,
            });
        }
        let number = 1 + self.number(MODEL_CHUNKS);
        Ok(Some(ChunkSubscription {
            number,
            method: method.into(),
            period,
            max_bytes_per_sec,
        }))
    }

    /// The subscription to the images of a camera.
    pub(crate) fn images_of(&self, camera: &str) -> ImageSubscription {
        self.cameras
            .get(camera)
            .copied()
            .unwrap_or(self.live_images)
    }

    /// Whether the images of any camera are sent.
    pub(crate) fn has_live_images(&self) -> bool {
        std::iter::once(&self.live_images)
            .chain(self.cameras.values())
            .any(|images| images.period.is_some())
    }

    /// Subscribes to the images of one camera, instead of the subscription for all cameras.
    fn set_camera(
        &mut self,
        camera: String,
        images: ImageSubscription,
    ) -> Result<(), InvalidRequest> {
        // At the limit, the rate of a known camera can still be changed.
        let is_known = self.cameras.contains_key(&*camera);
        if camera.len() > MAX_NAME_BYTES || (!is_known && self.cameras.len() >= MAX_CAMERAS) {
            return Err(InvalidRequest::Cameras {
                max: MAX_CAMERAS,
                max_bytes: MAX_NAME_BYTES,
            });
        }
        self.cameras.insert(camera.into(), images);
        Ok(())
    }
}

/// The largest size within `max_px` that has the aspect ratio of `size_px`, and at least one pixel.
/// Images are never enlarged.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "smaller than the image"
)]
pub(crate) fn fitted(size_px: [u32; 2], max_px: [u32; 2]) -> [u32; 2] {
    // An image without pixels must not lead to a division by zero.
    let ratio = |axis: usize| f64::from(max_px[axis]) / f64::from(size_px[axis].max(1));
    let scale = ratio(0).min(ratio(1)).min(1.0);
    // The short side of a long, thin image would be rounded to 0 pixels.
    size_px.map(|side| ((f64::from(side) * scale).round() as u32).clamp(1, side.max(1)))
}

#[cfg(test)]
mod tests {
    use super::{MAX_CAMERAS, Subscriptions, fitted};
    use crate::client::protocol::SubscribeMessage;
    use serde_json::{Value, json};
    use std::time::Duration;

    fn apply(subscriptions: &mut Subscriptions, message: Value) -> Result<(), String> {
        let message = serde_json::from_value::<SubscribeMessage>(message)
            .map_err(|error| error.to_string())?;
        subscriptions
            .apply(message)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn cameras_have_their_own_size_and_rate() {
        let mut subscriptions = Subscriptions::default();
        assert_eq!(subscriptions.images_of("wrist").max_px[0], 640);
        apply(
            &mut subscriptions,
            json!({"topic": "live_images", "rate_hz": 2.0, "size_px": [240, 255]}),
        )
        .expect("valid");
        apply(
            &mut subscriptions,
            json!({"topic": "live_images", "rate_hz": 0, "camera": "rear"}),
        )
        .expect("valid");
        assert_eq!(subscriptions.images_of("wrist").max_px, [240, 240]);
        assert_eq!(
            subscriptions.images_of("wrist").period,
            Some(Duration::from_millis(500))
        );
        assert_eq!(subscriptions.images_of("rear").period, None);
        assert!(subscriptions.has_live_images());
        apply(
            &mut subscriptions,
            json!({"topic": "live_images", "rate_hz": 0}),
        )
        .expect("valid");
        assert!(
            !subscriptions.has_live_images(),
            "neither the rear camera nor the others"
        );
        apply(
            &mut subscriptions,
            json!({"topic": "live_images", "rate_hz": 1, "camera": "front"}),
        )
        .expect("valid");
        assert!(subscriptions.has_live_images(), "the front camera");
        assert_eq!(
            subscriptions.period("robot_state"),
            None,
            "costs nothing until a client subscribes"
        );
        apply(
            &mut subscriptions,
            json!({"topic": "robot_state", "rate_hz": 50}),
        )
        .expect("valid");
        assert_eq!(
            subscriptions.period("robot_state"),
            Some(Duration::from_millis(20))
        );
        // The smallest positive number is a valid rate.
        apply(
            &mut subscriptions,
            json!({"topic": "status", "rate_hz": 5e-324}),
        )
        .expect("valid");
        assert_eq!(
            subscriptions.period("status"),
            Some(Duration::from_secs(86_400))
        );
    }

    #[test]
    fn invalid_subscriptions_are_rejected() {
        let mut subscriptions = Subscriptions::default();
        for (message, named) in [
            (
                json!({"topic": "tides", "rate_hz": 1}),
                "\"tides\", expected base_path, keyframe_points, ",
            ),
            (json!({"topic": "scene", "rate_hz": 1}), "\"scene\""),
            (json!({"topic": "status"}), "rate_hz"),
            (json!({"topic": "status", "rate_hz": -1}), "rate_hz is -1"),
            (json!({"topic": "status", "rate_hz": 101}), "rate_hz is 101"),
            (
                json!({"topic": "status", "rate_hz": 1, "size_px": [9, 9]}),
                "live_images",
            ),
            (
                json!({"topic": "live_images", "rate_hz": 1, "size_px": [9, 100]}),
                "16",
            ),
            (
                json!({"topic": "live_images", "rate_hz": 1, "colour": true}),
                "colour",
            ),
            (json!({"topic": "model_chunks", "rate_hz": 1}), "method"),
            (
                json!({"topic": "model_chunks", "rate_hz": 1, "method": "m".repeat(999)}),
                "method",
            ),
            (
                json!({"topic": "model_chunks", "rate_hz": 1, "method": "m", "max_bytes_per_sec": 1}),
                "10000",
            ),
            (
                json!({"topic": "status", "rate_hz": 1, "method": "splat"}),
                "model_chunks",
            ),
        ] {
            let error = apply(&mut subscriptions, message.clone()).expect_err("invalid");
            assert!(error.contains(named), "{message}: {error}");
        }
        assert_eq!(subscriptions, Subscriptions::default());
        let of_camera =
            |ix: usize| json!({"topic": "live_images", "rate_hz": 1, "camera": ix.to_string()});
        for ix in 0..MAX_CAMERAS {
            apply(&mut subscriptions, of_camera(ix)).expect("valid");
        }
        assert!(
            apply(&mut subscriptions, of_camera(MAX_CAMERAS))
                .expect_err("too many")
                .contains("64")
        );
        apply(&mut subscriptions, of_camera(0)).expect("a known camera can be changed");
    }

    #[test]
    fn images_keep_their_aspect_ratio_and_are_never_enlarged() {
        for (size_px, max_px, expected) in [
            ([1280, 720], [640, u32::MAX], [640, 360]),
            ([640, 480], [240, 240], [240, 180]),
            ([480, 640], [240, 240], [180, 240]),
            ([320, 240], [640, u32::MAX], [320, 240]),
            ([4000, 1], [640, u32::MAX], [640, 1]),
        ] {
            assert_eq!(fitted(size_px, max_px), expected);
        }
    }
}
