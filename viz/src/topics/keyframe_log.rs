//! The keyframe list with the order of its changes, so that clients receive only what has changed.

use crate::client::protocol::MAX_CHANGED_KEYFRAMES;
use crate::client::server_message::{NumberedKeyframe, ServerMessage};
use crate::topics::published_data::KeyframePose;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Maximum number of remembered removals. Each takes 16 bytes. A client that has not received an
/// older removal gets the complete list. With fewer removals, clients on slow links would get
/// complete lists more often.
const MAX_REMOVALS: usize = 1024;

/// The keyframes, and the versions of the list in which they were added and changed. The version
/// counts single changes.
#[derive(Clone, Debug)]
pub(crate) struct KeyframeLog {
    version: u64,
    n_added: u64,
    /// Keyframes by number.
    keyframes: BTreeMap<u64, Entry>,
    /// Numbers of the keyframes in the latest list.
    numbers: BTreeMap<Key, u64>,
    /// Version and number of removed keyframes.
    removals: VecDeque<(u64, u64)>,
    /// Version of the newest removal that is no longer remembered.
    forgotten: u64,
}

/// Camera, stamp, and the number of earlier keyframes in the list with the same camera and stamp.
type Key = (Arc<str>, i64, u32);

#[derive(Clone, Debug)]
struct Entry {
    /// Version that added the keyframe.
    added: u64,
    /// Version that changed it last.
    changed: u64,
    keyframe: KeyframePose,
}

/// How much of the list a client has received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ListPosition {
    /// The client has received the changes up to this version; 0 without a list.
    version: u64,
    /// Version of the log when the client's list was started.
    began: u64,
    /// Newest version that the client's list has matched; 0 until the list is complete.
    complete: u64,
}

/// The next message for a client.
#[derive(Clone, Debug)]
pub(crate) struct KeyframeListUpdate {
    /// The message.
    pub(crate) json: String,
    /// What the client has after the message.
    pub(crate) position: ListPosition,
    /// Whether the message replaces the client's list.
    pub(crate) is_new_list: bool,
}

impl Default for KeyframeLog {
    /// An empty list. It has version 1, because version 0 means that a client has no list.
    fn default() -> Self {
        Self {
            version: 1,
            n_added: 0,
            keyframes: BTreeMap::new(),
            numbers: BTreeMap::new(),
            removals: VecDeque::new(),
            forgotten: 0,
        }
    }
}

impl KeyframeLog {
    /// Whether a client at this position has all changes.
    pub(crate) fn is_up_to_date(&self, position: ListPosition) -> bool {
        position.version == self.version
    }

    /// Whether a client at this position certainly has the keyframe with this number.
    pub(crate) fn is_sent(&self, number: u64, position: ListPosition) -> bool {
        // Keyframes that have changed since the list was complete still count as sent.
        let is_sent =
            |entry: &Entry| entry.changed <= position.version || entry.added <= position.complete;
        self.keyframes.get(&number).is_some_and(is_sent)
    }

    /// Whether the list has a keyframe with this number.
    pub(crate) fn contains(&self, number: u64) -> bool {
        self.keyframes.contains_key(&number)
    }

    /// The keyframe with this number.
    pub(crate) fn get(&self, number: u64) -> Option<&KeyframePose> {
        self.keyframes.get(&number).map(|entry| &entry.keyframe)
    }

    /// Number, camera and stamp of all keyframes, the newest first.
    pub(crate) fn newest_first(&self) -> impl Iterator<Item = (u64, &KeyframePose)> {
        self.keyframes
            .iter()
            .rev()
            .map(|(number, entry)| (*number, &entry.keyframe))
    }

