//! Times at which each keyframe of a live run passed the stages from the camera to the screens of
//! viewers.

use crate::latency::Latency;
use capture::InputTimes;
use kinematics::Stamp;
use std::sync::Arc;
use std::time::Instant;
use viz::{NewestKeyframe, ShownPicture, TrainedKeyframes};

/// The times of one keyframe, all on the clock of this process.
#[derive(Clone, Debug)]
pub struct KeyframeTimes {
    /// Name of its camera.
    pub camera: Arc<str>,
    /// Its stamp.
    pub stamp: Stamp,
    /// Times in the input.
    pub input: InputTimes,
    /// Time at which it was added to the models.
    pub pushed: Instant,
    /// Number of steps of each model at `pushed`, including queued steps.
    pub pushed_at_steps: Vec<u64>,
    /// Time at which the first steps of the first model after `pushed` were complete; `None` until
    /// then.
    pub trained: Option<Instant>,
    /// Time at which the server began to send the first picture that contains it, to the first
    /// client that reported this picture as shown. Clients that have connected later are not
    /// considered.
    pub sent: Option<Instant>,
    /// Time at which this client showed this picture, as reported by the client.
    pub shown: Option<Instant>,
}

impl KeyframeTimes {
    /// Mid-exposure; the time of arrival if the stamp is on another clock.
    #[must_use]
    pub fn captured_at(&self) -> Instant {
        self.input.captured.unwrap_or(self.input.arrived)
    }

    /// Time from mid-exposure until `at`, milliseconds.
    #[must_use]
    pub fn millis_until(&self, at: Instant) -> Option<f64> {
        Some(at.checked_duration_since(self.captured_at())?.as_secs_f64() * 1e3)
    }
}

/// The keyframes of a live run in the order in which the models received them.
#[derive(Debug, Default)]
pub struct Ledger {
    keyframes: Vec<KeyframeTimes>,
    /// Number of keyframes, from the first, of which [`KeyframeTimes::trained`] is known.
    n_trained: usize,
    /// Pauses of the training; the end is `None` while one is in progress.
    pauses: Vec<(Instant, Option<Instant>)>,
}

impl Ledger {
    /// The keyframes so far.
    #[must_use]
    pub fn keyframes(&self) -> &[KeyframeTimes] {
        &self.keyframes
    }

    /// The keyframes that were available in at least one of the first `step` steps of a model.
    #[must_use]
    pub fn trained_keyframes(&self, session_ix: usize, step: u64) -> TrainedKeyframes {
        let n = self.n_in_model(session_ix, step);
        let newest = n.checked_sub(1).map(|ix| &self.keyframes[ix]);
        let newest = newest.map(|keyframe| NewestKeyframe {
            captured_at: keyframe.captured_at(),
            added_at: keyframe.pushed,
        });
        TrainedKeyframes {
            n: n as u64,
            newest,
        }
    }

    /// Durations from mid-exposure by stage, in order. Durations that overlap a pause of the
    /// training are left out, because they would only show the length of the pause.
    #[must_use]
    pub fn latencies(&self) -> Vec<(String, Latency)> {
        stages(&self.keyframes, &self.pauses)
    }

    /// Records at `now` whether training is paused.
    pub(crate) fn set_paused(&mut self, is_paused: bool, now: Instant) {
        match self.pauses.last_mut() {
            Some((_, end @ None)) if !is_paused => *end = Some(now),
            Some((_, None)) => {}
            _ if is_paused => self.pauses.push((now, None)),
            _ => {}
        }
    }

    /// Number of keyframes, from the first, that were available in at least one of the first `step`
    /// steps of a model.
    fn n_in_model(&self, session_ix: usize, step: u64) -> usize {
        self.keyframes
            .partition_point(|keyframe| keyframe.pushed_at_steps[session_ix] < step)
    }

    /// Adds a keyframe that was just pushed.
    pub(crate) fn push(&mut self, keyframe: KeyframeTimes) {
        self.keyframes.push(keyframe);
    }

    /// Records that the first model has completed `step` steps.
    pub(crate) fn completed(&mut self, step: u64) {
        // A rejected trial restores an earlier step, but keyframes stay trained.
        let n_trained = self.n_in_model(0, step).max(self.n_trained);
        let now = Instant::now();
        self.keyframes[self.n_trained..n_trained]
            .iter_mut()
            .for_each(|keyframe| keyframe.trained = Some(now));
        self.n_trained = n_trained;
    }

