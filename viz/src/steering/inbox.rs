//! Requests that wait until the loop takes them.
//!
//! The loop takes all of them at once, many times per second. If it is held up, the inbox must
//! neither grow nor delay a stop, so requests that change nothing are merged:
//!
//! - A command takes the place of the device's last waiting command if that has the same grip, and
//!   if only commands and previews came since. The loop therefore sees each opening and closing of
//!   the switch, in its order among leases, stops and permissions. A switch that was closed before
//!   motion was permitted must not look as if it had been closed afterward.
//! - A stop is dropped if one waits already and nobody has asked to permit motion since.
//! - Renewing or giving up the lease is dropped if the client's last waiting request of another kind
//!   than commands and previews is the same.
//! - A preview replaces the client's waiting preview, and a view its waiting view.
//!
//! A client may have [`MAX_WAITING`] requests; further ones are refused. Stops, open switches and
//! giving up the lease are always accepted. Their number is also limited, because each of them
//! follows a request that can be refused, or is merged.

use crate::steering::request::{ReceivedRequest, SteeringCommand, SteeringRequest};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

/// Maximum number of waiting requests of a client. A person makes at most a few in the period of
/// the loop.
const MAX_WAITING: usize = 64;
/// Maximum number of devices of a client: two hands, a gamepad, a keyboard, a pointer and a touch
/// screen, and two more. Each device may have an open switch that cannot be refused.
const MAX_DEVICES: usize = 8;

/// Waiting requests of all clients, in the order of their arrival.
#[derive(Debug, Default)]
pub(crate) struct Inbox {
    waiting: Vec<ReceivedRequest>,
    clients: BTreeMap<u64, Sender>,
}

/// A client that sends requests.
#[derive(Debug, Default)]
struct Sender {
    /// The greatest number of a command, by device.
    newest_sequences: BTreeMap<u64, u64>,
    /// Whether the loop has taken a request of this client, so that it must learn of its end.
    is_known: bool,
}

/// Why a request is not passed on, in one sentence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum NotAccepted {
    /// The client has left.
    #[error("the connection has ended")]
    Gone,
    /// A command was repeated or overtaken.
    #[error("command {sequence} came after command {newest} of the same device")]
    OutOfOrder { sequence: u64, newest: u64 },
    /// Control was offered to a viewer.
    #[error("client {to} may only watch: offer control to an operator")]
    OnlyWatches { to: u64 },
    /// Too many devices.
    #[error("a connection may have at most {MAX_DEVICES} devices: connect again")]
    Devices,
    /// Too many requests.
    #[error("{MAX_WAITING} requests wait already: send fewer requests")]
    Full,
}

impl Inbox {
    /// Adds a client, which may now send requests.
    pub(crate) fn join(&mut self, client: u64) {
        self.clients.insert(client, Sender::default());
    }

    /// Adds a request of a client.
    pub(crate) fn push(
        &mut self,
        client: u64,
        received_at: Instant,
        request: SteeringRequest,
    ) -> Result<(), NotAccepted> {
        if !self.clients.contains_key(&client) {
            return Err(NotAccepted::Gone);
        }
        if let SteeringRequest::Command(command) = &request {
            self.check_command(client, command)?;
        }
        if self.is_repeated(client, &request) {
            return Ok(());
        }
        let replaced_ix = self.replaced_ix(client, &request);
        if replaced_ix.is_none() && !is_urgent(&request) && self.n_waiting(client) >= MAX_WAITING {
            return Err(NotAccepted::Full);
        }
        // A command counts as received only now: a refused closing may be repeated.
        if let SteeringRequest::Command(command) = &request {
            self.remember(client, command);
        }
        let received = ReceivedRequest {
            client,
            received_at,
            request,
        };
        match replaced_ix {
            Some(ix) => self.waiting[ix] = received,
            None => self.waiting.push(received),
        }
        Ok(())
    }

    /// Removes what a silent client asked for, except for stops. If the loop has seen the client, it
    /// learns of the silence.
    pub(crate) fn silence(&mut self, client: u64, at: Instant) {
        // The end of an earlier silence stays, too: the loop has not released that lease yet.
        let stays = |request: &SteeringRequest| {
            matches!(
                request,
                SteeringRequest::Stop | SteeringRequest::Disconnected
            )
        };
        self.waiting
            .retain(|waiting| waiting.client != client || stays(&waiting.request));
        let Some(sender) = self.clients.get_mut(&client) else {
            return;
        };
        if std::mem::take(&mut sender.is_known) {
            self.waiting.push(ReceivedRequest {
                client,
                received_at: at,
                request: SteeringRequest::Disconnected,
            });
        }
    }

    /// Removes a client that has left.
    pub(crate) fn leave(&mut self, client: u64, at: Instant) {
        self.silence(client, at);
        self.clients.remove(&client);
    }

