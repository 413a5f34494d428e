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
/// If at least this share of the recent images is lost, or is rejected for the same reason, this is
/// a problem.
const PROBLEM_SHARE: f64 = 1.0 / 2.0;
/// Smaller losses are common on slow computers and are no problem. From this share on, they are
/// mentioned.
const MENTIONED_SHARE: f64 = 1.0 / 4.0;
/// A finding is shown until its share of the images is below this part of the share at which it is
/// first shown. With a single limit, it would appear and disappear while the share varies around
/// the limit.
const KEPT_PART: f64 = 2.0 / 3.0;
/// The share in a shown text is updated if it has changed by more than this.
const MIN_SHARE_CHANGE: f64 = 0.15;
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

/// A common property of recent images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Finding {
    /// Many images did not arrive. This is a problem.
    Lost,
    /// Images were rejected for the reasons in this entry of [`REMEDIES`].
    Rejected(usize),
    /// Some images did not arrive.
    Dropped,
}

/// Advises the operator. It remembers the shown finding, so that the advice does not appear and
/// disappear while the images vary.
#[derive(Debug, Default)]
pub(crate) struct Advisor {
    /// The shown finding, and the share of the images in its text.
    shown: Option<(Finding, f64)>,
}

impl Advisor {
    /// The advice for a situation. Problems come first, the most costly one before the others.
    pub(crate) fn advise(&mut self, situation: &Situation) -> Advice {
        let state = state_text(situation);
        let is_scanning = match situation.state {
            // While training is paused, keyframes are still accepted, so losses matter.
            RunState::Collecting | RunState::Training | RunState::Paused => {
                !situation.has_input_ended
            }
            RunState::Waiting | RunState::Finished => false,
        };
        self.shown = finding(&situation.recent, self.shown).filter(|_| is_scanning);
        let is_late = situation.state == RunState::Waiting && situation.run_secs > MAX_WAIT_SECS;
        let problem = self
            .shown
            .and_then(|(finding, share)| remedy(finding, share));
        let (more, is_warning) = match problem {
            _ if is_late => {
                let text = "None has come so far: check the cameras with fieldrig doctor";
                (Some(text.to_owned()), true)
            }
            Some(problem) => (Some(problem), true),
            None if is_scanning => (self.hint(situation), false),
            None => (None, false),
        };
        Advice {
            text: more.map_or_else(|| state.clone(), |more| format!("{state}. {more}")),
            is_warning,
        }
    }

    /// Information for the operator when there is no problem.
    fn hint(&self, situation: &Situation) -> Option<String> {
        let Situation { recent, store, .. } = situation;
        let n_not_moved = recent.rejected.get(Rejection::NotMoved.name());
        let is_still = n_not_moved.is_some_and(|n| 2 * n >= recent.received);
        if recent.received >= MIN_IMAGES && recent.accepted == 0 && is_still {
            let text = "The cameras see nothing new: move them to places that they have not seen";
            return Some(text.to_owned());
        }
        if let Some((Finding::Dropped, share)) = self.shown {
            let share = share_text(share);
            return Some(format!("{share} dropped, and the next ones replace them"));
        }
        store.is_full().then(|| {
            format!(
                "The store is full with {} keyframes: new ones replace similar ones",
                store.keyframes
            )
        })
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

/// Why most of the images are of no use, and what to do.
pub(crate) fn problem(images: &ImageFlow) -> Option<String> {
    let (finding, share) = finding(images, None)?;
    remedy(finding, share)
}

/// The most costly problem of the recent images, or else whether images were dropped, and the share
/// of the images that is shown.
///
/// * `shown`: the previous result. It is kept while the images are similar.
#[expect(
    clippy::cast_precision_loss,
    reason = "counts of images are far below 2^53"
)]
fn finding(recent: &ImageFlow, shown: Option<(Finding, f64)>) -> Option<(Finding, f64)> {
    let n_sent = recent.received + recent.dropped;
    let n_rejected = |reasons: &[Rejection]| -> u64 {
        let counts = reasons.iter().map(|why| recent.rejected.get(why.name()));
        counts.flatten().sum()
    };
    let rejected = (REMEDIES.iter().enumerate())
        .map(|(ix, (reasons, _))| (Finding::Rejected(ix), n_rejected(reasons), recent.received));
    let candidates = std::iter::once((Finding::Lost, recent.dropped, n_sent))
        .chain(rejected)
        .chain([(Finding::Dropped, recent.dropped, n_sent)]);
    let mut enough = candidates.filter(|(.., n_all)| *n_all >= MIN_IMAGES);
    enough.find_map(|(finding, n, n_all)| {
        let share = n as f64 / n_all as f64;
        let shown_share = shown
            .filter(|shown| shown.0 == finding)
            .map(|shown| shown.1);
        let begin = match finding {
            Finding::Lost | Finding::Rejected(_) => PROBLEM_SHARE,
            Finding::Dropped => MENTIONED_SHARE,
        };
        let min_share = shown_share.map_or(begin, |_| KEPT_PART * begin);
        let is_similar = |shown: &f64| (shown - share).abs() <= MIN_SHARE_CHANGE;
        (share >= min_share).then(|| (finding, shown_share.filter(is_similar).unwrap_or(share)))
    })
}

/// Why images are of no use, and what to do. `None` if nothing has to be done.
fn remedy(finding: Finding, share: f64) -> Option<String> {
    match finding {
        Finding::Lost => {
            let share = share_text(share);
            Some(format!("{share} lost: lower rate_hz of the cameras"))
        }
        Finding::Rejected(ix) => Some(REMEDIES[ix].1.to_owned()),
        Finding::Dropped => None,
    }
}

/// A share of images in small numbers, such as `7 of 8 images`.
fn share_text(share: f64) -> String {
    if share >= 1.0 {
        return "All images are".to_owned();
    }
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

    fn advise(situation: &Situation) -> Advice {
        Advisor::default().advise(situation)
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
    fn advice_stays_while_the_images_vary_around_its_limit() {
        let mut advisor = Advisor::default();
        let mut text_of = |n_lost: u64| {
            let recent = flow(100 - n_lost, n_lost, &[]);
            advisor.advise(&situation(RunState::Training, recent)).text
        };
        let lost = |share: &str| {
            format!("Scanning. {share} images are lost: lower rate_hz of the cameras")
        };
        assert_eq!(text_of(52), lost("1 of 2"));
        for n_lost in [48, 60, 40, 64, 50] {
            assert_eq!(text_of(n_lost), lost("1 of 2"), "with {n_lost} of 100");
        }
        assert_eq!(text_of(75), lost("3 of 4"), "a change that matters");
        let dropped = "Scanning. 1 of 3 images are dropped, and the next ones replace them";
        for n_lost in [33, 45, 20] {
            assert_eq!(text_of(n_lost), dropped, "with {n_lost} of 100");
        }
        assert_eq!(text_of(15), "Scanning");
        assert_eq!(text_of(20), "Scanning", "it must begin anew");
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
        for (share, text) in [
            (0.5, "1 of 2 images are"),
            (0.667, "2 of 3 images are"),
            (0.745, "3 of 4 images are"),
            (0.48, "1 of 2 images are"),
            (0.94, "9 of 10 images are"),
            (0.95, "9 of 10 images are"),
            (0.999, "More than 9 of 10 images are"),
            (1.0, "All images are"),
        ] {
            assert_eq!(share_text(share), text);
        }
    }
}
