//! Shared state of the training thread and the server. The training thread never waits for a
//! client.

use crate::demands::{Demand, Demands};
use crate::edit::EditRequest;
use crate::operator_requests::OperatorRequests;
use crate::pictures::picture_requests::PictureRequests;
use crate::pictures::queue::Outgoing;
use crate::server::access::Role;
use parking_lot::Mutex;
use std::any::{Any, TypeId};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use tokio::sync::{Notify, watch};

/// Handle shared by the training thread and a [`Server`](crate::Server). Clones refer to the same
/// hub.
#[derive(Clone, Debug, Default)]
pub struct Hub {
    shared: Arc<Shared>,
}

/// The latest data of the topics, by type.
type LatestData = BTreeMap<TypeId, Box<dyn Any + Send>>;

#[derive(Debug, Default)]
struct Shared {
    /// A [`watch::Sender`] of each type that [`Hub::latest`] was called with.
    latest: Mutex<LatestData>,
    demands: Demands,
    operator_requests: OperatorRequests,
    pictures: Arc<PictureRequests>,
    /// Whether somebody besides the clients needs images and robot states.
    is_observed: AtomicBool,
}

impl Hub {
    /// Creates an empty hub.
    pub fn new() -> Self {
        Self::default()
    }

    /// The latest data of this type. A type belongs to one topic, whose module sets and reads it. A
    /// topic with a common type, such as a number, therefore wraps it in a separate type.
    pub(crate) fn latest<T: Default + Send + Sync + 'static>(&self) -> watch::Sender<T> {
        // There is no field for each topic, so a new topic needs no change here. The lock is held
        // only to find the sender, so the training thread does not wait for threads that read the
        // data.
        let mut latest = self.shared.latest.lock();
        let sender = latest
            .entry(TypeId::of::<T>())
            .or_insert_with(|| Box::new(watch::Sender::<T>::default()));
        sender
            .downcast_ref::<watch::Sender<T>>()
            .expect("the key is its type")
            .clone()
    }

    /// The pictures that clients have requested.
    pub fn pictures(&self) -> &Arc<PictureRequests> {
        &self.shared.pictures
    }

    /// What operators have requested of the run.
    pub fn operator_requests(&self) -> &OperatorRequests {
        &self.shared.operator_requests
    }

    /// What the connected clients receive.
    pub(crate) fn demands(&self) -> &Demands {
        &self.shared.demands
    }

    /// Sets whether somebody besides the clients needs images and robot states.
    #[cfg(feature = "foxglove")]
    pub(crate) fn set_observed(&self, is_observed: bool) {
        self.shared
            .is_observed
            .store(is_observed, Ordering::Relaxed);
    }

    pub(crate) fn is_observed(&self) -> bool {
        self.shared.is_observed.load(Ordering::Relaxed)
    }

    /// Sends the client a one-sentence reason why an edit could not be made.
    pub fn reject_edit(&self, request: &EditRequest, reason: &str) {
        let rejected = Outgoing::Rejected {
            id: request.id,
            reason: reason.to_owned(),
        };
        self.pictures().push_outgoing(request.client, rejected);
    }

    /// Number of connected clients.
    pub fn n_clients(&self) -> usize {
        self.pictures().n_clients()
    }

    pub(crate) fn join(&self, role: Role) -> (u64, Arc<Notify>) {
        let (client, wake) = self.pictures().join(role);
        self.set_demand(client, Demand::new(Instant::now()));
        (client, wake)
    }

    pub(crate) fn leave(&self, client: u64) {
        self.pictures().leave(client);
        self.demands().remove(client);
        // Chunks of a model take as much memory as its file.
        self.model_chunks().drop_unused();
    }

    /// Sets what a client receives.
    pub(crate) fn set_demand(&self, client: u64, demand: Demand) {
        self.demands().set(client, demand);
        self.model_chunks().drop_unused();
    }
}
