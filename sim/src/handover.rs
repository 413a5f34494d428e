//! Passes an arm from its tour to the controller that an operator steers.
//!
//! The thread of the simulation moves the arm and renders, so it may lag behind real time. The
//! controller runs in real time on a separate thread, and stays ahead of the simulation: it
//! generates one setpoint per step, and the simulation follows them when it gets there.

use drivers::motion::Setpoint;
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// Number of setpoints that wait for the simulation: those of a minute. A simulation that is later
/// than this has stopped, and follows the newest setpoints when it continues.
const MAX_SETPOINTS: usize = 60_000;
/// Maximum time to wait for a setpoint, after which the arm rests. A setpoint comes every
/// millisecond, so only a controller that has ended is silent for this long.
const MAX_WAIT: Duration = Duration::from_secs(2);

/// The connection between the simulation and the controller. Clones share it. Positions are
/// reported positions, in the order of the joint readings.
#[derive(Clone, Debug, Default)]
pub(crate) struct Handover(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// Motion of the arm on its tour at the newest step.
    tour: Option<Setpoint>,
    is_wanted: bool,
    /// Where the tour ended: number of the step, and the motion at this step.
    tour_end: Option<(i64, Setpoint)>,
    /// Setpoints of the steps after the tour that the simulation has not reached.
    setpoints: VecDeque<Setpoint>,
    /// Whether one of the two threads has ended.
    is_over: bool,
}

impl Handover {
    /// For the simulation: notes the motion of the tour at a step. Returns whether the tour has
    /// ended there; the setpoints of the steps after it come from the controller.
    pub(crate) fn note_tour(&self, step: i64, motion: Setpoint) -> bool {
        let mut state = self.0.state.lock();
        state.tour = Some(motion.clone());
        if state.is_wanted {
            state.tour_end = Some((step, motion));
            self.0.changed.notify_all();
        }
        state.is_wanted
    }

    /// For the simulation: the setpoint of the next step. `None` if the controller has ended.
    pub(crate) fn next_setpoint(&self) -> Option<Setpoint> {
        let mut state = self.0.state.lock();
        loop {
            if let Some(setpoint) = state.setpoints.pop_front() {
                return Some(setpoint);
            }
            if state.is_over || self.0.changed.wait_for(&mut state, MAX_WAIT).timed_out() {
                return None;
            }
        }
    }

    /// For the controller: motion of the tour at the newest step; `None` before the first step.
    pub(crate) fn tour(&self) -> Option<Setpoint> {
        self.0.state.lock().tour.clone()
    }

    /// For the controller: asks for the end of the tour, which comes with the next step. Returns
    /// the end once it is known.
    pub(crate) fn end_tour(&self) -> Option<(i64, Setpoint)> {
        let mut state = self.0.state.lock();
        state.is_wanted = true;
        state.tour_end.clone()
    }

    /// For the controller: adds the setpoint of the next step.
    pub(crate) fn push(&self, setpoint: Setpoint) {
        let mut state = self.0.state.lock();
        if state.setpoints.len() >= MAX_SETPOINTS {
            state.setpoints.pop_front();
        }
        state.setpoints.push_back(setpoint);
        self.0.changed.notify_all();
    }

    /// Ends both sides.
    pub(crate) fn finish(&self) {
        self.0.state.lock().is_over = true;
        self.0.changed.notify_all();
    }

    /// Whether one of the two sides has ended.
    pub(crate) fn is_over(&self) -> bool {
        self.0.state.lock().is_over
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(position: f64) -> Setpoint {
        Setpoint {
            position: vec![position],
            velocity: vec![0.0],
            acceleration: vec![0.0],
        }
    }

    #[test]
    fn the_tour_ends_at_the_step_after_the_controller_wants_the_arm() {
        let handover = Handover::default();
        assert!(!handover.note_tour(7, at(0.7)));
        assert_eq!(handover.tour(), Some(at(0.7)));
        assert_eq!(handover.end_tour(), None, "the next step decides");
        assert!(handover.note_tour(8, at(0.8)));
        assert_eq!(handover.end_tour(), Some((8, at(0.8))));
        handover.push(at(0.9));
        handover.push(at(1.0));
        handover.finish();
        assert_eq!(handover.next_setpoint(), Some(at(0.9)));
        assert_eq!(handover.next_setpoint(), Some(at(1.0)));
        assert_eq!(handover.next_setpoint(), None, "nothing follows");
    }
}
