//! Several models on one device: whose turn it is to learn.
//!
//! Turns go by the time that each had so far. What a model learns does not depend on them: it is a function of its steps and
//! of its keyframes alone.

use crate::session::Session;
use std::time::Duration;

/// A turn among several lasts about this long: at its end the device has nothing to do for a moment.
pub(crate) const TURN: Duration = Duration::from_millis(40);

/// Lets the model learn that had the least time of those that can, then tells what is due of all.
///
/// `n_most`: maximum number of steps of a session in this turn, by its index. `is_awaited`: whether a picture waits for the end
/// of the turn, which then comes after the current submit.
pub(crate) fn take(
    sessions: &mut [Session],
    n_most: impl Fn(usize, &Session) -> u64,
    is_awaited: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let learns = |ix: usize, session: &Session| !session.is_over() && !session.is_idle() && n_most(ix, session) > 0;
    let had: Vec<Option<Duration>> =
        sessions.iter().enumerate().map(|(ix, session)| learns(ix, session).then(|| session.had())).collect();
    if let Some((ix, least)) = next(&had) {
        if sessions.len() == 1 {
            sessions[ix].learn(n_most(ix, &sessions[ix]))?;
        } else {
            // Who had nothing to learn for a while does not catch up on that.
            sessions.iter_mut().for_each(|session| session.had_at_least(least));
            sessions[ix].take_turn(|session| n_most(ix, session), is_awaited)?;
        }
    }
    sessions.iter_mut().try_for_each(Session::tell_due)
}

/// Place and time of the one that had the least, the first of several; `None` where nobody can learn.
fn next(had: &[Option<Duration>]) -> Option<(usize, Duration)> {
    had.iter().enumerate().filter_map(|(ix, had)| Some((ix, (*had)?))).min_by_key(|(_, had)| *had)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_share_the_time_however_long_each_lasts() {
        const MILLIS: [u64; 3] = [40, 90, 55];
        let mut had = [Duration::ZERO; 3];
        for _ in 0..1000 {
            let (ix, _) = next(&had.map(Some)).expect("all can learn");
            had[ix] += Duration::from_millis(MILLIS[ix]);
        }
        let (most, least) = (had.iter().max().expect("three"), had.iter().min().expect("three"));
        assert!(*most - *least <= Duration::from_millis(90), "{had:?}");
        assert_eq!(next(&[None, Some(had[1]), None]), Some((1, had[1])));
        assert_eq!(next(&[None, None]), None);
    }
}