    /// Replaces the list.
    pub(crate) fn set(&mut self, keyframes: &[KeyframePose]) {
        // Keyframes are recognized by camera and stamp. Stamps need not be unique, so keyframes
        // with the same stamp are recognized by their order.
        let mut numbers = BTreeMap::new();
        let mut n_same: BTreeMap<(&str, i64), u32> = BTreeMap::new();
        for keyframe in keyframes {
            let n_before = n_same
                .entry((&*keyframe.camera, keyframe.stamp.0))
                .or_default();
            let key = (Arc::clone(&keyframe.camera), keyframe.stamp.0, *n_before);
            *n_before += 1;
            // What remains in `self.numbers` after the loop is not in the new list.
            let number = self.numbers.remove(&key).unwrap_or_else(|| {
                self.n_added += 1;
                self.n_added
            });
            let before = self.keyframes.get(&number);
            // The pose is compared with the one in the log, not with the one in the last list, so
            // that slow drift adds up until it is noticeable.
            if before.is_none_or(|entry| has_changed(&entry.keyframe, keyframe)) {
                // Every change has a separate version, so that a long list can be interrupted after
                // any keyframe.
                self.version += 1;
                let added = before.map_or(self.version, |entry| entry.added);
                let entry = Entry {
                    added,
                    changed: self.version,
                    keyframe: keyframe.clone(),
                };
                self.keyframes.insert(number, entry);
            }
            numbers.insert(key, number);
        }
        // The remaining keyframes are no longer in the list. Removals come after additions, so that
        // a client between two messages has too many keyframes rather than too few.
        for number in std::mem::replace(&mut self.numbers, numbers).into_values() {
            self.keyframes.remove(&number);
            self.version += 1;
            self.removals.push_back((self.version, number));
        }
        while self.removals.len() > MAX_REMOVALS {
            self.forgotten = self
                .removals
                .pop_front()
                .map_or(self.forgotten, |(version, _)| version);
        }
    }

    /// The next message for a client at this position; `None` if it is up to date. A message from
    /// version 0 replaces the client's list.
    pub(crate) fn next_changes(&self, position: ListPosition) -> Option<KeyframeListUpdate> {
        // A list does not contain keyframes that were removed before it was started, so it needs
        // only later removals. A version above the version of the log would be a mistake, which a
        // complete list corrects.
        let is_outdated = position.version.max(position.began) < self.forgotten
            || position.version > self.version;
        let position = if is_outdated {
            ListPosition::default()
        } else {
            position
        };
        let from_version = position.version;
        if from_version == self.version {
            return None;
        }
        // The keyframes are in the order of their changes. The version of the last keyframe that is
        // sent is then the version of the client.
        let mut changed: Vec<_> = self
            .keyframes
            .iter()
            .filter(|(_, entry)| entry.changed > from_version)
            .collect();
        changed.sort_unstable_by_key(|(_, entry)| entry.changed);
        // A long list is sent in several messages, so that others can be sent in between.
        let version = match changed.get(MAX_CHANGED_KEYFRAMES) {
            Some((_, next)) => next.changed - 1,
            None => self.version,
        };
        let keyframes = changed
            .into_iter()
            .take(MAX_CHANGED_KEYFRAMES)
            .map(|(number, entry)| NumberedKeyframe::new(*number, &entry.keyframe))
            .collect();
        // A new list is empty at first, so nothing can be removed from it.
        let is_new = |at: u64| from_version > 0 && at > from_version && at <= version;
        let removed = self
            .removals
            .iter()
            .filter(|(at, _)| is_new(*at))
            .map(|(_, number)| *number)
            .collect();
        let is_new_list = from_version == 0;
        let began = if is_new_list {
            self.version
        } else {
            position.began
        };
        // Until the list is complete, a keyframe that was added earlier may not have been sent. If
        // it has changed since then, its change is now near the end of the list.
        let complete = if version == self.version {
            version
        } else {
            position.complete
        };
        let json = ServerMessage::KeyframeChanges {
            from_version,
            version,
            keyframes,
            removed,
        }
        .to_json();
        Some(KeyframeListUpdate {
            json,
            position: ListPosition {
                version,
                began,
                complete,
            },
            is_new_list,
        })
    }
}

/// Smaller motions are not sent, because optimization makes them all the time.
fn has_changed(before: &KeyframePose, after: &KeyframePose) -> bool {
    let motion = before.world_from_camera.inverse() * after.world_from_camera;
    let is_same_lens = (before.size_px, before.focal_px, before.principal_px)
        == (after.size_px, after.focal_px, after.principal_px);
    !is_same_lens || kinematics::transform::is_noticeable(&motion)
}

