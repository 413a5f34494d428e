//! When pictures are sent to clients and shown by them.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum number of sent pictures per view and model of which a client can still report when they
/// were shown. Only a few pictures are in transit at a time. Other unreported pictures were dropped
/// by the client.
const MAX_UNREPORTED: usize = 16;
/// Maximum number of pairs of a view and a model per client. Beyond it, the pair whose last picture
/// was sent longest ago is dropped.
const MAX_STREAMS: usize = 8;
/// Maximum time for which a client counts as waiting for new keyframes. Pictures that a client has
/// not reported are attributed to the next picture that it reports. If the wait for their keyframes
/// began longer ago than this, these keyframes are ignored, because the page was probably hidden.
const MAX_WAIT: Duration = Duration::from_secs(10);
/// Maximum number of shown pictures that wait for the run. Beyond it, the oldest are dropped. A
/// command that does not measure latency never takes them.
const MAX_SHOWN: usize = 1024;

/// The keyframes on which a model had been trained when a picture was drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrainedKeyframes {
    /// Number of these keyframes, counted from the start of the run.
    pub n: u64,
    /// The last of these keyframes; `None` if there are none.
    pub newest: Option<NewestKeyframe>,
}

/// The keyframe that was added last to a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NewestKeyframe {
    /// Mid-exposure of its image. If the stamp is on another clock, this is the time of arrival.
    pub captured_at: Instant,
    /// When it was added to the model.
    pub added_at: Instant,
}

/// A complete picture of a model in training that a client has shown.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShownPicture {
    /// Requested model; the first model if `None`.
    pub method: Option<String>,
    /// The keyframes that the client had not shown in this view of this model before, counted from
    /// the start of the run. Keyframes of pictures that the client has not reported belong to the
    /// next picture that it reports, unless the client has not waited for them (see `MAX_WAIT`).
    pub new_keyframes: Range<u64>,
    /// When the server began to send it.
    pub sent_at: Instant,
    /// When the client showed it, as reported by the client, but not before `sent_at` and not after
    /// its report.
    pub shown_at: Instant,
}

/// A picture with color that was sent to a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SentPicture {
    pub(crate) id: u64,
    pub(crate) view: Arc<str>,
    pub(crate) method: Option<String>,
    pub(crate) n_keyframes: u64,
    pub(crate) sent_at: Instant,
}

/// A picture that its client has not reported as shown.
#[derive(Debug)]
struct Unreported {
    picture: SentPicture,
    new_keyframes: Range<u64>,
    /// When the previous picture was sent, which did not contain the new keyframes.
    waits_since: Instant,
}

/// The pictures of a model in a view.
#[derive(Debug)]
struct Stream {
    view: Arc<str>,
    method: Option<String>,
    /// Largest number of keyframes of all pictures.
    n_keyframes: u64,
    last_sent_at: Instant,
    /// Oldest first.
    pictures: VecDeque<Unreported>,
}

/// Pictures that were sent to one client and that it has not reported as shown. The stream of the
/// picture that was sent last is at the end.
#[derive(Debug, Default)]
pub(crate) struct UnreportedPictures(VecDeque<Stream>);

impl UnreportedPictures {
    /// Adds a picture that is about to be sent. The first picture of a model in a view has no new
    /// keyframes: the client did not wait for them.
    pub(crate) fn sent(&mut self, picture: SentPicture) {
        // There are at most `MAX_STREAMS` entries, so searching is cheaper than a separate map.
        let found = self
            .0
            .iter()
            .position(|stream| stream.view == picture.view && stream.method == picture.method);
        let mut stream = found
            .and_then(|ix| self.0.remove(ix))
            .unwrap_or_else(|| Stream::before(&picture));
        stream.push(picture);
        if self.0.len() == MAX_STREAMS {
            self.0.pop_front();
        }
        self.0.push_back(stream);
    }

    /// Removes a picture that its client has shown. `None` if the picture is unknown or was
    /// reported before.
    pub(crate) fn shown(&mut self, id: u64, view: &str, shown_at: Instant) -> Option<ShownPicture> {
        let mut streams = self.0.iter_mut().filter(|stream| *stream.view == *view);
        let (picture, new_keyframes) = streams.find_map(|stream| stream.take(id))?;
        // The time comes from the client, whose estimate of the server's clock may be wrong.
        let shown_at = shown_at.min(Instant::now()).max(picture.sent_at);
        Some(ShownPicture {
            method: picture.method,
            new_keyframes,
            sent_at: picture.sent_at,
            shown_at,
        })
    }
}

impl Stream {
    /// The stream that begins with a picture.
    fn before(picture: &SentPicture) -> Self {
        Self {
            view: Arc::clone(&picture.view),
            method: picture.method.clone(),
            n_keyframes: picture.n_keyframes,
            last_sent_at: picture.sent_at,
            pictures: VecDeque::new(),
        }
    }

    fn push(&mut self, picture: SentPicture) {
        // Empty if the picture was drawn earlier than the last one, with fewer keyframes.
        let new_keyframes = self.n_keyframes..picture.n_keyframes;
        let waits_since = std::mem::replace(&mut self.last_sent_at, picture.sent_at);
        self.n_keyframes = self.n_keyframes.max(picture.n_keyframes);
        if self.pictures.len() == MAX_UNREPORTED {
            self.pictures.pop_front();
        }
        self.pictures.push_back(Unreported {
            picture,
            new_keyframes,
            waits_since,
        });
    }

