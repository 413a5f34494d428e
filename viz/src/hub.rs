//! Shared state of the training thread and the server. The training thread never waits for a client.

use crate::edit::EditRequest;
use crate::pictures::picture::packing;
use crate::pictures::picture_times::{SentPicture, ShownPicture, ShownPictures, TrainedKeyframes};
use crate::pictures::queue::{DrawnPicture, Outgoing, Queue, RenderJob};
use crate::pictures::view_request::ViewRequest;
use crate::pictures::viewpoint::Viewpoint;
use crate::pose::row_major;
use crate::server::access::Role;
use crate::session::protocol::{Control, ProjectionMessage};
use crate::session::server_message::PictureHeader;
use crate::topics::base_path::BasePath;
use crate::topics::chunk_list::ChunkList;
use crate::topics::observation_map::{ObservationMap, PackedObservations};
use crate::topics::range_scan::RangeScan;
use crate::topics::robot::{RobotDescription, RobotState};
use crate::topics::subscriptions::Subscriptions;
use crate::topics::updates::{KeyframePose, LiveImage, RunResult, SceneHint, Status};
use keyframe::Keyframe;
use kinematics::{Stamp, Transform};
use parking_lot::{Condvar, Mutex, MutexGuard};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, watch};
use trainer::{ModelChunks, Packing, Projection, RenderRequest, Rendered};

/// Handle shared by the training thread and a [`Server`](crate::Server). Clones refer to the same hub.
#[derive(Clone, Debug, Default)]
pub struct Hub {
    shared: Arc<Shared>,
}

/// Latest images by camera name.
pub(crate) type LiveImages = BTreeMap<Arc<str>, Arc<LiveImage>>;

/// Latest scans by scanner name.
pub(crate) type RangeScans = BTreeMap<Arc<str>, Arc<RangeScan>>;

/// Chunks of models by method.
pub(crate) type ModelLists = BTreeMap<Arc<str>, Arc<ChunkList>>;

/// Keyframes by camera and stamp.
type KeyframeSources = BTreeMap<(Arc<str>, i64), Weak<Keyframe>>;

/// A client gets keyframes and images this long after it has joined, or after its hello. Earlier, it is not known which
/// of them it wants, and at which size.
const HELLO_GRACE: Duration = Duration::from_millis(500);
/// Maximum number of edits that wait to be applied.
pub(crate) const MAX_WAITING_EDITS: usize = 64;
/// Maximum time between two positions on the path of the base.
const PATH_PERIOD: Duration = Duration::from_millis(100);

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
        Self { joined, has_hello: false, subscriptions: Arc::default(), has_keyframe_changes: false, viewpoint: None }
    }

    /// The time from which the client gets keyframes and images, if it is later.
    pub(crate) fn settles_at(&self, now: Instant) -> Option<Instant> {
        let settled = self.joined + HELLO_GRACE;
        (!self.has_hello && settled > now).then_some(settled)
    }
}

#[derive(Debug, Default)]
struct Shared {
    status: watch::Sender<Option<Arc<Status>>>,
    scene: watch::Sender<Option<Arc<SceneHint>>>,
    keyframes: watch::Sender<Arc<[KeyframePose]>>,
    live_images: watch::Sender<LiveImages>,
    /// Keyframes whose points clients can draw. The run owns them and may drop them at any time.
    keyframe_sources: Mutex<KeyframeSources>,
    /// Chunks of the models to which clients subscribe.
    model_chunks: watch::Sender<ModelLists>,
    /// Pose of the models in the world of the clients; the identity if `None`.
    world_from_model: Mutex<Option<Transform>>,
    robot: watch::Sender<Option<Arc<RobotDescription>>>,
    robot_state: watch::Sender<Option<Arc<RobotState>>>,
    base_path: watch::Sender<BasePath>,
    /// When the path was extended last.
    path_extended: Mutex<Option<Instant>>,
    range_scans: watch::Sender<RangeScans>,
    observations: watch::Sender<Option<Arc<PackedObservations>>>,
    /// Requirements of the connected clients.
    demands: Mutex<BTreeMap<u64, Demand>>,
    /// For each camera: transform `reported_from_corrected`.
    camera_corrections: Mutex<BTreeMap<Arc<str>, Transform>>,
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

