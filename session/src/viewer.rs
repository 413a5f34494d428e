//! Draws trained models for viewers: the loop of `view`, and of a run after its training.

use crate::chunk_publisher::ChunkPublisher;
use crate::edited_copy;
use crate::editing::{self, Editor};
use crate::methods;
use crate::observations::{ModelState, ObservationPublisher, PosedKeyframe};
use crate::photographs;
use capture::Stop;
use kinematics::Transform;
use model_files::{Aabb, Edits};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use trainer::{AlignedModel, Method, ModelKind, RenderRequest, Rendered};
use viz::{
    Control, EditAction, EditRequest, Hub, KeyframePose, LastEdit, PendingRender, SavedEdits,
    Status,
};

/// Maximum response time to Ctrl-C while no client requests a picture. Edits are delayed by up to
/// the same time. A shorter period would use more processor time while nothing happens.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// A model that clients can view.
pub struct ServedModel {
    /// The method.
    pub kind: ModelKind,
    /// The model.
    pub method: AlignedModel,
    /// Erased space, in the model's world.
    pub edits: Arc<Edits>,
    /// Folder or file of the saved model. Edits are stored in the folder, or in a copy of the file.
    pub path: PathBuf,
}

/// A note on an edit or save.
struct Note {
    text: String,
    /// Whether it only informs, so that nobody has to act.
    is_info: bool,
}

/// Trained models and the hub of the clients that view them.
pub struct ModelViewer {
    /// The models. The first model is drawn for requests that name no method.
    models: Vec<ServedModel>,
    hub: Hub,
    chunk_publisher: ChunkPublisher,
    /// Views of the training images, in the page's world.
    cameras: Vec<PosedKeyframe>,
    observation_publisher: ObservationPublisher,
    /// Pose of the page's world, which is z up, in the model's world.
    model_from_page: Transform,
    editor: Editor,
    /// The edits that are stored.
    saved: Vec<Arc<Edits>>,
    /// Number of requests to save edits.
    n_saves: u64,
    /// What the last edit or save did.
    note: Option<Note>,
    published_notes: Vec<String>,
}

impl ModelViewer {
    /// A viewer of models whose z axis points up. The keyframes of the hub are the views of the
    /// model's training images.
    pub fn new(models: Vec<ServedModel>, hub: Hub) -> Self {
        let posed = |pose: KeyframePose| PosedKeyframe {
            pose,
            keyframe: None,
            color_from_depth: Transform::identity(),
        };
        Self {
            saved: models
                .iter()
                .map(|model| Arc::clone(&model.edits))
                .collect(),
            models,
            chunk_publisher: ChunkPublisher::new(hub.clone()),
            cameras: hub.keyframes().poses().into_iter().map(posed).collect(),
            observation_publisher: ObservationPublisher::new(hub.clone()),
            hub,
            model_from_page: Transform::identity(),
            editor: Editor::default(),
            n_saves: 0,
            note: None,
            published_notes: Vec::new(),
        }
    }

    /// Rotates the models so that they are upright in the page's world, which is z up.
    pub fn with_model_from_page(self, model_from_page: Transform) -> Self {
        self.hub
            .model_chunks()
            .set_world_from_model(model_from_page.inverse());
        Self {
            model_from_page,
            ..self
        }
    }

    /// Draws requested pictures until a signal requests a stop.
    pub fn serve(&mut self, stop: &Stop) {
        let paths = self.models.iter().map(|model| &*model.path);
        photographs::serve_stored(&self.hub, paths, &self.model_from_page);
        while !stop.signaled() {
            self.apply_edits();
            if self.hub.pictures().wait_for_request(POLL_PERIOD)
                && let Some(pending) = self.hub.pictures().next_request()
            {
                self.answer(pending);
            }
            self.publish_chunks();
            self.publish_observations();
        }
        // Saving is a decision of the operator, because it changes the files of the model.
        if self.has_unsaved_edits() {
            log::warn!("the last edits are lost, because they were not saved on the page");
        }
    }

    fn has_unsaved_edits(&self) -> bool {
        self.models
            .iter()
            .zip(&self.saved)
            .any(|(model, saved)| model.edits != *saved)
    }

