//! Shared state of the training thread and the server. The training thread never waits for a
//! client.

use crate::client::protocol::{Control, ProjectionMessage};
use crate::client::server_message::PictureHeader;
use crate::edit::EditRequest;
use crate::pictures::picture::packing;
use crate::pictures::picture_times::{SentPicture, ShownPicture, ShownPictures, TrainedKeyframes};
use crate::pictures::queue::{DrawnPicture, Outgoing, Queue, RenderJob};
use crate::pictures::view_request::ViewRequest;
use crate::pictures::viewpoint::Viewpoint;
use crate::pose::row_major;
use crate::server::access::Role;
use crate::topics::subscriptions::Subscriptions;
use parking_lot::{Condvar, Mutex, MutexGuard};
use std::any::{Any, TypeId};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, watch};
use trainer::{Packing, Projection, RenderRequest, Rendered};

/// Handle shared by the training thread and a [`Server`](crate::Server). Clones refer to the same
/// hub.
#[derive(Clone, Debug, Default)]
pub struct Hub {
    shared: Arc<Shared>,
}

/// The latest data of the topics, by type.
type LatestData = BTreeMap<TypeId, Box<dyn Any + Send>>;

/// A client gets keyframes and images this long after it has joined, or after its hello. Earlier,
/// it is not known which of them it wants, and at which size. With less time, pages on slow links
/// get complete lists and large images first; with more, clients that send no hello wait longer.
const HELLO_GRACE: Duration = Duration::from_millis(500);
/// Maximum number of edits that wait to be applied. It is also the maximum number of edits of a
/// model.
pub(crate) const MAX_WAITING_EDITS: usize = 64;

/// What a client receives.
#[derive(Clone, Debug)]
pub(crate) struct Demand {
    joined: Instant,
    /// Whether it has sent a hello.
    pub(crate) has_hello: bool,
    /// Its subscriptions.
    pub(crate) subscriptions: Arc<Subscriptions>,
    /// Whether it receives only the changes of the keyframe list.
    pub(crate) has_keyframe_changes: bool,
    /// Viewpoint of its newest picture.
    pub(crate) viewpoint: Option<Viewpoint>,
}

impl Demand {
    /// The demand of a client that has sent nothing.
    pub(crate) fn new(joined: Instant) -> Self {
        Self {
            joined,
            has_hello: false,
            subscriptions: Arc::default(),
            has_keyframe_changes: false,
            viewpoint: None,
        }
    }

    /// The time from which the client gets keyframes and images, if it is later.
    pub(crate) fn settles_at(&self, now: Instant) -> Option<Instant> {
        let settled = self.joined + HELLO_GRACE;
        (!self.has_hello && settled > now).then_some(settled)
    }
}

#[derive(Debug, Default)]
struct Shared {
    /// A [`watch::Sender`] of each type that [`Hub::latest`] was called with.
    latest: Mutex<LatestData>,
    /// Requirements of the connected clients.
    demands: Mutex<BTreeMap<u64, Demand>>,
    /// Actions that the run has not taken yet, without repetitions.
    controls: Mutex<Vec<Control>>,
    shown_pictures: Mutex<ShownPictures>,
    /// Edits that the run has not taken yet.
    edits: Mutex<Vec<EditRequest>>,
    /// Whether somebody besides the clients needs images and robot states.
    is_observed: AtomicBool,
    queue: Mutex<Queue>,
    work_arrived: Condvar,
}

impl Hub {
    /// Creates an empty hub.
    pub fn new() -> Self {
        Self::default()
    }