    /// Records that a client has shown a picture of the first model.
    pub(crate) fn shown(&mut self, picture: &ShownPicture) {
        // A range that ends beyond the list must not cause a panic.
        let [begin, end] = [picture.new_keyframes.start, picture.new_keyframes.end].map(|n| {
            usize::try_from(n)
                .unwrap_or(usize::MAX)
                .min(self.keyframes.len())
        });
        for keyframe in self
            .keyframes
            .iter_mut()
            .take(end)
            .skip(begin)
            .filter(|keyframe| keyframe.shown.is_none())
        {
            keyframe.sent = Some(picture.sent_at);
            keyframe.shown = Some(picture.shown_at);
        }
    }
}

/// Durations from mid-exposure to each stage, over these keyframes. If stamps are on another clock,
/// the durations begin with the arrival of the image.
pub fn latencies(keyframes: &[KeyframeTimes]) -> Vec<(String, Latency)> {
    stages(keyframes, &[])
}

/// [`latencies`] without the durations that overlap a pause.
fn stages(
    keyframes: &[KeyframeTimes],
    pauses: &[(Instant, Option<Instant>)],
) -> Vec<(String, Latency)> {
    let until = |name: &str, at: fn(&KeyframeTimes) -> Option<Instant>| {
        Some((name.to_owned(), latency_until(keyframes, at, pauses)?))
    };
    let stages = [
        // If the time of capture is not known, the duration would begin and end with the arrival.
        until("shutter to arrival", |keyframe| {
            keyframe.input.captured.and(Some(keyframe.input.arrived))
        }),
        until("shutter to keyframe", |keyframe| {
            Some(keyframe.input.queued)
        }),
        until("shutter to model", |keyframe| Some(keyframe.pushed)),
        until("shutter to first step", |keyframe| keyframe.trained),
        until("shutter to sent", |keyframe| keyframe.sent),
        until("shutter to shown", |keyframe| keyframe.shown),
    ];
    stages.into_iter().flatten().collect()
}

