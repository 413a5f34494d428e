//! The link between the clients of `/steer` and the loop that steers an arm.

use crate::Hub;
use crate::server::access::Role;
use crate::steering::arm_description::ArmDescription;
use crate::steering::inbox::{Inbox, NotAccepted};
use crate::steering::outbox::{Outbox, Reply};
use crate::steering::preview::Preview;
use crate::steering::request::{ReceivedRequest, RefusedRequest, SteeringRequest};
use crate::steering::state::{LimitEffect, LimitLink, SteeringState};
use crate::topics::operator_status::ConnectedClient;
use parking_lot::{Condvar, Mutex};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{Notify, watch};

/// Passes the requests of clients to the loop that steers an arm, and its answers to the clients.
///
/// No function waits for a client. [`publish_steering`] gives it to the server, which then accepts
/// clients under `/steer`.
#[derive(Debug)]
pub struct SteeringServer {
    description: ArmDescription,
    inbox: Mutex<Inbox>,
    request_arrived: Condvar,
    clients: Mutex<BTreeMap<u64, SteeringClient>>,
    published: watch::Sender<Published>,
}

#[derive(Debug)]
struct SteeringClient {
    role: Role,
    outbox: Outbox,
}

/// What all clients receive.
#[derive(Clone, Debug, Default)]
pub(crate) struct Published {
    /// The newest state.
    pub(crate) state: Option<Arc<SteeringState>>,
    /// The connected clients.
    pub(crate) clients: Arc<[ConnectedClient]>,
    /// Number of changes that clients must learn at once.
    pub(crate) n_urgent: u64,
}

impl SteeringServer {
    /// A server without clients and without a state.
    pub fn new(description: ArmDescription) -> Arc<Self> {
        Arc::new(Self {
            description,
            inbox: Mutex::default(),
            request_arrived: Condvar::new(),
            clients: Mutex::default(),
            published: watch::Sender::default(),
        })
    }

    /// The arm.
    pub fn description(&self) -> &ArmDescription {
        &self.description
    }

    /// The requests that have arrived since the last call, in the order of their arrival. Of
    /// commands of a device with the same grip, and of previews, only the newest of each client is
    /// returned.
    pub fn take_requests(&self) -> Vec<ReceivedRequest> {
        self.inbox.lock().take()
    }

    /// Waits up to `timeout` until there are requests.
    pub fn wait_for_requests(&self, timeout: Duration) {
        let mut inbox = self.inbox.lock();
        self.request_arrived
            .wait_while_for(&mut inbox, |inbox| inbox.is_empty(), timeout);
    }

    /// Sets the state that clients receive: at once if the lease, the stop or the kinds of limits
    /// have changed, and at most 30 times per second otherwise.
    pub fn publish(&self, state: SteeringState) {
        self.published.send_modify(|published| {
            let before = published.state.as_deref().map(urgent_part);
            if before != Some(urgent_part(&state)) {
                published.n_urgent += 1;
            }
            published.state = Some(Arc::new(state));
        });
    }

    /// Answers a preview. Does nothing if the client has left.
    pub fn answer_preview(&self, client: u64, id: u64, preview: Preview) {
        self.reply(client, Reply::Preview { id, preview });
    }

    /// Sends the client the reason why a request was refused, in one sentence. Does nothing if the
    /// client has left.
    pub fn refuse(&self, client: u64, request: RefusedRequest, text: String) {
        self.reply(client, Reply::Refused { request, text });
    }

    /// The connected clients.
    pub fn clients(&self) -> Arc<[ConnectedClient]> {
        Arc::clone(&self.published.borrow().clients)
    }

    /// Adds a client. The returned handle is notified when there is a reply.
    pub(crate) fn join(&self, client: u64, role: Role) -> Arc<Notify> {
        self.inbox.lock().join(client);
        let outbox = Outbox::default();
        let wake = outbox.wake();
        self.clients
            .lock()
            .insert(client, SteeringClient { role, outbox });
        self.publish_clients();
        wake
    }

    /// Removes a client. The loop learns that it has left.
    pub(crate) fn leave(&self, client: u64) {
        self.inbox.lock().leave(client, Instant::now());
        self.request_arrived.notify_all();
        self.clients.lock().remove(&client);
        self.publish_clients();
    }

    /// Reports to the loop that a client is silent.
    pub(crate) fn silence(&self, client: u64) {
        self.inbox.lock().silence(client, Instant::now());
        self.request_arrived.notify_all();
    }

    /// Adds a request of a client.
    pub(crate) fn request(
        &self,
        client: u64,
        received_at: Instant,
        request: SteeringRequest,
    ) -> Result<(), NotAccepted> {
        if let SteeringRequest::OfferLease { to } = request {
            self.check_offer(to)?;
        }
        let result = self.inbox.lock().push(client, received_at, request);
        self.request_arrived.notify_all();
        result
    }

