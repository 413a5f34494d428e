//! Detects mistakes in the stamps of a stream: wrong units, rounded stamps, several bodies in one
//! file.

use super::PoseSample;
use crate::hand_eye::Refusal;

/// Units in which stamps are often given by mistake, and the number of these units per second.
const UNITS: [(&str, f64); 3] = [
    ("milliseconds", 1e3),
    ("microseconds", 1e6),
    ("nanoseconds", 1e9),
];
/// Times between poses of cameras, trackers and robots, seconds. They correspond to rates of 2.5 to
/// 2500 Hz. The range spans a factor of 1000, which is also the ratio of neighboring units. A step
/// therefore fits only one unit.
const USUAL_STEPS_SECS: std::ops::RangeInclusive<f64> = 0.0004..=0.4;

/// The unit of stamps that are not seconds. Stamps in seconds with steps of several seconds look
/// like milliseconds. This function is therefore used only to explain streams that cannot be used.
///
/// * `step_secs`: typical difference of consecutive stamps.
pub(super) fn unit_mistake(name: &str, step_secs: f64) -> Option<Refusal> {
    if USUAL_STEPS_SECS.contains(&step_secs) {
        return None;
    }
    let (unit, per_sec) = UNITS
        .into_iter()
        .find(|(_, per_sec)| USUAL_STEPS_SECS.contains(&(step_secs / per_sec)))?;
    Some(Refusal::new(
        format!(
            "the stamps of stream {name} are probably in {unit}: they advance by {} from one pose to the next, which is {:.4} s in {unit}",
            rounded(step_secs),
            step_secs / per_sec
        ),
        format!("divide the stamps by {per_sec:e}, so that they are in seconds"),
    ))
}

/// A step in any unit, as text.
fn rounded(value: f64) -> String {
    if value < 1e4 {
        format!("{value:.1}")
    } else {
        format!("{value:.3e}")
    }
}

/// Describes a single stamp that is far from all others.
pub(super) fn distant_stamp(name: &str, sorted: &[PoseSample]) -> Option<String> {
    const MIN_POSES: usize = 4;
    /// Distance from the other stamps, relative to their range.
    const MAX_FACTOR: f64 = 1000.0;
    let n = sorted.len();
    (n >= MIN_POSES).then_some(())?;
    let is_distant = |gap: f64, rest: f64| gap > MAX_FACTOR * rest;
    let secs = |ix: usize| sorted[ix].secs;
    let (distant, [first, last]) = if is_distant(secs(n - 1) - secs(n - 2), secs(n - 2) - secs(0)) {
        (secs(n - 1), [secs(0), secs(n - 2)])
    } else if is_distant(secs(1) - secs(0), secs(n - 1) - secs(1)) {
        (secs(0), [secs(1), secs(n - 1)])
    } else {
        return None;
    };
    Some(format!(
        "stream {name} has a pose with the stamp {distant:e}, but all others are between {first:.3} and {last:.3} s; remove this pose"
    ))
}

/// Whether two neighboring poses differ, but have the same stamp. Equal poses with equal stamps are
/// repetitions, which some recorders write.
fn is_conflict(pair: &[PoseSample]) -> bool {
    const SAME_RAD: f64 = 1e-9;
    const SAME_M: f64 = 1e-9;
    let difference = pair[0].pose.inverse() * pair[1].pose;
    pair[0].secs == pair[1].secs
        && (difference.rotation.angle() > SAME_RAD || difference.translation.vector.norm() > SAME_M)
}

/// Describes stamps that several different poses share. `None` if there are only a few, which are
/// removed later.
pub(super) fn repeated_stamps(name: &str, sorted: &[PoseSample]) -> Option<String> {
    /// Up to this fraction, repeated stamps are removed by deduplication.
    const MAX_FRAC: f64 = 0.2;
    let mut conflicts = sorted.windows(2).filter(|pair| is_conflict(pair));
    let n_conflicts = conflicts.clone().count();
    if n_conflicts as f64 <= MAX_FRAC * sorted.len() as f64 {
        return None;
    }
    let example = conflicts.next()?[0].secs;
    let cause = if sorted.iter().all(|sample| sample.secs.fract() == 0.0) {
        "the stamps are probably rounded to whole seconds"
    } else {
        "the file probably contains several bodies, or its stamps are rounded"
    };
    Some(format!(
        "{n_conflicts} of {} poses of stream {name} have the same stamp as another pose (for example {example}), expected one pose per stamp; {cause}",
        sorted.len()
    ))
}
