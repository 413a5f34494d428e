//! Applies the requests of operators: pausing, checkpoints, edits.

use super::models::Models;
use crate::checkpoints::CheckpointProgress;
use crate::editing::Editor;
use viz::{CheckpointState, Control, EditRequest, Hub, LastEdit, RequestedCheckpoint};

/// Requests of operators, and their results.
#[derive(Default)]
pub(super) struct Requests {
    /// Whether an operator has paused training.
    pub(super) is_paused: bool,
    /// Number of the client that has paused training.
    pub(super) paused_by: Option<u64>,
    /// The last checkpoint that an operator requested.
    checkpoint: Option<RequestedCheckpoint>,
    editor: Editor,
    pub(super) last_edit: Option<LastEdit>,
    /// Number of times that edits of any model have changed.
    pub(super) edit_revision: u64,
    /// Whether an edit was applied or begun since this flag was cleared.
    pub(super) has_edited: bool,
}

impl Requests {
    /// Notes on checkpoints and edits that only inform.
    pub(super) fn infos(&self) -> impl Iterator<Item = String> {
        let checkpoint = self.checkpoint_note(|state| state != CheckpointState::Failed);
        let edit = self.last_edit.as_ref().map(|edit| edit.text.clone());
        [checkpoint, edit, self.editor.note()].into_iter().flatten()
    }

    /// Notes on checkpoints that could not be written.
    pub(super) fn warnings(&self) -> Option<String> {
        self.checkpoint_note(|state| state == CheckpointState::Failed)
    }

    fn checkpoint_note(&self, is_shown: impl Fn(CheckpointState) -> bool) -> Option<String> {
        let shown = self.checkpoint.as_ref().filter(|it| is_shown(it.state));
        shown.map(|checkpoint| checkpoint.text.clone())
    }

    /// The last checkpoint that an operator requested.
    pub(super) fn checkpoint(&self) -> Option<RequestedCheckpoint> {
        self.checkpoint.clone()
    }

    /// Updates the state of the requested checkpoint from the models.
    pub(super) fn update_checkpoint(&mut self, models: &mut Models) {
        let is_pending =
            |checkpoint: &RequestedCheckpoint| checkpoint.state == CheckpointState::Requested;
        if !self.checkpoint.as_ref().is_some_and(is_pending) {
            return;
        }
        let secs = models.sessions[0].time().secs();
        let mut is_written = true;
        for session in &mut models.sessions {
            match session.persistence().requested_checkpoint() {
                Some(CheckpointProgress::Written) => {}
                Some(CheckpointProgress::Failed(reason)) => {
                    self.checkpoint = Some(RequestedCheckpoint {
                        state: CheckpointState::Failed,
                        text: format!("the checkpoint could not be written: {reason}"),
                    });
                    return;
                }
                Some(CheckpointProgress::Due | CheckpointProgress::Writing) | None => {
                    is_written = false;
                }
            }
        }
        if is_written {
            self.checkpoint = Some(RequestedCheckpoint {
                state: CheckpointState::Written,
                text: format!("checkpoint written after {secs:.0} s"),
            });
        }
    }

    /// Applies the actions that operators have requested. An evaluation is completed first.
    pub(super) fn apply_controls(&mut self, hub: &Hub, models: &mut Models) {
        // All images of an evaluation are scored on the same state of the model.
        if models.is_scoring() {
            return;
        }
        for request in hub.operator_requests().take_control_requests() {
            match request.action {
                Control::Pause => {
                    self.is_paused = true;
                    self.paused_by.get_or_insert(request.client);
                }
                Control::Resume => {
                    self.is_paused = false;
                    self.paused_by = None;
                }
                Control::Save => {
                    let mut is_due = true;
                    // Every session is asked, also after one that writes no checkpoints.
                    for session in &mut models.sessions {
                        is_due &= session.persistence().request_checkpoint();
                    }
                    let secs = models.sessions[0].time().secs();
                    let (state, text) = if is_due {
                        (
                            CheckpointState::Requested,
                            format!("checkpoint requested after {secs:.0} s"),
                        )
                    } else {
                        (
                            CheckpointState::Failed,
                            "this run writes no checkpoints".to_owned(),
                        )
                    };
                    self.checkpoint = Some(RequestedCheckpoint { state, text });
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

    /// Whether a search for floaters is running.
    pub(super) fn is_searching(&self) -> bool {
        self.editor.is_searching()
    }

    /// Erases floaters once they are found. If `wait` is set, waits for the search. Returns whether
    /// a search has ended.
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
