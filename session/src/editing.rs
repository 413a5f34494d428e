//! Applies the edits that operators request.

use background::Task;
use model_files::edits::{Edit, Edits};
use std::sync::Arc;
use trainer::floaters::{Floaters, PendingFloaters};
use trainer::{Error, Method};
use viz::{EditAction, EditRequest};

/// Changes the edits of models. Searches for floaters on another thread, one model at a time, so
/// that training and pictures continue.
#[derive(Default)]
pub(crate) struct Editor {
    search: Option<Search>,
}

/// A search for floaters.
struct Search {
    request: EditRequest,
    thread: Task<Result<Floaters, Error>>,
}

impl Editor {
    /// Changes the edits of a model. Returns a note on what was done, `None` if a search was
    /// started, or the reason why the edit is not possible.
    ///
    /// * `action`: the action of `request`, in the world of the model.
    pub(crate) fn apply(
        &mut self,
        request: &EditRequest,
        action: &EditAction,
        edits: &mut Arc<Edits>,
        method: &mut dyn Method,
    ) -> Result<Option<String>, String> {
        let applied = match action {
            EditAction::Erase(aabb) => Arc::make_mut(edits)
                .push(Edit::Box(*aabb))
                .map(|()| Some("erased a box".to_owned()))
                .map_err(Error::from),
            EditAction::Undo => Arc::make_mut(edits)
                .undo()
                .map(|()| Some("undid the last edit".to_owned()))
                .map_err(Error::from),
            EditAction::Redo => Arc::make_mut(edits)
                .redo()
                .map(|()| Some("redid the last undone edit".to_owned()))
                .map_err(Error::from),
            // A second search would find the same floaters again.
            EditAction::RemoveFloaters if self.search.is_some() => {
                return Err(
                    "a search for floaters is already running; wait for its result".to_owned(),
                );
            }
            EditAction::RemoveFloaters => method.find_floaters(edits).map(|pending| {
                self.start(request.clone(), pending);
                None
            }),
        };
        applied.map_err(|error| error.to_string())
    }

    fn start(&mut self, request: EditRequest, pending: PendingFloaters) {
        self.search = Some(Search {
            request,
            thread: Task::start("floaters", || pending.finish()),
        });
    }

    /// A note on the search that is running.
    pub(crate) fn note(&self) -> Option<String> {
        self.search
            .as_ref()
            .map(|_| "looking for floaters …".to_owned())
    }

    /// Whether a search is running.
    pub(crate) fn is_searching(&self) -> bool {
        self.search
            .as_ref()
            .is_some_and(|search| !search.thread.is_finished())
    }

    /// Takes the result of the search if it is ready. If `wait` is set, waits for the result. The
    /// result is the request and the floaters, or the reason why the search failed.
    pub(crate) fn take_found(
        &mut self,
        wait: bool,
    ) -> Option<(EditRequest, Result<Floaters, String>)> {
        let Search { request, thread } = self
            .search
            .take_if(|search| wait || search.thread.is_finished())?;
        // A panic in a search must not end the run.
        let found = match thread.join() {
            Ok(found) => found.map_err(|error| error.to_string()),
            Err(_) => Err("the search for floaters panicked".to_owned()),
        };
        Some((request, found))
    }
}

/// Erases floaters. Returns a note on what was done, or the reason why it is not possible.
pub(crate) fn erase_floaters(
    edits: &mut Arc<Edits>,
    Floaters {
        cells,
        n_erased,
        item,
    }: Floaters,
) -> Result<String, String> {
    Arc::make_mut(edits)
        .push(Edit::Cells(cells))
        .map_err(|error| error.to_string())?;
    Ok(format!(
        "removed floaters: {}",
        messages::counted(n_erased, item)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;
    use trainer::FailedModel;

    #[test]
    fn other_edits_are_applied_while_one_search_runs() {
        let mut editor = Editor::default();
        let mut edits = Arc::default();
        let request = EditRequest::of_nobody(EditAction::RemoveFloaters);
        let mut apply = |editor: &mut Editor, action: &EditAction| {
            editor.apply(&request, action, &mut edits, &mut FailedModel)
        };
        let (end, ended) = mpsc::sync_channel(1);
        editor.start(
            request.clone(),
            PendingFloaters::new(move || {
                ended.recv().expect("the test ends the search");
                Err(Error::NoFloaters)
            }),
        );
        assert!(editor.take_found(false).is_none() && editor.note().is_some());
        let second = apply(&mut editor, &EditAction::RemoveFloaters);
        assert_eq!(
            second,
            Err("a search for floaters is already running; wait for its result".to_owned())
        );
        assert_eq!(
            apply(&mut editor, &EditAction::Undo),
            Err("there is nothing to undo".to_owned())
        );
        end.send(()).expect("the search waits");
        let (of, found) = editor.take_found(true).expect("a result");
        assert_eq!(
            (of, found),
            (request.clone(), Err(Error::NoFloaters.to_string()))
        );
        assert!(editor.take_found(true).is_none() && editor.note().is_none());
        let third = apply(&mut editor, &EditAction::RemoveFloaters);
        assert_eq!(
            third,
            Err(Error::CannotFindFloaters.to_string()),
            "the model is asked again"
        );
    }
}
