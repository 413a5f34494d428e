//! Messages that wait to be sent to one client, besides states.

use crate::steering::preview::Preview;
use crate::steering::request::RefusedRequest;
use std::collections::VecDeque;
use std::sync::Arc;
use tokio::sync::Notify;

/// Maximum number of replies that wait. A client that does not read misses further ones.
const MAX_REPLIES: usize = 64;

/// A reply to one message of a client.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Reply {
    /// A request was refused.
    Refused {
        request: RefusedRequest,
        text: String,
    },
    /// Whether a goal can be reached.
    Preview { id: u64, preview: Preview },
    /// The reply to a ping.
    Pong { id: u64 },
}

/// Replies to one client.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    replies: VecDeque<Reply>,
    wake: Arc<Notify>,
}

impl Outbox {
    /// Is notified when there is a reply.
    pub(crate) fn wake(&self) -> Arc<Notify> {
        Arc::clone(&self.wake)
    }

    /// Adds a reply. Refusals of commands, and previews, replace waiting ones, because there may be
    /// as many as commands.
    pub(crate) fn push(&mut self, reply: Reply) {
        if let Some(waiting) = self
            .replies
            .iter_mut()
            .find(|waiting| is_replaced(waiting, &reply))
        {
            *waiting = reply;
        } else if self.replies.len() < MAX_REPLIES {
            self.replies.push_back(reply);
        }
        self.wake.notify_one();
    }

    /// Takes the oldest reply.
    pub(crate) fn pop(&mut self) -> Option<Reply> {
        self.replies.pop_front()
    }
}

fn is_replaced(waiting: &Reply, reply: &Reply) -> bool {
    let is_of_command = |reply: &Reply| {
        matches!(
            reply,
            Reply::Refused {
                request: RefusedRequest::Command,
                ..
            }
        )
    };
    let is_preview = |reply: &Reply| matches!(reply, Reply::Preview { .. });
    is_of_command(waiting) && is_of_command(reply) || is_preview(waiting) && is_preview(reply)
}

#[cfg(test)]
mod tests {
    use super::{MAX_REPLIES, Outbox, Reply};
    use crate::steering::request::RefusedRequest;

    fn refused(request: RefusedRequest, text: &str) -> Reply {
        let text = text.to_owned();
        Reply::Refused { request, text }
    }

    #[test]
    fn refused_commands_replace_each_other_and_other_refusals_stay() {
        let mut outbox = Outbox::default();
        outbox.push(refused(RefusedRequest::Command, "old"));
        outbox.push(refused(RefusedRequest::Lease, "first"));
        outbox.push(refused(RefusedRequest::Lease, "second"));
        outbox.push(refused(RefusedRequest::Command, "new"));
        let taken: Vec<_> = std::iter::from_fn(|| outbox.pop()).collect();
        let expected = [
            refused(RefusedRequest::Command, "new"),
            refused(RefusedRequest::Lease, "first"),
            refused(RefusedRequest::Lease, "second"),
        ];
        assert_eq!(taken, expected);
    }

    #[test]
    fn replies_to_a_client_that_does_not_read_are_limited() {
        let mut outbox = Outbox::default();
        for id in 0..10_000 {
            outbox.push(Reply::Pong { id });
        }
        assert_eq!(std::iter::from_fn(|| outbox.pop()).count(), MAX_REPLIES);
    }
}