    /// The latest data of this type. Each topic has types of its own, and sets and reads them in
    /// its module.
    pub(crate) fn latest<T: Default + Send + Sync + 'static>(&self) -> watch::Sender<T> {
        // Without a field for each topic, a new topic needs no change here. The lock is held only
        // to find the sender, so the training thread does not wait for whoever reads the data.
        let mut latest = self.shared.latest.lock();
        let sender = latest
            .entry(TypeId::of::<T>())
            .or_insert_with(|| Box::new(watch::Sender::<T>::default()));
        sender
            .downcast_ref::<watch::Sender<T>>()
            .expect("the key is its type")
            .clone()
    }

    /// Whether a client receives a topic.
    pub(crate) fn is_wanted(&self, topic: &str) -> bool {
        self.has_subscription(|subscriptions| subscriptions.period(topic).is_some())
    }

    /// Whether the subscriptions of any client fulfill a condition.
    pub(crate) fn has_subscription(&self, condition: impl Fn(&Subscriptions) -> bool) -> bool {
        self.shared
            .demands
            .lock()
            .values()
            .any(|demand| condition(&demand.subscriptions))
    }

    /// The minimum period over the subscriptions of all clients; `None` if no client has one.
    pub(crate) fn min_over_subscriptions(
        &self,
        period: impl Fn(&Subscriptions) -> Option<Duration>,
    ) -> Option<Duration> {
        self.shared
            .demands
            .lock()
            .values()
            .filter_map(|demand| period(&demand.subscriptions))
            .min()
    }

    /// Sets whether somebody besides the clients needs images and robot states.
    #[cfg(feature = "foxglove")]
    pub(crate) fn set_observed(&self, is_observed: bool) {
        self.shared
            .is_observed
            .store(is_observed, Ordering::Relaxed);
    }

    pub(crate) fn is_observed(&self) -> bool {
        self.shared.is_observed.load(Ordering::Relaxed)
    }

    /// The actions that operators have requested since the last call, in order.
    pub fn take_controls(&self) -> Vec<Control> {
        std::mem::take(&mut *self.shared.controls.lock())
    }

    /// Requests an action of the run.
    pub(crate) fn control(&self, action: Control) {
        let mut controls = self.shared.controls.lock();
        // Repeated clicks count once, and as the last action: after pause, resume and pause, the
        // run must pause.
        controls.retain(|earlier| *earlier != action);
        controls.push(action);
    }

    /// The pictures of models in training that clients have shown since the last call. If it is not
    /// called for long, the oldest are missing.
    pub fn take_shown_pictures(&self) -> Vec<ShownPicture> {
        self.shared.shown_pictures.lock().take()
    }

    /// Records that the server begins to send a picture to a client.
    pub(crate) fn picture_sent(&self, client: u64, picture: SentPicture) {
        if let Some(unreported) = self.queue().unreported(client) {
            unreported.sent(picture);
        }
    }

    /// Records that a client has shown a picture; does nothing if the picture is unknown.
    pub(crate) fn picture_shown(&self, client: u64, id: u64, view: &str, shown_at: Instant) {
        let picture = self
            .queue()
            .unreported(client)
            .and_then(|unreported| unreported.shown(id, view, shown_at));
        // The lock of the queue has been released, so that there is no order of locks to keep.
        if let Some(picture) = picture {
            self.shared.shown_pictures.lock().push(picture);
        }
    }

    /// The edits that operators have requested since the last call, in order.
    pub fn take_edits(&self) -> Vec<EditRequest> {
        std::mem::take(&mut *self.shared.edits.lock())
    }

    /// Sends the client a one-sentence reason why an edit could not be made.
    pub fn reject_edit(&self, request: &EditRequest, reason: &str) {
        let rejected = Outgoing::Rejected {
            id: request.id,
            reason: reason.to_owned(),
        };
        self.queue().push_outgoing(request.client, rejected);
    }

    /// Requests an edit. Returns false if too many edits are waiting.
    pub(crate) fn edit(&self, request: EditRequest) -> bool {
        let mut edits = self.shared.edits.lock();
        let has_room = edits.len() < MAX_WAITING_EDITS;
        if has_room {
            edits.push(request);
        }
        has_room
    }

    /// Number of connected clients.
    pub fn n_clients(&self) -> usize {
        self.queue().n_clients()
    }

    /// The next picture to render, if a client is waiting for one.
    ///
    /// Each call returns one stage of one view. Clients are served in turn, and so are the views of
    /// a client.
    pub fn next_request(&self) -> Option<PendingRender> {
        let job = self.queue().take()?;
        Some(PendingRender {
            request: job.view_request.stage_request(job.stage),
            started: Instant::now(),
            hub: self.clone(),
            job,
            trained_on: None,
            is_released: false,
        })
    }

    /// Waits up to `timeout` until a client requests a picture. Returns whether one did.
    ///
    /// For callers that have nothing to train.
    pub fn wait_for_request(&self, timeout: Duration) -> bool {
        // The queue is unlocked while waiting, and requests notify after they have released it.
        let mut queue = self.queue();
        self.shared
            .work_arrived
            .wait_while_for(&mut queue, |queue| !queue.has_work(), timeout);
        queue.has_work()
    }

    pub(crate) fn join(&self, role: Role) -> (u64, Arc<Notify>) {
        let (client, wake) = self.queue().join(role);
        self.set_demand(client, Demand::new(Instant::now()));
        (client, wake)
    }

    pub(crate) fn leave(&self, client: u64) {
        self.queue().leave(client);
        self.shared.demands.lock().remove(&client);
        // Chunks of a model take as much memory as its file.
        self.drop_unused_chunks();
    }

    /// Sets what a client receives.
    pub(crate) fn set_demand(&self, client: u64, demand: Demand) {
        self.shared.demands.lock().insert(client, demand);
        self.drop_unused_chunks();
    }

    /// What the connected clients receive.
    pub(crate) fn demands(&self) -> Vec<Demand> {
        self.shared.demands.lock().values().cloned().collect()
    }

    /// Adds a request. Returns false if the client has too many views.
    pub(crate) fn view_request(&self, client: u64, view_request: ViewRequest) -> bool {
        let is_added = self.queue().view_request(client, view_request);
        self.shared.work_arrived.notify_all();
        is_added
    }

    pub(crate) fn collect(&self, client: u64) -> Option<Outgoing> {
        self.queue().collect(client)
    }

    pub(crate) fn release(&self, client: u64) {
        self.queue().release(client);
        // There is room for another picture of this client, so its next request can be rendered.
        self.shared.work_arrived.notify_all();
    }

    /// Locks the queue. It holds plain values that are valid after every statement, so it stays
    /// usable after a panic elsewhere.
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.shared.queue.lock()
    }
}

