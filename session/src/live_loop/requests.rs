//! Applies the requests of operators: pausing, checkpoints, edits.

use super::{LiveLoop, session_for_method};
use crate::editing::Editor;
use viz::{Control, EditRequest};

/// Requests of operators, and their results.
#[derive(Default)]
pub(super) struct Requests {
    /// Whether an operator has paused training.
    pub(super) is_paused: bool,
    /// Result of the last checkpoint that an operator requested.
    checkpoint_note: Option<String>,
    editor: Editor,
    /// Result of the last edit.
    edit_note: Option<String>,
    /// Number of times that edits of any model have changed.
    pub(super) edit_revision: u64,
}

impl Requests {
    /// Notes on checkpoints and edits, for viewers.
    pub(super) fn notes(&self) -> impl Iterator<Item = String> {
        [
            self.checkpoint_note.clone(),
            self.edit_note.clone(),
            self.editor.note(),
        ]
        .into_iter()
        .flatten()
    }
}

impl LiveLoop {
    /// Applies the actions that operators have requested. An evaluation is completed first.
    pub(super) fn apply_controls(&mut self) {
        // All images of an evaluation are scored on the same state of the model.
        if self.is_scoring() {
            return;
        }
        for control in self.hub.take_controls() {
            match control {
                Control::Pause => self.requests.is_paused = true,
                Control::Resume => self.requests.is_paused = false,
                Control::Save => {
                    let mut is_due = true;
                    // Every session is asked, also after one that writes no checkpoints.
                    for session in &mut self.sessions {
                        is_due &= session.request_checkpoint();
                    }
                    self.requests.checkpoint_note = Some(if is_due {
                        format!(
                            "checkpoint requested after {:.0} s",
                            self.sessions[0].secs()
                        )
                    } else {
                        "this run writes no checkpoints".to_owned()
                    });
                }
            }
        }
    }

    /// Erases the floaters that were found, and applies the edits that operators have requested.
    pub(super) fn apply_edits(&mut self) {
        self.erase_found(false);
        for request in self.hub.take_edits() {
            let edited = match session_for_method(&self.sessions, request.method()) {
                Some(session_ix) => {
                    self.sessions[session_ix].edit(&mut self.requests.editor, &request)
                }
                None => Err(self.unknown_method(request.method())),
            };
            self.report_edit(&request, edited);
        }
    }

    /// Erases floaters once they are found, or waits for them if `wait`. Returns whether a search
    /// has ended.
    pub(super) fn erase_found(&mut self, wait: bool) -> bool {
        let Some((request, found)) = self.requests.editor.take_found(wait) else {
            return false;
        };
        let session_ix = session_for_method(&self.sessions, request.method()).unwrap_or_default();
        let erased = found.and_then(|floaters| self.sessions[session_ix].erase_floaters(floaters));
        self.report_edit(&request, erased.map(Some));
        true
    }

    /// Shows the note on an edit, or sends the reason why it was not possible.
    fn report_edit(&mut self, request: &EditRequest, edited: Result<Option<String>, String>) {
        match edited {
            Ok(note) => {
                // Without a note, a search was started and nothing has changed yet.
                if note.is_some() {
                    self.requests.edit_note = note;
                    self.requests.edit_revision += 1;
                }
                self.publishing.status_at = None; // Viewers wait for the new status.
            }
            Err(reason) => self.hub.reject_edit(request, &reason),
        }
    }
}
