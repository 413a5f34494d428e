//! Decides which update a client receives next, according to its subscriptions.

use crate::pictures::viewpoint::Viewpoint;
use crate::topics::broadcast::{Item, LatestMessages};
use crate::topics::chunk_sender::{ChunkSender, NextChunk};
use crate::topics::keyframe_log::{Changes, ListPosition};
use crate::topics::subscriptions::Subscriptions;
use axum::extract::ws::Message;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What a client has received.
#[derive(Debug, Default)]
pub(crate) struct ClientUpdates {
    scene: u64,
    robot: u64,
    status: Sent,
    keyframe_list: Sent,
    keyframe_changes: ListPosition,
    /// When the client's list was last up to date.
    keyframe_changes_at: Option<Instant>,
    /// Number of the subscription to keyframes that the list belongs to.
    n_keyframe_lists: u64,
    live_images: BTreeMap<Arc<str>, Sent>,
    base_path: Sent,
    range_scans: BTreeMap<Arc<str>, Sent>,
    observations: Sent,
    /// Whether the last long message was a live image.
    was_image: bool,
    /// Numbers of the keyframes whose points were sent, and the time of the last ones.
    keyframe_points: BTreeSet<u64>,
    keyframe_points_at: Option<Instant>,
    /// Number of the subscription to points that these points belong to.
    n_point_subscriptions: u64,
    model_chunks: ChunkSender,
    /// Viewpoint of the client's newest picture.
    pub(crate) viewpoint: Option<Viewpoint>,
}

/// Number of the last item of a kind, and when it was sent.
#[derive(Clone, Copy, Debug, Default)]
struct Sent {
    number: u64,
    at: Option<Instant>,
}

impl Sent {
    /// The message of a newer item if the client has subscribed to this kind and its period is over.
    fn next(&mut self, (period, latest): (Option<Duration>, &Option<Item>), timer: &mut Timer) -> Option<Message> {
        let item = latest.as_ref().filter(|item| item.number > self.number)?;
        if !timer.is_due(self.at, period?) {
            return None;
        }
        *self = Self { number: item.number, at: Some(timer.now) };
        Some(item.message.clone())
    }
}

/// What to do next.
#[derive(Debug, PartialEq)]
pub(crate) enum Next {
    /// Sends this message, which is short.
    Short(Message),
    /// Sends this message, which may be long.
    Long(Message),
    /// Waits until this time, unless something changes before.
    WaitUntil(Instant),
    /// Waits until something changes.
    Wait,
}

/// Decides which items are due, and remembers when the next one is.
struct Timer {
    now: Instant,
    earliest: Option<Instant>,
}

impl Timer {
    /// Whether an item may be sent after this period since the last one.
    fn is_due(&mut self, last: Option<Instant>, period: Duration) -> bool {
        let due = last.and_then(|at| at.checked_add(period)).unwrap_or(self.now);
        if due > self.now {
            self.wait_until(due);
        }
        due <= self.now
    }

    /// Records that an item is due at this time.
    fn wait_until(&mut self, due: Instant) {
        self.earliest = Some(self.earliest.map_or(due, |earliest| earliest.min(due)));
    }
}

impl ClientUpdates {
    /// The next message, which counts as sent. Short messages come first; long ones follow only if `allows_long` is set.
    pub(crate) fn next(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        has_keyframe_changes: bool,
        now: Instant,
        allows_long: bool,
    ) -> Next {
        let mut timer = Timer { now, earliest: None };
        if let Some(message) = self.next_short(latest, subscriptions, &mut timer) {
            return Next::Short(message);
        }
        self.restart(subscriptions);
        if allows_long {
            // Images and keyframes alternate, so that neither delays the other for long.
            for is_image in [!self.was_image, self.was_image] {
                let message = if is_image {
                    self.next_image(latest, subscriptions, &mut timer)
                        .or_else(|| self.next_scan(latest, subscriptions, &mut timer))
                } else if has_keyframe_changes {
                    self.next_changes(latest, subscriptions, &mut timer)
                        .or_else(|| self.next_points(latest, subscriptions, &mut timer))
                } else {
                    self.next_list(latest, subscriptions, &mut timer)
                };
                if let Some(message) = message {
                    self.was_image = is_image;
                    return Next::Long(message);
                }
            }
            let observations = (subscriptions.observations, &latest.observations);
            if let Some(message) = self.observations.next(observations, &mut timer) {
                return Next::Long(message);
            }
            if let Some(message) = self.next_chunk(latest, subscriptions, &mut timer) {
                return Next::Long(message);
            }
        }
        timer.earliest.map_or(Next::Wait, Next::WaitUntil)
    }