    /// Sets the run status that clients receive.
    pub fn set_status(&self, status: Status) {
        self.shared.status.send_replace(Some(Arc::new(status.thinned())));
    }

    /// Replaces the state in the latest status and keeps its numbers, for example while the model is saved.
    pub fn set_state(&self, state: &str) {
        self.change_status(|status| state.clone_into(&mut status.state));
    }

    /// Sets the result of the run. Clients continue to show it after the server has stopped.
    pub fn set_run_result(&self, result: RunResult) {
        self.change_status(|status| {
            "finished".clone_into(&mut status.state);
            status.result = Some(result);
        });
    }

    /// Changes the latest status.
    pub fn change_status(&self, change: impl FnOnce(&mut Status)) {
        self.shared.status.send_modify(|latest| {
            let mut status = latest.as_deref().cloned().unwrap_or_default();
            change(&mut status);
            *latest = Some(Arc::new(status));
        });
    }

    /// Sets the latest image of a camera. It is encoded later, on another thread, and only while clients are
    /// connected. Its pose is corrected as set by [`Self::set_camera_corrections`].
    pub fn set_live_image(&self, mut image: LiveImage) {
        if let (Some(pose), Some(correction)) =
            (&mut image.world_from_camera, self.shared.camera_corrections.lock().get(&image.camera))
        {
            *pose *= correction;
        }
        self.shared.live_images.send_modify(|images| {
            images.insert(Arc::clone(&image.camera), Arc::new(image));
        });
    }

    /// Sets `reported_from_corrected` of each camera, with which the poses of later live images are corrected.
    pub fn set_camera_corrections(&self, corrections: BTreeMap<Arc<str>, Transform>) {
        *self.shared.camera_corrections.lock() = corrections;
    }

    /// Sets the scene extent and the initial view.
    pub fn set_scene_hint(&self, hint: SceneHint) {
        self.shared.scene.send_replace(Some(Arc::new(hint)));
    }

    /// Replaces the keyframe frustums. Call this when the keyframes have changed.
    pub fn set_keyframes(&self, keyframes: Vec<KeyframePose>) {
        self.shared.keyframes.send_replace(keyframes.into());
    }

    /// The keyframe frustums.
    pub fn keyframe_poses(&self) -> Vec<KeyframePose> {
        self.shared.keyframes.borrow().to_vec()
    }

    /// The minimum time between two calls of [`Self::set_model_chunks`] for a model; `None` if no client draws it.
    pub fn chunk_period(&self, method: &str) -> Option<Duration> {
        let demands = self.shared.demands.lock();
        let subscriptions = demands.values().filter_map(|demand| demand.subscriptions.model_chunks.as_ref());
        subscriptions.filter(|chunks| &*chunks.method == method).map(|chunks| chunks.period).min()
    }

    /// Whether clients have the chunks of this model, so that only changed chunks are needed.
    pub fn has_model_chunks(&self, method: &str) -> bool {
        self.shared.model_chunks.borrow().contains_key(method)
    }

    /// Sets the chunks of a model, or those that have changed. They are kept only while a client draws the model.
    pub fn set_model_chunks(&self, method: &str, chunks: ModelChunks) {
        if self.chunk_period(method).is_none() {
            return;
        }
        self.shared.model_chunks.send_modify(|lists| {
            let mut list = lists.get(method).map(|list| (**list).clone()).unwrap_or_default();
            list.world_from_model = self.shared.world_from_model.lock().unwrap_or_default();
            if list.apply(chunks) {
                lists.insert(method.into(), Arc::new(list));
            }
        });
    }

    /// Sets the pose of models in the world of the clients, for chunks; by default, the two frames are the same.
    pub fn set_world_from_model(&self, world_from_model: Transform) {
        *self.shared.world_from_model.lock() = Some(world_from_model);
    }

