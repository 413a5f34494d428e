//! One or two sentences for the operator of a live run: what it does, and what to do about lost or
//! useless images.

use crate::run_state::RunState;
use capture::{Rejection, StoreUse};
use std::collections::BTreeMap;
use viz::Advice;

/// Minimum number of images in the recent past that advice is based on. Fewer images may all have
/// the same problem by chance.
const MIN_IMAGES: u64 = 8;
/// Waiting for the first image for longer than this is a problem. Cameras take up to some seconds
/// to start.
const MAX_WAIT_SECS: f64 = 10.0;
/// Maximum difference between a share and the simple fraction, such as 7 of 8, by which it is
/// described.
const MAX_SHARE_ERROR: f64 = 0.01;
/// The same if no fraction with a denominator of at most 10 is that close. Tenths are always this
/// close.
const MAX_ROUGH_ERROR: f64 = 0.05;
/// Larger shares than this are not expressed as a fraction with a denominator of at most 10.
const NEARLY_ALL: f64 = 0.95;

/// Advice for images that are rejected for the same reason, by reason.
const REMEDIES: [(&[Rejection], &str); 7] = [
    (
        &[Rejection::NoPose, Rejection::QueueFull],
        "Most images have no robot pose: check that joint states and base poses arrive, and their clocks",
    ),
    (
        &[Rejection::PoseNotFinite],
        "The poses of most images are not numbers: check the source of the base poses",
    ),
    (
        &[Rejection::Blur, Rejection::Shear],
        "Most images are blurred by motion: move more slowly, or shorten the exposure",
    ),
    (
        &[Rejection::ShearUnknown],
        "Most images are taken at an unknown velocity: check that joint states arrive without gaps",
    ),
    (
        &[Rejection::Exposure],
        "Most images are too dark or too bright: change the light or the exposure",
    ),
    (
        &[Rejection::NotSharp],
        "Most images are not sharp: clean the lens, or move more slowly",
    ),
    (
        &[Rejection::Undecodable, Rejection::UnknownCamera],
        "Most images cannot be used: check the cameras with fieldrig doctor",
    ),
];

/// What happened to the color images of some time.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct ImageFlow {
    /// Images that arrived.
    pub(crate) received: u64,
    /// Images dropped before they arrived.
    pub(crate) dropped: u64,
    /// Images that became keyframes.
    pub(crate) accepted: u64,
    /// Images that did not, by [`Rejection::name`].
    pub(crate) rejected: BTreeMap<String, u64>,
}

/// What the advice depends on.
#[derive(Clone, Debug)]
pub(crate) struct Situation {
    /// What the run does.
    pub(crate) state: RunState,
    /// Whether the devices will send nothing more.
    pub(crate) has_input_ended: bool,
    /// Time since the start of the run, seconds.
    pub(crate) run_secs: f64,
    /// What happened to the images of the last seconds.
    pub(crate) recent: ImageFlow,
    /// The store of keyframes.
    pub(crate) store: StoreUse,
    /// Number of keyframes with which training starts.
    pub(crate) start_keyframes: usize,
    /// Number of the client that has paused training.
    pub(crate) paused_by: Option<u64>,
}

/// The advice for a situation. Problems come first, the most costly one before the others.
#[must_use]
pub(crate) fn advise(situation: &Situation) -> Advice {
    let state = state_text(situation);
    let warning = |text: String| Advice {
        text,
        is_warning: true,
    };
    let info = |text: String| Advice {
        text,
        is_warning: false,
    };
    let is_scanning = match situation.state {
        RunState::Waiting if situation.run_secs > MAX_WAIT_SECS => {
            return warning(format!(
                "{state}. None has come so far: check the cameras with fieldrig doctor"
            ));
        }
        // While training is paused, keyframes are still accepted, so losses matter.
        RunState::Collecting | RunState::Training | RunState::Paused => !situation.has_input_ended,
        RunState::Waiting | RunState::Finished => false,
    };
    if !is_scanning {
        return info(state);
    }
    match problem(&situation.recent) {
        Some(problem) => warning(format!("{state}. {problem}")),
        None => match hint(situation) {
            Some(hint) => info(format!("{state}. {hint}")),
            None => info(state),
        },
    }
}

