//! Render requests by client and view: the newest request of each view, stage by stage. Clients
//! take turns, and so do the views of a client.

use crate::client::protocol::DepthFormat;
use crate::client::server_message::PictureHeader;
use crate::pictures::picture_times::{TrainedKeyframes, UnreportedPictures};
use crate::pictures::view_request::ViewRequest;
use crate::server::access::Role;
use crate::topics::operator_status::ConnectedClient;
use std::collections::{BTreeMap, VecDeque};
use std::ops::Bound;
use std::sync::Arc;
use tokio::sync::Notify;
use trainer::Rendered;

/// Maximum number of pictures per client that are being rendered or sent. It limits rendering for
/// slow clients. With a maximum of one, the next picture would be rendered only after the last one
/// was sent. With a larger maximum, pictures would be older when they arrive.
const MAX_UNSENT: usize = 2;
/// Memory that each client may use for these pictures, bytes. Any picture without f32 depth fits.
/// The largest picture, 4096 x 4096 pixels, counts as exactly this much.
const CLIENT_BYTES: usize = 16 << 20;
/// Additional memory for larger pictures, bytes, shared by all clients of a role. Viewers and
/// operators have separate shares, so that slow viewers do not delay operators.
const SHARED_BYTES: usize = 256 << 20;

/// Maximum number of results that wait to be sent to a client. A client that does not read its
/// messages misses the reasons of further failed edits.
const MAX_OUTBOX: usize = 64;

/// Maximum number of views per client. The client chooses the name of a view. Without a limit, the
/// list of views could grow forever.
pub(crate) const MAX_VIEWS: usize = 8;

/// If the full picture is expected to take less time than this, coarser stages are skipped, because
/// they would be replaced before they are shown. At 30 pictures per second, a picture is shown for
/// 33 ms.
const FAST_MILLIS: f64 = 30.0;

/// All connected clients and their requests.
#[derive(Debug, Default)]
pub(crate) struct Queue {
    clients: BTreeMap<u64, ClientQueue>,
    n_joined: u64,
    last_served: u64,
}

/// Pending work of one client.
#[derive(Debug)]
struct ClientQueue {
    role: Role,
    views: BTreeMap<Arc<str>, ViewQueue>,
    last_served: Arc<str>,
    /// Bytes of the pictures that are being rendered or sent, the oldest first.
    unsent: VecDeque<usize>,
    outbox: VecDeque<Outgoing>,
    unreported: UnreportedPictures,
    wake: Arc<Notify>,
}

/// Pending work of one view.
#[derive(Debug, Default)]
struct ViewQueue {
    view_request: Option<Arc<ViewRequest>>,
    next_stage: usize,
    last_full: Option<FullPicture>,
}

/// Render time of the last stage of a view's last request.
#[derive(Debug)]
struct FullPicture {
    method: Option<String>,
    n_px: f64,
    millis: f64,
}

/// One stage to render.
#[derive(Clone, Debug)]
pub(crate) struct RenderJob {
    /// Requesting client.
    pub(crate) client: u64,
    /// The request.
    pub(crate) view_request: Arc<ViewRequest>,
    /// Index of the stage.
    pub(crate) stage: usize,
}

/// A result to send to a client.
#[derive(Debug)]
pub(crate) enum Outgoing {
    /// A rendered stage that is not encoded yet.
    Picture(Box<DrawnPicture>),
    /// A stage that could not be rendered.
    Failed {
        id: u64,
        view: Arc<str>,
        reason: String,
    },
    /// An edit that could not be made.
    Rejected { id: Option<u64>, reason: String },
}

/// A rendered stage.
#[derive(Debug)]
pub(crate) struct DrawnPicture {
    pub(crate) job: RenderJob,
    /// The header, which does not yet describe the payload.
    pub(crate) header: PictureHeader,
    /// The keyframes in the model, in a live run.
    pub(crate) trained_on: Option<TrainedKeyframes>,
    pub(crate) rendered: Rendered,
}

impl Queue {
    /// Adds a client. The returned handle is notified when its outbox has a result.
    pub(crate) fn join(&mut self, role: Role) -> (u64, Arc<Notify>) {
        let client = self.reserve_number();
        let waiting = ClientQueue::new(role);
        let wake = Arc::clone(&waiting.wake);
        self.clients.insert(client, waiting);
        (client, wake)
    }