    /// Whether the robot was sent. States without it cannot be drawn.
    pub(crate) fn has_robot(&self) -> bool {
        self.robot > 0
    }

    fn next_short(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        if let Some(scene) = newer(latest.scene.as_ref(), &mut self.scene) {
            return Some(scene);
        }
        if let Some(status) = self.status.next((subscriptions.status, &latest.status), timer) {
            return Some(status);
        }
        if let Some(path) = self.base_path.next((subscriptions.base_path, &latest.base_path), timer) {
            return Some(path);
        }
        subscriptions.robot_state.and_then(|_| newer(latest.robot.as_ref(), &mut self.robot))
    }

    /// Forgets what was sent for earlier subscriptions: new ones begin with the complete list, and with all points.
    fn restart(&mut self, subscriptions: &Subscriptions) {
        if subscriptions.n_keyframe_lists > self.n_keyframe_lists {
            self.n_keyframe_lists = subscriptions.n_keyframe_lists;
            self.keyframe_list = Sent::default();
            (self.keyframe_changes, self.keyframe_changes_at) = (ListPosition::default(), None);
        }
        if subscriptions.n_point_subscriptions > self.n_point_subscriptions {
            self.n_point_subscriptions = subscriptions.n_point_subscriptions;
            self.keyframe_points.clear();
        }
    }

    /// The image of the camera whose last image was sent longest ago.
    fn next_image(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        let waiting = latest.live_images.iter().filter_map(|((camera, max_px), item)| {
            let subscription = subscriptions.images_of(camera);
            let sent = self.live_images.get(camera).copied().unwrap_or_default();
            let is_wanted = *max_px == subscription.max_px && item.number > sent.number;
            let is_next = is_wanted && timer.is_due(sent.at, subscription.period?);
            is_next.then_some((sent.number, camera, item))
        });
        let (_, camera, item) = waiting.min_by_key(|(number, ..)| *number)?;
        self.live_images.insert(Arc::clone(camera), Sent { number: item.number, at: Some(timer.now) });
        Some(item.message.clone())
    }

    /// The scan of the scanner whose last scan was sent longest ago.
    fn next_scan(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        let period = subscriptions.range_scans?;
        let waiting = latest.range_scans.iter().filter_map(|(scanner, item)| {
            let sent = self.range_scans.get(scanner).copied().unwrap_or_default();
            (item.number > sent.number && timer.is_due(sent.at, period)).then_some((sent.number, scanner, item))
        });
        let (_, scanner, item) = waiting.min_by_key(|(number, ..)| *number)?;
        self.range_scans.insert(Arc::clone(scanner), Sent { number: item.number, at: Some(timer.now) });
        Some(item.message.clone())
    }

    /// The complete list of keyframes.
    fn next_list(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        self.keyframe_list.next((subscriptions.keyframes, &latest.keyframe_list), timer)
    }

    /// Changes of the list of keyframes.
    fn next_changes(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        let log = latest.keyframe_log.as_ref().filter(|log| !log.is_up_to_date(self.keyframe_changes))?;
        if !timer.is_due(self.keyframe_changes_at, subscriptions.keyframes?) {
            return None;
        }
        let Changes { json, position, is_new_list } = log.next_changes(self.keyframe_changes)?;
        if is_new_list {
            // Clients discard points together with their keyframes.
            self.keyframe_points.clear();
        }
        // The parts of a long list follow each other.
        self.keyframe_changes_at = log.is_up_to_date(position).then_some(timer.now);
        self.keyframe_changes = position;
        Some(Message::text(json))
    }