/// What the run does, without a period.
fn state_text(situation: &Situation) -> String {
    match situation.state {
        RunState::Waiting => "Waiting for images".to_owned(),
        RunState::Collecting => format!(
            "Collecting keyframes, {} of {}",
            situation.store.keyframes, situation.start_keyframes
        ),
        RunState::Training if situation.has_input_ended => {
            "Training on the data so far, because the input has ended".to_owned()
        }
        RunState::Training => "Scanning".to_owned(),
        RunState::Paused => {
            let by = situation
                .paused_by
                .map_or(String::new(), |client| format!(" by client {client}"));
            let keyframes = if situation.has_input_ended {
                "the input has ended"
            } else {
                "keyframes are still taken"
            };
            format!("Paused{by}, {keyframes}")
        }
        RunState::Finished => {
            "All data are in the model: end the run in the terminal to save it".to_owned()
        }
    }
}

/// Why most of the recent images are of no use, and what to do.
pub(crate) fn problem(recent: &ImageFlow) -> Option<String> {
    let n_sent = recent.received + recent.dropped;
    // Smaller losses are common on slow computers and are no problem: see `hint`.
    if n_sent >= MIN_IMAGES && 2 * recent.dropped >= n_sent {
        let share = share_text(recent.dropped, n_sent);
        return Some(format!("{share} lost: lower rate_hz of the cameras"));
    }
    let n_rejected = |reasons: &[Rejection]| -> u64 {
        let counts = reasons.iter().map(|why| recent.rejected.get(why.name()));
        counts.flatten().sum()
    };
    let is_common = |reasons: &[Rejection]| 2 * n_rejected(reasons) >= recent.received;
    let found = REMEDIES.iter().find(|(reasons, _)| is_common(reasons));
    found
        .filter(|_| recent.received >= MIN_IMAGES)
        .map(|(_, remedy)| (*remedy).to_owned())
}

/// What the operator may want to know although nothing is wrong.
fn hint(situation: &Situation) -> Option<String> {
    let Situation { recent, store, .. } = situation;
    let n_not_moved = recent.rejected.get(Rejection::NotMoved.name());
    let is_still = n_not_moved.is_some_and(|n| 2 * n >= recent.received);
    if recent.received >= MIN_IMAGES && recent.accepted == 0 && is_still {
        return Some(
            "The cameras see nothing new: move them to places that they have not seen".to_owned(),
        );
    }
    let n_sent = recent.received + recent.dropped;
    if n_sent >= MIN_IMAGES && 4 * recent.dropped >= n_sent {
        let share = share_text(recent.dropped, n_sent);
        return Some(format!("{share} dropped, and the next ones replace them"));
    }
    store.is_full().then(|| {
        format!(
            "The store is full with {} keyframes: new ones replace similar ones",
            store.keyframes
        )
    })
}

