//! Decides which chunk of a model a client receives next. First, the client receives all chunks in
//! their coarse form, and then all chunks in full. After that, it receives the chunks that have
//! changed most, within a budget. While the client's copy is incomplete, chunks in its view come
//! first.

use crate::client::server_message::{BinaryHeader, ChunkHeader, ServerMessage, frame};
use crate::pictures::viewpoint::Viewpoint;
use crate::pose::row_major;
use crate::topics::chunk_list::{ChunkList, VersionedChunk};
use crate::topics::subscriptions::ChunkSubscription;
use axum::extract::ws::Message;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Unused budget is saved for at most this time, seconds. With a longer time, a pause of training
/// would be followed by a longer burst of chunks, which would delay pictures on slow links.
const MAX_SAVED_SECS: f64 = 0.1;
/// Maximum time for which changes wait after new chunks have exceeded the budget, seconds. Without
/// a maximum, a large model would get no changes for a long time after it was sent completely.
const MAX_DEBT_SECS: f64 = 1.0;

/// What a client has of a model.
#[derive(Debug, Default)]
pub(crate) struct ChunkSender {
    /// Number of the subscription that the chunks belong to.
    n_subscriptions: u64,
    /// Chunks by id.
    sent: BTreeMap<u64, SentChunk>,
    /// Bytes that may be spent on changes, and when they were last updated.
    balance_bytes: f64,
    updated: Option<Instant>,
}

/// What a client has of a chunk.
#[derive(Clone, Copy, Debug)]
struct SentChunk {
    version: u64,
    is_fine: bool,
    total_change: f64,
}

/// What to do next.
#[derive(Debug)]
pub(crate) enum NextChunk {
    /// Sends this message.
    Send(Message),
    /// The budget allows the next message at this time.
    WaitUntil(Instant),
    /// The client has everything.
    Wait,
}

impl ChunkSender {
    /// The next message, which counts as sent. `viewpoint` is the viewpoint of the client's newest
    /// picture.
    pub(crate) fn next(
        &mut self,
        list: &ChunkList,
        subscription: &ChunkSubscription,
        viewpoint: Option<&Viewpoint>,
        now: Instant,
    ) -> NextChunk {
        if subscription.number != self.n_subscriptions {
            // The new subscription may be for another model, or the client may have discarded its
            // chunks.
            *self = Self {
                n_subscriptions: subscription.number,
                ..Self::default()
            };
        }
        self.refill(subscription.max_bytes_per_sec, now);
        // In the first round, every chunk is sent in some form. A coarse model without holes is
        // more useful than an exact part of the model.
        let is_unsent = |chunk: &&Arc<VersionedChunk>| self.copy_of(chunk).is_none();
        if let Some(chunk) = first_needed(list, viewpoint, is_unsent) {
            // Meshes, and chunks of few splats, have no coarse form.
            let is_fine = chunk.chunk.coarse.is_none();
            return self.send(list, &chunk, is_fine, subscription, viewpoint);
        }
        // Removed chunks were replaced by other chunks, which the client has by now. If the removed
        // chunks were deleted earlier, the picture would have holes.
        if let Some(removal) = self.next_removal(list, &subscription.method) {
            return NextChunk::Send(removal);
        }
        // In the second round, all chunks are sent in full.
        let is_coarse =
            |chunk: &&Arc<VersionedChunk>| self.copy_of(chunk).is_some_and(|copy| !copy.is_fine);
        if let Some(chunk) = first_needed(list, viewpoint, is_coarse) {
            return self.send(list, &chunk, true, subscription, viewpoint);
        }
        // After that, changes are sent, which never end while the model is trained. Only changes
        // wait for the budget. The largest changes come first. Changes that the client has missed
        // add up, so every chunk is sent at some time.
        let is_outdated = |chunk: &&Arc<VersionedChunk>| {
            self.copy_of(chunk)
                .is_some_and(|copy| copy.version != chunk.version)
        };
        let outdated = list.chunks.values().filter(is_outdated);
        let Some(chunk) = most_changed(outdated, |chunk| self.missed_change(chunk)) else {
            return NextChunk::Wait;
        };
        if self.balance_bytes < 0.0 {
            // The chunk is chosen again at that time, because another chunk may have changed more
            // by then.
            let secs = -self.balance_bytes / subscription.max_bytes_per_sec;
            return NextChunk::WaitUntil(now + Duration::from_secs_f64(secs));
        }
        self.send(list, &chunk, true, subscription, viewpoint)
    }

    /// What the client has of a chunk.
    fn copy_of(&self, chunk: &VersionedChunk) -> Option<&SentChunk> {
        self.sent.get(&chunk.chunk.id)
    }

    /// How much a chunk has changed since it was sent to the client.
    fn missed_change(&self, chunk: &VersionedChunk) -> f64 {
        chunk.total_change - self.copy_of(chunk).map_or(0.0, |copy| copy.total_change)
    }