    /// A chunk of the model that the client draws, or the ids of removed chunks.
    fn next_chunk(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        let subscription = subscriptions.model_chunks.as_ref()?;
        let list = latest.model_chunks.get(&subscription.method)?;
        match self.model_chunks.next(list, subscription, self.viewpoint.as_ref(), timer.now) {
            NextChunk::Send(message) => Some(message),
            NextChunk::WaitUntil(due) => {
                timer.wait_until(due);
                None
            }
            NextChunk::Wait => None,
        }
    }

    /// The points of the newest keyframe that the client has without points.
    fn next_points(
        &mut self,
        latest: &LatestMessages,
        subscriptions: &Subscriptions,
        timer: &mut Timer,
    ) -> Option<Message> {
        let period = subscriptions.keyframe_points?;
        let log = latest.keyframe_log.as_ref()?;
        self.keyframe_points.retain(|number| latest.keyframe_points.contains_key(number));
        let mut newest_first = latest.keyframe_points.iter().rev();
        let (number, message) = newest_first.find_map(|(number, message)| {
            let is_next = !self.keyframe_points.contains(number) && log.is_sent(*number, self.keyframe_changes);
            Some((number, message.as_ref()?)).filter(|_| is_next)
        })?;
        if !timer.is_due(self.keyframe_points_at, period) {
            return None;
        }
        self.keyframe_points.insert(*number);
        self.keyframe_points_at = Some(timer.now);
        Some(message.clone())
    }
}

/// The item's message if it is newer than the last one.
fn newer(item: Option<&Item>, number: &mut u64) -> Option<Message> {
    let item = item.filter(|item| item.number > *number)?;
    *number = item.number;
    Some(item.message.clone())
}

#[cfg(test)]
mod tests {
    use super::{ClientUpdates, Next};
    use crate::session::protocol::SubscribeMessage;
    use crate::topics::broadcast::{Item, LatestMessages};
    use crate::topics::keyframe_log::KeyframeLog;
    use crate::topics::subscriptions::Subscriptions;
    use crate::topics::updates::KeyframePose;
    use axum::extract::ws::Message;
    use kinematics::{Stamp, Transform};
    use serde_json::{Value, json};
    use std::collections::BTreeSet;
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    const DEFAULT_PX: [u32; 2] = [640, u32::MAX];

    fn item(number: u64) -> Item {
        Item { number, message: Message::text(number.to_string()) }
    }

    /// A client at a time that the test advances.
    struct Client {
        updates: ClientUpdates,
        subscriptions: Subscriptions,
        now: Instant,
    }

    impl Client {
        fn new() -> Self {
            Self { updates: ClientUpdates::default(), subscriptions: Subscriptions::default(), now: Instant::now() }
        }

        fn subscribe(&mut self, message: Value) {
            let message: SubscribeMessage = serde_json::from_value(message).expect("valid");
            self.subscriptions.apply(message).expect("valid");
        }

        fn next(&mut self, latest: &LatestMessages, allows_long: bool) -> Option<String> {
            match self.updates.next(latest, &self.subscriptions, false, self.now, allows_long) {
                Next::Short(message) | Next::Long(message) => Some(message.into_text().expect("text").to_string()),
                Next::WaitUntil(_) | Next::Wait => None,
            }
        }
    }

    #[test]
    fn short_messages_first_then_cameras_round_robin() {
        let mut latest = LatestMessages { scene: Some(item(1)), status: Some(item(4)), ..LatestMessages::default() };
        latest.keyframe_list = Some(item(2));
        latest.live_images = [(("left".into(), DEFAULT_PX), item(3)), (("right".into(), DEFAULT_PX), item(5))].into();
        let mut client = Client::new();
        assert_eq!(client.next(&latest, false).as_deref(), Some("1"));
        assert_eq!(client.next(&latest, false).as_deref(), Some("4"));
        assert_eq!(client.next(&latest, false), None, "only long messages are left");
        assert_eq!(client.next(&latest, true).as_deref(), Some("3"));
        latest.live_images.insert(("left".into(), DEFAULT_PX), item(6));
        assert_eq!(client.next(&latest, true).as_deref(), Some("2"), "keyframes come after at most one image");
        assert_eq!(client.next(&latest, true).as_deref(), Some("5"), "the other camera comes next");
        client.now += Duration::from_millis(200);
        assert_eq!(client.next(&latest, true).as_deref(), Some("6"));
        assert_eq!(client.next(&latest, true), None);
    }

