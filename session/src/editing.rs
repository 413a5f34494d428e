//! Applies the edits that operators request.

use std::sync::Arc;
use trainer::edits::{Edit, Edits};
use trainer::{Error, Method};
use viz::EditAction;

/// Changes the edits of a model. Returns a note on what was done.
pub(crate) fn apply(action: &EditAction, edits: &mut Arc<Edits>, method: &mut dyn Method) -> Result<String, Error> {
    let mut changed = (**edits).clone();
    let note = match action {
        EditAction::Erase(aabb) => {
            changed.push(Edit::Box(*aabb))?;
            "erased a box".to_owned()
        }
        EditAction::RemoveFloaters => {
            let floaters = method.find_floaters(edits)?;
            changed.push(Edit::Cells(floaters.cells))?;
            format!("removed floaters: {}", keyframe::counted(floaters.n_erased, floaters.item))
        }
        EditAction::Undo => {
            changed.undo()?;
            "undid the last edit".to_owned()
        }
    };
    *edits = Arc::new(changed);
    Ok(note)
}