#[cfg(test)]
mod tests {
    use super::{KeyframeListUpdate, KeyframeLog, ListPosition, MAX_REMOVALS};
    use crate::client::protocol::MAX_CHANGED_KEYFRAMES;
    use crate::topics::published_data::KeyframePose;
    use kinematics::{Stamp, Transform};
    use numbers::random::Random;
    use serde_json::Value;
    use std::collections::BTreeMap;

    fn keyframe(stamp: i64, x: f64) -> KeyframePose {
        KeyframePose {
            camera: "wrist".into(),
            stamp: Stamp(stamp),
            world_from_camera: Transform::translation(x, 0.0, 0.0),
            size_px: [640, 480],
            focal_px: [600.0; 2],
            principal_px: [320.0, 240.0],
        }
    }

    /// A client's list: stamp and x by number.
    #[derive(Default)]
    struct Replica {
        position: ListPosition,
        keyframes: BTreeMap<u64, (i64, f64)>,
        n_received: usize,
    }

    impl Replica {
        /// Applies all messages, as `docs/reference/protocol.md` says.
        fn update(&mut self, log: &KeyframeLog) {
            let mut n_messages = 0;
            while self.receive_one(log) {
                n_messages += 1;
                assert!(n_messages <= 200, "the messages do not end");
            }
            assert!(log.is_up_to_date(self.position));
        }

        /// Applies the next message. Returns false if there is none.
        fn receive_one(&mut self, log: &KeyframeLog) -> bool {
            let Some(KeyframeListUpdate {
                json,
                position,
                is_new_list,
            }) = log.next_changes(self.position)
            else {
                return false;
            };
            let message: Value = serde_json::from_str(&json).expect("JSON");
            assert_eq!(
                message["from_version"],
                if is_new_list {
                    0
                } else {
                    self.position.version
                }
            );
            if is_new_list {
                self.keyframes.clear();
            }
            let list = |name: &str| message[name].as_array().expect("a list").clone();
            assert!(list("keyframes").len() <= MAX_CHANGED_KEYFRAMES);
            self.n_received += list("keyframes").len();
            for keyframe in list("keyframes") {
                let number = keyframe["id"].as_u64().expect("a number");
                let stamp = keyframe["stamp_nanos"].as_i64().expect("a stamp");
                self.keyframes.insert(
                    number,
                    (stamp, keyframe["world_from_camera"][3].as_f64().expect("x")),
                );
            }
            for number in list("removed") {
                self.keyframes.remove(&number.as_u64().expect("a number"));
            }
            assert_eq!(message["version"].as_u64(), Some(position.version));
            assert!(
                position.version > self.position.version || is_new_list,
                "no progress"
            );
            self.position = position;
            for (number, _) in log.newest_first() {
                let (is_sent, has_it) = (
                    log.is_sent(number, self.position),
                    self.keyframes.contains_key(&number),
                );
                assert!(
                    has_it || !is_sent,
                    "keyframe {number} at {:?}",
                    self.position
                );
                assert!(
                    is_sent || !log.is_up_to_date(self.position),
                    "keyframe {number} at {:?}",
                    self.position
                );
            }
            true
        }

        fn sorted(&self) -> Vec<(i64, f64)> {
            let mut keyframes: Vec<_> = self.keyframes.values().copied().collect();
            keyframes.sort_by_key(|(stamp, _)| *stamp);
            keyframes
        }
    }

    #[test]
    fn replicas_follow_random_edits() {
        let mut random = Random::new(7);
        let mut log = KeyframeLog::default();
        let mut list: Vec<(i64, f64)> = Vec::new();
        let mut replicas = [(); 3].map(|()| Replica::default());
        for round in 0..400 {
            for _ in 0..1 + random.below(6) {
                let is_removal = !list.is_empty() && random.below(3) == 0;
                if is_removal {
                    list.remove(random.below(list.len()));
                } else {
                    list.push((round * 100 + i64::try_from(list.len()).expect("short"), 1.0));
                }
            }
            if random.below(4) == 0 {
                list.iter_mut().for_each(|(_, x)| *x += 0.25);
            }
            log.set(
                &list
                    .iter()
                    .map(|(stamp, x)| keyframe(*stamp, *x))
                    .collect::<Vec<_>>(),
            );
            // The last client receives messages only sometimes.
            let n_up_to_date = if round % 57 == 56 { 3 } else { 2 };
            for replica in &mut replicas[..n_up_to_date] {
                replica.update(&log);
                let mut expected = list.clone();
                expected.sort_by_key(|(stamp, _)| *stamp);
                assert_eq!(replica.sorted(), expected, "round {round}");
            }
        }
    }