    #[test]
    fn each_topic_has_its_own_rate() {
        let mut latest = LatestMessages::default();
        let mut client = Client::new();
        client.subscribe(json!({"topic": "status", "rate_hz": 2}));
        client.subscribe(json!({"topic": "live_images", "rate_hz": 10, "size_px": [192, 192]}));
        let (mut n_status, mut n_images) = (0, 0);
        for tick in 0..200_u64 {
            latest.status = Some(item(3 * tick + 1));
            latest.live_images.insert(("left".into(), [192, 192]), item(3 * tick + 2));
            // An image of a size for another client.
            latest.live_images.insert(("left".into(), DEFAULT_PX), item(3 * tick + 3));
            while let Some(sent) = client.next(&latest, true) {
                match sent.parse::<u64>().expect("a number") % 3 {
                    1 => n_status += 1,
                    2 => n_images += 1,
                    _ => panic!("an image of the wrong size"),
                }
            }
            client.now += Duration::from_millis(20);
        }
        assert_eq!((n_status, n_images), (8, 40), "in 4 s");
        client.subscribe(json!({"topic": "live_images", "rate_hz": 0}));
        client.subscribe(json!({"topic": "status", "rate_hz": 0}));
        latest.status = Some(item(9000));
        latest.live_images.insert(("left".into(), DEFAULT_PX), item(9001));
        client.now += Duration::from_secs(9);
        assert_eq!(client.next(&latest, true), None);
    }

    #[test]
    fn the_end_of_a_pause_is_known() {
        let mut client = Client::new();
        let mut latest = LatestMessages { status: Some(item(1)), ..LatestMessages::default() };
        assert_eq!(client.next(&latest, true).as_deref(), Some("1"));
        let now = client.now;
        assert_eq!(client.updates.next(&latest, &client.subscriptions, false, now, true), Next::Wait);
        latest.status = Some(item(2));
        let next = client.updates.next(&latest, &client.subscriptions, false, now, true);
        assert_eq!(next, Next::WaitUntil(now + Duration::from_millis(190)));
    }

    #[test]
    fn robot_is_sent_once_to_subscribed_clients() {
        let latest = LatestMessages { robot: Some(item(1)), ..LatestMessages::default() };
        let mut client = Client::new();
        assert_eq!(client.next(&latest, true), None);
        client.subscribe(json!({"topic": "robot_state", "rate_hz": 60}));
        assert_eq!(client.next(&latest, true).as_deref(), Some("1"));
        assert_eq!(client.next(&latest, true), None);
    }

    fn keyframes(n: i64) -> Vec<KeyframePose> {
        let keyframe = |ix| KeyframePose {
            camera: "wrist".into(),
            stamp: Stamp(ix),
            world_from_camera: Transform::identity(),
            size_px: [640, 480],
            focal_px: [600.0; 2],
            principal_px: [320.0, 240.0],
        };
        (0..n).map(keyframe).collect()
    }

    /// A client that draws keyframes and their points, with the numbers that it has.
    struct PointsClient {
        client: Client,
        log: KeyframeLog,
        latest: LatestMessages,
        keyframes: BTreeSet<u64>,
        points: BTreeSet<u64>,
        /// Numbers of points that came without their keyframe.
        n_dropped: usize,
    }

    impl PointsClient {
        fn new() -> Self {
            let mut client = Client::new();
            client.subscribe(json!({"topic": "keyframes", "rate_hz": 2}));
            client.subscribe(json!({"topic": "keyframe_points", "rate_hz": 20}));
            Self {
                client,
                log: KeyframeLog::default(),
                latest: LatestMessages::default(),
                keyframes: BTreeSet::new(),
                points: BTreeSet::new(),
                n_dropped: 0,
            }
        }

