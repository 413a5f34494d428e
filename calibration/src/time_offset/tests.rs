//! Time offsets of simulated and recorded streams.

use super::{PoseSample, TimeOffset, TimeOffsetOptions, estimate_time_offset};
use crate::Error;
use crate::hand_eye::Refusal;
use kinematics::Transform;
use nalgebra::Vector3;
use numbers::random::Random;

/// A smooth motion with frequencies up to 1 Hz.
struct Motion {
    terms: Vec<([f64; 3], [f64; 3], f64, f64)>,
}

impl Motion {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let terms = (0..8)
            .map(|_| {
                let mut vector = |size: f64| [0; 3].map(|_| size * random.normal());
                (
                    vector(0.2),
                    vector(0.1),
                    random.uniform(0.1, 1.0),
                    random.uniform(0.0, 6.0),
                )
            })
            .collect();
        Self { terms }
    }

    fn at(&self, secs: f64) -> Transform {
        let (mut rotation, mut translation) = (Vector3::zeros(), Vector3::zeros());
        for (turn, shift, hz, phase) in &self.terms {
            let wave = (std::f64::consts::TAU * hz * secs + phase).sin();
            rotation += Vector3::from(*turn) * wave;
            translation += Vector3::from(*shift) * wave;
        }
        Transform::new(translation, rotation)
    }
}

const TRUE_OFFSET_SECS: f64 = 12.3456;

fn a_body_from_b_body() -> Transform {
    Transform::new(Vector3::new(0.1, -0.05, 0.2), Vector3::new(0.5, -1.2, 0.8))
}

/// Streams of 20 s. A has 100 Hz. B has 25 Hz, noise, a gap and wrong poses. B's clock is behind
/// A's clock by the true offset, and A's clock is faster by `drift`.
fn streams(seed: u64, noise_rad: f64, drift: f64) -> (Vec<PoseSample>, Vec<PoseSample>) {
    let motion = Motion::new(seed);
    let mut random = Random::new(seed + 1);
    let mut noisy = |pose: Transform| {
        let mut vector =
            |size: f64| Vector3::new(random.normal(), random.normal(), random.normal()) * size;
        pose * Transform::new(vector(noise_rad * 0.5), vector(noise_rad))
    };
    let y = Transform::new(Vector3::new(1.0, 2.0, 0.5), Vector3::new(-0.3, 0.4, 2.0));
    let a = (0..2000).map(|ix| f64::from(ix) * 0.01);
    let a = a
        .map(|secs| PoseSample {
            secs: secs * (1.0 + drift) + TRUE_OFFSET_SECS,
            pose: noisy(motion.at(secs)),
        })
        .collect();
    let b = (0..480)
        .map(|ix| 0.4 + f64::from(ix) * 0.04)
        .filter(|secs| !(6.0..7.5).contains(secs));
    let mut b: Vec<PoseSample> = b
        .map(|secs| PoseSample {
            secs,
            pose: noisy(y.inverse() * motion.at(secs) * a_body_from_b_body()),
        })
        .collect();
    for ix in [30, 77, 150, 151, 300] {
        b[ix].pose *= Transform::new(Vector3::zeros(), Vector3::new(0.5, 1.0, -0.4));
    }
    (a, b)
}

fn refusal(result: Result<TimeOffset, Error>) -> Refusal {
    match result {
        Err(Error::Refused(refusal)) => *refusal,
        other => panic!("not refused: {other:?}"),
    }
}