    /// The number of a new client, which no other client gets.
    pub(crate) fn reserve_number(&mut self) -> u64 {
        self.n_joined += 1;
        self.n_joined
    }

    /// Removes a client and its pending work.
    pub(crate) fn leave(&mut self, client: u64) {
        self.clients.remove(&client);
    }

    /// Number of connected clients.
    pub(crate) fn n_clients(&self) -> usize {
        self.clients.len()
    }

    /// The connected clients, in the order in which they joined.
    pub(crate) fn clients(&self) -> Vec<ConnectedClient> {
        let clients = self.clients.iter();
        clients
            .map(|(&id, waiting)| ConnectedClient {
                id,
                role: waiting.role,
            })
            .collect()
    }

    /// Adds a request. Stages of the older request for the same view that have not been started are
    /// dropped. Returns false if all of the client's views have pending requests, so that there is
    /// no room for another view.
    ///
    /// Only the last stage is kept if it is expected to be fast.
    pub(crate) fn view_request(&mut self, client: u64, mut view_request: ViewRequest) -> bool {
        // The client is about to disconnect and would not receive an error.
        let Some(waiting) = self.clients.get_mut(&client) else {
            return true;
        };
        if !waiting.views.contains_key(&view_request.view) && waiting.views.len() >= MAX_VIEWS {
            // An idle view is kept only for its render time.
            let idle = waiting
                .views
                .iter()
                .find(|(_, view)| view.view_request.is_none());
            let Some(name) = idle.map(|(name, _)| Arc::clone(name)) else {
                return false;
            };
            waiting.views.remove(&name);
        }
        let view = waiting
            .views
            .entry(Arc::clone(&view_request.view))
            .or_default();
        if view
            .last_full
            .as_ref()
            .is_some_and(|last| last.expected_millis(&view_request) < FAST_MILLIS)
        {
            view_request.stages.drain(..view_request.stages.len() - 1);
        }
        view.view_request = Some(Arc::new(view_request));
        view.next_stage = 0;
        true
    }

    /// Whether [`take`](Self::take) would return a stage.
    pub(crate) fn has_work(&self) -> bool {
        self.clients
            .values()
            .any(|waiting| self.next_view(waiting).is_some())
    }

    /// The next stage to render. Clients take turns, the views of a client take turns, and the
    /// stages of a view follow in order.
    pub(crate) fn take(&mut self) -> Option<RenderJob> {
        // Numbers of clients only grow, so the next one in turn is the next larger number.
        let after = self.clients.range(self.last_served + 1..);
        let before = self.clients.range(..=self.last_served);
        let (client, name) = after
            .chain(before)
            .find_map(|(&id, waiting)| Some((id, self.next_view(waiting)?)))?;
        self.last_served = client;
        self.clients.get_mut(&client)?.take(client, name)
    }

    /// The view whose picture a client gets next; `None` if there is none, or if there is no room
    /// for its pictures.
    fn next_view(&self, waiting: &ClientQueue) -> Option<Arc<str>> {
        let same_role = self
            .clients
            .values()
            .filter(|other| other.role == waiting.role);
        // Clients need the shared memory only for bytes beyond their own memory.
        let n_shared = same_role
            .map(|other| other.n_unsent_bytes().saturating_sub(CLIENT_BYTES))
            .sum();
        waiting.next_view(SHARED_BYTES.saturating_sub(n_shared))
    }

    /// Records the render time of the last stage of a request.
    pub(crate) fn record_render_time(&mut self, job: &RenderJob, millis: f64) {
        let view = self
            .clients
            .get_mut(&job.client)
            .and_then(|waiting| waiting.views.get_mut(&job.view_request.view));
        if let Some(view) = view {
            view.last_full = Some(FullPicture {
                method: job.view_request.method.clone(),
                n_px: n_px_of_last_stage(&job.view_request),
                millis,
            });
        }
    }