/// A share of images in small numbers, such as `7 of 8 images`.
#[expect(
    clippy::cast_precision_loss,
    reason = "counts of images are far below 2^53"
)]
fn share_text(n: u64, n_all: u64) -> String {
    if n >= n_all {
        return "All images are".to_owned();
    }
    let share = n as f64 / n_all as f64;
    if share > NEARLY_ALL {
        return "More than 9 of 10 images are".to_owned();
    }
    let fraction = |denominator: u32| {
        let numerator = (share * f64::from(denominator))
            .round()
            .min(f64::from(denominator - 1));
        let error = (numerator / f64::from(denominator) - share).abs();
        (numerator, error)
    };
    // The simplest of the fractions that are close, or else of those that are at most half a tenth
    // away.
    let simplest = |max_error: f64| (2..=10).find(|n_parts| fraction(*n_parts).1 <= max_error);
    let denominator = simplest(MAX_SHARE_ERROR)
        .or_else(|| simplest(MAX_ROUGH_ERROR))
        .unwrap_or(10);
    format!("{} of {denominator} images are", fraction(denominator).0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow(received: u64, dropped: u64, rejected: &[(Rejection, u64)]) -> ImageFlow {
        let rejected = rejected.iter().map(|(why, n)| (why.name().to_owned(), *n));
        let rejected: BTreeMap<String, u64> = rejected.collect();
        ImageFlow {
            received,
            dropped,
            accepted: received - rejected.values().sum::<u64>(),
            rejected,
        }
    }

    fn situation(state: RunState, recent: ImageFlow) -> Situation {
        Situation {
            state,
            has_input_ended: false,
            run_secs: 3.0,
            recent,
            store: StoreUse {
                keyframes: 30,
                max_keyframes: 400,
                max_bytes: 1,
                ..StoreUse::default()
            },
            start_keyframes: 12,
            paused_by: None,
        }
    }

    #[test]
    fn advice_names_the_costliest_problem_of_the_recent_images() {
        let cases = [
            (flow(20, 0, &[]), "Scanning", false),
            (
                flow(2653, 18343, &[]),
                "Scanning. 7 of 8 images are lost: lower rate_hz of the cameras",
                true,
            ),
            (
                flow(10, 10, &[(Rejection::Blur, 10)]),
                "Scanning. 1 of 2 images are lost: lower rate_hz of the cameras",
                true,
            ),
            (
                flow(0, 9, &[]),
                "Scanning. All images are lost: lower rate_hz of the cameras",
                true,
            ),
            (flow(1, 6, &[]), "Scanning", false),
            (flow(20, 5, &[]), "Scanning", false),
            (
                flow(12, 8, &[]),
                "Scanning. 2 of 5 images are dropped, and the next ones replace them",
                false,
            ),
            (
                flow(10, 0, &[(Rejection::Blur, 3), (Rejection::Shear, 2)]),
                "Scanning. Most images are blurred by motion: move more slowly, or shorten the exposure",
                true,
            ),
            (flow(10, 0, &[(Rejection::Blur, 4)]), "Scanning", false),
            (
                flow(40, 0, &[(Rejection::NoPose, 39)]),
                "Scanning. Most images have no robot pose: check that joint states and base poses arrive, and their clocks",
                true,
            ),
            (
                flow(40, 0, &[(Rejection::NotMoved, 40)]),
                "Scanning. The cameras see nothing new: move them to places that they have not seen",
                false,
            ),
            (flow(40, 0, &[(Rejection::NotMoved, 39)]), "Scanning", false),
        ];
        for (recent, text, is_warning) in cases {
            let advice = advise(&situation(RunState::Training, recent.clone()));
            assert_eq!(
                (&*advice.text, advice.is_warning),
                (text, is_warning),
                "{recent:?}"
            );
        }
    }

    #[test]
    fn every_state_has_a_sentence() {
        let lossy = flow(1, 9, &[]);
        let cases = [
            (RunState::Waiting, "Waiting for images"),
            (
                RunState::Collecting,
                "Collecting keyframes, 30 of 12. 9 of 10 images are lost: lower rate_hz of the cameras",
            ),
            (
                RunState::Paused,
                "Paused, keyframes are still taken. 9 of 10 images are lost: lower rate_hz of the cameras",
            ),
            (
                RunState::Finished,
                "All data are in the model: end the run in the terminal to save it",
            ),
        ];
        for (state, text) in cases {
            assert_eq!(advise(&situation(state, lossy.clone())).text, text);
        }
        let paused = Situation {
            paused_by: Some(3),
            ..situation(RunState::Paused, ImageFlow::default())
        };
        assert_eq!(
            advise(&paused).text,
            "Paused by client 3, keyframes are still taken"
        );
        let paused_at_end = Situation {
            has_input_ended: true,
            ..situation(RunState::Paused, lossy.clone())
        };
        assert_eq!(advise(&paused_at_end).text, "Paused, the input has ended");
        let ended = Situation {
            has_input_ended: true,
            ..situation(RunState::Training, lossy)
        };
        assert!(!advise(&ended).is_warning, "nothing more can be lost");
        let waiting = Situation {
            run_secs: 11.0,
            ..situation(RunState::Waiting, ImageFlow::default())
        };
        assert!(advise(&waiting).is_warning);
    }

    #[test]
    fn a_full_store_is_mentioned_but_is_no_problem() {
        let mut full = situation(RunState::Training, flow(20, 0, &[]));
        full.store.keyframes = 400;
        let advice = advise(&full);
        assert_eq!(
            (&*advice.text, advice.is_warning),
            (
                "Scanning. The store is full with 400 keyframes: new ones replace similar ones",
                false
            )
        );
    }

    #[test]
    fn shares_are_small_fractions() {
        for (n, n_all, text) in [
            (1, 2, "1 of 2 images are"),
            (667, 1000, "2 of 3 images are"),
            (745, 1000, "3 of 4 images are"),
            (48, 100, "1 of 2 images are"),
            (94, 100, "9 of 10 images are"),
            (95, 100, "9 of 10 images are"),
            (999, 1000, "More than 9 of 10 images are"),
            (5, 5, "All images are"),
        ] {
            assert_eq!(share_text(n, n_all), text);
        }
    }
}
