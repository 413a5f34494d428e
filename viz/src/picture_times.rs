//! When pictures are sent to clients and shown by them.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

/// Maximum number of sent pictures per client of which it can still report when they were shown.
const MAX_UNREPORTED: usize = 16;
/// Maximum number of shown pictures that wait for the run; the oldest are dropped.
const MAX_SHOWN: usize = 1024;

/// The keyframes on which a model had been trained when a picture was drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrainedKeyframes {
    /// Their number, counted from the start of the run.
    pub n: u64,
    /// The last one of them; `None` if there are none.
    pub newest: Option<NewestKeyframe>,
}

/// The keyframe that was added last to a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NewestKeyframe {
    /// Mid-exposure of its image; the time of arrival if the stamp is on another clock.
    pub captured_at: Instant,
    /// When it was added to the model.
    pub added_at: Instant,
}

/// A complete picture of a model in training that a client has shown.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShownPicture {
    /// Requested model; the first if `None`.
    pub method: Option<String>,
    /// The keyframes that the client's previous picture of this model did not contain, counted from the start of the run.
    pub new_keyframes: Range<u64>,
    /// When the server began to send it.
    pub sent_at: Instant,
    /// When the client showed it, as reported by the client, but not before `sent_at` and not after its report.
    pub shown_at: Instant,
}

/// A picture that was sent to a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SentPicture {
    pub(crate) id: u64,
    pub(crate) view: Arc<str>,
    pub(crate) method: Option<String>,
    pub(crate) n_keyframes: u64,
    pub(crate) sent_at: Instant,
}

/// Pictures that were sent to one client and that it has not reported as shown.
#[derive(Debug, Default)]
pub(crate) struct UnreportedPictures {
    /// Each picture and its new keyframes, oldest first.
    pictures: VecDeque<(SentPicture, Range<u64>)>,
    /// Model and number of keyframes of the last picture.
    last: Option<(Option<String>, u64)>,
}

impl UnreportedPictures {
    /// Adds a picture that is about to be sent. The first picture of a model has no new keyframes: the client did not
    /// wait for them.
    pub(crate) fn sent(&mut self, picture: SentPicture) {
        let last = self.last.take().filter(|(method, _)| *method == picture.method);
        let n_before = last.map_or(picture.n_keyframes, |(_, n)| n);
        self.last = Some((picture.method.clone(), picture.n_keyframes.max(n_before)));
        if self.pictures.len() == MAX_UNREPORTED {
            self.pictures.pop_front();
        }
        let new_keyframes = n_before..picture.n_keyframes;
        self.pictures.push_back((picture, new_keyframes));
    }

    /// Removes a picture that its client has shown. `None` if the picture is unknown or was reported before.
    pub(crate) fn shown(&mut self, id: u64, view: &str, shown_at: Instant) -> Option<ShownPicture> {
        let ix = self.pictures.iter().position(|(picture, _)| picture.id == id && *picture.view == *view)?;
        let (SentPicture { method, sent_at, .. }, new_keyframes) = self.pictures.remove(ix)?;
        let shown_at = shown_at.min(Instant::now()).max(sent_at);
        Some(ShownPicture { method, new_keyframes, sent_at, shown_at })
    }
}

/// Shown pictures that the run has not taken yet, oldest first.
#[derive(Debug, Default)]
pub(crate) struct ShownPictures(VecDeque<ShownPicture>);

impl ShownPictures {
    pub(crate) fn push(&mut self, picture: ShownPicture) {
        if self.0.len() == MAX_SHOWN {
            self.0.pop_front();
        }
        self.0.push_back(picture);
    }

    pub(crate) fn take(&mut self) -> Vec<ShownPicture> {
        std::mem::take(&mut self.0).into()
    }
}

#[cfg(test)]
mod tests {
    use super::{MAX_UNREPORTED, SentPicture, ShownPicture, UnreportedPictures};
    use std::time::{Duration, Instant};

    fn picture(id: u64, view: &str, n_keyframes: u64, sent_at: Instant) -> SentPicture {
        SentPicture { id, view: view.into(), method: None, n_keyframes, sent_at }
    }

    #[test]
    fn pictures_are_reported_once_between_sending_and_now() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        (1..=3).for_each(|id| unreported.sent(picture(id, "", 10 + id, sent_at)));
        unreported.sent(picture(3, "inset", 20, sent_at));
        assert_eq!(unreported.shown(4, "", sent_at), None, "this picture was not sent");
        assert_eq!(unreported.shown(2, "inset", sent_at), None, "nor was this one");
        let early = sent_at.checked_sub(Duration::from_millis(1)).expect("the machine has run for longer");
        assert_eq!(unreported.shown(2, "", early).map(|shown| shown.shown_at), Some(sent_at));
        let late = Instant::now() + Duration::from_secs(60);
        assert!(unreported.shown(3, "", late).is_some_and(|shown| shown.shown_at < late && shown.shown_at >= sent_at));
        let shown = unreported.shown(3, "inset", sent_at);
        assert_eq!(shown, Some(ShownPicture { method: None, new_keyframes: 13..20, sent_at, shown_at: sent_at }));
        assert_eq!(unreported.shown(3, "inset", sent_at), None, "it was reported before");
    }

    #[test]
    fn keyframes_before_the_first_picture_of_a_model_are_not_new() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        let mut new_keyframes = |id: u64, method: Option<&str>, n_keyframes: u64| {
            unreported.sent(SentPicture { method: method.map(str::to_owned), ..picture(id, "", n_keyframes, sent_at) });
            unreported.shown(id, "", sent_at).expect("it was sent").new_keyframes
        };
        assert_eq!(new_keyframes(1, None, 500), 500..500);
        assert_eq!(new_keyframes(2, None, 503), 500..503);
        assert!(new_keyframes(3, None, 501).is_empty(), "drawn earlier");
        assert_eq!(new_keyframes(4, None, 504), 503..504);
        assert_eq!(new_keyframes(5, Some("tsdf"), 600), 600..600);
        assert_eq!(new_keyframes(6, Some("tsdf"), 601), 600..601);
    }

    #[test]
    fn clients_that_report_nothing_use_little_memory() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        (0..1000).for_each(|id| unreported.sent(picture(id, "", id, sent_at)));
        assert_eq!(unreported.pictures.len(), MAX_UNREPORTED);
        assert!(unreported.shown(999, "", sent_at).is_some() && unreported.shown(0, "", sent_at).is_none());
    }
}
