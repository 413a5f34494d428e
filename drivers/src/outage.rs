//! Outage of a camera: its start, the number of reconnection attempts, and the time of the next
//! attempt.

use kinematics::Stamp;
use std::time::{Duration, Instant};

/// A period without images because a camera is disconnected.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outage {
    pub(crate) since: Instant,
    pub(crate) n_tries: u32,
    last_try: Instant,
}

impl Outage {
    /// Returns the current outage of a camera, or starts a new one.
    pub(crate) fn of(outage: &mut Option<Self>) -> Self {
        let now = Instant::now();
        let outage = outage.get_or_insert(Self {
            since: now,
            n_tries: 0,
            last_try: now,
        });
        // A camera that was opened but sent nothing starts a new pause here. Without the pause, it
        // would be reopened at once, again and again.
        outage.last_try = now;
        *outage
    }

    /// Waits until the next attempt is due, which is one `pause` after the last attempt. Then
    /// counts the attempt and returns true. If the attempt is due after the deadline, waits only
    /// until the deadline and returns false.
    pub(crate) fn wait_for_retry(&mut self, pause: Duration, deadline: Instant) -> bool {
        let next_try = self.last_try + pause;
        std::thread::sleep(
            next_try
                .min(deadline)
                .saturating_duration_since(Instant::now()),
        );
        if next_try > deadline {
            return false;
        }
        self.n_tries += 1;
        self.last_try = Instant::now();
        true
    }
}

/// Number of images between two stamps at the given rate.
pub(crate) fn n_between(last: Stamp, next: Stamp, rate_hz: f64) -> u64 {
    let periods = next.0.saturating_sub(last.0) as f64 * 1e-9 * rate_hz;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the cast saturates as intended"
    )]
    // Stamps jitter by a fraction of a period, so the number of periods is rounded. The number of
    // images between two images is one less than the number of periods.
    let n_images = (periods.round() - 1.0).max(0.0) as u64;
    n_images
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outage_duration_converts_to_missed_images() {
        let millis = |millis: i64| Stamp(millis * 1_000_000);
        assert_eq!(n_between(millis(0), millis(33), 30.0), 0);
        assert_eq!(n_between(millis(0), millis(100), 30.0), 2);
        assert_eq!(n_between(millis(0), millis(1000), 30.0), 29);
        assert_eq!(n_between(millis(1000), millis(0), 30.0), 0);
    }

    #[test]
    fn retry_waits_for_pause_but_not_past_deadline() {
        let mut lost = None;
        let mut outage = Outage::of(&mut lost);
        assert!(
            outage.wait_for_retry(Duration::ZERO, Instant::now()),
            "the first attempt may be due immediately"
        );
        let began = Instant::now();
        assert!(!outage.wait_for_retry(Duration::from_secs(60), began + Duration::from_millis(10)));
        assert!(
            began.elapsed() >= Duration::from_millis(10)
                && began.elapsed() < Duration::from_secs(30)
        );
        assert!(outage.wait_for_retry(Duration::from_millis(20), began + Duration::from_secs(60)));
        assert!(began.elapsed() >= Duration::from_millis(15));
        assert_eq!(outage.n_tries, 2);
        assert_eq!(
            Outage::of(&mut lost).since,
            outage.since,
            "the same outage continues"
        );
    }
}
