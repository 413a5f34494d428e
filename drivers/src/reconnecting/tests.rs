//! Tests of the reconnection state machine with a camera that fails and returns as scripted.

use super::*;
use crate::PixelFormat;
use std::collections::VecDeque;
use std::sync::Arc;

const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// A wait that is shorter than [`RETRY_PAUSE`], so it ends before the next attempt.
const BRIEFLY: Duration = Duration::from_millis(10);
/// Limit of an outage that is never reached. The next limit is reached at the first failed attempt.
const UNLIMITED: Duration = Duration::from_secs(3600);
const ONE_ATTEMPT: Duration = Duration::ZERO;

/// Action of the camera at the next call.
#[derive(Debug)]
enum Step {
    /// Opening succeeds. The mode of the camera is described if it streams at once.
    Opens(Option<&'static str>),
    /// Opening fails.
    Refuses(&'static str),
    /// Opening fails in a way that no further attempt can change.
    Unsupported,
    /// A reset replaces an attempt to open the camera.
    Resets,
    /// Opening completes later.
    Streams(&'static str),
    /// The camera delivers an image stamped at this number of periods, after skipping some images.
    Color(i64, u64),
    Depth(i64),
    /// The camera sends nothing until the deadline.
    Quiet,
    /// The camera is disconnected.
    Lost(&'static str),
    /// The file that replaces the camera ends.
    Ends,
}
use Step::{Color, Depth, Ends, Lost, Opens, Quiet, Refuses, Resets, Streams, Unsupported};

#[derive(Debug)]
struct Scripted {
    steps: VecDeque<Step>,
    opened_at: Vec<Instant>,
    /// Number of open streams.
    n_open: Arc<()>,
}

#[derive(Debug)]
struct ScriptedStream {
    mode: Option<&'static str>,
    _open: Arc<()>,
}

impl ReopenableCamera for Scripted {
    type Stream = ScriptedStream;
    type Problem = String;

    fn open(&mut self) -> Result<ScriptedStream, Failure<String>> {
        assert_eq!(
            Arc::strong_count(&self.n_open),
            1,
            "the camera is closed before it is opened again"
        );
        self.opened_at.push(Instant::now());
        match self.steps.pop_front() {
            Some(Opens(mode)) => Ok(ScriptedStream {
                mode,
                _open: Arc::clone(&self.n_open),
            }),
            Some(Refuses(problem)) => Err(problem.to_owned().into()),
            Some(Unsupported) => Err(Failure::Final(Error::Simulation {
                reason: "unsupported colors".into(),
            })),
            other => panic!("opened instead of {other:?}"),
        }
    }

    fn describe(&self, stream: &ScriptedStream) -> Option<String> {
        stream.mode.map(str::to_owned)
    }

    fn next_image(
        &mut self,
        stream: &mut ScriptedStream,
        deadline: Instant,
    ) -> Result<Option<Image>, Failure<String>> {
        match self.steps.pop_front() {
            Some(Color(periods, n_skipped)) => {
                Ok(Some(image(periods, n_skipped, PixelFormat::Gray8)))
            }
            Some(Depth(periods)) => Ok(Some(image(
                periods,
                0,
                PixelFormat::DepthU16 {
                    meters_per_count: 1e-3,
                },
            ))),
            Some(Streams(mode)) => {
                stream.mode = Some(mode);
                Ok(None)
            }
            Some(Quiet) => {
                std::thread::sleep(deadline.saturating_duration_since(Instant::now()));
                Ok(None)
            }
            Some(Lost(problem)) => Err(problem.to_owned().into()),
            Some(Ends) => Err(Failure::Final(Error::Ended {
                camera: "front".into(),
            })),
            other => panic!("read instead of {other:?}"),
        }
    }

    fn reset(&mut self, _n_tries: u32) -> bool {
        self.steps
            .pop_front_if(|step| matches!(step, Resets))
            .is_some()
    }

    fn lost(&self, _waited: Duration, n_tries: u32, last: String) -> Error {
        Error::Simulation {
            reason: format!("lost after {n_tries} attempts: {last}"),
        }
    }
}

/// An image at a multiple of the period of a camera at 10 Hz.
fn image(periods: i64, n_skipped: u64, format: PixelFormat) -> Image {
    Image {
        camera: "front".into(),
        stamp: Stamp(periods * 100_000_000),
        size_px: [1, 1],
        format,
        data: [].into(),
        exposure_secs: None,
        n_skipped,
    }
}

/// A camera that was opened and continues as scripted.
fn camera(
    reconnect_for: Duration,
    steps: impl IntoIterator<Item = Step>,
) -> Reconnecting<Scripted> {
    let policy = ReconnectPolicy {
        camera: "front".into(),
        rate_hz: 10.0,
        reconnect_for,
        first_pause: Duration::ZERO,
        retry_pause: RETRY_PAUSE,
    };
    let steps = std::iter::once(Opens(Some("gray8"))).chain(steps).collect();
    let mut device = Scripted {
        steps,
        opened_at: Vec::new(),
        n_open: Arc::default(),
    };
    let stream = device.open().expect("the first step opens it");
    Reconnecting::new(device, stream, policy)
}

/// Stamps in periods and numbers of skipped images until the script ends with an error.
fn read_all(camera: &mut Reconnecting<Scripted>) -> (Vec<(i64, u64)>, Error) {
    let mut images = Vec::new();
    loop {
        match camera.next_image(Duration::from_secs(60)) {
            Ok(image) => images.push((image.stamp.0 / 100_000_000, image.n_skipped)),
            Err(error) => return (images, error),
        }
    }
}

#[test]
fn camera_that_returns_continues_and_counts_missed_images() {
    let lost_twice = [
        Color(0, 0),
        Color(2, 1),
        Lost("unplugged"),
        Refuses("absent"),
        Refuses("absent"),
        Opens(Some("gray8")),
        Color(12, 4), // By time, nine images are missing. The new stream knows of four.
        Color(13, 0),
        Lost("unplugged"),
        Opens(Some("gray8")),
        Color(16, 5), // By time, two are missing. The new stream knows of five.
        Color(18, 1),
        Ends,
    ];
    let mut camera = camera(UNLIMITED, lost_twice);
    let (images, end) = read_all(&mut camera);
    assert_eq!(images, [(0, 0), (2, 1), (12, 9), (13, 0), (16, 5), (18, 1)]);
    assert!(matches!(end, Error::Ended { .. }), "{end}");
    assert_eq!(
        camera.counts(),
        CameraCounts {
            n_images: 6,
            n_skipped: 16,
            n_reconnections: 2
        }
    );
}

#[test]
fn color_and_depth_missed_in_an_outage_are_counted_separately() {
    let steps = [
        Color(0, 0),
        Depth(1),
        Lost("unplugged"),
        Opens(Some("both")),
        Color(5, 0),
        Depth(5),
        Color(6, 0),
        Depth(7), // A gap in a stream is for the stream to count.
        Ends,
    ];
    let (images, _) = read_all(&mut camera(UNLIMITED, steps));
    assert_eq!(images, [(0, 0), (1, 0), (5, 4), (5, 3), (6, 0), (7, 0)]);
}

#[test]
fn caller_learns_that_the_camera_reconnects() {
    let steps = [
        Quiet,
        Lost("unplugged"),
        Refuses("absent"),
        Opens(None),
        Quiet,
        Streams("gray8"),
        Quiet,
        Color(3, 0),
        Quiet,
        Ends,
    ];
    let mut camera = camera(UNLIMITED, steps);
    let mut is_connected = |timeout| match camera.next_image(timeout) {
        Err(Error::NoImage { camera, waited }) => {
            assert_eq!((camera.as_str(), waited), ("front", timeout));
            true
        }
        Err(Error::Reconnecting { camera, .. }) => {
            assert_eq!(camera, "front");
            false
        }
        other => panic!("{other:?}"),
    };
    assert!(is_connected(BRIEFLY), "quiet, but connected");
    assert!(
        !is_connected(BRIEFLY),
        "unplugged, and the first attempt fails"
    );
    // The pause before the second attempt ends. The camera opens but does not stream yet.
    assert!(!is_connected(2 * RETRY_PAUSE), "opening");
    assert!(is_connected(BRIEFLY), "streaming, but without images");
    assert_eq!(camera.counts().n_reconnections, 1);
    // On a busy machine, one more wait may end before the image.
    let image = std::iter::repeat_with(|| camera.next_image(BRIEFLY)).find_map(Result::ok);
    assert_eq!(
        image.map(|image| image.n_skipped),
        Some(0),
        "the first image ever"
    );
    assert!(matches!(
        camera.next_image(BRIEFLY),
        Err(Error::NoImage { .. })
    ));
}

#[test]
fn attempts_are_paused_but_the_first_is_not() {
    let steps = [
        Lost("unplugged"),
        Refuses("absent"),
        Refuses("absent"),
        Opens(Some("")),
        Ends,
    ];
    let mut camera = camera(UNLIMITED, steps);
    read_all(&mut camera);
    let opened_at = &camera.device().opened_at;
    let pauses: Vec<Duration> = opened_at.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert_eq!(pauses.len(), 3);
    // Pauses are counted from the start of an attempt, which is slightly before the camera is
    // opened.
    assert!(
        pauses[1..].iter().all(|pause| *pause > RETRY_PAUSE / 2),
        "{pauses:?}"
    );

    let mut camera = self::camera(UNLIMITED, [Lost("unplugged"), Opens(Some("")), Color(0, 0)]);
    camera.policy.retry_pause = UNLIMITED;
    camera
        .next_image(Duration::from_secs(60))
        .expect("the first attempt is not delayed");
    let mut camera = self::camera(UNLIMITED, [Lost("unplugged")]);
    camera.policy.first_pause = UNLIMITED;
    assert!(
        matches!(camera.next_image(BRIEFLY), Err(Error::Reconnecting { .. })),
        "unless the policy says so"
    );
}

#[test]
fn camera_that_stays_away_is_given_up_with_the_last_problem() {
    let steps = |n_refusals| {
        let other_modes = std::iter::repeat_with(|| Refuses("other modes")).take(n_refusals);
        [Color(0, 0), Lost("unplugged"), Refuses("absent")]
            .into_iter()
            .chain(other_modes)
    };
    let (images, error) = read_all(&mut camera(ONE_ATTEMPT, steps(0)));
    assert_eq!(images, [(0, 0)]);
    assert!(
        error.to_string().ends_with("lost after 1 attempts: absent"),
        "{error}"
    );
    // After five pauses, the limit is reached: the sixth attempt is the last. A busy machine makes
    // fewer attempts.
    let (images, error) = read_all(&mut camera(5 * RETRY_PAUSE, steps(5)));
    assert_eq!(images, [(0, 0)]);
    assert!(
        error.to_string().ends_with(" attempts: other modes"),
        "{error}"
    );
}

#[test]
fn camera_that_opens_but_sends_nothing_is_given_up() {
    let steps = [
        Color(0, 0),
        Lost("silent"),
        Opens(Some("")),
        Lost("silent again"), // The outage continues: this is a failed attempt.
    ];
    let mut camera = camera(ONE_ATTEMPT, steps);
    let (images, error) = read_all(&mut camera);
    assert_eq!(images, [(0, 0)]);
    assert!(
        error
            .to_string()
            .ends_with("lost after 1 attempts: silent again"),
        "{error}"
    );
    assert_eq!(camera.counts().n_reconnections, 1);
}

#[test]
fn image_ends_the_outage() {
    // With this limit, every failed attempt is the last. The disconnection itself is not an
    // attempt.
    let steps = [
        Lost("one"),
        Opens(Some("")),
        Color(0, 0),
        Lost("two"),
        Opens(Some("")),
        Color(1, 0),
        Ends,
    ];
    let (images, end) = read_all(&mut camera(ONE_ATTEMPT, steps));
    assert_eq!(images, [(0, 0), (1, 0)]);
    assert!(matches!(end, Error::Ended { .. }), "{end}");
}

#[test]
fn final_error_while_reopening_is_returned_at_once() {
    let mut camera = camera(
        UNLIMITED,
        [
            Lost("unplugged"),
            Unsupported,
            Opens(Some("")),
            Color(0, 0),
            Ends,
        ],
    );
    let error = camera
        .next_image(Duration::from_secs(60))
        .expect_err("another attempt cannot help")
        .to_string();
    assert!(error.contains("unsupported colors"), "{error}");
    // A caller that calls again gets another attempt.
    assert_eq!(read_all(&mut camera).0, [(0, 0)]);
}

#[test]
fn reset_takes_the_place_of_an_attempt() {
    let mut camera = camera(
        UNLIMITED,
        [
            Lost("hangs"),
            Refuses("hangs"),
            Resets,
            Opens(Some("")),
            Lost("hangs"),
            Resets,
            Opens(Some("")),
            Ends,
        ],
    );
    read_all(&mut camera);
    assert_eq!(camera.device().opened_at.len(), 4);
    assert_eq!(camera.counts().n_reconnections, 2);
    // The reset counts as an attempt.
    let steps = [Lost("hangs"), Resets, Refuses("still hangs")];
    let error = read_all(&mut self::camera(ONE_ATTEMPT, steps))
        .1
        .to_string();
    assert!(
        error.ends_with("lost after 2 attempts: still hangs"),
        "{error}"
    );
}