    fn publish_observations(&mut self) {
        if self.cameras.is_empty() || !self.observation_publisher.is_due() {
            return;
        }
        let ServedModel { method, edits, .. } = &mut self.models[0];
        let method = method.model_mut();
        let model_from_page = &self.model_from_page;
        let render = |request: &RenderRequest| method.render(&in_model(request, model_from_page));
        // The step has no effect, because the model does not change.
        let model = ModelState {
            step: 1,
            edits,
            captured_at: &|_| None,
        };
        self.observation_publisher
            .publish(&self.cameras, &model, render);
    }

    fn publish_chunks(&mut self) {
        for ServedModel {
            kind,
            method,
            edits,
            ..
        } in &mut self.models
        {
            self.chunk_publisher
                .publish(*kind, method.model_mut(), edits);
        }
    }

    /// Applies the edits that operators have requested, and saves them if this is requested.
    fn apply_edits(&mut self) {
        // The result of an earlier search comes before new edits, in the order of the requests.
        if let Some((request, found)) = self.editor.take_found(false) {
            let erased = found.and_then(|floaters| {
                let model = model_mut(&mut self.models, request.method())?;
                editing::erase_floaters(&mut model.edits, floaters)
            });
            self.report_edit(&request, erased.map(Some));
        }
        for request in self.hub.operator_requests().take_edits() {
            let edited = self.edit(&request);
            self.report_edit(&request, edited);
        }
        if self
            .hub
            .operator_requests()
            .take_controls()
            .contains(&Control::Save)
        {
            self.save_edits();
        }
    }

    /// Saves the edits of all models, and publishes the result.
    fn save_edits(&mut self) {
        let saved = self.models.iter_mut().zip(&mut self.saved);
        let results: Vec<Result<String, String>> = saved
            .map(|(model, saved)| model.save_edits(saved))
            .collect();
        let has_failed = results.iter().any(Result::is_err);
        let texts: Vec<String> = results
            .into_iter()
            .map(|result| result.unwrap_or_else(|reason| reason))
            .collect();
        let text = texts.join("; ");
        self.n_saves += 1;
        let saved_edits = SavedEdits {
            revision: self.n_saves,
            text: text.clone(),
            has_failed,
        };
        self.hub
            .change_status(|status| status.saved_edits = Some(saved_edits));
        self.note = Some(Note {
            text,
            is_info: !has_failed,
        });
        self.publish_notes();
    }

    /// Makes an edit; see [`Editor::apply`].
    fn edit(&mut self, request: &EditRequest) -> Result<Option<String>, String> {
        let model = model_mut(&mut self.models, request.method())?;
        // Pages draw boxes in their own world, which is z up. Edits are stored in the model's
        // world.
        let action = match *request.action() {
            EditAction::Erase(aabb) => EditAction::Erase(box_in_model(aabb, &self.model_from_page)),
            action => action,
        };
        self.editor
            .apply(request, &action, &mut model.edits, model.method.model_mut())
    }

    /// Publishes the result of an edit, or sends the reason why it was not possible.
    fn report_edit(&mut self, request: &EditRequest, edited: Result<Option<String>, String>) {
        match edited {
            Ok(None) => {}
            Ok(Some(note)) => {
                self.publish_edits(LastEdit {
                    client: request.client(),
                    text: note.clone(),
                });
                let is_unsaved = self.has_unsaved_edits();
                let text = if is_unsaved {
                    format!("{note}; not saved yet")
                } else {
                    note
                };
                self.note = Some(Note {
                    text,
                    is_info: !is_unsaved,
                });
            }
            Err(reason) => self.hub.reject_edit(request, &reason),
        }
        self.publish_notes();
    }

    /// Publishes the edits.
    fn publish_edits(&self, edit: LastEdit) {
        let page_from_model = self.model_from_page.inverse();
        self.hub.change_status(
            |Status {
                 model,
                 others,
                 edit_revision,
                 last_edit,
                 ..
             }| {
                for status in std::iter::once(model).chain(others) {
                    let edited = self
                        .models
                        .iter()
                        .find(|model| model.kind.name() == status.method);
                    if let Some(edited) = edited {
                        *status =
                            std::mem::take(status).with_edits(&edited.edits, &page_from_model);
                    }
                }
                *edit_revision += 1;
                *last_edit = Some(edit);
            },
        );
    }