    /// Refuses to offer control to a client that cannot take it. The loop has no access to the roles.
    fn check_offer(&self, to: u64) -> Result<(), NotAccepted> {
        let clients = self.clients.lock();
        let only_watches = clients
            .get(&to)
            .is_some_and(|client| client.role < Role::Operator);
        if only_watches {
            return Err(NotAccepted::OnlyWatches { to });
        }
        Ok(())
    }

    /// Adds a reply to a client.
    pub(crate) fn reply(&self, client: u64, reply: Reply) {
        if let Some(client) = self.clients.lock().get_mut(&client) {
            client.outbox.push(reply);
        }
    }

    /// Takes the oldest reply to a client.
    pub(crate) fn take_reply(&self, client: u64) -> Option<Reply> {
        self.clients.lock().get_mut(&client)?.outbox.pop()
    }

    /// What all clients receive.
    pub(crate) fn published(&self) -> watch::Receiver<Published> {
        self.published.subscribe()
    }

    fn publish_clients(&self) {
        // The lock is held until the list is published, so that the newest list is the last.
        let clients = self.clients.lock();
        let list = clients.iter().map(|(&id, client)| ConnectedClient {
            id,
            role: client.role,
        });
        let list = list.collect();
        self.published.send_modify(|published| {
            published.clients = list;
            published.n_urgent += 1;
        });
    }
}

/// The parts of a state whose changes clients must learn at once. Texts and scales of limits change
/// with every motion, so they are left out.
type UrgentPart<'a> = (
    Option<u64>,
    Option<u64>,
    Option<&'a str>,
    Option<u64>,
    bool,
    Vec<(LimitLink, LimitEffect)>,
);

fn urgent_part(state: &SteeringState) -> UrgentPart<'_> {
    let limits = state.limits.iter();
    (
        state.holder,
        state.offered_to,
        state.stop.as_deref(),
        state.stop_number,
        state.is_recovering,
        limits.map(|limit| (limit.link, limit.effect)).collect(),
    )
}

/// Waits until clients may no longer steer the arm of this server.
pub(crate) async fn steering_ended(hub: &Hub, server: &Arc<SteeringServer>) {
    let mut steered = hub.latest::<SteeredArm>().subscribe();
    let is_other = |arm: &SteeredArm| {
        let current = arm.0.as_ref();
        current.is_none_or(|current| !Arc::ptr_eq(current, server))
    };
    // The hub keeps the sender, so there is no error while somebody waits.
    let _ = steered.wait_for(is_other).await;
}

/// The arm that clients may steer.
#[derive(Clone, Debug, Default)]
struct SteeredArm(Option<Arc<SteeringServer>>);

/// Sets the arm that clients of a hub may steer. With `None`, and before the first call, `/steer`
/// answers 404, and connected clients are disconnected. The status says whether there is an arm.
pub fn publish_steering(hub: &Hub, server: Option<Arc<SteeringServer>>) {
    hub.latest::<SteeredArm>().send_replace(SteeredArm(server));
    // The hub fills in the status. Before the first status, there is nothing to update.
    if hub.status().is_some() {
        hub.change_status(|_| {});
    }
}

/// The arm that clients of a hub may steer.
pub(crate) fn steered_arm(hub: &Hub) -> Option<Arc<SteeringServer>> {
    hub.latest::<SteeredArm>().borrow().0.clone()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_is_not_offered_to_clients_that_may_only_watch() {
        const HOLDER: u64 = 1;
        const VIEWER: u64 = 2;
        const OPERATOR: u64 = 3;
        let server = SteeringServer::new(ArmDescription {
            base_link: "base".to_owned(),
            tip_link: "tip".to_owned(),
            joints: Vec::new(),
            expiry_secs: 0.12,
            lease_secs: 5.0,
            servo_round_trip_millis: 120.0,
            base: None,
        });
        for (client, role) in [
            (HOLDER, Role::Operator),
            (VIEWER, Role::Viewer),
            (OPERATOR, Role::Operator),
        ] {
            server.join(client, role);
        }
        let offer = |to| {
            let request = SteeringRequest::OfferLease { to };
            server.request(HOLDER, Instant::now(), request)
        };
        let refusal = offer(VIEWER).expect_err("a viewer cannot take control");
        assert_eq!(refusal, NotAccepted::OnlyWatches { to: VIEWER });
        assert!(refusal.to_string().contains("client 2 may only watch"));
        assert_eq!(offer(OPERATOR), Ok(()));
        let received = server.take_requests();
        assert_eq!(received.len(), 1, "the loop sees no offer to the viewer");
    }
}
