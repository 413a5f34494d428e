//! Decides which message of a topic a client receives next.

use crate::pictures::viewpoint::Viewpoint;
use crate::topics::subscriptions::Subscriptions;
use crate::topics::{ClientState, Feed, KeyframeProgress, Priority, TOPICS, Timer, Topic};
use axum::extract::ws::Message;
use std::sync::Arc;
use std::time::Instant;

/// The feeds of a client.
pub(crate) struct ClientUpdates {
    /// In the order of the table.
    feeds: Vec<NamedFeed>,
    keyframes: KeyframeProgress,
    /// Whether the last message about live data or keyframes was about live data.
    was_live: bool,
    /// Viewpoint of the client's newest picture.
    pub(crate) viewpoint: Option<Viewpoint>,
}

/// A feed, and the entry of its topic in the table.
pub(crate) struct NamedFeed {
    pub(crate) name: &'static str,
    pub(crate) priority: Priority,
    pub(crate) feed: Box<dyn Feed>,
}

/// The data that a client has requested.
#[derive(Clone, Copy)]
struct ClientNeeds<'a> {
    subscriptions: &'a Subscriptions,
    has_keyframe_changes: bool,
}

/// What to do next.
#[derive(Debug, PartialEq)]
pub(crate) enum NextUpdate {
    /// Sends this message, which is short.
    Short(Message),
    /// Sends this message, which may be long.
    Long(Message),
    /// Waits until this time, unless something changes before.
    WaitUntil(Instant),
    /// Waits until something changes.
    Wait,
}

impl ClientUpdates {
    /// The feeds of a client that has received nothing.
    pub(crate) fn new(topics: &[Arc<dyn Topic>]) -> Self {
        // `start_all` has started the topics in the order of the table.
        let feeds = TOPICS.iter().zip(topics).map(|(entry, topic)| NamedFeed {
            name: entry.name,
            priority: entry.priority,
            feed: Arc::clone(topic).feed(),
        });
        Self::of_feeds(feeds.collect())
    }

    fn of_feeds(feeds: Vec<NamedFeed>) -> Self {
        Self {
            feeds,
            keyframes: KeyframeProgress::default(),
            was_live: false,
            viewpoint: None,
        }
    }

    /// The next message, which counts as sent. Short messages come first; long ones follow only if
    /// `allows_long` is set.
    pub(crate) fn next(
        &mut self,
        subscriptions: &Subscriptions,
        has_keyframe_changes: bool,
        now: Instant,
        allows_long: bool,
    ) -> NextUpdate {
        let mut timer = Timer::new(now);
        let client = ClientNeeds {
            subscriptions,
            has_keyframe_changes,
        };
        if let Some(message) = self.next_of(Priority::Short, client, &mut timer) {
            return NextUpdate::Short(message);
        }
        if allows_long {
            // Live data and keyframes take turns. On a slow link, a new image waits whenever the
            // last one has been sent. With a fixed order, keyframes would then never be sent.
            let in_turn = if self.was_live {
                [Priority::Keyframes, Priority::Live]
            } else {
                [Priority::Live, Priority::Keyframes]
            };
            for priority in in_turn {
                if let Some(message) = self.next_of(priority, client, &mut timer) {
                    self.was_live = priority == Priority::Live;
                    return NextUpdate::Long(message);
                }
            }
            if let Some(message) = self.next_of(Priority::Background, client, &mut timer) {
                return NextUpdate::Long(message);
            }
        }
        // If long messages are not allowed now, the writer asks again when they are.
        timer
            .earliest()
            .map_or(NextUpdate::Wait, NextUpdate::WaitUntil)
    }

    /// The next message of the topics with a priority, in the order of the table.
    fn next_of(
        &mut self,
        priority: Priority,
        needs: ClientNeeds<'_>,
        timer: &mut Timer,
    ) -> Option<Message> {
        let mut client = ClientState {
            subscriptions: needs.subscriptions,
            has_keyframe_changes: needs.has_keyframe_changes,
            viewpoint: self.viewpoint.as_ref(),
            keyframes: &mut self.keyframes,
        };
        let mut feeds = self
            .feeds
            .iter_mut()
            .filter(|named| named.priority == priority);
        feeds.find_map(|named| named.feed.next(&mut client, timer))
    }

    /// Whether the client has received anything of a topic.
    pub(crate) fn has_sent(&self, topic: &str) -> bool {
        self.feeds
            .iter()
            .any(|named| named.name == topic && named.feed.has_sent())
    }
}

#[cfg(test)]
mod tests {
    use super::{ClientUpdates, NamedFeed, NextUpdate};
    use crate::Hub;
    use crate::client::protocol::SubscribeMessage;
    use crate::topics::keyframe_log::KeyframeLog;
    use crate::topics::keyframe_points::PointTopic;
    use crate::topics::keyframes::{KeyframeTopic, SharedLog};
    use crate::topics::live_images::LiveImageTopic;
    use crate::topics::published_data::KeyframePose;
    use crate::topics::robot_state::RobotDescriptionTopic;
    use crate::topics::scene::SceneTopic;
    use crate::topics::shared_topic::LatestMessages;
    use crate::topics::status::StatusTopic;
    use crate::topics::subscriptions::Subscriptions;
    use crate::topics::{EncodedMessage, TOPICS, Topic};
    use axum::extract::ws::Message;
    use kinematics::{Stamp, Transform};
    use serde_json::{Value, json};
    use std::collections::BTreeSet;
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    const DEFAULT_PX: [u32; 2] = [640, u32::MAX];