#[test]
fn offset_is_found_in_both_directions_despite_gap_and_wrong_poses() {
    let (a, b) = streams(1, 2e-3, 0.0);
    let options = TimeOffsetOptions {
        hand_eye: true,
        ..TimeOffsetOptions::default()
    };
    let found = estimate_time_offset(&a, &b, &options).unwrap();
    let off_secs = found.offset_secs - TRUE_OFFSET_SECS;
    assert!(
        off_secs.abs() < 5e-4 && off_secs.abs() < 4.0 * found.sigma_secs,
        "{off_secs} +- {}",
        found.sigma_secs
    );
    assert!(found.drift_ppm.is_none(), "{:?}", found.drift_ppm);
    let bodies = found.hand_eye.unwrap().unwrap();
    let difference = bodies.a_body_from_b_body.inverse() * a_body_from_b_body();
    assert!(
        difference.translation.vector.norm() < 3e-3 && difference.rotation.angle() < 5e-3,
        "{difference}"
    );
    let reversed = estimate_time_offset(&b, &a, &TimeOffsetOptions::default()).unwrap();
    assert!((reversed.offset_secs + found.offset_secs).abs() < 1e-6);
}

#[test]
fn stated_sigma_matches_the_errors() {
    let n = 30;
    let squares = (0..n).map(|seed| {
        let (a, b) = streams(100 + seed, 3e-3, 0.0);
        let found = estimate_time_offset(&a, &b, &TimeOffsetOptions::default())
            .unwrap_or_else(|error| panic!("{seed}: {error}"));
        ((found.offset_secs - TRUE_OFFSET_SECS) / found.sigma_secs).powi(2)
    });
    let ratio = (squares.sum::<f64>() / n as f64).sqrt();
    // The standard error of the ratio is 0.13. The standard error of the sigmas, which are from 20
    // parts each, is added to it.
    assert!(
        (0.6..1.5).contains(&ratio),
        "errors are {ratio} times the stated ones"
    );
}

#[test]
fn drift_is_reported_if_it_is_significant() {
    let (a, b) = streams(3, 2e-3, 200e-6);
    let found = estimate_time_offset(&a, &b, &TimeOffsetOptions::default()).unwrap();
    let [drift, sigma] = found.drift_ppm.unwrap();
    assert!((drift - 200.0).abs() < 4.0 * sigma, "{drift} +- {sigma}");
}

#[test]
fn motion_without_information_is_refused() {
    let still = |secs: f64| PoseSample {
        secs,
        pose: Transform::translation(secs.sin(), 0.0, 0.0),
    };
    let constant = |secs: f64| PoseSample {
        secs,
        pose: Transform::rotation(Vector3::z() * 0.8 * secs),
    };
    let periodic = |secs: f64| PoseSample {
        secs,
        pose: Transform::rotation(Vector3::z() * (2.0 * secs).sin()),
    };
    let stream = |at: &dyn Fn(f64) -> PoseSample| -> Vec<PoseSample> {
        (0..1000).map(|ix| at(f64::from(ix) * 0.02)).collect()
    };
    let of = |at: &dyn Fn(f64) -> PoseSample| {
        refusal(estimate_time_offset(
            &stream(at),
            &stream(at),
            &TimeOffsetOptions::default(),
        ))
        .why
    };
    assert!(of(&still).contains("hardly rotates"), "{}", of(&still));
    assert!(of(&constant).contains("constant rate"), "{}", of(&constant));
    assert!(of(&periodic).contains("repeats"), "{}", of(&periodic));
    let (a, _) = streams(1, 1e-3, 0.0);
    let (_, b) = streams(2, 1e-3, 0.0);
    let unrelated = refusal(estimate_time_offset(&a, &b, &TimeOffsetOptions::default())).why;
    assert!(
        unrelated.contains("not correlated") || unrelated.contains("still differ"),
        "{unrelated}"
    );
}

#[test]
fn invalid_streams_are_rejected() {
    let (a, mut b) = streams(1, 1e-3, 0.0);
    let short = estimate_time_offset(&a, &b[..5], &TimeOffsetOptions::default());
    assert!(
        matches!(short, Err(Error::TimeOffsetInput { why }) if why.contains("stream B has 5 poses"))
    );
    b[7].secs = f64::NAN;
    let invalid = estimate_time_offset(&a, &b, &TimeOffsetOptions::default());
    assert!(
        matches!(invalid, Err(Error::TimeOffsetInput { why }) if why.contains("pose 7 of stream B"))
    );
}