    /// Puts a result into a client's outbox and wakes the client's writer. Drops the reason of a
    /// failed edit if the outbox is full; the number of the other results is limited by
    /// [`MAX_UNSENT`].
    pub(crate) fn push_outgoing(&mut self, client: u64, outgoing: Outgoing) {
        if let Some(waiting) = self.clients.get_mut(&client) {
            if waiting.outbox.len() >= MAX_OUTBOX && matches!(outgoing, Outgoing::Rejected { .. }) {
                log::debug!("client {client} does not read: a failed edit is not reported");
                return;
            }
            waiting.outbox.push_back(outgoing);
            waiting.wake.notify_one();
        }
    }

    /// Takes the oldest result from a client's outbox.
    pub(crate) fn collect(&mut self, client: u64) -> Option<Outgoing> {
        self.clients.get_mut(&client)?.outbox.pop_front()
    }

    /// The pictures that were sent to a client and that it has not reported as shown.
    pub(crate) fn unreported(&mut self, client: u64) -> Option<&mut UnreportedPictures> {
        self.clients
            .get_mut(&client)
            .map(|waiting| &mut waiting.unreported)
    }

    /// Records that a stage was sent or will never be rendered.
    pub(crate) fn release(&mut self, client: u64) {
        if let Some(waiting) = self.clients.get_mut(&client) {
            // Pictures are sent in the order in which they were taken, so this is the oldest.
            waiting.unsent.pop_front();
        }
    }
}

impl ClientQueue {
    fn new(role: Role) -> Self {
        Self {
            role,
            views: BTreeMap::new(),
            last_served: Arc::default(),
            unsent: VecDeque::new(),
            outbox: VecDeque::new(),
            unreported: UnreportedPictures::default(),
            wake: Arc::default(),
        }
    }

    fn n_unsent_bytes(&self) -> usize {
        self.unsent.iter().sum()
    }

    /// The next view in turn whose picture fits into [`CLIENT_BYTES`]. If the client has no other
    /// picture, `n_shared_bytes` are added.
    fn next_view(&self, n_shared_bytes: usize) -> Option<Arc<str>> {
        if self.unsent.len() >= MAX_UNSENT {
            return None;
        }
        // A picture that is larger than the client's memory must be the only one, so that a client
        // cannot take all of the shared memory.
        let n_more = if self.unsent.is_empty() {
            n_shared_bytes
        } else {
            0
        };
        let n_free = (CLIENT_BYTES + n_more).saturating_sub(self.n_unsent_bytes());
        let last = Bound::Excluded(Arc::clone(&self.last_served));
        let after = self.views.range::<Arc<str>, _>((last, Bound::Unbounded));
        // All views follow again, from the first to the last served one.
        let mut in_turn = after.chain(&self.views);
        let fits = |view: &ViewQueue| view.n_bytes_of_next().is_some_and(|n| n <= n_free);
        in_turn
            .find(|(_, view)| fits(view))
            .map(|(name, _)| Arc::clone(name))
    }

    fn take(&mut self, client: u64, name: Arc<str>) -> Option<RenderJob> {
        let view = self.views.get_mut(&name)?;
        // The bytes are counted before rendering, because the memory is needed from then on.
        self.unsent.push_back(view.n_bytes_of_next()?);
        let view_request = view.view_request.clone()?;
        let stage = view.next_stage;
        view.next_stage += 1;
        if view.next_stage == view_request.stages.len() {
            view.view_request = None;
        }
        self.last_served = name;
        Some(RenderJob {
            client,
            view_request,
            stage,
        })
    }
}

impl ViewQueue {
    /// Memory that the picture of the next stage needs until it is sent, bytes. JPEG and packed
    /// depth together take less than a byte per pixel. If depth is sent as f32, color is not packed
    /// on the GPU either, and the picture needs more memory.
    fn n_bytes_of_next(&self) -> Option<usize> {
        let view_request = self.view_request.as_ref()?;
        let [width, height] = view_request
            .stage_request(self.next_stage)
            .size_px
            .map(|n| n as usize);
        let is_f32 = view_request.depth == Some(DepthFormat::F32);
        let n_bytes_per_px = if is_f32 {
            4 + 4 * usize::from(view_request.color)
        } else {
            1
        };
        Some(width * height * n_bytes_per_px)
    }
}

