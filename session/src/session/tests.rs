//! Checks that scoring image by image gives the same result as scoring all images at once.

use super::*;
use gpu::{GpuOptions, PassTiming};
use keyframe::Split;
use kinematics::Transform;
use std::path::Path;
use std::time::Duration;
use trainer::{CorrectedKeyframe, Error, Method, PendingCheckpoint, Picture, RenderRequest};

const SIZE_PX: [u32; 2] = [4, 2];
const N_TESTS: u8 = 5;
const MAX_IMAGES_DURING_TRAINING: usize = 3;

/// A model that draws pictures of one gray level and counts them.
#[derive(Default)]
struct Gray {
    level: u8,
    n_drawn: std::rc::Rc<std::cell::Cell<u32>>,
}

impl Method for Gray {
    fn push(&mut self, _keyframe: Arc<Keyframe>) -> Result<(), Error> {
        Ok(())
    }

    fn remove(&mut self, _camera: &str, _stamp: Stamp) -> Result<(), Error> {
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        self.level += 1;
        Ok(n.min(1))
    }

    fn is_idle(&self) -> bool {
        false
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        Ok(self.level.into())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.n_drawn.set(self.n_drawn.get() + 1);
        assert!(!request.depth, "PSNR needs no depth");
        let n = request.size_px[0] as usize * request.size_px[1] as usize;
        Ok(Picture {
            size_px: request.size_px,
            rgba_srgb: vec![self.level; 4 * n],
            depth_m: Vec::new(),
        })
    }

    fn recalibrate(&mut self, _: &[CorrectedKeyframe], _: &Alignment) -> Result<(), Error> {
        Ok(())
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        Ok(Vec::new())
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.level.into(),
            ..Progress::default()
        }
    }

    fn save(&mut self, _folder: &Path) -> Result<(), Error> {
        Ok(())
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        Err(Error::AllPixelsMasked)
    }
}

fn test_keyframe(ix: u8) -> Arc<Keyframe> {
    Arc::new(Keyframe {
        camera: "wrist".into(),
        stamp: Stamp(ix.into()),
        size_px: SIZE_PX,
        focal_px: [4.0; 2],
        principal_px: [2.0, 1.0],
        rgba_srgb: [100_u8.wrapping_add(ix.wrapping_mul(10)), 50, 50, 255]
            .repeat(8)
            .into(),
        depth: None,
        world_from_camera: Transform::identity(),
        twist: None,
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: None,
        split: Split::Test,
        truth: None,
        robot: None,
    })
}

/// A session after one second of training, with an evaluation due, and the counter of its pictures.
fn session_with_evaluation_due(
    stop: &Stop,
    scores_stepwise: bool,
) -> (Session, std::rc::Rc<std::cell::Cell<u32>>) {
    let method = Gray::default();
    let n_drawn = method.n_drawn.clone();
    let quick = Evaluator::psnr_only;
    let evaluators = Evaluators {
        during_training: quick(),
        max_images_during_training: MAX_IMAGES_DURING_TRAINING,
        max_frac_during_training: None,
        at_end: quick(),
    };
    let gpu = Gpu::open(&GpuOptions::default()).expect("an adapter");
    let mut session = Session::new(
        gpu,
        (
            ModelKind::default(),
            AlignedModel::unaligned(Box::new(method)),
        ),
        SessionOptions {
            stop: stop.clone(),
            scores_stepwise,
            ..SessionOptions::new(evaluators, Limits::default(), Box::new(()))
        },
    );
    for ix in 0..N_TESTS {
        session.push(&test_keyframe(ix)).expect("held");
    }
    session.time().start(
        Instant::now()
            .checked_sub(Duration::from_secs(1))
            .expect("the machine has run for a second"),
    );
    session.train_steps(1).expect("a step");
    (session, n_drawn)
}

#[test]
fn stepwise_scoring_equals_scoring_at_once() {
    let stop = Stop::default();
    let (mut at_once, n_at_once) = session_with_evaluation_due(&stop, false);
    at_once.evaluate_when_due().expect("scored");
    assert!(!at_once.scoreboard.is_scoring() && n_at_once.get() == 3);

    let (mut stepwise, n_drawn) = session_with_evaluation_due(&stop, true);
    stepwise.evaluate_when_due().expect("opened");
    assert!(
        stepwise.scoreboard.is_scoring()
            && stepwise.reporter.evaluations().is_empty()
            && n_drawn.get() == 0,
        "images are scored only by score_next"
    );
    for n in 1..=3 {
        assert!(stepwise.scoreboard.is_scoring());
        stepwise.score_next().expect("scored");
        assert_eq!(n_drawn.get(), n, "one image at a time");
    }
    assert!(!stepwise.scoreboard.is_scoring());
    let [one, other] = [&at_once, &stepwise].map(|session| &session.reporter.evaluations()[0]);
    assert_eq!((one.n_images, one.step), (3, 1));
    assert_eq!((other.n_images, other.step), (3, 1));
    assert!(one.scores == other.scores && one.scores.psnr.is_some());
    assert!(
        (other.seconds - 1.0).abs() < 0.9,
        "{} s, expected the time when it was due",
        other.seconds
    );
    assert!(stepwise.scoreboard.psnr() == at_once.scoreboard.psnr());
    stepwise.score_next().expect("nothing to do");
    assert_eq!(
        (stepwise.reporter.evaluations().len(), n_drawn.get()),
        (1, 3)
    );
}

#[test]
fn scoring_in_parallel_equals_scoring_one_by_one() {
    let tests: Vec<Arc<Keyframe>> = (0..50).map(test_keyframe).collect();
    let mut method = AlignedModel::unaligned(Box::new(Gray::default()));
    let mut reported = Vec::new();
    let evaluator = Evaluator::psnr_only();
    let at_once = evaluator
        .score_all(&mut method, tests.iter(), |_, n| reported.push(n))
        .expect("scored");
    let one_by_one: Vec<_> = tests
        .iter()
        .map(|test| evaluator.score(&mut method, test).expect("scored"))
        .collect();
    assert_eq!(at_once, one_by_one, "in the order of the images");
    assert!(
        reported.is_sorted() && reported.last() == Some(&50),
        "{reported:?}"
    );
    let broken = Arc::new(Keyframe {
        rgba_srgb: [].into(),
        ..(*tests[7]).clone()
    });
    let with_broken = [&tests[..7], &[broken], &tests[8..]].concat();
    let error = evaluator
        .score_all(&mut method, with_broken.iter(), |_, _| {})
        .expect_err("an image has no pixels");
    assert!(
        error.to_string().contains(&tests[7].stamp.0.to_string()),
        "{error:#}"
    );
}

#[test]
fn evaluation_is_dropped_when_stopping() {
    let stop = Stop::default();
    let (mut session, n_drawn) = session_with_evaluation_due(&stop, true);
    session.evaluate_when_due().expect("opened");
    session.score_next().expect("scored");
    stop.request();
    session.score_next().expect("dropped");
    assert!(
        !session.scoreboard.is_scoring()
            && session.reporter.evaluations().is_empty()
            && n_drawn.get() == 1
    );
}