/// Reads rows `t,x,y,z,qx,qy,qz,qw` of the test data. `None` if the data are absent.
fn recorded(name: &str) -> Option<Vec<PoseSample>> {
    let path = test_support::data_folder(&format!("handeye/{name}"))?;
    let text = std::fs::read_to_string(path).unwrap();
    let row = |line: &str| {
        let v: Vec<f64> = line
            .split(',')
            .map(|value| value.trim().parse().unwrap())
            .collect();
        let rotation = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
            v[7], v[4], v[5], v[6],
        ));
        PoseSample {
            secs: v[0],
            pose: Transform::from_parts(Vector3::new(v[1], v[2], v[3]).into(), rotation),
        }
    };
    Some(text.lines().map(row).collect())
}

#[test]
fn halves_of_a_recording_agree_within_their_uncertainty() {
    let folder = "ethz_prime_sense_1/prime_sense_1/2017-04-09-18-13-10";
    let Some(a) = recorded(&format!("{folder}_vicon_prime_sense.csv")) else {
        return;
    };
    let Some(b) = recorded(&format!("{folder}_W_camera_rgb_image_raw.csv")) else {
        return;
    };
    let options = TimeOffsetOptions {
        hand_eye: true,
        ..TimeOffsetOptions::default()
    };
    let all = estimate_time_offset(&a, &b, &options).unwrap();
    let halves = [&b[..b.len() / 2], &b[b.len() / 2..]]
        .map(|half| estimate_time_offset(&a, half, &options).unwrap());
    let [first, second] = &halves;
    let difference_secs = first.offset_secs - second.offset_secs;
    let sigma_secs = first.sigma_secs.hypot(second.sigma_secs);
    let details = || {
        halves
            .iter()
            .chain([&all])
            .map(|h| format!("{h:?}"))
            .collect::<Vec<String>>()
            .join("\n")
    };
    assert!(
        difference_secs.abs() < 0.002,
        "{difference_secs}: {}",
        details()
    );
    assert!(
        difference_secs.abs() < 2.0 * sigma_secs,
        "{difference_secs}, stated {sigma_secs}: {}",
        details()
    );
    eprintln!("{}", details());
}

#[test]
fn hand_eye_of_an_arm_that_rotates_about_one_axis_is_refused() {
    let folder = "ethz_arm_sim/robot_arm_w_color_camera_sim/robot_arm_sim";
    let Some(hand) = recorded(&format!("{folder}_hand.csv")) else {
        return;
    };
    let Some(camera) = recorded(&format!("{folder}_camera.csv")) else {
        return;
    };
    let options = TimeOffsetOptions {
        hand_eye: true,
        ..TimeOffsetOptions::default()
    };
    let found = estimate_time_offset(&hand, &camera, &options).unwrap();
    eprintln!("{found:?}");
    let refusal = found.hand_eye.unwrap().unwrap_err();
    assert!(
        refusal.why.contains("all rotations are around") && refusal.axis.is_some(),
        "{refusal}"
    );
}

#[test]
fn stamps_in_other_units_are_named() {
    for (unit, factor) in [
        ("milliseconds", 1e3),
        ("microseconds", 1e6),
        ("nanoseconds", 1e9),
    ] {
        for scales_b in [false, true] {
            let (mut a, mut b) = streams(1, 1e-3, 0.0);
            let (scaled, name) = if scales_b {
                (&mut b, "stream B")
            } else {
                (&mut a, "stream A")
            };
            scaled.iter_mut().for_each(|sample| sample.secs *= factor);
            let text = message(&a, &b);
            assert!(
                text.contains(unit) && text.contains(name) && text.contains("divide"),
                "{text}"
            );
        }
        let (mut a, mut b) = streams(1, 1e-3, 0.0);
        a.iter_mut()
            .chain(&mut b)
            .for_each(|sample| sample.secs *= factor);
        assert!(message(&a, &b).contains(unit));
    }
}

