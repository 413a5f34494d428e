//! Tells a second Ctrl-C from one key press whose signal arrives twice.

use std::time::{Duration, Instant};

/// A signal within this time after another one belongs to the same key press, because some programs
/// send it both to a process and to its group.
const MAX_SAME_PRESS: Duration = Duration::from_millis(500);

/// What a SIGINT requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// An orderly stop.
    Stop,
    /// Nothing: it belongs to the key press before.
    Nothing,
    /// The end of the process.
    Exit,
}

/// The key presses so far.
#[derive(Debug, Default)]
pub struct CtrlC {
    /// Time of the last signal that counted.
    last_at: Option<Instant>,
}

impl CtrlC {
    /// What a signal at `now` requests.
    ///
    /// * `is_stopping`: whether the program is stopping because of an earlier Ctrl-C.
    #[must_use]
    pub fn request(&mut self, is_stopping: bool, now: Instant) -> Request {
        let is_same_press = self
            .last_at
            .is_some_and(|last| now.duration_since(last) < MAX_SAME_PRESS);
        if is_same_press {
            return Request::Nothing;
        }
        self.last_at = Some(now);
        if is_stopping {
            Request::Exit
        } else {
            Request::Stop
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_within_half_a_second_are_one_key_press() {
        let start = Instant::now();
        let mut ctrl_c = CtrlC::default();
        for (millis, is_stopping, expected) in [
            (1000, false, Request::Stop),
            (1000, true, Request::Nothing),
            (1499, true, Request::Nothing),
            // The time counts from the first signal of a press, so that a held key ends the program.
            (1500, true, Request::Exit),
            (1600, true, Request::Nothing),
        ] {
            let now = start + Duration::from_millis(millis);
            assert_eq!(ctrl_c.request(is_stopping, now), expected, "{millis} ms");
        }
    }

    #[test]
    fn press_after_a_stop_was_withdrawn_requests_a_stop_again() {
        let start = Instant::now();
        let mut ctrl_c = CtrlC::default();
        for (millis, expected) in [
            (0, Request::Stop),
            (200, Request::Nothing),
            (800, Request::Stop),
        ] {
            let now = start + Duration::from_millis(millis);
            assert_eq!(ctrl_c.request(false, now), expected, "{millis} ms");
        }
    }
}
