//! Decides which update a client receives next, according to its subscriptions.

use crate::broadcast::{Item, LatestMessages};
use crate::subscriptions::Subscriptions;
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
    keyframe_changes: Sent,
    /// Number of the subscription to keyframes that the list belongs to.
    n_keyframe_lists: u64,
    live_images: BTreeMap<Arc<str>, Sent>,
    /// Numbers of the keyframes whose points were sent, and the time of the last ones.
    keyframe_points: BTreeSet<u64>,
    points_sent: Sent,
}

/// Number of the last item of a kind, and when it was sent.
#[derive(Clone, Copy, Debug, Default)]
struct Sent {
    number: u64,
    at: Option<Instant>,
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

impl Sent {
    /// When the next item may be sent.
    fn due(self, period: Duration, now: Instant) -> Instant {
        self.at.and_then(|at| at.checked_add(period)).unwrap_or(now)
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
        let mut earliest: Option<Instant> = None;
        let mut is_due = |sent: Sent, period: Duration| {
            let due = sent.due(period, now);
            if due > now {
                earliest = Some(earliest.map_or(due, |earliest| earliest.min(due)));
            }
            due <= now
        };
        if let Some(scene) = newer(latest.scene.as_ref(), &mut self.scene) {
            return Next::Short(scene);
        }
        if let (Some(period), Some(item)) = (subscriptions.status, &latest.status)
            && item.number > self.status.number
            && is_due(self.status, period)
        {
            self.status = Sent { number: item.number, at: Some(now) };
            return Next::Short(item.message.clone());
        }
        if subscriptions.robot_state.is_some()
            && let Some(robot) = newer(latest.robot.as_ref(), &mut self.robot)
        {
            return Next::Short(robot);
        }
        if allows_long {
            // The camera whose last image was sent longest ago comes first.
            let waiting = latest.live_images.iter().filter_map(|((camera, max_px), item)| {
                let subscription = subscriptions.images_of(camera);
                let sent = self.live_images.get(camera).copied().unwrap_or_default();
                let is_wanted = *max_px == subscription.max_px && item.number > sent.number;
                let is_next = is_wanted && is_due(sent, subscription.period?);
                is_next.then_some((sent.number, camera, item))
            });
            if let Some((_, camera, item)) = waiting.min_by_key(|(number, ..)| *number) {
                self.live_images.insert(Arc::clone(camera), Sent { number: item.number, at: Some(now) });
                return Next::Long(item.message.clone());
            }
            if subscriptions.n_keyframe_lists > self.n_keyframe_lists {
                // A new subscription begins with the complete list.
                self.n_keyframe_lists = subscriptions.n_keyframe_lists;
                (self.keyframe_list, self.keyframe_changes) = (Sent::default(), Sent::default());
            }
            if let Some(period) = subscriptions.keyframes {
                if !has_keyframe_changes
                    && let Some(item) = &latest.keyframe_list
                    && item.number > self.keyframe_list.number
                    && is_due(self.keyframe_list, period)
                {
                    self.keyframe_list = Sent { number: item.number, at: Some(now) };
                    return Next::Long(item.message.clone());
                }
                if has_keyframe_changes
                    && let Some(log) = &latest.keyframe_log
                    && log.version() != self.keyframe_changes.number
                    && is_due(self.keyframe_changes, period)
                    && let Some((json, version)) = log.next_changes(self.keyframe_changes.number)
                {
                    // The parts of a long list follow each other.
                    let at = (version == log.version()).then_some(now);
                    self.keyframe_changes = Sent { number: version, at };
                    return Next::Long(Message::text(json));
                }
            }
            match subscriptions.keyframe_points {
                // The client has the keyframes, in whose frames the points are, before their points.
                Some(period) if has_keyframe_changes && is_due(self.points_sent, period) => {
                    if let Some(points) = self.next_points(latest) {
                        self.points_sent = Sent { number: 0, at: Some(now) };
                        return Next::Long(points);
                    }
                }
                Some(_) => {}
                None => self.keyframe_points.clear(),
            }
        }
        earliest.map_or(Next::Wait, Next::WaitUntil)
    }

    /// The points of the newest keyframe that the client does not have.
    fn next_points(&mut self, latest: &LatestMessages) -> Option<Message> {
        self.keyframe_points.retain(|number| latest.keyframe_points.contains_key(number));
        let mut newest_first = latest.keyframe_points.iter().rev();
        let (number, message) = newest_first.find_map(|(number, message)| {
            Some((number, message.as_ref()?)).filter(|_| !self.keyframe_points.contains(number))
        })?;
        self.keyframe_points.insert(*number);
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
    use crate::broadcast::{Item, LatestMessages};
    use crate::protocol::SubscribeMessage;
    use crate::subscriptions::Subscriptions;
    use axum::extract::ws::Message;
    use serde_json::{Value, json};
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
        assert_eq!(client.next(&latest, true).as_deref(), Some("5"), "the other camera comes next");
        client.now += Duration::from_millis(200);
        assert_eq!(client.next(&latest, true).as_deref(), Some("6"));
        assert_eq!(client.next(&latest, true).as_deref(), Some("2"));
        assert_eq!(client.next(&latest, true), None);
    }

    #[test]
    fn each_topic_has_its_own_rate() {
        let mut latest = LatestMessages::default();
        let mut client = Client::new();
        client.subscribe(json!({"topic": "status", "rate_hz": 2}));
        client.subscribe(json!({"topic": "live_images", "rate_hz": 10, "size_px": [200, 200]}));
        let (mut n_status, mut n_images) = (0, 0);
        for tick in 0..200_u64 {
            latest.status = Some(item(3 * tick + 1));
            latest.live_images.insert(("left".into(), [200, 200]), item(3 * tick + 2));
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
}
