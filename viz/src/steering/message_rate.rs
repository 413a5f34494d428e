//! Limits the number of messages that a client may send, so that a flood costs little.

use std::time::{Duration, Instant};

/// Maximum number of messages in a [`PERIOD`]. Two hands at 90 Hz and pings take less than 250. After
/// an interruption of the network, the messages of some seconds may arrive at once.
const MAX_MESSAGES: u32 = 1000;
const PERIOD: Duration = Duration::from_secs(1);

/// Counts the messages of one client.
#[derive(Debug)]
pub(crate) struct MessageRate {
    since: Instant,
    n_messages: u32,
}

/// Whether a message is within the limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Counted {
    /// It is.
    Within,
    /// It is the first one in this period that is not.
    FirstBeyond,
    /// It is not, and neither was the last one.
    Beyond,
}

/// The sentence for clients that exceed the limit.
pub(crate) fn flood_text() -> String {
    format!(
        "more than {MAX_MESSAGES} messages in a second: until it is over, only stops, open switches \
         and released leases are obeyed"
    )
}

impl MessageRate {
    /// No messages so far.
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            since: now,
            n_messages: 0,
        }
    }

    /// Counts a message.
    pub(crate) fn count(&mut self, now: Instant) -> Counted {
        if now.saturating_duration_since(self.since) >= PERIOD {
            *self = Self::new(now);
        }
        self.n_messages = self.n_messages.saturating_add(1);
        match self.n_messages {
            ..=MAX_MESSAGES => Counted::Within,
            n if n == MAX_MESSAGES + 1 => Counted::FirstBeyond,
            _ => Counted::Beyond,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Counted, MAX_MESSAGES, MessageRate, PERIOD};
    use std::time::{Duration, Instant};

    #[test]
    fn messages_beyond_the_limit_are_told_apart_until_the_period_is_over() {
        let start = Instant::now();
        let mut rate = MessageRate::new(start);
        let counted: Vec<_> = (0..10_000)
            .map(|ix| rate.count(start + Duration::from_micros(99 * ix)))
            .collect();
        let n_of = |wanted| counted.iter().filter(|counted| **counted == wanted).count();
        assert_eq!(n_of(Counted::Within), MAX_MESSAGES as usize);
        assert_eq!(n_of(Counted::FirstBeyond), 1);
        assert_eq!(rate.count(start + PERIOD), Counted::Within);
    }

    #[test]
    fn two_hands_and_pings_are_within_the_limit() {
        let start = Instant::now();
        let mut rate = MessageRate::new(start);
        let is_within = |ix: u32| {
            let at = start + ix * PERIOD / 250;
            rate.count(at) == Counted::Within
        };
        assert!((0..2500).all(is_within));
    }
}