impl FullPicture {
    /// Expected render time of the last stage of a request: the time of the previous picture,
    /// scaled up if the request has more pixels.
    fn expected_millis(&self, view_request: &ViewRequest) -> f64 {
        // Another model may be much slower, so the estimate would be meaningless.
        if self.method != view_request.method {
            return f64::INFINITY;
        }
        // A picture with fewer pixels takes less time, but not in proportion: each picture has
        // costs that do not depend on its size.
        self.millis * (n_px_of_last_stage(view_request) / self.n_px).max(1.0)
    }
}

fn n_px_of_last_stage(view_request: &ViewRequest) -> f64 {
    let size_px = view_request
        .stage_request(view_request.stages.len() - 1)
        .size_px;
    f64::from(size_px[0]) * f64::from(size_px[1])
}

#[cfg(test)]
mod tests {
    use super::{CLIENT_BYTES, MAX_OUTBOX, Outgoing, Queue, SHARED_BYTES};
    use crate::client::protocol::{DepthFormat, RenderMessage};
    use crate::pictures::view_request::ViewRequest;
    use crate::server::access::Role;

    fn view_request(id: u64) -> ViewRequest {
        let message: RenderMessage = serde_json::from_value(serde_json::json!({
            "id": id, "size_px": [100, 100], "projection": {"kind": "equirectangular"},
            "world_from_camera": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
        }))
        .expect("valid");
        ViewRequest::check(&message).expect("valid")
    }

    /// Takes and releases all stages at once, like a fast client.
    fn drain(queue: &mut Queue) -> Vec<(u64, u64, usize)> {
        std::iter::from_fn(|| {
            let job = queue.take()?;
            queue.release(job.client);
            Some((job.client, job.view_request.id, job.stage))
        })
        .collect()
    }

    #[test]
    fn clients_are_served_round_robin() {
        let mut queue = Queue::default();
        let (a, _) = queue.join(Role::Operator);
        let (b, _) = queue.join(Role::Operator);
        queue.view_request(a, view_request(10));
        queue.view_request(b, view_request(20));
        let served = drain(&mut queue);
        assert_eq!(
            served,
            [
                (a, 10, 0),
                (b, 20, 0),
                (a, 10, 1),
                (b, 20, 1),
                (a, 10, 2),
                (b, 20, 2)
            ]
        );
    }

    #[test]
    fn newer_request_replaces_waiting_stages() {
        let mut queue = Queue::default();
        let (a, _) = queue.join(Role::Operator);
        queue.view_request(a, view_request(1));
        let first = queue.take().expect("a request is pending");
        assert_eq!((first.view_request.id, first.stage), (1, 0));
        queue.view_request(a, view_request(2));
        queue.release(a);
        assert_eq!(drain(&mut queue), [(a, 2, 0), (a, 2, 1), (a, 2, 2)]);
    }

    #[test]
    fn slow_client_delays_only_itself() {
        let mut queue = Queue::default();
        let (slow, _) = queue.join(Role::Operator);
        let (fast, _) = queue.join(Role::Operator);
        queue.view_request(slow, view_request(1));
        queue.view_request(fast, view_request(2));
        let mut served = Vec::new();
        while let Some(job) = queue.take() {
            if job.client == fast {
                queue.release(fast);
            }
            served.push(job.client);
        }
        assert_eq!(served, [slow, fast, slow, fast, fast]);
        queue.release(slow);
        assert!(queue.has_work());
    }

    #[test]
    fn memory_of_unsent_pictures_is_bounded() {
        let large = |id, view: &str| {
            let mut large = view_request(id);
            (large.view, large.stages, large.depth) =
                (view.into(), vec![1.0], Some(DepthFormat::F32));
            large.request.size_px = [4096, 4096];
            large
        };
        let mut queue = Queue::default();
        let viewers: Vec<u64> = (0..32).map(|_| queue.join(Role::Viewer).0).collect();
        for viewer in &viewers {
            (0..8).for_each(|n| _ = queue.view_request(*viewer, large(n, &n.to_string())));
        }
        let served: Vec<u64> = std::iter::from_fn(|| queue.take())
            .map(|job| job.client)
            .collect();
        assert_eq!(
            served,
            viewers[..2],
            "one large picture each, of two clients"
        );
        let n_bytes: usize = queue
            .clients
            .values()
            .map(super::ClientQueue::n_unsent_bytes)
            .sum();
        assert!(n_bytes <= viewers.len() * CLIENT_BYTES + SHARED_BYTES);
        let (operator, _) = queue.join(Role::Operator);
        queue.view_request(operator, large(1, ""));
        assert_eq!(
            queue.take().expect("viewers do not delay operators").client,
            operator
        );
        let (other, _) = queue.join(Role::Viewer);
        queue.view_request(other, view_request(5));
        assert_eq!(
            queue.take().expect("a small picture always fits").client,
            other
        );
        queue.release(viewers[0]);
        assert!(viewers.contains(&queue.take().expect("there is room again").client));
    }