    /// The message that removes the chunks that no longer exist; `None` if the client has none.
    fn next_removal(&mut self, list: &ChunkList, method: &str) -> Option<Message> {
        if self.sent.keys().all(|id| list.chunks.contains_key(id)) {
            return None;
        }
        let (kept, removed): (BTreeMap<_, _>, BTreeMap<_, _>) = std::mem::take(&mut self.sent)
            .into_iter()
            .partition(|(id, _)| list.chunks.contains_key(id));
        self.sent = kept;
        let ids = removed.into_keys().collect();
        let message = ServerMessage::ModelChunksRemoved { method, ids };
        Some(message.to_message())
    }

    /// Adds the budget of the time since the last call.
    fn refill(&mut self, bytes_per_sec: f64, now: Instant) {
        let secs = self
            .updated
            .map_or(0.0, |updated| (now - updated).as_secs_f64());
        self.updated = Some(now);
        self.balance_bytes =
            (self.balance_bytes + secs * bytes_per_sec).min(MAX_SAVED_SECS * bytes_per_sec);
    }

    /// The message with a chunk, which counts as sent.
    fn send(
        &mut self,
        list: &ChunkList,
        chunk: &VersionedChunk,
        is_fine: bool,
        subscription: &ChunkSubscription,
        viewpoint: Option<&Viewpoint>,
    ) -> NextChunk {
        let VersionedChunk {
            version,
            total_change,
            chunk,
        } = chunk;
        self.sent.insert(
            chunk.id,
            SentChunk {
                version: *version,
                is_fine,
                total_change: *total_change,
            },
        );
        // The remaining chunks are counted after this chunk counts as sent, because the page shows
        // how much is left after this message.
        let remaining = self.remaining(list, viewpoint);
        let data = if is_fine {
            &chunk.fine
        } else {
            chunk.coarse.as_ref().unwrap_or(&chunk.fine)
        };
        let header = ChunkHeader {
            method: &subscription.method,
            id: chunk.id,
            is_coarse: !is_fine,
            n_chunks: list.chunks.len(),
            n_incomplete: remaining.n_incomplete,
            n_unsent: remaining.n_unsent,
            n_incomplete_in_view: viewpoint.map(|_| remaining.n_incomplete_in_view),
            n_unsent_in_view: viewpoint.map(|_| remaining.n_unsent_in_view),
            world_from_model: row_major(&list.world_from_model),
            layout: data.layout,
        };
        let bytes = frame(&BinaryHeader::ModelChunk(&header), &[&data.bytes]);
        // All chunks reduce the budget, so that changes wait after the model was sent.
        let max_debt_bytes = MAX_DEBT_SECS * subscription.max_bytes_per_sec;
        self.balance_bytes = (self.balance_bytes - bytes.len() as f64).max(-max_debt_bytes);
        NextChunk::Send(Message::binary(bytes))
    }

    /// Counts the chunks that the client lacks.
    fn remaining(&self, list: &ChunkList, viewpoint: Option<&Viewpoint>) -> Remaining {
        let mut remaining = Remaining::default();
        for chunk in list.chunks.values() {
            let copy = self.copy_of(chunk);
            if copy.is_some_and(|copy| copy.is_fine) {
                continue;
            }
            let n_unsent = usize::from(copy.is_none());
            remaining.n_incomplete += 1;
            remaining.n_unsent += n_unsent;
            if viewpoint.is_some_and(|viewpoint| !is_hidden(list, viewpoint, chunk)) {
                remaining.n_incomplete_in_view += 1;
                remaining.n_unsent_in_view += n_unsent;
            }
        }
        remaining
    }
}

/// Numbers of chunks that a client lacks.
#[derive(Debug, Default)]
struct Remaining {
    /// Chunks that it has only in the coarse form, or not at all.
    n_incomplete: usize,
    /// Chunks that it does not have at all.
    n_unsent: usize,
    /// Those of the incomplete chunks that are in its view.
    n_incomplete_in_view: usize,
    /// Those of the unsent chunks that are in its view.
    n_unsent_in_view: usize,
}

/// Whether a chunk is outside the view.
fn is_hidden(list: &ChunkList, viewpoint: &Viewpoint, chunk: &VersionedChunk) -> bool {
    let (is_hidden, _) = viewpoint.rank(&list.world_from_model, &chunk.chunk.fine.layout);
    is_hidden
}