    /// Frees the chunks of models that no client draws any longer.
    fn drop_unused_chunks(&self) {
        let unused = |method: &str| self.chunk_period(method).is_none();
        self.shared.model_chunks.send_if_modified(|lists| {
            let n_before = lists.len();
            lists.retain(|method, _| !unused(method));
            lists.len() < n_before
        });
    }

    /// Sets the robot that clients draw.
    pub fn set_robot(&self, robot: RobotDescription) {
        self.shared.robot.send_replace(Some(Arc::new(robot)));
    }

    /// Sets the current state of the robot.
    pub fn set_robot_state(&self, state: RobotState) {
        *self.shared.path_extended.lock() = Some(Instant::now());
        self.shared.base_path.send_if_modified(|path| path.push(state.world_from_base.translation.vector.into()));
        self.shared.robot_state.send_replace(Some(Arc::new(state)));
    }

    /// Sets whether somebody besides the clients needs images and robot states.
    #[cfg(feature = "foxglove")]
    pub(crate) fn set_observed(&self, is_observed: bool) {
        self.shared.is_observed.store(is_observed, Ordering::Relaxed);
    }

    fn is_observed(&self) -> bool {
        self.shared.is_observed.load(Ordering::Relaxed)
    }

    /// Whether a client shows the images of any camera.
    pub fn needs_live_images(&self) -> bool {
        self.is_observed() || self.shared.demands.lock().values().any(|demand| demand.subscriptions.has_live_images())
    }

    /// Whether a client draws the robot, or the path of its base is due.
    pub fn needs_robot_state(&self) -> bool {
        let is_path_due = self.shared.path_extended.lock().is_none_or(|at| at.elapsed() >= PATH_PERIOD);
        self.is_observed()
            || is_path_due
            || self.shared.demands.lock().values().any(|demand| demand.subscriptions.robot_state.is_some())
    }

    /// Sets the latest scan of a range scanner. It is encoded later, on another thread, and only for clients that show
    /// it.
    pub fn set_range_scan(&self, range_scan: RangeScan) {
        self.shared.range_scans.send_modify(|scans| {
            scans.insert(Arc::clone(&range_scan.scan.scanner), Arc::new(range_scan));
        });
    }

    /// Whether a client shows when and how precisely the scene was observed.
    pub fn needs_observations(&self) -> bool {
        self.shared.demands.lock().values().any(|demand| demand.subscriptions.observations.is_some())
    }

    /// Sets the map of observations. Compresses it, which takes some milliseconds.
    pub fn set_observations(&self, map: &ObservationMap) {
        match PackedObservations::new(map) {
            Ok(packed) => _ = self.shared.observations.send_replace(Some(Arc::new(packed))),
            Err(error) => log::error!("cannot compress the map of observations: {error}"),
        }
    }

