//! Draws trained models for viewers: the loop of `view`, and of a run after its training.

use crate::chunk_publisher::ChunkPublisher;
use crate::observations::{ObservationPublisher, SeenFrom};
use capture::Stop;
use kinematics::Transform;
use std::time::Duration;
use trainer::{Aabb, Method, ModelKind, RenderRequest, Rendered};
use viz::{Hub, KeyframePose, PendingRender};

/// Maximum response time to Ctrl-C while no client requests a picture.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// A model that clients can view.
pub struct ServedModel {
    /// The method.
    pub kind: ModelKind,
    /// The model.
    pub method: Box<dyn Method>,
}

/// Trained models and the hub of the clients that view them.
pub struct ModelViewer {
    /// The first model is drawn for requests that name no method.
    models: Vec<ServedModel>,
    hub: Hub,
    chunk_publisher: ChunkPublisher,
    /// Views of the training images, in the page's world.
    cameras: Vec<SeenFrom>,
    observation_publisher: ObservationPublisher,
    /// Pose of the page's world, which is z up, in the model's world.
    model_from_page: Transform,
}

impl ModelViewer {
    /// A viewer of models whose z axis points up. The keyframes of the hub are the views of the model's training images.
    pub fn new(models: Vec<ServedModel>, hub: Hub) -> Self {
        let seen_from = |pose: KeyframePose| SeenFrom { pose, keyframe: None };
        Self {
            models,
            chunk_publisher: ChunkPublisher::new(hub.clone()),
            cameras: hub.keyframe_poses().into_iter().map(seen_from).collect(),
            observation_publisher: ObservationPublisher::new(hub.clone()),
            hub,
            model_from_page: Transform::identity(),
        }
    }

    /// Rotates the models so that they are upright in the page's world, which is z up.
    pub fn with_model_from_page(self, model_from_page: Transform) -> Self {
        self.hub.set_world_from_model(model_from_page.inverse());
        Self { model_from_page, ..self }
    }

    /// Draws requested pictures until a signal requests a stop.
    pub fn serve(&mut self, stop: &Stop) {
        while !stop.signaled() {
            if self.hub.wait_for_request(POLL_PERIOD)
                && let Some(pending) = self.hub.next_request()
            {
                self.answer(pending);
            }
            self.publish_chunks();
            self.publish_observations();
        }
    }

    fn publish_observations(&mut self) {
        if self.cameras.is_empty() || !self.observation_publisher.is_due() {
            return;
        }
        let method = &mut self.models[0].method;
        let model_from_page = &self.model_from_page;
        let render = |request: &RenderRequest| method.render(&in_model(request, model_from_page));
        // The step has no effect, because the model does not change.
        self.observation_publisher.publish(&self.cameras, 1, None, render);
    }

    fn publish_chunks(&mut self) {
        for ServedModel { kind, method } in &mut self.models {
            self.chunk_publisher.publish(*kind, method.as_mut());
        }
    }

    fn answer(&mut self, pending: PendingRender) {
        let request = in_model(&pending.request, &self.model_from_page);
        let requested_method = pending.method().map(str::to_owned);
        let is_requested =
            |model: &&mut ServedModel| requested_method.as_deref().is_none_or(|name| model.kind.name() == name);
        let Some(model) = self.models.iter_mut().find(is_requested) else {
            let names: Vec<&str> = self.models.iter().map(|model| model.kind.name()).collect();
            let requested_method = requested_method.unwrap_or_default();
            return pending.fail(&format!("no model with the method {requested_method:?}; use {}", names.join(" or ")));
        };
        let rendered = match pending.packing() {
            Some(packing) => model.method.render_packed(&request, packing),
            None => model.method.render(&request).map(Rendered::Picture),
        };
        match rendered {
            Ok(picture) => pending.deliver(picture),
            Err(error) => pending.fail(&error.to_string()),
        }
    }
}

/// Transforms a request from the page's world frame to the model's world frame.
fn in_model(request: &RenderRequest, model_from_page: &Transform) -> RenderRequest {
    let crop = request.crop.map(|crop| Aabb { world_from_box: model_from_page * crop.world_from_box, ..crop });
    RenderRequest { world_from_camera: model_from_page * request.world_from_camera, crop, ..request.clone() }
}