        /// Sets a list of this many keyframes, all with points.
        fn set_keyframes(&mut self, n: i64) {
            self.log.set(&keyframes(n));
            let points = |number: u64| (number, Some(Message::text(number.to_string())));
            self.latest.keyframe_points = self.log.newest_first().map(|(number, _)| points(number)).collect();
            self.latest.keyframe_log = Some(Arc::new(self.log.clone()));
        }

        fn next(&mut self) -> Next {
            let Client { updates, subscriptions, now } = &mut self.client;
            updates.next(&self.latest, subscriptions, true, *now, true)
        }

        /// Receives what is sent within a time. Like the page, drops points without a keyframe.
        fn receive(&mut self, millis: u64) {
            for _ in 0..millis / 10 {
                while let Next::Short(message) | Next::Long(message) = self.next() {
                    self.apply(&message.into_text().expect("text"));
                }
                self.client.now += Duration::from_millis(10);
            }
        }

        fn apply(&mut self, text: &str) {
            match serde_json::from_str(text).expect("JSON") {
                Value::Number(number) => {
                    let number = number.as_u64().expect("an integer");
                    if self.keyframes.contains(&number) {
                        self.points.insert(number);
                    } else {
                        self.n_dropped += 1;
                    }
                }
                changes => {
                    if changes["from_version"] == 0 {
                        self.keyframes.clear();
                    }
                    let list = |name: &str| changes[name].as_array().expect("a list").clone();
                    self.keyframes.extend(list("keyframes").iter().filter_map(|keyframe| keyframe["id"].as_u64()));
                    for number in list("removed").iter().filter_map(Value::as_u64) {
                        self.keyframes.remove(&number);
                    }
                    self.points.retain(|number| self.keyframes.contains(number));
                }
            }
        }
    }

    #[test]
    fn points_come_after_their_keyframes() {
        let mut viewer = PointsClient::new();
        for n in 1..=60 {
            viewer.set_keyframes(n);
            viewer.receive(100);
        }
        viewer.receive(1000);
        assert_eq!((viewer.keyframes.len(), viewer.points.len(), viewer.n_dropped), (60, 60, 0));
    }

    #[test]
    fn new_lists_and_subscriptions_bring_all_points_again() {
        let mut viewer = PointsClient::new();
        viewer.set_keyframes(50);
        viewer.receive(4000);
        assert_eq!(viewer.points.len(), 50);
        viewer.client.subscribe(json!({"topic": "keyframes", "rate_hz": 2}));
        viewer.receive(4000);
        assert_eq!((viewer.keyframes.len(), viewer.points.len()), (50, 50), "after a new list");
        // Off and on again, faster than the server looks.
        viewer.points.clear();
        viewer.client.subscribe(json!({"topic": "keyframe_points", "rate_hz": 0}));
        viewer.client.subscribe(json!({"topic": "keyframe_points", "rate_hz": 20}));
        viewer.receive(4000);
        assert_eq!((viewer.points.len(), viewer.n_dropped), (50, 0), "after a new subscription");
    }

    #[test]
    fn keyframes_are_sent_between_images() {
        let mut viewer = PointsClient::new();
        viewer.client.subscribe(json!({"topic": "live_images", "rate_hz": 100}));
        viewer.set_keyframes(200);
        let mut n_images = 0_u64;
        while viewer.keyframes.len() < 200 {
            // The link is so slow that a new image always waits.
            viewer.client.now += Duration::from_millis(200);
            viewer.latest.live_images.insert(("left".into(), DEFAULT_PX), item(1 + n_images));
            match viewer.next() {
                Next::Long(message) if message == item(1 + n_images).message => n_images += 1,
                Next::Long(message) => viewer.apply(&message.into_text().expect("text")),
                other => panic!("{other:?} instead of a message"),
            }
            assert!(n_images <= 20, "only {} keyframes after {n_images} images", viewer.keyframes.len());
        }
        assert!(n_images >= 6, "images are sent, too");
    }
}
