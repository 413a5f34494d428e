//! Status of the run.

use crate::Hub;
use crate::client::server_message::ServerMessage;
use crate::clock::ServerClock;
use crate::steering::steering_server::steered_arm;
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
    // The documented rate is 5 Hz, a period of 200 ms. The default is slightly shorter. With
    // exactly 200 ms, a message that is slightly early would wait for the next check, 20 ms later.
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
    /// Sets the run status that clients receive. The hub fills in the list of clients.
    pub fn set_status(&self, status: Status) {
        self.change_status(|latest| *latest = status.thinned());
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

    /// Changes the latest status. If the state changes, fields that still describe the previous
    /// state are removed.
    pub fn change_status(&self, change: impl FnOnce(&mut Status)) {
        // The change is made within the lock, so that two threads do not overwrite each other's
        // changes.
        self.latest::<Option<Arc<Status>>>().send_modify(|latest| {
            let mut status = latest.as_deref().cloned().unwrap_or_default();
            change(&mut status);
            if let Some(previous) = latest.as_deref() {
                remove_outdated(&mut status, previous);
            }
            // The clients are also read within the lock. A client that joins afterwards then
            // changes this status.
            status.operator.clients = self.pictures().clients();
            status.operator.steering = steered_arm(self).is_some();
            *latest = Some(Arc::new(status));
        });
    }

    /// The latest status, if the run has published one.
    pub(crate) fn status(&self) -> Option<Arc<Status>> {
        self.latest::<Option<Arc<Status>>>().borrow().clone()
    }
}

/// Removes the fields that describe the previous state: the advice, and the client that has paused
/// training.
fn remove_outdated(status: &mut Status, previous: &Status) {
    if status.state == previous.state {
        return;
    }
    let (operator, before) = (&mut status.operator, &previous.operator);
    if operator.advice == before.advice {
        operator.advice = None;
    }
    if operator.paused_by == before.paused_by {
        operator.paused_by = None;
    }
}

/// Updates the clients in the latest status, after one has joined or left. Before the first status,
/// there is nothing to update.
pub(crate) fn refresh_clients(hub: &Hub) {
    if hub.status().is_some() {
        hub.change_status(|_| {});
    }
}

#[cfg(test)]
mod tests {
    use super::refresh_clients;
    use crate::Hub;
    use crate::server::access::Role;
    use crate::topics::operator_status::Advice;
    use crate::topics::published_data::Status;

    fn ids(hub: &Hub) -> Vec<u64> {
        let status = hub.status().expect("a status");
        let clients = status.operator.clients.iter();
        clients.map(|client| client.id).collect()
    }

    #[test]
    fn every_status_lists_the_clients_that_are_connected() {
        let hub = Hub::new();
        let (first, _) = hub.join(Role::Operator);
        refresh_clients(&hub);
        assert!(hub.status().is_none(), "joining publishes no status");
        hub.set_status(Status::default());
        assert_eq!(ids(&hub), [first]);
        let (second, _) = hub.join(Role::Viewer);
        refresh_clients(&hub);
        let status = hub.status().expect("a status");
        let roles: Vec<Role> = status
            .operator
            .clients
            .iter()
            .map(|client| client.role)
            .collect();
        assert_eq!(
            (ids(&hub), roles),
            (vec![first, second], vec![Role::Operator, Role::Viewer])
        );
        hub.leave(first);
        refresh_clients(&hub);
        assert_eq!(ids(&hub), [second]);
    }

    #[test]
    fn advice_does_not_outlive_its_state() {
        let hub = Hub::new();
        let mut status = Status::default();
        status.operator.advice = Some(Advice {
            text: "Scanning.".to_owned(),
            is_warning: false,
        });
        hub.set_status(status);
        hub.set_state("saving");
        let saving = hub.status().expect("a status");
        assert_eq!((&*saving.state, &saving.operator.advice), ("saving", &None));
        hub.change_status(|status| {
            "paused".clone_into(&mut status.state);
            status.operator.paused_by = Some(3);
        });
        hub.change_status(|status| status.seconds = 5.0);
        let paused = hub.status().expect("a status");
        assert_eq!(paused.operator.paused_by, Some(3), "it is the same state");
        hub.set_state("saving");
        let saving = hub.status().expect("a status");
        assert_eq!(saving.operator.paused_by, None);
    }
}