/// Durations from mid-exposure to a stage; `None` if no keyframe has reached it.
fn latency_until(
    keyframes: &[KeyframeTimes],
    at: fn(&KeyframeTimes) -> Option<Instant>,
    pauses: &[(Instant, Option<Instant>)],
) -> Option<Latency> {
    let millis = keyframes.iter().filter_map(|keyframe| {
        let end = at(keyframe)?;
        let is_paused = pauses
            .iter()
            .any(|(from, to)| *from < end && to.is_none_or(|to| keyframe.captured_at() < to));
        keyframe.millis_until(end).filter(|_| !is_paused)
    });
    Latency::of(millis)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn keyframe(pushed_at_step: u64) -> KeyframeTimes {
        let now = Instant::now();
        KeyframeTimes {
            camera: "wrist".into(),
            stamp: Stamp(0),
            input: InputTimes {
                captured: Some(now),
                arrived: now,
                queued: now,
            },
            pushed: now,
            pushed_at_steps: vec![pushed_at_step, 0],
            trained: None,
            sent: None,
            shown: None,
        }
    }

    #[test]
    fn keyframes_are_trained_by_the_first_step_after_their_push() {
        let mut ledger = Ledger::default();
        let trained = |ledger: &Ledger| {
            ledger
                .keyframes()
                .iter()
                .map(|keyframe| keyframe.trained.is_some())
                .collect::<Vec<_>>()
        };
        ledger.push(keyframe(0));
        ledger.completed(0);
        assert_eq!(trained(&ledger), [false]);
        ledger.completed(5);
        ledger.push(keyframe(5));
        ledger.completed(5);
        assert_eq!(trained(&ledger), [true, false]);
        assert_eq!(
            [0, 1, 5, 6].map(|step| ledger.n_in_model(0, step)),
            [0, 1, 1, 2]
        );
        let first = ledger.keyframes()[0].trained;
        ledger.completed(6);
        assert_eq!(trained(&ledger), [true, true]);
        assert_eq!(ledger.keyframes()[0].trained, first);
    }

    #[test]
    fn first_shown_picture_with_a_keyframe_counts() {
        let mut ledger = Ledger::default();
        (0..4).for_each(|n| ledger.push(keyframe(5 * n)));
        let newest = |trained: TrainedKeyframes| {
            (trained.n, trained.newest.map(|keyframe| keyframe.added_at))
        };
        let pushed = |ix: usize| Some(ledger.keyframes()[ix].pushed);
        assert_eq!(newest(ledger.trained_keyframes(0, 0)), (0, None));
        assert_eq!(newest(ledger.trained_keyframes(0, 6)), (2, pushed(1)));
        assert_eq!(
            newest(ledger.trained_keyframes(1, 6)),
            (4, pushed(3)),
            "the second model"
        );
        let captured = ledger.keyframes()[0].captured_at();
        let at = |millis| captured + Duration::from_millis(millis);
        let reversed = std::ops::Range { start: 2, end: 1 }; // A picture that was drawn before the previous one.
        for (new_keyframes, sent, shown) in [
            (0..0, 10, 15),
            (1..2, 30, 45),
            (1..3, 40, 60),
            (3..99, 50, 70),
            (reversed, 1, 1),
        ] {
            let (sent_at, shown_at) = (at(sent), at(shown));
            ledger.shown(&ShownPicture {
                method: None,
                new_keyframes,
                sent_at,
                shown_at,
            });
        }
        let times: Vec<_> = ledger
            .keyframes()
            .iter()
            .map(|keyframe| keyframe.sent.zip(keyframe.shown))
            .collect();
        let expected = [
            None,
            Some((at(30), at(45))),
            Some((at(40), at(60))),
            Some((at(50), at(70))),
        ];
        assert_eq!(
            times, expected,
            "the first was already known when the client connected"
        );
    }

    #[test]
    fn durations_during_a_pause_are_left_out() {
        let mut ledger = Ledger::default();
        let began = Instant::now();
        let at = |millis| began + Duration::from_millis(millis);
        // Before, during and after the pause from 100 to 900 ms.
        for captured in [10, 200, 1000] {
            ledger.push(KeyframeTimes {
                input: InputTimes {
                    captured: Some(at(captured)),
                    arrived: at(captured + 5),
                    queued: at(captured + 6),
                },
                pushed: at(captured + 7),
                trained: Some(at(captured.max(893) + 7)),
                ..keyframe(0)
            });
        }
        let n_of = |ledger: &Ledger, name: &str| {
            let latencies = ledger.latencies();
            let found = latencies.iter().find(|(stage, _)| stage == name);
            found.map(|(_, latency)| latency.n)
        };
        assert_eq!(n_of(&ledger, "shutter to first step"), Some(3));
        for (is_paused, millis) in [
            (false, 50),
            (true, 100),
            (true, 300),
            (false, 900),
            (false, 950),
        ] {
            ledger.set_paused(is_paused, at(millis));
        }
        assert_eq!(n_of(&ledger, "shutter to first step"), Some(1));
        assert_eq!(n_of(&ledger, "shutter to model"), Some(2));
        ledger.set_paused(true, at(1001));
        assert_eq!(
            n_of(&ledger, "shutter to model"),
            Some(1),
            "the pause has not ended"
        );
    }

    #[test]
    fn latencies_start_at_mid_exposure_or_at_arrival() {
        let timed = |captured: Option<u64>| {
            let began = Instant::now();
            let at = |millis| began + Duration::from_millis(millis);
            let input = InputTimes {
                captured: captured.map(at),
                arrived: at(10),
                queued: at(14),
            };
            KeyframeTimes {
                input,
                pushed: at(20),
                shown: Some(at(50)),
                ..keyframe(0)
            }
        };
        let rounded = |keyframes: &[KeyframeTimes]| -> Vec<(String, f64)> {
            latencies(keyframes)
                .into_iter()
                .map(|(name, latency)| (name, latency.p50.round()))
                .collect()
        };
        let named = |pairs: &[(&str, f64)]| -> Vec<(String, f64)> {
            pairs
                .iter()
                .map(|(name, millis)| (format!("shutter to {name}"), *millis))
                .collect()
        };
        let on_clock = [
            ("arrival", 10.0),
            ("keyframe", 14.0),
            ("model", 20.0),
            ("shown", 50.0),
        ];
        assert_eq!(rounded(&[timed(Some(0))]), named(&on_clock));
        assert_eq!(
            rounded(&[timed(None)]),
            named(&[("keyframe", 4.0), ("model", 10.0), ("shown", 40.0)])
        );
    }
}