    /// Sets the keyframes of which clients can draw points. They are not kept alive.
    pub fn set_keyframe_sources<'a>(&self, keyframes: impl IntoIterator<Item = &'a Arc<Keyframe>>) {
        let key = |keyframe: &Keyframe| (Arc::clone(&keyframe.camera), keyframe.stamp.0);
        let sources = keyframes.into_iter().map(|keyframe| (key(keyframe), Arc::downgrade(keyframe))).collect();
        *self.shared.keyframe_sources.lock() = sources;
    }

    /// The keyframe with this camera and stamp, if the run still has it.
    pub(crate) fn keyframe_source(&self, camera: &Arc<str>, stamp: Stamp) -> Option<Arc<Keyframe>> {
        self.shared.keyframe_sources.lock().get(&(Arc::clone(camera), stamp.0))?.upgrade()
    }

    /// The actions that operators have requested since the last call, in order.
    pub fn take_controls(&self) -> Vec<Control> {
        std::mem::take(&mut *self.shared.controls.lock())
    }

    /// Requests an action of the run.
    pub(crate) fn control(&self, action: Control) {
        let mut controls = self.shared.controls.lock();
        controls.retain(|earlier| *earlier != action);
        controls.push(action);
    }

    /// The pictures of models in training that clients have shown since the last call. If it is not called for long, the
    /// oldest are missing.
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
        let picture = self.queue().unreported(client).and_then(|unreported| unreported.shown(id, view, shown_at));
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
        let rejected = Outgoing::Rejected { id: request.id, reason: reason.to_owned() };
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
    /// Each call returns one stage of one view. Clients are served in turn, and so are the views of a client.
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
        let mut queue = self.queue();
        self.shared.work_arrived.wait_while_for(&mut queue, |queue| !queue.has_work(), timeout);
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
        self.shared.work_arrived.notify_all();
    }

    pub(crate) fn status(&self) -> watch::Receiver<Option<Arc<Status>>> {
        self.shared.status.subscribe()
    }

    pub(crate) fn scene(&self) -> watch::Receiver<Option<Arc<SceneHint>>> {
        self.shared.scene.subscribe()
    }

    pub(crate) fn keyframes(&self) -> watch::Receiver<Arc<[KeyframePose]>> {
        self.shared.keyframes.subscribe()
    }

    pub(crate) fn robot(&self) -> watch::Receiver<Option<Arc<RobotDescription>>> {
        self.shared.robot.subscribe()
    }

    pub(crate) fn robot_state(&self) -> watch::Receiver<Option<Arc<RobotState>>> {
        self.shared.robot_state.subscribe()
    }

    pub(crate) fn base_path(&self) -> watch::Receiver<BasePath> {
        self.shared.base_path.subscribe()
    }

    pub(crate) fn range_scans(&self) -> watch::Receiver<RangeScans> {
        self.shared.range_scans.subscribe()
    }

    pub(crate) fn observations(&self) -> watch::Receiver<Option<Arc<PackedObservations>>> {
        self.shared.observations.subscribe()
    }

    pub(crate) fn model_chunks(&self) -> watch::Receiver<ModelLists> {
        self.shared.model_chunks.subscribe()
    }

    pub(crate) fn live_images(&self) -> watch::Receiver<LiveImages> {
        self.shared.live_images.subscribe()
    }

    /// Locks the queue. It holds plain values that are valid after every statement, so it stays usable after a panic
    /// elsewhere.
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.shared.queue.lock()
    }
}

/// A picture for which a client is waiting. If it is dropped without an answer, the client receives nothing for this
/// stage.
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

    /// How this stage is packed on the GPU; `None` if the client requested a format that the GPU does not support.
    pub fn packing(&self) -> Option<Packing> {
        packing(&self.job.view_request, self.job.stage + 1 == self.job.view_request.stages.len())
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
        if header.last {
            self.hub.queue().record_render_time(&self.job, header.render_millis);
        }
        let drawn = DrawnPicture { job: self.job.clone(), header, trained_on: self.trained_on, rendered };
        self.enqueue_answer(Outgoing::Picture(Box::new(drawn)));
    }

    /// Sends the client a one-sentence reason why this picture could not be rendered.
    pub fn fail(mut self, reason: &str) {
        let view_request = &self.job.view_request;
        let (id, view) = (view_request.id, Arc::clone(&view_request.view));
        self.enqueue_answer(Outgoing::Failed { id, view, reason: reason.to_owned() });
    }

    fn enqueue_answer(&mut self, outgoing: Outgoing) {
        self.is_released = true; // The session releases it after sending.
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
            newest_keyframe: None,
            sent_millis: 0.0,
            color: None,
            depth: None,
        }
    }
}

impl Drop for PendingRender {
    fn drop(&mut self) {
        if !self.is_released {
            self.hub.release(self.job.client);
        }
    }
}

fn projection_message(projection: &Projection) -> ProjectionMessage {
    match *projection {
        Projection::Pinhole { focal_px, principal_px } => ProjectionMessage::Pinhole {
            focal_px: Some(focal_px),
            principal_px: Some(principal_px),
            vertical_fov_rad: None,
        },
        Projection::Equirectangular => ProjectionMessage::Equirectangular {},
    }
}