    /// Whether requests wait.
    pub(crate) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Takes all requests.
    pub(crate) fn take(&mut self) -> Vec<ReceivedRequest> {
        let senders: BTreeSet<u64> = self
            .waiting
            .iter()
            .filter(|waiting| can_hold(&waiting.request))
            .map(|waiting| waiting.client)
            .collect();
        for client in senders {
            if let Some(sender) = self.clients.get_mut(&client) {
                sender.is_known = true;
            }
        }
        std::mem::take(&mut self.waiting)
    }

    /// Refuses repeated and overtaken commands, because an old message that is sent again must not
    /// replace the newest. An open switch is accepted whatever its number is.
    fn check_command(&self, client: u64, command: &SteeringCommand) -> Result<(), NotAccepted> {
        let Some(sender) = self.clients.get(&client) else {
            return Err(NotAccepted::Gone);
        };
        let sequence = command.sequence;
        match sender.newest_sequences.get(&command.device) {
            None if sender.newest_sequences.len() >= MAX_DEVICES => Err(NotAccepted::Devices),
            Some(&newest) if command.grip.is_some() && sequence <= newest => {
                Err(NotAccepted::OutOfOrder { sequence, newest })
            }
            _ => Ok(()),
        }
    }

    fn remember(&mut self, client: u64, command: &SteeringCommand) {
        if let Some(sender) = self.clients.get_mut(&client) {
            let newest = sender.newest_sequences.entry(command.device).or_default();
            *newest = command.sequence.max(*newest);
        }
    }

    /// Whether a request adds nothing to the waiting ones.
    fn is_repeated(&self, client: u64, request: &SteeringRequest) -> bool {
        match request {
            // The last stop or permission decides, whoever asked for it.
            SteeringRequest::Stop => {
                let last = self.waiting.iter().rev().find(|waiting| {
                    matches!(
                        waiting.request,
                        SteeringRequest::Stop | SteeringRequest::Rearm { .. }
                    )
                });
                last.is_some_and(|last| last.request == SteeringRequest::Stop)
            }
            SteeringRequest::RenewLease | SteeringRequest::ReleaseLease => {
                let mut of_client = self.of_client(client).rev();
                let last = of_client.find(|waiting| !is_replaceable(&waiting.request));
                last.is_some_and(|last| last.request == *request)
            }
            _ => false,
        }
    }

    /// Index of the waiting request that a request makes superfluous.
    fn replaced_ix(&self, client: u64, request: &SteeringRequest) -> Option<usize> {
        match request {
            SteeringRequest::Preview(_) => self.waiting.iter().position(|waiting| {
                waiting.client == client && matches!(waiting.request, SteeringRequest::Preview(_))
            }),
            SteeringRequest::View { .. } => self.waiting.iter().position(|waiting| {
                waiting.client == client && matches!(waiting.request, SteeringRequest::View { .. })
            }),
            SteeringRequest::Command(command) => self.replaced_command_ix(client, command),
            _ => None,
        }
    }

    fn replaced_command_ix(&self, client: u64, command: &SteeringCommand) -> Option<usize> {
        for (ix, waiting) in self.waiting.iter().enumerate().rev() {
            match &waiting.request {
                SteeringRequest::Command(other)
                    if waiting.client == client && other.device == command.device =>
                {
                    return (other.grip == command.grip).then_some(ix);
                }
                request if is_replaceable(request) => {}
                _ => return None,
            }
        }
        None
    }

    fn n_waiting(&self, client: u64) -> usize {
        self.of_client(client).count()
    }

    fn of_client(&self, client: u64) -> impl DoubleEndedIterator<Item = &ReceivedRequest> {
        let waiting = self.waiting.iter();
        waiting.filter(move |waiting| waiting.client == client)
    }
}

/// Whether a request is accepted however many wait.
fn is_urgent(request: &SteeringRequest) -> bool {
    match request {
        SteeringRequest::Stop | SteeringRequest::ReleaseLease => true,
        SteeringRequest::Command(command) => command.grip.is_none(),
        _ => false,
    }
}

/// Whether a newer request of the same kind replaces a request.
fn is_replaceable(request: &SteeringRequest) -> bool {
    matches!(
        request,
        SteeringRequest::Command(_) | SteeringRequest::Preview(_) | SteeringRequest::View { .. }
    )
}

/// Whether the sender of a request may hold something afterward that its end must release.
fn can_hold(request: &SteeringRequest) -> bool {
    !matches!(
        request,
        SteeringRequest::Stop
            | SteeringRequest::Preview(_)
            | SteeringRequest::View { .. }
            | SteeringRequest::Disconnected
    )
}

#[cfg(test)]
mod tests;