/// The chunk that is needed first for a view. Without a view, this is the chunk that has changed
/// most.
fn first_needed(
    list: &ChunkList,
    viewpoint: Option<&Viewpoint>,
    is_candidate: impl Fn(&&Arc<VersionedChunk>) -> bool,
) -> Option<Arc<VersionedChunk>> {
    let candidates = list.chunks.values().filter(is_candidate);
    let Some(viewpoint) = viewpoint else {
        return most_changed(candidates, |chunk| chunk.total_change);
    };
    // Every chunk has a fine form, so the bounds of the fine form are used in both rounds.
    let ranked = candidates.map(|chunk| {
        (
            viewpoint.rank(&list.world_from_model, &chunk.chunk.fine.layout),
            chunk,
        )
    });
    let first = ranked.min_by(|((a_hidden, a_m), _), ((b_hidden, b_m), _)| {
        a_hidden.cmp(b_hidden).then(a_m.total_cmp(b_m))
    });
    first.map(|(_, chunk)| Arc::clone(chunk))
}

fn most_changed<'a>(
    chunks: impl Iterator<Item = &'a Arc<VersionedChunk>>,
    change: impl Fn(&VersionedChunk) -> f64,
) -> Option<Arc<VersionedChunk>> {
    chunks
        .max_by(|a, b| change(a).total_cmp(&change(b)))
        .map(Arc::clone)
}

#[cfg(test)]
mod tests {
    use super::{ChunkSender, NextChunk};
    use crate::pictures::viewpoint::Viewpoint;
    use crate::pictures::viewpoint::tests::{cube, viewpoint};
    use crate::topics::chunk_list::ChunkList;
    use crate::topics::chunk_list::tests::{chunk, complete};
    use crate::topics::subscriptions::ChunkSubscription;
    use axum::extract::ws::Message;
    use serde_json::Value;
    use std::time::{Duration, Instant};
    use trainer::ModelChunks;

    fn subscription(number: u64) -> ChunkSubscription {
        ChunkSubscription {
            number,
            method: "tsdf".into(),
            period: Duration::from_secs(1),
            max_bytes_per_sec: 1e5,
        }
    }

    fn changes(chunks: Vec<trainer::ModelChunk>, removed: Vec<u64>) -> ModelChunks {
        ModelChunks {
            is_complete: false,
            chunks,
            removed,
        }
    }

    /// A client that receives everything at once.
    struct Receiver {
        sender: ChunkSender,
        number: u64,
        viewpoint: Option<Viewpoint>,
        now: Instant,
        n_bytes: usize,
        /// Header of the last chunk.
        header: Option<Value>,
    }

    impl Receiver {
        fn new() -> Self {
            Self {
                sender: ChunkSender::default(),
                number: 1,
                viewpoint: None,
                now: Instant::now(),
                n_bytes: 0,
                header: None,
            }
        }

        /// Receives until nothing more is sent now. Returns `id` or `id coarse` of chunks, and `-
        /// ids` of removed ones.
        fn receive(&mut self, list: &ChunkList) -> Vec<String> {
            std::iter::from_fn(|| self.receive_one(list)).collect()
        }

        fn receive_one(&mut self, list: &ChunkList) -> Option<String> {
            let subscription = subscription(self.number);
            let next = self
                .sender
                .next(list, &subscription, self.viewpoint.as_ref(), self.now);
            let NextChunk::Send(message) = next else {
                return None;
            };
            Some(match message {
                Message::Binary(bytes) => {
                    self.n_bytes += bytes.len();
                    let n_header =
                        u32::from_le_bytes(bytes[..4].try_into().expect("4 bytes")) as usize;
                    let header: Value =
                        serde_json::from_slice(&bytes[4..4 + n_header]).expect("JSON");
                    let suffix = if header["is_coarse"] == true {
                        " coarse"
                    } else {
                        ""
                    };
                    let name = format!("{}{suffix}", header["id"]);
                    self.header = Some(header);
                    name
                }
                other => {
                    let text: Value =
                        serde_json::from_str(&other.into_text().expect("text")).expect("JSON");
                    format!("- {}", text["ids"])
                }
            })
        }
    }

    #[test]
    fn all_chunks_come_coarsely_first_then_in_full() {
        let mut list = ChunkList::default();
        let mut client = Receiver::new();
        list.apply(complete(vec![
            chunk(1, 1.0, 100_000),
            chunk(2, 3.0, 100_000),
            chunk(3, 2.0, 100_000),
        ]));
        // The budget does not apply to chunks that the client does not have.
        assert_eq!(
            client.receive(&list),
            ["2 coarse", "3 coarse", "1 coarse", "2", "3", "1"]
        );
        assert!(client.receive(&list).is_empty());
        client.number = 2;
        assert_eq!(
            client.receive(&list).len(),
            6,
            "a new subscription begins with all chunks"
        );
    }

