//! What operators have requested of the run: actions and edits.

use crate::client::protocol::Control;
use crate::edit::EditRequest;
use parking_lot::Mutex;

/// Maximum number of edits that wait to be applied. It is also the maximum number of edits of a
/// model.
pub(crate) const MAX_WAITING_EDITS: usize = 64;

/// An action that an operator has requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ControlRequest {
    /// What to do.
    pub action: Control,
    /// Number of the client that requested it.
    pub client: u64,
}

/// Requests of operators that the run has not taken yet.
#[derive(Debug, Default)]
pub struct OperatorRequests {
    /// Actions without repetitions.
    controls: Mutex<Vec<ControlRequest>>,
    edits: Mutex<Vec<EditRequest>>,
}

impl OperatorRequests {
    /// The actions that operators have requested since the last call, in order.
    pub fn take_controls(&self) -> Vec<Control> {
        let requests = self.take_control_requests().into_iter();
        requests.map(|request| request.action).collect()
    }

    /// The actions that operators have requested since the last call, in order, with the clients
    /// that requested them.
    pub fn take_control_requests(&self) -> Vec<ControlRequest> {
        std::mem::take(&mut *self.controls.lock())
    }

    /// The edits that operators have requested since the last call, in order.
    pub fn take_edits(&self) -> Vec<EditRequest> {
        std::mem::take(&mut *self.edits.lock())
    }

    /// Requests an action of the run.
    pub(crate) fn control(&self, request: ControlRequest) {
        let mut controls = self.controls.lock();
        // A repeated action counts once, at its last position. For example, the run must pause
        // after pause, resume and pause.
        controls.retain(|earlier| earlier.action != request.action);
        controls.push(request);
    }

    /// Requests an edit. Returns false if too many edits are waiting.
    pub(crate) fn edit(&self, request: EditRequest) -> bool {
        let mut edits = self.edits.lock();
        let has_room = edits.len() < MAX_WAITING_EDITS;
        if has_room {
            edits.push(request);
        }
        has_room
    }
}
