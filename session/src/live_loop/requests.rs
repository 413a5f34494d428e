//! Applies the requests of operators: pausing, checkpoints, edits.

use super::models::Models;
use crate::editing::Editor;
use viz::{Control, EditRequest, Hub, LastEdit};

/// Requests of operators, and their results.
#[derive(Default)]
pub(super) struct Requests {
    /// Whether an operator has paused training.
    pub(super) is_paused: bool,
    /// Result of the last checkpoint that an operator requested.
    checkpoint_note: Option<String>,
    editor: Editor,
    pub(super) last_edit: Option<LastEdit>,
    /// Number of times that edits of any model have changed.
    pub(super) edit_revision: u64,
    /// Whether an edit was applied or begun since this flag was cleared.
    pub(super) has_edited: bool,
}

impl Requests {
    /// Notes on checkpoints and edits, for viewers.
    pub(super) fn notes(&self) -> impl Iterator<Item = String> {
        [
            self.checkpoint_note.clone(),
            self.last_edit.as_ref().map(|edit| edit.text.clone()),
            self.editor.note(),
        ]
        .into_iter()
        .flatten()
    }

    /// Applies the actions that operators have requested. An evaluation is completed first.
    pub(super) fn apply_controls(&mut self, hub: &Hub, models: &mut Models) {
        // All images of an evaluation are scored on the same state of the model.
        if models.is_scoring() {
            return;
        }
        for control in hub.operator_requests().take_controls() {
            match control {
                Control::Pause => self.is_paused = true,
                Control::Resume => self.is_paused = false,
                Control::Save => {
                    let mut is_due = true;
                    // Every session is asked, also after one that writes no checkpoints.
                    for session in &mut models.sessions {
                        is_due &= session.persistence().request_checkpoint();
                    }
                    self.checkpoint_note = Some(if is_due {
                        format!(
                            "checkpoint requested after {:.0} s",
                            models.sessions[0].time().secs()
                        )
                    } else {
                        "this run writes no checkpoints".to_owned()
                    });
                }
            }
        }
    }

    /// Erases the floaters that were found, and applies the edits that operators have requested.
    pub(super) fn apply_edits(&mut self, hub: &Hub, models: &mut Models) {
        self.erase_found(false, hub, models);
        for request in hub.operator_requests().take_edits() {
            let edited = match models.session_ix(request.method()) {
                Ok(session_ix) => models.sessions[session_ix]
                    .viewed()
                    .edit(&mut self.editor, &request),
                Err(reason) => Err(reason),
            };
            self.report_edit(hub, &request, edited);
        }
    }

    /// Erases floaters once they are found, or waits for them if `wait`. Returns whether a search
    /// has ended.
    pub(super) fn erase_found(&mut self, wait: bool, hub: &Hub, models: &mut Models) -> bool {
        let Some((request, found)) = self.editor.take_found(wait) else {
            return false;
        };
        let session_ix = models.session_ix(request.method()).unwrap_or_default();
        let session = &mut models.sessions[session_ix];
        let erased = found.and_then(|floaters| session.viewed().erase_floaters(floaters));
        self.report_edit(hub, &request, erased.map(Some));
        true
    }

    /// Shows the note on an edit, or sends the reason why it was not possible.
    fn report_edit(
        &mut self,
        hub: &Hub,
        request: &EditRequest,
        edited: Result<Option<String>, String>,
    ) {
        match edited {
            Ok(note) => {
                // Without a note, a search was started and nothing has changed yet.
                if let Some(text) = note {
                    self.last_edit = Some(LastEdit {
                        client: request.client(),
                        text,
                    });
                    self.edit_revision += 1;
                }
                self.has_edited = true;
            }
            Err(reason) => hub.reject_edit(request, &reason),
        }
    }
}