    #[test]
    fn an_incomplete_copy_is_completed_in_view_first() {
        let mut list = ChunkList::default();
        let at = |id, change, z: f32| {
            let mut chunk = chunk(id, change, 1000);
            chunk.fine.layout = cube([0.0, 0.0, z]);
            chunk
        };
        list.apply(complete(vec![
            at(1, 1.0, 2.0),
            at(2, 9.0, 5.0),
            at(3, 5.0, -1.0),
            at(4, 7.0, -3.0),
        ]));
        let mut client = Receiver {
            viewpoint: Some(viewpoint(0.0, 0.0)),
            ..Receiver::new()
        };
        let coarse: Vec<_> = (0..4).filter_map(|_| client.receive_one(&list)).collect();
        assert_eq!(coarse, ["1 coarse", "2 coarse", "3 coarse", "4 coarse"]);
        assert_eq!(client.receive_one(&list).as_deref(), Some("1"));
        client.viewpoint = Some(viewpoint(0.0, std::f64::consts::PI));
        assert_eq!(
            client.receive(&list),
            ["3", "4", "2"],
            "the view has turned"
        );
        // A complete copy is updated where it has changed most.
        client.now += Duration::from_secs(10);
        list.apply(changes(
            vec![at(1, 1.0, 2.0), at(2, 9.0, 5.0), at(3, 5.0, -1.0)],
            Vec::new(),
        ));
        assert_eq!(client.receive(&list), ["2", "3", "1"]);
    }

    #[test]
    fn messages_count_what_the_view_still_lacks() {
        let mut list = ChunkList::default();
        let at = |id, z: f32| {
            let mut chunk = chunk(id, 1.0, 1000);
            chunk.fine.layout = cube([0.0, 0.0, z]);
            chunk
        };
        list.apply(complete(vec![at(1, 2.0), at(2, 5.0), at(3, -1.0)]));
        let mut client = Receiver {
            viewpoint: Some(viewpoint(0.0, 0.0)),
            ..Receiver::new()
        };
        let mut counts = Vec::new();
        while client.receive_one(&list).is_some() {
            let header = client.header.take().expect("a chunk");
            counts.push(
                [
                    "n_unsent",
                    "n_unsent_in_view",
                    "n_incomplete",
                    "n_incomplete_in_view",
                ]
                .map(|name| header[name].as_u64().expect("a number")),
            );
        }
        assert_eq!(
            counts,
            [
                [2, 1, 3, 2],
                [1, 0, 3, 2],
                [0, 0, 3, 2],
                [0, 0, 2, 1],
                [0, 0, 1, 0],
                [0, 0, 0, 0]
            ]
        );
        // Without a view, the chunks in view are not known.
        client = Receiver::new();
        client.receive_one(&list).expect("a chunk");
        let header = client.header.take().expect("a chunk");
        assert!(header["n_unsent_in_view"].is_null() && header["n_unsent"] == 2);
    }

    #[test]
    fn removed_chunks_disappear_after_their_replacements_have_come() {
        let mut list = ChunkList::default();
        let mut client = Receiver::new();
        list.apply(complete(vec![chunk(1, 1.0, 1000), chunk(2, 1.0, 1000)]));
        client.receive(&list);
        list.apply(changes(
            vec![chunk(10, 1.0, 1000), chunk(11, 2.0, 1000)],
            vec![1],
        ));
        assert_eq!(
            client.receive(&list),
            ["11 coarse", "10 coarse", "- [1]", "11", "10"]
        );
        list.apply(complete(Vec::new()));
        assert_eq!(client.receive(&list), ["- [2,10,11]"]);
    }

    #[test]
    fn changes_stay_within_the_budget_and_the_largest_come_first() {
        let mut list = ChunkList::default();
        let mut client = Receiver::new();
        let model = |change: fn(u64) -> f64| {
            (0..50)
                .map(|id| chunk(id, change(id), 20_000))
                .collect::<Vec<_>>()
        };
        list.apply(complete(model(|_| 1.0)));
        client.receive(&list);
        client.n_bytes = 0;
        let mut times = std::collections::BTreeMap::<String, usize>::new();
        for step in 0..600 {
            client.now += Duration::from_millis(100);
            if step % 10 == 0 {
                // Ten chunks change five times as much as the others.
                list.apply(changes(
                    model(|id| if id < 10 { 5.0 } else { 1.0 }),
                    Vec::new(),
                ));
            }
            client
                .receive(&list)
                .into_iter()
                .for_each(|id| *times.entry(id).or_default() += 1);
        }
        // 60 s at 100 kB/s, with at most one chunk and a tenth of a second too many.
        assert!(
            (5_700_000..6_040_000).contains(&client.n_bytes),
            "{} bytes",
            client.n_bytes
        );
        assert_eq!(times.len(), 50, "every chunk is updated at some time");
        let mean = |ids: std::ops::Range<u64>| {
            let n = ids.end - ids.start;
            ids.map(|id| times[&id.to_string()]).sum::<usize>() as f64 / n as f64
        };
        let ratio = mean(0..10) / mean(10..50);
        assert!((3.0..7.0).contains(&ratio), "{ratio}");
    }
}