/// A picture for which a client is waiting. If it is dropped without an answer, the client receives
/// nothing for this stage.
#[derive(Debug)]
pub struct PendingRender {
    /// What to render, at the size of this stage.
    pub request: RenderRequest,
    started: Instant,
    hub: Hub,
    job: RenderJob,
    trained_on: Option<TrainedKeyframes>,
    is_released: bool,
}

impl PendingRender {
    /// Requested model; the first if `None`. The name comes from the client and may not exist.
    pub fn method(&self) -> Option<&str> {
        self.job.view_request.method.as_deref()
    }

    /// Sets the keyframes on which the model has been trained, of which the client is informed.
    #[must_use]
    pub fn of_keyframes(mut self, trained_on: TrainedKeyframes) -> Self {
        self.trained_on = Some(trained_on);
        self
    }

    /// How this stage is packed on the GPU; `None` if the client requested a format that the GPU
    /// does not support.
    pub fn packing(&self) -> Option<Packing> {
        packing(
            &self.job.view_request,
            self.job.stage + 1 == self.job.view_request.stages.len(),
        )
    }

    /// Sets when rendering began, if other pictures of a batch were rendered first.
    #[must_use]
    pub fn began_at(mut self, began: Instant) -> Self {
        self.started = self.started.max(began);
        self
    }

    /// Sends the rendered picture to the client. Encoding happens on the server's threads.
    pub fn deliver(mut self, picture: impl Into<Rendered>) {
        let rendered = picture.into();
        let header = self.header(rendered.size_px());
        // Coarse stages take less time, and the estimate is for the full picture.
        if header.last {
            self.hub
                .queue()
                .record_render_time(&self.job, header.render_millis);
        }
        let drawn = DrawnPicture {
            job: self.job.clone(),
            header,
            trained_on: self.trained_on,
            rendered,
        };
        self.enqueue_answer(Outgoing::Picture(Box::new(drawn)));
    }

    /// Sends the client a one-sentence reason why this picture could not be rendered.
    pub fn fail(mut self, reason: &str) {
        let id = self.job.view_request.id;
        let view = Arc::clone(&self.job.view_request.view);
        self.enqueue_answer(Outgoing::Failed {
            id,
            view,
            reason: reason.to_owned(),
        });
    }

    fn enqueue_answer(&mut self, outgoing: Outgoing) {
        self.is_released = true; // The writer releases it after sending.
        self.hub.queue().push_outgoing(self.job.client, outgoing);
    }

    fn header(&self, size_px: [u32; 2]) -> PictureHeader {
        let view_request = &self.job.view_request;
        PictureHeader {
            id: view_request.id,
            view: (!view_request.view.is_empty()).then(|| view_request.view.to_string()),
            stage: self.job.stage,
            n_stages: view_request.stages.len(),
            scale: view_request.stages[self.job.stage],
            last: self.job.stage + 1 == view_request.stages.len(),
            size_px,
            full_size_px: view_request.request.size_px,
            world_from_camera: row_major(&view_request.request.world_from_camera),
            projection: projection_message(&view_request.request.projection),
            near_m: view_request.request.near_m,
            far_m: view_request.request.far_m,
            waited_millis: (self.started - view_request.received).as_secs_f64() * 1e3,
            render_millis: self.started.elapsed().as_secs_f64() * 1e3,
            encode_millis: None,
            keyframes: self.trained_on.map(|trained_on| trained_on.n),
            // These are known only when the picture is sent.
            newest_keyframe: None,
            sent_millis: 0.0,
            color: None,
            depth: None,
        }
    }
}

impl Drop for PendingRender {
    fn drop(&mut self) {
        // The run dropped it, for example after an error. Its place must become free.
        if !self.is_released {
            self.hub.release(self.job.client);
        }
    }
}

fn projection_message(projection: &Projection) -> ProjectionMessage {
    match *projection {
        Projection::Pinhole {
            focal_px,
            principal_px,
        } => ProjectionMessage::Pinhole {
            focal_px: Some(focal_px),
            principal_px: Some(principal_px),
            vertical_fov_rad: None,
        },
        Projection::Equirectangular => ProjectionMessage::Equirectangular {},
    }
}
