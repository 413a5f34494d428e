//! Edits of a model that operators request.

use crate::client::protocol::{EditKind, EditMessage};
use crate::pictures::view_request::{InvalidRequest, checked_box};
use model_files::Aabb;

/// What an operator wants to change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EditAction {
    /// Erases the part of the model in a box.
    Erase(Aabb),
    /// Erases small parts that are not connected to the large parts of the model.
    RemoveFloaters,
    /// Undoes the last edit.
    Undo,
    /// Makes the last undone edit again.
    Redo,
}

impl std::fmt::Display for EditAction {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Erase(Aabb {
                min_m: [x, y, z],
                max_m: [to_x, to_y, to_z],
                ..
            }) => {
                write!(
                    formatter,
                    "erase the box from ({x:.3}, {y:.3}, {z:.3}) to ({to_x:.3}, {to_y:.3}, {to_z:.3}) m"
                )
            }
            Self::RemoveFloaters => formatter.write_str("remove floaters"),
            Self::Undo => formatter.write_str("undo"),
            Self::Redo => formatter.write_str("redo"),
        }
    }
}

/// A validated request to edit a model.
#[derive(Clone, Debug, PartialEq)]
pub struct EditRequest {
    /// The client that sent it.
    pub(crate) client: u64,
    /// Number chosen by the client, repeated in the reply if the edit fails.
    pub(crate) id: Option<u64>,
    method: Option<String>,
    action: EditAction,
}

impl EditRequest {
    /// Validates a client's message.
    pub(crate) fn check(client: u64, message: &EditMessage) -> Result<Self, InvalidRequest> {
        // A box with another action would be ignored, although the operator expects an effect.
        let action = match (message.action, &message.erased_box) {
            (EditKind::Erase, Some(erased_box)) => {
                EditAction::Erase(checked_box(erased_box, "box")?)
            }
            (EditKind::RemoveFloaters, None) => EditAction::RemoveFloaters,
            (EditKind::Undo, None) => EditAction::Undo,
            (EditKind::Redo, None) => EditAction::Redo,
            _ => return Err(InvalidRequest::EditBox),
        };
        Ok(Self {
            client,
            id: message.id,
            method: message.method.clone(),
            action,
        })
    }

    /// A request for the first model, with no client that waits for it.
    pub fn of_nobody(action: EditAction) -> Self {
        Self {
            // Clients are numbered from 1, so a rejection is sent to nobody.
            client: 0,
            id: None,
            method: None,
            action,
        }
    }

    /// Number of the client that sent it; 0 for nobody.
    pub fn client(&self) -> u64 {
        self.client
    }

    /// The model to edit; the first if `None`. The name comes from the client and may not exist.
    pub fn method(&self) -> Option<&str> {
        self.method.as_deref()
    }

    /// What to change. Coordinates are in the world of the page.
    pub fn action(&self) -> &EditAction {
        &self.action
    }
}
