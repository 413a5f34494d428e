//! Time slices for several models on one device.
//!
//! The next slice goes to the model with the least device time so far. Slices do not affect
//! results, which depend only on the steps and keyframes of a model.

use crate::session::Session;
use std::time::{Duration, Instant};

/// Approximate duration of a slice.
///
/// The device is idle for a moment at the end of each slice, so shorter slices train less. Longer
/// slices delay new keyframes, the other models, and the status, which are handled between slices.
const TIME_SLICE: Duration = Duration::from_millis(40);

/// Trains the session with the least device time among those that can train, then runs all
/// evaluations that are due.
///
/// `max_steps` returns the maximum number of steps of a session, given its index.
/// `is_render_pending` returns whether a picture is requested; the slice then ends after the
/// current submit.
pub(crate) fn train_next(
    sessions: &mut [Session],
    max_steps: impl Fn(usize, &Session) -> u64,
    is_render_pending: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let can_train = |ix: usize, session: &Session| {
        !session.is_over() && !session.is_idle() && max_steps(ix, session) > 0
    };
    let device_time: Vec<Option<Duration>> = sessions
        .iter()
        .enumerate()
        .map(|(ix, session)| can_train(ix, session).then(|| session.time().device_time()))
        .collect();
    if let Some((ix, min_time)) = next(&device_time) {
        if sessions.len() == 1 {
            // A single model needs no slices. Without the wait at the end of a slice, the GPU gets
            // the next steps before it has completed the last ones.
            sessions[ix].train_steps(max_steps(ix, &sessions[ix]))?;
        } else {
            // A session that was idle for a while does not catch up.
            sessions
                .iter_mut()
                .for_each(|session| session.time_mut().raise_device_time(min_time));
            run_slice(
                &mut sessions[ix],
                |session| max_steps(ix, session),
                is_render_pending,
            )?;
        }
    }
    // All sessions are evaluated, not only the session that has trained. They share one clock, so
    // evaluations and checkpoints of the other sessions become due, too.
    sessions.iter_mut().try_for_each(Session::evaluate_when_due)
}

/// Trains a session for one slice on a shared device, at most `max_steps` steps. Queued work is
/// complete when this returns.
///
/// `is_render_pending` returns whether a picture is requested, which ends the slice; called after
/// each submit.
fn run_slice(
    session: &mut Session,
    max_steps: impl Fn(&Session) -> u64,
    is_render_pending: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let started = Instant::now();
    let mut n_steps = 0;
    loop {
        let n = session.train_steps(max_steps(session))?;
        n_steps += n;
        // In lockstep, 0 means that the next keyframe is due before the next step.
        let is_at_end = session.is_over() || session.is_idle() || max_steps(session) == 0;
        if n == 0 || is_at_end || started.elapsed() >= TIME_SLICE || is_render_pending() {
            break;
        }
    }
    // Waits for the queued steps. Otherwise, the next session would be charged for their time.
    session.n_total_steps()?;
    // A session that cannot train is charged a full slice, so that it is not selected every time.
    session.time_mut().add_device_time(if n_steps == 0 {
        TIME_SLICE
    } else {
        started.elapsed()
    });
    if session.has_finished_steps() {
        session.time_mut().mark_finished();
    }
    Ok(())
}

/// Index and device time of the session with the least device time (the first one if several have
/// the same); `None` if no session can train.
fn next(device_time: &[Option<Duration>]) -> Option<(usize, Duration)> {
    device_time
        .iter()
        .enumerate()
        .filter_map(|(ix, device_time)| Some((ix, (*device_time)?)))
        .min_by_key(|(_, device_time)| *device_time)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_slices_share_the_time_evenly() {
        const MILLIS: [u64; 3] = [40, 90, 55];
        let mut device_time = [Duration::ZERO; 3];
        for _ in 0..1000 {
            let (ix, _) = next(&device_time.map(Some)).expect("all can train");
            device_time[ix] += Duration::from_millis(MILLIS[ix]);
        }
        let (max_time, min_time) = (
            device_time.iter().max().expect("three"),
            device_time.iter().min().expect("three"),
        );
        assert!(
            *max_time - *min_time <= Duration::from_millis(90),
            "{device_time:?}"
        );
        assert_eq!(
            next(&[None, Some(device_time[1]), None]),
            Some((1, device_time[1]))
        );
        assert_eq!(next(&[None, None]), None);
    }
}