    fn item(number: u64) -> EncodedMessage {
        EncodedMessage {
            number,
            message: Message::text(number.to_string()),
        }
    }

    /// Topics whose messages the tests set without encoding.
    struct Latest {
        hub: Hub,
        scene: Arc<LatestMessages<SceneTopic>>,
        status: Arc<LatestMessages<StatusTopic>>,
        robot: Arc<LatestMessages<RobotDescriptionTopic>>,
        images: Arc<LiveImageTopic>,
        keyframes: Arc<KeyframeTopic>,
        points: Arc<PointTopic>,
    }

    impl Latest {
        fn new() -> Self {
            let hub = Hub::new();
            Self {
                scene: Arc::new(LatestMessages::new(&hub)),
                status: Arc::new(LatestMessages::new(&hub)),
                robot: Arc::new(LatestMessages::new(&hub)),
                images: Arc::new(LiveImageTopic::new(&hub)),
                keyframes: Arc::new(KeyframeTopic::new(&hub)),
                points: Arc::new(PointTopic::new(&hub)),
                hub,
            }
        }

        /// The feeds of a client, in the order of the table.
        fn updates(&self) -> ClientUpdates {
            let topics: [(&str, Arc<dyn Topic>); 6] = [
                ("scene", self.scene.clone()),
                ("status", self.status.clone()),
                ("robot_state", self.robot.clone()),
                ("live_images", self.images.clone()),
                ("keyframes", self.keyframes.clone()),
                ("keyframe_points", self.points.clone()),
            ];
            let feeds = topics.into_iter().map(|(name, topic)| {
                let entry = TOPICS
                    .iter()
                    .find(|entry| entry.name == name)
                    .expect("a topic of the table");
                NamedFeed {
                    name: entry.name,
                    priority: entry.priority,
                    feed: topic.feed(),
                }
            });
            ClientUpdates::of_feeds(feeds.collect())
        }
    }

    /// A client at a time that the test advances.
    struct Client {
        updates: ClientUpdates,
        subscriptions: Subscriptions,
        now: Instant,
    }

    impl Client {
        fn of(latest: &Latest) -> Self {
            Self {
                updates: latest.updates(),
                subscriptions: Subscriptions::default(),
                now: Instant::now(),
            }
        }

        fn subscribe(&mut self, message: Value) {
            let message: SubscribeMessage = serde_json::from_value(message).expect("valid");
            self.subscriptions.apply(message).expect("valid");
        }

        fn next(&mut self, allows_long: bool) -> Option<String> {
            match self
                .updates
                .next(&self.subscriptions, false, self.now, allows_long)
            {
                NextUpdate::Short(message) | NextUpdate::Long(message) => {
                    Some(message.into_text().expect("text").to_string())
                }
                NextUpdate::WaitUntil(_) | NextUpdate::Wait => None,
            }
        }
    }

    #[test]
    fn short_messages_first_then_cameras_round_robin() {
        let latest = Latest::new();
        latest.scene.set("", item(1));
        latest.status.set("", item(4));
        latest.keyframes.set_list(item(2));
        latest.images.set("left", DEFAULT_PX, item(3));
        latest.images.set("right", DEFAULT_PX, item(5));
        let mut client = Client::of(&latest);
        assert_eq!(client.next(false).as_deref(), Some("1"));
        assert_eq!(client.next(false).as_deref(), Some("4"));
        assert_eq!(client.next(false), None, "only long messages are left");
        assert_eq!(client.next(true).as_deref(), Some("3"));
        latest.images.set("left", DEFAULT_PX, item(6));
        assert_eq!(
            client.next(true).as_deref(),
            Some("2"),
            "keyframes come after at most one image"
        );
        assert_eq!(
            client.next(true).as_deref(),
            Some("5"),
            "the other camera comes next"
        );
        client.now += Duration::from_millis(200);
        assert_eq!(client.next(true).as_deref(), Some("6"));
        assert_eq!(client.next(true), None);
    }