    /// Removes a picture and the pictures that were sent before it. The new keyframes of these
    /// earlier pictures are added to the new keyframes of the picture.
    fn take(&mut self, id: u64) -> Option<(SentPicture, Range<u64>)> {
        // The search begins at the end, because a client may use a number again.
        let ix = self
            .pictures
            .iter()
            .rposition(|unreported| unreported.picture.id == id)?;
        let older: Vec<Unreported> = self.pictures.drain(..ix).collect();
        let Unreported {
            picture,
            new_keyframes,
            ..
        } = self.pictures.pop_front()?;
        // The client has dropped the older pictures for newer ones, so its operator saw their
        // keyframes only now. If the page was hidden for a long time, nobody waited for these
        // keyframes.
        let waited = older
            .iter()
            .filter(|old| picture.sent_at - old.waits_since <= MAX_WAIT);
        let start = waited
            .map(|old| old.new_keyframes.start)
            .fold(new_keyframes.start, u64::min);
        Some((picture, start..new_keyframes.end))
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
    use super::{
        MAX_STREAMS, MAX_UNREPORTED, MAX_WAIT, SentPicture, ShownPicture, UnreportedPictures,
    };
    use std::time::{Duration, Instant};

    fn picture(id: u64, view: &str, n_keyframes: u64, sent_at: Instant) -> SentPicture {
        SentPicture {
            id,
            view: view.into(),
            method: None,
            n_keyframes,
            sent_at,
        }
    }

    #[test]
    fn pictures_are_reported_once_between_sending_and_now() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        (1..=3).for_each(|id| unreported.sent(picture(id, "", 10 + id, sent_at)));
        unreported.sent(picture(3, "inset", 20, sent_at));
        unreported.sent(picture(4, "inset", 21, sent_at));
        assert_eq!(
            unreported.shown(4, "", sent_at),
            None,
            "this picture was not sent"
        );
        assert_eq!(
            unreported.shown(2, "inset", sent_at),
            None,
            "nor was this one"
        );
        let early = sent_at
            .checked_sub(Duration::from_millis(1))
            .expect("the machine has run for longer");
        assert_eq!(
            unreported.shown(2, "", early).map(|shown| shown.shown_at),
            Some(sent_at)
        );
        let late = Instant::now() + Duration::from_secs(60);
        assert!(
            unreported
                .shown(3, "", late)
                .is_some_and(|shown| shown.shown_at < late && shown.shown_at >= sent_at)
        );
        let shown = unreported.shown(4, "inset", sent_at);
        assert_eq!(
            shown,
            Some(ShownPicture {
                method: None,
                new_keyframes: 20..21,
                sent_at,
                shown_at: sent_at
            })
        );
        assert_eq!(
            unreported.shown(4, "inset", sent_at),
            None,
            "it was reported before"
        );
    }

    #[test]
    fn keyframes_before_the_first_picture_of_a_model_are_not_new() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        let mut new_keyframes = |id: u64, method: Option<&str>, n_keyframes: u64| {
            unreported.sent(SentPicture {
                method: method.map(str::to_owned),
                ..picture(id, "", n_keyframes, sent_at)
            });
            unreported
                .shown(id, "", sent_at)
                .expect("it was sent")
                .new_keyframes
        };
        assert_eq!(new_keyframes(1, None, 500), 500..500);
        assert_eq!(new_keyframes(2, None, 503), 500..503);
        assert!(new_keyframes(3, None, 501).is_empty(), "drawn earlier");
        assert_eq!(new_keyframes(4, None, 504), 503..504);
        assert_eq!(new_keyframes(5, Some("tsdf"), 600), 600..600);
        assert_eq!(new_keyframes(6, Some("tsdf"), 601), 600..601);
    }

    #[test]
    fn pictures_of_other_views_take_no_keyframes() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        unreported.sent(picture(1, "", 5, sent_at));
        for (id, n_keyframes) in [(1, 6), (2, 8)] {
            unreported.sent(picture(id, "surroundings", n_keyframes, sent_at));
        }
        unreported.sent(picture(2, "", 9, sent_at));
        assert_eq!(
            unreported
                .shown(2, "", sent_at)
                .map(|shown| shown.new_keyframes),
            Some(5..9)
        );
    }

    #[test]
    fn keyframes_of_pictures_that_are_not_reported_belong_to_the_next_report() {
        let began = Instant::now();
        let mut unreported = UnreportedPictures::default();
        let mut send = |id: u64, n_keyframes: u64, secs: u64| {
            unreported.sent(picture(
                id,
                "",
                n_keyframes,
                began + Duration::from_secs(secs),
            ));
        };
        let away = 5 + MAX_WAIT.as_secs();
        for (id, n_keyframes, secs) in [
            (1, 10, 0),
            (2, 12, 1),
            (3, 13, 2),
            (4, 90, away),
            (5, 91, away),
            (6, 95, away),
        ] {
            send(id, n_keyframes, secs);
        }
        assert_eq!(
            unreported
                .shown(3, "", began)
                .map(|shown| shown.new_keyframes),
            Some(10..13)
        );
        assert_eq!(
            unreported.shown(2, "", began),
            None,
            "its keyframes were reported"
        );
        // The client did not wait for the keyframes of the fourth picture.
        assert_eq!(
            unreported
                .shown(6, "", began)
                .map(|shown| shown.new_keyframes),
            Some(90..95)
        );
    }

    #[test]
    fn clients_that_report_nothing_use_little_memory() {
        let sent_at = Instant::now();
        let mut unreported = UnreportedPictures::default();
        (0..1000).for_each(|id| unreported.sent(picture(id, "", id, sent_at)));
        assert_eq!(unreported.0[0].pictures.len(), MAX_UNREPORTED);
        assert!(
            unreported.shown(999, "", sent_at).is_some()
                && unreported.shown(0, "", sent_at).is_none()
        );
        (0..100).for_each(|id| unreported.sent(picture(id, &id.to_string(), id, sent_at)));
        assert_eq!(unreported.0.len(), MAX_STREAMS);
    }
}
