//! Status of the run.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::topics::published_data::{RunResult, StateProgress, Status};
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use std::sync::Arc;
use std::time::Duration;

/// The topic.
#[derive(Default)]
pub(crate) struct StatusTopic;

impl SharedTopic for StatusTopic {
    const NAME: &'static str = "status";
    // The documented rate is 5 Hz, a period of 200 ms. Data are checked every 20 ms, so that with
    // exactly 200 ms, a message that is a little early would wait for the next check.
    const DEFAULT: DefaultRate = DefaultRate::Period(Duration::from_millis(190));
    const PRIORITY: Priority = Priority::Short;
    const CAPABILITY: Option<&'static str> = None;
    // People cannot read numbers that change more often.
    const PERIOD: Duration = Duration::from_millis(100);
    type Source = Option<Arc<Status>>;

    fn encode(&mut self, source: &Self::Source, _: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message = source
            .as_ref()
            .map(|status| ServerMessage::Status(status).to_message());
        only_message(message)
    }
}

impl Hub {
    /// Sets the run status that clients receive.
    pub fn set_status(&self, status: Status) {
        self.latest::<Option<Arc<Status>>>()
            .send_replace(Some(Arc::new(status.thinned())));
    }

    /// Replaces the state in the latest status and keeps its numbers, for example while the model
    /// is saved.
    pub fn set_state(&self, state: &str) {
        self.set_state_and_progress(state, None);
    }

    /// Replaces the state and its progress in the latest status and keeps its numbers.
    pub fn set_state_and_progress(&self, state: &str, progress: Option<StateProgress>) {
        self.change_status(|status| {
            state.clone_into(&mut status.state);
            status.progress = progress;
        });
    }

    /// Sets the result of the run. Clients continue to show it after the server has stopped.
    pub fn set_run_result(&self, result: RunResult) {
        self.change_status(|status| {
            "finished".clone_into(&mut status.state);
            status.progress = None;
            status.result = Some(result);
        });
    }

    /// Changes the latest status.
    pub fn change_status(&self, change: impl FnOnce(&mut Status)) {
        // Within the lock, so that two threads do not overwrite each other's changes.
        self.latest::<Option<Arc<Status>>>().send_modify(|latest| {
            let mut status = latest.as_deref().cloned().unwrap_or_default();
            change(&mut status);
            *latest = Some(Arc::new(status));
        });
    }

    /// The latest status.
    pub(crate) fn status(&self) -> Option<Arc<Status>> {
        self.latest::<Option<Arc<Status>>>().borrow().clone()
    }
}