    #[test]
    fn only_noticeable_changes_are_sent() {
        let mut log = KeyframeLog::default();
        let list = |dx: f64| (0..400).map(|ix| keyframe(ix, dx)).collect::<Vec<_>>();
        let mut replica = Replica::default();
        replica.update(&log);
        log.set(&list(0.0));
        replica.update(&log);
        assert_eq!(replica.n_received, 400);
        log.set(&list(1e-4));
        replica.update(&log);
        assert_eq!(
            replica.n_received, 400,
            "a tenth of a millimeter is not sent"
        );
        log.set(&[list(1e-4), vec![keyframe(400, 0.0)]].concat());
        replica.update(&log);
        assert_eq!(replica.n_received, 401, "only the new keyframe is sent");
        log.set(&list(0.01));
        replica.update(&log);
        assert_eq!((replica.n_received, replica.keyframes.len()), (801, 400));
    }

    #[test]
    fn outdated_clients_receive_the_complete_list() {
        let mut log = KeyframeLog::default();
        let n = i64::try_from(MAX_REMOVALS).expect("small");
        log.set(&(0..n + 10).map(|ix| keyframe(ix, 0.0)).collect::<Vec<_>>());
        let mut replica = Replica::default();
        replica.update(&log);
        log.set(&[keyframe(3, 0.0)]);
        assert!(
            log.next_changes(replica.position)
                .expect("changes")
                .is_new_list
        );
        replica.update(&log);
        assert_eq!(replica.sorted(), [(3, 0.0)]);
    }

    #[test]
    fn a_new_client_learns_that_the_list_is_empty() {
        let log = KeyframeLog::default();
        let changes = log
            .next_changes(ListPosition::default())
            .expect("a message");
        assert!(
            changes.json.contains("\"keyframes\":[]"),
            "{}",
            changes.json
        );
        assert!(log.next_changes(changes.position).is_none());
    }

    #[test]
    fn long_lists_end_after_many_removals() {
        let mut log = KeyframeLog::default();
        let list = |n: i64| (0..n).map(|ix| keyframe(ix, 0.0)).collect::<Vec<_>>();
        log.set(&list(2000));
        // The first messages of the remaining list end below the version of the forgotten removals.
        log.set(&list(40));
        let mut replica = Replica::default();
        replica.update(&log);
        assert_eq!((replica.keyframes.len(), replica.n_received), (40, 40));
    }

    #[test]
    fn changes_during_a_long_list_do_not_count_as_sent() {
        let mut log = KeyframeLog::default();
        let list = |n: i64, x: f64| (0..n).map(|ix| keyframe(ix, x)).collect::<Vec<_>>();
        log.set(&list(100, 0.0));
        let mut replica = Replica::default();
        // `receive_one` checks that only received keyframes count as sent.
        for n_sent in 1..=20 {
            let x = f64::from(n_sent);
            log.set(&list(
                100 + 3 * i64::from(n_sent),
                if n_sent % 2 == 0 { x } else { x - 1.0 },
            ));
            assert!(replica.receive_one(&log));
        }
        replica.update(&log);
        assert_eq!(replica.keyframes.len(), 160);
    }

    #[test]
    fn keyframes_with_the_same_stamp_are_distinct() {
        let mut log = KeyframeLog::default();
        let mut replica = Replica::default();
        for list in [
            vec![(5, 0.0), (5, 1.0), (5, 2.0)],
            vec![(5, 0.0), (5, 1.0)],
            vec![],
        ] {
            log.set(
                &list
                    .iter()
                    .map(|(stamp, x)| keyframe(*stamp, *x))
                    .collect::<Vec<_>>(),
            );
            replica.update(&log);
            assert_eq!(replica.sorted(), list);
        }
    }
}
