//! The pace of an emulated robot in a test: its time stands still until the test has caught up, so
//! that the test does not depend on the speed of the machine.

use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// A robot that stands still continues with one state after this time, because a driver takes a
/// robot that is silent for a second for lost.
const MAX_STANDSTILL: Duration = Duration::from_millis(200);

/// Number of states that a robot may still send; `None` is no limit. Clones share it.
#[derive(Clone, Default)]
pub(super) struct Pace(Arc<(Mutex<Option<u64>>, Condvar)>);

impl Pace {
    /// Waits until the robot may send a state. Its joint simulator calls this first.
    pub(super) fn wait(&self) {
        let (n_left, changed) = &*self.0;
        let n_left = n_left.lock().unwrap();
        let is_over = |n_left: &mut Option<u64>| *n_left == Some(0);
        let (mut n_left, _) = changed
            .wait_timeout_while(n_left, MAX_STANDSTILL, is_over)
            .unwrap();
        *n_left = n_left.map(|n_left| n_left.saturating_sub(1));
    }

    /// Lets the robot send this many states, and then stand still.
    pub(super) fn limit(&self, n_states: u64) {
        self.set(Some(n_states));
    }

    /// Lets the robot send one state more.
    pub(super) fn extend(&self) {
        let (n_left, changed) = &*self.0;
        let mut n_left = n_left.lock().unwrap();
        *n_left = n_left.map(|n_left| n_left + 1);
        changed.notify_all();
    }

    /// Lets the robot send states without a limit.
    pub(super) fn free(&self) {
        self.set(None);
    }

    /// Whether the robot stands still.
    pub(super) fn is_standing_still(&self) -> bool {
        *self.0.0.lock().unwrap() == Some(0)
    }

    fn set(&self, limit: Option<u64>) {
        let (n_left, changed) = &*self.0;
        *n_left.lock().unwrap() = limit;
        changed.notify_all();
    }
}
