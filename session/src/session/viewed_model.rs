//! The model of a session for viewers: pictures, chunks and edits.

use super::persistence::Persistence;
use crate::chunk_publisher::ChunkPublisher;
use crate::editing::{self, Editor};
use crate::evaluate;
use gpu::Gpu;
use keyframe::Keyframe;
use kinematics::Transform;
use model_files::Edits;
use std::sync::Arc;
use std::time::Duration;
use trainer::floaters::Floaters;
use trainer::{AlignedModel, ModelKind, Packing, Picture, QueuedPicture, RenderRequest, Rendered};
use viz::{EditRequest, PendingRender};

/// Draws and edits the model of a session.
pub(crate) struct ViewedModel<'a> {
    pub(super) kind: ModelKind,
    pub(super) method: &'a mut AlignedModel,
    pub(super) gpu: &'a Gpu,
    pub(super) persistence: &'a mut Persistence,
    pub(super) edits: &'a mut Arc<Edits>,
}

impl ViewedModel<'_> {
    /// The kind of model.
    pub(crate) fn kind(&self) -> ModelKind {
        self.kind
    }

    /// The same model, borrowed for a shorter time.
    pub(super) fn reborrow(&mut self) -> ViewedModel<'_> {
        ViewedModel {
            kind: self.kind,
            method: &mut *self.method,
            gpu: self.gpu,
            persistence: &mut *self.persistence,
            edits: &mut *self.edits,
        }
    }

    /// Creates splats for the keyframes so far.
    pub(crate) fn seed(&mut self) -> anyhow::Result<()> {
        self.persistence.log_render();
        Ok(self.method.model_mut().seed()?)
    }

    /// Draws a picture.
    pub(crate) fn render(&mut self, request: &RenderRequest) -> Result<Picture, trainer::Error> {
        self.persistence.log_render();
        self.method.model_mut().render(request)
    }

    /// Draws color and depth at the pose of a keyframe. Also returns this pose, with the corrections
    /// that the model has found.
    pub(crate) fn draw_keyframe(
        &mut self,
        keyframe: &Keyframe,
    ) -> Result<(Picture, Transform), trainer::Error> {
        self.persistence.log_render();
        let world_from_camera = self.method.calibrated_camera(keyframe)?.world_from_camera;
        let picture = evaluate::draw(self.method, keyframe, true)?;
        Ok((picture, world_from_camera))
    }

    /// Labels a requested picture with this model, which draws it.
    pub(crate) fn label(&self, pending: PendingRender) -> PendingRender {
        pending.of_model(self.kind.name(), self.method.model().progress().step)
    }

    /// Starts to render a picture, packed if `packing` is given; see
    /// [`trainer::Method::queue_packed`].
    pub(crate) fn queue_picture(
        &mut self,
        request: &RenderRequest,
        packing: Option<Packing>,
    ) -> Result<QueuedPicture, trainer::Error> {
        self.persistence.log_render();
        let model = self.method.model_mut();
        match packing {
            Some(packing) => model.queue_packed(request, packing),
            None => model
                .render(request)
                .map(|picture| QueuedPicture::ready(picture.into())),
        }
    }

    /// Waits for the picture of a request.
    pub(crate) fn finish_picture(
        &mut self,
        queued: QueuedPicture,
        request: &RenderRequest,
        packing: Option<Packing>,
    ) -> Result<Rendered, trainer::Error> {
        let model = self.method.model_mut();
        match (queued.finish(self.gpu)?, packing) {
            (Some(rendered), _) => Ok(rendered),
            // A buffer was too small for the queued picture. Rendering it again, with waiting,
            // grows the buffer.
            (None, Some(packing)) => model.render_packed(request, packing),
            (None, None) => model.render(request).map(Rendered::Picture),
        }
    }

    /// Draws a requested picture and sends it, or the reason why this failed, to its client.
    pub(crate) fn answer(&mut self, mut pending: PendingRender) {
        pending.request.edits = Arc::clone(self.edits);
        let drawn = self
            .queue_picture(&pending.request, pending.packing())
            .and_then(|queued| self.finish_picture(queued, &pending.request, pending.packing()));
        match drawn {
            Ok(picture) => pending.deliver(picture),
            Err(error) => pending.fail(&error.to_string()),
        }
    }

    /// Publishes the chunks of the model if they are due. Returns the time spent.
    pub(crate) fn publish_chunks(&mut self, publisher: &mut ChunkPublisher) -> Duration {
        publisher.publish(self.kind, self.method.model_mut(), self.edits)
    }

    /// Changes the edits; see [`Editor::apply`].
    pub(crate) fn edit(
        &mut self,
        editor: &mut Editor,
        request: &EditRequest,
    ) -> Result<Option<String>, String> {
        editor.apply(
            request,
            request.action(),
            self.edits,
            self.method.model_mut(),
        )
    }

    /// Erases floaters; see [`editing::erase_floaters`].
    pub(crate) fn erase_floaters(&mut self, floaters: Floaters) -> Result<String, String> {
        editing::erase_floaters(self.edits, floaters)
    }

    /// Sets whether pictures are requested during training. While they are, each submit contains
    /// fewer steps.
    pub(crate) fn set_watched(&mut self, watched: bool) {
        self.method.model_mut().set_watched(watched);
    }
}