    #[test]
    fn each_topic_has_its_own_rate() {
        let latest = Latest::new();
        let mut client = Client::of(&latest);
        client.subscribe(json!({"topic": "status", "rate_hz": 2}));
        client.subscribe(json!({"topic": "live_images", "rate_hz": 10, "size_px": [192, 192]}));
        let (mut n_status, mut n_images) = (0, 0);
        for tick in 0..200_u64 {
            latest.status.set("", item(3 * tick + 1));
            latest.images.set("left", [192, 192], item(3 * tick + 2));
            // An image of a size for another client.
            latest.images.set("left", DEFAULT_PX, item(3 * tick + 3));
            while let Some(sent) = client.next(true) {
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
        latest.status.set("", item(9000));
        latest.images.set("left", DEFAULT_PX, item(9001));
        client.now += Duration::from_secs(9);
        assert_eq!(client.next(true), None);
    }

    #[test]
    fn the_end_of_a_pause_is_known() {
        let latest = Latest::new();
        let mut client = Client::of(&latest);
        latest.status.set("", item(1));
        assert_eq!(client.next(true).as_deref(), Some("1"));
        let now = client.now;
        assert_eq!(
            client.updates.next(&client.subscriptions, false, now, true),
            NextUpdate::Wait
        );
        latest.status.set("", item(2));
        let next = client.updates.next(&client.subscriptions, false, now, true);
        assert_eq!(
            next,
            NextUpdate::WaitUntil(now + Duration::from_millis(190))
        );
    }

    #[test]
    fn robot_is_sent_once_to_subscribed_clients() {
        let latest = Latest::new();
        latest.robot.set("", item(1));
        let mut client = Client::of(&latest);
        assert_eq!(client.next(true), None);
        client.subscribe(json!({"topic": "robot_state", "rate_hz": 60}));
        assert_eq!(client.next(true).as_deref(), Some("1"));
        assert_eq!(client.next(true), None);
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
        latest: Latest,
        keyframes: BTreeSet<u64>,
        points: BTreeSet<u64>,
        /// Numbers of points that came without their keyframe.
        n_dropped: usize,
    }

    impl PointsClient {
        fn new() -> Self {
            let latest = Latest::new();
            let mut client = Client::of(&latest);
            client.subscribe(json!({"topic": "keyframes", "rate_hz": 2}));
            client.subscribe(json!({"topic": "keyframe_points", "rate_hz": 20}));
            Self {
                client,
                log: KeyframeLog::default(),
                latest,
                keyframes: BTreeSet::new(),
                points: BTreeSet::new(),
                n_dropped: 0,
            }
        }

        /// Sets a list of this many keyframes, all with points.
        fn set_keyframes(&mut self, n: i64) {
            self.log.set(&keyframes(n));
            let points = |number: u64| (number, Some(Message::text(number.to_string())));
            self.latest.points.set(
                self.log
                    .newest_first()
                    .map(|(number, _)| points(number))
                    .collect(),
            );
            self.latest
                .hub
                .latest::<SharedLog>()
                .send_replace(Some(Arc::new(self.log.clone())));
        }

        fn next(&mut self) -> NextUpdate {
            let Client {
                updates,
                subscriptions,
                now,
            } = &mut self.client;
            updates.next(subscriptions, true, *now, true)
        }

        /// Receives the messages that are sent within a time. Like the page, drops points without a
        /// keyframe.
        fn receive(&mut self, millis: u64) {
            for _ in 0..millis / 10 {
                while let NextUpdate::Short(message) | NextUpdate::Long(message) = self.next() {
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
                    self.keyframes.extend(
                        list("keyframes")
                            .iter()
                            .filter_map(|keyframe| keyframe["id"].as_u64()),
                    );
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
        assert_eq!(
            (
                viewer.keyframes.len(),
                viewer.points.len(),
                viewer.n_dropped
            ),
            (60, 60, 0)
        );
    }

    #[test]
    fn new_lists_and_subscriptions_bring_all_points_again() {
        let mut viewer = PointsClient::new();
        viewer.set_keyframes(50);
        viewer.receive(4000);
        assert_eq!(viewer.points.len(), 50);
        viewer
            .client
            .subscribe(json!({"topic": "keyframes", "rate_hz": 2}));
        viewer.receive(4000);
        assert_eq!(
            (viewer.keyframes.len(), viewer.points.len()),
            (50, 50),
            "after a new list"
        );
        // The subscription ends and begins again before the server checks it.
        viewer.points.clear();
        viewer
            .client
            .subscribe(json!({"topic": "keyframe_points", "rate_hz": 0}));
        viewer
            .client
            .subscribe(json!({"topic": "keyframe_points", "rate_hz": 20}));
        viewer.receive(4000);
        assert_eq!(
            (viewer.points.len(), viewer.n_dropped),
            (50, 0),
            "after a new subscription"
        );
    }

    #[test]
    fn keyframes_are_sent_between_images() {
        let mut viewer = PointsClient::new();
        viewer
            .client
            .subscribe(json!({"topic": "live_images", "rate_hz": 100}));
        viewer.set_keyframes(200);
        let mut n_images = 0_u64;
        while viewer.keyframes.len() < 200 {
            // The link is so slow that a new image always waits.
            viewer.client.now += Duration::from_millis(200);
            viewer
                .latest
                .images
                .set("left", DEFAULT_PX, item(1 + n_images));
            match viewer.next() {
                NextUpdate::Long(message) if message == item(1 + n_images).message => n_images += 1,
                NextUpdate::Long(message) => viewer.apply(&message.into_text().expect("text")),
                other => panic!("{other:?} instead of a message"),
            }
            assert!(
                n_images <= 20,
                "only {} keyframes after {n_images} images",
                viewer.keyframes.len()
            );
        }
        assert!(n_images >= 6, "images are sent, too");
    }
}
