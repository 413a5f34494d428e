//! Passes pictures between the clients that request them and the training thread that renders them.

use crate::client::protocol::ProjectionMessage;
use crate::client::server_message::PictureHeader;
use crate::pictures::picture::packing;
use crate::pictures::picture_times::{SentPicture, ShownPicture, ShownPictures, TrainedKeyframes};
use crate::pictures::queue::{DrawnPicture, Outgoing, Queue, RenderJob};
use crate::pictures::view_request::ViewRequest;
use crate::pose::row_major;
use crate::server::access::Role;
use crate::topics::operator_status::ConnectedClient;
use parking_lot::{Condvar, Mutex, MutexGuard};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Notify;
use trainer::{Packing, Projection, RenderRequest, Rendered};

/// The pictures that clients have requested, from the request until they are shown.
#[derive(Debug, Default)]
pub struct PictureRequests {
    queue: Mutex<Queue>,
    work_arrived: Condvar,
    shown_pictures: Mutex<ShownPictures>,
}

impl PictureRequests {
    /// The next picture to render, if a client is waiting for one.
    ///
    /// Each call returns one stage of one view. Clients are served in turn, and so are the views of
    /// a client.
    pub fn next_request(self: &Arc<Self>) -> Option<PendingRender> {
        let job = self.queue().take()?;
        Some(PendingRender {
            request: job.view_request.stage_request(job.stage),
            started: Instant::now(),
            pictures: Arc::clone(self),
            job,
            trained_on: None,
            model: None,
            is_released: false,
        })
    }

    /// Waits up to `timeout` until a client requests a picture. Returns whether one did.
    ///
    /// For callers that have nothing to train.
    pub fn wait_for_request(&self, timeout: Duration) -> bool {
        // The queue is unlocked while waiting, and requests notify after they have released it.
        let mut queue = self.queue();
        self.work_arrived
            .wait_while_for(&mut queue, |queue| !queue.has_work(), timeout);
        queue.has_work()
    }

    /// The pictures of models in training that clients have shown since the last call. If this is
    /// not called for a long time, the oldest pictures are missing.
    pub fn take_shown(&self) -> Vec<ShownPicture> {
        self.shown_pictures.lock().take()
    }

    /// Adds a client.
    pub(crate) fn join(&self, role: Role) -> (u64, Arc<Notify>) {
        self.queue().join(role)
    }

    /// A number that no client of any socket has or gets.
    pub(crate) fn reserve_number(&self) -> u64 {
        self.queue().reserve_number()
    }

    /// Removes a client with its requests.
    pub(crate) fn leave(&self, client: u64) {
        self.queue().leave(client);
    }

    /// Number of connected clients.
    pub(crate) fn n_clients(&self) -> usize {
        self.queue().n_clients()
    }

    /// The connected clients, in the order in which they joined.
    pub(crate) fn clients(&self) -> Vec<ConnectedClient> {
        self.queue().clients()
    }

    /// Adds a request. Returns false if the client has too many views.
    pub(crate) fn request(&self, client: u64, view_request: ViewRequest) -> bool {
        let is_added = self.queue().view_request(client, view_request);
        self.work_arrived.notify_all();
        is_added
    }

    /// Puts a result into a client's outbox.
    pub(crate) fn push_outgoing(&self, client: u64, outgoing: Outgoing) {
        self.queue().push_outgoing(client, outgoing);
    }

    /// Takes the next result out of a client's outbox.
    pub(crate) fn collect(&self, client: u64) -> Option<Outgoing> {
        self.queue().collect(client)
    }

    /// Frees the place of a picture that was sent or will not be sent.
    pub(crate) fn release(&self, client: u64) {
        self.queue().release(client);
        // There is room for another picture of this client, so its next request can be rendered.
        self.work_arrived.notify_all();
    }

    /// Records that the server begins to send a picture to a client.
    pub(crate) fn record_sent(&self, client: u64, picture: SentPicture) {
        if let Some(unreported) = self.queue().unreported(client) {
            unreported.sent(picture);
        }
    }

    /// Records that a client has shown a picture; does nothing if the picture is unknown.
    pub(crate) fn record_shown(&self, client: u64, id: u64, view: &str, shown_at: Instant) {
        let picture = self
            .queue()
            .unreported(client)
            .and_then(|unreported| unreported.shown(id, view, shown_at));
        // The lock of the queue has been released before another lock is taken, so no order of
        // locks is needed.
        if let Some(picture) = picture {
            self.shown_pictures.lock().push(picture);
        }
    }

    /// Locks the queue. It holds plain values that are valid after every statement, so it stays
    /// usable after a panic elsewhere.
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock()
    }
}

/// The model in a picture.
#[derive(Clone, Debug)]
struct DrawnModel {
    method: String,
    /// Number of optimizer steps.
    step: u64,
}

/// A picture for which a client is waiting. If it is dropped without an answer, the client receives
/// nothing for this stage.
#[derive(Debug)]
pub struct PendingRender {
    /// What to render, at the size of this stage.
    pub request: RenderRequest,
    started: Instant,
    pictures: Arc<PictureRequests>,
    job: RenderJob,
    trained_on: Option<TrainedKeyframes>,
    model: Option<DrawnModel>,
    is_released: bool,
}

impl PendingRender {
    /// Requested model; the first model if `None`. The name comes from the client and may not
    /// exist.
    pub fn method(&self) -> Option<&str> {
        self.job.view_request.method.as_deref()
    }

    /// Sets the model that is drawn: its method and its number of steps. Clients label the picture
    /// with these values, so they must describe the drawn model and not the request.
    #[must_use]
    pub fn of_model(mut self, method: &str, step: u64) -> Self {
        self.model = Some(DrawnModel {
            method: method.to_owned(),
            step,
        });
        self
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
        // Only the last stage is recorded, because the estimate is for the full picture and coarse
        // stages take less time.
        if header.last {
            self.pictures
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
        self.pictures.push_outgoing(self.job.client, outgoing);
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
            method: self.model.as_ref().map(|model| model.method.clone()),
            step: self.model.as_ref().map(|model| model.step),
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
        // The run dropped the request without an answer, for example after an error. The place of
        // its picture must become free.
        if !self.is_released {
            self.pictures.release(self.job.client);
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