    #[test]
    fn fast_full_picture_skips_coarse_stages() {
        let mut queue = Queue::default();
        let (a, _) = queue.join(Role::Operator);
        let draw = |queue: &mut Queue, id: u64, millis: f64, change: fn(&mut ViewRequest)| {
            let mut requested = view_request(id);
            change(&mut requested);
            queue.view_request(a, requested);
            let mut scales = Vec::new();
            while let Some(job) = queue.take() {
                scales.push(job.view_request.stages[job.stage]);
                if job.stage + 1 == job.view_request.stages.len() {
                    queue.record_render_time(&job, millis);
                }
                queue.release(a);
            }
            scales
        };
        assert_eq!(
            draw(&mut queue, 1, 29.0, |_| ()),
            [0.1, 0.5, 1.0],
            "there is no earlier picture"
        );
        assert_eq!(
            draw(&mut queue, 2, 31.0, |_| ()),
            [1.0],
            "the last one was fast"
        );
        assert_eq!(
            draw(&mut queue, 3, 3.0, |_| ()),
            [0.1, 0.5, 1.0],
            "the last one was slow"
        );
        assert_eq!(
            draw(&mut queue, 4, 3.0, |view_request| view_request.stages =
                vec![0.5]),
            [0.5]
        );
        assert_eq!(
            draw(&mut queue, 5, 8.0, |_| ()),
            [1.0],
            "four times the pixels in 12 ms"
        );
        assert_eq!(
            draw(&mut queue, 6, 6.0, |view_request| view_request
                .request
                .size_px = [200, 200]),
            [0.1, 0.5, 1.0],
            "32 ms"
        );
        assert_eq!(
            draw(&mut queue, 7, 1.0, |view_request| view_request.method =
                Some("nerf".to_owned())),
            [0.1, 0.5, 1.0]
        );
        assert_eq!(
            draw(&mut queue, 8, 1.0, |view_request| view_request.method =
                Some("nerf".to_owned())),
            [1.0]
        );
    }

    #[test]
    fn client_that_does_not_read_gets_a_limited_number_of_results() {
        let mut queue = Queue::default();
        let (a, _) = queue.join(Role::Operator);
        let rejected = |id| Outgoing::Rejected {
            id: Some(id),
            reason: String::new(),
        };
        (0..1000).for_each(|id| queue.push_outgoing(a, rejected(id)));
        queue.push_outgoing(
            a,
            Outgoing::Failed {
                id: 5,
                view: "".into(),
                reason: String::new(),
            },
        );
        let sent: Vec<Outgoing> = std::iter::from_fn(|| queue.collect(a)).collect();
        assert_eq!(sent.len(), MAX_OUTBOX + 1);
        assert!(
            matches!(sent[63], Outgoing::Rejected { id: Some(63), .. }),
            "the oldest are kept: {:?}",
            sent[63]
        );
        assert!(
            matches!(sent[64], Outgoing::Failed { .. }),
            "pictures are never dropped: {:?}",
            sent[64]
        );
        queue.push_outgoing(a, rejected(7));
        assert!(queue.collect(a).is_some(), "there is room again");
    }

    #[test]
    fn disconnected_client_is_forgotten() {
        let mut queue = Queue::default();
        let (a, _) = queue.join(Role::Operator);
        queue.view_request(a, view_request(1));
        queue.leave(a);
        assert!(queue.take().is_none() && !queue.has_work() && queue.n_clients() == 0);
        queue.view_request(a, view_request(2));
        assert!(queue.take().is_none());
    }
}