    /// Publishes the notes on edits in place of the previous ones.
    fn publish_notes(&mut self) {
        let search = self.editor.note();
        let of_edit = self.note.as_ref();
        let infos: Vec<String> = of_edit
            .filter(|note| note.is_info)
            .map(|note| note.text.clone())
            .into_iter()
            .chain(search.clone())
            .collect();
        let current: Vec<String> = of_edit
            .map(|note| note.text.clone())
            .into_iter()
            .chain(search)
            .collect();
        let previous = std::mem::replace(&mut self.published_notes, current.clone());
        // The status also has notes of other code, which remain.
        self.hub.change_status(
            |Status {
                 notes, operator, ..
             }| {
                for (shown, new) in [(notes, current), (&mut operator.infos, infos)] {
                    shown.retain(|note| !previous.contains(note));
                    shown.extend(new);
                }
            },
        );
    }

    fn answer(&mut self, pending: PendingRender) {
        let request = in_model(&pending.request, &self.model_from_page);
        let model = match model_mut(&mut self.models, pending.method()) {
            Ok(model) => model,
            Err(reason) => return pending.fail(&reason),
        };
        let pending = of_model(pending, model.kind, model.method.model());
        answer_with(pending, request, model.method.model_mut(), &model.edits);
    }
}

/// Labels a requested picture with the model that draws it.
fn of_model(pending: PendingRender, kind: ModelKind, method: &dyn Method) -> PendingRender {
    pending.of_model(kind.name(), method.progress().step)
}

/// Draws a picture and sends it to the client that has requested it.
///
/// * `request`: what to draw, in the world frame of the model.
fn answer_with(
    pending: PendingRender,
    request: RenderRequest,
    method: &mut dyn Method,
    edits: &Arc<Edits>,
) {
    let request = RenderRequest {
        edits: Arc::clone(edits),
        ..request
    };
    let rendered = match pending.packing() {
        Some(packing) => method.render_packed(&request, packing),
        None => method.render(&request).map(Rendered::Picture),
    };
    match rendered {
        Ok(picture) => pending.deliver(picture),
        Err(error) => pending.fail(&error.to_string()),
    }
}

impl ServedModel {
    /// Stores the edits, and updates `saved`. Returns a sentence on the result, or on why they could
    /// not be stored.
    fn save_edits(&mut self, saved: &mut Arc<Edits>) -> Result<String, String> {
        let written = if self.path.is_dir() {
            self.write_edits()
        } else {
            edited_copy::save(&self.path, &self.edits).map(|out| match out {
                Some(out) => format!("edited model saved as {}", out.display()),
                None => "nothing was saved, because there are no edits".to_owned(),
            })
        };
        let written = written.map_err(|error| format!("cannot save the edits: {error:#}"))?;
        *saved = Arc::clone(&self.edits);
        Ok(written)
    }

    /// Writes the edits into the folder of the model.
    fn write_edits(&mut self) -> anyhow::Result<String> {
        self.edits.write(&self.path)?;
        self.method
            .model_mut()
            .write_for_others(&self.path, &self.edits)?;
        let path = self.path.display();
        Ok(match self.edits.len() {
            0 => format!("edits saved in {path}: none are left"),
            _ => format!("edits saved in {path}"),
        })
    }
}

/// The model of this method; the first one if no method is given.
fn model_mut<'a>(
    models: &'a mut [ServedModel],
    method: Option<&str>,
) -> Result<&'a mut ServedModel, String> {
    // The search returns an index. A reference would keep `models` borrowed, and the error needs
    // `models`, too.
    match models
        .iter()
        .position(|model| method.is_none_or(|name| model.kind.name() == name))
    {
        Some(ix) => Ok(&mut models[ix]),
        None => Err(methods::unknown(
            models.iter().map(|model| model.kind),
            method,
        )),
    }
}

/// Transforms a box from the page's world frame to the model's world frame.
fn box_in_model(aabb: Aabb, model_from_page: &Transform) -> Aabb {
    Aabb {
        world_from_box: model_from_page * aabb.world_from_box,
        ..aabb
    }
}

/// Transforms a request from the page's world frame to the model's world frame.
fn in_model(request: &RenderRequest, model_from_page: &Transform) -> RenderRequest {
    let crop = request.crop.map(|crop| box_in_model(crop, model_from_page));
    RenderRequest {
        world_from_camera: model_from_page * request.world_from_camera,
        crop,
        ..request.clone()
    }
}