#[test]
fn stamps_that_advance_at_another_rate_or_repeat_are_named() {
    let (a, b) = streams(1, 1e-3, 0.0);
    let mut twice = b.clone();
    twice.iter_mut().for_each(|sample| sample.secs *= 2.0);
    let text = message(&a, &twice);
    assert!(text.contains("twice as fast"), "{text}");
    // The stamps are rounded to whole seconds.
    let mut rounded = b.clone();
    rounded
        .iter_mut()
        .for_each(|sample| sample.secs = sample.secs.floor());
    let text = message(&a, &rounded);
    assert!(
        text.contains("stream B") && text.contains("whole seconds"),
        "{text}"
    );
    // Exact repetitions of rows do not affect the result.
    let repeated: Vec<PoseSample> = b.iter().flat_map(|sample| [*sample, *sample]).collect();
    let found = estimate_time_offset(&a, &repeated, &TimeOffsetOptions::default()).unwrap();
    assert!(
        (found.offset_secs - TRUE_OFFSET_SECS).abs() < 0.005,
        "{}",
        found.offset_secs
    );
}

fn message(a: &[PoseSample], b: &[PoseSample]) -> String {
    estimate_time_offset(a, b, &TimeOffsetOptions::default())
        .unwrap_err()
        .to_string()
}

#[test]
fn quaternions_in_another_order_are_named() {
    let (a, b) = streams(5, 0.003, 0.0);
    let w_first = |samples: &[PoseSample]| -> Vec<PoseSample> {
        let written = |sample: &PoseSample| {
            let [x, y, z, w]: [f64; 4] = sample.pose.rotation.coords.into();
            let mut pose = sample.pose;
            pose.rotation =
                nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(z, w, x, y));
            PoseSample { pose, ..*sample }
        };
        samples.iter().map(written).collect()
    };
    let options = TimeOffsetOptions::default();
    for (name, a, b) in [
        ("stream A", w_first(&a), b.clone()),
        ("stream B", a.clone(), w_first(&b)),
    ] {
        let refused = refusal(estimate_time_offset(&a, &b, &options));
        assert!(
            refused
                .why
                .starts_with(&format!("the quaternions of {name} are in the order w")),
            "{refused}"
        );
    }
}

#[test]
fn offsets_beyond_the_limit_are_refused() {
    let (a, b) = streams(6, 0.001, 0.0);
    let within = |most: f64| {
        let options = TimeOffsetOptions {
            max_offset_secs: Some(most),
            ..TimeOffsetOptions::default()
        };
        estimate_time_offset(&a, &b, &options)
    };
    // The limit is exceeded by half of the time between two poses.
    let refused = refusal(within(TRUE_OFFSET_SECS - 0.005));
    assert!(
        refused
            .why
            .contains("more than the largest offset to search"),
        "{refused}"
    );
    for most in [TRUE_OFFSET_SECS, TRUE_OFFSET_SECS + 0.005] {
        assert!(
            (within(most).unwrap().offset_secs - TRUE_OFFSET_SECS).abs() < 2e-3,
            "{most}"
        );
    }
}

#[test]
fn small_limits_and_single_wrong_stamps_are_named() {
    let (a, mut b) = streams(6, 0.001, 0.0);
    let options = TimeOffsetOptions {
        max_offset_secs: Some(0.001),
        ..TimeOffsetOptions::default()
    };
    let refused = refusal(estimate_time_offset(&a, &b, &options));
    assert!(!refused.why.contains("overlap"), "{refused}");
    b[100].secs = 1e308;
    let error = estimate_time_offset(&a, &b, &TimeOffsetOptions::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("stream B has a pose with the stamp 1e308"),
        "{error}"
    );
}
